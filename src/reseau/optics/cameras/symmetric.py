"""Cameras that are symmetric about their axis: the image radius depends on the angle of the ray alone."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ...core.data import Array
from ..mapping import Derivatives, as_points, as_values
from .grid import PixelGrid
from .kernels import CameraColumns, kernel
from .radial import Radial
from .registry import Parameter

__all__ = ["FRAME", "Symmetric", "placed", "start_of"]

# Parameters of the image plane, before those of the radial function.
FRAME = (
    Parameter("fx", "px", "scale", usual=True, required=True),
    Parameter("fy", "px", "scale", usual=True, required=True),
    Parameter("cx", "px", "centre", usual=True, required=True),
    Parameter("cy", "px", "centre", usual=True, required=True),
)


@dataclass(frozen=True, eq=False)
class Symmetric(Radial):
    """Base of x = fx·u·q(s) + cx, y = fy·v·q(s) + cy with s = u² + v² and q(0) = 1."""

    values: Array = field(default_factory=lambda: np.zeros(0))

    names: ClassVar[tuple[str, ...]]

    def __post_init__(self) -> None:
        given = self.values if np.size(self.values) else [1.0, 1.0] + [0.0] * (len(self.names) - 2)
        object.__setattr__(self, "values", as_values(self.names, given))

    @abstractmethod
    def factor(self, s: Array) -> tuple[Array, Array, Array]:
        """Return q (n,), dq/ds (n,) and the derivatives of q by the parameters after the frame (n, k)."""

    @abstractmethod
    def outwards(self, m: Array) -> Array:
        """Return approximate tangents of the angles of image radii (n,), in units of the focal length."""

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        uv = as_points(xy)
        q, by_s, by_values = self.factor((uv**2).sum(axis=1))
        focal, centre = self.values[:2], self.values[2:4]
        bent = uv * q[:, None]
        slope = q[:, None, None] * np.eye(2) + 2 * by_s[:, None, None] * uv[:, :, None] * uv[:, None, :]
        d = np.zeros((len(uv), 2, len(self.values)))
        d[:, [0, 1], [0, 1]] = bent
        d[:, [0, 1], [2, 3]] = 1.0
        d[:, :, 4:] = (focal * uv)[:, :, None] * by_values[:, None, :]
        return Derivatives(bent * focal + centre, slope * focal[:, None], d)

    def _start(self, xy: Array) -> Array:
        m = (xy - self.values[2:4]) / self.values[:2]
        size = np.hypot(m[:, 0], m[:, 1])
        with np.errstate(all="ignore"):
            out = self.outwards(size)
            part = np.where(size > 0, out / size, 1.0)
        return self.within(m * np.where(np.isfinite(part), part, 1.0)[:, None])


@kernel
def placed(
    k: int, c: int, u: float, v: float, q: float, by_s: float, xy: Array, cameras: CameraColumns,
    by_uv: Array, d: Array, off: Array,
) -> None:  # fmt: skip
    """Write misfit, slope and the derivatives by the frame, from q and dq/ds."""
    p = cameras.values
    by_uv[0, 0] = p[c, 0] * (q + 2.0 * by_s * u * u)
    by_uv[0, 1] = p[c, 0] * 2.0 * by_s * u * v
    by_uv[1, 0] = p[c, 1] * 2.0 * by_s * u * v
    by_uv[1, 1] = p[c, 1] * (q + 2.0 * by_s * v * v)
    d[:, :] = 0.0
    d[0, 0], d[1, 1], d[0, 2], d[1, 3] = u * q, v * q, 1.0, 1.0
    off[0] = p[c, 0] * u * q + p[c, 2] - xy[k, 0]
    off[1] = p[c, 1] * v * q + p[c, 3] - xy[k, 1]


def start_of(f: float, grid: PixelGrid) -> dict[str, float]:
    """Approximate values for a focal length of f pixels."""
    return {"fx": f, "fy": f, "cx": (grid.width - 1) / 2, "cy": (grid.height - 1) / 2}
