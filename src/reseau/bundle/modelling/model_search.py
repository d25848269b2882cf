"""An adjustment with the weights and the parameters that its own observations ask for."""

from __future__ import annotations

from dataclasses import dataclass

from ...adjust import VarianceComponents
from ...core.failure import Failure
from ..diagnostics import Result
from ..network import Network
from ..solver import BundleFit
from .adjustment import Options, adjust_network
from .components import Kind, estimate_components, reweighted
from .selection import Eliminated, cross_validation, eliminate_parameters

__all__ = ["Searched", "search_model"]


@dataclass(frozen=True, eq=False)
class Searched:
    """An adjustment, and how its model was found; truthy.

    Parameters
    ----------
    result : Result
        Of the network with the weights and parameters found.
    components : VarianceComponents, optional
        Factors on the standard deviations that were given.
    eliminated : tuple of Eliminated, optional
        Parameters that were dropped, in this order; None where none was looked for.
    validation : (float, float), optional
        Root mean square of image coordinates predicted without them, in their standard deviations: with all
        parameters, and with those that stayed.
    """

    result: Result
    components: VarianceComponents[BundleFit] | None = None
    eliminated: tuple[Eliminated, ...] | None = None
    validation: tuple[float, float] | None = None

    def __bool__(self) -> bool:
        return True


def search_model(
    network: Network,
    options: Options | None = None,
    components: Kind | None = None,
    level: float | None = None,
) -> Searched | Failure:
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
    Searched or Failure
        A failure when an adjustment fails, or the components do not settle.
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
        return result if isinstance(result, Failure) else Searched(result, found)
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
    return Searched(selection.result, found, selection.steps, (numbers[0], numbers[1]))
