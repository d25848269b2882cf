"""Reverberations: second echoes of one reflector, behind the first by a fixed spacing and weaker by a ratio.

Three explanations of a frame compete. Either its spots are unrelated; then a spot lies behind another one by
chance, as dense as spots are. Or reflectors stand at equal spacings, as the rods of a lattice; then they are
as strong as those in front of them. Or the instrument repeats each echo: then *every* echo that is strong
enough has a weaker second one at the spacing, unless a wire hides it, and an echo without one contradicts.
Points of a body that happen to lie behind others explain some pairs, but not that none is missing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array, Mask, Rows
from ..marks.judging import robust_spread

_SEEN = 0.95
"""Probability that a second echo is found where it is strong enough and nothing hides it."""
_ACROSS, _ALONG = 0.06, 0.15
"""Scatter of the offset: in depth over the spacing, as a display distorts it, and along the echo over its
length, as wires hide parts of either."""
_PIXELS = 0.7
"""Scatter of the offsets of approximate positions, pixels."""
_FAINTER = 0.35
"""Scatter of the logarithm of the ratio of strengths."""
_RATIOS = np.log(np.geomspace(0.08, 0.65, 12))
"""Ratios of strengths that are tried, equally likely before."""
_FIRST_ODDS = np.log(1000.0)
"""What an instrument that repeats its echoes must explain better, beyond the number of spacings tried."""
_DECIDED = np.log(20.0)
"""Logarithm of the odds from which a spot is a point, or a second echo; between, it may be either."""


@dataclass(frozen=True, eq=False)
class Reverberations:
    """Which spots of a frame repeat others.

    Parameters
    ----------
    of : ndarray of int (m,)
        Spot that each one repeats; -1 for none, -2 where the first echo is not seen.
    doubtful : ndarray of bool (m,)
        Spots that may be second echoes or points.
    spacing : float
        Distance behind the first echo, pixels.
    ratio : float
        Strength over that of the first echo.
    evidence : float
        Logarithm of the ratio of likelihoods of both explanations.
    """

    of: Rows
    doubtful: Mask
    spacing: float = np.nan
    ratio: float = np.nan
    evidence: float = 0.0


def find_reverberations(
    xy: Array,
    height: Array,
    length: Array,
    candidate: Mask,
    covered: Mask,
    least: float,
    farthest: float,
    direction: float = 0.0,
) -> Reverberations:
    """Decide whether the instrument repeats its echoes, and which spots repeat others.

    Parameters
    ----------
    xy, height, length : ndarray (m, 2), (m,), (m,)
        Spots.
    candidate : ndarray of bool (m,)
        Spots that may be first echoes; others may only repeat them.
    covered : ndarray (h, w) of bool
        Pixels on which nothing is found.
    least : float
        Height from which a spot is found.
    farthest : float
        Largest spacing, pixels.
    direction : float
        Common direction (rad) of the echoes; depth is at right angles to it.

    Examples
    --------
    Twenty echoes, of which each but one, whose second echo is behind a wire, is repeated 12 px below it:

    >>> rng = np.random.default_rng(0)
    >>> first = rng.uniform([20, 20], [780, 560], (20, 2))
    >>> xy = np.concatenate([first, first[1:] + [0.0, 12.0]])
    >>> height, every = np.repeat([100.0, 35.0], [20, 19]), np.ones(39, dtype=bool)
    >>> covered = np.zeros((600, 800), dtype=bool)
    >>> x, y = np.rint(first[0]).astype(int)
    >>> covered[y + 10 : y + 15, x - 5 : x + 6] = True
    >>> found = find_reverberations(xy, height, np.full(39, 25.0), every, covered, 5.0, 60.0)
    >>> round(found.spacing, 1), round(found.ratio, 2), found.of[20:].tolist() == list(range(1, 20))
    (12.0, 0.35, True)
    """
    pairs = _Pairs(xy, height, length, candidate, covered, least, farthest, direction)
    best = Reverberations(np.full(len(xy), -1), np.zeros(len(xy), dtype=bool))
    spacings = pairs.spacings()
    score, found = 0.0, None
    for spacing in spacings:
        for ratio in _RATIOS:
            gain = pairs.gain(spacing, ratio)
            if gain > score:
                score, found = gain, (spacing, ratio)
    if found is None or score < _FIRST_ODDS + np.log(len(spacings) * len(_RATIOS)):
        return best
    return pairs.decided(*pairs.refined(*found), score)


class _Pairs:
    """Spots and those behind them."""

    def __init__(
        self,
        xy: Array,
        height: Array,
        length: Array,
        candidate: Mask,
        covered: Mask,
        least: float,
        far: float,
        direction: float,
    ) -> None:
        c, s = np.cos(direction), np.sin(direction)
        self.depth = np.array([-s, c])
        across, down = xy @ [c, s], xy @ self.depth
        self.xy, self.height, self.length = xy, height, length
        self.candidate, self.covered, self.least = candidate, covered, least
        self.log = np.log(np.maximum(height, 1e-12))
        rows, columns = covered.shape
        self.density = max(len(xy), 1) / (rows * columns)
        first, second = np.nonzero(
            (np.abs(down[None] - down[:, None]) < far)
            & (np.abs(across[None] - across[:, None]) < 0.5 * length[:, None] + 2)
            & candidate[:, None]
            & ~np.eye(len(xy), dtype=bool)
        )
        self.first, self.second = first, second
        self.off = np.stack([axis[self.second] - axis[self.first] for axis in (across, down)], axis=1)
        self.fainter = self.log[self.second] - self.log[self.first]

    def spacings(self) -> Array:
        """Spacings at which most pairs agree, in both directions, pixels."""
        depth = self.off[:, 1]
        if len(depth) < 2:
            return np.empty(0)
        near = np.abs(depth[None] - depth[:, None]) < _PIXELS + _ACROSS * np.abs(depth)[:, None]
        order = np.argsort(-near.sum(axis=1), kind="stable")
        chosen: list[float] = []
        for k in order:
            middle = float(np.median(depth[near[k]]))
            if abs(middle) > 2 and all(abs(middle - one) > _PIXELS for one in chosen):
                chosen.append(middle)
            if len(chosen) == 20:
                break
        return np.array(chosen)

    def _seconds(self, spacing: float, ratio: float) -> tuple[Rows, Array]:
        """The likeliest second echo of each spot, -1 for none, and what it explains."""
        depth = np.hypot(_PIXELS, _ACROSS * spacing)
        along = np.hypot(_PIXELS, _ALONG * self.length[self.first])
        gain = -0.5 * (
            ((self.off[:, 1] - spacing) / depth) ** 2
            + (self.off[:, 0] / along) ** 2
            + ((self.fainter - ratio) / _FAINTER) ** 2
        )
        # Against a spot anywhere, of any strength between that of the faintest and of the first.
        spread = np.maximum(self.log[self.first] - np.log(self.least), 0.5)
        gain += np.log(_SEEN * spread / ((2 * np.pi) ** 1.5 * depth * along * _FAINTER * self.density))
        best, second = np.zeros(len(self.xy)), np.full(len(self.xy), -1)
        order = np.argsort(gain, kind="stable")
        for k in order[gain[order] > 0]:
            best[self.first[k]], second[self.first[k]] = gain[k], self.second[k]
        return second, best

    def expected(self, spacing: float, ratio: float) -> Mask:
        """Spots whose second echo would be strong enough, and not hidden."""
        at = self.xy + spacing * self.depth
        strong = self.log + ratio - 2 * _FAINTER > np.log(self.least)
        return np.asarray(strong & ~self.hidden(at))

    def hidden(self, at: Array) -> Mask:
        """Places (k, 2) on which nothing is found, or beyond the frame."""
        rows, columns = self.covered.shape
        x, y = np.rint(at).astype(np.intp).T
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        return np.asarray(~inside | self.covered[np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)])

    def gain(self, spacing: float, ratio: float) -> float:
        """Logarithm of the likelihood of spots that repeat others, over that of the better rival."""
        second, best = self._seconds(spacing, ratio)
        repeated = np.zeros(len(self.xy), dtype=bool)
        repeated[second[second >= 0]] = True
        alone = self.candidate & (second < 0) & ~repeated & self.expected(spacing, ratio)
        depth = np.hypot(_PIXELS, _ACROSS * spacing)
        behind = np.abs(self.off[:, 1] - spacing) < 2.5 * depth
        alike = (self.fainter[behind] / _FAINTER) ** 2 - ((self.fainter[behind] - ratio) / _FAINTER) ** 2
        return float(min(best.sum(), 0.5 * alike.sum()) + np.log(1 - _SEEN) * alone.sum())

    def refined(self, spacing: float, ratio: float) -> tuple[float, float]:
        """Spacing and ratio, from the pairs that they explain."""
        second, _ = self._seconds(spacing, ratio)
        has = second >= 0
        depth = (self.xy[second[has]] - self.xy[has]) @ self.depth
        return float(np.median(depth)), float(np.median(self.log[second[has]] - self.log[has]))

    def decided(self, spacing: float, ratio: float, evidence: float) -> Reverberations:
        """What each spot is."""
        second, best = self._seconds(spacing, ratio)
        of, doubtful = np.full(len(self.xy), -1), np.zeros(len(self.xy), dtype=bool)
        has = np.flatnonzero(second >= 0)
        # A spot much stronger than the second echo that it covers is a point.
        excess = (self.log[second[has]] - self.log[has] - ratio) / _FAINTER
        of[second[has]] = has
        doubtful[second[has[(best[has] < _DECIDED) | (excess > 2.5)]]] = True
        firsts = np.setdiff1d(np.flatnonzero(self.candidate), second[has])
        usual = float(np.median(self.log[firsts])) if len(firsts) else 0.0
        scatter = np.hypot(_FAINTER, robust_spread(self.log[firsts], usual))
        # Spots behind a wire that may hide their first echo: weak, and without a second one.
        behind = self.hidden(self.xy - spacing * self.depth) & (second < 0) & (of < 0)
        for k in np.flatnonzero(behind):
            odds = 0.5 * ((self.log[k] - usual) / scatter) ** 2
            odds -= 0.5 * ((self.log[k] - usual - ratio) / scatter) ** 2
            if self.expected(spacing, ratio)[k]:
                odds -= np.log(1 - _SEEN)
            if odds > -_DECIDED:
                of[k], doubtful[k] = -2, odds < _DECIDED
        return Reverberations(of, doubtful, spacing, float(np.exp(ratio)), evidence)
