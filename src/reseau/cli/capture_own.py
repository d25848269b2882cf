"""`reseau capture own`: the plan of a Python file, carried out like those that come with the package."""

from __future__ import annotations

import inspect
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.errors import FormatError, UsageError
from .acquisition import CameraName, Where, conduct, in_session

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..capture import Acquisition, Bench, Plan

__all__ = ["own"]

GENERATOR = "generator.py"


@in_session()
def own(
    where: Where,
    generator: Annotated[
        Path | None, typer.Option("--generator", "-g", help="Python file with a generator `plan(run, …)`.")
    ] = None,
    given: Annotated[
        list[str] | None, typer.Option("--set", help="A parameter of the plan, as tilt=30; may be repeated.")
    ] = None,
    retakes: Annotated[int, typer.Option(min=0, help="How often a bad frame is taken again.")] = 0,
    camera: CameraName = None,
) -> None:
    """Carry out a plan of one's own: a generator in Python, kept with the session."""
    values = dict(_value(text) for text in given or ())
    if generator is not None:
        from ..io import read_text

        _bound(_plan_of(read_text(generator), generator), values, generator)

    def parameters(found: Bench) -> dict[str, Any]:
        return {"set": values, "retakes": retakes, "park": {}, "camera": camera}

    def planned(run: Acquisition, begun: dict[str, Any]) -> Plan:
        made: Plan = _plan_of(run.kept.input(GENERATOR), GENERATOR)(run, **begun["set"])
        return made

    conduct(where, "own", planned, parameters, {GENERATOR: generator})


def _value(text: str) -> tuple[str, Any]:
    """Name and value of a parameter: a number, a list … as TOML has it, else a text."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise UsageError(f"is {text!r}", where="--set", do="write it like tilt=30")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value


def _plan_of(text: str, where: object) -> Callable[..., Any]:
    """The generator `plan` of a Python file.

    Raises
    ------
    FormatError
        When it is no Python, or has none.
    """
    names: dict[str, Any] = {"__name__": "plan", "__file__": str(where)}
    try:
        exec(compile(text, str(where), "exec"), names)  # what its owner asked to be carried out
    except SyntaxError as error:
        raise FormatError(f"line {error.lineno} is no Python ({error.msg})", where=where) from None
    plan = names.get("plan")
    if not inspect.isgeneratorfunction(plan):
        raise FormatError("has no generator `plan(run, …)`", where=where, do="define one, with `yield from`")
    return plan


def _bound(plan: Callable[..., Any], values: dict[str, Any], where: object) -> None:
    """Refuse parameters that a plan does not have, and the lack of those that it needs."""
    try:
        inspect.signature(plan).bind(None, **values)
    except TypeError as error:
        raise UsageError(f"its plan does not fit ({error})", where=where, do="see --set") from None
