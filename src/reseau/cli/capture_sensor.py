"""`reseau capture sensor`: a camera's sensor calibrated, from its frames in the dark and in even light."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import AsJson, say, writable

if TYPE_CHECKING:
    from ..instruments import Camera
    from ..refine.sensor import SensorResult

__all__ = ["sensor"]


def sensor(
    out: Annotated[Path, typer.Option("--out", "-o", help="Calibration to write.")],
    bench: Annotated[Path, typer.Option("--bench", "-b", help="The bench.")] = Path("bench.toml"),
    camera: Annotated[str | None, typer.Option("--camera", help="Where the bench has several.")] = None,
    levels: Annotated[int, typer.Option(min=5, help="Exposures in light.")] = 14,
    frames: Annotated[int, typer.Option(min=2, help="Of each exposure.")] = 8,
    longest_ms: Annotated[float, typer.Option(min=0.2, help="Longest exposure.")] = 1000.0,
    edge: Annotated[bool, typer.Option("--edge", help="Measure the MTF too, by a slanted edge.")] = False,
    region: Annotated[
        tuple[int, int, int, int] | None, typer.Option(help="Of the edge: left top width height.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Wait for nobody: all is done by others.")] = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate a camera's sensor: dark, flat, linearity, noise and gain, full well, defects, sharpness."""
    from ..capture import Bench
    from ..capture.sensor import SensorPlan, capture_edge, capture_sensor
    from ..formats import write_whole
    from ..provenance import Provenance, canonical_json
    from ..refine.sensor import calibrate_sensor, measure_edge
    from .common import required

    writable(out)
    plan = SensorPlan(levels, frames, longest_ms * 1000)

    def ready(what: str) -> None:
        typer.echo(f"please {what}", err=True)
        if not yes:
            typer.prompt("Enter when done", default="", show_default=False, err=True)

    with Bench.read(bench) as found:
        device = _camera(found, camera)
        identity = str(device.connect())
        series = capture_sensor(device, plan, ready, lambda said: typer.echo(said, err=True))
        sharp = None
        if edge:
            sharp = required(measure_edge(capture_edge(device, ready), region), "edge")
    result = replace(calibrate_sensor(series), edge=sharp)
    options = {"camera": identity, "levels": levels, "frames": frames, "settings": device.settings.to_dict()}
    calibration = result.calibration(
        identity,
        Provenance({}, options).to_dict(),
        {"taken": datetime.now(UTC).isoformat(timespec="seconds")},
    )
    write_whole(out, calibration.to_json())
    if as_json:
        quantities = {name: each.model_dump() for name, each in result.quantities().items()}
        said = {"schema": "reseau-sensor/1", "parameters": quantities, "validity": result.validity()}
        say(canonical_json(said))
    else:
        say(_told(result) + f"{out}\n")


def _camera(bench: Any, name: str | None) -> Camera:
    """The camera of a name, or the only one.

    Raises
    ------
    UsageError
        When there is none, or more than one and none was named.
    """
    from ..errors import UsageError
    from ..instruments import Camera

    found = {each: device for each, device in bench.instruments.items() if isinstance(device, Camera)}
    if name is None and len(found) != 1:
        raise UsageError(f"has {len(found)} cameras", where="bench", do="name one with --camera")
    chosen = next(iter(found)) if name is None else name
    if chosen not in found:
        raise UsageError(
            "is no camera of this bench", where=chosen, do=f"there are {', '.join(found) or 'none'}"
        )
    device: Camera = found[chosen]
    return device


def _told(result: SensorResult) -> str:
    """What was found, a line for each."""
    lines = [
        f"{name:<11} {each.value:.5g} ± {each.sigma:.2g} {each.unit}"
        for name, each in result.quantities().items()
    ]
    validity = result.validity()
    lines.append(f"{'dark':<11} ± {result.dsnu:.3g} DN from pixel to pixel")
    lines.append(f"{'response':<11} ± {100 * result.prnu:.3g} % from pixel to pixel, uneven light included")
    lines.append(f"{'defects':<11} {validity['defects']} pixels")
    if not validity["saturated"]:
        lines.append("full well   not reached: give more light or longer exposures")
    return "\n".join(lines) + "\n"
