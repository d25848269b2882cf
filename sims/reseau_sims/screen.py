"""The screen of a cathode-ray tube: light on a raster in its plane."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from reseau.core.data import Array
from reseau.optics.mapping import PlaneMapping
from reseau.optics.resampling import on_lattice


@dataclass
class Screen:
    """Light of the phosphor in the plane of the screen: millimetres, origin at the centre, y up.

    Parameters
    ----------
    width_mm, height_mm : float
        Size of the phosphor.
    pitch_mm : float
        Spacing of the raster.
    margin_mm : float
        Width of the dark margin that the raster includes.

    Attributes
    ----------
    light : ndarray (rows, columns)
        Grey values that a camera sees of each sample; row 0 at the top. Initially dark.

    Examples
    --------
    >>> screen = Screen()
    >>> screen.draw_disk(0.0, 0.0, radius=10.0, light=100.0)
    >>> screen.light.shape, bool(screen.light.max() > 99)
    ((1341, 1701), True)
    """

    width_mm: float = 158.0
    height_mm: float = 122.0
    pitch_mm: float = 0.1
    margin_mm: float = 6.0
    light: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        size = np.array([self.height_mm, self.width_mm]) + 2 * self.margin_mm
        rows, columns = np.rint(size / self.pitch_mm).astype(int) + 1
        self.light = np.zeros((rows, columns), dtype=np.float32)

    def raster(self) -> tuple[Array, Array]:
        """Coordinates x (columns,) and y (rows,) of the samples in millimetres."""
        rows, columns = self.light.shape
        x = (np.arange(columns) - (columns - 1) / 2) * self.pitch_mm
        y = -(np.arange(rows) - (rows - 1) / 2) * self.pitch_mm
        return x, y

    def illuminate(
        self,
        level: float | NDArray[np.floating],
        rng: np.random.Generator,
        *,
        gradient: tuple[float, float] = (0.06, -0.04),
        falloff: float = 0.10,
        grain: float = 0.001,
    ) -> None:
        """Set the light of the phosphor, uniform or a picture, with the unevenness of a tube.

        Parameters
        ----------
        level : float or ndarray (rows, columns)
            Grey value for a phosphor as bright as at the centre.
        rng : Generator
            Source of the phosphor's grain.
        gradient : (float, float)
            Relative change of the light from the centre to the right and to the upper edge.
        falloff : float
            Relative loss in the corners.
        grain : float
            Relative standard deviation of the phosphor's grain, from sample to sample.
        """
        x, y = self.raster()
        u, v = (2 * x / self.width_mm)[None, :], (2 * y / self.height_mm)[:, None]
        field_ = 1 + gradient[0] * u + gradient[1] * v - falloff * (u**2 + v**2) / 2
        # The mask of the tube is a rounded rectangle with an edge that is out of focus.
        inset = (1 - (u**8 + v**8) ** (1 / 8)) * self.height_mm / 2
        edge = 0.5 + 0.5 * np.tanh(inset / 0.6)
        texture = 1 + grain * rng.standard_normal(self.light.shape)
        self.light = (level * field_ * (0.04 + 0.96 * edge) * texture).astype(np.float32)

    def draw_disk(self, x: float, y: float, radius: float, light: float, softness: float = 1.0) -> None:
        """Change the light within a disk (mm) by a grey value, with an edge of some softness (mm)."""
        at_x, at_y = self.raster()
        distance = np.hypot(at_x[None, :] - x, at_y[:, None] - y)
        change = light * (0.5 - 0.5 * np.tanh((distance - radius) / softness))
        self.light = np.maximum(self.light + change, 0).astype(np.float32)

    def seen(self, view: PlaneMapping, shape: tuple[int, int], blur_px: float = 0.0) -> Array:
        """Light on the pixels of a camera.

        Parameters
        ----------
        view : PlaneMapping
            From the plane of the screen (mm) to the image (px).
        shape : (int, int)
            Height and width of the image.
        blur_px : float
            Width (one sigma) of the point-spread function of the camera; for a picture. An even light needs
            none, and is sampled linearly.

        Returns
        -------
        ndarray (height, width)
            Grey values; constant beyond the edge of the raster.
        """
        height, width = shape
        x, y = on_lattice(view.inverse, np.arange(float(width)), np.arange(float(height)))
        rows, columns = self.light.shape
        at = np.stack([(rows - 1) / 2 - y / self.pitch_mm, (columns - 1) / 2 + x / self.pitch_mm])
        at = np.nan_to_num(at, nan=-1e9)
        # Samples are as large as a pixel, and the tube has nothing finer than its spot.
        order = 2 if blur_px else 1
        light: Array = scipy.ndimage.map_coordinates(
            self.light, at, output=np.float64, order=order, mode="nearest"
        )
        return (
            np.maximum(scipy.ndimage.gaussian_filter(light, blur_px, truncate=5.0), 0) if blur_px else light
        )
