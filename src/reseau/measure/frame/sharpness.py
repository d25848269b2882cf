"""How sharp the steps of a frame's edges are, and by how much what lies beside an edge may have drawn them.

A line of the picture close behind an edge (Cruz et al., fig. 7B) cannot be told from it by a profile alone.
But it widens the step that is seen, and neighbours alike; a picture's forms do so at random, here and there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from ...core.data import Array
from .edges import NEIGHBOURS, EdgeProfiles

__all__ = ["FEW_DRAWN", "Sharp", "common_widths", "drawn_by_lines", "sharp_steps"]

_QUANTILES, _EVEN = (0.1, 0.3), 0.015
"""Of the widths of profiles: the greater is that of a sharp step, their difference tells how they differ from
place to place, logarithm, at least so much."""
_UNEVEN, _SCRATCHED = 0.2, 0.5
"""Logarithms by which widths of three edges differ if the scan is sharper at one side than at another, and
that of the sharpest from the next if it is no edge's."""
_TOO_SHARP = 0.3
"""Logarithm by which steps are too sharp for those of an edge."""
_FARTHEST = 1.5
"""Widths by which a line may draw a step at most; one that is farther away is seen by itself."""
_RATIO, FEW_DRAWN = 4.0, 0.22
"""Of the second step to the first, where a line of the picture draws an edge; and part of its profiles that
show it by chance."""
_TOGETHER, _INDEPENDENT = 5, 2.5
"""Neighbourhoods of profiles that a line widens alike; as how many their mean tells in a picture's forms."""


class Sharp(NamedTuple):
    """Sharp steps of an edge.

    Parameters
    ----------
    log_width : float
        Logarithm of their width.
    scatter, texture : float
        By how much it differs from place to place at least; and at random, by the picture's forms.
    """

    log_width: float
    scatter: float
    texture: float

    @property
    def width(self) -> float:
        """One sigma, pixels."""
        return float(np.exp(self.log_width))

    def beyond(self, found: EdgeProfiles) -> bool:
        """Whether most steps are sharper than those of an edge can be: a scratch's."""
        return bool(np.median(found.blur[0][found.good]) < self.log_width - _TOO_SHARP)


def common_widths(profiles: Sequence[EdgeProfiles | None]) -> list[float | None]:
    """Width of the blurred step for each edge: one for all, unless they are focused differently."""
    told = sorted(p.width for p in profiles if p is not None and p.good.sum() > 20)
    if not told:
        return [None] * len(profiles)
    if _uneven(told):
        return [None if p is None else p.width for p in profiles]
    return [told[(len(told) - 1) // 2]] * len(profiles)


def sharp_steps(profiles: Sequence[EdgeProfiles | None]) -> list[Sharp]:
    """Sharp steps of each edge: of all together, unless they are focused differently."""
    own = [p.blur[0][p.good] if p is not None else np.zeros(0) for p in profiles]
    sharp = [_sharp(widths) for widths in own]
    seen = [each for each, widths in zip(sharp, own, strict=True) if len(widths)]
    if not seen:
        return sharp
    # A line beside one of the edges scatters its widths, not those of the others.
    second = min(1, len(seen) - 1)
    texture = sorted(each.texture for each in seen)[second]
    if _uneven(sorted(each.width for each in seen)):
        return [each._replace(texture=texture) for each in sharp]
    scatter = sorted(each.scatter for each in seen)[second]
    return [Sharp(_sharp(np.concatenate(own)).log_width, scatter, texture)] * len(profiles)


def drawn_by_lines(found: EdgeProfiles, sharp: Sharp) -> tuple[Array, float]:
    """By how much lines of the picture beside an edge may draw its steps to them, pixels (n,); how many do.

    A second step of a part r of the contrast, s behind the first, is seen as one that is moved by r·s and has
    the variance w² + r(1 − r)·s². One that is too sharp is a line by itself.
    """
    sure = _unlike(found, sharp, 2.0)
    part = float(np.mean(sure[found.good] > 0)) if found.good.any() else 0.0
    if part > FEW_DRAWN:
        # There is such a line: what is no proof is a sign now.
        sure = _unlike(found, sharp, 1.0)
    moved = np.minimum(np.sqrt(_RATIO * np.expm1(2 * np.maximum(sure, 0.0))), _FARTHEST)
    if part > FEW_DRAWN:
        moved = moved * np.sqrt(NEIGHBOURS)  # which are drawn alike
    return np.asarray(sharp.width * moved), part


def _unlike(found: EdgeProfiles, sharp: Sharp, sigmas: float) -> Array:
    """By how much widths surely differ from a sharp step's, logarithm (n,): alone, or with those around."""
    other, variance = found.blur[0] - sharp.log_width, found.blur[1] + sharp.texture**2
    size = min(_TOGETHER * NEIGHBOURS, len(other))
    mean, own = (uniform_filter1d(values, size, mode="nearest") for values in (other, variance))
    alone = np.abs(other) - sigmas * np.sqrt(variance)
    together = mean - sigmas * np.sqrt(own / _INDEPENDENT)
    return np.asarray(np.minimum(np.maximum(alone, together) - sharp.scatter, 1.0))


def _sharp(widths: Array) -> Sharp:
    if not len(widths):
        return Sharp(0.0, _EVEN, 0.0)
    low, high = np.quantile(widths, _QUANTILES)
    # A picture's forms move the steps, too, where it shows; a line along the edge widens neighbours alike.
    apart = np.abs(np.diff(widths[::NEIGHBOURS]))
    texture = 1.4826 * float(np.median(apart)) / np.sqrt(2) if len(apart) > 3 else 0.0
    return Sharp(float(high), max(float(high - low), _EVEN), texture)


def _uneven(widths: Sequence[float]) -> bool:
    """Whether sorted widths differ by more than what a picture beside one of the edges does to it."""
    if len(widths) > 3 and np.log(widths[1] / widths[0]) > _SCRATCHED:
        widths = widths[1:]  # no lens is that sharp at one edge alone
    return bool(len(widths) > 2 and np.log(widths[2] / widths[0]) > _UNEVEN)
