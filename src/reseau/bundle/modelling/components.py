"""How good the image coordinates really are: factors on the sigmas of axes, images, cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from ...adjust import VarianceComponents, variance_components
from ...core.data import Mask, Rows
from ...core.failure import Failure
from ..network import Network
from ..solver import BundleFit
from .adjustment import Options, problem_of

__all__ = ["Kind", "estimate_components", "reweighted"]

Kind = Literal["axes", "images", "cameras"]


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
    """The network with standard deviations multiplied by the factors found; correlations stay."""
    factor = np.ones(network.xy.shape)
    known = dict(zip(found.names, found.factors.tolist(), strict=True))
    for name, mask in _kinds(network)[kind]().items():
        factor[mask] = known.get(name, 1.0)
    return replace(network, cov=network.cov * factor[:, :, None] * factor[:, None, :])
