"""Marks of a plane target, once they are found and numbered: learning of their appearance, and matching.

The image of every mark is formed with the mapping through all marks, to second order, and matched. The
estimate is therefore the image of its point, not the centre of its image. What differs between kinds of marks
are the images themselves, which :class:`PlaneMarks` leaves to its subclasses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import KDTree

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code, Remark
from ...core.tone import ToneCurve
from ...optics import Chain
from ...optics.field import SmoothField
from ...optics.formation import PixelResponse
from ..matching import (
    Matches,
    MatchOptions,
    Shape,
    ShapeSubset,
    Window,
    grey_variance,
    match,
    with_alike_errors,
)
from ..points import Reason
from ..response import FilteredShape, Samples, estimate_kernel
from ..screening import Screened
from ..testfield.targets import merged, replaced
from ..tone import find_curve
from .lens_mapping import mapping_through
from .marks import ReseauOptions
from .sheet_placement import through

__all__ = ["Appearance", "Located", "PlaneMarks"]

_CLASS_PX = 4
"""Step of the window sizes."""
_GROUND_PX, _GROUND_WIDTHS = 5, 3.0
"""Background shown by a window around its mark: pixels, and widths of the point-spread function."""
_LEARNT_FROM = 120
"""Most marks from which mapping and appearance are learnt first."""
_AT_ONCE_PX = 60_000
"""Number of pixels of windows matched together; what is formed in them fits into the cache of a processor."""
_SLOPE = 0.3
"""Standard deviation of the change of contrast from the centre of a mark to the edge of its window, caused by
reflected light."""
_SEEN = 0.6
"""Least share of a mark on pixels that can be used."""
_HIGH_RESIDUALS = 1.25
"""Multiple of the usual residuals from which something is suspected in front of a mark."""
_DISTURBED = 1.6
"""Multiple of the usual residuals from which a mark is declined."""
_FOREIGN, _SHADE, _SHIFT_PX = 4.0, 0.03, 0.25
"""Tolerances of the prediction of a mark by its neighbours: noise, share of the light, and shift."""
_NEIGHBOURS = 6
"""Number of neighbours whose light is taken."""
_LIKELY = 0.7
"""Correlation with the formed image from which a mark that was not found at first is looked for."""
_ENOUGH_LIKE = 6
"""Least number of reliable marks from which something is learnt."""
_FEW = 3
"""One in so many of these shows whether a kernel is needed."""
_KERNELS = 2
"""Number of times a kernel is estimated."""
_FILTERED = 0.85
"""Ratio of mean square residuals below which a kernel is used."""
_BULGED = 0.3
"""Largest deviation of a mark from its neighbours' prediction, in radii: paper bulges."""
_UNMODELLED_PX = 0.05
"""Scatter of positions beyond their own sigmas: the sheet is not plane."""
_FORMED_PX = 0.002
"""Standard deviation of what no formed image contains: edges of prints, unequal pixels."""
_EXPLAINED = 0.7
"""Ratio of residuals below which a curve explains what looked like motion or sharpening."""
_UNKNOWN_PX = 1.0
"""Error of a position that nothing bounds; it is more than is accepted."""
_WHOLE = 0.97
"""Share of the pixels of a mark below which it is seen in part."""
_BENT_PX = 0.15
"""Distance of one mark in ten from the mapping through all, from which that is adjusted again."""
_ROUNDS, _SAME = 6, 0.5
"""Most rounds of matching with the mapping through the last matches; change of the middles of images, in
sigmas, by which positions are moved rather than matched again."""
_SPREAD = 16
"""Least number of marks that show the mapping through a lens before all are matched."""
_NEAR_WIDTH, _NEAR_FORM = 0.15, 0.01
"""Relative error of the sharpness, and change of the form, beyond which marks are matched again before the
camera's response is learnt."""
_AROUND_PX, _SHARPNESS_OF, _SHARP = 9, 9, (0.4, 6.0)
"""Reach around a mark within which the sharpness is seen first, number of marks; and its limits, pixels."""
_LENGTH_OF = 80
"""Number of marks from which the correlation length of what a polynomial leaves is that of half as many."""
_PER_SMOOTH = 2.5
"""Least number of coordinates for each term of the polynomial about which positions scatter."""
_PSF_LOG_SIGMA = 0.2
"""Spread of sharpness (logarithm) over the marks of one frame."""
_BLURRED = 1.8
"""Tolerated factor of the sharpness of a mark."""
_LEAST_RIM = 0.25
"""Share of the edge of a mark below which the level of the paper is hardly seen, and has no slope."""
_BESIDE = 0.05
"""Share of a pixel from which other ink hides it from the matching; the light of fainter tails is
subtracted."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of the marks of this frame.

    Examples
    --------
    >>> Appearance(0.7, 0.5, 1.0, np.zeros(0), None, None, 0.7, None, None).psf_px
    0.7
    """

    psf_px: float
    psf_log_sigma: float
    size: float
    form_sigma: Array
    variance: tuple[float, float] | None
    kernel: Array | None
    """Of motion or sharpening, see :mod:`reseau.measure.response`."""
    blur_px: float
    """Width of the point-spread function with the kernel."""
    contrast: Array | None
    """Contrast (n,) of each mark of the design."""
    light: Array | None
    """Grey values (n,) that full ink adds at each mark of the design; negative for dark ink."""


@dataclass(frozen=True, eq=False)
class Located:
    """Where the marks of a design are in a frame, approximately.

    Parameters
    ----------
    ids : tuple of str (n,)
        Names of the marks.
    xy : ndarray (n, 2)
        Their coordinates in the plane of the design.
    polarity : {"dark", "bright"}
        Of the marks.
    mapping : Chain
        Mapping from lattice coordinates to the image.
    frame, origin : ndarray (2, 2), (2,)
        Lattice coordinates are `frame` times those of the design, plus `origin`.
    found : ndarray of bool (n,)
        Marks that were found.
    start : ndarray (n, 2)
        Where they were found; for others any value.

    Examples
    --------
    >>> from reseau.measure.testfield.lattice_mapping import started
    >>> plain, two = started(np.eye(3), 1, (480, 640)), np.array([[0.0, 0.0], [1.0, 0.0]])
    >>> all_found = np.ones(2, dtype=bool)
    >>> Located(("a", "b"), two, "dark", plain, np.eye(2), np.zeros(2), all_found, 100 * two).at[1]
    array([1., 0.])
    """

    ids: tuple[str, ...]
    xy: Array
    polarity: Literal["dark", "bright"]
    mapping: Chain
    frame: Array
    origin: Array
    found: Mask
    start: Array

    @property
    def at(self) -> Array:
        """Lattice coordinates (n, 2)."""
        return np.asarray(self.xy @ self.frame.T + self.origin)


def _variance(found: Matches) -> Array:
    """Mean variance (k,) of both coordinates."""
    return np.asarray(np.trace(found.cov, axis1=1, axis2=2) / 2)


def _sure(found: Matches) -> Mask:
    """Marks that show the mapping."""
    return found.converged & (found.t > 8) & (found.rejected < 0.1) & (found.seen > _SEEN)


class PlaneMarks(ABC):
    """The two rounds of matching, and the tests of every mark.

    Parameters
    ----------
    image : Frame
        The frame.
    screened : Screened
        Its grey values as they are matched.
    located : Located
        The marks.
    options : ReseauOptions
        Options of the measurement.
    size : float
        Size of a mark in the unit of the design.
    """

    word: ClassVar[str]
    """What a mark is called in messages."""
    form_sigma: ClassVar[Array]
    """Standard deviations of the parameters of the form, before anything is learnt."""
    learnt_form_sigma: ClassVar[Array]
    """The same for marks whose common size is known."""
    learnt_from: ClassVar[int] = _LEARNT_FROM
    """Most marks from which mapping and appearance are learnt first."""
    sampled: ClassVar[int] = 20
    """Most marks that show the camera's response."""
    precise_start: ClassVar[bool] = False
    """Whether marks are found so precisely that a match can continue from what is known of them."""
    eccentric: ClassVar[bool] = False
    """Whether the mapping moves the centres of images so much that marks are matched again with the
    one through all of them."""
    least_seen: ClassVar[float] = _SEEN
    """Least share of a mark on pixels that can be used."""
    curve_first: ClassVar[bool] = False
    """Whether a curve between light and grey values is looked for before motion and sharpening."""
    even: ClassVar[bool] = False
    """Whether images of marks are even about their points."""
    formed_px: ClassVar[float] = _FORMED_PX
    """Standard deviation of what no formed image contains."""

    def __init__(
        self, image: Frame, screened: Screened, located: Located, options: ReseauOptions, size: float
    ) -> None:
        self.image, self.screened, self.options = image, screened, options
        self.ids, self.xy, self.polarity = located.ids, located.xy, located.polarity
        self.frame, self.mapping, self.origin = located.frame, located.mapping, located.origin
        self.at, self.found = located.at, located.found
        self.start = np.where(self.found[:, None], located.start, self.mapping(self.at))
        self.look = Appearance(
            options.psf_px, 0.5, size, self.form_sigma, None, None, options.psf_px, None, None
        )
        self.hidden = np.zeros(screened.grey.shape, dtype=bool)
        self.dazzled = np.zeros(len(self.at), dtype=bool)  # by reflected light
        self.lit = np.zeros_like(self.dazzled)  # by so little that no pixels are lost
        self.notes: tuple[Remark, ...] = ()
        self.displaced: tuple[Chain, ...] = ()
        self.learning = True
        self.quick = self.precise_start  # whether marks are matched without a search for blunders
        self.own_px = np.zeros(len(self.at))  # pixels of the windows that belong to marks, matched last
        self.begun_px = options.psf_px  # width of the point-spread function from which the first match began
        self.rough = 0.0  # residuals of the marks that were learnt from

    @abstractmethod
    def _images(self, rows: Rows) -> tuple[Shape, Array]:
        """Images of marks around the images of their points, and half their width and height (k, 2)."""

    @abstractmethod
    def _settle(self, first: Matches) -> Matches:
        """Learn sharpness and size; the form of the matches refers to the new size."""

    @abstractmethod
    def _edge_seen(self, rows: Rows, found: Matches) -> Array:
        """Share (k,) of the pixels on the blurred edge of each mark that were used."""

    @abstractmethod
    def _radius(self, rows: Rows) -> Array:
        """Half the mean extent (k,) of marks in the image."""

    def _misshapen(self, found: Matches) -> list[tuple[Mask, Reason]]:
        """Objections to the form of marks."""
        return []

    def _beside(self) -> Array | None:
        """Share (h, w) of each pixel that other ink of the target takes."""
        return None

    def _region(self, rows: Rows, half: tuple[int, int]) -> Mask | None:
        """Pixels (k, rows, columns) of the windows that belong to the marks; None for all."""
        return None

    def columns(self, *, with_field: bool = True) -> dict[str, Any]:
        """Columns of the result; the field from the design to the image only if wanted."""
        rows = np.flatnonzero(self.found)
        if len(rows) > self.learnt_from:
            rows = rows[np.linspace(0, len(rows) - 1, self.learnt_from).astype(np.intp)]
        first, sure = self._first(rows)
        if sure.sum() >= _ENOUGH_LIKE:
            self._respond(self._learn(first.select(sure), rows[sure]), rows[sure])
        rows, self.learning, self.quick = self._in_sight(), False, False
        found = self._match_all(rows)
        # Marks with something in front of them show neither the mapping nor its errors.
        plain = _sure(found) & ~self._uneasy(found) & (found.seen > _WHOLE) & (found.rejected == 0)
        if self.eccentric or self._bent(rows[plain], found.select(plain)):
            found = self._mapped(rows, found, _sure(found) if self.eccentric else plain)
        doubtful, field = self._doubtful(rows, found)
        if doubtful.any() and field is not None and (~doubtful & ~self.dazzled[rows]).sum() >= _NEIGHBOURS:
            # Look again where their neighbours predict them, without what lies in front of them.
            found = self._uncovered(rows, found, doubtful, field)
        alike = with_alike_errors(found, np.rint(self.start[rows]) if self.even else None)
        found = self._tempered(rows, found, alike) if self.even else alike
        if self.precise_start:
            found = self._with_doubtful_light(rows, found)
        found = replace(found, cov=found.cov + self._misformed(rows))
        why, field = self._judged(rows, found, field)
        return self._spread(rows, found, why, field, with_field)

    def _uncovered(self, rows: Rows, found: Matches, doubtful: Mask, field: SmoothField) -> Matches:
        """Matches of which the doubtful ones are made without what lies in front of them.

        A reflection adds light that neighbours do not have, and so seems to hide marks beside it. It is
        smooth: a mark that was matched without an objection, and of which then too little is left, keeps
        its first match.
        """
        good, start = np.all([~mask for mask, _ in self._objections(rows, found)], axis=0), self.start.copy()
        self._uncover(rows, found, doubtful, field)
        again = self._match_all(rows[doubtful])
        if self.precise_start:
            hidden = {Code.HIDDEN, Code.NOT_CONVERGED, Code.UNCERTAIN}
            lost = [mask for mask, why in self._objections(rows[doubtful], again) if why.code in hidden]
            lit = good[doubtful] & np.any(lost, axis=0)
            those = rows[doubtful][lit]
            self.lit[those], self.start[those] = True, start[those]
            again = replaced(again, ~lit, found.select(np.flatnonzero(doubtful)[lit]))
        return replaced(found, ~doubtful, again)

    def _mapped(self, rows: Rows, found: Matches, sure: Mask) -> Matches:
        """Matches with the mapping through the marks that are `sure`, which itself depends on the matches."""
        h, w = self.screened.grey.shape
        for _ in range(_ROUNDS if self.eccentric else 1):
            if sure.sum() < _ENOUGH_LIKE:
                break
            before, sigma = self._off_centre(self.mapping, rows), np.sqrt(_variance(found))
            through_all = mapping_through(self.at[rows[sure]], found.xy[sure], sigma[sure], (h, w))
            self.mapping, self.displaced = through_all.mapping, through_all.displaced
            moved = self._off_centre(self.mapping, rows) - before
            if self.eccentric and (np.abs(moved[sure]).max(axis=1) < _SAME * sigma[sure]).all():
                # A match follows the middle of an image, to first order.
                return replace(found, xy=found.xy - moved)
            self.start[rows[sure]] = found.xy[sure]
            if self.eccentric:
                # Growth about the image of the point is not that of the mark on its plane.
                self._settle(found.select(sure))
            found = self._match_all(rows)
            sure = _sure(found)
        return found

    def _off_centre(self, mapping: Chain, rows: Rows) -> Array:
        """How far (k, 2) the middles of the images of marks are from the images of their points."""
        return np.zeros((len(rows), 2))

    def _misformed(self, rows: Rows) -> Array:
        """Covariances (k, 2, 2) of what formed images lack, and of the mapping that forms them."""
        cov = np.tile(self.formed_px**2 * np.eye(2), (len(rows), 1, 1))
        middle = self._off_centre(self.mapping, rows)
        for mapping in self.displaced:
            off = self._off_centre(mapping, rows) - middle
            cov += off[:, :, None] * off[:, None]
        return cov

    def _first(self, rows: Rows) -> tuple[Matches, Mask]:
        """First matches of some marks, and which of them are reliable."""
        if self.precise_start:
            psf_px = self._sharpness(rows)
            self.look, self.begun_px = replace(self.look, psf_px=psf_px, blur_px=psf_px), psf_px
            first = self._match(rows)
            sure = first.converged & (first.t > 8)
            if sure.any():
                sure &= first.noise < _DISTURBED * np.median(first.noise[sure])
            if 2 * sure.sum() > len(rows):
                return first, sure
            self.begun_px = self.options.psf_px
            self.look = replace(self.look, psf_px=self.begun_px, blur_px=self.begun_px)
            self.quick = False
        first = self._match(rows)
        return first, first.converged & (first.t > 8) & (first.rejected < 0.2)

    def _sharpness(self, rows: Rows) -> float:
        """Width of the point-spread function by the steepest slopes around some of the marks, pixels."""
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, _SHARPNESS_OF).astype(np.intp))]
        half = _AROUND_PX + int(np.ceil(self._radius(rows).max()))
        x, y = self._pixels(rows, (half, half))
        grey = self.screened.grey[y, x]
        # Over two pixels; that and the pixel itself have variances of 1/3 and 1/12.
        across = (grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]) / 2
        down = (grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]) / 2
        steep = np.quantile(np.hypot(across, down).reshape(len(rows), -1), 0.98, axis=1)
        dark, bright = np.quantile(grey.reshape(len(rows), -1), [0.1, 0.9], axis=1)
        variance = (bright - dark) ** 2 / (2 * np.pi * np.maximum(steep, 1e-9) ** 2) - 1 / 3 - 1 / 12
        return float(np.clip(np.sqrt(max(float(np.median(variance)), 0.0)), *_SHARP))

    def _doubtful(self, rows: Rows, found: Matches) -> tuple[Mask, SmoothField | None]:
        """Marks that are looked at again, and the field that predicts them."""
        # Where paper is saturated, neighbours do not predict the light.
        if self.precise_start:
            doubtful = self._uneasy(found)
            for mask, _ in self._objections(rows, found):
                doubtful |= mask
            doubtful |= (np.abs(found.xy - self.mapping(self.at[rows])) > self.options.neighbour_px).any(
                axis=1
            )
            if not (doubtful & ~self.dazzled[rows]).any():
                return doubtful & ~self.dazzled[rows], None
        why, field = self._judged(rows, found)
        return ((why != "") | self._uneasy(found)) & ~self.dazzled[rows], field

    def _bent(self, rows: Rows, found: Matches) -> bool:
        """Whether the lens bends the target more than the mapping through the marks found contains."""
        off = np.abs(found.xy - self.mapping(self.at[rows]))
        return bool(len(off) >= _ENOUGH_LIKE and np.quantile(off, 0.9) > _BENT_PX)

    def _straight(self, rows: Rows) -> Array:
        """Images by the projectivity alone, the source coordinates of smooth fields."""
        return self.mapping.first(self.at[rows])

    def _in_sight(self) -> Rows:
        """Indices of disks whose centres lie in the frame."""
        h, w = self.screened.grey.shape
        inside = ((self.start > 0) & (self.start < (w - 1, h - 1))).all(axis=1)
        return np.flatnonzero(inside)

    def _with_doubtful_light(self, rows: Rows, found: Matches) -> Matches:
        """Matches with covariances that contain what another background would change.

        Where a part of a window is saturated or hidden, it is no longer symmetric about its mark, and errors
        of the background shift the position, as those of a reflection do.
        """
        used = np.isfinite(found.residuals).sum(axis=(1, 2))
        partly = found.converged & ((used < _WHOLE * self.own_px[rows]) | self.lit[rows])
        if not partly.any():
            return found
        cov = found.cov.copy()
        # What a parabola leaves of reflected light is seen by a cubic, too.
        for some, background in ((partly, 1), (partly & self.lit[rows], 3)):
            if not some.any():
                continue
            other = self._match(rows[some], background=background)
            # Light that another background cannot describe has no known influence.
            unknown = np.where(self.lit[rows[some]], _UNKNOWN_PX, 0.0)[:, None]
            change = np.where(other.converged[:, None], other.xy - found.xy[some], unknown)
            cov[some] += change[:, :, None] * change[:, None, :]
            # The change shows the size of the error, not its direction.
            cov[some] += 0.5 * (change**2).sum(axis=1)[:, None, None] * np.eye(2)
        return replace(found, cov=cov)

    def _tempered(self, rows: Rows, plain: Matches, alike: Matches) -> Matches:
        """Matches with as much of the errors that pixels have in common as the scatter of positions shows.

        Correlations of residuals are those of the whole frame; what they make of a position is a bound.
        Positions also scatter about a smooth mapping: with the covariances C + f E, of independent
        errors and of what they have in common, the weighted square sum of the deviations is the redundancy.
        """
        extra = alike.cov - plain.cov
        good = plain.converged & (plain.t > 8) & (plain.rejected < 0.1) & (plain.seen > _SEEN)
        good &= np.trace(extra, axis1=1, axis2=2) != 0
        count = int(good.sum())
        degree = next((d for d in (5, 4, 3) if _PER_SMOOTH * (d + 1) * (d + 2) <= 2 * count), None)
        if degree is None:
            return alike
        at = self._straight(rows[good])
        at = (at - at.mean(axis=0)) / np.maximum(np.ptp(at, axis=0) / 2, 1e-9)
        terms = np.stack(
            [at[:, 0] ** i * at[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1
        )
        c, e = (np.diagonal(cov[good], axis1=1, axis2=2) for cov in (plain.cov, extra))
        redundancy = 2 * (count - terms.shape[1])

        def excess(share: float) -> float:
            total = 0.0
            for k in range(2):
                root = np.sqrt(c[:, k] + share * e[:, k])
                weighted = terms / root[:, None]
                off = plain.xy[good, k] / root
                total += float(((off - weighted @ np.linalg.lstsq(weighted, off, rcond=None)[0]) ** 2).sum())
            return float(total - redundancy)

        none, whole = excess(0.0), excess(1.0)
        if none * whole < 0:
            share = float(brentq(excess, 0.0, 1.0, xtol=0.01))
        else:
            share = 0.0 if abs(none) < abs(whole) else 1.0
        return replace(alike, cov=plain.cov + share * extra)

    def _match_all(self, rows: Rows) -> Matches:
        """Match disks; on even paper where paper is saturated all around."""
        found = self._match(rows, influence=True)
        if self.look.kernel is not None and self.precise_start and not found.converged.all():
            # Without the kernel residuals are larger, and so are the sigmas.
            look, lost = self.look, ~found.converged
            self.look = replace(look, kernel=None, psf_px=look.blur_px)
            found = replaced(found, ~lost, self._match(rows[lost], influence=True))
            self.look = look
        # Only where pixels are lost can the edge be.
        lost = found.converged & (np.isfinite(found.residuals).sum(axis=(1, 2)) < self.own_px[rows])
        if not lost.any():
            return found
        dim = lost.copy()
        dim[lost] = self._edge_seen(rows[lost], found.select(lost)) < _LEAST_RIM
        self.dazzled[rows] |= dim
        if not dim.any():
            return found
        return replaced(found, ~dim, self._match(rows[dim], background=0, influence=True))

    def _match(self, rows: Rows, background: int = 2, influence: bool = False) -> Matches:
        """Match disks, grouped by window size."""
        images, reach = self._images(rows)
        beside = self._beside()
        # In a large frame every copy takes time.
        valid = self.screened.valid & ~self.hidden if self.hidden.any() else self.screened.valid
        if beside is not None:
            valid = valid & (beside < _BESIDE) & (beside > -_BESIDE)
        parts, found = [], []
        for part, half in self._windows(reach):
            region = self._region(rows[part], half)
            here = None if beside is None else beside[self._pixels(rows[part], half)[::-1]]
            self.own_px[rows[part]] = float((2 * np.array(half) + 1).prod())
            if region is not None:
                # What is printed there is known, and the same around every mark.
                own = region if here is None else region & (np.abs(here) < _BESIDE)
                self.own_px[rows[part]] = own.sum(axis=(1, 2))
            options = MatchOptions(
                half_px=half,
                psf_px=self.look.psf_px,
                psf_log_sigma=self.look.psf_log_sigma,
                response=PixelResponse(self.options.fill),
                polarity=self.polarity,
                row_jitter_px=self.options.row_jitter_px,
                settled=0.05,
                influence=influence,
                contrast=None if self.look.contrast is None else self.look.contrast[rows[part]],
                contrast_slope=_SLOPE,
                background=background,
                variance=self.look.variance,
            )
            found.append(
                match(
                    self.screened.grey,
                    valid,
                    self._shape(images, part),
                    self.start[rows[part]],
                    options,
                    noise=max(self.screened.noise, self.rough),
                    form_sigma=self._form_sigma(),
                    light=self._known_light(rows[part], background),
                    precise=self.quick,
                    others=self._light_of(here, rows[part]),
                    region=region,
                    least=(np.where(self.found[rows[part]], -1.0, _LIKELY), self.least_seen),
                )
            )
            parts.append(part)
        return merged(parts, found)

    def _form_sigma(self) -> Array:
        """Standard deviations of the parameters of the form."""
        return self.look.form_sigma

    def _shape(self, images: Shape, part: Rows) -> Shape:
        """Images of some of the marks."""
        plain = ShapeSubset(images, part)
        return plain if self.look.kernel is None else FilteredShape(plain, self.look.kernel)

    def _windows(self, reach: Array) -> Iterator[tuple[Rows, tuple[int, int]]]:
        """Marks with windows of one size, not too many, and half their width and height."""
        ground = max(_GROUND_PX, int(np.ceil(_GROUND_WIDTHS * self.look.blur_px)))
        sizes, of = np.unique(np.ceil(reach / _CLASS_PX).astype(np.intp), axis=0, return_inverse=True)
        for k, size in enumerate(sizes):
            half = size * _CLASS_PX + ground
            part = np.flatnonzero(of.ravel() == k)
            some = max(1, int(_AT_ONCE_PX // (2 * half + 1).prod()))
            for piece in np.array_split(part, -(-len(part) // some)):
                yield piece, (int(half[0]), int(half[1]))

    def _pixels(self, rows: Rows, half: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns (k, 1, c) and rows (k, r, 1) of the windows of marks, within the frame."""
        h, w = self.screened.grey.shape
        centre = np.rint(self.start[rows]).astype(np.intp)
        x, y = (centre[:, k, None] + np.arange(-half[k], half[k] + 1) for k in (0, 1))
        return np.clip(x, 0, w - 1)[:, None, :], np.clip(y, 0, h - 1)[:, :, None]

    def _known_light(self, rows: Rows, background: int) -> tuple[Array, Array] | None:
        """Contrast and background from which the match of marks continues."""
        look = self.look
        if not self.precise_start or look.contrast is None or look.light is None:
            return None
        ground = np.zeros((len(rows), (background + 1) * (background + 2) // 2))
        ground[:, 0] = np.abs(look.light[rows] / look.contrast[rows])
        return look.contrast[rows], ground

    def _light_of(self, beside: Array | None, rows: Rows) -> Array | None:
        """Light (k, rows, columns) that other ink, its share in the windows given, takes there."""
        light = self.look.light
        if light is None or beside is None:
            return None
        return np.asarray(beside * light[rows, None, None])

    def _learn(self, first: Matches, rows: Rows) -> Matches:
        """Learn mapping, sharpness, size and noise from reliable marks; their form refers to the new size."""
        self.start[rows] = first.xy
        known = self.found if self.precise_start else np.isin(np.arange(len(self.at)), rows)
        h, w = self.screened.grey.shape
        self.mapping = through(self.at[known], self.start[known], (h, w))
        if self.eccentric and len(rows) >= _SPREAD:
            sigma = np.sqrt(_variance(first))
            self.mapping = mapping_through(self.at[rows], first.xy, sigma, (h, w)).mapping
        self._weigh(first, rows)
        first = self._settle(first)
        self.look = replace(
            self.look,
            psf_log_sigma=_PSF_LOG_SIGMA,
            form_sigma=self.learnt_form_sigma,
            blur_px=self.look.psf_px,
        )
        self.start = np.where(self.found[:, None], self.start, self.mapping(self.at))
        return first

    def _depth(self, found: Matches) -> Array:
        """Grey values (k,) that ink adds."""
        return np.asarray(found.contrast * (-found.level if self.polarity == "dark" else 1))

    def _respond(self, first: Matches, rows: Rows) -> None:
        """Learn what motion, sharpening and the curve of the camera make of the images."""
        some = np.unique(np.linspace(0, len(rows) - 1, self.sampled).astype(np.intp))
        first, rows = first.select(np.isin(np.arange(len(rows)), some)), rows[some]
        # The first match may have begun far from the sharpness and form of these images, or with other
        # figures beside them.
        near = abs(np.log(np.median(first.psf_px) / self.begun_px)) < _NEAR_WIDTH
        near &= bool((np.median(np.abs(first.form), axis=0) < _NEAR_FORM).all())
        if not (self.precise_start and near and self._beside() is None):
            first = self._settle(self._match(rows))
            self._weigh(first, rows)
        few = np.arange(len(rows)) % _FEW == 0
        kernel, sharper, gain = estimate_kernel(self._samples(first.select(few), rows[few])[0])
        bent = False
        if gain < _FILTERED and self.curve_first:
            first, bent = self._straighten(first, rows, beside=gain)
            if bent:
                kernel, sharper, gain = estimate_kernel(self._samples(first.select(few), rows[few])[0])
        if gain < _FILTERED:
            for again in range(_KERNELS):
                if again:
                    # Position and form were those of images without the kernel.
                    self.look = replace(self.look, kernel=None)
                    kernel, sharper, _ = estimate_kernel(self._samples(first, rows)[0], (1.0,))
                self.look = replace(self.look, kernel=kernel, psf_px=sharper * self.look.psf_px)
                first = self._settle(self._match(rows))
                self._weigh(first, rows)
            text = "the images are smeared by motion or sharpened: this was estimated and is modelled"
            self.notes += (Remark(text, Code.FILTERED),)
        if not bent:
            self._straighten(first, rows)

    def _straighten(self, first: Matches, rows: Rows, beside: float | None = None) -> tuple[Matches, bool]:
        """Learn the curve between light and grey values; whether there is one.

        Where a kernel leaves the share `beside` of the mean square residuals, a curve is adopted only if it
        leaves less than that, and much less than grey values as they are.
        """
        straight, full_scale = ToneCurve(1.0), self.image.full_scale
        tried = {straight: (self.screened, self.look, first)}

        def matched(curve: ToneCurve) -> tuple[Samples, Array] | None:
            if curve not in tried:
                self.screened = replace(self.screened, grey=self._linear(curve))
                # The noise of grey values is alike, that of light grows with it where curves are steeper.
                bent = float(curve.light(np.array(0.5), 1.0)) < 0.5
                variance = (0.02 * full_scale, 1.0) if bent else None
                self.look = self._relit(replace(self.look, variance=variance), tried[straight][1], curve)
                again = self._settle(self._match(rows))
                self.screened = replace(self.screened, noise=float(np.median(again.noise)))
                tried[curve] = self.screened, self.look, again
            self.screened, self.look, again = tried[curve]
            good = again.converged
            if not good.all() and not (self.precise_start and good.sum() >= _ENOUGH_LIKE):
                return None
            return self._samples(again.select(good), rows[good])

        found = find_curve(matched, full_scale, self.image.curve, beside=1.0 if beside is None else beside)
        chosen = found.curve or straight
        if beside is not None and found:
            # A kernel was suspected: whether the curve explains the residuals instead.
            left, before = (
                np.median(tried[c][2].noise / np.abs(self._depth(tried[c][2]))) for c in (chosen, straight)
            )
            chosen = chosen if left < _EXPLAINED * before else straight
        self.screened, self.look, first = tried[chosen]
        if chosen is not straight:
            self._weigh(first, rows)
        note = found.remark(f"{self.word}s")
        if note is not None and (chosen is not straight or beside is None):
            self.notes += (note,)
        return first, chosen is not straight

    def _relit(self, look: Appearance, straight: Appearance, curve: ToneCurve) -> Appearance:
        """An appearance with the contrast and light of another one in grey values along a curve."""
        if straight.light is None or straight.contrast is None or self.polarity != "dark":
            return replace(look, light=None)
        level = np.abs(straight.light / straight.contrast)
        paper, ink = (curve.light(v, self.image.full_scale) for v in (level, level + straight.light))
        contrast = 1 - ink / np.maximum(paper, 1e-12)
        return replace(look, contrast=contrast, light=ink - paper)

    def _weigh(self, first: Matches, rows: Rows) -> None:
        """Learn noise, contrast and light from some of the marks; those of the others change as much."""

        def renewed(known: Array | None, values: Array) -> Array:
            whole = np.full(len(self.at), np.median(values))
            if known is not None:
                whole = known * np.median(values / known[rows])
            whole[rows] = values
            return np.asarray(whole)

        look, self.rough = self.look, float(np.median(first.noise))
        self.look = replace(
            look,
            variance=grey_variance(self.screened.grey, self.start[rows], first.residuals),
            contrast=renewed(look.contrast, first.contrast),
            light=renewed(look.light, self._depth(first)),
        )

    def _linear(self, curve: ToneCurve) -> NDArray[np.float32]:
        """Grey values of the frame that are proportional to the light."""
        pixels, full_scale = self.image.pixels, self.image.full_scale
        if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
            return curve.light(pixels.astype(np.float32), full_scale)
        levels = np.arange(np.iinfo(pixels.dtype).max + 1, dtype=np.float32)
        return np.asarray(curve.light(levels, full_scale)[pixels])

    def _samples(self, first: Matches, rows: Rows) -> tuple[Samples, Array]:
        """Matched marks in windows of one size, and their adjusted images."""
        images, reach = self._images(rows)
        high, wide = (n // 2 for n in first.residuals.shape[1:])
        size = np.max([half for _, half in self._windows(reach)], axis=0)
        half = int(min(size[0], wide)), int(min(size[1], high))
        x, y = self._pixels(rows, half)
        centre = slice(high - half[1], high + half[1] + 1), slice(wide - half[0], wide + half[0] + 1)
        residuals = first.residuals[:, *centre]
        grey = self.screened.grey[y, x].astype(np.float64)
        beside = self._beside()
        if beside is not None and (others := self._light_of(beside[y, x], rows)) is not None:
            grey -= others
        window = Window(x[:, 0].astype(float), y[:, :, 0].astype(float), PixelResponse(self.options.fill))
        every = np.arange(len(rows))
        samples = Samples(
            self._shape(images, every),
            first.xy,
            first.psf_px,
            first.form,
            self._depth(first),
            window,
            grey,
            np.isfinite(residuals),
        )
        return samples, grey + np.nan_to_num(residuals)

    def _uneasy(self, found: Matches) -> Mask:
        """Marks with larger residuals than the others, or that did not converge."""
        known = found.noise[found.converged]
        ordinary = np.median(known) if len(known) else np.inf
        spread = 1.4826 * np.median(np.abs(known / ordinary - 1)) if len(known) else 0.0
        return ~found.converged | (found.noise > max(_HIGH_RESIDUALS, 1 + 4 * spread) * ordinary)

    def _uncover(self, rows: Rows, found: Matches, uneasy: Mask, field: SmoothField) -> None:
        """Mask the pixels of windows that show neither paper nor ink, but something in front of them.

        The images of marks are predicted from their neighbours. The tolerance contains what a shift of a
        quarter of a pixel makes of them.
        """
        good = ~uneasy & ~self.dazzled[rows]
        near = KDTree(self.at[rows[good]]).query(self.at[rows], k=min(_NEIGHBOURS, int(good.sum())))[1]
        level, depth = (np.median(values[good][near], axis=1) for values in (found.level, self._depth(found)))
        noise = float(np.median(found.noise[good]))
        some = rows[uneasy]
        xy = field(self._straight(some))
        self.start[some] = xy
        images, reach = self._images(some)
        foreign: NDArray[Any] = np.zeros(self.screened.grey.shape, dtype=np.uint8)
        seen = np.zeros(foreign.shape, dtype=bool)
        for part, half in self._windows(reach):
            x, y = self._pixels(some[part], half)
            window = Window(x[:, 0].astype(float), y[:, :, 0].astype(float), PixelResponse(self.options.fill))
            formed = self._shape(images, part)
            width, form = np.full(len(part), self.look.psf_px), np.zeros((len(part), formed.parameters))
            share, slopes = formed.derivatives(xy[part], width, form, np.arange(len(part)), window)
            here, ink = (values[uneasy][part, None, None] for values in (level, depth))
            off = self.screened.grey[y, x] - here - ink * share
            tolerance = _FOREIGN * noise + _SHADE * np.abs(here)
            tolerance = tolerance + _SHIFT_PX * np.abs(ink) * np.hypot(slopes[:, 0], slopes[:, 1])
            np.maximum.at(foreign, (y, x), np.abs(off) > tolerance)
            seen[y, x] = True
        foreign = cv2.morphologyEx(foreign, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        margin = int(np.ceil(2 * self.look.psf_px)) + 1
        foreign = cv2.dilate(foreign, np.ones((2 * margin + 1,) * 2, np.uint8))
        self.hidden |= (foreign > 0) & seen

    def _objections(self, rows: Rows, found: Matches) -> list[tuple[Mask, Reason]]:
        """Objections to marks from their own images, the most serious first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        strong = found.converged & (found.t > 8)
        ordinary = float(np.median(found.psf_px[strong])) if strong.any() else self.look.psf_px
        usual = float(np.median(found.noise[strong])) if strong.any() else np.inf
        return [
            (
                found.seen < self.least_seen,
                Reason("hidden, saturated or beyond the edge of the frame", Code.HIDDEN),
            ),
            (~found.converged, Reason("the match did not converge", Code.NOT_CONVERGED)),
            (
                ~(found.t >= o.least_t) | (found.contrast <= 0),
                Reason(f"no {self.word} is distinct from its surroundings", Code.LOW_CONTRAST),
            ),
            (
                found.psf_px > _BLURRED * ordinary,
                Reason(f"less sharp than the other {self.word}s", Code.BLURRED),
            ),
            *self._misshapen(found),
            # Without paper, the reflection in a disk is all that is left to compare.
            (
                (found.correlation < 0.8) & ~self.dazzled[rows],
                Reason(f"the image is not that of a {self.word}", Code.UNLIKE),
            ),
            (
                (found.rejected > 0.25) | (found.noise > _DISTURBED * usual),
                Reason("partly hidden or disturbed", Code.DISTURBED),
            ),
            (~(sigma <= o.most_sigma_px), Reason("too uncertain", Code.UNCERTAIN)),
        ]

    def _judged(
        self, rows: Rows, found: Matches, before: SmoothField | None = None
    ) -> tuple[Array, SmoothField | None]:
        """Reason why each mark is rejected, and the field through the others; `before` has its length."""
        why = np.full(len(rows), "", dtype=object)
        for mask, reason in self._objections(rows, found):
            why[mask & (why == "")] = reason
        source, field, known = self._straight(rows), None, before
        variance = np.trace(found.cov, axis1=1, axis2=2) / 2 + _UNMODELLED_PX**2
        radius = self._radius(rows)
        while (good := np.flatnonzero(why == "")).size >= 10:
            relative = np.sqrt(variance[good] / np.median(variance[good]))
            if known is None and good.size >= _LENGTH_OF:
                # The length that some of them show is that of all.
                some = good[:: good.size // (_LENGTH_OF // 2)]
                known = SmoothField.fit(source[some], found.xy[some])
            length = known.length if known is not None and np.isfinite(known.length) else None
            field = known = SmoothField.fit(source[good], found.xy[good], sigma=relative, length=length)
            deviation, sigma = field.leave_one_out()
            limit = np.maximum(np.maximum(self.options.neighbour_px, _BULGED * radius[good, None]), 4 * sigma)
            excess = (np.abs(deviation) / limit).max(axis=1)
            worst = int(excess.argmax())
            if excess[worst] <= 1:
                break
            distance = np.hypot(*deviation[worst])
            why[good[worst]] = Reason(
                f"{distance:.1f} px from the position predicted by its neighbours", Code.DEVIATES
            )
        return why, field

    def _spread(
        self, rows: Rows, found: Matches, why: Array, field: SmoothField | None, with_field: bool
    ) -> dict[str, Any]:
        """Columns over all marks of the design."""
        n, good = len(self.at), why == ""
        ok, reasons = (
            np.zeros(n, dtype=bool),
            Reason("outside the frame", Code.OUTSIDE).repeated(n),
        )
        ok[rows], reasons[rows] = good, why
        predicted, deviation = self.mapping(self.at), np.full((n, 2), np.nan)
        if field is not None:
            predicted[rows] = field(self._straight(rows))
            deviation[rows[good]] = field.leave_one_out()[0]

        def spread(values: Array, keep: Mask | slice = slice(None)) -> Array:
            full = np.full((n, *values.shape[1:]), np.nan)
            full[rows[keep]] = values[keep]
            return full

        design: dict[str, Any] = {}
        if with_field and field is not None and good.sum() >= 10:
            design["field"] = SmoothField.fit(self.xy[rows[good]], found.xy[good])
        elif with_field:
            design["field"] = SmoothField.fit(self.xy, self.mapping(self.at), local=False)
        return (
            design
            | {
                "image": self.image.name,
                "sha256": self.image.sha256,
                "ids": self.ids,
                "xy": spread(found.xy, good),
                "cov": spread(found.cov, good),
                "ok": ok,
                "why": tuple(reasons),
                "predicted": predicted,
                "deviation": deviation,
                "notes": self.notes,
            }
            | {name: spread(getattr(found, name)) for name in ("psf_px", "contrast", "t", "noise")}
        )
