"""`reseau capture sensor`: calibrate the sensor of a camera from dark and evenly lit frames."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .acquisition import CameraName, Where, ask_operator, conduct, in_session
from .common import say, writable
from .sensor import event, lines

if TYPE_CHECKING:
    from ..archive import Session
    from ..capture import Bench
    from ..sessions import SensorParameters

__all__ = ["sensor"]


@in_session("out", "yes")
def sensor(
    where: Where,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write the calibration to, in addition to the archive."),
    ] = None,
    camera: CameraName = None,
    levels: Annotated[int, typer.Option(min=5, help="Number of exposure times in light.")] = 14,
    frames: Annotated[int, typer.Option(min=2, help="Number of frames for each exposure time.")] = 8,
    longest_ms: Annotated[float, typer.Option(min=0.2, help="Longest exposure time (ms).")] = 1000.0,
    edge: Annotated[bool, typer.Option("--edge", help="Also measure the MTF, with a slanted edge.")] = False,
    region: Annotated[
        tuple[int, int, int, int] | None, typer.Option(help="Region of the edge: left top width height (px).")
    ] = None,
    retakes: Annotated[int, typer.Option(min=0, help="Number of additional attempts after a bad frame.")] = 2,
    yes: Annotated[bool, typer.Option("--yes", help="Do not prompt.")] = False,
) -> None:
    """Calibrate a camera's sensor: dark signal, response, linearity, noise, gain, full well, defects, MTF."""
    if out is not None:
        writable(out)

    def parameters(bench: Bench) -> SensorParameters:
        from ..sessions import SensorParameters

        return SensorParameters.on_bench(
            bench, camera=camera, levels=levels, frames=frames, longest_us=longest_ms * 1000, edge=edge,
            region=region, retakes=retakes,
        )  # fmt: skip

    def afterwards(session: Session) -> None:
        _print_result(session, out, where.as_json)

    who = _print_request if yes else ask_operator
    conduct(where, "sensor", parameters, operator=who, afterwards=afterwards)


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
