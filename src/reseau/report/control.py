"""Control charts as a figure: values with what was expected of them, limits, signals and service events."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any

import matplotlib.dates as dates

from ..core.data import Array, Rows
from ..core.figures import ACCENT, BLUE, FAINT, INK, sheet, to_svg

_HIGH, _WIDE, _LIMIT = 1.35, 8.6, 3.0


def control_figure(
    names: Sequence[str],
    times: Sequence[datetime],
    values: Array,
    expected: Array,
    sigma: Array,
    alarm: Rows,
    events: Sequence[tuple[datetime, str]] = (),
) -> str:
    """Draw the charts of a configuration, one above the other.

    Parameters
    ----------
    names : sequence of str (c,)
        Names of the series.
    times : sequence of datetime (n,)
        Times of the calibrations.
    values, expected, sigma : ndarray (n, c)
        Values, their predictions from the earlier ones, and the standard deviations of value minus
        prediction; NaN where nothing is predicted yet.
    alarm : ndarray (n, c)
        Where a chart signals, not zero.
    events : sequence of (datetime, str)
        Service events.

    Returns
    -------
    str
        An SVG element.

    Examples
    --------
    >>> import numpy as np
    >>> at = [datetime(2026, 3, day) for day in (2, 9)]
    >>> none = np.full((2, 1), np.nan)
    >>> control_figure(("c",), at, np.ones((2, 1)), none, none, np.zeros((2, 1), int))[:4]
    '<svg'
    """
    with sheet((_WIDE, 0.6 + _HIGH * len(names))) as figure:
        every: Any = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        number: Any = dates.date2num(list(times))  # type: ignore[no-untyped-call]
        for k, axes in enumerate(every):
            low, high = (expected[:, k] + side * _LIMIT * sigma[:, k] for side in (-1, 1))
            axes.fill_between(number, low, high, color=BLUE, alpha=0.12, linewidth=0, step="mid")
            axes.plot(number, expected[:, k], "-", color=FAINT, linewidth=0.8)
            axes.plot(number, values[:, k], "o-", color=INK, markersize=3, linewidth=0.7)
            signals = alarm[:, k] != 0
            axes.plot(number[signals], values[signals, k], "o", color=ACCENT, markersize=6)
            for at, _ in events:
                axes.axvline(float(dates.date2num(at)), color=ACCENT, linewidth=0.8, linestyle=":")  # type: ignore[no-untyped-call]
            axes.set_ylabel(names[k])
            axes.margins(x=0.02)
        every[-1].xaxis.set_major_formatter(dates.ConciseDateFormatter(dates.AutoDateLocator()))  # type: ignore[no-untyped-call]
        return to_svg(figure)
