"""Reseau and echoes of PHOTO II and III of the oscilloscope procedure, measured and referred to PHOTO I."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..calibration import CameraCorrection
from ..core.data import Array, Frame, ImagePoints
from ..core.failure import Code, Failure, Remark
from ..io import ReseauDesign
from ..measure import (
    PinDetections,
    PinOptions,
    PinResult,
    ReseauOptions,
    ReseauResult,
    measure_pins,
    measure_reseau,
)
from ..refine import Registration, register
from ..refine.echoes import middles_on_screen
from ..refine.remarks import ANOTHER_SHAPE_PX

_STATIONARY_PX = 6.0
"""Search distance of the reseau from its position in PHOTO I; beyond it, the whole image is searched."""


def pins_in(
    photo: Frame | ImagePoints,
    reseau: ReseauDesign,
    test_object: ReseauDesign,
    camera: CameraCorrection,
    marks: ImagePoints | None,
    options: ReseauOptions | None,
    pins: PinOptions | None,
) -> tuple[ImagePoints, Registration | None, PinResult | None, ReseauResult | None] | Failure:
    """Images of the rods (px of PHOTO I), their registration, and the measurements of rods and reseau."""
    measured, shown = None, None
    if isinstance(photo, Frame):
        seen = reseau_in(photo, reseau, camera, options)
        if isinstance(seen, Failure):
            return seen
        hidden = seen.shadow(reseau, photo.pixels.shape)
        found = measure_pins(photo, test_object, pins, hidden=hidden)
        if isinstance(found, Failure):
            return found
        marks, shown, measured, images = seen.points, seen, found, found.points
    else:
        images = photo
    if marks is None:
        return images, None, measured, shown
    registration = register(marks, reseau, camera)
    if isinstance(registration, Failure):
        return registration
    if measured is not None:
        images = middles_of_echoes(measured, camera, registration)
    return registration.carry(images), registration, measured, shown


def middles_of_echoes(
    measured: PinResult | PinDetections, camera: CameraCorrection, registration: Registration
) -> ImagePoints:
    """The middles of echoes on the screen, in pixels of their photograph."""
    points, ok = measured.points, measured.ok
    if measured.reach is None:
        return points
    reach, curvature, tilt = (values[ok] for values in (measured.reach, measured.curvature, measured.tilt))
    return middles_on_screen(points, reach, curvature, tilt, camera, registration)


def shared_errors(measured: PinResult | None, registration: Registration | None) -> Array | None:
    """Errors that the echoes share, as :func:`reseau.refine.correct_instrument` takes them, in PHOTO I."""
    if measured is None or measured.shared is None:
        return None
    points, shared = measured.points, measured.shared[measured.ok]
    if registration is None:
        return shared

    def carried(xy: Array) -> Array:
        return registration.carry(ImagePoints(points.names, xy, points.cov)).xy

    # They are small: differences are derivatives.
    at = carried(points.xy)
    return np.stack([carried(points.xy + one) - at for one in np.moveaxis(shared, 2, 0)], axis=2)


def declined_rods(measured: PinResult) -> dict[str, str]:
    """Reasons of the rods that were seen, and not measured, by name."""
    unseen = (None, Code.NOT_FOUND, Code.OUTSIDE, Code.NO_COORDINATES)
    return {
        name: str(why)
        for name, why, code in zip(measured.ids, measured.why, measured.codes, strict=True)
        if code not in unseen
    }


def notes_of(*results: ReseauResult | PinResult | None) -> tuple[Remark, ...]:
    """Notes on the measurements of a photograph, each once."""
    notes = [note for result in results if result is not None for note in result.notes]
    return tuple(dict.fromkeys(notes))


def reseau_in(
    photo: Frame, reseau: ReseauDesign, camera: CameraCorrection, options: ReseauOptions | None
) -> ReseauResult | Failure:
    """Measure the reseau at its position in PHOTO I; search it if that may have missed a row.

    If the camera was moved by the pitch of the reseau, marks appear at the positions of others; if by half of
    it, a single wire passes there. Neither has the shape that PHOTO I predicts.
    """
    o = options or ReseauOptions()
    expected = camera.to_pixels(camera.object_system(reseau.xy))
    near = replace(o, nominal=True, nominal_within_px=_STATIONARY_PX)
    known = measure_reseau(photo, reseau.expected_at(expected), near)
    found, left = 0, np.inf
    if isinstance(known, ReseauResult):
        found, left = known.found, _left_px(known, reseau, camera)
    if len(reseau.ids) - found <= 0.5 * np.sqrt(len(reseau.ids)) and left <= ANOTHER_SHAPE_PX:
        return known
    anew = measure_reseau(photo, reseau, o)
    if not isinstance(anew, ReseauResult):
        return known
    if left > ANOTHER_SHAPE_PX:
        return anew if _left_px(anew, reseau, camera) < left else known
    return anew if anew.found > found else known


def _left_px(seen: ReseauResult, reseau: ReseauDesign, camera: CameraCorrection) -> float:
    """Residuals of the marks of a photograph against PHOTO I, pixels rms; see `Registration`."""
    registered = register(seen.points, reseau, camera)
    return registered.left_px if isinstance(registered, Registration) else np.inf
