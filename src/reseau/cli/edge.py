"""`reseau measure edge`: sharpness from a slanted edge, or from all edges of a chart."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.files import writable
from .common import Reading, overlay_files, progress, required, say
from .measure import Output

if TYPE_CHECKING:
    from ..io.edges import EdgesDocument


_SHOWN = 40
"""Most edges of which a line is printed."""


def edge(
    image: Annotated[Path, typer.Argument(help="Photograph of an edge, or of a chart of slanted edges.")],
    reading: Reading,
    output: Output,
    region: Annotated[list[v.Region] | None, "Repeatable. Default: edges are found."] = None,
    report: v.Report | None = None,
) -> None:
    """Measure the sharpness (MTF, SFR) of a photograph from slanted edges, over the field for a chart."""
    from ..io import write_whole
    from ..procedures.edges import measure_sharpness
    from ..report.edges import edges_overlay, edges_report

    regions = region or []
    out, overlay = output.out, output.overlay
    suffix = ".json" if out is None else writable(out, ".json", ".csv").suffix.lower()
    writable(report)
    picture = overlay_files(overlay, [image])[image] if overlay is not None else None
    frame = reading.frame(image)
    options = {"regions": regions or None, "channel": reading.channel}
    with progress(f"measuring {image.name}", max(1, len(regions))) as step:
        result = measure_sharpness(frame, regions, options=options, step=step)
    found = required(result, image)
    document = found.document()
    if picture is not None:
        edges_overlay(found, picture)
    if report is not None:
        write_whole(report, edges_report(found, title=f"Sharpness of {image.name}"))
    if out is not None:
        write_whole(out, _csv(document) if suffix == ".csv" else document.to_json())
    say(document.to_json() if output.as_json else _lines(document))


def _lines(document: EdgesDocument) -> str:
    """What was measured as text."""
    from ..core.numbers import measured

    text = [f"{document.image}: {document.found} of {document.expected} edges measured"]
    for each in document.edges[:_SHOWN]:
        place = f"  {each.id:<5} {each.x:7.0f} {each.y:6.0f}  "
        if not each.ok:
            text.append(f"{place}{each.why}")
            continue
        values = [f"psf {measured(each.psf or 0.0, each.s_psf or 0.0, 'px')}"]
        if each.mtf50_free is not None and each.s_mtf50_free is not None:
            values.append(f"MTF50 {measured(each.mtf50_free, each.s_mtf50_free, '1/px')}")
        elif each.mtf50 is not None and each.s_mtf50 is not None:
            values.append(f"MTF50 {measured(each.mtf50, each.s_mtf50, '1/px')} (Gaussian)")
        if any(test["name"] == "flat beside the edge" and not test["passed"] for test in each.tests):
            values.append("not flat beside the edge: blur beyond the region, or uneven light")
        text.append(place + ", ".join(values))
    if len(document.edges) > _SHOWN:
        text.append(f"  … and {len(document.edges) - _SHOWN} more, in the file")
    text += [f"note: {note}" for note in document.notes]
    return "\n".join(text) + "\n"


def _csv(document: EdgesDocument) -> str:
    """The edges as CSV, without curves."""
    columns = (
        "id", "x", "y", "angle_deg", "normal_deg", "radial_deg", "psf", "s_psf", "mtf50", "s_mtf50",
        "mtf50_free", "s_mtf50_free", "mtf_nyquist_free", "s_mtf_nyquist_free",
    )  # fmt: skip
    rows = [",".join(columns)]
    for each in document.edges:
        if each.ok:
            cells = [getattr(each, name) for name in columns]
            rows.append(",".join("" if c is None else c if isinstance(c, str) else f"{c:.6g}" for c in cells))
    return "\n".join(rows) + "\n"
