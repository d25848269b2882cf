"""Fiducial marks as outlines: unions of crosses, disks, rings, arcs, wedges and notches.

A part of a mark is one or more polygons (curves have short sides and the area of the curve); the boundary of
the union is what of each part's boundary lies outside the other parts. Its corners move with the parameters
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
from ..matching.shapes import Window

_SIDES = 72
"""Sides of the polygon of a circle."""
_SAME = 1e-9


def margin_of(mark: FiducialMark) -> float:
    """Width around a mark in which its background is even, mm."""
    return mark.margin if mark.margin is not None else 0.3 * 2 * reach_of(mark)


def reach_of(mark: FiducialMark) -> float:
    """Largest distance of a mark's outline from its point, mm; of a notch, its tooth."""
    return max(float(np.hypot(*part.at)) + _half(part) for part in mark.parts)


def boldest_of(mark: FiducialMark) -> float:
    """Width of the boldest part of a mark, mm: of its lines, or its size."""
    return max(part.line_width or part.size for part in mark.parts)


def _half(part: MarkPart) -> float:
    if part.shape == "wedge":
        return float(np.hypot(part.size, (part.width or 0.0) / 2))
    if part.shape == "notch":
        width = part.width or 0.0
        return width / 2 if part.form == "round" else float(np.hypot(part.size, width / 2))
    return part.size / np.sqrt(2) if part.shape == "square" else part.size / 2


@lru_cache(maxsize=256)
def contours_of(mark: FiducialMark, beyond: float) -> list[Array]:
    """Closed polygons (m, 2) of the union of a mark's parts, interior on the left, y up, in mm.

    The border of a notch extends to twice `beyond`, half the side of a window around it.

    Examples
    --------
    A cross through a ring has an outer contour and four windows:

    >>> cross = MarkPart(shape="cross", size=2.0, line_width=0.1)
    >>> ring = MarkPart(shape="ring", size=1.0, line_width=0.1)
    >>> len(contours_of(FiducialMark(polarity="dark", parts=(cross, ring)), 3.0))
    5
    """
    parts = [_polygons(part, beyond) for part in mark.parts]
    if len(parts) == 1:
        return parts[0]
    kept = []
    for k, part in enumerate(parts):
        rest = [other for j, other in enumerate(parts) if j != k]
        sides = np.concatenate([_sides(polygon) for polygon in part])
        sides = _divided(sides, np.concatenate([_sides(polygon) for other in rest for polygon in other]))
        middle = sides.mean(axis=1)
        outside = np.ones(len(sides), dtype=bool)
        for other in rest:
            outside &= ~_inside(middle, other)
        kept.append(sides[outside])
    return _chained(np.concatenate(kept))


def _polygons(part: MarkPart, beyond: float) -> list[Array]:
    """Polygons of one part; a hole runs in the opposite direction."""
    line, half = part.line_width or 0.0, part.size / 2
    if part.shape == "cross":
        found = _cross(half, line / 2, (part.gap or 0.0) / 2)
    elif part.shape == "disk":
        found = [_circle(half)]
    elif part.shape == "square":
        found = [half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])]
    elif part.shape == "ring":
        found = [_circle(half), _circle(half - line)[::-1]]
    elif part.shape == "arc":
        start, stop = np.deg2rad([part.from_deg or 0.0, part.to_deg or 0.0])
        found = [np.concatenate([_bow(half, start, stop), _bow(half - line, start, stop)[::-1]])]
    elif part.shape == "wedge":
        w = (part.width or 0.0) / 2
        found = [np.array([[0, 0], [-w, -part.size], [w, -part.size]])]
    else:
        w = (part.width or 0.0) / 2
        edge = 0.0 if part.form == "round" else -part.size
        tooth = _bow(w, 0.0, np.pi) if part.form == "round" else np.array([[w, edge], [0, 0], [-w, edge]])
        b = 2 * beyond + part.size
        found = [np.concatenate([[[-b, edge - b], [b, edge - b], [b, edge]], tooth, [[-b, edge]]])]
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


def _cross(half: float, w: float, gap: float) -> list[Array]:
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    if gap <= w:
        arm = np.array([[half, -w], [half, w], [w, w]])
        return [np.concatenate([arm @ np.linalg.matrix_power(turn, k) for k in range(4)])]
    arm = np.array([[gap, -w], [half, -w], [half, w], [gap, w]])
    return [arm @ np.linalg.matrix_power(turn, k) for k in range(4)]


def _sides(polygon: Array) -> Array:
    return np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)


def _divided(sides: Array, others: Array) -> Array:
    """Sides (m, 2, 2) divided where other sides cross them."""
    pieces = []
    start, along = others[:, 0], others[:, 1] - others[:, 0]
    for a, b in sides:
        d = b - a
        cross = d[0] * along[:, 1] - d[1] * along[:, 0]
        safe = np.where(np.abs(cross) < 1e-15, np.inf, cross)
        rest = start - a
        t = (rest[:, 0] * along[:, 1] - rest[:, 1] * along[:, 0]) / safe
        u = (rest[:, 0] * d[1] - rest[:, 1] * d[0]) / safe
        inner = (t > _SAME) & (t < 1 - _SAME) & (u >= 0) & (u <= 1)
        at = np.concatenate([[0.0], np.unique(t[inner]), [1.0]])
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
