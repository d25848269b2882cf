"""What goes wrong between the light and the file, and what stands behind the marks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Faults"]


@dataclass(frozen=True)
class Faults:
    """How much of each fault a world has; none by default.

    Parameters
    ----------
    missing : int
        Marks that are broken off.
    false_marks : int
        Things beside the marks that look like one.
    scene : float
        Grey values of bright and dark disks on the screen behind the marks.
    bit_errors : int
        Pixels of which one bit arrives wrong.
    lost_rows : int
        Rows that do not arrive: they are black.
    """

    missing: int = 0
    false_marks: int = 0
    scene: float = 0.0
    bit_errors: int = 0
    lost_rows: int = 0

    def transmit(self, pixels: NDArray[Any], bits: int, rng: np.random.Generator) -> NDArray[Any]:
        """What arrives of a frame."""
        arrived = pixels.copy()
        if self.bit_errors:
            at = rng.choice(arrived.size, self.bit_errors, replace=False)
            flip = 1 << rng.integers(0, bits, self.bit_errors)
            arrived.reshape(-1)[at] ^= flip.astype(arrived.dtype)
        if self.lost_rows:
            arrived[rng.choice(len(arrived), self.lost_rows, replace=False)] = 0
        return arrived
