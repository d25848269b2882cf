"""The uncertainty of a calibration, by its sources, and that of measurements made with it.

Sources of the uncertainty of the parameters p, with covariance C of the calibration, a posteriori, of which
C_f is the part that presumes independent errors of all image points:

* *grey values*: C_f less the part of the observed target coordinates;
* *target coordinates*: Q_pt P_t Q_tp σ₀², Q_pt being the cofactors of parameters and targets;
* *temperature*: the coefficients times the uncertainty of the temperature;
* *model*: C − C_f, by errors that the points of an image have in common. Calibrations of earlier versions,
  whose C is C_f, have the standard deviations s_b from the scatter between images instead: F C F,
  f² = max(0, s_b²/s² − 1). Of measured points also the misfit of the model;
* *reproducibility*: the covariance of the parameters between sessions beyond that within, both by the
  calibrations of a configuration since its last service event.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from ...adjust import Contribution, propagate, simulate
from ...adjust.uncertainty import Simulated, UncertaintyBudget
from ...calibration import Calibration, CameraMapping, projection_field
from ...core.data import Array, ImagePoints
from ...core.errors import UsageError
from .data import CertificateData

SOURCES = ("grey values", "target coordinates", "temperature", "model", "reproducibility")
# Images that show what their points have in common; those that earlier versions needed for their scatter.
_LEAST_IMAGES, _LEAST_SCATTERED = 3, 6
_LEAST_SESSIONS = 3
_ADJUSTMENT = "adjustment"
_ROUNDS, _CONVERGED_PX = 30, 1e-8


@dataclass(frozen=True, eq=False)
class CalibrationUncertainty:
    """Contributions to the uncertainty of the estimated parameters of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    names, units : tuple of str (u,)
        Estimated parameters.
    values : ndarray (u,)
        Their estimates.
    contributions : tuple of Contribution (g,)
        Contributions.
    sources : tuple of str (g,)
        Source of each: one of `SOURCES`, or "other".
    missing : mapping of str to str
        Sources of which nothing is known, and why.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> found = uncertainty_of(example_calibration())
    >>> found.names, found.sources, sorted(found.missing)
    (('c',), ('grey values',), ['model', 'reproducibility', 'target coordinates', 'temperature'])
    """

    calibration: Calibration
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    contributions: tuple[Contribution, ...]
    sources: tuple[str, ...]
    missing: Mapping[str, str]

    def budget(self) -> UncertaintyBudget:
        """Budget of the parameters themselves."""
        return propagate(
            lambda x: x, self.values, self.contributions, names=self.names, inputs=self.names,
            units=self.units, sensitivities=np.eye(len(self.values)),
        )  # fmt: skip


def uncertainty_of(
    calibration: Calibration, earlier: Sequence[Calibration] = (), data: CertificateData | None = None
) -> CalibrationUncertainty:
    """Collect the contributions to the uncertainty of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    earlier : sequence of Calibration
        Calibrations of the same configuration in other sessions, for the reproducibility.
    data : CertificateData, optional
        Temperature and further contributions.

    Raises
    ------
    UsageError
        If no parameter was estimated, or a contribution names a parameter that was not.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> found = uncertainty_of(example_calibration())
    >>> [each.name for each in found.contributions][0], sorted(found.missing)[0]
    ('grey values', 'model')
    """
    names = calibration.covariance.names
    where = f"calibration {calibration.name}"
    if not names:
        raise UsageError("has no estimated parameters", where=where)
    values = np.array([calibration.parameters[name].value for name in names])
    covariance = np.array(calibration.covariance.matrix, dtype=np.float64).reshape(len(names), len(names))
    found: _Found = []
    missing: dict[str, str] = {}
    if "covariates" in calibration.validity:
        _add_function(found, missing, calibration, covariance, data)
    else:
        shared = _add_adjustment(found, missing, calibration, covariance)
        _add_temperature(found, missing, names, data)
        _add_model(found, missing, calibration, covariance, shared)
        _add_reproducibility(found, missing, calibration, earlier)
    for each in () if data is None else data.contributions:
        row = _row(each.sensitivities, names, each.name)
        cov = each.sigma**2 * np.outer(row, row)
        nu = np.inf if each.degrees is None else each.degrees
        found.append((each.kind, Contribution(each.name, cov, nu, each.distribution)))
        missing.pop(each.kind, None)
    sources, contributions = zip(*found, strict=True)
    units = tuple(calibration.parameters[name].unit for name in names)
    return CalibrationUncertainty(calibration, names, units, values, contributions, sources, missing)


_Found = list[tuple[str, Contribution]]


def _add_function(
    found: _Found, missing: dict[str, str], calibration: Calibration, covariance: Array,
    data: CertificateData | None,
) -> None:  # fmt: skip
    """Contributions to a calibration that a function of covariates gives: sessions, and each covariate."""
    covariates: dict[str, dict[str, Any]] = calibration.validity["covariates"]
    if data is not None and data.temperature is not None and data.temperature.coefficients:
        raise UsageError(
            "has coefficients, but the calibration is already a function of covariates", where="temperature",
            do="state the uncertainty of the covariate with `reseau calibrations at`",
        )  # fmt: skip
    of_covariates: _Found = []
    for name, each in covariates.items():
        effect = np.array(each["effect"], dtype=np.float64)
        if effect.shape != covariance.shape[:1]:
            raise UsageError("has damaged `covariates`", where=f"calibration {calibration.name}")
        cov = float(each["sigma"]) ** 2 * np.outer(effect, effect)
        of_covariates.append((name if name in SOURCES else "other", Contribution(name, cov)))
    rest = covariance - sum(each.covariance for _, each in of_covariates)
    text = f"sessions about the function of {', '.join(covariates)}"
    found.append(("reproducibility", Contribution(text, (rest + rest.T) / 2, float(calibration.redundancy))))
    found += [each for each in of_covariates if each[1].covariance.any()]
    for source in ("grey values", "target coordinates", "model"):
        missing[source] = "it is part of the scatter of the sessions, as far as it differs between them"
    if not any(source == "temperature" for source, _ in found):
        known = "temperature" in covariates
        missing["temperature"] = "its value is taken as known" if known else "it is not a covariate"


def _add_adjustment(
    found: _Found, missing: dict[str, str], calibration: Calibration, covariance: Array
) -> Array:
    """Contributions of the adjustment; returns what images have in common."""
    where = f"calibration {calibration.name}"
    degrees = float(calibration.redundancy) if calibration.sigma0 is not None else np.inf
    parts = {name: calibration.validity.get(f"covariance_of_{name}") for name in ("targets", "held")}
    for name, part in parts.items():
        if part is not None and np.shape(part) != covariance.shape:
            raise UsageError(f"has a damaged `covariance_of_{name}`", where=where)
    none = np.zeros_like(covariance)
    targets, held = (none if part is None else np.array(part, np.float64) for part in parts.values())
    if parts["held"] is not None:
        text = "model: coefficients that were not chosen"
        found.append(("model", Contribution(text, held, np.inf)))
        covariance = covariance - held
    shared = _shared(calibration, covariance - targets, np.diag(targets))
    grey = Contribution("grey values", covariance - targets - shared, degrees, group=_ADJUSTMENT)
    found.append(("grey values", grey))
    if parts["targets"] is None:
        missing["target coordinates"] = "they were held, or estimated without observations of them"
    else:
        found.append(
            ("target coordinates", Contribution("target coordinates", targets, degrees, group=_ADJUSTMENT))
        )
    return shared


def _shared(calibration: Calibration, rest: Array, targets: Array) -> Array:
    """The part of a covariance by what the points of an image have in common.

    What is left without it has the formal variances, `targets` included, and the correlations of `rest`, as
    far as it is not above `rest` in any direction: both parts are covariances, and their sum is `rest`.
    """
    given = calibration.validity.get("sigma_formal")
    if given is None:
        return np.zeros_like(rest)
    variance, names = np.diag(rest), calibration.covariance.names
    formal = np.array([given.get(name, np.inf) for name in names], dtype=np.float64) ** 2 - targets
    none = variance <= 1e-12 * np.diag(calibration.covariance.matrix)
    ratio = np.where(none, 1.0, np.sqrt(np.clip(formal / np.where(none, 1.0, variance), 0.0, 1.0)))
    if (ratio > 1 - 1e-9).all():
        return np.zeros_like(rest)
    return _between(rest, rest * np.outer(ratio, ratio))


def _add_temperature(
    found: _Found, missing: dict[str, str], names: tuple[str, ...], data: CertificateData | None
) -> None:
    given = None if data is None else data.temperature
    if given is None:
        missing["temperature"] = "it was not recorded"
        return
    if not given.coefficients:
        missing["temperature"] = "no coefficients of the parameters are given"
        return
    row = _row(given.coefficients, names, "temperature")
    nu = np.inf if given.degrees is None else given.degrees
    cov = given.sigma**2 * np.outer(row, row)
    found.append(("temperature", Contribution("temperature", cov, nu, given.distribution)))


def _add_model(
    found: _Found, missing: dict[str, str], calibration: Calibration, covariance: Array, shared: Array
) -> None:
    names, validity = calibration.covariance.names, calibration.validity
    images = int(validity.get("images", 0))
    if "sigma_formal" in validity:
        if 0 < images < _LEAST_IMAGES:
            missing["model"] = f"what images have in common needs {_LEAST_IMAGES} of them"
        else:
            degrees = _degrees_of(calibration, covariance, shared)
            found.append(("model", Contribution("model: what images have in common", shared, degrees)))
        return
    between = validity.get("sigma_between_images") or {}
    if not any(name in between for name in names):
        missing["model"] = f"the scatter between images needs {_LEAST_SCATTERED} of them"
        return
    formal = np.diag(covariance)
    ratio = np.array([between.get(name, 0.0) ** 2 for name in names]) / np.where(formal > 0, formal, np.inf)
    f = np.sqrt(np.maximum(ratio - 1.0, 0.0))
    cov = covariance * np.outer(f, f)
    degrees = max((images or _LEAST_SCATTERED) - 1.0, 1.0)
    found.append(("model", Contribution("model: scatter between images", cov, degrees)))


def _degrees_of(calibration: Calibration, covariance: Array, shared: Array) -> float:
    """Degrees of freedom of what images have in common: with them the whole has those of the calibration."""
    held = calibration.validity.get("covariance_of_held")
    estimated = covariance if held is None else covariance - np.array(held, np.float64)
    formal = estimated - shared
    # Those of the calibration are, in relation to the formal covariance, with what held coefficients do.
    known = 1.0 if held is None else _relative(covariance, formal) / _relative(estimated, formal)
    whole = float(calibration.validity.get("degrees_of_freedom", np.inf)) / known**2
    part = _relative(shared, estimated)
    if not part > 0 or not np.isfinite(whole):
        return whole
    redundancy = float(calibration.redundancy) if calibration.redundancy > 0 else np.inf
    spread = 1 / whole - (1 - part) ** 2 / redundancy
    return max(part**2 / spread, 1.0) if spread > 0 else whole


def _relative(part: Array, whole: Array) -> float:
    """Mean over the parameters of a covariance in relation to another one."""
    size = np.sqrt(np.diag(whole))
    scale = np.where(np.outer(size, size) > 0, np.outer(size, size), 1.0)
    return float(np.trace(np.linalg.pinv(whole / scale, hermitian=True) @ (part / scale))) / max(len(size), 1)


def _add_reproducibility(
    found: _Found, missing: dict[str, str], calibration: Calibration, earlier: Sequence[Calibration]
) -> None:
    names = calibration.covariance.names
    every = [calibration, *(each for each in earlier if each.covariance.names == names)]
    if len(every) < _LEAST_SESSIONS:
        missing["reproducibility"] = f"needs {_LEAST_SESSIONS} sessions; there are {len(every)}"
        return
    values = np.array([[each.parameters[name].value for name in names] for each in every])
    within = np.mean([each.covariance.matrix for each in every], axis=0)
    cov = _between(np.atleast_2d(np.cov(values.T)), within)
    contribution = Contribution("reproducibility between sessions", cov, len(every) - 1.0)
    found.append(("reproducibility", contribution))


def _between(total: Array, within: Array) -> Array:
    """The positive part of total − within, in the directions in which `within` is a unit matrix."""
    size = np.sqrt(np.diag(within))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(within / np.outer(scale, scale))
    keep = values > 1e-12 * values[-1]
    root = scale[:, None] * vectors[:, keep] * np.sqrt(values[keep])
    white = (vectors[:, keep] / np.sqrt(values[keep])).T / scale
    ratio, turn = scipy.linalg.eigh(white @ total @ white.T)
    back = root @ turn
    found: Array = (back * np.maximum(ratio - 1.0, 0.0)) @ back.T
    return found


def _row(given: Mapping[str, float], names: tuple[str, ...], where: str) -> Array:
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise UsageError(f"names {unknown[0]!r}, which is not an estimated parameter", where=where,
                         do=f"use {', '.join(names)}")  # fmt: skip
    return np.array([given.get(name, 0.0) for name in names])


def measurement_budget(uncertainty: CalibrationUncertainty, points: ImagePoints) -> UncertaintyBudget:
    """Budget of points measured with the calibrated instrument, with the covariance of all of them.

    Parameters
    ----------
    uncertainty : CalibrationUncertainty
        Of the calibration.
    points : ImagePoints
        In pixels.

    Returns
    -------
    UncertaintyBudget
        Results are x and y of each point in the system of the calibration (directions, for a camera); they
        are correlated by the calibration.

    Raises
    ------
    UsageError
        If the calibration has no value at a point, or its parameters are not those of its mapping.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> pair = ImagePoints.with_sigma(["a", "b"], [[400.0, 300.0], [420.0, 300.0]], 0.02)
    >>> found = measurement_budget(uncertainty_of(example_calibration()), pair)
    >>> found.names, found.covariance.shape
    (('a.x', 'a.y', 'b.x', 'b.y'), (4, 4))
    """
    mapping = uncertainty.calibration.mapping()
    value, slope, by_parameters = mapping.derivatives(points.xy)
    n, u = len(points), len(uncertainty.values)
    lost = [name for name, xy in zip(points.names, value, strict=True) if not np.isfinite(xy).all()]
    if lost:
        raise UsageError("has no value under the calibration", where=f"point {lost[0]}")
    if by_parameters.shape[2] != u:
        raise UsageError("has no derivatives by its parameters", where=uncertainty.calibration.name)
    sensitivities = np.zeros((2 * n, 2 * n + u))
    for k in range(n):
        own = slice(2 * k, 2 * k + 2)
        sensitivities[own, own], sensitivities[own, 2 * n :] = slope[k], by_parameters[k]
    of_points = [f"{name}.{axis}" for name in points.names for axis in "xy"]
    return propagate(
        lambda x: np.broadcast_to(value.ravel(), (len(x), 2 * n)), _inputs(uncertainty, points),
        _of_measurement(uncertainty, points), names=of_points, inputs=[*of_points, *uncertainty.names],
        units=[mapping.unit] * (2 * n), sensitivities=sensitivities,
    )  # fmt: skip


def simulate_measurement(
    uncertainty: CalibrationUncertainty,
    points: ImagePoints,
    *,
    probability: float = 0.95,
    draws: int = 10_000,
    digits: int | None = None,
    part: float = 1.0,
    seed: int = 0,
) -> Simulated:
    """Draw points and parameters, and map the points with the calibration of the drawn parameters.

    Parameters
    ----------
    uncertainty, points
        As for :func:`measurement_budget`.
    probability, draws, digits, part, seed
        As for :func:`reseau.adjust.simulate`.

    Raises
    ------
    UsageError
        If a calibration of this kind does not follow its parameters.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> one = ImagePoints.with_sigma(["a"], [[400.0, 300.0]], 0.02)
    >>> found = simulate_measurement(uncertainty_of(example_calibration()), one, draws=4000)
    >>> found.draws, found.mean.shape
    (4000, (2,))
    """
    calibration, n = uncertainty.calibration, len(points)
    mapping = calibration.mapping()
    start, slope, _ = mapping.derivatives(points.xy)

    def one(x: Array) -> Array:
        xy, values = x[: 2 * n].reshape(n, 2), x[2 * n :]
        if isinstance(mapping, CameraMapping):
            return _directions(mapping, values, xy, start, slope).ravel()
        return _mapped(calibration, uncertainty.names, values, xy).ravel()

    x = _inputs(uncertainty, points)
    contributions = _of_measurement(uncertainty, points)
    budget = measurement_budget(uncertainty, points)
    step = np.zeros(len(x))
    step[2 * n :] = np.sqrt(np.diag(sum(each.covariance for each in contributions)))[2 * n :]
    moved, expected = one(x + step) - one(x), budget.sensitivities @ step
    if np.abs(moved - expected).max() > 0.1 * np.abs(expected).max(initial=0.0):
        raise UsageError(f"a calibration of the kind {calibration.kind!r} does not follow its parameters",
                         where="Monte Carlo", do="leave it out")  # fmt: skip
    return simulate(
        lambda rows: np.array([one(row) for row in rows]), x, contributions, probability=probability,
        draws=draws, digits=digits, part=part, seed=seed,
    )  # fmt: skip


def _directions(camera: CameraMapping, values: Array, xy: Array, start: Array, slope: Array) -> Array:
    """Directions of pixels with other parameters: Newton's method with constant derivatives, from nearby."""
    given = camera.mapping.values.copy()
    given[camera.rows] = values
    mapping, uv = camera.mapping.with_values(given), start
    for _ in range(_ROUNDS):
        off = mapping(uv) - xy
        uv = uv - np.einsum("nij,nj->ni", slope, off)
        if np.abs(off).max() < _CONVERGED_PX:
            found: Array = uv
            return found
    return np.full_like(start, np.nan)


def _mapped(calibration: Calibration, names: tuple[str, ...], values: Array, xy: Array) -> Array:
    parameters = dict(calibration.parameters)
    for name, value in zip(names, values.tolist(), strict=True):
        parameters[name] = parameters[name].model_copy(update={"value": value})
    return calibration.model_copy(update={"parameters": parameters}).mapping().derivatives(xy)[0]


def _inputs(uncertainty: CalibrationUncertainty, points: ImagePoints) -> Array:
    return np.concatenate([points.xy.ravel(), uncertainty.values])


def _lacking(calibration: Calibration, xy: Array) -> Array:
    """Variances (n,) of points, px², that the verdict has beyond those of the calibration."""
    lens, assessed = calibration.mapping(), calibration.assessment
    if not isinstance(lens, CameraMapping) or assessed is None or assessed.errors is None:
        return np.zeros(len(xy))
    errors = assessed.errors
    own = projection_field(lens, len(errors.x), len(errors.y)).sigma
    beyond = np.nan_to_num(np.maximum(errors.total**2 - own**2, 0.0))
    at = np.clip(xy, 0.0, [errors.x[-1], errors.y[-1]])
    found: Array = scipy.interpolate.RegularGridInterpolator((errors.y, errors.x), beyond)(at[:, ::-1])
    return found


def _of_measurement(uncertainty: CalibrationUncertainty, points: ImagePoints) -> list[Contribution]:
    """Contributions to points and parameters."""
    n, u = len(points), len(uncertainty.values)

    def placed(part: Array, begin: int) -> Array:
        full = np.zeros((2 * n + u, 2 * n + u))
        full[begin : begin + len(part), begin : begin + len(part)] = part
        return full

    found = [Contribution("grey values of the measurement", placed(scipy.linalg.block_diag(*points.cov), 0))]
    lacking = _lacking(uncertainty.calibration, points.xy)
    if lacking.any():
        found.append(Contribution("model of the lens", placed(np.diag(np.repeat(lacking, 2)), 0)))
    for each in uncertainty.contributions:
        name = f"calibration: {each.name}"
        cov = placed(each.covariance, 2 * n)
        found.append(Contribution(name, cov, each.degrees, each.distribution, each.group))
    return found
