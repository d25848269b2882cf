"""The NIST StRD problems of non-linear regression: reading the files, and their models with derivatives.

The files (https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml) hold data, two starts and certified
values of 11 digits. The models are written for any arithmetic numpy can carry, so that the same function
serves double precision and decimal numbers; derivatives are in double precision.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from reseau.adjust import Adjustment, GaussMarkov, Parameters

__all__ = ["DIGITS", "MISPRINTS", "MODELS", "NistProblem", "data_directory", "digits", "load", "names"]

DIGITS = 11  # of the certified values
# The file as it is handed around has its first digit wrong. The residual sum and all
# standard deviations certified beside it belong to the value as corrected here, and not to the one printed.
MISPRINTS = {("Roszman1", "1.20196866396E-0"): "0.20196866396E-0"}
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class NistProblem:
    """One file: the table as printed, starts (2, u), certified parameters and their sigmas (u,)."""

    name: str
    table: tuple[tuple[str, ...], ...]
    starts: np.ndarray
    certified: np.ndarray
    sigmas: np.ndarray
    residual_sum: float
    residual_sigma: float
    degrees: int
    stated: int
    misprinted: tuple[float, ...]

    def columns(self, number: Callable[[str], Any] = float) -> list[np.ndarray]:
        """Response, then predictors, each (n,), in the arithmetic of `number`."""
        kind = float if number is float else object
        if number is np.longdouble:
            kind = np.longdouble
        return [
            np.array([number(text) for text in column], dtype=kind)
            for column in zip(*self.table, strict=True)
        ]

    def problem(self, start: int, number: Callable[[str], Any] = float, analytic: bool = True) -> GaussMarkov:
        """The problem from start 0 or 1, with its observations in a given arithmetic."""
        model, slopes = MODELS[self.name]
        y, *x = self.columns(number)
        plain = self.columns()[1:]
        if self.name == "Nelson":
            y = np.log(y)
        names = tuple(f"b{i + 1}" for i in range(len(self.certified)))
        return GaussMarkov(
            lambda b: model(b, *x),
            y,
            None,
            Parameters(names, self.starts[start]),
            jacobian=(lambda b: np.stack(slopes(b, *plain), axis=1)) if analytic else None,
        )


def data_directory() -> Path:
    """Folder of the files: $RESEAU_DATA/nist_strd, or ../shared/data next to the checkout."""
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    return Path(os.environ.get("RESEAU_DATA", beside)) / "nist_strd"


def names() -> list[str]:
    """Problems whose files exist."""
    return sorted(path.stem for path in data_directory().glob("*.dat"))


def load(name: str) -> NistProblem:
    """Read one file."""
    lines = (data_directory() / f"{name}.dat").read_text(encoding="ascii").splitlines()
    rows = [_NUMBER.findall(line.split("=", 1)[1]) for line in lines if re.match(r"\s*b\d+\s*=", line)]
    misprinted = tuple(float(row[2]) for row in rows if (name, row[2]) in MISPRINTS)
    rows = [[MISPRINTS.get((name, text), text) for text in row] for row in rows]
    values = np.array([[float(text) for text in row] for row in rows])
    last = max(i for i, line in enumerate(lines) if line.startswith("Data:"))
    table = tuple(tuple(_NUMBER.findall(line)) for line in lines[last + 1 :] if line.strip())
    stated = {key: _after(lines, key) for key in _STATED}
    return NistProblem(
        name,
        table,
        starts=values[:, :2].T,
        certified=values[:, 2],
        sigmas=values[:, 3],
        residual_sum=stated["Residual Sum of Squares:"],
        residual_sigma=stated["Residual Standard Deviation:"],
        degrees=int(stated["Degrees of Freedom:"]),
        stated=int(stated["Number of Observations:"]),
        misprinted=misprinted,
    )


_STATED = (
    "Residual Sum of Squares:",
    "Residual Standard Deviation:",
    "Degrees of Freedom:",
    "Number of Observations:",
)


def _after(lines: Iterable[str], key: str) -> float:
    return next(float(line.split(":", 1)[1]) for line in lines if line.startswith(key))


def digits(estimate: Sequence[float], certified: Sequence[float]) -> np.ndarray:
    """Correct digits, −log₁₀ of the relative error, at most those that are certified."""
    error = np.abs(np.asarray(estimate, float) - certified) / np.abs(certified)
    return np.minimum(-np.log10(np.maximum(error, 1e-30)), DIGITS)


def digits_of(fit: Adjustment, problem: NistProblem) -> tuple[np.ndarray, np.ndarray]:
    """Correct digits of parameters and of standard deviations."""
    return digits(fit.values, problem.certified), digits(fit.sigma, problem.sigmas)


def _pi(b: Any) -> Any:
    return Decimal("3.141592653589793238462643383279") if b.dtype == object else np.pi


def _exp2(b, x):
    return np.exp(-b * x), -x * np.exp(-b * x)


def _misra1a(b, x):
    return b[0] * (1 - np.exp(-b[1] * x))


def _misra1a_d(b, x):
    e = np.exp(-b[1] * x)
    return 1 - e, b[0] * x * e


def _misra1b(b, x):
    return b[0] * (1 - 1 / (1 + b[1] * x / 2) ** 2)


def _misra1b_d(b, x):
    d = 1 + b[1] * x / 2
    return 1 - d**-2, b[0] * x * d**-3


def _misra1c(b, x):
    return b[0] * (1 - 1 / np.sqrt(1 + 2 * b[1] * x))


def _misra1c_d(b, x):
    d = 1 + 2 * b[1] * x
    return 1 - d**-0.5, b[0] * x * d**-1.5


def _misra1d(b, x):
    return b[0] * b[1] * x / (1 + b[1] * x)


def _misra1d_d(b, x):
    d = 1 + b[1] * x
    return b[1] * x / d, b[0] * x / d**2


def _chwirut(b, x):
    return np.exp(-b[0] * x) / (b[1] + b[2] * x)


def _chwirut_d(b, x):
    d = b[1] + b[2] * x
    f = np.exp(-b[0] * x) / d
    return -x * f, -f / d, -x * f / d


def _danwood(b, x):
    return b[0] * x ** b[1]


def _danwood_d(b, x):
    return x ** b[1], b[0] * np.log(x) * x ** b[1]


def _lanczos(b, x):
    return b[0] * np.exp(-b[1] * x) + b[2] * np.exp(-b[3] * x) + b[4] * np.exp(-b[5] * x)


def _lanczos_d(b, x):
    columns = []
    for i in (0, 2, 4):
        e = np.exp(-b[i + 1] * x)
        columns += [e, -b[i] * x * e]
    return columns


def _gauss(b, x):
    return (
        b[0] * np.exp(-b[1] * x)
        + b[2] * np.exp(-((x - b[3]) ** 2) / b[4] ** 2)
        + b[5] * np.exp(-((x - b[6]) ** 2) / b[7] ** 2)
    )


def _gauss_d(b, x):
    e = np.exp(-b[1] * x)
    columns = [e, -b[0] * x * e]
    for i in (2, 5):
        t = (x - b[i + 1]) / b[i + 2]
        g = np.exp(-(t**2))
        columns += [g, 2 * b[i] * g * t / b[i + 2], 2 * b[i] * g * t**2 / b[i + 2]]
    return columns


def _enso(b, x):
    two_pi = 2 * _pi(b)
    return (
        b[0]
        + b[1] * np.cos(two_pi * x / 12)
        + b[2] * np.sin(two_pi * x / 12)
        + b[4] * np.cos(two_pi * x / b[3])
        + b[5] * np.sin(two_pi * x / b[3])
        + b[7] * np.cos(two_pi * x / b[6])
        + b[8] * np.sin(two_pi * x / b[6])
    )


def _enso_d(b, x):
    year = 2 * np.pi * x / 12
    columns = [np.ones_like(x), np.cos(year), np.sin(year)]
    for i in (3, 6):
        t = 2 * np.pi * x / b[i]
        c, s = np.cos(t), np.sin(t)
        columns += [(b[i + 1] * s - b[i + 2] * c) * t / b[i], c, s]
    return columns


def _rational(b, x, top):
    """b₀ + b₁x + … over 1 + …, `top` coefficients above."""
    above = sum(b[i] * x**i for i in range(top))
    below = 1 + sum(b[top + i] * x ** (i + 1) for i in range(len(b) - top))
    return above, below


def _quotient(top):
    def model(b, x):
        above, below = _rational(b, x, top)
        return above / below

    def slopes(b, x):
        above, below = _rational(b, x, top)
        columns = [x**i / below for i in range(top)]
        return columns + [-above / below**2 * x ** (i + 1) for i in range(len(b) - top)]

    return model, slopes


def _mgh09(b, x):
    return b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3])


def _mgh09_d(b, x):
    d = x**2 + x * b[2] + b[3]
    f = b[0] * (x**2 + x * b[1]) / d
    return (x**2 + x * b[1]) / d, b[0] * x / d, -f * x / d, -f / d


def _mgh10(b, x):
    return b[0] * np.exp(b[1] / (x + b[2]))


def _mgh10_d(b, x):
    e = np.exp(b[1] / (x + b[2]))
    return e, b[0] * e / (x + b[2]), -b[0] * b[1] * e / (x + b[2]) ** 2


def _mgh17(b, x):
    return b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4])


def _mgh17_d(b, x):
    e, f = np.exp(-x * b[3]), np.exp(-x * b[4])
    return np.ones_like(x), e, f, -b[1] * x * e, -b[2] * x * f


def _rat42(b, x):
    return b[0] / (1 + np.exp(b[1] - b[2] * x))


def _rat42_d(b, x):
    e = np.exp(b[1] - b[2] * x)
    d = 1 + e
    return 1 / d, -b[0] * e / d**2, b[0] * x * e / d**2


def _rat43(b, x):
    return b[0] / (1 + np.exp(b[1] - b[2] * x)) ** (1 / b[3])


def _rat43_d(b, x):
    e = np.exp(b[1] - b[2] * x)
    d = 1 + e
    f = d ** (-1 / b[3])
    g = b[0] * f * e / d / b[3]
    return f, -g, x * g, b[0] * f * np.log(d) / b[3] ** 2


def _roszman(b, x):
    return b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / _pi(b)


def _roszman_d(b, x):
    d = (x - b[3]) ** 2 + b[2] ** 2
    return np.ones_like(x), -x, -(x - b[3]) / d / np.pi, -b[2] / d / np.pi


def _bennett(b, x):
    return b[0] * (b[1] + x) ** (-1 / b[2])


def _bennett_d(b, x):
    f = (b[1] + x) ** (-1 / b[2])
    return f, -b[0] * f / (b[1] + x) / b[2], b[0] * f * np.log(b[1] + x) / b[2] ** 2


def _eckerle(b, x):
    return b[0] / b[1] * np.exp(-((x - b[2]) ** 2) / b[1] ** 2 / 2)


def _eckerle_d(b, x):
    t = (x - b[2]) / b[1]
    g = np.exp(-(t**2) / 2) / b[1]
    return g, b[0] * g * (t**2 - 1) / b[1], b[0] * g * t / b[1]


def _nelson(b, x1, x2):
    return b[0] - b[1] * x1 * np.exp(-b[2] * x2)


def _nelson_d(b, x1, x2):
    e = np.exp(-b[2] * x2)
    return np.ones_like(x1), -x1 * e, b[1] * x1 * x2 * e


MODELS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "Bennett5": (_bennett, _bennett_d),
    "BoxBOD": (_misra1a, _misra1a_d),
    "Chwirut1": (_chwirut, _chwirut_d),
    "Chwirut2": (_chwirut, _chwirut_d),
    "DanWood": (_danwood, _danwood_d),
    "ENSO": (_enso, _enso_d),
    "Eckerle4": (_eckerle, _eckerle_d),
    "Gauss1": (_gauss, _gauss_d),
    "Gauss2": (_gauss, _gauss_d),
    "Gauss3": (_gauss, _gauss_d),
    "Hahn1": _quotient(4),
    "Kirby2": _quotient(3),
    "Lanczos1": (_lanczos, _lanczos_d),
    "Lanczos2": (_lanczos, _lanczos_d),
    "Lanczos3": (_lanczos, _lanczos_d),
    "MGH09": (_mgh09, _mgh09_d),
    "MGH10": (_mgh10, _mgh10_d),
    "MGH17": (_mgh17, _mgh17_d),
    "Misra1a": (_misra1a, _misra1a_d),
    "Misra1b": (_misra1b, _misra1b_d),
    "Misra1c": (_misra1c, _misra1c_d),
    "Misra1d": (_misra1d, _misra1d_d),
    "Nelson": (_nelson, _nelson_d),
    "Rat42": (_rat42, _rat42_d),
    "Rat43": (_rat43, _rat43_d),
    "Roszman1": (_roszman, _roszman_d),
    "Thurber": _quotient(4),
}
