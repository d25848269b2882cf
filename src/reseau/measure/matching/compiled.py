"""Least-squares matching of many windows, compiled.

The equations are those of :class:`reseau.measure.matching.patches.Patches` (grey values, derivatives, common
errors of rows) and of the damped chord method of :func:`reseau.adjust.adjust_batch`; here they are computed
window by window, so that they fit into a cache. A window that needs another Jacobian (a refused step, slow
convergence) is marked STALE: the caller forms its image with derivatives, and linearises it again.
"""

from __future__ import annotations

import math

import numpy as np

from ...core.assign import assign
from ...core.compiled import compiled
from .compiled_rows import (
    TOGETHER,
    Floats,
    add_squares,
    add_weighted,
    factorised,
    fill_normal,
    fill_weighted,
    multiply,
    product,
    solve,
    without_common,
)

__all__ = [
    "ACTIVE",
    "DONE",
    "FAILED",
    "STALE",
    "advanced",
    "influenced",
    "linearised",
]

ACTIVE, DONE, STALE, FAILED = 0, 1, 2, 3
"""States of a window: to be evaluated at its trial, converged, to be linearised at its estimates, without a
solution."""
_COST, _DAMPING, _PREDICTED, _LAST, _FRESH, _GROWTH = range(6)
"""Columns of an iteration: sum of squares, damping, its decrease that is predicted, and the same in the
iteration before, whether the Jacobian is that at the estimates, factor of the damping after a refusal."""
_WIDTH, _CONTRAST, _LEVEL = 2, 3, 4
_SERVES, _SHRINKS, _LEAST_DAMPING, _MOST_DAMPING = 0.75, 0.1, 1e-10, 1e12
_GAINS, _HELD = 1e-4, 1e-2
"""As in :mod:`reseau.adjust.batch`."""
_TINY = 1e-300
f32 = np.float32


@compiled
def _formed(
    x: Floats,
    share: Floats,
    monomials: Floats,
    across: Floats,
    dark: bool,
    plane: Floats,
    contrast: Floats,
    grey: Floats,
) -> None:
    """Background, contrast and grey values (n,) of a window of which `share` (n,) is covered."""
    n, ground = len(share), len(monomials)
    plane[:], contrast[:] = 0.0, x[_CONTRAST]
    add_weighted(x, np.intp(_LEVEL), monomials, plane)
    add_weighted(x, _LEVEL + ground, across, contrast)
    if dark:
        for i in range(n):
            grey[i] = plane[i] * (1.0 - contrast[i] * share[i])
    else:
        for i in range(n):
            grey[i] = plane[i] + contrast[i] * share[i]


@compiled
def _step(
    normal: Floats, gradient: Floats, damping: float, scale: Floats, lower: Floats, step: Floats
) -> float:
    """Fill a damped correction; the decrease of the sum of squares it predicts, negative if there is none."""
    if not factorised(normal, damping, scale, lower):
        return -1.0
    u = len(gradient)
    for i in range(u):
        step[i] = gradient[i] * scale[i]
    solve(lower, step)
    # The decrease 2 sᵀ g − sᵀ N s of the sum of squares, with (N + d I) s = g.
    predicted = 0.0
    for i in range(u):
        predicted += step[i] * (gradient[i] * scale[i] + damping * step[i])
    for i in range(u):
        step[i] *= scale[i]
    return predicted


@compiled
def _next(
    k: int,
    normal: Floats,
    gradient: Floats,
    limit: float,
    x: Floats,
    trial: Floats,
    iteration: Floats,
    state: Floats,
) -> None:
    """Correct window `k`, or place its trial."""
    u = len(gradient)
    scale, lower, step = np.empty(u), np.empty((u, u)), np.empty(u)
    predicted = _step(normal, gradient, iteration[k, _DAMPING], scale, lower, step)
    if not predicted >= 0:
        state[k] = FAILED
        return
    last = iteration[k, _LAST]
    rate2 = predicted / max(last, predicted) if predicted > 0 else 1.0
    done = predicted * rate2 <= limit
    for i in range(u):
        trial[k, i] = x[k, i] + step[i]
    if done and iteration[k, _DAMPING] > _HELD:
        # Damping makes corrections small: the one without it decides.
        done = _step(normal, gradient, _LEAST_DAMPING, scale, lower, step) <= limit
    if not done and last > 0 and predicted > _SHRINKS * last:
        state[k] = STALE  # corrections decrease slowly
        return
    iteration[k, _PREDICTED] = iteration[k, _LAST] = predicted
    if done:
        state[k] = DONE
        assign(x[k], trial[k])


@compiled
def _roots(weights: Floats, root: Floats) -> int:
    """Fill square roots of the weights (n,); the number of pixels used."""
    used = 0
    for i in range(len(root)):
        root[i] = math.sqrt(weights[i])
        used += weights[i] > 0
    return used


@compiled
def _factors(
    plane: Floats,
    contrast: Floats,
    share: Floats,
    root: Floats,
    dark: bool,
    by_share: Floats,
    by_contrast: Floats,
    rest: Floats,
) -> None:
    """Derivatives (n,) of grey values by share, contrast and background, times the roots of their weights."""
    n = len(share)
    if dark:
        for i in range(n):
            by_share[i] = -plane[i] * contrast[i] * root[i]
        for i in range(n):
            by_contrast[i] = -plane[i] * share[i] * root[i]
        for i in range(n):
            rest[i] = (1.0 - contrast[i] * share[i]) * root[i]
    else:
        for i in range(n):
            by_share[i] = contrast[i] * root[i]
        multiply(share, root, by_contrast)
        assign(rest, root)


@compiled
def _widening(log_width: float, psf: float) -> float:
    """Derivative of the width of the point-spread function by its logarithm above the lower bound."""
    wide = math.exp(log_width)
    return wide * wide / math.hypot(psf, wide)


@compiled
def _fill_jacobian(
    slopes: Floats,
    factors: Floats,
    window: tuple[Floats, Floats, int],
    widening: float,
    jacobian: Floats,
) -> None:
    """Fill derivatives (u, n) of grey values times the roots of their weights; `factors` (3, n)."""
    monomials, across, _ = window
    by_share, by_contrast, rest = factors[0], factors[1], factors[2]
    ground, u = len(monomials), len(jacobian)
    multiply(by_share, slopes[0], jacobian[0])
    multiply(by_share, slopes[1], jacobian[1])
    multiply(by_share, slopes[2], jacobian[_WIDTH])
    for i in range(jacobian.shape[1]):
        jacobian[_WIDTH, i] *= f32(widening)
    assign(jacobian[_CONTRAST], by_contrast)
    for m in range(ground):
        multiply(rest, monomials[m], jacobian[_LEVEL + m])
    at = _LEVEL + ground
    for m in range(len(across)):
        multiply(by_contrast, across[m], jacobian[at + m])
    at += len(across)
    for m in range(u - at):
        multiply(by_share, slopes[3 + m], jacobian[at + m])


@compiled
def _fill_gradient(
    slopes: Floats,
    factors: Floats,
    window: tuple[Floats, Floats, int],
    widening: float,
    off: Floats,
    part: Floats,
    gradient: Floats,
) -> None:
    """Fill the negative product (u,) of the derivatives and weighted residuals `off` (n,).

    The derivatives themselves would take a cache; `part` (n,) is memory of their kind.
    """
    monomials, across, _ = window
    ground, forms, n = len(monomials), len(slopes) - 3, len(off)
    multiply(factors[0], off, part)
    for m in range(len(slopes)):
        at = m if m <= _WIDTH else len(gradient) - forms + m - 3
        gradient[at] = -product(slopes[m], part, np.intp(0), n)
    gradient[_WIDTH] *= widening
    multiply(factors[1], off, part)
    total = 0.0
    for i in range(n):
        total += part[i]
    gradient[_CONTRAST] = -total
    for m in range(len(across)):
        gradient[_LEVEL + ground + m] = -product(across[m], part, np.intp(0), n)
    multiply(factors[2], off, part)
    for m in range(ground):
        gradient[_LEVEL + m] = -product(monomials[m], part, np.intp(0), n)


@compiled
def _fill_influence(
    jacobian: Floats, cofactor: Floats, root: Floats, part: Floats, on_position: Floats, leverage: Floats
) -> None:
    """Fill influences (2, n) and leverages (n,) of a window; see :func:`linearised`.

    With the factor C of a cofactor Q = C Cᵀ the leverages are the squared lengths of the columns of Cᵀ Aᵀ.
    `part` is memory of some pixels.
    """
    u, n = jacobian.shape
    scale, factor = np.empty(u), np.empty((u, u))
    positive = factorised(cofactor, 0.0, scale, factor)
    first, columns = cofactor[:2].astype(f32), np.zeros((u, u), f32)
    for m in range(u):
        for i in range(m, u):
            columns[m, i] = factor[i, m] / scale[i]
    leverage[:] = f32(0)
    for begin in range(0, n, len(part)):
        end = min(begin + len(part), n)
        some = part[: end - begin]
        for m in range(2):
            fill_weighted(first[m], np.intp(0), jacobian, begin, some)
            multiply(some, root[begin:end], on_position[m, begin:end])
        if not positive:
            continue
        for m in range(u):
            fill_weighted(columns[m], m, jacobian, begin, some)
            add_squares(some, leverage[begin:end])


@compiled
def linearised(
    rows: Floats,
    share: Floats,
    slopes: Floats,
    observed: Floats,
    weights: Floats,
    window: tuple[Floats, Floats, int],
    light: tuple[bool, float, float],
    psf: Floats,
    mean: Floats,
    prior: Floats,
    share_of_sigma: float,
    x: Floats,
    work: tuple[Floats, Floats, Floats, Floats, Floats, Floats],
    trial: Floats,
    iteration: Floats,
    state: Floats,
    influence: tuple[Floats, Floats],
) -> None:
    """Form the normal equations of windows `rows` (m,) at `x`, and the next trial of each.

    Parameters
    ----------
    share, slopes : ndarray (m, n), (m, 3 + p, n), float32
        Images formed at `x`, and their derivatives by x, y, width and form.
    observed, weights : ndarray (k, n)
        Grey values, and their weights; 0 where a pixel is not used.
    window : tuple
        Monomials (b, n) of the background, those (0 or 2, n) of the contrast, number of columns.
    light : tuple
        Whether marks are dark; variance of unit weight; variance of the shift of a row over that of a grey
        value.
    psf : ndarray (k,)
        Lower bound of the width of the point-spread function.
    mean, prior : ndarray (k, u), (u,)
        Observed parameters, and their weights.
    share_of_sigma : float
        Corrections below this share of their standard deviation end the iteration.
    x : ndarray (k, u)
        Approximate values, replaced by the estimates where the state becomes DONE.
    work : tuple
        Filled: residuals (k, n), normal equations (k, u, u), gradients (k, u), cofactors (k, u, u), slope and
        weighted slope (k, n) of the common errors of rows, float32, both times the roots of the weights,
        (0, n) if rows have none.
    trial, iteration, state : ndarray (k, u), (k, 6), (k,)
        Filled: next values to evaluate; columns of the iteration, of which the damping and its factor are
        given; ACTIVE, DONE or FAILED.
    influence : tuple
        Filled where the state becomes DONE: influence of each pixel on the position (k, 2, n) and its
        leverage (k, n), float32; (0, …) if they are not wanted. With derivatives A, weights W and cofactor Q
        they are the first rows of Q Aᵀ W, and the diagonal of A Q Aᵀ W.
    """
    monomials, across, columns = window
    dark, variance, jitter = light
    residuals, normals, gradients, cofactors, slope, weighted = work
    on_position, leverage = influence
    n, u, forms = observed.shape[1], x.shape[1], slopes.shape[1] - 3
    plane, contrast, grey = np.empty(n), np.empty(n), np.empty(n)
    root, part, factors = np.empty(n, f32), np.empty(n, f32), np.empty((3, n), f32)
    jacobian, some = np.empty((u, n), f32), np.empty(TOGETHER, f32)
    scale, lower, left = np.empty(u), np.empty((u, u)), np.empty(n, f32)
    for j in range(len(rows)):
        k = rows[j]
        covered, seen = share[j], observed[k]
        _formed(x[k], covered, monomials, across, dark, plane, contrast, grey)
        used, widening = _roots(weights[k], root), _widening(x[k, _WIDTH], psf[k])
        _factors(plane, contrast, covered, root, dark, factors[0], factors[1], factors[2])
        _fill_jacobian(slopes[j], factors, window, widening, jacobian)
        for i in range(n):
            # Pixels that are not used may carry any value.
            residuals[k, i] = grey[i] - seen[i] if root[i] > 0 else 0.0
        multiply(residuals[k], root, left)
        if len(slope):
            along, heavy = slope[k], weighted[k]
            assign(along, jacobian[0])
            for first in range(0, n, columns):
                length2 = variance * product(along, along, first, first + columns)
                factor = f32(variance * (1.0 - 1.0 / math.sqrt(1.0 + jitter * length2)) / max(length2, 1e-30))
                for i in range(first, first + columns):
                    heavy[i] = along[i] * factor
            without_common(left, along, heavy, columns, part)
            for m in range(u):
                without_common(jacobian[m], along, heavy, columns, part)
            _unweighted(left, root, residuals[k])
        cost = product(left, left, np.intp(0), n)
        for m in range(u):
            cost += prior[m] * (mean[k, m] - x[k, m]) ** 2
        fill_normal(jacobian, normals[k])
        gradient = np.dot(jacobian, left)
        for m in range(u):
            normals[k, m, m] += prior[m]
            gradients[k, m] = prior[m] * (mean[k, m] - x[k, m]) - gradient[m]
        freedom = used + np.count_nonzero(prior) - u
        iteration[k, _COST], iteration[k, _LAST], iteration[k, _FRESH] = cost, 0.0, 1.0
        if not (math.isfinite(cost) and freedom >= 0 and factorised(normals[k], 0.0, scale, lower)):
            state[k] = FAILED
            continue
        for m in range(u):
            for i in range(u):
                cofactors[k, m, i] = 1.0 if i == m else 0.0
            solve(lower, cofactors[k, m])
            for i in range(u):
                cofactors[k, m, i] *= scale[i] * scale[m]
        limit = share_of_sigma**2 * cost / max(freedom, 1)
        state[k] = ACTIVE
        _next(k, normals[k], gradients[k], limit, x, trial, iteration, state)
        # What the first correction leaves is smaller than itself by half the relative change of the mark.
        wide = math.exp(x[k, _WIDTH])
        total = math.hypot(psf[k], wide)
        change = max(abs(trial[k, 0] - x[k, 0]), abs(trial[k, 1] - x[k, 1])) / total
        change = max(change, abs(trial[k, _WIDTH] - x[k, _WIDTH]) * (wide / total) ** 2)
        change = max(change, abs(trial[k, _CONTRAST] / x[k, _CONTRAST] - 1.0))
        for m in range(u - forms, u):
            change = max(change, abs(trial[k, m] - x[k, m]))
        left_over = iteration[k, _PREDICTED]
        if state[k] == ACTIVE and left_over * (change / 4) ** 2 <= limit * (1 - left_over / cost):
            _extrapolated(x[k], trial[k], jacobian, slopes[j], widening, covered, root, left, residuals[k])
            iteration[k, _COST], state[k] = cost - left_over, DONE
        if len(leverage) and state[k] == DONE:
            _fill_influence(jacobian, cofactors[k], root, some, on_position[k], leverage[k])


@compiled
def _unweighted(off: Floats, root: Floats, residuals: Floats) -> None:
    """Fill residuals (n,) from weighted ones; 0 where a pixel is not used."""
    for i in range(len(off)):
        residuals[i] = off[i] / root[i] if root[i] > 0 else 0.0


@compiled
def influenced(
    rows: Floats,
    places: Floats,
    first: tuple[Floats, Floats, Floats],
    weights: Floats,
    window: tuple[Floats, Floats, int],
    dark: bool,
    psf: Floats,
    cofactors: Floats,
    influence: tuple[Floats, Floats],
) -> None:
    """Fill influences of windows `rows` (m,) that have converged after they were linearised.

    Parameters
    ----------
    places : ndarray (m,)
        Their rows of `first`.
    first : tuple
        Values (r, u), images (r, n) and derivatives (r, 3 + p, n) at which they were linearised last.
    weights, window, dark, psf, cofactors, influence
        As in :func:`linearised`.
    """
    at, share, slopes = first
    monomials, across, _ = window
    on_position, leverage = influence
    n, u = weights.shape[1], at.shape[1]
    plane, contrast, grey = np.empty(n), np.empty(n), np.empty(n)
    root, factors = np.empty(n, f32), np.empty((3, n), f32)
    jacobian, some = np.empty((u, n), f32), np.empty(TOGETHER, f32)
    for j in range(len(rows)):
        k, p = rows[j], places[j]
        _formed(at[p], share[p], monomials, across, dark, plane, contrast, grey)
        _roots(weights[k], root)
        _factors(plane, contrast, share[p], root, dark, factors[0], factors[1], factors[2])
        _fill_jacobian(slopes[p], factors, window, _widening(at[p, _WIDTH], psf[k]), jacobian)
        _fill_influence(jacobian, cofactors[k], root, some, on_position[k], leverage[k])


@compiled
def _extrapolated(
    x: Floats,
    trial: Floats,
    jacobian: Floats,
    slopes: Floats,
    widened: float,
    share: Floats,
    root: Floats,
    off: Floats,
    residuals: Floats,
) -> None:
    """Change `x` to `trial`, and share and residuals (n,) of a window by their derivatives.

    `off` (n,) are residuals times the roots of the weights.
    """
    u, forms = len(x), len(slopes) - 3
    steps = np.empty(u + len(slopes), f32)
    for m in range(u):
        steps[m] = trial[m] - x[m]
    for m in range(len(slopes)):
        steps[u + m] = steps[m if m <= _WIDTH else u - forms + m - 3] * f32(widened if m == _WIDTH else 1.0)
    add_weighted(steps, np.intp(0), jacobian, off)
    _unweighted(off, root, residuals)
    add_weighted(steps, u, slopes, share)
    assign(x, trial)


@compiled
def advanced(
    rows: Floats,
    places: Floats,
    first: tuple[Floats, Floats, Floats],
    share: Floats,
    observed: Floats,
    weights: Floats,
    window: tuple[Floats, Floats, int],
    dark: bool,
    psf: Floats,
    mean: Floats,
    prior: Floats,
    share_of_sigma: float,
    x: Floats,
    work: tuple[Floats, Floats, Floats, Floats, Floats, Floats],
    trial: Floats,
    iteration: Floats,
    state: Floats,
) -> None:
    """Accept or refuse the trials of windows `rows` (m,), in which `share` (m, n) was formed; place the next.

    Parameters as in :func:`linearised`, and `places`, `first` as in :func:`influenced`.
    """
    monomials, across, columns = window
    residuals, normals, gradients, _, slope, weighted = work
    at, begun, slopes = first
    n, u = observed.shape[1], x.shape[1]
    plane, contrast, grey, left = np.empty(n), np.empty(n), np.empty(n), np.empty(n, f32)
    root, part, factors = np.empty(n, f32), np.empty(n, f32), np.empty((3, n), f32)
    for j in range(len(rows)):
        k, p, seen = rows[j], places[j], observed[rows[j]]
        _formed(trial[k], share[j], monomials, across, dark, plane, contrast, grey)
        used = _roots(weights[k], root)
        for i in range(n):
            grey[i] = grey[i] - seen[i] if root[i] > 0 else 0.0
        multiply(grey, root, left)
        if len(slope):
            without_common(left, slope[k], weighted[k], columns, part)
            _unweighted(left, root, grey)
        cost = product(left, left, np.intp(0), n)
        for m in range(u):
            cost += prior[m] * (trial[k, m] - mean[k, m]) ** 2
        gain = (iteration[k, _COST] - cost) / max(iteration[k, _PREDICTED], _TINY)
        limit = share_of_sigma**2 * cost / max(used + np.count_nonzero(prior) - u, 1)
        if gain > _SERVES:
            assign(x[k], trial[k])
            assign(residuals[k], grey)
            if len(slope):
                # The transposed of what made the derivatives independent.
                without_common(left, weighted[k], slope[k], columns, part)
            _formed(at[p], begun[p], monomials, across, dark, plane, contrast, grey)
            _factors(plane, contrast, begun[p], root, dark, factors[0], factors[1], factors[2])
            widening = _widening(at[p, _WIDTH], psf[k])
            _fill_gradient(slopes[p], factors, window, widening, left, part, gradients[k])
            for m in range(u):
                gradients[k, m] += prior[m] * (mean[k, m] - x[k, m])
            iteration[k, _COST], iteration[k, _FRESH], iteration[k, _GROWTH] = cost, 0.0, 2.0
            iteration[k, _DAMPING] = max(iteration[k, _DAMPING] / 3, _LEAST_DAMPING)
            _next(k, normals[k], gradients[k], limit, x, trial, iteration, state)
        elif iteration[k, _FRESH] == 0.0:
            state[k] = STALE
        elif gain > _GAINS:
            assign(x[k], trial[k])
            assign(residuals[k], grey)
            state[k] = STALE
            iteration[k, _COST], iteration[k, _GROWTH] = cost, 2.0
            shrink = max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            iteration[k, _DAMPING] = max(iteration[k, _DAMPING] * shrink, _LEAST_DAMPING)
        else:
            iteration[k, _DAMPING] *= iteration[k, _GROWTH]
            iteration[k, _GROWTH] *= 2.0
            iteration[k, _LAST] = 0.0
            limit = share_of_sigma**2 * iteration[k, _COST] / max(used + np.count_nonzero(prior) - u, 1)
            if iteration[k, _DAMPING] > _MOST_DAMPING:
                state[k] = FAILED
            else:
                _next(k, normals[k], gradients[k], limit, x, trial, iteration, state)
