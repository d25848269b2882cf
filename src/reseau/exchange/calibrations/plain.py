"""What the files of other programs hold of a camera: a registered model, its values and the image size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import NamedTuple

import numpy as np

from ...core.data import Array
from ...core.errors import FormatError
from ...optics import PixelGrid, camera_model
from ...optics.mapping import PlaneMapping

RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2")
RATIONAL = (*RADIAL_TANGENTIAL, "k3", "k4", "k5", "k6")
THIN_PRISM = (*RATIONAL, "s1", "s2", "s3", "s4")
TILTED = (*THIN_PRISM, "tau_x", "tau_y")
"""Coefficients of OpenCV's model in the order of OpenCV: 4, 8, 12 and 14 of them."""


class Mounted(NamedTuple):
    """A camera of a rig: x_c = R (x − b) of a point x in the axes of its first camera.

    Parameters
    ----------
    camera : PlainCamera
        The camera.
    rotation : ndarray (3, 3)
        R, from the axes of the first camera to its own.
    base : ndarray (3,)
        b, its projection centre, mm.

    Examples
    --------
    >>> camera = PlainCamera("left", 640, 480, "opencv", {"fx": 800.0, "fy": 800.0})
    >>> Mounted(camera, np.eye(3), np.array([120.0, 0.0, 0.0])).translation
    array([-120.,    0.,    0.])
    """

    camera: PlainCamera
    rotation: Array
    base: Array

    @property
    def translation(self) -> Array:
        """t of x_c = R x + t, mm."""
        # A sum with 0 has no negative zeros, whose sign would depend on the BLAS in use.
        return np.asarray(0.0 - self.rotation @ self.base)


@dataclass(frozen=True)
class PlainCamera:
    """A camera in one of the registered models, without uncertainty.

    Parameters
    ----------
    name : str
        Name of the camera.
    width, height : int
        Size of the image, pixels.
    model : str
        Name of the model.
    values : mapping of str to float
        Its parameters; those that are missing are zero.
    pitch_mm : (float, float)
        Pixel size; 1 where the model is in pixels.
    options : mapping of str to str or float
        Options of the model.

    Examples
    --------
    >>> values = {"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5}
    >>> PlainCamera("front", 640, 480, "opencv", values).mapping()([[0.1, 0.0]])
    array([[399.5, 239.5]])
    """

    name: str
    width: int
    height: int
    model: str
    values: Mapping[str, float]
    pitch_mm: tuple[float, float] = (1.0, 1.0)
    options: Mapping[str, str | float] = field(default_factory=dict)

    def mapping(self) -> PlaneMapping:
        """The mapping from ideal directions to pixels."""
        model = camera_model(self.model)
        values = [self.values.get(name, 0.0) for name in model.names]
        return model.mapping(values, PixelGrid(self.width, self.height, self.pitch_mm), self.options)

    def of(self, *names: str) -> list[float]:
        """Values of parameters, zero where they are missing."""
        return [float(self.values.get(name, 0.0)) for name in names]


def opencv_camera(
    name: str,
    size: Sequence[int],
    focal: Sequence[float],
    centre: Sequence[float],
    coefficients: Sequence[float],
    where: object,
    *,
    fisheye: bool = False,
) -> PlainCamera:
    """Create a camera from coefficients in the order of OpenCV.

    Raises
    ------
    FormatError
        When their number is none that OpenCV has, or a number is not finite.
    """
    names: tuple[str, ...]
    if fisheye:
        names = ("k1", "k2", "k3", "k4")
        known = len(coefficients) == 4
    else:
        names = TILTED
        known = len(coefficients) in (0, 4, 5, 8, 12, 14)
    if not known:
        raise FormatError(f"has {len(coefficients)} coefficients of distortion", where=where)
    model = "fisheye" if fisheye else "opencv" if len(coefficients) <= len(RATIONAL) else "opencv_full"
    numbers = [*focal, *centre, *coefficients]
    if not all(isfinite(number) for number in numbers) or min(focal) <= 0 or min(size) < 1:
        raise FormatError("has no finite camera matrix and image size", where=where)
    values = dict(zip(("fx", "fy", "cx", "cy", *names), map(float, numbers), strict=False))
    return PlainCamera(name, int(size[0]), int(size[1]), model, values)
