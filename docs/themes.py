"""Figures for pages of both themes: on white with dark ink, and without a ground with light ink.

The second is made from the first: every colour keeps its hue and gets the opposite lightness. Pixels of
images stay as they are.
"""

from __future__ import annotations

import colorsys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import Collection
from matplotlib.colors import ListedColormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation, Text

from reseau.core.figures import set_style, to_bytes
from reseau.core.files import write_whole

__all__ = ["reset", "save", "scraper", "turn_dark"]

Colour = tuple[float, float, float, float]


def save(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure as PNG for light pages, and beside it, with `-dark` in its name, for dark ones.

    The figure is dark afterwards.
    """
    write_whole(path, to_bytes(figure, "png", dpi=dpi, facecolor="white"))
    turn_dark(figure)
    write_whole(_dark(path), to_bytes(figure, "png", dpi=dpi, transparent=True))


def _dark(path: Path) -> Path:
    return path.with_name(f"{path.stem}-dark{path.suffix}")


def reset(gallery: dict[str, Any], name: str) -> None:
    """Set the common style before and after an example (sphinx-gallery's interface)."""
    import matplotlib.pyplot as plt

    plt.close("all")
    plt.switch_backend("agg")
    set_style()


def scraper(block: Any, variables: dict[str, Any], gallery: dict[str, Any], **options: Any) -> str:
    """Save the figures of a block of an example for both themes (sphinx-gallery's interface)."""
    import matplotlib.pyplot as plt

    text, source = "", Path(gallery["src_dir"])
    for number in plt.get_fignums():
        figure, path = plt.figure(number), Path(next(variables["image_path_iterator"]))
        titles = [axes.get_title("left") for axes in figure.axes]
        alternative = "; ".join(title for title in titles if title) or f"figure {number}"
        save(figure, path, dpi=130)
        for theme, name in (("light", path), ("dark", _dark(path))):
            place = name.relative_to(source).as_posix()
            text += f"\n.. image:: /{place}\n   :alt: {alternative}\n"
            text += f"   :class: sphx-glr-single-img only-{theme}\n"
    plt.close("all")
    return text + "\n"


def turn_dark(figure: Figure) -> None:
    """Give every colour of a figure the opposite lightness."""
    # A contour set colours its labels when its colours change: texts get their colours last.
    texts = [(text, text.get_color()) for text in figure.findobj(Text)]
    for artist in figure.findobj():
        if isinstance(artist, Annotation) and artist.arrow_patch is not None:
            artist.arrow_patch.set_color(_turned(artist.arrow_patch.get_edgecolor()))
        if isinstance(artist, Line2D):
            # Those of markers follow the line's, unless they are set.
            face, edge = artist.get_markerfacecolor(), artist.get_markeredgecolor()
            artist.set_color(_turned(artist.get_color()))
            artist.set_markerfacecolor(_turned(face))
            artist.set_markeredgecolor(_turned(edge))
        elif isinstance(artist, Patch | Collection):
            if isinstance(artist, ScalarMappable) and artist.get_array() is not None:
                _turn_shades(artist)
                continue
            edges, faces = artist.get_edgecolor(), artist.get_facecolor()
            artist.set_edgecolor(_all_turned(edges))
            artist.set_facecolor(_all_turned(faces))
        elif isinstance(artist, Axes):
            artist.tick_params(which="both", color=_turned("#9aa3a8"))
    for text, colour in texts:
        text.set_color(_turned(colour))


def _turn_shades(artist: Any) -> None:
    """Turn a colour map of one colour, or that begins or ends in white; others serve both themes."""
    steps = artist.cmap(np.linspace(0.0, 1.0, 256))
    if steps[[0, -1], :3].min(axis=1).max() > 0.97 or not np.ptp(steps, axis=0).any():
        artist.set_cmap(ListedColormap([_turned(tuple(step)) for step in steps]))


def _all_turned(colours: Any) -> Any:
    """The colour of a patch, or those of a collection."""
    if isinstance(colours, np.ndarray) and colours.ndim == 2:
        return [_turned(tuple(each)) for each in colours]
    return _turned(colours)


def _turned(colour: Any) -> Any:
    """A colour of the opposite lightness; none, and names that stand for another colour, stay."""
    if isinstance(colour, str) and colour in ("none", "auto", "face"):
        return colour
    red, green, blue, alpha = to_rgba(colour)
    hue, lightness, saturation = colorsys.rgb_to_hls(red, green, blue)
    return (*colorsys.hls_to_rgb(hue, 1.0 - lightness, saturation), alpha)
