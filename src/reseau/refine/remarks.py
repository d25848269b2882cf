"""Remarks on the photographs of the oscilloscope procedure, for the user."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..calibration import CameraCorrection
from ..core.data import ImagePoints
from ..core.failure import Code, Remark
from ..io import ReseauDesign
from .instrument import FittedInstrument
from .registration import Registration
from .standard import StandardTest

_UPRIGHT = np.deg2rad(20.0)
"""Rotation of the test object against the reseau, or of the reseau in the image, that is accepted."""
ANOTHER_SHAPE_PX = 0.3
"""Largest rms residual of the marks of a photograph that has the shape of PHOTO I."""


def of_the_camera(camera: CameraCorrection, registration: Registration | None) -> tuple[Remark, ...]:
    """Remarks on the camera."""
    notes = []
    angle = camera.photo_system.angle
    if abs(angle) > np.pi - _UPRIGHT:
        notes.append(
            Remark(
                "the x-axis of the common system runs to the left in the image: are O and S swapped?",
                Code.TARGET_ROTATED,
            )
        )
    elif abs(angle) > _UPRIGHT:
        notes.append(
            Remark(
                f"the common system is turned by {np.rad2deg(angle):.0f}° in the image: are O and S right?",
                Code.TARGET_ROTATED,
            )
        )
    if registration is not None and registration.moved:
        notes.append(
            Remark(
                f"the camera has moved since PHOTO I, by up to {registration.displacement_px:.2f} px; "
                "the photograph was transformed back",
                Code.CAMERA_MOVED,
            )
        )
    if registration is not None and registration.left_px > ANOTHER_SHAPE_PX:
        notes.append(
            Remark(
                f"the marks of the reseau differ from PHOTO I by {registration.left_px:.2f} px (rms): "
                "take PHOTO I again",
                Code.INCONSISTENT,
            )
        )
    return tuple(notes)


def of_gross_errors(what: str, names: tuple[str, ...]) -> tuple[Remark, ...]:
    """A remark on points that were left out."""
    text = f"{what} that contradict the others and were left out: {', '.join(names)}"
    return (Remark(text, Code.GROSS_ERRORS),) if names else ()


def of_the_change(test: StandardTest, registration: Registration | None, unit: str) -> tuple[Remark, ...]:
    """Remarks on changes since a calibration, and their likely causes."""
    if test.holds:
        return ()
    notes, shift = [], float(np.hypot(*test.shift))
    if test.p_shift < test.alpha:
        shifted = f"the display has shifted against the reseau by {shift:.3g} {unit}"
        if registration is not None and registration.moved:
            notes.append(
                Remark(
                    f"{shifted} while the camera moved: there is a gap between reseau and screen (parallax); "
                    "keep the camera where PHOTO I was taken",
                    Code.PARALLAX,
                )
            )
        else:
            notes.append(Remark(f"{shifted}: was it centred again?", Code.DISPLAY_SHIFTED))
    if test.p_rest < test.alpha:
        rod, length = test.largest
        notes.append(
            Remark(
                f"the display of the instrument has changed, by up to {length:.3g} {unit} at rod {rod}: "
                "calibrate it again",
                Code.INSTRUMENT_CHANGED,
            )
        )
    return tuple(notes)


def of_the_object(
    instrument: FittedInstrument,
    pins: ImagePoints,
    design: ReseauDesign,
    declined: Mapping[str, str] | None = None,
) -> tuple[Remark, ...]:
    """Remarks on the test object; `declined` gives the reasons of rods that were seen and not measured."""
    plane = instrument.plane
    notes = [*of_gross_errors("rods", instrument.gross)]
    if instrument.enlarged > 1:
        text = f"residuals of the rods are {instrument.enlarged:.1f} times their standard deviations"
        notes.append(Remark(f"{text}, beyond chance; those of group B were enlarged", Code.SIGMAS_DOUBTFUL))
    if abs(plane.rotation) > np.pi - _UPRIGHT:
        notes.append(Remark("the test object is upside down, or M and N are swapped", Code.TARGET_ROTATED))
    elif abs(plane.rotation) > np.deg2rad(2.0):
        notes.append(
            Remark(
                f"the test object is turned by {np.rad2deg(plane.rotation):.1f}° against the reseau",
                Code.TARGET_ROTATED,
            )
        )
    missing = [i for i, name in enumerate(design.ids) if name not in pins.names]
    for axis, word in ((1, "row"), (0, "column")):
        for value in np.unique(np.round(design.xy[:, axis], 6)):
            line = np.flatnonzero(np.abs(design.xy[:, axis] - value) < 1e-6)
            if len(line) >= 3 and set(line) <= set(missing):
                where = f"{word} of rods at {'xy'[axis]} = {value:g} {design.unit}"
                notes.append(_of_a_line(where, [design.ids[i] for i in line], declined or {}))
    ratio = plane.scale[0] / plane.scale[1]
    if abs(ratio - 1) > 0.1:
        notes.append(
            Remark(
                f"the scales along and across differ by {abs(ratio - 1):.0%}: check the display's aspect",
                Code.UNEQUAL_SCALES,
            )
        )
    return tuple(notes)


def _of_a_line(where: str, names: list[str], declined: Mapping[str, str]) -> Remark:
    """Why none of a row or column of rods was measured."""
    reasons = [declined[name] for name in names if name in declined]
    if not reasons:
        return Remark(f"the whole {where} is missing", Code.NOT_FOUND)
    usual = max(reasons, key=reasons.count)
    number = "all" if len(reasons) == len(names) else f"{len(reasons)} of {len(names)}"
    others = "" if len(reasons) == len(names) else ", the others are missing"
    return Remark(
        f"the whole {where} was not measured: {number} were declined ({usual}){others}", Code.DECLINED
    )
