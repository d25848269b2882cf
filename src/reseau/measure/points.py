"""Measured points of one frame: the columns that all results of a measurement share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ..core.data import Array, ImagePoints, Mask
from ..core.failure import Code
from ..io import ReseauMeasurement

__all__ = ["Measured", "Reason"]


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


@dataclass(frozen=True, eq=False)
class Measured:
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
        Which points were measured.
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
        names = tuple(name for name, ok in zip(self.ids, self.ok, strict=True) if ok)
        return ImagePoints(names, self.xy[self.ok], self.cov[self.ok])

    def rms(self) -> Array:
        """Root mean square deviation from the prediction, per axis (2,); NaN without predictions."""
        known = self.deviation[np.isfinite(self.deviation).all(axis=1)]
        return np.sqrt((known**2).mean(axis=0)) if len(known) else np.full(2, np.nan)

    def measurement(self) -> ReseauMeasurement:
        """The result as a document."""
        return ReseauMeasurement.from_columns(
            self.image, self.sha256, self.ids, self.xy, self.cov, self.ok, tuple(map(str, self.why))
        )
