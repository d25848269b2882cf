"""Lines of a testfield, compiled: where ridge points support them, and the light that they take."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = [
    "add_windows",
    "attenuate",
    "bends",
    "curved",
    "distinct_lines",
    "illumination",
    "numberings",
    "ridges",
    "supported",
    "voted",
    "without_own",
]


@compiled
def supported(
    xy: NDArray[Any],
    normal: NDArray[Any],
    across: NDArray[Any],
    distance: NDArray[Any],
    near: float,
    parallel: float,
    step: float,
    least: float,
) -> NDArray[Any]:
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
    reach = 0.0
    for i in range(len(xy)):
        reach = max(reach, abs(xy[i, 0]) + abs(xy[i, 1]))
    count, ends = int(2 * reach / step) + 2, np.empty((len(across), 2))
    points = np.empty(count)
    for k in range(len(across)):
        a, b = across[k, 0], across[k, 1]
        points[:] = 0
        for i in range(len(xy)):
            off = xy[i, 0] * a + xy[i, 1] * b - distance[k]
            if abs(off) < near and abs(normal[i, 0] * a + normal[i, 1] * b) > parallel:
                points[int((xy[i, 1] * a - xy[i, 0] * b + reach) / step)] += 1
        best, total, begin = 0.0, 0.0, 0
        ends[k, 0], ends[k, 1] = 0.0, -1.0
        for j in range(count):
            if total <= 0:
                total, begin = 0.0, j
            total += 1.0 if points[j] >= least else -1.0
            if total > best:
                best = total
                ends[k, 0], ends[k, 1] = begin * step - reach, (j + 1) * step - reach
    return ends


@compiled
def _line_through(
    xy: NDArray[Any],
    normal: NDArray[Any],
    across: NDArray[Any],
    distance: float,
    near: float,
    parallel: float,
    least: int,
) -> tuple[NDArray[Any], float, NDArray[Any], NDArray[Any]]:
    """A line adjusted to the ridge points along it: normal, distance, ends (2, 2), and rows of its points.

    Parameters
    ----------
    xy, normal, near, parallel
        As in :func:`supported`.
    across, distance : ndarray (2,), float
        Normal and distance of the approximate line.
    least : int
        Number of points from which it is adjusted.
    """
    rows, count = np.empty(len(xy), np.intp), 0
    for i in range(len(xy)):
        off = xy[i, 0] * across[0] + xy[i, 1] * across[1] - distance
        if abs(off) < near and abs(normal[i, 0] * across[0] + normal[i, 1] * across[1]) > parallel:
            rows[count] = i
            count += 1
    rows, ends = rows[:count].copy(), np.empty((2, 2))
    along = np.array([-across[1], across[0]])
    if count < least:
        for k in range(2):
            ends[k, 0], ends[k, 1] = across[0] * distance, across[1] * distance
        return across.copy(), distance, ends, rows
    at, middle = np.empty(count), 0.0
    for i in range(count):
        at[i] = xy[rows[i], 0] * along[0] + xy[rows[i], 1] * along[1]
        middle += at[i] / count
    total, first, second, of_off, product = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        off, t = xy[rows[i], 0] * across[0] + xy[rows[i], 1] * across[1] - distance, at[i] - middle
        weight = 1 - (off / near) ** 2
        total, first, second = total + weight, first + weight * t, second + weight * t * t
        of_off, product = of_off + weight * off, product + weight * t * off
    slope, total = product / max(second, 1e-9), max(total, 1e-9)
    # off = level + slope (at − middle), as a normal of unit length.
    level, scale = of_off / total - slope * first / total, math.hypot(1.0, slope)
    at.sort()
    for k in range(2):
        t = at[int(np.rint((0.02, 0.98)[k] * (count - 1)))]
        off = distance + level + slope * (t - middle)
        for c in range(2):
            ends[k, c] = t * along[c] + off * across[c]
    return (across - slope * along) / scale, (distance + level - slope * middle) / scale, ends, rows


@compiled
def distinct_lines(
    xy: NDArray[Any],
    normal: NDArray[Any],
    across: NDArray[Any],
    distance: NDArray[Any],
    near: tuple[float, float, int],
    own: float,
    most: int,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
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
    kept, normals, places = np.empty(most, np.intp), np.empty((most, 2)), np.empty(most)
    ends, free, count = np.empty((most, 2, 2)), np.ones(len(xy), np.bool_), 0
    for k in range(len(across)):
        if count == most:
            break
        turned, place, end, rows = _line_through(xy, normal, across[k], distance[k], *near)
        mine = 0
        for i in rows:
            mine += free[i]
        apart = not (len(rows) and mine < own * len(rows))
        for j in range(count):
            off = 0.0
            for e in range(2):
                off = max(off, abs(end[e, 0] * normals[j, 0] + end[e, 1] * normals[j, 1] - places[j]))
            apart = apart and off > 2 * near[0]
        if apart:
            kept[count], places[count] = k, place
            for e in range(2):
                normals[count, e] = turned[e]
                ends[count, e, 0], ends[count, e, 1] = end[e, 0], end[e, 1]
            count += 1
            for i in rows:
                free[i] = False
    return kept[:count].copy(), normals[:count].copy(), places[:count].copy(), ends[:count].copy()


@compiled
def _agree(one: NDArray[Any], other: NDArray[Any], none: int, alike: float) -> bool:
    """Whether most lines have the same numbers in both (n,), except for an offset; `none` is no number."""
    first, second, most = 0, 0, 0
    for i in range(len(one)):
        first, second, same = first + (one[i] != none), second + (other[i] != none), 0
        if one[i] == none or other[i] == none:
            continue
        for j in range(len(one)):
            both = one[j] != none and other[j] != none
            same += both and one[j] - other[j] == one[i] - other[i]
        most = max(most, same)
    return most > 1 and most >= alike * min(first, second)


@compiled
def numberings(
    at: NDArray[Any],
    weight: NDArray[Any],
    limits: tuple[float, float, float, int],
    most: tuple[int, int],
    alike: float,
    strongest: tuple[int, int],
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
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
    n, none = len(at), -(2**40)
    off_step, nearest, smooth, widest = limits
    by_weight = np.argsort(-weight, kind="mergesort")
    groups = [np.arange(n)]
    groups += [np.sort(by_weight[:size]) for size in strongest if size < n]
    most_tried = 0
    for group in groups:
        most_tried += 144 * len(group)
    numbers, worths, tried = np.empty((most_tried, n), np.int64), np.empty(most_tried), 0
    value = np.empty(n)
    for group in groups:
        for first in range(len(group)):
            for code in range(144):  # the next two lines, at most four further each, and two gaps up to three
                second = first + 1 + code // 36
                third, gap = second + 1 + code // 9 % 4, 1 + code // 3 % 3
                if third >= len(group):
                    continue
                one, two, three = group[first], group[second], group[third]
                wide, near, far = gap + 1 + code % 3, at[two] - at[one], at[three] - at[one]
                # gap (1 + β near) = α near, wide (1 + β far) = α far.
                beta = (wide * near - gap * far) / (near * far * (gap - wide))
                alpha = gap / near + gap * beta
                # Gaps change slowly from one to the next in any perspective in which all can be seen.
                if not abs(math.log((far - near) / (wide - gap) / (near / gap))) < smooth * wide:
                    continue
                worth, count, low, high, last = 0.0, 0, 0, 0, -1
                found = numbers[tried]
                for i in range(n):
                    t = at[i] - at[one]
                    depth = 1 + beta * t
                    number = alpha * t / depth
                    found[i] = none
                    if not (depth > nearest and abs(number) < 1e6):
                        continue
                    whole = np.rint(number)
                    off = number - whole
                    if not abs(off) < off_step:
                        continue
                    found[i], value[i] = int(whole), weight[i] * (1 - (off / off_step) ** 2)
                    worth += value[i]
                    low, high = (
                        (found[i], found[i]) if count == 0 else (min(low, found[i]), max(high, found[i]))
                    )
                    count += 1
                    # Of two lines with one number the stronger one counts.
                    if last == i - 1 and last >= 0 and found[last] == found[i]:
                        worth -= min(value[last], value[i])
                        count -= 1
                    last = i
                # With a sufficiently small step any lines fit; therefore gaps are penalized.
                span = high - low + 1
                if count >= 2 and span <= widest and math.isfinite(worth):
                    worths[tried] = worth * count / span
                    tried += 1
    kept, made = np.empty(most[1], np.int64), 0
    order = np.argsort(-worths[:tried], kind="mergesort")
    for k in order[: most[0]]:
        found = numbers[k]
        for i in range(n):
            for j in range(i):
                if found[i] != none and found[i] == found[j]:
                    found[j if weight[i] > weight[j] else i] = none
        new = True
        for j in range(made):
            new = new and not _agree(found, numbers[kept[j]], none, alike)
        if new:
            kept[made] = k
            made += 1
            if made == most[1]:
                break
    chosen = numbers[kept[:made]]
    return chosen != none, chosen, worths[kept[:made]]


@compiled
def voted(
    xy: NDArray[Any], own: NDArray[Any], direction: NDArray[Any], spread: int, reach: int
) -> NDArray[Any]:
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
    turns = len(direction)
    votes = np.zeros((turns, 2 * reach + 1))
    for i in range(len(xy)):
        for turn in range(own[i] - spread, own[i] + spread + 1):
            k = turn % turns
            rho = xy[i, 0] * direction[k, 0] + xy[i, 1] * direction[k, 1] + reach
            low = math.floor(rho)
            votes[k, low] += 1 - rho + low
            votes[k, low + 1] += rho - low
    return votes


@compiled
def add_windows(
    total: NDArray[Any], seen: NDArray[Any], first: NDArray[Any], images: NDArray[Any], wanted: bool
) -> None:
    """Add images (k, r, c), of which the first pixel is at column and row `first` (k, 2), to a frame (h, w).

    Where `wanted`, their pixels are marked in `seen`.
    """
    h, w = total.shape
    for k in range(len(images)):
        left, top = first[k, 0], first[k, 1]
        for r in range(max(0, -top), min(images.shape[1], h - top)):
            for c in range(max(0, -left), min(images.shape[2], w - left)):
                total[top + r, left + c] += images[k, r, c]
                if wanted:
                    seen[top + r, left + c] = True


@compiled
def without_own(
    total: NDArray[Any], first: NDArray[Any], own: NDArray[Any], sign: float, others: NDArray[Any]
) -> None:
    """Fill the light (k, r, c) of other marks in windows: `sign` times the total (h, w) without the own.

    `first` (k, 2) are column and row of the first pixels; the border of the frame continues beyond it.
    """
    h, w = total.shape
    for k in range(len(own)):
        for r in range(own.shape[1]):
            y = min(max(first[k, 1] + r, 0), h - 1)
            for c in range(own.shape[2]):
                x = min(max(first[k, 0] + c, 0), w - 1)
                others[k, r, c] = sign * (total[y, x] - own[k, r, c])


@compiled
def attenuate(free: NDArray[Any], contrast: NDArray[Any], size: NDArray[Any]) -> None:
    """Replace the free share of pixels (h, w) by the light that is missing there.

    Parameters
    ----------
    contrast : ndarray (6,)
        Coefficients of 1, u, v, u², u v, v², with u and v from −1 to 1 over the frame.
    size : ndarray (2,)
        Width and height of the frame.
    """
    for r in range(free.shape[0]):
        v = 2 * r / size[1] - 1
        for c in range(free.shape[1]):
            if free[r, c] == 1.0:
                free[r, c] = 0.0
                continue
            u = 2 * c / size[0] - 1
            light = contrast[0] + contrast[1] * u + contrast[2] * v
            light += contrast[3] * u * u + contrast[4] * u * v + contrast[5] * v * v
            free[r, c] = light * (1.0 - free[r, c])


@compiled
def bends(
    grey: NDArray[Any], total: NDArray[Any], near: NDArray[Any], sign: float, limit: float
) -> NDArray[Any]:
    """Differences (n,) of pixels from the mean of both neighbours in the row, where the formed image is flat.

    Parameters
    ----------
    grey, total : ndarray (h, w)
        Grey values; light that marks attenuate or add.
    near : ndarray (h, w) of bool
        Pixels to look at.
    sign : float
        Factor with which `total` is added to the grey values.
    limit : float
        Largest difference of the formed image at the two neighbours.
    """
    found, count = np.empty(np.count_nonzero(near)), 0
    for r in range(grey.shape[0]):
        for c in range(1, grey.shape[1] - 1):
            if near[r, c] and abs(total[r, c + 1] - total[r, c - 1]) < limit:
                beside = grey[r, c - 1] + grey[r, c + 1] + sign * (total[r, c - 1] + total[r, c + 1])
                found[count] = abs(grey[r, c] + sign * total[r, c] - beside / 2)
                count += 1
    return found[:count]


@compiled
def ridges(
    xx: NDArray[Any], yy: NDArray[Any], xy: NDArray[Any], x: NDArray[Any], y: NDArray[Any], least: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Ridge points (n, 2) and their normals (n, 2) from the derivatives (h, w) of a smoothed frame.

    The curvature across is at least `least`, that along less than half of it, and the slope across vanishes
    within 0.7 pixels.
    """
    points, normals, count = np.empty((16384, 2)), np.empty((16384, 2)), 0
    for r in range(xx.shape[0]):
        for c in range(xx.shape[1]):
            half, mean = (xx[r, c] - yy[r, c]) / 2, (xx[r, c] + yy[r, c]) / 2
            square, lack = half * half + xy[r, c] * xy[r, c], least - mean
            if not (square > lack * lack or lack < 0):
                continue
            root = math.sqrt(square)
            across = mean + root
            if not (across > least and abs(mean - root) < across / 2):
                continue
            # The direction across has half the angle of (half, xy).
            if half > 0:
                u = math.sqrt(0.5 + 0.5 * half / root)
                v = 0.5 * xy[r, c] / (root * u)
            else:
                v = math.copysign(math.sqrt(0.5 - 0.5 * half / root), xy[r, c])
                u = 0.5 * xy[r, c] / (root * v)
            step = -(x[r, c] * u + y[r, c] * v) / across
            if abs(step) < 0.7:
                if count == len(points):
                    points = np.concatenate((points, np.empty_like(points)))
                    normals = np.concatenate((normals, np.empty_like(normals)))
                points[count, 0], points[count, 1] = c + step * u, r + step * v
                normals[count, 0], normals[count, 1] = u, v
                count += 1
    return points[:count].copy(), normals[:count].copy()


@compiled
def curved(
    nodes: NDArray[Any],
    tangents: NDArray[Any],
    kind: NDArray[Any],
    ways: NDArray[Any],
    xy: NDArray[Any],
    dxy: NDArray[Any],
    reach: NDArray[Any],
) -> None:
    """Images of outlines under mappings of second degree, their interior on the left.

    Parameters
    ----------
    nodes, tangents : ndarray (m, j, 2)
        Flat outlines of the kinds; see :class:`reseau.optics.formation.Outline`.
    kind : ndarray of int (k,)
        Kind of each target.
    ways : ndarray (k, 5, 2)
        Images of x, y, x², x y and y².
    xy, dxy, reach : ndarray (k, j, 2), (k, j, 2), (k, 2)
        Filled: images of nodes and tangents; largest distances from the origin along x and y.
    """
    for k in range(len(kind)):
        (a, b), (c, d), (e, f), (g, h), (p, q) = ways[k]
        area = 0.0
        reach[k] = 0.0
        for j in range(nodes.shape[1]):
            (x, y), (u, v) = nodes[kind[k], j], tangents[kind[k], j]
            uu, uv, vv = 2 * x * u, x * v + y * u, 2 * y * v
            right = a * x + c * y + e * x * x + g * x * y + p * y * y
            down = b * x + d * y + f * x * x + h * x * y + q * y * y
            along = a * u + c * v + e * uu + g * uv + p * vv
            turn = b * u + d * v + f * uu + h * uv + q * vv
            xy[k, j, 0], xy[k, j, 1], dxy[k, j, 0], dxy[k, j, 1] = right, down, along, turn
            area += right * turn - down * along
            reach[k, 0], reach[k, 1] = max(reach[k, 0], abs(right)), max(reach[k, 1], abs(down))
        if area < 0:
            for j in range(nodes.shape[1]):
                dxy[k, j, 0], dxy[k, j, 1] = -dxy[k, j, 0], -dxy[k, j, 1]


@compiled
def illumination(design: NDArray[Any], values: NDArray[Any], undetermined: float) -> NDArray[Any]:
    """Coefficients (b, m) of b sets of values at n points, adjusted three times without outliers.

    Parameters
    ----------
    design : ndarray (n, m)
        Monomials at the points.
    values : ndarray (b, n)
        Values; those that are not finite are left out.
    undetermined : float
        Weight of the coefficients as observations of zero, relative to that of the points: a few points, or
        points on a line, do not determine all of them.
    """
    n, m = design.shape
    found = np.empty((len(values), m))
    for b in range(len(values)):
        finite = np.isfinite(values[b])
        keep, off = finite.copy(), np.empty(n)
        for _ in range(3):
            normal, right = np.zeros((m, m)), np.zeros(m)
            for k in range(n):
                if keep[k]:
                    for i in range(m):
                        right[i] += design[k, i] * values[b, k]
                        for j in range(i + 1):
                            normal[i, j] += design[k, i] * design[k, j]
            trace = 0.0
            for i in range(m):
                trace += normal[i, i]
                for j in range(i):
                    normal[j, i] = normal[i, j]
            for i in range(m):
                normal[i, i] += undetermined * (1.0 + trace)
            found[b] = np.linalg.solve(normal, right)
            for k in range(n):
                fitted = 0.0
                for i in range(m):
                    fitted += design[k, i] * found[b, i]
                off[k] = abs(values[b, k] - fitted)
            limit = 4 * np.median(off[keep]) + 1e-9 if keep.any() else 0.0
            same = True
            for k in range(n):
                now = finite[k] and off[k] <= limit
                same = same and now == keep[k]
                keep[k] = now
            if same:
                break
    return found
