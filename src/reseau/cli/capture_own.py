"""`reseau capture own`: carry out a plan from a Python file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from .acquisition import Where, conduct


def own(
    where: Where,
    generator: Annotated[
        Path | None, typer.Option("--generator", "-g", help="Python file with a generator `plan(run, …)`.")
    ] = None,
    set_: Annotated[v.Set | None, "Here arguments of the plan, as tilt=30."] = None,
    retakes: v.Retakes = 0,
    camera: v.Camera | None = None,
    table: v.Table | None = None,
) -> None:
    """Carry out your own plan: a Python generator, stored with the session."""
    values = dict(_value(text) for text in set_ or ())
    if generator is not None:
        from ..io import read_text
        from ..sessions.kinds import own_plan

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
