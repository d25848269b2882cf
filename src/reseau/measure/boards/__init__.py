"""Boards of other programs, and single tags."""

from .measure import BoardOptions, BoardResult, measure_board
from .single_tags import measure_tags

__all__ = ["BoardOptions", "BoardResult", "measure_board", "measure_tags"]
