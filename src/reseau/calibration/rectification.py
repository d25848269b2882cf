"""Rectified images of two cameras that are fixed to each other: an object point is in the same row of both.

The axes of the rectified cameras are the base and, across it, the mean of both optical axes (Fusiello, Trucco
& Verri 2000, *Machine Vision and Applications* 12). With v = y/z in these axes, e₂ and e₃ the directions of
rows and depth, and the ray r of a camera,

    dv = (e₂ − v e₃)·dr / (e₃·r),

to which an error db of the base adds (−e₂ + v e₃)·db / z for points at the depth z: by it, the errors of both
lenses and of the relative orientation become a difference of rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Mask
from ..core.display import Display
from ..core.errors import UsageError
from .camera import CameraMapping

_ACROSS, _RIM = 13, 65
"""Places across the rectified image for its errors; places along each side of an image that is looked at."""
_LARGEST = 1.5
"""Largest side of a rectified image, by that of the images."""
_AHEAD = 0.1
"""Least cosine of a ray to the axis of the rectified cameras."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two cameras that are fixed to each other.

    Parameters
    ----------
    lenses : (CameraMapping, CameraMapping)
        The first is the reference.
    rotation : ndarray (3, 3)
        From the axes of the first to those of the second.
    base : ndarray (3,)
        Projection centre of the second in the axes of the first.
    unit : str
        Unit of the base.
    covariance : ndarray (k + 6, k + 6)
        Of the estimated parameters of both lenses, of a small rotation about the axes of the second (rad),
        and of the base, together.

    Examples
    --------
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5})
    >>> camera = CameraMapping(lens, 640, 480, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
    >>> cov = np.diag([1e-8, 1e-8, 1e-8, 0.01, 0.01, 0.01])
    >>> pair = Pair((camera, camera), np.eye(3), np.array([100.0, 0.0, 0.0]), "mm", cov)
    >>> found = rectified(pair, 1000.0)
    >>> found
    <Rectification: 640 × 480 px, rows differ by 0.12 px at most (σ), both cameras see 100 % of it>
    """

    lenses: tuple[CameraMapping, CameraMapping]
    rotation: Array
    base: Array
    unit: str
    covariance: Array


@dataclass(frozen=True, eq=False, repr=False)
class Rectification(Display):
    """Rectified images of two cameras.

    Parameters
    ----------
    rotations : ndarray (2, 3, 3)
        From the axes of each camera to those of the rectified ones.
    matrix : ndarray (3, 3)
        Camera matrix of both rectified images, px.
    base : ndarray (3,)
        Projection centre of the second rectified camera in the axes of the first: along x, or along y where
        one camera is above the other.
    maps : ndarray (2, h, w, 2), float32
        Where the pixels of both rectified images are in the images, as ``cv2.remap`` takes it; NaN where a
        camera has no image.
    sigma : ndarray (rows, columns)
        Standard deviation of the difference of rows over the image (of columns, with one camera above the
        other), px; NaN where one camera has no image.
    distance : float
        Depth of the points for which that is so.
    unit : str
        Unit of base and depth.

    Examples
    --------
    See :class:`Pair`.
    """

    rotations: Array
    matrix: Array
    base: Array
    maps: NDArray[np.float32]
    sigma: Array
    distance: float
    unit: str

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.maps.shape[2], self.maps.shape[1]

    @property
    def common(self) -> Mask:
        """Pixels (h, w) that both cameras have, of points far away."""
        return np.asarray(np.isfinite(self.maps).all(axis=(0, 3)))

    @property
    def greatest_px(self) -> float:
        """Largest standard deviation of the difference of rows."""
        return float(np.nanmax(self.sigma))

    @property
    def projections(self) -> tuple[Array, Array]:
        """Matrices (3, 4) that project points in the axes of the first rectified camera: OpenCV's P1, P2."""
        first = np.column_stack([self.matrix, np.zeros(3)])
        return first, np.column_stack([self.matrix, -self.matrix @ self.base])

    @property
    def to_points(self) -> Array:
        """Matrix Q (4, 4): (x, y, disparity, 1) becomes a point, as ``cv2.reprojectImageTo3D`` takes it."""
        f, (cx, cy) = self.matrix[0, 0], self.matrix[:2, 2]
        length = float(self.base[np.argmax(np.abs(self.base))])
        return np.array([[1, 0, 0, -cx], [0, 1, 0, -cy], [0, 0, 0, f], [0, 0, 1 / length, 0.0]])

    def _facts(self) -> list[tuple[str, str]]:
        which = "rows" if abs(self.base[0]) > abs(self.base[1]) else "columns"
        return [
            (f"{self.size[0]} × {self.size[1]} px", ""),
            (f"{which} differ by {self.greatest_px:.2g} px at most (σ)", ""),
            (f"both cameras see {100 * self.common.mean():.0f} % of it", ""),
        ]

    def write(self, path: Path | str) -> None:
        """Write maps and matrices as NumPy's ``.npz``, by OpenCV's names.

        ``map1`` and ``map2`` (h, w, 2) for ``cv2.remap``, ``R1``, ``R2``, ``P1``, ``P2``, ``Q``; ``common``
        (h, w), and ``sigma_px``, the standard deviation of the difference of rows, with the places ``x`` and
        ``y`` of its columns and rows.
        """
        (width, height), (one, two) = self.size, self.projections
        rows, columns = self.sigma.shape
        with Path(path).open("wb") as file:
            np.savez_compressed(
                file, map1=self.maps[0], map2=self.maps[1], R1=self.rotations[0], R2=self.rotations[1],
                P1=one, P2=two, Q=self.to_points, common=self.common, sigma_px=self.sigma,
                x=np.linspace(0, width - 1, columns), y=np.linspace(0, height - 1, rows),
            )  # fmt: skip


def rectified(pair: Pair, distance: float) -> Rectification:
    """Rectify the images of two cameras.

    Parameters
    ----------
    pair : Pair
        The cameras.
    distance : float
        Depth of points for which the error is given; may be infinite.

    Raises
    ------
    UsageError
        When a camera has parallel rays, the cameras are at one place, or do not see the same.

    Examples
    --------
    See :class:`Pair`.
    """
    if any(lens.mapping.parallel for lens in pair.lenses):
        raise UsageError("have parallel rays, which no base makes one image of", where="rectified images")
    turn, along = _axes(pair)
    turns = np.stack([turn, turn @ pair.rotation.T])
    sizes = np.array([lens.size for lens in pair.lenses])
    focal = min(_focal(lens) for lens in pair.lenses)
    seen = np.stack([_extent(lens, each) for lens, each in zip(pair.lenses, turns, strict=True)])
    low, high = seen[:, 0].max(axis=0), seen[:, 1].min(axis=0)
    # Along the base, near points are where only one camera has those far away.
    low[along], high[along] = seen[:, 0, along].min(), seen[:, 1, along].max()
    most = _LARGEST * sizes.max(axis=0) / (2 * focal)
    low, high = np.maximum(low, -most), np.minimum(high, most)
    if not (high > low).all():
        raise UsageError("have no field in common", where="rectified images")
    width, height = (np.round((high - low) * focal).astype(int) + 1).tolist()
    centre = -low * focal
    matrix = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    base = np.zeros(3)
    base[along] = (turn @ pair.base)[along]
    maps = np.stack(
        [_images(lens, each, _grid(width, height, width, height), matrix)
         for lens, each in zip(pair.lenses, turns, strict=True)]
    ).reshape(2, height, width, 2)  # fmt: skip
    down = max(2, round(_ACROSS * height / width))
    at = _grid(width, height, _ACROSS, down)
    sigma = _sigma(pair, turns, along, at, matrix, distance).reshape(down, _ACROSS)
    return Rectification(turns, matrix, base, maps.astype(np.float32), sigma, distance, pair.unit)


def _axes(pair: Pair) -> tuple[Array, int]:
    """Axes of the rectified cameras (3, 3) in those of the first, and which of them is the base."""
    length = float(np.linalg.norm(pair.base))
    if not length > 0:
        raise UsageError("are at one place", where="rectified images")
    along = int(np.argmax(np.abs(pair.base[:2])))
    e = pair.base / length * np.sign(pair.base[along] or 1.0)
    z = np.array([0.0, 0.0, 1.0]) + pair.rotation[2]
    z = z - (z @ e) * e
    if not np.linalg.norm(z) > _AHEAD:
        raise UsageError("look along their base", where="rectified images")
    z = z / np.linalg.norm(z)
    return np.stack([e, np.cross(z, e), z] if along == 0 else [np.cross(e, z), e, z]), along


def _focal(lens: CameraMapping) -> float:
    """Pixels per radian at the axis."""
    return float(np.sqrt(abs(np.linalg.det(lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]))))


def _grid(width: int, height: int, across: int, down: int) -> Array:
    """Places (n, 2) over an image, from edge to edge."""
    x, y = np.meshgrid(np.linspace(0, width - 1, across), np.linspace(0, height - 1, down))
    return np.column_stack([x.ravel(), y.ravel()])


def _extent(lens: CameraMapping, turn: Array) -> Array:
    """Least and largest x/z and y/z (2, 2) of what a camera sees, in the rectified axes."""
    uv = lens.mapping.inverse(_grid(*lens.size, _RIM, _RIM))
    uv = uv[np.isfinite(uv).all(axis=1)]
    ray = np.column_stack([uv, np.ones(len(uv))]) @ turn.T
    ray = ray[ray[:, 2] > _AHEAD * np.linalg.norm(ray, axis=1)]
    if not len(ray):
        raise UsageError("have no field in common", where="rectified images")
    seen = ray[:, :2] / ray[:, 2:]
    return np.stack([seen.min(axis=0), seen.max(axis=0)])


def _images(lens: CameraMapping, turn: Array, at: Array, matrix: Array) -> Array:
    """Where pixels (n, 2) of a rectified image are in that of the camera; NaN where it has none."""
    ray = np.column_stack([(at - matrix[:2, 2]) / matrix[0, 0], np.ones(len(at))]) @ turn
    ahead = ray[:, 2] > 0
    xy = np.full((len(at), 2), np.nan)
    xy[ahead] = lens.to_pixels(ray[ahead, :2] / ray[ahead, 2:])
    inside: Mask = np.asarray(((xy >= -0.5) & (xy <= np.array(lens.size) - 0.5)).all(axis=1))
    return np.where(inside[:, None], xy, np.nan)


def _sigma(pair: Pair, turns: Array, along: int, at: Array, matrix: Array, distance: float) -> Array:
    """Standard deviations (n,) of the difference of rows at places of the rectified images."""
    across, (own, other) = 1 - along, pair.lenses
    v = ((at - matrix[:2, 2]) / matrix[0, 0])[:, across]
    models, k = list[Array](), 0
    ahead = turns[0][across] - v[:, None] * turns[0][2]  # of a ray in the axes of the first camera
    count = len(own.rows) + len(other.rows)
    slope = np.zeros((len(at), count + 6))
    disparity = np.zeros(2)
    disparity[along] = matrix[0, 0] * (turns[0] @ pair.base)[along] / distance
    for number, lens in enumerate(pair.lenses):
        xy = _images(lens, turns[number], at - number * disparity, matrix)
        known = np.isfinite(xy).all(axis=1)
        uv, _, by = lens.derivatives(xy[known])
        by_all = np.full((len(at), 2, by.shape[2]), np.nan)
        by_all[known] = by
        ray = np.full((len(at), 3), np.nan)
        ray[known] = np.column_stack([uv, np.ones(len(uv))])
        to_first = np.eye(3) if number == 0 else pair.rotation.T
        depth = ray @ to_first.T @ turns[0][2]
        turned = ahead @ to_first  # the same, in the axes of this camera
        sign = (1.0 if number == 0 else -1.0) / depth
        moved = sign[:, None] * np.einsum("ni,nik->nk", turned[:, :2], by_all)
        slope[:, k : k + len(lens.rows)] = moved[:, : len(lens.rows)]
        models.append(moved[:, len(lens.rows) :])
        k += len(lens.rows)
        if number == 1:
            # A rotation δ of the camera moves its ray by −Rᵀ(δ × r).
            slope[:, count : count + 3] = -sign[:, None] * np.cross(ray, turned)
    slope[:, count + 3 :] = -ahead / distance
    variance = np.einsum("ni,ij,nj->n", slope, pair.covariance, slope)
    variance += (np.concatenate(models, axis=1) ** 2).sum(axis=1)
    return np.asarray(matrix[0, 0] * np.sqrt(np.maximum(variance, 0.0)))
