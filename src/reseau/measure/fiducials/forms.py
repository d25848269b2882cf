"""Fiducial marks as outlines: of parts that are united or cut, each one or more polygons.

Curves have short sides and the area of the curve. The boundary of a mark is every side of its parts that has
the mark on one side and not on the other. Its corners move with the parameters
of the form, which describe what the report of a camera does not state: the size, a small rotation, and the
spread of edges by which film and development make a line wider or narrower.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from ...core.data import Array, Mask, Rows
from ...io import FiducialMark, MarkPart
from ...optics.formation import Outline, coverage, coverage_derivatives, side_rule
from ..matching.shapes import Shape, Window
from .learnt import LearntShape, thickness_of

_SIDES = 72
"""Sides of the polygon of a circle."""
_SAME = 1e-9
_BESIDE = 1e-7
"""Distance from a side at which it is asked what lies left and right of it, in units of its length."""


def margin_of(mark: FiducialMark) -> float:
    """Width around a mark in which its background is even, mm."""
    if mark.learnt is not None:
        return 0.0
    return mark.margin if mark.margin is not None else 0.3 * 2 * reach_of(mark)


def reach_of(mark: FiducialMark) -> float:
    """Largest distance of a mark's outline from its point, mm; of a notch, its tooth."""
    if mark.learnt is not None:
        return mark.learnt.reach / mark.learnt.px_per_mm
    parts = [part for part in mark.parts if part.use == "mark"]
    return max(float(np.hypot(*corners.T).max()) for part in parts for corners in _polygons(part, None))


@lru_cache(maxsize=256)
def thicknesses(mark: FiducialMark) -> tuple[float, float]:
    """Widths of the thinnest and of the boldest part of a mark, mm: of its lines, or its size."""
    if mark.learnt is not None:
        thickness = thickness_of(mark.learnt)
        return thickness, thickness
    each = [
        part.line_width
        or part.width
        or 4 * abs(_area(corners)) / np.hypot(*np.ptp(_sides(corners), 1).T).sum()
        for part in mark.parts
        if part.use == "mark"
        for corners in _polygons(part, None)[:1]
    ]
    return float(min(each)), float(max(each))


@lru_cache(maxsize=256)
def contours_of(mark: FiducialMark, beyond: float, ignored: bool = False) -> list[Array]:
    """Closed polygons (m, 2) of a mark, interior on the left, y up, in mm.

    The border of a notch extends to twice `beyond`, half the side of a window around it. With `ignored`, the
    outline of what is not used around the mark.

    Examples
    --------
    A cross through a ring has an outer contour and four windows:

    >>> cross = MarkPart(shape="cross", size=2.0, line_width=0.1)
    >>> ring = MarkPart(shape="ring", size=1.0, line_width=0.1)
    >>> len(contours_of(FiducialMark(polarity="dark", parts=(cross, ring)), 3.0))
    5
    """
    used = [part for part in mark.parts if (part.use == "ignore") == ignored]
    parts = [(part.use == "cut", _polygons(part, beyond)) for part in used]
    if len(parts) == 1:
        return parts[0][1]
    every = np.concatenate([_sides(polygon) for _, polygons in parts for polygon in polygons])
    sides = _divided(every)
    middle, along = sides.mean(axis=1), sides[:, 1] - sides[:, 0]
    beside = _BESIDE * np.stack([-along[:, 1], along[:, 0]], axis=1)
    left, right = (_covered(middle + step, parts) for step in (beside, -beside))
    kept = np.where((left & ~right)[:, None, None], sides, sides[:, ::-1])[left != right]
    # Parts that touch have sides in common.
    _, once = np.unique(np.rint(kept.mean(axis=1) / _SAME / 10), axis=0, return_index=True)
    return _chained(kept[np.sort(once)])


def _covered(points: Array, parts: list[tuple[bool, list[Array]]]) -> Mask:
    """Points that lie in the mark: a cut takes away from what is before it."""
    inside = np.zeros(len(points), dtype=bool)
    for cut, polygons in parts:
        inside = np.where(_inside(points, polygons), not cut, inside)
    return inside


def _polygons(part: MarkPart, beyond: float | None) -> list[Array]:
    """Polygons of one part; a hole runs in the opposite direction. Without `beyond`, of a notch its tooth."""
    line, half, w = part.line_width or 0.0, (part.size or 0.0) / 2, (part.width or 0.0) / 2
    if part.shape == "cross":
        found = _cross(half, line / 2, (part.gap or 0.0) / 2, part.arms_deg or (0.0, 90.0, 180.0, 270.0))
    elif part.shape == "bar":
        found = [np.array([[-half, -line / 2], [half, -line / 2], [half, line / 2], [-half, line / 2]])]
    elif part.shape == "disk":
        found = [_circle(half)]
    elif part.shape == "square":
        found = [half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])]
    elif part.shape == "ring":
        found = [_circle(half), _circle(half - line)[::-1]]
    elif part.shape == "arc":
        start, stop = np.deg2rad([part.from_deg or 0.0, part.to_deg or 0.0])
        inner = _bow(half - line, start, stop)[::-1] if line else np.zeros((1, 2))
        found = [np.concatenate([_bow(half, start, stop), inner])]
    elif part.shape == "polygon":
        corners = np.array(part.corners, dtype=np.float64)
        found = [corners if _area(corners) > 0 else corners[::-1]]
    elif part.shape == "wedge":
        found = [np.array([[0, 0], [-w, -2 * half], [w, -2 * half]])]
    else:
        edge = 0.0 if part.form == "round" else -2 * half
        found = [_bow(w, 0.0, np.pi) if part.form == "round" else np.array([[w, edge], [0, 0], [-w, edge]])]
        if beyond is not None:
            b = 2 * beyond + 2 * half
            found = [np.concatenate([[[-b, edge - b], [b, edge - b], [b, edge]], found[0], [[-b, edge]]])]
    c, s = np.cos(np.deg2rad(part.turn_deg)), np.sin(np.deg2rad(part.turn_deg))
    return [polygon @ np.array([[c, s], [-s, c]]) + part.at for polygon in found]


def _circle(radius: float) -> Array:
    return _bow(radius, 0.0, 2 * np.pi)[:-1]


def _bow(radius: float, start: float, stop: float) -> Array:
    """Corners on a circle; the polygon has the area of the sector."""
    count = max(4, int(np.ceil(_SIDES * (stop - start) / (2 * np.pi))))
    step = (stop - start) / count
    angle = start + step * np.arange(count + 1)
    grown = radius * np.sqrt(step / np.sin(step))
    return np.asarray(grown * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _cross(half: float, w: float, gap: float, arms_deg: tuple[float, ...]) -> list[Array]:
    """Arms in any directions, joined where neighbouring sides meet, or apart."""
    turns = np.sort(np.deg2rad(np.array(arms_deg)) % (2 * np.pi))
    apart = np.diff(turns, append=turns[0] + 2 * np.pi)
    joined = []
    for turn, angle in zip(turns, apart, strict=True):
        c, s = np.cos(turn), np.sin(turn)
        foot = [[gap, w], [gap, -w]] if gap > w else [[w / np.tan(angle / 2), w]]
        arm = np.array([[half, -w], [half, w], *foot])
        joined.append(arm @ np.array([[c, s], [-s, c]]))
    return joined if gap > w else [np.concatenate(joined)]


def _area(polygon: Array) -> float:
    after = np.roll(polygon, -1, axis=0)
    return float((polygon[:, 0] * after[:, 1] - polygon[:, 1] * after[:, 0]).sum() / 2)


def _sides(polygon: Array) -> Array:
    return np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)


def _divided(sides: Array) -> Array:
    """Sides (m, 2, 2) divided where others cross them or end on them."""
    pieces = []
    start, along = sides[:, 0], sides[:, 1] - sides[:, 0]
    for a, b in sides:
        d = b - a
        cross = d[0] * along[:, 1] - d[1] * along[:, 0]
        safe = np.where(np.abs(cross) < 1e-15, np.inf, cross)
        rest = start - a
        t = (rest[:, 0] * along[:, 1] - rest[:, 1] * along[:, 0]) / safe
        u = (rest[:, 0] * d[1] - rest[:, 1] * d[0]) / safe
        at = rest @ d / (d @ d)
        on = np.abs(rest[:, 0] * d[1] - rest[:, 1] * d[0]) < _SAME * (d @ d)
        cuts = np.concatenate([t[(u >= 0) & (u <= 1)], at[on]])
        cuts = np.unique(np.rint(cuts[(cuts > _SAME) & (cuts < 1 - _SAME)] / _SAME) * _SAME)
        at = np.concatenate([[0.0], cuts, [1.0]])
        pieces.append(np.stack([a + at[:-1, None] * d, a + at[1:, None] * d], axis=1))
    return np.concatenate(pieces)


def _inside(points: Array, polygons: list[Array]) -> Mask:
    """Points with a winding number other than zero."""
    winding = np.zeros(len(points), dtype=np.intp)
    for polygon in polygons:
        a, b = polygon, np.roll(polygon, -1, axis=0)
        for p, q in zip(a, b, strict=True):
            left = (q[0] - p[0]) * (points[:, 1] - p[1]) - (points[:, 0] - p[0]) * (q[1] - p[1])
            winding += (p[1] <= points[:, 1]) & (q[1] > points[:, 1]) & (left > 0)
            winding -= (p[1] > points[:, 1]) & (q[1] <= points[:, 1]) & (left < 0)
    return np.asarray(winding != 0)


def _chained(sides: Array) -> list[Array]:
    """Closed polygons from sides whose ends meet."""
    free, found = list(range(len(sides))), []
    while free:
        chain = [free.pop(0)]
        while free:
            gap = np.hypot(*(sides[free, 0] - sides[chain[-1], 1]).T)
            nearest = int(gap.argmin())
            home = float(np.hypot(*(sides[chain[0], 0] - sides[chain[-1], 1])))
            if home <= gap[nearest]:
                break
            chain.append(free.pop(nearest))
        found.append(sides[chain, 0])
    return found


@dataclass(frozen=True, eq=False)
class MovedOutline:
    """Shapes whose outlines move with parameters of the form; see :class:`reseau.measure.matching.Shape`.

    Parameters
    ----------
    nodes : Outline
        Outlines (k, j, 2) in pixels around the point to be measured, padded with zeros.
    motions : Outline
        Motions (k, p, j, 2) of the nodes and of their tangents with each parameter.

    Examples
    --------
    >>> mark = FiducialMark(polarity="dark", parts=(MarkPart(shape="disk", size=8.0),))
    >>> disk = outlined([contours_of(mark, 0.0)], np.eye(2)[None], 0.5, np.ones(3))
    >>> from reseau.optics.formation import PixelResponse
    >>> window = Window(np.arange(21.0)[None], np.arange(21.0)[None], PixelResponse())
    >>> at = np.array([[10.0, 10.0]]), np.ones(1), np.array([[0.0, 0.0, 1.0]]), np.array([0])
    >>> round(float(disk.image(*at, window).sum() / np.pi), 2)  # wider by 1 px on all sides
    25.0
    """

    nodes: Outline
    motions: Outline

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return int(self.motions.xy.shape[1])

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.Shape`."""
        return coverage(self._placed(xy, form, at), window.columns, window.rows, width, window.response)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        return coverage_derivatives(
            self._placed(xy, form, at),
            window.columns,
            window.rows,
            width,
            window.response,
            self.motions.xy[at],
        )

    def _placed(self, xy: Array, form: Array, at: Rows) -> Outline:
        moved = (
            nodes[at] + np.einsum("kp,kpji->kji", form, motions[at])
            for nodes, motions in (
                (self.nodes.xy, self.motions.xy),
                (self.nodes.dxy, self.motions.dxy),
            )
        )
        nodes, tangents = moved
        return Outline(nodes + xy[:, None, :], tangents)


def shape_of(mark: FiducialMark, axes: Array, spacing: float, step: Array) -> Shape:
    """The shape of a mark, by its outline or its image; see :func:`outlined`."""
    if mark.learnt is not None:
        return LearntShape(mark.learnt, axes, step[:2])
    contours = contours_of(mark, reach_of(mark) + margin_of(mark))
    return outlined([contours], axes[None], spacing, step)


def outlined(marks: list[list[Array]], axes: Array, spacing: float, step: Array) -> MovedOutline:
    """Outlines of marks in pixels, with the motions of size, rotation and spread.

    Parameters
    ----------
    marks : list of list of ndarray (m, 2)
        Contours of each mark.
    axes : ndarray (k, 2, 2)
        Linear mappings from the plane of the contours to pixels.
    spacing : float
        Largest distance of nodes, pixels.
    step : ndarray (3,)
        Units of the parameters: relative change of the size, rotation in radians, and displacement of the
        edges outwards in pixels.
    """
    columns = []
    for contours, matrix in zip(marks, axes, strict=True):
        polygons = [polygon @ matrix.T for polygon in contours]
        if np.linalg.det(matrix) < 0:
            polygons = [polygon[::-1] for polygon in polygons]
        columns.append(np.concatenate([_nodes(polygon, spacing, step) for polygon in polygons], axis=2))
    most = max(column.shape[2] for column in columns)
    padded = np.stack([np.pad(c, ((0, 0), (0, 0), (0, most - c.shape[2]), (0, 0))) for c in columns])
    return MovedOutline(
        Outline(padded[:, 0, 0], padded[:, 0, 1]), Outline(padded[:, 1:, 0], padded[:, 1:, 1])
    )


def _nodes(polygon: Array, spacing: float, step: Array) -> Array:
    """Nodes and tangents (4, 2, j, 2) of a polygon, and their motions with three parameters."""
    corners = np.stack(
        [
            polygon,
            step[0] * polygon,
            step[1] * np.stack([-polygon[:, 1], polygon[:, 0]], axis=1),
            step[2] * _mitres(polygon),
        ]
    )
    closed = np.concatenate([corners, corners[:, :1]], axis=1)
    found = []
    for k, (start, stop) in enumerate(pairwise(polygon[[*range(len(polygon)), 0]])):
        along, weight = side_rule(float(np.hypot(*(stop - start))), spacing)
        a, b = closed[:, k, None], closed[:, k + 1, None]
        xy = a + along[:, None] * (b - a)
        found.append(np.stack([xy, weight[:, None] * (b - a)], axis=1))
    return np.concatenate(found, axis=2)


def _mitres(polygon: Array) -> Array:
    """Motions (m, 2) of the corners when all sides move outwards by one."""
    along = np.roll(polygon, -1, axis=0) - polygon
    along /= np.hypot(*along.T)[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)  # the interior is on the left
    before = np.roll(normal, 1, axis=0)
    # A corner between sides that nearly reverse would move far.
    return np.asarray((normal + before) / np.maximum(1 + (normal * before).sum(axis=1), 0.1)[:, None])
