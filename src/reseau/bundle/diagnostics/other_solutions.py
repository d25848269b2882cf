"""Solutions that explain the observations as well as the estimates, and that standard deviations exclude.

Standard deviations of first order presume that misfits are linear in the unknowns. Where points lie on a
quadric through the projection centres, vᵀPv is flat along a curved valley, or has more than one minimum in
it (Krames 1941; Maybank 1993, *Theory of Reconstruction from Image Motion*, ch. 5); so it has for an image on
the cylinder through its control points. The estimates are then one of several answers.

An unknown is held at t of its standard deviations from its estimate, and all others are adjusted. To first
order vᵀPv increases by t² variances; the excess that is found is less where another solution is near. The
observations allow what they predict not ten times worse than the estimates, and another minimum that is not a
thousand times worse; it is another solution where standard deviations make it ten times less probable than
the observations do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...core.data import Array, Mask
from ...core.failure import Failure
from ...optics.poses import matrix_to_vector
from ..network.network import finite
from ..solver.datum import similarity_onto
from ..solver.iteration import Iterated, iterate
from ..solver.problem import BundleFit
from ..solver.values import Correction, Values
from .evidence import ODDS

# Excess of vᵀPv, in variances, up to which observations allow a solution; that of standard deviations is this
# larger where they exclude it.
_CHANCE = 2 * ODDS
# The same of another minimum, in which everything can differ: it is a thousand times less probable.
_SEPARATE = 2 * np.log(1000.0)
# Standard deviations at which a solution that is as likely as the estimates is excluded.
_FIRST = np.sqrt(2 * _CHANCE)
# Unknowns that are looked at, combinations of them that are followed, places that are tried in a direction,
# and the interval, relative to the distance, that is fine enough.
_LOOKED, _FOLLOWED, _TRIED, _FINE = 40, 3, 10, 0.2
# Iterations of each adjustment, relative offset that ends them, and damping at first.
_STEPS, _ROUGHLY, _DAMPING = 60, 3e-3, 1e-6
# Excess, in variances, that iterations leave.
_LEFT = 1e-2
# Largest number of reduced unknowns: in larger networks many images hold each other.
_LARGEST = 600


@dataclass(frozen=True, eq=False)
class OtherSolution:
    """Another solution of a network.

    Parameters
    ----------
    values : Values
        In the coordinate system of the estimates.
    excess : float
        vᵀPv beyond that of the estimates, in variances.
    minimum : bool
        Whether it is another minimum of vᵀPv.
    """

    values: Values
    excess: float
    minimum: bool = False

    def change(self, fit: BundleFit) -> tuple[Array, Array]:
        """Changes of the reduced unknowns (u,) and of points (p, 3), from the estimates."""
        unknowns, one, other = fit.unknowns, fit.values, self.values
        change = np.zeros(unknowns.size)
        images = np.flatnonzero(unknowns.pose >= 0)
        turn = matrix_to_vector(other.rotation[images] @ np.swapaxes(one.rotation[images], 1, 2))
        shift = (other.x0 - one.x0)[images]
        along = unknowns.network.parallel[images]
        shift[along] = np.einsum("nij,nj->ni", one.rotation[images][along], shift[along])
        change[unknowns.pose[images, None] + np.arange(6)] = np.concatenate([turn, shift], axis=1)
        for c in np.flatnonzero(unknowns.camera >= 0):
            count = unknowns.count[c]
            rows = unknowns.free[c, :count]
            change[unknowns.camera[c] : unknowns.camera[c] + count] = (other.cameras - one.cameras)[c, rows]
        for e in np.flatnonzero(unknowns.extra >= 0):
            count = unknowns.extra_count[e]
            change[unknowns.extra[e] : unknowns.extra[e] + count] = (other.extra - one.extra)[e, :count]
        points = np.where(fit.usable.points[:, None], other.xyz - one.xyz, 0.0)
        kept, columns = unknowns.kept_points
        change[columns] = points[kept]
        return change, points

    def excluded(self, fit: BundleFit) -> tuple[Mask, Mask]:
        """Reduced unknowns (u,) and points (p,) whose standard deviations exclude this solution."""
        change, points = self.change(fit)
        limit = (max(self.excess, 0.0) + _CHANCE) * fit.variance
        known = fit.cofactors.reduced.diagonal, np.diagonal(fit.cofactors.points, axis1=1, axis2=2)
        # What is held has no variance; points that the other solution leaves out are nowhere.
        columns, of_points = (
            (own > 0) & ~(by**2 <= limit * own) for own, by in zip(known, (change, points), strict=True)
        )
        # A pose is one.
        poses = fit.unknowns.pose[fit.unknowns.pose >= 0, None] + np.arange(6)
        columns[poses] = columns[poses].any(axis=1, keepdims=True)
        return columns, of_points.any(axis=1)

    @property
    def better(self) -> bool:
        """Whether it explains more than the estimates, by more than iterations leave."""
        return self.excess < -_LEFT

    @property
    def allowed(self) -> bool:
        """Whether the observations allow it."""
        return bool(self.excess <= (_SEPARATE if self.minimum else _CHANCE))


def excluded(fit: BundleFit, others: Sequence[OtherSolution]) -> tuple[Mask, Mask]:
    """Reduced unknowns (u,) and points (p,) whose standard deviations exclude one of some solutions."""
    columns, points = np.zeros(fit.unknowns.size, dtype=bool), np.zeros(len(fit.usable.points), dtype=bool)
    for other in others:
        own, seen = other.excluded(fit)
        columns, points = columns | own, points | seen
    return columns, points


def comparable(fit: BundleFit) -> bool:
    """Whether other solutions are looked for: of images and cameras alone, and not too many."""
    network, constraints = fit.problem.network, fit.linear.system.constraints
    alone = constraints is None and network.refraction is None and not network.shutters.any()
    return alone and fit.cofactors.reduced.known and fit.unknowns.size <= _LARGEST


def followed(fit: BundleFit) -> list[OtherSolution]:
    """Find solutions along the unknowns that misfits depend on least linearly.

    Parameters
    ----------
    fit : BundleFit
        The adjustment.

    Returns
    -------
    list of OtherSolution
        Those that the observations allow. One with a negative excess is better than the estimates.
    """
    system = fit.linear.system
    held = system.held
    try:
        return list(_Valley(fit).solutions())
    finally:
        system.held = held


class _Valley:
    """The surroundings of the estimates, with the datum that its cofactors have."""

    def __init__(self, fit: BundleFit) -> None:
        self.fit, self.linear, self.system = fit, fit.linear, fit.linear.system
        cofactors = fit.cofactors
        before = cofactors.reduced if cofactors.referral is None else cofactors.referral.before
        self.datum, self.held, self.cofactors = before.held, before.held, before.full

    def solutions(self) -> Iterator[OtherSolution]:
        """All that are found; once there are some, what else is undetermined makes no difference."""
        q, found = self.cofactors, list[OtherSolution]()
        for _ in range(_FOLLOWED):
            k = self._least_linear(q)
            if k is None:
                return
            for sign in (1.0, -1.0):
                found += [
                    each
                    for each in self._along(k, sign * q[:, k] / np.sqrt(q[k, k]))
                    if each.better or any(part.any() for part in each.excluded(self.fit))
                ]
            yield from found
            if found:
                return
            # What is looked at next is independent of it, to first order.
            q = q - np.outer(q[:, k], q[:, k]) / q[k, k]
            self.held = self.held | (np.arange(len(q)) == k)

    def _least_linear(self, q: Array) -> int | None:
        """The unknown along which misfits are least linear; None where that makes no difference.

        With misfits v + t·a + t²·s, a of length one and v ⟂ a, no sum of squares is less than t² by more than
        2 t³ |s| + 2 t² |v·s|.
        """
        own = np.diag(q).copy()
        weight = own * self.fit.cofactors.normal.sums.diagonal
        best, least = None, _CHANCE
        for k in np.argsort(-weight)[:_LOOKED].tolist():
            if self.held[k] or own[k] <= 1e-9 * self.cofactors[k, k]:
                continue
            step = self._step(_FIRST * q[:, k] / np.sqrt(own[k]))
            ahead, back = (self._misfits(step.times(sign)) for sign in (1.0, -1.0))
            here = np.concatenate([self.linear.misfits.ravel(), self.linear.other_misfits])
            bend = (ahead + back - 2 * here) / 2
            size = float(np.linalg.norm(bend)) / np.sqrt(self.fit.variance)
            more = 2 * _FIRST * size + 2 * abs(float(here @ bend)) / self.fit.variance
            if not more <= least:
                best, least = k, more if np.isfinite(more) else np.inf
        return best

    def _step(self, change: Array) -> Correction:
        """The change of all unknowns that belongs to one of the reduced ones (u,), in standard deviations."""
        y = np.sqrt(self.fit.variance) * change
        nothing = np.zeros((len(self.linear.prior), 3, 1))
        return Correction(y, self.fit.cofactors.normal.points(nothing, y[:, None])[:, :, 0], 0.0)

    def _misfits(self, step: Correction) -> Array:
        seen, others = self.system.misfits(self.linear.values.moved(self.fit.unknowns, step))
        return np.concatenate([seen.ravel(), others])

    def _along(self, k: int, along: Array) -> Iterator[OtherSolution]:
        """Solutions in one direction, as far as the observations allow, and what is reached from there."""
        at, near, far, ends = self.linear.values, 0.0, np.inf, list[Values]()
        for _ in range(_TRIED):
            t = min(max(2 * near, np.sqrt(_CHANCE)), (near + far) / 2)
            found = self._adjusted(at.moved(self.fit.unknowns, self._step((t - near) * along)), k)
            if found is None:
                far = t
                continue
            other = self._solution(found)
            if other.allowed:
                at, near = found.linear.values, t
                yield other
            elif not np.isfinite(far):
                # Beyond a barrier there may be another minimum.
                ends.append(found.linear.values)
            if other.better:
                ends.append(found.linear.values)
            far = far if other.allowed else t
            if far - near < _FINE * far:
                break
        for end in ends:
            found = self._adjusted(end, None)
            if found is not None and (other := self._solution(found, minimum=True)).allowed:
                yield other

    def _adjusted(self, start: Values, k: int | None) -> Iterated | None:
        """All other unknowns adjusted with one held; None where that fails or leaves points behind images."""
        held = self.datum if k is None else self.held | (np.arange(len(self.held)) == k)
        before, self.system.held = self.system.held, held
        found = iterate(
            self.system, start, redundancy=max(1, self.fit.redundancy), max_iterations=_STEPS,
            tolerance=_ROUGHLY, damping=_DAMPING,
        )  # fmt: skip
        self.system.held = before
        if isinstance(found, Failure) or not before_images(self.fit, found.linear.values):
            return None
        return found

    def _solution(self, found: Iterated, *, minimum: bool = False) -> OtherSolution:
        excess = (found.linear.cost - self.fit.cost) / self.fit.variance
        values = in_datum(self.fit, found.values.shifted(self.fit.problem.centre))
        return OtherSolution(values, excess, minimum)


def before_images(fit: BundleFit, values: Values) -> bool:
    """Whether all points are before their images that are so in the estimates."""
    seen = fit.linear.system.seen
    one, other = (
        np.einsum("ni,ni->n", at.rotation[seen.image, 2], at.xyz[seen.point] - at.x0[seen.image])
        for at in (fit.linear.values, values)
    )
    behind = (one > 0) & (other <= 0) & ~fit.unknowns.network.parallel[seen.image]
    return not behind.any()


def in_datum(fit: BundleFit, values: Values) -> Values:
    """Return values in the datum of an adjustment."""
    defect = fit.freedom.defect
    if fit.problem.network.datum != "free" or defect < 6:
        return values
    chosen = (fit.usable.points if fit.datum is None else fit.datum) & finite(values.xyz)
    return replace(
        similarity_onto(values.xyz[chosen], fit.values.xyz[chosen], scaled=defect == 7)(values),
        extra=values.extra,
    )
