"""What files of cameras share: names of parameters, OpenCV's coefficients, places on a rig."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np

from ...bundle import Camera
from ...core.data import Array
from ...core.errors import FormatError

CENTRE = ("fx", "fy", "cx", "cy")
FISHEYE = ("k1", "k2", "k3", "k4")
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2")
RATIONAL = (*RADIAL_TANGENTIAL, "k3", "k4", "k5", "k6")
THIN_PRISM = (*RATIONAL, "s1", "s2", "s3", "s4")
TILTED = (*THIN_PRISM, "tau_x", "tau_y")
"""Coefficients of OpenCV's model in the order of OpenCV: 4, 8, 12 and 14 of them."""


class Mounted(NamedTuple):
    """A camera of a rig: x_c = R (x − b) of a point x in the axes of its first camera.

    Parameters
    ----------
    camera : Camera
        The camera.
    rotation : ndarray (3, 3)
        R, from the axes of the first camera to its own.
    base : ndarray (3,)
        b, its projection centre, mm.

    Examples
    --------
    >>> camera = Camera.of("left", (640, 480), "opencv", {"fx": 800.0, "fy": 800.0})
    >>> Mounted(camera, np.eye(3), np.array([120.0, 0.0, 0.0])).translation
    array([-120.,    0.,    0.])
    """

    camera: Camera
    rotation: Array
    base: Array

    @property
    def translation(self) -> Array:
        """t of x_c = R x + t, mm."""
        # A sum with 0 has no negative zeros, whose sign would depend on the BLAS in use.
        return np.asarray(0.0 - self.rotation @ self.base)


def given(camera: Camera, *names: str) -> list[float]:
    """Values of parameters, zero where the model has none."""
    values = camera.parameters
    return [values.get(name, 0.0) for name in names]


def opencv_camera(
    name: str,
    size: Sequence[int],
    focal: Sequence[float],
    centre: Sequence[float],
    coefficients: Sequence[float],
    where: object,
    *,
    fisheye: bool = False,
) -> Camera:
    """Create a camera from coefficients in the order of OpenCV.

    Raises
    ------
    FormatError
        When their number is none that OpenCV has, or a number is not finite.
    """
    names, known = (FISHEYE, (4,)) if fisheye else (TILTED, (0, 4, 5, 8, 12, 14))
    if len(coefficients) not in known:
        raise FormatError(f"has {len(coefficients)} coefficients of distortion", where=where)
    model = "fisheye" if fisheye else "opencv" if len(coefficients) <= len(RATIONAL) else "opencv_full"
    numbers = [*focal, *centre, *coefficients]
    if not all(isfinite(number) for number in numbers) or min(focal) <= 0 or min(size) < 1:
        raise FormatError("has no finite camera matrix and image size", where=where)
    values = dict(zip((*CENTRE, *names), map(float, numbers), strict=False))
    return Camera.of(name, (int(size[0]), int(size[1])), model, values)
