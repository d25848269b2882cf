"""Assign candidates to the marks of a design, from approximate positions.

Votes determine a common shift. A polynomial from the design to the image then grows in degree, and outwards
from its reliable part, while the search radius decreases.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...optics.field import SmoothField, monomials, trend_degree
from .candidates import Candidates

# Widest search radius in the pitch; of common shifts that are closer than this, one is tried.
_REACH = 0.2


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
        return np.minimum(t[self.candidate[has]] / _usual(t, len(self.candidate)), 1.0)

    def support(self, t: Array) -> float:
        """The score with every mark weighted with its likeness."""
        return float(self.likeness(t).sum()) - 0.5 * self.missed


def _usual(t: Array, marks: int) -> float:
    """Strength that marks have, from the strengths (m,) of all candidates in descending order."""
    return float(np.median(t[: max(4, marks // 2)]))


def spacing(xy: Array) -> float:
    """Median distance of a point to its nearest neighbour."""
    return float(np.median(scipy.spatial.KDTree(xy).query(xy, k=2)[0][:, 1]))


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
        return _assigned(source, start, candidates, valid, pitch, min(within_px, _REACH * pitch))
    for shift in _common_shifts(start, candidates, pitch, shifts):
        found = _assigned(source, start + shift, candidates, valid, pitch, _REACH * pitch)
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
    tree, predicted, gate = scipy.spatial.KDTree(candidates.xy), start, widest
    field: SmoothField | None = None
    rows = np.full(len(start), -1)
    for step, most in enumerate((1, 1, 2, 3, 3, 5, 5, 5)):
        reached = far <= max(3.5 * pitch, np.quantile(far, min(1.0, 0.35 + 0.13 * step)))
        rows = nearest_candidates(tree, candidates, predicted, gate, reached)
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
    rows = nearest_candidates(tree, candidates, predicted, gate, np.ones(len(start), dtype=bool))
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
    # Strong places count more, up to the strength that marks have: along a wire there are many weak ones.
    most = max(15.0, _usual(candidates.t, len(start)))
    weight = np.broadcast_to(np.minimum(candidates.t, most), (len(start), len(candidates))).ravel()
    near = (np.abs(offset) < pitch).all(axis=1)
    votes, (x, y) = voted(offset[near], weight[near], [(-pitch, pitch)] * 2, max(1.0, pitch / 40), 2.0)
    # Of two shifts with similar support take the smaller: a grid agrees with itself at every pitch.
    votes *= 1 - 0.3 * np.hypot(x[:, None], y[None]) / (1.5 * pitch)
    most = votes.max()
    for _ in range(count):
        i, j = np.unravel_index(votes.argmax(), votes.shape)
        if not votes[i, j] > 0.5 * most:
            return
        yield np.array([x[i], y[j]])
        votes[np.hypot(x[:, None] - x[i], y[None] - y[j]) < _REACH * pitch] = 0


def voted(
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
    smooth: Array = scipy.ndimage.gaussian_filter(votes, blur, mode="constant", truncate=3.0)
    return smooth, (centres[0], centres[1])


def _densest(start: Array, candidates: Candidates, pitch: float) -> Array:
    """Position of a mark most of whose neighbours have a candidate at their predicted places."""
    has = scipy.spatial.KDTree(candidates.xy).query(start)[0] < 0.2 * pitch
    near = scipy.spatial.KDTree(start).query(start, k=min(9, len(start)))[1]
    score = has[near].sum(axis=1) - 1e-3 * np.hypot(*(start - start.mean(axis=0)).T) / pitch
    centre: Array = start[score.argmax()]
    return centre


def nearest_candidates(
    tree: scipy.spatial.KDTree, candidates: Candidates, predicted: Array, gate: float, reached: Mask
) -> Rows:
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
