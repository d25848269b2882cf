"""`reseau capture sensor`: a camera's sensor calibrated, from its frames in the dark and in even light."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .acquisition import CameraName, Where, conduct, in_session, operator
from .common import say, writable

if TYPE_CHECKING:
    from ..archive import Session
    from ..calibration.document import Calibration
    from ..capture import Acquisition, Bench, Plan

__all__ = ["sensor"]

CALIBRATION = "calibration.json"


@in_session("out", "yes")
def sensor(
    where: Where,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Calibration to write, too.")] = None,
    camera: CameraName = None,
    levels: Annotated[int, typer.Option(min=5, help="Exposures in light.")] = 14,
    frames: Annotated[int, typer.Option(min=2, help="Of each exposure.")] = 8,
    longest_ms: Annotated[float, typer.Option(min=0.2, help="Longest exposure.")] = 1000.0,
    edge: Annotated[bool, typer.Option("--edge", help="Measure the MTF too, by a slanted edge.")] = False,
    region: Annotated[
        tuple[int, int, int, int] | None, typer.Option(help="Of the edge: left top width height.")
    ] = None,
    retakes: Annotated[int, typer.Option(min=0, help="How often a bad frame is taken again.")] = 2,
    yes: Annotated[bool, typer.Option("--yes", help="Wait for nobody: all is done by others.")] = False,
) -> None:
    """Calibrate a camera's sensor: dark, flat, linearity, noise and gain, full well, defects, sharpness."""
    from ..capture.sensor import ALL_LIMITS, SensorPlan
    from ..capture.sensor import sensor as series
    from ..instruments import Camera

    if out is not None:
        writable(out)

    def parameters(found: Bench) -> dict[str, Any]:
        device = found.one(Camera, camera)
        settings = device.settings.to_dict()
        own = float(settings["exposure_us"]) if edge else None
        return {
            **vars(wanted := SensorPlan(levels, frames, longest_ms * 1000, own)),
            "count": wanted.count,
            "camera": device.name,
            "settings": settings,
            "region": None if region is None else list(region),
            "retakes": retakes,
            "park": {},
        }

    def planned(run: Acquisition, given: dict[str, Any]) -> Plan:
        return series(run, SensorPlan(*(given[key] for key in ("levels", "frames", "longest_us", "edge_us"))))

    def afterwards(kept: Session) -> None:
        _told(kept, out, where.as_json)

    who = _others if yes else operator
    conduct(where, "sensor", planned, parameters, limits=ALL_LIMITS, operator=who, afterwards=afterwards)


def _others(what: str) -> None:
    """Say what others do."""
    typer.echo(what, err=True)


def _told(kept: Session, out: Path | None, as_json: bool) -> None:
    """Say what was found, and write it where it was asked for.

    Raises
    ------
    EstimationError
        When an edge was shown in which there was nothing to measure; all else is kept and written.
    """
    from ..calibration.document import Calibration
    from ..core.errors import EstimationError
    from ..io import write_whole

    last = [result for result in kept.results() if result.name == CALIBRATION][-1]
    found = Calibration.parse(kept.content(last).decode("utf-8"), where=CALIBRATION)
    if out is not None:
        begun = {"begun": kept.begun.isoformat(timespec="seconds")}
        write_whole(out, found.model_copy(update={"times": begun}).to_json())
    if as_json:
        quantities = {name: each.model_dump() for name, each in found.parameters.items()}
        told = {"parameters": quantities, "validity": found.validity, "tests": list(found.tests)}
        say(json.dumps({"event": "calibration", "schema": "reseau-sensor/1", **told}) + "\n")
    else:
        say(_lines(found) + (f"{out}\n" if out is not None else ""))
    if kept.parameters["edge_us"] is not None and "psf" not in found.parameters:
        raise EstimationError(found.validity.get("edge", "has no good frame"), where="edge")


def _lines(found: Calibration) -> str:
    """What was found, a line for each."""
    lines = [
        f"{name:<16} {each.value:.5g} ± {each.sigma:.2g} {each.unit}"
        for name, each in found.parameters.items()
    ]
    validity = found.validity
    lines.append(f"{'dark':<16} ± {validity['dsnu']:.3g} DN from pixel to pixel")
    lines.append(
        f"{'response':<16} ± {100 * validity['prnu']:.3g} % from pixel to pixel, uneven light included"
    )
    lines.append(f"{'defects':<16} {validity['defects']} pixels")
    if not validity["saturated"]:
        lines.append("full well        not reached: give more light or longer exposures")
    lines += [f"{test['name']:<20} {_verdict(test)}" for test in found.tests if "p" in test]
    return "\n".join(lines) + "\n"


def _verdict(test: dict[str, Any]) -> str:
    """Of a test of the edge."""
    likely = f"p = {test['p']:.2g}" if test["p"] >= 5e-4 else "p < 0.001"
    return f"{'yes' if test['passed'] else 'no'} ({likely})"
