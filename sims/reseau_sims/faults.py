"""Faults of a simulated world: damaged marks, transmission errors, wrong set-up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import UsageError
from reseau.io import ReseauDesign


def swapped(design: ReseauDesign) -> ReseauDesign:
    """The design with O and S, or M and N, exchanged.

    Examples
    --------
    >>> from reseau.designs import standard_reseau
    >>> design = standard_reseau()
    >>> swapped(design).origin == design.axis
    True
    """
    return design.model_copy(update={"origin": design.axis, "axis": design.origin})


@dataclass(frozen=True)
class Faults:
    """Amount of each fault in a world; none by default.

    Parameters
    ----------
    missing : int
        Number of broken marks.
    false_marks : int
        Number of false marks between the marks.
    scene : float
        Grey values of bright and dark disks on the screen behind the marks.
    bit_errors : int
        Number of pixels with one wrong bit.
    lost_rows : int
        Number of lost rows; they are black.
    parallax_mm : float
        Gap between the reseau and the phosphor behind it.
    camera_moved_mm : float
        Displacement of the camera after PHOTO I, in a random direction; it also rotates, by 1° per 20 mm.
    object_turned_deg : float
        Rotation of the test object in the tank.
    missing_row : str
        Row of rods of the test object without echoes, by the letters of their names.

    Examples
    --------
    >>> sorted(Faults(missing_row="B").silent(("A1", "B1", "B2")))
    ['B1', 'B2']
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
        """The rods without echoes.

        Raises
        ------
        UsageError
            When no rod belongs to the missing row.
        """
        row = self.missing_row
        gone = frozenset(name for name in names if row and name.rstrip("0123456789") == row)
        if row and not gone:
            raise UsageError("is no row of the test object", where=f"missing row {row!r}")
        return gone

    def transmit(self, pixels: NDArray[Any], bits: int, rng: np.random.Generator) -> NDArray[Any]:
        """The frame after transmission, with bit errors and lost rows."""
        arrived = pixels.copy()
        if self.bit_errors:
            at = rng.choice(arrived.size, self.bit_errors, replace=False)
            flip = 1 << rng.integers(0, bits, self.bit_errors)
            arrived.reshape(-1)[at] ^= flip.astype(arrived.dtype)
        if self.lost_rows:
            arrived[rng.choice(len(arrived), self.lost_rows, replace=False)] = 0
        return arrived
