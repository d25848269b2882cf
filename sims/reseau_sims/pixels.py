"""A sensor with individual pixels and known parameters, as truth for a calibration of sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array, Mask


@dataclass(frozen=True, eq=False)
class PixelSensor:
    """Pixels with individual bias, dark current and response.

    Parameters
    ----------
    bias, dark_current, response : ndarray (height, width)
        Grey values, grey values per microsecond, and factors of a mean of 1.
    hot, dead : ndarray (height, width) of bool
        Hot pixels are far too bright in the dark; dead pixels have a tenth of the response.
    gain : float
        Electrons per grey value.
    read_noise : float
        Grey values.
    full_well : float
        Electrons at which a pixel saturates.
    b2, b3 : float
        Of the electronics: a true signal s reads as g with g·(1 + b2·u + b3·u²) = s, u = g / full scale.
    bits : int
        Of the converter.
    """

    bias: Array
    dark_current: Array
    response: Array
    hot: Mask
    dead: Mask
    gain: float = 4.0
    read_noise: float = 2.0
    full_well: float = 14_000.0
    b2: float = 0.0
    b3: float = 0.0
    bits: int = 12

    @classmethod
    def drawn(cls, rng: np.random.Generator, width: int = 96, height: int = 64, **known: Any) -> Self:
        """A random sensor: bias 60 ± 1, response ± 1 %, three hot pixels and two dead ones."""
        shape = height, width
        hot, dead = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        chosen = rng.choice(height * width, 5, replace=False)
        hot.ravel()[chosen[:3]], dead.ravel()[chosen[3:]] = True, True
        return cls(
            rng.normal(60.0, 1.0, shape),
            np.abs(rng.normal(2e-5, 4e-6, shape)),
            rng.normal(1.0, 0.01, shape),
            hot,
            dead,
            **known,
        )

    @property
    def full_scale(self) -> float:
        """Grey value at which the converter saturates."""
        return float(2**self.bits - 1)

    def expose(self, light: Array | float, exposure_us: float, rng: np.random.Generator) -> NDArray[Any]:
        """A frame.

        Parameters
        ----------
        light : ndarray (height, width) or float
            Grey values per microsecond on a pixel of response 1.
        exposure_us : float
            Exposure time.
        rng : Generator
            Source of the noise.
        """
        answer = np.where(self.dead, 0.1, self.response)
        glow = np.where(self.hot, 0.02, self.dark_current)
        electrons = rng.poisson(light * answer * exposure_us * self.gain)
        signal = np.minimum(electrons, self.full_well) / self.gain
        thermal = rng.poisson(np.maximum(glow, 0.0) * exposure_us * self.gain) / self.gain
        grey = self._read(signal) + self.bias + thermal
        grey += rng.normal(0.0, self.read_noise, grey.shape)
        kind = np.uint8 if self.bits <= 8 else np.uint16
        return np.clip(np.rint(grey), 0, self.full_scale).astype(kind)

    def _read(self, signal: Array) -> Array:
        """Output of the electronics: the inverse of the linearisation, by iteration."""
        read = signal
        for _ in range(20):
            u = read / self.full_scale
            read = signal / (1 + self.b2 * u + self.b3 * u**2)
        return read
