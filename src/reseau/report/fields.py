"""Figures of fields over the image: uncertainty of the projection, difference of two calibrations."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..calibration import FieldDifference, ProjectionField
from ..core.data import Array
from ..core.figures import ACCENT, FAINT, INK, draw_contours, drawing, image_axes, nice, to_svg

__all__ = ["difference_figure", "uncertainty_figure"]

_SIZE = (6.2, 4.6)
"""Inches."""
_ARROWS = 13
_SURE = 0.01
"""Level at which the difference at a single place is marked as significant."""


def uncertainty_figure(
    field: ProjectionField,
    points: Array | None = None,
    title: str = "σ of the projection in the worst direction [px]",
) -> str:
    """Draw the standard deviation of the projection in its worst direction, as contours.

    Parameters
    ----------
    field : ProjectionField
        The uncertainty.
    points : ndarray (n, 2), optional
        Image points used in the calibration.
    title : str
        What the map shows.

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
        draw_contours(axes, field.xy, field.sigma)
        _label_axes(axes, field.xy, title)
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
        draw_contours(axes, found.xy, found.sigma)
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
        _label_axes(axes, found.xy, f"difference × {enlarged:g} over its σ [px]; longest {longest:.2g} px")
        return to_svg(figure)


def _label_axes(axes: Axes, xy: Array, title: str) -> None:
    """Title and axes in pixels, within the places (rows, columns, 2) of the field."""
    limits = axes.axis()
    image_axes(axes, xy[..., 0].max(), xy[..., 1].max(), title)
    axes.axis(limits)
