"""A frame with what was found and declined in it, as an image: every pixel of the frame, and a legend.

The picture is that of the frame, its grey values stretched, enlarged by a whole number if it is small.
Symbols have a dark and a bright edge, so that they are seen on any background.
Importing it imports matplotlib.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import cv2
import numpy as np
import scipy
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, withStroke
from numpy.typing import NDArray

from .arrays import Array
from .figures import INK, drawing, nice
from .files import write_whole

FOUND, OTHER, MISSING, _SIGMA = "#3ddc84", "#5cc8ff", "#ff6a3d", "#fff07a"
"""Colours of measured places, of places that look alike, of missing ones, and of ellipses."""
_DECLINED = (
    ("x", MISSING),
    ("s", "#ffb300"),
    ("^", "#ff5fd2"),
    ("D", "#b79cff"),
    ("v", "#7fa8ff"),
    ("+", "#ff3b3b"),
)
"""Symbols and colours of declined places, one for each reason; they begin anew after the last."""
_SMALL, _LARGE = 1200, 120_000_000
"""Longer side up to which frames are enlarged, and number of pixels above which they are reduced."""
_TEXT = 13.0
"""Height of the text, in pixels of a picture of 1600 pixels."""
_NAMES = 12
"""Most names in a line of the legend."""
_CUT = 5.0
"""Largest axis of an ellipse that is drawn, in radii of the symbols."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Places of one kind in a frame, with their line in the legend.

    Parameters
    ----------
    label : str
        Text in the legend.
    xy : ndarray (n, 2)
        Places in pixels; those that are NaN are not drawn.
    names : tuple of str (n,)
        Names, drawn where there is room; empty for none.
    cov : ndarray (n, 2, 2), optional
        Covariances in px², drawn as enlarged standard ellipses.
    symbol, colour : str
        Marker of matplotlib, and colour.
    paths : sequence of ndarray (k, 2)
        Lines in pixels.

    Examples
    --------
    >>> Layer("measured", np.array([[3.0, 4.0]]), ("A1",)).symbol
    'o'
    """

    label: str
    xy: Array
    names: tuple[str, ...] = ()
    cov: Array | None = None
    symbol: str = "o"
    colour: str = FOUND
    paths: Sequence[Array] = ()


def declined_layers(names: Sequence[str], xy: Array, why: Sequence[str], code: Sequence[str]) -> list[Layer]:
    """One layer for each code of the declined places, the most frequent first.

    Parameters
    ----------
    names, why, code : sequence of str (n,)
        Names, reasons and codes.
    xy : ndarray (n, 2)
        Where the places were expected or seen.

    Examples
    --------
    >>> at = np.array([[1.0, 2.0], [3.0, 4.0]])
    >>> declined_layers(("A", "B"), at, ("too dark", "too dark"), ("hidden", "hidden"))[0].label
    'hidden, 2: A, B (too dark)'
    """
    kinds, first, count = np.unique(np.asarray(code, dtype=object), return_index=True, return_counts=True)
    layers = []
    for k, i in enumerate(np.lexsort((first, -count))):
        rows = np.flatnonzero(np.asarray(code, dtype=object) == kinds[i]).tolist()
        symbol, colour = _DECLINED[k % len(_DECLINED)]
        named = [names[row] for row in rows[:_NAMES]] + (["…"] if len(rows) > _NAMES else [])
        listed = f": {', '.join(named)}" if any(named) else ""
        reasons = list(dict.fromkeys(why[row] for row in rows))
        reason = reasons[0] + (f"; {reasons[1]}" if len(reasons) == 2 else "; …" if len(reasons) > 2 else "")
        unseen = int((~np.isfinite(xy[rows]).all(axis=1)).sum())
        where = f"; {unseen} without a place in the frame" if unseen else ""
        label = f"{kinds[i]}, {len(rows)}{listed} ({reason}{where})"
        layers.append(Layer(label, xy[rows], tuple(names[row] for row in rows), symbol=symbol, colour=colour))
    return layers


def draw_overlay(
    pixels: NDArray[Any],
    layers: Sequence[Layer],
    title: str,
    notes: Sequence[str] = (),
    path: Path | str | None = None,
) -> NDArray[np.uint8]:
    """Draw layers over a frame, with a legend below it.

    Parameters
    ----------
    pixels : ndarray (h, w) or (h, w, 3)
        Grey or RGB values.
    layers : sequence of Layer
        What to draw, in this order.
    title : str
        First line of the legend.
    notes : sequence of str
        Last lines of the legend.
    path : str or Path, optional
        PNG file to write, completely or not at all.

    Returns
    -------
    ndarray (h', w', 3) of uint8
        RGB. The upper part is the frame, enlarged by a whole number if it is small; the legend is below.

    Raises
    ------
    InputError
        When the file cannot be written.

    Examples
    --------
    >>> frame = np.random.default_rng(0).integers(0, 255, (400, 600), dtype=np.uint8)
    >>> marks = Layer("measured, 2", np.array([[100.0, 80.0], [300.0, 80.0]]), ("A1", "A2"))
    >>> picture = draw_overlay(frame, [marks], "frame.png: 2 of 2 marks measured")
    >>> picture.shape[1], picture.shape[0] > 800
    (1200, True)
    """
    zoom = _zoom(*pixels.shape[:2])
    shown = _stretched(pixels, zoom)
    height, width = shown.shape[:2]
    text = _TEXT * max(1.0, max(height, width) / 1600)
    known = [layer.xy[np.isfinite(layer.xy).all(axis=1)] for layer in layers]
    radius = _radius(np.concatenate([np.empty((0, 2)), *known]), zoom, text)
    factor = _enlargement(layers, radius, zoom)
    if factor is not None:
        layers = [_stated(layer, factor, radius / (zoom * factor)) for layer in layers]
    if zoom < 1:
        notes = (*notes, f"reduced: one of {round(1 / zoom)} × {round(1 / zoom)} pixels is shown")
    columns = max(24, int(width / (0.56 * text)))
    legend = _legend(layers, title, notes, columns)
    foot = round((len(legend) + 0.8) * 1.5 * text)
    out = np.full((height + foot, width, 3), 255, dtype=np.uint8)
    out[:height] = shown
    with drawing():
        figure = Figure(figsize=(width / 72, (height + foot) / 72), dpi=72)
        canvas = FigureCanvasAgg(figure)
        below = foot / (height + foot)
        axes = figure.add_axes((0.0, below, 1.0, 1.0 - below), xlim=(0, width), ylim=(height, 0))
        words = figure.add_axes((0.0, 0.0, 1.0, below), xlim=(0, width), ylim=(foot, 0))
        axes.axis("off")
        words.axis("off")
        pen = max(1.0, text / 10)
        for layer in layers:
            _draw(axes, layer, zoom, radius, pen, factor)
        for at, name, colour in _labels(layers, zoom, radius, text, (width, height)):
            axes.text(at[0], at[1], name, color=colour, fontsize=text * 0.9, ha="center", va="center",
                      family="DejaVu Sans", path_effects=_edge(0.22 * text))  # fmt: skip
        for row, (line, marked) in enumerate(legend):
            y, indent = (row + 0.9) * 1.5 * text, 2.2 * text if row else 0.6 * text
            words.text(indent, y, line, color=INK, fontsize=text, va="center", family="DejaVu Sans",
                      weight="bold" if row == 0 else "normal")  # fmt: skip
            if marked is not None:
                words.plot([1.2 * text], [y], marked.symbol, markersize=0.75 * text, color=marked.colour,
                          **_hollow(marked, pen))  # fmt: skip
        canvas.draw()  # type: ignore[no-untyped-call]
        drawn = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    picture = _composed(out, drawn[: height + foot, :width])
    if path is not None:
        _, coded = cv2.imencode(".png", picture[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 4])
        write_whole(Path(path), coded.tobytes())
    return picture


def _zoom(height: int, width: int) -> float:
    """Enlargement of a frame: a whole number, or for a very large one the inverse of one."""
    if height * width > _LARGE:
        return float(1.0 / np.ceil(np.sqrt(height * width / _LARGE)))
    return float(np.ceil(_SMALL / max(height, width)))


def _stretched(pixels: NDArray[Any], zoom: float) -> NDArray[np.uint8]:
    """RGB values with 8 bits, stretched between the 0.1 and 99.9 percentiles."""
    if zoom < 1:
        step = round(1 / zoom)
        pixels = pixels[::step, ::step]
    sample = pixels.reshape(-1)[:: max(1, pixels.size // 1_000_000)].astype(np.float64)
    low, high = np.percentile(sample, [0.1, 99.9])
    gain = 255 / max(high - low, 1e-9)
    grey = np.empty(pixels.shape, dtype=np.uint8)
    for top in range(0, len(pixels), 1024):
        part = (pixels[top : top + 1024].astype(np.float32) - np.float32(low)) * np.float32(gain)
        grey[top : top + 1024] = np.clip(np.rint(part), 0, 255)
    rgb = grey if grey.ndim == 3 else np.repeat(grey[:, :, None], 3, axis=2)
    whole = max(1, round(zoom))
    return np.ascontiguousarray(np.repeat(np.repeat(rgb, whole, axis=0), whole, axis=1))


def _radius(xy: Array, zoom: float, text: float) -> float:
    """Radius of the symbols, pixels of the picture: at most a third of the distance of neighbours."""
    most = 0.9 * text
    if len(xy) < 2:
        return most
    apart = scipy.spatial.KDTree(xy).query(xy, k=2)[0][:, 1]
    return float(np.clip(0.33 * np.median(apart) * zoom, min(4.0, most), most))


def _enlargement(layers: Sequence[Layer], radius: float, zoom: float) -> float | None:
    """Factor of the ellipses: their median is as large as a symbol."""
    covariances = [layer.cov for layer in layers if layer.cov is not None and len(layer.cov)]
    if not covariances:
        return None
    axis = np.sqrt(np.linalg.eigvalsh(np.concatenate(covariances))[:, 1])
    axis = axis[np.isfinite(axis) & (axis > 0)]
    return None if not len(axis) else nice(0.8 * radius / (zoom * float(np.median(axis))))


def _stated(layer: Layer, factor: float, sigma: float) -> Layer:
    """The layer, whose text in the legend explains its ellipses."""
    if layer.cov is None:
        return layer
    cut = ""
    axis = np.sqrt(np.linalg.eigvalsh(layer.cov)[:, 1]) if len(layer.cov) else np.empty(0)
    if (axis > _CUT * sigma).any():
        cut = f", cut at {_CUT * sigma:.2g} px"
    label = f"{layer.label}; ellipses: standard deviations × {factor:g}{cut}"
    return Layer(label, layer.xy, layer.names, layer.cov, layer.symbol, layer.colour, layer.paths)


def _edge(width: float) -> list[Any]:
    return [withStroke(linewidth=width, foreground="#000000b0"), Normal()]


def _hollow(layer: Layer, pen: float) -> dict[str, Any]:
    return {
        "markerfacecolor": "none",
        "markeredgewidth": 1.3 * pen,
        "linestyle": "none",
        "path_effects": _edge(3.0 * pen),
    }


def _draw(axes: Any, layer: Layer, zoom: float, radius: float, pen: float, factor: float | None) -> None:
    """Draw one layer."""
    for path in layer.paths:
        axes.plot(
            *_placed(path, zoom).T, "-", color=layer.colour, linewidth=1.3 * pen, path_effects=_edge(3 * pen)
        )
    seen = np.isfinite(layer.xy).all(axis=1)
    at = _placed(layer.xy[seen], zoom)
    if not len(at):
        return
    if not layer.paths:
        axes.plot(*at.T, layer.symbol, markersize=2 * radius, color=layer.colour, **_hollow(layer, pen))
    if layer.cov is None or factor is None:
        return
    variance, axis = np.linalg.eigh(layer.cov[seen])
    semi = np.minimum(np.sqrt(np.maximum(variance, 0.0)) * factor * zoom, _CUT * radius)
    angle = np.rad2deg(np.arctan2(axis[:, 1, 1], axis[:, 0, 1]))
    for colour, line in (("#000000b0", 2.4 * pen), (_SIGMA, 1.0 * pen)):
        # The y-axis of the picture points down, as that of the frame.
        ellipses = EllipseCollection(
            2 * semi[:, 1], 2 * semi[:, 0], angle, units="xy", offsets=at, offset_transform=axes.transData
        )
        ellipses.set(facecolor="none", edgecolor=colour, linewidth=line)
        axes.add_collection(ellipses)
    dot = {"markersize": 1.6 * pen, "markeredgewidth": 0, "path_effects": _edge(2 * pen)}
    axes.plot(*at.T, "o", color=_SIGMA, **dot)


def _placed(xy: Array, zoom: float) -> Array:
    """Places in the picture, whose pixel (0, 0) begins at 0."""
    return (xy + 0.5) * zoom


def _labels(
    layers: Sequence[Layer], zoom: float, radius: float, text: float, size: tuple[int, int]
) -> Iterator[tuple[Array, str, str]]:
    """Names where there is room, those of declined places first: beside the symbols, not over others."""
    known = [np.asarray(np.isfinite(layer.xy).all(axis=1)) for layer in layers]
    at = [_placed(layer.xy[seen], zoom) for layer, seen in zip(layers, known, strict=True)]
    centres = np.concatenate([np.empty((0, 2)), *at])
    if len(centres) > 3000:
        return
    taken = np.concatenate([centres, np.full(centres.shape, 0.8 * radius)], axis=1)
    for layer, seen, places in sorted(
        zip(layers, known, at, strict=True), key=lambda each: each[0].colour == FOUND
    ):
        names = [name for name, ok in zip(layer.names, seen, strict=True) if ok] if layer.names else []
        for place, name in zip(places, names, strict=False):
            box = np.array([0.3 * text * len(name), 0.55 * text])
            spot = _free(place, box, radius, taken, size)
            if spot is not None and name:
                taken = np.concatenate([taken, [[*spot, *box]]])
                yield spot, name, layer.colour


def _free(place: Array, box: Array, radius: float, taken: Array, size: tuple[int, int]) -> Array | None:
    """First free centre of a label around its place; None without one."""
    away = radius + box + 1.0
    for way in ((0, -1), (0, 1), (1, 0), (-1, 0), (0.8, -0.8), (-0.8, -0.8), (0.8, 0.8), (-0.8, 0.8)):
        spot = place + away * way
        if (spot < box).any() or (spot + box > size).any():
            continue
        if not (np.abs(taken[:, :2] - spot) < taken[:, 2:] + box).all(axis=1).any():
            return np.asarray(spot)
    return None


def _legend(
    layers: Sequence[Layer], title: str, notes: Sequence[str], columns: int
) -> list[tuple[str, Layer | None]]:
    """Lines of the legend, each with the layer whose symbol stands before it."""
    lines: list[tuple[str, Layer | None]] = [(line, None) for line in wrap(title, columns)[:2]]
    for layer in layers:
        for k, line in enumerate(wrap(layer.label, columns - 4)[:3]):
            lines.append((line, layer if k == 0 else None))
    for note in notes:
        lines += [(line, None) for line in wrap(f"note: {note}", columns - 4)[:3]]
    return lines


def _composed(picture: NDArray[np.uint8], drawn: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with drawn pixels (h, w, 4) over it, stripe by stripe."""
    for top in range(0, len(picture), 1024):
        part = slice(top, top + 1024)
        over = drawn[part].astype(np.float32)
        share = over[:, :, 3:] / 255
        mixed = picture[part] * (1 - share) + over[:, :, :3] * share
        picture[part] = np.rint(mixed).astype(np.uint8)
    return picture
