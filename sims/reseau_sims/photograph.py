"""What lenses, light and processing of usual cameras do to an image, freer than the models that measure it.

The kernel of a lens out of focus is a disk, and that of a shaking camera a path that bends to and fro at
uneven speed; measurement knows Gaussians and straight paths. Kernels are symmetric, as others displace all
images alike. Grey values then follow a curve, are sharpened and compressed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array

_POINTS = 12
"""Points of a disk out of focus, and of a path."""
_GOLDEN = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Photograph:
    """Blur in addition to the point-spread function, unevenness of the light, and processing.

    Parameters
    ----------
    defocus_px : float
        Radius of the disk that a lens out of focus makes of a point.
    motion_px, motion_angle : float
        Length of the motion during the exposure, and its direction in degrees.
    motion_bend, motion_speed : float
        Largest distance of the S-shaped path from the straight one relative to its length, and relative
        change of the speed from the middle to the ends.
    curvature : (float, float, float)
        Change of the light of second degree, see :func:`reseau.optics.illumination`.
    gamma : float
        Grey values are those of the light to the power of 1 / gamma, relative to the full scale.
    sharpening : float
        Weight of an unsharp mask of 1 px.
    jpeg : int
        Quality of the compression of 8-bit images; 0 without.

    Examples
    --------
    >>> Photograph(motion_px=4.0, motion_bend=0.2).kernel()[0].mean(axis=0).round(1) + 0.0
    array([0., 0.])
    """

    defocus_px: float = 0.0
    motion_px: float = 0.0
    motion_angle: float = 30.0
    motion_bend: float = 0.0
    motion_speed: float = 0.0
    curvature: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gamma: float = 1.0
    sharpening: float = 0.0
    jpeg: int = 0

    def kernel(self) -> tuple[Array, Array]:
        """Displacements (n, 2) of the images that are averaged, and their weights; their mean is zero."""
        place, weight = np.zeros((1, 2)), np.ones(1)
        k = np.arange(_POINTS)
        if self.defocus_px:
            radius, angle = self.defocus_px * np.sqrt((k + 0.5) / _POINTS), _GOLDEN * k
            place = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
            weight = np.full(_POINTS, 1 / _POINTS)
        if self.motion_px:
            s = 2 * (k + 0.5) / _POINTS - 1
            along, across = self.motion_px * s / 2, 2.6 * self.motion_px * self.motion_bend * (s - s**3)
            c, d = np.cos(np.deg2rad(self.motion_angle)), np.sin(np.deg2rad(self.motion_angle))
            path = np.column_stack([c * along - d * across, d * along + c * across])
            share = 1 / (1 + self.motion_speed * s**2)
            place = (place[:, None] + path).reshape(-1, 2)
            weight = np.outer(weight, share / share.sum()).ravel()
        return place - weight @ place, weight

    def processed(self, pixels: NDArray[Any], full_scale: float) -> NDArray[Any]:
        """Grey values after the curve, the sharpening and the compression."""
        grey = pixels.astype(np.float64)
        if self.gamma != 1:
            grey = full_scale * (grey / full_scale) ** (1 / self.gamma)
        if self.sharpening:
            grey += self.sharpening * (grey - cv2.GaussianBlur(grey, (0, 0), 1.0))
        if self.gamma != 1 or self.sharpening:
            pixels = np.clip(np.rint(grey), 0, full_scale).astype(pixels.dtype)
        if self.jpeg:
            coded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg])[1]
            pixels = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))
        return pixels
