r"""What the picture shows beside an edge of the frame: contours beside parts of it, or a line along it.

A line of the picture close behind an edge (Cruz et al., fig. 7B) cannot be separated from it in a single
profile. But it widens the visible step consistently over neighbouring profiles, whereas picture content does
so at random. The widths of the steps therefore show which parts of an edge are affected, and by how much.
Two explanations of the widths along an edge compete, both with their prior probabilities: contours beside
parts of it, each by itself, and a straight line at the distances s from −1 to 1 along it,

.. math::
    s(t) = s_0 \frac{1 - t}{2} + s_1 \frac{1 + t}{2},

in widths w of the step, with a share r of the contrast. It displaces the step by r s w and adds r(1 − r) s²
to its variance; where it would be in front of the edge there is none, and where it is far behind, the edge is
seen by itself. Which of them it is, is decided together with the places of the steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy

from ...core.data import Array
from .edges import NEIGHBOURS, EdgeProfiles
from .steps import StepForm

_QUANTILE, _EVEN = 0.3, 0.015
"""Quantile of the widths of profiles that is the width of an edge's steps, because content of the picture
widens some of them; and least standard deviation of its logarithm."""
_MODELLED = 0.3
"""Error of an edge's width by the model of the step, in standard deviations of that of a profile: where
pixels hardly show the width, small errors of their model have a large part in it."""
_SOFTNESS, _DIRECTIONS = 0.03, 0.04
"""Scatter of logarithmic widths from edge to edge, by focus and penumbra, and half the difference of the two
directions of a scan, by lens and carriage; both with the heavy tails of Student's distribution."""
_LINES, _CONTOURS, _HIDDEN = 2.0, 20.0, 3.0
"""Number of lines of a picture that run in the direction of an edge from end to end, number of contours that
a line across the picture meets, and widths of the step within which they are hidden in it."""
_LEVEL = float(np.deg2rad(1.0))
"""Scatter of the directions of these lines about that of the edge: cameras are held so well, radians."""
_SHARPENED = 0.01
"""Prior probability that what was measured is sharper than an edge can be (a scratch)."""
_RANGE = 1.5
"""Range of logarithmic widths of lines that are sharper than edges."""
_PERSISTENT = 0.9
"""Share of the neighbourhoods of profiles beside which a second step goes on to the next."""
_LEAST_SQUARE = 0.6
"""Least variance of a step with a second one, relative to that of the step alone."""
_SPREAD = 0.1
"""Range of widths beyond those that an edge shows and that the others show, logarithmic."""
_LEAST = 20
"""Least number of profiles that show the softness of an edge."""


def _second_steps(*, alone: bool) -> tuple[Array, Array, Array]:
    """Second steps as they may be: increase of the logarithmic width, displacement (widths), and weight.

    A second step with a share r of the contrast, at the distance s behind the first, appears as one step that
    is displaced by r·s and has the variance w² + r(1 − r)·s²; a negative share, of a picture that is brighter
    at its edge than behind it, sharpens the step. Where the picture is as dark as film at its edge, the
    second step is seen `alone`, sharper if it is that of a narrow line. Shares are evenly distributed,
    distances in their logarithm.
    """
    shares = np.concatenate([np.linspace(-0.9, -0.05, 18), np.linspace(0.05, 0.9, 18)])
    share, distance = (each.ravel() for each in np.meshgrid(shares, _DISTANCES))
    square = 1 + share * (1 - share) * distance**2
    # What sharpens a step further is visible beside it.
    hidden = square > _LEAST_SQUARE
    increase, moved = 0.5 * np.log(square[hidden]), (share * distance)[hidden]
    if alone:
        narrow, distance = (each.ravel() for each in np.meshgrid([0.0, -0.1, -0.2, -0.3], _DISTANCES))
        increase, moved = np.append(increase, narrow), np.append(moved, distance)
    return increase, moved, np.full(len(moved), 1 / len(moved))


_DISTANCES = np.geomspace(0.15, 6.0, 30)
_ALL, _PARTS = _second_steps(alone=False), _second_steps(alone=True)
"""Those beside all of an edge, which a step of its own must show, and those beside parts of it."""
_FAR, _SEEN = np.array([-4.0, -2.0, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0]), 4.0
"""Distances of a line from the ends of an edge, and the one beyond which the edge is seen alone, widths."""
_SHARES = np.linspace(-0.8, 1.0, 19)
_EVENLY = np.array([0.5, *np.ones(17), 0.5]) / 18
"""Shares of the contrast that a line has, and their probabilities: evenly distributed."""
_TABLE = 1000
"""Number of differences of logarithmic widths for which the likelihood of a line beside all is computed."""
_BASES = 9
"""Number of widths that the steps of an edge may have by themselves."""


class Softness(NamedTuple):
    """Softness of an edge's steps, and whether it is its own.

    Parameters
    ----------
    log_width : float
        Logarithm of the width of a single step.
    scatter, texture : float
        Standard deviation of it, and of the width of a profile by content of the picture.
    lined : float
        Probability that a line beside all of the edge widens its steps.
    sharpened : float
        Probability that the steps are sharper than those of an edge.
    before, beside : float
        Probabilities, without the widths, of a line beside all of the edge, and of a contour beside a place
        of it.
    alone : ndarray (b, 2)
        Logarithms of widths of a single step, and of their densities as the other edges show them.
    """

    log_width: float
    scatter: float = _EVEN
    texture: float = 0.0
    lined: float = 0.0
    sharpened: float = 0.0
    before: float = 0.0
    beside: float = 0.0
    alone: Array = np.zeros((1, 2))

    @property
    def width(self) -> float:
        """Width of a single step, one sigma, pixels."""
        return float(np.exp(self.log_width))


def student(value: Array, scale: Array | float) -> Array:
    """Density of Student's distribution with four degrees of freedom."""
    square = 1 + np.square(value / (2 * scale))
    return np.asarray(0.375 / (square * square * np.sqrt(square) * scale))


def normalised(log: Array) -> tuple[Any, Array]:
    """Sum of probabilities over the first axis, as a logarithm, and their shares of it."""
    total = scipy.special.logsumexp(log, axis=0)
    return total, np.exp(log - total)


def softness_of(widths: Sequence[tuple[float, float] | None], side: float) -> list[Softness]:
    """Explain the widths of the steps of four edges together.

    Each edge is as soft as the scan in its direction, with a scatter of its own; or a line beside it widens
    its steps; or they are those of a scratch. The softness of the scan is what all edges explain best.

    Parameters
    ----------
    widths : sequence of (float, float) or None
        Logarithm of the width of each edge and its standard deviation; None if it was not measured.
    side : float
        Side of the frame, pixels: the wider a step, the more of the picture is hidden in it.
    """
    seen = [k for k, each in enumerate(widths) if each is not None]
    if not seen:
        return [Softness(0.0)] * len(widths)
    own, sigma = np.array([widths[k] for k in seen]).T
    scale = np.hypot(_SOFTNESS, sigma)
    common = np.linspace(own.min() - 0.4, own.max() + 0.4, 161)
    apart = np.linspace(-0.4, 0.4, 33) if len(seen) > 2 else np.zeros(1)
    sign = np.where(np.array(seen) % 2 == 0, -1.0, 1.0)
    away = own - common[:, None, None] - sign * apart[:, None]  # (common, apart, edge)
    hidden = 2 * _HIDDEN * np.exp(own) / side
    before = _LINES * hidden * np.minimum(hidden / _LEVEL, 1.0)
    before, beside = before / (1 + before), 1 - np.exp(-_CONTOURS * hidden / 2)
    alike = (1 - before) * (1 - _SHARPENED) * student(away, scale)
    increase, _, share = _ALL
    # A smooth function of one number for each edge.
    at = np.linspace(away.min(), away.max(), _TABLE)
    tables = [student(at[:, None] - increase, each) @ share for each in scale]
    each = [np.interp(away[..., i], at, table) for i, table in enumerate(tables)]
    lined = before * np.stack(each, axis=-1)
    sharp = (
        _SHARPENED / _RANGE * ((away < 0) & (away > -_RANGE)) * (1 - 2 * scale**2 / (away**2 + 2 * scale**2))
    )
    every = alike + lined + sharp
    total = np.log(every).sum(axis=2) + np.log(student(apart, _DIRECTIONS))
    weight = np.exp(total - total.max())
    weight /= weight.sum()
    found = [Softness(0.0)] * len(widths)
    for i, k in enumerate(seen):
        p, q = (float((weight * part[..., i] / every[..., i]).sum()) for part in (lined, sharp))
        at = common[:, None] + sign[i] * apart
        scan = float((weight * at).sum())
        log = scan if p + q > 0.5 else float(own[i])
        base = np.linspace(min(scan, own[i]) - _SPREAD, max(scan, own[i]) + _SPREAD, _BASES)
        others = weight / every[..., i]
        density = student(base[:, None] - at.ravel(), _SOFTNESS) @ (others / others.sum()).ravel()
        alone = np.stack([base, np.log(density * (base[1] - base[0]))], axis=1)
        found[k] = Softness(log, float(sigma[i]), 0.0, p, q, float(before[i]), float(beside[i]), alone)
    return found


def common_forms(profiles: Sequence[EdgeProfiles | None], side: float) -> list[StepForm | None]:
    """Form of the blurred step for each edge: width as the edges together explain it, common lobes."""
    kept = [p if p is not None and p.good.sum() > _LEAST else None for p in profiles]
    soft = softness_of([None if p is None else (float(np.log(p.width)), 2 * _EVEN) for p in kept], side)
    forms = [p.form for p in kept if p is not None]
    if not forms:
        return [None] * len(profiles)
    weight = sum(form.weight for form in forms)
    lobes = sum(form.weight * form.lobes for form in forms) / max(weight, 1e-12)
    middle = float(np.median([each.width for each, p in zip(soft, kept, strict=True) if p is not None]))
    return [
        None
        if p is None
        else StepForm(each.width if k is not None else middle, lobes, p.form.half, weight, p.form.tone)
        for p, k, each in zip(profiles, kept, soft, strict=True)
    ]


def soft_steps(profiles: Sequence[EdgeProfiles | None], side: float) -> list[Softness]:
    """Softness of the steps of each edge, from its profiles."""
    widths: list[tuple[float, float] | None] = []
    textures = []
    for found in profiles:
        if found is None or found.good.sum() <= _LEAST:
            widths.append(None)
            continue
        own, variance = found.blur[:, found.good]
        low, high = _quantiles(own, 1 / (variance + _EVEN**2), (0.1, _QUANTILE))
        shown = _MODELLED * float(np.sqrt(1 / (1 / (variance + _EVEN**2)).mean()))
        widths.append((high, float(np.sqrt(_EVEN**2 + (high - low) ** 2 / 4 + shown**2))))
        # Picture content changes widths at random; a line along the edge widens neighbours alike.
        change = np.abs(np.diff(own[::NEIGHBOURS]))
        textures.append(1.4826 * float(np.median(change)) / np.sqrt(2) if len(change) > 3 else 0.0)
    texture = sorted(textures)[min(1, len(textures) - 1)] if textures else 0.0
    return [each._replace(texture=texture) for each in softness_of(widths, side)]


def _quantiles(values: Array, weight: Array, shares: Sequence[float]) -> list[float]:
    """Weighted quantiles: a sharp step in the middle of a pixel hardly shows its width."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weight[order]) / weight.sum()
    at = np.minimum(np.searchsorted(below, shares), len(order) - 1)
    return [float(each) for each in values[order][at]]


class Beside(NamedTuple):
    """What may be beside an edge: contours beside parts of it, or one of h lines along it.

    Parameters
    ----------
    share : ndarray (n,)
        Probabilities of a contour beside each profile.
    scatter : ndarray (2, n)
        Standard deviations of the displacements of profiles by contours, and by a line, pixels.
    moved : ndarray (1 + h, n)
        Mean displacements by contours, and by each line, inwards, pixels.
    log : ndarray (1 + h,)
        Logarithms of the probabilities of contours and of each line, by the widths alone, up to a constant.
    """

    share: Array
    scatter: Array
    moved: Array
    log: Array


def beside_edge(found: EdgeProfiles, soft: Softness, side: float) -> Beside:
    """Explain the widths of the steps along an edge by what is beside it: a second step changes them.

    Parameters
    ----------
    found : EdgeProfiles
        Profiles of the edge.
    soft : Softness
        Softness of its steps.
    side : float
        Length of the edge, pixels.
    """
    n, good = len(found.place), np.flatnonzero(found.good)
    groups = [g for g in np.array_split(good, max(1, n // NEIGHBOURS)) if len(g)]
    if not groups or soft.before <= 0:
        return Beside(np.zeros(n), np.zeros((2, n)), np.zeros((2, n)), np.array([0.0, -np.inf]))
    weight = 1 / (found.blur[1] + _EVEN**2)
    width = np.array([np.average(found.blur[0][g], weights=weight[g]) for g in groups])
    # The texture was seen with the noise in it.
    noise = np.array([max(1 / weight[g].mean(), soft.texture**2) for g in groups])
    scale, place = np.sqrt(noise + soft.scatter**2), np.array([found.place[g].mean() for g in groups])
    base, known = soft.alone.T
    excess, unit = width - base[:, None], np.exp(base)

    # Contours: beside a part or not.
    increase, displaced, share = _PARTS
    each = share * student(excess[..., None] - increase, scale[:, None])
    prior, total = max(soft.beside, soft.lined), each.sum(axis=2)
    seen, log = _chain(np.stack([student(excess, scale), total], axis=2), np.array([1 - prior, prior]))
    evidence, of_base = normalised(log + known)
    part = of_base @ seen[..., 1]
    mean, square = ((of_base * unit**k) @ (seen[..., 1] * (each @ displaced**k) / total) for k in (1, 2))

    # Lines: at each place with one of the shares of the contrast.
    prior_of, away = _lines_along(place, soft, side)
    variance = 1 + _SHARES * (1 - _SHARES) * away[..., None] ** 2
    increase = 0.5 * np.log(np.maximum(variance, _LEAST_SQUARE))
    seen, log = _chain(student(excess[:, None, :, None] - increase, scale[:, None]), _EVENLY)
    lines, of_base = normalised(log + known[:, None] + prior_of)
    means, squares = (
        away**k * np.einsum("bh,bhg->hg", of_base * unit[:, None] ** k, seen @ _SHARES**k) for k in (1, 2)
    )
    scatter = np.stack([square - mean**2, normalised(lines)[1] @ (squares - means**2)])
    at = partial(np.interp, found.place, place)
    return Beside(
        np.asarray(at(part)),
        np.sqrt(np.maximum([at(each) for each in scatter], 0.0)),
        np.array([at(each) for each in (mean, *means)]),
        np.append(evidence, lines),
    )


def _lines_along(place: Array, soft: Softness, side: float) -> tuple[Array, Array]:
    """Logarithmic prior probabilities (h,) of lines along an edge, and their distances (h, n) in widths, zero
    where the edge is seen by itself.
    """
    start, stop = (each.ravel() for each in np.meshgrid(_FAR, _FAR, indexing="ij"))
    area = np.outer(np.gradient(_FAR), np.gradient(_FAR)).ravel()
    turned = (stop - start) * soft.width / side / _LEVEL
    prior = np.log(soft.before / _HIDDEN**2 * area) - turned**2 / 2
    away = (start[:, None] * (1 - place) + stop[:, None] * (1 + place)) / 2
    away = np.where((away > 0) & (away < _SEEN), away, 0.0)
    beside = away.any(axis=1)
    return prior[beside], away[beside]


def _chain(seen: Array, prior: Array) -> tuple[Array, Array]:
    """Probabilities (…, n, m) of what is beside each part of an edge (Rabiner 1989), and the evidence (…).

    What is beside one part is beside the next one, too: a hidden Markov chain. `seen` are the likelihoods of
    the widths of n parts (…, n, m) with each of m kinds, `prior` their probabilities (m,); the evidence is
    the logarithm of the likelihood of all.
    """
    before, after, log = np.empty_like(seen), np.ones_like(seen), np.zeros(seen.shape[:-2])
    state = prior
    for k in range(seen.shape[-2]):
        both = state * seen[..., k, :]
        total = both.sum(axis=-1)
        log += np.log(total)
        before[..., k, :] = both / total[..., None]
        state = _PERSISTENT * before[..., k, :] + (1 - _PERSISTENT) * prior
    for k in range(seen.shape[-2] - 2, -1, -1):
        both = seen[..., k + 1, :] * after[..., k + 1, :]
        both = _PERSISTENT * both + (1 - _PERSISTENT) * (both @ prior)[..., None]
        after[..., k, :] = both / both.sum(axis=-1, keepdims=True)
    both = before * after
    return both / both.sum(axis=-1, keepdims=True), log
