"""Boards of other programs: chessboards, ChArUco boards, circle grids and AprilGrids."""

from .measure import BoardOptions, BoardResult, measure_board

__all__ = ["BoardOptions", "BoardResult", "measure_board"]
