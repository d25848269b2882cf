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

A kernel is also the mapping of its camera: :func:`evaluated` runs it as it is, with columns of n points in
place of the numbers u and v. Where a case depends on the point it says :func:`either`, not ``if``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...core.compiled import Kernel, kernel
from ...core.data import Array
from ..mapping import Derivatives


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


class _Either(Kernel[[Any, Any, Any], Any]):
    """A choice that columns can be given, too."""

    def __call__(self, *arguments: Any) -> Any:
        """Choose for each point."""
        return np.where(*arguments)


@_Either
def either(condition: Any, one: Any, other: Any) -> Any:
    """One of two values; both are computed."""
    return one if condition else other


class _Unwanted:
    """Derivatives that a kernel writes and nobody reads."""

    def __setitem__(self, at: Any, value: Any) -> None:
        pass

    def __getitem__(self, at: Any) -> float:
        return 0.0


def evaluated(
    own: Kernel[..., Any], values: Array, xy: Array, constants: ArrayLike = (), *, parameters: bool = True
) -> Derivatives:
    """Evaluate the kernel of a camera without pixels of its own for all points at once.

    Parameters
    ----------
    own : Kernel
        The kernel; its misfit must be that of the projection.
    values : ndarray (p,)
        All parameters that the kernel reads.
    xy : ndarray (n, 2)
        Directions.
    constants : array_like
        What the model computes from its options.
    parameters : bool
        Whether the derivatives with respect to the parameters are wanted; otherwise they are empty.
    """
    n, none = len(xy), np.zeros((1, 0))
    columns = CameraColumns(values[None], np.asarray(constants)[None], none, none, none)
    value, d_xy, d = np.empty((n, 2)), np.empty((n, 2, 2)), np.zeros((n, 2, len(values) if parameters else 0))
    off, by_uv, by_values = (np.moveaxis(each, 0, -1) for each in (value, d_xy, d))
    wanted = by_values if parameters else _Unwanted()
    with np.errstate(all="ignore"):
        own(0, 0, -1, *xy.T, np.zeros((1, 2)), columns, by_uv, wanted, none, off)
    return Derivatives(value, d_xy, d)


def corrected(own: Kernel[..., Any], values: Array, base: float, degree: int, xy: Array) -> Derivatives:
    """Evaluate the kernel of additional parameters at points (n, 2), to which it is added."""
    n, none = len(xy), np.zeros((1, 0))
    more = np.zeros((n, 2, len(values)))
    columns = CameraColumns(none, none, none, values[None], np.array([[base, degree]]))
    found = own(0, *xy.T, columns, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.moveaxis(more, 0, -1))
    dx, dy, *slope = (np.broadcast_to(each, n) for each in found)
    d_xy = np.eye(2) + np.stack(slope, axis=1).reshape(n, 2, 2)
    return Derivatives(xy + np.stack([dx, dy], axis=1), d_xy, more)


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
