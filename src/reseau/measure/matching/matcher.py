"""The matcher: patches of a frame adjusted to the formed image of what they should show.

For each mark, position, width of the point-spread function, contrast, the background, and where wanted the
form, are estimated together, all marks of a frame in one batch of least-squares problems
(:func:`reseau.adjust.adjust_batch`). What is matched differs only in the outline that is formed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...adjust import BatchAdjustment, BatchOptions, BatchReason, adjust_batch
from ...core.data import Array, Mask, Rows
from ...optics.formation import Outline
from .noise import medians
from .patches import CONTRAST, LEVEL, WIDTH, MatchOptions, Patches, X, Y
from .shapes import GrownOutline, Shape, Some

__all__ = ["SIZE", "MatchOptions", "Matches", "Shape", "match"]

Columns = TypeVar("Columns", "Matches", BatchAdjustment)

_PLAIN = 1.25
"""Times the limit for blunders from which they are looked for in patches that are nearly right."""

_FIRST, _MOST = 10, 50
"""Iterations before blunders have been looked for, and at most."""

SIZE = np.eye(2)[None]
"""The form's one parameter for a mark of unknown size: the local frame grows by its share."""


@dataclass(frozen=True, eq=False)
class Matches:
    """What came out, in columns over the k marks.

    Parameters
    ----------
    xy : ndarray (k, 2)
        Positions in pixels.
    cov : ndarray (k, 2, 2)
        Their covariances, from the residuals of each patch.
    psf_px : ndarray (k,)
        Widths of the point-spread function.
    contrast : ndarray (k,)
        Share of the light that a dark mark takes; grey values that a bright one adds.
    level : ndarray (k,)
        Grey value of the background there.
    t : ndarray (k,)
        Contrast over its standard deviation, width and form given.
    form : ndarray (k, m)
        Parameters of the form.
    noise : ndarray (k,)
        Standard deviation of the residuals, grey values.
    correlation : ndarray (k,)
        Correlation of the patch with the formed image, the plane of the background taken off both.
    seen : ndarray (k,)
        Share of the mark that lies on valid pixels.
    rejected : ndarray (k,)
        Share of the mark that lies on pixels left out as blunders.
    converged : ndarray of bool (k,)
        Whether the adjustment did.
    residuals : ndarray (k, rows, columns)
        Adjusted minus observed, NaN where left out.
    """

    xy: Array
    cov: Array
    psf_px: Array
    contrast: Array
    level: Array
    t: Array
    form: Array
    noise: Array
    correlation: Array
    seen: Array
    rejected: Array
    converged: Mask
    residuals: Array

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, keep: Mask) -> Matches:
        """The matches of a mask (k,)."""
        return Matches(**{column.name: getattr(self, column.name)[keep] for column in fields(self)})

    def replaced(self, rows: Rows, others: Matches) -> Matches:
        """These matches with `rows` taken from others, made in a window of the same size."""
        return _with_rows(self, rows, others)


def _with_rows(whole: Columns, rows: Rows, part: Columns) -> Columns:
    """A dataclass of columns with some rows taken from another."""
    columns = {}
    for column in fields(whole):
        columns[column.name] = getattr(whole, column.name).copy()
        columns[column.name][rows] = getattr(part, column.name)
    return replace(whole, **columns)


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
    others: Array | None = None,
    light: tuple[Array, Array] | None = None,
    searching: bool = True,
) -> Matches:
    """Match every patch with the formed image of its mark.

    Parameters
    ----------
    pixels : ndarray (h, w)
        Grey values.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    outline : Outline or Shape
        Outlines (k, j, 2) in pixels around the point that is to be measured, or a shape of k marks with
        parameters of its own.
    xy : ndarray (k, 2)
        Approximate positions, good to about the radius of the mark.
    options : MatchOptions
        How.
    noise : float
        Approximate standard deviation of the grey values; it weighs the priors only.
    form : ndarray (m, 2, 2), optional
        Generators of the form for an outline: it is multiplied by 1 + Σ p_i F_i.
    form_sigma : ndarray (m,), optional
        Prior standard deviations of the p around 0.
    claims : tuple, optional
        Whose each pixel is, (h, w) of int, below 0 for nobody's; and the number (k,) under which each mark
        claims its own. What belongs to another is not looked at.
    others : ndarray (k, rows, columns), optional
        Light of others in each window, which is taken off first.
    light : tuple, optional
        Contrast (k,) and coefficients of the background (k, b) where these, the positions and the width are
        known to begin with: then nothing is searched for, but in patches where something is amiss.
    searching : bool
        Whether it is there; otherwise these count as not converged.

    Returns
    -------
    Matches
        Of all k; those that failed have `converged` False or a small `t`.
    """
    if isinstance(outline, Outline):
        outline = GrownOutline(outline, np.zeros((0, 2, 2)) if form is None else form)
    patch = Patches(pixels, valid, outline, xy, options, claims, others)
    free = np.full(patch.form_at + patch.forms, np.inf)
    free[[X, Y]], free[WIDTH] = np.array(options.half) / 2, options.psf_log_sigma
    free[CONTRAST] = options.contrast_sigma
    free[patch.ground.stop : patch.form_at] = options.contrast_slope or np.inf
    if form_sigma is not None:
        free[patch.form_at :] = form_sigma
    if light is None:
        return _searched(patch, free, noise)
    quick, amiss = _continued(patch, patch.begin(*light), free, noise)
    quick.converged[amiss] = False
    if not len(amiss) or not searching:
        return quick
    few = Patches(
        pixels,
        valid,
        Some(outline, amiss),
        xy[amiss],
        replace(options, psf_px=patch.psf[amiss]),
        None if claims is None else (claims[0], claims[1][amiss]),
        None if others is None else others[amiss],
    )
    return quick.replaced(amiss, _searched(few, free, noise))


def _searched(patch: Patches, free: Array, noise: float) -> Matches:
    """Matches from approximate positions alone, blunders among the pixels left out."""
    options = patch.options
    start = patch.start(noise)

    def adjust(rows: Rows, start_at: Array, most: int = _MOST) -> BatchAdjustment:
        return adjust_batch(
            lambda x, at: patch.form_image(x, rows[at]),
            start_at[rows],
            patch.grey[rows],
            weights=used[rows] * patch.course[rows] / scale[rows] ** 2,
            prior=(start[rows], free),
            options=BatchOptions(share=options.settled, max_iterations=most),
        )

    every = np.arange(len(patch.xy))
    used, scale = patch.weights, np.full((len(patch.xy), 1), noise)
    # Before the blunders are out there is nothing to settle.
    found = adjust(every, start, _FIRST)
    for most in (_FIRST, _MOST):
        # Only around a mark that has been found are large residuals blunders; before, the mark itself is one.
        residuals, tolerated = patch.residuals(found.estimates)
        limit = options.rejection * np.maximum(_robust_sigma(residuals, used), noise) + tolerated
        kept = patch.weights * (np.abs(residuals) < limit)
        # What the model leaves of a scene counts as noise, or the prior knowledge would weigh nothing there.
        rougher = np.maximum(noise, _rms(residuals, kept, start.shape[1]))
        renewed = (kept != used).any(axis=1) | (rougher > 1.2 * scale)[:, 0]
        renewed |= found.reasons == BatchReason.MAX_ITERATIONS
        changed = np.flatnonzero(renewed)
        if not len(changed):
            break
        used, scale = kept, np.where(np.isin(every, changed)[:, None], rougher, scale)
        found = _with_rows(found, changed, adjust(changed, found.estimates, most))
    for _ in range(2 if options.row_jitter_px > 0 else 0):
        # The residuals hold the jitter the first time; then they are whitened, and tell the noise alone.
        patch.whiten(found.estimates, _rms(found.residuals, used, start.shape[1]), options.row_jitter_px)
        found = adjust(every, found.estimates)
    return _columns(patch, found, used > 0, scale[:, 0])


def _continued(patch: Patches, start: Array, free: Array, noise: float) -> tuple[Matches, Rows]:
    """Matches from values that are nearly right, and the rows in which something is amiss."""
    if patch.options.row_jitter_px > 0:
        patch.whiten(start, np.full((len(start), 1), noise), patch.options.row_jitter_px)
    found = adjust_batch(
        patch.form_image,
        start,
        patch.grey,
        weights=patch.weights * patch.course / noise**2,
        prior=(start, free),
        values=patch.form_values,
        options=BatchOptions(share=patch.options.settled, max_iterations=_FIRST, damping=1e-5),
    )
    used = patch.weights > 0
    worst = np.where(used, np.abs(found.residuals), 0.0).max(axis=1)
    rms = found.sigma0 * noise
    amiss = (
        ~found.converged
        | ~(worst < _PLAIN * patch.options.rejection * np.maximum(rms, noise))
        | ~(rms < 2 * noise)
    )
    return _columns(patch, found, used, np.full(len(start), noise), patch.shares), np.flatnonzero(amiss)


def _robust_sigma(residuals: Array, used: Array) -> Array:
    """1.4826 × the median of the absolute residuals in use, (k, 1); not below half their rms."""
    sigma = 1.4826 * medians(np.abs(residuals), used > 0)
    # An image of few grey steps may have half its residuals at nought.
    return np.maximum(sigma, 0.5 * _rms(residuals, used, 0))


def _rms(residuals: Array, used: Array, parameters: int) -> Array:
    """Root mean square of the residuals in use, (k, 1)."""
    squares = np.where(used > 0, np.nan_to_num(residuals) ** 2, 0.0).sum(axis=1, keepdims=True)
    rms: Array = np.sqrt(squares / np.maximum((used > 0).sum(axis=1, keepdims=True) - parameters, 1))
    return rms


def _columns(
    patch: Patches, found: BatchAdjustment, used: Mask, scale: Array, share: Array | None = None
) -> Matches:
    """Columns of results from the adjusted batch, and from the share of the pixels if it is known."""
    x, k = found.estimates, len(patch.xy)
    flat = (patch.share(x) if share is None else share).reshape(k, -1)
    sight = np.maximum(flat.sum(axis=1), 1e-12)
    plane = patch.background(x).reshape(k, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cov = found.covariance
        expected = -plane * flat if patch.options.polarity == "dark" else flat
        correlation = _correlation(patch.grey - plane, expected, used)
        t = correlation * np.sqrt(np.maximum(used.sum(axis=1) - patch.form_at, 1) / (1 - correlation**2))
    return Matches(
        xy=patch.xy + x[:, :2],
        cov=cov[:, :2, :2],
        psf_px=patch.width(x, np.arange(k)),
        contrast=x[:, CONTRAST],
        level=x[:, LEVEL],
        t=np.nan_to_num(t),
        form=x[:, patch.form_at :],
        noise=found.sigma0 * scale,
        correlation=np.nan_to_num(correlation),
        seen=(flat * patch.weights).sum(axis=1) / sight,
        rejected=(flat * (patch.weights - used)).sum(axis=1) / sight,
        converged=found.converged & np.isfinite(cov[:, :2, :2]).all(axis=(1, 2)),
        residuals=np.where(used, found.residuals, np.nan).reshape(patch.shape),
    )


def _correlation(a: Array, b: Array, used: Mask) -> Array:
    """Correlation of the rows of two arrays over the entries in use, (k,)."""
    n = used.sum(axis=1, keepdims=True)
    a = np.where(used, a - np.where(used, a, 0).sum(axis=1, keepdims=True) / n, 0)
    b = np.where(used, b - np.where(used, b, 0).sum(axis=1, keepdims=True) / n, 0)
    r: Array = (a * b).sum(axis=1) / np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    return r
