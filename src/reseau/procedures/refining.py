"""The oscilloscope procedure for a series of photographs, or with a stored calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration import Calibration, InstrumentCorrection
from ..core.data import Frame, ImagePoints
from ..core.errors import UsageError
from ..core.failure import Failure
from ..io import ReseauDesign
from ..measure.pins.detection import PinOptions
from ..measure.reseau.marks import ReseauOptions
from .oscilloscope import photo_i, photo_ii, photo_iii, still_standard_in
from .refined import Refined


@dataclass(frozen=True)
class Photographs:
    """Photographs of the procedure: files, or what else is read, or None.

    Parameters
    ----------
    first, second : Any
        PHOTO I and II.
    third : sequence
        PHOTO III of each body.

    Examples
    --------
    >>> Photographs("one.png", third=("three.png",)).given
    ('one.png', 'three.png')
    """

    first: Any = None
    second: Any = None
    third: Sequence[Any] = ()

    @property
    def given(self) -> tuple[Any, ...]:
        """All that there are, in their order."""
        return tuple(each for each in (self.first, self.second, *self.third) if each is not None)


@dataclass(frozen=True)
class RefineOptions:
    """Options of the procedure.

    Parameters
    ----------
    check : tuple of str
        Marks and rods that are held out for a check.
    alpha : float
        Level of the tests of coefficients.
    marks, pins : ReseauOptions, PinOptions
        Options of the measurement of reseau and rods.
    points : ImagePoints, optional
        Points of the body in PHOTO III, where they were measured elsewhere.

    Examples
    --------
    >>> RefineOptions().alpha
    0.05
    """

    check: tuple[str, ...] = ()
    alpha: float = 0.05
    marks: ReseauOptions = field(default_factory=ReseauOptions)
    pins: PinOptions = field(default_factory=PinOptions)
    points: ImagePoints | None = None


def refine_photographs(
    photographs: Photographs,
    reseau: ReseauDesign | None = None,
    test_object: ReseauDesign | None = None,
    calibration: Calibration | None = None,
    options: RefineOptions | None = None,
    *,
    read: Callable[[Any], Frame | ImagePoints],
    seen: Callable[[Any, Frame | ImagePoints, Any], None] = lambda *_: None,
) -> Refined | Failure:
    """Correct photographs by PHOTO I and II, or by a stored calibration, which a new PHOTO II tests.

    Parameters
    ----------
    photographs : Photographs
        With a calibration PHOTO II and III only.
    reseau, test_object : ReseauDesign, optional
        Designs for PHOTO I and PHOTO II. With a calibration, which contains its own, the test object is
        another one for its test.
    calibration : Calibration, optional
        Groups A and B.
    options : RefineOptions, optional
        Options of the procedure.
    read : callable
        Returns a photograph, or the coordinates measured in it.
    seen : callable
        Is called with each photograph as it was given, as it was read, and with what was found in it.

    Returns
    -------
    Refined or Failure
        The result of each photograph; a failure when one of the targets is not found.

    Raises
    ------
    UsageError
        When something is missing or cannot be given together, or a mark or rod of the check is unknown.
    """
    options = options or RefineOptions()
    _check(photographs, reseau, test_object, calibration, options)

    def found_in(photo: Any, find: Callable[..., Any], *about: Any, **more: Any) -> Any:
        """What a step finds in a photograph; coordinates are divided into marks and others."""
        frame = whole = read(photo)
        if isinstance(whole, ImagePoints) and find is not photo_i:
            frame, more["marks"] = _split(whole, grid)
        found = find(frame, *about, options=options.marks, **more)
        seen(photo, whole, found)
        if isinstance(found, Failure):
            return replace(found, where=str(photo)) if isinstance(photo, Path) else found
        if find is photo_i and isinstance(whole, Frame):
            size = whole.width, whole.height
            found = replace(found, camera=replace(found.camera, size=size))
        return found

    tests = {"alpha": options.alpha, "check": options.check}
    first = second = again = instrument = None
    if calibration is None:
        assert reseau is not None
        grid = reseau
        first = found_in(photographs.first, photo_i, grid, **tests)
        if isinstance(first, Failure):
            return first
        if test_object is not None:
            about = grid, test_object, first.camera
            second = found_in(photographs.second, photo_ii, *about, pins=options.pins, **tests)
            if isinstance(second, Failure):
                return second
            instrument = second.instrument
    else:
        instrument, grid, rods = InstrumentCorrection.from_calibration(calibration)
        if photographs.second is not None:
            again = found_in(
                photographs.second, still_standard_in, instrument, grid, test_object or rods,
                pins=options.pins, same_object=test_object is None, alpha=options.alpha,
            )  # fmt: skip
            if isinstance(again, Failure):
                return again
        test_object = test_object or rods
    bodies = []
    for photo in photographs.third:
        body = found_in(photo, photo_iii, instrument, grid, points=options.points)
        if isinstance(body, Failure):
            return body
        bodies.append(body)
    return Refined(first, second, tuple(bodies), grid, test_object, again, instrument, photographs.given)


def _split(points: ImagePoints, design: ReseauDesign) -> tuple[ImagePoints, ImagePoints | None]:
    """Points other than marks of the reseau, and these."""
    marks = np.isin(points.names, design.ids)
    return points.select(~marks), (points.select(marks) if marks.any() else None)


def _check(
    photographs: Photographs, reseau: ReseauDesign | None, rods: ReseauDesign | None,
    calibration: Calibration | None, options: RefineOptions,
) -> None:  # fmt: skip
    """Refuse what is missing or superfluous."""
    if not 0 < options.alpha < 1:
        raise UsageError(f"{options.alpha:g} is not between 0 and 1", where="alpha")
    if calibration is not None:
        if photographs.first is not None or reseau is not None:
            raise UsageError(
                "contains PHOTO I and its reseau", where="calibration", do="give PHOTO III, or II to test it"
            )
        if not photographs.given:
            raise UsageError(
                "needs a photograph", where="calibration", do="give PHOTO III, or PHOTO II to test it"
            )
        return
    if photographs.first is None or reseau is None:
        raise UsageError("needs PHOTO I and its reseau, or a calibration", where="refine")
    if (photographs.second is None) != (rods is None):
        raise UsageError("PHOTO II and its test object must be given together", where="refine")
    if photographs.third and photographs.second is None:
        raise UsageError("needs PHOTO II and its test object", where="PHOTO III")
    known = {*reseau.ids, *(() if rods is None else rods.ids)}
    unknown = [name for name in options.check if name not in known]
    if unknown:
        raise UsageError(f"{unknown[0]!r} is neither a mark nor a rod", where="check")
