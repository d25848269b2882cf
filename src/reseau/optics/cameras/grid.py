"""Pixels of an image and their photo-coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.data import Array
from ...core.errors import UsageError
from ..mapping import as_points


@dataclass(frozen=True)
class PixelGrid:
    """Pixels of an image and their photo-coordinates.

    Pixels have their origin at the centre of the top-left pixel, y down; photo-coordinates at the
    centre of the image, y up.

    Parameters
    ----------
    width, height : int
        Number of columns and rows.
    pitch_mm : (float, float)
        Distance of neighbouring columns and of neighbouring rows, in millimetres.

    Examples
    --------
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> grid.to_photo([[0.0, 0.0]])
    array([[-3.195,  2.395]])
    """

    width: int
    height: int
    pitch_mm: tuple[float, float]

    def __post_init__(self) -> None:
        if not (min(self.width, self.height) > 0 and min(self.pitch_mm) > 0):
            raise UsageError(
                f"has {self.width}×{self.height} pixels of {self.pitch_mm} mm", where="pixel grid"
            )

    @property
    def centre(self) -> Array:
        """Centre of the image in pixels, (2,)."""
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2])

    @property
    def pixels_per_mm(self) -> Array:
        """Derivative of the pixels by the photo-coordinates, the diagonal (2,); that of y is negative."""
        return np.array([1 / self.pitch_mm[0], -1 / self.pitch_mm[1]])

    def to_photo(self, pixels: ArrayLike) -> Array:
        """Photo-coordinates (n, 2) in mm of pixels (n, 2)."""
        return (as_points(pixels) - self.centre) / self.pixels_per_mm

    def to_pixels(self, photo: ArrayLike) -> Array:
        """Pixels (n, 2) of photo-coordinates (n, 2) in mm."""
        return as_points(photo) * self.pixels_per_mm + self.centre
