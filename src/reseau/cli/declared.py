"""Commands of declared options: Typer's parameters are made of what :mod:`reseau.core.options` says of each.

A parameter of a command whose type is a declared option becomes the option of its name; one whose type is a
dataclass becomes an option for each of its fields, and the command is given the dataclass.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup
from typer.models import ArgumentInfo, OptionInfo

from ..core.options import Declared, Group, declaration, value_name, words


class _Plain:
    """Help without the types of Python: arguments have names, options say what their value is."""

    def get_params(self, ctx: Any) -> Any:
        found = super().get_params(ctx)  # type: ignore[misc]
        for each in found:
            if isinstance(each, TyperArgument) or getattr(each, "is_flag", False):
                each.display_type_rich = lambda ctx: ""
        return found


class _Command(_Plain, TyperCommand):
    """A command."""


class _Group(_Plain, TyperGroup):
    """A group of commands; help shows them in the order in which they were added."""

    order: Sequence[str] = ()

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted(self.commands, key=lambda name: self.order.index(name) if name in self.order else 0)


class Commands(typer.Typer):
    """A group of commands whose options are declared."""

    def __init__(self, **about: Any) -> None:
        self._order = list[str]()
        group = type("_Group", (_Group,), {"order": self._order})
        super().__init__(**{"cls": group, "no_args_is_help": True, **about})

    def add_panel(self, title: str, commands: Mapping[str, Any]) -> None:
        """Add commands and groups of commands, which help shows in a panel of their own."""
        for name, each in commands.items():
            self._order.append(name)
            if isinstance(each, typer.Typer):
                self.add_typer(each, name=name, rich_help_panel=title)
            else:
                self.command(name, rich_help_panel=title)(each)

    def command(self, name: str | None = None, **about: Any) -> Callable[[Any], Any]:
        """Return a decorator that adds a command, and leaves the function as it is."""
        add = super().command(name, **{"cls": _Command, **about})

        def decorated(function: Any) -> Any:
            add(declared(function))
            return function

        return decorated


def declared(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command as Typer takes it, with an option for each parameter and field that is declared."""
    hints = get_type_hints(command, include_extras=True)
    given = inspect.signature(command).parameters
    groups = {name: hints[name] for name in given if dataclasses.is_dataclass(hints[name])}
    made, splits = list[inspect.Parameter](), dict[str, Declared]()
    for name, parameter in given.items():
        if name not in groups:
            made.append(_parameter(name, hints[name], parameter.default, splits))
            continue
        fields, whole = _fields(groups[name])
        made += fields
        splits |= whole

    @functools.wraps(command)
    def called(**values: Any) -> Any:
        for name, option in splits.items():
            values[name] = _whole(name, option, values[name])
        for name, cls in groups.items():
            values[name] = cls(**{each.name: values.pop(each.name) for each in dataclasses.fields(cls)})
        return command(**values)

    shown = sorted(made, key=_place)
    called.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
    called.__annotations__ = {each.name: each.annotation for each in shown}
    # The terminal breaks lines, not the source; lists are kept.
    called.__doc__ = re.sub(r"(?<=\S)\n(?=\w)", " ", inspect.cleandoc(command.__doc__ or ""))
    return called


@functools.cache
def _fields(cls: Any) -> tuple[list[inspect.Parameter], dict[str, Declared]]:
    """Parameters of the fields of a dataclass, and those that are made of texts."""
    hints, splits = get_type_hints(cls, include_extras=True), dict[str, Declared]()
    made = [
        _parameter(each.name, hints[each.name], _default(each), splits) for each in dataclasses.fields(cls)
    ]
    return made, splits


def _place(parameter: inspect.Parameter) -> int:
    """Place of a parameter in help: options in the order of their groups, after the arguments."""
    about = getattr(parameter.annotation, "__metadata__", ())
    panel = next((each.rich_help_panel for each in about if isinstance(each, OptionInfo)), None)
    return 0 if panel is None else list(Group).index(Group(panel))


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default


def _parameter(name: str, hint: Any, default: Any, splits: dict[str, Declared]) -> inspect.Parameter:
    """Typer's parameter of an option; what is declared to Typer itself only gets names of values."""
    option = declaration(hint)
    if option is None:
        return inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=_with_value(name, hint)
        )
    kind = option.type
    if tuple in (get_origin(_inner(kind)), get_origin(kind)) or option.option.parse is not None:
        splits[name] = option
        many = get_origin(kind) is list or option.is_several
        one = Path if get_args(kind)[:1] == (Path,) else str
        kind = GenericAlias(list, (one,)) if many else one
        if isinstance(default, tuple) and not many:
            default = ",".join(map(str, default))
        default = default or None
    kind = kind | None if option.optional or default is None else kind
    annotation: Any = Annotated[kind, _info(name, option, default)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _info(name: str, declared: Declared, default: Any) -> OptionInfo:
    option, kind = declared.option, declared.type
    flag = f"--{(option.called or name).replace('_', '-')}"
    if kind is bool and (option.off or declared.optional or default is True):
        flag = f"{flag}/{option.off or f'--no-{flag[2:]}'}"
    group = option.group or (Group.FILES if _inner(kind) is Path else Group.BASIC)
    info: OptionInfo = typer.Option(
        *filter(None, (flag, option.letter)),
        help=declared.help,
        min=option.least,
        max=option.most,
        metavar=option.value or _value(kind),
        envvar=option.environment or None,
        rich_help_panel=None if group is Group.BASIC else group.value,
    )
    return info


def _inner(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is list else kind


def _value(kind: Any) -> str | None:
    """What help writes for a value of a type."""
    if get_origin(kind) is Literal:
        return f"[{'|'.join(map(str, get_args(kind)))}]"
    if get_origin(_inner(kind)) is tuple:
        return ",".join(map(value_name, get_args(_inner(kind)))).strip()
    return value_name(_inner(kind)) or None


def _with_value(name: str, hint: Any) -> Any:
    """The type of a parameter that is declared to Typer itself, with what help writes for its value."""
    if get_origin(hint) is Annotated:
        for each in get_args(hint)[1:]:
            if isinstance(each, ArgumentInfo) and each.metavar is None:
                each.metavar = name.upper()
    return hint


def _whole(name: str, option: Declared, value: Any) -> Any:
    """The value of an option of the texts that were given."""
    kind = _inner(option.type)
    if value is None:
        return None if option.optional else option.type() if get_origin(kind) is dict else ()
    if kind is not option.type:
        return [_whole(name, dataclasses.replace(option, type=kind), each) for each in value]
    if option.is_several:
        return tuple(value if get_args(kind)[0] is Path else words(value))
    return option.read(value, f"--{name.replace('_', '-')}")
