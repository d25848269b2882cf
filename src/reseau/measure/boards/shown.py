"""What a frame shows of regular patterns, whatever the design: lattices of corners or circles, and markers.

The designs that follow from it are explanations of the frame: which of them is right, other photographs tell.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Frame, Rows
from ...core.failure import Failure
from ...core.threads import one_thread
from ...designs.boards import board
from ...io.board import BoardDesign, BoardKind
from ...optics.composition import Chain
from ..mosaic import balanced
from ..plane.growth import first_mapping
from ..plane.lattice_mapping import slope_of
from ..reseau.disks import Disks, find_disks
from ..reseau.sheet_placement import disk_seeds, grown_disks
from ..screening import screen
from .bits import Integers
from .candidates import Saddles, find_saddles, grown, seeds
from .deltilles import lattice_of_deltille
from .markers import ReadMarkers, markers_of_any_dictionary
from .placement import THIRD
from .tags import with_seen_edges

_SIDE_MM = 25.0
"""Distance of the points of a board of which nothing is known."""
_MOST = 40
"""Largest number of columns and rows."""
_SEEDS = 40
_FEWEST, _FEWEST_MARKERS = 12, 4
"""Least number of points, and of markers, that show a board."""
_REACHES = (2.7, 4.0, 6.5)
"""Distances of circles in radii, of which neighbouring ones are near enough to each other to find all."""
_POLARITIES: tuple[tuple[Literal["dark", "bright"], int], ...] = (("dark", 1), ("bright", -1))
_HALF = 0.5
"""Share of a line of a lattice that is seen, from which it belongs to the board."""
_AGREE = 0.006
"""Largest distance of markers from their places in a layout, as a share of the frame: lenses bend it."""
_NESTED = (50, 100, 250, 1000)
"""Sizes of the dictionaries of one series, of which the larger ones contain the smaller ones."""


def boards_shown(frame: Frame) -> list[BoardDesign]:
    """Boards of which a frame may show the whole, those with markers first; their size is not known.

    Parameters
    ----------
    frame : Frame
        A photograph.

    Examples
    --------
    >>> squares = np.indices((5, 6)).sum(axis=0) % 2 * 160 + 30
    >>> sheet = np.pad(np.kron(squares, np.ones((20, 20))), 30, constant_values=190)
    >>> sheet = cv2.GaussianBlur(sheet, (0, 0), 0.8)
    >>> sheet += np.random.default_rng(0).normal(0, 1, sheet.shape)
    >>> [(each.kind, each.columns, each.rows) for each in boards_shown(Frame(sheet, 255.0))]
    [('chess', 6, 5)]
    """
    with one_thread():
        frame = balanced(frame)
        screened = screen(frame, None)
        if isinstance(screened, Failure):
            return []
        grey, saddles = screened.grey, find_saddles(screened.grey, screened.noise)
        marked = _marked(markers_of_any_dictionary(frame, grey, saddles), grey.shape)
        if marked:
            return marked
        chess = _chessboard(grey, saddles) or _chessboard(grey, with_seen_edges(grey, saddles))
        if chess is not None:
            return [chess]
        most, circles = 0, list[BoardDesign]()
        for polarity, sign in _POLARITIES:
            disks = find_disks(sign * grey, screened.valid, screened.noise)
            for nodes, rows, mapping in _lattices_of_disks(disks, grey.shape):
                if len(nodes) > most:
                    most, circles = len(nodes), list(_circles(nodes, rows, mapping, disks, polarity))
        return circles or _deltilles(lattice_of_deltille(grey, screened.noise, _MOST))


def _deltilles(nodes: Integers) -> list[BoardDesign]:
    """A deltille in that of its three directions in which its nodes (m, 2) fill a rectangle best, or none."""
    best, most = list[BoardDesign](), 0.0
    for turn in range(3):
        # Columns in halves of the distance of corners in a row, and rows.
        turned = nodes @ np.linalg.matrix_power(THIRD, turn).T @ np.array([[2, 0], [1, 1]])
        filled = _filled(turned, 2)
        wide, high = (np.ptp(filled, axis=0) + 1).tolist() if len(filled) >= _FEWEST else (0, 0)
        if min(wide / 2, high) < 3:
            continue
        # Each corner in a rectangle speaks for it, each place without one against it.
        if (lead := _lead(filled, 0.5)) > most:
            best, most = [board("deltille", (wide + 1) // 2, high, _SIDE_MM)], lead
    return best


def _chessboard(grey: NDArray[np.float32], saddles: Saddles) -> BoardDesign | None:
    """The largest lattice of corners of squares, as a chessboard."""
    shape, tried = (grey.shape[0], grey.shape[1]), np.zeros(len(saddles), dtype=bool)
    best: Integers = np.zeros((0, 2), dtype=np.intp)
    for row, step in seeds(saddles)[:_SEEDS]:
        if tried[row]:
            continue
        nodes, rows, _ = grown(grey, saddles, first_mapping(step, saddles.xy[row], shape), _MOST)
        tried[rows] = True
        if len(nodes) > len(best):
            best = nodes.astype(np.intp)
    best = _filled(best)
    if len(best) < _FEWEST:
        return None
    columns, rows = (np.ptp(best, axis=0) + 2).tolist()
    return board("chess", columns, rows, _SIDE_MM)


def _filled(nodes: Integers, step: int = 1) -> Integers:
    """Nodes (m, 2) of a lattice without outer lines of which little is seen; `step` is that of columns."""
    while len(nodes):
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        for axis, end in ((0, low), (0, high), (1, low), (1, high)):
            line, other = nodes[:, axis] == end[axis], 1 - axis
            if line.sum() < _HALF * (high[other] - low[other] + 1) / step:
                nodes = nodes[~line]
                break
        else:
            break
    # A line alone is no lattice.
    return nodes if len(nodes) and np.ptp(nodes, axis=0).min() > 0 else nodes[:0]


def _lead(nodes: Integers, filled: float = 1.0) -> float:
    """Nodes (m, 2) on a grid less the empty places of its outline, of which a share is `filled`."""
    return 2 * len(nodes) - filled * float((np.ptp(nodes, axis=0) + 1).prod()) if len(nodes) else 0.0


def _lattices_of_disks(disks: Disks, shape: tuple[int, ...]) -> Iterator[tuple[Integers, Rows, Chain]]:
    for reach in _REACHES:
        for seed in disk_seeds(disks, reach):
            nodes, rows, mapping = grown_disks(*seed, disks, (shape[0], shape[1]), _MOST)
            if len(nodes) >= _FEWEST:
                yield nodes.astype(np.intp), rows, mapping
                break


def _circles(
    nodes: Integers, rows: Rows, mapping: Chain, disks: Disks, polarity: Literal["dark", "bright"]
) -> Iterator[BoardDesign]:
    """Grids of circles, regular or with every second row shifted, whichever fills its outline better."""
    slope = np.abs(np.linalg.det(slope_of(mapping, nodes.astype(np.float64))))
    size = 2 * float(np.median(np.sqrt(np.linalg.det(disks.form[rows]) / slope)))
    # The diagonals of a shifted grid are its rows and columns.
    straight, shifted = _filled(nodes), _filled(nodes @ np.array([[1, 1], [-1, 1]]), 2)
    # Each circle on a grid speaks for it, each place without a circle against it.
    regular, diagonal = _lead(straight), _lead(shifted, 0.5)
    if max(regular, diagonal) <= 0:
        return
    if regular >= diagonal:
        columns, high = (np.ptp(straight, axis=0) + 1).tolist()
        yield board("circles", columns, high, _SIDE_MM, size=size * _SIDE_MM, polarity=polarity)
        return
    ends = (np.ptp(shifted, axis=0) + 1).tolist()
    for wide, high in (ends, ends[::-1]):
        if wide % 2 == 0 and wide > 2:  # one column is no grid
            yield board(
                "circles", wide // 2, high, _SIDE_MM, size=np.sqrt(2) * size * _SIDE_MM, polarity=polarity,
                asymmetric=True,
            )  # fmt: skip


def _marked(found: list[ReadMarkers], shape: tuple[int, ...]) -> list[BoardDesign]:
    """Boards in whose layouts the markers lie that were read; those with most of them."""
    limit, best = max(3.0, _AGREE * max(shape)), list[tuple[int, BoardDesign]]()
    for read in found:
        if len(read.numbers) < _FEWEST_MARKERS or (best and len(read.numbers) <= best[0][0]):
            continue
        best = sorted([*best, *_layouts(read, limit)], key=lambda each: -each[0])
    # Half of the markers read lie in no layout by chance.
    return [each for count, each in best if count == best[0][0]][:2]


def _layouts(read: ReadMarkers, limit: float) -> Iterator[tuple[int, BoardDesign]]:
    """Layouts of a dictionary in which markers lie, and how many do."""
    centres, most = _middles(read.corners), max(_FEWEST_MARKERS, _HALF * len(read.numbers))
    for columns in range(1, _MOST):
        for design in _of_columns(read, columns):
            of = {int(number): k for k, number in enumerate(design.markers[0])}
            places = design.markers[1][[of[int(number)] for number in read.numbers]] / design.pitch
            matrix, agree = cv2.findHomography(places.mean(axis=1), centres, cv2.RANSAC, limit)
            if matrix is None or (count := int(agree.sum())) < most:
                continue
            good = agree.ravel() > 0
            # The corners in the plane of the board tell how markers are turned, and their size.
            seen = cv2.perspectiveTransform(read.corners[good], np.linalg.inv(matrix))
            sides = seen - seen.mean(axis=1, keepdims=True)
            own = places[good] - places[good].mean(axis=1, keepdims=True)
            unit = own / np.abs(own) / 2
            size = float(np.median((sides * unit).sum(axis=(1, 2)) / (unit**2).sum(axis=(1, 2))))
            if (sides * own).sum() < _HALF * np.linalg.norm(sides) * np.linalg.norm(own) or not 0 < size < 1:
                continue
            yield count, design.model_copy(update={"size": round(size * design.pitch, 3)})


def _of_columns(read: ReadMarkers, columns: int) -> Iterator[BoardDesign]:
    """Boards with this number of columns that have the markers which were read, and no further row."""
    last = int(read.numbers.max())
    name, _, count = read.dictionary.rpartition("_")
    if count == str(_NESTED[-1]):
        count = next(str(n) for n in _NESTED if last < n)
    options = {"dictionary": f"{name}_{count}", "border_bits": read.border_bits}
    if not read.touching and columns > 1:
        for legacy in (False, True):
            for rows in range(2, _MOST):
                # The markers of two rows are as many as columns; of odd numbers the first row may have less.
                one = board(
                    "charuco", columns, rows, _SIDE_MM, legacy=legacy, dictionary="DICT_ARUCO_ORIGINAL"
                )
                if len(one.markers[0]) > last and not (legacy and rows % 2):
                    yield one.model_copy(update=options)
                    break
    kind: BoardKind = "aprilgrid" if read.touching else "markers"
    one = board(kind, columns, 1, _SIDE_MM, dictionary="DICT_ARUCO_ORIGINAL")
    yield one.model_copy(update={"rows": last // columns + 1, **options})


def _middles(corners: Array) -> Array:
    """Where the diagonals of quadrangles (m, 4, 2) meet: the images of the middles of squares."""
    ends = np.concatenate([corners, np.ones((len(corners), 4, 1))], axis=2)
    one, two = np.cross(ends[:, 0], ends[:, 2]), np.cross(ends[:, 1], ends[:, 3])
    at = np.cross(one, two)
    return np.asarray(at[:, :2] / at[:, 2:])
