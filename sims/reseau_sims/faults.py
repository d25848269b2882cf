"""What goes wrong between the light and the file, and what stands behind the marks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import UsageError
from reseau.io import ReseauDesign

__all__ = ["Faults", "swapped"]


def swapped(design: ReseauDesign) -> ReseauDesign:
    """The design as one gets it who confuses O with S, or M with N."""
    return design.model_copy(update={"origin": design.axis, "axis": design.origin})


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
    parallax_mm : float
        Gap between the reseau and the phosphor behind it.
    camera_moved_mm : float
        How far someone pushed the camera after PHOTO I, in a direction of the seed; it turned with it, by a
        degree for 20 mm.
    object_turned_deg : float
        How far the test object stands turned in the tank.
    missing_row : str
        Row of rods of the test object that send no echo, by the letters of their names.
    """

    missing: int = 0
    false_marks: int = 0
    scene: float = 0.0
    bit_errors: int = 0
    lost_rows: int = 0
    parallax_mm: float = 0.0
    camera_moved_mm: float = 0.0
    object_turned_deg: float = 0.0
    missing_row: str = ""

    def silent(self, names: tuple[str, ...]) -> frozenset[str]:
        """Those of the rods that send no echo.

        Raises
        ------
        UsageError
            When the missing row is none of theirs.
        """
        row = self.missing_row
        gone = frozenset(name for name in names if row and name.rstrip("0123456789") == row)
        if row and not gone:
            raise UsageError("is no row of the test object", where=f"missing row {row!r}")
        return gone

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
