"""The normal distribution in single precision, for images that are formed by the hundred."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data import Array

__all__ = ["normal_single"]

_HASTINGS = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)


def normal_single(z: NDArray[Any]) -> tuple[Array, Array]:
    """Distribution and density at z (...), good to 3e-7 and several times as fast as in double precision.

    Hastings' approximation (Abramowitz & Stegun 1964, *Handbook of Mathematical Functions*, 7.1.26).
    """
    bell = np.exp(np.float32(-0.5) * z * z)
    t = np.float32(1.0) / (np.float32(1.0) + np.float32(0.3275911 / np.sqrt(2)) * np.abs(z))
    tail: NDArray[Any] = np.full_like(t, 0.5 * _HASTINGS[0])
    for coefficient in _HASTINGS[1:]:
        tail *= t
        tail += np.float32(0.5 * coefficient)
    tail *= t * bell
    return np.where(z < 0, tail, np.float32(1.0) - tail), bell * np.float32(1 / np.sqrt(2 * np.pi))
