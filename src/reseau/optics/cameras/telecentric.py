"""The camera with parallel rays, ``telecentric``: mapping and registration."""

from __future__ import annotations

from collections.abc import Mapping as Named
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

from ...core.data import Array
from .brown import PARAMETERS, Brown, brown_constants, brown_kernel, with_additional
from .grid import PixelGrid
from .registry import CameraModel, Option, Parameter, register_camera


@dataclass(frozen=True, eq=False)
class Telecentric(Brown):
    """Camera with a lens that is telecentric in object space: every ray is parallel to the optical axis.

    With xs = m·xc, ys = −m·yc (mm) of a point (xc, yc, zc) in the system of the camera, and the distortion Δ
    of :class:`BrownDistortion`, its image is x' = x0 + xs + Δx, y' = y0 + ys + Δy: Brown's camera with the
    magnification m in place of c/zc. The image does not depend on zc: one image does not determine the
    distance of the camera along its axis. It determines x0, y0 only as the centre of the distortion.

    Li, D. & Tian, J. (2013), An accurate calibration method for a camera with telecentric lenses, Optics and
    Lasers in Engineering 51(5), eq. (1)–(6).

    Parameters
    ----------
    values : array_like (10,)
        m (mm per unit of object space), x0, y0 (mm), then the parameters of the distortion.
    side, balance_radius_mm, grid
        As for :class:`Brown`.

    Examples
    --------
    >>> camera = Telecentric(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"m": 0.5})
    >>> camera([[1.0, 0.0]])
    array([[369.5, 239.5]])
    """

    ALL_NAMES: ClassVar[tuple[str, ...]] = ("m", *(p.name for p in PARAMETERS[1:]))

    @property
    def names(self) -> tuple[str, ...]:
        """The ten names."""
        return self.ALL_NAMES

    @property
    def parallel(self) -> bool:
        """True: the rays are parallel to the axis."""
        return True


def _build(values: Array, grid: PixelGrid, options: Named[str, Any]) -> Telecentric:
    return Telecentric(values, options["side"], options["balance_radius_mm"], grid)


def _start(f: float, grid: PixelGrid) -> dict[str, float]:
    return {"m": f * grid.pitch_mm[0]}


register_camera(
    CameraModel(
        "telecentric",
        (
            Parameter("m", "", "scale", usual=True, required=True),
            # Without distortion they cannot be distinguished from a shift of the camera.
            *(replace(p, usual=p.name == "K1") for p in PARAMETERS[1:]),
        ),
        _build,
        _start,
        (Option("side", "object", ("object", "image")), Option("balance_radius_mm", 0.0)),
        needs_pitch=True,
        combine=with_additional,
        kernel=brown_kernel,
        constants=partial(brown_constants, higher=False),
        parallel=True,
    )
)
