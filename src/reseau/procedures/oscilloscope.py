"""The oscilloscope procedure (Wishahy): images refined by successive elimination of each factor.

Three photographs tell the factors apart. PHOTO I shows the reseau alone: its distortion is that of the camera
and the film (group A). PHOTO II shows a test object behind the reseau: what is left of it once it is refined
of group A is the ultrasonic instrument's doing (group B). In PHOTO III both are known, and an object without
any control point gets its true coordinates. The steps carry the paper's numbers and symbols.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from ..calibration import CameraCorrection, InstrumentCorrection
from ..core.data import Frame, ImagePoints
from ..core.failure import Code, Failure, Remark
from ..io import ReseauDesign
from ..measure import (
    PinDetections,
    PinOptions,
    PinResult,
    ReseauOptions,
    ReseauResult,
    find_pins,
    measure_pins,
    measure_reseau,
)
from ..optics import RationalPolynomial
from ..refine import (
    Causes,
    FittedCamera,
    FittedInstrument,
    Registration,
    StandardTest,
    causes_of,
    correct_camera,
    correct_instrument,
    register,
    still_standard,
)
from ..refine.remarks import of_the_camera, of_the_change, of_the_object

__all__ = [
    "PhotoI",
    "PhotoII",
    "PhotoIII",
    "StillStandard",
    "photo_i",
    "photo_ii",
    "photo_iii",
    "still_standard_in",
]

_STOOD_STILL_PX = 6.0
"""How far the reseau is looked for from where PHOTO I had it, before it is looked for everywhere."""


class _Refined:
    """What a step gives where it does not fail."""

    def required(self) -> Self:
        """The result itself; see :meth:`~reseau.core.failure.Failure.required`."""
        return self


@dataclass(frozen=True, eq=False)
class PhotoI(_Refined):
    """PHOTO I refined.

    Parameters
    ----------
    points : ImagePoints
        The reseau's marks in pixels.
    camera : FittedCamera
        Group A.
    measured : ReseauResult, optional
        How the marks were measured; None where they came from elsewhere.
    """

    points: ImagePoints
    camera: FittedCamera
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
class PhotoII(_Refined):
    """PHOTO II refined.

    Parameters
    ----------
    pins : ImagePoints
        Images of the rods, in pixels of PHOTO I.
    instrument : FittedInstrument
        Groups A and B.
    registration : Registration or None
        How the photograph was referred to PHOTO I; None where its reseau was not given.
    causes : Causes or None
        The physical causes of group B's coefficients, and the conditions they impose; None for another model
        than equations (7a, b).
    notes : tuple of Remark
        What the user should look into.
    measured : PinResult, optional
        How the pins were measured; None where they came from elsewhere.
    """

    pins: ImagePoints
    instrument: FittedInstrument
    registration: Registration | None
    causes: Causes | None
    notes: tuple[Remark, ...]
    measured: PinResult | None


@dataclass(frozen=True, eq=False)
class PhotoIII(_Refined):
    """PHOTO III refined.

    Parameters
    ----------
    points : ImagePoints
        The body's points in pixels of PHOTO I.
    true : ImagePoints
        Their true coordinates in the object's plane, with covariances.
    registration : Registration or None
        How the photograph was referred to PHOTO I.
    notes : tuple of Remark
        What the user should look into.
    measured : PinDetections, optional
        How the points were measured; None where they came from elsewhere.
    """

    points: ImagePoints
    true: ImagePoints
    registration: Registration | None
    notes: tuple[Remark, ...]
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
        As in :func:`reseau.refine.correct_instrument`; by default equations (7a, b) with F-tests
        at 0.05.

    Returns
    -------
    PhotoII or Failure
        A failure when reseau or test object are not found, or too few of their points.
    """
    # (iv) photo-coordinates of the test object, (v) into the common system by way of PHOTO I
    seen = _pins_in(photo, reseau, test_object, camera, marks, options, pins)
    if isinstance(seen, Failure):
        return seen
    images, registration, measured = seen
    # (iv) to (vii)
    instrument = correct_instrument(
        images, test_object, camera, model=model, alpha=alpha, criterion=criterion, check=check
    )
    if isinstance(instrument, Failure):
        return instrument
    notes = of_the_camera(camera, registration) + of_the_object(instrument, images, test_object)
    causes = None if instrument.fit is None else causes_of(instrument.fit.adjustment)
    return PhotoII(images, instrument, registration, causes, notes, measured)


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
        return Failure("the photograph shows no echo of a body", Code.NOT_FOUND)
    registration = None
    if marks is not None:
        registered = register(marks, reseau, instrument.camera)
        if isinstance(registered, Failure):
            return registered
        registration, body = registered, registered.apply(body)
    notes = of_the_camera(instrument.camera, registration)
    return PhotoIII(body, instrument.apply(body), registration, notes, measured)


@dataclass(frozen=True, eq=False)
class StillStandard(_Refined):
    """Stored coefficients held against a new PHOTO II.

    Parameters
    ----------
    test : StandardTest
        Whether they still hold.
    registration : Registration or None
        How the photograph was referred to PHOTO I; None where its reseau was not given.
    notes : tuple of Remark
        What has changed, and what it points to.
    measured : PinResult, optional
        How the pins were measured; None where they came from elsewhere.
    """

    test: StandardTest
    registration: Registration | None
    notes: tuple[Remark, ...]
    measured: PinResult | None


def still_standard_in(
    photo: Frame | ImagePoints,
    instrument: InstrumentCorrection,
    reseau: ReseauDesign,
    test_object: ReseauDesign,
    *,
    marks: ImagePoints | None = None,
    options: ReseauOptions | None = None,
    pins: PinOptions | None = None,
    same_object: bool = True,
    alpha: float = 0.05,
) -> StillStandard | Failure:
    """Test whether stored coefficients are still the instrument's, by a new PHOTO II.

    Taken from another place than PHOTO I, the photograph shows as well whether the phosphor lies behind the
    reseau: from one place a gap g looks like a larger scale, (1 + g/D) about the foot of the camera at the
    distance D, and group B takes it up; a camera pushed by t sees the display shift by g·t/D.

    Parameters
    ----------
    photo, marks, options, pins
        As for :func:`photo_ii`.
    instrument : InstrumentCorrection
        The stored groups A and B.
    reseau, test_object : ReseauDesign
        The reseau and the rods.
    same_object : bool
        Whether the rods are those that the calibration was made with.
    alpha : float
        Level of the test.

    Returns
    -------
    StillStandard or Failure
        A failure when reseau or test object are not found, or too few of their points.
    """
    seen = _pins_in(photo, reseau, test_object, instrument.camera, marks, options, pins)
    if isinstance(seen, Failure):
        return seen
    images, registration, measured = seen
    test = still_standard(instrument, images, test_object, same_object=same_object, alpha=alpha)
    if isinstance(test, Failure):
        return test
    notes = of_the_camera(instrument.camera, registration)
    notes += of_the_change(test, registration, instrument.unit)
    return StillStandard(test, registration, notes, measured)


def _pins_in(
    photo: Frame | ImagePoints,
    reseau: ReseauDesign,
    test_object: ReseauDesign,
    camera: CameraCorrection,
    marks: ImagePoints | None,
    options: ReseauOptions | None,
    pins: PinOptions | None,
) -> tuple[ImagePoints, Registration | None, PinResult | None] | Failure:
    """Images of the rods in pixels of PHOTO I, how they came there, and how they were measured."""
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
    if marks is None:
        return images, None, measured
    registration = register(marks, reseau, camera)
    if isinstance(registration, Failure):
        return registration
    return registration.apply(images), registration, measured


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
