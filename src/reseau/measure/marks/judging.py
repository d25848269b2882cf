"""The judgement of measured marks: by their own images, and by what their neighbours predict."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ...core.data import Array, Mask, Rows
from ...core.failure import Code
from ...optics.field import SmoothField
from ..matching import Matches
from ..points import Reason

Objection = tuple[Mask, str, Code]
"""Which of some marks are declined, and why."""
_FEWEST = 10
"""Number of marks from which they predict each other."""
_LENGTH_OF = 80
"""Number of marks from which the correlation length of what a polynomial leaves is that of half as many."""


def robust_spread(values: Array, middle: float | None = None) -> float:
    """Standard deviation of values about their median, or `middle`, by the median of absolute deviations."""
    return 1.4826 * float(np.median(np.abs(values - (np.median(values) if middle is None else middle))))


def reasons_of(objections: Iterable[Objection], count: int) -> Array:
    """The first objection to each of so many marks, as a :class:`Reason`; empty where there is none."""
    why = np.full(count, "", dtype=object)
    for mask, text, code in objections:
        why[mask & (why == "")] = Reason(text, code)
    return why


def judged_by_neighbours(
    source: Array,
    xy: Array,
    variance: Array,
    why: Array,
    limit: Array,
    sigmas: float,
    before: SmoothField | None,
) -> tuple[Array, SmoothField | None, Array]:
    """Decline marks that deviate from the prediction by all others, the worst first.

    Parameters
    ----------
    source, xy : ndarray (n, 2)
        Coordinates of the design, and measured ones.
    variance : ndarray (n,)
        Mean variance of both coordinates, with what no sigma contains.
    why : ndarray (n,)
        Reasons so far.
    limit : ndarray (n,)
        Largest deviation along an axis, where `sigmas` of the prediction are not more.
    before : SmoothField, optional
        A field with the length scale of these marks.

    Returns
    -------
    why : ndarray (n,)
        Reasons, with those that were added.
    field : SmoothField or None
        The field through the marks without a reason; None where these are too few.
    deviation : ndarray (n, 2)
        Deviations of these from the prediction by the others, NaN elsewhere.
    """
    why, field, known, deviation = why.copy(), None, before, np.full(xy.shape, np.nan)
    while (good := np.flatnonzero(why == "")).size >= _FEWEST:
        if known is None and good.size >= _LENGTH_OF:
            some = good[:: good.size // (_LENGTH_OF // 2)]
            known = SmoothField.fit(source[some], xy[some])
        # The length scale found first is used in all rounds; without one, the likeliest is chosen.
        length = known.length if known is not None and np.isfinite(known.length) else None
        relative = np.sqrt(variance[good] / np.median(variance[good]))
        field = known = SmoothField.fit(source[good], xy[good], sigma=relative, length=length)
        off, sigma = field.leave_one_out()
        deviation[:] = np.nan
        deviation[good] = off
        excess = (np.abs(off) / np.maximum(limit[good, None], sigmas * sigma)).max(axis=1)
        worst = int(excess.argmax())
        if excess[worst] <= 1:
            break
        text = f"{np.hypot(*off[worst]):.1f} px from the position predicted by its neighbours"
        why[good[worst]] = Reason(text, Code.DEVIATES)
    deviation[why != ""] = np.nan
    return why, field, deviation


def spread(values: Array, rows: Rows, count: int) -> Array:
    """Values (k, …) of some rows in a column of so many, NaN elsewhere."""
    full = np.full((count, *values.shape[1:]), np.nan)
    full[rows] = values
    return full


def columns_of(found: Matches, rows: Rows, why: Array, otherwise: Array) -> dict[str, Any]:
    """Columns of a result over all marks of a design, of which `rows` were matched.

    Parameters
    ----------
    found : Matches
        The matches (k).
    why : ndarray (k,)
        Reasons of those that are declined.
    otherwise : ndarray (n,)
        Reasons of all marks that were not matched.
    """
    good, n = why == "", len(otherwise)
    reasons = otherwise.copy()
    reasons[rows] = why
    columns = {name: spread(getattr(found, name), rows, n) for name in ("psf_px", "contrast", "t", "noise")}
    kept = {name: spread(getattr(found, name)[good], rows[good], n) for name in ("xy", "cov")}
    return columns | kept | {"ok": np.isin(np.arange(n), rows[good]), "why": tuple(reasons)}
