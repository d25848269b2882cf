"""Check the control points against the shape determined by the images alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, islice

import numpy as np

from ...core.data import Array, Mask, Rows
from ..network import Network
from ..network.network import finite
from ..solver import BundleFit, BundleProblem, approximate
from ..solver.datum import similarity_onto
from ..solver.unknowns import Unknowns
from ..solver.values import Values

__all__ = ["doubtful_control"]

_TRIPLES, _SIGMAS, _LEAST = 500, 8.0, 4
# Tolerated error of a control point, as a fraction of their extent.
_LOOSE = 2e-3
# Misfits after an exchange of two points that explains those before it, relative to these.
_SMALLER = 0.2


def doubtful_control(network: Network) -> str:
    """Find wrong control points by a free network adjustment.

    The network is adjusted without control, as a free network, and transformed to the control points by the
    similarity of three points with which most others agree. The points that do not agree are reported, or the
    pair whose exchange makes all agree.

    Parameters
    ----------
    network : Network
        Network with at least four control points with three known coordinates.

    Returns
    -------
    str
        What is wrong with the control points; empty where nothing was found.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> network = example_network()
    >>> xyz = network.xyz.copy()
    >>> xyz[[0, 19]] = xyz[[19, 0]]
    >>> doubtful_control(replace(network, xyz=xyz, sigma=np.zeros((20, 3)), datum="control"))
    'the coordinates of control points p0 and p19 look exchanged'
    """
    rows = np.flatnonzero(finite(network.xyz) & ~np.isnan(network.sigma).any(axis=1) & (network.rays > 1))
    if len(rows) < _LEAST:
        return ""
    fit = _free(network)
    if fit is None:
        return ""
    rows = rows[fit.usable.points[rows]]
    if len(rows) < _LEAST:
        return ""
    given, found = network.xyz[rows], fit.values.xyz[rows]
    extent = float(np.ptp(given, axis=0).max())
    scale = extent / max(float(np.ptp(found, axis=0).max()), 1e-300)
    trace = np.trace(fit.cofactors.points[rows], axis1=1, axis2=2) * fit.variance
    limit = _SIGMAS * (scale * np.sqrt(trace) + network.sigma[rows].max(axis=1)) + _LOOSE * extent
    agree = _largest_agreement(found, given, limit)
    if agree.all():
        return ""
    names_of = [network.points[j] for j in rows]
    exchanged = [f"{names_of[a]} and {names_of[b]}" for a, b in _exchanged(found, given, limit)]
    if exchanged:
        return f"the coordinates of control points {', or '.join(exchanged)} look exchanged"
    if agree.sum() < _LEAST:
        mirrored = _largest_agreement(found * [1.0, 1.0, -1.0], given, limit)
        if mirrored.sum() > max(_LEAST - 1, agree.sum()):
            return "the control points are mirrored: their coordinate system is left-handed"
        return (
            f"the control points {', '.join(names_of)} do not agree with the shape determined by the images"
        )
    wrong = np.flatnonzero(~agree)
    names = ", ".join(names_of[k] for k in wrong)
    return f"control point{'s' * (len(wrong) > 1)} {names} contradict{'s' * (len(wrong) == 1)} the others"


def _free(network: Network) -> BundleFit | None:
    """Adjust the network without control."""
    nothing = np.full(network.xyz.shape, np.nan)
    posed = np.full(network.x0.shape, np.nan)
    none: Rows = np.zeros((0, 2), dtype=np.intp)
    free = replace(
        network, xyz=nothing, sigma=nothing, x0=posed, rotation=posed, datum="free",
        datum_points=np.ones(len(network.points), dtype=bool), distance_of=none, distance=np.zeros((0, 2)),
        stage=None,
    )  # fmt: skip
    start = approximate(free)
    if not finite(start.x0).any():
        return None
    unknowns = Unknowns.of(free, finite(start.x0))
    values = Values.of_cameras(unknowns, start.rotation, start.x0, start.xyz)
    fit = BundleProblem(free, values, start.xyz, max_iterations=50, tolerance=1e-4).adjusted()
    return fit if isinstance(fit, BundleFit) else None


def _exchanged(found: Array, given: Array, limit: Array) -> list[tuple[int, int]]:
    """Return pairs whose exchange makes all points agree; several pairs where the control is symmetric."""
    pairs, every = [], np.ones(len(found), dtype=bool)
    as_given = _misfits(found, given, every)
    for a, b in combinations(range(len(found)), 2):
        order = np.arange(len(found))
        order[[a, b]] = b, a
        misfit = _misfits(found, given[order], every)
        # In a symmetric figure an exchange can leave the shape as it is.
        if (misfit < limit).all() and np.linalg.norm(misfit) < _SMALLER * np.linalg.norm(as_given):
            pairs.append((a, b))
    return pairs


def _agreeing(found: Array, given: Array, limit: Array, chosen: Mask) -> Mask:
    """Return which points agree with the similarity of the chosen ones."""
    return np.asarray(_misfits(found, given, chosen) < limit)


def _misfits(found: Array, given: Array, chosen: Mask) -> Array:
    """Distances of all points after the similarity of the chosen ones."""
    nothing = np.zeros((1, 12))
    values = Values(np.zeros((0, 3, 3)), np.zeros((0, 3)), found, nothing, nothing)
    moved = similarity_onto(values.xyz[chosen], given[chosen], scaled=True)(values).xyz
    return np.asarray(np.linalg.norm(moved - given, axis=1))


def _largest_agreement(found: Array, given: Array, limit: Array) -> Mask:
    """Return the points that agree with the best similarity of three points."""
    best = np.zeros(len(found), dtype=bool)
    for three in islice(combinations(range(len(found)), 3), _TRIPLES):
        chosen = np.zeros(len(found), dtype=bool)
        chosen[list(three)] = True
        for _ in range(2):
            agree = _agreeing(found, given, limit, chosen)
            if agree.sum() < 3:
                break
            chosen = agree
        if agree.sum() > best.sum():
            best = agree
    return best
