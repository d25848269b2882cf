"""Streams of random numbers, one for each purpose: nothing random depends on what was asked for before it."""

from __future__ import annotations

from hashlib import sha256

import numpy as np

__all__ = ["stream"]


def stream(seed: int, *purpose: str | int | float) -> np.random.Generator:
    """The stream of a seed for one purpose, which is what the words tell."""
    words = sha256(repr(purpose).encode()).digest()
    return np.random.default_rng([seed, *np.frombuffer(words, dtype="<u4").tolist()])
