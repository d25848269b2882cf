"""Reading and writing of documents: strict validation, and files written completely or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from ..core.data import twice
from ..core.errors import FormatError, InputError
from ..core.files import write_whole
from ..core.provenance import canonical_json

__all__ = ["write_whole"]


class Strict(BaseModel):
    """Base class of the parts of a document: no unknown keys, no coercion of types, no NaN.

    Examples
    --------
    >>> class Point(Strict):
    ...     x: float
    >>> Point(x=1.5).x
    1.5
    >>> Point(x="1.5")
    Traceback (most recent call last):
        ...
    pydantic_core._pydantic_core.ValidationError: 1 validation error for Point...
    """

    # A model is built when it is used first: importing needs few of them.
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True, defer_build=True)


class Columns(Strict):
    """Columns of one length."""

    @classmethod
    def _column_names(cls) -> tuple[str, ...]:
        """Names of the columns; empty where all fields are columns."""
        return ()

    @model_validator(mode="after")
    def _one_length(self) -> Self:
        length = None
        for name, info in type(self).model_fields.items():
            column = getattr(self, name)
            if column is None or (self._column_names() and name not in self._column_names()):
                continue
            length = len(column) if length is None else length
            if len(column) != length:
                raise ValueError(
                    f"column `{info.alias or name}` has {len(column)} entries, the first {length}"
                )
        return self


def read_text(path: Path, otherwise: str | None = None) -> str:
    """Read a UTF-8 text file of at most 1 GB.

    Parameters
    ----------
    path : Path
        The file.
    otherwise : str, optional
        Encoding of files that are not UTF-8, such as those of older programs with the names of their files.

    Raises
    ------
    InputError
        When it cannot be read, is larger than 1 GB or is not UTF-8.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_whole(Path(folder) / "note.txt", "21 µm")
    ...     read_text(Path(folder) / "note.txt")
    '21 µm'
    """
    try:
        if path.stat().st_size > 1_000_000_000:
            raise InputError("is larger than 1 GB", where=path)
        # Some editors write a byte-order mark.
        return path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        if otherwise is not None:
            return path.read_text(otherwise)
        raise InputError("is not UTF-8 text", where=path, do="check the file name") from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None


class _Duplicate(Exception):
    """A key that appears twice in an object."""


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if (again := twice(name for name, _ in pairs)) is not None:
        raise _Duplicate(again)
    return dict(pairs)


def _one_line(error: ValidationError) -> str:
    """Return the first error of a validation in one line, with the number of further errors."""
    errors = error.errors(include_url=False, include_context=False)
    first = errors[0]
    # Tags of unions, in angle brackets, are not keys of the document.
    parts = [part for part in first["loc"] if not str(part).startswith("<")]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).lstrip(".")
    text = {
        "extra_forbidden": f"unknown key `{key}`",
        "missing": f"missing key `{key}`",
    }.get(first["type"])
    if text is None:
        message = first["msg"].removeprefix("Value error, ")
        text = f"`{key}`: {message}" if key else message
    more = len(errors) - 1
    return text + (f" (and {more} more)" if more else "")


class Document(Strict):
    """A JSON file with a ``schema`` key first.

    Subclasses set `SCHEMA`, as in ``reseau-design/1``.

    Examples
    --------
    >>> class Note(Document):
    ...     SCHEMA = "note/1"
    ...     text: str
    >>> print(Note(text="clean the glass").to_json(), end="")
    {
     "schema": "note/1",
     "text": "clean the glass"
    }
    >>> Note.parse('{"schema": "note/1", "text": "done"}', where="note.json").text
    'done'
    """

    SCHEMA: ClassVar[str]
    LEFT_OUT: ClassVar[dict[str, Any]] = {}

    @classmethod
    def parse(cls, text: str, *, where: object) -> Self:
        """Read a document from JSON text; `where` names it in messages.

        Raises
        ------
        FormatError
            When it is not JSON, or not this document.
        """
        try:
            content = json.loads(text, object_pairs_hook=_without_duplicates)
        except _Duplicate as error:
            raise FormatError(f"the key `{error}` appears twice", where=where, do="keep one") from None
        except (json.JSONDecodeError, RecursionError) as error:
            raise FormatError(f"is not JSON ({error})", where=where) from None
        return cls.from_content(content, where=where)

    @classmethod
    def from_content(cls, content: Any, *, where: object) -> Self:
        """Return the document of decoded content; `where` names it in messages.

        Raises
        ------
        FormatError
            When it is not this document.
        """
        found = content.pop("schema", None) if isinstance(content, dict) else None
        if found != cls.SCHEMA:
            kind = "has no key `schema`" if found is None else f"has the schema {found!r}"
            raise FormatError(f"{kind}; {cls.SCHEMA!r} was expected", where=where)
        try:
            # As JSON again: pydantic's strict mode accepts a JSON array as a tuple, but not a Python list.
            return cls.model_validate_json(json.dumps(content, default=str))
        except ValidationError as error:
            raise FormatError(_one_line(error), where=where) from None

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a document from a file.

        Raises
        ------
        InputError
            When the file cannot be read.
        FormatError
            When it is not this document.
        """
        return cls.parse(read_text(Path(path)), where=path)

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema (draft 2020-12) of the file: keys, types and limits of single values.

        What depends on several values, as names that must be known, only reading the file checks.

        Examples
        --------
        >>> class Note(Document):
        ...     SCHEMA = "note/1"
        ...     text: str
        >>> Note.json_schema()["required"]
        ['schema', 'text']
        """
        found = cls.model_json_schema()
        key = {"const": cls.SCHEMA, "description": "Name and version of the format.", "type": "string"}
        return {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            **found,
            "title": cls.SCHEMA,
            "properties": {"schema": key} | found.get("properties", {}),
            "required": ["schema", *found.get("required", ())],
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file, ``schema`` first."""
        return {"schema": self.SCHEMA} | self.model_dump(mode="json", by_alias=True, **self.LEFT_OUT)

    def to_json(self) -> str:
        """Return the text of the file: same content, same bytes."""
        return canonical_json(self.to_dict())

    def write(self, path: Path | str) -> None:
        """Write the document completely or not at all.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        write_whole(Path(path), self.to_json())
