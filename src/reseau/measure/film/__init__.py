"""Interior orientation of scanned film frames from their four edges."""

from .orientation import orient_frames
from .perforations import film_plane

__all__ = ["film_plane", "orient_frames"]
