"""Interior orientation of scanned film frames from their four edges."""

from .orientation import FrameOptions, FrameResult, orient_frames
from .perforations import PITCH_MM, FilmPlane, edge_of, film_plane
from .roll import Kind, Roll, result_of, roll_of, transformed

__all__ = [
    "PITCH_MM",
    "FilmPlane",
    "FrameOptions",
    "FrameResult",
    "Kind",
    "Roll",
    "edge_of",
    "film_plane",
    "orient_frames",
    "result_of",
    "roll_of",
    "transformed",
]
