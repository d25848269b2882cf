"""Where unexposed film ends: the straight line beyond which there is film alone, and within it a picture.

The strongest gradient is not the edge of a frame where something bright runs along it within the picture
(Cruz et al., fig. 7B). What tells the edge is what is *beyond* it: film of one tone. Each place along and
across gets the logarithm of how much more likely it belongs to a picture than to unexposed film; the edge is
the line for which their sum within it is greatest. Both likelihoods have broad tails: dust and scratches on
the film cost little, and so do dark parts of the picture.
"""

from __future__ import annotations

import numpy as np

from ...data import Array

__all__ = ["best_line", "first_departure", "likelihood"]

_PICTURE, _FILM = 2.3, 0.65
"""Log-likelihood of a place that differs from film, and the loss by one that does not: half of a picture's
edge may be as dark as film, one place in twenty of film may be dust."""


def likelihood(departure: Array, known: Array, start: int, gap: int) -> Array:
    """How much more likely places belong to the picture than to film.

    Parameters
    ----------
    departure : ndarray (n, s)
        By how much n profiles differ from film, in the sense of the picture, over the least difference that
        is significant; s places from the outside to the inside.
    known : ndarray of bool (n, s)
        Which places are in the scan at all.
    start : int
        A column that is surely not far outside the edge. What lies further out behind `gap` columns of film,
        as perforations and neighbours do, counts as film.
    """
    ratio = np.clip((departure - 0.5) / 0.5, 0.0, 1.0) * known
    differs = ratio > 0.5
    run, beyond = np.zeros(len(ratio)), np.zeros(len(ratio), dtype=bool)
    for column in range(start, -1, -1):
        run = np.where(differs[:, column], 0.0, run + 1)
        ratio[beyond, column] = 0.0
        beyond |= run >= gap
    found = np.where(known, -_FILM + (_PICTURE + _FILM) * ratio, 0.0)
    # A profile that differs nowhere tells nothing about where its picture begins.
    lit = (ratio > 0.5).any(axis=1, keepdims=True)
    return np.asarray(np.where(lit, found, 0.0))


def best_line(found: Array, along: Array, first: int, last: int, tilt: int) -> tuple[float, float, float]:
    """Straight line of the greatest sum within it.

    Parameters
    ----------
    found : ndarray (n, s)
        As from :func:`likelihood`.
    along : ndarray (n,)
        Places of the profiles, −1 to 1.
    first, last : int
        Range of the column at which the line may stand at either end.
    tilt : int
        Columns by which its ends may differ at most.

    Returns
    -------
    (float, float, float)
        Columns before which the inside begins at the places −1 and 1 (the line is half a column before), and
        the sum per profile, less that of the best line that is elsewhere.
    """
    within = np.cumsum(found[:, ::-1], axis=1)[:, ::-1]
    within = np.concatenate([within, np.zeros((len(found), 1))], axis=1)
    ends = np.arange(first, last + 1)
    start, stop = (e.ravel() for e in np.meshgrid(ends, ends, indexing="ij"))
    near = np.abs(stop - start) <= tilt
    start, stop = start[near], stop[near]
    share = (along + 1) / 2
    column = np.rint(start[:, None] * (1 - share) + stop[:, None] * share).astype(np.intp)
    total = within[np.arange(len(found)), np.clip(column, 0, found.shape[1])].sum(axis=1)
    best = int(np.argmax(total))
    # Lines as good as the best are one with it: take their middle.
    alike = total > total[best] - 0.5
    alike &= (np.abs(start - start[best]) <= 1) & (np.abs(stop - stop[best]) <= 1)
    other = (np.abs(start - start[best]) > 3) & (np.abs(stop - stop[best]) > 3)
    margin = float(total[best] - total[other].max()) if other.any() else float(total[best])
    return float(start[alike].mean()), float(stop[alike].mean()), margin / len(found)


def first_departure(found: Array, middle: Array, reach: int) -> Array:
    """For each profile the column at which its inside begins, within `reach` of the given columns (n,)."""
    within = np.cumsum(found[:, ::-1], axis=1)[:, ::-1]
    columns = np.rint(middle).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    columns = np.clip(columns, 0, found.shape[1] - 1)
    value = np.take_along_axis(within, columns, axis=1)
    return np.asarray(np.take_along_axis(columns, value.argmax(axis=1)[:, None], axis=1)[:, 0], dtype=float)
