"""Independent streams of random numbers, one for each purpose, so that their order is irrelevant."""

from __future__ import annotations

from hashlib import sha256

import numpy as np


def stream(seed: int, *purpose: str | int | float) -> np.random.Generator:
    """The random stream of a seed for one purpose, named by words."""
    words = sha256(repr(purpose).encode()).digest()
    return np.random.default_rng([seed, *np.frombuffer(words, dtype="<u4").tolist()])
