"""Lenses of CODE V: sequence files ``.seq``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ..core.errors import FormatError
from ..optics.lenses import AIR, Aperture, Medium, Prescription
from ..optics.lenses.media import Cauchy, model_glass
from ..optics.lenses.prescription import Layout, Surface
from .lines import read_bytes
from .prescribed import (
    MOST_MB,
    Opening,
    UnknownGlass,
    catalogue_glass,
    far,
    finite,
    glasses_beside,
    kind_behind,
    scale_of,
    schott,
    with_stop,
    within,
)

_UNITS = {"M": ("mm", 1.0), "C": ("cm", 10.0), "I": ("inches", 25.4)}
_LETTERS = "ABCDEFGHIJ"
"""Coefficients of r⁴ to r²²."""
_CODE = re.compile(r"(\d{3,})[.:](\d{3,})")
_INDEX_AND_ABBE = re.compile(r"([1-3]\.\d+):(\d+(?:\.\d*)?)")
_TERMS = 4
"""Terms of Cauchy's formula through the indices of a private glass."""
_INFINITE = {"INF": "1e13", "INFINITY": "1e13"}
"""Words for the distance by which CODE V stands for infinity."""
_OPENINGS: dict[str, Literal["diameter", "f-number", "object aperture"]] = {
    "EPD": "diameter",
    "FNO": "f-number",
    "NAO": "object aperture",
}
_NO_OPTICS = frozenset(
    "LEN TIT INI XAN YAN XIM YIM XOB YOB XRI YRI WTF GO DER POL CCY CUY THC GLC KC SLB PIM".split()  # noqa: SIM905
)
"""Commands that say nothing about rays: texts, fields, variables, solves whose result is in the file."""
_VIGNETTING = ("VUX", "VLX", "VUY", "VLY")


@dataclass
class _Listed:
    """A line SO, S or SI, and what is stated for its surface."""

    number: int
    shape: float
    thickness: float
    glass: str
    stop: bool = False
    conic: float = 0.0
    coefficients: dict[str, float] = field(default_factory=dict)
    apertures: list[Aperture] = field(default_factory=list)

    @property
    def name(self) -> str:
        return f"surface {self.number}"


def read_codev(path: Path | str) -> Prescription:
    """Read a lens from a sequence file of CODE V.

    Centred refracting spheres, conics and even aspheres. Mirrors, tilts and decentres are refused, and so is
    every command of a surface that is not known.

    Parameters
    ----------
    path : Path or str
        The file, ASCII or Latin-1.

    Returns
    -------
    Prescription
        Lengths in mm; its `notes` tell what is not as in the file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no lens, or has a surface or a glass that is not supported, which is named.

    Examples
    --------
    >>> import tempfile
    >>> text = "rdm; len; dim m; epd 10; wl 587.6; so 0 1e13; s 50 5 NBK7_SCHOTT; sto; s 0 93.4; si 0 0; go"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "lens.seq"
    ...     _ = path.write_text(text)
    ...     lens = read_codev(path)
    >>> lens.stop_radius, lens.indices(587.5618).round(4)
    (5.0, array([1.    , 1.5168, 1.    , 1.    ]))
    """
    path = Path(path)
    text = read_bytes(path, MOST_MB).decode("latin-1")
    return within(path, lambda: _lens(list(_commands(text)), path.stem, glasses_beside(path)))


def _commands(text: str) -> Iterator[tuple[str, list[str]]]:
    """Commands with their words, in capital letters except texts; without comments."""
    text = re.sub(r"&\s*\n", " ", re.sub(r"!.*", "", text))
    for line in re.split(r"[;\n]", re.sub(r"'[^'\n]*'|\"[^\"\n]*\"", _quoted, text)):
        words = line.split()
        if words:
            yield words[0].upper(), words[1:]


def _quoted(found: re.Match[str]) -> str:
    """Return a text as one word."""
    return found[0].replace(";", ",").replace(" ", "\xa0")


def _numbers(name: str, words: list[str], count: int = 1) -> list[float]:
    try:
        found = [finite(_INFINITE.get(word.upper(), word)) for word in words]
    except ValueError:
        found = []
    if len(found) < count:
        raise FormatError(f"`{name} {' '.join(words)}` is not understood")
    return found


def _lens(commands: list[tuple[str, list[str]]], stem: str, own: Mapping[str, Medium]) -> Prescription:
    listed, stated, private = _listed(commands)
    private = {**own, **private}
    if len(listed) < 3:
        raise FormatError("is not a lens of CODE V: it has no surfaces between SO and SI")
    notes: list[str] = []
    scale = scale_of(stated.get("DIM"), _UNITS, notes)
    if "TEM" in stated and _numbers("TEM", stated["TEM"])[0] != 20:
        notes.append(f"is meant for {stated['TEM'][0]} °C; indices are those at 20 °C")
    if any(any(_numbers(key, stated[key])) for key in _VIGNETTING if key in stated):
        notes.append("has vignetting factors, which are not used: apertures limit rays")
    radii = "RDM" in stated and stated["RDM"][:1] not in (["N"], ["n"])
    surfaces: list[Surface] = []
    layout, before = Layout(), _medium(listed[0], private, notes)
    medium = before
    for at in listed[1:]:
        surface, medium = _surface(at, layout, medium, radii, scale, private, notes, last=at is listed[-1])
        surfaces.append(surface)
        layout.advance(scale * at.thickness if at is not listed[-1] else 0.0)
    stop = next((k for k, at in enumerate(listed[1:]) if at.stop), None)
    if stop is None:
        notes.append("names no stop; CODE V takes the first surface")
    wavelengths = tuple(_numbers("WL", stated.get("WL", []), 0))
    reference = int(_numbers("REF", stated["REF"])[0]) - 1 if "REF" in stated else (len(wavelengths) - 1) // 2
    if "REF" not in stated and len(wavelengths) > 1:
        notes.append(
            f"names no reference wavelength; the middle one, {wavelengths[reference]:g} nm, is taken"
        )
    lens = Prescription(
        tuple(surfaces),
        stop or 0,
        wavelengths_nm=wavelengths,
        weights=tuple(_numbers("WTW", stated["WTW"])) if "WTW" in stated else (),
        reference=reference,
        before=before,
        name=" ".join(stated.get("TIT", [])).replace("\xa0", " ").strip("'\" ") or stem,
    )
    lens = with_stop(lens, _opening(stated, scale, far(scale * listed[0].thickness), notes))
    clear = [a.size[0] for a in lens.surfaces[lens.stop].apertures if a.shape == "circle" and not a.blocks]
    if clear and lens.stop_radius is not None and min(clear) < lens.stop_radius:
        notes.append(
            f"the aperture of its stop, {min(clear):g} mm, is smaller than its beam, {lens.stop_radius:g} mm"
        )
    return replace(lens, notes=tuple(dict.fromkeys(notes)))


def _listed(
    commands: list[tuple[str, list[str]]],
) -> tuple[list[_Listed], dict[str, list[str]], dict[str, Medium]]:
    """Surfaces, commands for the whole lens with their words, and private glasses."""
    listed: list[_Listed] = []
    stated: dict[str, list[str]] = {}
    private, lines = dict[str, Medium](), list[float]()
    whole = {"DIM", "RDM", "WL", "REF", "WTW", "TEM", *_OPENINGS, *_VIGNETTING}
    catalogue = ended = False
    for command, words in commands:
        key = command[:3]
        if command == "PRV":
            catalogue = True
        elif catalogue:
            catalogue = key != "END"
            if key == "PWL":
                lines = _numbers(command, words)
            elif command[0] in "'\"":
                name = command.strip("'\"")
                private[name] = _private(name, lines, words)
        elif command in ("SO", "S", "SI"):
            shape, thickness = _numbers(command, words[:2], 2)
            listed.append(
                _Listed(len(listed), shape, thickness, words[2].strip("'\"") if len(words) > 2 else "")
            )
            ended = command == "SI"
        elif key in whole:
            stated[key] = words
        elif key in _NO_OPTICS or (ended and command == "THI"):
            stated.setdefault(key, words)
        elif not listed:
            raise FormatError(f"the command {command} is not supported")
        elif not within(listed[-1].name, lambda: _of_surface(listed[-1], command, words)):  # noqa: B023
            raise FormatError(f"has {command}, which is not supported", where=listed[-1].name)
    return listed, stated, private


def _private(name: str, lines_nm: list[float], words: list[str]) -> Medium:
    """A glass of the file: Laurent's formula, or Cauchy's through its indices at some wavelengths."""
    if words and words[0].isalpha():
        if words[0].upper() != "LAU":
            return UnknownGlass(name, words[0], ("LAU", "indices"))
        return schott(_numbers(name, words[1:], 6), name, None)
    indices = _numbers(name, words)
    if not lines_nm or len(indices) != len(lines_nm):
        raise FormatError(
            f"the private glass {name} has {len(indices)} indices for {len(lines_nm)} wavelengths (PWL)"
        )
    terms = min(len(lines_nm), _TERMS)
    columns = np.power.outer(1e6 / np.array(lines_nm) ** 2, np.arange(terms))
    found = np.linalg.lstsq(columns, np.array(indices), rcond=None)[0]
    return Cauchy(tuple(found.tolist()), name, (min(lines_nm), max(lines_nm)) if terms > 1 else None)


def _of_surface(at: _Listed, command: str, words: list[str]) -> bool:
    """Take what a command states for a surface; whether it is supported."""
    if command[:3] == "STO":
        at.stop = True
    elif command in ("ASP", "CON", "SPH"):
        pass
    elif command == "K":
        at.conic = _numbers(command, words)[0]
    elif command in _LETTERS:
        at.coefficients[command] = _numbers(command, words)[0]
    elif command == "CUF":
        return _numbers(command, words)[0] == 0
    elif command == "CIR":
        qualifier = words[0].upper() if len(words) > 1 else "CLR"
        if qualifier not in ("CLR", "OBS", "EDG"):
            return False
        if qualifier != "EDG":  # the rim of the glass, which limits no rays
            radius = _numbers(command, words[-1:])[0]
            at.apertures.append(Aperture("circle", (radius, 0.0), blocks=qualifier == "OBS"))
    else:
        return False
    return True


def _opening(stated: dict[str, list[str]], scale: float, distance: float, notes: list[str]) -> Opening:
    key = next((key for key in _OPENINGS if key in stated), None)
    if key is None:
        raise FormatError("does not state the width of its beam (EPD, FNO or NAO)")
    value = _numbers(key, stated[key])[0]
    if key == "FNO" and np.isfinite(distance):
        notes.append(f"its f-number of {value:g} is taken as that for objects at infinity")
    return Opening(_OPENINGS[key], scale * value if key == "EPD" else value, distance)


def _medium(at: _Listed, private: Mapping[str, Medium], notes: list[str]) -> Medium:
    name = at.glass
    if name.upper() in ("", "AIR"):
        return AIR
    code, plain = _CODE.fullmatch(name), _INDEX_AND_ABBE.fullmatch(name)
    if plain is not None:
        index, abbe = float(plain[1]), float(plain[2])
    elif code is not None:
        # 517.642: the decimals of the index, and the Abbe number with two digits in front of its point.
        index, abbe = 1 + float(f"0.{code[1]}"), float(f"{code[2][:2]}.{code[2][2:]}")
    else:
        return catalogue_glass(name, at.name, notes, private)
    notes.append(
        f"the glass {name} of {at.name} is known by its index {index:g} and Abbe number {abbe:g} only"
    )
    return within(at.name, lambda: model_glass(index, abbe, name))


def _surface(
    at: _Listed,
    layout: Layout,
    before: Medium,
    radii: bool,
    scale: float,
    private: Mapping[str, Medium],
    notes: list[str],
    *,
    last: bool,
) -> tuple[Surface, Medium]:
    """A surface, and the medium behind it."""
    if at.glass.upper() == "REFL":
        raise FormatError("is a mirror (REFL), which is not supported", where=at.name)
    curvature = at.shape if not radii else (1 / at.shape if at.shape else 0.0)
    form = [at.coefficients.get(letter, 0.0) / scale ** (2 * k + 3) for k, letter in enumerate(_LETTERS)]
    medium = before if last else _medium(at, private, notes)
    apertures = tuple(replace(a, size=(scale * a.size[0], 0.0)) for a in at.apertures)
    found = Surface(
        curvature / scale,
        at.conic,
        tuple(np.trim_zeros(form, "b")),
        kind_behind(before, medium),
        medium,
        layout.vertex,
        layout.axes,
        apertures,
        at.name,
    )
    return found, medium
