"""A network as a problem of :mod:`reseau.adjust`, with a sparse solver and the same statistics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from ...adjust import Options as AdjustOptions
from ...adjust.engine import AdjustmentFailure
from ...adjust.fitted import Fitted
from ...adjust.stochastic import Weighting
from ...core.data import Array, Mask, Rows
from ...core.display import Display
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ...core.memory import available_memory
from ...core.threads import one_thread
from ..network.network import Network, Usable, finite, usable
from .arrow import Singular
from .datum import Freedom, freedom_of, held_minimally, scaled_by_windows, similarity_onto
from .implicit import normal_of
from .iteration import Iterated, iterate
from .linear import Linear, linearised
from .noise import determined_by_noise
from .observations import OtherObservations
from .posterior import BlockSolution, Cofactors, cofactors_of
from .rank import (
    SCALE_OF_WINDOWS,
    axis_without_effect,
    missing_windows,
    points_from_one_place,
    poorly_determined_points,
    steady_points,
    undetermined,
    weak_images,
    weak_points,
    why_without_effect,
    without_effect,
)
from .system import System, residuals
from .unknowns import Unknowns
from .values import Values

# Initial damping, relative to the diagonal of the normal equations.
_DAMPING = 1e-5
# Maximum number of rounds in which points that diverge to infinity are left out.
LAST_ROUND = 12
# Iterations, and relative offset, of the first adjustment with windows and media as given.
_BEFORE_WINDOWS, _ROUGHLY = 30, 1e-2
# Relative standard deviation of a scale above which covariances of first order say nothing about it.
_LOOSE = 0.2
# Copies of the full matrix in memory while its eigenvectors are computed.
_FULL_COPIES = 6
# What is wrong where conjugate gradients do not reach their accuracy at the estimates, or where the matrix is
# singular and there is no memory to name the unknowns.
_WEAK = (
    "the observations determine the images too weakly for the normal equations, or not at all: are all of "
    "them connected? With more memory for the normal equations the unknowns would be named"
)
# Iterations after which poorly determined points of an adjustment that has not converged are left out.
_SLOW = 50
# Redundancy from which sigma0, uncertain by a tenth, is taken as it is.
_FEW = 50


@dataclass(frozen=True, eq=False, repr=False)
class BundleProblem(Display):
    """All observations of a network in one column, with approximate values.

    Image coordinates come first, x and y alternating, then distances, observed coordinates, observed interior
    orientation (single parameters, then joint), windows and media, motion of the images, readings and axis of
    a stage. It is an
    :class:`~reseau.adjust.fitted.Adjustable`: robust estimation, data snooping and variance components of
    :mod:`reseau.adjust` apply to it as to any other problem.

    Parameters
    ----------
    network : Network
        Network to adjust.
    start : Values
        Approximate values, NaN where unknown; known points have the coordinates of the network.
    reference : ndarray (p, 3)
        Coordinates that inner constraints refer to.
    weights : ndarray (N,), optional
        Factors on the weights.
    max_iterations : int
        Maximum number of iterations.
    tolerance : float
        See :func:`~reseau.bundle.solver.iteration.iterate`.
    watch : callable, optional
        Called with the number of iterations and vᵀPv after each iteration.
    rounds : int
        Number of rounds so far in which diverging points were left out.
    memory : float, optional
        Memory (bytes) that normal equations and their factors may take; by default half of what is available.
        Where they need more, they are solved by conjugate gradients.

    Examples
    --------
    >>> from reseau.bundle import example_network, problem_of
    >>> problem, _ = problem_of(example_network())
    >>> problem
    <BundleProblem: 8 images, 20 points, 320 observations>
    """

    network: Network
    start: Values
    reference: Array
    weights: Array | None = None
    max_iterations: int = 200
    tolerance: float = 1e-6
    watch: Callable[[int, float], None] | None = None
    rounds: int = 0
    memory: float | None = None

    def _facts(self) -> list[tuple[str, str]]:
        images, points = len(self.network.images), len(self.network.points)
        return [
            (f"{images} images", ""),
            (f"{points} points", ""),
            (f"{len(self.observations)} observations", ""),
        ]

    @cached_property
    def centre(self) -> Array:
        """Centroid of the points (3,), the origin of reduced coordinates: large ones keep their precision."""
        known = self.start.xyz[finite(self.start.xyz)]
        return known.mean(axis=0) if len(known) else np.zeros(3)

    @cached_property
    def others(self) -> OtherObservations:
        """Observations other than image coordinates, of all points; with reduced coordinates."""
        every = np.ones(len(self.network.points), dtype=bool)
        return OtherObservations.of(self.network, every, self.network.xyz - self.centre, self.centre)

    @cached_property
    def observations(self) -> NDArray[Any]:
        """All observations (N,), with reduced coordinates."""
        return np.concatenate([self.network.xy.ravel(), self.others.value])

    @property
    def covariance(self) -> list[Array]:
        """Covariances: blocks (n, 2, 2), and standard deviations."""
        return [self.network.cov, self.others.sigma]

    @cached_property
    def marks(self) -> NDArray[np.intp]:
        """Number of the mark of each observation: x and y of an image point are rejected together."""
        n, more = len(self.network.xy), len(self.others.value)
        return np.concatenate([np.repeat(np.arange(n), 2), n + np.arange(more)])

    @cached_property
    def groups(self) -> NDArray[np.intp]:
        """Object point of each observation: errors of different points hardly affect each other.

        Distances are one group: a wrong one changes the scale, and with it the residuals of all others.
        """
        points, bars = len(self.network.points), self.others.slices[0].stop
        more = points + np.maximum(np.arange(len(self.others.value)) - bars + 1, 0)
        return np.concatenate([np.repeat(self.network.point_of, 2), more])

    @property
    def limit(self) -> float:
        """Memory (bytes) that normal equations and their factors may take."""
        return available_memory() / 2 if self.memory is None else self.memory

    @property
    def too_large(self) -> str:
        """What is said where normal equations are solved by conjugate gradients; empty where they are not."""
        unknowns, limit = Unknowns.of(self.network, finite(self.start.x0)), self.limit
        if self.network.rig is not None or self.network.stage is not None:
            return ""
        if unknowns.bytes_of_factors <= limit:
            return ""
        return (
            f"the normal equations of {unknowns.size} unknowns beside the points would take "
            f"{unknowns.bytes_of_factors / 1e9:.3g} GB of memory, more than {limit / 1e9:.3g} GB"
        )

    def with_weights(self, weights: ArrayLike | None) -> Self:
        """Return the problem with other factors on the weights."""
        return replace(self, weights=None if weights is None else np.asarray(weights, dtype=np.float64))

    def continued(self, fit: BundleFit) -> Self:
        """Return the problem with the estimates as approximate values, where there are estimates."""
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
        """Weighted misfits (n, 2) of the image coordinates at the approximate values; NaN without these."""
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
            Replaces `max_iterations` and `tolerance` of the problem. By default these are used, with an
            initial damping of 1e-5 and covariances a posteriori.

        Raises
        ------
        UsageError
            For an option that this solver does not support: a method other than Levenberg–Marquardt, a bound
            of the curvature, a rank tolerance, a check of derivatives.
        """
        if options is None:
            return self._adjusted(
                AdjustOptions(max_iterations=self.max_iterations, tolerance=self.tolerance, damping=_DAMPING)
            )
        if options.rank_tolerance is not None:
            raise UsageError("is not supported by the bundle adjustment", where="Options.rank_tolerance")
        return self._adjusted(options)

    def approached(self, max_iterations: int) -> Values | None:
        """Return approximate values after some iterations, converged or not; None where they fail."""
        with one_thread():
            return _Run(self, AdjustOptions(max_iterations=max_iterations, damping=_DAMPING)).approach()

    def linearised(self) -> Linear:
        """Return the linear problem at the approximate values, of all observations that can be used."""
        with one_thread():
            run = _Run(self, AdjustOptions())
            return linearised(run.system, run.start())

    def _adjusted(self, options: AdjustOptions) -> BundleFit | Failure:
        with one_thread():
            return _Run(self, options).adjust()


@dataclass(frozen=True, eq=False, repr=False)
class BundleFit(Fitted, Display):
    """A bundle adjustment that converged; truthy.

    Columns over the observations have the order of :class:`BundleProblem`; undetermined residuals are NaN.

    Parameters
    ----------
    problem : BundleProblem
        The adjusted problem.
    values : Values
        Estimates, in the coordinate system of the network.
    unknowns : Unknowns
        Columns of the reduced cofactors, for the observations that were used.
    usable : Usable
        Observations, images and points that were used.
    freedom : Freedom
        Similarity transformations that the observations do not determine.
    cofactors : Cofactors
        Of unknowns and adjusted observations; rotations are about the camera axes.
    linear : Linear
        The linear problem at the estimates.
    sigma0, redundancy, cost, residuals, iterations, costs, solution, scale
        As in :class:`~reseau.adjust.Adjustment`.
    offset : float
        Size of the next correction, in standard deviations.
    counts : tuple of int
        Observations, unknowns before datum constraints, datum constraints.
    datum : ndarray of bool (p,), optional
        Points of the inner constraints: the chosen ones, or all except weak points.

    Examples
    --------
    >>> from reseau.bundle import example_network, problem_of
    >>> problem, _ = problem_of(example_network())
    >>> fit = problem.adjusted()
    >>> fit
    <BundleFit: sigma0 1.005, redundancy 215, ... iterations>
    >>> fit.counts
    (320, 112, 7)
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

    def _facts(self) -> list[tuple[str, str]]:
        return [
            ("sigma0", f"{self.sigma0:.3f}"),
            ("redundancy", f"{self.redundancy}"),
            (f"{self.iterations} iterations", ""),
        ]

    @property
    def variance(self) -> float:
        """Variance factor of covariances: sigma0² a posteriori, one a priori.

        A few observations do not say how large sigma0 is: what is known beforehand counts, too.
        """
        if self.scale != "a-posteriori":
            return 1.0
        return expected_variance(self.cost, self.redundancy) if 0 < self.redundancy < _FEW else self.sigma0**2


def expected_variance(square: float, redundancy: int) -> float:
    """Expected variance factor, never below sigma0².

    Standard deviations of the observations are known to a third (an inverse gamma distribution), or with one
    in a hundred not at all (a factor from a ten-thousandth to ten thousand).
    """
    n, r, square = 2.0 / 0.6**2, float(redundancy), max(square, 1e-300)
    gamma = scipy.special.gammaln
    known = gamma((n + r) / 2) - gamma(n / 2) + n / 2 * np.log(n / 2) - (n + r) / 2 * np.log((n + square) / 2)
    unknown = gamma(r / 2) - r / 2 * np.log(square / 2) - np.log(4 * np.log(1e4))
    share = float(scipy.special.expit(known - unknown + np.log(99.0)))
    return max(share * (n + square) / (n + r) + (1 - share) * square / r, square / r)


class _Run:
    """State of one adjustment."""

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
        windows = np.ones(len(more.refraction), dtype=bool)
        moved = self.usable.images[more.motion[:, 0]]
        read, staged = self._read(more.reading)
        tilt, shift = (part if staged else part[:, :0] for part in (more.tilt, more.shift))
        axis = np.full(more.tilt.shape[1] + more.shift.shape[1], staged)
        bases = self._connected(more.bases)
        self.in_others = np.concatenate(
            [bars, coordinate, interior, joint, windows, moved, read, axis, bases]
        )
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
            more.refraction,
            more.motion[moved],
            more.reading[read],
            tilt,
            shift,
            more.nominal,
            more.bases[bases],
            more.value[self.in_others],
            more.sigma[self.in_others],
        )
        mine = Weighting(
            [self.network.cov], self.weights[: 2 * n].reshape(n, 2)[self.usable.observations].ravel()
        )
        factors = self.weights[2 * n :][self.in_others]
        self.system = System(
            self.unknowns, others, mine, factors, self.unknowns.dropped.copy(), problem.centre
        )
        if self.system.constraints is None:
            self.system.iterative = self.unknowns.bytes_of_factors > problem.limit

    def _read(self, reading: Rows) -> tuple[Mask, bool]:
        """Which images with an observed reading of a stage count, and whether any image on the stage does."""
        stage, images = self.problem.network.stage, self.usable.images
        if stage is None:
            return np.zeros(0, dtype=bool), False
        first = self.problem.network.same_reading
        seen = np.bincount(first[images & (stage.pose >= 0)], minlength=len(first)) > 0
        return np.asarray(seen[reading]), bool(seen.any())

    def _connected(self, bases: Rows) -> Mask:
        """Whether the cameras of known bases (b, 2) are connected by adjusted images."""
        rig = self.problem.network.rig
        if rig is None:
            return np.zeros(0, dtype=bool)
        seen = np.bincount(rig.camera[self.usable.images & (rig.exposure >= 0)], minlength=len(rig.camera))
        reference = rig.references(self.usable.images)
        return np.array(
            [seen[a] > 0 and seen[b] > 0 and reference[a] == reference[b] for a, b in bases], dtype=bool
        )

    def adjust(self) -> BundleFit | Failure:
        problem, network = self.problem, self.network
        if not self.usable.images.any():
            return Failure(
                "no image could be oriented: where its pose is not given, it takes four points with known or "
                "computable coordinates, of which three leave up to four poses",
                Code.TOO_FEW_POINTS,
            )
        astray = self._without_axes()
        if astray is not None:
            return astray
        start = self.start()
        alone = points_from_one_place(self.system, start)
        if len(alone) and problem.rounds < LAST_ROUND:
            return self._without(alone, start)._adjusted(self.options)
        freedom = freedom_of(self.system, start, self.usable.points)
        if network.datum == "control" and freedom.defect:
            return Failure(
                f"rank defect {freedom.defect}: {', '.join(freedom.names)} not determined; "
                "give control points or distances, or use the datum `minimal` or `free`",
                Code.NO_DATUM,
            )
        loose = self._without_axis(start)
        if loose is not None:
            return loose
        self._fix(freedom, start)
        counts = self._counts(freedom)
        redundancy = counts[0] - counts[1] + counts[2]
        if redundancy < 0:
            return Failure(
                f"{counts[0]} observations for {counts[1]} unknowns and {counts[2]} constraints",
                Code.NO_REDUNDANCY,
            )
        start = self._behind_given_windows(start, redundancy)
        found = iterate(
            self.system, start, redundancy=redundancy, max_iterations=self.options.max_iterations,
            tolerance=self.options.tolerance, damping=self.options.damping, watch=problem.watch,
        )  # fmt: skip
        if isinstance(found, Failure):
            return found
        # Points with nearly parallel rays converge very slowly, and only follow the noise.
        away = found.away if found.converged else self._slowly_converging(found)
        if len(away) and problem.rounds < LAST_ROUND:
            again = self._without(away, found.values)._adjusted(self.options)
            if found.converged or again:
                return again
        if not found.converged:
            idle = self._idle(found.linear, found.costs)
            if idle is not None:
                return idle
            reason = f"not converged in {found.iterations} iterations"
            if network.refraction is not None and scaled_by_windows(self.system, start, self.usable.points):
                reason += f": {SCALE_OF_WINDOWS}"
            return AdjustmentFailure(
                reason, Code.NOT_CONVERGED, iterations=found.iterations, costs=found.costs
            )
        values, inner = found.values, network.datum == "free" and freedom.defect > 0
        chosen = network.datum_points & self.usable.points
        if inner:
            if int(chosen.sum()) < 3:
                return Failure("inner constraints require three determined datum points", Code.TOO_FEW_POINTS)
            if network.datum_points.all() and not network.datum_chosen:
                chosen = steady_points(linearised(self.system, values), chosen)
            values = self._aligned(values, freedom, chosen)
        linear = linearised(self.system, values)
        idle = self._idle(linear, found.costs)
        if idle is not None:
            return idle
        freedom = freedom_of(self.system, values, self.usable.points)
        try:
            cofactors = cofactors_of(linear, freedom, chosen if inner else None, self.usable.points)
        except Singular:
            weak = weak_points(linear)
            if len(weak) and problem.rounds < LAST_ROUND:
                return self._without(weak, values)._adjusted(self.options)
            images = weak_images(linear)
            if 0 < len(images) < self.usable.images.sum() and problem.rounds < LAST_ROUND:
                left = self._without(weak, values)
                left.start.x0[images] = np.nan
                return left._adjusted(self.options)
            # The names follow from the eigenvectors of the full matrix.
            needed = 8 * _FULL_COPIES * self.unknowns.size**2
            if self.system.iterative or needed > problem.limit:
                return AdjustmentFailure(_WEAK, Code.SINGULAR, iterations=found.iterations, costs=found.costs)
            return undetermined(linear, freedom, tuple(found.costs))
        sigma0 = float(np.sqrt(linear.cost / redundancy)) if redundancy > 0 else 1.0
        datum = chosen if inner else None
        noisy = determined_by_noise(linear, cofactors, self.usable.points, sigma0)
        if noisy:
            return AdjustmentFailure(
                f"the observations do not determine {' with '.join(noisy)}: what they seem to tell is noise; "
                "take images from more directions, or points at more depths, or hold one of them",
                Code.RANK_DEFECT, iterations=found.iterations, costs=found.costs,
            )  # fmt: skip
        if self._scale_is_loose((start, values), sigma0, datum):
            return AdjustmentFailure(
                SCALE_OF_WINDOWS, Code.NOT_IDENTIFIED, iterations=found.iterations, costs=found.costs
            )
        return self._fit(linear, freedom, cofactors, counts, found, datum)

    def _idle(self, linear: Linear, costs: tuple[float, ...]) -> Failure | None:
        """A failure where no ray depends on a free parameter of windows or media."""
        network, values = self.problem.network, linear.values
        idle = without_effect(linear)
        if not idle or network.refraction is None:
            return None
        reason = f"rank defect {len(idle)}: no ray depends on {', '.join(idle)}"
        reason += why_without_effect(network.refraction, values.refraction, idle)
        missed = missing_windows(network, values, np.ones(len(network.xy), dtype=bool))
        if len(missed):
            reason += (
                f"; {len(missed)} image points are not seen through their windows, which must lie between "
                "cameras and points, in the coordinate system of the network"
            )
        return AdjustmentFailure(reason, Code.RANK_DEFECT, costs=tuple(costs))

    def _scale_is_loose(self, at: tuple[Values, ...], sigma0: float, datum: Mask | None) -> bool:
        """Whether windows alone determine the scale, and worse than covariances of first order can say.

        The standard deviation of the scale is that of the root mean square distance of the projection centres
        from their mean. It is computed at the approximate values as well: from there an iteration without a
        scale can reach a small false network that looks determined.
        """
        unknowns, part = self.unknowns, self.usable.points
        images = np.flatnonzero(unknowns.pose >= 0)
        for values in at:
            if self.network.refraction is None or not scaled_by_windows(self.system, values, part):
                return False
            linear = linearised(self.system, values)
            try:
                cofactors = cofactors_of(linear, freedom_of(self.system, values, part), datum, part)
            except Singular:
                return True
            centres = values.x0[images] - values.x0[images].mean(axis=0)
            along = np.zeros(unknowns.size)
            along[unknowns.pose[images, None] + np.arange(3, 6)] = centres / (centres**2).sum()
            if sigma0 * np.sqrt(along @ cofactors.reduced.times(along[:, None])[:, 0]) > _LOOSE:
                return True
        return False

    def _without_axes(self) -> Failure | None:
        """A failure where the axes of a rig, in which a window is given, would be those of another camera."""
        network = self.network
        if network.rig is None or network.refraction is None or not network.refraction.on_rig.any():
            return None
        images, paths = self.usable.images, network.refraction.path_of
        own = np.unique(network.camera_of[images & (paths >= 0) & network.refraction.on_rig[paths]])
        first, used = (network.rig.references(mask)[own] for mask in (np.ones_like(images), images))
        for camera in first[first != used]:
            return Failure(
                f"no oriented image of {network.cameras[camera].label} has an exposure in common with "
                "the other cameras; the window on the rig is given in its axes",
                Code.PREREQUISITE_MISSING,
            )
        return None

    def _without_axis(self, start: Values) -> Failure | None:
        """A failure where orientations of the images would not determine the axis of a stage."""
        constraints, stage = self.system.constraints, self.network.stage
        if constraints is None or constraints.stage is None or stage is None:
            return None
        open_ = axis_without_effect(linearised(self.system, start))
        if not open_:
            return None
        what = "angles" if stage.rotary else "readings"
        return Failure(
            f"rank defect {len(open_)}: {' and '.join(dict.fromkeys(open_))} not determined: no pose has "
            f"images at two different {what}; give such images, or hold what is known of the axis",
            Code.RANK_DEFECT,
        )

    def _fix(self, freedom: Freedom, start: Values) -> None:
        """Hold unknowns that fix the datum ``minimal``."""
        if self.network.datum != "minimal":
            return
        constraints = self.system.constraints
        if constraints is None or constraints.stage is None:
            self.system.held[held_minimally(freedom, self.unknowns, start)] = True
            return
        linear = linearised(self.system, start)
        free, slopes = normal_of(linear, 0.0).constrained(), linear.constraint_slopes
        self.system.fixed = constraints.held_for(freedom.reduced, free.back, slopes, np.diag(free.matrix))

    def approach(self) -> Values | None:
        """Approximate values in the coordinate system of the network after some iterations."""
        if not self.usable.images.any():
            return None
        start = self.start()
        freedom = freedom_of(self.system, start, self.usable.points)
        counts = self._counts(freedom)
        if counts[0] - counts[1] + counts[2] < 0:
            return None
        if self._without_axis(start) is not None:
            return None
        self._fix(freedom, start)
        found = iterate(
            self.system, start, redundancy=max(1, counts[0] - counts[1]), tolerance=_ROUGHLY,
            max_iterations=self.options.max_iterations, damping=self.options.damping,
        )  # fmt: skip
        if isinstance(found, Failure) or not np.isfinite(found.linear.cost):
            return None
        values, chosen = found.values, self.network.datum_points & self.usable.points
        if self.network.datum == "free" and freedom.defect and chosen.sum() >= 3:
            values = self._aligned(values, freedom, chosen)
        return self._without(found.away, values).start

    def _behind_given_windows(self, start: Values, redundancy: int) -> Values:
        """Approximate values adjusted with windows and media as given.

        Rough approximate values could otherwise move a window to where no further step leads back.
        """
        if self.unknowns.refraction < 0:
            return start
        held = self.system.held.copy()
        self.system.held[self.unknowns.refraction_columns] = True
        found = iterate(
            self.system, start, redundancy=redundancy, max_iterations=_BEFORE_WINDOWS,
            tolerance=_ROUGHLY, damping=self.options.damping,
        )  # fmt: skip
        self.system.held = held
        return start if isinstance(found, Failure) or len(found.away) else found.values

    def _slowly_converging(self, found: Iterated) -> Rows:
        """Poorly determined points that may prevent convergence; none after few iterations."""
        none = np.zeros(0, dtype=np.intp)
        return poorly_determined_points(found.linear) if found.iterations >= _SLOW else none

    def _without(self, points: Rows, values: Values) -> BundleProblem:
        """Return the problem with the estimates as approximate values, without points with parallel rays."""
        start, images = self.problem.start, self.usable.images
        values = values.shifted(self.problem.centre)
        xyz = np.where(self.usable.points[:, None], values.xyz, start.xyz)
        xyz[points] = np.nan
        rotation = np.where(images[:, None, None], values.rotation, start.rotation)
        x0 = np.where(images[:, None], values.x0, start.x0)
        start = replace(values, rotation=rotation, x0=x0, xyz=xyz)
        return replace(self.problem, start=start, rounds=self.problem.rounds + 1)

    def start(self) -> Values:
        """Approximate values with reduced coordinates; finite for unused images and points as well."""
        start = self.problem.start.shifted(-self.problem.centre)
        known = finite(start.x0)
        extra = start.extra
        if extra.shape[0] != max(1, len(self.unknowns.extra)):
            extra = np.zeros((max(1, len(self.unknowns.extra)), extra.shape[1]))
        rotation = np.where(known[:, None, None], start.rotation, np.eye(3))
        x0 = np.where(known[:, None], start.x0, 0.0)
        return replace(start, rotation=rotation, x0=x0, xyz=np.nan_to_num(start.xyz), extra=extra)

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
        """Transform the estimates so that the chosen points fit their approximate coordinates best."""
        if freedom.defect < 6:
            return values
        reference = self.problem.reference - self.problem.centre
        chosen = chosen & finite(reference)
        scaled = freedom.defect == 7
        similarity = similarity_onto(values.xyz[chosen], reference[chosen], scaled=scaled)
        moved, bent = similarity(values), self.network.refraction
        for c, camera in enumerate(self.network.cameras):
            if camera.parallel and camera.registered is not None:
                # A magnification counts per unit of object space.
                rows = [camera.names.index(name) for name in camera.registered.of_role("scale")]
                moved.cameras[c, rows] /= similarity.scale
        if bent is None:
            return moved
        # Windows count from the origin of the network.
        whole = similarity.about(self.problem.centre)
        return replace(moved, refraction=bent.transformed(values.refraction, *whole))

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
        values = linear.values.shifted(self.problem.centre)
        xyz = np.where(self.usable.points[:, None], values.xyz, np.nan)
        xyz = np.where(whole.held & self.usable.points[:, None], whole.xyz, xyz)
        images = self.usable.images
        x0 = np.where(images[:, None], values.x0, np.nan)
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
        v[rows] = residuals(whole, self.unknowns, rows, values, self.problem.centre)
        more = self.problem.others
        others = np.where(self.in_others, more.computed(values) - more.value, np.nan)
        return np.concatenate([v.ravel(), others])
