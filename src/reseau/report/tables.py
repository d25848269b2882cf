"""Tables shared by the sections of a report: coefficients, tests, eliminations."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from markupsafe import Markup

from ..adjust import Adjustment
from ..adjust.elimination import Elimination
from ..core.data import Array, Mask
from ..core.numbers import aligned, grouped, power
from ..optics.field import SmoothField

Item = tuple[str, str, str]
"""A number in the summary of a page: number, unit, meaning."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Estimates:
    """Coefficients for a table.

    Parameters
    ----------
    value, sigma : mapping of str to float
        By name; a name without a value was dropped from the model.
    unit : mapping of str to str
        As in calibration files: ``mm^-2``, ``1``.
    """

    value: Mapping[str, float]
    sigma: Mapping[str, float]
    unit: Mapping[str, str]


def _root_mean_square(values: Array) -> Array:
    """Per axis of (n, 2); NaN for no point."""
    if not len(values):
        return np.full(2, np.nan)
    found: Array = np.sqrt((np.asarray(values) ** 2).mean(axis=0))
    return found


def rms(values: Array) -> float:
    """Root mean square length of vectors (n, 2); zero for none."""
    return float(np.hypot(*_root_mean_square(values))) if len(values) else 0.0


def rms_pair(values: Array) -> tuple[float, float]:
    """Root mean square per axis of (n, 2); zero for none."""
    if not len(values):
        return 0.0, 0.0
    x, y = _root_mean_square(values)
    return float(x), float(y)


def symbol(name: str) -> Markup:
    """Return the printed symbol of a coefficient.

    Examples
    --------
    >>> print(symbol("A6"), symbol("h'2"), symbol("k"))
    A<sub>6</sub> h′<sub>2</sub> k
    """
    match = re.fullmatch(r"([A-Za-z]+)('?)(\w*)", name)
    if match is None:
        return Markup("{}").format(name)
    letter, prime, index = match.groups()
    head = letter + prime.replace("'", "′")
    return Markup("{}<sub>{}</sub>").format(head, index) if index else Markup("{}").format(head)


def unit_markup(unit: str) -> Markup:
    """Return a unit with a raised exponent: mm^-3 as mm⁻³; empty for the unit 1."""
    base, _, exponent = unit.partition("^")
    if unit == "1":
        return Markup("")
    if not exponent:
        return Markup("{}").format(base)
    return Markup("{}<sup>{}</sup>").format(base, exponent.replace("-", "−"))


def unit_text(unit: str) -> str:
    """A unit with its exponent raised, as plain text.

    Examples
    --------
    >>> unit_text("mm^-2"), unit_text("px")
    ('mm⁻²', 'px')
    """
    base, _, exponent = unit.partition("^")
    return base + exponent.translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def probability(p: float) -> str:
    """Return a probability with three decimals, or an upper limit.

    Examples
    --------
    >>> probability(0.0312), probability(1e-9)
    ('0.031', '< 0.001')
    """
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def coefficient_rows(elimination: Elimination, estimates: Estimates) -> list[Row]:
    """Return all coefficients of the full model with their tests.

    The test of a coefficient is that of the step in which it was dropped, or of the last step for one kept.
    """
    tests = {test.name: test for test in elimination.kept}
    dropped = {step.name: step.test for step in elimination.steps}
    rows = []
    for name in elimination.full.names:
        test = tests.get(name) or dropped.get(name)
        known = name in estimates.value
        rows.append(
            {
                "name": symbol(name),
                "value": power(estimates.value[name], estimates.sigma[name]) if known else None,
                "unit": unit_markup(estimates.unit[name]) if known else "",
                "statistic": "" if test is None else grouped(test.statistic),
                "p": "" if test is None else probability(test.p),
                "verdict": "not tested" if test is None else "dropped" if name in dropped else "kept",
            }
        )
    return rows


class Measured(Protocol):
    """Marks or rods with the success of their measurement."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Names, (n,)."""

    @property
    def ok(self) -> Mask:
        """Which were measured, (n,)."""

    @property
    def why(self) -> tuple[str, ...]:
        """Why not, (n,)."""


def declined_rows(measured: Measured) -> list[tuple[str, str]]:
    """Return names of marks that were not measured, with the reasons."""
    return [
        (name, why) for name, why, ok in zip(measured.ids, measured.why, measured.ok, strict=True) if not ok
    ]


def step_rows(elimination: Elimination) -> list[Row]:
    """Return the dropped coefficients in the order of elimination."""
    return [
        {
            "name": symbol(step.name),
            "statistic": f"{step.test.statistic:.2f}",
            "critical": f"{step.test.critical:.2f}",
            "p": probability(step.test.p),
            "before": f"{step.sigma0_before:.3f}",
            "after": f"{step.sigma0_after:.3f}",
        }
        for step in elimination.steps
    ]


def model_tests(fit: Adjustment, alpha: float, local: SmoothField | None) -> Row:
    """Return the global test of an adjustment and the test for an additional local model."""
    globally = fit.global_test(alpha) if fit.redundancy > 0 else None
    need = None if local is None else [float(p) for p in np.atleast_1d(local.need)]
    return {
        "statistic": None if globally is None else f"{globally.statistic:.1f}",
        "redundancy": fit.redundancy,
        "lower": None if globally is None else f"{globally.lower:.1f}",
        "upper": None if globally is None else f"{globally.upper:.1f}",
        "p": None if globally is None else probability(globally.p),
        "passed": globally is not None and globally.passed,
        "sigma0": f"{fit.sigma0:.3f}",
        "scaled": fit.scale == "a-posteriori",
        "too_large": globally is not None and globally.statistic > globally.upper,
        "need": None if need is None else [probability(p) for p in need],
        "local": need is not None and min(need) < alpha,
    }


def axis_rows(
    stages: list[tuple[str, list[Array]]], decimals: int, *, largest: bool = False
) -> list[tuple[str, ...]]:
    """Return root mean squares of vectors per axis, one row for each stage, in columns of equal decimals.

    Parameters
    ----------
    stages : list of (name, list of ndarray (n, 2))
        Every stage has the same groups of vectors; an empty group gives a dash.
    decimals : int
        Number of decimals.
    largest : bool
        Add the largest magnitude of each group.
    """
    table = []
    for _, groups in stages:
        row: list[float] = []
        for group in groups:
            row += [float(value) for value in _root_mean_square(group)]
            if largest:
                row.append(float(np.abs(group).max()) if len(group) else np.nan)
        table.append(row)
    columns = [aligned(column, decimals) for column in zip(*table, strict=True)]
    return [(name, *cells) for (name, _), *cells in zip(stages, *columns, strict=True)]
