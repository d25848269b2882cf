"""The common style of all figures, drawn to the same bytes every time. Importing it imports matplotlib."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from .arrays import Array

Pair = tuple[Array, Array]

INK, FAINT, PALE, ACCENT, BLUE = "#22272b", "#9aa3a8", "#e9edef", "#b3402a", "#2f5d7c"

_STYLE = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 9.5,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.6,
    "axes.titlesize": 10.5,
    "axes.titlepad": 8,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.direction": "out",
    "svg.hashsalt": "reseau",
    "svg.fonttype": "path",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
}


_SHADES = LinearSegmentedColormap.from_list("reseau", ["#ffffff", "#c9d8e3", BLUE])
_SPAN, _FEWEST, _MOST = 25.0, 3, 6
"""Largest ratio of the levels of contours; fewest of them, and most of a narrow range."""


def set_style() -> None:
    """Set the common style for all figures that follow, whatever the user's own settings are."""
    mpl.rcdefaults()
    mpl.rcParams.update(_STYLE)  # type: ignore[arg-type]


@contextmanager
def drawing() -> Iterator[None]:
    """Draw figures in the common style; the user's own settings return afterwards."""
    with mpl.rc_context():
        set_style()
        yield


@contextmanager
def sheet(size: tuple[float, float], layout: Any = "constrained", **more: Any) -> Iterator[Figure]:
    """Draw on a new figure in the common style, laid out by its content; the size is in inches."""
    with drawing():
        yield Figure(figsize=size, layout=layout, **more)


def to_bytes(figure: Figure, kind: str, **options: Any) -> bytes:
    """Return the file of a figure, without dates: the same figure, the same bytes.

    Parameters
    ----------
    figure : Figure
    kind : {"png", "pdf", "svg"}
    options
        Of :meth:`matplotlib.figure.Figure.savefig`; `metadata` in addition to those that make it repeatable.
    """
    dated = {"png": ("Software",), "pdf": ("CreationDate", "Creator"), "svg": ("Date", "Creator")}[kind]
    metadata = dict.fromkeys(dated) | options.pop("metadata", {})
    stream = io.BytesIO()
    with drawing():
        figure.savefig(stream, format=kind, metadata=metadata, **options)
    return stream.getvalue()


def to_svg(figure: Figure) -> str:
    """Return the figure as an SVG element, without date and declaration."""
    text = to_bytes(figure, "svg").decode()
    return text[text.index("<svg") :]


@dataclass(frozen=True)
class Panel:
    """Options for drawing a plane with vectors.

    Parameters
    ----------
    unit : str
        Of the plane and of the vectors.
    pitch : float, optional
        Length of a typical large vector, and margin around the points; by default the distance of
        neighbouring points.
    typical : float, optional
        A typical large vector; by default the 0.9 quantile of those drawn.
    tolerance : float
        Radius of a disk drawn under each point, in the scale of its vector; 0 for none.
    labels : (str, str)
        Of the axes, as mathematics.
    """

    unit: str
    pitch: float | None = None
    typical: float | None = None
    tolerance: float = 0.0
    labels: tuple[str, str] = ("\\bar x", "\\bar y")


def nice(value: float) -> float:
    """Return the largest number 1, 2 or 5 times a power of ten that does not exceed a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def length(value: float, unit: str) -> str:
    """Return a length with its unit, in micrometres where that is easier to read."""
    return f"{value * 1000:g} µm" if unit == "mm" and value < 0.1 else f"{value:g} {unit}"


def draw_ellipses(
    axes: Axes, at: Array, cov: Array, colour: str = ACCENT, enlarged: float | None = None, **style: Any
) -> float:
    """Draw standard ellipses of points, enlarged.

    Parameters
    ----------
    axes : Axes
        Axes to draw into; their limits must be set before.
    at : ndarray (n, 2)
        Points.
    cov : ndarray (n, 2, 2)
        Covariance matrices, in the squared unit of the points.
    colour : str
        Of the lines.
    enlarged : float, optional
        Factor of enlargement; by default a round one that makes them 4 % of the axes' width in the median.
    **style
        Of the collection, in place of its own.

    Returns
    -------
    float
        The factor of enlargement.
    """
    if not len(at):
        return 1.0
    variance, axis = np.linalg.eigh(cov)
    semi = np.sqrt(np.maximum(variance, 0.0))
    if enlarged is None:
        width = abs(float(np.diff(axes.get_xlim())[0]))
        enlarged = nice(max(0.04 * width / max(float(np.median(semi[:, 1])), 1e-12), 1e-3))
    angle = np.rad2deg(np.arctan2(axis[:, 1, 1], axis[:, 0, 1]))
    ellipses = EllipseCollection(
        2 * enlarged * semi[:, 1],
        2 * enlarged * semi[:, 0],
        angle,
        units="xy",
        offsets=at,
        offset_transform=axes.transData,
    )
    ellipses.set(**{"facecolor": "none", "edgecolor": colour, "linewidth": 0.6, **style})
    axes.add_collection(ellipses)
    return enlarged


def draw_arrows(
    axes: Axes, at: Array, vectors: Array, colour: str, width: float = 0.004, **style: Any
) -> None:
    """Draw vectors (n, 2) as arrows from points (n, 2), in the scale of the axes."""
    form = {"color": colour, "width": width, **style}
    axes.quiver(*at.T, *vectors.T, angles="xy", scale_units="xy", scale=1, **form)


def plane_axes(axes: Axes, panel: Panel, title: str) -> None:
    """Set equal scales, the title and the label of the x-axis, and hide the upper and right spines."""
    axes.set_aspect("equal")
    axes.locator_params(nbins=6)
    axes.set_title(title, loc="left")
    axes.set_xlabel(f"${panel.labels[0]}$ / {panel.unit}")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def frame_of(axes: Axes, at: Array, pitch: float, below: float = 2.2) -> None:
    """Set the limits of a panel, with room for a scale arrow at the bottom."""
    low, high = at.min(axis=0), at.max(axis=0)
    axes.set_xlim(low[0] - pitch, high[0] + pitch)
    axes.set_ylim(low[1] - below * pitch, high[1] + pitch)


def typical_pitch(at: Array) -> float:
    """Return the median distance between neighbouring points."""
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(distance, np.inf)
    return float(np.median(distance.min(axis=1)))


def draw_vectors(axes: Axes, marks: Pair, check: Pair, panel: Panel, title: str) -> None:
    """Draw residual vectors at fitted marks and, in red, at check marks, with a scale arrow.

    Parameters
    ----------
    axes : Axes
        Axes to draw into.
    marks, check : (ndarray (n, 2), ndarray (n, 2))
        Positions and vectors.
    panel : Panel
        Options.
    title : str
        Title of the axes.
    """
    pitch = panel.pitch or typical_pitch(marks[0])
    frame_of(axes, np.concatenate([marks[0], check[0]]), pitch)
    plane_axes(axes, panel, title)
    _vectors(axes, marks, check, 0.9 * pitch, panel)


def _vectors(axes: Axes, marks: Pair, check: Pair, reach: float, panel: Panel) -> None:
    """Draw vectors, a typical large one as long as `reach`, with a scale arrow at the lower right."""
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
        head = {"headwidth": 3.2, "headlength": 4.2, "headaxislength": 3.8}
        draw_arrows(axes, at, vectors * scale, colour, 0.0032, zorder=2, **head)
    _scale_arrow(axes, scale, nice(typical), panel.unit)


def _scale_arrow(axes: Axes, scale: float, shown: float, unit: str) -> None:
    """Draw an arrow at the lower right that is `shown` long in the scale of the vectors."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    x, y = right - 0.02 * (right - left) - shown * scale, low + 0.06 * (high - low)
    arrow = {"arrowstyle": "-|>", "color": INK, "lw": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}
    axes.annotate("", xy=(x + shown * scale, y), xytext=(x, y), arrowprops=arrow)
    beside(axes, x, y, length(shown, unit))


def beside(axes: Axes, x: float, y: float, text: str) -> None:
    """Write a text left of a bar or an arrow."""
    how: Any = {"xytext": (-4, 0), "textcoords": "offset points", "ha": "right", "va": "center"}
    axes.annotate(text, (x, y), fontsize=8.5, **how)


def new_axes(axes: Axes | None, size: tuple[float, float] = (6.4, 4.8)) -> Axes:
    """Return the axes of a caller, or those of a new figure of pyplot.

    Parameters
    ----------
    axes : Axes or None
        Axes to draw into.
    size : (float, float)
        Width and height of a new figure in inches.
    """
    if axes is not None:
        return axes
    import matplotlib.pyplot as plt

    _, made = plt.subplots(figsize=size, layout="constrained")
    return made


def image_axes(axes: Axes, width: float, height: float, title: str = "") -> None:
    """Set the limits of an image in pixels, y down, with equal scales.

    Parameters
    ----------
    axes : Axes
        Axes to set up.
    width, height : float
        Size of the image in pixels.
    title : str
        Title of the axes.
    """
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x / px")
    axes.set_ylabel("y / px")
    axes.set_title(title, loc="left")


def label_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Set title and labels, and hide the upper and right spines."""
    axes.set_title(title, loc="left")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def over_picture(axes: Axes | None, pixels: NDArray[Any] | None = None, *, y_down: bool = True) -> Axes:
    """Return axes for points of an image, with equal scales and y down; the image is drawn if it is given.

    Parameters
    ----------
    axes : Axes or None
        Axes of a caller, also ones that are drawn into already; by default those of a new figure.
    pixels : ndarray (h, w), optional
        Grey values. Without them, the limits follow from what is drawn.
    y_down : bool
        False for points that are not in an image.
    """
    axes = new_axes(axes)
    if pixels is not None:
        draw_picture(axes, pixels)
        image_axes(axes, pixels.shape[1], pixels.shape[0])
    else:
        axes.set_aspect("equal")
        if y_down and not axes.yaxis_inverted():
            axes.invert_yaxis()
    return axes


def draw_picture(axes: Axes, pixels: NDArray[Any]) -> None:
    """Draw grey values between their 0.1 and 99.9 percentiles.

    Parameters
    ----------
    axes : Axes
        Axes to draw into.
    pixels : ndarray (h, w)
        Grey values.
    """
    sample = pixels.reshape(-1)[:: max(1, pixels.size // 1_000_000)]
    low, high = np.percentile(sample, [0.1, 99.9])
    h, w = pixels.shape
    axes.imshow(
        pixels, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), extent=(-0.5, w - 0.5, h - 0.5, -0.5)
    )


def draw_contours(
    axes: Axes | None, xy: Array, sigma: Array, title: str = "", scale: Array | None = None
) -> Axes:
    """Draw contours of positive values over an image, y down, at levels 1, 2, 5 …, and a colour bar.

    Parameters
    ----------
    axes : Axes or None
        Axes to draw into; without any those of a new figure.
    xy : ndarray (rows, columns, 2)
        Places, pixels, from edge to edge of the image.
    sigma : ndarray (rows, columns)
        Values; NaN where there is none.
    title : str
        Title of the axes.
    scale : ndarray, optional
        Values whose levels are taken, those of another map beside it.
    """
    axes, x, y = new_axes(axes), xy[0, :, 0], xy[:, 0, 1]
    levels = contour_levels(sigma if scale is None else scale)
    shown = np.ma.masked_invalid(sigma)
    # Each step of the levels is one of the colours, however far apart they are.
    norm = BoundaryNorm(levels, _SHADES.N, extend="both")
    filled = axes.contourf(x, y, shown, levels=levels, cmap=_SHADES, norm=norm, extend="both")
    lines = axes.contour(x, y, shown, levels=levels, colors=INK, linewidths=0.5)
    axes.clabel(lines, fontsize=7.5, fmt="%g")
    image_axes(axes, x[-1] + 1, y[-1] + 1, title)
    if axes.figure is not None:
        bar = axes.figure.colorbar(filled, ax=axes, shrink=0.8, ticks=levels, format="%g")
        bar.outline.set_linewidth(0.6)
    return axes


def contour_levels(values: Array) -> list[float]:
    """Levels 1, 2, 5 × powers of ten over the range of values; of a narrow range, multiples of such a step.

    Examples
    --------
    >>> contour_levels(np.array([0.013, 0.3])), contour_levels(np.array([0.112, 0.139]))
    ([0.02, 0.05, 0.1, 0.2], [0.115, 0.12, 0.125, 0.13, 0.135])
    """
    known = values[np.isfinite(values) & (values > 0)]
    if not len(known):
        return [0.5, 1.0]
    high = float(np.quantile(known, 0.995))
    low = max(float(known.min()), high / _SPAN)
    round_ones = [m * 10.0**k for k in range(-12, 12) for m in (1, 2, 5)]
    levels = [level for level in round_ones if low < level < high]
    if len(levels) < _FEWEST:
        step = next(s for s in round_ones if s >= (high - low) / _MOST)
        levels = [k * step for k in range(int(low / step) + 1, int(high / step) + 1)]
    levels = [float(f"{level:.6g}") for level in levels]
    return levels if len(levels) > 1 else [0.9 * low, 1.1 * high]
