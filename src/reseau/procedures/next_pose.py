"""The photograph that would improve a calibration most.

An image at another pose adds, after the elimination of its orientation, the normal matrix

    N = Jᵀ P J − Jᵀ P B (Bᵀ P B)⁻¹ Bᵀ P J

with the derivatives J by the parameters of the camera and B by the six of the orientation, to the inverse of
their covariance (Förstner & Wrobel 2016, sect. 4.2.7). The points of the target count as known in this
comparison of candidates; the prediction for the chosen one is that of an adjustment of the whole network with
its image.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..bundle import Network, Result, Stage, adjust_network, camera_mapping, with_estimates
from ..calibration import CameraMapping, projection_field
from ..calibration.camera import by_rotation
from ..core.data import Array, Mask
from ..core.failure import Failure
from ..optics import Pose
from ..optics.poses import matrix_to_vector, rotation_matrix

__all__ = ["PREDICTED", "NextPose", "next_photograph", "with_image"]

_MARGIN_PX = 6.0
"""Points closer to the edge of the image are not expected to be measured."""
PREDICTED = "predicted"
"""Name of the image that is not taken yet."""
_TILT = float(np.deg2rad(40.0))
_FILLS, _HALF = 0.9, 0.48
"""Share of the image across which the target extends."""
_ASIDE = 0.26
"""Distance of the middle of the target from the middle of the image, in image widths and heights."""
_BACK = 1.2
_FOCUS = 1.6
"""Factor beyond the distances so far at which the image would be out of focus."""
_FIELD = 13
_MOSTLY = 0.7
"""Share of the largest gain in coverage that a photograph must have."""
_WORTH = 0.97
"""A photograph that leaves more than this share of the uncertainty is not worth while."""
_EDGES = ("", "right", "left", "lower", "upper")
_PLACES = {
    (0, 0): "middle", (-1, 0): "left half", (1, 0): "right half", (0, -1): "upper half", (0, 1): "lower half",
    (-1, -1): "upper left", (1, -1): "upper right", (-1, 1): "lower left", (1, 1): "lower right",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class NextPose:
    """A pose for the next photograph.

    Parameters
    ----------
    pose : Pose
        Of the camera.
    words : str
        How the photograph looks.
    outline : ndarray (k, 2)
        The images of the target's corners, pixels, in the order of its outline.
    xy : ndarray (p, 2)
        Those of its points inside the image.
    worst_px : float
        Largest standard deviation of the projection over the image with the photograph, px.

    Examples
    --------
    >>> pose = Pose(np.zeros(3), np.zeros(3))
    >>> NextPose(pose, "the target fills the image", np.zeros((4, 2)), np.zeros((0, 2)), 0.02).worst_px
    0.02
    """

    pose: Pose
    words: str
    outline: Array
    xy: Array
    worst_px: float


def with_image(
    network: Network, lens: CameraMapping, pose: Pose, uv: Array, stage: Stage | None = None
) -> Network | None:
    """Return the network with an image at another pose.

    Parameters
    ----------
    network : Network
        With one camera.
    lens : CameraMapping
        Its mapping.
    pose : Pose
        Of the image.
    uv : ndarray (p, 2)
        Ideal directions of all points; NaN where a point cannot be seen.
    stage : Stage, optional
        Heights of all images, with those of the new one.

    Returns
    -------
    Network or None
        None when fewer than four points are inside the image.
    """
    seen, inside = _inside(lens, uv)
    rows = np.flatnonzero(inside)
    if len(rows) < 4:
        return None
    m, bent = len(network.images), network.refraction
    cov = np.median(network.cov, axis=0)
    return replace(
        network,
        images=(*network.images, PREDICTED),
        stage=stage,
        refraction=None if bent is None else replace(bent, path_of=np.append(bent.path_of, bent.path_of[:1])),
        camera_of=np.append(network.camera_of, 0),
        x0=np.vstack([network.x0, pose.x0]),
        rotation=np.vstack([network.rotation, matrix_to_vector(pose.matrix)]),
        image_of=np.concatenate([network.image_of, np.full(len(rows), m)]),
        point_of=np.concatenate([network.point_of, rows]),
        xy=np.concatenate([network.xy, seen[rows]]),
        cov=np.concatenate([network.cov, np.tile(cov, (len(rows), 1, 1))]),
        groups=(*network.groups, None),
        files=(*network.files, PREDICTED),
    )


def _inside(lens: CameraMapping, uv: Array) -> tuple[Array, Mask]:
    """Images (p, 2) of directions, and whether they lie inside the image."""
    seen = lens.mapping(uv)
    size = np.array(lens.size) - 1
    rows = np.flatnonzero(np.isfinite(uv).all(axis=1))
    good = lens.mapping.one_to_one(uv[rows])
    good &= ((seen[rows] >= _MARGIN_PX) & (seen[rows] <= size - _MARGIN_PX)).all(axis=1)
    inside = np.zeros(len(uv), dtype=np.bool_)
    inside[rows[good]] = True
    return seen, inside


def next_photograph(result: Result, empty: Mask) -> NextPose | None:
    """Choose the pose whose photograph lowers the largest uncertainty of the projection most.

    Parameters
    ----------
    result : Result
        A calibration with one camera, without windows, of a plane target.
    empty : ndarray of bool (rows, columns)
        Parts of the image without points; where there are any, only photographs that show the target in most
        of those that one photograph can reach are considered.

    Returns
    -------
    NextPose or None
        None when no photograph lowers it by 3 %, or where the network is another one.
    """
    network = result.network
    camera = network.cameras[0]
    if len(network.cameras) > 1 or network.refraction is not None or network.stage is not None:
        return None
    if not camera.has_plane_mapping or camera.additional is not None:
        return None
    lens = camera_mapping(result, 0)
    if lens.mapping.parallel:
        return None
    part = result.fit.usable
    xyz = result.fit.values.xyz[part.points]
    weight = 1.0 / (float(np.median(network.cov[:, [0, 1], [0, 1]])) * result.fit.variance)
    precision = _inverse(lens.covariance)
    before = _worst(lens)
    best: tuple[float, Pose, str] | None = None
    every = list(_candidates(lens, xyz, result.fit.values.x0[part.images]))
    gained = [_gained(*_inside(lens, _directions(xyz, pose)), lens, empty) for pose, _ in every]
    least = _MOSTLY * max(gained, default=0.0)
    for (pose, words), gain in zip(every, gained, strict=True):
        if gain < least:
            continue
        uv = _directions(xyz, pose)
        _, inside = _inside(lens, uv)
        if inside.sum() < max(4, 0.4 * len(xyz)):
            continue
        normal = weight * _reduced(lens, uv[inside], pose(xyz)[inside, 2])
        after = _worst(replace(lens, covariance=_inverse(precision + normal)))
        if best is None or after < best[0]:
            best = after, pose, words
    if best is None or not best[0] < _WORTH * before:
        return None
    _, pose, words = best
    joined = with_image(with_estimates(result), lens, pose, _directions(result.fit.values.xyz, pose))
    found = None if joined is None else adjust_network(joined)
    if found is None or isinstance(found, Failure):
        return None
    # The predicted image has no errors: the variance factor stays that of the observations.
    factor = result.fit.variance / found.fit.variance
    after = _worst(camera_mapping(found, 0)) * float(np.sqrt(factor))
    if not after < _WORTH * before:
        return None
    seen, inside = _inside(lens, _directions(xyz, pose))
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    z = xyz[:, 2].mean()
    corners = np.array(
        [(x, y, z) for x, y in ((low[0], low[1]), (high[0], low[1]), high[:2], (low[0], high[1]))]
    )
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    around = np.concatenate([np.linspace(a, b, 12, endpoint=False) for a, b in sides])
    outline = lens.to_pixels(_directions(around, pose))
    return NextPose(pose, words, outline, seen[inside], after)


def _candidates(lens: CameraMapping, xyz: Array, x0: Array) -> Iterator[tuple[Pose, str]]:
    """Poses from which the target fills the image, or half of it at nine places; straight and tilted."""
    middle, half = (xyz.max(axis=0) + xyz.min(axis=0)) / 2, np.ptp(xyz, axis=0)[:2] / 2
    size, axis = np.array(lens.size), lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]
    focal = float(np.sqrt(abs(np.linalg.det(axis))))
    # The target is looked at from the side where the cameras were; y of the image is down.
    front = np.diag([1.0, -1.0, -1.0]) if x0[:, 2].mean() > middle[2] else np.eye(3)
    away = np.linalg.norm(x0 - middle, axis=1)
    for roll in (0, 90):
        turned = rotation_matrix(np.array([0.0, 0.0, np.deg2rad(roll)])) @ front
        extent = half[::-1] if roll else half
        for share, places in ((_FILLS, [(0, 0)]), (_HALF, list(_PLACES))):
            distance = float((2 * focal * extent / (share * size)).max())
            if not away.min() / _FOCUS <= distance <= away.max() * _FOCUS:
                continue
            for place in places:
                pixel = (size - 1) / 2 + _ASIDE * size * place * (share == _HALF)
                ray = np.append(lens.mapping.inverse(pixel[None])[0], 1.0)
                for edge, tilt in zip(_EDGES, _tilts(), strict=True):
                    turn = rotation_matrix(tilt) @ turned
                    if np.isfinite(ray).all():
                        # A tilted target has an edge that is closer, and larger.
                        centre = distance * (_BACK if edge else 1.0) * ray / ray[2]
                        pose = Pose(matrix_to_vector(turn), middle - turn.T @ centre)
                        yield pose, _words(place, share == _FILLS, edge, bool(roll))


def _tilts() -> Array:
    """Rotation vectors that bring the right, the left, the lower and the upper edge towards the camera."""
    return _TILT * np.array([[0, 0, 0], [0, 1, 0], [0, -1, 0], [-1, 0, 0], [1, 0, 0]], dtype=np.float64)


def _words(place: tuple[int, int], fills: bool, edge: str, turned: bool) -> str:
    found = "the target fills the image" if fills else f"the target in the {_PLACES[place]} of the image"
    found += f", its {edge} edge 40° towards the camera" if edge else ", straight from the front"
    return found + (", the camera turned by 90°" if turned else "")


def _directions(xyz: Array, pose: Pose) -> Array:
    """Ideal directions (p, 2); NaN behind the camera."""
    x = pose(xyz)
    uv: Array = x[:, :2] / np.where(x[:, 2:] > 0, x[:, 2:], np.nan)
    return uv


def _gained(seen: Array, inside: Mask, lens: CameraMapping, empty: Mask) -> float:
    """Share of the parts of the image without points that have some then."""
    rows, columns = empty.shape
    at = seen[inside] / np.array(lens.size) * [columns, rows]
    cell = np.clip(at.astype(int), 0, [columns - 1, rows - 1])
    then = np.zeros_like(empty)
    then[cell[:, 1], cell[:, 0]] = True
    return float((then & empty).sum() / max(int(empty.sum()), 1))


def _reduced(lens: CameraMapping, uv: Array, z: Array) -> Array:
    """Normal matrix of the camera's parameters by an image, for unit weights."""
    seen = lens.mapping.derivatives(uv)
    by_shift = np.zeros((len(uv), 2, 3))
    by_shift[:, 0, 0] = by_shift[:, 1, 1] = 1.0 / z
    by_shift[:, :, 2] = -uv / z[:, None]
    pose = np.concatenate([seen.d_xy @ by_rotation(uv), seen.d_xy @ by_shift], axis=2).reshape(-1, 6)
    own = seen.d_parameters[:, :, lens.rows].reshape(len(pose), -1)
    left: Array = own - pose @ np.linalg.lstsq(pose, own, rcond=None)[0]
    normal: Array = left.T @ left
    return normal


def _inverse(matrix: Array) -> Array:
    """Inverse of a positive semidefinite matrix whose rows have different units."""
    size = np.sqrt(np.diag(matrix))
    size = np.where(size > 0, size, 1.0)
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(matrix / scale, hermitian=True) / scale, dtype=np.float64)


def _worst(lens: CameraMapping) -> float:
    """Largest standard deviation of the projection over the image."""
    sigma = projection_field(lens, _FIELD).sigma
    return float(np.nanmax(sigma)) if np.isfinite(sigma).any() else float("inf")
