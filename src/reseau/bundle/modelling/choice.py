"""Choice of a camera model: the simplest one that predicts images which it has not seen as well as any other.

A first stage adjusts the usual perspective model with a moderate number of coefficients. Where parameters of
the same model beyond these predict images that are left out no better, nothing is left that the images have
in common, and the lens is perspective. Otherwise the models of wide lenses and of fisheyes are adjusted, too,
each from the best before it. Then the candidates of all models that were adjusted are compared by the density
with which images that are left out are predicted (see :mod:`~reseau.bundle.modelling.left_out`); what is
chosen is adjusted, and compared anew. Images of one view are left out together: copies of what is left out
would predict it with any camera.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from ...calibration import CameraMapping, calibration_difference
from ...calibration.camera import Rival, projection_field
from ...core.data import Array, Rows
from ...core.display import Display
from ...core.errors import UsageError
from ...core.failure import Code, Estimated, Failure
from ...core.numbers import or_null
from ...optics.cameras.registry import camera_model
from ..diagnostics.checks import unmodelled_pattern
from ..diagnostics.evidence import ODDS
from ..diagnostics.views import views_of
from ..network.camera import Camera
from ..network.network import Network
from ..solver.problem import BundleFit
from .adjustment import Options, adjust_network
from .calibration import model_entry
from .candidates import (
    PARALLEL,
    SERIES,
    Candidate,
    adjusted_to,
    camera_candidates,
    families,
    first_fit,
    surface,
    wider_model,
    with_parallel_rays,
)
from .determined import mapping_of, result_of
from .left_out import Information, Prediction, information_of

_LEVEL = 0.01
# Least number of images, of which one is left out.
_LEAST = 3
# Images, and image points of each, beyond which a choice takes longer and becomes no better.
_IMAGES, _POINTS = 60, 200
# Probability of a model that does not count; draws of how often images are taken.
_NOTHING, _DRAWS = 1e-9, 1000
# Places along the longer side at which cameras are compared.
_ACROSS = 13


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
        Standard deviation of unit weight; NaN where it was not considered.
    cost : float
        vᵀPv.
    length : float
        −2 times the logarithm of the density with which images that are left out are predicted, less that of
        the best candidate.
    predicted : float
        Root mean square of predicted image coordinates, in their standard deviations.
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
class ModelChoice(Estimated, Display):
    """The chosen camera model and the others, also those that were not adjusted and why; truthy.

    Parameters
    ----------
    camera : Camera
        The chosen camera, with its estimates as approximate values.
    compared : tuple of Compared
        All candidates, by description length; those that failed last.
    chosen : Compared
        The chosen one of them.
    rivals : tuple of Rival
        The best candidate of each other kind, as probable as it predicts images that are left out.

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
    rivals: tuple[Rival, ...] = ()

    @property
    def alternatives(self) -> tuple[Compared, ...]:
        """The others."""
        return tuple(each for each in self.compared if each is not self.chosen)

    def entries(self) -> list[dict[str, Any]]:
        """Return the comparison as JSON values for the calibration document; unknown numbers are null."""

        return [
            {
                "model": each.candidate.model,
                "free": list(each.candidate.free),
                "additional": each.candidate.additional,
                "reason": each.reason,
                "sigma0": or_null(each.sigma0),
                "length": or_null(each.length),
                "predicted": or_null(each.predicted),
                "p": or_null(each.p),
                "rms_px": or_null(each.rms_px),
                "corner_px": or_null(each.corner_px),
                "corner_sigma_px": or_null(each.corner_sigma_px),
                "significant_share": or_null(each.share),
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
    network: Network, candidates: Sequence[Candidate] | None = None, options: Options | None = None
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
        Options of the adjustments. Gross errors are rejected with the model that is chosen with them, so that
        no good observation is rejected because a model is too simple; all are then compared without them.

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
    Chosen is the candidate with the fewest parameters of those than which none of the n with more parameters
    makes images that are left out 10 n times as probable, as far as these agree in it. One image that others
    contradict decides nothing: what images tell of the camera counts with the variance with which they
    differ. Large networks are represented by 60 of their images.

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
    if len(network.cameras) != 1:
        raise UsageError(
            "has several cameras", where="network", do="choose the models of all with choose_models"
        )
    found = choose_models(network, candidates, options)
    return found if isinstance(found, Failure) else found[0]


def choose_models(
    network: Network,
    candidates: Sequence[Candidate] | None = None,
    options: Options | None = None,
    known: Collection[int] = (),
) -> tuple[ModelChoice, ...] | Failure:
    """Choose the model of each camera of a network: its kind from its own images, its parameters from all.

    Parameters
    ----------
    network, candidates, options
        See :func:`choose_model`; cameras may be fixed to each other.
    known : collection of int
        Rows of cameras that have the model that they have.

    Returns
    -------
    tuple of ModelChoice, or Failure
        In the order of the cameras. A failure when no candidate can be adjusted.

    Raises
    ------
    UsageError
        For a network with additional or observed parameters, or without candidates.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> [found.chosen.candidate.label for found in choose_models(example_network())]
    ['brown: K1']
    """
    options, chosen = options or Options(), list[_Search]()
    for c, camera in enumerate(network.cameras):
        if c not in known and (
            camera.additional is not None or camera.sigma or camera.covariance is not None
        ):
            raise UsageError(
                "has additional or observed parameters", where=f"{camera.label}, choice of a model"
            )
    if candidates is not None and not candidates:
        raise UsageError("there are none", where="candidates of the choice of a model")
    network = _sampled(network)
    for c in range(len(network.cameras)):
        own = [Candidate.of(network.cameras[c])] if c in known else candidates
        found = _alone(network, c, own, options)
        if isinstance(found, Failure):
            return found
        chosen.append(found)
    if len(chosen) > 1:
        joint = _jointly(network, chosen, options)
        if isinstance(joint, Failure):
            return joint
        chosen = joint
    return tuple(search.choice() for search in chosen)


def _sampled(network: Network) -> Network:
    """The network with fewer images and points, evenly distributed, where there are many."""
    keep = np.ones(len(network.xy), dtype=bool)
    for c in range(len(network.cameras)):
        images = np.flatnonzero(network.camera_of == c)
        if len(images) > _IMAGES:
            if network.rig is None:
                some = images[np.linspace(0, len(images) - 1, _IMAGES).round().astype(np.intp)]
            else:
                # Images that were taken at once stay together.
                every = np.unique(network.rig.exposure)
                wanted = every[np.linspace(0, len(every) - 1, _IMAGES).round().astype(np.intp)]
                some = images[np.isin(network.rig.exposure[images], wanted)]
            keep &= (network.camera_of[network.image_of] != c) | np.isin(network.image_of, some)
    typical = float(
        np.median(np.bincount(network.image_of[keep], minlength=1)[np.unique(network.image_of[keep])])
    )
    step = int(np.ceil(typical / _POINTS))
    if step > 1:
        some = np.arange(len(network.points)) % step == 0
        some[network.distance_of.ravel()] = True
        keep &= some[network.point_of]
    return network if keep.all() else network.select(keep)


def _alone(
    network: Network, c: int, candidates: Sequence[Candidate] | None, options: Options
) -> _Search | Failure:
    """Search for the model of a camera with its own images only."""
    camera = network.cameras[c]
    pitch_known = camera.registered is not None and camera.registered.needs_pitch
    usual = candidates is None
    every = camera_candidates(pitch_known=pitch_known) if candidates is None else tuple(candidates)
    if len(network.cameras) > 1:
        own = network.camera_of == c
        network = replace(
            network.select(own[network.image_of]), rig=None, cameras=(camera,),
            camera_of=np.zeros(len(own), dtype=np.intp),
        )  # fmt: skip
    first = first_fit(network, [family[0] for family in families(every)], options)
    if isinstance(first, Failure) and usual and pitch_known:
        # Rays that are parallel have no perspective from which a central projection could begin.
        first = with_parallel_rays(network, PARALLEL[0], options, None)
        every = PARALLEL
    if isinstance(first, Failure):
        return first
    search = _Search(every, 0, pitch_known).from_fit(first)
    if isinstance(search, Failure):
        return search
    if not search.simple:
        # A model that does not fit may have led to poor orientations: they are computed anew with the one
        # that does.
        own = replace(network, cameras=(camera_of(search.fit, 0),))
        several = [
            first_fit(own, [search.pick], options),
            first_fit(network, [search.pick], options, anew=True),
        ]
        fresh = min(
            (fit for fit in several if isinstance(fit, BundleFit)),
            key=lambda fit: fit.cost,
            default=search.fit,
        )
        if search.fit.cost - fresh.cost > 2 * ODDS * search.variance:
            better = _Search(every, 0, pitch_known).from_fit(fresh)
            search = search if isinstance(better, Failure) else better
    if options.outliers == "reject":
        result = adjust_network(search.fit.problem.network, options)
        if isinstance(result, Failure):
            return result
        # The kind of model is as before; what the gross errors hid shows now.
        again = search.fit.problem.continued(search.fit).with_weights(result.fit.problem.weights).adjusted()
        if isinstance(again, Failure):
            return again
        search = _Search(every, 0, pitch_known).from_fit(again)
        if isinstance(search, Failure):
            return search
    if usual:
        search.add_further(network, options)
    return search


def _jointly(network: Network, alone: Sequence[_Search], options: Options) -> list[_Search] | Failure:
    """Search for the parameters of each camera in the network of all, with the kinds of models found."""
    cameras = []
    for given, search in zip(network.cameras, alone, strict=True):
        richer = search.start if search.simple else search.pick
        cameras.append(replace(camera_of(search.adjusted[richer].fit, 0), id=given.id))
    result = adjust_network(replace(network, cameras=tuple(cameras)), options)
    if isinstance(result, Failure):
        return result
    found, fit = list[_Search](), result.fit
    for c, search in enumerate(alone):
        own = [each for each in search.candidates if each.alike(search.pick)]
        joint = _Search(own, c, search.pitch_known).from_fit(fit)
        if isinstance(joint, Failure):
            return joint
        joint.before = search
        found.append(joint)
        fit = joint.fit
    return found


@dataclass(frozen=True, eq=False)
class _Adjusted:
    """An adjusted candidate, and what the images tell there; None where that is not known."""

    fit: BundleFit
    information: Information | None


@dataclass(eq=False)
class _Search:
    """Candidates for one camera of a network: those that were adjusted, and the choice from them.

    Parameters
    ----------
    candidates : sequence of Candidate
        All of them.
    camera : int
        Row of the camera.
    pitch_known : bool
        Whether the size of a pixel is known.
    """

    candidates: Sequence[Candidate]
    camera: int
    pitch_known: bool
    adjusted: dict[Candidate, _Adjusted] = field(default_factory=dict)
    declined: dict[Candidate, str] = field(default_factory=dict)
    before: _Search | None = None
    views: Rows | None = None
    loose: set[Candidate] = field(default_factory=set)
    start: Candidate = field(init=False)
    pick: Candidate = field(init=False)

    def from_fit(self, first: BundleFit) -> _Search | Failure:
        """Begin with an adjustment, of one of the candidates if possible, and search."""
        own, self.views = first.problem.network.cameras[self.camera], views_of(first)
        several = families(self.candidates)
        given = next((each for each in self.candidates if each.describes(own)), None)
        if given is not None:
            several.sort(key=lambda family: not family[0].alike(given))
            self._add(given, first)
        for family in several:
            if self.adjusted:
                break
            self._adjust(family[0], first)
        if not self.adjusted:
            return Failure("no camera model can be adjusted", Code.NOT_CONVERGED)
        self.start = next(iter(self.adjusted))
        beyond = [each for each in self.candidates if self.start.within(each) and each.alike(self.start)]
        # What parameters do that are far from zero, no linear problem tells: each next step is adjusted.
        open_ = [each for each in beyond if not any(other.within(each) for other in beyond)]
        open_ += [family[0] for family in several if not family[0].alike(self.start)]
        while True:
            self.pick = self._picked()
            known = self.pick in self.adjusted
            if open_ and (not self.simple or (known and self._pattern_left())):
                for each in open_:
                    self._adjust(each, (self._nearest(each) if each in beyond else self.best).fit)
                open_ = []
                self._look_again()
            elif known:
                return self
            else:
                self._adjust(self.pick, self._nearest(self.pick).fit)

    def add_further(self, network: Network, options: Options) -> None:
        """Compare candidates beyond the usual ones, where those give a reason to."""
        fit, series = self.fit, SERIES if self.pitch_known else ()
        flexible = surface(fit, self.camera)
        further = [*([] if flexible is None else [flexible]), *series]
        parallel = [each for each in PARALLEL if each not in self.candidates]
        self.candidates = (*self.candidates, *further, *parallel)
        for each in further:
            if self._pattern_left():
                self._adjust(each, fit)
            else:
                self.declined[each] = (
                    "not needed: the usual models leave no pattern that images have in common"
                )
        size, seen = result_of(fit).perspective(self.camera)
        for each in parallel:
            if seen:
                self.declined[each] = (
                    f"perspective is significant: 1/focal length is {size:.3g} times its sigma"
                )
            elif not self.pitch_known:
                self.declined[each] = "needs the size of a pixel"
            else:
                self._add(each, with_parallel_rays(network, each, options, fit.problem.weights))
        while (pick := self._picked()) not in self.adjusted:
            self._adjust(pick, self._nearest(pick).fit)
        self.pick = pick

    @property
    def simple(self) -> bool:
        """Whether what is chosen has no parameters beyond those with which the search began."""
        return self.pick == self.start or self.pick.within(self.start)

    @property
    def variance(self) -> float:
        """Variance factor of what is chosen."""
        known = self.adjusted[self.pick].information
        return 1.0 if known is None else known.predicted(self.pick.estimated).variance

    @property
    def fit(self) -> BundleFit:
        """Adjustment of what is chosen."""
        return self.adjusted[self.pick].fit

    @property
    def best(self) -> _Adjusted:
        """The adjustment with the least residuals."""
        return min(self.adjusted.values(), key=lambda each: each.fit.cost)

    def _look_again(self) -> None:
        """Which images are one view, now that a model fits better: what it left made others look alike."""
        views = views_of(self.best.fit)
        if self.views is None or not np.array_equal(views, self.views):
            self.views, every = views, self.adjusted
            self.adjusted = {}
            for candidate, each in every.items():
                self._add(candidate, each.fit)

    def _adjust(self, candidate: Candidate, fit: BundleFit) -> None:
        self._add(candidate, adjusted_to(fit, candidate, self.camera))

    def _add(self, candidate: Candidate, fit: BundleFit | Failure) -> None:
        if isinstance(fit, Failure):
            text = fit.reason if fit.code is Code.NOT_CONSIDERED else f"not adjusted: {fit.reason}"
            self.declined[candidate] = text
            return
        wider = wider_model(candidate.model)
        known = any(each.alike(candidate) and each.model == wider for each in self.candidates)
        told = information_of(fit, self.camera, wider if known else None, self.views)
        self.adjusted[candidate] = _Adjusted(fit, told)

    def _nearest(self, candidate: Candidate) -> _Adjusted:
        """The adjustment of its family that differs from a candidate in the fewest parameters."""
        several = [item for item in self.adjusted.items() if item[0].alike(candidate)]
        return min(several, key=lambda item: len(candidate.parts ^ item[0].parts))[1]

    def _predictions(self) -> dict[Candidate, Prediction]:
        """Predictions of all candidates that are determined, and of whose kind one was adjusted."""
        found, self.loose = dict[Candidate, Prediction](), set()
        for each in self.candidates:
            if each in self.declined or not any(own.alike(each) for own in self.adjusted):
                continue
            near = self._nearest(each).information
            if near is not None and len(near.own) >= _LEAST:
                found[each] = near.predicted(each.estimated)
                if not found[each].determined:
                    self.loose.add(each)
                    del found[each]
        return found

    def _picked(self) -> Candidate:
        """The simplest candidate than which no richer one predicts better by more than chance."""
        found = self._predictions()
        order = sorted(found, key=lambda each: found[each].parameters)
        for k, each in enumerate(order):
            better = [found[richer].better(found[each]) for richer in order[k:]]
            if max(better) <= ODDS + np.log(len(better)):
                return each
        # Too few images to leave one out.
        usual = camera_model(self.start.model).usual
        return next(
            (
                each
                for each in self.candidates
                if each.free == usual and each.alike(self.start) and each not in self.declined
            ),
            self.start,
        )

    def _pattern_left(self) -> bool:
        """Whether the residuals of what is chosen have a pattern that the images have in common."""
        return unmodelled_pattern(result_of(self.fit), self.camera) is not None

    def choice(self) -> ModelChoice:
        """Return the choice, with all candidates."""
        found, fit = self._predictions(), self.fit
        variance = found[self.pick].variance if self.pick in found else 1.0
        by_image = {each: one.log_density(variance) for each, one in found.items()}
        density = {each: float(one.sum()) for each, one in by_image.items()}
        best = max(density.values(), default=0.0)
        compared = []
        # What was chosen comes first: it may predict worse than others, by no more than chance.
        for each in sorted(
            self.candidates, key=lambda each: (each != self.pick, -density.get(each, -np.inf))
        ):
            one = found.get(each)
            if each == self.pick and one is None:
                reason = "chosen: the images are too few to compare models"
                compared.append(Compared(each, reason, fit.sigma0, fit.cost, np.nan))
            elif one is None:
                beside = f"not needed: {self.start.label} leaves nothing that the images have in common"
                if each in self.loose:
                    beside = "the images do not determine all its parameters"
                reason = self.declined.get(
                    each, beside if found else "the images are too few to compare models"
                )
                compared.append(Compared(each, reason, np.nan, np.nan, np.nan))
            else:
                compared.append(self._compared(each, one, found[self.pick], 2 * (best - density[each])))
        chosen = next(each for each in compared if each.candidate == self.pick)
        if self.before is None:
            rivals = self._rivals(found, by_image)
        else:
            alone, known = self.before.choice(), {each.candidate for each in compared}
            compared += [each for each in alone.compared if each.candidate not in known]
            rivals = alone.rivals
        return ModelChoice(camera_of(fit, self.camera), tuple(compared), chosen, rivals)

    def _rivals(
        self, found: Mapping[Candidate, Prediction], by_image: Mapping[Candidate, Array]
    ) -> tuple[Rival, ...]:
        """The best candidate of each kind but that of the chosen one, with its probability.

        The images are few: which kinds others would have preferred is the mean over how often each of these
        could have been taken (Yao, Vehtari, Simpson & Gelman 2018, *Bayesian Anal.* 13: pseudo-BMA+).
        """
        if self.pick not in by_image:
            return ()
        order, kinds = sorted(by_image, key=lambda each: -float(by_image[each].sum())), list[Candidate]()
        for each in order:
            kinds += [each] if not any(each.alike(other) for other in kinds) else []
        each_image = np.stack([by_image[each] for each in kinds])
        images = each_image.shape[1]
        often = images * np.random.default_rng(0).dirichlet(np.ones(images), _DRAWS)
        probability = scipy.special.softmax(often @ each_image.T, axis=1).mean(axis=0)
        return tuple(
            Rival(float(p), self._mapping(each, found[each]), self._entry(each))
            for each, p in zip(kinds, probability, strict=True)
            if p > _NOTHING and not each.alike(self.pick)
        )

    def _compared(self, own: Candidate, one: Prediction, chosen: Prediction, length: float) -> Compared:
        """Compare a candidate with the chosen one."""
        information = self._nearest(own).information
        assert information is not None
        left = information.redundancy - one.parameters
        sigma0 = float(np.sqrt(one.cost / left)) if left > 0 else np.nan
        predicted = float(np.sqrt(one.squares.sum() / information.count))
        p, more = np.nan, abs(one.parameters - chosen.parameters)
        if (own.within(self.pick) or self.pick.within(own)) and more > 0:
            f = abs(one.cost - chosen.cost) / more / one.richer(chosen).variance
            p = float(scipy.special.fdtrc(more, max(left, 1.0), f))
        found = Compared(
            own, "", sigma0, one.cost, length, predicted, p, **self._difference(own, one, chosen)
        )
        return replace(found, reason=self._reason(found, one, chosen))

    def _reason(self, found: Compared, one: Prediction, chosen: Prediction) -> str:
        """Say why a candidate was chosen, or not."""
        gain = one.better(chosen)
        if found.candidate == self.pick:
            return "chosen: none with more parameters predicts images better"
        if found.candidate.within(self.pick):
            return f"too simple: predicts images worse, the parameters that it lacks have p = {found.p:.2g}"
        how = "no better than chance" if gain > 0 else "worse"
        if self.pick.within(found.candidate):
            return f"too many parameters: predicts images {how}"
        more = "more parameters, and " if one.parameters > chosen.parameters and gain > 0 else ""
        return f"{more}predicts images {how}"

    def _mapping(self, own: Candidate, one: Prediction) -> CameraMapping:
        """The camera with the parameters by which images were predicted."""
        fit = self._nearest(own).fit
        if own.additional is not None:
            return mapping_of(fit, self.camera)
        given, model = fit.problem.network.cameras[self.camera], camera_model(own.model)
        values = one.values[: len(model.names)]
        at = np.array([model.names.index(name) for name in own.free], dtype=np.intp)
        return CameraMapping(
            model.mapping(values, given.grid, own.options), given.width, given.height, at,
            one.covariance[np.ix_(at, at)],
        )  # fmt: skip

    def _entry(self, own: Candidate) -> dict[str, Any]:
        """The model as in a calibration."""
        camera = self._nearest(own).fit.problem.network.cameras[self.camera]
        if own.additional is None:
            camera = replace(camera, additional=None)
        return {**model_entry(camera), "model": own.model, **own.options}

    def _difference(self, own: Candidate, one: Prediction, chosen: Prediction) -> dict[str, float]:
        """Difference of a camera from the chosen one over the image, and what it means."""
        if own == self.pick:
            return {"rms_px": 0.0, "corner_px": 0.0, "share": 0.0}
        best, other = self._mapping(self.pick, chosen), self._mapping(own, one)
        try:
            with np.errstate(all="ignore"):
                field_ = calibration_difference(best, other, _ACROSS)
        except UsageError:
            # They have no rays in common: linear problems end anywhere with models that are far from right.
            return {}
        size = np.hypot(field_.difference[..., 0], field_.difference[..., 1])
        richer = best if len(best.rows) >= len(other.rows) else other
        sigma = projection_field(richer, _ACROSS).sigma
        corners = [(0, 0), (0, -1), (-1, 0), (-1, -1)]
        known = [place for place in corners if np.isfinite(size[place])]
        worst = max(known, key=lambda place: float(size[place]), default=None)
        seen = np.isfinite(size) & np.isfinite(sigma)
        limit = np.sqrt(scipy.special.chdtri(2, _LEVEL))
        return {
            "rms_px": float(np.sqrt(np.nanmean(size**2))),
            "corner_px": np.nan if worst is None else float(size[worst]),
            "corner_sigma_px": np.nan if worst is None else float(sigma[worst]),
            "share": float((size[seen] > limit * sigma[seen]).mean()) if seen.any() else np.nan,
        }


def camera_of(fit: BundleFit, c: int) -> Camera:
    """A camera with its estimates as approximate values; observed parameters keep what was observed."""
    camera = fit.problem.network.cameras[c]
    observed = np.array([name in camera.sigma for name in camera.names])
    values = np.where(observed, camera.values, fit.values.cameras[c, : len(observed)])
    return replace(camera, values=values)
