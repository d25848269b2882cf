"""Maps of true coordinates with their error ellipses."""

from __future__ import annotations

import numpy as np
import scipy
from matplotlib.axes import Axes

from ..core.data import Array, ImagePoints
from ..core.figures import (
    ACCENT,
    BLUE,
    FAINT,
    INK,
    Panel,
    beside,
    draw_ellipses,
    length,
    nice,
    plane_axes,
    sheet,
    to_svg,
)

PROBABILITY = 0.95
"""Probability that a point lies within its ellipse."""
_SIZE = (4.1, 4.1)
_SHOWN = 4.0
"""Semi-axis of a median ellipse, in percent of the extent of the map."""


def body_map(true: ImagePoints, rods: Array, unit: str, errors: Array | None = None) -> tuple[str, float]:
    """Draw points with their ellipses.

    Parameters
    ----------
    true : ImagePoints
        True coordinates with covariances.
    rods : ndarray (m, 2)
        The rods of the test object, which show the validity of the correction.
    unit : str
        Unit of the coordinates.
    errors : ndarray (n, 2), optional
        Errors of the coordinates where the truth is known, else NaN.

    Returns
    -------
    svg : str
        An SVG element.
    enlarged : float
        Factor of enlargement of the ellipses.
    """
    with sheet(_SIZE) as figure:
        axes = figure.subplots()
        enlarged = draw_body(axes, true, rods, unit, errors)
        axes.set_ylabel(f"$Y$ / {unit}")
        return to_svg(figure), enlarged


def draw_body(
    axes: Axes,
    true: ImagePoints,
    rods: Array,
    unit: str,
    errors: Array | None = None,
    *,
    named: bool = True,
) -> float:
    """Draw the content of :func:`body_map` into axes; return the factor of enlargement."""
    factor = scipy.special.chdtri(2, 1 - PROBABILITY)
    semi = np.sqrt(np.linalg.eigvalsh(true.cov) * factor)
    both = np.concatenate([true.xy, rods])
    low, high = both.min(axis=0), both.max(axis=0)
    extent = float((high - low).max())
    enlarged = nice(max(_SHOWN / 100 * extent / max(float(np.median(semi[:, 1])), 1e-12), 1e-3))
    margin = 0.06 * extent
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - 2.2 * margin, high[1] + margin)
    plane_axes(axes, Panel(unit, labels=("X", "Y")), "")
    axes.plot(*rods.T, "+", color=FAINT, markersize=4, markeredgewidth=0.6, zorder=0)
    draw_ellipses(axes, true.xy, factor * true.cov, BLUE, enlarged, facecolor=BLUE + "18", linewidth=0.7)
    axes.plot(*true.xy.T, ".", color=INK, markersize=2.2)
    if errors is not None:
        ends = true.xy - enlarged * errors
        lines = np.stack([true.xy, ends, np.full_like(ends, np.nan)], axis=1).reshape(-1, 2)
        axes.plot(*lines.T, color=ACCENT, lw=0.8)
        axes.plot(*ends.T, "o", color=ACCENT, markersize=1.8)
    if named:
        reach = enlarged * np.sqrt(np.diagonal(true.cov, axis1=1, axis2=2) * -2 * np.log(1 - PROBABILITY))
        for name, (x, y), (dx, dy) in zip(true.names, true.xy, reach, strict=True):
            axes.annotate(
                name,
                (x + 0.75 * dx, y + 0.75 * dy),
                xytext=(1, 0.5),
                textcoords="offset points",
                fontsize=7.5,
            )
    _scale_bar(axes, enlarged, nice(float(np.median(semi[:, 1])) * 3), unit)
    return enlarged


def _scale_bar(axes: Axes, enlarged: float, shown: float, unit: str) -> None:
    """Draw a bar at the lower right that is `shown` long in the scale of the ellipses."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    end, y = right - 0.02 * (right - left), low + 0.045 * (high - low)
    tick = 0.008 * (high - low)
    start = end - shown * enlarged
    axes.plot(
        [start, start, start, end, end, end],
        [y - tick, y + tick, y, y, y - tick, y + tick],
        color=INK,
        lw=0.8,
    )
    beside(axes, start, y, length(shown, unit))
