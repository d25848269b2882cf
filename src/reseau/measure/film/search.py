"""Search for frames in an overview of a scan: four straight edges of one polarity with known proportions.

Gradients of a small overview vote for directed lines (Hough 1962; Ballard 1981). Each edge of a frame on dark
film has its normal inwards, on bright film outwards; therefore the four edges in turn differ in direction
from two lines of the picture and from the edges of a neighbouring frame. Combinations are selected by their
proportions, and tested by what lies on both sides of the edges: unexposed film of uniform tone outside,
picture inside. Finally each edge is moved to the end of the unexposed film.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array
from .border import best_line, likelihood, row_median

Plane = NDArray[np.float32]

_OUTWARD_MM = 0.8
"""Distance beyond a detected line within which the edge is searched; perforations are hardly closer."""
_OUTSIDE, _INSIDE = (-3.5, -2.5, -1.5), (2.0, 3.0)
"""Distances inwards, in pixels of the overview, at which film and picture are sampled."""
_GAP_MM = 0.15
"""Minimum width of film that separates the frame from other structures."""
_ALONG = np.linspace(-0.92, 0.92, 80)
"""Positions along an edge at which its surroundings are sampled, −1 to 1."""


@dataclass(frozen=True, eq=False)
class FrameGuess:
    """A candidate for a frame in the overview.

    Parameters
    ----------
    corners : ndarray (4, 2)
        Corners ul, ur, lr, ll in pixels of the overview.
    polarity : int
        1 if the film around is darker than the picture, −1 if it is brighter.
    format_mm : (float, float)
        Width and height of the format as it lies in the scan.
    supported : tuple of bool
        Which edges were detected: upper, right, lower, left. A missing one follows from the format.
    score : float
        Amount of outline that separates unexposed film from picture, minus contradictions, 0 to 4.
    """

    corners: Array
    polarity: int
    format_mm: tuple[float, float]
    supported: tuple[bool, bool, bool, bool]
    score: float


def _judged(guess: FrameGuess, grey: Plane) -> FrameGuess | None:
    """The guess with its score from both sides of its edges; None if it is no frame."""
    outside, inside = _sides(guess, grey)
    known, seen = np.isfinite(outside) & np.isfinite(inside), np.array(guess.supported)
    if (known.mean(axis=1)[seen] < 0.5).any() or (seen.all() and not _within(guess.corners, grey.shape)):
        return None
    level, spread, strong = _film(guess, outside[seen], inside[seen])
    if strong <= 0:
        return None
    own = np.median(np.where(known, outside, level), axis=1)
    contrast = guess.polarity * (inside - own[:, None])
    least = max(4 * spread, 0.08 * strong)
    film = np.abs(outside - own[:, None]) < max(least, 0.15 * strong)
    step, against = (film & (contrast > least)).mean(axis=1), (~film & known).mean(axis=1)
    # A rectangle within the picture is surrounded by different tones on its sides.
    excess = guess.polarity * (own - level) / strong
    if (excess[seen] > 0.6).any() or (step[seen] < 0.12).any() or (against[seen] > 0.5).any():
        return None
    total = float((step - against - np.clip(2 * excess - 0.1, 0, 1))[seen].sum())
    if total < 0.4 * seen.sum():
        return None
    return FrameGuess(guess.corners, guess.polarity, guess.format_mm, guess.supported, total)


def _within(corners: Array, shape: tuple[int, ...]) -> bool:
    return bool((corners > -1).all() and (corners < np.array(shape[::-1])).all())


def _film(guess: FrameGuess, outside: Array, inside: Array) -> tuple[float, float, float]:
    """Tone of unexposed film, its scatter, and the contrast of a bright picture against it."""
    own = row_median(outside)
    # Film is darker than any picture (polarity 1); the second darkest of the edges is robust.
    level = float(guess.polarity * np.sort(guess.polarity * own)[min(1, len(own) - 1)])
    spread = float(row_median(np.abs(outside - own[:, None]).reshape(1, -1))[0])
    strong = float(np.nanquantile(guess.polarity * (inside - level), 0.8))
    return level, spread, strong


def _settled(guess: FrameGuess, grey: Plane) -> FrameGuess:
    """Move each edge to where unexposed film ends; the lines that got votes may lie within the picture."""
    scale = float(np.mean(size_of(guess.corners) / guess.format_mm))
    seen = np.array(guess.supported)
    outside, inside = _sides(guess, grey)
    level, spread, strong = _film(guess, outside[seen], inside[seen])
    out, reach = int(np.clip(_OUTWARD_MM * scale, 4, 20)), 6
    offsets = np.arange(-out - 2, 3 * reach + 1)
    profiles = np.stack([_beside(guess.corners, grey, (float(o),)) for o in offsets], axis=2)
    known = np.isfinite(profiles)
    least = max(4 * spread, 0.08 * strong)
    ends = np.zeros((4, 2))
    for k in np.flatnonzero(seen):
        near = _running(outside[k], level)
        # Nothing is known beyond the border of the scan, where film may be brighter than at other edges.
        beyond = np.nanmean(np.where(known[k], profiles[k], np.nan)[:, : out // 2], axis=1)
        far = _running(np.where(np.isfinite(beyond), beyond, near), level)
        # If tones beyond the detected line differ from film, search for film further outside.
        further = guess.polarity * (np.median(far) - np.median(near)) / strong
        raised = guess.polarity * (np.median(near) - level) > 0.1 * strong
        film = (far if raised and further < 0 else near)[:, None]
        # Where film is a narrow strip, blurred with other structures, a single place must be sufficient.
        narrow = further > 0.1
        gap = 1 if narrow else max(2, round(_GAP_MM * scale))
        significant = max(least, 0.4 * further * strong) if narrow else least
        departure = guess.polarity * (np.where(known[k], profiles[k], film) - film) / significant
        found = likelihood(departure, known[k], out + 2, gap)
        start, stop = best_line(found, _ALONG, 2, len(offsets) - 2 * reach, 4)
        ends[k] = offsets[0] - 0.5 + np.array([start, stop])
    return FrameGuess(
        moved(guess.corners, ends), guess.polarity, guess.format_mm, guess.supported, guess.score
    )


def _running(values: Array, level: float) -> Array:
    """Running median of values (n,) along an edge, because the scanner's light may be uneven."""
    filled = np.where(np.isfinite(values), values, level)
    return np.asarray(scipy.ndimage.median_filter(filled, size=31, mode="nearest"))


def frame_axes(corners: Array) -> tuple[Array, Array, Array]:
    """Start and end of the edges of a frame and their inward normals, each (4, 2)."""
    following = corners[[1, 2, 3, 0]]
    along = (following - corners) / np.hypot(*(following - corners).T)[:, None]
    return corners, following, np.stack([-along[:, 1], along[:, 0]], axis=1)


def moved(corners: Array, ends: Array) -> Array:
    """Corners of a frame whose edges are moved inwards by `ends` (4, 2) at their start and end."""
    a, b, normal = frame_axes(corners)
    (ax, ay), (bx, by) = (a + ends[:, :1] * normal).T, (b + ends[:, 1:] * normal).T
    x, y, z = line = np.stack([ay - by, bx - ax, ax * by - ay * bx])
    u, v, w = line[:, [3, 0, 1, 2]]
    return np.asarray(np.stack([v * z - w * y, w * x - u * z], axis=1) / (u * y - v * x)[:, None])


def _sides(guess: FrameGuess, grey: Plane) -> tuple[Array, Array]:
    """Grey values (4, 80) along the edges: outside, where they are most similar to film, and inside."""
    outside = [guess.polarity * _beside(guess.corners, grey, (offset,)) for offset in _OUTSIDE]
    return guess.polarity * np.fmin.reduce(outside), _beside(guess.corners, grey, _INSIDE)


def _beside(corners: Array, grey: Plane, offsets: Sequence[float]) -> Array:
    """Mean grey values (4, 80) along the edges at given distances inwards; NaN outside the overview."""
    t = (_ALONG + 1) / 2
    a, b, normal = frame_axes(corners)
    at = a[:, None] + t[:, None] * (b - a)[:, None]
    total = np.zeros(at.shape[:2])
    for offset in offsets:
        xy = (at + offset * normal[:, None]).astype(np.float32)
        # No values beyond the border of the scan.
        total += cv2.remap(
            grey, xy[..., 0], xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
        )
    return total / len(offsets)


def size_of(corners: Array) -> Array:
    """Width and height of a frame, as means of opposite sides."""
    ul, ur, lr, ll = corners
    return np.array([np.hypot(*(ur + lr - ul - ll)), np.hypot(*(ll + lr - ul - ur))]) / 2


_BIN = np.deg2rad(0.5)
"""Step of the directions; the step of the distances is one pixel of the overview."""
_SPREAD = 16
"""A gradient votes for this many directions on either side of its own; texture at an edge rotates it."""
_PEAKS, _OF_STRIP = 8, 24
"""Maximum number of lines of each direction that are combined with others; and of a strip of frames of which
size and direction are known."""
_LEAST_SIDE = 0.2
"""Minimum side of a frame, relative to the shorter side of the overview."""


class _Lines(NamedTuple):
    """Peaks of the votes for one direction: distances from the centre, and votes."""

    at: Array
    votes: Array


def search_frames(
    overview: NDArray[np.float32],
    formats: Sequence[tuple[float, float]],
    *,
    max_tilt_deg: float = 16.0,
    tolerance: float = 0.05,
    px_per_mm: float | None = None,
    hint: float | None = None,
    tried: int = 60,
    near: Array | None = None,
    missing: bool = False,
    along: float | None = None,
) -> list[FrameGuess]:
    """Find frames in an overview; the best first, without overlap.

    Parameters
    ----------
    overview : ndarray (h, w, c)
        The scan, reduced to some hundred pixels on its longer side.
    formats : sequence of (width, height)
        Possible formats in mm, each tried in both orientations.
    max_tilt_deg : float
        Largest tilt.
    tolerance : float
        Largest relative deviation of a frame's proportions from its format.
    px_per_mm : float, optional
        Pixels of the overview per millimetre, if the resolution is known.
    hint : float, optional
        The same according to the file, which may be wrong; used for frames with a missing edge.
    tried : int
        Number of combinations of lines of each format whose surroundings are tested.
    near : ndarray (4, 2), optional
        Approximate corners, accurate to one tenth of the frame's size; no other frames are searched.
    missing : bool
        Whether to search frames of which one edge was not detected.
    along : float, optional
        Direction of the upper edges of a strip of frames, radians; many of them are expected.
    """
    grey, gradient = _gradients(overview)
    votes, reach = _votes(*gradient, grey.shape, max_tilt_deg)
    shapes = list(dict.fromkeys([f for w, h in formats for f in ((w, h), (h, w))]))
    scale = (px_per_mm or hint) if missing else px_per_mm
    turns, peaks = _turns(max_tilt_deg), _PEAKS
    if along is not None:
        turns, peaks = range(round(along / _BIN) - 2, round(along / _BIN) + 3), _OF_STRIP
    found = [
        guess
        for turn in turns
        for guess in _combined(votes, reach, turn, shapes, tolerance, scale, grey.shape, missing, peaks)
    ]
    if near is not None:
        most = 0.1 * float(size_of(near).max())
        found = [guess for guess in found if np.abs(guess.corners - near).max() < most]
    found.sort(key=lambda guess: -guess.score)
    # The lines of any picture form frames of one format or another, which must not displace each other.
    of_format: dict[tuple[float, ...], list[FrameGuess]] = {}
    for guess in found:
        of_format.setdefault(tuple(sorted(guess.format_mm)), []).append(guess)
    tested = [guess for alike in of_format.values() for guess in _distinct(alike, tried)]
    with warnings.catch_warnings():  # an edge outside the scan has no tones; it is excluded later
        warnings.simplefilter("ignore", RuntimeWarning)
        scored = [_judged(guess, grey) for guess in tested]
        good = sorted((g for g in scored if g is not None), key=lambda g: _far(g, near) - g.score)
        return [_settled(guess, grey) for guess in _apart(good, along is not None)]


def _far(guess: FrameGuess, near: Array | None) -> float:
    """Penalty for the distance from the given corners, at most one edge."""
    if near is None:
        return 0.0
    return float(np.abs(guess.corners - near).max() / (0.1 * size_of(near).max()))


def _gradients(overview: NDArray[np.float32]) -> tuple[Plane, tuple[Array, Array, Array, Array]]:
    """Grey values of the channel with most contrast, and its gradients: x, y, direction, weight."""
    spread = np.ptp(np.quantile(overview, [0.02, 0.98], axis=(0, 1)), axis=0)
    best = int(np.argmax(spread))
    grey = np.ascontiguousarray(overview[:, :, best])
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    gx, gy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) / 8 for order in ((1, 0), (0, 1)))
    size = np.hypot(gx, gy)
    noise = float(np.quantile(size, 0.25))
    least = max(2.0 * noise, 0.004 * float(spread[best]), 1e-6)
    size[[0, 1, -2, -1]] = 0
    size[:, [0, 1, -2, -1]] = 0
    row, column = np.nonzero(size > least)
    s = size[row, column].astype(np.float64)
    # A faint edge gets nearly the same weight as strong gradients of the picture.
    weight = s / (s + 2 * least)
    direction = np.arctan2(gy[row, column], gx[row, column]).astype(np.float64)
    return grey, (column.astype(np.float64), row.astype(np.float64), direction, weight)


def _turns(max_tilt_deg: float) -> range:
    most = int(np.ceil(np.deg2rad(max_tilt_deg) / _BIN))
    return range(-most, most + 1)


def _votes(
    x: Array, y: Array, direction: Array, weight: Array, shape: tuple[int, int], max_tilt_deg: float
) -> tuple[Plane, int]:
    """Votes (directions, distances); distances are from the centre along the direction; index of zero."""
    reach = int(np.hypot(*shape) / 2) + 3
    turns, width = round(2 * np.pi / _BIN), 2 * reach + 1
    own = np.rint(direction / _BIN).astype(np.intp)
    quarter = turns // 4
    near = np.abs((own + quarter // 2) % quarter - quarter // 2) <= len(_turns(max_tilt_deg)) // 2 + _SPREAD
    own, weight = own[near], weight[near]
    x, y = x[near] - (shape[1] - 1) / 2, y[near] - (shape[0] - 1) / 2
    cosine, sine = np.cos(np.arange(turns) * _BIN), np.sin(np.arange(turns) * _BIN)
    total = np.zeros(turns * width)
    for step in range(-_SPREAD, _SPREAD + 1, 2):
        k = (own + step) % turns
        rho = np.rint(x * cosine[k] + y * sine[k]).astype(np.intp) + reach
        part = weight * np.exp(-0.5 * (step / (0.6 * _SPREAD)) ** 2)
        total += np.bincount(k * width + rho, part, minlength=total.size)
    votes = total.reshape(turns, width).astype(np.float32)
    votes = np.asarray(votes + np.roll(votes, 1, 0) + np.roll(votes, -1, 0), dtype=np.float32)
    return np.asarray(cv2.GaussianBlur(votes, (5, 1), 1.0), dtype=np.float32), reach


def _lines(votes: Plane, reach: int, direction: int, sign: float, peaks: int) -> _Lines:
    """Strongest lines of a direction; distances along `sign` times the direction."""
    row = votes[direction % len(votes)]
    peak = row >= cv2.dilate(row[None], np.ones((1, 7), np.uint8))[0]
    at = np.flatnonzero(peak & (row > 0))
    at = at[np.argsort(-row[at], kind="stable")[:peaks]]
    return _Lines((sign * (at - reach)).astype(np.float64), row[at].astype(np.float64))


def _combined(
    votes: Plane,
    reach: int,
    turn: int,
    shapes: Sequence[tuple[float, float]],
    tolerance: float,
    px_per_mm: float | None,
    shape: tuple[int, int],
    missing: bool,
    peaks: int,
) -> Iterator[FrameGuess]:
    """Rectangles of one direction; with `missing`, those with one edge that was not detected."""
    quarter = len(votes) // 4
    for polarity in (1, -1):
        base = turn if polarity > 0 else turn + 2 * quarter
        # Normals point from dark to bright; distances are along the axes of the frame.
        signs = (polarity, -polarity, -polarity, polarity)
        upper, right, lower, left = (
            _lines(votes, reach, base + quarter * k, float(sign), peaks)
            for k, sign in zip((1, 2, 3, 0), signs, strict=True)
        )
        for w, h in shapes:
            across, a_seen = _pairs(left, right, missing)
            down, d_seen = _pairs(upper, lower, missing)
            size_x, size_y = across[:, 1] - across[:, 0], down[:, 1] - down[:, 0]
            aspect = (size_x[:, None] * h) / np.where(size_y != 0, size_y * w, 1.0)
            whole = np.outer(a_seen.all(axis=1), d_seen.all(axis=1))
            good = (np.abs(np.log(np.maximum(aspect, 1e-9))) < tolerance) & whole
            good &= (size_x[:, None] > _LEAST_SIDE * min(shape)) & (size_y > _LEAST_SIDE * min(shape))
            if missing:
                yield from _completed(
                    across, down, a_seen, d_seen, (w, h), turn, polarity, shape, px_per_mm, peaks
                )
                continue
            if px_per_mm is not None:
                good &= np.abs(np.log(np.maximum(size_x, 1e-9)[:, None] / (w * px_per_mm))) < 2 * tolerance
            i, j = np.nonzero(good)
            # Votes of an edge relative to its length; neighbouring frames in line do not increase the score.
            share = np.minimum(across[i, 2:] / size_y[j, None], 1.5).sum(axis=1)
            share += np.minimum(down[j, 2:] / size_x[i, None], 1.5).sum(axis=1)
            for n in np.argsort(-share, kind="stable")[: 5 * peaks]:
                box = (across[i[n], 0], down[j[n], 0], across[i[n], 1], down[j[n], 1])
                corners = _rectangle(box, turn * _BIN, shape)
                yield FrameGuess(corners, polarity, (w, h), (True,) * 4, float(share[n]))


def _pairs(first: _Lines, second: _Lines, missing: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Pairs of opposite lines (k, 4): distances and votes; which exist. With `missing`, also single lines."""
    i, j = (part.ravel() for part in np.meshgrid(np.arange(len(first.at)), np.arange(len(second.at))))
    both = np.stack([first.at[i], second.at[j], first.votes[i], second.votes[j]], axis=1)
    seen = np.ones((len(both), 2), dtype=bool)
    if missing:
        for lines, place in ((first, 0), (second, 1)):
            one = np.full((len(lines.at), 4), np.nan)
            one[:, place], one[:, 2 + place], one[:, 3 - place] = lines.at, lines.votes, 0.0
            both = np.concatenate([both, one])
            alone = np.zeros((len(one), 2), dtype=bool)
            alone[:, place] = True
            seen = np.concatenate([seen, alone])
    return both, seen


def _completed(
    across: Array,
    down: Array,
    a_seen: NDArray[np.bool_],
    d_seen: NDArray[np.bool_],
    size: tuple[float, float],
    turn: int,
    polarity: int,
    shape: tuple[int, int],
    px_per_mm: float | None,
    peaks: int,
) -> Iterator[FrameGuess]:
    """Rectangles from three lines and the format."""
    for lying in (True, False):
        pairs, ones = (down, across) if lying else (across, down)
        p_seen, o_seen = (d_seen, a_seen) if lying else (a_seen, d_seen)
        pairs, ones, alone = pairs[p_seen.all(axis=1)], ones[~o_seen.all(axis=1)], o_seen[~o_seen.all(axis=1)]
        span = pairs[:, 1] - pairs[:, 0]
        ratio = size[0] / size[1] if lying else size[1] / size[0]
        length = np.maximum(span * ratio, 1.0)
        good = span > _LEAST_SIDE * min(shape)
        if px_per_mm is not None:
            good &= np.abs(np.log(np.maximum(span, 1) / (size[1 if lying else 0] * px_per_mm))) < 0.06
        i, j = np.nonzero(good[:, None] & np.ones(len(ones), dtype=bool))
        first = alone[j, 0]
        low = np.where(first, ones[j, 0], ones[j, 1] - length[i])
        # A missing edge inside the scan is accepted only if the scale is known.
        if px_per_mm is None and len(i):
            gone = np.where(first, low + length[i], low), pairs[i, :2].mean(axis=1)
            outside = ~_in_scan(gone if lying else gone[::-1], turn * _BIN, shape)
            i, j, first, low = i[outside], j[outside], first[outside], low[outside]
        # Votes relative to the length of the edges: a long line does not speak for a short edge.
        share = np.minimum(pairs[i, 2:] / length[i, None], 1.0).sum(axis=1)
        share += np.minimum(ones[j, 2:].max(axis=1) / np.maximum(span[i], 1), 1.0)
        for n in np.argsort(-share, kind="stable")[: 6 * peaks // _PEAKS]:
            p, high = pairs[i[n]], low[n] + length[i[n]]
            box = (low[n], p[0], high, p[1]) if lying else (p[0], low[n], p[1], high)
            missed = (1 if first[n] else 3) if lying else (2 if first[n] else 0)
            seen = tuple(k != missed for k in range(4))
            corners = _rectangle(box, turn * _BIN, shape)
            yield FrameGuess(corners, polarity, size, seen, float(share[n]))  # type: ignore[arg-type]


def _in_scan(at: tuple[Array, Array], angle: float, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which points, in axes rotated about the centre of the overview, lie within it."""
    x, y = at
    c, s = np.cos(angle), np.sin(angle)
    column, row = c * x - s * y + (shape[1] - 1) / 2, s * x + c * y + (shape[0] - 1) / 2
    return np.asarray((column > 0) & (column < shape[1] - 1) & (row > 0) & (row < shape[0] - 1))


def _rectangle(box: Sequence[float], angle: float, shape: tuple[int, int]) -> Array:
    """Corners of a box (x0, y0, x1, y1) in axes rotated about the centre of the overview."""
    x0, y0, x1, y1 = box
    at = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    c, s = np.cos(angle), np.sin(angle)
    centre = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    return np.asarray(at @ np.array([[c, s], [-s, c]]) + centre)


def _distinct(guesses: list[FrameGuess], most: int) -> list[FrameGuess]:
    """The best of each group of nearly identical guesses."""
    kept: list[FrameGuess] = []
    corners = np.zeros((0, 8))
    for guess in guesses:
        flat = guess.corners.ravel()
        if not len(corners) or np.abs(corners - flat).max(axis=1).min() > 2.5:
            kept.append(guess)
            corners = np.concatenate([corners, flat[None]])
        if len(kept) >= most:
            break
    return kept


def _apart(guesses: list[FrameGuess], together: bool) -> list[FrameGuess]:
    """The best guess, and similar ones that do not overlap with it: frames of one strip.

    Of a strip they are chosen `together`: a line of a picture makes a guess that displaces two frames.
    """
    if not guesses:
        return []
    best = guesses[0]
    size = size_of(best.corners)
    alike = [
        guess
        for guess in guesses
        if guess.polarity == best.polarity
        and all(guess.supported) == all(best.supported)
        and np.abs(size_of(guess.corners) / size - 1).max() < 0.04
    ]
    if together and len(alike) > 1:
        pairs = [
            (i, j)
            for j, guess in enumerate(alike)
            for i, other in enumerate(alike[:j])
            if overlap_of(guess.corners, other.corners) > 0.05
        ]
        apart = np.zeros((len(pairs), len(alike)))
        apart[np.repeat(np.arange(len(pairs)), 2), np.ravel(pairs).astype(np.intp)] = 1.0
        found = scipy.optimize.milp(
            [-guess.score for guess in alike],
            integrality=np.ones(len(alike)),
            bounds=scipy.optimize.Bounds(0, 1),
            constraints=scipy.optimize.LinearConstraint(apart, ub=1) if pairs else (),
        )
        return [guess for guess, taken in zip(alike, found.x, strict=True) if taken > 0.5]
    kept: list[FrameGuess] = []
    for guess in alike:
        if all(overlap_of(guess.corners, other.corners) < 0.05 for other in kept):
            kept.append(guess)
    return kept


def overlap_of(first: Array, second: Array) -> float:
    """Common area relative to that of the first."""
    common: Any = cv2.intersectConvexConvex(first.astype(np.float32), second.astype(np.float32))[0]
    return float(common) / float(np.prod(size_of(first)))
