"""What an instrument draws beside its image: characters, ticks, scale dots, markers.

A drawn stroke is as sharp as the screen is, in every direction; an echo is blurred along its arc. Where a
drawing has been softened by copying, its fellows betray it: characters stand in rows of one height, the dots
and ticks of a scale are alike and equally spaced. A row is condemned when most of its members look drawn each
by itself, so that rods in rows are not.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Frame, Mask, Rows
from .echoes import Echoes

__all__ = ["is_sharp", "looks_sharp", "same_in_all", "series"]

_SHARP = 0.16
"""Squared steps over squared light even along the stroke: a Gaussian of 1.8 px."""
_SUSPECT = 0.08
"""The same of a spot that is drawn if its fellows are: a Gaussian of 2.5 px."""
_ACROSS = 0.42
"""The same across it: a Gaussian of 1.1 px; an echo that sharp is drawn when it is short, too."""
_FEWEST = 4
"""Members that make a row."""


def is_sharp(echoes: Echoes) -> Mask:
    """Spots with sharp borders all around, (m,)."""
    short = echoes.length < 8.0
    sharp: Mask = (echoes.edge[:, 1] > _SHARP) | (short & (echoes.edge[:, 0] > _ACROSS))
    return sharp


def looks_sharp(echoes: Echoes) -> Mask:
    """Spots about as sharp along as across, (m,): drawn, if they stand in a row of such."""
    suspect: Mask = echoes.edge[:, 1] > _SUSPECT
    return suspect


def series(echoes: Echoes, suspect: Mask) -> tuple[Mask, Mask]:
    """Spots that belong to rows of characters, and to rows of like marks at equal spacing.

    Parameters
    ----------
    echoes : Echoes
        The spots (m,).
    suspect : ndarray of bool (m,)
        Which look drawn each by itself.

    Returns
    -------
    characters, scale : ndarray of bool (m,)
        Spots of rows in which most are suspect.
    """
    return _condemned(_lines_of_text(echoes), suspect), _condemned(_equally_spaced(echoes), suspect)


def _condemned(rows: list[Rows], suspect: Mask) -> Mask:
    found = np.zeros(len(suspect), dtype=bool)
    for row in rows:
        if suspect[row].mean() > 0.5:
            found[row] = True
    return found


def _lines_of_text(echoes: Echoes) -> list[Rows]:
    """Runs of neighbours between one top and one bottom."""
    left, right, top, bottom = echoes.box.T
    high, middle = bottom - top + 1, (top + bottom) / 2
    rows = []
    glyph = (right - left < 1.6 * high) & (high > 3)
    for size in np.unique(high[glyph]):
        for line in np.unique(top[glyph & (high == size)]):
            alike = np.flatnonzero(glyph & (np.abs(top - line) <= 1) & (np.abs(high - size) <= 1))
            for run in _runs(left[alike], right[alike], 1.5 * size):
                if len(run) < _FEWEST:
                    continue
                first, last = left[alike[run]].min(), right[alike[run]].max()
                # Points, dashes and the parts of letters between them belong to the line.
                inside = (np.abs(middle - line - size / 2) < size) & (high <= 2 * size)
                inside &= (right > first - 2 * size) & (left < last + 2 * size)
                rows.append(np.flatnonzero(inside))
    return rows


def _runs(left: Rows, right: Rows, gap: float) -> list[Rows]:
    """Intervals in groups whose members are at most a gap apart."""
    order = np.argsort(left, kind="stable")
    reached = np.maximum.accumulate(right[order])
    breaks = np.flatnonzero(left[order][1:] - reached[:-1] > gap) + 1
    return list(np.split(order, breaks))


def _equally_spaced(echoes: Echoes) -> list[Rows]:
    """Rows of like spots at equal steps along a straight line."""
    rows = []
    size = np.stack([echoes.length, echoes.thickness], axis=1)
    for i in range(len(echoes)):
        alike = np.flatnonzero(
            (np.abs(echoes.height - echoes.height[i]) < 0.08 * echoes.height[i])
            & (np.abs(size - size[i]) < 0.15 * size[i] + 0.3).all(axis=1)
        )
        alike = alike[alike != i]
        if len(alike) < _FEWEST - 1:
            continue
        step = echoes.xy[alike] - echoes.xy[i]
        # With each of its fellows as the next of the row: how many more are where the row has them?
        off = (
            np.abs(step[None] - 2 * step[:, None]).max(axis=2),
            np.abs(step[None] - 3 * step[:, None]).max(axis=2),
        )
        third, fourth = (distance.argmin(axis=1) for distance in off)
        each = np.arange(len(alike))
        on = (off[0][each, third] < 1.5) & (off[1][each, fourth] < 2.0)
        rows += [np.array([i, alike[k], alike[third[k]], alike[fourth[k]]]) for k in np.flatnonzero(on)]
    return rows


def same_in_all(frame: Frame, others: tuple[Frame, ...]) -> Mask | None:
    """Pixels that are bright and the same in all frames of a sequence; None where nothing moves at all.

    Parameters
    ----------
    frame : Frame
        One of them.
    others : tuple of Frame
        Further ones; those of another size are left out.
    """
    stack: list[Array] = [other.pixels for other in others if other.pixels.shape == frame.pixels.shape]
    if not stack:
        return None
    own = frame.pixels.astype(np.float32)
    change = np.max([np.abs(own - other) for other in stack], axis=0)
    ground = float(np.median(own))
    bright = own > ground + 0.05 * (float(own.max()) - ground)
    same: Mask = change <= 0.02 * frame.full_scale
    if not bright.any() or same[bright].mean() > 0.98:
        return None
    return bright & same
