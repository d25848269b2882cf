"""Which parameters of the cameras the observations ask for: elimination, and what left-out points say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...adjust.significance import CoefficientTest
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ..diagnostics import Result
from ..network import Camera, Network
from ..solver import BundleFit
from .adjustment import Options, adjust_network, problem_of

__all__ = ["Eliminated", "Selection", "cross_validation", "eliminate_parameters"]


@dataclass(frozen=True)
class Eliminated:
    """One parameter dropped.

    Parameters
    ----------
    camera : str
        Whose parameter.
    test : CoefficientTest
        Its test before it was dropped.
    sigma0 : float
        Standard deviation of unit weight without it.
    """

    camera: str
    test: CoefficientTest
    sigma0: float


@dataclass(frozen=True, eq=False)
class Selection:
    """A network with the parameters its observations ask for; truthy.

    Parameters
    ----------
    network : Network
        With the others held at zero.
    result : Result
        Its adjustment.
    steps : tuple of Eliminated
        In the order in which they were dropped.
    """

    network: Network
    result: Result
    steps: tuple[Eliminated, ...]

    def __bool__(self) -> bool:
        return True


def eliminate_parameters(
    network: Network, alpha: float = 0.05, options: Options | None = None
) -> Selection | Failure:
    """Drop the least significant distortion, adjust again, and so on until all that remain are significant.

    Additional parameters are dropped one by one too, of each set by itself.

    Parameters
    ----------
    network : Network
        With all parameters that may be needed.
    alpha : float
        Level of each test.
    options : Options, optional
        How to adjust.

    Returns
    -------
    Selection or Failure
        A failure when an adjustment fails.
    """
    steps: list[Eliminated] = []
    result = adjust_network(network, options)
    while not isinstance(result, Failure):
        weakest = _weakest(network, result, alpha)
        if weakest is None:
            return Selection(network, result, tuple(steps))
        c, test = weakest
        cameras = list(network.cameras)
        cameras[c] = _without(cameras[c], test.name)
        network = replace(network, cameras=tuple(cameras))
        result = adjust_network(network, options)
        if not isinstance(result, Failure):
            steps.append(Eliminated(cameras[c].id, test, result.sigma0))
    return result


def _weakest(network: Network, result: Result, alpha: float) -> tuple[int, CoefficientTest] | None:
    tests = [
        (c, test)
        for c in range(len(network.cameras))
        for test in result.camera_tests(c, alpha)
        if not test.significant
    ]
    return max(tests, key=lambda found: found[1].p, default=None)


def _without(camera: Camera, name: str) -> Camera:
    extra = camera.additional
    if name not in camera.free and extra is not None:
        return replace(camera, additional=replace(extra, dropped=extra.dropped | {name}))
    values = camera.values.copy()
    values[camera.names.index(name)] = 0.0
    sigma = {key: s for key, s in camera.sigma.items() if key != name}
    return replace(camera, values=values, free=tuple(n for n in camera.free if n != name), sigma=sigma)


def cross_validation(
    network: Network, folds: int = 5, seed: int = 0, options: Options | None = None
) -> float | Failure:
    """Root mean square of image coordinates predicted without them, in their standard deviations.

    A model with parameters that are not needed predicts worse, although it fits better.

    Parameters
    ----------
    network : Network
        To be adjusted.
    folds : int
        Parts of the image points, each left out once.
    seed : int
        Of the division.
    options : Options, optional
        How to adjust.

    Raises
    ------
    UsageError
        For less than two folds.
    """
    if folds < 2:
        raise UsageError(f"{folds} folds leave nothing to adjust", where="cross_validation")
    problem, _ = problem_of(network, options)
    n = len(network.xy)
    part = np.random.default_rng(seed).permutation(n) % folds
    squares, count = 0.0, 0
    sigma = np.sqrt(np.diagonal(network.cov, axis1=1, axis2=2))
    for fold in range(folds):
        weights = np.ones(len(problem.observations))
        weights[: 2 * n] = np.repeat(part != fold, 2)
        fit = problem.with_weights(weights).adjusted()
        if not isinstance(fit, BundleFit):
            return fit
        v = (fit.residuals[: 2 * n].reshape(n, 2) / sigma)[part == fold]
        known = np.isfinite(v).all(axis=1)
        squares += float((v[known] ** 2).sum())
        count += 2 * int(known.sum())
    return (
        float(np.sqrt(squares / count))
        if count
        else Failure("no point could be predicted without its image", Code.NO_REDUNDANCY)
    )
