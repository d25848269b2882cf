"""The one matcher: windows of a frame adjusted to the formed image of what they should show."""

from .matcher import SIZE, Matches, MatchOptions, match
from .noise import grey_variance
from .shapes import FormedShape, Shape, Some, Window

__all__ = [
    "SIZE",
    "FormedShape",
    "MatchOptions",
    "Matches",
    "Shape",
    "Some",
    "Window",
    "grey_variance",
    "match",
]
