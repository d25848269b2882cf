"""The form of the echoes of a frame: chosen by their images, and what the echoes have in common.

The echoes of a frame come from one instrument: they are all beams or all even lines, fade towards the same
end, have ends of the same softness. What the clear ones tell is the prior of the others, with the scatter
between echoes as its standard deviation. It matters where a wire hides an end.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...optics import Arcs
from ..matching.patches import MatchOptions
from ..matching.shapes import Window
from .arcs import ArcMatches, Windows
from .echoes import Echoes
from .hidden_ends import integrate_over_hidden_ends
from .shapes import ACROSS_SIGMA, BEAM, FURTHER, LINE, ArcShape, Form, ends_of, lines_with

_MOST_OF_WIDTH = 0.8
"""Largest variance of a blur as a share of those of an arc across and of its ends."""
_SAMPLES = 2
"""Samples per pixel along each axis, to form a blurred arc."""


@dataclass(frozen=True, eq=False)
class Details:
    """What the forms of k arcs leave out, and how it shifts them.

    Parameters
    ----------
    blur_px : ndarray (k, 2)
        Shift due to the blur of a bent line, whose image is not the bent image of a blurred line.
    course_px : ndarray (k, 2)
        Shift if κ² is replaced by cκ² in the course of the arc, for each unit of c - 1: the course is a
        hyperbola for c = 1, and a parabola for c = 0.
    score, information : ndarray (k,)
        Derivative of the logarithm of the likelihood with respect to c, all other unknowns eliminated, and
        the information about c.
    """

    blur_px: Array
    course_px: Array
    score: Array
    information: Array


def details_of(work: Windows, rows: Rows, found: ArcMatches, form: Form, blur: Array) -> Details:
    """What forms leave out, and how it shifts the arcs `rows`, to first order.

    Parameters
    ----------
    work : Windows
        The arcs and their windows.
    rows : ndarray of int (k,)
        Which ones.
    found : ArcMatches
        The matches.
    form : Form
        What was unknown of the form.
    blur : ndarray (m,)
        Width of a camera's blur, pixels, for each of all arcs.
    """
    parts = []
    for part in work.of_like_size(rows):
        parts.append((np.searchsorted(rows, part), _of_one_size(work, part, found, form, blur[part])))
    columns: dict[str, Any] = {}
    for f in fields(Details):
        columns[f.name] = np.zeros((len(rows), 2) if f.name.endswith("_px") else len(rows))
        for at, one in parts:
            columns[f.name][at] = getattr(one, f.name)
    return Details(**columns)


def _of_one_size(work: Windows, rows: Rows, found: ArcMatches, form: Form, blur: Array) -> Details:
    """The same for arcs of one size."""
    arcs, xy, noise = found.arcs.select(rows), found.xy[rows], found.noise[rows]
    columns, lines = work.window(rows, xy)
    shape = ArcShape(arcs, tuple(form.sigma))
    window = Window(columns, lines, work.options.response)
    none = np.zeros((len(rows), shape.parameters))
    image, parts = shape.derivatives(xy, arcs.across, none, np.arange(len(rows)), window)
    c, s = np.cos(arcs.tilt)[:, None, None], np.sin(arcs.tilt)[:, None, None]
    x, y = (columns - xy[:, :1])[:, None, :], (lines - xy[:, 1:])[:, :, None]
    u2 = (c * x + s * y) ** 2
    bend = arcs.curvature[:, None, None]
    # From -(dI/dv) u²/(r(1 + r)), r² = 1 + κ²u², to the derivative by c where κ² is replaced by cκ².
    by_bend = parts[:, 3 + shape.free.index("curvature")] * arcs.along[:, None, None]
    by_course = -by_bend * bend**3 * u2 / (2 * (1 + np.sqrt(1 + bend**2 * u2)))
    count = len(rows)
    flat = (count, 1, image[0].size)
    used = work.usable(rows, columns, lines).reshape(flat)
    contrast = found.contrast[rows][:, None, None]
    parts[:, 2] *= arcs.across[:, None, None]
    plane = np.stack(
        np.broadcast_arrays(1.0 + 0 * x, x / columns.shape[1] + 0 * y, y / lines.shape[1] + 0 * x), axis=1
    )
    design = used * np.concatenate(
        [
            contrast * parts.reshape(count, parts.shape[1], -1),
            image.reshape(flat),
            plane.reshape(count, 3, -1),
        ],
        axis=1,
    )
    known = np.zeros(design.shape[1])
    known[2 : parts.shape[1]] = 1 / np.array([ACROSS_SIGMA, *form.sigma.values()]) ** 2
    normal = design @ design.swapaxes(1, 2)
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-12))
    normal += noise[:, None, None] ** 2 * np.diag(known)
    normal /= scale[:, :, None] * scale[:, None, :]
    normal += 1e-9 * np.eye(len(known))
    grey = work.grey_in(columns, lines)
    columns_of = (
        np.stack(
            [
                contrast * (_blurred(arcs, xy, columns, lines, blur) - image),
                contrast * by_course,
                grey - contrast * image,
            ],
            axis=1,
        ).reshape(count, 3, -1)
        * used
    )
    right = (design @ columns_of.swapaxes(1, 2)) / scale[:, :, None]
    solved = np.linalg.solve(normal, right) / scale[:, :, None]
    left = columns_of - (solved.swapaxes(1, 2) @ design)
    limit = (work.options.rejection * noise)[:, None]
    rest = np.clip(left[:, 2] - left[:, 0], -limit, limit)
    variance = noise**2 * found.inflation[rows]
    return Details(
        blur_px=solved[:, :2, 0],
        course_px=solved[:, :2, 1],
        score=(left[:, 1] * rest).sum(axis=1) / variance,
        information=(left[:, 1] ** 2).sum(axis=1) / variance,
    )


def _blurred(arcs: Arcs, xy: Array, columns: Array, lines: Array, blur: Array) -> Array:
    """Images (k, r, c) of sharper arcs that a blur (k,) makes as wide as these, as bright as these."""
    half, soft = ends_of(arcs)
    variance = np.minimum(blur**2, _MOST_OF_WIDTH * np.minimum(arcs.across, soft) ** 2)
    sharp = replace(
        lines_with(half, np.sqrt(soft**2 - variance), arcs), across=np.sqrt(arcs.across**2 - variance)
    )
    pad, n = int(np.ceil(4 * np.sqrt(variance.max()))), _SAMPLES
    x, y = (
        axis[:, :1] - pad + np.arange((axis.shape[1] + 2 * pad) * n - n + 1) / n for axis in (columns, lines)
    )
    light = sharp.image(xy, x, y)
    inner = slice(pad * n, -pad * n if pad else None, n)
    found = np.stack(
        [
            scipy.ndimage.gaussian_filter(one, n * width, mode="nearest", truncate=4.0)[inner, inner]
            for one, width in zip(light, np.sqrt(variance), strict=True)
        ]
    )
    image = arcs.image(xy, columns, lines)
    bright = (image * found).sum(axis=(1, 2)) / np.maximum((found * found).sum(axis=(1, 2)), 1e-300)
    return np.asarray(bright[:, None, None] * found)


_CLEAR = 10.0
"""Minimum contrast over its standard deviation of an echo by which a form is chosen."""
_WHOLE, _LONG = 0.9, 1.5
"""Minimum visible share of such an echo, and minimum of its width along over that across."""
_MOST = 40
"""Largest number of echoes that tell what all have in common, the brightest."""
_FEW = 16
"""Number of these by which forms are compared."""
_EVIDENCE, _EACH = 12.0, 3.0
"""Minimum of twice the logarithm of the ratio of likelihoods by which a form must be better, and what is
subtracted from it for every echo."""
_EXPLAINED = 0.9
"""Share of the squared residuals beyond the noise that another form than a beam must explain."""
_WHITE = 1.2
"""Factor of the variances for correlated residuals below which these are as good as white noise."""
_IMPROVED = 0.7
"""Share of the clear echoes that it must explain better: they are all of one form."""
_PLAUSIBLE = 3.0
"""Largest median deviation from a form, over its prior standard deviation."""
_SHARED = 6
"""Minimum number of clear echoes that determine what all have in common; for their tilt, twice as many."""
_QUADRATIC = 18
"""Minimum number of clear echoes that show how the tilt depends on the squares of coordinates."""
_BENDING = 0.03, 0.03, 0.06
"""Usual change of the tilt of lines in a photograph, rad: over 1000 px in x, in y, and over the squares of
these. A lens that distorts by 1 % at 600 px turns lines by 0.06 times the product of both."""
_MOSTLY = 0.9
"""Share of the echoes for which the common tilt is at least as certain as its standard deviation says."""
_LEAST_SCATTER = {"softness": 0.01, "tilt": 0.002, "fading": 0.01, "tapering": 0.01, "thickening": 0.01}
"""Smallest scatter between echoes that is assumed."""
_BLUR_SHARE = 0.25
"""Standard deviation of an unknown blur's variance, as a share of that of the width across."""
_COURSE = 0.5, 0.5
"""Expected course of an arc, and its standard deviation: 1 is a hyperbola, 0 a parabola."""
_ORDER = 0.7
"""Uncertainty of the order in which a line fades and its ends become soft: 0 or 1, and the fading itself."""
_HALF_HIDDEN = 0.5
"""Hidden share of a flank from which the position of an arc depends on the other flank."""


def match_arcs(
    grey: NDArray[np.float32],
    valid: Mask,
    echoes: Echoes,
    at: Rows,
    options: MatchOptions,
    noise: float,
    blur: tuple[float, float] | None = None,
) -> ArcMatches:
    """Match the echoes `at` with arcs of the form that suits those of the frame.

    Parameters
    ----------
    grey : ndarray (h, w)
        Frame.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    echoes : Echoes
        All echoes of the frame; pixels of the others are excluded.
    at : ndarray of int (m,)
        Indices of the echoes to match.
    options : MatchOptions
        Options of the matching; window and widths are set here.
    noise : float
        Standard deviation of the grey values.
    blur : (float, float), optional
        Width of the camera's blur and its standard deviation, pixels, if it is known.
    """
    work = Windows(grey, valid, echoes, at, options, noise)
    form, found, start, unsure = _chosen(work)
    touching = np.flatnonzero((echoes.joined[at] > 0) & found.converged)
    if len(touching):
        # It is unknown how the instrument combines overlapping echoes: behind a logarithmic amplifier the
        # stronger one is shown; otherwise their sum. The first match assumed the former; the difference to
        # the latter is added to the uncertainty.
        pulled = work.shift_without_others(touching, found, form)
        found.cov[touching] += pulled[:, :, None] * pulled[:, None, :]
    half_hidden = np.flatnonzero((work.hidden_flanks(found) > _HALF_HIDDEN) & found.converged)
    if len(half_hidden):
        # If one flank of an arc is hidden, its centre follows from the shape of the other. Effects of raster
        # lines or reverberation on this shape no longer cancel and are not noise of single pixels. Their size
        # is estimated by leaving out slightly more of the arc.
        pulled = work.shift_with_wider_gap(half_hidden, found, form)
        found.cov[half_hidden] += pulled[:, :, None] * pulled[:, None, :]
    shift, details = _correct_for_details(work, found, form, blur)
    if "length" in form.sigma:
        ends = integrate_over_hidden_ends(work, found, form, start)
        # What displaces a line along itself is known to first order only, where an end is hidden.
        axes = np.stack([np.cos(found.arcs.tilt[ends]), np.sin(found.arcs.tilt[ends])], axis=1)
        along = (shift[ends] * axes).sum(axis=1, keepdims=True) * axes
        found.cov[ends] += along[:, :, None] * along[:, None, :]
    found.xy[:] -= shift
    if "fading" in form.sigma:
        # Whether a line fades before its ends become soft, or after, shifts its middle by g s²/a.
        arcs = found.arcs
        assert arcs.fading is not None
        shift = _ORDER * arcs.fading * ends_of(arcs)[1] ** 2 / arcs.along
        along = shift[:, None] * np.stack([np.cos(arcs.tilt), np.sin(arcs.tilt)], axis=1)
        found.cov[:] += along[:, :, None] * along[:, None, :]
    of_priors = [found.by_prior[name][:, :, None] * unsure[name][:, None, :] for name in unsure]
    return replace(found, shared=np.concatenate([*of_priors, details], axis=2))


def _correct_for_details(
    work: Windows, found: ArcMatches, form: Form, blur: tuple[float, float] | None
) -> tuple[Array, Array]:
    """Shifts (m, 2) due to blur and course, by which arcs are to be corrected; adds their covariances.

    The second result is what is uncertain of them and shared by all arcs, (m, 2, 2).

    If the blur is not known, it is at most that of the echo itself, but mostly much less. The course of all
    arcs is a hyperbola if a range bends them; a display may bend it to a parabola, or beyond.
    """
    arcs, shift = found.arcs, np.zeros_like(found.xy)
    shared = np.zeros((*shift.shape, 2))
    rows = np.flatnonzero(found.converged)
    if not len(rows):
        return shift, shared
    unknown = np.sqrt(_BLUR_SHARE) * np.minimum(arcs.across, ends_of(arcs)[1])
    widths = unknown if blur is None else np.full(len(arcs), blur[0])
    less = details_of(work, rows, found, form, widths)
    clear = found.t[rows] > _CLEAR
    information = float(less.information[clear].sum()) + 1 / _COURSE[1] ** 2
    course = (float(less.score[clear].sum()) + (_COURSE[0] - 1) / _COURSE[1] ** 2) / information
    relative = 1.0 if blur is None else 2 * blur[1] / blur[0]
    shift[rows] = course * less.course_px + (0.0 if blur is None else 1.0) * less.blur_px
    for k, uncertain in enumerate((relative * less.blur_px, less.course_px / np.sqrt(information))):
        found.cov[rows] += uncertain[:, :, None] * uncertain[:, None, :]
        shared[rows, :, k] = uncertain
    return shift, shared


def _chosen(work: Windows) -> tuple[Form, ArcMatches, Arcs, dict[str, Array]]:
    """The form of the frame's echoes, all of them matched with it, and its priors as in `_in_common`."""
    form, start, xy = BEAM, work.start, work.echoes.xy[work.at]
    # The brightest ones are enough to choose the form, as a rule.
    some = work.every[: 2 * _FEW]
    found = work.matched(some, form, start.select(some), xy[some])
    if len(_clear(found)) < _FEW and len(some) < len(work.at):
        some = work.every
        found = work.matched(some, form, start, xy)
    sample = _clear(found)[:_FEW]
    if len(sample):
        form = _line_or_beam(work, found, sample)
    if form is BEAM and len(some) < len(work.at):
        found = work.matched(work.every, form, start, xy)
    if not len(sample):
        return form, found, start, {}
    if form is not BEAM:
        start = work.start_of_lines
        work.resized(start)
        found = work.matched(work.every, form, start, xy)
    if "fading" in form.sigma:
        # The brightness need not decrease exponentially.
        form = form.with_(tapering=FURTHER["tapering"])
        found = work.matched(work.every, form, found.arcs, found.xy)
    while (further := _further(work, form, found)) is not None:
        form = form.with_(**{further: FURTHER[further]})
        found = work.matched(work.every, form, found.arcs, found.xy)
    shared, start, unsure = _in_common(form, found, start)
    if shared is not form:
        form, found = shared, work.matched(work.every, shared, start, found.xy)
    return form, found, start, unsure


def _line_or_beam(work: Windows, found: ArcMatches, sample: Rows) -> Form:
    """The form that explains the clear echoes `sample` of others, matched as beams, best."""
    first, xy = work.start_of_lines.select(sample), work.echoes.xy[work.at[sample]]
    form, best = BEAM, 0.0
    # An uneven line may be as unlike an even one as it is unlike a beam.
    for candidate in (LINE, *(LINE.with_(**{name: sigma}) for name, sigma in FURTHER.items())):
        line = work.matched(sample, candidate, first, xy)
        ratio, _, _ = _compared(found, line, sample, work.noise)
        if ratio > 2 * best and _better(found, line, sample, work.noise) and _plausible(line):
            best, form = ratio, candidate
            if _is_white(line):
                break
    return form


def _is_white(found: ArcMatches) -> bool:
    """Whether what a form leaves of the echoes is as good as white noise."""
    return float(np.median(found.inflation)) < _WHITE


def _clear(found: ArcMatches) -> Rows:
    """The echoes by which a form is chosen: the clearest of those that are seen whole, and no round spots."""
    whole = found.converged & (found.t > _CLEAR) & (found.seen > _WHOLE)
    whole &= found.arcs.along > _LONG * found.arcs.across
    return np.flatnonzero(whole)[:_MOST]


def _compared(before: ArcMatches, after: ArcMatches, rows: Rows, noise: float) -> tuple[float, float, float]:
    """How much better another form explains the clear echoes `rows`.

    Returns
    -------
    ratio : float
        Twice the logarithm of the ratio of likelihoods, less what an unknown explains by chance.
    explained : float
        Share of the squared residuals beyond the noise that the other form explains.
    improved : float
        Share of the echoes that it explains better.
    """
    both = before.converged[rows] & after.converged
    old, new = before.noise[rows][both], np.maximum(after.noise[both], 1e-12)
    pixels = after.pixels[both]
    ratio = pixels * np.log((old / new) ** 2) - _EACH
    excess = float((pixels * np.maximum((old / noise) ** 2 - 1, 0)).sum())
    explained = float((pixels * (old**2 - new**2)).sum()) / noise**2
    return float(ratio.sum()), explained / max(excess, 1e-12), float((ratio > 0).sum()) / len(rows)


def _better(before: ArcMatches, after: ArcMatches, rows: Rows, noise: float) -> bool:
    """Whether another form with one more unknown is the form of the clear echoes `rows`."""
    ratio, explained, improved = _compared(before, after, rows, noise)
    # What is left of real echoes beside a beam is mostly speckle, in which other forms fit by chance. Noise
    # is white; its size is that of the frame only where the light falls off little.
    enough = _is_white(after) or explained > _EXPLAINED or "length" in before.sigma
    return ratio > _EVIDENCE and enough and improved >= _IMPROVED


def _further(work: Windows, form: Form, found: ArcMatches) -> str | None:
    """The deviation from a form that explains most of the residuals; None if there is none."""
    rows = _clear(found)[:_FEW]
    if not len(rows):
        return None
    best, most = None, 0.0
    for name, sigma in FURTHER.items():
        # A change of the brightness of a Gaussian beam is a shift, or another width.
        if name in form.sigma or ("length" not in form.sigma and name in ("fading", "tapering")):
            continue
        other = work.matched(rows, form.with_(**{name: sigma}), found.arcs.select(rows), found.xy[rows])
        ratio, _, _ = _compared(found, other, rows, work.noise)
        if ratio > most and _better(found, other, rows, work.noise) and _plausible(other):
            best, most = name, ratio
    return best


def _plausible(found: ArcMatches) -> bool:
    """Whether the deviations from a form have a usual size."""
    return all(
        float(np.median(np.abs(getattr(found.arcs, name)))) < _PLAUSIBLE * sigma
        for name, sigma in FURTHER.items()
        if name in found.sigma
    )


def _in_common(form: Form, found: ArcMatches, start: Arcs) -> tuple[Form, Arcs, dict[str, Array]]:
    """The priors that the clear echoes give.

    Returns
    -------
    form : Form
        With their standard deviations.
    start : Arcs (m,)
        Their means, where the matching begins.
    unsure : dict of str to ndarray (m, k)
        Derivatives of the means by k errors of unit variance: the means have them in common.
    """
    rows, arcs = _clear(found), found.arcs
    names = [name for name in form.sigma if name in ("softness", *FURTHER)]
    if len(rows) < _SHARED:
        return form, start, {}
    columns = {f: getattr(arcs, f) for f in Arcs.__dataclass_fields__}
    # The priors of all else stay where they were.
    columns["curvature"], columns["tilt"] = start.curvature, start.tilt
    half, soft = ends_of(arcs)
    sigma, unsure = {}, {}
    for name in names:
        values = np.log(soft) if name == "softness" else columns[name]
        mean, cov, scatter = _population(values[rows], found.sigma[name][rows], np.ones((len(rows), 1)))
        sigma[name] = max(float(np.sqrt(scatter**2 + cov[0, 0])), _LEAST_SCATTER.get(name, 0.01))
        unsure[name] = np.full((len(soft), 1), np.sqrt(cov[0, 0]))
        if name == "softness":
            soft = np.full(len(soft), np.exp(mean[0]))
        else:
            columns[name] = np.full(len(soft), mean[0])
    if len(rows) >= 2 * _SHARED:
        # The arcs are parallel but for the distortion of display and camera: shear turns them alike, the
        # quadratic terms linearly with their place, and a radial distortion with the product of coordinates.
        x, y = ((found.xy - found.xy[rows].mean(axis=0)) / 1000).T
        terms, spread = [np.ones_like(x), x, y, x * y], [np.inf, *_BENDING]
        if len(rows) >= _QUADRATIC:
            terms, spread = [*terms, x * x, y * y], [*spread, _BENDING[-1], _BENDING[-1]]
        place = np.column_stack(terms)
        mean, cov, scatter = _population(
            arcs.tilt[rows], found.sigma["tilt"][rows], place[rows], np.array(spread)
        )
        usual = place @ mean
        # Beyond the clear echoes, in the corners, the mean is less certain than among them.
        of_mean = np.nan_to_num(place) @ np.linalg.cholesky(cov)
        variance = (of_mean[found.converged] ** 2).sum(axis=1)
        sigma["tilt"] = max(
            float(np.sqrt(scatter**2 + np.quantile(variance, _MOSTLY))), _LEAST_SCATTER["tilt"]
        )
        if sigma["tilt"] < form.sigma["tilt"]:
            columns["tilt"] = np.where(np.isfinite(usual), usual, start.tilt)
            unsure["tilt"] = of_mean
        else:
            del sigma["tilt"]
    if not sigma:
        return form, start, {}
    common = Arcs(**columns)
    if "softness" in sigma:
        common = lines_with(half, soft, common)
    return form.with_(**sigma), common, unsure


def _population(
    values: Array, sigma: Array, design: Array, spread: Array | None = None
) -> tuple[Array, Array, float]:
    """A linear model of a population, and the scatter around it (DerSimonian and Laird).

    Parameters
    ----------
    values, sigma : ndarray (n,)
        Values and their standard deviations.
    design : ndarray (n, u)
        Of the model.
    spread : ndarray (u,), optional
        Standard deviations of the coefficients about zero, known beforehand; by default infinite.

    Returns
    -------
    coefficients : ndarray (u,)
    covariance : ndarray (u, u)
        Of the coefficients.
    scatter : float
        Of the population.
    """
    scatter = 0.0
    coefficients: Array = np.zeros(design.shape[1])
    known = np.zeros(design.shape[1]) if spread is None else 1 / spread**2
    for _ in range(20):
        weight = 1 / (sigma**2 + scatter**2)
        # Some echoes may be others: Huber's weights.
        off = np.abs(values - design @ coefficients) * np.sqrt(weight) if _ else np.zeros(len(values))
        weight = weight * np.minimum(1, 3 / np.maximum(off, 1e-12))
        normal = (design * weight[:, None]).T @ design + np.diag(known)
        coefficients = np.asarray(
            np.linalg.solve(normal, (design * weight[:, None]).T @ values), dtype=np.float64
        )
        rest = values - design @ coefficients
        excess = (weight * rest**2).sum() - (len(values) - design.shape[1])
        slope = weight.sum() - np.trace(np.linalg.solve(normal, (design * (weight**2)[:, None]).T @ design))
        grown = max(scatter**2 + excess / max(slope, 1e-300), 0.0)
        if abs(grown - scatter**2) < 1e-3 * (scatter**2 + np.median(sigma) ** 2):
            break
        scatter = float(np.sqrt(grown))
    return coefficients, np.asarray(np.linalg.inv(normal), dtype=np.float64), scatter
