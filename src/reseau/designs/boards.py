"""Boards that other programs use: chessboards, PuzzleBoards, deltilles, ChArUco, circles, AprilGrids."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from ..core.data import Array
from ..core.errors import UsageError
from ..io.board import BoardDesign, BoardKind
from .dots import dotted_squares

_SIZES = {"puzzle": 1 / 3, "charuco": 0.75, "circles": 0.5, "aprilgrid": 1 / 1.3, "markers": 0.8}
"""Sizes of dots, markers, circles and tags in pitches, where none is given; tags are 0.3 of a side apart."""
_USUAL_MM, _UNITS = 25.0, {"mm": 1.0, "m": 1000.0, "µm": 0.001}
"""Usual pitch of boards that are photographed; units that are mistaken for each other, in mm."""
_DICTIONARIES = {
    "charuco": "DICT_5X5_100",
    "aprilgrid": "DICT_APRILTAG_36h11",
    "markers": "DICT_5X5_100",
}


def board(
    kind: BoardKind,
    columns: int,
    rows: int,
    pitch: float,
    *,
    size: float | None = None,
    dictionary: str | None = None,
    first_id: int = 0,
    border_bits: int = 1,
    legacy: bool = False,
    polarity: Literal["dark", "bright"] = "dark",
    asymmetric: bool = False,
    dots: tuple[tuple[int, int], ...] = (),
    start: tuple[int, int] = (0, 0),
    name: str = "board",
) -> BoardDesign:
    """Design a board, with the usual size and dictionary where none is given.

    Parameters
    ----------
    kind : {"chess", "puzzle", "deltille", "charuco", "circles", "aprilgrid", "markers"}
        The pattern.
    columns, rows : int
        Number of squares, circles, corners of a deltille, or tags.
    pitch : float
        Distance between squares, rows of circles or tags, mm.
    size, dictionary, first_id, border_bits, legacy, polarity, asymmetric, dots, start, name
        See :class:`reseau.io.BoardDesign`.

    Raises
    ------
    UsageError
        When they do not agree with each other, or the dictionary has too few markers.

    Examples
    --------
    >>> design = board("charuco", 7, 9, 25.0)
    >>> design.size, design.dictionary, len(design.ids)
    (18.75, 'DICT_5X5_100', 48)
    """
    if size is None and kind in _SIZES:
        size = _SIZES[kind] * pitch
    try:
        design = BoardDesign(
            name=name, unit="mm", kind=kind, columns=columns, rows=rows, pitch=float(pitch),
            size=None if size is None else float(size), dictionary=dictionary or _DICTIONARIES.get(kind),
            first_id=first_id, border_bits=border_bits, legacy=legacy, polarity=polarity,
            asymmetric=asymmetric, dots=dots, start=start,
        )  # fmt: skip
    except ValidationError as error:
        first = error.errors()[0]
        what = str(first["msg"]).removeprefix("Value error, ")
        raise UsageError(what, where=".".join(map(str, first["loc"])) or "board") from None
    if design.dictionary is not None:
        marker_cells(design)
    return design


def unusual_size(design: BoardDesign) -> str:
    """Ask for the unit of a board whose size is more usual in another unit; empty where it is not.

    Examples
    --------
    >>> unusual_size(board("chess", 7, 10, 23.0))
    ''
    >>> unusual_size(board("chess", 7, 10, 0.025))
    'the pitch of the board is 0.025 mm (25 µm): is it 0.025 m, which is 25 mm? Lengths depend on it'
    """
    # Of two units the one in which the logarithm of the length is nearer to that of usual boards.
    away = {unit: abs(np.log(design.pitch * mm / _USUAL_MM)) for unit, mm in _UNITS.items()}
    unit = min(away, key=lambda each: away[each])
    if unit == "mm":
        return ""
    pitch, mm = design.pitch, design.pitch * _UNITS[unit]
    also = f" ({1000 * pitch:g} µm)" if pitch < 1 else f" ({pitch / 1000:g} m)"
    asked = f"is it {pitch:g} {unit}, which is {mm:g} mm? Lengths depend on it"
    return f"the pitch of the board is {pitch:g} mm{also}: {asked}"


def marker_dictionary(name: str) -> Any:
    """Dictionary of OpenCV by its name, as ``DICT_5X5_100``.

    Raises
    ------
    UsageError
        When OpenCV has no such dictionary.

    Examples
    --------
    >>> marker_dictionary("DICT_5X5_100").markerSize
    5
    """
    import cv2

    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(number, int):
        raise UsageError(
            f"{name!r} is not one of OpenCV", where="dictionary of a board", do="give one, as DICT_5X5_100"
        )
    return cv2.aruco.getPredefinedDictionary(number)


def dictionary_name(number: int) -> str:
    """Name of the dictionary that has a number in OpenCV.

    Raises
    ------
    UsageError
        When OpenCV has no such dictionary.

    Examples
    --------
    >>> dictionary_name(5)
    'DICT_5X5_100'
    """
    import cv2

    names = (name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    found = next((name for name in names if getattr(cv2.aruco, name) == number), None)
    if found is None:
        raise UsageError(
            f"{number} is not the number of one of OpenCV", where="dictionary of a board",
            do="give its name, as DICT_5X5_100",
        )  # fmt: skip
    return found


def marker_cells(design: BoardDesign) -> tuple[Array, NDArray[np.bool_]]:
    """Markers of a board: their corners (m, 4, 2) and their black cells (m, n, n), rows downwards.

    Raises
    ------
    UsageError
        When the dictionary has too few markers, or OpenCV has no such dictionary.

    Examples
    --------
    >>> corners, black = marker_cells(board("charuco", 4, 3, 20.0))
    >>> black.shape, bool(black[:, 0].all())
    ((6, 7, 7), True)
    """
    numbers, corners = design.markers
    assert design.dictionary is not None
    black = dictionary_cells(design.dictionary, design.border_bits, turned=design.kind == "aprilgrid")
    if (needed := int(numbers.max()) + 1) > len(black):
        raise UsageError(
            f"has {len(black)} markers, {needed} are needed", where=design.dictionary,
            do="take a larger dictionary or fewer squares",
        )  # fmt: skip
    return corners, black[numbers]


@lru_cache(maxsize=64)
def dictionary_cells(name: str, border_bits: int = 1, *, turned: bool = False) -> NDArray[np.bool_]:
    """Black cells (m, n, n) of all markers of a dictionary, rows downwards.

    OpenCV has the words of AprilTags `turned` by 180° against those of their authors, whom Kalibr follows.

    Examples
    --------
    >>> dictionary_cells("DICT_APRILTAG_36h11", 2).shape
    (587, 10, 10)
    """
    dictionary = marker_dictionary(name)
    side = dictionary.markerSize + 2 * border_bits
    count = len(dictionary.bytesList)
    images = [dictionary.generateImageMarker(k, side, None, border_bits) for k in range(count)]
    black = np.stack(images) == 0
    return np.rot90(black, 2, axes=(1, 2)) if turned else black


def board_figures(design: BoardDesign) -> tuple[list[Array], Array]:
    """Polygons of a board, and its circles (n, 3) with x, y and radius, in the ink of its polarity; mm, y up.

    Cells of markers that touch are covered twice, by strips along both axes, so that no gap shows between
    them however a drawing is rendered.

    Examples
    --------
    >>> polygons, circles = board_figures(board("circles", 4, 3, 20.0))
    >>> len(polygons), len(circles)
    (0, 12)
    """
    none = np.zeros((0, 3))
    if design.kind == "circles":
        assert design.size is not None
        return [], np.column_stack([design.xy, np.full(len(design.xy), design.size / 2)])
    if design.kind == "puzzle" or design.dots:
        return dotted_squares(design)
    if design.kind == "deltille":
        return _triangles(design), none
    polygons: list[Array] = []
    if design.kind in ("chess", "charuco"):
        row, column = np.divmod(np.arange(design.columns * design.rows), design.columns)
        black = (row + column) % 2 == (0 if design.dark_corner else 1)
        corner = design.pitch * np.stack([column[black] - 1.0, -row[black].astype(float)], axis=1)
        polygons += list(corner[:, None] + design.pitch * _BOX)
    if design.kind == "aprilgrid":
        assert design.size is not None
        gap = design.pitch - design.size
        row, column = np.divmod(np.arange((design.columns + 1) * (design.rows + 1)), design.columns + 1)
        corner = design.pitch * np.stack([column, row], axis=1) - gap
        polygons += list(corner[:, None] + gap * _BOX)
    if design.kind in ("charuco", "aprilgrid", "markers"):
        assert design.size is not None
        for corners, cells in zip(*marker_cells(design), strict=True):
            cell = design.size / len(cells)
            for across in (cells, cells.T):
                for k, line in enumerate(across):
                    for a, b in _runs(line):
                        low, high = np.array([a, k]), np.array([b, k + 1])
                        low, high = (low, high) if across is cells else (low[::-1], high[::-1])
                        x0, y0 = corners[0] + cell * low * [1, -1]
                        x1, y1 = corners[0] + cell * high * [1, -1]
                        polygons.append(np.array([(x0, y1), (x1, y1), (x1, y0), (x0, y0)]))
    return polygons, none


def _triangles(design: BoardDesign) -> list[Array]:
    """The black triangles, which point upwards, of all that meet in the corners of a deltille.

    Source: H. Ha, M. Perdoch, H. Alismail, I. S. Kweon, Y. Sheikh, Deltille grids for geometric camera
    calibration, ICCV 2017.
    """
    # Each is named by its left corner: a corner is the left, the right and the upper one of three triangles.
    left = np.concatenate([design.nodes + away for away in ([0, 0], [-2, 0], [-1, 1])])
    corners = np.unique(left, axis=0)[:, None] + np.array([[0, 0], [2, 0], [1, -1]])
    return list(corners * design.step * [1, -1])


_BOX = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def _runs(line: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Beginnings and ends of runs of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
