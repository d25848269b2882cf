"""What an option is: its meaning, limits and group, declared once in the type of a field.

The type of an option is ``Annotated[type, Option(…)]``. Fields of frozen dataclasses, of documents (pydantic)
and parameters of commands use it; commands, JSON Schema and forms are made of it. Its name is that of the
field, with the unit at its end; a command writes it with dashes.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from types import GenericAlias, NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

from .errors import UsageError

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema


class Group(StrEnum):
    """Groups of options in the help of a command."""

    BASIC = "Options"
    CAMERA = "Camera model"
    TARGET = "Target"
    ADJUSTMENT = "Adjustment"
    FILES = "Files"
    EXECUTION = "Execution"


@dataclass(frozen=True)
class Option:
    """Meaning and limits of an option.

    Parameters
    ----------
    help : str
        What it is, with its unit in brackets; the first sentence is the same in all commands.
    group : Group, optional
        Where help shows it; by default files among files, others first.
    letter : str
        Short name in commands, as ``-o``.
    called : str
        Name in commands, without dashes, where that of the field cannot be it, as ``json``.
    least, most : float, optional
        Limits of its value, which are allowed.
    value : str
        What help writes for the value, as ``NAME=FILE``; by default it follows from the type.
    parse : callable, optional
        Makes the value of its text, on the command line or in a form; raises ValueError. Values of other
        types than numbers, texts and tuples of them have one.
    off : str
        For a switch, the name of its opposite, as ``--not-mirrored``; by default ``--no-…``.
    environment : str
        Variable of the environment that is read where the option is not given.

    Examples
    --------
    >>> from typing import Annotated
    >>> Fill = Annotated[float, Option("Light-sensitive share of a pixel.", least=0, most=1)]
    >>> declaration(Fill).option.most
    1
    """

    help: str
    group: Group | None = None
    letter: str = ""
    called: str = ""
    least: float | None = None
    most: float | None = None
    value: str = ""
    parse: Callable[[str], Any] | None = None
    off: str = ""
    environment: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Limits for pydantic: those of this declaration."""
        from pydantic import Field

        if self.least is None and self.most is None:
            return handler(source)
        return handler.generate_schema(Annotated[source, Field(ge=self.least, le=self.most)])

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Meaning in the JSON Schema."""
        return handler(schema) | {"description": self.help}


@dataclass(frozen=True)
class Declared:
    """An option with its type.

    Parameters
    ----------
    type : type
        Type of a value, without None.
    optional : bool
        Whether None is a value.
    option : Option
        Its meaning.
    note : str
        What a command adds to the meaning: what the option does there, or its default.
    """

    type: Any
    optional: bool
    option: Option
    note: str = ""

    @property
    def help(self) -> str:
        """Meaning and note."""
        return f"{self.option.help} {self.note}".strip()

    @property
    def choices(self) -> tuple[str, ...]:
        """Values of which one is chosen; empty if it is free."""
        return get_args(self.type) if get_origin(self.type) is Literal else ()

    @property
    def is_number(self) -> bool:
        """Whether the value is a number."""
        return self.type in (int, float)

    @property
    def is_table(self) -> bool:
        """Whether the value is a table, which a file has."""
        return self.is_several and get_origin(get_args(self.type)[0]) is tuple

    @property
    def is_several(self) -> bool:
        """Whether the value is a tuple of any number of elements."""
        return get_origin(self.type) is tuple and get_args(self.type)[-1] is Ellipsis

    def read(self, text: str, where: str) -> Any:
        """Return the value that a text writes: names between commas, or as many numbers as it has.

        Raises
        ------
        UsageError
            If it writes none; `where` names the option.

        Examples
        --------
        >>> Declared(tuple[int, int], False, Option("Size of images (px).")).read("640x480", "size")
        (640, 480)
        """
        try:
            if self.option.parse is not None:
                return self.option.parse(text)
            if self.is_several:
                return tuple(words([text]))
            if get_origin(self.type) is tuple:
                parts = zip(get_args(self.type), re.split("[,x×]", text), strict=True)
                return tuple(one(part) for one, part in parts)
            if self.type is bool:
                return {"true": True, "false": False}[text]
            return self.type(text) if self.is_number else text
        except (ValueError, KeyError):
            kinds = get_args(self.type) if get_origin(self.type) is tuple else (self.type,)
            form = self.option.value or ",".join(value_name(each) for each in kinds)
            raise UsageError(f"cannot interpret {text!r}", where=where, do=f"write {form}") from None


def declaration(hint: Any) -> Declared | None:
    """Return what a type declares; None if it is no option.

    Texts after the option in ``Annotated`` are notes.

    Examples
    --------
    >>> from typing import Annotated
    >>> found = declaration(Annotated[int, Option("Number of rounds.")] | None)
    >>> found.type, found.optional, declaration(int)
    (<class 'int'>, True, None)
    """
    if get_origin(hint) is Annotated:
        inner, *about = get_args(hint)
        found = next((each for each in about if isinstance(each, Option)), None)
        notes = " ".join(each for each in about if isinstance(each, str))
        if found is None:
            below = declaration(inner)
            return below and dataclasses.replace(below, note=f"{below.note} {notes}".strip())
        kind, optional = _without_none(inner)
        return Declared(kind, optional, found, notes)
    kind, optional = _without_none(hint)
    if get_origin(kind) is list:
        one = declaration(*get_args(kind))
        kind = None if one is None else GenericAlias(list, (one.type,))
        return one and dataclasses.replace(one, type=kind, optional=optional)
    found_below = declaration(kind) if optional else None
    return found_below and dataclasses.replace(found_below, optional=True)


def options_of(cls: type) -> dict[str, Declared]:
    """Return the options that the fields of a dataclass or document declare, by their names.

    Fields whose type is imported for type checkers only are no options.

    Examples
    --------
    >>> from reseau.measure.boards.measure import BoardOptions
    >>> list(options_of(BoardOptions))
    ['mirrored', 'psf_px', 'row_jitter_px', 'fill']
    """
    found = {}
    for base in reversed(cls.__mro__):
        for name, hint in inspect.get_annotations(base).items():
            try:
                hint = eval(hint, vars(sys.modules[base.__module__])) if isinstance(hint, str) else hint
            except NameError:
                continue
            declared = declaration(hint)
            if declared is not None:
                found[name] = declared
    document = getattr(cls, "model_fields", None)
    fields = [each.name for each in dataclasses.fields(cls)] if document is None else document
    return {name: found[name] for name in fields if name in found}


def values_of_texts(cls: type, texts: Mapping[str, str], where: object) -> dict[str, Any]:
    """Return values of declared options that are written as on the command line; empty ones are left out.

    Raises
    ------
    UsageError
        If there is no such option, or a text cannot be interpreted.

    Examples
    --------
    >>> from reseau.measure.boards.measure import BoardOptions
    >>> values_of_texts(BoardOptions, {"mirrored": "true", "psf_px": "", "fill": "0.8"}, "monday")
    {'mirrored': True, 'fill': 0.8}
    """
    known = options_of(cls)
    for name in texts.keys() - known.keys():
        raise UsageError(f"unknown key `{name}`", where=where)
    return {name: known[name].read(text, name) for name, text in texts.items() if text.strip()}


def words(texts: Iterable[str]) -> list[str]:
    """Return the words of texts, between commas."""
    return [word for text in texts for each in text.split(",") if (word := each.strip())]


def value_name(kind: Any) -> str:
    """Return what help writes for a value of a type."""
    return _VALUES.get(kind, "")


_VALUES = {int: "INTEGER", float: "NUMBER", str: "TEXT", Path: "PATH"}


def _without_none(hint: Any) -> tuple[Any, bool]:
    """Type of a value, and whether None is one."""
    if get_origin(hint) not in (Union, UnionType):
        return hint, False
    rest = [each for each in get_args(hint) if each is not NoneType]
    return (rest[0] if len(rest) == 1 else hint), len(rest) < len(get_args(hint))
