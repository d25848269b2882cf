"""Lines of which a wire hides an end: positions are means over all places of that end."""

from __future__ import annotations

import numpy as np

from ...adjust import adjust_batch
from ...adjust.batch import BatchOptions
from ...core.data import Array, Mask, Rows
from ...optics import Arcs
from ..matching.shapes import Window
from .arcs import ArcMatches, Windows
from .shapes import ACROSS_SIGMA, BOLD, FURTHER, ArcShape, Form, ends_of

_END_HIDDEN = 0.15
"""Hidden share of an end of a line from which its place is integrated over."""
_BEYOND_PX, _PLACES = 24.0, 25
"""Largest displacement of a hidden end, and number of its places; as many again among the likely ones."""
_SCALES_PX = 0.1, 6.0
"""Bounds of the displacement up to which the places are equidistant, not in a ratio."""
_LINEAR = 0.15
"""Standard deviation of an end over its softness up to which its likelihood is normal."""
_UNLIKELY = 25.0
"""Costs over the least of places that are left out."""
_HELD_SHARE, _HELD_ITERATIONS = 0.05, 6
"""End of the iterations where an end of a line is held."""
_OTHER = 2.0
"""Factor of the limit of residuals where neither the end of a line nor its background are known."""


def integrate_over_hidden_ends(work: Windows, found: ArcMatches, form: Form, start: Arcs) -> Rows:
    """Replace positions of lines of which one end is hidden by their mean over all places of that end.

    The likelihood of the visible pixels as a function of the place e of the hidden end is far from normal.
    For each e all other unknowns are adjusted anew; the middle has the mean m(e) and the covariance C(e)
    then. With the weights w of the likelihoods, mean and covariance are Σwm and Σw(C + (m − Σwm)(m − Σwm)ᵀ).
    Where both ends are hidden in part, their visible parts determine them well, or the position along the
    line counts as unknown.

    Parameters
    ----------
    work : Windows
        The lines and their windows.
    found : ArcMatches
        The matches; positions and covariances are replaced.
    form : Form
        What is unknown of their form.
    start : Arcs
        The means of its priors.

    Returns
    -------
    ndarray of int
        Rows of the lines with a hidden end.
    """
    share = _hidden_shares(work, found)
    hidden = share > _END_HIDDEN
    rows = np.flatnonzero(found.converged & hidden.any(axis=1))
    half, soft = ends_of(found.arcs)
    for row in rows.tolist():
        tilt = found.arcs.tilt[row]
        along = np.array([np.cos(tilt), np.sin(tilt)])
        sigma = float(np.sqrt(along @ found.cov[row] @ along))
        if hidden[row].all():
            # What shows both ends determines them well, or is mistaken for them: a fragment beside a wire.
            if np.hypot(sigma, half[row] * found.sigma["length"][row]) > _LINEAR * soft[row]:
                found.cov[row] += _BEYOND_PX**2 * np.outer(along, along)
            continue
        side = 1.0 if hidden[row, 1] else -1.0
        end = 2 * sigma  # the other end is certain
        if end < _LINEAR * soft[row]:
            continue
        scale = float(np.clip(end, *_SCALES_PX))
        most = np.arcsinh(_BEYOND_PX / scale)
        steps = scale * np.sinh(np.linspace(-most, most, _PLACES))
        cost = _with_end_at(work, found, row, side, steps, form, start)[0]
        if not np.isfinite(cost).any():
            found.converged[row] = False
            continue
        likely = np.flatnonzero(cost < cost.min() + _UNLIKELY)
        first, last = steps[np.clip(likely[[0, -1]] + [-1, 1], 0, len(steps) - 1)].tolist()
        finer = np.linspace(first, last, _PLACES)
        cost, middle, cov, others, with_others = _with_end_at(work, found, row, side, finer, form, start)
        seen = np.isfinite(cost)
        if not seen.any():
            found.converged[row] = False
            continue
        cost, middle, cov, others, with_others = (
            values[seen] for values in (cost, middle, cov, others, with_others)
        )
        weight = np.exp(-0.5 * (cost - cost.min()))
        weight /= weight.sum()
        off = middle - weight @ middle
        found.xy[row] = weight @ middle
        found.cov[row] = np.einsum("n,nij->ij", weight, cov) + np.einsum("n,ni,nj->ij", weight, off, off)
        joint = np.einsum("n,nip->ip", weight, with_others) + np.einsum("n,ni,np->ip", weight, off, others)
        for k, name in enumerate(name for name in form.sigma if name != "length"):
            found.by_prior[name][row] = joint[:, k] / form.sigma[name] ** 2
        found.by_prior["length"][row] = 0.0
        if likely[0] == 0 or likely[-1] == len(steps) - 1:
            found.cov[row] += _BEYOND_PX**2 * np.outer(along, along)
    return rows


def _hidden_shares(work: Windows, found: ArcMatches) -> Array:
    """Hidden shares of both ends of each arc, (m, 2)."""
    arcs = found.arcs
    half, soft = ends_of(arcs)
    across = np.linspace(-1.5, 1.5, 7)
    u, v = (grid.ravel() for grid in np.meshgrid(across, across))
    c, s = np.cos(arcs.tilt)[:, None], np.sin(arcs.tilt)[:, None]
    height, width = work.valid.shape
    share = np.zeros((len(work.at), 2))
    for k, side in enumerate((-1.0, 1.0)):
        along = side * half[:, None] + soft[:, None] * u
        down = 0.5 * arcs.curvature[:, None] * along**2 + arcs.across[:, None] * v
        x = found.xy[:, :1] + c * along - s * down
        y = found.xy[:, 1:] + s * along + c * down
        column, row = (np.nan_to_num(np.rint(at), nan=-1).astype(np.intp) for at in (x, y))
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        seen = inside & work.valid[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        share[:, k] = 1 - seen.mean(axis=1)
    return share


def _with_end_at(
    work: Windows, found: ArcMatches, row: int, side: float, steps: Array, form: Form, start: Arcs
) -> tuple[Array, Array, Array, Array, Array]:
    """Lines adjusted anew with one end held, displaced by given steps along the curve.

    Parameters
    ----------
    found : ArcMatches
        The matches.
    row : int
        Which line.
    side : float
        1 for the end in the direction of the tilt, -1 for the other.
    steps : ndarray (n,)
        Displacements of the end outwards, pixels.
    form : Form
        What is unknown of the form.
    start : Arcs
        The means of its priors.

    Returns
    -------
    costs : ndarray (n,)
        -2 times the logarithm of the likelihood of each place of the end, the other unknowns integrated
        over; infinite where nothing would be left of the line.
    middles : ndarray (n, 2)
        The middle of the line.
    covs : ndarray (n, 2, 2)
        Its covariances for a given place of the end.
    forms : ndarray (n, p)
        The unknowns of the form but for the length.
    with_forms : ndarray (n, 2, p)
        Covariances of the middle and these.
    """
    n, at = len(steps), np.full(len(steps), row)
    one, mean = found.arcs.select(at), start.select(at)
    half, soft = ends_of(one)
    half_of_mean, soft_of_mean = ends_of(mean)
    moved = 0.5 * side * steps
    course = one.tilt + 0.5 * one.curvature * moved
    base = found.xy[row] + moved[:, None] * np.stack([np.cos(course), np.sin(course)], axis=1)
    tilt = one.tilt + one.curvature * moved
    along, across = np.stack([[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]]).swapaxes(1, 2)
    left = half + steps / 2
    possible = left > soft
    left = np.maximum(left, soft)
    names = tuple(form.sigma)
    shape = ArcShape(mean, names)
    others = [name for name in names if name != "length"]
    begun = {name: getattr(one, name) - getattr(mean, name) for name in others if name in FURTHER}
    begun |= {
        "softness": np.log(soft / soft_of_mean),
        "curvature": (one.curvature - mean.curvature) * mean.along,
        "tilt": tilt - mean.tilt,
    }
    grey, columns, lines, used = _seen(work, found, row)
    plane = np.stack([np.ones(used.sum()), *(g[used] for g in np.meshgrid(columns, lines))])
    plane[1:] -= plane[1:].mean(axis=1, keepdims=True)
    plane[1:] /= np.abs(plane[1:]).max(axis=1, keepdims=True)
    free = 3 + len(others)

    def placed(x: Array, k: Rows) -> tuple[Array, Array, Array]:
        """Positions, widths and corrections of the form."""
        xy = base[k] + x[:, :1] * across[k] - 0.5 * side * x[:, 1:2] * along[k]
        longer = np.log(np.maximum(left[k] + 0.5 * x[:, 1], 0.1) / half_of_mean[k])
        values = dict(zip(others, x[:, 3:free].T, strict=True)) | {"length": longer}
        return (
            xy,
            np.exp(np.clip(x[:, 2], -BOLD, BOLD)),
            np.stack([values[name] for name in names], axis=1),
        )

    def formed(x: Array, k: Rows) -> tuple[Array, Array]:
        xy, width, corrections = placed(x, k)
        window = Window(
            np.broadcast_to(columns, (len(k), len(columns))),
            np.broadcast_to(lines, (len(k), len(lines))),
            work.options.response,
        )
        image, parts = shape.derivatives(xy, width, corrections, k, window)
        image, parts = image[:, used], parts[:, :, used]
        contrast = x[:, free, None]
        by_along, by_across = ((parts[:, :2] * axis[k][:, :, None]).sum(axis=1) for axis in (along, across))
        by_length = parts[:, 3 + names.index("length")] / np.maximum(left[k] + 0.5 * x[:, 1], 0.1)[:, None]
        jacobian = np.empty((len(k), image.shape[1], free + 4))
        jacobian[:, :, 0] = contrast * by_across
        jacobian[:, :, 1] = contrast * 0.5 * (by_length - side * by_along)
        jacobian[:, :, 2] = contrast * width[:, None] * parts[:, 2]
        for i, name in enumerate(others):
            jacobian[:, :, 3 + i] = contrast * parts[:, 3 + names.index(name)]
        jacobian[:, :, free] = image
        jacobian[:, :, free + 1 :] = plane.T
        return contrast * image + x[:, free + 1 :] @ plane, jacobian

    x = np.zeros((n, free + 4))
    x[:, 2] = np.log(one.across)
    for i, name in enumerate(others):
        x[:, 3 + i] = begun[name]
    x[:, free] = found.contrast[row]
    first, _ = formed(x, np.arange(n))
    x[:, free + 1] = np.median(grey - first, axis=1)
    sigma = np.full(free + 4, np.inf)
    sigma[2], sigma[3:free] = ACROSS_SIGMA, [form.sigma[name] for name in others]
    expected = np.zeros(free + 4)
    expected[2] = np.log(mean.across[0])
    variance = found.noise[row] ** 2 * found.inflation[row]
    adjusted = adjust_batch(
        formed,
        x,
        np.broadcast_to(grey, (n, len(grey))),
        weights=np.full((n, len(grey)), 1 / variance),
        prior=(expected, sigma),
        options=BatchOptions(share=_HELD_SHARE, max_iterations=_HELD_ITERATIONS, damping=1e-6),
    )
    cofactor = adjusted.cofactor
    usable = possible & np.isfinite(cofactor).all(axis=(1, 2)) & np.isfinite(adjusted.sigma0)
    costs = adjusted.sigma0**2 * adjusted.redundancy
    costs[usable] -= np.linalg.slogdet(cofactor[usable])[1]
    middles, _, _ = placed(adjusted.estimates, np.arange(n))
    turned = np.stack([across, -0.5 * side * along], axis=2)
    covs = turned @ cofactor[:, :2, :2] @ turned.swapaxes(1, 2)
    with_forms = turned @ cofactor[:, :2, 3:free]
    return np.where(usable, costs, np.inf), middles, covs, adjusted.estimates[:, 3:free], with_forms


def _seen(work: Windows, found: ArcMatches, row: int) -> tuple[Array, Array, Array, Mask]:
    """Grey values of the pixels by which an arc was matched; columns, rows and mask of its window."""
    one = np.array([row])
    columns, lines = work.window(one, found.xy[one])
    grey, used = work.grey_in(columns, lines)[0], work.usable(one, columns, lines)[0]
    # Without what is no part of the line.
    rest = grey - found.contrast[row] * found.arcs.select(one).image(found.xy[one], columns, lines)[0]
    rest -= np.median(rest[used])
    used &= np.abs(rest) < _OTHER * work.options.rejection * found.noise[row]
    return grey[used], columns[0], lines[0], used
