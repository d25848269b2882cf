"""Prints of other programs' boards, as functions of the position on their plane.

Squares, markers and tags are black cells between lines along both axes; the ink in a sample is an integral of
the cells over it, which is bilinear between the lines. Words of markers are those of OpenCV's dictionaries.
Nothing of the project is used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from .pixels import Array, edge, per_sample

__all__ = ["Deltille", "Print", "aprilgrid", "charuco", "chess", "circles", "dotted", "markers", "puzzle"]

_COARSE = 16
"""Step of samples at which disks are looked for."""


@dataclass(frozen=True, eq=False)
class Print:
    """A board on paper.

    Parameters
    ----------
    ids : tuple of str
        Names of the points.
    xy : ndarray (n, 2)
        Their places, mm, y up.
    black : ndarray (m, 4)
        Black rectangles: left, lower, right and upper end. They do not overlap.
    disks : ndarray (k, 3)
        Black disks: x, y, radius.
    margin : float
        Paper around the ink, mm.
    white : ndarray (k, 3)
        Disks without ink, on top of everything: x, y, radius.
    symmetries : int
        1 if every point has its own name; else in how many ways the board looks the same.
    """

    ids: tuple[str, ...]
    xy: Array
    black: Array
    disks: Array = field(default_factory=lambda: np.zeros((0, 3)))
    margin: float = 8.0
    symmetries: int = 1
    white: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        ends = np.concatenate(
            [self.black[:, :2], self.black[:, 2:], self.disks[:, :2] - self.disks[:, 2:],
             self.disks[:, :2] + self.disks[:, 2:]]
        )  # fmt: skip
        lines = [np.unique(np.round(self.black[:, [k, k + 2]], 9)) for k in (0, 1)]
        known: dict[str, Any] = {"ends": (ends.min(axis=0) - self.margin, ends.max(axis=0) + self.margin)}
        if len(self.black):
            filled = np.zeros([len(line) for line in lines])
            at = [np.searchsorted(lines[k % 2], np.round(self.black[:, k], 9)) for k in range(4)]
            for a, b, c, d in zip(*at, strict=True):
                filled[a:c, b:d] += np.outer(np.diff(lines[0][a : c + 1]), np.diff(lines[1][b : d + 1]))
            # Ink to the left of and below each crossing of lines.
            total = np.zeros_like(filled)
            total[1:, 1:] = filled[:-1, :-1].cumsum(axis=0).cumsum(axis=1)
            # Share of ink in each cell between lines, and in those around them.
            shares = np.pad(filled[:-1, :-1] / np.outer(*map(np.diff, lines)), 1)
            known |= {"lines": lines, "total": total, "shares": shares}
        object.__setattr__(self, "_known", known)

    _known: Any = field(init=False, repr=False, default=None)

    def _below(self, x: Array, y: Array) -> Array:
        """Ink (mm²) to the left of and below positions."""
        part, row = [], []
        for line, at in zip(self._known["lines"], (x, y), strict=True):
            at = np.clip(at, line[0], line[-1])
            k = np.clip(np.searchsorted(line, at, side="right") - 1, 0, len(line) - 2)
            row.append(k)
            part.append((at - line[k]) / (line[k + 1] - line[k]))
        (i, j), (u, v), t = row, part, self._known["total"]
        low = (1 - u) * t[i, j] + u * t[i + 1, j]
        return np.asarray((1 - v) * low + v * ((1 - u) * t[i, j + 1] + u * t[i + 1, j + 1]))

    def _ink(self, x: Array, y: Array, half: list[Array]) -> Array:
        """Shares (h, w) of black rectangles in samples that reach by `half` along both axes."""
        inside, cell = np.ones(x.shape, dtype=bool), []
        for line, at, reach in zip(self._known["lines"], (x, y), half, strict=True):
            k = np.searchsorted(line, at, side="right")
            ends = np.concatenate([[-np.inf], line, [np.inf]])
            inside &= (at - reach >= ends[k]) & (at + reach <= ends[k + 1])
            cell.append(k)
        # Most samples are in one cell; only those over a line need an integral.
        ink = self._known["shares"][cell[0], cell[1]]
        x, y, p, q = (at[~inside] for at in (x, y, *half))
        a, b, c, d = x - p, y - q, x + p, y + q
        whole = self._below(c, d) - self._below(a, d) - self._below(c, b) + self._below(a, b)
        ink[~inside] = np.clip(whole / np.maximum((c - a) * (d - b), 1e-12), 0, 1)
        return np.asarray(ink)

    def printed(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Shares (h, w) of paper, and of ink on it, at places that follow each other closely."""
        half = [per_sample(at) / 2 for at in (x, y)]
        low, high = self._known["ends"]
        paper = np.ones(x.shape)
        for at, a, b, reach in ((x, low[0], high[0], half[0]), (y, low[1], high[1], half[1])):
            paper *= edge(np.minimum(at - a, b - at), 2 * reach)
        if not paper.any():
            return paper, np.zeros(x.shape)
        ink = self._ink(x, y, half) if len(self.black) else np.zeros(x.shape)
        # Where a disk is follows from few samples.
        few = [at[::_COARSE, ::_COARSE] for at in (x, y)]
        apart = sum(np.abs(np.gradient(at)).max(axis=0) for at in few) if min(few[0].shape) > 1 else np.inf
        for k, (u, v, radius) in enumerate(np.concatenate([self.disks, self.white])):
            rows = np.nonzero(np.maximum(np.abs(few[0] - u), np.abs(few[1] - v)) < radius + apart)
            if not rows[0].size:
                continue
            part = tuple(slice(max(0, (r.min() - 1) * _COARSE), (r.max() + 2) * _COARSE) for r in rows)
            dx, dy = x[part] - u, y[part] - v
            away = np.maximum(np.hypot(dx, dy), 1e-9)
            inside = edge(radius - away, np.maximum(per_sample(away), 1e-9))
            white = k >= len(self.disks)
            ink[part] = np.minimum(ink[part], 1 - inside) if white else np.maximum(ink[part], inside)
        return paper, ink

    def design(self) -> dict[str, Any]:
        """Points by name."""
        return {"ids": self.ids, "xy": self.xy.tolist()}


def _cells(
    dictionary: str, number: int, border: int, left: float, low: float, side: float, turns: int
) -> Any:
    """Black rectangles of a marker, turned by quarter turns to the left."""
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    n = words.markerSize + 2 * border
    black = np.rot90(cv2.aruco.generateImageMarker(words, number, n, None, border) == 0, turns)
    row, column = np.nonzero(black)
    cell = side / n
    x, y = left + cell * column, low + cell * (n - 1 - row)
    return np.column_stack([x, y, left + cell * (column + 1), low + cell * (n - row)])


def chess(columns: int, rows: int, side: float, dark_first: bool = True) -> Print:
    """A chessboard of squares; its inner corners row by row from the upper left."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    black = (row + column) % 2 == (0 if dark_first else 1)
    x, y = side * (column[black] - 1.0), -side * row[black].astype(float)
    square = np.column_stack([x, y, x + side, y + side])
    row, column = np.divmod(np.arange((columns - 1) * (rows - 1)), columns - 1)
    # With two odd or two even numbers a half turn changes nothing.
    ways = 2 if (columns + rows) % 2 == 0 else 1
    xy = side * np.stack([column, -row], axis=1)
    return Print(tuple(map(str, range(len(xy)))), xy.astype(float), square, symmetries=ways)


def dotted(columns: int, rows: int, side: float, squares: list[tuple[int, int]]) -> Print:
    """A chessboard with dots in some squares, as OpenCV's `gen_pattern.py` draws them (radius 0.17)."""
    plain = chess(columns, rows, side)
    dots = np.array([(side * (c - 0.5), side * (0.5 - r), 0.17 * side) for c, r in squares])
    bare = np.array([(c + r) % 2 == 1 for c, r in squares])
    return Print(plain.ids, plain.xy, plain.black, dots[bare], white=dots[~bare])


def puzzle(side: float, vertical: Any, horizontal: Any, dark_first: bool = True) -> Print:
    """A PuzzleBoard: a chessboard with a dot on each edge, of a third of its length, white for true bits.

    `vertical` (r - 1, c) are the bits below the corners of each row, `horizontal` (r, c - 1) those beside
    them.
    """
    rows, columns = len(horizontal), len(vertical[0])
    plain = chess(columns + 1, rows + 1, side, dark_first)
    ends = np.array([[-0.5, 0.5 - rows, columns - 0.5, 0.5]]) * side
    low, high = np.maximum(plain.black[:, :2], ends[0, :2]), np.minimum(plain.black[:, 2:], ends[0, 2:])
    dots = [(c, -r - 0.5, bit) for r, line in enumerate(vertical) for c, bit in enumerate(line)]
    dots += [(c + 0.5, -r, bit) for r, line in enumerate(horizontal) for c, bit in enumerate(line)]
    at = np.array(dots)
    disks = np.column_stack([side * at[:, :2], np.full(len(at), side / 6)])
    true = at[:, 2] > 0
    return Print(plain.ids, plain.xy, np.hstack([low, high]), disks[~true], white=disks[true])


def charuco(
    columns: int, rows: int, side: float, marker: float, dictionary: str, legacy: bool = False
) -> Print:
    """A ChArUco board; in the old layout with an even number of rows, the upper left square is white."""
    plain = chess(columns, rows, side, not (legacy and rows % 2 == 0))
    row, column = np.divmod(np.arange(columns * rows), columns)
    white = (row + column) % 2 == (0 if legacy and rows % 2 == 0 else 1)
    away = (side - marker) / 2
    parts = [
        _cells(dictionary, k, 1, side * (c - 1) + away, -side * r + away, marker, 0)
        for k, (r, c) in enumerate(zip(row[white], column[white], strict=True))
    ]
    return Print(plain.ids, plain.xy, np.concatenate([plain.black, *parts]))


def aprilgrid(columns: int, rows: int, size: float, spacing: float, dictionary: str, border: int) -> Print:
    """Kalibr's grid: tag 0 is at the lower left; corners anticlockwise from the lower left."""
    pitch, gap = size * (1 + spacing), size * spacing
    parts, names, xy = [], [], []
    for k in range(columns * rows):
        x, y = pitch * (k % columns), pitch * (k // columns)
        # Kalibr's words are OpenCV's turned upside down.
        parts.append(_cells(dictionary, k, border, x, y, size, 2))
        names += [f"{k}.{corner}" for corner in range(4)]
        xy += [(x, y), (x + size, y), (x + size, y + size), (x, y + size)]
    for k in range((columns + 1) * (rows + 1)):
        x, y = pitch * (k % (columns + 1)) - gap, pitch * (k // (columns + 1)) - gap
        parts.append(np.array([[x, y, x + gap, y + gap]]))
    return Print(tuple(names), np.array(xy), np.concatenate(parts))


def markers(columns: int, rows: int, size: float, gap: float, dictionary: str) -> Print:
    """A grid of separate markers as OpenCV's: row by row from the upper left, corners clockwise."""
    parts, names, xy = [], [], []
    for k in range(columns * rows):
        x, y = (size + gap) * (k % columns), -(size + gap) * (k // columns)
        parts.append(_cells(dictionary, k, 1, x, y - size, size, 0))
        names += [f"{k}.{corner}" for corner in range(4)]
        xy += [(x, y), (x + size, y), (x + size, y - size), (x, y - size)]
    return Print(tuple(names), np.array(xy), np.concatenate(parts))


def circles(columns: int, rows: int, pitch: float, size: float, asymmetric: bool = False) -> Print:
    """Disks row by row from the upper left; every second row is shifted if asymmetric."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    xy = pitch * np.stack([2 * column + row % 2 if asymmetric else column, -row], axis=1).astype(float)
    disks = np.column_stack([xy, np.full(len(xy), size / 2)])
    # An asymmetric grid with an odd number of rows equals itself turned by 180° if its rows do.
    ways = (2 if rows % 2 else 1) if asymmetric else (4 if columns == rows else 2)
    return Print(tuple(map(str, range(len(xy)))), xy, np.zeros((0, 4)), disks, 20.0, ways)


@dataclass(frozen=True, eq=False)
class Deltille:
    """A grid of equilateral triangles: black ones point upwards; corners row by row from the upper left.

    Triangles lie between three families of lines, of which each changes the colour; the grid ends with a
    rectangle.

    Parameters
    ----------
    columns, rows : int
        Numbers of corners; every second row is shifted to the right by half a side.
    side : float
        Of a triangle, mm.
    """

    columns: int
    rows: int
    side: float
    symmetries: int = 1

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the corners."""
        return tuple(map(str, range(self.columns * self.rows)))

    @property
    def xy(self) -> Array:
        """Their places (n, 2), y up."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        return np.stack([self.side * (column + 0.5 * (row % 2)), -self.side * np.sqrt(3) / 2 * row], axis=1)

    @property
    def _ends(self) -> tuple[Array, Array]:
        return self.xy.min(axis=0), self.xy.max(axis=0)

    def printed(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Shares (h, w) of paper, and of ink on it, at places that follow each other closely."""
        high, sign = self.side * np.sqrt(3) / 2, np.ones(x.shape)
        for angle in np.deg2rad([90.0, 210.0, 330.0]):
            away = (x * np.cos(angle) + y * np.sin(angle)) / high
            line = np.rint(away)
            inside = (away - line) / np.maximum(per_sample(away), 1e-9)
            sign *= (2 * edge(inside, 1.0) - 1) * np.where(line % 2 == 0, 1, -1)
        # No further corners of a row fit into half a side.
        low, top = (
            v + s * np.array([0.45 * self.side, high]) for v, s in zip(self._ends, (-1, 1), strict=True)
        )
        within, paper = np.ones(x.shape), np.ones(x.shape)
        for at, a, b in ((x, low[0], top[0]), (y, low[1], top[1])):
            step = np.maximum(per_sample(at), 1e-9)
            within *= edge(np.minimum(at - a, b - at) / step, 1.0)
            paper *= edge(np.minimum(at - a, b - at) / step + self.side / step, 1.0)
        # Between the upward edges of a corner one sign is positive and two are not: that is white.
        return paper, within * (1 - sign) / 2

    def design(self) -> dict[str, Any]:
        """Points by name."""
        return {"ids": self.ids, "xy": self.xy.tolist()}
