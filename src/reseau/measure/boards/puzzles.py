"""Which part of the code of all PuzzleBoards a frame shows.

The dots on the edges of a PuzzleBoard are two maps of 3 × 167 bits (:mod:`reseau.designs.dots`), which repeat
along both axes. The bits of vertical edges tell the column modulo 167 and the row modulo 3, those of
horizontal edges the row modulo 167 and the column modulo 3: together they tell the place among 501 × 501
corners. Each map is compared at all its 501 places and in four quarter turns of the lattice.

Source: P. Stelldinger, N. Schönherr, J. Biermann, PuzzleBoard: A new camera calibration pattern with position
encoding, GCPR 2024 (arXiv:2409.20127).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.failure import Code, Failure
from ...designs.dots import puzzle_maps
from ...io.board import PUZZLE_CODE
from .bits import Bits, Integers

MISREAD = 0.2
"""Largest share of the dots of a PuzzleBoard that are not as in the code."""
_CHANCE = 1e-4
"""Largest probability that dots without any order agree as well with one of the places, and that the place
is another one."""
QUARTER = np.array([[0, -1], [1, 0]])
"""A quarter turn of a lattice of squares."""


@dataclass(frozen=True)
class PuzzlePart:
    """Corners of the code that were found.

    Parameters
    ----------
    low, high : (int, int)
        First and last column and row.
    corners : int
        Number of corners found.

    Examples
    --------
    >>> str(PuzzlePart((100, 7), (108, 13), 60))
    'columns 100 to 108 and rows 7 to 13 of the code of PuzzleBoards'
    """

    low: tuple[int, int]
    high: tuple[int, int]
    corners: int

    def __str__(self) -> str:
        columns, rows = zip(self.low, self.high, strict=True)
        return "columns {} to {} and rows {} to {} of the code of PuzzleBoards".format(*columns, *rows)


def part_of_code(nodes: NDArray[np.intp], bits: Bits, mirrored: bool) -> PuzzlePart | Failure:
    """Find the part of the code that the dots between corners show.

    Parameters
    ----------
    nodes : ndarray of int (n, 2)
        Corners of a lattice.
    bits : Bits
        The dots between them.
    mirrored : bool
        Whether the axes of the lattice are anticlockwise in the image.
    """
    found = []
    vertical, horizontal = puzzle_maps()
    for quarter in range(4):
        turn = np.linalg.matrix_power(QUARTER, quarter) @ np.diag([-1 if mirrored else 1, 1])
        # Twice the column and the row; the column of a vertical edge is whole, the row of a horizontal one.
        at = bits.at @ turn.T
        whole = at[:, 0] % 2 == 0
        (x, y), (u, v) = at[whole].T // 2, at[~whole].T // 2
        halves = _differing(vertical, y, x, bits.sign[whole]), _differing(horizontal, u, v, bits.sign[~whole])
        least = [int(half.min()) for half in halves]
        found.append((sum(least), least, halves, turn))
    found.sort(key=lambda one: one[0])
    wrong, _, halves, turn = found[0]
    count = len(bits.sign)
    if (
        wrong > MISREAD * count
        or len(found) * PUZZLE_CODE**2 * scipy.special.bdtr(wrong, count, 0.5) > _CHANCE
    ):
        return Failure(f"{count} dots do not show a part of the code of PuzzleBoards", Code.NOT_IDENTIFIED)
    # Every dot is misread with the same probability, by the rule of succession.
    lost = np.log((count - wrong + 1) / (wrong + 1))
    likely = sum(
        np.exp(-lost * (total - wrong))
        * np.prod([np.exp(lost * (n - half)).sum() for n, half in zip(few, both, strict=True)])
        for total, few, both, *_ in found
    )
    if 1 - 1 / likely > _CHANCE:
        return Failure(f"{count} dots do not tell which part of the code it is", Code.NOT_IDENTIFIED)
    (row3, column), (column3, row) = (np.unravel_index(half.argmin(), half.shape) for half in halves)
    place = nodes @ turn.T
    first = [
        _both(int(a + low) % long, int(b + low) % 3, long)
        for a, b, low, long in (
            (column, column3, place[:, 0].min(), halves[0].shape[1]),
            (row, row3, place[:, 1].min(), halves[1].shape[1]),
        )
    ]
    last = [a + int(n) for a, n in zip(first, np.ptp(place, axis=0), strict=True)]
    if max(last) >= PUZZLE_CODE:
        return Failure(
            f"the board continues beyond the {PUZZLE_CODE} × {PUZZLE_CODE} corners of its code",
            Code.OTHER_DESIGN,
        )
    return PuzzlePart((first[0], first[1]), (last[0], last[1]), len(nodes))


def _differing(
    map_: NDArray[np.int8], short: Integers, long: Integers, sign: NDArray[np.int8]
) -> NDArray[np.intp]:
    """Number (3, 167) of bits that differ from a map, by how far it is shifted along both axes."""
    rows, columns = map_.shape
    total = np.zeros(map_.shape)
    np.add.at(total, (short % rows, long % columns), sign)
    shifted = [(np.arange(n)[:, None] + np.arange(n)) % n for n in map_.shape]
    # map_[(i + a) % 3, (j + b) % 167] by (a, i, b, j)
    agree = np.einsum("ij,aibj->ab", total, map_[shifted[0][:, :, None, None], shifted[1]])
    return np.asarray(np.rint((len(sign) - agree) / 2), dtype=np.intp)


def _both(by_long: int, by_three: int, long: int) -> int:
    """The number below 3 × long with these remainders."""
    return next(n for n in range(by_long, 3 * long, long) if n % 3 == by_three)
