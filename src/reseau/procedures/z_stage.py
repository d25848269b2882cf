"""A plane target on a z-stage: images of one pose at several heights form a spatial target.

At each height the target is displaced along the axis of the stage by the reading. Images of one pose have one
exterior orientation; see :class:`reseau.bundle.Stage`. The coordinates of the design are observations: they
give the scale, which a plane parallel to the image does not separate from the principal distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..bundle import Network, Stage
from ..core.data import Array, Rows
from ..core.errors import UsageError

_LEAST_POINTS = 8


@dataclass(frozen=True, eq=False)
class Heights:
    """Readings of the stage and their standard deviations.

    Parameters
    ----------
    pose : mapping of str to int
        Number of the pose of each image; images of one pose differ only in height.
    reading : mapping of str to float
        Height of each image, in the unit of the design.
    sigma : float
        Standard deviation of a reading.
    axis_sigma : float
        Standard deviation of each of the two angles between axis and normal of the target (rad).
    field_sigma : float
        Standard deviation of each coordinate of the design, including flatness.

    Examples
    --------
    >>> heights = Heights({"a": 0, "b": 0}, {"a": 0.0, "b": 50.0}, 0.01, 1e-3, 0.05)
    >>> heights.stage(["a", "b"], np.array([0.0, 0.0, 1.0])).reading.tolist()
    [0.0, 50.0]
    """

    pose: Mapping[str, int]
    reading: Mapping[str, float]
    sigma: float
    axis_sigma: float
    field_sigma: float

    def __post_init__(self) -> None:
        for name, value in (
            ("a height", self.sigma),
            ("the axis", self.axis_sigma),
            ("the design", self.field_sigma),
        ):
            if not 0 < value < np.inf:
                raise UsageError("must be larger than 0", where=f"standard deviation of {name}")

    def stage(self, images: Sequence[str], axis: Array) -> Stage | None:
        """Return the readings of some images; None if no pose has two heights."""
        pose = np.array([self.pose[name] for name in images], dtype=np.intp)
        reading = np.array([self.reading[name] for name in images])
        seen = {(int(p), float(h)) for p, h in zip(pose, reading, strict=True)}
        if len(seen) == len(np.unique(pose)):
            return None
        return Stage(pose, reading, self.sigma, axis, self.axis_sigma)

    def lifted(self, network: Network) -> Network:
        """Return a network of images of a plane with the stage, and with the design as observations."""
        p, camera = len(network.points), network.cameras[0]
        network = replace(
            network, sigma=np.full((p, 3), self.field_sigma), role=("control",) * p, datum="control"
        )
        stage = self.stage(network.images, np.array([0.0, 0.0, 1.0]))
        if stage is None:
            return network
        frames = np.array([*_frames(network, stage)]).reshape(-1, 3, 3)
        f = _focal_length(frames)
        if f is not None and 0.2 < f / max(camera.width, camera.height) < 100:
            network = replace(network, cameras=(camera.rescaled(f),))
        # Towards the camera or away from it: the three directions must be right-handed.
        sign = -1.0 if len(frames) and float(np.sign(np.linalg.det(frames)).sum()) < 0 else 1.0
        return replace(network, stage=replace(stage, axis=np.array([0.0, 0.0, sign])))


def _frames(network: Network, stage: Stage) -> Iterator[Array]:
    """μ K R (3, 3) of each pose with several heights, K = diag(f, f, 1).

    The first two columns of the projectivity of the plane at height h are those of K R, and the last column
    changes by h K r₃, up to one factor for each image, which follows from the first two columns.
    """
    camera = network.cameras[0]
    middle = (np.array([camera.width, camera.height]) - 1) / 2
    for pose in np.unique(stage.pose):
        images = np.flatnonzero(stage.pose == pose)
        found = [_projectivity(network, int(i), middle) for i in images]
        seen: Rows = np.array([k for k, h in enumerate(found) if h is not None], dtype=np.intp)
        heights = stage.reading[images[seen]]
        if len(seen) < 2 or np.ptp(heights) == 0:
            continue
        first: Array = np.asarray(found[seen[0]])
        scaled = []
        for k in seen:
            h: Array = np.asarray(found[k])
            scaled.append(h * float((first[:, :2] * h[:, :2]).sum() / (h[:, :2] ** 2).sum()))
        last = np.array(scaled)[:, :, 2]
        up = (heights - heights.mean()) @ last / ((heights - heights.mean()) ** 2).sum()
        frame = np.column_stack([first[:, :2], up])
        size = np.cbrt(abs(np.linalg.det(frame)))
        if size > 0:
            yield frame / size


def _projectivity(network: Network, image: int, middle: Array) -> Array | None:
    """Projectivity from the plane of the design to an image with its origin in the centre."""
    rows = np.flatnonzero(network.image_of == image)
    if len(rows) < _LEAST_POINTS:
        return None
    found, _ = cv2.findHomography(network.xyz[network.point_of[rows], :2], network.xy[rows] - middle)
    return None if found is None else np.asarray(found, dtype=np.float64)


def _focal_length(frames: Array) -> float | None:
    """f (px) for which the columns g of each μ K R (k, 3, 3) are orthogonal and of equal length.

    (g_x g'_x + g_y g'_y)/f² + g_z g'_z is μ² for a column with itself and 0 for two columns: linear in 1/f²
    and μ².
    """
    k = len(frames)
    if not k:
        return None
    plane = np.einsum("kai,kaj->kij", frames[:, :2], frames[:, :2])
    along = np.einsum("ki,kj->kij", frames[:, 2], frames[:, 2])
    i, j = np.triu_indices(3)
    design = np.zeros((k, 6, 1 + k))
    design[:, :, 0] = plane[:, i, j]
    design[np.arange(k), :, 1 + np.arange(k)] = -(i == j).astype(np.float64)
    scale = np.linalg.norm(design.reshape(6 * k, -1), axis=0)
    found = np.linalg.lstsq(design.reshape(6 * k, -1) / scale, -along[:, i, j].ravel(), rcond=None)[0] / scale
    return float(1.0 / np.sqrt(found[0])) if found[0] > 0 else None
