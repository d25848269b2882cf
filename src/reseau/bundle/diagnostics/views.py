"""Photographs of one view: copies of each other in what their points have in common.

Frames of a video, or photographs of a target that was not moved, repeat the errors that the points of an
image have in common: they are one photograph, taken several times. Either each photograph is a view of its
own, or those whose points lie in about the same places are one view. How many views there are is what the
evidence for a smooth field of each view says (see :mod:`~reseau.bundle.diagnostics.evidence`).
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Rows
from ...core.threads import one_thread
from ..network.network import Network
from ..solver.problem import BundleFit
from .evidence import ODDS, Effect, scores, sigma_seen, too_large, used_rows
from .image_effects import smooth_effects

_LENGTH, _DEGREE = "0.6", 2
"""Length of the fields that are compared, and degree of their polynomials, in which copies are alike, too."""
LEAST, _MOST, _TOGETHER = 3, 48, 400
"""Fewer images show nothing in common; of more, as many are looked at; beyond, each is a view of its own."""


def looked_at(fit: BundleFit) -> Rows:
    """Images from which it is estimated what points have in common: all, or as many spread over them."""
    images = np.flatnonzero(fit.usable.images)
    return images if len(images) <= _MOST else images[np.linspace(0, len(images) - 1, _MOST).astype(int)]


@one_thread()
def views_of(fit: BundleFit) -> Rows:
    """Return the number of the view of each image of a network (m,); those that are looked at come first."""
    network, images = fit.problem.network, looked_at(fit)
    every = np.arange(len(network.images), dtype=np.intp)
    if len(images) < LEAST or len(every) > _TOGETHER or fit.redundancy < 1:
        return _numbered(every, images)
    smooth, forms = smooth_effects(fit, _DEGREE)
    q, place = smooth.slope.shape[2], np.full(len(every), -1, dtype=np.intp)
    place[images] = np.arange(len(images))
    some = Effect(smooth.slope, np.where(smooth.group >= 0, place[smooth.group], -1), len(images))
    if too_large(fit, some.count):
        return _numbered(every, images)
    root = np.sqrt(np.mean(sigma_seen(fit) ** 2)) * forms[_LENGTH][images]
    alone = scores(fit, [some]).combined(len(images), root)
    nothing = best = alone.log_evidence()
    found, before = every, len(images)
    tree = _tree(network, used_rows(fit))
    for count in range(len(every) - 1, LEAST - 1, -1):
        views = _cut(tree, count)
        own = np.unique(views[images], return_inverse=True)[1]
        if (several := int(own.max()) + 1) in (before, 1):
            continue
        before = several
        evidence = alone.mapped(np.kron(own[:, None] == np.arange(several), np.eye(q))).log_evidence()
        if evidence > best:
            best, found = evidence, views
        elif evidence < best - ODDS:
            break
    return _numbered(found if best > nothing + ODDS else every, images)


def _numbered(views: Rows, images: Rows) -> Rows:
    """The same views with numbers from zero on, those of some images first."""
    order = dict.fromkeys([*views[images].tolist(), *views.tolist()])
    number = {view: k for k, view in enumerate(order)}
    return np.array([number[view] for view in views.tolist()], dtype=np.intp)


def _tree(network: Network, rows: Rows) -> Array:
    """Images by how far apart they show the same points, in half the diagonal of the image."""
    from scipy.cluster.hierarchy import linkage  # takes long to import

    at = np.full((len(network.images), len(network.points), 2), np.nan)
    at[network.image_of[rows], network.point_of[rows]] = network.xy[rows]
    away = []
    for k, c in enumerate(network.camera_of[:-1]):
        camera = network.cameras[c]
        square = ((at[k + 1 :] - at[k]) ** 2).sum(axis=2)
        count = np.isfinite(square).sum(axis=1)
        mean = np.nansum(square, axis=1) / np.maximum(count, 1)
        both = (count > 0) & (network.camera_of[k + 1 :] == c)
        away.append(np.where(both, np.sqrt(mean) / (np.hypot(camera.width, camera.height) / 2), 2.0))
    return np.asarray(linkage(np.concatenate(away), "average"))


def _cut(tree: Array, count: int) -> Rows:
    """Number of the group of each leaf where a tree has been merged to so many groups."""
    n = len(tree) + 1
    group = np.arange(n)
    for k in range(n - count):
        group[np.isin(group, tree[k, :2])] = n + k
    return group
