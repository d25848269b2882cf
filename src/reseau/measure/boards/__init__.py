"""Boards of other programs, and single tags."""

from .measure import BoardOptions, BoardResult, measure_board, puzzle_part
from .puzzles import PuzzlePart
from .shown import boards_shown
from .single_tags import measure_tags

__all__ = [
    "BoardOptions",
    "BoardResult",
    "PuzzlePart",
    "boards_shown",
    "measure_board",
    "measure_tags",
    "puzzle_part",
]
