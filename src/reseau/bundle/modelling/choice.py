"""Choice of a camera model: which of several describes a camera well enough, without parameters too many.

Every candidate is adjusted with the same observations. The description length (Schwarz 1978, *Estimating the
dimension of a model*, Annals of Statistics 6; Rissanen 1978, Modeling by shortest data description,
Automatica 14) weighs residuals against the number of parameters. Those that come close are compared by
cross-validation over images: an image that did not contribute is predicted. The difference of the image
coordinates from those of the chosen model, after the best rotation, says what the choice matters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.special

from ...calibration.camera import projection_field
from ...calibration.compare import calibration_difference
from ...core.display import Display
from ...core.errors import UsageError
from ...core.executors import Executor, Here
from ...core.failure import Code, Failure
from ..network import Camera, Network
from ..solver import BundleFit
from .adjustment import Options, adjust_network
from .candidates import (
    Candidate,
    adjusted_candidates,
    best_fit,
    camera_candidates,
    first_problem,
    further_candidates,
)
from .determined import mapping_of, parameters_determined, undetermined
from .prediction import LEVEL, mean_square, predicted_images, worse_predictions

__all__ = ["Compared", "ModelChoice", "choose_model"]

# Description lengths within this of the least are not worse (Kass & Raftery 1995, Bayes factors, JASA 90,
# table on p. 777: "not worth more than a bare mention"); beyond the second no cross-validation is needed.
_EQUAL, _HOPELESS = 2.0, 30.0
# Candidates that are cross-validated at most.
_VALIDATED = 6


@dataclass(frozen=True, eq=False)
class Compared:
    """A candidate, compared with the one that was chosen.

    Parameters
    ----------
    candidate : Candidate
        Model and free parameters.
    reason : str
        Why it was not chosen, or why it was.
    sigma0 : float
        Standard deviation of unit weight; NaN where the adjustment failed.
    cost : float
        vᵀPv.
    length : float
        Description length −2 ln L + u ln N with the variance estimated, less that of the best candidate.
    predicted : float
        Root mean square of predicted image coordinates, in their standard deviations, by cross-validation
        over images; NaN where this was not needed.
    p : float
        Probability of the test against the chosen model where one is a part of the other; NaN otherwise.
    rms_px, corner_px : float
        Difference from the chosen model over the image, and the largest one at a corner.
    corner_sigma_px : float
        Standard deviation there, of the model of the two with more parameters.
    share : float
        Part of the image where the difference is significant at 1 %.

    Examples
    --------
    >>> Compared(Candidate("opencv", ("fx", "fy")), "chosen", 1.0, 10.0, 0.0).candidate.label
    'opencv: no distortion'
    """

    candidate: Candidate
    reason: str
    sigma0: float
    cost: float
    length: float
    predicted: float = np.nan
    p: float = np.nan
    rms_px: float = np.nan
    corner_px: float = np.nan
    corner_sigma_px: float = np.nan
    share: float = np.nan


@dataclass(frozen=True, eq=False, repr=False)
class ModelChoice(Display):
    """The chosen camera model and the others, also those that were not adjusted and why; truthy.

    Parameters
    ----------
    camera : Camera
        The chosen camera, with its estimates as approximate values.
    compared : tuple of Compared
        All candidates, by description length; those that failed last.
    chosen : Compared
        The chosen one of them.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> names = ("c", "x0", "y0")
    >>> found = choose_model(
    ...     example_network(), [Candidate("brown", (*names, *more)) for more in ((), ("K1",), ("K1", "K2"))]
    ... )
    >>> found.chosen.candidate.label
    'brown: K1'
    """

    camera: Camera
    compared: tuple[Compared, ...]
    chosen: Compared

    def __bool__(self) -> bool:
        return True

    @property
    def alternatives(self) -> tuple[Compared, ...]:
        """The others."""
        return tuple(each for each in self.compared if each is not self.chosen)

    def entries(self) -> list[dict[str, Any]]:
        """Return the comparison as JSON values for the calibration document; unknown numbers are null."""

        def number(value: float) -> float | None:
            return value if np.isfinite(value) else None

        return [
            {
                "model": each.candidate.model,
                "free": list(each.candidate.free),
                "additional": each.candidate.additional,
                "reason": each.reason,
                "sigma0": number(each.sigma0),
                "length": number(each.length),
                "predicted": number(each.predicted),
                "p": number(each.p),
                "rms_px": number(each.rms_px),
                "corner_px": number(each.corner_px),
                "corner_sigma_px": number(each.corner_sigma_px),
                "significant_share": number(each.share),
            }
            for each in self.compared
        ]

    def _facts(self) -> list[tuple[str, str]]:
        return [(self.chosen.candidate.label, ""), (f"of {len(self.compared)} candidates", "")]

    def _columns(self) -> dict[str, list[object]]:
        return {
            "model": [each.candidate.label for each in self.compared],
            "sigma0": [f"{each.sigma0:.4f}" for each in self.compared],
            "length": [f"{each.length:.1f}" for each in self.compared],
            "predicted": [f"{each.predicted:.4f}" for each in self.compared],
            "corners / px": [f"{each.corner_px:.2g}" for each in self.compared],
            "reason": [each.reason for each in self.compared],
        }


def choose_model(
    network: Network,
    candidates: Sequence[Candidate] | None = None,
    options: Options | None = None,
    *,
    folds: int = 5,
    seed: int = 0,
    executor: Executor | None = None,
) -> ModelChoice | Failure:
    """Choose the model of the only camera of a network.

    Parameters
    ----------
    network : Network
        Network with one camera, of any registered model.
    candidates : sequence of Candidate, optional
        By default :func:`camera_candidates`. Where the best of these leaves a residual pattern that the
        images have in common, a spline surface and, with a pixel size, series of additional parameters are
        compared too; where perspective is not significant, the telecentric camera.
    options : Options, optional
        Options of the adjustments. Gross errors are rejected with the candidate of least residuals, so that
        no good observation is rejected because a model is too simple; all are then compared without them.
    folds : int
        Number of parts of the images, each left out once.
    seed : int
        Seed of the random division.
    executor : Executor, optional
        What adjusts the network without each part of the images; by default this process.

    Returns
    -------
    ModelChoice or Failure
        A failure when no candidate can be adjusted.

    Raises
    ------
    UsageError
        For a network with several cameras, additional or observed parameters, or without candidates.

    Notes
    -----
    Chosen is the candidate with the fewest parameters of those whose description length is within 2 of the
    least, and which predict images not significantly worse than another. Residuals alone never decide. A
    candidate whose projection has a standard deviation of more than 2 px in a corner of the image is left out
    where another one, with residuals larger by less than 0.02 px, is determined ten times as well.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> names = ("c", "x0", "y0")
    >>> found = choose_model(
    ...     example_network(), [Candidate("brown", (*names, *more)) for more in ((), ("K1",), ("K1", "K2"))]
    ... )
    >>> [(each.candidate.label, each.p < 0.01) for each in found.alternatives]
    [('brown: K1 K2', False), ('brown: no distortion', True)]
    """
    if len(network.cameras) != 1 or network.cameras[0].additional is not None or network.cameras[0].sigma:
        raise UsageError(
            "needs a network of one camera without additional or observed parameters",
            where="choice of a model",
        )
    camera = network.cameras[0]
    own = camera.registered
    usual, pitch_known = candidates is None, own is not None and own.needs_pitch
    candidates = camera_candidates(pitch_known=pitch_known) if candidates is None else list(candidates)
    if not candidates:
        raise UsageError("there are none", where="candidates of the choice of a model")
    options = options or Options()
    first = first_problem(network, candidates, options)
    fits = [first] * len(candidates) if isinstance(first, Failure) else adjusted_candidates(first, candidates)
    if options.outliers == "reject" and (best := best_fit(fits)) is not None:
        result = adjust_network(best.problem.network, options)
        if isinstance(result, Failure):
            return result
        weights = result.fit.problem.weights
        first = best.problem.continued(best).with_weights(weights)
        fits = adjusted_candidates(first, candidates)
    more = further_candidates(network, best_fit(fits), options, pitch_known=pitch_known) if usual else []
    candidates = [*candidates, *(candidate for candidate, _ in more)]
    fits = [*fits, *(fit for _, fit in more)]
    if best_fit(fits) is None:
        reason = first.reason if isinstance(first, Failure) else "no camera model can be adjusted"
        return Failure(reason, Code.NOT_CONVERGED)
    return _chosen(network, candidates, fits, folds, seed, executor or Here())


def _chosen(
    network: Network,
    candidates: Sequence[Candidate],
    fits: Sequence[BundleFit | Failure],
    folds: int,
    seed: int,
    executor: Executor,
) -> ModelChoice:
    """Compare the adjusted candidates."""
    good = [k for k, fit in enumerate(fits) if isinstance(fit, BundleFit)]
    length, number = np.full(len(fits), np.inf), np.zeros(len(fits))
    for k in good:
        fit = fits[k]
        assert isinstance(fit, BundleFit)
        count = 2 * int(fit.usable.observations.sum())
        number[k] = parameters_determined(fit)
        length[k] = count * np.log(fit.cost / count) + number[k] * np.log(count)
    order = sorted(range(len(fits)), key=lambda k: (length[k], k))
    vague = undetermined({k: fit for k in order if isinstance(fit := fits[k], BundleFit)})
    length -= min(length[k] for k in good if k not in vague)
    close = [k for k in order if k not in vague and length[k] < _HOPELESS][:_VALIDATED]
    squares = predicted_images([fits[k] for k in close], folds, seed, executor) if len(close) > 1 else None
    worse = worse_predictions(squares)
    equal = [k for row, k in enumerate(close) if length[k] <= _EQUAL and row not in worse] or close[:1]
    best = min(equal, key=lambda k: (number[k], length[k], k))
    fit = fits[best]
    assert isinstance(fit, BundleFit)
    found = []
    for k in order:
        other = fits[k]
        if isinstance(other, Failure):
            why = "" if other.code is Code.NOT_CONSIDERED else "not adjusted: "
            found.append(Compared(candidates[k], f"{why}{other.reason}", np.nan, np.nan, np.nan))
            continue
        row = close.index(k) if k in close else None
        predicted = np.nan if squares is None or row is None else float(np.sqrt(mean_square(squares[row])))
        one = Compared(
            candidates[k], "", other.sigma0, other.cost, float(length[k]), predicted,
            _test(candidates[k], other, candidates[best], fit), **_difference(fit, other),
        )  # fmt: skip
        reason = _reason(one, k == best, row in worse, candidates[best], len(equal))
        if k in vague:
            if np.isfinite(vague[k]):
                reason = (
                    f"its projection is not determined ({vague[k]:.2g} px in a corner), that of others is"
                )
            else:
                reason = "its projection is folded before a corner, that of others is not"
        found.append(replace(one, reason=reason))
    camera = fit.problem.network.cameras[0]
    observed = np.array([name in camera.sigma for name in camera.names])
    camera = replace(camera, values=np.where(observed, camera.values, fit.values.cameras[0, : len(observed)]))
    return ModelChoice(replace(camera, id=network.cameras[0].id), tuple(found), found[order.index(best)])


def _reason(one: Compared, best: bool, worse: bool, chosen: Candidate, equal: int) -> str:
    """Say why a candidate was chosen, or not."""
    own = one.candidate
    if best:
        text = "chosen: shortest description" if one.length == 0 else "chosen: fewest parameters"
        return text + (f" of {equal} that are as good" if equal > 1 else "")
    if one.length <= _EQUAL:
        if worse:
            return "predicts images significantly worse"
        return "as good, with more parameters" if len(own.free) > len(chosen.free) else "as good"
    if own.within(chosen):
        return f"too simple: the parameters that it lacks are significant, p = {one.p:.2g}"
    if chosen.within(own):
        size = "not " if one.p > LEVEL else "hardly "
        return f"too many parameters: the others are {size}significant, p = {one.p:.2g}"
    return f"longer description by {one.length:.1f}" + (", and predicts images worse" if worse else "")


def _test(own: Candidate, fit: BundleFit, chosen: Candidate, best: BundleFit) -> float:
    """F test of the parameters in which one of two nested models exceeds the other."""
    if own.within(chosen):
        small, large = fit, best
    elif chosen.within(own):
        small, large = best, fit
    else:
        return np.nan
    more = small.redundancy - large.redundancy
    if more <= 0 or large.redundancy <= 0:
        return np.nan
    ratio = max(small.cost - large.cost, 0.0) / more / (large.cost / large.redundancy)
    return float(scipy.special.fdtrc(more, large.redundancy, ratio))


def _difference(best: BundleFit, other: BundleFit) -> dict[str, float]:
    """Difference of two cameras over the image, and what it means."""
    if best is other:
        return {"rms_px": 0.0, "corner_px": 0.0, "share": 0.0}
    one, two = (mapping_of(fit) for fit in (best, other))
    try:
        field_ = calibration_difference(one, two)
    except UsageError:
        return {}
    size = np.hypot(field_.difference[..., 0], field_.difference[..., 1])
    sigma = projection_field(one if len(one.names) >= len(two.names) else two).sigma
    corners = [(0, 0), (0, -1), (-1, 0), (-1, -1)]
    known = [place for place in corners if np.isfinite(size[place])]
    worst = max(known, key=lambda place: float(size[place]), default=None)
    seen = np.isfinite(size) & np.isfinite(sigma)
    limit = np.sqrt(scipy.special.chdtri(2, 0.01))
    return {
        "rms_px": float(np.sqrt(np.nanmean(size**2))),
        "corner_px": np.nan if worst is None else float(size[worst]),
        "corner_sigma_px": np.nan if worst is None else float(sigma[worst]),
        "share": float((size[seen] > limit * sigma[seen]).mean()) if seen.any() else np.nan,
    }
