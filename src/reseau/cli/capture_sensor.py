"""`reseau capture sensor`: calibrate the sensor of a camera from dark and evenly lit frames."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.files import writable
from ..core.options import Option
from .acquisition import Where, ask_operator, conduct
from .common import say
from .sensor import event, lines

if TYPE_CHECKING:
    from ..archive import Session
    from ..capture import Bench
    from ..sessions.parameters import SensorParameters


def sensor(
    where: Where,
    out: Annotated[v.Out | None, "Here the calibration, in addition to the archive."] = None,
    camera: v.Camera | None = None,
    levels: Annotated[int, Option("Number of exposure times in light.", least=5)] = 14,
    frames: Annotated[int, Option("Number of frames for each exposure time.", least=2)] = 8,
    longest_ms: v.LongestMs = 1000.0,
    mtf: Annotated[bool, Option("Also measure the MTF, with a slanted edge.")] = False,
    region: v.Region | None = None,
    retakes: v.Retakes = 2,
    yes: Annotated[bool, Option("Do not prompt.")] = False,
) -> None:
    """Calibrate a camera's sensor: dark signal, response, linearity, noise, gain, full well, defects, MTF."""
    writable(out)

    def parameters(bench: Bench) -> SensorParameters:
        from ..sessions.parameters import SensorParameters

        return SensorParameters.on_bench(
            bench, camera=camera, levels=levels, frames=frames, longest_us=longest_ms * 1000, edge=mtf,
            region=region, retakes=retakes,
        )  # fmt: skip

    def afterwards(session: Session) -> None:
        _print_result(session, out, where.as_json)

    who = _print_request if yes else ask_operator
    conduct(where, "sensor", parameters, operator=who, afterwards=afterwards, also_resumed=("out", "yes"))


def _print_request(request: str) -> None:
    """Print a request to the operator without waiting."""
    typer.echo(request, err=True)


def _print_result(session: Session, out: Path | None, as_json: bool) -> None:
    """Print the calibration, and write it if `out` is given.

    Raises
    ------
    EstimationError
        If an edge was taken but could not be measured; all other results are stored.
    """
    from ..core.errors import EstimationError
    from ..io import write_whole
    from ..sessions import calibration_of, parameters_of

    found = calibration_of(session)
    if out is not None:
        write_whole(out, found.to_json())
    if as_json:
        say(json.dumps(event(found)) + "\n")
    else:
        say(lines(found) + (f"{out}\n" if out is not None else ""))
    if getattr(parameters_of(session), "edge_us", None) is not None and "psf" not in found.parameters:
        raise EstimationError(found.validity.get("edge", "no usable frame"), where="edge")
