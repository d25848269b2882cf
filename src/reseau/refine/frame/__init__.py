"""The inner orientation of scanned film frames from their four edges."""

from .camera import Kind, Roll, roll_of, transformed
from .orientation import FrameOptions, FrameResult, orient_frames

__all__ = ["FrameOptions", "FrameResult", "Kind", "Roll", "orient_frames", "roll_of", "transformed"]
