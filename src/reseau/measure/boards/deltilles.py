r"""Corners of a deltille in a frame: where six triangles meet, dark and bright in turn.

The image of such a corner is a sum of three edges, whose normals are at 120° to each other when it is seen
from the front. Derivatives of the smoothed image by z = x + i y tell it from all else: of an edge of the
normal :math:`e^{i\varphi}`, blurred to the width s, :math:`s\,|\partial_z|` and
:math:`s^3 |\partial_z^3|` are equal on the edge. In a corner the first derivatives of the three cancel each
other, and the third ones, of the phases :math:`3\varphi`, add up.

Source of the target: H. Ha, M. Perdoch, H. Alismail, I. S. Kweon, Y. Sheikh, Deltille grids for geometric
camera calibration, ICCV 2017.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure
from ...io.board import BoardDesign
from ...optics.composition import Chain
from ..plane.growth import first_mapping, grown_through
from ..plane.lattice_mapping import images_of
from ..plane.levels import levels_around
from .placement import NO_ROWS, Placed, cost_of, failed, laid_once, numbered

_SMOOTH_PX = 1.8
"""Width of the smoothing, pixels."""
_BESIDE = 7
"""Side of the square in which a corner is the strongest, pixels."""
_WEAK = 0.1
"""Least strength of a corner, as a share of the strong ones."""
_LEAST_T = 6.0
"""Least strength of a corner over that of noise."""
_MOST = 3000
_ALIKE = 0.5
"""Largest difference of the phases of neighbours, of π; the same sectors of both are dark."""
_NEAR = 14
"""Number of neighbours examined for a seed."""
_GATE = 0.22
"""Largest distance of a neighbour from where it is expected, in steps."""
_SEEDS, _SHOWN = 12, 10
"""Most seeds of corners of one strength; number of the strongest corners, which all boards have."""
_STRONG = (0.4, 0.15, 0.0)
"""Strengths, as shares of that of the strongest, of the corners among which a lattice is looked for."""
_LATTICE = "corners in a lattice of triangles"
_FEWEST = 6
"""Least number of corners that show a board."""
_ENOUGH = 0.6
"""Share of the corners of the board from which no other seed is tried."""
_CROSSED = 0.3
"""Least difference between the darkest of the bright sectors and the brightest of the dark ones, of that
between their means."""
_CLOSE = 0.3
"""Part of the way to the middle of a triangle at which a sector is seen close to its corner."""
_MOSTLY = 0.8
"""Share of the corners in sight with which a deltille is not looked for any further."""
_STEPS = np.array([[1, 0], [0, 1], [-1, 1], [-1, 0], [0, -1], [1, -1]])
"""Steps to the neighbours of a corner in the lattice."""
_SHORTER_PX = 0.7
"""Width of the smoothing before a frame is shortened, pixels."""
_LARGE_PX = 2_500_000
"""Size of a frame from which it is searched at half its size."""


@dataclass(frozen=True, eq=False)
class SixSectors:
    """Places of a frame where six sectors meet, in columns.

    Parameters
    ----------
    xy : ndarray (m, 2)
        Positions in pixels, good to a fraction of a pixel.
    phase : ndarray (m,)
        Three times the direction of an edge from dark to bright, radians.
    strength : ndarray (m,)
        In descending order.
    """

    xy: Array
    phase: Array
    strength: Array

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, keep: Mask | Rows) -> SixSectors:
        """Selected places."""
        return SixSectors(self.xy[keep], self.phase[keep], self.strength[keep])


def _bells() -> list[Array]:
    """Gaussian and its first three derivatives, times powers of its width."""
    x = np.arange(-int(4 * _SMOOTH_PX + 1), int(4 * _SMOOTH_PX + 2)) / _SMOOTH_PX
    bell = np.exp(-0.5 * x * x)
    bell /= bell.sum()
    # The kernel of a correlation is the derivative of the reflected Gaussian.
    return [bell, x * bell, (x * x - 1) * bell, (x**3 - 3 * x) * bell]


def find_six_sectors(grey: NDArray[np.float32], noise: float, halved: bool = False) -> SixSectors:
    """Find the corners of a frame in which six sectors meet, that noise does not explain.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    noise : float
        Their standard deviation.
    halved : bool
        Whether to search at half the size, as for blurred frames.
    """
    if halved or grey.size > _LARGE_PX:
        h, w = (n // 2 * 2 for n in grey.shape)
        half: Any = cv2.resize(grey[:h, :w], (w // 2, h // 2), interpolation=cv2.INTER_AREA)
        found = find_six_sectors(half, noise / 2)
        # Pixel 0 at half the size covers pixels 0 and 1.
        return SixSectors(2 * found.xy + 0.5, found.phase, found.strength)
    bells = _bells()

    def derived(across: int, down: int) -> Array:
        return np.asarray(cv2.sepFilter2D(grey, cv2.CV_32F, bells[across], bells[down]))

    xxx, xxy, xyy, yyy = (derived(3 - k, k) for k in range(4))
    real, imaginary = xxx - 3 * xyy, 3 * xxy - yyy
    third, first = np.hypot(real, imaginary), np.hypot(derived(1, 0), derived(0, 1))
    score = (third - first).astype(np.float32)
    peak = (score >= cv2.dilate(score, np.ones((_BESIDE, _BESIDE), np.uint8))) & (score > 0)
    powers = [float((bell**2).sum()) for bell in bells]
    peak &= score > _LEAST_T * noise * np.sqrt(powers[3] * powers[0] + 9 * powers[1] * powers[2])
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    v, u = np.nonzero(peak)
    strength = score[v, u].astype(np.float64)
    order = np.argsort(-strength, kind="stable")
    if len(order):
        order = order[strength[order] > _WEAK * strength[order[:30]].mean()][:_MOST]
    v, u = v[order], u[order]
    # The vertex of the parabola along each axis.
    away = []
    for dv, du in ((0, 1), (1, 0)):
        low, mid, high = (score[v + s * dv, u + s * du].astype(np.float64) for s in (-1, 0, 1))
        away.append(np.clip(0.5 * (low - high) / np.minimum(low - 2 * mid + high, -1e-12), -0.5, 0.5))
    phase = np.arctan2(imaginary[v, u], real[v, u]).astype(np.float64)
    return SixSectors(np.stack([u + away[0], v + away[1]], axis=1), phase, strength[order])


def find_oblique(grey: NDArray[np.float32], noise: float, angle: float) -> SixSectors:
    """Find the corners of a deltille seen at some 60°: the frame is shortened along an angle to its half.

    Seen obliquely the directions of the three edges are so uneven that their first derivatives do not cancel.

    Parameters
    ----------
    grey, noise
        See :func:`find_six_sectors`.
    angle : float
        Direction along which the frame is shortened, radians, x into y.
    """
    h, w = grey.shape
    along = np.array([np.cos(angle), np.sin(angle)])
    matrix = np.eye(2) - 0.5 * np.outer(along, along)
    ends = np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]]) @ matrix.T
    low = ends.min(axis=0)
    wide, high = (int(np.ceil(n)) + 1 for n in np.ptp(ends, axis=0))
    shorter = cv2.warpAffine(
        cv2.GaussianBlur(grey, (0, 0), _SHORTER_PX), np.column_stack([matrix, -low]), (wide, high),
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    found = find_six_sectors(np.asarray(shorter, dtype=np.float32), noise)
    xy = (found.xy + low) @ np.linalg.inv(matrix).T
    inside = ((xy >= 0) & (xy <= [w - 1, h - 1])).all(axis=1)
    return SixSectors(xy, found.phase, found.strength).select(inside)


def find_deltille(
    grey: NDArray[np.float32], noise: float, design: BoardDesign
) -> tuple[Placed | Failure, Array]:
    """Find a deltille in a frame, blurred or seen obliquely, too; also places (m, 2) that look like corners.

    Parameters
    ----------
    grey, noise
        See :func:`find_six_sectors`.
    design : BoardDesign
        A deltille.
    """
    ways = [partial(find_six_sectors, grey, noise), partial(find_six_sectors, grey, noise, halved=True)]
    ways += [partial(find_oblique, grey, noise, angle) for angle in np.pi / 4 * np.arange(4)]
    corners = ways[0]()
    first = lay_deltille(grey, corners, design)
    best, most = None, (0, 0)
    for k, way in enumerate(ways):
        found = lay_deltille(grey, way(), design) if k else first
        if isinstance(found, Failure):
            continue
        seen = _seen(grey, found)
        if best is None or seen > most:
            best, most = found, seen
        if not best.notes and _complete(best, grey.shape):
            break
    return best or first, corners.xy


def _complete(placed: Placed, shape: tuple[int, ...]) -> bool:
    """Whether most corners that should be in sight were found."""
    at = images_of(placed.located.mapping, placed.located.at)
    sight = ((at > 0) & (at < np.array(shape[::-1]) - 1)).all(axis=1)
    return bool(placed.located.found.sum() >= _MOSTLY * sight.sum())


def _seen(grey: NDArray[np.float32], placed: Placed) -> tuple[int, int]:
    """Number of the corners found whose sectors are seen close to them, and number of all found.

    In a frame that was shortened, a place on an edge beside each corner of a large deltille looks like one.
    """
    located = placed.located
    close = _crossed(_levels(grey, located.mapping, located.at[located.found], _CLOSE))
    return int(close.sum()), len(close)


def lay_deltille(grey: NDArray[np.float32], corners: SixSectors, design: BoardDesign) -> Placed | Failure:
    """Find a deltille among the corners of a frame, and number them.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    corners : SixSectors
        Its corners.
    design : BoardDesign
        A deltille.
    """
    found = failed(0, _LATTICE)
    for few in _by_strength(corners):
        laid = laid_once(few, partial(_laid, grey, design), design)
        if not isinstance(laid, Failure):
            return laid
        # Another board than that which was designed says more than none.
        found = laid if found.code is Code.NOT_FOUND else found
    return found


def lattice_of_deltille(grey: NDArray[np.float32], noise: float, extent: int) -> Rows:
    """Nodes (m, 2) of the largest lattice of triangles in a frame, at most `extent` to any side."""
    best: Rows = np.zeros((0, 2), dtype=np.intp)
    for few in _by_strength(find_six_sectors(grey, noise)):
        found = _grown(grey, few, extent, np.inf)
        if found is None or len(found[0]) <= len(best):
            continue
        # Outer corners are seen close to them only, where the print ends within the triangles beside them.
        beside = np.unique((found[0][:, None] + _STEPS).reshape(-1, 2), axis=0)
        close = _crossed(_levels(grey, found[2], beside, _CLOSE))
        best = np.unique(np.concatenate([found[0], beside[close]]), axis=0).astype(np.intp)
    return best


def _by_strength(corners: SixSectors) -> Iterator[SixSectors]:
    """The strong ones, and more: edges and texture have weaker corners, some of them beside the true ones."""
    for share in _STRONG if len(corners) else ():
        yield corners.select(corners.strength >= share * corners.strength[:_SHOWN].mean())


def _grown(
    grey: NDArray[np.float32], corners: SixSectors, extent: int, enough: float
) -> tuple[Array, Rows, Chain] | None:
    """The largest lattice that grows from corners: nodes (m, 2), rows of the corners, and mapping."""
    shape = (grey.shape[0], grey.shape[1])

    def accepted(mapping: Chain, beside: Array, row: Rows, slopes: Array) -> Mask:
        return _crossed(_levels(grey, mapping, beside))

    best: tuple[Array, Rows, Chain] | None = None
    for row, step in _seeds(corners):
        mapping = first_mapping(step, corners.xy[row], shape)
        levels = _levels(grey, mapping, np.zeros((1, 2)))
        if levels[:, :3].mean() < levels[:, 3:].mean():
            # A sixth of a turn exchanges the sectors.
            mapping = first_mapping(step @ np.array([[0, -1], [1, 1]]), corners.xy[row], shape)
        found = grown_through(corners.xy, mapping, extent, shape, accepted)
        if best is None or len(found[0]) > len(best[0]):
            best = found
        if len(best[0]) >= enough:
            break
    return best


def _laid(
    grey: NDArray[np.float32], design: BoardDesign, corners: SixSectors
) -> tuple[Placed | Failure, Rows]:
    """A deltille among corners of one strength, see :func:`lay_deltille`."""
    shape = (grey.shape[0], grey.shape[1])
    best = _grown(grey, corners, design.columns + design.rows, _ENOUGH * len(design.nodes))
    if best is None or len(best[0]) < _FEWEST:
        return failed(0 if best is None else len(best[0]), _LATTICE), NO_ROWS
    nodes, rows, mapping = best
    levels = np.median(_levels(grey, mapping, nodes), axis=0)
    cost = cost_of(float(levels[3:].mean()), float(levels[:3].mean()))

    def missed(missing: Array) -> Array:
        levels, close = (_levels(grey, mapping, missing, part) for part in (1.0, _CLOSE))
        return cost(levels, _crossed(levels) | _crossed(close))

    # The print may end within the triangles beside its outer corners.
    between = float(np.median(_levels(grey, mapping, nodes, _CLOSE), axis=0).mean())

    def ended(beyond: Array) -> Mask:
        """Whether one of the dark triangles is paper, as the bright ones are."""
        around = _levels(grey, mapping, beyond, _CLOSE)
        return np.asarray((around[:, :3].min(axis=1) > between) & (around[:, 3:].max(axis=1) > between))

    known = nodes.astype(np.intp), corners.xy[rows], mapping, shape
    return numbered(design, *known, None, missed, ends=ended), rows


def _seeds(corners: SixSectors) -> list[tuple[int, Array]]:
    """Corners with neighbours on all six sides, and the steps (2, 2) of the lattice there, in columns."""
    if len(corners) < _FEWEST:
        return []
    most = min(_NEAR + 1, len(corners))
    near = scipy.spatial.KDTree(corners.xy).query(corners.xy, k=most)[1][:, 1:]
    apart = np.abs(np.angle(np.exp(1j * (corners.phase[near] - corners.phase[:, None]))))
    away = np.where(apart[..., None] < _ALIKE * np.pi, corners.xy[near] - corners.xy[:, None], np.inf)
    found: list[tuple[int, int, Array]] = []
    for i, steps in enumerate(away):
        steps = steps[np.isfinite(steps).all(axis=1)]
        if len(steps) < 3:
            continue
        a, b = (part.ravel() for part in np.meshgrid(*2 * [np.arange(len(steps))], indexing="ij"))
        one, two = steps[a], steps[b]
        length = np.hypot(*np.stack([one, two, two - one]).transpose(2, 0, 1))  # (3, pairs)
        # Clockwise as seen, the second about 60° from the first.
        turned = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
        likely = (turned > 0.3 * length[0] * length[1]) & (length.max(axis=0) < 2.5 * length.min(axis=0))
        if not likely.any():
            continue
        one, two = one[likely], two[likely]
        around = np.stack([one, two, two - one, -one, -two, one - two], axis=1)
        gap = np.hypot(*np.moveaxis(around[:, :, None] - steps, 3, 0)).min(axis=2)
        support = (gap < _GATE * length[:, likely].min(axis=0)[:, None]).sum(axis=1)
        k = int(np.lexsort((length[:, likely].sum(axis=0), -support))[0])
        if support[k] >= 4:
            found.append((-int(support[k]), i, np.stack([one[k], two[k]], axis=1)))
    # Those with most neighbours, and of these the strongest, come first.
    found.sort(key=lambda seed: seed[:2])
    return [(i, step) for _, i, step in found[:_SEEDS]]


def _levels(grey: NDArray[np.float32], mapping: Chain, nodes: Array, part: float = 1.0) -> Array:
    """Grey values (n, 6) in the triangles around nodes: three bright ones, three dark ones.

    They are those of the middles, or of places on the way to these, at a part of it.
    """
    third = np.array([[1, 1], [-2, 1], [1, -2], [-1, -1], [2, -1], [-1, 2]]) / 3
    return levels_around(grey, mapping, nodes, part * third)


def _crossed(levels: Array) -> Mask:
    """Whether all bright sectors (n, 6) are brighter than all dark ones by a share of the contrast."""
    bright, dark = levels[:, :3], levels[:, 3:]
    contrast = bright.mean(axis=1) - dark.mean(axis=1)
    return np.asarray(bright.min(axis=1) - dark.max(axis=1) > _CROSSED * np.maximum(contrast, 1e-9))
