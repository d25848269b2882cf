"""Image sensors: noise, saturation, quantisation and jitter of the rows.

The noise model is that of the photon transfer curve (Janesick, Photon Transfer; EMVA Standard 1288): the
variance of a grey value is its light over the gain in electrons per grey value, plus the read noise,
plus 1/12 for the rounding to integers. Signal-to-noise ratios follow the convention of peak signal,
SNR = 20·log10(255/σ) dB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array
from ..core.errors import UsageError


def snr_db(sigma: float, full_scale: float = 255.0) -> float:
    """Signal-to-noise ratio in dB of a noise of standard deviation `sigma` grey values: 20·log10(255/σ).

    Examples
    --------
    >>> round(snr_db(2.55), 6)
    40.0
    """
    return float(20 * np.log10(full_scale / sigma))


def sigma_of_snr(snr: float, full_scale: float = 255.0) -> float:
    """Standard deviation in grey values of a signal-to-noise ratio in dB; see :func:`snr_db`.

    Examples
    --------
    >>> round(sigma_of_snr(40.0), 6)
    2.55
    """
    return float(full_scale / 10 ** (snr / 20))


@dataclass(frozen=True)
class Sensor:
    """An area sensor and its electronics.

    Parameters
    ----------
    width, height : int
        Number of columns and rows.
    bits : int
        Depth of the grey values, 1 to 16; it saturates at 2^bits − 1.
    gain : float
        Electrons per grey value.
    read_noise : float
        Standard deviation of the read noise, in grey values.
    shot_noise : bool
        Whether the light arrives as a Poisson process of electrons.
    offset : float
        Grey value without light.
    row_jitter_px : float
        Standard deviation of the shift of a row along x, in pixels (a frame grabber's line synchronisation).
    quantise : bool
        Whether grey values are rounded to integers; otherwise they are floats, which also saturate.

    Raises
    ------
    UsageError
        When a value is not possible.

    Examples
    --------
    >>> sensor = Sensor(width=6, height=4, bits=12, gain=10.0, read_noise=2.0)
    >>> frame = sensor.expose(np.full((4, 6), 1000.0), np.random.default_rng(1))
    >>> frame.shape, frame.dtype, sensor.full_scale
    ((4, 6), dtype('uint16'), 4095.0)
    >>> sensor.variance(np.full((4, 6), 1000.0))[0, 0].round(3).item()
    104.083
    """

    width: int
    height: int
    bits: int = 8
    gain: float = 40.0
    read_noise: float = 0.0
    shot_noise: bool = True
    offset: float = 0.0
    row_jitter_px: float = 0.0
    quantise: bool = True

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 2 or not 1 <= self.bits <= 16:
            raise UsageError(f"has {self.width}×{self.height} pixels of {self.bits} bits", where="sensor")
        for name in ("read_noise", "offset", "row_jitter_px"):
            if not getattr(self, name) >= 0:
                raise UsageError(f"is {getattr(self, name)}, not at least zero", where=f"{name} of a sensor")
        if not self.gain > 0:
            raise UsageError(f"is {self.gain}, not positive", where="gain of a sensor")

    @property
    def full_scale(self) -> float:
        """Grey value at which the sensor saturates."""
        return float(2**self.bits - 1)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the exposed pixels."""
        if not self.quantise:
            return np.dtype(np.float64)
        return np.dtype(np.uint8 if self.bits <= 8 else np.uint16)

    def expose(self, irradiance: ArrayLike, rng: np.random.Generator) -> NDArray[Any]:
        """Take an image.

        Parameters
        ----------
        irradiance : array_like (height, width)
            Light on each pixel, in grey values.
        rng : Generator
            Source of the noise; the same state gives the same image.

        Returns
        -------
        ndarray (height, width)
            Grey values of :attr:`dtype`.

        Raises
        ------
        UsageError
            When the size of the image differs from the sensor's, or light is negative or not finite.
        """
        light = self._light(irradiance)
        grey: Array = rng.poisson(light * self.gain) / self.gain if self.shot_noise else light.copy()
        grey += self.offset
        if self.read_noise > 0:
            grey += rng.normal(0.0, self.read_noise, grey.shape)
        if self.quantise:
            np.rint(grey, out=grey)
        return np.clip(grey, 0.0, self.full_scale, out=grey).astype(self.dtype)

    def variance(self, irradiance: ArrayLike) -> Array:
        """Variance of the grey values of each pixel, (height, width), in squared grey values.

        Clipping at black and at saturation is not included, and the rounding error is treated as independent
        of the light, which requires a noise of at least half a grey value.
        """
        light = self._light(irradiance)
        shot = light / self.gain if self.shot_noise else np.zeros_like(light)
        return shot + self.read_noise**2 + (1 / 12 if self.quantise else 0.0)

    def row_shifts(self, rng: np.random.Generator) -> Array:
        """Shifts of the rows along x in pixels, (height,), for the formation of the image to be exposed."""
        return rng.normal(0.0, self.row_jitter_px, self.height)

    def _light(self, irradiance: ArrayLike) -> Array:
        light = np.asarray(irradiance, dtype=np.float64)
        if light.shape != (self.height, self.width):
            raise UsageError(
                f"has the shape {light.shape}, not ({self.height}, {self.width})",
                where="irradiance of a sensor",
            )
        # Formed images are exact within rounding; values further below zero are an error of the caller.
        if not (light.min() >= -1e-6 * self.full_scale and light.max() < np.inf):
            raise UsageError("is negative or not finite somewhere", where="irradiance of a sensor")
        return np.maximum(light, 0.0)


def illumination(
    width: int,
    height: int,
    *,
    gradient: tuple[float, float] = (0.0, 0.0),
    curvature: tuple[float, float, float] = (0.0, 0.0, 0.0),
    corner_angle: float = 0.0,
) -> Array:
    """Uneven light over an image, 1 at its centre.

    The field (1 + gx·x + gy·y + qxx·x² + qxy·xy + qyy·y²)·cos⁴α, with x and y from the centre of the image in
    units of half its larger side; cos⁴α is the natural fall-off of light (Kraus, Photogrammetry).

    Parameters
    ----------
    width, height : int
        Size of the image in pixels.
    gradient : (float, float)
        gx and gy.
    curvature : (float, float, float)
        qxx, qxy and qyy.
    corner_angle : float
        Angle α between the axis and the ray to the corner of the image, radians; tan α grows with the radius.

    Returns
    -------
    ndarray (height, width)
        Factors to multiply the irradiance with.

    Raises
    ------
    UsageError
        When a part of the image is without light.

    Examples
    --------
    >>> illumination(5, 3, gradient=(0.2, 0.0))[1].round(2)
    array([0.8, 0.9, 1. , 1.1, 1.2])
    """
    half = np.array([(width - 1) / 2, (height - 1) / 2])
    x = (np.arange(width) - half[0])[None, :] / half.max()
    y = (np.arange(height) - half[1])[:, None] / half.max()
    qxx, qxy, qyy = curvature
    field = 1 + gradient[0] * x + gradient[1] * y + qxx * x**2 + qxy * x * y + qyy * y**2
    tangent_squared = np.tan(corner_angle) ** 2 * (x**2 + y**2) * (half.max() ** 2 / (half @ half))
    light: Array = field / (1 + tangent_squared) ** 2
    if not light.min() > 0:
        raise UsageError("leaves a part of the image without light", where="illumination")
    return light
