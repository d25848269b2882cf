"""What a calibration is good for: the verdict that belongs to it, in memory and in its file.

:func:`reseau.procedures.assessment.assess` computes it from an adjustment. Everything that states the
accuracy of a calibration takes it from here: texts, figures, documents, exports, certificates.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from html import escape
from typing import TYPE_CHECKING, Self

import numpy as np
import scipy
from pydantic import Field

from ..core.data import Array
from ..core.errors import UsageError
from ..io import Strict
from ..optics import Pose

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_DIGITS, _FINE = 4, 5
"""Significant digits of the errors in a file; places that are drawn for each of a map."""

Rows = tuple[tuple[float | None, ...], ...]


class Use(StrEnum):
    """What a calibration is accurate enough for, by its error in the corners of the image.

    Examples
    --------
    >>> Use.of(0.2), Use.of(0.2).words
    (<Use.RECONSTRUCTION: 'reconstruction'>, 'usable for 3-D reconstruction, stereo and poses, not for ...')
    """

    MEASUREMENT = "measurement"  # up to 0.05 px
    RECONSTRUCTION = "reconstruction"  # up to 0.3 px: stereo, poses of objects and robots, models of scenes
    VIEWING = "viewing"  # up to 2 px: images without visible distortion
    NOTHING = "nothing"

    @classmethod
    def of(cls, corners_px: float) -> Use:
        """The use for which an error in the corners is small enough."""
        return next((use for use, limit in _LIMITS.items() if corners_px <= limit), Use.NOTHING)

    @property
    def limit_px(self) -> float:
        """Largest error in the corners."""
        return _LIMITS.get(self, float("inf"))

    @property
    def words(self) -> str:
        """What it is usable for."""
        return _FOR[self]


_LIMITS = {Use.MEASUREMENT: 0.05, Use.RECONSTRUCTION: 0.3, Use.VIEWING: 2.0}
_FOR = {
    Use.MEASUREMENT: "usable for measurement",
    Use.RECONSTRUCTION: "usable for 3-D reconstruction, stereo and poses, not for precise measurement",
    Use.VIEWING: "usable to remove visible distortion only",
    Use.NOTHING: "not usable",
}


_COLOURS = {
    Use.MEASUREMENT: "#2e7d4f", Use.RECONSTRUCTION: "#2f5d7c", Use.VIEWING: "#b8860b", Use.NOTHING: "#b3402a",
}  # fmt: skip


@dataclass(frozen=True)
class Cause:
    """One explanation of what an adjustment leaves.

    Parameters
    ----------
    code : str
        ``lens``, ``refocus``, ``other-camera``, ``rolling-shutter``, ``motion``, ``target-shape``,
        ``target-scale``, ``names``, ``blunders``, ``noise`` or ``unknown``.
    form : str
        Its form.
    amount_px : float
        What it explains in the image points, root mean square.
    share : float
        Its part of the sum of squares of the residuals.
    probability : float
        Among all explanations that were compared.
    where : str
        Images, points or cameras concerned; empty where it is all of them.
    do : str
        What to do.
    instead : bool
        Whether it explains the same as the cause before it.

    Examples
    --------
    >>> Cause("lens", "radial", 0.12, 0.9, 1.0, "", "estimate more coefficients").code
    'lens'
    """

    code: str
    form: str
    amount_px: float
    share: float
    probability: float
    where: str = ""
    do: str = ""
    instead: bool = False


class NextPhotograph(Strict):
    """The photograph that would improve a calibration most.

    `text` says how it looks; `outline_px` and `points_px` are the images of the target's outline and points.
    `worst_px` is the largest standard deviation of the projection with it. `rotation` (vector, rad) and `x0`
    are the pose of the camera in the system of the target.

    Examples
    --------
    >>> NextPhotograph(text="fills the image", outline_px=((0.0, 0.0),), worst_px=0.02).pose is None
    True
    """

    text: str
    outline_px: tuple[tuple[float, float], ...]
    worst_px: float
    points_px: tuple[tuple[float, float], ...] = ()
    rotation: tuple[float, float, float] | None = None
    x0: tuple[float, float, float] | None = None

    @classmethod
    def of(cls, pose: Pose, text: str, outline: Array, xy: Array, worst_px: float) -> Self:
        """The photograph from a pose; places without a ray (NaN) are left out of the outline."""
        return cls(
            text=text, outline_px=_pairs(outline[np.isfinite(outline).all(axis=1)]), worst_px=worst_px,
            points_px=_pairs(xy), rotation=tuple(pose.rotation.tolist()), x0=tuple(pose.x0.tolist()),
        )  # fmt: skip

    @property
    def pose(self) -> Pose | None:
        """Pose of the camera; None in files of earlier versions."""
        if self.rotation is None or self.x0 is None:
            return None
        return Pose(np.array(self.rotation), np.array(self.x0))


class ErrorMap(Strict):
    """Standard errors of the projection over the image, worst direction, at the crossings of `x` and `y`.

    `total_px` contains everything that is known to be wrong or uncertain; `formal_px` only the noise of the
    image points, as if they were independent. Rows run down; null where the camera has no ray.

    Examples
    --------
    >>> errors = ErrorMap(x=(0.0, 9.0), y=(0.0,), total_px=((0.2, None),), formal_px=((0.1, None),))
    >>> errors.greatest_px
    0.2
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    total_px: Rows
    formal_px: Rows

    @classmethod
    def of(cls, xy: Array, total: Array, formal: Array) -> Self:
        """The map of places (rows, columns, 2) and errors (rows, columns)."""
        return cls(
            x=tuple(xy[0, :, 0].tolist()), y=tuple(xy[:, 0, 1].tolist()), total_px=_rounded(total),
            formal_px=_rounded(formal),
        )  # fmt: skip

    @property
    def xy(self) -> Array:
        """Places (rows, columns, 2), pixels."""
        return np.stack(np.meshgrid(np.array(self.x), np.array(self.y)), axis=-1)

    @property
    def total(self) -> Array:
        """Total errors (rows, columns), px; NaN where there is no ray."""
        return np.array(self.total_px, dtype=np.float64)

    @property
    def formal(self) -> Array:
        """Formal standard deviations (rows, columns), px."""
        return np.array(self.formal_px, dtype=np.float64)

    @property
    def greatest_px(self) -> float:
        """The largest total error; NaN without any."""
        known = self.total[np.isfinite(self.total)]
        return float(known.max()) if len(known) else float("nan")

    @property
    def median_px(self) -> float:
        """Median of the total errors; NaN without any."""
        known = self.total[np.isfinite(self.total)]
        return float(np.median(known)) if len(known) else float("nan")

    def _finely(self, values: Array) -> tuple[Array, Array]:
        """Places and values between those of the map, for smooth contours, where none is missing."""
        if not (values > 0).all() or min(values.shape) < 4:
            return self.xy, values
        x, y = (np.linspace(at[0], at[-1], _FINE * (len(at) - 1) + 1) for at in (self.x, self.y))
        between = scipy.interpolate.RectBivariateSpline(self.y, self.x, np.log(values))
        return np.stack(np.meshgrid(x, y), axis=-1), np.exp(between(y, x))

    def plot(self, axes: Axes | None = None, *, formal: bool = False) -> Axes:
        """Draw contours of the total errors, or of the formal standard deviations, with matplotlib.

        Both have the same levels.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        formal : bool
            Whether to draw the formal standard deviations.
        """
        from ..core.figures import draw_contours

        xy, drawn = self._finely(self.formal if formal else self.total)
        title = f"{'formal σ' if formal else 'error'} of the projection / px"
        return draw_contours(axes, xy, drawn, title, np.stack([self.total, self.formal]))


class Assessment(Strict):
    """What a calibration is good for.

    Parameters
    ----------
    use : Use
        What it is accurate enough for.
    lines : tuple of str
        The verdict in words: use, errors and causes; then what the photographs cover, and what to do next.
    centre_px : float
        Standard error of the projection in the middle.
    corners_px : float, optional
        That in the worst of the corners, or of a circular image in the worst place; None where the projection
        is not determined there.
    circular_deg : float
        Angle from the axis up to which a circular image has rays; 0 where the image fills the frame.
    causes : tuple of Cause
        What is wrong, the most probable first; empty where nothing is.
    images : int, optional
        Number of photographs.
    tilts_deg : (float, float), optional
        Angles at which the two most tilted photographs of a plane target were taken, the largest first; None
        where it is not plane.
    covered : float, optional
        Share of the image, in cells of a twelfth of its width and height, with points.
    uncovered : tuple of str
        Parts of the image with few points.
    next_photograph : NextPhotograph, optional
        Photograph that would help most; None where no photograph lowers the error, or something other than
        the model of the lens is wrong.
    errors : ErrorMap, optional
        The errors over the image.

    Examples
    --------
    >>> found = Assessment(use=Use.MEASUREMENT, lines=(), centre_px=0.0016, corners_px=0.024)
    >>> found
    <Assessment: usable for measurement: 0.0016 px at the centre, 0.024 px in the corners>
    """

    use: Use = Field(strict=False)
    lines: tuple[str, ...]
    centre_px: float
    corners_px: float | None
    circular_deg: float = 0.0
    causes: tuple[Cause, ...] = ()
    images: int | None = None
    tilts_deg: tuple[float, float] | None = None
    covered: float | None = None
    uncovered: tuple[str, ...] = ()
    next_photograph: NextPhotograph | None = None
    errors: ErrorMap | None = None

    def __repr__(self) -> str:
        return f"<Assessment: {self.short}>"

    def __str__(self) -> str:
        return "\n".join(self.lines or (self.short,))

    def _repr_html_(self) -> str:
        colour = _COLOURS[self.use]
        first, *rest = self.lines or (self.short,)
        more = "".join(f"<div>{escape(line)}</div>" for line in rest)
        style = f"border-left:.3em solid {colour};padding-left:.6em;text-align:left"
        return f'<div style="{style}"><b>{escape(first)}</b>{more}</div>'

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the total error over the image with matplotlib; in a new figure with the formal one beside it.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.

        Raises
        ------
        UsageError
            When there is no map of the errors.
        """
        if self.errors is None:
            raise UsageError("has no map of its errors", where="assessment")
        if axes is not None:
            return self.errors.plot(axes)
        import matplotlib.pyplot as plt

        figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.4), layout="constrained")
        figure.suptitle(self.short, fontsize="medium")
        self.errors.plot(right, formal=True)
        return self.errors.plot(left)

    @property
    def fits(self) -> bool:
        """Whether nothing is wrong, but perhaps the standard deviations of the image points."""
        return all(cause.code == "noise" for cause in self.causes)

    @property
    def short(self) -> str:
        """Use and errors in a few words."""
        return f"{self.use.words}: {self.stated}"

    @property
    def stated(self) -> str:
        """The errors at the centre and in the corners, in words."""
        if self.corners_px is None:
            return "the projection is not determined in the corners"
        place = f"up to {self.circular_deg:.0f}° from the axis" if self.circular_deg else "in the corners"
        return f"{two_digits(self.centre_px)} px at the centre, {two_digits(self.corners_px)} px {place}"


_WITHOUT = "it was imported, computed from others, or made by an earlier version"


def required_use(
    assessed: Iterable[tuple[str, Assessment | None]], doing: str, *, anyway: bool = False
) -> tuple[str, ...]:
    """Refuse to use what is usable for nothing; return what is to be said of the others, a line each.

    Parameters
    ----------
    assessed : iterable of (str, Assessment or None)
        Names of calibrations of cameras, and what they are good for.
    doing : str
        What is to be done with them, as ``exported`` or ``applied``.
    anyway : bool
        Whether to go on where a calibration is usable for nothing.

    Returns
    -------
    tuple of str
        Of each that has no verdict, or is usable for less than measurement.

    Raises
    ------
    UsageError
        When one is usable for nothing, unless `anyway`.

    Examples
    --------
    >>> required_use([("front", None)], "exported")
    ('calibration front has no verdict: it was imported, computed from others, or made by an ...',)
    >>> bad = Assessment(use=Use.NOTHING, lines=(), centre_px=0.2, corners_px=50.0)
    >>> required_use([("front", bad)], "exported")
    Traceback (most recent call last):
    reseau.core.errors.UsageError: calibration front: is not usable: 0.2 px at the centre, 50 px in the ...
    """
    said = []
    for name, found in assessed:
        where = f"calibration {name}"
        if found is None:
            said.append(f"{where} has no verdict: {_WITHOUT}")
            continue
        if found.use is Use.NOTHING and not anyway:
            raise UsageError(
                f"is {found.short}; it is not {doing}", where=where,
                do=f"{_advice(found)}, or go on with --anyway (anyway=True)",
            )  # fmt: skip
        if found.use is not Use.MEASUREMENT:
            said.append(f"{where} is {found.short}")
    return tuple(said)


def _advice(found: Assessment) -> str:
    """What to do about a calibration that is not usable, in a few words."""
    named = [cause.do for cause in found.causes if cause.do and cause.code != "noise"]
    if named:
        return named[0]
    return "take more photographs" if found.next_photograph is None else "take the photograph that would help"


def two_digits(value: float) -> str:
    """Two significant digits, never with an exponent for large values.

    Examples
    --------
    >>> two_digits(0.01234), two_digits(1234.5)
    ('0.012', '1200')
    """
    digits = f"{value:.2g}"
    return f"{float(digits):.0f}" if value >= 99.5 else digits


def _pairs(xy: Array) -> tuple[tuple[float, float], ...]:
    """Points (n, 2) to a hundredth of a pixel."""
    return tuple((x, y) for x, y in np.round(xy, 2).tolist())


def _rounded(values: Array) -> Rows:
    return tuple(
        tuple(float(f"{v:.{_DIGITS}g}") if np.isfinite(v) else None for v in row) for row in values.tolist()
    )
