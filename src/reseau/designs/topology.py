r"""The topological code of a testfield: identification of a cluster of sixteen targets by their arrangement.

A cluster is a 4×4 grid of targets of eight kinds (four shapes in two sizes), two of each. Write the place of
a target as four bits, row and column from the upper left, and its kind as three: two for the shape, one for
the size. The words of the code are affine functions :math:`w(p) = M p + b` over the field of two elements
with M of rank 3, so that every kind occurs at exactly two places. Two words agree where
:math:`(M - M')\,p = b' - b`: at none, two, four or eight places. Rotation and reflection of the cluster are
affine in the place, too, so a rotated word is again such a function. Of the 20160 functions those below were
selected such that any two words, each in any of its eight rotations and reflections, agree at most at four
places: **the code has distance 12**. Up to five wrongly classified targets of a cluster are corrected, and up
to eleven hidden ones are tolerated; with h hidden ones, (11 − h)/2 may also be wrong.

No code of this kind can have a distance above 14: 256 words of eight symbols agree at 1.95 of sixteen places
on average (Plotkin 1960).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ..core.errors import UsageError
from ..core.failure import Code
from ..io import TestfieldDesign

HIDDEN = -1
"""Symbol of a target that is not visible."""
_SIDE = 4
_PLACES = _SIDE * _SIDE
_WORDS = (
    "4de5 6236 3948 6e44 0e53 1467 648e 095f 2edc 14d1 569d 18cb 13df 210b 5ca8 26c4 73d5 3d31 3a51 3e77 "
    "6755 0d38 50b3 20e1 5960 0ea9 65f3 5b75 5625 0ab1 5310 426a 642d 49f7 636e 2ca7 55e8 2616 5623 2b0d "
    "1c0f 49f5 464d 2a63 0ce9 713c 6122 7592 6754 23ac 41ad 3f6d 72ee 4b9f 2930 71a3 1eb1 4f2f 4e6f 33a2 "
    "713a 648f 1be9 2737 4522 1749 3b58 4943 4765 0e50 1cb9 1748 4a39 6b1b 1a11 1928 464e 38ab 320f 6ae2 "
    "2475 4d16 249a 71a4 2dc0 7244 4adf 1f5e 29e8 7562 3997 426b 1270 29ea 60c4 545d 31b8 41ae 3150 32f5 "
    "5311 3a53 1d70 428e 3d89 5bb2 59cb 63cc 3ea1 1ac4 1d75 1340 6f23 4d13 6297 09c0 5bb3 66bc 59c8 69dc "
    "53e0 2bf6 26c5 0d39 46f3 6c34 5f46 2a65 524d 22cd 150c 5ab8 0c27 0dc8 14d2 573a 3f68 30ea 2c4e 4de1 "
    "320e 3b5c 3a9d 6a2f 6d4c 40db 4e8f 5d1d 0b64 74da 4c56 1463 7241 35a9 4492 428f 0ce8 0a1f 5459 5967 "
    "3411 5caa 2f15 3ea7 73d7 3ce5 4b9b 4762 "
)
"""Functions as numbers: four bits for each row of M, three for b. Any two of the first 64 differ in the
shapes of eight targets, for all rotations."""

Symbols = NDArray[np.intp]


def words(count: int) -> Symbols:
    """The first words of the code, (count, 16): symbols in rows from the upper left.

    Raises
    ------
    UsageError
        When the code has fewer words.
    """
    numbers = np.array([int(number, 16) for number in _WORDS.split()])
    if not 0 < count <= len(numbers):
        raise UsageError(f"has {len(numbers)} words, not {count}", where="the code of the testfield")
    place = np.arange(_PLACES)[None, :]
    symbol = np.zeros((count, _PLACES), dtype=np.intp)
    for k in range(3):
        row = numbers[:count, None] >> (11 - 4 * k) & 15
        # The scalar product of two bit vectors is the parity of their common bits.
        product = _PARITY[row & place] ^ (numbers[:count, None] >> k & 1)
        symbol += product << (2 - k)
    return symbol


_PARITY = np.array([bin(value).count("1") % 2 for value in range(16)])


@dataclass(frozen=True)
class Decoded:
    """Result of decoding a cluster; falsy if it was not identified.

    Parameters
    ----------
    square : int
        Number of the square, from 1.
    quarter_turns : int
        Number of quarter turns, 0 to 3, by which the cluster appears rotated counter-clockwise (after a
        reflection left to right, if mirrored).
    mirrored : bool
        Whether it appears mirrored.
    corrections : int
        Number of targets that were classified wrongly.
    hidden : int
        Number of targets that are not visible.
    why : str
        Reason why it was not identified; empty otherwise.
    code : Code or None
        The same for programs: HIDDEN or INCONSISTENT.

    Examples
    --------
    >>> bool(Decoded(square=23))
    True
    """

    square: int = 0
    quarter_turns: int = 0
    mirrored: bool = False
    corrections: int = 0
    hidden: int = 0
    why: str = ""
    code: Code | None = None

    def __bool__(self) -> bool:
        return self.code is None


@dataclass(frozen=True, eq=False)
class TopologicalCode:
    """The clusters of a testfield as words, in all possible appearances.

    Parameters
    ----------
    clusters : ndarray of int (k, 16)
        Symbols of the clusters in rows from the upper left, k squares in the order of their numbers.

    Examples
    --------
    >>> code = TopologicalCode(words(64))
    >>> code.distance
    12
    >>> seen = np.rot90(code.clusters[22].reshape(4, 4)).copy()
    >>> seen[0, :2], seen[3, 3] = HIDDEN, (seen[3, 3] + 1) % 8
    >>> code.decode(seen)
    Decoded(square=23, quarter_turns=1, mirrored=False, corrections=1, hidden=2, why='', code=None)
    """

    clusters: Symbols

    def __post_init__(self) -> None:
        if self.clusters.ndim != 2 or self.clusters.shape[1] != _PLACES or not len(self.clusters):
            raise UsageError(f"have the shape {self.clusters.shape}, not (k, 16)", where="clusters of a code")

    @staticmethod
    def of(design: TestfieldDesign) -> TopologicalCode:
        """The code of a design, with its targets sorted by place.

        Raises
        ------
        UsageError
            When a square does not have sixteen targets in a grid of four by four.
        """
        return _code_of(design)

    @cached_property
    def appearances(self) -> Symbols:
        """All appearances of the clusters, (8, k, 16): rotated by 0 to 3 quarters, then also mirrored."""
        grid = self.clusters.reshape(-1, _SIDE, _SIDE)
        turned = [
            np.rot90(seen, quarters, axes=(1, 2))
            for seen in (grid, grid[:, :, ::-1])
            for quarters in range(4)
        ]
        return np.stack(turned).reshape(8, -1, _PLACES)

    @cached_property
    def distance(self) -> int:
        """Least number of targets in which two appearances differ, including mirrored ones.

        Zero if the clusters do not identify squares, rotations and handedness uniquely.
        """
        every = self.appearances.reshape(-1, _PLACES)
        # It is sufficient to compare with the clusters as designed: if one is rotated, rotate both back.
        least = _PLACES
        for k, cluster in enumerate(self.clusters):
            differ = (every != cluster).sum(axis=1)
            differ[k] = _PLACES
            least = min(least, int(differ.min()))
        return least

    def decode(self, seen: Symbols) -> Decoded:
        """Identify a cluster.

        Parameters
        ----------
        seen : ndarray of int (4, 4) or (16,)
            Symbols of its targets as they appear, in rows from the upper left, `HIDDEN` for invisible ones.

        Returns
        -------
        Decoded
            Falsy, with the reason, if no cluster or more than one matches.
        """
        return self.decoded(np.asarray(seen).reshape(1, _PLACES))[0]

    def decoded(self, seen: Symbols) -> tuple[Decoded, ...]:
        """Identify clusters (s, 16); see :meth:`decode`."""
        visible = seen != HIDDEN
        hidden = (_PLACES - visible.sum(axis=1)).tolist()
        every = self.appearances.reshape(-1, _PLACES)
        wrong = ((every != seen[:, None]) & visible[:, None]).sum(axis=2)
        best = wrong.argmin(axis=1)
        least = np.take_along_axis(wrong, best[:, None], 1)[:, 0].tolist()
        given = zip(best.tolist(), least, hidden, strict=True)
        return tuple(self._decoded(*one) for one in given)

    def _decoded(self, best: int, corrections: int, hidden: int) -> Decoded:
        """A cluster that differs least from one appearance, in `corrections` targets."""
        way, square = divmod(best, len(self.clusters))
        if 2 * corrections + hidden >= self.distance:
            # Within half the distance there is at most one word; beyond it there may be two, or none.
            why = f"{corrections} of its {_PLACES - hidden} visible targets fit no square of the design"
            code = Code.INCONSISTENT
            if not corrections:
                why, code = f"{hidden} of its targets are hidden", Code.HIDDEN
            return Decoded(corrections=corrections, hidden=hidden, why=why, code=code)
        return Decoded(square + 1, way % 4, way >= 4, corrections, hidden)


@lru_cache(maxsize=16)
def _code_of(design: TestfieldDesign) -> TopologicalCode:
    """Cached code of a testfield: computing its distance takes longer than reading a cluster."""
    return TopologicalCode(design.symbols[places(design)])


def places(design: TestfieldDesign) -> Symbols:
    """Index of the target at each place of each square, (k, 16), in rows from the upper left.

    Raises
    ------
    UsageError
        When a square does not have sixteen targets in a grid of four by four.
    """
    square = np.array(design.targets.square) - 1
    count = design.squares[0] * design.squares[1]
    if (np.bincount(square, minlength=count) != _PLACES).any():
        raise UsageError("does not have sixteen targets in each square", where=f"design {design.name}")
    relative = design.xy - design.centres[square]
    unit = np.unique(np.round(np.abs(relative), 6))
    if len(unit) != 2 or not 2.5 < unit[1] / unit[0] < 3.5:
        raise UsageError("targets do not form a grid of four by four", where=f"design {design.name}")
    step = 2 * unit[0]
    column, row = (np.rint(_SIDE / 2 - 0.5 + sign * relative[:, k] / step) for k, sign in ((0, 1), (1, -1)))
    at = (row * _SIDE + column).astype(np.intp)
    table = np.full((count, _PLACES), -1, dtype=np.intp)
    table[square, at] = np.arange(len(square))
    if (table < 0).any():
        raise UsageError("has two targets at one place", where=f"design {design.name}")
    return table
