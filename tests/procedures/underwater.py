"""A frame of targets under water, photographed behind a plane port; drawn with the rays that measure it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reseau.bundle import Camera, Network
from reseau.core.data import Array, Frame
from reseau.io.targets import SpaceTargets, TargetColumns
from reseau.optics.formation import PixelResponse
from reseau.optics.lenses import AIR, Prescription, PupilElements, glass, in_order, ray_image
from reseau.optics.lenses.images import PlaneTarget
from reseau.optics.lenses.media import Water
from reseau.optics.lenses.ray_maps import LensCamera, SensorPlane
from reseau.optics.lenses.windows import behind_windows
from reseau.optics.poses import matrix_to_vector
from reseau.optics.refraction import Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex
from reseau.procedures.blurred import focused

SIZE, PITCH, DISTANCE = (1000, 750), 0.024, 1500.0
PRINCIPAL = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
ROWS = [(0.028, 5.0, glass("N-BK7")), (-0.02, 1.5, glass("SF2")), (-0.006, 3.0, AIR), (0.0, 40.0, AIR)]
LENS = focused(Prescription(in_order(ROWS), stop=3, stop_radius=5.5, wavelengths_nm=(546.1, 480.0)), 900.0)
CAMERA = LensCamera(LENS, SensorPlane((PITCH, PITCH), PRINCIPAL))
WATER = Water(temperature_c=15.0)
REFRACTION = Refraction(
    (
        RefractiveIndex("air", 1.0),
        RefractiveIndex("glass", glass("N-BK7").index(546.1), dispersion=glass("N-BK7").index),
        RefractiveIndex("water", WATER.index(546.1), dispersion=WATER.index),
    ),
    (Window("port", "plane", "camera", {"distance": 30.0, "thickness": 25.0}, ("air", "glass", "water")),),
    ((0,),),
    np.zeros(3, np.intp),
)


@dataclass(frozen=True, eq=False)
class Project:
    """Photographs, targets, and the true corresponding rays (n, 2) of the network's image points."""

    network: Network
    frames: dict[str, Frame]
    targets: SpaceTargets
    true: Array
    xyz: Array


def project(seed: int = 0, noise: float = 1.0, columns: int = 4) -> Project:
    """Three photographs of a space frame of bright disks."""
    rng = np.random.default_rng(seed)
    grid = np.array([[x, y] for x in range(columns) for y in (-1, 0, 1)], dtype=float)
    count = len(grid)
    xyz = np.column_stack(
        [grid * [250.0 / (columns - 1), 90.0] - [125.0, 0.0], 60.0 * ((np.arange(count) * 7) % 5)]
    )
    x0 = np.array([[-500.0, 100.0, DISTANCE], [0.0, -200.0, DISTANCE], [520.0, 150.0, DISTANCE - 50]])
    rotation = np.stack([_looking(at, roll) for at, roll in zip(x0, (0.0, 1.57, 0.1), strict=True)])
    centre = [tuple(n) for n in (np.array([0.0, 0.0, 1.0]) + 0.1 * rng.normal(size=(count, 3))).tolist()]
    names = tuple(f"t{k}" for k in range(count))
    targets = SpaceTargets(
        unit="mm", polarity="bright",
        targets=TargetColumns(id=names, shape=("disk",) * count, size=(10.0,) * count, normal=tuple(centre)),
    )  # fmt: skip
    rows, frames = [], {}
    for i in range(3):
        camera = behind_windows(CAMERA, REFRACTION, 0, rotation[i], x0[i])
        image = np.full((SIZE[1], SIZE[0]), 40.0)
        for k in range(count):
            plane = PlaneTarget(
                rotation[i] @ (xyz[k] - x0[i]), rotation[i] @ targets.axes(k), targets.outline(k, 0.3)
            )
            formed = ray_image(camera, plane, PupilElements.gauss(6))
            if not ((formed.point > 45).all() and (formed.point < np.array(SIZE) - 45).all()):
                continue
            at = np.rint(formed.point).astype(int)
            pixels = np.arange(-40, 41.0)
            share = formed.formed(formed.point, 0.5, at[0] + pixels, at[1] + pixels, PixelResponse())
            image[at[1] - 40 : at[1] + 41, at[0] - 40 : at[0] + 41] += 140 * share
            centroid = formed.point + formed.centroid
            rows.append((i, k, *formed.point, *centroid))
        frames[f"i{i}"] = Frame(image + noise * rng.normal(size=image.shape), 255.0, f"i{i}")
    table = np.array(rows)
    n = len(table)
    values = np.array([0.0, 0.0, 0.0, *7 * [0.0]])
    values[0] = float(np.linalg.norm(_principal_distance()))
    camera = Camera("cam", *SIZE, (PITCH, PITCH), "brown", values, ("c", "K1"), {"side": "object"})
    network = Network(
        cameras=(camera,), images=("i0", "i1", "i2"), camera_of=np.zeros(3, np.intp),
        x0=x0, rotation=matrix_to_vector(rotation), points=names,
        xyz=np.where(np.arange(count)[:, None] % 2 == 0, xyz, np.nan),
        sigma=np.where(np.arange(count)[:, None] % 2 == 0, 0.0, np.nan) * np.ones(3),
        role=tuple("control" if k % 2 == 0 else "tie" for k in range(count)),
        image_of=table[:, 0].astype(np.intp), point_of=table[:, 1].astype(np.intp),
        xy=table[:, 4:6] + 0.05 * rng.normal(size=(n, 2)), cov=np.tile(0.05**2 * np.eye(2), (n, 1, 1)),
        distance_of=np.zeros((0, 2), np.intp), distance=np.zeros((0, 2)), datum="control",
        datum_points=np.ones(count, dtype=bool), groups=(None,) * 3, files=(None,) * 3, unit="mm",
        refraction=replace(REFRACTION),
    )  # fmt: skip
    return Project(network, frames, targets, table[:, 2:4], xyz)


def _principal_distance() -> float:
    near = CAMERA.corresponding(np.array([[0.0, 0.0, 1000.0], [10.0, 0.0, 1000.0]]))
    return float((near[1] - near[0])[0]) * PITCH * 100.0


def _looking(at: Array, roll: float) -> Array:
    z = -at / np.linalg.norm(at)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y, c, s = np.cross(z, x), np.cos(roll), np.sin(roll)
    return np.stack([c * x + s * y, -s * x + c * y, z])
