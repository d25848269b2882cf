"""Dots on chessboards that tell where a part of the board belongs.

On OpenCV's ``radon_checkerboard`` a few squares have a dot in the other colour. On a PuzzleBoard there is a
dot on each edge between two corners, black (0) or white (1). The bits of vertical edges in rows are those of
a 3 × 167 map, those of horizontal edges in columns of another; each window of 3 × 3 occurs once in a map, so
that the numbers of a row or column modulo 3 and modulo 167 follow from few bits.

Source: P. Stelldinger, N. Schönherr, J. Biermann, PuzzleBoard: A new camera calibration pattern with position
encoding, GCPR 2024 (arXiv:2409.20127), with the maps of its authors' generator.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array
from ..io.board import BoardDesign

_DOT = 0.34
"""Diameter of a dot in a square of OpenCV's board, in squares."""
_VERTICAL = (
    "05c3aa91ad8771488fc15fa64aeb87edacdf73d3d1",
    "30fdfe89078982230c0e351dd6ec90d31d47131ea4",
    "20a1d0f5f41242e9b3ad65925997b9c056fad987a3",
)
_HORIZONTAL = (
    "7d4fc29bc8264fc68ed211cf404e02f96bee96b272",
    "5989acec3512ac160705b0fab6c6792576ce65c719",
    "182a3d4b0c90187a3d95494bf405ad7f11ebb286ff",
)
"""Maps of 3 rows and 167 columns, the latter of horizontal edges with rows and columns exchanged."""
_LONG = 167
_PARTS = 12
"""Sides of a half disk."""


def _map(lines: tuple[str, ...]) -> NDArray[np.int8]:
    """A map (3, 167) of 1 and -1."""
    bits = [[int(bit) for bit in f"{int(line, 16):0{_LONG}b}"] for line in lines]
    return (2 * np.array(bits) - 1).astype(np.int8)


def puzzle_maps() -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Maps (3, 167) of 1 (white) and -1: of vertical edges by row and column, of horizontal ones the reverse.

    Examples
    --------
    >>> [map_.shape for map_ in puzzle_maps()]
    [(3, 167), (3, 167)]
    """
    return _map(_VERTICAL), _map(_HORIZONTAL)


def dot_signs(design: BoardDesign) -> NDArray[np.int8]:
    """What dots say of each place between corners: signs (2 c + 1, 2 r + 1) by twice the column and the row.

    The first corner is at (1, 1), c and r are the numbers of corners. Of a PuzzleBoard the places half way
    between corners have 1 for a white dot and -1 for a black one; of a chessboard with dots the middles of
    squares have 1 with and -1 without a dot. Elsewhere, and of boards without dots, it is 0.

    Examples
    --------
    >>> from reseau.designs import board
    >>> dot_signs(board("chess", 5, 5, 10.0, dots=((2, 1),)))[2:7:2, 2:7:2].T.tolist()
    [[-1, 1, -1], [-1, -1, -1], [-1, -1, -1]]
    >>> dot_signs(board("puzzle", 5, 5, 10.0))[1::2, 2].tolist()  # the first row of vertical edges
    [-1, -1, -1, -1]
    """
    columns, rows = design.columns - 1, design.rows - 1
    signs = np.zeros((2 * columns + 1, 2 * rows + 1), dtype=np.int8)
    if design.kind == "puzzle":
        x, y = np.arange(columns) + design.start[0], np.arange(rows) + design.start[1]
        vertical, horizontal = puzzle_maps()
        signs[1::2, 2:-1:2] = vertical[y[None, :-1] % 3, x[:, None] % _LONG]
        signs[2:-1:2, 1::2] = horizontal[x[:-1, None] % 3, y[None] % _LONG]
    elif design.dots:
        signs[2:-1:2, 2:-1:2] = -1
        signs[tuple(2 * np.array(design.dots).T)] = 1
    return signs


def dotted_squares(design: BoardDesign) -> tuple[list[Array], Array]:
    """Black squares less their white dots, as polygons, and black dots (n, 3): x, y, radius; y up."""
    row, column = np.divmod(np.arange(design.columns * design.rows), design.columns)
    black = (row + column) % 2 == (0 if design.dark_corner else 1)
    corner = np.stack([column[black], row[black]], axis=1)
    if design.kind == "chess":
        centre = np.array(design.dots, dtype=np.float64).reshape(-1, 2) - 0.5
        radius, first = _DOT / 2, 0 if design.dark_corner else 1
        inked = np.array([(c + r) % 2 == first for c, r in design.dots], dtype=bool)
        around = radius * _circle(4 * _PARTS)
        white = {(int(u + 0.5), int(v + 0.5)): at + around for (u, v), at in zip(centre, centre, strict=True)}
        polygons = []
        for square in corner:
            at = square - 1.0 + np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
            if (hole := white.get((int(square[0]), int(square[1])))) is not None:
                # One outline, with a cut from the corner to the dot and back.
                at = np.concatenate([at, at[:1], hole[::-1], hole[-1:]])
            polygons.append(at)
        dots = centre[~inked]
    else:
        assert design.size is not None
        signs, radius = dot_signs(design), design.size / design.pitch / 2
        polygons = [_puzzle_square(square, signs, radius) for square in corner]
        place = np.argwhere(signs < 0)
        dots = (place - 1) / 2
    scale = design.pitch * np.array([1.0, -1.0])
    rounds = np.column_stack([dots * scale, np.full(len(dots), radius * design.pitch)])
    return [polygon * scale for polygon in polygons], rounds


def _circle(count: int) -> Array:
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _puzzle_square(square: Array, signs: NDArray[np.int8], radius: float) -> Array:
    """Outline of a black square in corners, rows downwards, less white half dots; outer ones are halves."""
    most = (np.array(signs.shape) - 1) / 2 - 0.5
    corners = np.clip(square - 1.0 + np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), -0.5, most)
    outline = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        outline.append(a[None])
        middle = (a + b) / 2
        place = tuple(np.rint(2 * middle + 1).astype(int))
        if np.hypot(*(b - a)) > 0.9 and (np.array(place) < signs.shape).all() and signs[place] > 0:
            along, inwards = b - a, np.array([a[1] - b[1], b[0] - a[0]])
            angle = np.linspace(0, np.pi, 2 * _PARTS + 1)[:, None]
            outline.append(middle + radius * (-np.cos(angle) * along + np.sin(angle) * inwards))
    return np.concatenate(outline)


def halves_of_dots(design: BoardDesign) -> tuple[Array, Array]:
    """Parts of dots that lie in squares of the other colour: outlines (m, k, 2), y up, and their ink (m,).

    The ink is 1 for black parts in white squares, -1 for white ones in black squares.
    """
    signs = dot_signs(design)
    first = 0 if design.dark_corner else 1  # squares whose column and row add up to it are black
    found, ink = list[Array](), list[float]()
    # A polygon of the area of the half disk.
    angle = np.linspace(0, np.pi, _PARTS + 1)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.sqrt(np.pi / _PARTS / np.sin(np.pi / _PARTS))
    if design.kind == "chess":
        for column, row in design.dots:
            black = (column + row) % 2 == first
            half = _DOT / 2 * arc
            for part in (half, -half):
                found.append(np.array([column - 0.5, row - 0.5]) + part)
                ink.append(-1.0 if black else 1.0)
    else:
        assert design.size is not None
        radius = design.size / design.pitch / 2
        for u, v in np.argwhere(signs != 0):
            middle, along_x = np.array([u - 1, v - 1]) / 2, u % 2 == 0
            # Squares on both sides: below and above a horizontal edge, right and left of a vertical one.
            for side in (1, -1):
                square = (u // 2, (v + side) // 2) if along_x else ((u + side) // 2, v // 2)
                black = sum(map(int, square)) % 2 == first
                if black == (signs[u, v] < 0):
                    continue
                half = arc * [1, side] if along_x else arc[:, ::-1] * [side, 1]
                found.append(middle + radius * half)
                ink.append(-1.0 if black else 1.0)
    outlines = np.array(found).reshape(-1, _PARTS + 1, 2)
    return outlines * design.pitch * np.array([1.0, -1.0]), np.array(ink)
