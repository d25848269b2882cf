"""The report of the edges of a photograph, and the photograph with its edges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.layout_engine import ConstrainedLayoutEngine

from ..core.data import Array
from ..core.failure import Failure
from ..core.figures import ACCENT, BLUE, FAINT, INK, image_axes, label_axes, sheet, to_svg
from ..core.overlay import Layer, declined_layers, draw_overlay
from ..procedures.edges import Sharpness
from ..sensor import EdgeSpread, FreeCurve
from ..sensor.chart import ChartEdge
from .template import rendered

_SIZE, _FIELD = (8.6, 3.8), (8.6, 5.2)
"""Inches."""


def half_of(edge: ChartEdge) -> float:
    """MTF50 of an edge: of the free curve if there is one, else of the Gaussian; NaN if not measured."""
    found = edge.found
    if isinstance(found, Failure):
        return float("nan")
    free = found.free.mtf50 if isinstance(found.free, FreeCurve) else None
    return free[0] if free is not None else found.mtf50[0]


def edges_overlay(found: Sharpness, path: Path) -> None:
    """Draw the photograph with the edges that were measured, labelled with MTF50, and the declined ones.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    names = tuple(f"{edge.at.name} {half_of(edge):.3f}" for edge in found.measured)
    xy = np.array([edge.at.centre for edge in found.measured])
    label = f"measured, {len(names)}: name and MTF50 (cycles per pixel)"
    layers = [Layer(label, xy, names, paths=[path for edge in found.measured for path in _outline(edge)])]
    declined = [(edge, edge.found) for edge in found.edges if isinstance(edge.found, Failure)]
    if declined:
        layers += declined_layers(
            [edge.at.name for edge, _ in declined],
            np.array([edge.at.centre for edge, _ in declined]),
            [failure.reason for _, failure in declined],
            [failure.code.value for _, failure in declined],
        )
    title = f"{found.frame.name}: {len(found.measured)} of {len(found.edges)} edges measured"
    draw_overlay(found.frame.pixels, layers, title, found.notes, path)


def _outline(edge: ChartEdge) -> list[Array]:
    """The edge, and the border of the pixels that were used."""
    left, top, width, height = edge.at.region
    if edge.at.good is None:
        x, y = left - 0.5 + np.array([0, width, width, 0, 0]), top - 0.5 + np.array([0, 0, height, height, 0])
        return [np.column_stack([x, y])]
    along = edge.at.xy[1] - edge.at.xy[0]
    upright = abs(along[1]) > abs(along[0])
    aside = np.array([1.0, 0.0]) if upright else np.array([0.0, 1.0])
    size = (width if upright else height) - abs(along[0 if upright else 1])
    (first, last), shift = edge.at.xy, 0.5 * size * aside
    return [np.stack([first - shift, last - shift, last + shift, first + shift, first - shift]), edge.at.xy]


def edges_report(found: Sharpness, *, title: str) -> str:
    """Render the report: the photograph's sharpness over the field, curves, and a table.

    Parameters
    ----------
    found : Sharpness
        The edges.
    title : str
        Heading of the page.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.
    """
    halves = np.array([half_of(edge) for edge in found.measured])
    return rendered(
        "edges.html.j2",
        title=title,
        summary=[
            (f"{found.frame.width} × {found.frame.height}", "px", "size of the photograph"),
            (f"{len(found.measured)} / {len(found.edges)}", "", "edges measured / found"),
            (f"{np.median(halves):.3f}", "px⁻¹", "MTF50, median"),
            (f"{halves.min():.3f}–{halves.max():.3f}", "px⁻¹", "MTF50, least and largest"),
        ],
        curves=Markup(_curves(found)),
        field=Markup(_field(found)) if len(halves) > 3 else None,
        rows=[_row(edge) for edge in found.measured],
        declined=[(e.at.name, e.found.reason) for e in found.edges if isinstance(e.found, Failure)],
        notes=found.notes,
        provenance=found.provenance.to_dict(),
    )


def _row(edge: ChartEdge) -> tuple[str, ...]:
    found = edge.found
    assert isinstance(found, EdgeSpread)
    free = found.free.mtf50 if isinstance(found.free, FreeCurve) else None
    nyquist = found.free.nyquist if isinstance(found.free, FreeCurve) else None
    failed = [str(test["name"]) for test in found.tests() if not test["passed"]]
    return (
        edge.at.name,
        *(f"{value:.0f}" for value in edge.at.centre),
        f"{abs(np.rad2deg(found.angle)):.1f}",
        f"{abs(found.fit['psf']):.3f}",
        "–" if free is None else f"{free[0]:.4f}",
        "–" if free is None else f"{free[1]:.4f}",
        "–" if nyquist is None else f"{nyquist[0]:.4f}",
        "–" if nyquist is None else f"{nyquist[1]:.4f}",
        ", ".join(failed) or "–",
    )


def _curves(found: Sharpness) -> str:
    """All curves, the sharpest, the median and the least sharp one emphasised with their 95 % bands."""
    order = sorted(found.measured, key=half_of)
    chosen = {id(order[-1]): (BLUE, "sharpest"), id(order[0]): (ACCENT, "least sharp")}
    if len(order) > 2:
        chosen[id(order[len(order) // 2])] = (INK, "median")
    if len(order) == 1:
        chosen = {id(order[0]): (BLUE, "")}
    with sheet(_SIZE, layout=ConstrainedLayoutEngine(wspace=0.06)) as figure:
        left, right = figure.subplots(1, 2)
        left.axvline(0.5, color=FAINT, lw=0.6)
        for edge in order:
            spread = edge.found
            assert isinstance(spread, EdgeSpread)
            colour, label = chosen.get(id(edge), (FAINT, ""))
            strong = id(edge) in chosen
            free = spread.free
            limit = free.limit if isinstance(free, FreeCurve) else 1.0
            f = np.linspace(0.0, limit, 129 if strong else 41)
            if isinstance(free, FreeCurve):
                value, sigma = free.mtf(f)
                if strong:
                    band = np.clip([value - 1.96 * sigma, value + 1.96 * sigma], 0.0, None)
                    left.fill_between(f, *band, color=colour, alpha=0.2, lw=0)
            else:
                value = spread.mtf(f)
            text = f"{edge.at.name}{', ' if label else ''}{label}" if strong else None
            left.plot(
                f, value, color=colour, lw=1.2 if strong else 0.4, label=text, zorder=3 if strong else 1
            )
            if strong and isinstance(free, FreeCurve):
                reach = 4 * abs(spread.fit["psf"]) + 2.5
                at = np.linspace(-reach, reach, 301)
                right.plot(at, free.line_spread(at)[0], color=colour, lw=1.2)
        left.set(xlim=(0, 1), ylim=(0, 1.08))
        left.legend(frameon=False, fontsize=8.5, loc="upper right")
        label_axes(left, "modulation transfer", "cycles per pixel, along the normal", "")
        label_axes(right, "line-spread function", "distance from the edge / px", "share of the step per px")
        return to_svg(figure)


def _field(found: Sharpness) -> str:
    """MTF50 of each edge at its place; the line has the direction along which it was measured."""
    halves = np.array([half_of(edge) for edge in found.measured])
    shades = ScalarMappable(Normalize(halves.min(), halves.max()), "viridis")
    length = 0.025 * max(found.frame.width, found.frame.height)
    with sheet(_FIELD) as figure:
        axes = figure.subplots()
        for edge, half in zip(found.measured, halves, strict=True):
            along = edge.at.xy[1] - edge.at.xy[0]
            normal = np.array([-along[1], along[0]]) / np.hypot(*along)
            ends = np.stack([edge.at.centre - length * normal, edge.at.centre + length * normal])
            axes.plot(*ends.T, color=shades.to_rgba(half), lw=2.4, solid_capstyle="round")
            axes.plot(*edge.at.centre, "o", color=shades.to_rgba(half), markersize=4)
        image_axes(axes, found.frame.width, found.frame.height, "MTF50 / cycles per pixel")
        figure.colorbar(shades, ax=axes, shrink=0.8)
        return to_svg(figure)
