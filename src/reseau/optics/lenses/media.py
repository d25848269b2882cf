"""Refractive indices of glasses, water and air as functions of the wavelength.

All indices are relative to air at 20 °C and 1013.25 hPa, as in the catalogues of the makers; the air around a
lens has the index 1. Wavelengths are those in air, nanometres.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Protocol

import numpy as np

from ...core.errors import UsageError

_LINES = {"F": 486.1327, "d": 587.5618, "C": 656.2725}
"""Fraunhofer lines (nm) that define index and Abbe number of a glass."""


class Medium(Protocol):
    """A transparent medium.

    Examples
    --------
    >>> medium: Medium = Constant(1.5)
    >>> medium.index(550.0)
    1.5
    """

    @property
    def name(self) -> str:
        """Name in messages."""

    def index(self, wavelength_nm: float) -> float:
        """Refractive index relative to air at a wavelength."""


@dataclass(frozen=True)
class Constant:
    """A medium of the same index at all wavelengths.

    Examples
    --------
    >>> Constant(1.333).index(600.0)
    1.333
    """

    n: float
    name: str = ""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.n) and 0.5 < self.n < 10):
            raise UsageError(f"{self.n} is not a refractive index", where=self.name or None)

    def index(self, wavelength_nm: float) -> float:
        """See :class:`Medium`."""
        _checked(wavelength_nm, None, self.name)
        return self.n


AIR = Constant(1.0, "air")
"""Air at 20 °C and 1013.25 hPa, to which all indices are relative."""


@dataclass(frozen=True)
class Cauchy:
    """n = A + B/λ² + C/λ⁴ …, λ in µm.

    Examples
    --------
    >>> round(Cauchy((1.5046, 0.0042)).index(587.5618), 5)
    1.51677
    """

    coefficients: tuple[float, ...]
    name: str = ""
    range_nm: tuple[float, float] | None = None

    def index(self, wavelength_nm: float) -> float:
        """See :class:`Medium`."""
        w = _checked(wavelength_nm, self.range_nm, self.name)
        return float(sum(a / w ** (2 * k) for k, a in enumerate(self.coefficients)))


@dataclass(frozen=True)
class Sellmeier:
    """n² = 1 + Σ B λ² / (λ² − C), λ in µm (Sellmeier 1871; the form of the makers' catalogues).

    Examples
    --------
    >>> b, c = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    >>> round(Sellmeier(b, c, "N-BK7").index(587.5618), 5)
    1.5168
    """

    b: tuple[float, ...]
    c: tuple[float, ...]
    name: str = ""
    range_nm: tuple[float, float] | None = None

    def index(self, wavelength_nm: float) -> float:
        """See :class:`Medium`."""
        w = _checked(wavelength_nm, self.range_nm, self.name) ** 2
        return _root(1 + sum(b * w / (w - c) for b, c in zip(self.b, self.c, strict=True)), self.name)


@dataclass(frozen=True)
class Powers:
    """n² = a₀ + Σ a λᵖ, λ in µm (the form of Schott's older catalogues, Hoya and Sumita).

    Examples
    --------
    >>> round(Powers(2.25, ((0.01, -2.0),)).index(500.0), 4)
    1.5133
    """

    constant: float
    terms: tuple[tuple[float, float], ...]
    name: str = ""
    range_nm: tuple[float, float] | None = None

    def index(self, wavelength_nm: float) -> float:
        """See :class:`Medium`."""
        w = _checked(wavelength_nm, self.range_nm, self.name)
        return _root(self.constant + sum(a * w**p for a, p in self.terms), self.name)


@dataclass(frozen=True)
class Water:
    """Fresh water and sea water, 400 to 700 nm, 0 to 30 °C, salinity to 35 g/kg.

    Source: Quan and Fry 1995, Applied Optics 34, 3477, equation 3; accurate to 3e-5.

    Examples
    --------
    >>> round(Water().index(589.3), 4), round(Water(salinity=35.0).index(589.3), 4)
    (1.333, 1.3394)
    """

    temperature_c: float = 20.0
    salinity: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.temperature_c <= 30 and 0 <= self.salinity <= 35):
            raise UsageError(
                f"water of {self.temperature_c:g} °C and a salinity of {self.salinity:g} g/kg is outside the "
                "formula: 0 to 30 °C, 0 to 35 g/kg"
            )

    @property
    def name(self) -> str:
        """See :class:`Medium`."""
        return "water"

    def index(self, wavelength_nm: float) -> float:
        """See :class:`Medium`."""
        w = 1e3 * _checked(wavelength_nm, (400.0, 700.0), self.name)
        t, s = self.temperature_c, self.salinity
        return (
            1.31405
            + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2) * s
            - 2.02e-6 * t**2
            + (15.868 + 0.01155 * s - 0.00423 * t) / w
            - 4382 / w**2
            + 1.1455e6 / w**3
        )


@dataclass(frozen=True)
class Air:
    """Dry air of another temperature and pressure than the reference; see :data:`AIR`.

    Source: Birch and Downs 1993, Metrologia 30, 155, equations 1 to 3 (modified Edlén equation).

    Examples
    --------
    >>> f"{Air(20.0, 800.0).index(550.0) - 1:.2e}"
    '-5.75e-05'
    """

    temperature_c: float = 20.0
    pressure_hpa: float = 1013.25

    def __post_init__(self) -> None:
        if not (-60 <= self.temperature_c <= 100 and 0 <= self.pressure_hpa <= 2000):
            raise UsageError(
                f"air of {self.temperature_c:g} °C and {self.pressure_hpa:g} hPa is outside the formula: "
                "-60 to 100 °C, 0 to 2000 hPa"
            )

    @property
    def name(self) -> str:
        """See :class:`Medium`."""
        return "air"

    def index(self, wavelength_nm: float) -> float:
        """See :class:`Medium`."""
        w = _checked(wavelength_nm, (300.0, 1700.0), self.name)
        here, reference = (
            _refractivity(w, t, 100 * p)
            for t, p in ((self.temperature_c, self.pressure_hpa), (20.0, 1013.25))
        )
        return (1 + here) / (1 + reference)


def _refractivity(wavelength_um: float, temperature_c: float, pressure_pa: float) -> float:
    """Return n − 1 of dry air relative to vacuum."""
    s = 1 / wavelength_um**2
    standard = 1e-8 * (8342.54 + 2406147 / (130 - s) + 15998 / (38.9 - s))
    density = 1 + 1e-8 * (0.601 - 0.00972 * temperature_c) * pressure_pa
    return pressure_pa * standard * density / (96095.43 * (1 + 0.003661 * temperature_c))


def model_glass(n_d: float, abbe: float, name: str = "") -> Cauchy:
    """Glass of which only the index at 587.56 nm and the Abbe number are known.

    Cauchy's formula with two terms, which has that index and, between 486.13 and 656.27 nm, that dispersion.
    Between these lines it differs from a real glass by some 1e-4, outside by more.

    Examples
    --------
    >>> glass = model_glass(1.5168, 64.17)
    >>> n_f, n_d, n_c = (glass.index(w) for w in (486.1327, 587.5618, 656.2725))
    >>> round(n_d, 4), round((n_d - 1) / (n_f - n_c), 2)
    (1.5168, 64.17)
    """
    if not (1 < n_d < 4 and abbe > 0):
        raise UsageError(f"n = {n_d:g} with an Abbe number of {abbe:g} is no glass", where=name or None)
    f, d, c = (1e6 / w**2 for w in _LINES.values())
    b = (n_d - 1) / abbe / (f - c)
    return Cauchy((n_d - b * d, b), name)


def glass(name: str) -> Medium:
    """Glass of the catalogue by its name, in any usual spelling: N-BK7, NBK7, NBK7_SCHOTT.

    Raises
    ------
    UsageError
        When the catalogue does not contain it.

    Examples
    --------
    >>> round(glass("NBK7_SCHOTT").index(587.5618), 5)
    1.5168
    """
    key = name.upper().replace("-", "")
    found, maker = _catalogue().get(key), ""
    if found is None:
        key, _, maker = key.rpartition("_")
        found = _catalogue().get(key)
    if found is None or (maker and found[0] and maker != found[0]):
        raise UsageError(
            f"the glass {name} is not in the catalogue",
            do="give its dispersion: an index, or coefficients of Cauchy or Sellmeier",
        )
    return found[1]


def glass_names() -> list[str]:
    """Names of the glasses in the catalogue.

    Examples
    --------
    >>> "N-BK7" in glass_names()
    True
    """
    return [medium.name for _, medium in _catalogue().values()]


@cache
def _catalogue() -> dict[str, tuple[str, Medium]]:
    """Maker and dispersion of every glass, by name without hyphens."""
    text = files(__package__).joinpath("glasses.csv").read_text("utf-8")
    found: dict[str, tuple[str, Medium]] = {}
    form: dict[str, Callable[..., Medium]] = {"sellmeier": _sellmeier, "powers": _powers}
    for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#")):
        values = [float(value) for value in row["coefficients"].split()]
        limits = float(row["from_nm"]), float(row["to_nm"])
        found[row["name"].replace("-", "")] = row["maker"], form[row["formula"]](values, row["name"], limits)
    return found | {"BK7": found["NBK7"]}  # the same coefficients


def _sellmeier(values: list[float], name: str, limits: tuple[float, float]) -> Medium:
    return Sellmeier(tuple(values[::2]), tuple(values[1::2]), name, limits)


def _powers(values: list[float], name: str, limits: tuple[float, float]) -> Medium:
    return Powers(values[0], tuple(zip(values[1::2], values[2::2], strict=True)), name, limits)


def _checked(wavelength_nm: float, limits: tuple[float, float] | None, name: str) -> float:
    """Return the wavelength in µm, checked against the range of a formula."""
    if not 1 <= wavelength_nm <= 1e6:
        raise UsageError(f"{wavelength_nm} nm is not a wavelength")
    if limits is not None and not limits[0] <= wavelength_nm <= limits[1]:
        raise UsageError(
            f"the index at {wavelength_nm:g} nm is not known: the formula holds from {limits[0]:g} to "
            f"{limits[1]:g} nm",
            where=name or None,
        )
    return wavelength_nm / 1e3


def _root(square: float, name: str) -> float:
    if square <= 0:
        raise UsageError("its coefficients give no index at this wavelength", where=name or None)
    return float(np.sqrt(square))
