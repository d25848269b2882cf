"""The inner orientation of scanned film frames from their four edges."""

from .camera import Kind, Roll, roll_of, transformed
from .orientation import FrameOptions, FrameResult, orient_frames
from .perforations import PITCH_MM, FilmPlane, edge_of, film_plane

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
    "roll_of",
    "transformed",
]
