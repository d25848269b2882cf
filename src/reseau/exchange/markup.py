"""XML of other programs: texts and attributes of elements; what is missing is named with its place."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..core.data import Array
from ..core.errors import FormatError
from .lines import read_bytes

_MOST_MB = 1000


class Node:
    """An element of an XML file, which knows where it is.

    Parameters
    ----------
    element : Element
        The element.
    where : str
        File and path of names, for messages.
    """

    def __init__(self, element: ElementTree.Element, where: str) -> None:
        self._element, self.where = element, where

    @property
    def tag(self) -> str:
        """Its name."""
        return self._element.tag

    @property
    def text(self) -> str:
        """Its text, without white space at the ends."""
        return (self._element.text or "").strip()

    def find(self, path: str) -> Node | None:
        """Return the first descendant along a path of names, or None."""
        found = self._element.find(path)
        return None if found is None else Node(found, f"{self.where}, {path}")

    def all(self, path: str) -> Iterator[Node]:
        """All descendants along a path of names."""
        for k, found in enumerate(self._element.findall(path), start=1):
            name = found.get("id") or found.get("label") or str(k)
            yield Node(found, f"{self.where}, {path} {name}")

    def need(self, path: str) -> Node:
        """Return the first descendant along a path of names.

        Raises
        ------
        FormatError
            When there is none.
        """
        found = self.find(path)
        if found is None:
            raise FormatError(f"has no element <{path}>", where=self.where)
        return found

    def get(self, name: str, default: str = "") -> str:
        """Return an attribute."""
        return self._element.get(name, default)

    def attribute(self, name: str) -> str:
        """Return an attribute that must be there.

        Raises
        ------
        FormatError
            When it is missing.
        """
        value = self._element.get(name)
        if value is None:
            raise FormatError(f"has no attribute `{name}`", where=self.where)
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number in an attribute; `default` where it is missing."""
        if default is not None and self._element.get(name) is None:
            return default
        return float(_finite([self.attribute(name)], 1, f"{self.where}, {name}")[0])

    def pixels(self, name: str) -> int:
        """Return the number of pixels in an attribute."""
        found = self.number(name)
        if not (found >= 1 and found.is_integer()):
            raise FormatError(f"is {found:g}, not a number of pixels", where=f"{self.where}, {name}")
        return int(found)

    def numbers(self, count: int | None = None) -> Array:
        """Return the finite numbers of its text, separated by white space or commas.

        Raises
        ------
        FormatError
            When they are not numbers, or not `count`.
        """
        return _finite(re.split(r"[\s,]+", self.text), count, self.where)

    def value(self, path: str, default: float | None = None) -> float:
        """Return the number in the text of a descendant; `default` where there is none."""
        found = self.find(path)
        if found is None and default is not None:
            return default
        return float(self.need(path).numbers(1)[0])


def _finite(words: list[str], count: int | None, where: str) -> Array:
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        values = np.full(len(words), np.nan)
    if not np.isfinite(values).all() or (count is not None and len(values) != count):
        wanted = "numbers" if count is None else "a number" if count == 1 else f"{count} numbers"
        raise FormatError(f"`{' '.join(words)[:60]}` is not {wanted}", where=where)
    return values


def read_markup(path: Path, content: bytes | None = None) -> Node:
    """Read the root of an XML file.

    Parameters
    ----------
    path : Path
        The file.
    content : bytes, optional
        Its content, where it is a part of another file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is not well-formed XML, or declares entities, which none of the formats needs.
    """
    content = read_bytes(path, _MOST_MB) if content is None else content
    # Entities can grow without bound when they are expanded.
    if b"<!ENTITY" in content[:100_000]:
        raise FormatError("declares XML entities, which are not read", where=path)
    try:
        return Node(ElementTree.fromstring(content), str(path))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise FormatError(
            f"is not well-formed XML ({error})", where=path, do="export it again, completely"
        ) from None
