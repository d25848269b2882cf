"""How well a camera predicts images that are left out, for all subsets of its parameters at once.

With the unknowns other than those of the camera eliminated, R = I − A Q Aᵀ, and K the derivatives of the
image coordinates by the parameters of the camera (all weighted), the normal equations of a subset S of the
parameters are N = Kᵀ R K, g = Kᵀ v. An image with the rows B adds T = K̃ᵀ (R_BB)⁻¹ K̃, t = K̃ᵀ (R_BB)⁻¹ v_B,
with K̃ = (R K)_B, to what all others tell of the camera: without it they are N − T and g − t, also where
points of the target are unknown and the same for all images. With x = N⁻¹ g, what is left of the image is d =
v_B − K̃ x, and its predicted coordinates differ from the measured ones by R_BB⁻¹-weighted squares and a
density of

    q = |d|² + (t − T x)ᵀ (N − T)⁻¹ (t − T x),    ln p = −q / 2ω + ½ ln det(N − T) − ½ ln det N + const

(Förstner & Wrobel 2016, sect. 4.6; Cook & Weisberg 1982, Residuals and Influence in Regression, ch. 2–3). No
adjustment is repeated, and all subsets of the parameters use the same sums. ω is the variance factor of what
images tell of the camera: images that differ in more than noise (the paper, a motion, the focus) contradict
each other in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...core.threads import one_thread
from ...optics.cameras.registry import camera_model
from ..network.camera import Camera
from ..solver.linear import Linear
from ..solver.normal import SEGMENTS
from ..solver.problem import BundleFit, BundleProblem
from .determined import whole_camera

# Variance that is added to directions which an image alone determines, relative to that of its coordinates:
# they predict nothing, and the same for all cameras.
_NOTHING = 1e-6
# Eigenvalues of scaled normal equations that belong to combinations without effect; information of one image,
# relative to that of all, without which the others know nothing.
_RANK, _ALONE = 1e-11, 1e-9


@dataclass(frozen=True, eq=False)
class Prediction:
    """Images that are left out, predicted by the others.

    Parameters
    ----------
    log_det : ndarray (m,)
        Logarithm of the density of the coordinates of each image that is predicted without an error, without
        terms that all cameras share.
    squares : ndarray (m,)
        Sum of squares of the predicted coordinates of each image, in their standard deviations without the
        variance factor: what vᵀPv of the other images is smaller.
    cost : float
        vᵀPv of all images.
    parameters : float
        Parameters that the images determine, without what is only regularised.
    variance : float
        ω: the variance of unit weight, or that of what images tell of the camera, if it is larger.
    determined : bool
        Whether the images determine all free parameters.
    values, covariance : ndarray (u,), (u, u)
        Estimates of all parameters, those that are not free zero; with this variance factor.
    """

    log_det: Array
    squares: Array
    cost: float
    parameters: float
    variance: float
    determined: bool
    values: Array
    covariance: Array

    def log_density(self, variance: float) -> Array:
        """Logarithm of the density of each image (m,), with a variance factor."""
        return self.log_det - self.squares / (2 * variance)

    def richer(self, other: Prediction) -> Prediction:
        """The one of both whose camera has more parameters."""
        return max(self, other, key=lambda one: one.parameters)

    def better(self, other: Prediction) -> float:
        """Logarithm of how much better than another it predicts, as far as images agree in that.

        Images contradict each other in what only the camera with more parameters has: its variance factor
        counts. With a gain G = χ²/2, what an image tells has the variance χ² altogether; images that are
        predicted worse show how large it is, and χ² is smaller by the same factor: G² / Σ (d < 0) d².
        """
        variance = self.richer(other).variance
        each = self.log_density(variance) - other.log_density(variance)
        gain, worse = float(each.sum()), float((np.minimum(each, 0.0) ** 2).sum())
        return min(gain, gain**2 / worse) if gain > 0 and worse > 0 else gain


@dataclass(frozen=True, eq=False)
class Information:
    """What each image tells of the parameters of a camera.

    Parameters
    ----------
    names : tuple of str (u,)
        Parameters.
    values : ndarray (u,)
        Their values where the network was linearised.
    free : tuple of str
        Those that were estimated there.
    normal, side : ndarray (u, u), (u,)
        N and g of all images, and of observed parameters.
    own, own_side, square : ndarray (m, u, u), (m, u), (m,)
        T, t and vᵀR⁻¹v of each image.
    offset : ndarray (m,)
        ½ ln det R of each image.
    cost, redundancy : float
        vᵀPv, and redundancy without the parameters of the camera.
    weight : ndarray (u,)
        Weights of observed parameters, which are part of `normal`.
    count : int
        Image coordinates of the camera.
    """

    names: tuple[str, ...]
    values: Array
    free: tuple[str, ...]
    normal: Array
    side: Array
    own: Array
    own_side: Array
    square: Array
    offset: Array
    cost: float
    redundancy: float
    weight: Array
    count: int

    @cached_property
    def noise(self) -> float:
        """Variance of unit weight, where everything that images have in common is estimated."""
        basis = self._basis(self.names)
        left = self.redundancy - basis.shape[1]
        return (self.cost - float(((basis.T @ self.side) ** 2).sum())) / left if left >= 1 else 1.0

    def predicted(self, free: Sequence[str]) -> Prediction:
        """Predict each image from the others with these parameters free.

        Others that were estimated are zero, and those that were not are as they were. With G = R_BB^(−½) K̃,
        an image contradicts the estimates by s = Gᵀd with the cofactors T − T N⁻¹ T; sᵀ(T − T N⁻¹ T)⁺s is its
        χ² of as many degrees of freedom as there are parameters.
        """
        moved = np.where(self._at(self.free) & ~self._at(free), -self.values, 0.0)
        basis = self._basis(free)
        cost, side, own_side, square = self._moved(moved)
        x = basis.T @ side
        own, along = basis.T @ self.own @ basis, own_side @ basis
        left = along - own @ x
        residual = square - 2 * along @ x + np.einsum("i,mij,j->m", x, own, x)
        tau, turn = np.linalg.eigh(own)
        alone = np.maximum(1 - tau, _ALONE)
        contradiction = np.einsum("mji,mj->mi", turn, left) ** 2
        q = residual + (contradiction / alone).sum(axis=1)
        known = (tau > _RANK**0.5) & (tau < 1 - _RANK**0.5)
        variance = self.noise
        if known.any():
            # By the sums: what images share that tell much is much larger beside their noise.
            variance = max(variance, float(contradiction[known].sum() / (tau * (1 - tau))[known].sum()))
        found = basis @ basis.T
        return Prediction(
            self.offset + 0.5 * np.log(alone).sum(axis=1), q, cost - float(x @ x),
            basis.shape[1] - float(self.weight @ np.diag(found)), variance,
            basis.shape[1] == int(self._at(free).sum()), self.values + moved + basis @ x, variance * found,
        )  # fmt: skip

    def _at(self, free: Sequence[str]) -> Mask:
        return np.array([name in free for name in self.names], dtype=bool)

    def _basis(self, free: Sequence[str]) -> Array:
        """Combinations (u, k) of the parameters with unit normal equations."""
        at = self._at(free)
        scale = 1 / np.sqrt(np.maximum(np.diag(self.normal), np.finfo(float).tiny))
        some = np.ix_(at, at)
        values, vectors = np.linalg.eigh((self.normal * np.outer(scale, scale))[some])
        keep = values > _RANK * max(float(values[-1:].sum()), 1.0)
        basis = np.zeros((len(at), int(keep.sum())))
        basis[at] = scale[at, None] * vectors[:, keep] / np.sqrt(values[keep])
        return basis

    def _moved(self, moved: Array) -> tuple[float, Array, Array, Array]:
        """Cost, g, t and squares where the parameters have been changed."""
        own = self.own @ moved
        return (
            self.cost - 2 * float(self.side @ moved) + float(moved @ self.normal @ moved),
            self.side - self.normal @ moved,
            self.own_side - own,
            self.square - 2 * self.own_side @ moved + own @ moved,
        )


def information_of(
    fit: BundleFit, camera: int = 0, model: str | None = None, views: Rows | None = None
) -> Information | None:
    """Return what each image tells of the parameters of a camera, where the adjustment ended.

    Parameters
    ----------
    fit : BundleFit
        Adjustment.
    camera : int
        Row of the camera.
    model : str, optional
        Model of the parameters, of which that of the camera is a part, with the same order of parameters.
    views : ndarray of int (m,), optional
        View of each image (see :mod:`~reseau.bundle.diagnostics.views`); images of one view count as one.

    Returns
    -------
    Information or None
        None where the rest of the network is not determined.
    """
    given = fit.problem.network.cameras[camera]
    wanted = camera_model(model or given.model)
    values = np.zeros(len(wanted.names))
    values[: len(given.values)] = fit.values.cameras[camera, : len(given.values)]
    names, free, prior = wanted.names, given.free, wanted.priors(given.free)
    held = replace(given, values=values[: len(given.values)], free=(), sigma={}, covariance=None)
    every = replace(given, model=wanted.name, values=values, free=wanted.names, sigma={}, covariance=None)
    if given.additional is not None:
        whole = whole_camera(fit, camera)
        held = replace(
            held, model="mapping", mapping=whole, values=np.array(whole.values), options={}, additional=None
        )
        names, free = (*names, *given.additional.names), (*free, *given.additional.names)
        values = np.concatenate([values, fit.values.extra[0, : len(given.additional.names)]])
    rest = with_camera(fit, camera, held).adjusted()
    if not isinstance(rest, BundleFit) or not rest.cofactors.reduced.known:
        return None
    slopes = _slopes(with_camera(fit, camera, every).linearised(), camera, len(names))
    with one_thread():
        others = _Others.of(rest)
        columns = others.eliminated(slopes)
        network = rest.unknowns.network
        of = network.image_of[rest.unknowns.order]
        own = (network.camera_of == camera) & rest.usable.images
        view = np.where(own, np.arange(len(own)) if views is None else views, -1)[of]
        try:
            several = [np.flatnonzero(view == k) for k in np.unique(view[view >= 0])]
            parts = [others.image(rows, columns[rows]) for rows in several]
        except np.linalg.LinAlgError:
            # Rounding: the rest is hardly determined.
            return None
    own, own_side, square, offset = (np.array(part) for part in zip(*parts, strict=True))
    weight = np.array([1 / prior[name] ** 2 if name in prior else 0.0 for name in names])
    return Information(
        names, values, free, np.einsum("nri,nrj->ij", slopes, columns) + np.diag(weight),
        np.einsum("nri,nr->i", slopes, others.misfits) - weight * values, own, own_side, square, offset,
        rest.cost + float(weight @ values**2), float(rest.redundancy + (weight > 0).sum()), weight,
        2 * int((network.camera_of[of] == camera).sum()),
    )  # fmt: skip


def with_camera(fit: BundleFit, camera: int, own: Camera, values: Array | None = None) -> BundleProblem:
    """Return the problem of an adjustment, from its estimates, with another camera in place of one."""
    problem = fit.problem.continued(fit)
    cameras = list(problem.network.cameras)
    cameras[camera] = own
    every = np.zeros((len(cameras), max(len(each.values) for each in cameras)))
    for c, each in enumerate(problem.network.cameras):
        begun = fit.values.cameras[c, : len(each.values)]
        if c == camera:
            begun = own.values if values is None else values
        every[c, : len(begun)] = begun
    extra = np.zeros((1, 0)) if own.additional is None else fit.values.extra
    if own.additional is not None and extra.shape[1] != len(own.additional.names):
        extra = np.zeros((1, len(own.additional.names)))
    start = replace(problem.start, cameras=every, extra=extra)
    found = replace(
        problem, network=replace(problem.network, cameras=tuple(cameras)), start=start, rounds=0, watch=None
    )
    if problem.weights is None or len(found.observations) == len(problem.observations):
        return found
    # Observed parameters are used, or not there.
    n, weights = 2 * len(problem.network.xy), np.ones(len(found.observations))
    weights[:n] = problem.weights[:n]
    return found.with_weights(weights)


def _slopes(linear: Linear, camera: int, count: int) -> Array:
    """Weighted derivatives (n, 2, u) of the image coordinates by the parameters of a camera."""
    unknowns, own = linear.system.unknowns, linear.system.seen.camera == camera
    width = unknowns.count[camera]
    last = linear.rows.shape[2] - 3
    columns = np.r_[6 : 6 + width, last - (count - width) : last]
    return np.where(own[:, None, None], linear.rows[:, :, columns], 0.0)


@dataclass(frozen=True, eq=False)
class _Others:
    """A network in which a camera is held, linearised; its points are eliminated.

    Parameters
    ----------
    misfits : ndarray (n, 2)
        Weighted coordinates, measured less computed, in the order of points.
    by_points : sparse array (2n, 3p)
        Derivatives by the eliminated points.
    points : sparse array (3p, 3p)
        Inverse of their normal equations.
    rows, cofactors : ndarray (2n, u), (u, 2n)
        Derivatives by the other unknowns, reduced by the points, and their product with the cofactors.
    """

    misfits: Array
    by_points: scipy.sparse.csr_array
    points: scipy.sparse.bsr_array
    rows: Array
    cofactors: Array

    @classmethod
    def of(cls, fit: BundleFit) -> _Others:
        """Create it from the adjustment with the camera held."""
        linear, cofactors = fit.linear, fit.cofactors
        pattern, n = linear.system.pattern, len(linear.rows)
        plain = np.zeros((n, 2, fit.unknowns.size))
        for s in range(SEGMENTS):
            width, start, first = pattern.width[:, s], pattern.start[:, s], pattern.column[:, s]
            for i in range(int(width.max(initial=0))):
                k = np.flatnonzero(width > i)
                plain[k, :, start[k] + i] = linear.rows[k, :, first[k] + i]
        count, point = len(cofactors.normal.inverse), linear.system.seen.point
        k = np.flatnonzero(pattern.eliminated[point] == 1)
        row = 2 * k[:, None, None] + np.arange(2)[:, None] + np.zeros(3, dtype=np.intp)
        column = 3 * point[k, None, None] + np.arange(3) + np.zeros((2, 1), dtype=np.intp)
        at = (row.ravel(), column.ravel())
        value = linear.rows[k, :, linear.rows.shape[2] - 3 :].ravel()
        by_points = scipy.sparse.coo_array((value, at), shape=(2 * n, 3 * count)).tocsr()
        points = scipy.sparse.bsr_array((cofactors.normal.inverse, np.arange(count), np.arange(count + 1)))
        rows = plain.reshape(2 * n, -1)
        rows = rows - by_points @ (points @ (by_points.T @ rows))
        z = cofactors.reduced if cofactors.referral is None else cofactors.referral.before
        return cls(-linear.misfits, by_points, points, rows, z.times(rows.T))

    def eliminated(self, slopes: Array) -> Array:
        """R K (n, 2, u) of derivatives K by other unknowns."""
        plain = slopes.reshape(len(self.rows), -1)
        left = plain - self.by_points @ (self.points @ (self.by_points.T @ plain))
        return np.asarray(left - self.cofactors.T @ (self.rows.T @ plain)).reshape(slopes.shape)

    def image(self, rays: Rows, columns: Array) -> tuple[Array, Array, float, float]:
        """T, t, vᵀR⁻¹v and ½ ln det R of an image with these rays, from its rows of R K."""
        rows = (2 * rays[:, None] + np.arange(2)).ravel()
        own = self.by_points[rows]
        left = np.eye(len(rows)) * (1 + _NOTHING) - (own @ (self.points @ own.T)).toarray()
        left -= self.rows[rows] @ self.cofactors[:, rows]
        root = scipy.linalg.cholesky(left, lower=True)
        known = np.column_stack([columns.reshape(len(rows), -1), self.misfits[rays].ravel()])
        known = scipy.linalg.solve_triangular(root, known, lower=True)
        g, h = known[:, :-1], known[:, -1]
        return g.T @ g, g.T @ h, float(h @ h), float(np.log(np.diag(root)).sum())
