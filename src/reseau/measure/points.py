"""Measured points of one frame: the columns that all results of a measurement share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import scipy

from ..core.data import Array, Frame, ImagePoints, Mask
from ..core.display import Display
from ..core.errors import UsageError
from ..core.failure import Code, Estimated, Remark
from ..core.overlaid import Overlaid
from ..io import ReseauMeasurement
from ..optics.field import SmoothField
from .fitting import on_one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..core.overlay import Layer


class Reason(str):
    """Why a point was not measured: a text with a code.

    Parameters
    ----------
    text : str
        The reason for the user.
    code : Code
        The same for programs.

    Examples
    --------
    >>> why = Reason("outside the frame", Code.OUTSIDE)
    >>> why, why.code == "outside"
    ('outside the frame', True)
    """

    code: Code

    def __new__(cls, text: str, code: Code) -> Self:
        """The text, which carries its code."""
        reason = super().__new__(cls, text)
        reason.code = code
        return reason

    def repeated(self, count: int) -> Array:
        """An array (count,) of this reason."""
        reasons = np.empty(count, dtype=object)
        reasons[:] = self  # np.full would convert it to a plain str
        return reasons

    def __getnewargs__(self) -> tuple[str, Code]:  # type: ignore[override]
        return str(self), self.code


_ABOVE = 2.0
"""Ratio of the scatter about a smooth mapping to that of the sigmas, which hold within a quarter, from which
there is a note."""
_FALSE = 0.01
"""Share of sound frames in which one point deviates beyond chance."""
_SPARE = 6
"""Minimum number of points beyond the coefficients of a mapping, per axis."""


def deviating(ids: Sequence[str], source: Array, xy: Array, cov: Array) -> tuple[Remark, ...]:
    """A note where points deviate from every smooth mapping of the others more than their sigmas say.

    Mappings with trends of all degrees compete: the one that predicts points best from the others counts. A
    stiff one would make few points of a strong distortion look like wrong ones.

    Parameters
    ----------
    ids : sequence of str (n,)
        Names.
    source, xy : ndarray (n, 2)
        Points in the design and in the image, NaN where not measured.
    cov : ndarray (n, 2, 2)
        Covariances in the image.
    """
    known = np.flatnonzero(np.isfinite(xy).all(axis=1) & np.isfinite(source).all(axis=1))
    if len(known) < 3 + _SPARE or on_one_line(source[known]):
        return ()
    sigma = np.sqrt(np.trace(cov[known], axis1=1, axis2=2) / 2)
    spare = {degree: len(known) - (degree + 1) * (degree + 2) // 2 for degree in range(1, 6)}
    fields = {
        degree: SmoothField.fit(source[known], xy[known], sigma=sigma / np.median(sigma), degree=degree)
        for degree, freedom in spare.items()
        if freedom >= _SPARE
    }
    left = {degree: one.leave_one_out() for degree, one in fields.items()}
    degree = min(left, key=lambda each: float(np.square(left[each][0] / sigma[:, None]).sum()))
    best, (off, predicted) = fields[degree], left[degree]
    typical, scatter = float(np.median(sigma)), float(np.sqrt(np.mean(best.noise**2)))
    if scatter > _ABOVE * typical:
        text = (
            f"points deviate from the prediction by the others by {np.sqrt(np.mean(off**2)):.2g} px (rms), "
            f"more than the {typical:.2g} px of their sigmas explain: the distortion is not smooth, or "
            "sigmas do not contain all errors"
        )
        return (Remark(text, Code.INCONSISTENT),)
    # The scatter is that of the sigmas, or larger; one point that is wrong enlarges it for all.
    far = np.abs(off / predicted).max(axis=1) * max(scatter / typical, 1.0)
    worst = int(far.argmax())
    # The scatter is known from the points that are left, and the degree was chosen among several.
    chance = 2 * scipy.special.stdtr(spare[degree], -far[worst])
    if 2 * len(known) * len(fields) * chance > _FALSE:
        return ()
    away = float(np.hypot(*off[worst]))
    text = f"{ids[known[worst]]} deviates from the prediction by the others by {away:.2g} px"
    return (Remark(f"{text}, {far[worst]:.0f} sigma", Code.INCONSISTENT),)


@dataclass(frozen=True, eq=False, repr=False)
class Measured(Estimated, Display, Overlaid):
    """Points of a design measured in one frame, in columns over all n points of the design.

    Parameters
    ----------
    image, sha256 : str
        Name and hash of the frame.
    ids : tuple of str (n,)
        Names of the points.
    xy : ndarray (n, 2)
        Image coordinates in pixels, NaN where not measured.
    cov : ndarray (n, 2, 2)
        Covariances in px², NaN where not measured.
    ok : ndarray of bool (n,)
        Which points were measured, with certain names.
    why : tuple of str (n,)
        Reason why a point was not measured; empty where it was.
    predicted : ndarray (n, 2)
        Image coordinates predicted from the other points.
    deviation : ndarray (n, 2)
        Measured minus predicted; NaN where not measured, or where too few other points are known.
    contrast, t, noise : ndarray (n,)
        Quality of each match, see :class:`reseau.measure.matching.Matches`; NaN where there was no match.
    """

    image: str
    sha256: str
    ids: tuple[str, ...]
    xy: Array
    cov: Array
    ok: Mask
    why: tuple[str, ...]
    predicted: Array
    deviation: Array
    contrast: Array
    t: Array
    noise: Array

    def _facts(self) -> list[tuple[str, str]]:
        sigma = self.points.sigma
        return [
            ("image", self.image),
            ("measured", f"{self.found} of {len(self.ids)}"),
            ("median sigma", f"{np.median(sigma):.2g} px" if len(sigma) else "–"),
        ]

    def _columns(self) -> dict[str, list[Any]]:
        s = np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))
        columns = {"x_px": self.xy[:, 0], "y_px": self.xy[:, 1], "sx_px": s[:, 0], "sy_px": s[:, 1]}
        table: dict[str, list[Any]] = {"id": list(self.ids)}
        table |= {name: column.tolist() for name, column in columns.items()}
        return table | {"ok": self.ok.tolist(), "why": [str(why) for why in self.why]}

    def plot(self, axes: Axes | None = None, frame: Frame | None = None) -> Axes:
        """Draw measured points as circles, others as crosses where they are predicted, with matplotlib.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        frame : Frame, optional
            The image, drawn beneath.
        """
        from ..core.figures import ACCENT, BLUE, over_picture

        axes = over_picture(axes, None if frame is None else frame.pixels)
        axes.plot(
            *self.xy[self.ok].T, "o", markerfacecolor="none", color=BLUE, markersize=4, markeredgewidth=0.8
        )
        axes.plot(*self.predicted[~self.ok].T, "x", color=ACCENT, markersize=4, markeredgewidth=0.8)
        axes.set_title(f"{self.image}: {self.found} of {len(self.ids)} measured", loc="left")
        return axes

    def _heading(self) -> str:
        return f"{self.image}: {self.found} of {len(self.ids)} measured"

    def _footnotes(self) -> list[str]:
        return [str(note) for note in self.remarks]

    def layers(self) -> list[Layer]:
        """What is drawn over the frame: first what was measured, then each reason for declining."""
        from ..core.overlay import Layer, declined_layers

        found, rest = np.flatnonzero(self.ok), np.flatnonzero(~self.ok)
        measured = Layer(
            f"measured, {self.found}", self.xy[found], tuple(self.ids[i] for i in found), self.cov[found]
        )
        codes = [(self.codes[i] or Code.DECLINED).value for i in rest]
        at = np.where(np.isfinite(self.xy[rest]), self.xy[rest], self.predicted[rest])
        names, why = [self.ids[i] for i in rest], [str(self.why[i]) for i in rest]
        return [measured, *declined_layers(names, at, why, codes)]

    def write(self, path: Path | str) -> None:
        """Write the result: ``reseau-measurement/1``, or CSV ``id,x,y,sx,sy`` of the measured points.

        Parameters
        ----------
        path : str or Path
            A file that ends in ``.json`` or ``.csv``.

        Raises
        ------
        UsageError
            When the file has another suffix.
        InputError
            When the file cannot be written.
        """
        suffix = Path(path).suffix.lower()
        if suffix not in (".json", ".csv"):
            raise UsageError(f"ends in {suffix or 'no suffix'!r}", where=path, do="use .json or .csv")
        if suffix == ".json":
            self.measurement().write(path)
        else:
            self.points.write(path)

    @property
    def found(self) -> int:
        """Number of points measured."""
        return int(self.ok.sum())

    @property
    def codes(self) -> tuple[Code | None, ...]:
        """Codes (n,) of the reasons; None where a point was measured."""
        return tuple(why.code if isinstance(why, Reason) else None for why in self.why)

    @property
    def points(self) -> ImagePoints:
        """The points that were measured."""
        return self._some(self.ok)

    @property
    def candidates(self) -> ImagePoints:
        """The points that were measured, also those whose names are not certain."""
        return self._some(self.ok | self._unsure)

    @property
    def _unsure(self) -> Mask:
        """Points that were measured, but whose names are not certain."""
        unsure = np.array([code is Code.AMBIGUOUS for code in self.codes], dtype=bool)
        return np.asarray(unsure & np.isfinite(self.xy).all(axis=1))

    def _some(self, keep: Mask) -> ImagePoints:
        names = tuple(name for name, kept in zip(self.ids, keep, strict=True) if kept)
        return ImagePoints(names, self.xy[keep], self.cov[keep])

    def rms(self) -> Array:
        """Root mean square deviation from the prediction, per axis (2,); NaN without predictions."""
        known = self.deviation[np.isfinite(self.deviation).all(axis=1)]
        return np.sqrt((known**2).mean(axis=0)) if len(known) else np.full(2, np.nan)

    def measurement(self) -> ReseauMeasurement:
        """The result as a document."""
        why = tuple(map(str, self.why))
        return ReseauMeasurement.from_columns(
            self.image, self.sha256, self.ids, self.xy, self.cov, self.ok, why, self.remarks, self._unsure
        )

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """Notes for the user; results that have none have no `notes`."""
        return tuple(getattr(self, "notes", ()))
