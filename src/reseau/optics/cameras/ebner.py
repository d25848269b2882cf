"""Ebner's additional parameters of self-calibration, ``ebner12``: mapping, kernel and registration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ...core.compiled import kernel
from ...core.data import Array
from ...core.errors import UsageError
from ..mapping import Derivatives, PlaneMapping, as_points, as_values
from .kernels import CameraColumns, corrected
from .registry import AdditionalModel, register_additional


@dataclass(frozen=True, eq=False)
class EbnerCorrection(PlaneMapping):
    """Ebner's twelve parameters, orthogonal over a grid of nine points: (x, y) + (Δx, Δy), mm.

    With the base b of the grid, k = 2b²/3 and l = 4b²/3::

        Δx =  b1·x + b2·y − b3(2x²−l) + b4·xy + b5(y²−k) + b7·x(y²−k) + b9·y(x²−k) + b11(x²−k)(y²−k)
        Δy = −b1·y + b2·x + b3·xy − b4(2y²−l) + b6(x²−k) + b8·y(x²−k) + b10·x(y²−k) + b12(x²−k)(y²−k)

    Ebner (1976), Self calibrating block adjustment, Bildmessung und Luftbildwesen 44.

    Parameters
    ----------
    values : array_like (12,)
        b1 … b12.
    base_mm : float
        b, distance of neighbouring points of the grid.

    Raises
    ------
    UsageError
        For a base that is not above zero.

    Examples
    --------
    >>> EbnerCorrection(base_mm=9.0).with_values({"b1": 1e-3})([[2.0, 1.0]])
    array([[2.002, 0.999]])
    """

    names: ClassVar[tuple[str, ...]] = tuple(f"b{k}" for k in range(1, 13))
    values: Array = field(default_factory=lambda: np.zeros(12))
    base_mm: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))
        if not self.base_mm > 0:
            raise UsageError(f"{self.base_mm:g} is not above zero", where="base of the additional parameters")

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        return corrected(_ebner, self.values, self.base_mm, 0, as_points(xy))


B1, B2, B3, B4, B5, B6, B7, B8, B9, B10, B11, B12 = range(len(EbnerCorrection.names))


@kernel
def _ebner(
    e: int, x: float, y: float, cameras: CameraColumns, dx: float, dy: float, sxx: float, sxy: float,
    syx: float, syy: float, more: Array,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """See :func:`reseau.optics.cameras.kernels.additional`."""
    b, base = cameras.extra, cameras.base[e, 0]
    k, m = 2.0 * base * base / 3.0, 4.0 * base * base / 3.0
    xk, yk = x * x - k, y * y - k
    more[:, :] = 0.0
    more[0, B1], more[1, B1] = x, -y
    more[0, B2], more[1, B2] = y, x
    more[0, B3], more[1, B3] = m - 2.0 * x * x, x * y
    more[0, B4], more[1, B4] = x * y, m - 2.0 * y * y
    more[0, B5], more[1, B6] = yk, xk
    more[0, B7], more[1, B8] = x * yk, y * xk
    more[0, B9], more[1, B10] = y * xk, x * yk
    more[0, B11], more[1, B12] = xk * yk, xk * yk
    for i in range(B12 + 1):
        dx += b[e, i] * more[0, i]
        dy += b[e, i] * more[1, i]
    sxx += (
        b[e, B1]
        - 4.0 * b[e, B3] * x
        + b[e, B4] * y
        + b[e, B7] * yk
        + 2.0 * b[e, B9] * x * y
        + 2.0 * b[e, B11] * x * yk
    )
    sxy += (
        b[e, B2]
        + b[e, B4] * x
        + 2.0 * b[e, B5] * y
        + 2.0 * b[e, B7] * x * y
        + b[e, B9] * xk
        + 2.0 * b[e, B11] * xk * y
    )
    syx += (
        b[e, B2]
        + b[e, B3] * y
        + 2.0 * b[e, B6] * x
        + 2.0 * b[e, B8] * x * y
        + b[e, B10] * yk
        + 2.0 * b[e, B12] * x * yk
    )
    syy += (
        -b[e, B1]
        + b[e, B3] * x
        - 4.0 * b[e, B4] * y
        + b[e, B8] * xk
        + 2.0 * b[e, B10] * x * y
        + 2.0 * b[e, B12] * xk * y
    )
    return dx, dy, sxx, sxy, syx, syy


register_additional(AdditionalModel("ebner12", EbnerCorrection.names, EbnerCorrection, _ebner))
