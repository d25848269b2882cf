"""A plane target on a z-stage: photographs of one pose at several heights, as of one spatial target.

The target at a height is the target moved along the axis of the stage by what was read. Images of one pose
have one exterior orientation; see :class:`reseau.bundle.Stage`. The design is taken at its word to a standard
deviation: it gives the scale that a plane seen at right angles leaves to the principal distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..bundle import Network, Stage
from ..core.data import Array, Rows
from ..core.errors import UsageError

__all__ = ["Heights"]

_LEAST_POINTS = 8


@dataclass(frozen=True, eq=False)
class Heights:
    """What is known of target and stage.

    Parameters
    ----------
    pose : mapping of str to int
        Pose of each image: those of one differ in height alone.
    reading : mapping of str to float
        Height that was read in each image, in the unit of the design.
    sigma : float
        Standard deviation of a reading.
    axis_sigma : float
        Standard deviation of each of the two angles (rad) by which its axis is off the target's normal.
    field_sigma : float
        Standard deviation of each coordinate of the design's points, their unevenness too.
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
        """What was read in some images; nothing where no pose was seen at two heights."""
        pose = np.array([self.pose[name] for name in images], dtype=np.intp)
        reading = np.array([self.reading[name] for name in images])
        seen = {(int(p), float(h)) for p, h in zip(pose, reading, strict=True)}
        if len(seen) == len(np.unique(pose)):
            return None
        return Stage(pose, reading, self.sigma, axis, self.axis_sigma)

    def lifted(self, network: Network) -> Network:
        """A network of plane images with the stage, and the design's coordinates as observations."""
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
        # Towards the camera or away from it: with the right one the three directions are right-handed.
        sign = -1.0 if len(frames) and float(np.sign(np.linalg.det(frames)).sum()) < 0 else 1.0
        return replace(network, stage=replace(stage, axis=np.array([0.0, 0.0, sign])))


def _frames(network: Network, stage: Stage) -> Iterator[Array]:
    """μ K R of each pose seen at several heights (3, 3), K = diag(f, f, 1).

    The first two columns of the projectivity of the plane at a height h are K R without its last column, and
    the last one moves by h K r₃; all but for one factor of each image, which the first two tell.
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
    """From the plane of the design to an image, from its middle; positive before the camera."""
    rows = np.flatnonzero(network.image_of == image)
    if len(rows) < _LEAST_POINTS:
        return None
    found, _ = cv2.findHomography(network.xyz[network.point_of[rows], :2], network.xy[rows] - middle)
    return None if found is None else np.asarray(found, dtype=np.float64)


def _focal_length(frames: Array) -> float | None:
    """f in pixels by which the columns g of each μ K R (k, 3, 3) are of one length and at right angles.

    (g_x g'_x + g_y g'_y)/f² + g_z g'_z = μ² for a column with itself, 0 for one with another: linear in 1/f²
    and the μ².
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
