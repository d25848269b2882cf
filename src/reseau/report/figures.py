"""Figures of a correction: vectors of residuals, and the field of distortion."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..data import Array
from ..refine import CameraCorrection
from .style import ACCENT, BLUE, FAINT, INK, drawing, to_svg

__all__ = ["distortion_figure", "draw_vectors", "nice", "residual_figure"]

_SIZE = (8.6, 3.5)

Pair = tuple[Array, Array]
Triple = tuple[Array, Array, Array]


def nice(value: float) -> float:
    """The number 1, 2 or 5 times a power of ten that is next below a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def _length(value: float, unit: str) -> str:
    """A length in the unit, or in micrometres where that reads better."""
    return f"{value * 1000:g} µm" if unit == "mm" and value < 0.1 else f"{value:g} {unit}"


def _plane(axes: Axes, unit: str, title: str) -> None:
    axes.set_aspect("equal")
    axes.set_title(title, loc="left")
    axes.set_xlabel(f"$\\bar x$ / {unit}")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _vectors(axes: Axes, marks: Pair, check: Pair, reach: float, unit: str) -> None:
    """Vectors of which a typical large one is as long as `reach`, with a scale arrow below right."""
    lengths = np.hypot(*marks[1].T)
    typical = max(float(np.quantile(lengths, 0.9)), 1e-12)
    scale = reach / typical
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
    shown = nice(typical)
    (left, right), low = axes.get_xlim(), axes.get_ylim()[0]
    x = right - 0.02 * (right - left) - shown * scale
    y = low + 0.06 * (axes.get_ylim()[1] - low)
    arrow = {"arrowstyle": "-|>", "color": INK, "lw": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
    axes.annotate("", xy=(x + shown * scale, y), xytext=(x, y), arrowprops=arrow)
    axes.annotate(_length(shown, unit), (x - 1.5, y), ha="right", va="center", fontsize=8.5)


def _frame_of(axes: Axes, at: Array, pitch: float) -> None:
    low, high = at.min(axis=0), at.max(axis=0)
    axes.set_xlim(low[0] - pitch, high[0] + pitch)
    axes.set_ylim(low[1] - 2.2 * pitch, high[1] + pitch)


def _pitch(at: Array) -> float:
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def draw_vectors(axes: Axes, marks: Pair, check: Pair, unit: str, title: str) -> None:
    """Draw residual vectors at fitted marks and, in red, at check marks, with a scale arrow.

    Parameters
    ----------
    axes : Axes
        Where.
    marks, check : (ndarray (n, 2), ndarray (n, 2))
        Positions and vectors.
    unit : str
        Of both.
    title : str
        Above.
    """
    pitch = _pitch(marks[0])
    _frame_of(axes, np.concatenate([marks[0], check[0]]), pitch)
    _plane(axes, unit, title)
    _vectors(axes, marks, check, 0.9 * pitch, unit)


def residual_figure(marks: Triple, check: Triple, unit: str) -> str:
    """Vectors that the best similarity leaves, and those that the correction leaves, side by side.

    Parameters
    ----------
    marks, check : (ndarray (n, 2), ndarray (n, 2), ndarray (n, 2))
        Designed coordinates, residuals before, and residuals after; of the fitted marks, and of those held
        out.
    unit : str
        Of all.

    Returns
    -------
    str
        An SVG element.
    """
    with drawing():
        figure = Figure(figsize=_SIZE, layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for k, (axes, title) in enumerate(
            zip(panels, ("before: best similarity", "after: corrected"), strict=True), start=1
        ):
            draw_vectors(axes, (marks[0], marks[k]), (check[0], check[k]), unit, title)
        panels[0].set_ylabel(f"$\\bar y$ / {unit}")
        return to_svg(figure)


def distortion_figure(camera: CameraCorrection, target: Array, unit: str) -> str:
    """What the correction takes off the image beyond a similarity: a bent grid, and its magnitude.

    Parameters
    ----------
    camera : CameraCorrection
        The correction.
    target : ndarray (n, 2)
        Marks in the common system, which mark out the region.
    unit : str
        Of the common system.

    Returns
    -------
    str
        An SVG element.
    """
    low, high = target.min(axis=0), target.max(axis=0)
    steps = np.maximum(np.rint((high - low) / _pitch(target)).astype(int), 2)
    fine = [np.linspace(low[k], high[k], 121) for k in range(2)]
    grid = np.stack(np.meshgrid(*fine), axis=-1)
    flat = grid.reshape(-1, 2)
    photo = camera.model.inverse(flat)
    z, w = flat @ [1, 1j], photo @ [1, 1j]
    # The best similarity from design to photo, by complex regression; what it leaves is the distortion.
    basis = np.stack([np.ones_like(z), z], axis=1)
    coefficients, *_ = np.linalg.lstsq(basis, w, rcond=None)
    rest = (w - basis @ coefficients) / coefficients[1]
    distortion = np.stack([rest.real, rest.imag], axis=-1).reshape(grid.shape)
    magnitude = np.hypot(distortion[..., 0], distortion[..., 1])
    with drawing():
        figure = Figure(figsize=_SIZE, layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        exaggeration = nice(max(0.9 * _pitch(target) / float(magnitude.max()), 1e-3))
        bent = grid + exaggeration * distortion
        for k, count in enumerate(steps[::-1]):
            for i in np.rint(np.linspace(0, 120, count + 1)).astype(int):
                straight, line = (g[i] if k == 0 else g[:, i] for g in (grid, bent))
                left.plot(*straight.T, color=FAINT, lw=0.4, alpha=0.6)
                left.plot(*line.T, color=BLUE, lw=0.8)
        levels = _levels(float(magnitude.max()))
        lines = right.contour(*fine, magnitude, levels=levels, colors=[BLUE], linewidths=0.7)
        right.contourf(
            *fine, magnitude, levels=[0, *levels, magnitude.max() * 1.01], cmap="Blues", alpha=0.35
        )
        right.clabel(lines, fmt=lambda v: _length(round(v, 6), unit), fontsize=7.5, colors=[INK])
        for axes, title in (
            (left, f"distortion, {exaggeration:g} times enlarged"),
            (right, "its magnitude"),
        ):
            _frame_of(axes, target, _pitch(target))
            _plane(axes, unit, title)
        left.set_ylabel(f"$\\bar y$ / {unit}")
        return to_svg(figure)


def _levels(highest: float) -> list[float]:
    step = nice(highest / 3)
    return [k * step for k in range(1, 12) if k * step < highest]
