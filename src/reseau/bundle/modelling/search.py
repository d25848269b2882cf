"""Search for a model: variance components and elimination of parameters that are not significant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...adjust import variance_components
from ...adjust.components import VarianceComponents
from ...adjust.significance import CoefficientTest
from ...core.data import Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Estimated, Failure
from ..diagnostics.result import Eliminated, Result
from ..network.camera import Camera
from ..network.network import Network
from ..solver.problem import BundleFit
from .adjustment import Options, adjust_network, problem_of

Kind = Literal["axes", "images", "cameras"]


def search_model(
    network: Network,
    options: Options | None = None,
    components: Kind | None = None,
    level: float | None = None,
) -> Result | Failure:
    """Adjust a network with variance components and without parameters that are not significant.

    Parameters
    ----------
    network : Network
        Network to adjust.
    options : Options, optional
        Options of the adjustment.
    components : {"axes", "images", "cameras"}, optional
        Groups of image coordinates with separate factors on their standard deviations; by default none.
    level : float, optional
        Significance level of the tests by which distortion parameters are dropped; by default none is tested.

    Returns
    -------
    Result or Failure
        The result includes components, dropped parameters and cross-validation. A failure when an adjustment
        fails or the components do not converge.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> result = search_model(example_network(), components="axes")
    >>> result.components.names, result.components.factors.round(2)
    (('x', 'y'), array([0.93, 1.08]))
    """
    found = None
    if components is not None:
        first = adjust_network(network, options)
        if isinstance(first, Failure):
            return first
        estimated = estimate_components(network, components, options, ~first.rejected)
        if isinstance(estimated, Failure):
            return estimated
        found, network = estimated, reweighted(network, estimated, components)
    if level is None:
        result = adjust_network(network, options)
        return result if isinstance(result, Failure) else replace(result, components=found)
    selection = eliminate_parameters(network, level, options)
    if isinstance(selection, Failure):
        return selection
    # Gross errors would hide the difference of the models: both predict the observations that were kept.
    kept = ~selection.result.rejected
    both = [cross_validation(one.select(kept), options=options) for one in (network, selection.network)]
    for value in both:
        if isinstance(value, Failure):
            return value
    numbers = tuple(value for value in both if isinstance(value, float))
    return replace(
        selection.result,
        components=found,
        eliminated=selection.steps,
        validation=(numbers[0], numbers[1]),
    )


def estimate_components(
    network: Network, kind: Kind = "axes", options: Options | None = None, used: Mask | None = None
) -> VarianceComponents[BundleFit] | Failure:
    """Estimate factors on the standard deviations of image coordinates.

    Parameters
    ----------
    network : Network
        Network with approximate covariances; correlations of x and y are kept.
    kind : {"axes", "images", "cameras"}
        Groups with separate factors: `x` (columns) and `y` (rows), each image, or the images of each camera.
    options : Options, optional
        Options of the adjustment.
    used : ndarray of bool (n,), optional
        Image points to use; by default all.

    Returns
    -------
    VarianceComponents or Failure
        See :func:`reseau.adjust.variance_components`; other observations keep their standard deviations.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> found = estimate_components(example_network(), "axes")
    >>> found.factors.round(2), found.sigma.round(2)
    (array([0.93, 1.08]), array([0.06, 0.07]))
    """
    problem, _ = problem_of(network, options)
    n = len(network.xy)
    weights = np.ones(len(problem.observations))
    if used is not None:
        weights[: 2 * n] = np.repeat(used, 2)
    problem = problem.with_weights(weights)
    first = problem.adjusted()
    if isinstance(first, Failure):
        return first
    part = np.repeat(first.usable.observations, 2)
    masks = {}
    for name, own in _kinds(network)[kind]().items():
        mask = np.zeros(len(weights), dtype=bool)
        mask[: 2 * n] = own.ravel() & part
        if mask.any():
            masks[name] = mask
    # A thousandth of the standard deviations of the factors suffices; with many groups more would be slow.
    return variance_components(problem.continued(first), masks, tolerance=1e-5)


def _kinds(network: Network) -> dict[Kind, Callable[[], dict[str, Mask]]]:
    """Masks (n, 2) of the groups of each kind."""
    n, camera = len(network.xy), network.camera_of[network.image_of]

    def rows(of: Rows, names: list[str]) -> dict[str, Mask]:
        return {name: np.repeat((of == k)[:, None], 2, axis=1) for k, name in enumerate(names)}

    return {
        "axes": lambda: {"x": np.tile([True, False], (n, 1)), "y": np.tile([False, True], (n, 1))},
        "images": lambda: rows(network.image_of, [f"image {name}" for name in network.images]),
        "cameras": lambda: rows(camera, [f"camera {entry.id}" for entry in network.cameras]),
    }


def reweighted(network: Network, found: VarianceComponents[BundleFit], kind: Kind) -> Network:
    """Return the network with the factors applied to its standard deviations; correlations are kept.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> network = example_network()
    >>> found = estimate_components(network, "axes")
    >>> np.sqrt(np.diag(reweighted(network, found, "axes").cov[0])).round(3)
    array([0.046, 0.054])
    """
    factor = np.ones(network.xy.shape)
    known = dict(zip(found.names, found.factors.tolist(), strict=True))
    for name, mask in _kinds(network)[kind]().items():
        factor[mask] = known.get(name, 1.0)
    return replace(network, cov=network.cov * factor[:, :, None] * factor[:, None, :])


@dataclass(frozen=True, eq=False)
class Selection(Estimated):
    """A network without the parameters that are not significant; truthy.

    Parameters
    ----------
    network : Network
        Network with the dropped parameters held at zero.
    result : Result
        Result of its adjustment.
    steps : tuple of Eliminated
        Dropped parameters in order.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> selection = eliminate_parameters(example_network())
    >>> bool(selection), selection.steps
    (True, ())
    """

    network: Network
    result: Result
    steps: tuple[Eliminated, ...]


def eliminate_parameters(
    network: Network, alpha: float = 0.05, options: Options | None = None
) -> Selection | Failure:
    """Drop the least significant distortion parameter and adjust again, until all are significant.

    Additional parameters are dropped in the same way, separately for each set.

    Parameters
    ----------
    network : Network
        Network with all parameters that may be needed.
    alpha : float
        Significance level of each test.
    options : Options, optional
        Options of the adjustment.

    Returns
    -------
    Selection or Failure
        A failure when an adjustment fails.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> network = example_network()
    >>> camera = replace(network.cameras[0], free=("c", "x0", "y0", "K1", "K2"))
    >>> selection = eliminate_parameters(replace(network, cameras=(camera,)))
    >>> [step.test.name for step in selection.steps], selection.network.cameras[0].free
    (['K2'], ('c', 'x0', 'y0', 'K1'))
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
    """Compute the root mean square error of predicted image coordinates, in their standard deviations.

    Each part of the image points is predicted by an adjustment without it. A model with unnecessary
    parameters predicts worse, although it fits better.

    Parameters
    ----------
    network : Network
        Network to adjust.
    folds : int
        Number of parts of the image points, each left out once.
    seed : int
        Seed of the random division.
    options : Options, optional
        Options of the adjustment.

    Returns
    -------
    float or Failure
        A failure when an adjustment fails or no image point can be predicted.

    Raises
    ------
    UsageError
        For fewer than two folds.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> round(cross_validation(example_network(), folds=4), 1)
    1.3
    """
    if folds < 2:
        raise UsageError(f"{folds} is too few: at least two are required", where="folds")
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
        else Failure("no image point could be predicted", Code.NO_REDUNDANCY)
    )
