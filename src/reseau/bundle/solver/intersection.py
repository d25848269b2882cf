"""Intersection of good rays among gross errors: points from pairs of rays, judged by all their rays."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np

from ...adjust.mixture import Mixture
from ...core.data import Array, Mask, Rows
from .spatial import intersect

# Pairs of rays of a point that are tried, points of which this is done at once, and rounds of refinement.
_PAIRS, _AT_ONCE, _ROUNDS = 28, 2000, 3
# Standard deviations (rad) of rays that are tried where nothing is known.
_SIGMAS = np.geomspace(1e-5, 0.05, 13)
# Octaves by which the rays of a point may agree less well than others.
_LOOSER = 8
# Points that are looked at to determine it.
_SOME = 300


class Rays(NamedTuple):
    """Rays: point (n,), direction (n, 2), rotation and centre of the camera; whether they are parallel."""

    point: Rows
    uv: Array
    rotation: Array
    x0: Array
    parallel: Mask

    def of(self, rows: Rows | Mask) -> Self:
        """Some of the rays."""
        columns: list[Any] = [column[rows] for column in self]
        return type(self)(*columns)

    def nearest(self, points: int) -> tuple[Array, Array]:
        """Points (p, 3) nearest to all their rays, and the intersection angles."""
        return intersect(self.point, self.uv, self.rotation, self.x0, points, self.parallel)

    def misfits(self, xyz: Array) -> Array:
        """Angles (sine) between rays and the directions to places (n, 3); infinite behind the camera."""
        x = np.einsum("nij,nj->ni", self.rotation, xyz - self.x0)
        # Parallel rays: the distance from the ray, in that from the camera, which stands for its size.
        x[self.parallel, :2] -= self.uv[self.parallel]
        uv = np.where(self.parallel[:, None], 0.0, self.uv)
        ray = np.column_stack([uv, np.ones(len(uv))])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            across = np.linalg.norm(np.cross(x, ray), axis=1)
            off: Array = across / np.linalg.norm(x, axis=1) / np.linalg.norm(ray, axis=1)
        return np.where(x[:, 2] > 0, off, np.inf)

    def intersected(
        self, points: int, good: Mask, mixture: Mixture | None, reach: float
    ) -> tuple[Array, Array, Mask, Mixture | None]:
        """Points, angles of their good rays, which rays are good, and their misfits.

        Parameters
        ----------
        points : int
            Number of points p.
        good : ndarray of bool (n,)
            Rays that are taken as good at first.
        mixture : Mixture or None
            Misfits so far, where known.
        reach : float
            Extent of the field of view (rad).
        """
        count = np.bincount(self.point, minlength=points)
        if not (count > 1).any():
            return *self.nearest(points), good, mixture
        if mixture is None:
            some = np.flatnonzero(count > 1)
            some = some[np.linspace(0, len(some) - 1, min(_SOME, len(some))).astype(np.intp)]
            mixture = self._begun(some, reach)
        xyz, angle = self.of(good).nearest(points)
        off = self.misfits(xyz[self.point])
        doubtful = np.zeros(points, dtype=bool)
        doubtful[self.point[(mixture.gross(off) == good) & (count[self.point] > 1)]] = True
        good, chosen, sigma = good.copy(), np.flatnonzero(doubtful), np.full(points, mixture.sigma)
        for k in range(0, len(chosen), _AT_ONCE):
            self._chosen(chosen[k : k + _AT_ONCE], mixture, good, sigma)
        for _ in range(_ROUNDS):
            xyz, angle = self.of(good).nearest(points)
            off = self.misfits(xyz[self.point])
            own = doubtful[self.point] & np.isfinite(off)
            now = np.where(own, ~mixture.gross(off, sigma[self.point]), good)
            if (now == good).all():
                break
            good = now
        gain = np.where(np.isfinite(off), mixture.evidence(off, sigma[self.point]), 0.0)
        # Where fewer rays than two agree, there is no point.
        xyz[doubtful & (np.bincount(self.point, gain, points) < 3 * mixture.prices(sigma))] = np.nan
        seen = np.isfinite(xyz[self.point, 0])
        if seen.any():
            # A point takes three components of its rays.
            freedom = 1 - 1.5 * len(np.unique(self.point[seen])) / int(seen.sum())
            mixture = mixture.fitted(off[seen], max(freedom, 0.25))
        return xyz, angle, good, mixture

    def _tried(self, chosen: Rows) -> tuple[Rows, Rows, Array]:
        """Trials: the trial and the ray of each misfit, and the misfits, of pairs of rays of some points."""
        order = np.argsort(self.point, kind="stable")
        begin = np.searchsorted(self.point[order], chosen)
        end = np.searchsorted(self.point[order], chosen, side="right")
        pairs, trials, rays, number = [], [], [], 0
        for a, b in zip(begin.tolist(), end.tolist(), strict=True):
            own = order[a:b]
            first, second = np.triu_indices(len(own), 1)
            if len(first) > _PAIRS:
                some = np.linspace(0, len(first) - 1, _PAIRS).astype(np.intp)
                first, second = first[some], second[some]
            pairs.append(np.stack([own[first], own[second]], axis=1))
            trials.append(np.repeat(number + np.arange(len(first)), len(own)))
            rays.append(np.tile(own, len(first)))
            number += len(first)
        both = np.concatenate(pairs).ravel()
        two = self.of(both)._replace(point=np.repeat(np.arange(number), 2))
        xyz, _ = two.nearest(number)
        trial, ray = np.concatenate(trials), np.concatenate(rays)
        return trial, ray, self.of(ray).misfits(xyz[trial])

    def _begun(self, chosen: Rows, reach: float) -> Mixture:
        """Misfits with the standard deviation that explains the rays of some points best."""
        trial, ray, off = self._tried(chosen)
        point, best = np.searchsorted(chosen, self.point[ray]), list[float]()
        of = np.zeros(int(trial.max()) + 1, dtype=np.intp)
        of[trial] = point
        mixtures = [Mixture(float(s), 0.2, reach) for s in _SIGMAS]
        for each in mixtures:
            gain = np.bincount(trial, each.evidence(off))
            most = np.zeros(len(chosen))
            np.maximum.at(most, of, gain - 3 * each.price)
            best.append(float(most.sum()))
        return mixtures[int(np.argmax(best))]

    def _chosen(self, chosen: Rows, mixture: Mixture, good: Mask, sigma: Array) -> None:
        """Mark the rays of some points that agree with the best pair of each, and how well (p,).

        Images that have just been oriented are less accurate than others.
        """
        trial, ray, off = self._tried(chosen)
        number = int(trial.max()) + 1
        point = np.zeros(number, dtype=np.intp)
        point[trial] = self.point[ray]
        sigmas = mixture.sigma * 2.0 ** np.arange(_LOOSER)
        gains = np.stack(
            [np.bincount(trial, mixture.evidence(off, s)) - 3 * mixture.prices(s) for s in sigmas]
        )
        gain, own = gains.max(axis=0), sigmas[gains.argmax(axis=0)]
        order = np.lexsort((-gain, point))
        _, first = np.unique(point[order], return_index=True)
        best = np.zeros(number, dtype=bool)
        best[order[first]] = True
        sigma[point[best]] = own[best]
        rows = best[trial]
        good[ray[rows]] = ~mixture.gross(off[rows], own[trial[rows]])
