"""Dots between the corners of a lattice, read as bits; see :mod:`reseau.designs.dots`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...optics.composition import Chain
from ..plane.levels import levels_around

Integers = NDArray[np.signedinteger[Any]]
_SURE = 0.15
"""Least difference of a dot from the mean of ink and paper, as a share of their difference."""
_DOTTED = 0.5
"""Least difference of the middle of a square from the rest of it that is a dot, as such a share."""
_AROUND = 0.28
"""Where a square is looked at beside its middle, in steps along both axes."""


@dataclass(frozen=True, eq=False)
class Bits:
    """Dots that were read.

    Parameters
    ----------
    at : ndarray of int (k, 2)
        Twice the coordinates of their places in the lattice.
    sign : ndarray of int (k,)
        1 or -1, as in :func:`reseau.designs.dots.dot_signs`.
    """

    at: Integers
    sign: NDArray[np.int8]

    def compared(self, signs: NDArray[np.int8], turn: Integers, shift: Integers) -> tuple[int, int]:
        """Number of dots that differ from those of a design with the lattice there, and of all compared."""
        place = self.at @ turn.T + 2 * shift + 1
        inside = ((place >= 0) & (place < signs.shape)).all(axis=1)
        expected = signs[tuple(place[inside].T)]
        read = expected != 0
        return int((expected[read] != self.sign[inside][read]).sum()), int(read.sum())


def read_bits(grey: NDArray[np.float32], mapping: Chain, nodes: Integers, on_edges: bool) -> Bits:
    """Read the dots on edges between corners, or in squares.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    mapping : Chain
        Mapping from the lattice to the image.
    nodes : ndarray of int (n, 2)
        Nodes that were found.
    on_edges : bool
        Whether dots are on edges (white: 1), otherwise in squares (there is one: 1).
    """
    known = {tuple(node) for node in nodes.tolist()}

    def whole(*others: tuple[int, int]) -> Integers:
        """Nodes whose neighbours were found, too."""
        rows = [
            k for k, (x, y) in enumerate(nodes.tolist()) if all((x + i, y + j) in known for i, j in others)
        ]
        return np.asarray(nodes[rows])

    if not on_edges:
        middle = 2 * whole((1, 0), (0, 1), (1, 1)) + 1
        around = _AROUND * np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])
        own = levels_around(grey, mapping, middle / 2, around)
        beside = levels_around(grey, mapping, middle / 2, around * (1 / _AROUND - 1))
        # Squares that share a side have the other colour.
        other = np.median(beside, axis=1) - np.median(own, axis=1)
        level = levels_around(grey, mapping, middle / 2, np.zeros((1, 2)))[:, 0] - np.median(own, axis=1)
        dotted = level / np.where(other == 0, 1e-9, other) > _DOTTED
        return Bits(middle, np.where(dotted, 1, -1).astype(np.int8))
    found, sign = [], []
    for step in np.eye(2, dtype=np.intp):
        middle = np.asarray(2 * whole((int(step[0]), int(step[1]))) + step, dtype=np.intp)
        across = step[::-1]
        levels = levels_around(grey, mapping, middle / 2, np.array([[0.0], [0.4], [-0.4]]) * across)
        contrast = np.abs(levels[:, 1] - levels[:, 2])
        brighter = levels[:, 0] - levels[:, 1:].mean(axis=1)
        sure = np.abs(brighter) > _SURE * contrast
        found.append(middle[sure])
        sign.append(np.sign(brighter[sure]).astype(np.int8))
    return Bits(np.concatenate(found), np.concatenate(sign))
