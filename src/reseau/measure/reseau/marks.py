"""Matching of the marks of a frame in two rounds, and the tests of every mark."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import ArrayLike

from ...core import vocabulary as v
from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code
from ...io import ReseauDesign
from ...optics.field import SmoothField
from ...optics.formation import Outline, PixelResponse, coverage, mark_outline
from ..marks.judging import Objection, judged_by_neighbours, reasons_of, robust_spread, spread
from ..matching import Matches, grey_variance, match, with_alike_errors
from ..matching.matcher import SIZE
from ..matching.patches import MatchOptions
from ..plane.levels import levels_at
from ..points import Reason
from .assignment import spacing
from .placement import Placement
from .wires import grid_wires

TOO_WEAK = "too weak for the compression of the image"
"""Why a mark is declined whose image has lost its shape."""

_UNMODELLED_PX = 0.07
"""Scatter of positions in real frames beyond their own sigmas; balances the weights in fields."""
_LEARN_FROM = 50
"""Number of strongest marks from which the appearance of a mark in this frame is learnt."""
_SEEN = 0.1
"""Minimum share of a mark on pixels that carry an image."""
_BLURRED = 1.55
"""A mark counts as blurred from this multiple of the width of the others' images: it is another object."""
_LIKE_OTHERS = 4.0
"""Spreads by which the contrast of a mark may differ from that of the others."""
_ALL_LIGHT = 1.6
"""Share of the light that a dark mark may seem to take: a camera's zero may be above that of the light."""
_OTHER_KIND = 0.3
"""Relative difference from which two contrasts are not the same kind of mark in uneven light."""
_SIGMAS = 3.0
"""Standard deviations of a prediction by neighbours below which it declines no mark."""
_DISTINCT = 1.6
"""Multiple of the tolerated deviation from the neighbours' prediction for a distinct mark."""
_CERTAIN = 0.8
"""Correlation with its formed image from which a distinct mark may have any contrast."""
_BOTH_ARMS = 0.8
"""Least correlation with the formed image, corrected for noise, of a mark with arms; one alone has 0.7."""
_ARMS = ("cross", "line-grid")
"""Shapes with arms, whose directions are estimated."""
_FAINT, _MOST_FAINT = 0.25, 0.25
"""Significance of a faint crossing as a share of that of the others; share of clear crossings of a wire below
which the faint ones on it are doubted."""
_CLEARINGS = 2
"""Rounds of excluding what lies beside marks; in the second, predictions are those of cleared neighbours."""
_UNEASY = 1.2
"""Multiple of the others' residuals from which something is suspected over or beside a mark."""
_FEWEST_PLAIN = 8
"""Number of neighbours without suspicion whose median is the expected appearance of a mark."""
_FIXED = 1e-4
"""Standard deviation of a parameter that is not adjusted."""
_PREDICTABLE = 3.5
"""Scatter of marks about the predictions of their neighbours, in their own standard deviations, up to which a
prediction shows what does not belong to a mark."""
_PULLED, _BEYOND, _HALF = 4.0, 1.35, 0.7
"""Deviation of such a mark from its prediction, in standard deviations and relative to the largest of the
others, from which it is not accepted if its residuals are still large, or less than this share is left."""
_ENOUGH = 0.35
"""Share of a mark that must be left beside intruders for it to be matched without them."""
_FLANK = 2.5
"""Margin around an intruder in widths of the point-spread function."""
_MOVED = 0.5
"""Shift against the start, in widths of the mark's image, from which a mark is matched again."""
_ARM_ENDS, _END = 0.85, 1.55
"""Share of the contrast of an arm below which it has ended; margin from there in sigmas of blur: 2.6 from the
end itself, where half a per cent of the contrast is missing."""
_NEAR_PX = 2.5
"""Length of an arm beside a crossing that is used while it is not known where arms end."""
_FEWEST_SCATTERED = 20
"""Marks whose deviations show how much compression displaces them."""
_MOST_LOST = 2.5
"""Multiple of their sigmas up to which compression is taken for the cause of the deviations of marks; or that
of what it has taken at most over the residuals, where that is larger."""
_ABOVE_LOST = 4.0
"""Least contrast of a mark, in rms values of the detail that compression may have taken: what is left of
weaker ones has another shape."""
_TURN, _TURNED = 0.12, 0.02
"""Standard deviation (rad) of the direction of an arm: before it is learnt in the frame; and afterwards."""


@dataclass(frozen=True)
class ReseauOptions:
    """Options of the measurement of a reseau.

    Parameters
    ----------
    nominal : bool
        Whether to use the nominal positions of the design, if it has them.
    nominal_within_px : float, optional
        Uncertainty of the nominal positions; by default any smooth distortion and a shift of up to one pitch.
    mirrored : bool, optional
        Whether the image shows the design from behind, left and right exchanged, or from the front (x right,
        y up). By default the design tells, if it is not symmetric. Not used with nominal positions.
    max_rotation_deg : float, optional
        Largest rotation of the design in the image, used without nominal positions. By default any; if a
        symmetric design fits in several ways, it is taken as upright, with a note.
    mark_px : float, optional
        Size of a mark in the image (width of the line for a line grid); by default from the design.
    psf_px : float
        Approximate width (one sigma) of the point-spread function; it is estimated.
    row_jitter_px : float
        Standard deviation of the shift of single rows, if known.
    fill : float
        Light-sensitive share of the pixel pitch along either axis, 0 to 1, if known.
    least_t : float
        Minimum contrast of a mark over its standard deviation.
    most_sigma_px : float
        Largest standard deviation of a coordinate that is accepted.
    neighbour_px : float
        Largest deviation, per axis, from the prediction of the neighbours.

    Examples
    --------
    >>> ReseauOptions(mark_px=3.0, least_t=5.0).least_t
    5.0
    """

    nominal: bool = True
    nominal_within_px: float | None = None
    mirrored: v.Mirrored | None = None
    max_rotation_deg: v.MaxRotationDeg | None = None
    mark_px: v.MarkPx | None = None
    psf_px: v.PsfPx = 0.6
    row_jitter_px: v.RowJitterPx = 0.0
    fill: v.Fill = 1.0
    least_t: float = 3.5
    most_sigma_px: float = 0.5
    neighbour_px: float = 1.0


@dataclass(frozen=True, eq=False)
class Verdict:
    """Positions, covariances, reasons against, leave-one-out deviations and predictions of all marks."""

    xy: Array
    cov: Array
    why: Array
    deviation: Array
    predicted: Array


class MarkMeasurement:
    """The two rounds of matching, and the tests of every mark."""

    def __init__(
        self,
        frame: Frame,
        design: ReseauDesign,
        source: Array,
        placed: Placement,
        options: ReseauOptions,
        lost: float | None,
    ) -> None:
        self.lost = lost  # by compression, see `lost_in_blocks`
        self.frame, self.design, self.source, self.options = frame, design, source, options
        self.placed, self.screened, self.assignment = placed, placed.screened, placed.assignment
        self.field, self.predicted = placed.assignment.field, placed.assignment.predicted
        mark = design.mark
        scale = np.sqrt(np.abs(np.linalg.det(self.field.jacobian(source))))
        self.px_per_unit = float(np.median(scale))
        size = mark.line_width if mark.shape == "line-grid" else mark.size
        self.free_size = size is None
        self.size = placed.mark_px / self.px_per_unit if size is None else size
        self.extent_px = self.px_per_unit * (3.0 * self.size if mark.shape == "line-grid" else self.size)
        # Directions (n, 2, 2) of the two arms in the plane of the design, as columns.
        self.arms = (
            grid_wires(source).directions
            if mark.shape == "line-grid"
            else np.broadcast_to(np.eye(2), (len(source), 2, 2))
        )

        # Until it is known whether arms end, crossings are matched by what lies near them.
        self.reach_px = self.extent_px / 2 + _NEAR_PX if mark.shape == "line-grid" else np.inf
        self.covered = np.zeros(len(source), dtype=bool)

    def result(self) -> tuple[Rows, Matches, Verdict]:
        """Match, learn the appearance of marks, match again, test."""
        placed = self.assignment
        has = placed.candidate >= 0
        # The strongest marks show what a mark looks like here, and where exactly to look for the others; some
        # of all strengths show how much contrasts differ.
        ranked = np.flatnonzero(has)[np.argsort(placed.candidate[has], kind="stable")]
        rest = ranked[_LEARN_FROM:]
        shown = np.concatenate([ranked[:_LEARN_FROM], rest[:: max(1, -(-len(rest) // _LEARN_FROM))]])
        first = self._match(
            shown, placed.at[shown], self._first_options(), 0.3 if self.free_size else 0.1, _TURN
        )
        self._learn(shown, first, placed.at[shown])
        at = np.flatnonzero(self._near_frame(self.predicted))
        found = self._match_all(at, np.where(has[at, None], placed.at[at], self.predicted[at]))
        self._refit(at, found)
        judged = self._judged(at, found)
        # Look again for missed marks where their neighbours predict them.
        again = np.flatnonzero((judged.why[at] != "") & (found.seen > _SEEN))
        if 0 < len(again) < len(at):
            found = found.replaced(again, self._match_all(at[again], judged.predicted[at[again]]))
            judged = self._judged(at, found)
        for _ in range(_CLEARINGS):
            cleared = self._without_intruders(at, found, judged)
            if cleared is found:
                break
            found, judged = cleared, self._judged(at, cleared)
        alike = with_alike_errors(found)
        if alike is not found:
            found, judged = alike, self._judged(at, alike)
        if self.lost is not None:
            found = self._with_lost_detail(at, found, judged)
            judged = self._judged(at, found)
        return at, found, judged

    def _with_lost_detail(self, at: Rows, found: Matches, judged: Verdict) -> Matches:
        """Matches with covariances that contain what compression has taken from the images of marks.

        It takes the same detail from all pixels of a block, and from the residuals: those of some marks are
        small by chance. What it does to positions is seen from their deviations from a polynomial; a local
        model would follow it, as marks at one place in their blocks are displaced together. Residual times
        leave-one-out deviation has the variance of a position for its mean, whatever the degree.
        """
        good = np.flatnonzero(judged.why[at] == "")
        if len(good) < _FEWEST_SCATTERED:
            return found
        least = np.maximum(float(np.median(found.noise[good])) / np.maximum(found.noise, 1e-12), 1.0)
        cov = found.cov * least[:, None, None] ** 2
        field = SmoothField.fit(self.source[at[good]], found.xy[good], local=False)
        off = found.xy[good] - field(self.source[at[good]])
        variance = np.diagonal(cov[good], axis1=1, axis2=2)
        factor = (off * field.leave_one_out()[0] / variance).mean(axis=0)
        share = (self.lost or 0.0) / max(float(np.median(found.noise[good])), 1e-12)
        if factor.max() > max(_MOST_LOST, share) ** 2:
            factor = np.ones(2)  # they lie beside the design, or the distortion is not smooth
        root = np.sqrt(np.maximum(factor, 1.0))
        return replace(found, cov=cov * np.outer(root, root))

    def _without_intruders(self, at: Rows, found: Matches, judged: Verdict) -> Matches:
        """Match marks with large residuals again, without the pixels of what lies over or beside them.

        An echo beside a wire, or any other object at a mark, pulls the mark as long as its position is free:
        the brightest parts of the object are rejected, its flanks are not. At the position that the
        neighbours predict and with the appearance of the other marks, the object stands out as a whole.
        """
        plain = found.converged & (judged.why[at] == "")
        if plain.sum() < _FEWEST_PLAIN:
            return found
        ordinary = float(np.median(found.noise[plain]))
        suspect = np.flatnonzero((found.noise > _UNEASY * ordinary) & (found.seen > _SEEN))
        plain &= found.noise <= _UNEASY * ordinary
        if not len(suspect) or plain.sum() < max(_FEWEST_PLAIN, 3 * len(suspect)):
            return found  # a scene lies behind all of them
        off = judged.deviation[at[plain]]
        scatter = robust_spread(off[np.isfinite(off)], 0.0)
        sigma = float(np.median(np.sqrt(np.trace(found.cov[plain], axis1=1, axis2=2) / 2)))
        if not scatter < _PREDICTABLE * sigma:
            return found  # the neighbours do not tell where a mark is
        near = scipy.spatial.KDTree(self.source[at[plain]]).query(self.source[at[suspect]], k=_FEWEST_PLAIN)[
            1
        ]
        left_out = np.nan_to_num(judged.deviation[at[suspect]])
        predicted = np.where(left_out != 0, found.xy[suspect] - left_out, judged.predicted[at[suspect]])
        options = replace(
            self._options(),
            psf_px=np.median(found.psf_px[plain][near], axis=1),
            psf_log_sigma=_FIXED,
            held=(_FIXED, _FIXED),
            contrast=np.median(found.contrast[plain][near], axis=1),
            contrast_sigma=_FIXED * abs(float(np.median(found.contrast[plain]))),
        )
        expected = self._match(at[suspect], predicted, options, _FIXED, _FIXED)
        valid = self.screened.valid & ~self._intruders(expected, predicted, ordinary, 3 * scatter)
        again = self._match(at[suspect], predicted, self._options(), self.size_spread, _TURNED, valid)
        better = again.converged & (again.noise < found.noise[suspect]) & (again.seen > _ENOUGH)
        cleared = found.replaced(suspect[better], again.select(better))
        # What cannot be distinguished from the mark itself still displaces it.
        own = np.sqrt(np.trace(cleared.cov[suspect], axis1=1, axis2=2) / 2)
        # Residual distortion has more large values than a normal distribution.
        largest = float(np.nanmax(np.abs(judged.deviation[at[plain]])))
        limit = np.maximum(_PULLED * np.hypot(own, scatter), _BEYOND * largest)
        pulled = np.hypot(*(cleared.xy[suspect] - predicted).T) > limit
        left = (cleared.noise[suspect] > _UNEASY * ordinary) | (cleared.seen[suspect] < _HALF)
        self.covered[at[suspect]] = pulled & left
        return cleared

    def _intruders(self, expected: Matches, centres: Array, noise: float, off_px: float) -> Mask:
        """Mask (h, w) of pixels that differ from the images expected at `centres`, with a margin for blur.

        Images may be displaced by `off_px`.
        """
        h, w = self.screened.grey.shape
        intruders = np.zeros((h, w), dtype=np.uint8)
        rows, columns = expected.residuals.shape[1:]
        reach = int(np.ceil(_FLANK * float(np.median(expected.psf_px))))
        disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        for residuals, (x, y) in zip(expected.residuals, np.rint(centres).astype(int), strict=True):
            top, left = y - rows // 2, x - columns // 2
            inner = slice(max(0, top), min(h, top + rows)), slice(max(0, left), min(w, left + columns))
            own = (
                slice(inner[0].start - top, inner[0].stop - top),
                slice(inner[1].start - left, inner[1].stop - left),
            )
            if min(part.stop - part.start for part in inner) < 2:
                continue
            off = residuals[own]
            steps = np.hypot(*np.gradient(self.screened.grey[inner] + np.nan_to_num(off)))
            differs = ~(np.abs(off) < 4 * noise + off_px * steps) & self.screened.valid[inner]
            # A single pixel is noise or a bit error.
            count, labels, stats, _ = cv2.connectedComponentsWithStats(
                differs.astype(np.uint8), connectivity=8
            )
            large = stats[:, cv2.CC_STAT_AREA] > 2
            large[0] = False
            if count > 1:
                strange = np.asarray(cv2.dilate(large[labels].astype(np.uint8), disk), dtype=np.uint8)
                intruders[inner] = np.maximum(intruders[inner], strange)
        return intruders > 0

    def _near_frame(self, xy: Array) -> Mask:
        """Mask of marks that may lie in the frame, at least in part."""
        margin = self.extent_px / 2 + 1.0
        limits = np.array([self.frame.width, self.frame.height]) - 1 + margin
        return np.asarray(((xy > -margin) & (xy < limits)).all(axis=1))

    def _first_options(self) -> MatchOptions:
        return MatchOptions(
            half_px=int(np.clip(np.ceil(self.extent_px / 2 + 4), 4, 40)),
            psf_px=self.options.psf_px,
            psf_log_sigma=0.5,
            polarity=self.design.polarity,
            response=PixelResponse(self.options.fill),
            start_px=2.0,
            within_px=self.reach_px,
        )

    def _outline(self, at: Rows, options: MatchOptions) -> Outline:
        """Outlines of the marks `at` in pixels, mapped by the field."""
        psf_px = float(np.max(options.psf_px))
        axes = self._axes(at)
        mark = self.design.mark
        width = self.size if mark.shape == "line-grid" else mark.line_width
        if width is not None:
            # An arm becomes narrower where the other is not perpendicular to it.
            width = width / float(np.median(np.abs(np.linalg.det(self.arms[at]))))
        # Wires of a crossing are cut off outside the window, whatever its rotation.
        reach = (1.5 * max(options.half) + 8 * psf_px) / self.px_per_unit
        outline = mark_outline(mark.shape, self.size, width, 0.8 * psf_px / self.px_per_unit, reach).affine(
            axes
        )
        # A mirroring mapping reverses the direction of the outline.
        return Outline(outline.xy, outline.dxy * np.sign(np.linalg.det(axes))[:, None, None])

    def _axes(self, at: Rows) -> Array:
        """Linear mappings (m, 2, 2) from an upright mark to the images of the marks `at`."""
        return self.field.jacobian(self.source[at]) @ self.arms[at]

    def _match(
        self,
        at: Rows,
        start: Array,
        options: MatchOptions,
        size_sigma: float,
        turn_sigma: float,
        valid: Mask | None = None,
    ) -> Matches:
        form, sigma = SIZE, np.array([size_sigma])
        if self.design.mark.shape in _ARMS:
            # Each arm turns by itself: its tip moves in the direction of the other.
            axes = self._axes(at)
            turns = axes[:, None] @ np.array([[[0.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.0, 0.0]]])
            turns = turns @ np.linalg.inv(axes)[:, None]
            form = np.concatenate([np.broadcast_to(SIZE, (len(at), 1, 2, 2)), turns], axis=1)
            sigma = np.array([size_sigma, turn_sigma, turn_sigma])
        outline = self._outline(at, options)

        def matched(rows: Rows, start: Array) -> Matches:
            return match(
                self.screened.grey,
                self.screened.valid if valid is None else valid,
                Outline(outline.xy[rows], outline.dxy[rows]),
                start,
                replace(options, **_of_each(options, rows)),
                noise=self.screened.noise,
                form=form[rows] if form.ndim == 4 else form,
                form_sigma=sigma,
            )

        found = matched(np.arange(len(at)), start)
        if options.held is not None:
            return found
        # From a poor start, pixels of the mark are taken for objects in its background and rejected.
        moved = found.converged & (np.hypot(*(found.xy - start).T) > _MOVED * self._image_width(0.0))
        again = np.flatnonzero(moved & (found.t > self.options.least_t))
        return found.replaced(again, matched(again, found.xy[again])) if len(again) else found

    def _refit(self, at: Rows, found: Matches) -> None:
        """Fit the field through the reliable marks; the field of the candidates was coarse."""
        near = np.abs(found.xy - self.predicted[at]).max(axis=1) < max(3.0, self.extent_px)
        sure = _sure(found) & near
        if sure.sum() >= 10:
            relative = self._relative(found.cov[sure])
            self.field = SmoothField.fit(self.source[at[sure]], found.xy[sure], sigma=relative)
            self.predicted = self.field(self.source)

    def _learn(self, at: Rows, first: Matches, start: Array) -> None:
        """Learn width, contrast, size and noise of the marks of this frame."""
        sure = _sure(first)
        # The strongest marks show this best; the others are added for their contrasts only.
        strongest = sure & (np.arange(len(sure)) < _LEARN_FROM)
        self.variance = grey_variance(self.screened.grey, start[strongest], first.residuals[strongest])
        if strongest.sum() < 5:
            self.psf_px, self.psf_spread = self.options.psf_px, 0.3
            self.contrast, self.contrast_spread, self.size_spread = None, np.inf, 0.1
            return
        log_psf, self.psf_spread = _robust(np.log(first.psf_px[strongest]), 0.08)
        self.psf_px = float(np.exp(log_psf))
        self.contrast, spread = _robust(first.contrast[sure], 0.03)
        # Contrasts may be of several kinds; the rarest that is considered has a share of one twentieth.
        low, high = np.quantile(first.contrast[sure], [0.05, 0.95])
        if high - low > 2 * _OTHER_KIND * abs(self.contrast):
            spread = max(spread, float(high - low) / 2)
        self.contrast_spread = 1.5 * spread
        growth, self.size_spread = _robust(first.form[strongest, 0], 0.02)
        self.size *= 1 + growth
        self.extent_px *= 1 + growth
        if self.design.mark.shape in _ARMS:
            self.arms = self._turned(first.form[sure, 1:])
        if self.design.mark.shape == "line-grid":
            self.reach_px = self._reach(at[strongest], first.select(strongest))

    def _reach(self, at: Rows, first: Matches) -> float:
        """Distance from a crossing up to which its arms are continuous wires; infinite in a whole grid.

        Crossings of short bars end within the window, and where they end is no property of the crossing.
        """
        options = self._first_options()
        half = max(options.half)
        distance = np.arange(0.0, 1.5 * half, 0.5)
        along = self._axes(at)
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        along = np.swapaxes(np.concatenate([along, -along], axis=2), 1, 2)
        steps = along[:, :, None] * distance[:, None]
        seen = levels_at(self.screened.grey, first.xy[:, None, None] + steps)
        # Blurred wires are brighter where they cross than elsewhere.
        reach = float(np.ceil(distance[-1])) + 1
        pixels = np.arange(-reach, reach + 1)
        psf_px = float(np.median(first.psf_px))
        outline = self._outline(at, replace(options, psf_px=psf_px)).oriented()
        wires = coverage(outline, pixels, pixels, psf_px, options.response)
        formed = np.stack(
            [
                levels_at(image.astype(np.float32), reach + each)
                for image, each in zip(wires, steps, strict=True)
            ]
        )
        share = first.contrast[:, None, None] * formed
        profile = np.median(seen - first.level[:, None, None], axis=(0, 1)) / np.median(share, axis=(0, 1))
        profile = profile / np.median(profile[distance <= 0.7 * half])
        ended = np.flatnonzero(profile < _ARM_ENDS)
        if not len(ended):
            return np.inf
        blur = float(np.hypot(psf_px, 12**-0.5))  # of the optics and of a pixel
        return float(distance[ended[0]] - _END * blur)

    def _turned(self, turns: Array) -> Array:
        """The arms, turned by what the marks of the frame have in common."""
        first, second = np.median(turns, axis=0)
        arms = self.arms @ np.array([[1.0, second], [first, 1.0]])
        return np.asarray(arms / np.linalg.norm(arms, axis=1, keepdims=True))

    def _options(self) -> MatchOptions:
        """Options with the learnt appearance."""
        return replace(
            self._first_options(),
            psf_px=self.psf_px,
            psf_log_sigma=max(0.25, 1.5 * self.psf_spread),
            contrast=self.contrast,
            contrast_sigma=self.contrast_spread,
            row_jitter_px=self.options.row_jitter_px,
            start_px=1.0,
            variance=self.variance,
            influence=True,
        )

    def _match_all(self, at: Rows, start: Array) -> Matches:
        """Match with the learnt appearance; with a curved background where that is better."""
        options = self._options()
        found = self._match(at, start, options, self.size_spread, _TURNED)
        if self.contrast is not None:
            # A distinct mark of another contrast is no worse a mark: it is matched without this expectation.
            distinct = found.converged & (found.t > 8)
            off = np.abs(found.contrast - self.contrast)
            another = np.flatnonzero(
                distinct
                & (off > _LIKE_OTHERS * self.contrast_spread)
                & (off > _OTHER_KIND * abs(self.contrast))
            )
            own = replace(options, contrast_sigma=np.inf)
            if len(another):
                again = self._match(at[another], found.xy[another], own, self.size_spread, _TURNED)
                found = found.replaced(another, again)
        ordinary = np.median(found.noise[found.converged]) if found.converged.any() else np.inf
        uneasy = np.flatnonzero(~found.converged | (found.noise > 1.5 * ordinary) | (found.rejected > 0.1))
        if not len(uneasy):
            return found
        curved = self._match(
            at[uneasy], start[uneasy], replace(options, background=2), self.size_spread, _TURNED
        )
        better = ~found.converged[uneasy] | (_size(curved.cov) < 0.8 * _size(found.cov[uneasy]))
        better &= curved.converged
        return found.replaced(uneasy[better], curved.select(better))

    def _judged(self, at: Rows, found: Matches) -> Verdict:
        n, why = len(self.source), Reason("outside the frame", Code.OUTSIDE).repeated(len(self.source))
        own = reasons_of(self._objections(at, found, self.predicted[at]), len(at))
        lone = "most other crossings with its wire are not seen, and it is faint"
        own[(own == "") & self._beside_wires(at, found, own)] = Reason(lone, Code.UNLIKE)
        why[at] = own
        xy, cov = spread(found.xy, at, n), spread(found.cov, at, n)
        variance, distinct = spread(found.variance, at, n) + _UNMODELLED_PX**2, np.zeros(n, dtype=bool)
        # A distinct mark is where it is, though the distortion between its neighbours is less smooth.
        distinct[at] = (found.t > 15) & (found.correlation > _CERTAIN)
        limit = np.where(distinct, _DISTINCT, 1.0) * self.options.neighbour_px
        known = self.source, xy, variance
        why, field, deviation = judged_by_neighbours(*known, why, limit, _SIGMAS, self.field)
        self.field = field or self.field
        return Verdict(xy, cov, why, deviation, self.field(self.source))

    def _beside_wires(self, at: Rows, found: Matches, why: Array) -> Mask:
        """Mask of faint crossings on a wire of which most others are not seen.

        Where the light of a screen ends, wires that end there look like crossings with its edge.
        """
        suspect, good = np.zeros(len(at), dtype=bool), why == ""
        if self.design.mark.shape != "line-grid" or not good.any():
            return suspect
        faint = found.t < _FAINT * float(np.median(found.t[good]))
        row = np.full(len(self.source), -1)
        row[at] = np.arange(len(at))
        for chain in (chain for family in grid_wires(self.source).marks for chain in family):
            own = row[chain[row[chain] >= 0]]
            if (good[own] & ~faint[own]).sum() < _MOST_FAINT * len(own):
                suspect[own] |= faint[own]
        return suspect

    def found_by_chance(self, at: Rows) -> tuple[int, int]:
        """How many of the places beside the marks `at`, where there are none, pass for marks; of how many."""
        step = 0.5 * spacing(self.predicted)
        angle = np.arange(16) * np.pi / 8
        around = self.predicted[at, None] + step * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        free = scipy.spatial.KDTree(self.predicted).query(around)[0].argmax(axis=1)
        beside = around[np.arange(len(at)), free]
        inside = self._near_frame(beside)
        at, beside = at[inside], beside[inside]
        if not len(at):
            return 0, 0
        found = self._match_all(at, beside)
        refused = np.any([mask for mask, *_ in self._objections(at, found, beside)], axis=0)
        return int((~refused).sum()), len(at)

    def _objections(self, at: Rows, found: Matches, predicted: Array) -> list[Objection]:
        """Objections to marks from their own images, the most serious first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        strong = found.converged & (found.t > 8)
        ordinary = float(np.median(found.psf_px[strong])) if strong.any() else self.psf_px
        contrast_sigma = found.contrast / np.maximum(np.abs(found.t), 1e-9)
        expected = 0.0 if self.contrast is None else self.contrast
        unlike = np.abs(found.contrast - expected) > _LIKE_OTHERS * np.hypot(
            self.contrast_spread, contrast_sigma
        )
        unlike &= ~(strong & (found.correlation > _CERTAIN))
        moved = np.hypot(*(found.xy - predicted).T) > max(2.5, 0.6 * self.extent_px)
        height = np.abs(found.contrast * (found.level if self.design.polarity == "dark" else 1.0))
        least = _ABOVE_LOST * (self.lost or 0.0)
        # A dark mark takes no more than all the light; in the dark any noise looks like a larger share.
        impossible = found.contrast > _ALL_LIGHT + 3 * contrast_sigma
        impossible &= self.design.polarity == "dark"
        faint = ~(found.t >= o.least_t) | impossible
        blurred = self._image_width(found.psf_px) > _BLURRED * self._image_width(ordinary)
        return [
            (found.seen <= _SEEN, "on lost lines or beyond the edge of the frame", Code.HIDDEN),
            (~found.converged, "the match did not converge", Code.NOT_CONVERGED),
            (faint, "no mark is distinct from its surroundings", Code.LOW_CONTRAST),
            (height < least, TOO_WEAK, Code.LOW_CONTRAST),
            (blurred, "less sharp than the other marks", Code.BLURRED),
            (unlike, "contrast differs from the other marks", Code.UNLIKE),
            (strong & ~self._alike(found), "the image is not that of a mark", Code.UNLIKE),
            (found.rejected > 0.4, "disturbed by bit errors or the scene", Code.DISTURBED),
            (self.covered[at], "disturbed by an object over or beside it", Code.DISTURBED),
            (moved, "no mark at the position predicted by its neighbours", Code.DEVIATES),
            (~(sigma <= o.most_sigma_px), "too uncertain", Code.UNCERTAIN),
        ]

    def _alike(self, found: Matches) -> Mask:
        """Mask of matches whose images are those of marks, apart from the noise of the frame.

        A single wire looks like half a crossing, and its position along the wire is arbitrary.
        """
        if self.design.mark.shape not in _ARMS:
            return np.asarray(found.correlation >= 0.5)
        white = np.clip((self.screened.noise / np.maximum(found.noise, 1e-12)) ** 2, 0, 1)
        squared = np.clip(found.correlation, 0, 1) ** 2
        return np.asarray(1 - (1 - squared) * (1 - white) >= _BOTH_ARMS**2)

    def _image_width(self, psf_px: ArrayLike) -> Array:
        """Width (one sigma) of the images of marks: point-spread function, pixel, and the mark itself."""
        narrow = self.design.mark.line_width or self.size
        mark_px = min(narrow, self.size) * self.px_per_unit
        width: Array = np.sqrt(np.square(np.asarray(psf_px)) + (1 + mark_px**2) / 12)
        return width

    def _relative(self, cov: Array) -> Array:
        """Relative standard deviations of points for a field."""
        variance = np.trace(cov, axis1=1, axis2=2) / 2 + _UNMODELLED_PX**2
        relative: Array = np.sqrt(variance / np.median(variance))
        return relative


def _of_each(options: MatchOptions, rows: Rows) -> dict[str, Any]:
    """Options that differ from mark to mark, for some of the marks."""
    each = {name: getattr(options, name) for name in ("psf_px", "contrast")}
    return {name: values[rows] for name, values in each.items() if isinstance(values, np.ndarray)}


def _sure(found: Matches) -> Mask:
    """Mask of reliable matches."""
    return found.converged & (found.t > 8) & (found.seen > 0.9) & (found.rejected < 0.2)


def _robust(values: Array, least: float) -> tuple[float, float]:
    """Median and a robust measure of spread, at least `least`."""
    return float(np.median(values)), max(least, robust_spread(values))


def _size(cov: Array) -> Array:
    """Square root of the trace of covariances, infinite where unknown."""
    size: Array = np.sqrt(np.nan_to_num(np.trace(cov, axis1=1, axis2=2), nan=np.inf, posinf=np.inf))
    return size
