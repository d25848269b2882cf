"""The middle of an echo on the screen, from the middle of its image.

On the screen an echo is a bent line, as long to the left of its middle as to the right. In a photograph it is
not: shear displaces its ends against its middle by the shear times its rise, and perspective and distortion
lengthen one half of it. What is measured is the middle of the image; the correction of the camera tells where
the middle of the line is. With a rise of 0.3 mm and a shear of 0.002 they are 0.01 px apart, which is less
than the error of one echo, but all echoes have it in common.
"""

from __future__ import annotations

import numpy as np

from ..calibration import CameraCorrection
from ..core.data import Array, ImagePoints
from .registration import Registration


def middles_on_screen(
    points: ImagePoints,
    reach: Array,
    curvature: Array,
    tilt: Array,
    camera: CameraCorrection,
    registration: Registration,
) -> ImagePoints:
    """Images of the middles of echoes on the screen.

    Parameters
    ----------
    points : ImagePoints
        Middles of the images of n echoes, in pixels of the photograph.
    reach, curvature, tilt : ndarray (n,)
        Distance of what tells the place of an echo from its middle along the line (px), and the course of the
        line (1/px, rad); see :class:`reseau.measure.PinDetections`.
    camera : CameraCorrection
        Group A, which maps photographs to the screen.
    registration : Registration
        The photograph referred to PHOTO I.

    Returns
    -------
    ImagePoints
        In pixels of the photograph; covariances are those of the middles.
    """
    along = np.stack([np.cos(tilt), np.sin(tilt)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    fallen = 0.5 * (curvature * reach**2)[:, None] * across

    def on_screen(xy: Array) -> Array:
        in_photo_i = registration.carry(ImagePoints(points.names, xy, points.cov)).xy
        return np.asarray(camera.model(camera.photo_system(in_photo_i)))

    first, last = (on_screen(points.xy + sign * reach[:, None] * along + fallen) for sign in (-1, 1))
    chord = last - first
    length = np.maximum(np.hypot(*chord.T), 1e-300)
    # As a share of the length, along the line.
    share = (((first + last) / 2 - on_screen(points.xy)) * chord).sum(axis=1) / length**2
    shift = (2 * reach * share)[:, None] * along
    return ImagePoints(points.names, points.xy + shift, points.cov)
