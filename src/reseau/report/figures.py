"""Figures of a correction: vectors of residuals, and the field of distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from ..core.data import Array
from ..core.figures import ACCENT, BLUE, FAINT, INK, PALE, drawing, to_svg
from ..optics import PlaneMapping

__all__ = [
    "Panel",
    "distortion_figure",
    "draw_distortion",
    "draw_vectors",
    "length",
    "nice",
    "plane_axes",
    "residual_figure",
]

_WIDTH, _PANEL = 8.6, 3.75
"""Of a figure and of the plane of one of its two panels, in inches."""

Pair = tuple[Array, Array]
Triple = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Panel:
    """How a plane with vectors is drawn.

    Parameters
    ----------
    unit : str
        Of the plane and of the vectors.
    pitch : float, optional
        How long a typical large vector may be, and what is left free around the points; by default the
        distance of neighbouring points.
    typical : float, optional
        A typical large vector; by default the 0.9 quantile of those drawn.
    tolerance : float
        Radius of a disk under each point, in the scale of its vector; 0 for none.
    labels : (str, str)
        Of the axes, as mathematics.
    """

    unit: str
    pitch: float | None = None
    typical: float | None = None
    tolerance: float = 0.0
    labels: tuple[str, str] = ("\\bar x", "\\bar y")


def nice(value: float) -> float:
    """The number 1, 2 or 5 times a power of ten that is next below a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def length(value: float, unit: str) -> str:
    """A length in the unit, or in micrometres where that reads better."""
    return f"{value * 1000:g} µm" if unit == "mm" and value < 0.1 else f"{value:g} {unit}"


def plane_axes(axes: Axes, panel: Panel, title: str) -> None:
    """Equal scales, a title above on the left, no frame; the x-axis with its label."""
    axes.set_aspect("equal")
    axes.locator_params(nbins=6)
    axes.set_title(title, loc="left")
    axes.set_xlabel(f"${panel.labels[0]}$ / {panel.unit}")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _vectors(axes: Axes, marks: Pair, check: Pair, reach: float, panel: Panel) -> None:
    """Vectors of which a typical large one is as long as `reach`, with a scale arrow below right."""
    typical = panel.typical or max(float(np.quantile(np.hypot(*marks[1].T), 0.9)), 1e-12)
    scale = reach / typical
    if panel.tolerance > 0:
        at, across = np.concatenate([marks[0], check[0]]), 2 * panel.tolerance * scale
        disks = EllipseCollection(
            [across], [across], [0.0], units="xy", offsets=at, offset_transform=axes.transData, zorder=0
        )
        disks.set(facecolor=PALE, edgecolor="none")
        axes.add_collection(disks)
    for (at, vectors), colour in ((marks, INK), (check, ACCENT)):
        if not len(at):
            continue
        axes.plot(*at.T, ".", color=FAINT, markersize=1.6, zorder=1)
        axes.quiver(
            *at.T,
            *(vectors * scale).T,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=0.0032,
            headwidth=3.2,
            headlength=4.2,
            headaxislength=3.8,
            color=colour,
            zorder=2,
        )
    _scale_arrow(axes, scale, nice(typical), panel.unit)


def _scale_arrow(axes: Axes, scale: float, shown: float, unit: str) -> None:
    """An arrow below right that is `shown` long in the scale of the vectors."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    x, y = right - 0.02 * (right - left) - shown * scale, low + 0.06 * (high - low)
    arrow = {"arrowstyle": "-|>", "color": INK, "lw": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
    axes.annotate("", xy=(x + shown * scale, y), xytext=(x, y), arrowprops=arrow)
    axes.annotate(
        length(shown, unit),
        (x, y),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=8.5,
    )


def _frame_of(axes: Axes, at: Array, pitch: float, below: float = 2.2) -> None:
    """Limits of a panel; what lies below has room for a scale arrow."""
    low, high = at.min(axis=0), at.max(axis=0)
    axes.set_xlim(low[0] - pitch, high[0] + pitch)
    axes.set_ylim(low[1] - below * pitch, high[1] + pitch)


def _two_panels(at: Array, pitch: float, below: float = 2.2) -> tuple[Figure, list[Axes]]:
    """A figure as high as two panels of these points side by side want it."""
    width, height = np.ptp(at, axis=0) + pitch * np.array([2.0, 1.0 + below])
    inches = 0.95 + float(np.clip(_PANEL * height / width, 2.0, 4.5))
    figure = Figure(figsize=(_WIDTH, inches), layout=ConstrainedLayoutEngine(wspace=0.05))
    return figure, list(figure.subplots(1, 2, sharey=True))


def _pitch(at: Array) -> float:
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def draw_vectors(axes: Axes, marks: Pair, check: Pair, panel: Panel, title: str) -> None:
    """Draw residual vectors at fitted marks and, in red, at check marks, with a scale arrow.

    Parameters
    ----------
    axes : Axes
        Where.
    marks, check : (ndarray (n, 2), ndarray (n, 2))
        Positions and vectors.
    panel : Panel
        How.
    title : str
        Above.
    """
    pitch = panel.pitch or _pitch(marks[0])
    _frame_of(axes, np.concatenate([marks[0], check[0]]), pitch)
    plane_axes(axes, panel, title)
    _vectors(axes, marks, check, 0.9 * pitch, panel)


def residual_figure(marks: Triple, check: Triple, panel: Panel, titles: tuple[str, str]) -> str:
    """Vectors that are left before a correction, and those left after it, side by side.

    Parameters
    ----------
    marks, check : (ndarray (n, 2), ndarray (n, 2), ndarray (n, 2))
        Designed coordinates, residuals before, and residuals after; of the fitted marks, and of those held
        out.
    panel : Panel
        How they are drawn.
    titles : (str, str)
        Of the two panels.

    Returns
    -------
    str
        An SVG element.
    """
    with drawing():
        at = np.concatenate([marks[0], check[0]])
        figure, panels = _two_panels(at, panel.pitch or _pitch(marks[0]))
        for k, (axes, title) in enumerate(zip(panels, titles, strict=True), start=1):
            draw_vectors(axes, (marks[0], marks[k]), (check[0], check[k]), panel, title)
        panels[0].set_ylabel(f"${panel.labels[1]}$ / {panel.unit}")
        return to_svg(figure)


def distortion_figure(model: PlaneMapping, target: Array, panel: Panel) -> str:
    """What a correction takes off the image beyond a similarity: a bent grid, and its magnitude.

    Parameters
    ----------
    model : PlaneMapping
        The correction, between coordinates of the common system.
    target : ndarray (n, 2)
        Marks in the common system, which mark out the region.
    panel : Panel
        How it is drawn; its pitch is that of the grid.

    Returns
    -------
    str
        An SVG element.
    """
    pitch = panel.pitch or _pitch(target)
    with drawing():
        figure, (left, right) = _two_panels(target, pitch, below=1.0)
        fine, distortion = draw_distortion(left, model, target, panel)
        magnitude = np.hypot(distortion[..., 0], distortion[..., 1])
        highest = float(np.nanmax(magnitude, initial=1e-12))
        levels = _levels(highest)
        lines = right.contour(*fine, magnitude, levels=levels, colors=[BLUE], linewidths=0.7)
        right.contourf(*fine, magnitude, levels=[0, *levels, highest * 1.01], cmap="Blues", alpha=0.35)
        right.clabel(lines, fmt=lambda v: length(round(v, 6), panel.unit), fontsize=7.5, colors=[INK])
        _frame_of(right, target, pitch, below=1.0)
        plane_axes(right, panel, "its magnitude")
        left.set_ylabel(f"${panel.labels[1]}$ / {panel.unit}")
        return to_svg(figure)


def draw_distortion(
    axes: Axes, model: PlaneMapping, target: Array, panel: Panel, title: str = "distortion"
) -> tuple[list[Array], Array]:
    """Draw a square grid as it is seen before a correction, enlarged; see :func:`distortion_figure`.

    Returns
    -------
    fine : list of ndarray (121,)
        Coordinates x and y of a raster over the region.
    distortion : ndarray (121, 121, 2)
        The displacement there, NaN where the model has no inverse.
    """
    pitch = panel.pitch or _pitch(target)
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
    _frame_of(axes, target, pitch, below=1.0)
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
