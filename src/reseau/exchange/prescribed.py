"""What imports of lenses from other programs share: rows of their tables, and the radius of the stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from ..core.errors import FormatError, UsageError
from ..optics.lenses import Medium, Prescription, Tracer, glass
from ..optics.lenses.media import Powers, Sellmeier
from ..optics.lenses.paraxial import Paraxial
from ..optics.lenses.trace import Rays
from .lines import read_bytes

MOST_MB = 10
"""Largest size of a file with a prescription."""

T = TypeVar("T")

_MOULDED = {"D-ZK3M": "D-ZK3", "L-TIM28_MOLD": "L-TIM28"}
"""Glasses after precision moulding, under the names of makers of lenses, and the glass before moulding."""


_FAR = 1e9
"""Objects at this distance (mm) or farther are at infinity."""


@dataclass(frozen=True)
class Opening:
    """How a program states the width of the beam.

    Parameters
    ----------
    kind : {"diameter", "f-number", "working f-number", "object aperture", "stop"}
        Diameter of the entrance pupil, f-number for objects at infinity or for the object as it is, numerical
        aperture on the side of the object, radius of the stop.
    value : float
    object_distance : float
        Distance of the object from the first surface, mm.
    real : bool
        Whether the edge of the stop is where the real, not the paraxial, ray from the edge of the entrance
        pupil meets it.
    """

    kind: Literal["diameter", "f-number", "working f-number", "object aperture", "stop"]
    value: float
    object_distance: float = np.inf
    real: bool = False


def within(where: object, call: Callable[[], T]) -> T:
    """Call a function; what it refuses is an error in `where`, a file or a part of it."""
    try:
        return call()
    except (UsageError, FormatError) as error:
        what = error.what if error.where is None else f"{error.where}: {error.what}"
        raise FormatError(what, where=where, do=error.do) from None


def finite(word: str) -> float:
    """A number of a file.

    Raises
    ------
    ValueError
        When it is none, or not finite.
    """
    value = float(word)
    if not np.isfinite(value):
        raise ValueError(f"{word} is not finite")
    return value


def scale_of(stated: list[str] | None, known: Mapping[str, tuple[str, float]], notes: list[str]) -> float:
    """Millimetres of the unit of lengths that a file states, of those that a program has.

    Examples
    --------
    >>> notes = []
    >>> scale_of(["CM"], {"MM": ("mm", 1.0), "CM": ("cm", 10.0)}, notes), notes
    (10.0, ['is in cm; lengths are converted to mm'])
    """
    if stated is None:
        notes.append("states no unit; lengths are taken as mm")
        return 1.0
    word = stated[0].upper() if stated else ""
    if word not in known:
        *names, last = known
        do = f"expected {', '.join(names)} or {last}"
        raise FormatError(f"has the unit {word!r}, which is not known", do=do)
    unit, scale = known[word]
    if scale != 1:
        notes.append(f"is in {unit}; lengths are converted to mm")
    return scale


def far(distance: float) -> float:
    """Distance of an object; infinite where it is a large number that stands for it."""
    return distance if distance < _FAR else np.inf


def glasses_beside(path: Path) -> dict[str, Medium]:
    """Glasses of the catalogues ``.agf`` in the folder of a file, by name."""
    found = dict[str, Medium]()
    for file in sorted(path.parent.glob("*.[aA][gG][fF]")):
        content = read_bytes(file, MOST_MB)
        wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = content.decode("utf-16" if wide else "latin-1", "replace")
        found |= within(file, partial(_agf, text))
    return found


def _agf(text: str) -> dict[str, Medium]:
    """Glasses of a catalogue: lines NM (name, number of the formula), CD (coefficients), LD (range, µm)."""
    found, lines = dict[str, Medium](), dict[str, list[str]]()
    for words in (line.split() for line in f"{text}\nNM".splitlines()):
        if words[:1] == ["NM"] and "CD" in lines:
            name, formula = lines["NM"][0], lines["NM"][1] if len(lines["NM"]) > 1 else ""
            make = _FORMULAS.get(formula.partition(".")[0])
            try:
                values = [finite(word) for word in lines["CD"]]
                low, high = (1e3 * finite(word) for word in lines["LD"][:2])
            except (ValueError, KeyError):
                raise FormatError(f"the glass {name} has no coefficients or no range") from None
            found[name.upper()] = (
                UnknownGlass(name, formula, tuple(_FORMULAS))
                if make is None
                else make(values, name, (low, high))
            )
        if words:
            lines = {"NM": words[1:]} if words[0] == "NM" else lines | {words[0]: words[1:]}
    return found


@dataclass(frozen=True)
class UnknownGlass:
    """A glass whose formula is not known; it is refused where it is used."""

    name: str
    formula: str
    known: tuple[str, ...]

    def index(self, wavelength_nm: float) -> float:
        """See :class:`~reseau.optics.lenses.Medium`."""
        raise UsageError(
            f"its dispersion has the formula {self.formula}; known are {', '.join(self.known)}",
            where=f"glass {self.name}",
        )


def _pairs(values: list[float], name: str, limits: tuple[float, float]) -> Medium:
    pairs = [(b, c) for b, c in zip(values[::2], values[1::2], strict=False) if b]
    return Sellmeier(tuple(b for b, _ in pairs), tuple(c for _, c in pairs), name, limits)


def schott(values: list[float], name: str, limits: tuple[float, float] | None) -> Medium:
    """Schott's older formula, which CODE V calls that of Laurent."""
    return Powers(
        values[0], tuple(zip(values[1:6], (2.0, -2.0, -4.0, -6.0, -8.0), strict=False)), name, limits
    )


# Formulas of AGF by their numbers: Schott, and Sellmeier with three, four and five terms.
_FORMULAS: dict[str, Callable[[list[float], str, tuple[float, float]], Medium]] = {
    "1": schott,
    "2": _pairs,
    "6": _pairs,
    "11": _pairs,
}


def catalogue_glass(name: str, where: str, notes: list[str], own: Mapping[str, Medium]) -> Medium:
    """Glass of own catalogues or of ours; a note where it is there under another name, or a moulded one."""
    if name.upper() in own:
        return own[name.upper()]
    base = _MOULDED.get(name.upper())
    found = within(where, lambda: glass(base or name))
    plain = name.upper().replace("-", "").partition("_")[0]
    if base is not None:
        notes.append(
            f"the glass {name} is {base} after precision moulding; the index of {base} is used, of which "
            "moulding takes some 0.001 to 0.005"
        )
    elif plain != found.name.replace("-", "").partition("_")[0]:
        notes.append(f"the glass {name} is catalogued as {found.name}, which has the same coefficients")
    return found


def kind_behind(before: Medium, medium: Medium) -> Literal["refracting", "plain"]:
    """Whether a surface between two media is ``refracting`` or ``plain``."""
    return "plain" if before == medium else "refracting"


def with_stop(lens: Prescription, opening: Opening) -> Prescription:
    """The lens with the radius of its stop, from the width of the beam."""
    value, distance = opening.value, opening.object_distance
    if not (np.isfinite(value) and value > 0):
        raise UsageError(f"the width of its beam is {value:g}")
    if opening.kind == "stop":
        return replace(lens, stop_radius=value)
    first, stop = Paraxial(lens), lens.stop
    wide, oblique = (float(first.ray(*start, last=stop)[0][-1]) for start in ((1.0, 0.0), (0.0, 1.0)))
    # Height and slope, at the first surface, of the ray from the axis of the object to the edge of the pupil.
    start = (distance, 1.0) if np.isfinite(distance) else (1.0, 0.0)
    reach = wide * start[0] + oblique * start[1]
    slope = float(first.ray(*start)[1][-1])
    if opening.kind == "object aperture":
        if not np.isfinite(distance):
            raise UsageError("states a numerical aperture of an object at infinity")
        n = lens.before.index(lens.wavelength_nm)
        if value >= n:
            raise UsageError(f"a numerical aperture of {value:g} is impossible")
        radius = float(np.tan(np.arcsin(value / n))) * reach
    elif opening.kind == "working f-number":
        if slope == 0:
            raise UsageError("states a working f-number, but its image is at infinity")
        radius = reach / (2 * value * slope)
    else:
        radius = wide * (value if opening.kind == "diameter" else first.focal_length / value) / 2
    if opening.real:
        if reach == 0:
            raise UsageError("has its object in its entrance pupil")
        height, slope = (radius / reach * part for part in start)
        direction = np.array([[0.0, slope, 1.0]]) / np.hypot(slope, 1.0)
        # From well in front of the first surface, which may be concave towards the object.
        back = distance if np.isfinite(distance) else abs(first.focal_length)
        at = np.array([[0.0, height - slope * back, -back]])
        traced = Tracer(lens, last=stop, apertures=False).trace(Rays(at, direction))
        if not traced.arrived[0]:
            raise UsageError("the ray at the edge of its beam does not reach the stop")
        radius = float(traced.xy[0, 1])
    return replace(lens, stop_radius=abs(radius))
