"""Least-squares matching: windows of a frame are adjusted to formed images of marks."""

from .matcher import SIZE, Matches, MatchOptions, match
from .noise import grey_variance
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
    "grey_variance",
    "match",
]
