"""Features of a GenICam camera: what it has, in which ranges and units, and what its user sets contain.

A feature is described by the camera itself (EMVA, *GenICam Standard*). User sets are sets of values that the
camera keeps without power; ``Default`` is that of its maker.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Feature:
    """One feature of a camera.

    Parameters
    ----------
    category, name, kind : str
        Category, name and type: integer, float, boolean, enumeration, string, command or register.
    value : str
        Present value; empty if it cannot be read.
    unit : str
        Unit of a number.
    low, high, step : float, optional
        Range and increment of a number.
    entries : tuple of str
        Values of an enumeration that are available now.
    writable : bool
        Whether it can be changed now.
    about : str
        Description by the camera.

    Examples
    --------
    >>> print(Feature("Root", "Gain", "float", "3", "dB", 0.0, 24.0))
    Gain = 3 dB, 0 to 24 dB
    """

    category: str
    name: str
    kind: str
    value: str = ""
    unit: str = ""
    low: float | None = None
    high: float | None = None
    step: float | None = None
    entries: tuple[str, ...] = ()
    writable: bool = True
    about: str = ""

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        said = f"{self.name} = {self.value}{unit}" if self.value else f"{self.name}: {self.kind}"
        if self.low is not None and self.high is not None:
            said += f", {self.low:.10g} to {self.high:.10g}{unit}"
            said += f" in steps of {self.step:.10g}" if self.step not in (None, 0, 1) else ""
        elif self.entries:
            said += f", of {', '.join(self.entries)}"
        return said if self.writable else f"{said} (read only)"


def matching(features: Iterable[Feature], text: str) -> list[Feature]:
    """Return the features whose name, category, unit, entries or description contain a text.

    Examples
    --------
    >>> known = [Feature("AnalogControl", "Gain", "float"), Feature("Root", "Width", "integer")]
    >>> [each.name for each in matching(known, "analog")]
    ['Gain']
    """
    wanted = text.casefold()
    return [
        each
        for each in features
        if wanted in " ".join((each.name, each.category, each.unit, *each.entries, each.about)).casefold()
    ]


def differences(one: Mapping[str, str], other: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return the features with different values in two sets, with both values.

    Examples
    --------
    >>> differences({"Gain": "0", "Width": "96"}, {"Gain": "3", "Width": "96"})
    {'Gain': ('0', '3')}
    """
    return {
        name: (one.get(name, ""), other.get(name, ""))
        for name in sorted(one.keys() | other.keys())
        if one.get(name, "") != other.get(name, "")
    }


def found_features(library: Any, glib: Any, genicam: Any) -> Iterator[Feature]:
    """Yield the available features of an opened camera, by categories."""
    left, seen = [("Root", "Root")], set[str]()
    while left:
        category, name = left.pop(0)
        node = genicam.get_node(name)
        if node is None or name in seen:
            continue
        seen.add(name)
        if isinstance(node, library.GcCategory):
            left += [(name, each) for each in node.get_features()]
        elif isinstance(node, library.GcFeatureNode):
            try:
                if node.is_available():
                    yield _feature(library, glib, category, node)
            except glib.Error:  # a feature that this camera describes and does not have
                continue


def _feature(library: Any, glib: Any, category: str, node: Any) -> Feature:
    more: dict[str, Any] = {}
    kind = "register"
    if isinstance(node, library.GcCommand):
        kind = "command"
    elif isinstance(node, library.GcEnumeration):
        kind, more["entries"] = "enumeration", tuple(node.dup_available_string_values())
    elif isinstance(node, library.GcBoolean):
        kind = "boolean"
    elif isinstance(node, library.GcFloat):
        kind = "float"
    elif isinstance(node, library.GcInteger):
        kind = "integer"
    elif isinstance(node, library.GcString):
        kind = "string"
    if kind in ("float", "integer"):
        more["unit"] = node.get_unit() or ""
        for key, ask in (("low", "get_min"), ("high", "get_max"), ("step", "get_inc")):
            try:
                more[key] = float(getattr(node, ask)())
            except glib.Error:
                continue
        if kind == "float":
            more["step"] = None
    value = ""
    if kind != "command":
        try:
            value = str(node.get_value_as_string() or "")
        except glib.Error:
            value = ""
    access = node.get_actual_access_mode()
    writable = access in (library.GcAccessMode.RW, library.GcAccessMode.WO)
    about = str(node.get_description() or node.get_tooltip() or "")
    return Feature(category, node.get_name(), kind, value, **more, writable=writable, about=about)
