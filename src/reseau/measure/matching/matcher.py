"""Least-squares matching: patches of a frame are adjusted to formed images of marks.

For each mark the position, the width of the point-spread function, the contrast, the background and, if
wanted, the form are estimated together; all marks of a frame make one batch of least-squares problems
(:func:`reseau.adjust.adjust_batch`). Kinds of marks differ only in the outline that is formed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...adjust import adjust_batch
from ...adjust.batch import BatchAdjustment, BatchOptions, BatchReason
from ...core.data import Array, Mask, Rows
from ...core.threads import one_thread
from ...optics.formation import Outline
from .iteration import ACTIVE, DONE, STALE, Iteration
from .matches import Matches, matches_of, with_rows
from .noise import medians
from .patches import CONTRAST, WIDTH, MatchOptions, Patches, X, Y
from .shapes import GrownOutline, Shape, ShapeSubset

_PLAIN = 1.25
"""Multiple of the rejection limit from which blunders are searched for when good start values are known."""

_OTHER_SCALE = 1.2
"""Ratio of the residuals to those by which prior knowledge was weighed from which it is weighed again."""

_FIRST, _MOST = 10, 50
"""Iterations before the search for blunders, and maximum."""
_LAST = 4
"""Least number of iterations for marks that have converged with a Jacobian of other approximate values."""

SIZE = np.eye(2)[None]
"""Generator of the form for a mark of unknown size: a change of scale."""


def match(
    pixels: NDArray[Any],
    valid: Mask,
    outline: Outline | Shape,
    xy: Array,
    options: MatchOptions,
    *,
    noise: float,
    form: Array | None = None,
    form_sigma: Array | None = None,
    claims: tuple[NDArray[Any], Rows] | None = None,
    others: NDArray[Any] | None = None,
    region: Mask | None = None,
    light: tuple[Array, Array] | None = None,
    precise: bool = False,
    searching: float = np.inf,
    least: tuple[Array, float] | None = None,
) -> Matches:
    """Match every patch with the formed image of its mark.

    Parameters
    ----------
    pixels : ndarray (h, w)
        Grey values.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    outline : Outline or Shape
        Outlines (k, j, 2) in pixels around the point to be measured, or a shape of k marks with its own
        parameters.
    xy : ndarray (k, 2)
        Approximate positions, good to about the radius of a mark.
    options : MatchOptions
        Options of the matching.
    noise : float
        Approximate standard deviation of the grey values; used for the weights of prior knowledge only.
    form : ndarray (m, 2, 2) or (k, m, 2, 2), optional
        Generators F_i of the form of an outline, which is multiplied by 1 + Σ p_i F_i.
    form_sigma : ndarray (m,), optional
        Prior standard deviations of the p_i around 0.
    claims : tuple, optional
        Owner of each pixel, (h, w) of int, negative for none; and the owner number (k,) of each mark. Pixels
        owned by another mark are not used.
    others : ndarray (k, rows, columns), optional
        Light of other marks in each window, subtracted first.
    region : ndarray of bool (k, rows, columns), optional
        Pixels of each window that belong to the mark; the others are not used.
    light : tuple, optional
        Contrast (k,) and coefficients of the background (k, b), if these, the positions and the width are
        known approximately. Then only patches with large residuals are searched for blunders.
    precise : bool
        Whether positions and width are known so well that the light is found from the grey values, if it is
        not given; patches with large residuals are then left as they are.
    searching : float
        Multiple of `noise` up to which residuals are searched; patches with larger ones count as not
        converged, with 0 all of them.
    least : tuple, optional
        Least correlation (k,) with the formed image, and least share of a mark on pixels that may be used,
        from which patches are searched. By default all.

    Returns
    -------
    Matches
        All k marks; a failed match has `converged` False or a small `t`.

    Examples
    --------
    Form the image of a dark disk of radius 3 px at (10.3, 9.6) and measure its centre:

    >>> import numpy as np
    >>> from reseau.optics.formation import Outline, PixelResponse, coverage
    >>> disk = Outline.circle(3.0, 0.5)
    >>> x, y = np.arange(21.0)[None], np.arange(21.0)[None]
    >>> placed = Outline(disk.xy[None] + [10.3, 9.6], disk.dxy[None])
    >>> share = coverage(placed, x, y, np.ones(1), PixelResponse())[0]
    >>> grey = 200 * (1 - 0.6 * share)
    >>> options = MatchOptions(half_px=8, psf_px=1.0)
    >>> outline = Outline(disk.xy[None], disk.dxy[None])
    >>> found = match(grey, grey > 0, outline, np.array([[10.0, 10.0]]), options, noise=0.5)
    >>> found.xy.round(2)
    array([[10.3,  9.6]])
    """
    if isinstance(outline, Outline):
        outline = GrownOutline(outline, np.zeros((0, 2, 2)) if form is None else form)
    patch = Patches(pixels, valid, outline, xy, options, claims, others, region)
    free = np.full(patch.form_at + patch.forms, np.inf)
    free[[X, Y]], free[WIDTH] = options.held or np.array(options.half) / 2, options.psf_log_sigma
    free[CONTRAST] = options.contrast_sigma
    free[patch.ground.stop : patch.form_at] = options.contrast_slope or np.inf
    if form_sigma is not None:
        free[patch.form_at :] = form_sigma
    if light is None and not precise:
        return _searched(patch, free, noise)
    quick, amiss = _continued(patch, patch.begin(light), free, noise, least, not precise)
    if precise:
        return quick
    came, quick.converged[amiss] = quick.converged[amiss], False
    settled = np.zeros(len(xy), dtype=bool)
    settled[amiss] = came
    if least is not None:
        likely = (quick.correlation >= least[0]) & (quick.seen >= least[1])
        amiss = amiss[likely[amiss]]
    amiss = amiss[~(quick.noise[amiss] > searching * noise)] if searching > 0 else amiss[:0]
    if not len(amiss):
        return quick
    contrast = options.contrast
    few = Patches(
        pixels,
        valid,
        ShapeSubset(outline, amiss),
        xy[amiss],
        replace(
            options,
            psf_px=patch.psf[amiss],
            contrast=contrast[amiss] if isinstance(contrast, np.ndarray) else contrast,
        ),
        None if claims is None else (claims[0], claims[1][amiss]),
        None if others is None else others[amiss],
        None if region is None else region[amiss],
    )
    found = _searched(few, free, noise)
    # A search that leaves larger residuals than it started from has rejected the mark itself.
    worse = settled[amiss] & (~(found.noise < quick.noise[amiss]) | ~found.converged)
    quick.converged[amiss[worse]] = True
    return quick.replaced(amiss[~worse], found.select(~worse))


def _searched(patch: Patches, free: Array, noise: float) -> Matches:
    """Matches from approximate positions alone; pixels with blunders are rejected."""
    options = patch.options
    start = patch.start(noise)

    def adjust(rows: Rows, start_at: Array, most: int = _MOST) -> BatchAdjustment:
        weights = used[rows] * patch.relative_weights[rows] / scale[rows] ** 2
        iteration = BatchOptions(share=options.settled, max_iterations=most)
        if patch.single and patch.whitener is None:
            formed = patch.slopes(start_at[rows], rows)
            return _iterated(patch, rows, start_at[rows], start[rows], formed, weights, free, iteration)
        return adjust_batch(
            lambda x, at: patch.form_image(x, rows[at]),
            start_at[rows],
            patch.grey[rows],
            weights=weights,
            prior=(start[rows], free),
            options=iteration,
        )

    every = np.arange(len(patch.xy))
    used, scale = patch.weights, np.full((len(patch.xy), 1), noise)
    # Before blunders are rejected, full convergence is not needed.
    found = adjust(every, start, _FIRST)
    for most in (_FIRST, _MOST):
        # Large residuals are blunders only around a mark that was found; before, they may be the mark itself.
        residuals, tolerated = patch.residuals(found.estimates)
        limit = options.rejection * np.maximum(_robust_sigma(residuals, used), noise) + tolerated
        kept = patch.weights * (np.abs(residuals) < limit)
        # Model errors caused by a scene count as noise; otherwise prior knowledge would have no weight there.
        rougher = np.maximum(noise, _rms(residuals, kept, start.shape[1]))
        other = np.maximum(rougher / scale, scale / rougher)[:, 0]
        renewed = (kept != used).any(axis=1) | (other > _OTHER_SCALE)
        renewed |= found.reasons == BatchReason.MAX_ITERATIONS
        changed = np.flatnonzero(renewed)
        if not len(changed):
            break
        used, scale = kept, np.where(np.isin(every, changed)[:, None], rougher, scale)
        found = with_rows(found, changed, adjust(changed, found.estimates, most))
    for _ in range(2 if options.row_jitter_px > 0 else 0):
        # The residuals contain the jitter in the first round; whitened residuals contain the noise alone.
        patch.whiten(found.estimates, _rms(found.residuals, used, start.shape[1]), options.row_jitter_px)
        found = adjust(every, found.estimates)
    if patch.single and patch.whitener is None:
        return matches_of(patch, found, used > 0, scale[:, 0], patch.shares, patch.influences)
    return matches_of(patch, found, used > 0, scale[:, 0])


def _continued(
    patch: Patches,
    start: Array,
    free: Array,
    noise: float,
    least: tuple[Array, float] | None = None,
    trimming: bool = False,
) -> tuple[Matches, Rows]:
    """Matches from good start values, and the rows with blunders or without convergence.

    See :func:`match` for `least`; `trimming` rejects pixels of marks that were found.
    """
    weights = patch.weights * patch.relative_weights / noise**2
    options = BatchOptions(share=patch.options.settled, max_iterations=_FIRST, damping=1e-5)
    jitter = patch.options.row_jitter_px
    found, rows = None, np.arange(len(start))
    if patch.single:
        assert patch.first is not None
        found = _iterated(patch, rows, start, start, patch.first, weights, free, options, noise)
        rows = np.flatnonzero(found.reasons == BatchReason.MAX_ITERATIONS)
    if found is not None and least is not None and len(rows):
        rows = rows[patch.correlation(found.estimates, rows) >= least[0][rows]]
    if found is not None and len(rows) and jitter == 0:
        at = found.estimates[rows]
        again = _iterated(patch, rows, at, start[rows], patch.slopes(at, rows), weights[rows], free, options)
        found = with_rows(found, rows, again)
    elif found is None or len(rows):
        formed = patch.shares.copy()
        if jitter > 0:
            patch.whiten(start, np.full((len(start), 1), noise), jitter)
        general = adjust_batch(
            lambda x, at: patch.form_image(x, rows[at]),
            start[rows],
            patch.grey[rows],
            weights=weights[rows],
            prior=(start[rows], free),
            values=lambda x, at: patch.form_values(x, rows[at]),
            options=options,
        )
        found = general if found is None else with_rows(found, rows, general)
        formed[rows] = patch.shares[rows]
        patch.shares = formed
    used = patch.weights > 0
    worst = np.maximum(found.residuals.max(axis=1), -found.residuals.min(axis=1))  # 0 where none is used
    rms = found.sigma0 * noise
    amiss = ~found.converged | ~(rms < 2 * noise)
    large = ~amiss & ~(worst < _PLAIN * patch.options.rejection * np.maximum(rms, noise))
    if trimming and large.any() and patch.single and jitter == 0:
        rows = np.flatnonzero(large)
        found, used[rows] = _trimmed(patch, rows, found, start, weights, free, noise, options)
        large = ~found.converged | ~(found.sigma0 < 2)
    amiss |= large
    scale = np.full(len(start), noise)
    return matches_of(patch, found, used, scale, patch.shares, patch.influences), np.flatnonzero(amiss)


def _trimmed(
    patch: Patches,
    rows: Rows,
    found: BatchAdjustment,
    start: Array,
    weights: Array,
    free: Array,
    noise: float,
    options: BatchOptions,
) -> tuple[BatchAdjustment, Mask]:
    """Matches of which those in `rows` are continued without their blunders, and the pixels they use."""
    x, used = found.estimates[rows], patch.weights[rows] > 0
    off, share = np.abs(found.residuals[rows]), patch.shares[rows].reshape(len(rows), -1)
    limit = patch.options.rejection * np.maximum(_robust_sigma(off, patch.weights[rows]), noise)
    kept = used & (off < limit + patch.tolerated(x, share))
    fewer = np.flatnonzero((kept != used).any(axis=1))
    if len(fewer):
        some, at = rows[fewer], x[fewer]
        weighted = weights[some] * kept[fewer]
        again = _iterated(patch, some, at, start[some], patch.slopes(at, some), weighted, free, options)
        found = with_rows(found, some, again)
    return found, kept


def _iterated(
    patch: Patches,
    rows: Rows,
    start: Array,
    mean: Array,
    formed: tuple[Array, Array],
    weights: Array,
    free: Array,
    options: BatchOptions,
    noise: float | None = None,
) -> BatchAdjustment:
    """Adjust the marks `rows` (m,) with images of any kind in single precision.

    Parameters
    ----------
    start, mean : ndarray (m, u)
        Approximate values, and observed ones, with the standard deviations `free` (u,).
    formed : (ndarray (m, r, c), ndarray (m, 3 + p, r, c))
        Images and their derivatives at `start`.
    weights : ndarray (m, n)
        Weights of the grey values.
    noise : float, optional
        Standard deviation of grey values, if shifts of rows are among the errors.
    """
    work, n = Iteration(patch, rows, start, mean, weights, free, options, noise), patch.grey.shape[1]
    state, some, left, last = work.state, np.arange(len(rows)), options.max_iterations, _LAST
    if len(rows) == len(patch.xy):
        patch.shares = np.empty(patch.shape, np.float32)
    with one_thread():
        while len(some):
            share = np.ascontiguousarray(formed[0]).reshape(len(some), n)
            work.linearise(some, share, formed[1].reshape(len(some), -1, n))
            patch.shares[rows[some]] = share.reshape(-1, *patch.shape[1:])
            while left > 0 and len(some := np.flatnonzero(state == ACTIVE)):
                left -= 1
                tried = np.asarray(patch.image(work.trial[some], rows[some]))
                work.rounds[some] += 1
                taken = work.advance(some, tried.reshape(len(some), n))
                patch.shares[rows[some[taken]]] = tried[taken]
            # With derivatives of another image the gradient of the noise vanishes at another place.
            changed = (state == DONE) & (patch.change(work.begun, work.x, rows) > options.share)
            if changed.any() and left < last:
                left, last = last, 0
            # What is still active has no trials left.
            some = np.flatnonzero(changed | (state == STALE) | (state == ACTIVE))
            if left <= 0 or not len(some):
                break
            # Trials are counted, as in the general adjustment; only what has converged may go on without any.
            left -= int(changed.any())
            formed = patch.slopes(work.x[some], rows[some])
        # Errors that rows have in common are not among those of pixels.
        if patch.options.influence and not work.jitter2:
            done = np.flatnonzero(state == DONE)
            patch.keep(rows[done], *work.influences(done))
        return work.finished()


def _robust_sigma(residuals: Array, used: Array) -> Array:
    """1.4826 × the median of the absolute residuals in use, (k, 1); at least half their rms."""
    sigma = 1.4826 * medians(np.abs(residuals), used > 0)
    # In an image of few grey levels half of the residuals may be 0.
    return np.maximum(sigma, 0.5 * _rms(residuals, used, 0))


def _rms(residuals: Array, used: Array, parameters: int) -> Array:
    """Root mean square of the residuals in use, (k, 1)."""
    squares = np.where(used > 0, np.nan_to_num(residuals) ** 2, 0.0).sum(axis=1, keepdims=True)
    rms: Array = np.sqrt(squares / np.maximum((used > 0).sum(axis=1, keepdims=True) - parameters, 1))
    return rms
