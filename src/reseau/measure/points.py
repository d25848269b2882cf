"""Measured points of one frame: the columns that all results of a measurement share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Array, ImagePoints, Mask
from ..io import ReseauMeasurement

__all__ = ["Measured"]


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
            self.image, self.sha256, self.ids, self.xy, self.cov, self.ok, self.why
        )
