"""Which corners or circles of a board are those found in a frame.

The lattice that has grown through a frame is laid on the design in all quarter turns and shifts. Nodes of the
design that should be in sight and were not found count against a place, and so do nodes found that the design
has not. Where several places are equally good, one is taken and the user is told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...designs.dots import dot_signs
from ...io.board import BoardDesign
from ...optics.composition import Chain
from ..plane.growth import first_mapping
from ..plane.lattice_mapping import images_of, slope_of
from ..reseau.disks import Disks
from ..reseau.mark_windows import Located
from ..reseau.sheet_placement import MOST_DISKS, disk_seeds, grown_disks
from .bits import Bits, Integers, read_bits
from .candidates import (
    Saddles,
    bright_between,
    crossed,
    ended,
    grown,
    sector_levels,
    seeds,
)
from .puzzles import MISREAD, QUARTER, PuzzlePart, part_of_code

_MISSED, _HIDDEN, _ENDED, _FOREIGN = 0.4, 1.5, 3.0, 3.0
"""What counts against a place: a node in sight that was not found; all of them at most, as one thing may hide
whole rows; one where the pattern is seen to end; one found that the design has not."""
_ALIKE = 2.0
"""Lead in nodes of a place over another from which it is certain."""
_FITS = 0.4
"""Least lead of the points found over what counts against their place, as their share.

A hand in front of a third of a board leaves 0.77, a grid of triangles at 60° 0.44. Of half a lattice behind a
strong lens, whose mapping does not tell where the rest should be, the best place is a wrong one, with 0.28.
"""
_MISREAD_DOTS = 2
"""Most squares of a chessboard with a dot too many or too few."""
_CHANCE = 1e-4
"""Largest probability that dots without any order agree as well with one of the places compared."""
_SEEDS = 40
_LARGER = 2.0
"""Ratio of the meshes of two lattices from which the second is another one, not the first in perspective."""
FEWEST = 6
"""Least number of corners that show a board."""
_ENOUGH = 0.6
"""Share of the corners of the board from which no other seed is tried."""
_PUZZLE = 40
"""Largest number of corners of a PuzzleBoard of unknown size, along an axis from any of them."""
SECOND = Remark("the frame shows the board more than once: one of them is measured", Code.SEVERAL_TARGETS)
NO_ROWS: Rows = np.zeros(0, dtype=np.intp)
_AROUND = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, 0.5], [-0.5, -0.5]])
"""Middles of the squares that meet in a node."""
THIRD = np.array([[-1, -1], [1, 0]])
"""A turn of a lattice of triangles, whose steps are at 60°."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Where the points of a board are, approximately, and what the user should know about their names."""

    located: Located
    notes: tuple[Remark, ...] = ()
    certain: bool = True
    """Whether the frame shows which points they are, except for turns by which the board equals itself."""


class _Points(Protocol):
    """Places of a frame that look like points of boards, in columns."""

    @property
    def xy(self) -> Array:
        """Positions (m, 2)."""

    def select(self, keep: Mask | Rows) -> Self:
        """Selected places."""


P = TypeVar("P", bound=_Points)


def laid_once(
    points: P, lay: Callable[[P], tuple[Placed | Failure, Rows]], design: BoardDesign
) -> Placed | Failure:
    """The board on the first lattice of points that its design explains.

    Parameters
    ----------
    points : Saddles, Disks or SixSectors
        Places that look like points of the board.
    lay : callable
        Where the board is if it is the largest lattice of some of them, and the rows of that lattice.
    design : BoardDesign
        The board.
    """
    best: Placed | Failure | None = None
    while True:
        found, rows = lay(points)
        if best is None:
            best = found
        elif len(rows) < _ENOUGH * len(design.ids):
            # The rest of the scene is no board.
            return best
        elif isinstance(best, Placed):
            return replace(best, notes=(*best.notes, SECOND)) if isinstance(found, Placed) else best
        elif isinstance(found, Placed):
            best = found
        if not len(rows):
            return best
        # Another one may be beside it, or in front of it.
        tree = scipy.spatial.KDTree(points.xy[rows])
        apart = tree.query(points.xy[rows], k=2)[0][:, 1]
        gap, nearest = tree.query(points.xy)
        points = points.select(gap > apart[nearest] / 2)


def failed(found: int, what: str) -> Failure:
    """Too few points were found."""
    return Failure(f"{found} {what} are too few to show the board", Code.NOT_FOUND)


def lay_chessboard(grey: NDArray[np.float32], saddles: Saddles, design: BoardDesign) -> Placed | Failure:
    """Find a chessboard among the saddles of a frame, and number its corners.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    saddles : Saddles
        Their saddles.
    design : BoardDesign
        A chessboard.
    """
    return laid_once(saddles, partial(_laid_on_corners, grey, design), design)


def _laid_on_corners(
    grey: NDArray[np.float32], design: BoardDesign, saddles: Saddles
) -> tuple[Placed | Failure, Rows]:
    """See :func:`laid_once`."""
    numbers, shape = design.nodes, (grey.shape[0], grey.shape[1])
    extent = int(numbers.max()) + 2
    best: tuple[Array, Rows, Chain] | None = None
    enough, mesh = _ENOUGH * len(numbers), 0.0
    for row, step in seeds(saddles)[:_SEEDS]:
        size = abs(float(np.linalg.det(step)))
        # Another board may be in the scene, or a picture of one: the largest in the frame comes first.
        if best is not None and len(best[0]) >= enough and size < _LARGER * mesh:
            continue
        found = grown(grey, saddles, first_mapping(step, saddles.xy[row], shape), extent)
        if best is None or len(found[0]) >= min(enough, len(best[0]) + 1):
            best, mesh = found, size
    least = min(FEWEST, len(numbers))
    if best is None or len(best[0]) < least:
        return failed(0 if best is None else len(best[0]), "corners in a lattice"), NO_ROWS
    nodes, rows, mapping = best
    # The sector of a corner between the steps to the right and downwards is black where the sum is even, as
    # the square there is the one of the upper left corner, moved diagonally.
    dark = dark_sectors(design)
    bright = bright_between(saddles.edges[rows], slope_of(mapping, nodes))
    even = nodes.sum(axis=1) % 2 == 0
    odd = (bright == even).mean() > 0.5

    def seen(nodes: Array) -> tuple[Array, Mask]:
        return sector_levels(grey, mapping, nodes), (nodes.sum(axis=1) % 2 == 0) == odd

    def cost(missing: Array) -> Array:
        levels, bright = seen(missing)
        return _costs(crossed(levels, bright), ended(levels, bright))

    coded = design.kind == "puzzle" or bool(design.dots)
    bits = read_bits(grey, mapping, nodes.astype(np.intp), design.kind == "puzzle") if coded else None
    known = nodes.astype(np.intp), saddles.xy[rows], mapping, shape, (dark, ~bright)
    # The dots of a PuzzleBoard tell more than nodes that were not found.
    plain = design.kind != "puzzle"
    ends = (lambda nodes: ended(*seen(nodes))) if plain else None
    placed = numbered(design, *known, cost if plain else None, bits, ends)
    if isinstance(placed, Failure) and design.kind == "puzzle" and bits is not None:
        part = part_of_code(known[0], bits, _mirrored(mapping))
        if not isinstance(part, Failure):
            placed = Failure(f"the frame shows {part}, others than the board has", Code.OTHER_DESIGN)
    return placed, rows


def find_puzzle(grey: NDArray[np.float32], saddles: Saddles) -> PuzzlePart | Failure:
    """Find out which part of the code of PuzzleBoards a frame shows.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    saddles : Saddles
        Their saddles.
    """
    shape, tried = (grey.shape[0], grey.shape[1]), np.zeros(len(saddles), dtype=bool)
    least, found = FEWEST, failed(0, "corners in a lattice")
    for row, step in seeds(saddles)[:_SEEDS]:
        if tried[row]:
            continue
        nodes, rows, mapping = grown(grey, saddles, first_mapping(step, saddles.xy[row], shape), _PUZZLE)
        tried[rows] = True
        if len(nodes) >= least:
            least, corners = len(nodes), nodes.astype(np.intp)
            part = part_of_code(corners, read_bits(grey, mapping, corners, True), _mirrored(mapping))
            if not isinstance(part, Failure):
                return part
            found = part
    return found


def _mirrored(mapping: Chain) -> bool:
    """Whether the axes of a lattice are anticlockwise in the image."""
    return bool(np.linalg.det(slope_of(mapping, np.zeros((1, 2)))[0]) < 0)


def cost_of(ink: float, paper: float) -> Callable[[Array, Mask], Array]:
    """What nodes in sight that were not found count against a place, by the levels (n, s) of their sectors.

    A node that is there (n) but was not found does not count.
    """
    limits = paper - 0.25 * (paper - ink), ink + 0.25 * (paper - ink)

    def cost(levels: Array, there: Mask) -> Array:
        return _costs(there, np.asarray(((levels > limits[0]) | (levels < limits[1])).all(axis=1)))

    return cost


def _costs(there: Mask, gone: Mask) -> Array:
    """What nodes that were not found count against a place: seen all the same, ended, or hidden."""
    return np.where(there, 0.0, np.where(gone, _ENDED, _MISSED))


def dark_sectors(design: BoardDesign) -> Mask:
    """Whether the square below and to the right of each corner is black."""
    if design.kind == "aprilgrid":
        # Of the lower right corner of a tag it is the small square beside it, of the upper left one the tag.
        return np.asarray(np.arange(len(design.nodes)) % 2 == 1)
    same: Mask = np.asarray(design.nodes.sum(axis=1) % 2 == 0)
    return same if design.dark_corner else ~same


def numbered(
    design: BoardDesign,
    nodes: NDArray[np.intp],
    xy: Array,
    mapping: Chain,
    shape: tuple[int, int],
    dark: tuple[Mask, Mask] | None,
    cost: Callable[[Array], Array] | None = None,
    bits: Bits | None = None,
    ends: Callable[[Array], Mask] | None = None,
) -> Placed | Failure:
    """Lay the lattice found on the design; `cost` of nodes not found, `bits` what dots tell.

    `ends` says at which nodes nothing is seen that the design has there.
    """
    lattice = _Lattice(design, nodes, mapping, shape)
    signs = None if bits is None else dot_signs(design)
    found: list[tuple[float, Integers, Integers]] = []
    for turn, shift, odd in lattice.ways():
        of = lattice.rows(turn, shift)
        there = of >= 0
        if dark is not None:
            # An odd quarter turn exchanges the sectors of a corner.
            agree = dark[0][of[there]] == dark[1][there] ^ odd
            if not len(agree) or agree.mean() < 0.5:
                continue
        score = there.sum() - lattice.lost(turn, shift, cost) - _FOREIGN * (~there).sum()
        if bits is not None and signs is not None:
            score -= _FOREIGN * bits.compared(signs, turn, shift)[0]
        found.append((float(score), turn, shift))
    if not found:
        return Failure("the lattice found does not agree with the board at any place", Code.OTHER_DESIGN)
    found.sort(key=lambda one: -one[0])
    score, turn, moved = found[0]
    if bits is not None and signs is not None:
        misread = _misread(design, *bits.compared(signs, turn, moved), len(found))
        if misread is not None:
            return misread
    of = lattice.rows(turn, moved)
    there = of >= 0
    seen_at = partial(lattice.seen_at, turn, moved)
    more = any(
        _mostly(seen_at(line), mapping, shape, partial(lattice.goes_on, cost))
        for line in _lines_around(design)
    )
    if score < _FITS * min(len(nodes), len(of)) or (more and design.kind != "puzzle"):
        return Failure(
            f"{len(nodes)} points in a lattice were found; the board has others, or more beside them",
            Code.OTHER_DESIGN,
        )
    lines = [seen_at(design.nodes[line]) for line in _lines_beside(design, of[there])]
    if ends is not None and any(_mostly(line, mapping, shape, ends) for line in lines):
        return Failure(
            f"{there.sum()} points in a lattice were found, and nothing beside them where the board has more",
            Code.OTHER_DESIGN,
        )
    count = len(design.nodes)
    seen, start = np.zeros(count, dtype=bool), np.zeros((count, 2))
    seen[of[there]], start[of[there]] = True, xy[there]
    frame, origin = _to_lattice(design, turn, moved + lattice.least)
    located = Located(design.ids, design.xy, design.polarity, mapping, frame, origin, seen, start)
    alike = [one for one in found[1:] if score - one[0] < _ALIKE]
    texts = []
    if turned := [one for one in alike if _same(lattice.numbers, (turn, moved), one[1:])]:
        texts.append(
            f"the board looks the same turned in {len(turned) + 1} ways: names are those of one of them"
        )
    if shifted := len(turned) < len(alike):
        texts.append(
            f"the frame shows a part of a regular pattern, which may be at "
            f"{len(alike) - len(turned) + 1} places of the board: names may be off by rows or columns"
        )
    return Placed(located, tuple(Remark(text, Code.AMBIGUOUS) for text in texts), not shifted)


def _same(numbers: Integers, place: tuple[Integers, Integers], other: tuple[Integers, Integers]) -> bool:
    """Whether the whole board, turned and moved from one place to the other, covers itself."""
    back = np.rint(np.linalg.inv(place[0])).astype(np.intp)
    there = (numbers - place[1]) @ back.T @ other[0].T + other[1]
    return set(map(tuple, there.tolist())) == set(map(tuple, numbers.tolist()))


def _misread(design: BoardDesign, wrong: int, total: int, places: int) -> Failure | None:
    """Why the dots that were read are not those of the board at the best of so many places."""
    puzzle = design.kind == "puzzle"
    if wrong > (MISREAD * total if puzzle else _MISREAD_DOTS):
        return Failure(
            f"{wrong} of {total} dots are not as on the board where it fits best", Code.OTHER_DESIGN
        )
    if puzzle and places * scipy.special.bdtr(wrong, total, 0.5) > _CHANCE:
        return Failure(f"{total} dots are too few to tell which part it is", Code.NOT_IDENTIFIED)
    return None


class _Lattice:
    """Nodes (n, 2) of a lattice that was found, and the places of a design on it."""

    def __init__(self, design: BoardDesign, nodes: Integers, mapping: Chain, shape: tuple[int, int]) -> None:
        self.design, self.nodes, self.mapping, self.shape = design, nodes, mapping, shape
        self.mirrored = _mirrored(mapping)
        # Diagonals of a staggered grid are halved: its nodes have columns and rows that are both even or odd.
        numbers = self._numbers(design.nodes)
        self.least = numbers.min(axis=0)
        self.numbers = numbers - self.least
        self.size = self.numbers.max(axis=0) + 1
        self.index = np.full(tuple(self.size), -1, dtype=np.intp)
        self.index[tuple(self.numbers.T)] = np.arange(len(numbers))
        self.low = nodes.min(axis=0)
        self.seen = np.zeros(tuple(np.ptp(nodes, axis=0) + 1), dtype=bool)
        self.seen[tuple((nodes - self.low).T)] = True

    def _numbers(self, nodes: Integers) -> Integers:
        """Columns and rows of the design as steps between nearest neighbours."""
        return np.asarray(nodes @ _lattice_of(self.design).T // (2 if self.design.staggered else 1))

    def ways(self) -> Iterator[tuple[Integers, Integers, bool]]:
        """Turns (2, 2) and shifts (2,) from nodes to the design; whether they exchange dark sectors."""
        once, turns = (THIRD, 3) if self.design.kind == "deltille" else (QUARTER, 4)
        for quarter in range(turns):
            # Rows of a design go downwards as those of a frame do.
            turn = np.linalg.matrix_power(once, quarter)
            turn = turn @ np.diag([-1, 1]) if self.mirrored else turn
            low, extent = (self.nodes @ turn.T).min(axis=0), np.ptp(self.nodes @ turn.T, axis=0) + 1
            spare = self.size - extent
            first, last = -low + np.minimum(spare, 0), -low + np.maximum(spare, 0)
            for shift in product(
                *(range(a, b + 1) for a, b in zip(first.tolist(), last.tolist(), strict=True))
            ):
                yield turn, np.array(shift), (quarter % 2 == 1) ^ self.mirrored

    def rows(self, turn: Integers, shift: Integers) -> Rows:
        """Rows (n,) of the design at the nodes, -1 where it has no point."""
        return _entries(self.index, self.nodes @ turn.T + shift, -1)

    def seen_at(self, turn: Integers, shift: Integers, line: Integers) -> Array:
        """Places in the lattice of columns and rows (m, 2) of the design."""
        back = np.linalg.inv(turn)
        return np.asarray(np.rint((self._numbers(line) - self.least - shift) @ back.T))

    def lost(self, turn: Integers, shift: Integers, cost: Callable[[Array], Array] | None) -> float:
        """What points of the design that are in sight, and were not found, count against a place."""
        at = self.seen_at(turn, shift, self.design.nodes)
        gone = at[~_entries(self.seen, at - self.low, False)]
        if not len(gone):
            return 0.0
        where = images_of(self.mapping, gone)
        sight = ((where > 2) & (where < np.array(self.shape[::-1]) - 3)).all(axis=1)
        each = (np.full(len(gone), _MISSED) if cost is None else cost(gone))[sight]
        hidden = each == _MISSED
        return float(each[~hidden].sum()) + min(float(each[hidden].sum()), _HIDDEN)

    def goes_on(self, cost: Callable[[Array], Array] | None, beyond: Array) -> Mask:
        """At which nodes beyond the design something is seen."""
        found: Mask = _entries(self.seen, beyond - self.low, False)
        # The last ones of a print are seen, but not always found.
        if cost is None or not found.any():
            return found
        return np.asarray(found | (cost(beyond) == 0), dtype=bool)


def _entries(table: NDArray[Any], at: Array | Integers, outside: Any) -> NDArray[Any]:
    """Entries (n,) of a table at places (n, 2), and what is `outside` of it."""
    at = at.astype(np.intp)
    inside: Mask = np.all((at >= 0) & (at < table.shape), axis=1)
    return np.asarray(np.where(inside, table[tuple(np.where(inside[:, None], at, 0).T)], outside))


def _lines_beside(design: BoardDesign, found: Rows) -> list[Rows]:
    """Points of the design in the row and the column next to those found, on all sides that have one."""
    nodes, lines = design.nodes, []
    low, high = nodes[found].min(axis=0), nodes[found].max(axis=0)
    inside = (nodes >= low) & (nodes <= high)
    for axis in range(2):
        step = 2 if design.staggered and axis == 0 else 1
        for away in (low[axis] - nodes[:, axis], nodes[:, axis] - high[axis]):
            line = np.flatnonzero((away > 0) & (away <= step) & inside[:, 1 - axis])
            lines += [line] if len(line) else []
    return lines


def _lines_around(design: BoardDesign) -> list[NDArray[np.intp]]:
    """Columns and rows (m, 2) of the lines that a larger board would have beside those of the design."""
    lines, step = list[NDArray[np.intp]](), 2 if design.staggered else 1
    for axis, sign in product(range(2), (1, -1)):
        moved = design.nodes + sign * step * np.eye(2, dtype=np.intp)[axis]
        beyond = sign * moved[:, axis] - (sign * design.nodes[:, axis]).max()
        lines.append(moved[(beyond > 0) & (beyond <= (step if axis == 0 else 1))])
    return lines


def _mostly(nodes: Array, mapping: Chain, shape: tuple[int, int], holds: Callable[[Array], Mask]) -> bool:
    """Whether it holds at most nodes (n, 2) of a line that are in sight with what surrounds them."""
    where = images_of(mapping, (nodes[:, None] + _AROUND).reshape(-1, 2)).reshape(-1, 4, 2)
    nodes = nodes[((where > 2) & (where < np.array(shape[::-1]) - 3)).all(axis=(1, 2))]
    return bool(len(nodes) and holds(nodes).mean() > 0.5)


def _to_lattice(design: BoardDesign, turn: Integers, shift: Integers) -> tuple[Array, Array]:
    """Lattice coordinates as a linear function of those of the design: frame (2, 2) and origin (2,)."""
    # turn · node + shift is the place in the design, of which a point is step · (column, −row).
    scale = _lattice_of(design) @ np.diag([1.0, -1.0] / design.step) / (2 if design.staggered else 1)
    back = np.linalg.inv(turn)
    return back @ scale, -back @ shift


def lay_circles(grey: NDArray[np.float32], disks: Disks, design: BoardDesign) -> Placed | Failure:
    """Find a grid of circles among the ellipses of a frame, and number them.

    The circles of an asymmetric grid lie on the diagonals of its rows and columns: the lattice that is grown
    has these as its steps.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values, in which circles are dark.
    disks : Disks
        The ellipses.
    design : BoardDesign
        A grid of circles.
    """
    disks = disks.strongest(MOST_DISKS * len(design.ids))
    return laid_once(disks, partial(_laid_on_circles, grey, design), design)


def _laid_on_circles(
    grey: NDArray[np.float32], design: BoardDesign, disks: Disks
) -> tuple[Placed | Failure, Rows]:
    """See :func:`laid_once`."""
    assert design.size is not None
    shape = (grey.shape[0], grey.shape[1])
    numbers = design.nodes @ _lattice_of(design).T // (2 if design.asymmetric else 1)
    step = design.pitch * (np.sqrt(2) if design.asymmetric else 1.0)
    extent = int(np.ptp(numbers, axis=0).max()) + 2
    best: tuple[Array, Rows, Chain] | None = None
    again = False
    for seed in disk_seeds(disks, 2 * step / design.size):
        if again and best is not None and seed[0] in best[1]:
            continue
        found = grown_disks(*seed, disks, shape, extent)
        # The other disks of a lattice that has grown twice from different seeds grow to the same.
        again |= best is not None and np.array_equal(np.sort(found[1]), np.sort(best[1]))
        if best is None or len(found[0]) > len(best[0]):
            best, again = found, False
        if len(best[0]) >= _ENOUGH * len(numbers):
            break
    if best is None or len(best[0]) < min(FEWEST, len(numbers)):
        width = f"circles with a diameter of {100 * design.size / design.pitch:.0f} % of the pitch"
        return failed(0 if best is None else len(best[0]), f"{width} in a lattice"), NO_ROWS
    nodes, rows, mapping = best

    def seen(nodes: Array) -> tuple[Array, Array, Array]:
        """How much darker nodes are than meshes around them, their levels, and the brightest mesh."""
        around, centre = (sector_levels(grey, mapping, nodes, share) for share in (0.5, 0.0))
        level = centre[:, 0]
        return np.asarray(np.median(around, axis=1) - level), level, around.max(axis=1)

    circle, _, paper = (float(np.median(each)) for each in seen(nodes))

    def gone(beyond: Array, *, beside: bool) -> Mask:
        """Whether there is no circle, but paper, in its place or beside it: a hand would hide both."""
        darker, level, brightest = seen(beyond)
        return np.asarray((darker < circle / 2) & ((brightest if beside else level) > paper - circle / 2))

    def cost(missing: Array) -> Array:
        # Those that are blurred or cut by something are seen, but not found as disks.
        return _costs(seen(missing)[0] > circle / 2, gone(missing, beside=False))

    def ended(beyond: Array) -> Mask:
        return gone(beyond, beside=True)

    known = nodes.astype(np.intp), disks.xy[rows], mapping, shape
    return numbered(design, *known, None, cost, ends=ended), rows


def _lattice_of(design: BoardDesign) -> Integers:
    """Integer matrix from columns and rows to steps between nearest neighbours; twice them if staggered."""
    if design.kind == "deltille":
        return np.array([[1, -1], [0, 2]])
    return np.array([[1, 1], [-1, 1]]) if design.asymmetric else np.eye(2, dtype=np.intp)
