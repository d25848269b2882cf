"""Figures of a correction: vectors of residuals, and the field of distortion."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from ..core.data import Array
from ..core.figures import (
    BLUE,
    FAINT,
    INK,
    Panel,
    draw_vectors,
    drawing,
    frame_of,
    length,
    nice,
    plane_axes,
    to_svg,
    typical_pitch,
)
from ..optics.mapping import PlaneMapping

_WIDTH, _PANEL = 8.6, 3.75
"""Of a figure and of the plane of one of its two panels, in inches."""

Triple = tuple[Array, Array, Array]


def _two_panels(at: Array, pitch: float, below: float = 2.2) -> tuple[Figure, list[Axes]]:
    """A figure with two panels side by side, as high as the points require."""
    width, height = np.ptp(at, axis=0) + pitch * np.array([2.0, 1.0 + below])
    inches = 0.95 + float(np.clip(_PANEL * height / width, 2.0, 4.5))
    figure = Figure(figsize=(_WIDTH, inches), layout=ConstrainedLayoutEngine(wspace=0.05))
    return figure, list(figure.subplots(1, 2, sharey=True))


def residual_figure(marks: Triple, check: Triple, panel: Panel, titles: tuple[str, str]) -> str:
    """Draw residual vectors before and after a correction side by side.

    Parameters
    ----------
    marks, check : (ndarray (n, 2), ndarray (n, 2), ndarray (n, 2))
        Design coordinates, residuals before, and residuals after; of fitted and of check marks.
    panel : Panel
        Options.
    titles : (str, str)
        Titles of the two panels.

    Returns
    -------
    str
        An SVG element.
    """
    with drawing():
        at = np.concatenate([marks[0], check[0]])
        figure, panels = _two_panels(at, panel.pitch or typical_pitch(marks[0]))
        for k, (axes, title) in enumerate(zip(panels, titles, strict=True), start=1):
            draw_vectors(axes, (marks[0], marks[k]), (check[0], check[k]), panel, title)
        panels[0].set_ylabel(f"${panel.labels[1]}$ / {panel.unit}")
        return to_svg(figure)


def distortion_figure(model: PlaneMapping, target: Array, panel: Panel) -> str:
    """Draw the distortion that a correction removes beyond a similarity: a bent grid, and its magnitude.

    Parameters
    ----------
    model : PlaneMapping
        The correction, between coordinates of the common system.
    target : ndarray (n, 2)
        Marks in the common system, which define the region.
    panel : Panel
        Options; the pitch is that of the grid.

    Returns
    -------
    str
        An SVG element.
    """
    pitch = panel.pitch or typical_pitch(target)
    with drawing():
        figure, (left, right) = _two_panels(target, pitch, below=1.0)
        fine, distortion = draw_distortion(left, model, target, panel)
        magnitude = np.hypot(distortion[..., 0], distortion[..., 1])
        highest = float(np.nanmax(magnitude, initial=1e-12))
        levels = _levels(highest)
        lines = right.contour(*fine, magnitude, levels=levels, colors=[BLUE], linewidths=0.7)
        right.contourf(*fine, magnitude, levels=[0, *levels, highest * 1.01], cmap="Blues", alpha=0.35)
        right.clabel(lines, fmt=lambda v: length(round(v, 6), panel.unit), fontsize=7.5, colors=[INK])
        frame_of(right, target, pitch, below=1.0)
        plane_axes(right, panel, "magnitude")
        left.set_ylabel(f"${panel.labels[1]}$ / {panel.unit}")
        return to_svg(figure)


def draw_distortion(
    axes: Axes, model: PlaneMapping, target: Array, panel: Panel, title: str = "distortion"
) -> tuple[list[Array], Array]:
    """Draw a square grid as imaged before the correction, enlarged; see :func:`distortion_figure`.

    Returns
    -------
    fine : list of ndarray (121,)
        Coordinates x and y of a raster over the region.
    distortion : ndarray (121, 121, 2)
        The displacement there, NaN where the model has no inverse.
    """
    pitch = panel.pitch or typical_pitch(target)
    low, high = target.min(axis=0), target.max(axis=0)
    steps = np.maximum(np.rint((high - low) / pitch).astype(int), 2)
    fine = [np.linspace(low[k], high[k], 121) for k in range(2)]
    grid = np.stack(np.meshgrid(*fine), axis=-1)
    distortion = _beyond_similarity(model, grid.reshape(-1, 2)).reshape(grid.shape)
    highest = float(np.nanmax(np.hypot(distortion[..., 0], distortion[..., 1]), initial=1e-12))
    enlarged = nice(max(0.9 * pitch / highest, 1e-3))
    bent = grid + enlarged * distortion
    for k, count in enumerate(steps[::-1]):
        for i in np.rint(np.linspace(0, 120, count + 1)).astype(int):
            straight, line = (g[i] if k == 0 else g[:, i] for g in (grid, bent))
            axes.plot(*straight.T, color=FAINT, lw=0.4, alpha=0.6)
            axes.plot(*line.T, color=BLUE, lw=0.8)
    frame_of(axes, target, pitch, below=1.0)
    plane_axes(axes, panel, f"{title}, {enlarged:g} times enlarged")
    return fine, distortion


def _beyond_similarity(model: PlaneMapping, at: Array) -> Array:
    """Displacements (n, 2) of points by the inverse of a model, less the best similarity."""
    z, w = at @ [1, 1j], model.inverse(at) @ [1, 1j]
    # The best similarity by complex regression; what it leaves is the distortion.
    basis, known = np.stack([np.ones_like(z), z], axis=1), np.isfinite(w)
    coefficients, *_ = np.linalg.lstsq(basis[known], w[known], rcond=None)
    rest = (w - basis @ coefficients) / coefficients[1]
    return np.stack([rest.real, rest.imag], axis=-1)


def _levels(highest: float) -> list[float]:
    step = nice(highest / 3)
    return [k * step for k in range(1, 12) if k * step < highest]
