"""Find a design among candidates without approximate positions, and correct its place by steps of its grid.

Pairs of neighbours vote for scale, rotation and handedness, pairs of candidate and mark for the shift. From
there, candidates are assigned as from approximate positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask
from ...optics.field import SmoothField, monomials, trend_degree
from .assignment import Assignment, assign, in_sight, nearest_candidates, spacing, voted
from .candidates import Candidates

_NEIGHBOURS = 6
UPRIGHT = np.deg2rad(12.0)
"""Rotation up to which a design counts as upright in the image."""
_AS_STRONG = 0.6
"""Strength of a mark relative to the strongest ones, at least, where marks are equally distinct."""
_TRIED = 8
"""Number of start positions without prior knowledge that are followed."""
NEARLY = 0.75
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
        return (most,) if most <= UPRIGHT else (UPRIGHT, most)


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
                if found.score > NEARLY * len(source):
                    found = climbed(found, source, strong, valid)
                if best is None or _is_better(
                    found, best, source, uneven, found.support(strong.t) > best.support(strong.t) + 0.75
                ):
                    best = found
                # If no grid step improves it and nearly all marks support it, no other hypothesis is better.
                if found.support(strong.t) > NEARLY * len(source):
                    break
        if best is not None and best.support(strong.t) > NEARLY * len(source):
            break
    return best if best is None or best.missed == 0 else climbed(best, source, strong, valid)


def _supported(starts: list[Array], candidates: Candidates, usual: float, count: int) -> list[Array]:
    """The start positions near which most marks have a candidate that is as strong as marks usually are."""
    tree, likeness = scipy.spatial.KDTree(candidates.xy), np.minimum(candidates.t / usual, 1.0)
    support = []
    for start in starts:
        distance, row = tree.query(start)
        support.append(float(likeness[row[distance < 0.25 * spacing(start)]].sum()))
    return [starts[k] for k in np.argsort(-np.array(support, dtype=float), kind="stable")[:count]]


def climbed(found: Assignment, source: Array, candidates: Candidates, valid: Mask) -> Assignment:
    """Move the design by steps of its grid as long as that assigns more marks, each by its likeness.

    A regular design that is shifted by one pitch finds a candidate for all marks except those of one row;
    where the wires of a grid end at the edge of a bright screen, it finds weak ones there.
    Beyond the marks found so far a polynomial does not follow perspective; a projective mapping does. The
    places of an uneven design tell which of two positions is right where a row at the border is not seen.
    """
    steps, uneven = grid_steps(source), _unevenness(source)
    for _ in range(len(source)):
        found, plane = settled(found, source, candidates, valid)
        moved = [assign(source, found.field(source + step), candidates, valid, shifts=1) for step in steps]
        if plane is not None:
            moved += [
                _projected(source, _on_plane(plane, source + step), candidates, valid) for step in steps
            ]
        support = found.support(candidates.t)
        better = [
            m
            for m in moved
            if m is not None and _is_better(m, found, source, uneven, m.support(candidates.t) > support)
        ]
        if not better:
            break
        found = max(better, key=lambda m: m.support(candidates.t))
    return found


def settled(
    found: Assignment, source: Array, candidates: Candidates, valid: Mask
) -> tuple[Assignment, Array | None]:
    """The same position of the design, with the marks that a projective mapping predicts in addition.

    Returns
    -------
    found : Assignment
        The assignment.
    plane : ndarray (3, 3) or None
        The projective mapping of the design to its marks; None where they do not determine one.
    """
    plane = _homography(source, found.at)
    for _ in range(len(source)):
        again = None if plane is None else _projected(source, _on_plane(plane, source), candidates, valid)
        if again is None or again.score <= found.score:
            break
        found, plane = again, _homography(source, again.at)
    return found, plane


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
    tree, pitch, found = scipy.spatial.KDTree(source), spacing(source), [0.0]
    for step in grid_steps(source):
        distance, row = tree.query(source + step)
        neighbour = np.where((distance < 0.3 * pitch)[:, None], source[row], np.nan)
        if np.isfinite(neighbour).all(axis=1).sum() >= _FEWEST_PROJECTED:
            found.append(_scatter(source, neighbour))
    return min((s for s in found if s > 0), default=0.0)


def _projected(source: Array, start: Array, candidates: Candidates, valid: Mask) -> Assignment | None:
    """Assign candidates to marks of a plane in perspective, starting from approximate positions."""
    tree, pitch, predicted = scipy.spatial.KDTree(candidates.xy), spacing(start), start
    every = np.ones(len(source), dtype=bool)
    for _ in range(_PROJECTED):
        rows = nearest_candidates(tree, candidates, predicted, 0.2 * pitch, every)
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
    offset = (
        source[scipy.spatial.KDTree(source).query(source, k=min(5, len(source)))[1][:, 1:]] - source[:, None]
    )
    grain = np.hypot(*np.moveaxis(offset, -1, 0)).min() / 4
    steps, count = np.unique(np.round(offset.reshape(-1, 2) / grain), axis=0, return_counts=True)
    return np.asarray(steps[count > 0.2 * len(source)] * grain)


def _strongest(candidates: Candidates, count: int) -> Candidates:
    return replace(candidates, xy=candidates.xy[:count], t=candidates.t[:count])


def _starts(plane: Array, voters: Candidates, most: float, count: int) -> Iterator[Array]:
    """Start positions of the marks at rotations up to `most`, the likeliest first."""
    for similarity in _similarities(plane, voters, most, count if most <= UPRIGHT else 2 * count):
        yield from _shifted(plane, similarity, voters)


def _complex(xy: Array) -> NDArray[np.complex128]:
    return xy[:, 0] + 1j * xy[:, 1]


def _similarities(plane: Array, candidates: Candidates, most: float, count: int) -> list[complex]:
    """Scales and rotations, as complex factors, that map design neighbours to neighbouring candidates."""

    def steps(xy: Array, count: int) -> NDArray[np.complex128]:
        z = _complex(xy)
        row = scipy.spatial.KDTree(xy).query(xy, k=min(count + 1, len(xy)))[1]
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
    votes, (x, y) = voted(values, weights[keep].astype(float), limits, (0.01, 0.01), 2.0)
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
    votes, (x, y) = voted(values, np.ones(len(values)), limits, pitch / 6, 1.2)
    starts = []
    for _ in range(5):
        i, j = np.unravel_index(votes.argmax(), votes.shape)
        moved = turned + complex(x[i], y[j])
        starts.append(np.stack([moved.real, moved.imag], axis=1))
        votes[max(0, i - 4) : i + 5, max(0, j - 4) : j + 5] = 0
    return starts
