"""Compiled cameras: kernels for one observation.

A kernel is a plain Python function, decorated with :func:`reseau.core.compiled.kernel`; loops over
observations are compiled with the kernel of a camera model in the slot :func:`camera`.

The kernel of a camera model has the signature ``kernel(k, c, e, u, v, xy, cameras, by_uv, d, more, off)``. It
receives an ideal direction (u, v) and the measured image point ``xy[k]`` (px), and writes

- ``off`` (2,): the misfit v, computed less measured (px),
- ``by_uv`` (2, 2): its derivatives by u and v,
- ``d`` (2, parameters): its derivatives by the parameters of the model, in their order,
- ``more`` (2, additional parameters): those by the additional parameters; only where e ≥ 0.

``c`` is the row of the camera in `cameras`, a :class:`CameraColumns`, and ``e`` the row of the set of
additional parameters, or −1. A kernel indexes the arrays of `cameras` by element: a row taken out of them
would count its references in all threads at once.
"""

from __future__ import annotations

from typing import NamedTuple

from ...core.compiled import kernel
from ...core.data import Array


class CameraColumns(NamedTuple):
    """Cameras and sets of additional parameters, as the kernels receive them.

    Parameters
    ----------
    values : ndarray (c, p)
        Parameters, in the order of each model; padded to the longest.
    constants : ndarray (c, q)
        What a model computes from its options; padded to the longest.
    grid : ndarray (c, 4)
        Centre of the image (px) and pitch (mm).
    extra : ndarray (e, a)
        Values of the additional parameters; padded to the longest.
    base : ndarray (e, 2)
        Base of the additional parameters (mm), and their degree.
    """

    values: Array
    constants: Array
    grid: Array
    extra: Array
    base: Array


@kernel
def camera(
    k: int, c: int, e: int, u: float, v: float, xy: Array, cameras: CameraColumns, by_uv: Array, d: Array,
    more: Array, off: Array,
) -> None:  # fmt: skip
    """Slot for the kernel of a camera model."""


@kernel
def additional(
    e: int, x: float, y: float, cameras: CameraColumns, dx: float, dy: float, sxx: float, sxy: float,
    syx: float, syy: float, more: Array,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Slot for the kernel of additional parameters; by itself it adds nothing.

    Adds their effect at the photo-coordinates x, y (mm) to dx, dy and to the derivatives of these by x and y,
    and writes the derivatives by the parameters into `more`.
    """
    return dx, dy, sxx, sxy, syx, syy
