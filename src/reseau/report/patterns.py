"""Common residuals of several images, as text and figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from ..bundle import CommonPattern, Result, by_place, by_point, common_pattern
from ..core.errors import UsageError
from ..core.figures import ACCENT, FAINT, INK, drawing, nice, to_svg

_PANELS, _ACROSS = 8, 4
"""Number of groups of images drawn, and number of panels side by side."""
_SURE = 0.01
"""Level at which the shift of a single class is marked as significant."""


def patterns_of(result: Result) -> list[dict[str, Any]]:
    """Return the common residuals of a network: by place in each camera's image, and by groups of images.

    Without a test, `why_not` gives the reason.
    """
    network = result.network
    patterns = [
        (f"at the same place in all images of {camera.label}", by_place(result, c), False)
        for c, camera in enumerate(network.cameras)
    ]
    if any(group is not None for group in network.groups):
        patterns.append(
            ("of the same point in the images of a group", by_point(result, network.groups), True)
        )
    found = list[dict[str, Any]]()
    for title, key, grouped in patterns:
        try:
            pattern = common_pattern(result, key)
        except UsageError as error:
            found.append({"title": title, "why_not": error.what})
            continue
        found.append(
            {
                "title": title,
                "classes": len(pattern.count),
                "statistic": f"{pattern.statistic:.2f}",
                "degrees": " and ".join(str(degree) for degree in pattern.degrees),
                "p": f"{pattern.p:.2g}",
                "rms": f"{pattern.rms:.2g}",
                "sigma0": f"{pattern.sigma0:.4g}",
                "figure": Markup(_figure(result, pattern, grouped)),
            }
        )
    return found


def _figure(result: Result, pattern: CommonPattern, grouped: bool) -> str:
    """Draw shifts as arrows at their mean places, one panel for each group; significant ones in colour."""
    network = result.network
    labels = np.full(len(pattern.count), "", dtype=object)
    if grouped:
        seen = pattern.key >= 0
        labels[pattern.key[seen]] = np.array(network.groups, dtype=object)[network.image_of[seen]]
    names = list(dict.fromkeys(labels))[:_PANELS]
    across = min(len(names), _ACROSS)
    down = -(-len(names) // across)
    camera = network.cameras[0]
    shape = camera.height / camera.width
    size = np.hypot(*pattern.shift.T)
    typical = float(np.quantile(size, 0.9)) or 1.0
    enlarged = nice((0.1 if grouped else 0.04) * camera.width / typical)
    sure = pattern.p_at < _SURE
    width = 8.6 if across > 1 else 6.0
    with drawing():
        figure = Figure(figsize=(width, 0.5 + width * down * shape / across), layout="constrained")
        grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        for axes in grid.flat[len(names) :]:
            axes.remove()
        for axes, name in zip(grid.flat, names, strict=False):
            for chosen, colour in (((labels == name) & ~sure, INK), ((labels == name) & sure, ACCENT)):
                axes.quiver(
                    *pattern.xy[chosen].T, *(enlarged * pattern.shift[chosen]).T, color=colour, angles="xy",
                    scale_units="xy", scale=1, width=0.004,
                )  # fmt: skip
            axes.set_xlim(0, camera.width)
            axes.set_ylim(camera.height, 0)
            axes.set_aspect("equal")
            axes.label_outer()
            axes.set_title(str(name), color=FAINT if not grouped else INK)
        figure.supxlabel("x / px")
        figure.supylabel("y / px")
        figure.suptitle(f"shifts × {enlarged:g}; longest {size.max():.2g} px", fontsize=10.5)
        return to_svg(figure)
