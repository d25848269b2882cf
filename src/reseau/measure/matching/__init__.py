"""Least-squares matching: windows of a frame are adjusted to formed images of marks."""

from .correlation import with_alike_errors
from .matcher import SIZE, match
from .matches import Matches
from .noise import grey_variance
from .patches import MatchOptions, add_windows
from .shapes import FormedShape, GrownOutline, Shape, ShapeSubset, Window

__all__ = [
    "SIZE",
    "FormedShape",
    "GrownOutline",
    "MatchOptions",
    "Matches",
    "Shape",
    "ShapeSubset",
    "Window",
    "add_windows",
    "grey_variance",
    "match",
    "with_alike_errors",
]
