"""Search for the model that the observations need: variance components, elimination of parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...adjust import VarianceComponents, variance_components
from ...adjust.significance import CoefficientTest
from ...core.data import Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ..diagnostics import Eliminated, Result
from ..network import Camera, Network
from ..solver import BundleFit
from .adjustment import Options, adjust_network, problem_of

__all__ = [
    "Kind",
    "Selection",
    "cross_validation",
    "eliminate_parameters",
    "estimate_components",
    "reweighted",
    "search_model",
]

Kind = Literal["axes", "images", "cameras"]


def search_model(
    network: Network,
    options: Options | None = None,
    components: Kind | None = None,
    level: float | None = None,
) -> Result | Failure:
    """Adjust a network, with variance components and without parameters that are not needed.

    Parameters
    ----------
    network : Network
        What was observed.
    options : Options, optional
        How to adjust.
    components : {"axes", "images", "cameras"}, optional
        What gets a factor of its own on its standard deviations.
    level : float, optional
        Level of the tests by which distortion parameters are dropped.

    Returns
    -------
    Result or Failure
        The result says how its model was found. A failure when an adjustment fails, or the components do not
        converge.

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
    # Blunders would drown what the models differ by: both predict what the better one has kept.
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
        With the covariances as far as they are known; the correlations of x and y stay.
    kind : {"axes", "images", "cameras"}
        What has a factor of its own: `x` (columns) and `y` (rows), each image, or the images of each camera.
    options : Options, optional
        How to adjust.
    used : ndarray of bool (n,), optional
        Image points that count; by default all.

    Returns
    -------
    VarianceComponents or Failure
        See :func:`reseau.adjust.variance_components`; what else was observed keeps its standard deviation.

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
    # Factors to a thousandth of their own standard deviations are exact enough, and many need them so.
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
    """The network with standard deviations multiplied by the factors found; correlations stay.

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

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> round(cross_validation(example_network(), folds=4), 1)
    1.3
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
