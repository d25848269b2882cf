"""A camera that only turned: adjustment by rotations alone, and whether this predicts as well as depth does.

Images from one station have directions in place of points: three unknowns an image, two a point (Hartley
1997, Int. J. Comput. Vision 22, "Self-calibration of stationary cameras"). A linearised covariance of points
presumes that the base is real. Both adjustments are therefore compared by what they predict of image points
that are left out: vᵀPv of rotations alone is larger by two variances for each unknown more that pays (Stone
1977, J. R. Statist. Soc. B 39). Parallaxes are products of shifts a (3m) and depths b (p). Where there is no
base they fit more of the errors than as many unknowns would: a matrix of noise has a largest singular value
of √3m + √p (Davidson & Szarek 2001), so that 3m + p + 2 √(3mp) degrees of freedom are lost (Ye 1998, J. Am.
Statist. Assoc. 93).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...core.display import Display
from ...core.failure import Code, Estimated, Failure
from ...core.numbers import measured
from ...optics.poses import cross_matrix, rotation_matrix
from ..diagnostics.estimates import CameraEstimate
from ..diagnostics.evidence import ODDS
from ..network.network import Network, finite
from ..network.stage import nearest_rotation
from ..solver.problem import BundleFit, BundleProblem

# Iterations, decrease of vᵀPv that ends them, damping at first, and that at which nothing becomes better.
_STEPS, _SMALL, _DAMPING, _STUCK = 60, 1e-9, 1e-3, 1e9
# Level of the test that rotations explain what nothing else does, with the given standard deviations.
_LEVEL = 1e-3
# Images and points of a large network that are compared.
_IMAGES, _POINTS = 40, 400


@dataclass(frozen=True, eq=False, repr=False)
class RotationOnly(Estimated, Display):
    """Cameras that only turned, adjusted by rotations alone; truthy.

    Parameters
    ----------
    cameras : dict of str to CameraEstimate
        Estimated parameters by the name of the camera.
    rotation : ndarray (m, 3, 3)
        Rotations from the system of the first used image; NaN for images that were not used.
    direction : ndarray (p, 3)
        Unit vectors to the points in this system; NaN for points that were not used.
    cost : float
        vᵀPv.
    observations, redundancy : int
        Number of observations, and this less the number of unknowns.

    Examples
    --------
    >>> found = RotationOnly({}, np.eye(3)[None], np.array([[0.0, 0.0, 1.0]]), 96.0, 105, 100)
    >>> round(found.sigma0, 3)
    0.98
    """

    cameras: dict[str, CameraEstimate]
    rotation: Array
    direction: Array
    cost: float
    observations: int
    redundancy: int

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        return float(np.sqrt(self.cost / self.redundancy)) if self.redundancy > 0 else float("nan")

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{int(finite(self.rotation).sum())} images", ""),
            (f"{int(finite(self.direction).sum())} directions", ""),
            ("sigma0", f"{self.sigma0:.3f}"),
            ("redundancy", f"{self.redundancy}"),
        ]


class _State(NamedTuple):
    """Values of the free parameters of all cameras, rotations and directions."""

    cameras: Array
    rotation: Array
    direction: Array


@dataclass(frozen=True, eq=False)
class _Rotations:
    """The adjustment of some image points by rotations alone, from the approximate values of a problem."""

    problem: BundleProblem
    rows: Rows
    image: Rows
    point: Rows
    root: Array

    @classmethod
    def of(cls, problem: BundleProblem, rows: Rows) -> _Rotations:
        network = problem.network
        root = np.linalg.inv(np.linalg.cholesky(network.cov[rows]))
        root *= np.sqrt(_weights(problem)[rows])[:, None, None]
        _, image = np.unique(network.image_of[rows], return_inverse=True)
        _, point = np.unique(network.point_of[rows], return_inverse=True)
        return cls(problem, rows, image.astype(np.intp), point.astype(np.intp), root)

    @property
    def network(self) -> Network:
        return self.problem.network

    @property
    def camera(self) -> Rows:
        """Camera of each image point."""
        return self.network.camera_of[self.network.image_of[self.rows]]

    @property
    def free(self) -> list[Rows]:
        """Rows of the free parameters of each camera."""
        return [
            np.flatnonzero([name in camera.free for name in camera.names]) for camera in self.network.cameras
        ]

    def begun(self) -> _State:
        """Rotations by the rays that pairs of images have in common; the mean ray of each point."""
        values, network = self.problem.start, self.network
        every = [values.cameras[c, : len(camera.values)] for c, camera in enumerate(network.cameras)]
        uv = np.full((len(self.rows), 2), np.nan)
        for c, camera in enumerate(network.cameras):
            own = self.camera == c
            uv[own] = camera.bare_mapping(every[c]).inverse(network.xy[self.rows[own]])
        rays = np.nan_to_num(np.column_stack([uv, np.ones(len(uv))]))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        m, p = int(self.image.max()) + 1, int(self.point.max()) + 1
        rotation, sums = np.tile(np.eye(3), (m, 1, 1)), np.zeros((p, 3))
        left, order = set(range(1, m)), [0]
        while True:
            own = np.flatnonzero(self.image == order[-1])
            np.add.at(sums, self.point[own], rays[own] @ rotation[order[-1]])
            # Next is the image that shares most points with those before it.
            known = np.linalg.norm(sums, axis=1)[self.point] > 0
            shared = np.bincount(self.image[known], minlength=m)
            nearest = max(left, key=lambda i: shared[i], default=-1)
            if nearest < 0 or not shared[nearest]:
                break
            left.remove(nearest)
            order.append(nearest)
            own = np.flatnonzero((self.image == nearest) & known)
            rotation[nearest] = nearest_rotation(rays[own].T @ sums[self.point[own]])
        free = [own[k] for own, k in zip(every, self.free, strict=True)]
        size = np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
        return _State(np.concatenate(free), rotation, sums / size)

    def misfits(self, state: _State) -> tuple[Array, Array, Array, Array]:
        """Weighted misfits (n, 2), derivatives by cameras (n, 2, k), rotations and directions (n, 2, 3).

        Misfits are infinite where a point is not before its camera.
        """
        network, n = self.network, len(self.rows)
        seen = np.einsum("nij,nj->ni", state.rotation[self.image], state.direction[self.point])
        uv = seen[:, :2] / seen[:, 2:]
        plane = np.zeros((n, 2, 3))
        plane[:, 0, 0] = plane[:, 1, 1] = 1 / seen[:, 2]
        plane[:, :, 2] = -uv / seen[:, 2:]
        off, by_ray, by_camera, begin = np.zeros((n, 2)), plane, np.zeros((n, 2, len(state.cameras))), 0
        for c, (camera, free) in enumerate(zip(network.cameras, self.free, strict=True)):
            values = np.array(self.problem.start.cameras[c, : len(camera.values)])
            values[free] = state.cameras[begin : begin + len(free)]
            own = np.flatnonzero(self.camera == c)
            found = camera.bare_mapping(values).derivatives(uv[own])
            off[own] = network.xy[self.rows[own]] - found.value
            by_camera[own, :, begin : begin + len(free)] = found.d_parameters[:, :, free]
            by_ray[own] = found.d_xy @ plane[own]
            begin += len(free)
        weighted, by_ray = (self.root @ off[:, :, None])[:, :, 0], self.root @ by_ray
        weighted[(seen[:, 2] <= 0) | ~np.isfinite(weighted).all(axis=1)] = np.inf
        turn = -by_ray @ cross_matrix(seen)
        return weighted, self.root @ by_camera, turn, by_ray @ state.rotation[self.image]

    def observed(self, cameras: Array) -> tuple[Array, Array]:
        """Weights of observed parameters, and their misfits."""
        weight, given = [], []
        for camera, free in zip(self.network.cameras, self.free, strict=True):
            sigma = np.array([camera.sigma.get(camera.names[k], 0.0) for k in free])
            weight.append(np.where(sigma > 0, 1 / np.where(sigma > 0, sigma, 1.0) ** 2, 0.0))
            given.append(camera.values[free])
        return np.concatenate(weight), np.concatenate(given) - cameras

    def cost(self, state: _State) -> float:
        """Return vᵀPv; infinite where a point is not before its camera."""
        weight, left = self.observed(state.cameras)
        with np.errstate(all="ignore"):
            return float((self.misfits(state)[0] ** 2).sum() + weight @ left**2)

    def adjusted(self) -> tuple[_State, float, Array]:
        """Estimates, vᵀPv and cofactors of the parameters of the cameras."""
        state, damping = self.begun(), _DAMPING
        cost = self.cost(state)
        for _ in range(_STEPS):
            if not np.isfinite(cost):
                break
            normal, side, points = self._reduced(state)
            before = cost
            while damping < _STUCK:
                damped = normal + damping * np.diag(np.diag(normal))
                step: Array = scipy.linalg.lstsq(damped, side)[0]
                new = self._moved(state, step, points)
                now = self.cost(new)
                if now < cost:
                    state, cost, damping = new, now, damping / 10
                    break
                damping *= 10
            if before - cost <= _SMALL * cost:
                break
        k = len(state.cameras)
        cofactors = _inverted(self._reduced(state)[0])
        return state, cost, cofactors[:k, :k]

    def _reduced(self, state: _State) -> tuple[Array, Array, tuple[Array, ...]]:
        """Normal equations of cameras and rotations, directions eliminated; what gives these back.

        The first image defines the system and does not turn.
        """
        off, by_camera, turn, by_direction = self.misfits(state)
        tangent: Array = np.asarray(np.linalg.svd(state.direction[:, None, :])[2][:, 1:], dtype=np.float64)
        b = by_direction @ np.swapaxes(tangent[self.point], 1, 2)
        n, m, p, k = len(off), len(state.rotation), len(state.direction), by_camera.shape[2]
        a = np.zeros((n, 2, k + 3 * m))
        a[:, :, :k] = by_camera
        at = k + 3 * self.image[:, None] + np.arange(3)
        np.put_along_axis(a, np.broadcast_to(at[:, None], (n, 2, 3)), turn, axis=2)
        a = np.delete(a, np.arange(k, k + 3), axis=2).reshape(2 * n, -1)
        columns = np.repeat(2 * self.point[:, None] + np.arange(2), 2, axis=0)
        plain = scipy.sparse.csr_array(
            (b.reshape(-1), columns.ravel(), np.arange(0, 4 * n + 1, 2)), shape=(2 * n, 2 * p)
        )
        own = np.zeros((p, 2, 2))
        np.add.at(own, self.point, np.swapaxes(b, 1, 2) @ b)
        inverse = _inverted(own)
        between = np.asarray(plain.T @ a).reshape(p, 2, -1)
        right = np.asarray(plain.T @ off.ravel()).reshape(p, 2)
        normal = a.T @ a - np.einsum("pik,pij,pjl->kl", between, inverse, between, optimize=True)
        side = a.T @ off.ravel() - np.einsum("pik,pij,pj->k", between, inverse, right, optimize=True)
        weight, left = self.observed(state.cameras)
        normal[np.arange(k), np.arange(k)] += weight
        side[:k] += weight * left
        return normal, side, (tangent, inverse, between, right)

    def _moved(self, state: _State, step: Array, points: tuple[Array, ...]) -> _State:
        tangent, inverse, between, right = points
        k = len(state.cameras)
        turn = np.concatenate([np.zeros(3), step[k:]]).reshape(-1, 3)
        shift = np.einsum("pij,pj->pi", inverse, right - between @ step)
        direction = state.direction + np.einsum("pi,pij->pj", shift, tangent)
        return _State(
            state.cameras + step[:k], rotation_matrix(turn) @ state.rotation,
            direction / np.linalg.norm(direction, axis=1)[:, None],
        )  # fmt: skip


def _inverted(matrices: Array) -> Array:
    """Pseudo-inverses of symmetric matrices."""
    return np.asarray(np.linalg.pinv(matrices, hermitian=True), dtype=np.float64)


def rotation_only(problem: BundleProblem, rows: Rows | None = None) -> RotationOnly | Failure:
    """Adjust cameras that only turned, by rotations and directions.

    Parameters
    ----------
    problem : BundleProblem
        The problem; see :func:`reseau.bundle.problem_of`. No approximate poses are needed.
    rows : ndarray of int, optional
        Image points to use; by default all of points with two rays.

    Returns
    -------
    RotationOnly or Failure
        A failure where the model does not apply, or no rotations bring all points before the cameras.

    Examples
    --------
    >>> from reseau.bundle import example_network, problem_of
    >>> found = rotation_only(problem_of(example_network())[0])
    >>> found.sigma0 > 100  # its images were taken from eight places
    True
    """
    network = problem.network
    parts = (network.stage, network.rig, network.refraction)
    unlike = network.parallel.any() or network.shutters.any() or any(part is not None for part in parts)
    if unlike or any(c.additional is not None or c.covariance is not None for c in network.cameras):
        return Failure("the network has more than cameras and images", Code.NOT_CONSIDERED)
    rows = _twice_seen(problem, np.ones(len(network.images), dtype=bool)) if rows is None else rows
    if not len(rows):
        return Failure("no point has two rays", Code.TOO_FEW_POINTS)
    own = _Rotations.of(problem, rows)
    state, cost, cofactors = own.adjusted()
    if not np.isfinite(cost):
        return Failure("no rotations bring all points before the cameras", Code.NOT_CONVERGED)
    m, p = len(state.rotation), len(state.direction)
    observations = 2 * len(rows) + int((own.observed(state.cameras)[0] > 0).sum())
    redundancy = observations - len(state.cameras) - 3 * (m - 1) - 2 * p
    cameras, begin = dict[str, CameraEstimate](), 0
    variance = cost / redundancy if redundancy > 0 else 1.0
    for camera, free in zip(network.cameras, own.free, strict=True):
        names = tuple(camera.names[k] for k in free)
        part = slice(begin, begin + len(free))
        cameras[camera.id] = CameraEstimate(
            camera.id, names, state.cameras[part], variance * cofactors[part, part],
            tuple(camera.unit_of(name) for name in names),
        )  # fmt: skip
        begin += len(free)
    rotation = np.full((len(network.images), 3, 3), np.nan)
    direction = np.full((len(network.points), 3), np.nan)
    first = state.rotation[0]
    rotation[np.unique(network.image_of[rows])] = state.rotation @ first.T
    direction[np.unique(network.point_of[rows])] = state.direction @ first.T
    return RotationOnly(cameras, rotation, direction, cost, observations, redundancy)


def _weights(problem: BundleProblem) -> Array:
    """Factors on the weights of the image points (n,)."""
    n = len(problem.network.xy)
    return np.ones(n) if problem.weights is None else problem.weights[: 2 * n : 2]


def _twice_seen(problem: BundleProblem, images: Mask, points: Mask | None = None) -> Rows:
    """Rows of the image points in some images, of some points, that have two rays or more."""
    network = problem.network
    counted = (_weights(problem) > 0) & images[network.image_of]
    counted &= True if points is None else points[network.point_of]
    rays = np.bincount(network.point_of[counted], minlength=len(network.points))
    return np.flatnonzero(counted & (rays[network.point_of] > 1)).astype(np.intp)


def _some(among: Mask, count: int) -> Mask:
    """As many of some elements, spread over all."""
    rows = np.flatnonzero(among)
    if len(rows) <= count:
        return among
    found = np.zeros(len(among), dtype=bool)
    found[rows[np.linspace(0, len(rows) - 1, count).round().astype(np.intp)]] = True
    return found


def one_station(problem: BundleProblem, fit: BundleFit | None) -> Failure | None:
    """Whether rotations alone predict the image points as well as an adjustment with depth.

    Parameters
    ----------
    problem : BundleProblem
        The problem with depth.
    fit : BundleFit or None
        Its adjustment; None where that failed, and what it reaches is compared.

    Returns
    -------
    Failure or None
        The reason, with the cameras that rotations alone give; None where the points have depth, and where
        four or more points with given coordinates hold it.
    """
    network = problem.network
    if finite(network.xyz).sum() >= 4:
        return None
    if fit is None:
        values = problem.approached(_STEPS)
        problem = problem if values is None else replace(problem, start=values)
        points = finite(problem.start.xyz)
    else:
        problem, points = replace(problem.continued(fit), weights=fit.problem.weights), fit.usable.points
    images = _some(finite(problem.start.x0) if fit is None else fit.usable.images, _IMAGES)
    rows = _twice_seen(problem, images, points)
    seen = np.zeros(len(points), dtype=bool)
    seen[network.point_of[rows]] = True
    rows = _twice_seen(problem, images, _some(seen, _POINTS))
    turned = rotation_only(problem, rows) if len(np.unique(network.image_of[rows])) > 1 else None
    if not turned:
        return None
    if fit is None and turned.cost > scipy.special.chdtri(max(turned.redundancy, 1), _LEVEL):
        # Neither: nothing explains these image points.
        return None
    with_depth = float((_weights(problem)[rows] @ problem.misfits_at_start()[rows] ** 2).sum())
    m, p = (int(finite(part).sum()) for part in (turned.rotation, turned.direction))
    if turned.cost < with_depth:
        # The model with depth contains the other: its adjustment has not found its minimum.
        return None
    # Three shifts an image and a depth a point, less position and scale of the whole, and what they fit of
    # errors together where there is no base: the largest singular value of noise is √a + √b.
    unknowns = 3 * m + p - 4 + 2 * np.sqrt(3 * m * p)
    redundancy = turned.redundancy - (3 * m + p - 4)
    if redundancy < 1:
        return None
    gain = (turned.cost - with_depth) / (2 * with_depth / redundancy) - unknowns
    if gain > ODDS:
        return None
    turned = rotation_only(problem) or turned
    said = [
        f"{name} {measured(float(value), float(sigma), unit)}"
        for each in turned.cameras.values()
        for name, value, sigma, unit in zip(each.parameters, each.values, each.sigma, each.units, strict=True)
    ]
    return Failure(
        "all images are from one station: rotations of the camera alone predict the image points as well "
        f"(sigma0 {turned.sigma0:.3g}), so that points have no depth; take images from different places"
        + (f". With rotations alone: {', '.join(said)}" if said else ""),
        Code.ONE_STATION,
    )
