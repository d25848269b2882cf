"""Units in D-SI, the digital form of the SI (https://doi.org/10.5281/zenodo.3366901)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal

from ...core.errors import UsageError

# Name in D-SI and power of ten of the units that calibrations have. Pixels and grey values are counts.
_KNOWN = {
    "1": ("", 0), "": ("", 0), "px": ("", 0), "DN": ("", 0), "e": ("", 0), "e-": ("", 0), "%": ("", -2),
    "mm": ("metre", -3), "µm": ("metre", -6), "um": ("metre", -6), "nm": ("metre", -9), "m": ("metre", 0),
    "rad": ("radian", 0), "mrad": ("radian", -3), "deg": ("degree", 0), "°": ("degree", 0),
    "s": ("second", 0), "ms": ("second", -3), "K": ("kelvin", 0), "°C": ("degreecelsius", 0),
}  # fmt: skip
_PART = re.compile(r"(?P<name>[^\s^*·/]+)(\^(?P<power>-?\d+))?")


@dataclass(frozen=True)
class DigitalUnit:
    """A product of powers of SI units without prefixes, and the power of ten that leads to it.

    Examples
    --------
    >>> unit = digital_unit("mm^-2")
    >>> unit.text, unit.number(-4.5e-5)
    ('\\\\metre\\\\tothe{-2}', '-45')
    >>> digital_unit("px").text, digital_unit("mm").times(digital_unit("rad")).text
    ('\\\\one', '\\\\metre\\\\radian')
    """

    powers: tuple[tuple[str, int], ...]
    shift: int

    @property
    def text(self) -> str:
        """The unit as D-SI writes it."""
        parts = [f"\\{name}" + ("" if k == 1 else f"\\tothe{{{k}}}") for name, k in self.powers if k]
        return "".join(parts) or "\\one"

    def number(self, value: float) -> str:
        """A value in this unit, exactly as in the original one."""
        scaled = Decimal(repr(float(value))).scaleb(self.shift)
        return f"{scaled.normalize():.17G}".replace("E+0", "E+").replace("E-0", "E-")

    def times(self, other: DigitalUnit) -> DigitalUnit:
        """The product of both."""
        return _product([*self.powers, *other.powers], self.shift + other.shift)


def digital_unit(unit: str) -> DigitalUnit:
    """Return a unit in D-SI.

    Raises
    ------
    UsageError
        If it is not known.
    """
    powers, shift, sign, at = [], 0, 1, 0
    for found in _PART.finditer(unit):
        if "/" in unit[at : found.start()]:
            sign = -1
        at = found.end()
        if found["name"] not in _KNOWN:
            raise UsageError(f"{unit!r} has no form in D-SI", where="unit")
        name, ten = _KNOWN[found["name"]]
        power = sign * int(found["power"] or 1)
        powers.append((name, power))
        shift += ten * power
    return _product(powers, shift)


def _product(powers: Sequence[tuple[str, int]], shift: int) -> DigitalUnit:
    total: dict[str, int] = {}
    for name, power in powers:
        if name:
            total[name] = total.get(name, 0) + power
    return DigitalUnit(tuple((name, k) for name, k in total.items() if k), shift)
