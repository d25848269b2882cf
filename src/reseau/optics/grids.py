"""Grids of wires as disjoint outlines, whose sum is exact at the crossings too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Mask
from ..core.errors import UsageError
from .formation import Outline, side_rule


@dataclass(frozen=True, eq=False)
class Wires:
    r"""Wires of one direction, each with its own angle, offset and slight bend, in columns.

    The centre line of a wire is :math:`c(t) = (o + b t^2/2)\,n + t\,u` with the unit vector u at its angle
    and n to the left of it.

    Parameters
    ----------
    angle : ndarray (w,)
        Direction, radians from x towards y.
    offset : ndarray (w,)
        Distance from the origin, to the left of the direction.
    bend : ndarray (w,)
        Curvature at t = 0.

    Examples
    --------
    >>> zero = np.zeros(2)
    >>> upright = Wires(np.full(2, np.pi / 2), np.array([5.0, -5.0]), zero)
    >>> level = Wires(np.array([0.0, 0.1]), np.array([4.0, -4.0]), zero)
    >>> level.crossings(upright).round(3).tolist()
    [[[-5.0, 4.0], [5.0, 4.0]], [[-5.0, -4.522], [5.0, -3.518]]]
    """

    angle: Array
    offset: Array
    bend: Array

    def __len__(self) -> int:
        return len(self.angle)

    def edge(self, wire: NDArray[np.intp], t: Array, side: Array | float) -> tuple[Array, Array]:
        """Points (…, 2) at the distance `side` to the left of the centre lines, and derivatives by t.

        Parameters
        ----------
        wire : ndarray of int
            Indices of the wires, broadcast against `t` and `side`.
        t : ndarray
            Parameters.
        side : ndarray or float
            Distances from the centre lines.
        """
        angle, offset, bend = self.angle[wire], self.offset[wire], self.bend[wire]
        u = np.stack(np.broadcast_arrays(np.cos(angle), np.sin(angle)), axis=-1)
        n = np.stack([-u[..., 1], u[..., 0]], axis=-1)
        centre = (offset + bend * t**2 / 2)[..., None] * n + np.asarray(t)[..., None] * u
        way = u + (bend * t)[..., None] * n
        speed = np.sqrt(1 + (bend * t) ** 2)
        left = np.stack([-way[..., 1], way[..., 0]], axis=-1) / speed[..., None]
        shift = np.broadcast_to(side, speed.shape)
        return centre + shift[..., None] * left, way * (1 - shift * bend / speed**3)[..., None]

    def meet(self, other: Wires, sides: tuple[float, Array | float] = (0.0, 0.0)) -> tuple[Array, Array]:
        """Parameters (w, v) at which the edges of these w wires and of v others intersect.

        Parameters
        ----------
        other : Wires
            The other wires.
        sides : (float, ndarray (w, v) or float)
            Distances of the edges from the centre lines of these and of the others.
        """
        i, j = np.meshgrid(np.arange(len(self)), np.arange(len(other)), indexing="ij")
        s, t = np.zeros(i.shape), np.zeros(i.shape)
        for _ in range(8):  # the first step is exact for straight wires
            here, along = self.edge(i, s, sides[0])
            there, across = other.edge(j, t, sides[1])
            gap = there - here
            step = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
            s = s + (gap[..., 0] * across[..., 1] - gap[..., 1] * across[..., 0]) / step
            t = t + (gap[..., 0] * along[..., 1] - gap[..., 1] * along[..., 0]) / step
        return s, t

    def crossings(self, other: Wires) -> Array:
        """Points (w, v, 2) at which the centre lines of these w wires cross those of v others."""
        s, _ = self.meet(other)
        return self.edge(np.arange(len(self))[:, None], s, 0.0)[0]


def wire_grid(
    upright: Wires,
    level: Wires,
    line_width: float,
    spacing: float,
    *,
    beyond: float = 0.0,
    broken: Mask | None = None,
) -> list[Outline]:
    """Divide wires of two directions into pieces that do not overlap, whatever their directions.

    The upright wires are whole; the level ones reach from the edge of one upright wire to that of the next.

    Parameters
    ----------
    upright, level : Wires
        c wires in the order in which each level wire crosses them, and r wires in the order in which each
        upright wire does.
    line_width : float
        Width of the wires.
    spacing : float
        Largest distance of two nodes of the quadrature; see :meth:`Outline.polygon`.
    beyond : float
        Length of the wires beyond the outermost crossings.
    broken : ndarray of bool (r, c), optional
        Missing crossings, with their wires up to half way to the next.

    Returns
    -------
    list of Outline
        Pieces of the upright wires, with the crossings, and of the level wires.

    Raises
    ------
    UsageError
        When the order is another, wires touch beside their crossings, or nothing is left.

    Examples
    --------
    >>> zero = np.zeros(2)
    >>> upright = Wires(np.full(2, np.pi / 2), np.array([5.0, -5.0]), zero)
    >>> level = Wires(np.array([0.0, 0.1]), np.array([-4.0, 4.0]), zero)
    >>> [piece.xy.shape[0] for piece in wire_grid(upright, level, 0.3, 0.5, beyond=2.0)]
    [2, 6]
    """
    half = line_width / 2
    s, t = level.meet(upright)
    whole = np.ones(s.shape, dtype=bool) if broken is None else ~broken
    if whole.shape != s.shape or not whole.any():
        raise UsageError(f"has no crossing; `broken` has the shape {whole.shape}", where="wire grid")
    gaps = np.diff(s, axis=1).min(initial=np.inf), np.diff(t, axis=0).min(initial=np.inf)
    if not min(gaps) > line_width:
        raise UsageError("must ascend along each other, by more than their width", where="wires of a grid")
    # The edge of an upright wire that a level wire enters, and the one at which it leaves it.
    turn = np.sign(np.sin(upright.angle[None] - level.angle[:, None]))
    parts, ends = [], []
    for j in range(len(upright)):
        for low, high, _, _ in _runs(t[:, j], whole[:, j], beyond + half):
            parts.append(j)
            ends.append([low, low, high, high])
    pieces = [_ribbons(upright, np.array(parts), np.array(ends), half, spacing)]
    enter, leave = (
        np.stack([level.meet(upright, (side, edge * turn * half))[0] for side in (-half, half)], axis=-1)
        for edge in (1.0, -1.0)
    )
    enter, leave = np.minimum(enter, leave), np.maximum(enter, leave)
    parts, ends = [], []
    for i in range(len(level)):
        for low, high, first, last in _runs(s[i], whole[i], beyond + half):
            starts = [np.array([low, low]), *leave[i, first : last + 1]]
            stops = [*enter[i, first : last + 1], np.array([high, high])]
            for start, stop in zip(starts, stops, strict=True):
                if (stop > start).all():
                    parts.append(i)
                    ends.append([*start, *stop])
    if parts:
        pieces.append(_ribbons(level, np.array(parts), np.array(ends), half, spacing))
    return pieces


def _runs(at: Array, whole: Mask, beyond: float) -> list[tuple[float, float, int, int]]:
    """Runs of crossings that exist along a wire: start and end of the wire, first and last crossing."""
    middle = np.concatenate([[at[0] - beyond], (at[1:] + at[:-1]) / 2, [at[-1] + beyond]])
    steps = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(int)))
    return [
        (float(middle[first]), float(middle[end]), int(first), int(end) - 1)
        for first, end in zip(steps[::2], steps[1::2], strict=True)
    ]


def _ribbons(wires: Wires, part: NDArray[np.intp], ends: Array, half: float, spacing: float) -> Outline:
    """Outlines of pieces of wires.

    Parameters
    ----------
    part : ndarray of int (m,)
        The wire of each piece.
    ends : ndarray (m, 4)
        Parameters of its corners: starts of the right and the left edge, ends of the right and the left one.
    """
    long = float((ends[:, 2:] - ends[:, :2]).max())
    along, weight = side_rule(long, spacing)
    corners = [wires.edge(part, ends[:, k], half * (1 if k % 2 else -1))[0] for k in range(4)]
    short = max(float(np.hypot(*(corners[k + 1] - corners[k]).T).max()) for k in (0, 2))
    over, part_of = side_rule(short, spacing)
    sides = []
    # Forward on the right edge, across the end, back on the left edge, across the start.
    for start, stop, side in ((0, 2, -half), (3, 1, half)):
        length = (ends[:, stop] - ends[:, start])[:, None]
        t = ends[:, start, None] + length * along
        xy, way = wires.edge(part[:, None], t, side)
        sides.append((xy, way * (length * weight)[..., None]))
        here, there = corners[stop], corners[3 if stop == 2 else 0]
        cap = (there - here)[:, None]
        sides.append((here[:, None] + over[:, None] * cap, part_of[:, None] * cap))
    return Outline(*(np.concatenate([each[k] for each in sides], axis=1) for k in (0, 1)))
