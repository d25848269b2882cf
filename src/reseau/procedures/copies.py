"""Copies of a photograph among others, by the points that were measured in them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..core.data import Array, ImagePoints

_LEAST_COMMON = 8
"""Points in common with which photographs are compared."""
_KNOWN = np.log(1.5)
"""Standard deviation of the logarithm of the variances that measurements state, against the scatter of
photographs of one pose."""
_LEAST_SHARE = 1e-4
"""Share of the variances of a copy that was hardly compressed; of one that is as its original it is less."""


def copies_among(measured: Mapping[str, ImagePoints]) -> dict[str, str]:
    """Photographs that are copies of others, by their names: the first of those that are alike.

    Parameters
    ----------
    measured : mapping of str to ImagePoints
        Points of each photograph.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> xy = rng.uniform(0, 600, (20, 2))
    >>> names = [str(k) for k in range(20)]
    >>> first, second = (ImagePoints.with_sigma(names, xy + rng.normal(0, 0.01, (20, 2)), 0.01) for _ in "ab")
    >>> copies_among({"a.jpg": first, "b.jpg": second, "again.jpg": first})
    {'again.jpg': 'a.jpg'}
    """
    row = {
        name: k for k, name in enumerate(dict.fromkeys(n for each in measured.values() for n in each.names))
    }
    images = list(measured)
    xy = np.full((len(images), len(row), 2), np.nan)
    variance = np.full((len(images), len(row), 2), np.nan)
    for k, points in enumerate(measured.values()):
        at = [row[name] for name in points.names]
        xy[k, at], variance[k, at] = points.xy, np.diagonal(points.cov, axis1=1, axis2=2)
    original = dict[int, int]()
    for k in range(len(images)):
        if k not in original:
            later = np.arange(k + 1, len(images))
            square = (xy[later] - xy[k]) ** 2 / (variance[later] + variance[k])
            original |= {int(n): k for n in later[_of_one_exposure(square)] if int(n) not in original}
    return {images[n]: images[k] for n, k in sorted(original.items())}


def said_of_copies(copies: Mapping[str, str]) -> tuple[str, ...]:
    """What is said of copies: one note, or none.

    Examples
    --------
    >>> said_of_copies({"b.jpg": "a.jpg", "c.jpg": "a.jpg"})
    ('copies of one photograph count once: a.jpg = b.jpg = c.jpg',)
    """
    groups: dict[str, list[str]] = {}
    for copy, original in copies.items():
        groups.setdefault(original, [original]).append(copy)
    said = ", ".join(" = ".join(names) for names in groups.values())
    return (f"copies of one photograph count once: {said}",) if said else ()


def _of_one_exposure(square: Array) -> Array:
    """Which photographs (m,) have differences, squared and over their variances (m, n, 2), of a copy."""
    known = np.isfinite(square)
    count = known.sum(axis=(1, 2))
    share = np.where(known, square, 0.0).sum(axis=(1, 2)) / np.maximum(count, 1)
    size = np.log(np.maximum(share, _LEAST_SHARE))
    spread = np.sqrt(_KNOWN**2 + 2 / np.maximum(count, 1))
    exposure = np.exp(-0.5 * (size / spread) ** 2) / (np.sqrt(2 * np.pi) * spread)
    copy = 1 / -np.log(_LEAST_SHARE)
    return np.asarray((count >= 2 * _LEAST_COMMON) & (share < 1) & (copy > exposure))
