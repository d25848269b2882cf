"""The command line: `reseau --help`.

Modules of commands import other packages inside the commands, so that help and usage errors are fast.
"""

from __future__ import annotations

import gc
import os
import sys
from functools import cache
from typing import Annotated, Any

import typer
from typer.main import get_command

from ..core.errors import ReseauError
from ..core.notice import before_compiling
from ..core.optional import missing
from ..core.version import __version__
from . import (
    apply,
    archive,
    bench,
    blurred,
    bundle,
    bundle_compare,
    calibrate,
    calibrations,
    capture,
    certificates,
    design,
    export,
    measure,
    orient,
    program,
    refine,
    remote,
    schedule,
    sensor,
    serve,
    watch,
)
from .declared import Commands

__all__ = ["app", "main"]

_COMPILING = "compiling for this processor, once, what this command calls; `reseau compile` does it ahead"
_COLLECTING = (50_000, 20, 20)
"""When circles of objects are looked for: seldom: modules are most of what a command makes."""

app = Commands(
    name="reseau",
    help="Calibrate measuring cameras and imaging instruments.",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
measure.app.command()(orient.perforations)
measure.app.command()(orient.fiducials)
measure.app.command()(blurred.blurred)
measure.app.command()(sensor.edge)

# Help shows the commands in the order of the work.
_ORDER: dict[str, dict[str, Any]] = {
    "Calibrate": {
        "calibrate": calibrate.calibrate,
        "measure": measure.app,
        "refine": refine.refine,
        "orient": orient.orient,
        "blurred": blurred.blurred_network,
        "bundle": bundle.bundle,
        "sensor": sensor.sensor,
    },
    "Use a calibration": {
        "apply": apply.apply,
        "export": export.export,
        "compare": bundle_compare.compare,
        "uncertainty": certificates.uncertainty,
        "certificate": certificates.app,
    },
    "Targets and instruments": {
        "design": design.app,
        "bench": bench.app,
        "watch": watch.watch,
        "capture": capture.app,
    },
    "Archive and service": {
        "archive": archive.app,
        "calibrations": calibrations.app,
        "recalibrate": schedule.recalibrate,
        "schedule": schedule.app,
        "alarms": schedule.alarms,
        "serve": serve.serve,
        "service": serve.app,
        "remote": remote.app,
        "audit": serve.audit_app,
    },
    "This program": {"demo": program.demo, "schema": program.schema, "compile": program.compile_loops},
}
for _panel, _commands in _ORDER.items():
    app.add_panel(_panel, _commands)


def _version(requested: bool) -> None:
    if requested:
        typer.echo(f"reseau {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Calibrate measuring cameras and imaging instruments."""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 success, 1 failure, 2 usage error; errors in one line on stderr."""
    gc.set_threshold(*_COLLECTING)
    status = run(arguments)
    gc.freeze()  # what is left ends with the process
    sys.exit(status)


def run(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    if sys.stderr.isatty():
        before_compiling(lambda: print(_COMPILING, file=sys.stderr))
    try:
        return int(_command()(arguments, standalone_mode=False) or 0)
    except ReseauError as error:
        return _report(str(error), error.exit_status)
    except ModuleNotFoundError as error:
        package = missing(error)
        if package is None:
            raise
        return _report(str(package), package.exit_status)
    except KeyboardInterrupt:
        return _report("interrupted", 130)
    except BrokenPipeError:  # the program that reads the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        # Typer's own usage errors format themselves; they have no public class.
        format_message: Any = getattr(error, "format_message", None)
        if format_message is None:
            raise
        said = str(format_message()).replace("Value error, ", "")  # of pydantic
        return _report(said or "see `reseau --help`", int(getattr(error, "exit_code", 2)))


@cache
def _command() -> Any:
    """What Typer makes of all commands."""
    return get_command(app)


def _report(message: str, status: int) -> int:
    print(f"reseau: {' '.join(message.split())}", file=sys.stderr)
    return status
