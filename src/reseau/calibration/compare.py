"""Differences of two calibrations of a camera over the image, with their significance.

Two calibrations are compared after the rotation that brings the rays of one nearest to those of the other
(Kogan, *mrcal*: differences with the implied transformation, for points at infinity); see
:mod:`reseau.calibration.camera` for the reason.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..core.data import Array, Mask
from ..core.display import Display
from ..core.errors import UsageError
from ..optics.poses import rotation_matrix
from .camera import CameraMapping, by_rotation, places, referred, worst

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Standard deviations, relative to the largest, that are rounding errors.
_RANK = 1e-6
_ROUNDS = 6
_ARROWS = 13
_SURE = 0.01
"""Level at which the difference at a single place is marked as significant."""


@dataclass(frozen=True, eq=False, repr=False)
class FieldDifference(Display):
    """Difference of two independent calibrations over the image.

    Parameters
    ----------
    xy : ndarray (rows, columns, 2)
        Places in the image of the first, pixels.
    difference : ndarray (rows, columns, 2)
        Image of the ray by the second minus its image by the first, px.
    cov : ndarray (rows, columns, 2, 2)
        Covariances of the differences.
    rotation : ndarray (3,)
        Rotation vector (rad) by which the rays of the second were rotated.
    statistic, degrees : float
        χ² of the whole field, and its degrees of freedom: as many independent differences have the same
        spread.
    dof : float
        Degrees of freedom of the covariances: their scale is an estimate.
    root : ndarray (rows * columns, 2, k), optional
        A root of the covariance of all differences together.
    weight : float
        Probability of the pair of models that are compared.
    by_others : tuple of (float, FieldDifference)
        Probabilities of other pairs of models, and the differences by them.

    Examples
    --------
    >>> one = np.array([[[[0.04, 0.0], [0.0, 0.04]]]])
    >>> found = FieldDifference(np.zeros((1, 1, 2)), np.full((1, 1, 2), 0.2), one, np.zeros(3), 2.0, 2)
    >>> found
    <FieldDifference: 0.28 px rms, 0.28 px at most, probability if it is one camera 0.37>
    >>> found.p_at.round(3)
    array([[0.368]])
    """

    xy: Array
    difference: Array
    cov: Array
    rotation: Array
    statistic: float
    degrees: float
    dof: float = float("inf")
    root: Array | None = None
    weight: float = 1.0
    by_others: tuple[tuple[float, FieldDifference], ...] = ()

    @property
    def size(self) -> Array:
        """Lengths (rows, columns) of the differences, px."""
        return np.asarray(np.hypot(*np.moveaxis(self.difference, 2, 0)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the lengths of the differences."""
        return float(np.sqrt(np.nanmean(self.size**2)))

    @property
    def greatest_px(self) -> float:
        """The longest difference."""
        return float(np.nanmax(self.size))

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (f"{self.rms_px:.2g} px rms", ""),
            (f"{self.greatest_px:.2g} px at most", ""),
            ("probability if it is one camera", f"{self.p:.2g}"),
        ]

    @property
    def sigma(self) -> Array:
        """Standard deviation in the worst direction (rows, columns), px."""
        return worst(self.cov)

    @property
    def p(self) -> float:
        """Probability of a difference at least as large when both are calibrations of the same camera.

        Where models of other kinds are possible, it is at least the mean over the pairs of models.
        """
        mean = self.weight * self.p_alone + sum(weight * each.p_alone for weight, each in self.by_others)
        return max(self.p_alone, mean)

    @property
    def p_alone(self) -> float:
        """The same by the models that were chosen."""
        return float(_tail(self.degrees, self.dof, np.array(self.statistic))) if self.degrees else 1.0

    @property
    def p_at(self) -> Array:
        """The same for each place alone (rows, columns); NaN where no ray is imaged."""
        known = np.isfinite(self.sigma)
        known[known] = np.linalg.det(self.cov[known]) > 0
        p = np.full(known.shape, np.nan)
        d = self.difference[known]
        square = np.einsum("ni,ni->n", d, np.linalg.solve(self.cov[known], d[:, :, None])[:, :, 0])
        p[known] = _tail(2, self.dof, square)
        others = [weight * np.nan_to_num(each.p_at) for weight, each in self.by_others]
        return np.maximum(p, self.weight * p + sum(others)) if others else p

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the differences, enlarged, over their standard deviation with matplotlib.

        Those that are significant at 1 % are in red.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        """
        from ..core.figures import ACCENT, INK, draw_arrows, draw_contours, image_axes, new_axes, nice

        axes = new_axes(axes)
        if np.nanmax(self.sigma) > 0:
            draw_contours(axes, self.xy, self.sigma)
        step = max(1, self.xy.shape[1] // _ARROWS)
        part = (slice(step // 2, None, step), slice(step // 2, None, step))
        xy, d = (values[part].reshape(-1, 2) for values in (self.xy, self.difference))
        p, size = self.p_at[part].ravel(), self.size[part].ravel()
        typical = float(np.nanquantile(size, 0.8))
        pitch = float(self.xy[0, step, 0] - self.xy[0, 0, 0])
        enlarged = nice(pitch / typical) if typical > 0 else 1.0
        for sure, colour in ((False, INK), (True, ACCENT)):
            chosen = np.isfinite(size) & ((p < _SURE) == sure)
            draw_arrows(axes, xy[chosen], enlarged * d[chosen], colour, 0.003, zorder=4)
        title = f"difference × {enlarged:g} over its σ / px; longest {np.nanmax(size):.2g} px"
        width, height = (self.xy[-1, -1] + 1).tolist()
        image_axes(axes, width, height, title)
        return axes


def calibration_difference(
    first: CameraMapping, second: CameraMapping, across: int = 25, down: int | None = None
) -> FieldDifference:
    """Difference of two independent calibrations as a field over the image, with its significance.

    Parameters
    ----------
    first, second : CameraMapping
        Calibrations of images of the same size; their models may differ.
    across, down : int
        Places along the axes, from edge to edge.

    Raises
    ------
    UsageError
        When the images differ in size, or no ray is imaged by both.

    Notes
    -----
    The test of the whole field is that of the mean square of the differences, each in relation to its
    variance. The parameters themselves are not compared: what many of them do together is known much better
    than each, and where they are hardly determined they are no linear functions of the image points.

    A calibration whose model was chosen is one of several, with their probabilities. What they differ in at
    each place is a part of the covariance, as if it were normal; where it is not, the probability of the
    difference is its mean over the pairs of models (Meng 1994, *Annals of Statistics* 22: posterior
    predictive p-values). The larger one counts: where only the choice of the model differs, the cameras need
    not.

    Examples
    --------
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 640, 480, np.array([0]), np.array([[0.25]]))
    >>> found = calibration_difference(camera, camera, 5)
    >>> bool(abs(found.difference).max() < 1e-9), round(found.p, 3)
    (True, 1.0)
    """
    pairs = [(p * q, one, two) for p, one in first.models for q, two in second.models]
    by_others = []
    for probability, one, two in pairs[1:]:
        # Models without rays in common are not those of one camera.
        with suppress(UsageError):
            by_others.append((probability, _difference(one, two, across, down)))
    found = _difference(first, second, across, down)
    return replace(found, weight=pairs[0][0], by_others=tuple(by_others))


def _difference(
    first: CameraMapping, second: CameraMapping, across: int, down: int | None
) -> FieldDifference:
    """The difference by one model of each."""
    if (first.width, first.height) != (second.width, second.height):
        raise UsageError(
            f"{first.width}×{first.height} and {second.width}×{second.height} pixels cannot be compared",
            where="calibrations",
        )
    parallel = first.mapping.parallel
    if second.mapping.parallel != parallel:
        raise UsageError("parallel and central rays cannot be compared", where="calibrations")
    xy, shape = places(first, across, down)
    uv = first.mapping.inverse(xy)
    known = np.isfinite(uv).all(axis=1) & np.isfinite(second.mapping(uv)).all(axis=1)
    rows, turn = np.flatnonzero(known), np.eye(3)
    weight = np.ones(len(xy))
    for k in range(_ROUNDS):
        # Rays near a right angle to the axis may be turned out of what the second can image.
        rows = rows[_ahead(turn, uv[rows])]
        if len(rows) < 2:
            raise UsageError("image no ray in common", where="calibrations")
        here = first.mapping.derivatives(uv[rows])
        turned, by_uv = _turned(turn, uv[rows])
        there = second.mapping.derivatives(turned)
        g = there.d_xy @ by_rotation(turned, parallel)
        off = there.value - xy[rows]
        if not (np.isfinite(g).all() and np.isfinite(off).all()):
            raise UsageError("do not image the same rays", where="calibrations")
        if k in (0, _ROUNDS - 1):
            own = np.concatenate([there.d_parameters[:, :, second.rows], second.by_models(turned)], axis=2)
            moved = np.concatenate([here.d_parameters[:, :, first.rows], first.by_models(uv[rows])], axis=2)
            carried = there.d_xy @ by_uv @ np.linalg.inv(here.d_xy) @ moved
            by_first, by_second = referred(g, carried, weight[rows]), referred(g, own, weight[rows])
            root = _joint_root(first, second, by_first, by_second)
        if k == 0 and root.size:
            # Places that are known better say more of the rotation.
            variance = np.einsum("gik,gik->g", root, root)
            weight[rows] = 1 / np.sqrt(np.maximum(variance, _RANK**2 * variance.max() or 1.0))
        each = np.repeat(weight[rows], 2)
        step = -np.linalg.lstsq(each[:, None] * g.reshape(-1, 3), each * off.ravel(), rcond=None)[0]
        turn = (_shifted(step) if parallel else rotation_matrix(step)) @ turn
    statistic, degrees = _statistic(root, off)
    difference, cov = np.full((len(xy), 2), np.nan), np.full((len(xy), 2, 2), np.nan)
    difference[rows], cov[rows] = off, root @ np.swapaxes(root, 1, 2)
    every = np.full((len(xy), *root.shape[1:]), np.nan)
    every[rows] = root
    # The camera is rotated in the opposite sense to its rays.
    angle = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    if parallel:
        angle[:2] = 0.0
    return FieldDifference(
        xy.reshape(*shape, 2), difference.reshape(*shape, 2), cov.reshape(*shape, 2, 2), angle, statistic,
        degrees, _joint_dof(first, second, by_first, by_second), every,
    )  # fmt: skip


def _tail(degrees: float, dof: float, statistic: Array) -> Array:
    """Probability of a larger sum of squares, by estimated variances of so many degrees of freedom."""
    if not np.isfinite(dof):
        return np.asarray(scipy.special.chdtrc(degrees, statistic))
    return np.asarray(scipy.special.fdtrc(degrees, dof, statistic / degrees))


def _joint_dof(first: CameraMapping, second: CameraMapping, by_first: Array, by_second: Array) -> float:
    """Degrees of freedom of the sum of two covariances (Satterthwaite 1946), of their traces over the
    field."""
    parts = [
        float(np.einsum("nij,jk,nik->", by, lens.parameter_covariance, by))
        for by, lens in ((by_first, first), (by_second, second))
    ]
    spread = sum(part**2 / lens.dof for part, lens in zip(parts, (first, second), strict=True))
    return sum(parts) ** 2 / spread if spread > 0 else float("inf")


def _joint_root(first: CameraMapping, second: CameraMapping, by_first: Array, by_second: Array) -> Array:
    """A root (g, 2, k) of the covariance of the differences."""
    if type(first.mapping) is type(second.mapping) and first.names == second.names:
        # Derivatives at two estimates differ by their errors, which must not add dimensions of their own.
        u = len(first.rows)
        mean = (by_first[:, :, :u] + by_second[:, :, :u]) / 2
        parts = [mean @ _root(first.within + second.within), by_first[:, :, u:], by_second[:, :, u:]]
    else:
        parts = [by_first @ _root(first.parameter_covariance), by_second @ _root(second.parameter_covariance)]
    return np.concatenate(parts, axis=2)


def _shifted(step: NDArray[Any]) -> Array:
    """Shift and rotation of a plane, for homogeneous coordinates (3, 3)."""
    c, s = np.cos(step[2]), np.sin(step[2])
    return np.array([[c, -s, step[0]], [s, c, step[1]], [0.0, 0.0, 1.0]])


def _ahead(turn: Array, uv: Array) -> Mask:
    """Whether rays stay in front of the camera when they are turned."""
    return np.asarray(uv @ turn[2, :2] + turn[2, 2] > 0)


def _turned(turn: Array, uv: Array) -> tuple[Array, Array]:
    """Directions of turned rays (n, 2), and their derivatives by the directions before (n, 2, 2)."""
    ray = np.column_stack([uv, np.ones(len(uv))]) @ turn.T
    turned = ray[:, :2] / ray[:, 2:]
    slope = (turn[:2, :2] - turned[:, :, None] * turn[2, :2]) / ray[:, 2, None, None]
    return turned, slope


def _root(covariance: Array) -> Array:
    """A root L (u, k) with C = L Lᵀ, of a covariance that may be singular."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    root: Array = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _statistic(root: Array, off: Array) -> tuple[float, float]:
    """χ² of differences (g, 2) with a root of their covariance (g, 2, k), and its degrees of freedom.

    The mean of the squares, each in relation to the variance at its place, is a sum of squares of normal
    deviates with weights; it is compared with the χ² of the same mean and variance (Box 1954, theorem 3.1).
    """
    variance = np.einsum("gik,gik->g", root, root)
    known = variance > _RANK**2 * variance.max(initial=0.0)
    if not known.any():
        return 0.0, 0.0
    size = np.sqrt(known.sum() * variance[known])
    mean = float((off[known] ** 2 / size[:, None] ** 2).sum())
    one = (root[known] / size[:, None, None]).reshape(-1, root.shape[2])
    degrees = 1.0 / float((np.linalg.norm(one.T @ one)) ** 2)
    return degrees * mean, degrees
