"""Figures of fields over the image: uncertainty of the projection, difference of two calibrations."""

from __future__ import annotations

from matplotlib.axes import Axes

from ..calibration import FieldDifference
from ..calibration.assessment import ErrorMap
from ..calibration.camera import ProjectionField
from ..core.data import Array
from ..core.figures import FAINT, draw_contours, image_axes, sheet, to_svg

_SIZE = (6.2, 4.6)
"""Inches."""


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
    with sheet(_SIZE) as figure:
        axes = figure.subplots()
        _dots(axes, points)
        draw_contours(axes, field.xy, field.sigma)
        _label_axes(axes, field.xy, "σ of the projection in the worst direction [px]")
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
    with sheet(_SIZE) as figure:
        found.plot(figure.subplots())
        return to_svg(figure)


def errors_figure(errors: ErrorMap, points: Array | None = None) -> str:
    """Draw the total errors of a verdict over the image, and the formal standard deviations beside them.

    Parameters
    ----------
    errors : ErrorMap
        The errors.
    points : ndarray (n, 2), optional
        Image points used in the calibration.

    Returns
    -------
    str
        An SVG element.
    """
    with sheet((2 * _SIZE[0], _SIZE[1])) as figure:
        for axes, formal in zip(figure.subplots(1, 2), (False, True), strict=True):
            _dots(axes, points)
            errors.plot(axes, formal=formal)
        return to_svg(figure)


def _dots(axes: Axes, points: Array | None) -> None:
    """Draw image points, of many some."""
    if points is not None:
        axes.plot(*points[:: max(1, len(points) // 4000)].T, ",", color=FAINT, alpha=0.6, zorder=3)


def _label_axes(axes: Axes, xy: Array, title: str) -> None:
    """Title and axes in pixels, within the places (rows, columns, 2) of the field."""
    limits = axes.axis()
    image_axes(axes, xy[..., 0].max(), xy[..., 1].max(), title)
    axes.axis(limits)
