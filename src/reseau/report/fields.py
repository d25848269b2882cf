"""Figures of fields over the image: uncertainty of the projection, difference of two calibrations."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from ..calibration import FieldDifference, ProjectionField
from ..core.data import Array
from ..core.figures import ACCENT, BLUE, FAINT, INK, drawing, nice, to_svg

__all__ = ["difference_figure", "uncertainty_figure"]

_SHADES = LinearSegmentedColormap.from_list("reseau", ["#ffffff", "#c9d8e3", BLUE])
_LEVELS, _SPAN = 8, 25.0
_SIZE = (8.6, 5.2)
"""Inches."""
_ARROWS = 13
_SURE = 0.01
"""Level at which the difference at a single place is marked as significant."""


def uncertainty_figure(field: ProjectionField, points: Array | None = None) -> str:
    """Draw the standard deviation of the projection in its worst direction, as contours.

    Parameters
    ----------
    field : ProjectionField
        The uncertainty.
    points : ndarray (n, 2), optional
        Image points used in the calibration.

    Returns
    -------
    str
        An SVG element.
    """
    with drawing():
        figure = Figure(figsize=_SIZE, layout="constrained")
        axes = figure.subplots()
        if points is not None:
            axes.plot(*points[:: max(1, len(points) // 4000)].T, ",", color=FAINT, alpha=0.6, zorder=3)
        _contours(axes, field.xy, field.sigma)
        axes.set_title("σ of the projection in the worst direction [px]")
        return to_svg(figure)


def difference_figure(found: FieldDifference) -> str:
    """Draw the difference of two calibrations as arrows over its standard deviation.

    Significant arrows are in the accent colour.

    Parameters
    ----------
    found : FieldDifference
        The difference.

    Returns
    -------
    str
        An SVG element.
    """
    with drawing():
        figure = Figure(figsize=_SIZE, layout="constrained")
        axes = figure.subplots()
        _contours(axes, found.xy, found.sigma)
        step = max(1, found.xy.shape[1] // _ARROWS)
        xy, d = (
            values[step // 2 :: step, step // 2 :: step].reshape(-1, 2)
            for values in (found.xy, found.difference)
        )
        p = found.p_at[step // 2 :: step, step // 2 :: step].ravel()
        size = np.hypot(*d.T)
        longest, typical = (float(np.nanquantile(size, part)) for part in (1.0, 0.8))
        pitch = float(found.xy[0, step, 0] - found.xy[0, 0, 0])
        enlarged = nice(pitch / typical) if typical > 0 else 1.0
        for sure, colour in ((False, INK), (True, ACCENT)):
            chosen = np.isfinite(size) & ((p < _SURE) == sure)
            axes.quiver(
                *xy[chosen].T, *(enlarged * d[chosen]).T, color=colour, angles="xy", scale_units="xy",
                scale=1, width=0.003, zorder=4,
            )  # fmt: skip
        axes.set_title(f"difference × {enlarged:g} over its σ [px]; longest {longest:.2g} px")
        return to_svg(figure)


def _contours(axes: Axes, xy: Array, sigma: Array) -> None:
    """Draw contours over the image, y down."""
    x, y = xy[0, :, 0], xy[:, 0, 1]
    levels, digits = _levels(sigma)
    shown = np.ma.masked_invalid(sigma)
    axes.contourf(x, y, shown, levels=levels, cmap=_SHADES, extend="both")
    lines = axes.contour(x, y, shown, levels=levels, colors=INK, linewidths=0.5)
    axes.clabel(lines, fontsize=7.5, fmt=f"%.{digits}g")
    axes.set_aspect("equal")
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[-1], y[0])


def _levels(sigma: Array) -> tuple[list[float], int]:
    """Rounded levels in geometric steps over the range of the values, and their significant digits."""
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    if not len(known):
        return [0.0, 1.0], 1
    high = float(np.quantile(known, 0.995))
    low = max(float(known.min()), high / _SPAN)
    steps = np.geomspace(1.1 * low, max(high, 1.2 * low), _LEVELS)
    for digits in (2, 3, 4):
        rounded = sorted({float(f"{step:.{digits}g}") for step in steps})
        if len(rounded) == _LEVELS:
            break
    return rounded, digits
