"""`reseau capture own`: carry out a plan from a Python file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer

from ..core.errors import UsageError
from .acquisition import CameraName, Where, conduct, in_session

__all__ = ["own"]


@in_session()
def own(
    where: Where,
    generator: Annotated[
        Path | None, typer.Option("--generator", "-g", help="Python file with a generator `plan(run, …)`.")
    ] = None,
    given: Annotated[
        list[str] | None, typer.Option("--set", help="Argument of the plan, as tilt=30; repeatable.")
    ] = None,
    retakes: Annotated[int, typer.Option(min=0, help="Number of additional attempts after a bad frame.")] = 0,
    camera: CameraName = None,
    table: Annotated[
        str | None, typer.Option("--table", help="Turntable to use, if there are several.")
    ] = None,
) -> None:
    """Carry out your own plan: a Python generator, stored with the session."""
    values = dict(_value(text) for text in given or ())
    if generator is not None:
        from ..io import read_text
        from ..sessions import own_plan

        own_plan(read_text(generator), generator, values)
    how = {"set": values, "retakes": retakes, "park": {}, "camera": camera}
    how |= {} if table is None else {"table": table}
    conduct(where, "own", lambda bench: how, {"generator.py": generator})


def _value(text: str) -> tuple[str, Any]:
    """Parse an argument: its name, and its value in TOML (number, list …) or as text."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise UsageError(f"cannot interpret {text!r}", where="--set", do="write name=value, as tilt=30")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value
