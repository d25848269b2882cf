"""`reseau sensor`, `reseau measure edge`: calibrate a sensor from files of dark and lit exposures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import EstimationError, UsageError
from ..core.files import writable
from ..core.options import Option
from .common import Reading, probability, progress, required, say, say_notes
from .measure import Output

if TYPE_CHECKING:
    from ..calibration.document import Calibration
    from ..io.edges import EdgesDocument
    from ..procedures.sensor_files import FileExposure


def sensor(
    series: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with the folders `dark`, `light` and optionally `edge`, or a list: a descriptor of "
            "EMVA 1288, or CSV with the columns file, kind (dark, light, edge), exposure_us, [light]."
        ),
    ] = None,
    light: Annotated[list[Path] | None, Option("Folder or file of evenly lit exposures; repeatable.")] = None,
    dark: Annotated[list[Path] | None, Option("Folder or file of dark exposures; repeatable.")] = None,
    edge: Annotated[
        list[Path] | None, Option("Folder or file of a slanted edge, for the MTF; repeatable.")
    ] = None,
    region: v.Region | None = None,
    out: v.Out | None = None,
    report: v.Report | None = None,
    name: Annotated[v.Name | None, "Default: that of the folder or list."] = None,
    channel: v.Channel = "luma",
    as_json: v.AsJson = False,
) -> None:
    """Calibrate a sensor from files: dark signal, response, linearity, noise, gain, full well, defects, MTF.

    Exposure times come from the list, from names of folders or files (`light/5ms/01.tif`), or from what
    cameras write into files. Multi-page TIFF, DICOM loops and videos count as many frames.
    """
    from ..io import write_whole
    from ..procedures.sensor import SensorProcedure
    from ..procedures.sensor_files import add_files
    from ..report.sensor import sensor_report

    writable(out)
    writable(report)
    given = _exposures(series, {"light": light, "dark": dark, "edge": edge})
    called = name or (series.stem if series is not None else "sensor")
    root = None if series is None else series if series.is_dir() else series.parent
    options: dict[str, Any] = {"region": region, "channel": channel}
    procedure = SensorProcedure(name=called, region=region, options=options)
    with progress("reading", len(given)) as step:
        notes = add_files(procedure, given, channel=channel, root=root, step=step)
    say_notes(notes)
    found = procedure.calibration(called)
    if out is not None:
        write_whole(out, found.to_json())
    if report is not None:
        page = sensor_report(procedure.result(), title=f"Sensor of {called}", provenance=procedure.provenance)
        write_whole(report, page)
    if as_json:
        say(json.dumps(event(found)) + "\n")
    else:
        say(lines(found) + "".join(f"{path}\n" for path in (out, report) if path is not None))
    if any(each.kind == "edge" for each in given) and "psf" not in found.parameters:
        raise EstimationError(found.validity.get("edge", "no usable frame"), where="edge")


def _exposures(series: Path | None, places: dict[str, list[Path] | None]) -> tuple[FileExposure, ...]:
    """Files of the series and of the options.

    Raises
    ------
    UsageError
        If dark or lit exposures are missing.
    """
    from ..procedures.sensor_files import exposures_in, read_exposures

    found = () if series is None else read_exposures(series)
    for kind, folders in places.items():
        for folder in folders or []:
            found += exposures_in(folder, kind)
    for kind, what in (("light", "evenly lit"), ("dark", "dark")):
        if not any(each.kind == kind for each in found):
            raise UsageError(
                f"no {what} exposures", where=series or "sensor", do=f"add them with --{kind} FOLDER"
            )
    return found


def event(found: Calibration) -> dict[str, Any]:
    """The calibration without its fields, as `--json` prints it."""
    quantities = {name: each.model_dump() for name, each in found.parameters.items()}
    content = {"parameters": quantities, "validity": found.validity, "tests": list(found.tests)}
    return {"event": "calibration", "schema": "reseau-sensor/1", **content}


def lines(found: Calibration) -> str:
    """The calibration as text, one line for each quantity."""
    from ..core.numbers import measured

    text = [
        f"{name:<16} {measured(each.value, each.sigma, each.unit)}" for name, each in found.parameters.items()
    ]
    validity = found.validity
    text.append(f"{'dark signal':<16} ± {validity['dsnu']:.2g} DN from pixel to pixel")
    text.append(
        f"{'response':<16} ± {100 * validity['prnu']:.2g} % from pixel to pixel, including uneven light"
    )
    text.append(f"{'defects':<16} {validity['defects']} pixels")
    if validity["linearity"] != "fitted":
        text.append(f"{'linearity':<16} not estimated: {validity['linearity']}")
    if not validity["saturated"]:
        text.append(f"{'full well':<16} not reached: provide more light or longer exposures")
    text += [f"{test['name']:<16} {_verdict(test)}" for test in found.tests if "p" in test]
    for test in found.tests:
        if test["name"] == "photon transfer" and not test["passed"]:
            text.append(
                f"{'photon transfer':<16} rejected: the noise deviates by {found.sigma0:.2g} of its σ "
                "from the model (rms); look for a tone curve, compression, averaging, or light that changes"
            )
    return "\n".join(text) + "\n"


def _verdict(test: dict[str, Any]) -> str:
    """Outcome of a test of the edge."""
    return f"{'accepted' if test['passed'] else 'rejected'} ({probability(test['p'])})"


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
    picture = output.drawn(image)
    writable(report)
    frame = reading.frame(image)
    options = {"regions": regions or None, "channel": reading.channel}
    with progress(f"measuring {image.name}", max(1, len(regions))) as step:
        result = measure_sharpness(frame, regions, options=options, step=step)
    found = required(result, image)
    if picture is not None:
        edges_overlay(found, picture)
    if report is not None:
        write_whole(report, edges_report(found, title=f"Sharpness of {image.name}"))
    output.deliver(found.document(), _csv, _lines)


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
