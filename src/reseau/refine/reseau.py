"""Measure the marks of a reseau in one frame.

Screened frame → candidates by matched filter → the design laid over them → every mark matched with its formed
image, twice: first to learn what the marks of this frame look like (width of the point-spread function,
contrast, size), then with that as prior knowledge → each mark judged by its own image and by its neighbours.
A mark that is not there, or cannot be told from its surroundings, is reported as not found, with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..adjust import Failure
from ..data import Array, Frame, ImagePoints, Mask, Rows
from ..errors import UsageError
from ..formats import MeasuredPoint, ReseauDesign, ReseauMeasurement
from ..optics.formation import Outline, coverage, mark_outline
from .candidates import Candidates, find_candidates
from .field import SmoothField
from .grid import Assignment, GridOptions, assign, lay_out, spacing
from .matching import SIZE, Matches, MatchOptions, match
from .screening import Screened, screen

__all__ = ["ReseauOptions", "ReseauResult", "measure_reseau"]

_TRIAL_PX = (3.0, 4.5, 6.5, 10.0, 15.0, 22.0)
"""Sizes of a mark in the image that are tried where nothing tells it."""
_UNMODELLED_PX = 0.07
"""What positions scatter beyond their own sigmas in real frames; balances the weights of a field's points."""
BGH, BGD = 3.0, 2
_LEARN_FROM = 50
"""So many of the strongest marks tell what a mark of this frame looks like."""
_SEEN = 0.1
"""Share of a mark that must lie on pixels that carry an image."""
_BLURRED = 1.55
"""Widths of the others' point-spread function from which a mark counts as blurred: it is something else."""
_BENT = 1.25
"""Factor on the permitted deviation from the neighbours for marks whose own image is beyond doubt."""
_LIKE_OTHERS = 4.0
"""Spreads by which the contrast of a mark may differ from that of the others."""


@dataclass(frozen=True)
class ReseauOptions:
    """How a reseau is measured.

    Parameters
    ----------
    nominal : bool
        Whether the design's nominal positions are used, where it has them.
    mirrored : bool, optional
        See :class:`reseau.refine.grid.GridOptions`.
    max_rotation_deg : float
        Largest rotation of the design in the image, where there are no nominal positions.
    mark_px : float, optional
        Size of a mark in the image (width of the line for a line grid); by default from the design.
    psf_px : float
        First guess of the width (one sigma) of the point-spread function; estimated.
    row_jitter_px : float
        Standard deviation of the shift of single rows, where known.
    least_t : float
        Least contrast of a mark in units of its standard deviation.
    most_sigma_px : float
        Largest standard deviation of a coordinate that still counts as measured.
    neighbour_px : float
        Largest deviation, per axis, from what the neighbours predict. A mark whose own image is beyond doubt
        may deviate by a quarter more: beside a bright disc a scanned image is bent locally by that much.
    """

    nominal: bool = True
    mirrored: bool | None = None
    max_rotation_deg: float = 12.0
    mark_px: float | None = None
    psf_px: float = 0.6
    row_jitter_px: float = 0.0
    least_t: float = 3.5
    most_sigma_px: float = 0.5
    neighbour_px: float = 1.0


@dataclass(frozen=True, eq=False)
class ReseauResult:
    """The marks of a reseau in one frame, in columns over the n marks of the design.

    Parameters
    ----------
    image, sha256 : str
        The frame.
    ids : tuple of str (n,)
        The marks.
    xy : ndarray (n, 2)
        Image coordinates in pixels, NaN where not measured.
    cov : ndarray (n, 2, 2)
        Covariances in px², NaN where not measured.
    ok : ndarray of bool (n,)
        Which were measured.
    why : tuple of str (n,)
        Why not, empty where measured.
    predicted : ndarray (n, 2)
        Where the field has each mark.
    psf_px, contrast, t, noise : ndarray (n,)
        Of each match, see :class:`reseau.refine.matching.Matches`; NaN where there was none.
    deviation : ndarray (n, 2)
        Measured minus predicted from all *other* marks (leave-one-out), NaN where not measured.
    field : SmoothField
        From the design to the image. `field.need` tells whether the local model on top of the polynomial is
        needed.
    notes : tuple of str
        What the user should know.
    """

    image: str
    sha256: str
    ids: tuple[str, ...]
    xy: Array
    cov: Array
    ok: Mask
    why: tuple[str, ...]
    predicted: Array
    psf_px: Array
    contrast: Array
    t: Array
    noise: Array
    deviation: Array
    field: SmoothField
    notes: tuple[str, ...] = ()

    @property
    def found(self) -> int:
        """Number of marks measured."""
        return int(self.ok.sum())

    @property
    def points(self) -> ImagePoints:
        """The marks that were measured."""
        names = tuple(name for name, ok in zip(self.ids, self.ok, strict=True) if ok)
        return ImagePoints(names, self.xy[self.ok], self.cov[self.ok])

    def rms(self) -> Array:
        """Leave-one-out deviation, root mean square per axis (2,)."""
        rms: Array = np.sqrt(np.nanmean(self.deviation**2, axis=0))
        return rms

    def measurement(self) -> ReseauMeasurement:
        """The result as the document that others read."""
        points = []
        for i, name in enumerate(self.ids):
            if not self.ok[i]:
                points.append(MeasuredPoint(id=name, ok=False, why=self.why[i]))
                continue
            sx, sy = np.sqrt(np.diagonal(self.cov[i]))
            points.append(
                MeasuredPoint(
                    id=name,
                    x=float(self.xy[i, 0]),
                    y=float(self.xy[i, 1]),
                    sx=float(sx),
                    sy=float(sy),
                    rho=float(self.cov[i, 0, 1] / (sx * sy)),
                    ok=True,
                )
            )
        return ReseauMeasurement(
            image=self.image,
            sha256=self.sha256,
            points=tuple(points),
            found=self.found,
            expected=len(self.ids),
        )


def measure_reseau(
    frame: Frame, design: ReseauDesign, options: ReseauOptions | None = None
) -> ReseauResult | Failure:
    """Measure every mark of a reseau that can be measured.

    Parameters
    ----------
    frame : Frame
        A frame that shows the reseau, whole or in part, in front of any scene.
    design : ReseauDesign
        The reseau, with or without nominal positions in the image.
    options : ReseauOptions, optional
        How.

    Returns
    -------
    ReseauResult or Failure
        A failure (falsy) when the design is not to be found in the frame.

    Raises
    ------
    ImageError
        When the frame is all black, saturated, or of one grey.
    UsageError
        When the design has neither coordinates nor nominal positions to go by.
    """
    options = options or ReseauOptions()
    source = _source(design)
    known = np.flatnonzero(np.isfinite(source).all(axis=1))
    if len(known) < 4:
        raise UsageError("has fewer than four points with coordinates", where=f"design {design.name}")
    search = _Search(frame, design, source[known], known, options)
    placed = search.place()
    if isinstance(placed, Failure):
        return placed
    return _Measurement(search, placed).result()


def _source(design: ReseauDesign) -> Array:
    """Plane coordinates to go by: those of the design, or nominal positions where it has none."""
    if np.isfinite(design.xy).all(axis=1).sum() >= 4:
        return design.xy
    return design.nominal_px


class _Search:
    """Where the design lies in the frame, and how large a mark is there."""

    def __init__(
        self, frame: Frame, design: ReseauDesign, source: Array, known: Rows, options: ReseauOptions
    ) -> None:
        self.frame, self.design, self.source, self.known = frame, design, source, known
        self.options = options
        self.nominal = design.nominal_px[known]
        self.by_nominal = options.nominal and bool(np.isfinite(self.nominal).all())
        mark = design.mark
        self.size = mark.line_width if mark.shape == "line-grid" else mark.size
        self.assignment: Assignment
        self.mark_px = 0.0
        self.screened: Screened

    def place(self) -> Assignment | Failure:
        """Lay the design over the frame; the best of the sizes tried."""
        best: tuple[float, Assignment, float, Screened] | None = None
        for mark_px in self._sizes():
            screened = screen(self.frame, run=max(15, round(4 * mark_px)))
            template = self._template(mark_px)
            if len(template) > min(self.frame.pixels.shape):
                continue
            candidates = find_candidates(screened.grey, screened.valid, template)
            found = self._lay(candidates, screened, mark_px)
            if found is None:
                continue
            strength = float(np.log1p(candidates.t[found.candidate[found.candidate >= 0]]).sum())
            score = strength + found.score
            if best is None or score > best[0]:
                best = (score, found, mark_px, screened)
        least = max(4, min(10, len(self.source) // 3))
        found_marks = 0 if best is None else int((best[1].candidate >= 0).sum())
        if best is None or found_marks < least or best[1].score < -0.1 * len(self.source):
            return Failure(
                f"{self.frame.name}: design {self.design.name!r} is not to be found in the frame of "
                f"{self.frame.width}×{self.frame.height} px ({found_marks} of {len(self.source)} marks lie "
                "as it says)"
            )
        _, self.assignment, self.mark_px, self.screened = best
        return self.assignment

    def _sizes(self) -> tuple[float, ...]:
        if self.options.mark_px is not None:
            return (self.options.mark_px,)
        if self.by_nominal and self.size is not None:
            scale = spacing(self.nominal) / spacing(self.source)
            return (max(1.5, self.size * scale),)
        return _TRIAL_PX

    def _template(self, mark_px: float) -> Array:
        """Formed image of a mark of this size, upright."""
        mark, sigma = self.design.mark, self.options.psf_px
        size = width = mark_px
        if mark.shape == "cross" and mark.size and mark.line_width:
            width = mark_px * mark.line_width / mark.size
        reach = 1.5 * mark_px + 2
        half = int(np.ceil((reach if mark.shape == "line-grid" else size / 2) + 4))
        pixels = np.arange(-half, half + 1.0)
        outline = mark_outline(mark.shape, size, width, 0.5 * sigma, 2.0 * half)
        share = coverage(outline, pixels, pixels, sigma)
        return -share if self.design.polarity == "dark" else share

    def _lay(self, candidates: Candidates, screened: Screened, mark_px: float) -> Assignment | None:
        if self.by_nominal:
            return assign(self.source, self.nominal, candidates, screened.valid)
        options = GridOptions(np.deg2rad(self.options.max_rotation_deg), self.options.mirrored)
        found = lay_out(self.source, candidates, screened.valid, options)
        if found is None or self.size is None or self.options.mark_px is not None:
            return found
        # A pattern in the scene may fit the grid, but not with marks of another size than the design's.
        ratio = self.size * spacing(found.predicted) / spacing(self.source) / mark_px
        return found if 0.5 < ratio < 2.0 else None


@dataclass(frozen=True, eq=False)
class _Verdict:
    """Positions, covariances, reasons against, leave-one-out deviations, predictions of all marks."""

    xy: Array
    cov: Array
    why: Array
    deviation: Array
    predicted: Array


class _Measurement:
    """The two rounds of matching, and the verdict on every mark."""

    def __init__(self, search: _Search, placed: Assignment) -> None:
        self.search, self.options, self.screened = search, search.options, search.screened
        self.frame, self.source = search.frame, search.source
        self.field, self.predicted = placed.field, placed.predicted
        mark = search.design.mark
        scale = np.sqrt(np.abs(np.linalg.det(self.field.jacobian(self.source))))
        self.px_per_unit = float(np.median(scale))
        self.size = search.size if search.size is not None else search.mark_px / self.px_per_unit
        self.free_size = search.size is None
        self.extent_px = self.px_per_unit * (3.0 * self.size if mark.shape == "line-grid" else self.size)

    def result(self) -> ReseauResult:
        """Match, learn, match again, judge."""
        placed = self.search.assignment
        has = placed.candidate >= 0
        # The strongest tell what a mark looks like here, and where exactly to look for the others.
        strongest = np.flatnonzero(has)[np.argsort(placed.candidate[has], kind="stable")[:_LEARN_FROM]]
        first = self._match(
            strongest, placed.at[strongest], self._first_options(), 0.3 if self.free_size else 0.1
        )
        self._learn(first)
        at = np.flatnonzero(self._near_frame(self.predicted))
        found = self._match_all(at, np.where(has[at, None], placed.at[at], self.predicted[at]))
        self._refit(at, found)
        judged = self._judged(at, found)
        # Where a mark was missed, its neighbours now say better where to look.
        again = np.flatnonzero((judged.why[at] != "") & (found.seen > _SEEN))
        if 0 < len(again) < len(at):
            found = found.replaced(again, self._match_all(at[again], judged.predicted[at[again]]))
            judged = self._judged(at, found)
        return self._columns(at, found, judged)

    def _near_frame(self, xy: Array) -> Mask:
        """Marks of which something may be in the frame."""
        margin = self.extent_px / 2 + 1.0
        limits = np.array([self.frame.width, self.frame.height]) - 1 + margin
        return np.asarray(((xy > -margin) & (xy < limits)).all(axis=1))

    def _first_options(self) -> MatchOptions:
        return MatchOptions(
            half_px=int(np.clip(np.ceil(self.extent_px / 2 + 4), 4, 40)),
            psf_px=self.options.psf_px,
            psf_log_sigma=0.5,
            polarity=self.search.design.polarity,
            start_px=2.0,
        )

    def _outline(self, at: Rows, psf_px: float) -> Outline:
        """Outlines of the marks `at` in pixels, as the field maps them."""
        jacobian = self.field.jacobian(self.source[at])
        mark = self.search.design.mark
        width = self.size if mark.shape == "line-grid" else mark.line_width
        reach = 60.0 / self.px_per_unit
        outline = mark_outline(mark.shape, self.size, width, 0.45 * psf_px / self.px_per_unit, reach).affine(
            jacobian
        )
        # A mapping that mirrors turns the direction of travel around.
        return Outline(outline.xy, outline.dxy * np.sign(np.linalg.det(jacobian))[:, None, None])

    def _match(self, at: Rows, start: Array, options: MatchOptions, size_sigma: float) -> Matches:
        return match(
            self.screened.grey,
            self.screened.valid,
            self._outline(at, options.psf_px),
            start,
            options,
            noise=self.screened.noise,
            form=SIZE,
            form_sigma=np.array([size_sigma]),
        )

    def _refit(self, at: Rows, found: Matches) -> None:
        """The field through the marks beyond doubt; that of the candidates was coarse."""
        near = np.abs(found.xy - self.predicted[at]).max(axis=1) < max(3.0, self.extent_px)
        sure = _sure(found) & near
        if sure.sum() >= 10:
            relative = self._relative(found.cov[sure])
            self.field = SmoothField.fit(self.source[at[sure]], found.xy[sure], sigma=relative)
            self.predicted = self.field(self.source)

    def _learn(self, first: Matches) -> None:
        """What the marks of this frame look like: width, contrast, size."""
        sure = _sure(first)
        if sure.sum() < 5:
            self.psf_px, self.psf_spread = self.options.psf_px, 0.3
            self.contrast, self.contrast_spread, self.size_spread = None, np.inf, 0.1
            return
        log_psf, self.psf_spread = _robust(np.log(first.psf_px[sure]), 0.08)
        self.psf_px = float(np.exp(log_psf))
        self.contrast, spread = _robust(first.contrast[sure], 0.03)
        self.contrast_spread = 1.5 * spread
        growth, self.size_spread = _robust(first.form[sure, 0], 0.02)
        self.size *= 1 + growth
        self.extent_px *= 1 + growth

    def _match_all(self, at: Rows, start: Array) -> Matches:
        """Match with what has been learnt; amid a scene with a curved background, where that is better."""
        options = replace(
            self._first_options(),
            psf_px=self.psf_px,
            psf_log_sigma=max(0.25, 1.5 * self.psf_spread),
            contrast=self.contrast,
            contrast_sigma=self.contrast_spread,
            row_jitter_px=self.options.row_jitter_px,
            start_px=1.0,
        )
        found = self._match(at, start, options, self.size_spread)
        ordinary = np.median(found.noise[found.converged]) if found.converged.any() else np.inf
        uneasy = np.flatnonzero(~found.converged | (found.noise > 1.5 * ordinary) | (found.rejected > 0.1))
        if not len(uneasy):
            return found
        curved = self._match(at[uneasy], start[uneasy], replace(options, background=2), self.size_spread)
        better = ~found.converged[uneasy] | (_size(curved.cov) < 0.8 * _size(found.cov[uneasy]))
        better &= curved.converged
        return found.replaced(uneasy[better], curved.select(better))

    def _judged(self, at: Rows, found: Matches) -> _Verdict:
        n = len(self.source)
        why = np.full(n, "", dtype=object)
        outside = np.ones(n, dtype=bool)
        outside[at] = False
        why[outside] = "outside the frame"
        for mask, reason in self._objections(at, found):
            why[at[mask & (why[at] == "")]] = reason
        xy, cov = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan)
        xy[at], cov[at] = found.xy, found.cov
        deviation = self._judge_by_neighbours(at, found, xy, cov, why)
        return _Verdict(xy, cov, why, deviation, self.field(self.source))

    def _objections(self, at: Rows, found: Matches) -> list[tuple[Mask, str]]:
        """What speaks against a mark in its own image, the gravest first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        strong = found.converged & (found.t > 8)
        ordinary = float(np.median(found.psf_px[strong])) if strong.any() else self.psf_px
        contrast_sigma = found.contrast / np.maximum(np.abs(found.t), 1e-9)
        expected = 0.0 if self.contrast is None else self.contrast
        unlike = np.abs(found.contrast - expected) > _LIKE_OTHERS * np.hypot(
            self.contrast_spread, contrast_sigma
        )
        moved = np.hypot(*(found.xy - self.predicted[at]).T) > max(2.5, 0.6 * self.extent_px)
        return [
            (found.seen <= _SEEN, "on lost lines or beyond the edge of the frame"),
            (~found.converged, "the match does not converge"),
            (~(found.t >= o.least_t), "no mark stands out from its surroundings"),
            (found.psf_px > _BLURRED * ordinary, "blurred unlike the other marks"),
            (unlike, "of another contrast than the other marks"),
            (strong & (found.correlation < 0.5), "the image is not that of a mark"),
            (found.rejected > 0.4, "disturbed by bit errors or the scene"),
            (moved, "no mark where its neighbours have it"),
            (~(sigma <= o.most_sigma_px), "too uncertain"),
        ]

    def _judge_by_neighbours(self, at: Rows, found: Matches, xy: Array, cov: Array, why: Array) -> Array:
        """Reject, the worst first, what lies where its neighbours do not have it; fit the field anew."""
        deviation = np.full(xy.shape, np.nan)
        doubtless = np.zeros(len(xy), dtype=bool)
        doubtless[at] = (found.t > 15) & (found.seen > 0.9)
        limit = self.options.neighbour_px * np.where(doubtless, _BENT, 1.0)
        while (good := np.flatnonzero(why == "")).size >= 10:
            relative = self._relative(cov[good])
            # The length found first serves all rounds; where there is none yet, the likeliest is taken.
            length = self.field.length if np.isfinite(self.field.length) else None
            self.field = SmoothField.fit(self.source[good], xy[good], sigma=relative, length=length)
            deviation[:] = np.nan
            deviation[good], sigma = self.field.leave_one_out()
            # Where the neighbours themselves do not know to a pixel, they cannot object.
            excess = (np.abs(deviation[good]) / np.maximum(limit[good, None], 3 * sigma)).max(axis=1)
            worst = int(excess.argmax())
            if excess[worst] <= 1:
                break
            off = np.hypot(*deviation[good[worst]])
            why[good[worst]] = f"{off:.1f} px off the prediction of its neighbours"
        deviation[why != ""] = np.nan
        return deviation

    def _relative(self, cov: Array) -> Array:
        """Relative standard deviations of points for a field."""
        variance = np.trace(cov, axis1=1, axis2=2) / 2 + _UNMODELLED_PX**2
        relative: Array = np.sqrt(variance / np.median(variance))
        return relative

    def _columns(self, at: Rows, found: Matches, judged: _Verdict) -> ReseauResult:
        """Spread over all marks of the design, those without coordinates among them."""
        search, good = self.search, judged.why == ""
        judged.xy[~good], judged.cov[~good] = np.nan, np.nan
        n = len(search.design.points)

        def spread(values: Array, rows: Rows) -> Array:
            full = np.full((n, *values.shape[1:]), np.nan)
            full[rows] = values
            return full

        ok, reasons = np.zeros(n, dtype=bool), np.full(n, "the design does not say where", dtype=object)
        ok[search.known], reasons[search.known] = good, judged.why
        inside = search.known[at]
        return ReseauResult(
            image=self.frame.name,
            sha256=self.frame.sha256,
            ids=search.design.ids,
            xy=spread(judged.xy, search.known),
            cov=spread(judged.cov, search.known),
            ok=ok,
            why=tuple(reasons),
            predicted=spread(judged.predicted, search.known),
            psf_px=spread(found.psf_px, inside),
            contrast=spread(found.contrast, inside),
            t=spread(found.t, inside),
            noise=spread(found.noise, inside),
            deviation=spread(judged.deviation, search.known),
            field=self.field,
        )


def _sure(found: Matches) -> Mask:
    """Matches beyond doubt."""
    sure: Mask = found.converged & (found.t > 8) & (found.seen > 0.9) & (found.rejected < 0.2)
    return sure


def _robust(values: Array, least: float) -> tuple[float, float]:
    """Median and a robust spread, not below `least`."""
    median = float(np.median(values))
    return median, max(least, 1.4826 * float(np.median(np.abs(values - median))))


def _size(cov: Array) -> Array:
    """Root of the trace of covariances, infinite where not known."""
    size: Array = np.sqrt(np.nan_to_num(np.trace(cov, axis1=1, axis2=2), nan=np.inf, posinf=np.inf))
    return size
