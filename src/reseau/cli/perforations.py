"""`reseau measure perforations`: the scale of a scan from the perforations of its film."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.options import Option
from .common import overlay_files, required, say

Box = tuple[float, float, float, float]


def perforations(
    scan: Annotated[Path, typer.Argument(help="Scan of 35 mm film that runs from top to bottom.")],
    left: Annotated[
        Box,
        Option(
            "Approximate edges of the first perforation of the left row (px).",
            value="LEFT,TOP,RIGHT,BOTTOM",
        ),
    ],
    right: Annotated[
        Box,
        Option(
            "Approximate edges of the first perforation of the right row (px).",
            value="LEFT,TOP,RIGHT,BOTTOM",
        ),
    ],
    perforation_px: Annotated[
        float, typer.Option(min=1.0, help="Approximate pitch of the perforations (px).")
    ],
    number: Annotated[v.Number, "Here of perforations in a row, at least 2."],
    channel: Annotated[v.Channel | None, "Here that with the darkest rims. Default: the last."] = None,
    reach: Annotated[float, typer.Option(min=1.0, help="Search distance from the given edges (px).")] = 12.0,
    overlay: v.Overlay | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Measure the perforations of 35 mm film: scale, rotation and perspective of the scan.

    The scale follows from the pitch of 4.75 mm and the distance of the rows of 28.17 mm (ISO 2906).
    """
    import numpy as np

    from ..core.errors import UsageError
    from ..core.numbers import measured
    from ..core.provenance import canonical_json
    from ..io.images import open_scan
    from ..measure.film import film_plane
    from ..procedures.film_frame import film_scale

    if number < 2:
        raise UsageError(f"is {number}, not at least 2", where="--number")
    drawn = None if overlay is None else overlay_files(overlay, [scan])[scan]
    opened = open_scan(scan)
    name = channel or opened.channels[-1]
    if name not in opened.channels:
        do = f"use {', '.join(opened.channels)}"
        raise UsageError(f"the scan has no channel {name!r}", where="--channel", do=do)
    rows = [np.array([*box, perforation_px]) for box in (left, right)]
    plane = required(film_plane(opened, rows, number, channel=opened.channels.index(name), reach=reach), scan)
    if drawn is not None:
        pixels = opened.window(0, opened.height, 0, opened.width)
        plane.overlay(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels, drawn)
    found = film_scale(plane)
    if as_json:
        document: dict[str, Any] = {
            "schema": "reseau-film-plane/1",
            "edges": plane.edges,
            "rms_px": plane.rms_px,
            "quantities": {name: each.model_dump() for name, each in found.items()},
            "values": plane.values.tolist(),
            "covariance": plane.covariance.tolist(),
            "centre_px": plane.centre.tolist(),
            "unit_px": plane.unit,
        }
        say(canonical_json(document))
        return
    say(f"{scan.name}: {plane.edges} edges of perforations, rms {plane.rms_px:.2g} px\n")
    for name, each in found.items():
        say(f"  {name:<14} {measured(each.value, each.sigma, each.unit)}\n")
