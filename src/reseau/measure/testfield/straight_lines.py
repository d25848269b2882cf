"""Straight lines of a testfield: where ridge points support them, and how they are numbered."""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Mask, Rows

__all__ = ["distinct_lines", "numberings", "supported", "voted"]

_NONE = -(2**40)
"""No number."""
_CODES = np.indices((4, 4, 3, 3)).reshape(4, -1).T + 1
"""Distances to the next two lines, and the gaps between the numbers of the three."""


def voted(xy: Array, own: Rows, direction: Array, spread: int, reach: int) -> Array:
    """Votes of points for lines (angles, 2·reach + 1), linear between distances.

    Parameters
    ----------
    xy, own : ndarray (n, 2), ndarray of int (n,)
        Points, and the indices of the directions of their normals.
    direction : ndarray (a, 2)
        Normals of the lines.
    spread : int
        Points vote for so many directions to either side.
    reach : int
        Index of the distance 0.
    """
    turns, wide = len(direction), 2 * reach + 1
    count, share = np.zeros(turns * wide), np.zeros(turns * wide)
    x, y = np.ascontiguousarray(xy.T)
    for step in range(-spread, spread + 1):
        turn = (own + step) % turns
        place = x * direction[turn, 0] + y * direction[turn, 1] + reach
        low = place.astype(np.intp)  # never negative
        at = turn * wide + low
        count += np.bincount(at, minlength=len(count))
        share += np.bincount(at, place - low, len(count))
    votes = (count - share).reshape(turns, wide)
    votes[:, 1:] += share.reshape(turns, wide)[:, :-1]
    return votes


def _near(
    xy: Array, normal: Array, across: Array, distance: float, near: float, parallel: float
) -> tuple[Rows, Array]:
    """Rows of the ridge points along a line, and their distances from it."""
    off = xy @ across - distance
    rows = np.flatnonzero(np.abs(off) < near)
    rows = rows[np.abs(normal[rows] @ across) > parallel]
    return rows, off[rows]


def supported(
    xy: Array,
    normal: Array,
    across: Array,
    distance: Array,
    near: float,
    parallel: float,
    step: float,
    least: float,
) -> Array:
    """Part of each line on which ridge points are dense.

    A line is divided into steps. Those with enough points count 1, the others −1, and the part with the
    largest sum is taken (Bentley 1984): gaps within it are shorter than what is beyond them.

    Parameters
    ----------
    xy, normal : ndarray (n, 2)
        Ridge points and their normals.
    across, distance : ndarray (k, 2), (k,)
        Normals of the lines, and their distances from the origin.
    near : float
        Largest distance of a point from its line.
    parallel : float
        Least cosine of the angle between their normals.
    step : float
        Length of a step, pixels.
    least : float
        Number of points of a step from which it is supported.

    Returns
    -------
    ndarray (k, 2)
        Begin and end along (−y, x) of the normal; the end is before the begin where there is no such part.
    """
    reach = float(np.abs(xy).sum(axis=1).max(initial=0.0))
    count, ends = int(2 * reach / step) + 2, np.tile([0.0, -1.0], (len(across), 1))
    if not len(across):
        return ends
    dense = np.empty((len(across), count), bool)
    for k, turned in enumerate(across):
        rows, _ = _near(xy, normal, turned, distance[k], near, parallel)
        along = xy[rows] @ [-turned[1], turned[0]] + reach
        dense[k] = np.bincount((along / step).astype(np.intp), minlength=count) >= least
    total = np.zeros((len(across), count + 1), np.intp)
    np.cumsum(np.where(dense, 1, -1), axis=1, out=total[:, 1:])
    lowest = np.minimum.accumulate(total[:, :-1], axis=1)
    begin = np.maximum.accumulate(np.where(total[:, :-1] == lowest, np.arange(count), 0), axis=1)
    gain = total[:, 1:] - lowest
    last = gain.argmax(axis=1)
    some = np.flatnonzero(gain.max(axis=1) > 0)
    ends[some] = np.stack([begin[some, last[some]], last[some] + 1], axis=1) * step - reach
    return ends


def _line_through(
    xy: Array, normal: Array, across: Array, distance: float, near: tuple[float, float, int]
) -> tuple[Array, float, Array, Rows]:
    """A line adjusted to the ridge points along it: normal, distance, ends (2, 2), and rows of its points.

    `near` is as in :func:`distinct_lines`.
    """
    rows, off = _near(xy, normal, across, distance, *near[:2])
    along = np.array([-across[1], across[0]])
    if len(rows) < near[2]:
        return across, distance, np.tile(across * distance, (2, 1)), rows
    at = xy[rows] @ along
    middle = at.mean()
    t, weight = at - middle, 1 - (off / near[0]) ** 2
    first, total = weight @ t, max(weight.sum(), 1e-9)
    slope = (weight * t) @ off / max((weight * t) @ t, 1e-9)
    # off = level + slope (at − middle), as a normal of unit length.
    level, scale = weight @ off / total - slope * first / total, np.hypot(1.0, slope)
    end = np.sort(at)[np.rint(np.array([0.02, 0.98]) * (len(at) - 1)).astype(np.intp)]
    ends = end[:, None] * along + (distance + level + slope * (end - middle))[:, None] * across
    return (across - slope * along) / scale, (distance + level - slope * middle) / scale, ends, rows


def distinct_lines(
    xy: Array,
    normal: Array,
    across: Array,
    distance: Array,
    near: tuple[float, float, int],
    own: float,
    most: int,
) -> tuple[Rows, Array, Array, Array]:
    """Lines adjusted to the ridge points along them, without those that repeat a stronger one.

    A line is skipped that nearly coincides with one before it, or consists of points of such.

    Parameters
    ----------
    xy, normal : ndarray (n, 2)
        Ridge points and their normals.
    across, distance : ndarray (k, 2), (k,)
        Normals of the approximate lines, the strongest first, and their distances from the origin.
    near : tuple
        Largest distance of a point from its line, half that of different lines; least cosine of the angle
        between the normals; number of points from which a line is adjusted.
    own : float
        Minimum share of points of a line that are not those of a stronger one.
    most : int
        Most lines.

    Returns
    -------
    ndarray of int (m,), ndarray (m, 2), (m,), (m, 2, 2)
        Which of the lines are kept, their normals, distances and ends.
    """
    kept, normals, places, ends = list[int](), np.empty((most, 2)), np.empty(most), np.empty((most, 2, 2))
    free = np.ones(len(xy), bool)
    for k in range(len(across)):
        count = len(kept)
        if count == most:
            break
        turned, place, end, rows = _line_through(xy, normal, across[k], distance[k], near)
        off = np.abs(end @ normals[:count].T - places[:count]).max(axis=0)
        if free[rows].sum() < own * len(rows) or not (off > 2 * near[0]).all():
            continue
        normals[count], places[count], ends[count] = turned, place, end
        free[rows] = False
        kept.append(k)
    count = len(kept)
    return np.array(kept, np.intp), normals[:count], places[:count], ends[:count]


def numberings(
    at: Array,
    weight: Array,
    limits: tuple[float, float, float, int],
    most: tuple[int, int],
    alike: float,
    strongest: tuple[int, int],
) -> tuple[Mask, Rows, Array]:
    """Numberings of parallel lines as projective functions n = α t / (1 + β t) of their places t.

    Every function through three lines, with numbers 0, 1 to 3 and 1 to 3 more, is tried; lines that agree
    with it count with their weights, in relation to the gaps that it leaves. The three are near each other
    among all lines, or among the strongest: there may be many false ones between neighbouring lines.

    Parameters
    ----------
    at, weight : ndarray (n,)
        Places of the lines, ascending, and their weights; at least three.
    limits : tuple
        Largest deviation of a line from its number; least distance from the vanishing line; largest logarithm
        of the ratio of neighbouring gaps, per number; most numbers.
    most : (int, int)
        Most functions that are compared, the likeliest first, and most numberings.
    alike : float
        Share of lines with the same numbers from which two numberings are the same.
    strongest : (int, int)
        Numbers of the strongest lines among which the three are chosen, too.

    Returns
    -------
    ndarray of bool (m, n), ndarray of int (m, n), ndarray (m,)
        Lines that are numbered, their numbers, and the worth of each numbering, the likeliest first.
    """
    three, step, wide = _threes(at, weight, strongest)
    near, far = (at[three[:, k]] - at[three[:, 0]] for k in (1, 2))
    # step (1 + β near) = α near, wide (1 + β far) = α far.
    beta = (wide * near - step * far) / (near * far * (step - wide))
    alpha = step / near + step * beta
    # Gaps change slowly from one to the next in any perspective in which all can be seen.
    with np.errstate(invalid="ignore", divide="ignore"):
        slow = np.abs(np.log((far - near) / (wide - step) / (near / step))) < limits[2] * wide
    alpha, beta, first = alpha[slow, None], beta[slow, None], at[three[slow, :1]]
    numbers, worths = _counted(at, weight, first, alpha, beta, limits)
    order = np.argsort(-worths, kind="stable")
    order = order[worths[order] > -np.inf][: most[0]]
    kept = list[int]()
    stronger = (weight > weight[:, None]) | (
        (weight == weight[:, None]) & (np.arange(len(at)) < np.arange(len(at))[:, None])
    )
    for k in order:
        found = numbers[k]
        # Of two lines with one number the stronger one counts.
        found[((found == found[:, None]) & stronger).any(axis=1)] = _NONE
        if not _agree(found, numbers[kept], alike):
            kept.append(k)
            if len(kept) == most[1]:
                break
    chosen = numbers[kept]
    return chosen != _NONE, chosen, worths[kept]


def _threes(at: Array, weight: Array, strongest: tuple[int, int]) -> tuple[Rows, Array, Array]:
    """Rows (t, 3) of lines near each other, and numbers (t,) of the second and the third from the first."""
    n = len(at)
    by_weight = np.argsort(-weight, kind="stable")
    groups = [np.arange(n), *(np.sort(by_weight[:size]) for size in strongest if size < n)]
    rows, steps = list[Rows](), list[Rows]()
    for group in groups:
        first = np.repeat(np.arange(len(group)), len(_CODES))
        code = np.tile(_CODES, (len(group), 1))
        third = first + code[:, 0] + code[:, 1]
        there = third < len(group)
        rows.append(group[np.stack([first, first + code[:, 0], third], axis=1)[there]])
        steps.append(code[there, 2:])
    step, wide = np.cumsum(np.concatenate(steps), axis=1).T.astype(np.float64)
    return np.concatenate(rows), step, wide


def _counted(
    at: Array, weight: Array, first: Array, alpha: Array, beta: Array, limits: tuple[float, float, float, int]
) -> tuple[Rows, Array]:
    """Numbers (t, n) of lines by functions with coefficients (t, 1), and their worth (t,), or −∞."""
    off_step, nearest, _, widest = limits
    t = at - first
    depth = 1 + beta * t
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        number = alpha * t / depth
        seen = (depth > nearest) & (np.abs(number) < 1e6)
        whole = np.rint(np.where(seen, number, 0.0))
        off = number - whole
        seen &= np.abs(off) < off_step
    numbers = np.where(seen, whole, _NONE).astype(np.int64)
    value = np.where(seen, weight * (1 - (np.where(seen, off, 0.0) / off_step) ** 2), 0.0)
    # Of two lines with one number the stronger one counts.
    twice = seen[:, 1:] & seen[:, :-1] & (numbers[:, 1:] == numbers[:, :-1])
    worth = value.sum(axis=1) - np.where(twice, np.minimum(value[:, 1:], value[:, :-1]), 0.0).sum(axis=1)
    count = seen.sum(axis=1) - twice.sum(axis=1)
    # With a sufficiently small step any lines fit; therefore gaps are penalized.
    low, high = np.where(seen, whole, np.inf).min(axis=1), np.where(seen, whole, -np.inf).max(axis=1)
    span = np.where(count > 0, high - low, np.inf) + 1
    good = (count >= 2) & (span <= widest) & np.isfinite(worth)
    return numbers, np.where(good, worth * count / span, -np.inf)


def _agree(one: Rows, others: Rows, alike: float) -> bool:
    """Whether most lines have the same numbers (n,) as in any of the others (m, n), except for an offset."""
    there, both = one != _NONE, (one != _NONE) & (others != _NONE)
    offset = np.where(both, one - others, _NONE)
    same = ((offset[:, :, None] == offset[:, None]) & both[:, :, None]).sum(axis=1).max(axis=1, initial=0)
    fewer = np.minimum(there.sum(), (others != _NONE).sum(axis=1))
    return bool(((same > 1) & (same >= alike * fewer)).any())
