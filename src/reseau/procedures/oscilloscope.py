"""The oscilloscope procedure (Wishahy): images corrected for one systematic error after the other.

Three photographs separate the errors. PHOTO I shows the reseau alone: its distortion is that of camera and
film (group A). PHOTO II shows a test object behind the reseau: after the correction for group A, its
distortion is that of the ultrasonic instrument (group B). In PHOTO III both groups are known, and an object
without control points gets true coordinates. The steps have the numbers and symbols of the paper.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from ..calibration import CameraCorrection, InstrumentCorrection
from ..core.data import Array, Frame, ImagePoints
from ..core.failure import Code, Failure, Remark
from ..io import ReseauDesign
from ..measure import PinDetections, find_pins, measure_pins, measure_reseau
from ..measure.pins.detection import PinOptions
from ..measure.pins.measure import PinResult
from ..measure.reseau.marks import ReseauOptions
from ..measure.reseau.measure import ReseauResult
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
from ..refine.echoes import middles_on_screen
from ..refine.remarks import (
    ANOTHER_SHAPE_PX,
    of_gross_errors,
    of_the_camera,
    of_the_change,
    of_the_object,
)


class _Corrected:
    """Result of a step that did not fail."""

    def required(self) -> Self:
        """The result itself; see :meth:`~reseau.core.failure.Failure.required`."""
        return self


@dataclass(frozen=True, eq=False)
class PhotoI(_Corrected):
    """Corrected PHOTO I.

    Parameters
    ----------
    points : ImagePoints
        Marks of the reseau (px).
    camera : FittedCamera
        Group A.
    measured : ReseauResult, optional
        Measurement of the marks; None if they were measured elsewhere.
    """

    points: ImagePoints
    camera: FittedCamera
    measured: ReseauResult | None

    @property
    def notes(self) -> tuple[Remark, ...]:
        """Warnings for the user."""
        return of_gross_errors("marks", self.camera.gross) + notes_of(self.measured)


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
        The photograph of the reseau, or its marks measured elsewhere (px).
    reseau : ReseauDesign
        The reseau.
    options : ReseauOptions, optional
        Options of the measurement.
    model, alpha, criterion, check
        As in :func:`reseau.refine.correct_camera`; by default equations (5a, b) with χ² tests at 0.05.

    Returns
    -------
    PhotoI or Failure
        A failure if the reseau is not found, or too few of its marks.

    Examples
    --------
    Marks of a reseau, imaged without distortion at 8 px/mm: only the two scales are significant.

    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(5, 4, 20.0, Mark(shape="disk", size=4.0))
    >>> def imaged(design):  # 8 px/mm, y down
    ...     return ImagePoints.with_sigma(design.ids, [700, 500] + design.xy * [8, -8], 0.02)
    >>> camera = photo_i(imaged(reseau), reseau).camera
    >>> len(camera.model.names), len(camera.fit.elimination.dropped)
    (13, 11)
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
        return camera if measured is None else replace(camera, places=points.xy)
    return PhotoI(points, camera, measured)


@dataclass(frozen=True, eq=False)
class PhotoII(_Corrected):
    """Corrected PHOTO II.

    Parameters
    ----------
    pins : ImagePoints
        Images of the rods (px of PHOTO I).
    instrument : FittedInstrument
        Groups A and B.
    registration : Registration or None
        Registration to PHOTO I; None without marks of the reseau.
    causes : Causes or None
        Physical causes of the coefficients of group B, and their conditions; None for another model than
        equations (7a, b).
    notes : tuple of Remark
        Warnings for the user.
    measured : PinResult, optional
        Measurement of the pins; None if they were measured elsewhere.
    marks : ReseauResult, optional
        Measurement of the reseau; None if it was measured elsewhere.
    """

    pins: ImagePoints
    instrument: FittedInstrument
    registration: Registration | None
    causes: Causes | None
    notes: tuple[Remark, ...]
    measured: PinResult | None
    marks: ReseauResult | None = None


@dataclass(frozen=True, eq=False)
class PhotoIII(_Corrected):
    """Corrected PHOTO III.

    Parameters
    ----------
    points : ImagePoints
        Points of the body (px of PHOTO I).
    true : ImagePoints
        Their true coordinates in the plane of the object, with covariances.
    registration : Registration or None
        Registration to PHOTO I.
    notes : tuple of Remark
        Warnings for the user.
    measured : PinDetections, optional
        Measurement of the points; None if they were measured elsewhere.
    marks : ReseauResult, optional
        Measurement of the reseau; None if it was measured elsewhere.
    """

    points: ImagePoints
    true: ImagePoints
    registration: Registration | None
    notes: tuple[Remark, ...]
    measured: PinDetections | None = None
    marks: ReseauResult | None = None


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
        The photograph of the test object behind the reseau, or its pins measured elsewhere (px).
    reseau, test_object : ReseauDesign
        The reseau; the rods, with M and N as `origin` and `axis` and their tolerance as sigmas.
    camera : CameraCorrection
        Group A, from PHOTO I.
    marks : ImagePoints, optional
        Marks of the reseau in this photograph, if the pins were measured elsewhere.
    options, pins
        Options of the measurements.
    model, alpha, criterion, check
        As in :func:`reseau.refine.correct_instrument`; by default equations (7a, b) with F-tests
        at 0.05.

    Returns
    -------
    PhotoII or Failure
        A failure if reseau or test object are not found, or too few of their points.

    Examples
    --------
    An instrument without distortion: both scales of the display are 1.

    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(5, 4, 20.0, Mark(shape="disk", size=4.0))
    >>> rods = regular_reseau(4, 3, 18.0, Mark(shape="rod", size=1.0))
    >>> def imaged(design):  # 8 px/mm, y down
    ...     return ImagePoints.with_sigma(design.ids, [700, 500] + design.xy * [8, -8], 0.02)
    >>> first = photo_i(imaged(reseau), reseau)
    >>> second = photo_ii(imaged(rods), reseau, rods, first.camera, marks=imaged(reseau))
    >>> second.instrument.plane.scale.round(6).tolist()
    [1.0, 1.0]
    """
    # (iv) photo-coordinates of the test object, (v) in the common system by PHOTO I
    seen = pins_in(photo, reseau, test_object, camera, marks, options, pins)
    if isinstance(seen, Failure):
        return seen
    images, registration, measured, shown = seen
    # (iv) to (vii)
    instrument = correct_instrument(
        images,
        test_object,
        camera,
        model=model,
        alpha=alpha,
        criterion=criterion,
        check=check,
        registration=registration,
        shared=shared_errors(measured, registration),
    )
    if isinstance(instrument, Failure):
        return instrument if measured is None else replace(instrument, places=measured.points.xy)
    notes = of_the_camera(camera, registration) + of_the_object(
        instrument, images, test_object, {} if measured is None else declined_rods(measured)
    )
    notes += notes_of(shown, measured)
    causes = None if instrument.fit is None else causes_of(instrument.fit.adjustment)
    return PhotoII(images, instrument, registration, causes, notes, measured, shown)


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
    """Determine true coordinates of a body without control points in PHOTO III, step (viii).

    Parameters
    ----------
    photo : Frame or ImagePoints
        The photograph, or points of the body measured elsewhere (px).
    instrument : InstrumentCorrection
        Groups A and B.
    reseau : ReseauDesign
        The reseau.
    points : ImagePoints, optional
        Points of the body in a frame. Default: all echoes found in it.
    marks : ImagePoints, optional
        Marks of the reseau, if they were measured elsewhere. Without marks the camera is assumed not to
        have moved.
    options, pins
        Options of the measurements.

    Returns
    -------
    PhotoIII or Failure
        A failure if the reseau is not found, or no echo.

    Examples
    --------
    Two points of a body, which are two of the rods here:

    >>> import numpy as np
    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(5, 4, 20.0, Mark(shape="disk", size=4.0))
    >>> rods = regular_reseau(4, 3, 18.0, Mark(shape="rod", size=1.0))
    >>> def imaged(design):  # 8 px/mm, y down
    ...     return ImagePoints.with_sigma(design.ids, [700, 500] + design.xy * [8, -8], 0.02)
    >>> first = photo_i(imaged(reseau), reseau)
    >>> instrument = photo_ii(imaged(rods), reseau, rods, first.camera).instrument
    >>> body = imaged(rods).select(np.arange(12) < 2)
    >>> photo_iii(body, instrument, reseau).true.xy.round(6).tolist()
    [[-27.0, 18.0], [-9.0, 18.0]]
    """
    measured, shown = None, None
    if isinstance(photo, Frame):
        seen = reseau_in(photo, reseau, instrument.camera, options)
        if isinstance(seen, Failure):
            return seen
        marks, shown = seen.points, seen
        hidden = seen.shadow(reseau, photo.pixels.shape)
        if points is None:
            echoes = find_pins(photo, pins, hidden=hidden)
            if isinstance(echoes, Failure):
                return echoes
            measured, points = echoes, echoes.points
        body = points
    else:
        body = photo
    if not len(body):
        return Failure("no echo of a body found", Code.NOT_FOUND)
    registration, moves = None, None
    if marks is not None:
        registered = register(marks, reseau, instrument.camera)
        if isinstance(registered, Failure):
            return registered
        if measured is not None:
            body = middles_of_echoes(measured, instrument.camera, registered)
        registration, body = registered, registered.apply(body)
        moves = registration.moves(body.xy)
    notes = of_the_camera(instrument.camera, registration) + notes_of(shown)
    return PhotoIII(body, instrument.apply(body, moves), registration, notes, measured, shown)


@dataclass(frozen=True, eq=False)
class StillStandard(_Corrected):
    """Test of stored coefficients with a new PHOTO II.

    Parameters
    ----------
    test : StandardTest
        The test.
    registration : Registration or None
        Registration to PHOTO I; None without marks of the reseau.
    notes : tuple of Remark
        What has changed, and the probable cause.
    measured : PinResult, optional
        Measurement of the pins; None if they were measured elsewhere.
    marks : ReseauResult, optional
        Measurement of the reseau; None if it was measured elsewhere.
    """

    test: StandardTest
    registration: Registration | None
    notes: tuple[Remark, ...]
    measured: PinResult | None
    marks: ReseauResult | None = None

    def entries(self) -> dict[str, Any]:
        """The test as JSON."""
        test = self.test
        return {
            "holds": test.holds, "same_object": test.same_object, "chi2": test.statistic,
            "degrees": test.degrees, "critical": test.critical, "p": test.p, "shift": test.shift.tolist(),
            "shift_sigma": test.shift_sigma.tolist(), "p_shift": test.p_shift, "p_rest": test.p_rest,
            "rods": {"id": list(test.names), "change": test.change.tolist(), "sigma": test.sigma.tolist()},
        } | note_entries(self.notes)  # fmt: skip


def note_entries(notes: Sequence[Remark]) -> dict[str, Any]:
    """Notes as JSON."""
    return {"notes": [note.text for note in notes], "note_codes": [note.code.value for note in notes]}


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
    """Test whether stored coefficients are still valid for the instrument, with a new PHOTO II.

    Taken from another position than PHOTO I, the photograph also shows a gap g between reseau and phosphor.
    From one position at the distance D, the gap is equivalent to a scale of (1 + g/D), which group B absorbs;
    a camera displaced by t sees the display shifted by g·t/D.

    Parameters
    ----------
    photo, marks, options, pins
        As for :func:`photo_ii`.
    instrument : InstrumentCorrection
        The stored groups A and B.
    reseau, test_object : ReseauDesign
        The reseau and the rods.
    same_object : bool
        Whether the rods are those of the calibration.
    alpha : float
        Level of the test.

    Returns
    -------
    StillStandard or Failure
        A failure if reseau or test object are not found, or too few of their points.

    Examples
    --------
    A new photograph of an unchanged instrument:

    >>> from reseau.designs import regular_reseau
    >>> from reseau.io import Mark
    >>> reseau = regular_reseau(5, 4, 20.0, Mark(shape="disk", size=4.0))
    >>> rods = regular_reseau(4, 3, 18.0, Mark(shape="rod", size=1.0))
    >>> def imaged(design):  # 8 px/mm, y down
    ...     return ImagePoints.with_sigma(design.ids, [700, 500] + design.xy * [8, -8], 0.02)
    >>> first = photo_i(imaged(reseau), reseau)
    >>> instrument = photo_ii(imaged(rods), reseau, rods, first.camera).instrument
    >>> still_standard_in(imaged(rods), instrument, reseau, rods).test.holds
    True
    """
    seen = pins_in(photo, reseau, test_object, instrument.camera, marks, options, pins)
    if isinstance(seen, Failure):
        return seen
    images, registration, measured, shown = seen
    test = still_standard(instrument, images, test_object, same_object=same_object, alpha=alpha)
    if isinstance(test, Failure):
        return test if measured is None else replace(test, places=measured.points.xy)
    notes = of_the_camera(instrument.camera, registration)
    notes += of_the_change(test, registration, instrument.unit)
    notes += notes_of(shown, measured)
    return StillStandard(test, registration, notes, measured, shown)


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
