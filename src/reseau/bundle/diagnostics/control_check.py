"""Check the control points: against the shape determined by the images alone, and by tests of each.

:func:`control_shape` compares them with a free network, which shows what they have in common (exchanged,
mirrored, another shape); :func:`checked_control` then tests each with all covariances, several at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ..network.network import Network, finite
from ..solver.approximation import approximate
from ..solver.datum import similarity_onto
from ..solver.problem import BundleFit, BundleProblem
from ..solver.unknowns import Unknowns
from ..solver.values import Values
from .checks import listed

_TRIPLES, _SIGMAS, _LEAST = 500, 8.0, 4
# Points that agree, from which on a figure is not symmetric in them.
_SYMMETRIC = 20
# Tolerated error of a control point, as a fraction of their extent.
_LOOSE = 2e-3
# Misfits after an exchange of two points that explains those before it, relative to these.
_SMALLER = 0.2
# Level of the tests of all control points together, and number of adjustments.
_ALPHA, _ROUNDS = 1e-4, 20
# Points are left out together when their test values are at least this part of the largest.
_LIKEWISE = 0.5
# Part of the variance of an observation that its residual must have to be tested.
_UNSEEN = 1e-9
# Median of the absolute values of normal errors; deviation exceeded with a power of 80 %.
_MEDIAN, _POWER = 0.6745, 0.84
# Median of the test of three coordinates.
_MEDIAN_OF_THREE = 2.366
# Standard deviation, in the extent of the control, as which held coordinates are tested.
_TIGHT = 1e-5
# Part of the control points above which it cannot be said which are wrong.
_HALF = 0.5
# Times the median of the smallest errors found, above which errors of a point are said not to be found.
_HARDLY = 4.0
# Factor on the standard deviations of image points from which on it may hide a wrong control point, and the
# part of it that remains at most without this point.
_INFLATED, _DEFLATED = 1.3, 0.8
# Points up to which all are named.
_NAMED = 60
# Iterations of a free network; relative offset at which all adjustments end: what they find is compared with
# multiples of its standard deviation.
_FREE_ITERATIONS, _ROUGHLY = 50, 1e-2
# Thickness of a plane figure in its extent, its least number of points, part of the differences that a
# deflection of second degree explains, and its size in the standard deviations of the points.
_PLANE, _BENT_POINTS, _BENT_PART, _BENT_SIGMAS = 1e-3, 12, 0.7, 4.0
# Ratio of scales from which on units are asked for.
_UNIT = 2.0
_OTHER_SHAPE = "do not agree with the shape determined by the images"


@dataclass(frozen=True, eq=False)
class ControlShape:
    """Control points and a free network of the images, compared by the similarity that most agree with.

    Parameters
    ----------
    names : tuple of str (k,)
        Control points with three coordinates and at least two rays.
    points : ndarray of int (k,)
        Their numbers.
    given, found : ndarray (k, 3)
        Given coordinates, and those of the free network.
    sigma : ndarray (k,)
        Standard deviations of the differences between both.
    limit : ndarray (k,)
        Differences that are tolerated.
    agree : ndarray of bool (k,)
        Points that agree.

    Examples
    --------
    >>> three = np.eye(3)
    >>> one = np.ones(3)
    >>> shape = ControlShape(("a", "b", "c"), np.arange(3), three, three, one, 8 * one, one > 0)
    >>> shape.doubt()
    ''
    """

    names: tuple[str, ...]
    points: Rows
    given: Array
    found: Array
    sigma: Array
    limit: Array
    agree: Mask

    def doubt(self) -> str:
        """Return what is wrong with the control points as a whole; empty where nothing was found.

        Single points that do not agree are named where no pair of them can have been exchanged.
        """
        if self.agree.all():
            return ""
        names = self.names
        exchanged = [f"{names[a]} and {names[b]}" for a, b in self._exchanged]
        if exchanged:
            return f"the coordinates of control points {', or '.join(exchanged)} look exchanged"
        if self._mirrored:
            return "the control points are mirrored: their coordinate system is left-handed"
        if self.agree.sum() < _LEAST:
            return (
                f"the control points {', '.join(names)} do not agree with the shape determined by the images"
            )
        wrong = [names[k] for k in np.flatnonzero(~self.agree)]
        factor = self._in_another_unit
        if factor:
            right = [names[k] for k in np.flatnonzero(self.agree)]
            return (
                f"the control points {', '.join(wrong)} and the others, {', '.join(right)}, agree among "
                f"themselves, but not in scale (by a factor of {factor:.4g}): are some in another unit?"
            )
        return (
            f"control point{'s' * (len(wrong) > 1)} {', '.join(wrong)} "
            f"contradict{'s' * (len(wrong) == 1)} the others"
        )

    @cached_property
    def _mirrored(self) -> bool:
        """Whether more points agree with the mirrored figure; in a flat one some do with both."""
        mirrored = _largest_agreement(self.found * [1.0, 1.0, -1.0], self.given, self.limit)
        return bool(mirrored.sum() > max(_LEAST - 1, self.agree.sum()))

    @cached_property
    def _in_another_unit(self) -> float:
        """Ratio of the scales of points that do not agree and the others; 0 where it is none of a unit."""
        off, given, found = ~self.agree, self.given, self.found
        if off.sum() < _LEAST or self.agree.sum() < _LEAST:
            return 0.0
        size = [float(np.linalg.norm(given[k] - given[k].mean(axis=0))) for k in (off, self.agree)]
        true = [float(np.linalg.norm(found[k] - found[k].mean(axis=0))) for k in (off, self.agree)]
        ratio = size[0] / true[0] / (size[1] / true[1])
        scale = max(ratio, 1 / ratio)
        misfit = _misfits(found[off], given[off], np.ones(int(off.sum()), dtype=bool))
        # Errors of the others are in their scale.
        same = bool((misfit < self.limit[off] * min(1.0, ratio)).all())
        return float(scale) if same and scale > _UNIT else 0.0

    @cached_property
    def _exchanged(self) -> list[tuple[int, int]]:
        """Pairs whose exchange makes all points agree; several pairs where the control is symmetric."""
        found, given, off = self.found, self.given, np.flatnonzero(~self.agree)
        if len(off) > 2 and self.agree.sum() >= _LEAST:
            return []
        # In a symmetric figure the points that do not agree can be others than those exchanged.
        candidates = off if self.agree.sum() >= _SYMMETRIC else np.arange(len(found))
        pairs, every = list[tuple[int, int]](), np.ones(len(found), dtype=bool)
        as_given = _misfits(found, given, every)
        for a, b in combinations(candidates.tolist(), 2):
            order = np.arange(len(found))
            order[[a, b]] = b, a
            misfit = _misfits(found, given[order], every)
            # In a symmetric figure an exchange can leave the shape as it is.
            if (misfit < self.limit).all() and np.linalg.norm(misfit) < _SMALLER * np.linalg.norm(as_given):
                pairs.append((a, b))
        return pairs

    def bent(self) -> float:
        """Return the deflection of a figure that is given as plane, in its unit; 0 where it is not bent.

        The difference between the smallest and the largest value of a polynomial of second degree in the
        plane, less the plane that fits it best.
        """
        middle = self.given.mean(axis=0)
        _, extent, axes = np.linalg.svd(self.given - middle, full_matrices=False)
        if len(self.given) < _BENT_POINTS or extent[2] > _PLANE * extent[1]:
            return 0.0
        off = (_onto(self.found, self.given, np.ones(len(self.given), dtype=bool)) - self.given) @ axes.T
        u, v = ((self.given - middle) @ axes[:2].T / extent[0]).T
        plane, bend = np.stack([np.ones_like(u), u, v], axis=1), np.stack([u * u, u * v, v * v], axis=1)
        bend = bend - plane @ np.linalg.lstsq(plane, bend, rcond=None)[0]
        deflection = bend @ np.linalg.lstsq(bend, off[:, 2], rcond=None)[0]
        explained = float((deflection**2).sum())
        large = explained > _BENT_SIGMAS**2 * float((self.sigma**2).sum())
        return float(np.ptp(deflection)) if large and explained > _BENT_PART * (off**2).sum() else 0.0

    @property
    def as_a_whole(self) -> bool:
        """Whether the doubt is not about single points."""
        single = self.agree.sum() >= _LEAST and not self._exchanged and not self._in_another_unit
        return not (single and (self.agree.all() or not self._mirrored))


def control_shape(
    network: Network, used: Mask | None = None, fitted: Values | None = None
) -> ControlShape | None:
    """Compare the control points with a free network.

    The network is adjusted without control, as a free network, and transformed to the control points by the
    similarity of three points with which most others agree.

    Parameters
    ----------
    network : Network
        Network with at least four control points with three known coordinates.
    used : ndarray of bool (n,), optional
        Image points without gross errors; by default all.
    fitted : Values, optional
        Estimates with the control points, where there are any: the free network begins with these if they
        are closer than its own approximate values, as they are in cameras with strong distortion.

    Returns
    -------
    ControlShape or None
        None with fewer control points, or where the images alone do not determine their shape.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> network = example_network()
    >>> xyz = network.xyz.copy()
    >>> xyz[[0, 19]] = xyz[[19, 0]]
    >>> control_shape(replace(network, xyz=xyz, sigma=np.zeros((20, 3)), datum="control")).doubt()
    'the coordinates of control points p0 and p19 look exchanged'
    """
    rows = np.flatnonzero(finite(network.xyz) & ~np.isnan(network.sigma).any(axis=1) & (network.rays > 1))
    if len(rows) < _LEAST:
        return None
    fit = _free(network if used is None else network.select(used), fitted)
    if fit is None:
        return None
    rows = rows[fit.usable.points[rows]].astype(np.intp)
    if len(rows) < _LEAST:
        return None
    given, found = network.xyz[rows], fit.values.xyz[rows]
    extent = float(np.ptp(given, axis=0).max())
    scale = extent / max(float(np.ptp(found, axis=0).max()), 1e-300)
    trace = np.trace(fit.cofactors.points[rows], axis1=1, axis2=2) * fit.variance
    sigma = scale * np.sqrt(trace) + network.sigma[rows].max(axis=1)
    limit = _SIGMAS * sigma + _LOOSE * extent
    agree = _largest_agreement(found, given, limit)
    return ControlShape(tuple(network.points[j] for j in rows), rows, given, found, sigma, limit, agree)


@dataclass(frozen=True, eq=False)
class ControlCheck:
    """Control points tested against the images and the other control points; truthy where some are wrong.

    Parameters
    ----------
    points : ndarray of int (k,)
        Points with given coordinates.
    wrong : ndarray of bool (k,)
        Points that contradict the images and the other control points.
    w : ndarray (k,)
        Root of the test value: of wrong points for the difference from where the images and the other control
        points place them, of the others for their residuals.
    off : ndarray (k,)
        Lengths of these differences and residuals, in the unit of object space; NaN where unknown.
    detectable : ndarray (k,)
        Smallest error in the least favourable direction that the test finds with a power of 80 %; infinite
        where no other observation depends on it, as along the only ray of a point.

    Examples
    --------
    >>> one = np.zeros(1)
    >>> bool(ControlCheck(np.array([3]), np.array([True]), one + 9.1, one + 0.02, one + 0.01))
    True
    """

    points: Rows
    wrong: Mask
    w: Array
    off: Array
    detectable: Array

    def __bool__(self) -> bool:
        return bool(self.wrong.any())

    @property
    def undecided(self) -> bool:
        """Whether so many are wrong that it cannot be said which are right."""
        return bool(self.wrong.sum() > _HALF * len(self.wrong))

    def remarks(self, network: Network, *, left_out: bool = False) -> list[Remark]:
        """Name the points that contradict the others, and those whose errors cannot be found.

        Parameters
        ----------
        network : Network
            The network.
        left_out : bool
            Whether the wrong points were left out.
        """
        names = [network.points[j] for j in self.points]
        if not self:
            return []
        if self.undecided:
            text = f"the control points {listed(names)} {_OTHER_SHAPE}"
            return [Remark(text, Code.DOUBTFUL_CONTROL)]
        order = np.flatnonzero(self.wrong)
        order = order[np.argsort(-self.w[order], kind="stable")]
        wrong = [names[k] + self._size(k, network.unit) for k in order.tolist()]
        several = len(wrong) > 1
        text = (
            f"the control point{'s' * several} {', '.join(wrong)} contradict{'s' * (not several)} the other "
            f"observations{': left out' if left_out else ''}"
        )
        rest = self.unchecked(names, network.unit)
        return [Remark(text + (f"; {rest}" if rest else ""), Code.DOUBTFUL_CONTROL)]

    def unchecked(self, names: Sequence[str], unit: str) -> str:
        """Say of which of the other points errors cannot be found, and how large these may be."""
        detectable = np.where(self.wrong, np.nan, self.detectable)
        known = np.isfinite(detectable)
        if not known.any():
            return ""
        usual = known & (detectable <= _HARDLY * np.median(detectable[known]))
        hardly = np.flatnonzero(~self.wrong & ~usual)
        others = np.flatnonzero(usual & ~self.wrong)
        least, most = (f"{size:.2g}" for size in (detectable[others].min(), detectable[others].max()))
        size = most if least == most else f"{least} to {most}"
        rest = [names[k] for k in others.tolist()]
        every = ", ".join(rest) if len(rest) <= _NAMED else listed(rest)
        more = f"at the others ({every}) errors up to {size} {unit}"
        if not len(hardly):
            return f"{more} cannot be found"
        parts = [
            f"{names[k]} (up to {detectable[k]:.2g} {unit})" if known[k] else f"{names[k]} (of any size)"
            for k in hardly.tolist()
        ]
        return (
            f"errors of the control point{'s' * (len(parts) > 1)} {', '.join(parts)} cannot be found, with "
            f"too few rays or along them; {more} cannot be found"
        )

    def _size(self, k: int, unit: str) -> str:
        """Size of the error of a point, where its rays determine it."""
        return f" (by {self.off[k]:.3g} {unit}, w {self.w[k]:.1f})" if np.isfinite(self.off[k]) else ""


def _critical(count: int) -> float:
    """Critical value of the test of three coordinates of each of some points."""
    return float(scipy.special.chdtri(3, _ALPHA / count))


def suspected(problem: BundleProblem, fit: BundleFit) -> bool:
    """Whether control points, or their rays, have large test values, or have lost rays or coordinates.

    Parameters
    ----------
    problem : BundleProblem
        The problem, before observations were rejected.
    fit : BundleFit
        Its adjustment, perhaps without rejected observations.
    """
    network, n = problem.network, 2 * len(problem.network.xy)
    points = np.flatnonzero((network.observed | network.held).any(axis=1)).astype(np.intp)
    if network.datum != "control" or not len(points):
        return False
    others = problem.others
    rows = np.isin(network.point_of, points)
    weights = np.ones(len(problem.observations)) if fit.problem.weights is None else fit.problem.weights
    given = np.ones(len(problem.observations)) if problem.weights is None else problem.weights
    lost = (weights == 0) & (given > 0)
    at = n + others.slices[1].start
    if lost[:n].reshape(-1, 2)[rows].any() or lost[at : at + len(others.coordinate)].any():
        return True
    observed = points[network.observed[points].any(axis=1)]
    if len(observed):
        found = _Tested.of(problem, fit, observed, np.zeros(len(observed), dtype=bool))
        if (found.statistic > _critical(len(points))).any():
            return True
    # Input sigmas that are too large hide what does not fit.
    statistic = _ray_statistic(network, fit)[rows] / min(1.0, max(fit.sigma0, 1e-300)) ** 2
    large = statistic > scipy.special.chdtri(2, _ALPHA / max(1, int(rows.sum())))
    return bool(large.any())


def checked_control(
    problem: BundleProblem, fit: BundleFit, left_out: Rows | None = None
) -> ControlCheck | None:
    """Find control points that contradict the images and the other control points, several at once.

    Parameters
    ----------
    problem : BundleProblem
        The problem, with the weights that count.
    fit : BundleFit
        An adjustment of the network, for approximate values.
    left_out : ndarray of int, optional
        Points without which the search starts, such as those that do not agree with a free network.

    Returns
    -------
    ControlCheck or None
        None without control points, or where no adjustment of the network shows which are wrong.

    Notes
    -----
    With several gross errors the residuals of all control points are large, and those with few rays take up
    their errors. The search therefore starts with the points that agree with the shape of a free network, and
    goes on by the test of all coordinates of a point together (Förstner & Wrobel 2016, sect. 4.6.4):
    T = vᵀ Qvv⁻¹ v, or T = dᵀ (Q + C)⁻¹ d for the difference d of a point that is left out from its place by
    the other observations. The worst points are left out, those that agree are taken back, until nothing
    changes. A ray of a control point that explains more than its coordinates is left out in their stead. Held
    coordinates are tested as observations with very small standard deviations.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> network = example_network()
    >>> xyz = network.xyz.copy()
    >>> xyz[7, 2] += 0.1
    >>> given = replace(network, xyz=xyz, sigma=np.full((20, 3), 1e-3), datum="control")
    >>> found = adjust_network(given)
    >>> check = checked_control(found.fit.problem, found.fit)
    >>> [network.points[k] for k in check.points[check.wrong]]
    ['p7']
    """
    loose = _as_observed(replace(problem, tolerance=max(problem.tolerance, _ROUGHLY)))
    points = np.flatnonzero(loose.network.observed.any(axis=1)).astype(np.intp)
    if not len(points):
        return None
    weights = np.ones(len(loose.observations)) if loose.weights is None else loose.weights.copy()
    current, critical = loose.continued(fit), _critical(len(points))
    out = np.zeros(len(points), dtype=bool)
    if left_out is not None:
        out = np.isin(points, left_out)
    seen, last = set[bytes](), None
    for _ in range(_ROUNDS):
        seen.add(out.tobytes())
        again = current.with_weights(_without(loose, weights, points[out])).adjusted()
        if isinstance(again, Failure):
            if last is not None or not out.any():
                break
            out = np.zeros(len(points), dtype=bool)
            continue
        current = current.continued(again)
        last = _Tested.of(loose, again, points, out)
        # A ray that contradicts the other rays of its point displaces a point that is left out.
        gross = out & (last.rays > 2) & (last.ray_statistic > np.maximum(last.statistic, critical))
        if gross.any():
            weights[2 * last.ray[gross]] = weights[2 * last.ray[gross] + 1] = 0.0
            continue
        bad = ~out & (last.statistic > critical)
        if not bad.any() and last.unit > _INFLATED:
            bad = _hidden(current.with_weights(weights), points, out, last)
        if not bad.any():
            # Only now: while a wrong point is left, those that are left out can seem to agree with it.
            back = out & (last.statistic < critical)
            if not back.any() or (out & ~back).tobytes() in seen:
                break
            out = out & ~back
            continue
        worst = bad & (last.statistic >= _LIKEWISE * last.statistic[bad].max())
        by_ray = worst & (last.ray_statistic > last.statistic)
        if by_ray.any():
            weights[2 * last.ray[by_ray]] = weights[2 * last.ray[by_ray] + 1] = 0.0
        out = out | (worst & ~by_ray)
        if not by_ray.any() and out.tobytes() in seen:
            break
    if last is None:
        return None
    # A point that was left out with others, and agrees without them, is not wrong.
    wrong = out & ~(last.statistic < critical)
    return ControlCheck(points, wrong, np.sqrt(last.statistic), last.off, last.detectable)


def _hidden(problem: BundleProblem, points: Rows, out: Mask, tested: _Tested) -> Mask:
    """The point (k,) whose error increases the misfits of all others so much that its own test is passed."""
    worst = np.zeros(len(points), dtype=bool)
    worst[np.argmax(np.where(out, 0.0, tested.statistic))] = True
    weights = np.ones(len(problem.observations)) if problem.weights is None else problem.weights
    again = problem.with_weights(_without(problem, weights, points[out | worst])).adjusted()
    if isinstance(again, Failure):
        return np.zeros_like(worst)
    smaller = _unit(again.w[: 2 * len(problem.network.xy)]) < _DEFLATED * tested.unit
    return worst & ~out & smaller


def _without(problem: BundleProblem, weights: Array, points: Rows) -> Array:
    """Weights without the coordinates of some points."""
    others, weights = problem.others, weights.copy()
    at = 2 * len(problem.network.xy) + others.slices[1].start
    weights[at : at + len(others.coordinate)][np.isin(others.coordinate[:, 0], points)] = 0.0
    return weights


def without_control(problem: BundleProblem, points: Rows) -> BundleProblem:
    """Return the problem with control points as tie points."""
    network, others = problem.network, problem.others
    sigma = network.sigma.copy()
    sigma[points] = np.nan
    chosen = set(points.tolist())
    role = tuple("tie" if j in chosen else role for j, role in enumerate(network.role))
    weights = problem.weights
    if weights is not None:
        kept = np.ones(len(weights), dtype=bool)
        at = 2 * len(network.xy) + others.slices[1].start
        kept[at : at + len(others.coordinate)] = ~np.isin(others.coordinate[:, 0], points)
        weights = weights[kept]
    return replace(problem, network=replace(network, sigma=sigma, role=role), weights=weights)


@dataclass(frozen=True, eq=False)
class _Tested:
    """Tests (k,) of control points, the largest test of a ray of each, its row, the rays used, and the
    factor on the standard deviations of the image points by their misfits."""

    statistic: Array
    off: Array
    detectable: Array
    ray_statistic: Array
    ray: Rows
    rays: Rows
    unit: float

    @classmethod
    def of(cls, problem: BundleProblem, fit: BundleFit, points: Rows, out: Mask) -> _Tested:
        network, others, n = problem.network, problem.others, 2 * len(problem.network.xy)
        unit = _unit(fit.w[:n])
        statistic, off = np.zeros(len(points)), np.full(len(points), np.nan)
        detectable = np.full(len(points), np.inf)
        # Deviation of a normal variable that the test of three coordinates finds with the power chosen.
        found = np.sqrt(_critical(len(points))) + _POWER
        residual = fit.residuals[n + others.slices[1].start :][: len(others.coordinate)]
        for k, j in enumerate(points):
            own = others.coordinate[:, 0] == j
            axes = others.coordinate[own, 1]
            given = np.diag(network.sigma[j, axes] ** 2)
            if not fit.usable.points[j]:
                statistic[k] = np.inf if out[k] else 0.0
                continue
            adjusted = fit.cofactors.points[j][np.ix_(axes, axes)]
            v = residual[own]
            if out[k]:
                v = fit.values.xyz[j, axes] - network.xyz[j, axes]
                statistic[k] = v @ np.linalg.solve(given + adjusted, v)
            else:
                size = np.sqrt(np.diag(given))
                share, along = np.linalg.eigh(np.eye(len(axes)) - adjusted / np.outer(size, size))
                seen = share > _UNSEEN
                statistic[k] = (((v / size) @ along[:, seen]) ** 2 / share[seen]).sum()
                if seen.all():
                    detectable[k] = found * unit * float(size.max()) / np.sqrt(share[0])
            off[k] = np.linalg.norm(v)
        rays = _ray_statistic(network, fit)
        ray = np.zeros(len(points), dtype=np.intp)
        used = np.bincount(network.point_of[fit.usable.observations], minlength=len(network.points))
        for k, j in enumerate(points):
            rows = np.flatnonzero(network.point_of == j)
            ray[k] = rows[np.argmax(rays[rows])] if len(rows) else -1
        largest = np.where(ray >= 0, rays[ray], 0.0)
        statistic = statistic / unit**2
        # Small errors of most points (a board that is not flat, an imperfect lens) are not those of some.
        usual = max(1.0, float(np.median(statistic)) / _MEDIAN_OF_THREE) if len(points) >= _LEAST else 1.0
        return cls(
            statistic / usual, off, detectable * np.sqrt(usual), largest / unit**2 / usual, ray, used[points],
            unit,
        )  # fmt: skip


def _unit(w: Array) -> float:
    """Factor on the standard deviations of image coordinates by their median test value, at least one."""
    seen = np.abs(w[np.isfinite(w) & (w != 0)])
    return max(1.0, float(np.median(seen)) / _MEDIAN) if len(seen) else 1.0


def _ray_statistic(network: Network, fit: BundleFit) -> Array:
    """Test vᵀ Qvv⁻¹ v (n,) of x and y of each image point together; zero where it is not used."""
    n = len(network.xy)
    root = np.linalg.cholesky(network.cov)
    hat = next(iter(fit.solution.hats()))
    share, along = np.linalg.eigh(np.eye(2) - np.swapaxes(root, 1, 2) @ hat @ root)
    v = np.linalg.solve(root, np.nan_to_num(fit.residuals[: 2 * n]).reshape(n, 2)[:, :, None])
    part = (np.swapaxes(along, 1, 2) @ v)[:, :, 0] ** 2
    squares = np.where(share > _UNSEEN, part / np.maximum(share, _UNSEEN), 0.0).sum(axis=1)
    return np.where(fit.usable.observations, squares, 0.0)


def _as_observed(problem: BundleProblem) -> BundleProblem:
    """Return the problem with held coordinates as observations with very small standard deviations."""
    network = problem.network
    if not network.held.any():
        return problem
    known = network.xyz[network.held.any(axis=1)]
    extent = float(np.ptp(known, axis=0).max()) or 1.0
    loose = replace(network, sigma=np.where(network.held, _TIGHT * extent, network.sigma))
    weights = problem.weights
    if weights is not None:
        start = 2 * len(network.xy) + problem.others.slices[1].start
        before = problem.others.coordinate
        at = {tuple(row): k for k, row in enumerate(before.tolist())}
        after = np.argwhere(loose.observed).tolist()
        mine = [weights[start + at[tuple(row)]] if tuple(row) in at else 1.0 for row in after]
        weights = np.concatenate([weights[:start], mine, weights[start + len(before) :]])
    return replace(problem, network=loose, weights=weights)


def _free(network: Network, fitted: Values | None) -> BundleFit | None:
    """Adjust the network without control; None where images alone do not suffice, or windows are on a rig."""
    if network.refraction is not None and network.refraction.on_rig.any():
        return None
    nothing = np.full(network.xyz.shape, np.nan)
    posed = np.full(network.x0.shape, np.nan)
    none: Rows = np.zeros((0, 2), dtype=np.intp)
    free = replace(
        network, xyz=nothing, sigma=nothing, x0=posed, rotation=posed, datum="free",
        datum_points=np.ones(len(network.points), dtype=bool), distance_of=none, distance=np.zeros((0, 2)),
        stage=None, rig=None,
    )  # fmt: skip
    problem = _approximate(free)
    if fitted is not None:
        begun = BundleProblem(free, replace(fitted, stage=None, rig=None), fitted.xyz)
        problem = begun if problem is None else min(problem, begun, key=_typical_misfit)
    if problem is None:
        return None
    fit = replace(problem, max_iterations=_FREE_ITERATIONS, tolerance=_ROUGHLY).adjusted()
    return fit if isinstance(fit, BundleFit) else None


def _approximate(network: Network) -> BundleProblem | None:
    """Return the problem with approximate values; None where no image can be oriented."""
    start = approximate(network)
    if not finite(start.x0).any():
        return None
    unknowns = Unknowns.of(network, finite(start.x0))
    values = Values.of_cameras(unknowns, start.rotation, start.x0, start.xyz)
    return BundleProblem(network, values, start.xyz)


def _typical_misfit(problem: BundleProblem) -> float:
    """Median of the weighted misfits at the approximate values; infinite for images without these."""
    size = np.linalg.norm(problem.misfits_at_start(), axis=1)
    return float(np.median(np.where(np.isfinite(size), size, np.inf)))


def _agreeing(found: Array, given: Array, limit: Array, chosen: Mask) -> Mask:
    """Return which points agree with the similarity of the chosen ones."""
    return np.asarray(_misfits(found, given, chosen) < limit)


def _misfits(found: Array, given: Array, chosen: Mask) -> Array:
    """Distances of all points after the similarity of the chosen ones."""
    return np.asarray(np.linalg.norm(_onto(found, given, chosen) - given, axis=1))


def _onto(found: Array, given: Array, chosen: Mask) -> Array:
    """Return the points after the similarity of the chosen ones."""
    nothing = np.zeros((1, 12))
    values = Values(np.zeros((0, 3, 3)), np.zeros((0, 3)), found, nothing, nothing)
    return similarity_onto(values.xyz[chosen], given[chosen], scaled=True)(values).xyz


def _largest_agreement(found: Array, given: Array, limit: Array) -> Mask:
    """Return the points that agree with the best similarity of three points."""
    best = np.zeros(len(found), dtype=bool)
    for three in _triples(len(found)):
        chosen = np.zeros(len(found), dtype=bool)
        chosen[list(three)] = True
        for _ in range(2):
            agree = _agreeing(found, given, limit, chosen)
            if agree.sum() < 3:
                break
            chosen = agree
        if agree.sum() > best.sum():
            best = agree
    return best


def _triples(count: int) -> list[tuple[int, ...]]:
    """Return triples of points: all, or where these are too many, random ones."""
    if count * (count - 1) * (count - 2) // 6 <= _TRIPLES:
        return list(combinations(range(count), 3))
    rng = np.random.default_rng(0)
    return [tuple(rng.choice(count, 3, replace=False).tolist()) for _ in range(_TRIPLES)]
