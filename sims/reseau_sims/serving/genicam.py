"""Features of a simulated camera, and their description in GenICam's XML.

Sources: EMVA, *GenICam Standard* 2.1 (nodes of the description), and *Standard Features Naming Convention*
2.4 (names, units and categories).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal
from xml.sax.saxutils import escape, quoteattr

_FIRST, _SPACING = 0xA000, 0x10
"""Registers of the maker begin here."""


@dataclass(frozen=True)
class Feature:
    """One feature.

    Parameters
    ----------
    category, name : str
        Category and name.
    kind : {"integer", "float", "enumeration", "boolean", "command", "string"}
        Type; a string has 32 bytes.
    default : float or str
        Value after power-on; of an enumeration one of its entries.
    low, high, step : float
        Range and increment of a number.
    unit : str
        Unit of a number.
    entries : mapping of str to int
        Values of an enumeration.
    access : {"RW", "RO"}
        Whether it can be changed.
    address : int
        Register; 0: the next free one.
    length : int
        Size of the register (bytes); 0: as usual for its type.

    Examples
    --------
    >>> exposure = Feature("AcquisitionControl", "ExposureTime", "float", 5000.0, 10.0, 1e6, unit="us")
    >>> exposure.size, exposure.decode(exposure.encode(2500.0))
    (8, 2500.0)
    """

    category: str
    name: str
    kind: Literal["integer", "float", "enumeration", "boolean", "command", "string"]
    default: float | str = 0
    low: float = 0
    high: float = 0xFFFFFFFF
    step: float = 1
    unit: str = ""
    entries: Mapping[str, int] = field(default_factory=dict)
    access: Literal["RW", "RO"] = "RW"
    address: int = 0
    length: int = 0

    @property
    def size(self) -> int:
        """Size of its register (bytes)."""
        return self.length or {"float": 8, "string": 32}.get(self.kind, 4)

    def encode(self, value: float | str) -> bytes:
        """Return the content of its register for a value."""
        if self.kind == "string":
            return str(value).encode()[: self.size].ljust(self.size, b"\0")
        if self.kind == "float":
            return struct.pack(">d", float(value))
        number = self.entries[str(value)] if self.kind == "enumeration" else int(value)
        return number.to_bytes(self.size, "big")

    def decode(self, data: bytes) -> float | str:
        """Return the value in its register; of an enumeration its entry, empty if there is none."""
        if self.kind == "string":
            return data.rstrip(b"\0").decode("utf-8", "replace")
        if self.kind == "float":
            return float(struct.unpack(">d", data)[0])
        number = int.from_bytes(data, "big")
        if self.kind == "enumeration":
            return next((name for name, value in self.entries.items() if value == number), "")
        return number

    def valid(self, data: bytes) -> bool:
        """Whether the register takes this content."""
        value = self.decode(data)
        if self.kind in ("string", "command"):
            return True
        if self.kind == "enumeration":
            return value != ""
        if self.kind == "boolean":
            return value in (0, 1)
        return self.low <= float(value) <= self.high


def placed(features: Iterable[Feature]) -> dict[str, Feature]:
    """Return features by name, each with its register.

    Examples
    --------
    >>> hex(placed([Feature("Test", "One", "integer"), Feature("Test", "Two", "float")])["Two"].address)
    '0xa010'
    """
    found, at = {}, _FIRST
    for each in features:
        address = each.address
        if not address:
            address, at = at, at + max(_SPACING, each.size)
        found[each.name] = Feature(**{**vars(each), "address": address})
    return found


def description(features: Mapping[str, Feature], model: str, maker: str) -> bytes:
    """Return the description of a camera with these features.

    Examples
    --------
    >>> text = description(placed([Feature("Root", "Width", "integer", 96)]), "camera", "reseau")
    >>> b'<Integer Name="Width">' in text
    True
    """
    categories: dict[str, list[str]] = {}
    for each in features.values():
        categories.setdefault(each.category, []).append(each.name)
    lines = [_category("Root", categories)]
    lines += [_category(name, names) for name, names in categories.items()]
    lines += [_node(each) for each in features.values()]
    lines.append('<Port Name="Device"></Port>')
    head = (
        '<?xml version="1.0" encoding="utf-8"?>\n<RegisterDescription '
        f"ModelName={quoteattr(model)} VendorName={quoteattr(maker)} ToolTip={quoteattr(model)} "
        'StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" '
        'MajorVersion="1" MinorVersion="0" SubMinorVersion="0" '
        'ProductGuid="3e5f1f3a-5a3c-4d3e-9d0a-0a5f7b1c2d3e" '
        'VersionGuid="7c1f0b1e-8a5d-4b6f-a7b8-1d2e3f4a5b6c" '
        'xmlns="http://www.genicam.org/GenApi/Version_1_1">\n'
    )
    return (head + "\n".join(lines) + "\n</RegisterDescription>\n").encode()


def _category(name: str, features: Iterable[str]) -> str:
    inside = "".join(f"<pFeature>{each}</pFeature>" for each in features)
    return f'<Category Name="{name}">{inside}</Category>'


def _node(feature: Feature) -> str:
    """The nodes of a feature: what a program sees, and its register."""
    name, number = feature.name, "%.15g"
    where = (
        f"<Address>{feature.address:#x}</Address><Length>{feature.size}</Length>"
        f"<AccessMode>{feature.access}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
    )
    if feature.kind == "string":
        return f'<StringReg Name="{name}">{where}</StringReg>'
    kind = "FloatReg" if feature.kind == "float" else "IntReg"
    sign = "" if feature.kind == "float" else "<Sign>Unsigned</Sign>"
    register = f'<{kind} Name="{name}Reg">{where}{sign}<Endianess>BigEndian</Endianess></{kind}>'
    inside = f"<pValue>{name}Reg</pValue>"
    if feature.kind in ("integer", "float"):
        inside += f"<Min>{number % feature.low}</Min><Max>{number % feature.high}</Max>"
        inside += f"<Inc>{number % feature.step}</Inc>" if feature.kind == "integer" else ""
        inside += f"<Unit>{escape(feature.unit)}</Unit>" if feature.unit else ""
    elif feature.kind == "enumeration":
        inside = (
            "".join(
                f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>'
                for entry, value in feature.entries.items()
            )
            + inside
        )
    elif feature.kind == "boolean":
        inside += "<OnValue>1</OnValue><OffValue>0</OffValue>"
    else:
        inside += "<CommandValue>1</CommandValue>"
    node = feature.kind.capitalize()
    return f'<{node} Name="{name}">{inside}</{node}>\n{register}'
