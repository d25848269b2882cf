"""One name has one meaning in all commands, in documents and in dataclasses."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Annotated, Any, get_type_hints

import pytest
import typer
from typer.main import get_command

from reseau.bundle import Options as AdjustmentOptions
from reseau.cli import app
from reseau.cli.declared import declared
from reseau.core.errors import UsageError
from reseau.core.options import Declared, Group, Option, declaration, options_of
from reseau.core.vocabulary import names
from reseau.measure.blurred import BlurredOptions
from reseau.measure.boards.measure import BoardOptions
from reseau.measure.fiducials.measure import FiducialOptions
from reseau.measure.pins.detection import PinOptions
from reseau.measure.reseau.marks import ReseauOptions
from reseau.measure.testfield.measure import TestfieldOptions
from reseau.procedures.blurred_network import NetworkOptions
from reseau.procedures.calibration import CalibrationOptions
from reseau.procedures.film_frame import FrameOptions
from reseau.sessions import parameters

Run = Callable[..., tuple[int, str, str]]

OWN = {"control", "shape"}
"""What commands read from files is an object in Python: control points; the shape of a frame of film."""


def commands(command: Any = None, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Every command with its words."""
    command = get_command(app) if command is None else command
    below = getattr(command, "commands", None)
    if below is None:
        yield " ".join(words), command
    for name, each in (below or {}).items():
        yield from commands(each, (*words, name))


def options() -> Iterator[tuple[str, str, Any]]:
    """Every option: its long name, the command, and Typer's parameter."""
    for words, command in commands():
        for parameter in command.params:
            if parameter.param_type_name == "option":
                yield next(each for each in parameter.opts if each.startswith("--")), words, parameter


def kind(parameter: Any) -> str:
    """Type of one value, without the choices: of several values each has it."""
    descriptor = parameter.type_descriptor
    name: str = parameter.bare_type()
    return "choice" if descriptor.is_choice else name.removeprefix("list[").removesuffix("]")


def flag(name: str, declared: Declared) -> str:
    """An option of a command."""
    return f"--{(declared.option.called or name).replace('_', '-')}"


def test_a_name_has_one_type_and_one_meaning_in_all_commands() -> None:
    words = {flag(name, each): each.option.help for name, each in names().items()}
    found, where = defaultdict[str, set[str]](set), defaultdict[str, list[str]](list)
    for name, command, parameter in options():
        # What follows the meaning is a note of the command.
        meaning = words.get(name, parameter.help)
        assert parameter.help.startswith(meaning), (name, command)
        found[name].add(f"{kind(parameter)}: {meaning}")
        where[name].append(command)
    assert {name: (each, where[name]) for name, each in found.items() if len(each) > 1} == {}


def test_every_name_of_the_vocabulary_is_used_and_says_its_unit() -> None:
    used = {name for name, _, _ in options()}
    units = {"mm": "(mm)", "px": "(px", "deg": "(degrees)", "gb": "(GB)", "ms": "(ms)"}
    for name, each in names().items():
        assert flag(name, each) in used
        unit = units.get(name.rpartition("_")[2])
        assert unit is None or unit in each.option.help, name


def test_help_has_no_types_of_python(reseau: Run) -> None:
    for command in ("", "calibrate", "bench set", "service user change", "measure fiducials"):
        status, out, _ = reseau(*command.split(), "--help")
        assert status == 0
        assert not re.findall(r"<[a-z]\w*[^=]>|\bbool\b|Path\b|list\[|tuple", out), command


def test_options_are_in_groups_in_one_order(reseau: Run) -> None:
    out = reseau("calibrate", "--help")[1]
    places = [out.index(f"─ {group.value} ─") for group in Group]
    assert places == sorted(places)


def test_commands_are_in_the_order_of_the_work(reseau: Run) -> None:
    out = reseau("--help")[1]
    order = (
        "calibrate", "measure", "bundle", "apply", "compare", "design", "capture", "archive", "serve",
        "demo"
    )  # fmt: skip
    places = [out.index(f"│ {name} ") for name in order]
    assert places == sorted(places)


CLASSES = [
    AdjustmentOptions, BlurredOptions, BoardOptions, CalibrationOptions, FiducialOptions, FrameOptions,
    NetworkOptions, PinOptions, ReseauOptions, TestfieldOptions,
]  # fmt: skip


@pytest.mark.parametrize("cls", CLASSES)
def test_fields_of_options_have_the_types_of_the_vocabulary(cls: type) -> None:
    declared, known = options_of(cls), names()
    for field in dataclasses.fields(cls):
        if field.name in known and field.name not in OWN:
            assert declared[field.name].option == known[field.name].option


def test_parameters_of_sessions_have_the_meaning_and_the_limits_of_the_options() -> None:
    known = names()
    for kind in vars(parameters).values():
        if not (isinstance(kind, type) and issubclass(kind, parameters.SessionParameters)):
            continue
        hints = get_type_hints(kind, include_extras=True)
        schema = kind.json_schema()["properties"]
        for key in set(hints) & set(known) - {"format_mm", "set"}:
            found = declaration(hints[key])
            assert found is not None
            assert found.option == known[key].option
            assert known[key].option.help in str(schema[key])
    assert parameters.PhotographsParameters.json_schema()["properties"]["fill"]["maximum"] == 1


@pytest.mark.parametrize(
    ("given", "value"),
    [
        ("--sides 3x4", (3.0, 4.0)),
        ("--sides 3,4.5", (3.0, 4.5)),
        ("", None),
    ],
)
def test_a_tuple_is_one_text(given: str, value: Any) -> None:
    seen = _called(given.split(), sides=(Annotated[tuple[float, float], Option("Sides.")] | None, None))
    assert seen == {"sides": value}


def test_names_are_separated_by_commas_or_repeated() -> None:
    kind = (Annotated[tuple[str, ...], Option("Names.")], ())
    assert _called(["--free", "a,b", "--free", "c"], free=kind) == {"free": ("a", "b", "c")}
    assert _called([], free=kind) == {"free": ()}


def test_a_wrong_tuple_is_refused_with_its_form() -> None:
    kind = (Annotated[tuple[int, int], Option("Size.", value="WIDTHxHEIGHT")] | None, None)
    with pytest.raises(UsageError, match="--image-size: cannot interpret '640'; write WIDTHxHEIGHT"):
        _called(["--image-size", "640"], image_size=kind)


def _called(words: list[str], **parameters: tuple[Any, Any]) -> dict[str, Any]:
    """What a command with such parameters is given."""
    seen: dict[str, Any] = {}

    def command(**values: Any) -> None:
        seen.update(values)

    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)
            for name, (hint, default) in parameters.items()
        ]
    )
    command.__annotations__ = {name: hint for name, (hint, _) in parameters.items()}
    program = typer.Typer()
    program.command()(declared(command))
    program(words, standalone_mode=False)
    return seen
