"""Failed estimates and warnings: a text for the user and a code for the program."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from .arrays import Array
from .errors import EstimationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .data import Frame

__all__ = ["Code", "Failure", "Remark"]


class Code(StrEnum):
    """Why an estimate failed or a result carries a warning; callers branch on it, never on a text.

    Examples
    --------
    >>> Code("too-few-points") is Code.TOO_FEW_POINTS
    True
    """

    AMBIGUOUS = "ambiguous"  # several solutions fit equally well: add something that distinguishes them
    BLURRED = "blurred"  # less sharp than the other marks: another object, or out of focus
    CAMERA_MOVED = "camera-moved"  # the camera has moved between photographs
    CAMERA_UNSTABLE = "camera-unstable"  # the camera's parameters differ between images
    COLLINEAR = "collinear"  # all points lie on one line
    CORRELATED = "correlated"  # unknowns that the observations can hardly separate
    COVERAGE = "coverage"  # parts of the images have no points
    CRASHED = "crashed"  # what computed it ended its process, twice
    DECLINED = "declined"  # an earlier step declined the image
    DEVIATES = "deviates"  # far from the position predicted by the other points
    DISPLAY_SHIFTED = "display-shifted"  # the display has shifted against the reseau
    DISTURBED = "disturbed"  # bit errors, dust or another object cross the mark
    DOUBTFUL_CONTROL = "doubtful-control"  # control points or distances contradict the images
    DRAWN = "drawn"  # graphics of the instrument, not part of the image
    EDGE_MISSING = "edge-missing"  # one edge of a frame was not found; the format determines it
    FILTERED = "filtered"  # moved during the exposure, out of focus, or sharpened by a program
    GROSS_ERRORS = "gross-errors"  # single observations are probably wrong: check or leave them out
    FRONTAL = "frontal"  # a plane is seen at right angles only: principal distance and distance are one
    HIDDEN = "hidden"  # covered, saturated or on lost pixels
    IMPLAUSIBLE = "implausible"  # a value that no real camera has: check its unit
    INCONSISTENT = "inconsistent"  # the observations contradict the model or each other
    INSTRUMENT_CHANGED = "instrument-changed"  # the instrument has changed since its calibration
    LOW_CONTRAST = "low-contrast"  # nothing stands out from the noise
    MIRRORED = "mirrored"  # the target is seen from behind or the image is mirrored
    NONLINEAR = "nonlinear"  # grey values are not proportional to the light, or the file says so wrongly
    NOT_CONVERGED = "not-converged"  # the iteration ended before its minimum
    NOT_CONSIDERED = "not-considered"  # nothing gives a reason to compute it
    NOT_FINITE = "not-finite"  # the model has no finite value at the approximate values
    NOT_FOUND = "not-found"  # the target or the feature is not in the image
    NOT_IDENTIFIED = "not-identified"  # the observations do not determine a point or a parameter
    NO_COORDINATES = "no-coordinates"  # the design does not define the position
    NO_DATUM = "no-datum"  # nothing defines the coordinate system
    NO_REDUNDANCY = "no-redundancy"  # too few observations for the unknowns, or for a test
    ONE_STATION = "one-station"  # the camera was only turned: points have no depth
    READINGS = "readings"  # readings of a stage in another unit or sense than the images show
    OTHER_DESIGN = "other-design"  # a target of another design is in the image
    OUTSIDE = "outside"  # beyond the edge of the frame
    OVERLAPPING = "overlapping"  # the image touches that of another mark
    PARALLAX = "parallax"  # a gap between reseau and screen shows after the camera moved
    PREREQUISITE_MISSING = "prerequisite-missing"  # an earlier step has no result
    RANK_DEFECT = "rank-defect"  # the observations do not determine a combination of the unknowns
    SATURATED = "saturated"  # the image is overexposed
    SEVERAL_TARGETS = "several-targets"  # the image shows more than one target
    SIGMAS_DOUBTFUL = "sigmas-doubtful"  # input sigmas do not agree with the residuals
    SINGULAR = "singular"  # the normal equations are singular to rounding
    SLANT = "slant"  # an edge is slanted too little or too much
    TARGET_ROTATED = "target-rotated"  # the target is rotated, or named points are exchanged
    TILTED = "tilted"  # the perspective of a tilted copying camera was found
    TOO_FEW_IMAGES = "too-few-images"
    TOO_FEW_LEVELS = "too-few-levels"  # exposures at too few levels of light
    TOO_FEW_POINTS = "too-few-points"
    TOO_LARGE = "too-large"  # needs more memory than it may take
    TOO_MANY_OUTLIERS = "too-many-outliers"  # the model is probably wrong, not the observations
    TOO_SMALL = "too-small"  # the region or the target covers too few pixels
    UNCERTAIN = "uncertain"  # the standard deviation is larger than allowed
    UNEQUAL_SCALES = "unequal-scales"  # the scales along the two axes differ
    UNKNOWN_STEP = "unknown-step"  # the procedure has no step of this name
    UNLIKE = "unlike"  # the image is not that of the mark
    UNMODELLED = "unmodelled"  # the residuals show a pattern that the model does not describe
    WEAK_GEOMETRY = "weak-geometry"  # points, images or parameters with very large uncertainty


@dataclass(frozen=True)
class Failure:
    """An estimate that failed; falsy.

    Parameters
    ----------
    reason : str
        One line for the user: what is wrong and what helps, without the name of the file.
    code : Code
        The same for programs.
    where : str
        The frame, file or mark it is about; empty where only the caller knows it.
    places : ndarray (m, 2), optional
        Places that were found in the frame (px) before the estimate failed.

    Examples
    --------
    >>> found = Failure("3 points are too few", Code.TOO_FEW_POINTS, where="left.png")
    >>> bool(found), found.code == "too-few-points", str(found)
    (False, True, 'left.png: 3 points are too few')
    """

    reason: str
    code: Code
    where: str = ""
    places: Array | None = field(default=None, compare=False, repr=False)

    def __bool__(self) -> bool:
        return False

    def __str__(self) -> str:
        return f"{self.where}: {self.reason}" if self.where else self.reason

    def overlay(self, frame: Frame, path: Path | str | None = None) -> NDArray[np.uint8]:
        """Draw the places that were found over the frame, with the reason of the failure.

        Parameters
        ----------
        frame : Frame
            The frame.
        path : str or Path, optional
            PNG file to write.

        Returns
        -------
        ndarray (h, w, 3) of uint8
            See :meth:`reseau.measure.points.Measured.overlay`.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        from .overlay import OTHER, Layer, draw_overlay

        layers = []
        if self.places is not None:
            label = f"places found, {len(self.places)}"
            layers = [Layer(label, self.places, colour=OTHER)]
        title = str(self) if self.where else f"{frame.name}: {self.reason}"
        return draw_overlay(frame.pixels, layers, title, path=path)

    def required(self) -> NoReturn:
        """Raise, for callers that need the estimate.

        Raises
        ------
        EstimationError
            With the reason.
        """
        raise EstimationError(self.reason, where=self.where or None)


@dataclass(frozen=True)
class Remark:
    """A warning about a result that is usable nevertheless.

    Parameters
    ----------
    text : str
        One line for the user: what was noticed and what helps.
    code : Code
        The same for programs.

    Examples
    --------
    >>> remark = Remark("the camera has moved", Code.CAMERA_MOVED)
    >>> str(remark), remark.code == "camera-moved"
    ('the camera has moved', True)
    """

    text: str
    code: Code

    def __str__(self) -> str:
        return self.text
