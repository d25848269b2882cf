"""Calibrations as a function of covariates such as temperature, zoom or focus.

The parameters of K calibrations are regressed on the covariates, all with one design: β̂ = (ZᵀZ)⁻¹ Zᵀ Y has
the covariance S ⊗ (ZᵀZ)⁻¹ (Anderson 2003, *Multivariate Statistical Analysis*, ch. 8). S is that of one
calibration about the function, reproducibility between sessions included. A function is returned only if the
data support it.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import scipy
from pydantic import Field

from ..calibration import Calibration
from ..calibration.document import Covariance, Quantity
from ..core.data import Array
from ..core.errors import FormatError, UsageError
from ..core.failure import Code, Failure
from ..io import Document, Strict, read_text
from .charts import ChartOptions, Monitored, monitor

_OF_IMAGE = ("extent", "unit", "size")
"""What the validity of a single calibration says about the image, and not about its adjustment."""


@dataclass(frozen=True)
class FunctionOptions:
    """Options of :func:`fit_function`.

    Parameters
    ----------
    degree : {1, 2}
        Degree of the polynomial in each covariate.
    alpha : float
        Level of the tests of the function and of its lack of fit, over all parameters together.

    Examples
    --------
    >>> FunctionOptions().degree
    1
    """

    degree: Literal[1, 2] = 1
    alpha: float = 0.01


class Covariate(Strict):
    """A covariate and where it was observed: the function is not extrapolated.

    Examples
    --------
    >>> Covariate(name="temperature", unit="°C", low=18.0, high=26.0, centre=21.5).scaled(23.5)
    0.5
    """

    name: str
    unit: str
    low: float
    high: float
    centre: float

    def scaled(self, value: float) -> float:
        """Return the difference from the centre, in half ranges."""
        return (value - self.centre) / ((self.high - self.low) / 2)


class CalibrationFunction(Document):
    """A calibration as a function of covariates, ``reseau-calibration-function/1``.

    `coefficients` has a row for each term (constant, then the powers of each scaled covariate) and a column
    for each name; their covariance is the Kronecker product of `scatter` and `cofactors`. `p` is the
    probability of a relation at least as strong by chance.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> warm = np.linspace(18.0, 26.0, 30)
    >>> runs = [example_calibration(8.0 + 0.001 * (t - 22) + 2e-4 * rng.normal()) for t in warm]
    >>> found = fit_function(runs, {"temperature": warm}, {"temperature": "°C"})
    >>> found.at(temperature=25.0).parameters["c"]
    Quantity(value=8.0029..., sigma=0.00017..., unit='mm')
    """

    SCHEMA: ClassVar[str] = "reseau-calibration-function/1"

    base: dict[str, Any]
    names: tuple[str, ...]
    covariates: tuple[Covariate, ...]
    degree: Annotated[int, Field(ge=1, le=2)]
    runs: int
    coefficients: tuple[tuple[float, ...], ...]
    cofactors: tuple[tuple[float, ...], ...]
    scatter: tuple[tuple[float, ...], ...]
    p: float

    def at(self, sigmas: Mapping[str, float] | None = None, /, **values: float) -> Calibration:
        """Return the calibration at a value of each covariate.

        Its covariance is that of a single calibration at these values: of the coefficients, between sessions,
        and of the covariates. The last is also kept by itself (`covariates` of the validity), for budgets.

        Parameters
        ----------
        sigmas : mapping of str to float, optional
            Standard uncertainties of the values; by default they are known.
        **values : float
            Value of each covariate.

        Raises
        ------
        UsageError
            If a covariate is missing or unknown, a value is outside its range, or a sigma is negative.
        """
        sigmas = sigmas or {}
        names = [each.name for each in self.covariates]
        if set(values) != set(names):
            raise UsageError(
                f"needs {', '.join(names)}, not {', '.join(values) or 'none'}", where="calibration function"
            )
        for name, sigma in sigmas.items():
            if name not in names or not 0 <= sigma < np.inf:
                raise UsageError(f"{sigma:g} of {name} is no standard uncertainty", where="covariates")
        for each in self.covariates:
            value = values[each.name]
            if not each.low <= value <= each.high:
                raise UsageError(
                    f"{value:g} {each.unit} is outside {each.low:g} to {each.high:g} {each.unit}",
                    where=each.name, do="calibrate there",
                )  # fmt: skip
        scaled = np.array([[each.scaled(values[each.name]) for each in self.covariates]])
        row = _terms(scaled, self.degree)[0]
        estimate = row @ np.array(self.coefficients)
        cov = np.array(self.scatter) * (1.0 + row @ np.array(self.cofactors) @ row)
        effects = self._effects(scaled[0])
        for each, effect in zip(self.covariates, effects, strict=True):
            cov = cov + sigmas.get(each.name, 0.0) ** 2 * np.outer(effect, effect)
        base = Calibration.from_content(dict(self.base), where="calibration function")
        parameters = dict(base.parameters)
        for k, name in enumerate(self.names):
            sigma = float(np.sqrt(cov[k, k]))
            parameters[name] = Quantity(value=float(estimate[k]), sigma=sigma, unit=parameters[name].unit)
        return base.model_copy(
            update={
                "parameters": parameters,
                "covariance": Covariance(names=self.names, matrix=tuple(tuple(row) for row in cov.tolist())),
                "sigma0": None, "redundancy": self.runs - len(row), "tests": (), "times": {},
                "assessment": None,
                "validity": {key: base.validity[key] for key in _OF_IMAGE if key in base.validity} | {
                    "covariates": {
                        each.name: {
                            "value": float(values[each.name]), "sigma": float(sigmas.get(each.name, 0.0)),
                            "unit": each.unit, "effect": effect.tolist(),
                        }
                        for each, effect in zip(self.covariates, effects, strict=True)
                    }
                },
            }
        )  # fmt: skip

    def _effects(self, scaled: Array) -> Array:
        """Derivatives of the parameters by each covariate (q, c)."""
        q, coefficients = len(self.covariates), np.array(self.coefficients)
        half = np.array([(each.high - each.low) / 2 for each in self.covariates])
        powers = [coefficients[1 + k * q : 1 + (k + 1) * q] for k in range(self.degree)]
        slopes = [(k + 1) * scaled[:, None] ** k * each for k, each in enumerate(powers)]
        found: Array = np.sum(slopes, axis=0) / half[:, None]
        return found


@dataclass(frozen=True)
class CovariateTable:
    """Covariates of calibrations, such as their temperatures.

    Parameters
    ----------
    keys : tuple of str (n,)
        Starts of the keys of the decisions on them.
    values : mapping of str to ndarray (n,)
        Values of each covariate.
    units : mapping of str to str
        Their units.

    Examples
    --------
    >>> table = CovariateTable(("4f2a", "77b0"), {"temperature": np.array([20.1, 21.4])}, {})
    >>> table.of("77b01c")
    {'temperature': 21.4}
    """

    keys: tuple[str, ...]
    values: Mapping[str, Array]
    units: Mapping[str, str]

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a table with the columns ``calibration`` and, for example, ``temperature [°C]``.

        Raises
        ------
        FormatError
            If it is not one.
        """
        rows = [row for row in csv.reader(read_text(Path(path)).splitlines()) if any(row)]
        head = [re.fullmatch(r"\s*(\w+)\s*\[([^\]]+)\]\s*", each) for each in rows[0][1:]] if rows else []
        if not head or rows[0][0].strip() != "calibration" or not all(head):
            do = "begin with a line such as: calibration,temperature [°C]"
            raise FormatError("is not a table of covariates", where=path, do=do)
        named = [(each[1], each[2]) for each in head if each is not None]
        values = np.full((len(rows) - 1, len(named)), np.nan)
        for k, row in enumerate(rows[1:]):
            try:
                values[k] = [float(each) for each in row[1:]]
            except ValueError:
                raise FormatError("has no number for each covariate", where=f"{path}: line {k + 2}") from None
        keys = tuple(row[0].strip() for row in rows[1:])
        columns = {name: column for (name, _), column in zip(named, values.T, strict=True)}
        return cls(keys, columns, dict(named))

    @classmethod
    def recorded(cls, keys: Sequence[str], calibrations: Sequence[Calibration], names: Sequence[str]) -> Self:
        """Take covariates from what sensors measured while the calibrations were recorded.

        Parameters
        ----------
        keys : sequence of str (n,)
            Keys of the decisions on the calibrations.
        calibrations : sequence of Calibration (n,)
            Their provenance has the conditions of their frames; the means are used.
        names : sequence of str
            Conditions, as ``air.temperature``; ``temperature`` where one sensor measures it.

        Raises
        ------
        UsageError
            If a calibration has no such condition, several, or one in another unit than the others.

        Examples
        --------
        >>> around = {"air.temperature": {"mean": 21.5, "low": 21.4, "high": 21.6, "unit": "°C", "frames": 9}}
        >>> known = example_calibration().model_copy(update={"provenance": {"environment": around}})
        >>> CovariateTable.recorded(["4f2a"], [known], ["temperature"]).of("4f2a")
        {'temperature': 21.5}
        """
        columns, units = {}, {}
        for name in names:
            found = [_recorded(key, each, name) for key, each in zip(keys, calibrations, strict=True)]
            of_all = {unit for _, unit in found}
            if len(of_all) > 1:
                raise UsageError(f"has the units {', '.join(sorted(of_all))}", where=name)
            columns[name] = np.array([value for value, _ in found])
            units[name] = next(iter(of_all), "")
        return cls(tuple(keys), columns, units)

    def of(self, key: str) -> dict[str, float]:
        """Values of the calibration with this key.

        Raises
        ------
        UsageError
            If there are none, or several.
        """
        rows = [k for k, each in enumerate(self.keys) if each and key.startswith(each)]
        if len(rows) != 1 or not all(np.isfinite(each[rows[0]]) for each in self.values.values()):
            raise UsageError(f"has {len(rows) or 'no'} lines with it", where=f"covariates: calibration {key}")
        return {name: float(each[rows[0]]) for name, each in self.values.items()}


def conditions_of(calibrations: Sequence[Calibration]) -> dict[str, str]:
    """Units of the conditions that sensors measured with every one of several calibrations, by their names.

    Examples
    --------
    >>> around = {"air.temperature": {"mean": 21.5, "low": 21.4, "high": 21.6, "unit": "°C", "frames": 9}}
    >>> known = example_calibration().model_copy(update={"provenance": {"environment": around}})
    >>> conditions_of([known, known]), conditions_of([known, example_calibration()])
    ({'air.temperature': '°C'}, {})
    """
    found = [
        {name: str(each["unit"]) for name, each in one.provenance.get("environment", {}).items()}
        for one in calibrations
    ]
    first = found[0] if found else {}
    return {name: unit for name, unit in first.items() if all(one.get(name) == unit for one in found)}


def _recorded(key: str, calibration: Calibration, name: str) -> tuple[float, str]:
    """Mean and unit of a condition in the provenance of a calibration."""
    around: Mapping[str, Any] = calibration.provenance.get("environment", {})
    fitting = [each for each in around if each == name or each.endswith(f".{name}")]
    if len(fitting) != 1:
        what = f"recorded {', '.join(fitting) or 'nothing'} as {name}"
        known = ", ".join(around)
        do = f"choose from {known}" if known else "state it in a table: --covariates"
        raise UsageError(what, where=f"calibration {key}", do=do)
    return float(around[fitting[0]]["mean"]), str(around[fitting[0]]["unit"])


def series_of(calibrations: Sequence[Calibration]) -> tuple[tuple[str, ...], Array]:
    """Names and values (runs, c) of the parameters that all calibrations estimated.

    Raises
    ------
    UsageError
        If there are none, or the calibrations are of different kinds, models or units.

    Examples
    --------
    >>> series_of([example_calibration(8.0), example_calibration(8.1)])
    (('c',), array([[8. ],
           [8.1]]))
    """
    if not calibrations:
        raise UsageError("none were given", where="calibrations")
    first = calibrations[0]
    for other in calibrations[1:]:
        if (other.kind, _model(other)) != (first.kind, _model(first)):
            raise UsageError(
                "are of different models", where=f"{first.name}, {other.name}", do="convert them first"
            )
    names = tuple(
        n for n in first.covariance.names if all(n in each.covariance.names for each in calibrations)
    )
    if not names:
        raise UsageError("have no estimated parameter in common", where="calibrations")
    for name in names:
        units = {each.parameters[name].unit for each in calibrations}
        if len(units) > 1:
            raise UsageError(f"has the units {', '.join(sorted(units))}", where=name)
    return names, np.array([[each.parameters[name].value for name in names] for each in calibrations])


def fit_function(
    calibrations: Sequence[Calibration],
    covariates: Mapping[str, Array],
    units: Mapping[str, str],
    options: FunctionOptions | None = None,
) -> CalibrationFunction | Failure:
    """Fit a calibration as a function of covariates, if the data support it.

    Parameters
    ----------
    calibrations : sequence of Calibration
        Of one camera and model, in time order.
    covariates : mapping of str to ndarray (runs,)
        Values of each covariate.
    units : mapping of str to str
        Their units.
    options : FunctionOptions, optional
        Degree and level of the tests.

    Returns
    -------
    CalibrationFunction or Failure
        A failure if there are too few runs, a covariate did not vary, no parameter depends on the
        covariates, or the polynomial does not describe how.

    Raises
    ------
    UsageError
        If the calibrations cannot be compared, or the lengths differ.

    Examples
    --------
    >>> runs = [example_calibration(8.0 + 1e-4 * (k % 3)) for k in range(12)]
    >>> fit_function(runs, {"temperature": np.linspace(18, 26, 12)}, {"temperature": "°C"}).code
    <Code.NOT_IDENTIFIED: 'not-identified'>
    """
    options = options or FunctionOptions()
    names, y = series_of(calibrations)
    values = _columns(covariates, len(y))
    n, terms = len(y), 1 + options.degree * values.shape[1]
    if n < terms + 5:
        return Failure(
            f"{n} runs are too few for {terms} coefficients; {terms + 5} are needed", Code.NO_REDUNDANCY
        )
    if not (np.ptp(values, axis=0) > 0).all():
        constant = list(covariates)[int(np.argmin(np.ptp(values, axis=0)))]
        return Failure(f"{constant} did not vary", Code.NOT_IDENTIFIED)
    known = tuple(
        Covariate(
            name=name, unit=units[name], low=float(v.min()), high=float(v.max()), centre=float(v.mean())
        )
        for name, v in zip(covariates, values.T, strict=True)
    )
    scaled = np.column_stack(
        [(v - c.centre) / ((c.high - c.low) / 2) for v, c in zip(values.T, known, strict=True)]
    )
    z = _terms(scaled, options.degree)
    if np.linalg.matrix_rank(z) < terms:
        return Failure("the covariates depend on each other linearly", Code.NOT_IDENTIFIED)
    further = _terms(scaled, options.degree + 1)
    if n >= further.shape[1] + 5 and (lack := _p_value(y, further, z)) < options.alpha:
        word = "line" if options.degree == 1 else "parabola"
        return Failure(f"a {word} does not describe the relation (p = {lack:.2g})", Code.UNMODELLED)
    p = _p_value(y, z, np.ones((n, 1)))
    if not p < options.alpha:
        return Failure(f"no parameter depends on {', '.join(covariates)} (p = {p:.2g})", Code.NOT_IDENTIFIED)
    beta, residuals = _regressed(y, z)
    cofactors = np.asarray(np.linalg.inv(z.T @ z), dtype=np.float64)
    scatter = _scatter(residuals, z.shape[1], [_within(each, names) for each in calibrations])
    return CalibrationFunction(
        base=calibrations[-1].to_dict() | {"times": {}}, names=names, covariates=known,
        degree=options.degree, runs=n,
        coefficients=_rows(beta), cofactors=_rows(cofactors), scatter=_rows(scatter), p=p,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Explanation:
    """Signals of charts with and without covariates.

    Parameters
    ----------
    raw, adjusted : Monitored
        Charts without and with the covariates as predictors.
    p : float
        Probability of a dependence on the covariates at least as strong by chance, over all series.
    verdicts : tuple of (int, int, {"drift", "explained"})
        Run and series of each signal, in time order. A signal that the covariates remove is explained by
        them.

    Examples
    --------
    >>> Explanation(monitor(np.zeros((3, 1))), monitor(np.zeros((3, 1))), 1.0, ()).verdicts
    ()
    """

    raw: Monitored
    adjusted: Monitored
    p: float
    verdicts: tuple[tuple[int, int, Literal["drift", "explained"]], ...]


def explain(
    values: Array,
    covariates: Array,
    options: ChartOptions | None = None,
    *,
    one_sided: tuple[int, ...] = (),
    alpha: float = 0.01,
) -> Explanation:
    """Tell drift that covariates explain from drift.

    Parameters
    ----------
    values : ndarray (n, c)
        Series over the runs of one bench.
    covariates : ndarray (n, q)
        Covariates of each run.
    options, one_sided
        As for :func:`reseau.service.charts.monitor`.
    alpha : float
        Level at which a dependence on the covariates must be significant; otherwise nothing is explained by
        them.

    Examples
    --------
    >>> rng = np.random.default_rng(3)
    >>> warm = np.where(np.arange(80) < 40, 20.0, 23.0) + rng.normal(0.0, 0.8, 80)
    >>> values = 1.5 * warm[:, None] + rng.normal(size=(80, 1))
    >>> set(found[2] for found in explain(values, warm[:, None]).verdicts)
    {'explained'}
    """
    raw = monitor(values, options, one_sided=one_sided)
    adjusted = monitor(values, options, one_sided=one_sided, covariates=covariates)
    there = np.isfinite(values).all(axis=1)
    y, z = values[there], np.column_stack([np.ones(there.sum()), covariates[there]])
    enough = len(y) >= z.shape[1] + 5 and np.linalg.matrix_rank(z) == z.shape[1]
    p = _p_value(y, z, np.ones((len(y), 1))) if enough else 1.0
    known = p < alpha
    verdicts: list[tuple[int, int, Literal["drift", "explained"]]] = []
    for run, series in np.argwhere((raw.alarm != 0) | (adjusted.alarm != 0) & known).tolist():
        remains = bool(adjusted.alarm[run, series]) or not known
        verdicts.append((run, series, "drift" if remains else "explained"))
    return Explanation(raw, adjusted, p, tuple(verdicts))


def example_calibration(c: float = 8.0) -> Calibration:
    """A small calibration of a camera, for examples."""
    return Calibration(
        kind="camera", name="example", sigma0=1.0, redundancy=100,
        model={"model": "brown", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01]},
        parameters={"c": Quantity(value=c, sigma=1e-4, unit="mm")},
        covariance=Covariance(names=("c",), matrix=((1e-8,),)),
    )  # fmt: skip


def _model(calibration: Calibration) -> dict[str, Any]:
    model: dict[str, Any] = dict(calibration.model)
    return model if calibration.kind == "camera" else {"name": model.get("name")}


def _columns(covariates: Mapping[str, Array], runs: int) -> Array:
    """Covariates as columns (runs, q)."""
    if not covariates:
        raise UsageError("none were given", where="covariates")
    for name, v in covariates.items():
        if np.shape(v) != (runs,) or not np.isfinite(v).all():
            raise UsageError(f"needs a finite value for each of {runs} runs", where=name)
    return np.column_stack([np.asarray(v, dtype=np.float64) for v in covariates.values()])


def _terms(scaled: Array, degree: int) -> Array:
    """Constant and powers of the covariates (n, 1 + degree · q)."""
    powers = [scaled ** (k + 1) for k in range(degree)]
    return np.column_stack([np.ones(len(scaled)), *powers])


def _regressed(y: Array, z: Array) -> tuple[Array, Array]:
    beta = np.asarray(np.linalg.lstsq(z, y, rcond=None)[0], dtype=np.float64)
    return beta, y - z @ beta


def _p_value(y: Array, larger: Array, smaller: Array) -> float:
    """Level of the F-test that only the smaller design is needed, over all series (Bonferroni).

    Autocorrelated residuals are counted as n (1 − φ) / (1 + φ) independent ones.
    """
    scale = np.ptp(y, axis=0)
    y = (y - y.mean(axis=0)) / np.where(scale > 0, scale, 1.0)
    _, wide = _regressed(y, smaller)
    _, narrow = _regressed(y, larger)
    n, more = len(y), larger.shape[1] - smaller.shape[1]
    degrees = n - larger.shape[1]
    before, after = np.square(wide).sum(axis=0), np.square(narrow).sum(axis=0)
    usable = after > 1e-24 * n
    phi = np.where(usable, (narrow[1:] * narrow[:-1]).sum(axis=0) / np.where(usable, after, 1.0), 0.0)
    phi = np.clip(phi + (larger.shape[1] + 3 * phi) / n, 0.0, 0.9)
    f = np.where(usable, (before - after) / more / np.where(usable, after, 1.0) * degrees, np.inf)
    f = np.where(before > 1e-24 * n, f, 0.0) * (1.0 - phi) / (1.0 + phi)
    return float(min(1.0, y.shape[1] * scipy.special.fdtrc(more, degrees, f).min()))


def _within(calibration: Calibration, names: tuple[str, ...]) -> Array:
    """Covariance of the named parameters."""
    rows = [calibration.covariance.names.index(name) for name in names]
    return np.array(calibration.covariance.matrix)[np.ix_(rows, rows)]


def _scatter(residuals: Array, terms: int, within: Sequence[Array]) -> Array:
    """Covariance of one calibration about the function, at least its own: C + the positive part of S − C."""
    total = residuals.T @ residuals / (len(residuals) - terms)
    own = np.mean(within, axis=0)
    size = np.sqrt(np.maximum(np.diag(own), np.diag(total)))
    size = np.where(size > 0, size, 1.0)
    scaled = np.outer(size, size)
    values, vectors = scipy.linalg.eigh((total - own) / scaled)
    more: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    found: Array = own + more * scaled
    return (found + found.T) / 2


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())
