"""Report of a network of blurred targets: rounds, and residuals before and after (Meid, figure 6)."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from ..core.data import Rows
from ..core.figures import ACCENT, BLUE, FAINT, draw_arrows, nice, sheet, to_svg
from ..core.numbers import plain
from ..core.provenance import Provenance
from ..procedures.blurred_network import BlurredNetwork, BlurredRound
from .template import rendered

_IMAGES = 40


def blurred_network_report(found: BlurredNetwork, *, title: str, provenance: Provenance | None = None) -> str:
    """Render the report.

    Parameters
    ----------
    found : BlurredNetwork
        The network and its rounds.
    title : str
        Heading of the page.
    provenance : Provenance, optional
        Inputs, options, version.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.
    """
    network = found.rounds[0].result.network
    images = [i for i, name in enumerate(network.images) if name in found.rounds[-1].measured]
    return rendered(
        "blurred_network.html.j2",
        title=title,
        summary=_summary(found),
        notes=[remark.text for remark in found.notes],
        rounds=[_row(number, entry) for number, entry in enumerate(found.rounds)],
        chosen=found.chosen,
        warnings=found.result.warnings,
        figures=[{"name": network.images[i], "svg": Markup(_residuals(found, i))} for i in images[:_IMAGES]],
        provenance=(provenance or Provenance()).to_dict(),
    )


def _summary(found: BlurredNetwork) -> list[tuple[str, str, str]]:
    last = found.rounds[found.chosen]
    return [
        (f"{found.result.sigma0:.4g}", "", "σ₀ a posteriori"),
        (plain(found.rounds[0].rms_px(), 3), "px", "residuals of ordinary coordinates, rms"),
        (plain(last.rms_px(), 3), "px", "residuals of the final coordinates, rms"),
        (plain(last.shift_px, 3), "px", "mean shift of the coordinates measured by rays"),
    ]


def _row(number: int, entry: BlurredRound) -> list[str]:
    blur = [found.blur_px[found.ok] for found in entry.measured.values()]
    widest = max((float(values.max()) for values in blur if len(values)), default=0.0)
    misfit = max(
        (found.misfit for found in entry.measured.values() if np.isfinite(found.misfit)), default=0.0
    )
    return [
        "ordinary coordinates" if number == 0 else f"round {number}",
        f"{entry.result.sigma0:.4g}",
        plain(entry.rms_px(), 3),
        f"{int(entry.replaced.sum())}",
        f"{int(entry.kept.sum())}",
        f"{int(entry.declined.sum())}",
        plain(entry.shift_px, 3) if number else "",
        plain(widest, 2) if number else "",
        plain(misfit, 2) if number else "",
    ]


def _residuals(found: BlurredNetwork, i: int) -> str:
    """Residuals of an image before and after, to one scale; kept coordinates are grey."""
    first, last = found.rounds[0], found.rounds[found.chosen]
    camera = first.result.network.cameras[first.result.network.camera_of[i]]
    sizes = []
    for entry in (first, last):
        v = entry.result.residuals[entry.result.network.image_of == i]
        sizes.append(np.hypot(*v[np.isfinite(v).all(axis=1)].T))
    longest = float(np.max(np.concatenate(sizes), initial=0.0))
    enlarged = nice(0.12 * camera.width / longest) if longest > 0 else 1.0
    with sheet((8.6, 8.6 / 2 * camera.height / camera.width + 0.6)) as figure:
        for axes, entry, text in zip(
            figure.subplots(1, 2), (first, last), ("ordinary coordinates", "measured by rays"), strict=True
        ):
            _vectors(axes, entry, i, enlarged)
            axes.set_xlim(0, camera.width)
            axes.set_ylim(camera.height, 0)
            axes.set_aspect("equal")
            rows = entry.result.network.image_of == i
            axes.set_title(f"{text}: {plain(entry.rms_px(rows), 2)} px rms (× {enlarged:g})")
        return to_svg(figure)


def _vectors(axes: Axes, entry: BlurredRound, i: int, enlarged: float) -> None:
    network = entry.result.network
    seen = np.flatnonzero(network.image_of == i)
    seen = seen[np.isfinite(entry.result.residuals[seen]).all(axis=1)]
    # Rows of the first network that are in this one, in its order.
    rows = np.flatnonzero(~entry.declined)
    by_rays = entry.replaced[rows][seen]
    for chosen, colour in ((~by_rays, FAINT if entry.measured else BLUE), (by_rays, ACCENT)):
        part: Rows = seen[chosen].astype(np.intp)
        axes.plot(*network.xy[part].T, ".", color=colour, markersize=2)
        draw_arrows(axes, network.xy[part], enlarged * entry.result.residuals[part], colour)
