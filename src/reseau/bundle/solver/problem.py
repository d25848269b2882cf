"""A network as a problem of :mod:`reseau.adjust`: the same statistics, another solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...adjust import AdjustmentFailure
from ...adjust import Options as AdjustOptions
from ...adjust.fitted import Fitted
from ...adjust.stochastic import Weighting
from ...core.data import Array, Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ...core.threads import one_thread
from ..network import Network
from ..network.network import Usable, finite, usable
from .arrow import Singular
from .datum import Freedom, freedom_of, held_minimally, similarity_onto
from .iteration import Iterated, iterate
from .observations import OtherObservations
from .posterior import BlockSolution, Cofactors, cofactors_of
from .rank import creeping_points, steady_points, undetermined, weak_points
from .system import Linear, System, residuals
from .unknowns import Unknowns
from .values import Values

__all__ = ["BundleFit", "BundleProblem"]

# Options of the dense engine that this solver does not have, and their defaults.
_NOT_HERE, _USUAL = ("method", "curvature", "rank_tolerance", "check_jacobian"), AdjustOptions()
# Initial damping, relative to the diagonal of the normal equations.
_DAMPING = 1e-5
# Points that run off to infinity are left out at most this many times.
_ROUNDS = 12
# Corrections tried after which an adjustment that has not converged is asked for points that creep.
_ENOUGH = 50


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """All observations of a network in one column, with approximate values.

    Image coordinates come first, x and y in turn, then distances, observed coordinates, observed interior
    orientation, one by one or jointly, readings and axis of a stage. It is an
    :class:`~reseau.adjust.fitted.Adjustable`: robust estimation, data snooping and variance components of
    :mod:`reseau.adjust` take it as any other problem.

    Parameters
    ----------
    network : Network
        What was observed.
    start : Values
        Approximate values, NaN where there are none; coordinates of known points as the network has them.
    reference : ndarray (p, 3)
        Coordinates that inner constraints refer to.
    weights : ndarray (N,), optional
        Factors on the weights.
    max_iterations : int
        Corrections tried at most.
    tolerance : float
        See :func:`~reseau.bundle.solver.iteration.iterate`.
    watch : callable, optional
        Told the number of corrections and vᵀPv after each.
    rounds : int
        How often points have been left out that ran off to infinity.

    Examples
    --------
    >>> from reseau.bundle import example_network, problem_of
    >>> problem, _ = problem_of(example_network())
    >>> len(problem.observations), bool(problem.adjusted())
    (320, True)
    """

    network: Network
    start: Values
    reference: Array
    weights: Array | None = None
    max_iterations: int = 200
    tolerance: float = 1e-6
    watch: Callable[[int, float], None] | None = None
    rounds: int = 0

    @cached_property
    def centre(self) -> Array:
        """Middle of the points (3,): coordinates are reckoned from it, so that large ones lose nothing."""
        known = self.start.xyz[finite(self.start.xyz)]
        centre: Array = known.mean(axis=0) if len(known) else np.zeros(3)
        return centre

    @cached_property
    def others(self) -> OtherObservations:
        """Observations other than image coordinates, of all points; coordinates from the centre."""
        every = np.ones(len(self.network.points), dtype=bool)
        return OtherObservations.of(self.network, every, self.network.xyz - self.centre)

    @cached_property
    def observations(self) -> NDArray[Any]:
        """All observations (N,); coordinates are reckoned from the centre."""
        return np.concatenate([self.network.xy.ravel(), self.others.value])

    @property
    def covariance(self) -> list[Array]:
        """Covariances: blocks (n, 2, 2), and standard deviations."""
        return [self.network.cov, self.others.sigma]

    @cached_property
    def marks(self) -> NDArray[np.intp]:
        """The two coordinates of an image point leave together."""
        n, more = len(self.network.xy), len(self.others.value)
        return np.concatenate([np.repeat(np.arange(n), 2), n + np.arange(more)])

    @cached_property
    def groups(self) -> NDArray[np.intp]:
        """The object point of each observation: errors of different points hardly know of each other."""
        points = len(self.network.points)
        more = points + np.arange(len(self.others.value))
        return np.concatenate([np.repeat(self.network.point_of, 2), more])

    def with_weights(self, weights: ArrayLike | None) -> Self:
        """The same problem with other factors on the weights."""
        return replace(self, weights=None if weights is None else np.asarray(weights, dtype=np.float64))

    def continued(self, fit: BundleFit) -> Self:
        """The same problem, begun at the estimates; points without any keep their approximate values."""
        part, images = fit.usable.points[:, None], fit.usable.images
        start = replace(
            fit.values,
            rotation=np.where(images[:, None, None], fit.values.rotation, self.start.rotation),
            x0=np.where(images[:, None], fit.values.x0, self.start.x0),
            xyz=np.where(part, fit.values.xyz, self.start.xyz),
            extra=fit.values.extra if fit.values.extra.shape == self.start.extra.shape else self.start.extra,
        )
        return replace(self, start=start)

    def misfits_at_start(self) -> Array:
        """Weighted misfits (n, 2) of the image coordinates at the approximate values, NaN without any."""
        network, start = self.network, self.start
        known = finite(start.x0)[network.image_of] & finite(start.xyz)[network.point_of]
        rows, v = np.flatnonzero(known), np.full((len(known), 2), np.nan)
        unknowns = Unknowns.of(network, finite(start.x0))
        root = Weighting([network.cov]).roots[0].matrices
        v[rows] = (root[rows] @ residuals(network, unknowns, rows, start)[:, :, None])[:, :, 0]
        return v

    def adjusted(self, options: AdjustOptions | None = None) -> BundleFit | Failure:
        """Adjust the network.

        Parameters
        ----------
        options : reseau.adjust.Options, optional
            All its fields count, in place of `max_iterations` and `tolerance` of the problem. By default
            these, an initial damping of 1e-5, and covariances a posteriori.

        Raises
        ------
        UsageError
            For an option that this solver does not have: another method than Levenberg–Marquardt, a bound of
            the curvature, a rank tolerance, a check of derivatives.
        """
        if options is None:
            return self._adjusted(
                AdjustOptions(max_iterations=self.max_iterations, tolerance=self.tolerance, damping=_DAMPING)
            )
        for name in _NOT_HERE:
            if getattr(options, name) != getattr(_USUAL, name):
                raise UsageError(
                    f"is no option of a bundle adjustment: {getattr(options, name)!r}",
                    where=f"Options.{name}",
                    do="leave it at its default",
                )
        return self._adjusted(options)

    def _adjusted(self, options: AdjustOptions) -> BundleFit | Failure:
        with one_thread():
            return _Run(self, options).adjust()


@dataclass(frozen=True, eq=False)
class BundleFit(Fitted):
    """A bundle adjustment that converged; truthy.

    What stands in columns over the observations has the order of :class:`BundleProblem`; residuals of what
    was not determined are NaN.

    Parameters
    ----------
    problem : BundleProblem
        What was adjusted.
    values : Values
        Estimates, in the system of the network.
    unknowns : Unknowns
        Columns of the reduced cofactors, of the observations that took part.
    usable : Usable
        What took part.
    freedom : Freedom
        Similarities left free by the observations.
    cofactors : Cofactors
        Of unknowns and adjusted observations; rotations about the axes of their cameras.
    linear : Linear
        The linear problem at the estimates.
    sigma0, redundancy, cost, residuals, iterations, costs, solution, scale
        As in :class:`~reseau.adjust.Adjustment`.
    offset : float
        Corrections still to come, in standard deviations.
    counts : tuple of int
        Observations, unknowns before datum constraints, datum constraints.
    datum : ndarray of bool (p,), optional
        Points over which inner constraints hold: those chosen, or all but the weak ones.

    Examples
    --------
    >>> from reseau.bundle import example_network, problem_of
    >>> problem, _ = problem_of(example_network())
    >>> fit = problem.adjusted()
    >>> fit.counts, fit.redundancy, round(fit.sigma0, 3)
    ((320, 112, 7), 215, 1.005)
    """

    problem: BundleProblem
    values: Values
    unknowns: Unknowns
    usable: Usable
    freedom: Freedom
    cofactors: Cofactors
    linear: Linear
    sigma0: float
    redundancy: int
    cost: float
    residuals: Array
    iterations: int
    costs: tuple[float, ...]
    solution: BlockSolution
    scale: str
    offset: float
    counts: tuple[int, int, int]
    datum: Mask | None = None

    @property
    def variance(self) -> float:
        """Factor of the cofactors in covariances: sigma0² a posteriori, one a priori."""
        return self.sigma0**2 if self.scale == "a-posteriori" else 1.0


class _Run:
    """One adjustment of a network on its way."""

    def __init__(self, problem: BundleProblem, options: AdjustOptions) -> None:
        self.problem, self.options, whole = problem, options, problem.network
        n, size = len(whole.xy), len(problem.observations)
        weights = np.ones(size) if problem.weights is None else problem.weights
        pairs = weights[: 2 * n].reshape(n, 2)
        self.usable = usable(whole, np.asarray((pairs > 0).all(axis=1)), problem.start.x0, problem.start.xyz)
        part = self.usable.points
        bars = part[whole.distance_of].all(axis=1) & (weights[2 * n :][: len(whole.distance)] > 0)
        self.network = replace(
            whole.select(self.usable.observations),
            distance_of=whole.distance_of[bars],
            distance=whole.distance[bars],
        )
        more = problem.others
        used = np.bincount(whole.camera_of[self.usable.images], minlength=len(whole.cameras)) > 0
        coordinate, interior = part[more.coordinate[:, 0]], used[more.interior[:, 0]]
        joint = used[more.joint]
        read = self.usable.images[more.reading]
        axis = np.ones(more.across.shape[1], dtype=bool)
        self.in_others = np.concatenate([bars, coordinate, interior, joint, read, axis])
        self.weights = np.concatenate(
            [
                np.where(self.usable.observations[:, None], pairs, 0.0).ravel(),
                np.where(self.in_others, weights[2 * n :], 0.0),
            ]
        )
        self.weighting = Weighting([whole.cov], self.weights[: 2 * n])
        self.unknowns = Unknowns.of(self.network, self.usable.images)
        others = OtherObservations(
            self.network.distance_of,
            more.coordinate[coordinate],
            more.interior[interior],
            more.joint[joint],
            more.combination[joint],
            more.reading[read],
            more.across,
            more.value[self.in_others],
            more.sigma[self.in_others],
        )
        mine = Weighting(
            [self.network.cov], self.weights[: 2 * n].reshape(n, 2)[self.usable.observations].ravel()
        )
        factors = self.weights[2 * n :][self.in_others]
        self.system = System(self.unknowns, others, mine, factors, self.unknowns.dropped.copy())

    def adjust(self) -> BundleFit | Failure:
        problem, network = self.problem, self.network
        if not self.usable.images.any():
            return Failure(
                "no image has three points whose position in space is known or can be computed",
                Code.TOO_FEW_POINTS,
            )
        start = self._start()
        freedom = freedom_of(self.system, start, self.usable.points)
        if network.datum == "control" and freedom.defect:
            return Failure(
                f"rank defect {freedom.defect}: nothing determines {', '.join(freedom.names)}; "
                "give control points or distances, or a datum that is minimal or free",
                Code.NO_DATUM,
            )
        if network.datum == "minimal":
            self.system.held[held_minimally(freedom, self.unknowns, start)] = True
        counts = self._counts(freedom)
        redundancy = counts[0] - counts[1] + counts[2]
        if redundancy < 0:
            return Failure(
                f"{counts[0]} observations for {counts[1]} unknowns and {counts[2]} constraints",
                Code.NO_REDUNDANCY,
            )
        found = iterate(
            self.system, start, redundancy=redundancy, max_iterations=self.options.max_iterations,
            tolerance=self.options.tolerance, damping=self.options.damping, watch=problem.watch,
        )  # fmt: skip
        if isinstance(found, Failure):
            return found
        # What hardly any angle determines creeps on for ever, and what it creeps on is noise.
        away = found.away if found.converged else self._creeping(found)
        if len(away) and problem.rounds < _ROUNDS:
            again = self._without(away, found.values)._adjusted(self.options)
            if found.converged or again:
                return again
        if not found.converged:
            reason = f"not converged in {found.iterations} iterations"
            return AdjustmentFailure(
                reason, Code.NOT_CONVERGED, iterations=found.iterations, costs=found.costs
            )
        values, inner = found.values, network.datum == "free" and freedom.defect > 0
        chosen = network.datum_points & self.usable.points
        if inner:
            if int(chosen.sum()) < 3:
                return Failure(
                    "inner constraints need three datum points that are determined", Code.TOO_FEW_POINTS
                )
            if network.datum_points.all():
                chosen = steady_points(self.system.linearise(values), chosen)
            values = self._aligned(values, freedom, chosen)
        linear = self.system.linearise(values)
        freedom = freedom_of(self.system, values, self.usable.points)
        try:
            cofactors = cofactors_of(linear, freedom, chosen if inner else None, self.usable.points)
        except Singular:
            weak = weak_points(linear)
            if len(weak) and problem.rounds < _ROUNDS:
                return self._without(weak, values)._adjusted(self.options)
            return undetermined(linear, freedom, tuple(found.costs))
        return self._fit(linear, freedom, cofactors, counts, found, chosen if inner else None)

    def _creeping(self, found: Iterated) -> Rows:
        """Points without which an iteration that was given time enough may come to its end."""
        none = np.zeros(0, dtype=np.intp)
        return creeping_points(found.linear) if found.iterations >= _ENOUGH else none

    def _without(self, points: Rows, values: Values) -> BundleProblem:
        """The problem begun at the estimates, without points whose rays turn out to be parallel."""
        start, images = self.problem.start, self.usable.images
        xyz = np.where(self.usable.points[:, None], values.xyz + self.problem.centre, start.xyz)
        xyz[points] = np.nan
        rotation = np.where(images[:, None, None], values.rotation, start.rotation)
        x0 = np.where(images[:, None], values.x0 + self.problem.centre, start.x0)
        start = replace(values, rotation=rotation, x0=x0, xyz=xyz)
        return replace(self.problem, start=start, rounds=self.problem.rounds + 1)

    def _start(self) -> Values:
        """Approximate values from the centre, of all that takes part; the rest is out of the way."""
        start, centre = self.problem.start, self.problem.centre
        known = finite(start.x0)
        extra = start.extra
        if extra.shape[0] != max(1, len(self.unknowns.extra)):
            extra = np.zeros((max(1, len(self.unknowns.extra)), extra.shape[1]))
        rotation = np.where(known[:, None, None], start.rotation, np.eye(3))
        x0 = np.where(known[:, None], start.x0 - centre, 0.0)
        return replace(start, rotation=rotation, x0=x0, xyz=np.nan_to_num(start.xyz - centre), extra=extra)

    def _counts(self, freedom: Freedom) -> tuple[int, int, int]:
        """Observations, unknowns before datum constraints, datum constraints."""
        network, part = self.network, self.usable.points
        observations = int((self.weights > 0).sum())
        free = ~network.held & part[:, None]
        kept = self.unknowns.kept >= 0
        size = self.unknowns.size if self.system.constraints is None else self.system.constraints.size
        unknowns = size - int(self.unknowns.dropped.sum()) - 3 * int(kept.sum()) + int(free.sum())
        return observations, unknowns, freedom.defect if network.datum != "control" else 0

    def _aligned(self, values: Values, freedom: Freedom, chosen: Mask) -> Values:
        """The estimates carried to where the chosen points are nearest their approximate coordinates."""
        if freedom.defect < 6:
            return values
        reference = self.problem.reference - self.problem.centre
        chosen = chosen & finite(reference)
        scaled = freedom.defect == 7
        return similarity_onto(values, np.nan_to_num(reference), chosen, scaled=scaled)(values)

    def _fit(
        self,
        linear: Linear,
        freedom: Freedom,
        cofactors: Cofactors,
        counts: tuple[int, int, int],
        found: Iterated,
        datum: Mask | None,
    ) -> BundleFit:
        redundancy, cost = counts[0] - counts[1] + counts[2], linear.cost
        whole, n = self.problem.network, len(self.problem.network.xy)
        rows = np.flatnonzero(self.usable.observations)[self.unknowns.order]
        hats = np.zeros((n, 2, 2))
        hats[rows] = cofactors.seen
        residuals = self._residuals(linear.values)
        counted = np.where(self.weights > 0, residuals, 0.0)
        others = np.zeros(len(self.in_others))
        others[self.in_others] = cofactors.others
        second = Weighting([self.problem.others.sigma[:, None, None] ** 2], self.weights[2 * n :])
        weightings = [self.weighting, second] if len(others) else [self.weighting]
        whitened = np.concatenate([self.weighting.whiten(counted[: 2 * n]), second.whiten(counted[2 * n :])])
        solution = BlockSolution.of(weightings, whitened, [hats, others[:, None, None]][: len(weightings)])
        centre, values = self.problem.centre, linear.values
        xyz = np.where(self.usable.points[:, None], values.xyz + centre, np.nan)
        xyz = np.where(whole.held & self.usable.points[:, None], whole.xyz, xyz)
        images = self.usable.images
        x0 = np.where(images[:, None], values.x0 + centre, np.nan)
        rotation = np.where(images[:, None, None], values.rotation, np.nan)
        return BundleFit(
            problem=self.problem,
            values=replace(values, rotation=rotation, x0=x0, xyz=xyz),
            unknowns=self.unknowns,
            usable=self.usable,
            freedom=freedom,
            cofactors=cofactors,
            linear=linear,
            sigma0=float(np.sqrt(cost / redundancy)) if redundancy > 0 else float("nan"),
            redundancy=redundancy,
            cost=cost,
            residuals=residuals,
            iterations=found.iterations,
            costs=found.costs,
            solution=solution,
            scale=self.options.scale if redundancy > 0 else "a-priori",
            offset=found.offset,
            counts=counts,
            datum=datum,
        )

    def _residuals(self, values: Values) -> Array:
        """v of all observations (N,); NaN where image or point is not determined."""
        whole = self.problem.network
        rows = np.flatnonzero(self.usable.images[whole.image_of] & self.usable.points[whole.point_of])
        v = np.full((len(whole.xy), 2), np.nan)
        v[rows] = residuals(whole, self.unknowns, rows, values)
        more = self.problem.others
        others = np.where(self.in_others, more.computed(values) - more.value, np.nan)
        return np.concatenate([v.ravel(), others])
