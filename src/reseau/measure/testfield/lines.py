"""The straight lines of a testfield in a frame: from the Laplacian by Hough to a lattice of lines.

A line about a pixel wide is a ridge of the grey values' curvature. Ridge points with their directions vote
for straight lines (Hough 1962; Ballard 1981). What tells a line from a row of targets, which votes as well,
is that a line is dark everywhere along it, and a row of targets is not between them. The lines of a testfield
are equally spaced; seen in perspective they still are, projectively, and that numbers them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Rows
from ...core.failure import Code, Failure

__all__ = ["Lattice", "Ridges", "find_lattice", "ridge_points"]

_TURN = np.deg2rad(1.5)
"""Step of the Hough transform in angle; in distance it is a pixel."""
_SPREAD = 4
"""Steps in angle over which a ridge point votes, to either side of its own direction."""
_SIGNIFICANT = 4.0
"""Noise widths above which a curvature counts."""
_LEAST_SHARE = 0.85
"""Share of its length on which a line must be dark; rows of targets reach three quarters."""
_SECTION = 90
"""Length in pixels over which a straight line is looked at; a distorted one is not straight for longer."""
_OFF_STEP = 0.2
"""By how much of its size a gap between lines may fail to be a whole number of steps."""


@dataclass(frozen=True, eq=False)
class Ridges:
    """Points on the middle lines of thin dark structures, in columns.

    Parameters
    ----------
    xy : ndarray (n, 2)
        To a fraction of a pixel.
    normal : ndarray (n, 2)
        Unit vectors across.
    darkness : ndarray (h, w), float32
        What each pixel lacks of the brightness around it, grey values.
    """

    xy: Array
    normal: Array
    darkness: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Lattice:
    """Lines numbered within their families, and where they cross.

    Parameters
    ----------
    homography : ndarray (3, 3)
        From numbers of lines (i, j) to the image. Seen with i to the right, j runs up.
    across, along : ndarray of int (a,), (b,)
        Numbers i and j of the lines found.
    """

    homography: Array
    across: Rows
    along: Rows


def ridge_points(grey: NDArray[np.float32], noise: float, sigma: float = 1.0) -> Ridges:
    """Ridge points of dark lines on a bright ground.

    Where the curvature across is significant and that along is small, the point is where the slope across
    vanishes (Steger 1998, An unbiased detector of curvilinear structures, IEEE PAMI 20).

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values.
    noise : float
        Their standard deviation.
    sigma : float
        Width of the Gaussian that smooths, in pixels.
    """
    offset = np.arange(-int(np.ceil(4 * sigma)), int(np.ceil(4 * sigma)) + 1)
    bell = np.exp(-0.5 * (offset / sigma) ** 2)
    bell /= bell.sum()
    slope, bend = offset / sigma**2 * bell, (offset**2 / sigma**4 - 1 / sigma**2) * bell

    def filtered(x: Array, y: Array) -> NDArray[np.float32]:
        smooth: Any = cv2.sepFilter2D(grey, cv2.CV_32F, x.astype(np.float32), y.astype(np.float32))
        return np.asarray(smooth, dtype=np.float32)

    xx, yy, xy = filtered(bend, bell), filtered(bell, bend), filtered(slope, slope)
    half, mean = (xx - yy) / 2, (xx + yy) / 2
    root = cv2.magnitude(half, xy)
    across = mean + root
    least = _SIGNIFICANT * noise * float(np.sqrt((bend**2).sum() * (bell**2).sum()))
    row, column = np.nonzero((across > least) & (np.abs(mean - root) < 0.5 * across))
    at = row, column
    angle = 0.5 * np.arctan2(xy[at], half[at])
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    gradient = np.stack([filtered(slope, bell)[at], filtered(bell, slope)[at]], axis=1)
    step = -(gradient * normal).sum(axis=1) / across[at]
    on = np.abs(step) < 0.7
    points = np.stack([column, row], axis=1)[on] + step[on, None] * normal[on]
    return Ridges(points.astype(np.float64), normal[on].astype(np.float64), _darkness(grey))


def _darkness(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """What each pixel lacks of the brightest around it."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    size = max(grey.shape) // 14 | 1
    bright = cv2.blur(cv2.dilate(smooth, np.ones((size, size), np.uint8)), (size, size))
    lack: NDArray[np.float32] = bright - grey
    return lack


def find_lattice(ridges: Ridges) -> Lattice | Failure:
    """Find two families of straight lines and number them.

    Returns
    -------
    Lattice or Failure
        A failure where there are not two lines of each family.
    """
    candidates = _candidates(ridges)
    if len(candidates) < 4:
        return Failure("no straight lines are to be found", Code.NOT_FOUND)
    families = _families(candidates)
    numbered = [_numbered(family, ridges.darkness.shape) for family in families]
    if min(len(number) for _, number in numbered) < 2:
        found = " and ".join(str(len(number)) for _, number in numbered)
        return Failure(
            f"{found} equally spaced straight lines are found; it takes two and two", Code.NOT_FOUND
        )
    (first, i), (second, j) = numbered
    homography = _homography(first, i, second, j)
    middle = np.array([i.mean(), j.mean(), 1.0])
    # The derivative of a projectivity has the sign of its determinant times that of the denominator cubed.
    if np.linalg.det(homography) * (homography[2] @ middle) > 0:
        homography, j = homography * [1.0, -1.0, 1.0], -j
    return Lattice(homography, i, j)


def _candidates(ridges: Ridges) -> Array:
    """Straight lines (n, 4): angle of the normal, distance from the centre of the frame, votes, share."""
    votes, reach = _hough(ridges)
    peak = votes == cv2.dilate(votes, np.ones((3, 3), np.uint8))
    least = max(20.0, 0.12 * min(ridges.darkness.shape))
    turn, distance = np.nonzero(peak & (votes > least))
    if not len(turn):
        return np.zeros((0, 4))
    strongest = np.argsort(-votes[turn, distance], kind="stable")[:250]
    turn, distance = turn[strongest], distance[strongest]
    angle, rho = turn * _TURN, (distance - reach).astype(np.float64)
    share = _dark_share(ridges.darkness, angle, rho)
    lines = np.stack([angle, rho, votes[turn, distance], share], axis=1)[share > _LEAST_SHARE]
    # The best first; what is nearly the same line is not another one.
    kept: list[Array] = []
    for line in lines[np.argsort(-lines[:, 2] * lines[:, 3], kind="stable")]:
        if all(_apart(line, other) for other in kept):
            kept.append(line)
    return np.array(kept).reshape(-1, 4)


def _apart(line: Array, other: Array) -> bool:
    turn = line[0] - other[0]
    rho = other[1] * (1 if np.cos(turn) > 0 else -1)
    return bool(abs(np.sin(turn)) > np.sin(np.deg2rad(12)) or abs(line[1] - rho) > 6)


def _centre(shape: tuple[int, ...]) -> Array:
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])


def _hough(ridges: Ridges) -> tuple[NDArray[np.float32], int]:
    """Votes of the ridge points for lines (angles, distances), and the index of distance nought."""
    at = ridges.xy - _centre(ridges.darkness.shape)
    reach = int(np.hypot(*ridges.darkness.shape) / 2) + 2
    turns, width = round(np.pi / _TURN), 2 * reach + 1
    own = np.rint(np.arctan2(ridges.normal[:, 1], ridges.normal[:, 0]) / _TURN).astype(np.intp)
    votes = np.zeros(turns * width)
    for turn in range(-_SPREAD, _SPREAD + 1):
        k = (own + turn) % turns
        cosine, sine = np.cos(np.arange(turns) * _TURN)[k], np.sin(np.arange(turns) * _TURN)[k]
        rho = at[:, 0] * cosine + at[:, 1] * sine + reach
        low = np.floor(rho).astype(np.intp)
        part = rho - low
        votes += np.bincount(k * width + low, 1 - part, minlength=votes.size)
        votes += np.bincount(k * width + low + 1, part, minlength=votes.size)
    return votes.reshape(turns, width).astype(np.float32), reach


def _dark_share(darkness: NDArray[np.float32], angle: Array, rho: Array) -> Array:
    """Share of their best sections on which straight lines (n,) are half as dark as they mostly are."""
    h, w = darkness.shape
    along = np.arange(-max(h, w) * 0.7, max(h, w) * 0.7)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x = _centre(darkness.shape)[0] + rho[:, None] * normal[:, :1] - along * normal[:, 1:]
    y = _centre(darkness.shape)[1] + rho[:, None] * normal[:, 1:] + along * normal[:, :1]
    inside = (x > 0) & (x < w - 1) & (y > 0) & (y < h - 1)
    # Two pixels to either side: the line need not be quite there.
    across = [
        cv2.remap(darkness, (x + d * c).astype(np.float32), (y + d * s).astype(np.float32), cv2.INTER_LINEAR)
        for d in (-1.0, 0.0, 1.0)
        for c, s in ((normal[:, :1], normal[:, 1:]),)
    ]
    dark = np.max(across, axis=0)
    inside[:, 0] |= ~inside.any(axis=1)  # a median needs a value
    middle = np.nanmedian(np.where(inside, dark, np.nan), axis=1, keepdims=True)
    section = (min(_SECTION, int(0.6 * min(h, w))), 1)
    seen, dark_part = (
        cv2.blur(mask.astype(np.float32), section) for mask in (inside, (dark > 0.5 * middle) & inside)
    )
    # Less than most of a section tells nothing.
    return np.asarray(
        np.where(seen > 0.8, dark_part / np.maximum(seen, 0.1), 0).max(axis=1), dtype=np.float64
    )


def _families(lines: Array) -> tuple[Array, Array]:
    """Lines that run with the strongest one, and those that cross it."""
    turn = np.abs(np.sin(lines[:, 0] - lines[0, 0]))
    first, others = lines[turn < np.sin(np.deg2rad(25))], lines[turn > np.sin(np.deg2rad(35))]
    if not len(others):
        return first, others
    turn = np.abs(np.sin(others[:, 0] - others[0, 0]))
    return first, others[turn < np.sin(np.deg2rad(25))]


def _numbered(lines: Array, shape: tuple[int, ...]) -> tuple[Array, Rows]:
    """The lines (n, 3) of a family, as a·x + b·y + c = 0, that are equally spaced, and their numbers."""
    if len(lines) < 2:
        return lines[:, :3], np.arange(len(lines))
    main = lines[0, 0]
    sign = np.where(np.cos(lines[:, 0] - main) < 0, -1.0, 1.0)
    normal = sign[:, None] * np.stack([np.cos(lines[:, 0]), np.sin(lines[:, 0])], axis=1)
    rho, weight = sign * lines[:, 1], lines[:, 2] * lines[:, 3]
    # Where they cross the line through the centre of the frame that runs across them.
    at = rho / (normal @ [np.cos(main), np.sin(main)])
    order = np.argsort(at, kind="stable")
    at, weight = at[order], weight[order]
    best, number, keep = -1.0, np.zeros(0, dtype=np.intp), order[:0]
    for start in range(len(at) - 1):
        for next_one in range(start + 1, min(start + 3, len(at))):
            steps, kept = _walk(at, start, next_one)
            # With steps small enough any lines are whole numbers of them apart: gaps count against it.
            worth = float(weight[kept].sum() * len(kept) / (np.ptp(steps) + 1))
            if worth > best:
                best, number, keep = worth, steps, kept
    chosen = order[keep]
    constant = -rho[chosen] - normal[chosen] @ _centre(shape)
    return np.column_stack([normal[chosen], constant]), number


def _walk(at: Array, start: int, next_one: int) -> tuple[Rows, Rows]:
    """Number lines from two of them on, outwards to both sides; those that do not fit are left out."""
    number = {start: 0, next_one: 1}
    for way, first in ((1, next_one), (-1, start)):
        step, last = at[next_one] - at[start], first
        for k in range(first + way, len(at) if way > 0 else -1, way):
            gap = abs(at[k] - at[last])
            whole = round(gap / step)
            if whole < 1 or abs(gap / step - whole) > _OFF_STEP * whole:
                continue
            number[k] = number[last] + way * whole
            step, last = gap / whole, k
    rows = np.array(sorted(number), dtype=np.intp)
    return np.array([number[int(k)] for k in rows], dtype=np.intp), rows


def _homography(first: Array, i: Rows, second: Array, j: Rows) -> Array:
    """From numbers of lines to the image, by the crossings of all lines."""
    crossing = np.cross(first[:, None], second[None])
    xy = (crossing[..., :2] / crossing[..., 2:]).reshape(-1, 2)
    number = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float64)
    found: Any = cv2.findHomography(number, xy)[0]
    return np.asarray(found if found is not None else np.eye(3), dtype=np.float64)
