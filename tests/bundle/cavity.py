"""Four cameras before a cavity filled with a fluid: real images, measured and calibrated by others.

Origin and conventions: README.txt of ``multimedia_cavity`` in the reference data. The cameras 1 and 2 look
through the front window, 3 and 4 through the one at the back.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from reseau.bundle import Camera, Network
from reseau.core.data import Array
from reseau.optics.poses import Pose, matrix_to_vector
from reseau.optics.refraction import RefractedRays, Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex

PITCH = 0.012
ADDITIONAL = ("K1", "P1", "P2", "B1", "B2")
INTERIOR = ("c", "x0", "y0")
# A detection within this distance (px) of a computed point is that point.
NEAR = 4.0
_MEDIA = (RefractiveIndex("air", 1.0), RefractiveIndex("glass", 1.33), RefractiveIndex("fluid", 1.46))
_THICKNESS = 6.0


def cavity(folder: Path, free: tuple[str, ...] = (), window: tuple[str, ...] = ()) -> Network:
    """The network with the calibration of the data as approximate values.

    Parameters
    ----------
    folder : Path
        Folder of the data.
    free : tuple of str
        Free parameters of each camera.
    window : tuple of str
        Free parameters of each window.
    """
    target = np.loadtxt(folder / "cal" / "target_on_a_side.txt")
    cameras, x0, rotation = [], [], []
    for k in range(1, 5):
        numbers = [float(word) for word in (folder / "cal" / f"cam{k}.tif.ori").read_text().split()]
        turn = np.array(numbers[6:15]).reshape(3, 3)
        x0.append(numbers[:3])
        rotation.append(np.diag([1.0, -1.0, -1.0]) @ turn.T)
        # Their principal point is at (640, 512), the centre of our images at (639.5, 511.5).
        values = np.array([numbers[17], numbers[15] + 0.5 * PITCH, numbers[16] - 0.5 * PITCH, *7 * [0.0]])
        cameras.append(Camera(f"cam{k}", 1280, 1024, (PITCH, PITCH), "brown", values, free))
    sides = ("front", (0.0, 0.0, 1.0)), ("back", (0.0, 0.0, -1.0))
    windows = tuple(
        Window(name, "plane", "object", {"distance": -125.0 - _THICKNESS, "thickness": _THICKNESS},
               ("air", "glass", "fluid"), window, direction=normal)
        for name, normal in sides
    )  # fmt: skip
    refraction = Refraction(_MEDIA, windows, ((0,), (1,)), np.array([0, 0, 1, 1]))
    poses = np.stack(rotation)
    # A rotation in the file has seven digits.
    u, _, vt = np.linalg.svd(poses)
    poses = u @ vt
    seen = [
        (i, *row)
        for i in range(4)
        for row in _detected(folder, i, cameras[i], refraction, poses, np.array(x0), target[:, 1:])
    ]
    image, point = (np.array([row[c] for row in seen], dtype=np.intp) for c in (0, 1))
    n, p = len(seen), len(target)
    return Network(
        cameras=tuple(cameras),
        images=tuple(f"cam{k}" for k in range(1, 5)),
        camera_of=np.arange(4),
        x0=np.array(x0),
        rotation=matrix_to_vector(poses),
        points=tuple(str(int(name)) for name in target[:, 0]),
        xyz=target[:, 1:],
        sigma=np.zeros((p, 3)),
        role=("control",) * p,
        image_of=image,
        point_of=point,
        xy=np.array([row[2:] for row in seen], dtype=np.float64),
        cov=np.tile(np.eye(2), (n, 1, 1)),
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum="control",
        datum_points=np.ones(p, dtype=bool),
        groups=(None,) * 4,
        files=(None,) * 4,
        refraction=refraction,
    )


def of_camera(network: Network, k: int) -> Network:
    """The network of one camera only."""
    refraction = network.refraction
    assert refraction is not None
    rows = network.image_of == k
    chosen = network.select(rows)
    return replace(
        chosen,
        cameras=(network.cameras[k],),
        images=(network.images[k],),
        camera_of=np.zeros(1, dtype=np.intp),
        x0=network.x0[[k]],
        rotation=network.rotation[[k]],
        image_of=np.zeros(int(rows.sum()), dtype=np.intp),
        groups=(None,),
        files=(None,),
        refraction=replace(refraction, path_of=refraction.path_of[[k]]),
    )


def misfits(network: Network) -> Array:
    """Image points at the given values less measured ones (n, 2)."""
    refraction = network.refraction
    assert refraction is not None
    rays = RefractedRays.of(
        refraction.columns(refraction.values), refraction.path_of, Pose(network.rotation, network.x0).matrix,
        network.x0, network.xyz, network.image_of, network.point_of,
    )  # fmt: skip
    off = np.empty_like(network.xy)
    for k, camera in enumerate(network.cameras):
        rows = network.image_of == k
        off[rows] = camera.bare_mapping()(rays.uv[rows]) - network.xy[rows]
    return off


def _detected(
    folder: Path, k: int, camera: Camera, refraction: Refraction, rotation: Array, x0: Array, xyz: Array
) -> list[tuple[int, float, float]]:
    """Points and the detections nearest to them."""
    p = len(xyz)
    image, point = np.full(p, k, dtype=np.intp), np.arange(p)
    columns = refraction.columns(refraction.values)
    rays = RefractedRays.of(columns, refraction.path_of, rotation, x0, xyz, image, point)
    computed = camera.bare_mapping()(rays.uv)
    found = np.loadtxt(folder / "cal" / f"cam{k + 1}.tif_targets", skiprows=1)[:, 1:3]
    apart = np.linalg.norm(computed[:, None] - found[None], axis=2)
    nearest = apart.argmin(axis=1)
    return [(j, *found[nearest[j]].tolist()) for j in range(p) if apart[j, nearest[j]] < NEAR]
