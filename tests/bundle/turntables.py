"""A simulated object on a turntable in front of a camera, or of a rig of two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reseau.bundle import Camera, Network
from reseau.bundle.network.rig import Rig
from reseau.bundle.network.stage import Stage
from reseau.core.data import Array
from reseau.optics.poses import matrix_to_vector, rotation_matrix

__all__ = ["AXIS", "POINT", "Table", "turned"]

SIZE, PITCH, SIGMA = (1200, 1000), 0.005, 0.1
AXIS, POINT = np.array([0.05, -0.03, 1.0]), np.array([12.0, -7.0, 0.0])
AXIS /= np.linalg.norm(AXIS)
# Places on a rig: rotation about the axes of the first camera, and projection centre there.
_PLACES = ((np.zeros(3), np.zeros(3)), (np.array([0.03, 0.2, 0.1]), np.array([-120.0, 15.0, 10.0])))


@dataclass(frozen=True)
class Table:
    """A network with its truth: points (p, 3), and angles (m,) in radians."""

    network: Network
    xyz: Array
    angle: Array


def _looking(at: Array) -> Array:
    """Rotation of a camera at a place that looks at the origin, y down."""
    z = -at / np.linalg.norm(at)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def turned(
    seed: int = 0, *, angles_deg: Sequence[float] = tuple(range(0, 360, 30)), sigma: float | None = 0.0,
    setups: int = 2, cameras: int = 1, control: bool = False, carries: str = "object", cold: bool = False,
    noise: float = SIGMA, free: tuple[str, ...] = ("c", "K1"),
) -> Table:  # fmt: skip
    """Draw a network: `sigma` of the angles in radians, 0 for known ones, None for ones that are not read."""
    rng, world = np.random.default_rng(seed), np.random.default_rng(7)
    xyz = world.uniform(-80, 80, (40, 3)) + np.array([0.0, 0.0, 20.0])
    model = Camera("camera", *SIZE, (PITCH, PITCH), "brown", np.array([8.0, 0.02, -0.03, 1e-4] + 6 * [0.0]),
                   free)  # fmt: skip
    names = model.names
    values = np.zeros(len(names))
    for name, value in (("c", 8.0), ("x0", 0.02), ("y0", -0.03), ("K1", 1e-4)):
        values[names.index(name)] = value
    starts = ([520.0, 40.0, 160.0], [400.0, -330.0, 330.0], [150.0, 480.0, 60.0])[:setups]
    sign = 1.0 if carries == "object" else -1.0
    rows: list[tuple[int, int, int]] = []
    turns, centres, pose, angle = [], [], [], []
    for s, start in enumerate(starts):
        at = np.array(start)
        for k, alpha in enumerate(np.radians(angles_deg)):
            a = rotation_matrix(sign * alpha * AXIS)
            for c in range(cameras):
                turn, base = rotation_matrix(_PLACES[c][0]), _PLACES[c][1]
                rest = _looking(at)
                r0, x0 = turn @ rest, at + rest.T @ base
                turns.append(r0 @ a)
                centres.append(POINT + a.T @ (x0 - POINT))
                pose.append(s)
                angle.append(alpha)
                rows.append((s, k, c))
    rotation, x0 = np.array(turns), np.array(centres)
    m, p = len(rows), len(xyz)
    mapping = Camera("camera", *SIZE, (PITCH, PITCH), "brown", values, free)
    image_of, point_of, seen = [], [], []
    for i in range(m):
        inside = (xyz - x0[i]) @ rotation[i].T
        xy = mapping.plane_mapping()(inside[:, :2] / inside[:, 2:])
        ok = np.flatnonzero((xy > 0).all(axis=1) & (xy < np.array(SIZE) - 1).all(axis=1))
        image_of.append(np.full(len(ok), i))
        point_of.append(ok)
        seen.append(xy[ok])
    of, n = np.array([c for _, _, c in rows]), sum(map(len, seen))
    point_sigma = np.full((p, 3), np.nan)
    if control:
        point_sigma[:6] = 0.0
    reading = np.array(angle)
    drawn = rng.normal(size=len(reading))
    if sigma:
        # Images that were taken at once have one reading.
        drawn = drawn[np.arange(m) - of]
        reading = reading + sigma * drawn
    nothing = np.full((m, 3), np.nan)
    network = Network(
        cameras=tuple(
            Camera(f"camera {c}", *SIZE, (PITCH, PITCH), "brown", values, free) for c in range(cameras)
        ),
        images=tuple(f"{s}-{k}-{c}" for s, k, c in rows), camera_of=of,
        x0=nothing if cold else x0, rotation=nothing if cold else matrix_to_vector(rotation),
        points=tuple(str(k) for k in range(p)), xyz=np.where(np.isnan(point_sigma) & cold, np.nan, xyz),
        sigma=point_sigma, role=tuple("control" if row[0] == 0 else "tie" for row in point_sigma),
        image_of=np.concatenate(image_of), point_of=np.concatenate(point_of),
        xy=np.concatenate(seen) + noise * rng.normal(size=(n, 2)),
        cov=np.tile(np.eye(2) * SIGMA**2, (n, 1, 1)), distance_of=np.array([[0, 1]]),
        distance=np.array([[np.linalg.norm(xyz[1] - xyz[0]), 0.01]]), datum="control" if control else "free",
        datum_points=np.ones(p, dtype=bool), groups=(None,) * m, files=(None,) * m,
        rig=None if cameras == 1 else Rig(of, np.arange(m) // cameras),
        stage=Stage(np.array(pose), reading, np.nan if sigma is None else sigma, kind="rotary",
                    carries="object" if carries == "object" else "camera"),
    )  # fmt: skip
    return Table(network, xyz, np.array(angle))
