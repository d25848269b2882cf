"""Choice of the model of a target: flat as designed, bent by two parameters, or with all points free.

A board of paper on a plate bends. With coordinates x, y from −1 to 1 over the target, its deflection is
z = a(1 − x²) + b(1 − y²) (Kogan, *mrcal*: deformation of the calibration object), a and b in the unit of the
design. The model with all points free contains both others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from ...core.data import Array
from ...core.display import Display
from ...core.errors import UsageError
from ...core.failure import Estimated, Failure
from ...core.numbers import or_null
from ..diagnostics.result import Result
from ..network.network import Network
from ..solver.problem import BundleFit, BundleProblem
from .adjustment import Options, adjust_network

# Description lengths within this of the least are not worse; see the choice of a camera model.
_EQUAL = 2.0
# Rounds of the estimation of the deflection, step of the first as a part of the size of the target, and shift
# in standard deviations at which it has converged.
_ROUNDS, _STEP, _CONVERGED = 8, 1e-4, 0.01


@dataclass(frozen=True, eq=False)
class BoardModel:
    """One model of the target, adjusted with the same observations as the others.

    Parameters
    ----------
    name : {"flat", "warp", "free"}
        As designed, bent by two parameters, or all points free.
    parameters : int
        Unknowns of the target: 0, 2, or three for each point less those of the datum.
    sigma0, cost : float
        Standard deviation of unit weight, and vᵀPv.
    length : float
        Description length, less that of the best model.
    p : float
        Probability of the F test against the next richer model; NaN for the richest.
    values, sigma : mapping of str to float
        Parameters of the camera, and their standard deviations with those of the deflection included.
    warp, warp_sigma : ndarray (2,)
        Deflections a and b; NaN for other models.

    Examples
    --------
    >>> flat = BoardModel("flat", 0, 1.0, 100.0, 0.0, 0.4, {}, {}, np.full(2, np.nan), np.full(2, np.nan))
    >>> flat.parameters
    0
    """

    name: str
    parameters: int
    sigma0: float
    cost: float
    length: float
    p: float
    values: Mapping[str, float]
    sigma: Mapping[str, float]
    warp: Array
    warp_sigma: Array


@dataclass(frozen=True, eq=False, repr=False)
class BoardChoice(Estimated, Display):
    """The chosen model of the target and the others; truthy.

    Parameters
    ----------
    chosen : BoardModel
        The one with the fewest parameters whose description length is within 2 of the least.
    models : tuple of BoardModel
        Flat, bent and free, as far as they could be adjusted.
    points : int
        Image points with which all were adjusted; the result may leave out others.
    network : Network
        With the points held as designed where this was chosen; otherwise as it was, with all points free.

    Examples
    --------
    See :func:`choose_board`.

    >>> BoardChoice.__name__
    'BoardChoice'
    """

    chosen: BoardModel
    models: tuple[BoardModel, ...]
    points: int
    network: Network

    def entries(self) -> dict[str, Any]:
        """Return the comparison as JSON values for the calibration document; unknown numbers are null."""

        return {
            "chosen": self.chosen.name,
            "models": [
                {
                    "name": each.name, "parameters": each.parameters, "sigma0": or_null(each.sigma0),
                    "length": or_null(each.length), "p": or_null(each.p),
                    "warp": [or_null(v) for v in each.warp],
                    "warp_sigma": [or_null(v) for v in each.warp_sigma],
                }
                for each in self.models
            ],
        }  # fmt: skip

    def _facts(self) -> list[tuple[str, str]]:
        return [(self.chosen.name, ""), ("sigma0", f"{self.chosen.sigma0:.3f}")]

    def _columns(self) -> dict[str, list[object]]:
        return {
            "target": [each.name for each in self.models],
            "parameters": [each.parameters for each in self.models],
            "sigma0": [f"{each.sigma0:.4f}" for each in self.models],
            "length": [f"{each.length:.1f}" for each in self.models],
            "p": [f"{each.p:.2g}" for each in self.models],
        }


def choose_board(network: Network, options: Options | None = None) -> BoardChoice | Failure:
    """Choose the model of a plane target: flat as designed, bent by two parameters, or all points free.

    Parameters
    ----------
    network : Network
        Network of one camera with inner constraints over the points of a plane target, whose coordinates are
        those of the design.
    options : Options, optional
        Options of the adjustment with all points free; what it rejects is left out for all.

    Returns
    -------
    BoardChoice or Failure
        A failure when the adjustment with all points free fails.

    Raises
    ------
    UsageError
        For a network with several cameras, another datum, or points without coordinates or not in a plane.

    Notes
    -----
    The two parameters are estimated by Newton's method on the cost of adjustments with points held: its
    second differences give their covariance, those of the camera's parameters their dependence on the
    deflection.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> choose_board(example_network())
    Traceback (most recent call last):
    reseau.core.errors.UsageError: choice of a target: needs points of a plane, with coordinates of the design
    """
    flat = network.xyz
    if len(network.cameras) != 1 or network.datum != "free" or network.rig is not None:
        raise UsageError("needs one camera and inner constraints", where="choice of a target")
    if not np.isfinite(flat).all() or np.ptp(flat[:, 2]) > 1e-9 * np.ptp(flat[:, :2]):
        raise UsageError(
            "needs points of a plane, with coordinates of the design", where="choice of a target"
        )
    result = adjust_network(network, options)
    if isinstance(result, Failure):
        return result
    free, n = result.fit, len(network.xy)
    seen = result.used
    held = held_as_designed(network)
    start = replace(free.problem, network=held, start=free.values, rounds=0)
    weights = np.zeros(len(start.observations))
    weights[: 2 * n] = np.repeat(seen, 2)
    start = start.with_weights(weights)
    found = [_free_model(free)]
    plain = _held(start, flat)
    if isinstance(plain, BundleFit):
        names, own, cofactors = _camera(plain)
        nothing = np.full(2, np.nan)
        found.insert(0, _model("flat", 0, plain, names, own, np.sqrt(np.diag(cofactors)), nothing, nothing))
        bent = _bent(start.continued(plain), flat)
        if bent is not None:
            found.insert(1, bent)
    return _compared(network, held, found, int(seen.sum()))


def held_as_designed(network: Network) -> Network:
    """Return the network with all points held at their coordinates, which define the datum.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> bool(held_as_designed(example_network()).held.all())
    True
    """
    count = len(network.points)
    return replace(
        network, sigma=np.zeros((count, 3)), datum="control", role=("control",) * count,
        datum_points=np.zeros(count, dtype=bool),
    )  # fmt: skip


def _free_model(fit: BundleFit) -> BoardModel:
    """All points free."""
    names, values, cofactors = _camera(fit)
    points = 3 * int(fit.usable.points.sum()) - fit.freedom.defect
    nothing = np.full(2, np.nan)
    return _model("free", points, fit, names, values, np.sqrt(np.diag(cofactors)), nothing, nothing)


def _model(
    name: str, count: int, fit: BundleFit, names: tuple[str, ...], values: Array, sigma: Array, warp: Array,
    warp_sigma: Array,
) -> BoardModel:  # fmt: skip
    pairs = dict(zip(names, values.tolist(), strict=True))
    sigmas = dict(zip(names, sigma.tolist(), strict=True))
    return BoardModel(name, count, fit.sigma0, fit.cost, np.nan, np.nan, pairs, sigmas, warp, warp_sigma)


def _compared(network: Network, held: Network, found: list[BoardModel], seen: int) -> BoardChoice:
    """Description lengths, tests, and the choice."""
    count = 2 * seen
    length = np.array([count * np.log(each.cost / count) + each.parameters * np.log(count) for each in found])
    length -= length.min()
    models = []
    for k, each in enumerate(found):
        p = np.nan
        if k + 1 < len(found):
            richer = found[k + 1]
            more = richer.parameters - each.parameters
            rest = richer.cost / richer.sigma0**2
            ratio = max(each.cost - richer.cost, 0.0) / more / richer.sigma0**2
            p = float(scipy.special.fdtrc(more, rest, ratio))
        models.append(replace(each, length=float(length[k]), p=p))
    chosen = next(each for each in models if each.length <= _EQUAL)
    return BoardChoice(chosen, tuple(models), seen, held if chosen.name == "flat" else network)


def _held(start: BundleProblem, xyz: Array) -> BundleFit | Failure:
    """Adjust with the points held at these coordinates."""
    network = replace(start.network, xyz=xyz)
    return replace(start, network=network, start=replace(start.start, xyz=xyz)).adjusted()


def _camera(fit: BundleFit) -> tuple[tuple[str, ...], Array, Array]:
    """Names and values of the estimated parameters of the camera, and their covariance."""
    network = fit.problem.network
    result = Result(network, fit, np.zeros(len(network.xy), dtype=bool), ())
    names, _, values = result.camera_columns(0)
    return names, values, result.formal_camera_covariance(0)


class _Sample(NamedTuple):
    """An adjustment with a given deflection."""

    fit: BundleFit
    camera: Array


def _bent(start: BundleProblem, flat: Array) -> BoardModel | None:
    """The deflection by two parameters; None where an adjustment fails or it does not converge."""
    size = np.ptp(flat[:, :2], axis=0)
    x = 2 * (flat[:, :2] - flat[:, :2].min(axis=0)) / np.where(size > 0, size, 1.0) - 1
    shape = 1 - x**2

    def at(warp: Array) -> _Sample | None:
        xyz = flat + np.outer(shape @ warp, [0.0, 0.0, 1.0])
        fit = _held(start, xyz)
        return None if isinstance(fit, Failure) else _Sample(fit, _camera(fit)[1])

    warp, h = np.zeros(2), np.full(2, _STEP * float(np.hypot(*size)))
    for _ in range(_ROUNDS):
        steps = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]]) * h
        samples = [at(warp + step) for step in steps]
        if any(sample is None for sample in samples):
            return None
        good = [sample for sample in samples if sample is not None]
        cost = np.array([sample.fit.cost for sample in good])
        slope = np.array([cost[1] - cost[2], cost[3] - cost[4]]) / (2 * h)
        bend = np.diag([cost[1] + cost[2] - 2 * cost[0], cost[3] + cost[4] - 2 * cost[0]] / h**2)
        cross = (cost[5] + cost[6] - 2 * cost[0] - h[0] ** 2 * bend[0, 0] - h[1] ** 2 * bend[1, 1]) / (
            2 * h[0] * h[1]
        )
        bend[0, 1] = bend[1, 0] = cross
        if not (np.linalg.eigvalsh(bend) > 0).all():
            return None
        centre = good[0]
        sigma = np.sqrt(np.diag(2 * np.linalg.inv(bend))) * centre.fit.sigma0
        move = -np.linalg.solve(bend, slope)
        if (np.abs(move) < _CONVERGED * sigma).all():
            by = (
                np.stack(
                    [(good[1].camera - good[2].camera) / h[0], (good[3].camera - good[4].camera) / h[1]], 1
                )
                / 2
            )
            redundancy = centre.fit.redundancy - 2
            factor = centre.fit.redundancy / redundancy
            names, values, conditional = _camera(centre.fit)
            covariance = factor * (conditional + by @ (2 * np.linalg.inv(bend) * centre.fit.sigma0**2) @ by.T)
            fit = replace(
                centre.fit, sigma0=float(np.sqrt(factor)) * centre.fit.sigma0, redundancy=redundancy
            )
            return _model(
                "warp", 2, fit, names, values, np.sqrt(np.diag(covariance)), warp, np.sqrt(factor) * sigma
            )
        warp, h = warp + move, sigma
    return None
