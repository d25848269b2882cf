"""Explanations that choose among image points and images: gross errors, another camera.

Each choice pays for what it selects: k of n image points have the prior probability 1/(n·C(n, k)), k of m
images accordingly.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from ...core.data import Array, Rows
from ..diagnostics.evidence import Effect, Scores, scores
from .effects import Sight

_SUSPECTS, _PATIENCE = 120, 6
"""Image points that are looked at as gross errors, and how many more are tried when one does not help."""
_SPLITS = 60
"""Divisions of the images by their principal distances that are compared."""


@dataclass(frozen=True, eq=False)
class Single:
    """An explanation that is no form of effects: a choice, or another network.

    Parameters
    ----------
    code, form : str
        The cause, and its form.
    log_evidence : float
        Logarithm of the density of the image points, with the probability of the choice.
    explained : float
        Decrease of the sum of squares.
    rows : ndarray of int
        Used image points, or images, that were chosen.
    """

    code: str
    form: str
    log_evidence: float
    explained: float
    rows: Rows = field(default_factory=lambda: np.zeros(0, dtype=np.intp))


def log_choice(n: int, k: int) -> float:
    """Logarithm of the number of choices of k of n, for each of n numbers."""
    return float(
        scipy.special.gammaln(n + 1) - scipy.special.gammaln(k + 1) - scipy.special.gammaln(n - k + 1)
        + np.log(n)
    )  # fmt: skip


def gross_errors(sight: Sight, known: float) -> Single | None:
    """Single image points that are wrong, found one after the other."""
    result, n = sight.result, len(sight.rows)
    w = np.nan_to_num(np.abs(result.test_values[sight.rows]).max(axis=1))
    suspects = np.argsort(-w, kind="stable")[: min(_SUSPECTS, n // 4)]
    if not len(suspects):
        return None
    group = np.full(n, -1, dtype=np.intp)
    group[suspects] = np.arange(len(suspects))
    slope = np.tile(np.eye(2), (n, 1, 1)) * sight.sigma[:, None, None]
    every = scores(result.fit, [Effect(slope, group, len(suspects))])
    best: Single | None = None
    chosen, left = list[int](), every
    far = 1e4
    for _ in range(len(suspects)):
        own = left.m.reshape(len(suspects), 2, len(suspects), 2)
        k = np.arange(len(suspects))
        blocks, g = own[k, :, k, :] + np.eye(2) / far**2, left.g.reshape(-1, 2)
        gain = np.einsum("ni,ni->n", g, np.linalg.solve(blocks, g[:, :, None])[:, :, 0])
        gain[chosen] = -np.inf
        at = int(np.argmax(gain))
        chosen.append(at)
        left = left.with_effects(np.array([2 * at, 2 * at + 1]), far)
        columns = (2 * np.array(chosen)[:, None] + np.arange(2)).ravel()
        part = every.part(columns)
        found = part.log_evidence(known=known) - log_choice(n, len(chosen))
        if best is None or found > best.log_evidence:
            less = every.square - left.square
            best = Single("blunders", f"{len(chosen)}", found, less, suspects[chosen])
        elif len(chosen) >= len(best.rows) + _PATIENCE:
            break
    return best


def other_cameras(sight: Sight, part: Scores, known: float) -> Single | None:
    """Images that have another principal distance and point than the others, the same among themselves.

    Parameters
    ----------
    sight : Sight
        The image points.
    part : Scores
        Of principal distance and principal point of each image (3m).
    known : float
        Probability that the variance factor is one.
    """
    network, images = sight.network, len(sight.network.images)
    used = np.bincount(sight.image, minlength=images) > 0
    units = _units(part)
    plain = part.scaled(units)
    off = (np.linalg.solve(plain.m + _RIDGE * np.eye(3 * images), plain.g) * units).reshape(-1, 3)
    only = part.part(3 * np.arange(images))
    first = _units(only)
    alone = np.linalg.solve(only.scaled(first).m + _RIDGE * np.eye(images), only.g * first) * first
    found = dict[bytes, Single]()

    def looked_at(rows: Rows, count: int) -> Single:
        """Images with another camera, of all that could have it."""
        member = np.zeros(images)
        member[rows] = 1.0
        key = member.tobytes()
        if key not in found:
            split = part.mapped(np.asarray(np.kron(member[:, None], np.eye(3)), dtype=np.float64))
            split = split.scaled(_units(split))
            forms = [split.part(columns) for columns in (np.arange(1), np.arange(1, 3), np.arange(3))]
            each = [one.log_evidence(_INFORMATION, known=known) for one in forms]
            best = forms[int(np.argmax(each))]
            log = float(scipy.special.logsumexp(each)) - np.log(3.0) - log_choice(count, len(rows))
            explained = best.explained(best.best_size(_INFORMATION))
            found[key] = Single("other-camera", f"{len(rows)}", log, explained, np.flatnonzero(member))
        return found[key]

    for c in range(len(network.cameras)):
        own = np.flatnonzero(used & (network.camera_of == c))
        count, best = len(own), None
        for along in (alone, *off.T) if count > 2 else ():
            order = own[np.argsort(along[own], kind="stable")]
            for k in np.unique(np.linspace(1, count - 1, min(_SPLITS, count - 1)).astype(int)):
                one = looked_at(order[:k] if k <= count - k else order[k:], count)
                best = one if best is None or one.log_evidence > best.log_evidence else best
        while best is not None:
            # One image more, or less.
            others = [np.setxor1d(best.rows, [image]) for image in own]
            tried = [looked_at(rows, count) for rows in others if 0 < len(rows) <= count / 2]
            next_ = max(tried, key=lambda one: one.log_evidence, default=best)
            if next_.log_evidence <= best.log_evidence:
                break
            best = next_
    if not found:
        return None
    most = max(found.values(), key=lambda one: one.log_evidence)
    every = float(scipy.special.logsumexp([one.log_evidence for one in found.values()]))
    return replace(most, log_evidence=every)


def _units(scores: Scores) -> Array:
    """Units of the columns in which each has an information of one; 0 where it has none."""
    own = np.diag(scores.m)
    seen = own > _ABSORBED * max(float(own.max(initial=0.0)), 1e-300)
    return np.where(seen, 1.0 / np.sqrt(np.where(seen, own, 1.0)), 0.0)


_RIDGE, _ABSORBED = 1e-4, 1e-9
_INFORMATION = np.geomspace(0.3, 3e4, 24)
"""Sizes of effects whose unit is what the image points determine."""
