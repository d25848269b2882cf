"""What the points of an image have in common: components of variance, and the uncertainty that contains them.

Paper that bends, motion, a lens that focuses anew, or what the model leaves of the lens displace the points
of an image together. They are described by random effects of each image: a smooth field with the covariance
τ² exp(−d²/2ℓ²) over distances d in the image, and a change of the principal distance. The variances are
those of the largest restricted likelihood (Patterson & Thompson 1971, *Biometrika* 58), weighted over
several lengths ℓ. Points that are held displace the images of all photographs together: their shifts are a
component of their own. With the sensitivities H = Q Aᵀ P C of the estimates to the effects θ ~ N(0, T), the
covariance of the estimates is

    σ² Q + H T Hᵀ,

of which σ² Q with σ² from all residuals, the formal one, is the least that is taken. Degrees of freedom
follow from the information on the variances (Satterthwaite 1946; Fai & Cornelius 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from ...core.data import Array, Rows
from ...core.threads import one_thread
from ..solver.problem import BundleFit
from .evidence import (
    Effect,
    Scores,
    lower_factor,
    scores,
    sensitivities,
    sigma_seen,
    too_large,
    used_rows,
)
from .image_effects import distance_effects, point_effects, smooth_effects
from .views import LEAST, looked_at, views_of

_SHAPE = 0.7
"""Standard deviation of the logarithm by which fields of another form than assumed do more or less to a
parameter: a factor of two."""
_GRID, _FINE, _CONVERGED = np.geomspace(0.05, 100.0, 8), np.geomspace(0.03, 100.0, 80), 0.01
"""Standard deviations of the effects, in that of image points, at which the likelihood is computed first,
and where that is quick; gain of its logarithm that is none."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Covariance of some unknowns.

    Parameters
    ----------
    covariance, formal : ndarray (k, k)
        With what the points of an image have in common, and that of independent errors.
    dof : ndarray (k,)
        Degrees of freedom of the variances.
    degrees : float
        Those of the whole, for tests of all together.
    """

    covariance: Array
    formal: Array
    dof: Array
    degrees: float

    def with_errors(self, square: Array) -> Uncertainty:
        """The same with errors whose mean squares (k, k) are known."""
        before, total = np.diag(self.covariance), self.covariance + square
        share = np.divide(np.diag(total), before, out=np.ones(len(before)), where=before > 0)
        root = np.linalg.pinv(self.formal, hermitian=True)
        mean = np.trace(root @ total) / max(float(np.trace(root @ self.covariance)), 1e-300)
        return Uncertainty(total, self.formal, self.dof * share**2, self.degrees * float(mean) ** 2)


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Components of variance of an adjusted network.

    Parameters
    ----------
    fit : BundleFit
        The adjustment.
    variance : float
        Variance factor of single image points.
    smooth : ndarray (l,)
        Standard deviations of the smooth fields, in those of image points, by their length.
    distance, points : float
        The same of displacements by principal distances, and by points of the target.
    weights : ndarray (l,)
        Weights of the lengths; what is missing to one is that of no shared errors.
    spread : float
        Relative variance of the estimated variance factor.
    views : ndarray of int (m,)
        View of each image; those from which the errors were estimated come first.
    scores : Scores
        Of the parameters of the cameras, as effects of each of these views.
    pulls : ndarray (v · q, v · q)
        Covariance of these scores by the shared errors.
    """

    fit: BundleFit
    variance: float
    smooth: Array
    distance: float
    points: float
    weights: Array
    spread: float
    views: Rows
    scores: Scores
    pulls: Array

    @property
    def size(self) -> float:
        """Displacement that the points of an image have in common, in their standard deviations."""
        return float(np.sqrt(self.weights @ self.smooth**2 + self.distance**2 + self.points**2))

    def uncertainty(self, columns: Rows) -> Uncertainty:
        """The uncertainty of parameters of cameras (k,), by their columns among the reduced unknowns."""
        every, total, parts, spread = self._of_cameras
        place = {column: k for k, column in enumerate(every.tolist())}
        at = np.array([place[column] for column in columns.tolist()], dtype=np.intp)
        formal = self.fit.cofactors.reduced.block(columns, columns) * self.fit.variance
        whole, own = total[np.ix_(at, at)], parts[:, at][:, :, at]
        root = np.linalg.pinv(formal, hermitian=True)
        # As one variance: the mean of the parts in relation to the formal covariance.
        mean = np.array([np.trace(root @ part) for part in own])
        dof = _degrees(np.diagonal(own, axis1=1, axis2=2), spread)
        return Uncertainty(whole, formal, dof, float(_degrees(mean[:, None], spread)[0]))

    @cached_property
    def _of_cameras(self) -> tuple[Rows, Array, Array, Array]:
        """Columns of all cameras, their covariance, its parts by direction, and the covariance of these.

        What shared errors do to the cameras is corrected in each direction of its own: by the scores of the
        images, which may be larger or smaller than a field of the assumed form makes them.
        """
        fit = self.fit
        columns = _camera_columns(fit)
        q = fit.cofactors.reduced.block(columns, columns)
        formal = q * fit.variance
        shared, target = self._carried(columns), self._by_target(columns)
        if not len(columns) or not np.trace(shared + target) > 0:
            spread = np.array([[2.0 / fit.redundancy]])
            return columns, formal, formal[None], spread
        size = np.sqrt(np.maximum(np.diag(q), 0.0))
        values, vectors = np.linalg.eigh(q / np.outer(size, size))
        root = size[:, None] * vectors * np.sqrt(np.maximum(values, 1e-14 * values[-1]))
        inverse = np.linalg.inv(root)
        b, turn = np.linalg.eigh(inverse @ shared @ inverse.T)
        directions, b = root @ turn, np.maximum(b, 0.0)
        own, relative = self._scaled(columns, directions, b)
        parts = np.concatenate(
            [self.variance * q[None], target[None], self.variance * own[:, None, None]
             * directions.T[:, :, None] * directions.T[:, None, :]]
        )  # fmt: skip
        total = _not_below(parts.sum(axis=0), formal)
        # The size of all together is known as well as the likelihood says, that of each as its scores say.
        count = max(len(np.unique(fit.problem.network.point_of[used_rows(fit)])), 1)
        spread = np.diag(np.concatenate([[self.spread, 2.0 / (3 * count)], relative]))
        return columns, total, parts, spread

    def _carried(self, columns: Rows) -> Array:
        """Covariance (k, k) of parameters by what images share, for a variance factor of one."""
        fit, k = self.fit, len(columns)
        found = np.zeros((k, k))
        sigma = sigma_seen(fit)
        typical = float(np.sqrt(np.mean(sigma**2)))
        if self.smooth.any():
            smooth, forms = smooth_effects(fit)
            smooth, first = self._by_view(smooth), np.unique(self.views, return_index=True)[1]
            by = sensitivities(fit, smooth, columns).reshape(k, smooth.groups, -1)
            for weight, size, root in zip(self.weights, self.smooth, forms.values(), strict=True):
                if weight * size > 0:
                    own = np.einsum("kgq,gqp->kgp", by, typical * root[first]).reshape(k, -1)
                    found += weight * size**2 * (own @ own.T)
        if self.distance > 0:
            distance = self._by_view(distance_effects(fit))
            own = sensitivities(fit, distance, columns) * _inverse(distance.rms(sigma)).ravel()
            found += self.distance**2 * (own @ own.T)
        return found

    def _by_view(self, effect: Effect) -> Effect:
        """Effects of images as those of their views."""
        group = np.where(effect.group >= 0, self.views[effect.group], -1)
        return replace(effect, group=group, groups=int(self.views.max()) + 1)

    def _by_target(self, columns: Rows) -> Array:
        """Covariance (k, k) of parameters by errors of the points of the target."""
        effect = point_effects(self.fit) if self.points else None
        if effect is None:
            return np.zeros((len(columns), len(columns)))
        own = sensitivities(self.fit, effect, columns) * _one_unit(effect, sigma_seen(self.fit))
        return np.asarray(self.variance * self.points**2 * (own @ own.T))

    def _scaled(self, columns: Rows, directions: Array, b: Array) -> tuple[Array, Array]:
        """Variances by shared errors in each direction (k,), b where they have the form assumed; spreads."""
        camera, count = self.fit.unknowns.camera, self.fit.unknowns.count
        width = int(count.max(initial=0))
        groups = len(self.pulls) // max(width, 1)
        if not groups:
            return b, np.zeros(len(columns))
        by_image = np.zeros((groups, width, len(columns)))
        place = {column: k for k, column in enumerate(columns.tolist())}
        for i in range(groups):
            c = int(self.fit.problem.network.camera_of[np.argmax(self.views == i)])
            for q in range(int(count[c]) if camera[c] >= 0 else 0):
                by_image[i, q, place[int(camera[c]) + q]] = 1.0
        turned = by_image @ directions
        g = np.einsum("iq,iqk->ik", self.scores.g.reshape(groups, width), turned)
        blocks = (groups, width, groups, width)
        own, shared = (
            np.einsum("iqk,iqjr,jrk->kij", turned, m.reshape(blocks), turned, optimize=True)
            for m in (self.scores.m, self.pulls)
        )
        grid = np.linspace(np.log(0.05), np.log(5.0), 160)
        # The sum of squares over the images is what the parameters are pulled by: as many as are about equal.
        squares = (g**2).sum(axis=0) / self.variance
        total = own + shared
        many = np.trace(total, axis1=1, axis2=2) ** 2 / np.maximum((total**2).sum(axis=(1, 2)), 1e-300)
        own, shared = (np.maximum(np.trace(m, axis1=1, axis2=2), 0.0) for m in (own, shared))
        # Where no image that was looked at has a score, there is nothing but rounding errors.
        own = np.maximum(own, 1e-12 * float(own.max(initial=1e-88)))
        var = own + np.exp(2 * grid)[:, None] * shared
        log = -0.5 * many * (np.log(var) + squares / var)
        together = grid[int(np.argmax(log.sum(axis=1)))]
        log = log - 0.5 * ((grid[:, None] - together) / _SHAPE) ** 2
        weight = np.exp(log - log.max(axis=0))
        weight /= weight.sum(axis=0)
        # Middle and spread of logarithms: Student's distribution is wide by its degrees of freedom, not by a
        # larger variance, too.
        total = np.log1p(np.exp(2 * grid)[:, None] * b)
        middle = (weight * total).sum(axis=0)
        found, spread = np.expm1(middle), (weight * (total - middle) ** 2).sum(axis=0)
        return found, spread * (np.exp(middle) / np.maximum(found, 1e-12)) ** 2


def _degrees(parts: Array, spread: Array) -> Array:
    """Degrees of freedom of sums of parts (p, …) with relative variances and covariances (p, p)."""
    total = parts.sum(axis=0)
    variance = np.einsum("i...,ij,j...->...", parts, spread, parts)
    return np.asarray(np.divide(2 * total**2, variance, out=np.full(total.shape, np.inf), where=variance > 0))


def _camera_columns(fit: BundleFit) -> Rows:
    """Columns of all parameters of cameras among the reduced unknowns."""
    unknowns = fit.unknowns
    parts = [unknowns.camera[c] + np.arange(unknowns.count[c]) for c in np.flatnonzero(unknowns.camera >= 0)]
    parts += [
        unknowns.extra[e] + np.arange(unknowns.extra_count[e]) for e in np.flatnonzero(unknowns.extra >= 0)
    ]
    return np.concatenate(parts).astype(np.intp) if parts else np.zeros(0, dtype=np.intp)


@one_thread()
def shared_errors(fit: BundleFit) -> SharedErrors | None:
    """Estimate what the points of each image have in common.

    Parameters
    ----------
    fit : BundleFit
        The adjustment.

    Returns
    -------
    SharedErrors or None
        None with fewer than three images, without redundancy, or where the network is too large.
    """
    images = looked_at(fit)
    if len(images) < LEAST or fit.redundancy < 1 or not fit.sigma0 > 0:
        return None
    (smooth, forms), distance, points = smooth_effects(fit), distance_effects(fit), point_effects(fit)
    views = views_of(fit)
    groups, first = int(views[images].max()) + 1, images[np.unique(views[images], return_index=True)[1]]
    place = np.where(np.isin(np.arange(len(views)), images), views, -1)
    some = [
        Effect(effect.slope, np.where(effect.group >= 0, place[effect.group], -1), groups)
        for effect in (smooth, distance)
    ]
    if points is not None and not too_large(fit, sum(effect.count for effect in (*some, points))):
        some.append(points)
    if too_large(fit, sum(effect.count for effect in some)) or not len(_camera_columns(fit)):
        return None
    own = _camera_effects(fit, place, groups)
    every = scores(fit, [*some, own])
    sigma = sigma_seen(fit)
    typical = float(np.sqrt(np.mean(sigma**2)))
    ends = np.cumsum([effect.count for effect in some])
    parts = [slice(int(end) - effect.count, int(end)) for end, effect in zip(ends, some, strict=True)]
    count, end = some[0].count, int(ends[-1])
    unit = _inverse(some[1].rms(sigma)).ravel()
    if len(some) > 2:
        unit = np.concatenate([unit, np.full(some[2].count, _one_unit(some[2], sigma))])
    others = every.part(slice(count, end)).scaled(unit)
    cross = every.m[:count, count:end] * unit
    fits = []
    for root in forms.values():
        field = every.part(slice(0, count)).combined(groups, typical * root[first])
        between = _across(cross, typical * root[first])
        m = np.block([[field.m, between], [between.T, others.m]])
        joint = Scores(np.concatenate([field.g, others.g]), m, every.square, every.redundancy, m[:0])
        seen = np.concatenate(
            [_across(every.m[:count, end:], typical * root[first]), unit[:, None] * every.m[count:end, end:]]
        )
        fits.append((*_largest(joint, parts), joint, seen))
    # Each component pays for itself as a parameter with as many observations as it has groups (Schwarz 1978).
    price = 0.5 * np.log([effect.groups for effect in some])
    log = np.array([log - price @ (sizes > 0) for sizes, log, *_ in fits])
    nothing = float(every.log_likelihood(np.array(every.square)))
    weights = np.exp(log - max(float(log.max()), nothing))
    weights /= weights.sum() + len(weights) * np.exp(nothing - max(float(log.max()), nothing))
    best, _, joint, _ = fits[int(np.argmax(log))]
    variance, spread = _information(joint, parts, best)
    every_size = np.array([sizes for sizes, *_ in fits])
    width = own.slope.shape[2]
    pulls = np.zeros((groups * width, groups * width))
    by_image = parts[1].stop
    for weight, sizes, (*_, seen) in zip(weights, every_size, fits, strict=True):
        half = np.repeat(sizes[:2], [count, by_image - count])[:, None] * seen[:by_image]
        pulls += weight * (half.T @ half)
    distance_size = float(np.sqrt(weights @ every_size[:, 1] ** 2))
    points_size = float(np.sqrt(weights @ every_size[:, 2] ** 2)) if len(some) > 2 else 0.0
    by_camera = every.part(slice(end, None))
    return SharedErrors(
        fit, variance, every_size[:, 0], distance_size, points_size, weights, spread, views, by_camera, pulls
    )


def _camera_effects(fit: BundleFit, place: Rows, count: int) -> Effect:
    """The parameters of the camera as effects of each image: what they are pulled by."""
    linear, unknowns = fit.linear, fit.unknowns
    rows, network = used_rows(fit), fit.problem.network
    image = network.image_of[rows]
    camera = network.camera_of[image]
    width = int(unknowns.count.max(initial=0))
    slope, inverse = np.zeros((len(rows), 2, width)), np.linalg.inv(linear.system.seen.root)
    pattern = linear.system.pattern
    for c in np.flatnonzero(unknowns.camera >= 0):
        own = np.flatnonzero(camera == c)
        for k in range(unknowns.count[c]):
            at = unknowns.camera[c] + k
            inside = (pattern.start[own] <= at) & (at < pattern.start[own] + pattern.width[own])
            segment = np.argmax(inside, axis=1)
            column = pattern.column[own, segment] + at - pattern.start[own, segment]
            slope[own, :, k] = linear.rows[own, :, column] * inside.any(axis=1)[:, None]
    slope = inverse @ slope
    return Effect(slope, place[image], count)


def _across(cross: Array, roots: Array) -> Array:
    """Information between combined columns of each image and others."""
    groups, q, k = roots.shape
    return np.asarray((np.swapaxes(roots, 1, 2) @ cross.reshape(groups, q, -1)).reshape(groups * k, -1))


def _one_unit(effect: Effect, sigma: Array) -> float:
    """Size of all effects with which they displace the image points by their sigma, root mean square."""
    square = float(effect.mean_square(sigma).sum())
    return 1 / np.sqrt(square) if square > 0 else 0.0


def _inverse(rms: Array) -> Array:
    return np.divide(1.0, rms, out=np.zeros_like(rms), where=rms > 0)


def _largest(scores: Scores, parts: Sequence[slice]) -> tuple[Array, float]:
    """Sizes of the components with the largest restricted likelihood, and its logarithm."""
    columns = [np.arange(part.start, part.stop) for part in parts]
    sizes = np.zeros(len(parts))
    sizes[0], best = _along(scores.part(columns[0]), 0.0)
    for _ in range(2):
        before = best
        for k in range(1, len(parts)):
            log = _without(scores, columns, sizes, k).part(columns[k]).log_profile(_FINE)
            at = int(np.argmax(log))
            if log[at] > best + _CONVERGED:
                sizes[k], best = float(_FINE[at]), float(log[at])
        if best <= before + _CONVERGED:
            break
        sizes[0], best = _along(_without(scores, columns, sizes, 0).part(columns[0]), sizes[0])
    return sizes, best


def _without(scores: Scores, columns: Sequence[Rows], sizes: Array, k: int) -> Scores:
    """The scores after all components but one were taken into account."""
    for j, (own, size) in enumerate(zip(columns, sizes, strict=True)):
        if j != k and size:
            scores = scores.with_effects(own, float(size))
    return scores


def _along(scores: Scores, near: float) -> tuple[float, float]:
    """Size of the largest likelihood: on a coarse grid, then by parabolas on a logarithmic scale."""

    def log_of(x: float) -> float:
        size = float(np.exp(x))
        factor = lower_factor(size**2 * scores.m)
        half = scipy.linalg.solve_triangular(factor, size * scores.g, lower=True, check_finite=False)
        square = scores.square - float(half @ half)
        return float(scores.log_likelihood(np.array(square)) - np.log(np.diag(factor)).sum())

    nothing = float(scores.log_likelihood(np.array(scores.square)))
    grid = np.log(_GRID) if not near else np.log(near) + np.log(2.0) * np.arange(-1, 2)
    values = [log_of(float(x)) for x in grid]
    k = int(np.argmax(values))
    x, y, step = float(grid[k]), values[k], float(grid[1] - grid[0])
    left = values[k - 1] if k else log_of(x - step)
    right = values[k + 1] if k + 1 < len(values) else log_of(x + step)
    for _ in range(3):
        bend = left - 2 * y + right
        move = (
            float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) * step
            if -np.inf < bend < 0
            else (step if right > left else -step)
        )
        new = log_of(x + move)
        if new <= y + _CONVERGED:
            break
        x, y, step = x + move, new, step / 3
        left, right = log_of(x - step), log_of(x + step)
    return (float(np.exp(x)), y) if y > nothing else (0.0, nothing)


def _information(scores: Scores, parts: Sequence[slice], sizes: Array) -> tuple[float, float]:
    """Variance factor, and its relative variance, with the sizes of shared errors as unknown as they are."""
    units = np.repeat(sizes, [part.stop - part.start for part in parts])
    used = np.flatnonzero(units > 0)
    r, m = scores.redundancy, scores.m[np.ix_(used, used)]
    if not len(used):
        return scores.square / r, 2.0 / r
    s = np.linalg.inv(np.diag(1 / units[used] ** 2) + m)
    variance = (scores.square - float(scores.g[used] @ s @ scores.g[used])) / r
    sm = s @ m
    left = m - m @ sm
    twice = (np.eye(len(used)) - m @ s) @ left
    each = [np.flatnonzero((used >= part.start) & (used < part.stop)) for part in parts]
    fisher = np.zeros((1 + len(parts), 1 + len(parts)))
    fisher[0, 0] = r - 2 * np.trace(sm) + np.einsum("ij,ji->", sm, sm)
    for i, a in enumerate(each):
        fisher[0, i + 1] = fisher[i + 1, 0] = np.trace(twice[np.ix_(a, a)])
        for j, b in enumerate(each):
            fisher[i + 1, j + 1] = (left[np.ix_(a, b)] ** 2).sum()
    live = np.flatnonzero(np.diag(fisher) > 0)
    return variance, 2 * float(np.linalg.inv(fisher[np.ix_(live, live)])[0, 0])


def _not_below(total: Array, formal: Array) -> Array:
    """The least covariance that is not below either in any direction, to first order."""
    if not len(total):
        return total
    size = np.sqrt(np.maximum(np.diag(formal), 0.0))
    size = np.where(size > 0, size, 1.0)
    scaled = np.outer(size, size)
    values, vectors = np.linalg.eigh(formal / scaled)
    root = vectors * np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    inverse = np.linalg.inv(root)
    ratio, turn = np.linalg.eigh(inverse @ (total / scaled) @ inverse.T)
    whole = root @ turn
    return np.asarray((whole * np.maximum(ratio, 1.0)) @ whole.T * scaled)
