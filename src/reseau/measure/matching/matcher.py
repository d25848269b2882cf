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

from ...adjust import BatchAdjustment, BatchOptions, BatchReason, adjust_batch
from ...core.data import Array, Mask, Rows
from ...core.threads import one_thread
from ...optics.formation import Outline
from .matches import Matches, matches_of, with_rows
from .noise import medians
from .patches import CONTRAST, SHARPEST, WIDTH, MatchOptions, Patches, X, Y
from .shapes import GrownOutline, Shape, ShapeSubset, outlines_of

__all__ = ["SIZE", "match"]

_PLAIN = 1.25
"""Multiple of the rejection limit from which blunders are searched for when good start values are known."""

_FIRST, _MOST = 10, 50
"""Iterations before the search for blunders, and maximum."""

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
    searching: bool = True,
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
    searching : bool
        Whether to search those patches; if not, they count as not converged.
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
    if light is None:
        return _searched(patch, free, noise)
    quick, amiss = _continued(patch, patch.begin(*light), free, noise, least)
    came, quick.converged[amiss] = quick.converged[amiss], False
    settled = np.zeros(len(xy), dtype=bool)
    settled[amiss] = came
    if least is not None:
        likely = (quick.correlation >= least[0]) & (quick.seen >= least[1])
        amiss = amiss[likely[amiss]]
    if not len(amiss) or not searching:
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
        return adjust_batch(
            lambda x, at: patch.form_image(x, rows[at]),
            start_at[rows],
            patch.grey[rows],
            weights=used[rows] * patch.relative_weights[rows] / scale[rows] ** 2,
            prior=(start[rows], free),
            options=BatchOptions(share=options.settled, max_iterations=most),
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
        renewed = (kept != used).any(axis=1) | (rougher > 1.2 * scale)[:, 0]
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
    return matches_of(patch, found, used > 0, scale[:, 0])


def _continued(
    patch: Patches, start: Array, free: Array, noise: float, least: tuple[Array, float] | None = None
) -> tuple[Matches, Rows]:
    """Matches from good start values, and the rows with blunders or without convergence.

    See :func:`match` for `least`.
    """
    weights = patch.weights * patch.relative_weights / noise**2
    options = BatchOptions(share=patch.options.settled, max_iterations=_FIRST, damping=1e-5)
    found, rows, influence = _compiled(patch, start, free, noise, weights, options)
    if found is not None and least is not None and len(rows):
        rows = rows[patch.correlation(found.estimates, rows) >= least[0][rows]]
    if found is None or len(rows):
        formed = patch.shares.copy()
        if patch.options.row_jitter_px > 0:
            patch.whiten(start, np.full((len(start), 1), noise), patch.options.row_jitter_px)
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
    worst = np.where(used, np.abs(found.residuals), 0.0).max(axis=1)
    rms = found.sigma0 * noise
    amiss = (
        ~found.converged
        | ~(worst < _PLAIN * patch.options.rejection * np.maximum(rms, noise))
        | ~(rms < 2 * noise)
    )
    scale = np.full(len(start), noise)
    if influence is not None and len(rows):
        ours = patch.influence(found.estimates[rows], found.cofactor[rows], used[rows], scale[rows], rows)
        for whole, part in zip(influence, ours, strict=True):
            whole[rows] = part
    return matches_of(patch, found, used, scale, patch.shares, influence), np.flatnonzero(amiss)


def _compiled(
    patch: Patches, start: Array, free: Array, noise: float, weights: Array, options: BatchOptions
) -> tuple[BatchAdjustment | None, Rows, tuple[Array, Array] | None]:
    """The adjustment of :func:`_continued` by compiled code, the rows left to the general one, influences."""
    every, shape = np.arange(len(start)), patch.form
    assert patch.first is not None
    share, slopes = patch.first
    if share.dtype != np.float32:
        return None, every, None
    from .compiled import DONE, adjusted  # takes half a second to import; not every command needs it

    (k, n), u = patch.grey.shape, start.shape[1]
    jitter, dark = patch.options.row_jitter_px, patch.options.polarity == "dark"
    window = patch.monomials.T.copy(), patch.across.reshape(len(patch.across), n), patch.shape[2]
    prior, light = 1 / free**2, (dark, noise**2, (jitter / noise) ** 2)
    residuals, cofactor = np.empty((k, n)), np.full((k, u, u), np.nan)
    x, iteration, (state, rounds) = start.copy(), np.zeros((k, 4)), np.zeros((2, k), np.int64)
    iteration[:, 1] = options.damping
    patch.shares = share.copy()
    # Errors that rows have in common are not among those of pixels.
    wanted = k if patch.options.influence and jitter == 0 else 0
    influence: tuple[Any, Any] = (
        np.zeros((wanted, 2, n), np.float32),
        np.zeros((wanted, n), np.float32),
    )
    given = patch.grey, weights, window, light, SHARPEST * patch.psf, prior, options.share
    outlines = outlines_of(shape, every)
    if outlines is not None:
        plain, at = outlines
        with one_thread():
            adjusted(
                patch.shares,
                slopes.reshape(k, -1, n),
                (plain.nodes.xy, plain.nodes.dxy, plain.generators.astype(np.float32), at),
                patch.xy - np.stack([patch.window.columns[:, 0], patch.window.rows[:, 0]], axis=1),
                patch.options.response.fill,
                *given,
                options.max_iterations - 1,
                x,
                (residuals, cofactor, rounds, iteration, state),
                influence,
            )
    else:
        filled = residuals, cofactor, rounds, iteration, state
        _stepwise(patch, start, (share, slopes, *given), options, x, filled, influence)
    redundancy = (patch.weights > 0).sum(axis=1) + np.count_nonzero(prior) - u
    left = state != DONE
    found = BatchAdjustment(
        estimates=x,
        cofactor=cofactor,
        residuals=residuals,
        sigma0=np.sqrt(iteration[:, 0] / np.maximum(redundancy, 1)),
        redundancy=redundancy,
        converged=~left,
        iterations=rounds,
        reasons=np.where(left, BatchReason.MAX_ITERATIONS, BatchReason.CONVERGED).astype(np.int64),
        factors=np.broadcast_to(1.0, (k, n)),
    )
    shaped = None
    if wanted:
        shaped = influence[0].reshape(k, 2, *patch.shape[1:]), influence[1].reshape(patch.shape)
    return found, np.flatnonzero(left), shaped


def _stepwise(
    patch: Patches,
    start: Array,
    given: tuple[Any, ...],
    options: BatchOptions,
    x: Array,
    found: tuple[Any, ...],
    influence: tuple[Array, Array],
) -> None:
    """The iterations of :func:`reseau.measure.matching.compiled.adjusted` for shapes other than outlines."""
    from .compiled import ACTIVE, advanced, linearised  # takes half a second to import

    (residuals, cofactor, rounds, iteration, state), (k, n), u = found, patch.grey.shape, start.shape[1]
    share, slopes, observed, weights, window, light, psf, prior, share_of_sigma = given
    common = np.zeros((2, k if light[2] > 0 else 0, n), np.float32)
    kept, trial = np.empty((k, u, n), np.float32), start.copy()
    work = residuals, kept, np.zeros((k, u, u)), np.zeros((k, u)), cofactor, common[0], common[1]
    steps: Any = x, work, trial, iteration, state
    with one_thread():
        begun: Any = *steps, influence
        linearised(
            *(share.reshape(k, n), slopes.reshape(k, -1, n), observed, weights),
            *(window, light, psf, prior, share_of_sigma),
            *begun,
        )
        for _ in range(options.max_iterations - 1):
            rows = np.flatnonzero(state == ACTIVE)
            if not len(rows):
                break
            around = patch.window if len(rows) == k else patch.window.select(rows)
            width, form = patch.width(trial[rows], rows), trial[rows, patch.form_at :]
            tried = patch.form.image(patch.xy[rows] + trial[rows, :2], width, form, rows, around)
            patch.shares[rows] = tried
            rounds[rows] += 1
            advanced(
                rows,
                tried.reshape(len(rows), n),
                *(observed, weights, window, light[0], start, prior, share_of_sigma),
                *steps,
            )


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
