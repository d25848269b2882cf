"""Cameras in space: rotations, poses, and the image of object points with all derivatives.

A pose maps object to camera, x_c = R(X − X0); camera axes x right, y down, z along the view. Rotations are
rotation vectors r, R = exp([r]×); the angles omega, phi, kappa are for reports.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array
from ..core.errors import UsageError
from .mapping import PlaneMapping

# From the camera of the angles (y up, z backwards, as in a vertical photograph) to that used here.
_VIEW = np.diag([1.0, -1.0, -1.0])
# Below this angle the series of (θ − sin θ)/θ³ is more exact than the formula, which cancels.
_SMALL_ANGLE = 0.5


def cross_matrix(vectors: Array) -> Array:
    """Matrices [v]× (..., 3, 3) of vectors (..., 3): [v]× w = v × w.

    Examples
    --------
    >>> (cross_matrix(np.array([0.0, 0.0, 1.0])) @ [1.0, 0.0, 0.0]).tolist()
    [0.0, 1.0, 0.0]
    """
    matrix = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


def _sines(theta: Array) -> tuple[Array, Array]:
    """sin θ/θ and (1 − cos θ)/θ², exact at θ → 0."""
    half = 0.5 * np.where(theta == 0, 1e-20, theta)
    b = np.sin(half) / half
    return b * np.cos(half), 0.5 * b**2


def _third(theta: Array) -> Array:
    """(θ − sin θ)/θ³, exact at θ → 0."""
    square = np.minimum(theta, _SMALL_ANGLE) ** 2
    series = np.zeros_like(theta)
    # 1/3! − θ²/5! + θ⁴/7! …; at 0.5 rad the next term is below 1e-19.
    for factor in (14 * 15, 12 * 13, 10 * 11, 8 * 9, 6 * 7, 4 * 5):
        series = (1 - series) * square / factor
    small = theta < _SMALL_ANGLE
    return np.where(small, (1 - series) / 6, (theta - np.sin(theta)) / np.where(small, 1.0, theta) ** 3)


def rotation_matrix(r: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula.

    Examples
    --------
    >>> rotation_matrix([0.0, 0.0, np.pi / 2]).round(6) + 0.0
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    vectors = np.asarray(r, dtype=np.float64)
    theta = np.linalg.norm(vectors, axis=-1)[..., None, None]
    a, b = _sines(theta)
    k = cross_matrix(vectors)
    return np.eye(3) + a * k + b * (k @ k)


def rotate(r: ArrayLike, vectors: ArrayLike) -> tuple[Array, Array]:
    """R(r)·x and its derivative with respect to the rotation vector.

    ∂(R x)/∂r = −R [x]× (I − (1−cos θ)/θ² [r]× + (θ−sin θ)/θ³ [r]×²), exact at r → 0 too (the right Jacobian
    of the rotation group; Gallego & Yezzi 2015, A compact formula for the derivative of a 3-D rotation in
    exponential coordinates, J. Math. Imaging and Vision 51).

    Parameters
    ----------
    r : array_like (3,) or (n, 3)
        Rotation vectors.
    vectors : array_like (n, 3)
        Vectors to rotate.

    Returns
    -------
    ndarray (n, 3), ndarray (n, 3, 3)
        The rotated vectors and the derivatives.

    Examples
    --------
    >>> value, slope = rotate([0.0, 0.0, np.pi / 2], [[1.0, 0.0, 0.0]])
    >>> value.round(6) + 0.0, slope.shape
    (array([[0., 1., 0.]]), (1, 3, 3))
    """
    rotation, x = np.asarray(r, dtype=np.float64), np.asarray(vectors, dtype=np.float64)
    theta = np.linalg.norm(rotation, axis=-1)[..., None, None]
    b, c = _sines(theta)[1], _third(theta)
    k = cross_matrix(rotation)
    jacobian = np.eye(3) - b * k + c * (k @ k)
    matrix = rotation_matrix(rotation)
    value: Array = (matrix @ x[..., None])[..., 0]
    return value, -matrix @ cross_matrix(x) @ jacobian


def matrix_to_vector(matrix: ArrayLike) -> Array:
    """Rotation vectors (..., 3), at most π long, of rotation matrices (..., 3, 3).

    Raises
    ------
    UsageError
        When a matrix is not a rotation within 1e-6.

    Examples
    --------
    >>> matrix_to_vector(rotation_matrix([0.1, -0.2, 0.3])).round(6)
    array([ 0.1, -0.2,  0.3])
    """
    matrices = np.asarray(matrix, dtype=np.float64)
    flat = matrices.reshape(-1, 3, 3)
    orthogonal = np.abs(flat @ flat.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0) < 1e-6
    if not orthogonal or (np.linalg.det(flat) < 0).any():
        raise UsageError("is not orthogonal with determinant +1", where="rotation matrix")
    quaternion = quaternions(flat)
    w, v = quaternion[:, :1], quaternion[:, 1:]
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    # θ/sin(θ/2), which is 2 at θ = 0; arctan2 keeps it exact up to π.
    factor = np.where(sine > 1e-9, 2 * np.arctan2(sine, w) / np.where(sine > 0, sine, 1.0), 2.0)
    return (factor * v).reshape(matrices.shape[:-1])


def quaternions(matrix: Array) -> Array:
    """Unit quaternions (n, 4), scalar first and not negative, of rotation matrices (n, 3, 3).

    Examples
    --------
    >>> quaternions(np.eye(3)[None])
    array([[1., 0., 0., 0.]])

    Notes
    -----
    All four columns of the outer product q·qᵀ follow from the matrix; the one with the largest diagonal is
    free of cancellation (Shepperd 1978, Quaternion from rotation matrix, J. Guidance and Control 1).
    """
    m = matrix.transpose(1, 2, 0)
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    diagonal = 1 + signs @ np.stack([m[0, 0], m[1, 1], m[2, 2]])
    columns = np.array(
        [
            [diagonal[0], x, y, z],
            [x, diagonal[1], xy, xz],
            [y, xy, diagonal[2], yz],
            [z, xz, yz, diagonal[3]],
        ]
    )
    q: Array = columns[diagonal.argmax(axis=0), :, np.arange(len(matrix))]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(q[:, :1] < 0, -q, q)


def angles_to_matrix(omega: ArrayLike, phi: ArrayLike, kappa: ArrayLike) -> Array:
    """R = diag(1, −1, −1)·R3(κ)·R2(φ)·R1(ω), rotations of the axes; angles in radians.

    With all angles zero the camera looks down along −Z, x to the right and Y up in the image: the vertical
    photograph of aerial photogrammetry (Kraus, Photogrammetry; Mikhail, Bethel, McGlone, Introduction to
    Modern Photogrammetry). The factor turns that camera (y up, z backwards) into the one used here.

    Parameters
    ----------
    omega, phi, kappa : array_like (...)
        Angles of the same shape.

    Returns
    -------
    ndarray (..., 3, 3)
        Rotation matrices from object to camera.

    Examples
    --------
    >>> angles_to_matrix(0.0, 0.0, 0.0) + 0.0
    array([[ 1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0., -1.]])
    """
    w, p, k = np.broadcast_arrays(*(np.asarray(angle, dtype=np.float64) for angle in (omega, phi, kappa)))
    sw, cw, sp, cp, sk, ck = np.sin(w), np.cos(w), np.sin(p), np.cos(p), np.sin(k), np.cos(k)
    rows = [
        [cp * ck, cw * sk + sw * sp * ck, sw * sk - cw * sp * ck],
        [-cp * sk, cw * ck - sw * sp * sk, sw * ck + cw * sp * sk],
        [sp, -sw * cp, cw * cp],
    ]
    matrix: Array = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return _VIEW @ matrix


def matrix_to_angles(matrix: ArrayLike) -> Array:
    """Omega, phi, kappa (..., 3) in radians of matrices (..., 3, 3); see :func:`angles_to_matrix`.

    At φ = ±90° only a combination of ω and κ is determined: κ is set to zero.

    Examples
    --------
    >>> matrix_to_angles(angles_to_matrix(0.1, -0.2, 0.3)).round(6)
    array([ 0.1, -0.2,  0.3])
    """
    m = _VIEW @ np.asarray(matrix, dtype=np.float64)
    cos_phi = np.hypot(m[..., 0, 0], m[..., 1, 0])
    locked = cos_phi < 1e-12
    phi = np.arctan2(m[..., 2, 0], cos_phi)
    omega = np.where(locked, np.arctan2(m[..., 1, 2], m[..., 1, 1]), np.arctan2(-m[..., 2, 1], m[..., 2, 2]))
    kappa = np.where(locked, 0.0, np.arctan2(-m[..., 1, 0], m[..., 0, 0]))
    return np.stack([omega, phi, kappa], axis=-1)


@dataclass(frozen=True, eq=False)
class Pose:
    """Positions and rotations of cameras: x_c = R(X − X0).

    Parameters
    ----------
    rotation : ndarray (3,) or (n, 3)
        Rotation vectors of R, radians.
    x0 : ndarray (3,) or (n, 3)
        Projection centres, in the unit of object space.

    Examples
    --------
    >>> pose = Pose.from_angles(0.0, 0.0, 0.0, [0.0, 0.0, 1000.0])
    >>> pose([[100.0, 50.0, 0.0]]).round(6).tolist()
    [[100.0, -50.0, 1000.0]]
    """

    rotation: Array
    x0: Array

    def __post_init__(self) -> None:
        for name in ("rotation", "x0"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.ndim not in (1, 2) or array.shape[-1] != 3:
                raise UsageError(
                    f"has the shape {array.shape}, not (3,) or (n, 3)", where=f"{name} of a pose"
                )
            object.__setattr__(self, name, array)

    @classmethod
    def from_angles(cls, omega: ArrayLike, phi: ArrayLike, kappa: ArrayLike, x0: ArrayLike) -> Self:
        """A pose by its angles in radians; see :func:`angles_to_matrix`."""
        return cls(matrix_to_vector(angles_to_matrix(omega, phi, kappa)), np.asarray(x0, dtype=np.float64))

    @property
    def matrix(self) -> Array:
        """R, (3, 3) or (n, 3, 3)."""
        return rotation_matrix(self.rotation)

    @property
    def angles(self) -> Array:
        """Omega, phi, kappa in radians, (3,) or (n, 3)."""
        return matrix_to_angles(self.matrix)

    def __call__(self, points: ArrayLike) -> Array:
        """Object points (n, 3) in the systems of the cameras, (n, 3)."""
        return rotate(self.rotation, np.asarray(points, dtype=np.float64) - self.x0)[0]


class Projection(NamedTuple):
    """Image points and their derivatives.

    Parameters
    ----------
    xy : ndarray (n, 2)
        Image points; NaN for a point that is not in front of its camera.
    d_pose : ndarray (n, 2, 6)
        Derivatives with respect to rotation vector and projection centre.
    d_point : ndarray (n, 2, 3)
        Derivatives with respect to the object point.
    d_camera : ndarray (n, 2, u)
        Derivatives with respect to the camera's parameters.

    Examples
    --------
    See :func:`project`:

    >>> from reseau.optics.composition import Similarity
    >>> seen = project(Similarity(), Pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]), [[1.0, 2.0, -4.0]])
    >>> isinstance(seen, Projection), bool(np.isnan(seen.xy).all())
    (True, True)
    """

    xy: Array
    d_pose: Array
    d_point: Array
    d_camera: Array


def seen_by(camera: PlaneMapping, points: Array) -> tuple[Array, Array, Array]:
    """Image points (n, 2) of points (n, 3) in the system of the camera, before or behind it.

    Besides, the derivatives by these (n, 2, 3), and by the parameters of the camera (n, 2, u).
    """
    parallel = getattr(camera, "parallel", False)
    z = np.ones(len(points)) if parallel else points[:, 2]
    direction = points[:, :2] / z[:, None]
    xy, d_direction, d_camera = camera.derivatives(direction)
    by_points = np.zeros((len(z), 2, 3))
    by_points[:, :, :2] = d_direction / z[:, None, None]
    if not parallel:
        by_points[:, :, 2] = -(by_points[:, :, :2] @ direction[:, :, None])[:, :, 0]
    return xy, by_points, d_camera


def project(camera: PlaneMapping, pose: Pose, points: ArrayLike) -> Projection:
    """Image points of object points: the collinearity equations with the camera's distortion.

    Parameters
    ----------
    camera : PlaneMapping
        From ideal directions to the image; from xc, yc where its rays are parallel.
    pose : Pose
        One for all points, or one for each.
    points : array_like (n, 3)
        Object points.

    Returns
    -------
    Projection
        Image points and derivatives, NaN where a point is not in front of its camera; parallel rays have no
        such side.

    Examples
    --------
    >>> from reseau.optics.composition import Similarity
    >>> seen = project(Similarity(), Pose([0.0, 0.0, 0.0], [0.0, 0.0, -6.0]), [[1.0, 2.0, 4.0]])
    >>> seen.xy, seen.d_pose.shape, seen.d_point.shape, seen.d_camera.shape
    (array([[0.1, 0.2]]), (1, 2, 6), (1, 2, 3), (1, 2, 4))
    """
    object_points = np.asarray(points, dtype=np.float64)
    if object_points.ndim != 2 or object_points.shape[1] != 3:
        raise UsageError(f"object points have the shape {object_points.shape}, not (n, 3)")
    x_c, d_rotation = rotate(pose.rotation, object_points - pose.x0)
    if not getattr(camera, "parallel", False):
        x_c[x_c[:, 2] <= 0] = np.nan
    xy, d_x_c, d_camera = seen_by(camera, x_c)
    d_point = d_x_c @ pose.matrix
    # The parameters of a camera that sees no points must not appear determined.
    d_camera[np.isnan(xy).any(axis=1)] = np.nan
    return Projection(xy, np.concatenate([d_x_c @ d_rotation, -d_point], axis=2), d_point, d_camera)
