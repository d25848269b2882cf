"""Targets as `reseau design` draws them where nothing is chosen."""

from __future__ import annotations

from functools import cache, partial

from ..io import BoardDesign, ReseauDesign, TestfieldDesign
from ..io.board import BoardKind
from .boards import board
from .drawing import content_of
from .paper import PAPERS, Content, largest_pitch
from .reseaus import coded_sheet
from .testfield import coded_testfield

_SHEET, _FIELD, _BOARD = (10, 13), (8, 8), (7, 10)
_KINDS: tuple[BoardKind, ...] = ("charuco", "aprilgrid", "markers", "circles", "chess", "deltille")
"""All but the PuzzleBoard, whose dots tell what a photograph shows of it."""


@cache
def known_designs() -> dict[str, ReseauDesign | TestfieldDesign | BoardDesign]:
    """Sheets, testfields and boards that fill each size of paper, by a description.

    Examples
    --------
    >>> list(known_designs())[:3]
    ['sheet on A4', 'testfield on A4', 'charuco on A4']
    """
    found: dict[str, ReseauDesign | TestfieldDesign | BoardDesign] = {}
    for paper in PAPERS:
        pitch = largest_pitch(lambda p: content_of(coded_sheet(*_SHEET, p)), paper)
        found[f"sheet on {paper}"] = coded_sheet(*_SHEET, pitch)
        pitch = largest_pitch(lambda p: content_of(coded_testfield(*_FIELD, p)), paper)
        found[f"testfield on {paper}"] = coded_testfield(*_FIELD, pitch)
        for kind in _KINDS:
            pitch = largest_pitch(partial(_drawn_board, kind), paper)
            found[f"{kind} on {paper}"] = board(kind, *_BOARD, pitch)
    return found


def _drawn_board(kind: BoardKind, pitch: float) -> Content:
    return content_of(board(kind, *_BOARD, pitch))
