"""Forms of documents: fields follow from the schema of the document, labels from its description."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

_PARAMETERS = re.compile(r"^Parameters\n-+\n(.*?)(?:\n\n[A-Z][a-z]+\n-+\n|\Z)", re.DOTALL | re.MULTILINE)
_ENTRY = re.compile(r"^(\S[^\n]*?) :[^\n]*\n((?:    [^\n]*\n?)+)", re.MULTILINE)


@dataclass(frozen=True)
class FormField:
    """A field of a form, or a group of fields.

    Parameters
    ----------
    name : str
        Path of the key in the document, such as ``image.warning``.
    label : str
        What people read.
    kind : str
        ``text``, ``number``, ``flag``, ``choice``, ``date``, ``lines``, ``pairs`` or ``group``.
    required : bool
        Whether it must be filled in.
    value : object
        What it is filled with at first.
    choices : tuple of str
        What can be chosen.
    least, most : float or None
        Limits of a number.
    parts : tuple of FormField
        Fields of a group.

    Examples
    --------
    >>> FormField("window_minutes", "Window", "number", value=240).kind
    'number'
    """

    name: str
    label: str
    kind: str
    required: bool = False
    value: Any = None
    choices: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    parts: tuple[FormField, ...] = ()


def form_of(
    model: type[BaseModel],
    values: Mapping[str, Any] | None = None,
    prefix: str = "",
    but: tuple[str, ...] = (),
) -> tuple[FormField, ...]:
    """Return the fields of a document.

    Parameters
    ----------
    model : type
        The document.
    values : mapping, optional
        Content with which it is filled; by default the defaults of the document.
    prefix : str
        Path before the names.
    but : tuple of str
        Keys that have no field.

    Examples
    --------
    >>> from reseau.service import AcceptanceRules
    >>> [each.name for each in form_of(AcceptanceRules, prefix="rules.")][:2]
    ['rules.version', 'rules.image']
    """
    schema = model.model_json_schema()
    return _fields(schema, schema, dict(values or {}), prefix, True, but)


def _described(about: str) -> dict[str, str]:
    """The first sentence about each parameter of a class, by the description that its schema has."""
    found = _PARAMETERS.search(about)
    said = dict[str, str]()
    for names, text in _ENTRY.findall("" if found is None else found[1] + "\n"):
        sentence = " ".join(text.split()).replace("`", "")
        said |= {each: sentence.rstrip(".") for each in names.split(", ")}
    return said


def _fields(
    schema: Mapping[str, Any], whole: Mapping[str, Any], values: Mapping[str, Any], prefix: str,
    required: bool, but: tuple[str, ...] = (),
) -> tuple[FormField, ...]:  # fmt: skip
    said = _described(schema.get("description", ""))
    needed = schema.get("required", ()) if required else ()
    return tuple(
        _field(
            each, whole, prefix + name, said.get(name, name.replace("_", " ")), name in needed,
            values.get(name, each.get("default") if required else None),
        )
        for name, each in schema.get("properties", {}).items()
        if name not in but
    )  # fmt: skip


def _field(
    schema: Mapping[str, Any], whole: Mapping[str, Any], name: str, label: str, required: bool, value: Any
) -> FormField:
    """The field of a key, by its schema."""
    found = _plain(schema, whole)
    kind = found.get("type", "string")
    if "enum" in found:
        choices = tuple(map(str, found["enum"]))
        return FormField(name, label, "choice", required, value, choices)
    if kind == "object" and "properties" in found:
        parts = _fields(found, whole, value or {}, f"{name}.", required)
        return FormField(name, label, "group", required, parts=parts)
    if kind == "object":
        return FormField(
            name, label, "pairs", required, "\n".join(f"{k}={v}" for k, v in (value or {}).items())
        )
    if kind == "array":
        one = _plain(found.get("items", {}), whole)
        if "properties" not in one:
            return FormField(name, label, "lines", required, "\n".join(map(str, value or ())))
        filled = [*(value or ()), {}]
        groups = [_fields(one, whole, each, f"{name}.{k}.", False) for k, each in enumerate(filled)]
        return FormField(name, label, "group", parts=tuple(part for group in groups for part in group))
    if kind in ("number", "integer"):
        least = found.get("minimum", found.get("exclusiveMinimum"))
        most = found.get("maximum", found.get("exclusiveMaximum"))
        return FormField(name, label, "number", required, value, (), least, most)
    kind = {"boolean": "flag"}.get(kind, "date" if found.get("format") == "date" else "text")
    return FormField(name, label, kind, required, value)


def _plain(schema: Mapping[str, Any], whole: Mapping[str, Any]) -> Mapping[str, Any]:
    """A schema without references, and without the possibility that there is nothing."""
    if "anyOf" in schema:
        schema = next(each for each in schema["anyOf"] if each.get("type") != "null")
    if "$ref" in schema:
        schema = whole["$defs"][schema["$ref"].rpartition("/")[2]]
    return schema
