"""The oscilloscope procedure (Wishahy): images refined by successive elimination of each factor.

Three photographs tell the factors apart. PHOTO I shows the reseau alone: its distortion is that of the camera
and the film (group A). PHOTO II shows a test object behind the reseau: what is left of it once it is refined
of group A is the ultrasonic instrument's doing (group B). In PHOTO III both are known, and an object without
any control point gets its true coordinates. The steps carry the paper's numbers and symbols.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..adjust import Failure
from ..data import Frame, ImagePoints
from ..formats import ReseauDesign
from ..optics import RationalPolynomial
from ..refine import (
    CameraCorrection,
    PinDetections,
    PinOptions,
    PinResult,
    ReseauOptions,
    ReseauResult,
    correct_camera,
    find_pins,
    measure_pins,
    measure_reseau,
)
from ..refine.causes import COEFFICIENTS, Causes, physical_causes
from ..refine.instrument import InstrumentCorrection, correct_instrument
from ..refine.registration import Registration, register

__all__ = ["PhotoI", "PhotoII", "PhotoIII", "photo_i", "photo_ii", "photo_iii"]

_UPRIGHT = np.deg2rad(20.0)
"""Rotation of the test object against the reseau, or of the reseau in the image, that is still meant."""
_STOOD_STILL_PX = 6.0
"""How far the reseau is looked for from where PHOTO I had it, before it is looked for everywhere."""
_ANOTHER_SHAPE_PX = 0.3
"""What may remain at the marks of a photograph referred to PHOTO I."""


@dataclass(frozen=True, eq=False)
class PhotoI:
    """PHOTO I refined.

    Parameters
    ----------
    points : ImagePoints
        The reseau's marks in pixels.
    camera : CameraCorrection
        Group A.
    measured : ReseauResult, optional
        How the marks were measured; None where they came from elsewhere.
    """

    points: ImagePoints
    camera: CameraCorrection
    measured: ReseauResult | None


def photo_i(
    photo: Frame | ImagePoints,
    reseau: ReseauDesign,
    *,
    options: ReseauOptions | None = None,
    model: RationalPolynomial | None = None,
    alpha: float = 0.05,
    criterion: Literal["t", "chi2", "F"] = "chi2",
    check: Iterable[str] = (),
) -> PhotoI | Failure:
    """Correct the camera's distortions by PHOTO I, steps (i) to (iii).

    Parameters
    ----------
    photo : Frame or ImagePoints
        The photograph of the reseau, or its marks measured elsewhere, in pixels.
    reseau : ReseauDesign
        The reseau.
    options : ReseauOptions, optional
        How the marks are measured.
    model, alpha, criterion, check
        As in :func:`reseau.refine.correct_camera`; by default equations (5a, b) with χ² tests at 0.05.

    Returns
    -------
    PhotoI or Failure
        A failure when the reseau is not found in the photograph, or has too few marks in it.
    """
    # (i) object and photo-coordinates of the reseau
    measured = None
    if isinstance(photo, Frame):
        found = measure_reseau(photo, reseau, options)
        if isinstance(found, Failure):
            return found
        measured, points = found, found.points
    else:
        points = photo
    # (ii) both into the common system of O and S, (iii) equations (5a, b)
    camera = correct_camera(points, reseau, model=model, alpha=alpha, criterion=criterion, check=check)
    if isinstance(camera, Failure):
        return camera
    return PhotoI(points, camera, measured)


@dataclass(frozen=True, eq=False)
class PhotoII:
    """PHOTO II refined.

    Parameters
    ----------
    pins : ImagePoints
        Images of the rods, in pixels of PHOTO I.
    instrument : InstrumentCorrection
        Groups A and B.
    registration : Registration or None
        How the photograph was referred to PHOTO I; None where its reseau was not given.
    causes : Causes or None
        The physical causes of group B's coefficients, and the conditions they impose; None for another model
        than equations (7a, b).
    notes : tuple of str
        What the user should look into.
    measured : PinResult, optional
        How the pins were measured; None where they came from elsewhere.
    """

    pins: ImagePoints
    instrument: InstrumentCorrection
    registration: Registration | None
    causes: Causes | None
    notes: tuple[str, ...]
    measured: PinResult | None


@dataclass(frozen=True, eq=False)
class PhotoIII:
    """PHOTO III refined.

    Parameters
    ----------
    points : ImagePoints
        The body's points in pixels of PHOTO I.
    true : ImagePoints
        Their true coordinates in the object's plane, with covariances.
    registration : Registration or None
        How the photograph was referred to PHOTO I.
    notes : tuple of str
        What the user should look into.
    measured : PinDetections, optional
        How the points were measured; None where they came from elsewhere.
    """

    points: ImagePoints
    true: ImagePoints
    registration: Registration | None
    notes: tuple[str, ...]
    measured: PinDetections | None = None


def photo_ii(
    photo: Frame | ImagePoints,
    reseau: ReseauDesign,
    test_object: ReseauDesign,
    camera: CameraCorrection,
    *,
    marks: ImagePoints | None = None,
    options: ReseauOptions | None = None,
    pins: PinOptions | None = None,
    model: RationalPolynomial | None = None,
    alpha: float = 0.05,
    criterion: Literal["t", "chi2", "F"] = "F",
    check: Iterable[str] = (),
) -> PhotoII | Failure:
    """Correct the ultrasonic instrument by PHOTO II, steps (iv) to (vii).

    Parameters
    ----------
    photo : Frame or ImagePoints
        The photograph of the test object behind the reseau, or its pins measured elsewhere, in pixels.
    reseau, test_object : ReseauDesign
        The reseau; the rods, with M and N as `origin` and `axis` and their tolerance as sigmas.
    camera : CameraCorrection
        Group A, from PHOTO I.
    marks : ImagePoints, optional
        The reseau's marks in this photograph, where the pins came from elsewhere.
    options, pins
        How reseau and pins are measured.
    model, alpha, criterion, check
        As in :func:`reseau.refine.instrument.correct_instrument`; by default equations (7a, b) with F-tests
        at 0.05.

    Returns
    -------
    PhotoII or Failure
        A failure when reseau or test object are not found, or too few of their points.
    """
    # (iv) photo-coordinates of the test object
    measured = None
    if isinstance(photo, Frame):
        seen = _reseau_in(photo, reseau, camera, options)
        if isinstance(seen, Failure):
            return seen
        hidden = seen.shadow(reseau, photo.pixels.shape)
        found = measure_pins(photo, test_object, pins, hidden=hidden)
        if isinstance(found, Failure):
            return found
        marks, measured, images = seen.points, found, found.points
    else:
        images = photo
    # (v) into the common system, by way of PHOTO I
    registration = None
    if marks is not None:
        registered = register(marks, reseau, camera)
        if isinstance(registered, Failure):
            return registered
        registration, images = registered, registered.apply(images)
    # (iv) to (vii)
    instrument = correct_instrument(
        images, test_object, camera, model=model, alpha=alpha, criterion=criterion, check=check
    )
    if isinstance(instrument, Failure):
        return instrument
    notes = _of_the_camera(camera, registration) + _of_the_object(instrument, images, test_object)
    return PhotoII(images, instrument, registration, _causes(instrument), notes, measured)


def photo_iii(
    photo: Frame | ImagePoints,
    instrument: InstrumentCorrection,
    reseau: ReseauDesign,
    *,
    points: ImagePoints | None = None,
    marks: ImagePoints | None = None,
    options: ReseauOptions | None = None,
    pins: PinOptions | None = None,
) -> PhotoIII | Failure:
    """True coordinates of a body without control points in PHOTO III, step (viii).

    Parameters
    ----------
    photo : Frame or ImagePoints
        The photograph, or points of the body measured elsewhere, in pixels.
    instrument : InstrumentCorrection
        Groups A and B.
    reseau : ReseauDesign
        The reseau.
    points : ImagePoints, optional
        Points of the body in a frame; by default all echoes that are found in it.
    marks : ImagePoints, optional
        The reseau's marks, where they were measured elsewhere; without any the camera is taken to have stood
        still.
    options, pins
        How reseau and echoes are measured.

    Returns
    -------
    PhotoIII or Failure
        A failure when the reseau is not found, or the photograph shows nothing.
    """
    measured = None
    if isinstance(photo, Frame):
        seen = _reseau_in(photo, reseau, instrument.camera, options)
        if isinstance(seen, Failure):
            return seen
        marks = seen.points
        hidden = seen.shadow(reseau, photo.pixels.shape)
        if points is None:
            measured = find_pins(photo, pins, hidden=hidden)
            points = measured.points
        body = points
    else:
        body = photo
    if not len(body):
        return Failure("the photograph shows no echo of a body")
    registration = None
    if marks is not None:
        registered = register(marks, reseau, instrument.camera)
        if isinstance(registered, Failure):
            return registered
        registration, body = registered, registered.apply(body)
    notes = _of_the_camera(instrument.camera, registration)
    return PhotoIII(body, instrument.apply(body), registration, notes, measured)


def _reseau_in(
    photo: Frame, reseau: ReseauDesign, camera: CameraCorrection, options: ReseauOptions | None
) -> ReseauResult | Failure:
    """The reseau where PHOTO I had it; found anew where that leaves out what may be a row of it.

    A camera that was moved by the pitch of the reseau shows its marks where others stood.
    """
    o = options or ReseauOptions()
    expected = camera.to_pixels(camera.object_system(reseau.xy))
    near = replace(o, nominal=True, nominal_within_px=_STOOD_STILL_PX)
    known = measure_reseau(photo, reseau.expected_at(expected), near)
    found = known.found if isinstance(known, ReseauResult) else 0
    if len(reseau.ids) - found <= 0.5 * np.sqrt(len(reseau.ids)):
        return known
    anew = measure_reseau(photo, reseau, o)
    return anew if isinstance(anew, ReseauResult) and anew.found > found else known


def _causes(instrument: InstrumentCorrection) -> Causes | None:
    """The causes, from the adjustment with all coefficients: one dropped would be held at nought."""
    if instrument.fit is None:
        return None
    full = instrument.fit.elimination.full
    if any(name not in full.names for name in COEFFICIENTS):
        return None
    causes = physical_causes(full.names, full.values, full.cofactor)
    return None if isinstance(causes, Failure) else causes


def _of_the_camera(camera: CameraCorrection, registration: Registration | None) -> tuple[str, ...]:
    """What is odd about the camera's side."""
    notes = []
    angle = camera.photo_system.angle
    if abs(angle) > np.pi - _UPRIGHT:
        notes.append("the x-axis of the common system runs to the left in the image: are O and S swapped?")
    elif abs(angle) > _UPRIGHT:
        notes.append(
            f"the common system is turned by {np.rad2deg(angle):.0f}° in the image: are O and S right?"
        )
    if registration is not None and registration.moved:
        notes.append(
            f"the camera has moved since PHOTO I, by up to {registration.displacement_px:.2f} px; "
            "the photograph was carried back"
        )
    if registration is not None and registration.left_px > _ANOTHER_SHAPE_PX:
        notes.append(
            f"the reseau has another shape than in PHOTO I (by {registration.left_px:.2f} px, rms): "
            "take PHOTO I anew"
        )
    return tuple(notes)


def _of_the_object(
    instrument: InstrumentCorrection, pins: ImagePoints, design: ReseauDesign
) -> tuple[str, ...]:
    """What is odd about the test object's side."""
    notes, plane = [], instrument.plane
    if abs(plane.rotation) > np.pi - _UPRIGHT:
        notes.append("the test object stands on its head or M and N are swapped")
    elif abs(plane.rotation) > np.deg2rad(2.0):
        notes.append(f"the test object is turned by {np.rad2deg(plane.rotation):.1f}° against the reseau")
    missing = [i for i, name in enumerate(design.ids) if name not in pins.names]
    for axis, word in ((1, "row"), (0, "column")):
        for value in np.unique(np.round(design.xy[:, axis], 6)):
            line = np.flatnonzero(np.abs(design.xy[:, axis] - value) < 1e-6)
            if len(line) >= 3 and set(line) <= set(missing):
                notes.append(f"the whole {word} of rods at {'xy'[axis]} = {value:g} {design.unit} is missing")
    ratio = plane.scale[0] / plane.scale[1]
    if abs(ratio - 1) > 0.1:
        notes.append(
            f"the scales along and across differ by {abs(ratio - 1):.0%}: check the display's aspect"
        )
    return tuple(notes)
