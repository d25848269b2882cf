"""The one matcher: windows of a frame adjusted to the formed image of what they should show."""

from .matcher import SIZE, Matches, MatchOptions, match
from .noise import grey_variance
from .shapes import FormedShape, GrownOutline, Shape, Some, Window

__all__ = [
    "SIZE",
    "FormedShape",
    "GrownOutline",
    "MatchOptions",
    "Matches",
    "Shape",
    "Some",
    "Window",
    "grey_variance",
    "match",
]
