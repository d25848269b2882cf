"""Failed estimates and warnings: a text for the user and a code for the program."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NoReturn, Self

from .arrays import Array
from .errors import EstimationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .data import Frame


class Code(StrEnum):
    """Why an estimate failed or a result carries a warning; callers branch on it, never on a text.

    Each code has a `cause` and a `cure`, in general terms; a message says both for its case.

    Examples
    --------
    >>> Code("too-few-points") is Code.TOO_FEW_POINTS, Code.SATURATED.cure
    (True, 'take less light, or a shorter exposure')
    """

    cause: str
    cure: str

    def __new__(cls, value: str, cause: str = "", cure: str = "") -> Self:
        """Attach cause and cure to the text of the code."""
        code = str.__new__(cls, value)
        code._value_, code.cause, code.cure = value, cause, cure
        return code

    AMBIGUOUS = (
        "ambiguous",
        "several solutions fit equally well",
        "add something that distinguishes them: a coded mark, an approximate position, a limit of rotation; "
        "in a network control points, distances, or images from other places",
    )
    BLURRED = (
        "blurred",
        "less sharp than the other marks: another object, or out of focus",
        "focus, or stop down; leave the mark out",
    )
    CAMERA_MOVED = (
        "camera-moved",
        "the camera has moved between photographs",
        "fix it, and take the photographs again",
    )
    CAMERA_UNSTABLE = (
        "camera-unstable",
        "the camera's parameters differ between images",
        "fix focus and zoom, switch stabilisation off, and let the camera warm up",
    )
    COLLINEAR = "collinear", "all points lie on one line", "add points beside it"
    CORRELATED = (
        "correlated",
        "unknowns that the observations can hardly separate",
        "use them together only, or add images that separate them",
    )
    COVERAGE = (
        "coverage",
        "parts of the images have no points",
        "take photographs in which the target lies there",
    )
    CRASHED = (
        "crashed",
        "what computed it ended its process, twice",
        "check memory and input, and report it with them",
    )
    DECLINED = "declined", "an earlier step declined the image", "see the reason of that step"
    DEVIATES = (
        "deviates",
        "far from the position predicted by the other points",
        "look at the mark in the overlay; another object may have been taken for it",
    )
    DISPLAY_SHIFTED = (
        "display-shifted",
        "the display has shifted against the reseau",
        "take PHOTO II again, and calibrate anew",
    )
    DISTURBED = (
        "disturbed",
        "bit errors, dust or another object cross the mark",
        "clean it, or leave the mark out",
    )
    DOUBTFUL_CONTROL = (
        "doubtful-control",
        "control points or distances contradict the images",
        "check their numbers, units and names",
    )
    DRAWN = (
        "drawn",
        "graphics of the instrument, not part of the image",
        "switch the graphics off, or mask them",
    )
    EDGE_MISSING = (
        "edge-missing",
        "one edge of a frame was not found; the format determines it",
        "scan the whole frame with a margin",
    )
    FILTERED = (
        "filtered",
        "moved during the exposure, out of focus, or sharpened by a program",
        "use the camera's original, with a short exposure",
    )
    GROSS_ERRORS = (
        "gross-errors",
        "single observations are probably wrong",
        "check them, or leave them out with `--reject`",
    )
    FRONTAL = (
        "frontal",
        "a plane is seen at right angles only: principal distance and distance are one",
        "take photographs that are tilted by 30° and more",
    )
    HIDDEN = "hidden", "covered, saturated or on lost pixels", "uncover the mark, or take less light"
    IMPLAUSIBLE = "implausible", "a value that no real camera has", "check its unit"
    INCONSISTENT = (
        "inconsistent",
        "the observations contradict the model or each other",
        "check the numbers, the model, and that all images are of one camera",
    )
    INSTRUMENT_CHANGED = (
        "instrument-changed",
        "the instrument has changed since its calibration",
        "calibrate it again",
    )
    LOW_CONTRAST = (
        "low-contrast",
        "nothing stands out from the noise",
        "use more light, or another channel of the image",
    )
    MIRRORED = (
        "mirrored",
        "the target is seen from behind or the image is mirrored",
        "mirror the image, or say `--mirrored`",
    )
    NONLINEAR = (
        "nonlinear",
        "grey values are not proportional to the light, or the file says so wrongly",
        "use raw or linear files, or give a calibration of the sensor",
    )
    NOT_CONVERGED = (
        "not-converged",
        "the iteration ended before its minimum",
        "give better approximate values, or free fewer parameters",
    )
    NOT_CONSIDERED = "not-considered", "nothing gives a reason to compute it", "nothing is needed"
    NOT_FINITE = (
        "not-finite",
        "the model has no finite value at the approximate values",
        "give other approximate values",
    )
    NOT_FOUND = (
        "not-found",
        "the target or the feature is not in the image",
        "check image and design; see the overlay for the places that were considered",
    )
    NOT_IDENTIFIED = (
        "not-identified",
        "the observations do not determine a point or a parameter",
        "add images of it, hold it, or leave it out",
    )
    NO_COORDINATES = (
        "no-coordinates",
        "the design does not define the position",
        "add the point to the design",
    )
    NO_DATUM = (
        "no-datum",
        "nothing defines the coordinate system",
        "give control points, a distance, or ask for a free network",
    )
    NO_REDUNDANCY = (
        "no-redundancy",
        "too few observations for the unknowns, or for a test",
        "add observations, or hold parameters",
    )
    ONE_STATION = (
        "one-station",
        "the camera was only turned: points have no depth",
        "take photographs from other places",
    )
    READINGS = (
        "readings",
        "readings of a stage in another unit or sense than the images show",
        "check unit, sign and order of the readings",
    )
    OTHER_DESIGN = (
        "other-design",
        "a target of another design is in the image",
        "give the design of the target that was photographed",
    )
    OUTSIDE = (
        "outside",
        "beyond the edge of the frame",
        "nothing is needed, or take the photograph from farther away",
    )
    OVERLAPPING = (
        "overlapping",
        "the image touches that of another mark",
        "photograph from nearer, or with smaller marks",
    )
    PARALLAX = (
        "parallax",
        "a gap between reseau and screen shows after the camera moved",
        "keep the camera where it was in PHOTO I",
    )
    PREREQUISITE_MISSING = (
        "prerequisite-missing",
        "an earlier step has no result",
        "see the reason of that step",
    )
    RANK_DEFECT = (
        "rank-defect",
        "the observations do not determine a combination of the unknowns",
        "hold one of the parameters that are named, or add observations",
    )
    REVERBERATION = (
        "reverberation",
        "a second echo of a reflector, behind the first and weaker",
        "nothing is needed; it is no point",
    )
    SATURATED = "saturated", "the image is overexposed", "take less light, or a shorter exposure"
    SEVERAL_TARGETS = (
        "several-targets",
        "the image shows more than one target",
        "cover the others, or crop the image",
    )
    SIGMAS_DOUBTFUL = (
        "sigmas-doubtful",
        "input sigmas do not agree with the residuals",
        "check the standard deviations of the observations, then the model",
    )
    SINGULAR = (
        "singular",
        "the normal equations are singular to rounding",
        "hold parameters, or give better approximate values",
    )
    SLANT = "slant", "an edge is slanted too little or too much", "turn the chart by 3° to 15°"
    TARGET_ROTATED = (
        "target-rotated",
        "the target is rotated, or named points are exchanged",
        "check the names of the points, or the mount of the target",
    )
    TILTED = (
        "tilted",
        "the perspective of a tilted copying camera was found",
        "nothing is needed; a scan without a tilt is better",
    )
    TOO_FEW_IMAGES = (
        "too-few-images",
        "there are too few images",
        "take more photographs, from different directions",
    )
    TOO_FEW_LEVELS = (
        "too-few-levels",
        "exposures at too few levels of light",
        "take more levels between dark and saturation",
    )
    TOO_FEW_POINTS = (
        "too-few-points",
        "there are too few points",
        "show more of the target, or use a target with more points",
    )
    TOO_LARGE = (
        "too-large",
        "needs more memory than it may take",
        "allow more with `--memory-gb`, or divide the work",
    )
    TOO_MANY_OUTLIERS = (
        "too-many-outliers",
        "the model is probably wrong, not the observations",
        "look at the residuals, and choose another model",
    )
    TOO_SMALL = (
        "too-small",
        "the region or the target covers too few pixels",
        "photograph from nearer, or choose a larger region",
    )
    UNCERTAIN = (
        "uncertain",
        "the standard deviation is larger than allowed",
        "use more light, larger marks or more photographs",
    )
    UNEQUAL_SCALES = (
        "unequal-scales",
        "the scales along the two axes differ",
        "check the shape of the pixels, and the print of the target",
    )
    UNKNOWN_STEP = (
        "unknown-step",
        "the procedure has no step of this name",
        "use one of the names that are listed",
    )
    UNLIKE = (
        "unlike",
        "the image is not that of the mark",
        "look at the overlay; check shape and size in the design",
    )
    UNMODELLED = (
        "unmodelled",
        "the residuals show a pattern that the model does not describe",
        "choose a model with more parameters, or look for a bent target",
    )
    WEAK_GEOMETRY = (
        "weak-geometry",
        "points, images or parameters with very large uncertainty",
        "add convergent images, and images turned by 90°",
    )


class Estimated:
    """What did not fail: truthy, which type checkers know, too.

    Examples
    --------
    >>> result = Estimated()
    >>> result.required() is result if result else "failed"
    True
    """

    def __bool__(self) -> Literal[True]:
        return True

    def required(self) -> Self:
        """Return this; a :class:`Failure` raises."""
        return self


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

    def __bool__(self) -> Literal[False]:
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
            The frame, enlarged by a whole number if it is small, with a legend below it.

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
