"""Marks of a plane target, once they are found and numbered: all are matched, and each is tested.

The image of every mark is formed with the mapping through all marks, to second order, and matched.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code, Remark
from ...optics.composition import Chain
from ...optics.field import SmoothField
from ..marks.judging import Objection, columns_of, judged_by_neighbours, reasons_of, robust_spread
from ..matching import (
    Matches,
    with_alike_errors,
)
from ..plane.lattice_mapping import images_of, slope_of
from ..plane.lens_mapping import UNFIT, free_through, mapping_through
from ..points import Reason
from ..screening import Screened
from ..testfield.targets import replaced
from .learning import learn, weigh
from .mark_windows import BESIDE, DISTURBED, ENOUGH, SEEN, Located, MarkWindows
from .marks import ReseauOptions

_HIGH_RESIDUALS = 1.25
"""Multiple of the usual residuals from which something is suspected in front of a mark."""
_SPREADS = 4.0
"""The same in robust standard deviations of the residuals of all marks, where these differ more."""
_FOREIGN, _SHADE, _SHIFT_PX = 4.0, 0.03, 0.25
"""Tolerances of the prediction of a mark by its neighbours: noise, share of the light, and shift."""
_UNSURE = 1.5
"""The shift in standard deviations of the prediction."""
_NEIGHBOURS = 6
"""Number of neighbours whose light is taken."""
_BULGED = 0.3
"""Largest deviation of a mark from its neighbours' prediction, in radii: paper bulges."""
_SAFELY = 0.2
"""Part of the largest deviation from a prediction by neighbours up to which marks, which then lie on a
polynomial through the others, need not be compared with it."""
_SIGMAS = 4.0
"""Standard deviations of a prediction by neighbours below which it declines no mark."""
_UNMODELLED_PX = 0.05
"""Scatter of positions beyond their own sigmas: the sheet is not plane."""
_FORMED_PX = 0.002
"""Standard deviation of what no formed image contains: edges of prints, unequal pixels."""
_UNKNOWN_PX = 1.0
"""Error of a position that nothing bounds; it is more than is accepted."""
_WHOLE = 0.97
"""Share of the pixels of a mark below which it is seen in part."""
_BENT_PX = 0.15
"""Distance of one mark in ten from the mapping through all, from which that is adjusted again."""
_ROUNDS, _SAME, _NEAR = 6, 0.5, 2.0
"""Most rounds of matching with the mapping through the last matches; change of positions with the mapping,
in sigmas, from which both follow each other, and total change from which marks are matched again: what a
match gives is the middle of an image to first order only."""
_BOUND = 2.0
"""Standard deviations up to which the variance of positions may be larger than their scatter shows."""
_PER_SMOOTH = 2.5
"""Least number of coordinates for each term of the polynomial about which positions scatter."""
_BLURRED = 1.8
"""Tolerated factor of the sharpness of a mark."""
_LARGER = 3.0
"""Scale of the mapping at a mark that was not found, beside that at the others, from which it is not true."""
_LEAST_RIM = 0.25
"""Share of the edge of a mark below which the level of the paper is hardly seen, and has no slope."""


def intact(found: Matches) -> Mask:
    """Marks of which hardly anything was rejected."""
    return found.converged & (found.t > 8) & (found.rejected < 0.1)


def _sure(found: Matches) -> Mask:
    """Marks that show the mapping."""
    return intact(found) & (found.seen > SEEN)


class PlaneMarks(MarkWindows):
    """The matching of all marks with what is learnt from some, and the tests of every mark.

    Parameters as of :class:`MarkWindows`.
    """

    formed_px: ClassVar[float] = _FORMED_PX
    """Standard deviation of what no formed image contains."""

    def __init__(
        self, image: Frame, screened: Screened, located: Located, options: ReseauOptions, size: float
    ) -> None:
        super().__init__(image, screened, located, options, size)
        self.dazzled = np.zeros(len(self.at), dtype=bool)  # by reflected light
        self.lit = np.zeros_like(self.dazzled)  # by so little that no pixels are lost
        self.notes: tuple[Remark, ...] = ()
        self.changes: Callable[[Array], Array] | None = None  # of the mapping, see :class:`FoundMapping`
        self.misfit = 1.0  # of the mapping through all marks, in sigmas
        self.precise: tuple[Chain, Rows] | None = None  # mapping through precise marks, and which these are
        self.other: Chain | None = None  # another mapping, where that one does not fit

    @abstractmethod
    def _edge_seen(self, rows: Rows, found: Matches) -> Array:
        """Share (k,) of the pixels on the blurred edge of each mark that were used."""

    def _misshapen(self, found: Matches) -> list[Objection]:
        """Objections to the form of marks."""
        return []

    def columns(self, *, with_field: bool = True) -> dict[str, Any]:
        """Columns of the result; the field from the design to the image only if wanted."""
        self.notes = learn(self)
        rows, self.learning, self.quick = self._in_sight(), False, False
        found = self._match_all(rows)
        # Marks with something in front of them show neither the mapping nor its errors.
        plain = _sure(found) & ~self._uneasy(found) & (found.rejected == 0)
        whole = plain & (found.seen > _WHOLE)
        plain = whole if whole.any() else plain  # on saturated paper none is whole
        if self.eccentric or self._bent(rows[plain], found.select(plain)):
            found = self._mapped(rows, found, _sure(found) if self.eccentric else plain)
        doubtful, field = self._doubtful(rows, found)
        all_searched, self.searching = self.searching == np.inf, np.inf
        if doubtful.any() and field is not None and (~doubtful & ~self.dazzled[rows]).sum() >= _NEIGHBOURS:
            # Look again where their neighbours predict them, without what lies in front of them.
            found = self._uncovered(rows, found, doubtful, field)
        elif doubtful.any() and not all_searched:
            found = replaced(found, ~doubtful, self._match_all(rows[doubtful]))
        found = self._without_growth(rows, found)
        alike = with_alike_errors(found, np.rint(self.start[rows]) if self.even else None)
        found = self._tempered(rows, found, alike)
        if self.precise_start:
            found = self._with_doubtful_light(rows, found)
        found = self._in_shadows(rows, found)
        found = replace(found, cov=found.cov + self._misformed(rows, found))
        why, off = self._why(rows, found), None
        if self.precise_start and not with_field:
            off = self._off_polynomial(rows[why == ""], found.xy[why == ""])
        if off is None or not (np.abs(off) < _SAFELY * self.options.neighbour_px).all():
            (why, field), off = self._judged(rows, found, why, field), None
        return self._spread(rows, found, why, field, with_field, off)

    def _uncovered(self, rows: Rows, found: Matches, doubtful: Mask, field: SmoothField) -> Matches:
        """Matches of which the doubtful ones are made without what lies in front of them.

        A reflection adds light that neighbours do not have, and so seems to hide marks beside it. It is
        smooth: a mark that was matched without an objection, and of which then too little is left, keeps
        its first match.
        """
        good, start = np.all([~mask for mask, *_ in self._objections(rows, found)], axis=0), self.start.copy()
        self._uncover(rows, found, doubtful, field)
        again = self._match_all(rows[doubtful])
        if self.precise_start:
            hidden = {Code.HIDDEN, Code.NOT_CONVERGED, Code.UNCERTAIN}
            lost = [mask for mask, _, code in self._objections(rows[doubtful], again) if code in hidden]
            lit = good[doubtful] & np.any(lost, axis=0)
            those = rows[doubtful][lit]
            self.lit[those], self.start[those] = True, start[those]
            again = replaced(again, ~lit, found.select(np.flatnonzero(doubtful)[lit]))
        return replaced(found, ~doubtful, again)

    def _mapped(self, rows: Rows, found: Matches, sure: Mask) -> Matches:
        """Matches with the mapping through the marks that are `sure`, which itself depends on the matches."""
        for _ in range(_ROUNDS if self.eccentric else 1):
            if sure.sum() < ENOUGH:
                break
            found, settled = self._moved(rows, found, sure)
            if settled:
                return found
            weigh(self, found.select(sure), rows[sure])  # with the windows in which they were matched
            self.start[rows[sure]] = found.xy[sure]
            lost = rows[~sure & ~self.found[rows]]
            self.start[lost] = self.mapping(self.at[lost])
            if self.eccentric:
                # Growth about the image of the point is not that of the mark on its plane.
                self.settle(found.select(sure))
            found = self._match_all(rows)
            sure = _sure(found)
        return found

    def _moved(self, rows: Rows, found: Matches, sure: Mask) -> tuple[Matches, bool]:
        """Matches moved with the mapping through those that are `sure`; whether they need no other match.

        A match gives the middle of an image. Its point follows with the mapping, and that with the points.
        """
        (h, w), sigma = self.screened.grey.shape, np.sqrt(found.variance)
        xy, last = found.xy, np.inf
        middle = xy + self._off_centre(rows)
        while True:
            known = self.at[rows[sure]], xy[sure], sigma[sure]
            through_all = mapping_through(*known, (h, w))
            self.mapping, self.changes = through_all.mapping, through_all.changes
            self.precise = self.mapping, rows[sure]
            off = (self.mapping(known[0]) - xy[sure]) / sigma[sure, None]
            self.misfit = float(np.sqrt((off**2).mean()))
            self.other = free_through(self.mapping, *known) if self.misfit > UNFIT else None
            moved = middle - self._off_centre(rows)
            change, total = (
                float((np.abs(moved - before)[sure].max(axis=1) / sigma[sure]).max())
                for before in (xy, found.xy)
            )
            if not (self.eccentric and total < _NEAR and change < last):
                return found, False
            xy, last = moved, change
            if change < _SAME:
                return replace(found, xy=xy), True

    def _off_centre(self, rows: Rows, images: Callable[[Array], Array] | None = None) -> Array:
        """How far (k, 2) the middles of the images of marks are from the images of their points.

        `images` are those (m, n, 2) of lattice coordinates (n, 2) with m other mappings: then (m, k, 2).
        """
        return np.zeros((len(rows), 2))

    def _misformed(self, rows: Rows, found: Matches) -> Array:
        """Covariances (k, 2, 2) of what formed images lack, and of the mapping that forms them."""
        cov = np.tile(self.formed_px**2 * np.eye(2), (len(rows), 1, 1))
        if not self.eccentric:
            return cov
        middle, changes, other = self._off_centre(rows), self.changes, self.other
        if changes is not None:
            off = self._off_centre(rows, lambda at: images_of(self.mapping, at) + changes(at)) - middle
            cov += np.einsum("mki,mkj->kij", off, off)
        if other is not None:
            # The change shows the size of the error, not its direction.
            off = self._off_centre(rows, lambda at: images_of(other, at)[None])[0] - middle
            cov += off[:, :, None] * off[:, None] + 0.5 * (off**2).sum(axis=1)[:, None, None] * np.eye(2)
        return cov

    def _doubtful(self, rows: Rows, found: Matches) -> tuple[Mask, SmoothField | None]:
        """Marks that are looked at again, and the field that predicts them."""
        # Where paper is saturated, neighbours do not predict the light.
        if self.precise_start:
            doubtful = self._uneasy(found)
            for mask, *_ in self._objections(rows, found):
                doubtful |= mask
            doubtful |= (np.abs(found.xy - self.mapping(self.at[rows])) > self.options.neighbour_px).any(
                axis=1
            )
            if not (doubtful & ~self.dazzled[rows]).any():
                return doubtful & ~self.dazzled[rows], None
        why, field = self._judged(rows, found, self._why(rows, found))
        return ((why != "") | self._uneasy(found)) & ~self.dazzled[rows], field

    def _bent(self, rows: Rows, found: Matches) -> bool:
        """Whether the lens bends the target more than the mapping through the marks found contains."""
        off = np.abs(found.xy - self.mapping(self.at[rows]))
        return bool(len(off) >= ENOUGH and np.quantile(off, 0.9) > _BENT_PX)

    def _straight(self, rows: Rows) -> Array:
        """Images without the polynomial, the source coordinates of smooth fields."""
        return self.mapping.first(self.at[rows])

    def _in_sight(self) -> Rows:
        """Indices of disks whose centres lie in the frame."""
        h, w = self.screened.grey.shape
        inside = ((self.start > 0) & (self.start < (w - 1, h - 1))).all(axis=1)
        # Far from the marks found a polynomial may have any slope.
        scale = np.linalg.norm(slope_of(self.mapping, self.at), axis=(1, 2))
        largest = scale[self.found].max() if self.found.any() else np.inf
        return np.flatnonzero(inside & (self.found | (scale < _LARGER * largest)))

    def _best_known(self, rows: Rows) -> tuple[Chain, Mask]:
        """The most precise mapping, and which of some marks (k,) it was found from."""
        mapping, known = self.precise or (self.mapping, rows)
        return mapping, np.isin(rows, known)

    def _without_growth(self, rows: Rows, found: Matches) -> Matches:
        """Matches without the growth of ink that all marks have in common; balanced marks are not shifted."""
        return found

    def _in_shadows(self, rows: Rows, found: Matches) -> Matches:
        """Matches of which those across which edges of shadows run are made with these edges."""
        return found

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
            other = self.match(rows[some], background=background)
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
        Where they scatter less than C, errors of pixels cancel each other, as after sharpening, or residuals
        are larger than noise: blur, smear and levels that are not quite those of the model leave residuals
        that are even about a mark, and do not displace it. The covariance is then C + f E, or at least that
        of the odd residuals, whichever agrees better with the scatter.
        """
        extra = alike.cov - plain.cov
        # A polynomial through few marks has too few terms for a lens.
        mapping, known = self._best_known(rows)
        good = _sure(plain) & known
        terms = self._smooth_terms(rows[good])
        if terms is None:
            return alike
        bent = plain.xy[good] - mapping(self.at[rows[good]])
        c, e = (np.diagonal(cov[good], axis1=1, axis2=2) for cov in (plain.cov, extra))
        redundancy = 2 * (len(terms) - terms.shape[1])

        def excess(share: float) -> float:
            total = 0.0
            for k in range(2):
                root = np.sqrt(c[:, k] + share * e[:, k])
                weighted = terms / root[:, None]
                off = bent[:, k] / root
                rest = off - weighted @ np.linalg.solve(weighted.T @ weighted, weighted.T @ off)
                total += float(rest @ rest)
            return float(total - redundancy)

        none, whole = excess(0.0), excess(1.0)
        share, left = (0.0, none) if abs(none) < abs(whole) else (1.0, whole)
        if none * whole < 0:
            share, left = float(scipy.optimize.brentq(excess, 0.0, 1.0, xtol=0.01)), 0.0
        scatter = 1 + none / redundancy
        odd = self._odd_share(plain.residuals[good]) if self.even else 1.0
        bound = min(odd, scatter * (1 + _BOUND * np.sqrt(2 / redundancy)))
        even = max(scatter, bound) if none < 0 else 1.0
        if abs(left) < abs((none + redundancy) / even - redundancy):
            return replace(alike, cov=plain.cov + share * extra)
        return replace(alike, cov=even * plain.cov)

    @staticmethod
    def _odd_share(residuals: Array) -> float:
        """Mean square of the part of residuals (k, r, c) that is odd about the middle, over that of all."""
        off = residuals - residuals[:, ::-1, ::-1]
        both = np.isfinite(off)
        off, whole = off[both], residuals[both]
        if not len(off):
            return 1.0  # on saturated paper no pixel has one opposite
        return min(float(off @ off) / 2 / max(float(whole @ whole), 1e-300), 1.0)

    def _smooth_terms(self, rows: Rows) -> Array | None:
        """Orthonormal terms (k, u) of the polynomial about which marks scatter; None for too few of them."""
        degree = next((d for d in (5, 4, 3) if _PER_SMOOTH * (d + 1) * (d + 2) <= 2 * len(rows)), None)
        if degree is None:
            return None
        at = self._straight(rows)
        at = (at - at.mean(axis=0)) / np.maximum(np.ptp(at, axis=0) / 2, 1e-9)
        terms = [at[:, 0] ** i * at[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)]
        return np.linalg.qr(np.stack(terms, axis=1))[0]

    def _match_all(self, rows: Rows) -> Matches:
        """Match disks; on even paper where paper is saturated all around."""
        found = self.match(rows, influence=True)
        if self.look.kernel is not None and self.precise_start and not found.converged.all():
            # Without the kernel residuals are larger, and so are the sigmas.
            look, lost = self.look, ~found.converged
            self.look = replace(look, kernel=None, psf_px=look.blur_px)
            found = replaced(found, ~lost, self.match(rows[lost], influence=True))
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
        return replaced(found, ~dim, self.match(rows[dim], background=0, influence=True))

    def _uneasy(self, found: Matches) -> Mask:
        """Marks with larger residuals than the others, or that did not converge."""
        return ~found.converged | self._disturbed(found, found.converged, _HIGH_RESIDUALS)

    def _disturbed(self, found: Matches, known: Mask, least: float) -> Mask:
        """Marks whose residuals are larger, by a factor of at least `least`, than those known usually are.

        Of photographs that cameras sharpened residuals differ from mark to mark.
        """
        noise = found.noise[known]
        ordinary = float(np.median(noise)) if len(noise) else np.inf
        spread = robust_spread(noise) / ordinary if len(noise) else 0.0
        return np.asarray(found.noise > max(least, 1 + _SPREADS * spread) * ordinary)

    def _uncover(self, rows: Rows, found: Matches, uneasy: Mask, field: SmoothField) -> None:
        """Mask the pixels of windows that show neither paper nor ink, but something in front of them.

        The images of marks are predicted from the others. The tolerance contains what a shift makes of them:
        of a quarter of a pixel, and of the uncertainty of the prediction, which is larger towards a margin.
        """
        good = ~uneasy & ~self.dazzled[rows]
        near = scipy.spatial.KDTree(self.at[rows[good]]).query(
            self.at[rows], k=min(_NEIGHBOURS, int(good.sum()))
        )[1]
        level, depth = (np.median(values[good][near], axis=1) for values in (found.level, self.depth(found)))
        noise = float(np.median(found.noise[good]))
        some = rows[uneasy]
        xy, shift = field(self._straight(some)), np.full(len(some), _SHIFT_PX)
        if self.changes is not None:
            xy = self.mapping(self.at[some])
            shift = shift + _UNSURE * np.sqrt((self.changes(self.at[some]) ** 2).sum(axis=(0, 2)))
        self.start[some] = xy
        images, reach = self._images(some)
        beside = self.beside()
        foreign: NDArray[Any] = np.zeros(self.screened.grey.shape, dtype=np.uint8)
        seen = np.zeros(foreign.shape, dtype=bool)
        for part, half in self._windows(reach):
            window, (x, y) = self.window(some[part], half), self.pixels(some[part], half)
            formed = self._shape(images, part)
            width, form = np.full(len(part), self.look.psf_px), np.zeros((len(part), formed.parameters))
            share, slopes = formed.derivatives(xy[part], width, form, np.arange(len(part)), window)
            here, ink = (values[uneasy][part, None, None] for values in (level, depth))
            off = self.screened.grey[y, x] - here - ink * share
            tolerance = _FOREIGN * noise + _SHADE * np.abs(here)
            steep = np.hypot(slopes[:, 0], slopes[:, 1])
            tolerance = tolerance + shift[part, None, None] * np.abs(ink) * steep
            beyond = np.abs(off) > tolerance
            beyond &= (x == window.columns[:, None, :]) & (y == window.rows[:, :, None])
            if beside is not None:
                # What is printed beside a mark is not in front of it.
                region = self._region(some[part], half)
                beyond &= (np.abs(beside[y, x]) < BESIDE) & (True if region is None else region)
            row, column = np.broadcast_arrays(y, x)
            foreign[row[beyond], column[beyond]] = 1
            seen[y, x] = True
        foreign = cv2.morphologyEx(foreign, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        margin = int(np.ceil(2 * self.look.psf_px)) + 1
        foreign = cv2.dilate(foreign, np.ones((2 * margin + 1,) * 2, np.uint8))
        self.hidden |= (foreign > 0) & seen

    def _blurred(self, rows: Rows, found: Matches, known: Mask) -> Mask:
        """Marks that are less sharp than those known, and than those of them that are next to each."""
        width = np.hypot(found.psf_px, self.options.fill / np.sqrt(12))  # the pixel alone blurs a sharp image
        if known.sum() <= _NEIGHBOURS:
            ordinary = np.median(width[known]) if known.any() else np.hypot(self.look.psf_px, 12**-0.5)
            return np.asarray(width > _BLURRED * ordinary)
        # Towards the margin of a lens all are less sharp. A mark is the nearest to itself.
        near = scipy.spatial.KDTree(self.at[rows[known]]).query(self.at[rows], k=_NEIGHBOURS + 1)[1]
        beside = np.median(width[known][near], axis=1)
        return np.asarray(width > _BLURRED * np.maximum(beside, np.median(width[known])))

    def _objections(self, rows: Rows, found: Matches) -> list[Objection]:
        """Objections to marks from their own images, the most serious first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        strong = found.converged & (found.t > 8)
        disturbed = (found.rejected > 0.25) | self._disturbed(found, strong, DISTURBED)
        # Without paper, the reflection in a disk is all that is left to compare.
        unlike = (found.correlation < 0.8) & ~self.dazzled[rows]
        faint = ~(found.t >= o.least_t) | (found.contrast <= 0)
        return [
            (found.seen < self.least_seen, "hidden, saturated or beyond the edge of the frame", Code.HIDDEN),
            (~found.converged, "the match did not converge", Code.NOT_CONVERGED),
            (faint, f"no {self.word} is distinct from its surroundings", Code.LOW_CONTRAST),
            (self._blurred(rows, found, strong), f"less sharp than the other {self.word}s", Code.BLURRED),
            *self._misshapen(found),
            (unlike, f"the image is not that of a {self.word}", Code.UNLIKE),
            (disturbed, "partly hidden or disturbed", Code.DISTURBED),
            (~(sigma <= o.most_sigma_px), "too uncertain", Code.UNCERTAIN),
        ]

    def _why(self, rows: Rows, found: Matches) -> Array:
        """Reason why each mark (k,) is rejected by its own image; empty where it is not."""
        return reasons_of(self._objections(rows, found), len(rows))

    def _off_polynomial(self, rows: Rows, xy: Array) -> Array | None:
        """Deviations (k, 2) of marks from a polynomial through the others; None for too few of them."""
        terms = self._smooth_terms(rows)
        if terms is None:
            return None
        off = xy - self.mapping(self.at[rows])
        spare = 1 - np.einsum("ku,ku->k", terms, terms)
        return np.asarray((off - terms @ (terms.T @ off)) / np.maximum(spare, 1e-9)[:, None])

    def _judged(
        self, rows: Rows, found: Matches, why: Array, before: SmoothField | None = None
    ) -> tuple[Array, SmoothField | None]:
        """Reason why each mark is rejected, and the field through the others; `before` has its length.

        `why` (k,) are the reasons of their own images.
        """
        variance = found.variance + _UNMODELLED_PX**2
        limit = np.maximum(self.options.neighbour_px, _BULGED * self.radius(rows))
        known = self._straight(rows), found.xy, variance
        return judged_by_neighbours(*known, why, limit, _SIGMAS, before)[:2]

    def _spread(
        self,
        rows: Rows,
        found: Matches,
        why: Array,
        field: SmoothField | None,
        with_field: bool,
        off: Array | None = None,
    ) -> dict[str, Any]:
        """Columns over all marks; `off` are deviations of good ones from the others, else of the field."""
        n, good = len(self.at), why == ""
        predicted, deviation = self.mapping(self.at), np.full((n, 2), np.nan)
        if off is not None:
            predicted[rows[good]], deviation[rows[good]] = found.xy[good] - off, off
        elif field is not None:
            predicted[rows] = field(self._straight(rows))
            deviation[rows[good]] = field.leave_one_out()[0]

        design: dict[str, Any] = {}
        if with_field and field is not None and good.sum() >= 10:
            design["field"] = SmoothField.fit(self.xy[rows[good]], found.xy[good])
        elif with_field:
            design["field"] = SmoothField.fit(self.xy, self.mapping(self.at), local=False)
        outside = Reason("outside the frame", Code.OUTSIDE).repeated(n)
        columns = columns_of(found, rows, why, outside) | design
        return columns | {
            "image": self.image.name,
            "sha256": self.image.sha256,
            "ids": self.ids,
            "predicted": predicted,
            "deviation": deviation,
            "notes": self.notes,
        }
