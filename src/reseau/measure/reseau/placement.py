"""Find where a design lies in a frame: assign candidates to the marks of its grid.

With approximate positions only a common shift is voted for. Without them, pairs of neighbours vote for scale,
rotation and handedness, and pairs of candidate and mark vote for the shift. Both cases continue in the same
way: a polynomial from the design to the image grows in degree, and outwards from its reliable part, while the
search radius decreases.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...io import ReseauDesign
from ...optics.field import SmoothField, monomials, trend_degree
from ...optics.formation import coverage, mark_outline
from ..screening import Screened, screen
from .candidates import Candidates, find_candidates
from .wires import grid_wires

__all__ = [
    "Assignment",
    "GridOptions",
    "Placement",
    "PlacingOptions",
    "assign",
    "climbed",
    "grid_steps",
    "in_sight",
    "place",
    "place_grid",
]

_NEIGHBOURS = 6
_UPRIGHT = np.deg2rad(12.0)
"""Rotation up to which a design counts as upright in the image."""
_AS_STRONG = 0.6
"""Strength of a mark relative to the strongest ones, at least, where marks are equally distinct."""
_TRIED = 8
"""Number of start positions without prior knowledge that are followed."""
_NEARLY = 0.75
"""Share of the marks from which a layout is correct except for a shift by steps of the grid."""
_PROJECTED, _FEWEST_PROJECTED = 4, 10
"""Rounds of assigning marks of a plane in perspective; fewest marks that show a perspective."""
_FINEST_PX = 0.05
"""Error of the place of a candidate, pixels."""
_MOST_RIGHT = 0.85
"""Share of the marks whose candidates are taken to be right."""
_UNLIKE = 0.4
"""Difference of scatters that contradicts a position, as a share of that of the design shifted by a step."""
_FEWER = 0.1
"""Share of all marks by which the score of a position may be lower that fits their places."""


@dataclass(frozen=True)
class GridOptions:
    """What is known about the grid in the image.

    Parameters
    ----------
    max_rotation : float, optional
        Largest rotation of the design against the image (rad). By default any; a design that fits upright is
        not turned.
    mirrored : bool, optional
        Whether the design has the handedness of the image (x right, y down; False) or the opposite (True);
        None to determine it. A symmetric grid does not determine it; then the handedness of the nominal
        positions is used, or without them that of a design with y up.
    hypotheses : int
        Number of peaks of the vote for scale and rotation that are followed.
    """

    max_rotation: float | None = None
    mirrored: bool | None = None
    hypotheses: int = 4

    def rotations(self) -> tuple[float, ...]:
        """Largest rotations (rad) that are tried one after the other."""
        most = np.pi if self.max_rotation is None else self.max_rotation
        return (most,) if most <= _UPRIGHT else (_UPRIGHT, most)


@dataclass(frozen=True, eq=False)
class Assignment:
    """Marks with their candidates.

    Parameters
    ----------
    field : SmoothField
        Mapping from the design to the image.
    predicted : ndarray (n, 2)
        Position of each mark predicted by the field.
    candidate : ndarray of int (n,)
        Index of the candidate of each mark, -1 where there is none.
    at : ndarray (n, 2)
        Position of that candidate, NaN where there is none.
    missed : int
        Number of marks that should be visible and have no candidate.
    """

    field: SmoothField
    predicted: Array
    candidate: Rows
    at: Array
    missed: int

    @property
    def score(self) -> float:
        """Number of marks found, minus half the number missed."""
        return int((self.candidate >= 0).sum()) - 0.5 * self.missed

    def likeness(self, t: Array) -> Array:
        """Strength of the candidates of the marks (k,) relative to the strongest ones, at most 1.

        Of the marks of a frame none is much fainter than the others; places along a wire that only resemble a
        crossing are.

        Parameters
        ----------
        t : ndarray (m,)
            Strengths of all candidates, in descending order.
        """
        has = self.candidate >= 0
        usual = float(np.median(t[: max(4, len(self.candidate) // 2)]))
        likeness: Array = np.minimum(t[self.candidate[has]] / usual, 1.0)
        return likeness

    def support(self, t: Array) -> float:
        """The score with every mark weighted with its likeness."""
        return float(self.likeness(t).sum()) - 0.5 * self.missed


def spacing(xy: Array) -> float:
    """Median distance of a point to its nearest neighbour."""
    return float(np.median(KDTree(xy).query(xy, k=2)[0][:, 1]))


def assign(
    source: Array,
    start: Array,
    candidates: Candidates,
    valid: Mask,
    shifts: int = 4,
    within_px: float | None = None,
) -> Assignment | None:
    """Assign candidates to marks, starting from approximate positions.

    Parameters
    ----------
    source : ndarray (n, 2)
        Design coordinates.
    start : ndarray (n, 2)
        Approximate positions in pixels, correct up to any smooth distortion and a shift of up to one pitch.
    candidates : Candidates
        Places that look like a mark.
    valid : ndarray (h, w) of bool
        Pixels that carry an image; only there can a mark count as missed.
    shifts : int
        Maximum number of common shifts that are tried. A grid shifted by half a pitch or more agrees almost
        as well with neighbours in the place of its marks, but misses the marks at its border.
    within_px : float, optional
        Largest error of the approximate positions, if known; then no shifts are tried.

    Returns
    -------
    Assignment or None
        None if too few marks found a candidate.
    """
    if len(candidates) < 4:
        return None
    pitch, best = spacing(start), None
    if within_px is not None:
        return _assigned(source, start, candidates, valid, pitch, min(within_px, 0.2 * pitch))
    for shift in _common_shifts(start, candidates, pitch, shifts):
        found = _assigned(source, start + shift, candidates, valid, pitch, 0.2 * pitch)
        if found is None:
            continue
        # At a shift of half a pitch, wires look a little like crossings everywhere, but nowhere strongly.
        strength = found.score + float(np.log1p(candidates.t[found.candidate[found.candidate >= 0]]).sum())
        if best is None or strength > best[0] + 0.75:
            best = strength, found
    return None if best is None else best[1]


def _assigned(
    source: Array, start: Array, candidates: Candidates, valid: Mask, pitch: float, widest: float
) -> Assignment | None:
    """Assign candidates to marks whose approximate positions are wrong by a smooth distortion only."""
    centre = _densest(start, candidates, pitch)
    far = np.hypot(*(start - centre).T)
    tree, predicted, gate = KDTree(candidates.xy), start, widest
    field: SmoothField | None = None
    rows = np.full(len(start), -1)
    for step, most in enumerate((1, 1, 2, 3, 3, 5, 5, 5)):
        reached = far <= max(3.5 * pitch, np.quantile(far, min(1.0, 0.35 + 0.13 * step)))
        rows = _nearest(tree, candidates, predicted, gate, reached)
        fitted = _robust_field(
            source, rows, candidates, min(most, max(1, trend_degree(int((rows >= 0).sum()))))
        )
        if fitted is None:
            break
        field, scatter = fitted
        predicted = field(source)
        gate = float(np.clip(4 * scatter, min(max(2.0, 0.03 * pitch), widest), widest))
    if field is None:
        return None
    rows = _nearest(tree, candidates, predicted, gate, np.ones(len(start), dtype=bool))
    missed = (rows < 0) & in_sight(predicted, valid)
    at = np.where(rows[:, None] >= 0, candidates.xy[rows], np.nan)
    return Assignment(field, predicted, rows, at, int(missed.sum()))


def in_sight(xy: Array, valid: Mask) -> Mask:
    """Mask of positions on pixels that carry an image, at least two pixels from the border."""
    limits = np.array(valid.shape[::-1])
    inside = ((xy > 1) & (xy < limits - 2)).all(axis=1)
    column, row = np.clip(np.rint(np.nan_to_num(xy)), 0, limits - 1).astype(np.intp).T
    seen: Mask = inside & valid[row, column]
    return seen


def _common_shifts(start: Array, candidates: Candidates, pitch: float, count: int) -> Iterator[Array]:
    """Shifts of at most one pitch that most pairs of start and candidate support, the likeliest first."""
    offset = (candidates.xy[None] - start[:, None]).reshape(-1, 2)
    weight = np.broadcast_to(np.minimum(candidates.t, 15.0), (len(start), len(candidates))).ravel()
    near = (np.abs(offset) < pitch).all(axis=1)
    votes, (x, y) = _vote(offset[near], weight[near], [(-pitch, pitch)] * 2, max(1.0, pitch / 40), 2.0)
    # Of two shifts with similar support take the smaller: a grid agrees with itself at every pitch.
    votes *= 1 - 0.3 * np.hypot(x[:, None], y[None]) / (1.5 * pitch)
    most = votes.max()
    for _ in range(count):
        i, j = np.unravel_index(votes.argmax(), votes.shape)
        if not votes[i, j] > 0.5 * most:
            return
        yield np.array([x[i], y[j]])
        votes[np.hypot(x[:, None] - x[i], y[None] - y[j]) < 0.3 * pitch] = 0


def _vote(
    values: Array,
    weight: Array,
    limits: list[tuple[float, float]],
    width: float | tuple[float, float],
    blur: float,
) -> tuple[Array, tuple[Array, Array]]:
    """Smoothed two-dimensional histogram, and the centres of its bins."""
    widths = (width, width) if isinstance(width, float) else width
    bins = [max(3, int((high - low) / w)) for (low, high), w in zip(limits, widths, strict=True)]
    index = np.zeros(len(values), dtype=np.intp)
    centres: list[Array] = []
    for column, (low, high), count in zip(values.T, limits, bins, strict=True):
        step = (high - low) / count
        index = index * count + np.clip(((column - low) / step).astype(np.intp), 0, count - 1)
        centres.append(np.linspace(low, high, 2 * count + 1)[1::2])
    # Without values `bincount` counts in integers.
    votes = np.bincount(index, weight, minlength=bins[0] * bins[1]).astype(np.float64).reshape(bins)
    smooth: Array = gaussian_filter(votes, blur, mode="constant", truncate=3.0)
    return smooth, (centres[0], centres[1])


def _densest(start: Array, candidates: Candidates, pitch: float) -> Array:
    """Position of a mark most of whose neighbours have a candidate at their predicted places."""
    has = KDTree(candidates.xy).query(start)[0] < 0.2 * pitch
    near = KDTree(start).query(start, k=min(9, len(start)))[1]
    score = has[near].sum(axis=1) - 1e-3 * np.hypot(*(start - start.mean(axis=0)).T) / pitch
    centre: Array = start[score.argmax()]
    return centre


def _nearest(tree: KDTree, candidates: Candidates, predicted: Array, gate: float, reached: Mask) -> Rows:
    """Likeliest candidate within the search radius of each mark: strong, and near."""
    distance, row = tree.query(predicted, k=min(4, len(candidates)), distance_upper_bound=gate)
    likely = np.append(candidates.t, 0.0)[row] / (
        1 + 3 * (np.where(np.isfinite(distance), distance, 0) / gate) ** 2
    )
    best = likely.argmax(axis=1)
    each = np.arange(len(predicted))
    rows = np.where((likely[each, best] > 0) & reached, row[each, best], -1)
    # A candidate cannot serve two marks: the nearer one keeps it.
    order = np.lexsort((distance[each, best], rows))
    again = np.append(False, (rows[order][1:] == rows[order][:-1]) & (rows[order][1:] >= 0))
    rows[order[again]] = -1
    return rows


def _robust_field(
    source: Array, rows: Rows, candidates: Candidates, degree: int
) -> tuple[SmoothField, float] | None:
    """Polynomial through marks and their candidates, blunders rejected, and its scatter in pixels."""
    has = np.flatnonzero(rows >= 0)
    least = (degree + 1) * (degree + 2) // 2 + 3
    if len(has) < least:
        return None
    image, kept = candidates.xy[rows[has]], np.ones(len(has), dtype=bool)
    off = source[has] - source[has].mean(axis=0)
    x, y = off.T / np.abs(off).max()
    design = monomials(x, y, degree)
    for _ in range(6):
        used = kept
        trend = np.linalg.lstsq(design[used], image[used], rcond=None)[0]
        distance = np.hypot(*(design @ trend - image).T)
        scatter = max(float(np.median(distance[used])) / 1.18, 0.15)
        closer = distance < 3 * scatter
        if closer.sum() < least or (closer == used).all():
            break
        kept = closer
    try:
        field = SmoothField.fit(source[has[used]], image[used], degree=degree, local=False)
    except np.linalg.LinAlgError:  # marks of a single row
        return None
    return field, scatter


def place_grid(source: Array, candidates: Candidates, valid: Mask, options: GridOptions) -> Assignment | None:
    """Find the design among candidates without approximate positions.

    Parameters
    ----------
    source : ndarray (n, 2)
        Design coordinates.
    candidates : Candidates
        Places that look like a mark; false ones may be three times as many as the marks.
    valid : ndarray (h, w) of bool
        Pixels that carry an image.
    options : GridOptions
        What is known about the grid.

    Returns
    -------
    Assignment or None
        The assignment with the highest score; None if no hypothesis finds enough marks.
    """
    strong = _strongest(candidates, 4 * len(source))
    if len(strong) < 8 or len(source) < 8:
        return None
    # Many places along a wire look somewhat like a crossing: with all candidates voting, they may outvote the
    # crossings; with the strongest only, a scene behind the marks may. Therefore first one, then the other.
    # A frame that shows only part of the design has fewer crossings than expected, all about as strong.
    usual = float(np.median(strong.t[: max(4, len(source) // 2)]))
    alike = int((strong.t > _AS_STRONG * usual).sum())
    electorates = [_strongest(candidates, 3 * len(source) // 2), strong]
    if 8 <= alike < len(source):
        electorates.insert(0, _strongest(candidates, alike))
    best: Assignment | None = None
    uneven = _unevenness(source)
    for turned in options.rotations():
        # Hypotheses with y up come first: of two that explain the image equally, the first is kept.
        for mirrored in (True, False) if options.mirrored is None else (options.mirrored,):
            plane = source * [1, -1 if mirrored else 1]
            starts = (_starts(plane, voters, turned, options.hypotheses) for voters in electorates)
            for start in _supported(list(chain.from_iterable(starts)), strong, usual, _TRIED):
                found = assign(source, start, strong, valid, shifts=1)
                if found is None:
                    continue
                if found.score > _NEARLY * len(source):
                    found = climbed(found, source, strong, valid)
                if best is None or _is_better(
                    found, best, source, uneven, found.support(strong.t) > best.support(strong.t) + 0.75
                ):
                    best = found
                # If no grid step improves it and nearly all marks support it, no other hypothesis is better.
                if found.support(strong.t) > _NEARLY * len(source):
                    break
        if best is not None and best.support(strong.t) > _NEARLY * len(source):
            break
    return best if best is None or best.missed == 0 else climbed(best, source, strong, valid)


def _supported(starts: list[Array], candidates: Candidates, usual: float, count: int) -> list[Array]:
    """The start positions near which most marks have a candidate that is as strong as marks usually are."""
    tree, likeness = KDTree(candidates.xy), np.minimum(candidates.t / usual, 1.0)
    support = []
    for start in starts:
        distance, row = tree.query(start)
        support.append(float(likeness[row[distance < 0.25 * spacing(start)]].sum()))
    return [starts[k] for k in np.argsort(-np.array(support, dtype=float), kind="stable")[:count]]


def climbed(found: Assignment, source: Array, candidates: Candidates, valid: Mask) -> Assignment:
    """Move the design by steps of its grid as long as that assigns more marks.

    A regular design that is shifted by one pitch finds a candidate for all marks except those of one row.
    Beyond the marks found so far a polynomial does not follow perspective; a projective mapping does. The
    places of an uneven design tell which of two positions is right where a row at the border is not seen.
    """
    steps, uneven = grid_steps(source), _unevenness(source)
    for _ in range(len(source)):
        moved = [assign(source, found.field(source + step), candidates, valid, shifts=1) for step in steps]
        plane = _homography(source, found.at)
        if plane is not None:
            moved += [
                _projected(source, _on_plane(plane, source + step), candidates, valid)
                for step in (np.zeros(2), *steps)
            ]
        better = [
            m for m in moved if m is not None and _is_better(m, found, source, uneven, m.score > found.score)
        ]
        if not better:
            break
        found = max(better, key=lambda m: m.score)
    return found


def _is_better(other: Assignment, found: Assignment, source: Array, uneven: float, more: bool) -> bool:
    """Whether another position, which finds more marks or not, fits an uneven design better."""
    if other.score < found.score - _FEWER * len(source):
        return False
    expected = uneven * spacing(found.predicted) / spacing(source)
    here, there = (max(_FINEST_PX, _scatter(source, m.at)) for m in (found, other))
    if expected < 2 * min(here, there) or abs(there - here) < _UNLIKE * expected:
        return more
    return there < here


def _scatter(source: Array, at: Array) -> float:
    """Scatter of marks at (n, 2), NaN where there is none, about a smooth mapping of their design."""
    has = np.isfinite(at).all(axis=1)
    degree = trend_degree(int(has.sum()), most=3)
    off = source[has] - source[has].mean(axis=0)
    x, y = off.T / np.abs(off).max()
    design = monomials(x, y, degree)
    distance, image = np.zeros(len(x)), at[has]
    for share in (1.0, _MOST_RIGHT):  # some candidates are false
        kept = distance <= np.quantile(distance, share)
        trend = np.linalg.lstsq(design[kept], image[kept], rcond=None)[0]
        distance = np.hypot(*(design @ trend - image).T)
    return float(np.sqrt(np.mean(distance[distance <= np.quantile(distance, _MOST_RIGHT)] ** 2)))


def _unevenness(source: Array) -> float:
    """Scatter of the steps between neighbours of a design, beyond a smooth mapping of it."""
    tree, pitch, found = KDTree(source), spacing(source), [0.0]
    for step in grid_steps(source):
        distance, row = tree.query(source + step)
        neighbour = np.where((distance < 0.3 * pitch)[:, None], source[row], np.nan)
        if np.isfinite(neighbour).all(axis=1).sum() >= _FEWEST_PROJECTED:
            found.append(_scatter(source, neighbour))
    return min((s for s in found if s > 0), default=0.0)


def _projected(source: Array, start: Array, candidates: Candidates, valid: Mask) -> Assignment | None:
    """Assign candidates to marks of a plane in perspective, starting from approximate positions."""
    tree, pitch, predicted = KDTree(candidates.xy), spacing(start), start
    every = np.ones(len(source), dtype=bool)
    for _ in range(_PROJECTED):
        rows = _nearest(tree, candidates, predicted, 0.2 * pitch, every)
        at = np.where(rows[:, None] >= 0, candidates.xy[rows], np.nan)
        plane = _homography(source, at)
        if plane is None:
            return None
        predicted = _on_plane(plane, source)
    has = rows >= 0
    missed = ~has & in_sight(predicted, valid)
    field = SmoothField.fit(source[has], at[has], local=False)
    return Assignment(field, predicted, rows, at, int(missed.sum()))


def _homography(source: Array, at: Array) -> Array | None:
    """Projective mapping (3, 3) of the plane of the design to marks at (n, 2), NaN where there is none."""
    has = np.isfinite(at).all(axis=1)
    if has.sum() < _FEWEST_PROJECTED:
        return None
    plane, used = cv2.findHomography(source[has], at[has], cv2.RANSAC, max(2.0, 0.1 * spacing(at[has])))
    if plane is None or used.sum() < _FEWEST_PROJECTED:
        return None
    return np.asarray(plane, dtype=np.float64)


def _on_plane(plane: Array, source: Array) -> Array:
    """Points (n, 2) mapped by a homography (3, 3)."""
    return np.asarray(cv2.perspectiveTransform(source[None], plane)[0])


def grid_steps(source: Array) -> Array:
    """Steps (k, 2) from many marks of a design to a neighbour."""
    offset = source[KDTree(source).query(source, k=min(5, len(source)))[1][:, 1:]] - source[:, None]
    grain = np.hypot(*np.moveaxis(offset, -1, 0)).min() / 4
    steps, count = np.unique(np.round(offset.reshape(-1, 2) / grain), axis=0, return_counts=True)
    return np.asarray(steps[count > 0.2 * len(source)] * grain)


def _strongest(candidates: Candidates, count: int) -> Candidates:
    return replace(candidates, xy=candidates.xy[:count], t=candidates.t[:count])


def _starts(plane: Array, voters: Candidates, most: float, count: int) -> Iterator[Array]:
    """Start positions of the marks at rotations up to `most`, the likeliest first."""
    for similarity in _similarities(plane, voters, most, count if most <= _UPRIGHT else 2 * count):
        yield from _shifted(plane, similarity, voters)


def _complex(xy: Array) -> NDArray[np.complex128]:
    z: NDArray[np.complex128] = xy[:, 0] + 1j * xy[:, 1]
    return z


def _similarities(plane: Array, candidates: Candidates, most: float, count: int) -> list[complex]:
    """Scales and rotations, as complex factors, that map design neighbours to neighbouring candidates."""

    def steps(xy: Array, count: int) -> NDArray[np.complex128]:
        z = _complex(xy)
        row = KDTree(xy).query(xy, k=min(count + 1, len(xy)))[1]
        vectors: NDArray[np.complex128] = (z[row[:, 1:]] - z[:, None]).ravel()
        return vectors

    designed, seen = steps(plane, _NEIGHBOURS), steps(candidates.xy, _NEIGHBOURS)
    # Equal steps of a regular design vote once, weighted with their number.
    grain = np.abs(designed).min() / 50
    designed, weight = np.unique(np.round(designed / grain), return_counts=True)
    ratio = (seen[:, None] / (designed * grain)).ravel()
    weights = np.broadcast_to(weight, (len(seen), len(weight))).ravel()
    angle = np.angle(ratio)
    keep = (np.abs(angle) <= most) & (np.abs(ratio) > 0)
    logs = np.log(np.abs(ratio[keep]))
    limits = [
        (float(logs.min()) - 0.1, float(logs.max()) + 0.1),
        (-most, most),
    ]
    values = np.stack([logs, angle[keep]], axis=1)
    votes, (x, y) = _vote(values, weights[keep].astype(float), limits, (0.01, 0.01), 2.0)
    found = []
    for _ in range(count):
        i, j = np.unravel_index(votes.argmax(), votes.shape)
        found.append(complex(np.exp(x[i] + 1j * y[j])))
        votes[max(0, i - 6) : i + 7, max(0, j - 6) : j + 7] = 0
    return found


def _shifted(plane: Array, similarity: complex, candidates: Candidates) -> list[Array]:
    """Positions of the marks for the shifts supported by most pairs of mark and candidate."""
    turned = similarity * _complex(plane)
    offset = (_complex(candidates.xy)[:, None] - turned).ravel()
    pitch = abs(similarity) * spacing(plane)
    values = np.stack([offset.real, offset.imag], axis=1)
    limits = [
        (float(low), float(high)) for low, high in zip(values.min(axis=0), values.max(axis=0), strict=True)
    ]
    votes, (x, y) = _vote(values, np.ones(len(values)), limits, pitch / 6, 1.2)
    starts = []
    for _ in range(5):
        i, j = np.unravel_index(votes.argmax(), votes.shape)
        moved = turned + complex(x[i], y[j])
        starts.append(np.stack([moved.real, moved.imag], axis=1))
        votes[max(0, i - 4) : i + 5, max(0, j - 4) : j + 5] = 0
    return starts


_BETTER = 0.05
"""Share of all marks that another position must find in addition to contradict the nominal positions."""
_TRIAL_PX = (3.0, 4.5, 6.5, 10.0, 15.0, 22.0)
"""Sizes of a mark in the image that are tried if the size is unknown."""


@dataclass(frozen=True)
class PlacingOptions:
    """What is known about a design in a frame.

    Parameters
    ----------
    nominal : ndarray (n, 2), optional
        Approximate positions in pixels.
    within_px : float, optional
        Uncertainty of the approximate positions, if known.
    mark_px : float, optional
        Size of a mark in the image.
    psf_px : float
        Width of the point-spread function.
    grid : GridOptions
        What is known about the grid, used without approximate positions.
    """

    nominal: Array | None
    within_px: float | None
    mark_px: float | None
    psf_px: float
    grid: GridOptions


@dataclass(frozen=True, eq=False)
class Placement:
    """Position of a design in a frame.

    Parameters
    ----------
    screened : Screened
        The screened frame.
    assignment : Assignment
        Marks with their candidates and the field through them.
    candidates : Candidates
        Places that look like a mark.
    mark_px : float
        Approximate size of a mark in the image; the width of the line for a line grid.
    notes : tuple of Remark
        Notes for the user.
    """

    screened: Screened
    assignment: Assignment
    candidates: Candidates
    mark_px: float
    notes: tuple[Remark, ...] = ()

    @property
    def support(self) -> float:
        """See :meth:`Assignment.support`."""
        return self.assignment.support(self.candidates.t)

    @property
    def strength(self) -> float:
        """Score of the assignment, and strength of its marks."""
        has = self.assignment.candidate[self.assignment.candidate >= 0]
        return self.assignment.score + float(np.log1p(self.candidates.t[has]).sum())


def place(frame: Frame, design: ReseauDesign, source: Array, options: PlacingOptions) -> Placement | Failure:
    """Find the design in the frame; tries several mark sizes and keeps the best.

    Parameters
    ----------
    frame : Frame
        The frame.
    design : ReseauDesign
        The design, for the shape of its marks.
    source : ndarray (n, 2)
        Plane coordinates of the marks.
    options : PlacingOptions
        What is known about it.

    Returns
    -------
    Placement or Failure
        A failure if the design is not found.

    Raises
    ------
    ImageError
        When the frame is all black, saturated, or of one grey.
    """
    best = _placed(frame, design, source, options)
    if options.nominal is not None and options.within_px is None:
        best = _despite_nominal(best, source, options)
    marks = 0 if best is None else int((best.assignment.candidate >= 0).sum())
    least = max(4, min(10, len(source) // 3))
    if best is None or marks < least or best.assignment.score < -0.1 * len(source):
        return Failure(
            f"design {design.name!r} was not found in the frame of "
            f"{frame.width}×{frame.height} px ({marks} of {len(source)} marks agree with it)",
            Code.NOT_FOUND,
            where=frame.name,
            places=np.empty((0, 2)) if best is None else best.candidates.xy[: 3 * len(source)],
        )
    return best


def _placed(frame: Frame, design: ReseauDesign, source: Array, options: PlacingOptions) -> Placement | None:
    """The best position over all sizes and rotations of a mark."""
    mark = design.mark
    size = mark.line_width if mark.shape == "line-grid" else mark.size
    best: Placement | None = None
    sizes = _sizes(source, size, options)
    strengths: list[tuple[float, float]] = []
    for turn in _turns(design, options):
        if turn:
            # A mark that is not upright still looks most like one of its own size.
            sizes = tuple(size for _, size in sorted(strengths, reverse=True)[:2])
        for mark_px in sizes:
            screened = screen(frame, run=max(15, round(4 * mark_px)))
            template = _template(
                design, mark_px, options.psf_px, _axes(design, source, options.nominal, turn)
            )
            if len(template) > min(frame.pixels.shape):
                continue
            candidates = find_candidates(screened.grey, screened.valid, template)
            if not turn:
                strengths.append((float(candidates.t[: len(source)].sum()), mark_px))
            found = _lay(source, size, candidates, screened, mark_px, options)
            if found is None:
                continue
            placed = Placement(screened, found, candidates, mark_px)
            if best is None or placed.strength > best.strength:
                best = placed
            # All marks found, at the size of the design: no other size can be better.
            if size is not None and found.score >= len(source) - 1 and placed.support > _NEARLY * len(source):
                return placed
        if best is not None and best.support > _NEARLY * len(source):
            break
    return best


def _turns(design: ReseauDesign, options: PlacingOptions) -> tuple[float, ...]:
    """Rotations of a mark (rad) that are tried; marks look the same after a quarter of a turn."""
    most = options.grid.rotations()[-1]
    if options.nominal is not None or most <= _UPRIGHT or design.mark.shape in ("disk", "rod"):
        return (0.0,)
    return (0.0, np.pi / 8, -np.pi / 8, np.pi / 4)


def _despite_nominal(best: Placement | None, source: Array, options: PlacingOptions) -> Placement | None:
    """The position found from nominal positions, or a much better one that contradicts them."""
    assert options.nominal is not None
    n = len(source)
    if best is None:
        return None
    better = climbed(best.assignment, source, best.candidates, best.screened.valid)
    if better.score >= best.assignment.score + _BETTER * n:
        best = replace(best, assignment=better)
    off = np.hypot(*np.median(best.assignment.predicted - options.nominal, axis=0))
    if off < 0.5 * spacing(options.nominal):
        return best
    text = (
        f"the nominal positions are wrong by about {off:.0f} px, more than half the distance of the marks: "
        "the names of the marks may be wrong by a row or a column"
    )
    return replace(best, notes=(Remark(text, Code.DEVIATES),))


def _sizes(source: Array, size: float | None, options: PlacingOptions) -> tuple[float, ...]:
    if options.mark_px is not None:
        return (options.mark_px,)
    if options.nominal is not None and size is not None:
        return (max(1.5, size * spacing(options.nominal) / spacing(source)),)
    return _TRIAL_PX


def _axes(design: ReseauDesign, source: Array, nominal: Array | None, turn: float) -> Array:
    """Linear mapping (2, 2) of unit determinant from a mark to its image, by nominal positions if known."""
    if nominal is None:
        c, s = np.cos(turn), np.sin(turn)
        return np.array([[c, -s], [s, c]])
    from_mean = source - source.mean(axis=0)
    linear = np.linalg.lstsq(from_mean, nominal - nominal.mean(axis=0), rcond=None)[0].T
    if design.mark.shape == "line-grid":
        linear = linear @ grid_wires(source).directions.mean(axis=0)
    size = abs(float(np.linalg.det(linear)))
    return np.asarray(linear / np.sqrt(size)) if size > 1e-12 else np.eye(2)


def _template(design: ReseauDesign, mark_px: float, psf_px: float, axes: Array) -> Array:
    """Formed image of a mark of this size, turned and sheared by `axes`."""
    mark, width = design.mark, mark_px
    if mark.shape == "cross" and mark.size and mark.line_width:
        width = mark_px * mark.line_width / mark.size
    half = int(np.ceil((1.5 * mark_px + 2 if mark.shape == "line-grid" else mark_px / 2) + 4))
    pixels = np.arange(-half, half + 1.0)
    outline = mark_outline(mark.shape, mark_px, width, 0.5 * psf_px, 2.0 * half)
    share = coverage(outline.affine(axes).oriented(), pixels, pixels, psf_px)
    return -share if design.polarity == "dark" else share


def _lay(
    source: Array,
    size: float | None,
    candidates: Candidates,
    screened: Screened,
    mark_px: float,
    options: PlacingOptions,
) -> Assignment | None:
    if options.nominal is not None:
        return assign(source, options.nominal, candidates, screened.valid, within_px=options.within_px)
    found = place_grid(source, candidates, screened.valid, options.grid)
    if found is None or size is None or options.mark_px is not None:
        return found
    # A pattern of the scene may fit the grid, but not with marks of another size than the design's.
    ratio = size * spacing(found.predicted) / spacing(source) / mark_px
    return found if 0.5 < ratio < 2.0 else None
