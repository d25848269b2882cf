"""Least-squares matching: windows of a frame are adjusted to formed images of marks."""

from .correlation import with_alike_errors
from .matcher import match
from .matches import Matches
from .noise import grey_variance
from .shapes import Shape

__all__ = ["Matches", "Shape", "grey_variance", "match", "with_alike_errors"]
