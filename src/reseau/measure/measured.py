"""What was measured in one frame, and what was not: the common part of all results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Array, ImagePoints, Mask
from ..io import ReseauMeasurement

__all__ = ["Measured"]


@dataclass(frozen=True, eq=False)
class Measured:
    """The points of a design in one frame, in columns over all n of them.

    Parameters
    ----------
    image, sha256 : str
        The frame.
    ids : tuple of str (n,)
        Their names.
    xy : ndarray (n, 2)
        Image coordinates in pixels, NaN where not measured.
    cov : ndarray (n, 2, 2)
        Covariances in px², NaN where not measured.
    ok : ndarray of bool (n,)
        Which were measured.
    why : tuple of str (n,)
        Why not, empty where measured.
    predicted : ndarray (n, 2)
        Where the others have each.
    deviation : ndarray (n, 2)
        Measured minus predicted; NaN where not measured, or where there are too few others to predict.
    contrast, t, noise : ndarray (n,)
        Of each match, see :class:`reseau.measure.matching.Matches`; NaN where there was none.
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
        """Deviation from the prediction, root mean square per axis (2,); NaN where there is none."""
        known = self.deviation[np.isfinite(self.deviation).all(axis=1)]
        return np.sqrt((known**2).mean(axis=0)) if len(known) else np.full(2, np.nan)

    def measurement(self) -> ReseauMeasurement:
        """The result as the document that others read."""
        return ReseauMeasurement.from_columns(
            self.image, self.sha256, self.ids, self.xy, self.cov, self.ok, self.why
        )
