"""Lenses of Zemax (OpticStudio): sequential ``.zmx`` files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..core.errors import FormatError
from ..optics.lenses import AIR, Aperture, Medium, Prescription
from ..optics.lenses.media import model_glass
from ..optics.lenses.prescription import Layout, Surface
from .lines import read_bytes
from .prescribed import (
    MOST_MB,
    Opening,
    catalogue_glass,
    far,
    finite,
    glasses_beside,
    kind_behind,
    scale_of,
    with_stop,
    within,
)

_UNITS = {"MM": ("MM", 1.0), "CM": ("CM", 10.0), "IN": ("IN", 25.4), "METER": ("METER", 1000.0)}
_TYPES = ("STANDARD", "EVENASPH", "COORDBRK")
_OPENINGS: dict[
    str, Literal["diameter", "f-number", "working f-number", "object aperture", "stop"]
] = {"ENPD": "diameter", "FNUM": "f-number", "OBNA": "object aperture", "FLOA": "stop"}  # fmt: skip
_REFUSED = ("ELAP", "ELOB", "UDAD", "UDOB", "SPID", "SPIC")
_COEFFICIENTS = 8
"""Coefficients of an even asphere, from r² on."""


@dataclass
class _Listed:
    """Lines of one surface, by their first word; a line that may come several times, as PARM, by two."""

    number: int
    lines: dict[str, list[str]] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        return " ".join(self.lines.get("TYPE", ["STANDARD"])[:1]) or "without a name"

    @property
    def glass(self) -> str | None:
        return self.lines["GLAS"][0] if self.lines.get("GLAS") else None

    def value(self, key: str, default: float = 0.0, at: int = 0) -> float:
        """Return a number of a line; messages name the surface."""
        if key not in self.lines:
            return default
        return _number(self.lines, key, at, where=f"surface {self.number}")

    def parameter(self, number: int) -> float:
        return self.value(f"PARM {number}")


def read_zemax(path: Path | str) -> Prescription:
    """Read a lens from a sequential ``.zmx`` file.

    Spheres, conics, even aspheres, mirrors, and breaks of coordinates, of the configuration that the file
    shows. Diameters that Zemax computes limit no rays; apertures do. Fields and the distance of the object
    are no part of a lens.

    Parameters
    ----------
    path : Path or str
        The file, UTF-16, UTF-8 or Latin-1.

    Returns
    -------
    Prescription
        Lengths in mm; its `notes` tell what is not as in the file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no sequential lens, or has a surface, a glass or an aperture that is not supported, which
        is named.

    Examples
    --------
    >>> import tempfile
    >>> text = '''MODE SEQ
    ... UNIT MM
    ... ENPD 10
    ... WAVM 1 0.5875618 1
    ... SURF 0
    ...   DISZ INFINITY
    ... SURF 1
    ...   STOP
    ...   CURV 0.02
    ...   DISZ 5
    ...   GLAS N-BK7 0 0 1.5 40
    ... SURF 2
    ...   DISZ 93.4
    ... SURF 3
    ...   DISZ 0
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "lens.zmx"
    ...     _ = path.write_text(text)
    ...     lens = read_zemax(path)
    >>> lens.stop_radius, lens.indices(587.5618).round(4)
    (5.0, array([1.    , 1.5168, 1.    , 1.    ]))
    """
    header, listed = _parsed(_decoded(read_bytes(Path(path), MOST_MB)))
    if len(listed) < 3 or ("MODE" in header and header["MODE"][:1] != ["SEQ"]):
        raise FormatError("is not a sequential lens of Zemax", where=path)
    own = glasses_beside(Path(path))
    return within(path, lambda: _lens(header, listed, Path(path).stem, own))


def _decoded(content: bytes) -> str:
    """Text of a file: UTF-16 with or without a mark of byte order, UTF-8 or Latin-1."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", "replace")
    if content[1:2] == b"\0":
        return content.decode("utf-16-le", "replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _parsed(text: str) -> tuple[dict[str, list[str]], list[_Listed]]:
    """Lines of the header, and the surfaces with theirs, which are indented."""
    header: dict[str, list[str]] = {}
    listed: list[_Listed] = []
    inside = False
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        key, rest = words[0].upper(), words[1:]
        if key == "SURF":
            listed.append(_Listed(len(listed)))
            inside = True
        elif inside and line[0].isspace():
            several = key in ("PARM", "XDAT", "SCBD") and rest
            listed[-1].lines[f"{key} {rest[0]}" if several else key] = rest[1:] if several else rest
        else:
            inside = False
            several = key in ("WAVM",) and rest
            header.setdefault(f"{key} {rest[0]}" if several else key, rest[1:] if several else rest)
    return header, listed


def _lens(
    header: dict[str, list[str]], listed: list[_Listed], stem: str, own: Mapping[str, Medium]
) -> Prescription:
    notes: list[str] = []
    scale = scale_of(header.get("UNIT"), _UNITS, notes)
    wavelengths, weights, reference = _wavelengths(header)
    if len(header.get("MNUM", [])) and _number(header, "MNUM", 0) > 1:
        notes.append(f"of {header['MNUM'][0]} configurations, that which the file shows is read")
    temperature, pressure = (_number(header, "ENVD", at, value) for at, value in ((0, 20.0), (1, 1.0)))
    if (temperature, pressure) != (20.0, 1.0):
        notes.append(
            f"is meant for {temperature:g} °C and {pressure:g} atm; indices are those at 20 °C and 1 atm"
        )
    before = AIR if listed[0].glass is None else _medium(listed[0], notes, own)
    distance = far(_thickness(listed[0], scale))
    surfaces: list[Surface] = []
    layout, medium, stop = Layout(), before, -1
    for at in listed[1:]:
        last = at is listed[-1]
        if at.kind not in _TYPES:
            raise FormatError(f"has the type {at.kind}, which is not supported", where=_named(at))
        if "STOP" in at.lines:
            stop = len(surfaces)
        if at.kind == "COORDBRK":
            shift = scale * at.parameter(1), scale * at.parameter(2)
            tilt = at.parameter(3), at.parameter(4), at.parameter(5)
            layout.turn(shift, tilt, tilt_first=at.parameter(6) != 0)
        else:
            _break(at, layout, "SCBD 1", scale)
            surface, medium = _surface(at, layout, medium, scale, last, notes, own)
            surfaces.append(surface)
            _break(at, layout, "SCBD 2", scale)
        if not last:
            thickness = _thickness(at, scale)
            if not np.isfinite(thickness):
                raise FormatError("has an infinite distance to the next surface", where=_named(at))
            layout.advance(thickness)
    name = " ".join(header.get("NAME", [])) or stem
    lens = Prescription(
        tuple(surfaces),
        stop,
        wavelengths_nm=wavelengths,
        weights=weights,
        reference=reference,
        before=before,
        name=name,
    )
    lens = with_stop(lens, _opening(header, listed, scale, distance))
    if header.get("FTYP", ["0", "0"])[1:2] == ["1"]:
        notes.append("is meant to be telecentric on the side of the object; rays are aimed at the real stop")
    return replace(lens, notes=tuple(dict.fromkeys(notes)))


def _named(at: _Listed) -> str:
    comment = " ".join(at.lines.get("COMM", []))
    return f"surface {at.number}" + (f" ({comment})" if comment else "")


def _number(
    lines: dict[str, list[str]], key: str, at: int, default: float | None = None, where: str | None = None
) -> float:
    """Return a number of a line, or the default where there is none."""
    words = lines.get(key, [])
    if at >= len(words) and default is not None:
        return default
    try:
        return finite(words[at])
    except (IndexError, ValueError):
        raise FormatError(f"`{key} {' '.join(words)}` has no number", where=where) from None


def _wavelengths(header: dict[str, list[str]]) -> tuple[tuple[float, ...], tuple[float, ...], int]:
    """Wavelengths, nm, with weights, and the index of the primary one."""
    if "WAVL" in header:  # files before 2000
        microns = [finite(word) for word in header["WAVL"]]
        weights = [finite(word) for word in header.get("WWGT", ["1"] * len(microns))]
    else:
        rows = [key for key in header if key.startswith("WAVM ")]
        # Unused ones fill a table of 24; FTYP tells how many are used.
        used = int(_number(header, "FTYP", 3, len(rows)))
        pairs = [(_number(header, key, 0), _number(header, key, 1, 1.0)) for key in rows[:used]]
        microns, weights = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    found = tuple(round(1000 * microns_, 9) for microns_ in microns)
    return found, tuple(weights), int(_number(header, "PWAV", 0, 1.0)) - 1


def _thickness(at: _Listed, scale: float) -> float:
    words = at.lines.get("DISZ", ["0"])
    return np.inf if words and words[0].upper() == "INFINITY" else scale * at.value("DISZ")


def _opening(header: dict[str, list[str]], listed: list[_Listed], scale: float, distance: float) -> Opening:
    stated = [key for key in _OPENINGS if key in header]
    if not stated:
        raise FormatError("does not state the width of its beam (ENPD, FNUM, OBNA or FLOA)")
    key = stated[0]
    kind, value = _OPENINGS[key], _number(header, key, 0, np.nan)
    if key == "FNUM" and _number(header, key, 1, 0.0) == 1:
        kind = "working f-number"
    if key == "OBNA" and _number(header, key, 1, 0.0) == 1:
        raise FormatError("states its aperture as a cone angle, which is not supported")
    if key == "ENPD":
        value *= scale
    if key == "FLOA":
        stop = next((at for at in listed if "STOP" in at.lines), listed[0])
        value = scale * stop.value("DIAM")
    # Real rays are aimed at the stop where the file says so.
    return Opening(kind, value, distance, real=_number(header, "RAIM", 1, 0.0) == 2)


def _medium(at: _Listed, notes: list[str], own: Mapping[str, Medium]) -> Medium:
    """Medium of a line GLAS; numbers beside the name of a glass are placeholders."""
    assert at.glass is not None
    if at.glass.upper() == "___BLANK":
        return within(_named(at), lambda: model_glass(at.value("GLAS", at=3), at.value("GLAS", at=4)))
    return catalogue_glass(at.glass, _named(at), notes, own)


def _surface(
    at: _Listed,
    layout: Layout,
    before: Medium,
    scale: float,
    last: bool,
    notes: list[str],
    own: Mapping[str, Medium],
) -> tuple[Surface, Medium]:
    """A surface, and the medium behind it."""
    curvature, conic = at.value("CURV") / scale, at.value("CONI")
    coefficients = []
    if at.kind == "EVENASPH":
        square = at.parameter(1) / scale
        if square != 0 and curvature != 0:
            raise FormatError(
                "has a coefficient of r² beside its curvature, which is not supported", where=_named(at)
            )
        if square != 0:
            curvature, conic = 2 * square, -1.0  # a paraboloid
        coefficients = [at.parameter(k) / scale ** (2 * k - 1) for k in range(2, _COEFFICIENTS + 1)]
    kind: Literal["refracting", "mirror", "plain"]
    if at.glass is not None and at.glass.upper() == "MIRROR":
        kind, medium = "mirror", before
    elif last:
        kind, medium = "plain", before
    else:
        medium = AIR if at.glass is None else _medium(at, notes, own)
        kind = kind_behind(before, medium)
    found = Surface(
        curvature,
        conic,
        tuple(np.trim_zeros(coefficients, "b")),
        kind,
        medium,
        layout.vertex,
        layout.axes,
        within(_named(at), lambda: _apertures(at, scale)),
        _named(at),
    )
    return found, medium


def _apertures(at: _Listed, scale: float) -> tuple[Aperture, ...]:
    """Apertures of a surface; semi-diameters alone limit nothing."""
    found = []
    for key in _REFUSED:
        if key in at.lines:
            raise FormatError(f"has an aperture of the kind {key}, which is not supported")
    centre = scale * at.value("OBDC"), scale * at.value("OBDC", at=1) if "OBDC" in at.lines else 0.0
    for key in ("CLAP", "FLAP", "OBSC"):
        if key in at.lines:
            inner, outer = (scale * at.value(key, at=k) for k in (0, 1))
            found.append(Aperture("circle", (outer, inner), centre=centre, blocks=key == "OBSC"))
    for key in ("SQAP", "SQOB"):
        if key in at.lines:
            half = scale * at.value(key), scale * at.value(key, at=1)
            found.append(Aperture("rectangle", half, centre=centre, blocks=key == "SQOB"))
    return tuple(found)


def _break(at: _Listed, layout: Layout, key: str, scale: float) -> None:
    """Tilt and decentre stated with a surface itself, in front of it (SCBD 1) or behind it (SCBD 2)."""
    if key not in at.lines:
        return
    order, pickup, x, y, *tilt = (at.value(key, at=k) for k in range(7))
    if pickup != 0:
        raise FormatError("takes its tilt from elsewhere, which is not supported", where=_named(at))
    layout.turn((scale * x, scale * y), (tilt[0], tilt[1], tilt[2]), tilt_first=order != 0)
