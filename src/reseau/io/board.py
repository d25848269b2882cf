"""``reseau-board/1``: chessboards, PuzzleBoards, deltilles, ChArUco boards, circles, grids of tags."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..core.data import Array
from .document import Document

BoardKind = Literal["chess", "puzzle", "deltille", "charuco", "circles", "aprilgrid", "markers"]
Length = Annotated[float, Field(gt=1e-6, le=1e6)]
Count = Annotated[int, Field(ge=1, le=1000)]

_FEWEST = {"chess": 3, "puzzle": 4, "deltille": 3, "charuco": 2, "circles": 2, "aprilgrid": 1, "markers": 1}
_TAGGED = ("aprilgrid", "markers")
_MARKED = ("charuco", *_TAGGED)
_SQUARED = ("chess", "puzzle", "charuco")
_PLAIN = ("chess", "deltille")
PUZZLE_CODE = 501
"""Number of corners after which the code of a PuzzleBoard repeats."""


class BoardDesign(Document):
    """``reseau-board/1``: a board of one regular pattern, in millimetres.

    Names are those of the programs that the boards come from, coordinates have y up: the inner corners of a
    chessboard, a PuzzleBoard or a ChArUco board are numbered row by row from the upper left, and so are
    circles and the corners of a deltille (a grid of equilateral triangles, of which every second row of
    corners is shifted to the right by half a side), with the origin at the first; each tag of an AprilGrid
    has the corners ``tag.0`` … ``tag.3``, anticlockwise from the lower left, with the origin at the lower
    left of the first tag, which is the lower left one; each marker of a grid of OpenCV (`markers`: ArUco
    markers or AprilTags that touch nothing) has the corners clockwise from the upper left, with the origin
    at the upper left of the first marker, the upper left one.

    Parameters
    ----------
    kind : {"chess", "puzzle", "deltille", "charuco", "circles", "aprilgrid", "markers"}
        The pattern; a single marker is a grid of 1 × 1.
    columns, rows : int
        Number of squares, of circles, of corners of a deltille, or of tags. The outer squares of a
        PuzzleBoard are halves: its generator counts the corners, one less.
    pitch : float
        Side of a square or a triangle; distance of neighbouring circles in a row, or of the rows of an
        asymmetric grid; distance of tags from centre to centre.
    size : float, optional
        Diameter of a circle or of the dots of a PuzzleBoard, or side of a marker or a tag with its border.
    dictionary : str, optional
        Dictionary of the markers, as OpenCV names it: ``DICT_5X5_100``.
    first_id : int
        Number of the first marker.
    border_bits : int
        Width of the black border of a marker in bits.
    legacy : bool
        Whether a ChArUco board has the layout of OpenCV before 4.6: with an even number of rows, its upper
        left square is white.
    polarity : {"dark", "bright"}
        Whether circles are dark on bright ground, or bright on dark ground, as holes before a lamp.
    asymmetric : bool
        Whether every second row of circles is shifted by half a step; `pitch` is half their distance in a
        row, as in OpenCV.
    dots : tuple of (int, int)
        Squares of a chessboard (column, row from 0) with a dot in the other colour, 0.34 squares wide, as
        OpenCV's ``radon_checkerboard`` has three: they tell where a part of the board belongs.
    start : (int, int)
        Column and row of the first corner of a PuzzleBoard in its code of 501 × 501 corners.

    Examples
    --------
    >>> board = BoardDesign(name="print", unit="mm", kind="chess", columns=4, rows=3, pitch=25.0)
    >>> board.ids, board.xy[-1].tolist()
    (('0', '1', '2', '3', '4', '5'), [50.0, -25.0])
    >>> grid = BoardDesign(name="print", unit="mm", kind="deltille", columns=3, rows=3, pitch=20.0)
    >>> grid.xy[[1, 3]].round(2).tolist()
    [[20.0, -0.0], [10.0, -17.32]]
    """

    SCHEMA: ClassVar[str] = "reseau-board/1"
    LEFT_OUT: ClassVar[dict[str, Any]] = {"exclude_defaults": True}
    name: str
    unit: Literal["mm"]
    kind: BoardKind
    columns: Count
    rows: Count
    pitch: Length
    size: Length | None = None
    dictionary: str | None = None
    first_id: Annotated[int, Field(ge=0)] = 0
    border_bits: Annotated[int, Field(ge=1, le=4)] = 1
    legacy: bool = False
    polarity: Literal["dark", "bright"] = "dark"
    asymmetric: bool = False
    dots: tuple[tuple[int, int], ...] = ()
    start: tuple[int, int] = (0, 0)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        fewest = _FEWEST[self.kind]
        if min(self.columns, self.rows) < fewest:
            raise ValueError(f"a board of kind {self.kind!r} has at least {fewest} columns and rows")
        if (self.size is None) != (self.kind in _PLAIN):
            raise ValueError(f"`size` is {'needed' if self.size is None else 'unknown'} for {self.kind!r}")
        if (self.dictionary is not None) != (self.kind in _MARKED):
            raise ValueError(
                f"`dictionary` is {'needed' if self.dictionary is None else 'unknown'} for {self.kind!r}"
            )
        if self.size is not None and self.size >= self._room:
            raise ValueError(f"`size` ({self.size:g}) must be less than the space for it ({self._room:g})")
        if self.legacy and self.kind != "charuco":
            raise ValueError("`legacy` is for ChArUco boards")
        if self.asymmetric and self.kind != "circles":
            raise ValueError("`asymmetric` is for circles")
        if self.polarity != "dark" and self.kind != "circles":
            raise ValueError("`polarity` is for circles")
        if self.dots and self.kind != "chess":
            raise ValueError("`dots` are for chessboards")
        for column, row in self.dots:
            if not (0 < column < self.columns - 1 and 0 < row < self.rows - 1):
                raise ValueError(f"the dot in square ({column}, {row}) is not inside the outer squares")
        if self.start != (0, 0) and self.kind != "puzzle":
            raise ValueError("`start` is for PuzzleBoards")
        ends = [first + n - 1 for first, n in zip(self.start, (self.columns, self.rows), strict=True)]
        if self.kind == "puzzle" and (min(self.start) < 0 or max(ends) > PUZZLE_CODE):
            raise ValueError(f"a PuzzleBoard lies within {PUZZLE_CODE} × {PUZZLE_CODE} corners")
        return self

    @property
    def _room(self) -> float:
        return self.pitch * (np.sqrt(2) if self.asymmetric else 1.0)

    @property
    def staggered(self) -> bool:
        """Whether every second row is shifted by half a step: asymmetric circles and deltilles."""
        return self.asymmetric or self.kind == "deltille"

    @property
    def step(self) -> Array:
        """Distance (2,) of the columns and of the rows of nodes."""
        triangles = self.kind == "deltille"
        return self.pitch * np.array([0.5, np.sqrt(0.75)] if triangles else [1.0, 1.0])

    @property
    def nodes(self) -> NDArray[np.intp]:
        """Column and row (n, 2) of each point, rows downwards.

        Corners are counted in corners, the corners of tags in columns and rows of these. Columns of a
        staggered grid are steps of half the distance of its points in a row.
        """
        columns, rows = self.columns, self.rows
        if self.kind in _SQUARED:
            columns, rows = columns - 1, rows - 1
        if self.kind in _TAGGED:
            tag = np.arange(columns * rows)
            corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
            along = 2 * np.stack([tag % columns, tag // columns], axis=1)[:, None] + corner
            # Kalibr counts upwards, OpenCV downwards.
            up = -1 if self.kind == "aprilgrid" else 1
            return np.asarray(along.reshape(-1, 2) * [1, up], dtype=np.intp)
        row, column = np.divmod(np.arange(columns * rows), columns)
        if self.staggered:
            column = 2 * column + row % 2
        return np.stack([column, row], axis=1).astype(np.intp)

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points."""
        if self.kind in _TAGGED:
            tags = self.first_id + np.arange(self.columns * self.rows)
            return tuple(f"{tag}.{corner}" for tag in tags.tolist() for corner in range(4))
        return tuple(map(str, range(len(self.nodes))))

    @property
    def xy(self) -> Array:
        """Coordinates of the points (n, 2), y up."""
        if self.kind in _TAGGED:
            assert self.size is not None
            tag, corner = np.divmod(np.abs(self.nodes), 2)
            up = 1 if self.kind == "aprilgrid" else -1
            return np.asarray((tag * self.pitch + corner * self.size) * [1, up])
        return np.asarray(self.nodes * self.step * [1, -1], dtype=np.float64)

    @property
    def dark_corner(self) -> bool:
        """Whether the upper left square of a chessboard, a PuzzleBoard or a ChArUco board is black."""
        if self.kind == "puzzle":
            return sum(self.start) % 2 == 0
        return not (self.legacy and self.rows % 2 == 0)

    @property
    def markers(self) -> tuple[NDArray[np.intp], Array]:
        """Numbers (m,) of the markers, and their corners (m, 4, 2), y up, clockwise from the upper left."""
        if self.kind not in _MARKED:
            return np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2))
        assert self.size is not None
        around = self.size / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1.0]])
        if self.kind in _TAGGED:
            tag, up = np.arange(self.columns * self.rows), 1 if self.kind == "aprilgrid" else -1
            centre = self.pitch * np.stack([tag % self.columns, tag // self.columns], axis=1) + self.size / 2
            centre = centre * [1, up]
        else:
            row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
            white = (row + column) % 2 == (1 if self.dark_corner else 0)
            centre = self.pitch * np.stack([column[white] - 0.5, 0.5 - row[white]], axis=1)
        numbers = self.first_id + np.arange(len(centre))
        return numbers.astype(np.intp), np.asarray(centre[:, None] + around)
