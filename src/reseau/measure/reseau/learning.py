"""The appearance of the marks of a frame, learnt from some of them.

These are matched first as they come. They show the mapping, the sharpness, the size of the marks, noise and
light; what they leave shows motion or sharpening, and the curve between light and grey values.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Remark
from ...core.tone import ToneCurve
from ..matching import Matches, grey_variance
from ..matching.noise import relative_weights
from ..plane.lens_mapping import mapping_through
from ..plane.plane_mapping import plane_through
from ..response import Samples, estimate_kernel, sharpened_from_px
from ..screening import inner_pixels
from ..tone import find_curve
from .mark_windows import DISTURBED, ENOUGH, Appearance, MarkWindows

_GOLDEN = (np.sqrt(5) - 1) / 2
_FEW = 3
"""One in so many of these shows whether a kernel is needed."""
_KERNELS = 2
"""Number of times a kernel is estimated."""
_FILTERED = 0.85
"""Ratio of mean square residuals below which a kernel is used."""
_CONFIRMED = 0.7
"""The same with all marks that show it: what few marks have in common is also compression, or errors of
figures beside them, which leave 0.8; sharpening and motion leave 0.4."""
_EXPLAINED = 0.7
"""Ratio of residuals below which a curve explains what looked like motion or sharpening."""
_STEEP, _PLAIN = 0.1, 3.0
"""Slope, as a share of the steepest one of a mark, from which pixels are at an edge; significance from which
residuals there show that something is to be learnt."""
_SPREAD = 16
"""Least number of marks that show the mapping through a lens before all are matched."""
_ALIKE_PX = 0.3
"""Deviation of a mark, as it was found, from the mapping through precise ones, up to which it is expected
where this has it."""
_ASIDE = 2.0
"""The same as a multiple of what the precise ones had, if that is more."""
_WITHIN_PX = 0.49
"""Distance from the middle of a pixel within which a position has that one in the middle of its window."""
_FITS, _ROUGH_PX = 4.0, 0.01
"""Deviation of precise marks from that mapping, in their sigmas and a part that does not count, up to which
it predicts others."""
_NEAR_WIDTH, _NEAR_FORM = 0.15, 0.01
"""Relative error of the sharpness, and change of the form, beyond which marks are matched again before the
camera's response is learnt."""
_AROUND_PX, _SHARPNESS_OF, _SHARP = 9, 9, (0.4, 6.0)
"""Reach around a mark within which the sharpness is seen first, number of marks; and its limits, pixels."""
_PSF_LOG_SIGMA = 0.2
"""Spread of sharpness (logarithm) over the marks of one frame."""


def learn(marks: MarkWindows) -> tuple[Remark, ...]:
    """Learn the appearance of marks, and adopt it.

    Parameters
    ----------
    marks : MarkWindows
        Of which `look` is learnt, with positions and mapping, and grey values proportional to the light.

    Returns
    -------
    tuple of Remark
        What a user should know.
    """
    rows = np.flatnonzero(marks.found)
    if len(rows) > marks.learnt_from:
        # With the first and the last: a mapping is not known beyond the marks that show it.
        rows = rows[np.linspace(0, len(rows) - 1, marks.learnt_from).astype(np.intp)]
    first, sure, begun_px = _first(marks, rows)
    if sure.sum() < ENOUGH:
        return ()
    return _respond(marks, _learn(marks, first.select(sure), rows[sure]), rows[sure], begun_px)


def _some_of(count: int, most: int) -> Rows:
    """Indices of at most so many of `count` marks, in all rows and columns of a grid.

    Equal steps may be as long as a row, and give one column. Multiples of the golden ratio have no common
    measure with any length, and leave no gaps (Weyl's equidistribution).
    """
    if count <= most:
        return np.arange(count)
    return np.unique((count * ((np.arange(most) + 0.5) * _GOLDEN % 1.0)).astype(np.intp))


def _first(marks: MarkWindows, rows: Rows) -> tuple[Matches, Mask, float]:
    """First matches of some marks, which of them are reliable, and the sharpness from which they began."""
    if marks.precise_start:
        psf_px = _sharpness(marks, rows)
        marks.look = replace(marks.look, psf_px=psf_px, blur_px=psf_px)
        first = marks.match(rows)
        sure = first.converged & (first.t > 8)
        if sure.any():
            sure &= first.noise < DISTURBED * np.median(first.noise[sure])
        if 2 * sure.sum() > len(rows):
            return first, sure, psf_px
        psf_px = marks.options.psf_px
        marks.look = replace(marks.look, psf_px=psf_px, blur_px=psf_px)
        marks.quick = False
    first = marks.match(rows)
    return first, first.converged & (first.t > 8) & (first.rejected < 0.2), marks.options.psf_px


def _sharpness(marks: MarkWindows, rows: Rows) -> float:
    """Width of the point-spread function by the steepest slopes around some of the marks, pixels."""
    rows = rows[_some_of(len(rows), _SHARPNESS_OF)]
    half = _AROUND_PX + int(np.ceil(marks.radius(rows).max()))
    x, y = marks.pixels(rows, (half, half))
    grey = marks.screened.grey[y, x]
    # Over two pixels; that and the pixel itself have variances of 1/3 and 1/12.
    across = (grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]) / 2
    down = (grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]) / 2
    steep = np.quantile(np.hypot(across, down).reshape(len(rows), -1), 0.98, axis=1)
    dark, bright = np.quantile(grey.reshape(len(rows), -1), [0.1, 0.9], axis=1)
    variance = (bright - dark) ** 2 / (2 * np.pi * np.maximum(steep, 1e-9) ** 2) - 1 / 3 - 1 / 12
    return float(np.clip(np.sqrt(max(float(np.median(variance)), 0.0)), *_SHARP))


def _learn(marks: MarkWindows, first: Matches, rows: Rows) -> Matches:
    """Learn mapping, sharpness, size and noise from reliable marks; their form refers to the new size."""
    known = marks.found if marks.precise_start else np.isin(np.arange(len(marks.at)), rows)
    h, w = marks.screened.grey.shape
    xy, centre = marks.start.copy(), np.rint(marks.start[rows])
    moved = float(np.median(np.abs(first.xy - marks.start[rows]).max(axis=1)))
    xy[rows] = first.xy
    marks.mapping = plane_through(marks.at[known], xy[known], (h, w))
    weigh(marks, first, rows)
    # Windows remain where they are, if possible: residuals are those of their pixels.
    within = np.clip(first.xy, centre - _WITHIN_PX, centre + _WITHIN_PX)
    marks.start[rows] = np.where(np.abs(first.xy - within) < 1 - _WITHIN_PX, within, first.xy)
    if marks.precise_start and len(rows) >= _SPREAD:
        sigma = np.sqrt(first.variance)
        precise = mapping_through(marks.at[rows], first.xy, sigma, (h, w)).mapping
        marks.mapping = precise if marks.eccentric else marks.mapping
        predicted, limit = precise(marks.at), _FITS * np.hypot(sigma, _ROUGH_PX)[:, None]
        if (np.abs(predicted[rows] - first.xy) < limit).all():
            # Other marks that it predicts as they were found are nearer to it than they were found, also
            # where all were found aside, as tags between saturated paper.
            alike = max(_ALIKE_PX, _ASIDE * moved)
            near = marks.found & (np.abs(predicted - marks.start) < alike).all(axis=1)
            near &= ~np.isin(np.arange(len(near)), rows)
            marks.start[near] = predicted[near]
    first = marks.settle(first)
    marks.look = replace(
        marks.look,
        psf_log_sigma=_PSF_LOG_SIGMA,
        form_sigma=marks.learnt_form_sigma,
        blur_px=marks.look.psf_px,
    )
    marks.start = np.where(marks.found[:, None], marks.start, marks.mapping(marks.at))
    return first


def _respond(marks: MarkWindows, first: Matches, rows: Rows, begun_px: float) -> tuple[Remark, ...]:
    """Learn what motion, sharpening and the curve of the camera make of the images.

    `begun_px` is the sharpness from which the first match began.
    """
    some = _some_of(len(rows), marks.sampled)
    first, rows = first.select(np.isin(np.arange(len(rows)), some)), rows[some]
    # The first match may have begun far from the sharpness and form of these images, or with other
    # figures beside them.
    near = abs(np.log(np.median(first.psf_px) / begun_px)) < _NEAR_WIDTH
    near &= bool((np.median(np.abs(first.form), axis=0) < _NEAR_FORM).all())
    if marks.precise_start and near and not marks.surrounded and _plain(marks, first, rows):
        return ()
    # What is left is explained with images by the mapping through precise marks.
    first = marks.settle(marks.match(rows))
    weigh(marks, first, rows)
    if _plain(marks, first, rows):
        return ()
    few = np.arange(len(rows)) % _FEW == 0
    kernel, sharper, gain = estimate_kernel(marks.samples(first.select(few), rows[few])[0])
    linear = False  # whether grey values are known to be proportional to the light
    notes: tuple[Remark, ...] = ()
    if gain < _FILTERED and marks.curve_first:
        first, linear, notes = _straighten(marks, first, rows, beside=gain)
        if linear:
            kernel, sharper, gain = estimate_kernel(marks.samples(first.select(few), rows[few])[0])
    if gain < _FILTERED:
        plain = marks.look
        for again in range(_KERNELS):
            if again:
                # Position and form were those of images without the kernel.
                marks.look = replace(marks.look, kernel=None)
                kernel, sharper, gain = estimate_kernel(marks.samples(first, rows)[0], (1.0,))
            confirmed = not again or gain < _CONFIRMED
            if not confirmed:
                marks.look = plain
            else:
                marks.look = replace(marks.look, kernel=kernel, psf_px=sharper * marks.look.psf_px)
            first = marks.settle(marks.match(rows))
            weigh(marks, first, rows)
        if confirmed:
            _without_border(marks, sharpened_from_px(kernel))
            text = "the images are smeared by motion or sharpened: this was estimated and is modelled"
            notes = (*notes, Remark(text, Code.FILTERED))
        linear = linear or _plain(marks, first, rows)
    if not linear:
        notes = (*notes, *_straighten(marks, first, rows)[2])
    return notes


def _plain(marks: MarkWindows, first: Matches, rows: Rows) -> bool:
    """Whether residuals at the edges of marks are those of noise, as beside them: nothing is left to learn.

    Of marks that are not balanced a curve may shift edges without residuals, and one of the file is tried.
    Motion, sharpening and curves change images where these have a slope: in pictures with any of them the
    mean square residuals at edges were 1.8 to 33 times those beside, in others up to 1.2 times.
    """
    if not marks.balanced or marks.image.curve is not None:
        return False
    high, wide = (n // 2 for n in first.residuals.shape[1:])
    x, y = marks.pixels(rows, (wide, high))
    used = np.isfinite(first.residuals)
    off = np.where(used, first.residuals, 0.0)
    formed = marks.screened.grey[y, x] + off
    weights = relative_weights(
        formed.reshape(len(rows), -1).astype(np.float64), marks.look.variance or (1.0, 0.0)
    )
    square = off**2 * weights.reshape(off.shape)
    slope = np.zeros_like(formed)
    slope[:, :, 1:-1] = np.abs(formed[:, :, 2:] - formed[:, :, :-2])
    slope[:, 1:-1] += np.abs(formed[:, 2:] - formed[:, :-2])
    steep = slope > _STEEP * slope.max(axis=(1, 2), keepdims=True)
    at_edges, beside = square[used & steep], square[used & ~steep]
    if not (len(at_edges) and len(beside)):
        return False
    spread = np.sqrt(2 / len(at_edges) + 2 / len(beside))
    return bool(at_edges.mean() < (1 + _PLAIN * spread) * beside.mean())


def _without_border(marks: MarkWindows, width: int) -> None:
    """Use no pixels within some from the border of the frame."""
    if width:
        marks.screened = replace(marks.screened, valid=inner_pixels(marks.screened.valid, width))


def _straighten(
    marks: MarkWindows, first: Matches, rows: Rows, beside: float | None = None
) -> tuple[Matches, bool, tuple[Remark, ...]]:
    """Learn the curve between light and grey values; whether there is one, and what a user should know.

    Where a kernel leaves the share `beside` of the mean square residuals, a curve is adopted only if it
    leaves less than that, and much less than grey values as they are.
    """
    straight, full_scale = ToneCurve(1.0), marks.image.full_scale
    tried = {straight: (marks.screened, marks.look, first)}

    def matched(curve: ToneCurve) -> tuple[Samples, Array] | None:
        if curve not in tried:
            marks.screened = replace(marks.screened, grey=_linear(marks, curve))
            # The noise of grey values is alike, that of light grows with it where curves are steeper.
            bent = float(curve.light(np.array(0.5), 1.0)) < 0.5
            variance = (0.02 * full_scale, 1.0) if bent else None
            marks.look = _relit(marks, replace(marks.look, variance=variance), tried[straight][1], curve)
            again = marks.settle(marks.match(rows))
            marks.screened = replace(marks.screened, noise=float(np.median(again.noise)))
            tried[curve] = marks.screened, marks.look, again
        marks.screened, marks.look, again = tried[curve]
        good = again.converged
        if not good.all() and not (marks.precise_start and good.sum() >= ENOUGH):
            return None
        return marks.samples(again.select(good), rows[good])

    found = find_curve(matched, full_scale, marks.image.curve, beside=1.0 if beside is None else beside)
    chosen = found.curve or straight
    if beside is not None and found:
        # A kernel was suspected: whether the curve explains the residuals instead.
        left, before = (
            np.median(tried[c][2].noise / np.abs(marks.depth(tried[c][2]))) for c in (chosen, straight)
        )
        chosen = chosen if left < _EXPLAINED * before else straight
    marks.screened, marks.look, first = tried[chosen]
    if chosen is not straight:
        weigh(marks, first, rows)
    note = found.remark(f"{marks.word}s")
    noted = note is not None and (chosen is not straight or beside is None)
    return first, chosen is not straight, (note,) if note and noted else ()


def _relit(marks: MarkWindows, look: Appearance, straight: Appearance, curve: ToneCurve) -> Appearance:
    """An appearance with the contrast and light of another one in grey values along a curve."""
    if straight.light is None or straight.contrast is None or marks.polarity != "dark":
        return replace(look, light=None)
    level = np.abs(straight.light / straight.contrast)
    paper, ink = (curve.light(v, marks.image.full_scale) for v in (level, level + straight.light))
    contrast = 1 - ink / np.maximum(paper, 1e-12)
    return replace(look, contrast=contrast, light=ink - paper)


def weigh(marks: MarkWindows, first: Matches, rows: Rows) -> None:
    """Learn noise, contrast and light from some of the marks; those of the others change as much."""

    def renewed(known: Array | None, values: Array) -> Array:
        whole = np.full(len(marks.at), np.median(values))
        if known is not None:
            whole = known * np.median(values / known[rows])
        whole[rows] = values
        return np.asarray(whole)

    look, marks.rough = marks.look, float(np.median(first.noise))
    marks.look = replace(
        look,
        variance=grey_variance(marks.screened.grey, marks.start[rows], first.residuals),
        contrast=renewed(look.contrast, first.contrast),
        light=renewed(look.light, marks.depth(first)),
    )


def _linear(marks: MarkWindows, curve: ToneCurve) -> NDArray[np.float32]:
    """Grey values of the frame that are proportional to the light."""
    pixels, full_scale = marks.image.pixels, marks.image.full_scale
    if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
        return curve.light(pixels.astype(np.float32), full_scale)
    levels = np.arange(np.iinfo(pixels.dtype).max + 1, dtype=np.float32)
    return np.asarray(curve.light(levels, full_scale)[pixels])
