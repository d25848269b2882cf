"""Boards as other programs describe them: Kalibr's target files, and files of OpenCV's storage."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ..core.errors import FormatError, UsageError
from ..designs.boards import board, dictionary_name
from ..io import ReseauDesign, TestfieldDesign, read_design, read_text
from ..io.board import BoardDesign, BoardKind

_SUFFIXES = (".yaml", ".yml", ".xml")
"""Suffixes of files of other programs."""

_KALIBR: dict[str, BoardKind] = {
    "aprilgrid": "aprilgrid",
    "checkerboard": "chess",
    "circlegrid": "circles",
}
_OPENCV: dict[str, BoardKind] = {
    "CHESSBOARD": "chess",
    "CHARUCOBOARD": "charuco",
    "CIRCLES_GRID": "circles",
    "ASYMMETRIC_CIRCLES_GRID": "circles",
}


def read_board(path: Path | str) -> BoardDesign:
    """Read a board from its design, from Kalibr's target file (YAML), or from a file of OpenCV's storage.

    Kalibr counts the inner corners of a chessboard and measures in metres; so does OpenCV count them, in a
    unit of the user, which is taken as the millimetre. A ChArUco board is given there by its squares. Of
    OpenCV are read the settings of its calibration sample, and the arguments of its `CharucoBoard`
    (`squaresX`, `squaresY`, `squareLength`, `markerLength`, `dictionary`, `legacyPattern`).

    Parameters
    ----------
    path : str or Path
        ``reseau-board/1``; YAML of Kalibr; YAML, XML or JSON of OpenCV.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is neither, or a value is missing or not a number.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "april.yaml"
    ...     text = "target_type: 'aprilgrid'\\ntagCols: 6\\ntagRows: 5\\ntagSize: 0.088\\ntagSpacing: 0.3\\n"
    ...     _ = file.write_text(text)
    ...     design = read_board(file)
    >>> design.kind, design.columns, design.size, round(design.pitch, 3)
    ('aprilgrid', 6, 88.0, 114.4)
    """
    path = Path(path)
    text = read_text(path)
    if '"schema"' in text[:4096]:
        return BoardDesign.parse(text, where=path)
    entries = _entries(text)
    get = _Values(entries, path)
    try:
        if "target_type" in entries:
            return _kalibr(get, path.stem)
        if "Calibrate_Pattern" in entries:
            return _opencv(get, path.stem)
        if "squaresX" in entries:
            return _charuco(get, path.stem)
    except UsageError as error:
        raise FormatError(f"describes no board: {error.what}", where=path) from None
    raise FormatError(
        "has neither `target_type` (Kalibr) nor `Calibrate_Pattern` or `squaresX` (OpenCV)", where=path,
        do="give a target file of Kalibr, the settings of OpenCV's calibration sample or a CharucoBoard",
    )  # fmt: skip


def read_target(path: Path | str) -> ReseauDesign | TestfieldDesign | BoardDesign:
    """Read a design of a target, or the file in which Kalibr or OpenCV describes a board, by its suffix.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no design, and describes no board.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     board("chess", 7, 10, 23.0).write(Path(folder) / "board.json")
    ...     read_target(Path(folder) / "board.json").kind
    'chess'
    """
    return read_board(path) if Path(path).suffix.lower() in _SUFFIXES else read_design(path)


def _entries(text: str) -> dict[str, str]:
    """Keys and values of flat YAML or JSON, or of XML elements without children."""
    found = dict(re.findall(r"<(\w+)[^<>/]*>\s*([^<>]*?)\s*</\1>", text))
    for line in text.splitlines():
        pair = re.match(r"""\s*['"]?(\w+)['"]?\s*:\s*(.*?),?\s*(?:#.*)?$""", line)
        if pair and pair[2]:
            found[pair[1]] = pair[2]
    return {key: value.strip().strip("'\"") for key, value in found.items()}


class _Values:
    """Entries of a file as numbers."""

    def __init__(self, entries: dict[str, str], path: Path) -> None:
        self.entries, self.path = entries, path

    def text(self, key: str, default: str | None = None) -> str:
        value = self.entries.get(key, default)
        if value is None:
            raise FormatError(f"has no `{key}`", where=self.path)
        return value

    def number(self, key: str) -> float:
        try:
            return float(self.text(key))
        except ValueError:
            raise FormatError(f"`{key}` is {self.text(key)!r}, not a number", where=self.path) from None

    def count(self, key: str) -> int:
        value = self.number(key)
        if value != int(value):
            raise FormatError(f"`{key}` is {value:g}, not a whole number", where=self.path)
        return int(value)


def _kalibr(get: _Values, name: str) -> BoardDesign:
    kind = _KALIBR.get(get.text("target_type"))
    if kind is None:
        known = ", ".join(_KALIBR)
        raise FormatError(f"`target_type` is {get.text('target_type')!r}", where=get.path, do=f"use {known}")
    if kind == "aprilgrid":
        side = 1000 * get.number("tagSize")
        pitch = round(side * (1 + get.number("tagSpacing")), 9)
        # Kalibr's tags have a black border of two bits.
        counts, family = (get.count("tagCols"), get.count("tagRows")), get.text("tagFamily", "tag36h11")
        words = "DICT_APRILTAG_" + family.lower().removeprefix("tag").removeprefix("apriltag_")
        return board(kind, *counts, pitch, size=side, dictionary=words, border_bits=2, name=name)
    columns, rows = get.count("targetCols"), get.count("targetRows")
    if kind == "chess":
        across, down = get.number("colSpacingMeters"), get.number("rowSpacingMeters")
        if across != down:
            raise FormatError("has rectangles in place of squares", where=get.path)
        return board(kind, columns + 1, rows + 1, 1000 * across, name=name)
    asymmetric = get.text("asymmetricGrid", "False").lower() in ("true", "1")
    return board(kind, columns, rows, 1000 * get.number("spacingMeters"), asymmetric=asymmetric, name=name)


def _opencv(get: _Values, name: str) -> BoardDesign:
    pattern = get.text("Calibrate_Pattern")
    kind = _OPENCV.get(pattern)
    if kind is None:
        raise FormatError(
            f"`Calibrate_Pattern` is {pattern!r}", where=get.path, do=f"use {', '.join(_OPENCV)}"
        )
    columns, rows = get.count("BoardSize_Width"), get.count("BoardSize_Height")
    more = 1 if kind == "chess" else 0
    options: dict[str, Any] = {"asymmetric": pattern.startswith("ASYM")}
    if kind == "charuco":
        options |= {"size": get.number("Marker_Size"), "dictionary": get.text("ArUco_Dict_Name")}
    return board(kind, columns + more, rows + more, get.number("Square_Size"), name=name, **options)


def _charuco(get: _Values, name: str) -> BoardDesign:
    words = get.text("dictionary")
    if words.isdecimal():
        words = dictionary_name(int(words))
    legacy = get.text("legacyPattern", "0").lower() in ("true", "1")
    return board(
        "charuco", get.count("squaresX"), get.count("squaresY"), get.number("squareLength"),
        size=get.number("markerLength"), dictionary=words, legacy=legacy, name=name,
    )  # fmt: skip
