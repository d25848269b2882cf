"""The networks of the benchmark adjusted by COLMAP; called by ``benchmarks/bundle.py`` as a program.

    colmap.py bal NETWORK        BAL file; each image has f, k1, k2 of its own
    colmap.py shared NETWORK     one camera for all, as benchmarks/bundle.py writes it

Prints processor seconds in all, final half of the sum of squares, iterations, how the normal equations were
solved (COLMAP chooses it by the number of images), memory (MB) before the adjustment and its peak. The sums
are COLMAP's own: an observation whose point lies behind its camera counts nothing there, and it has no
distortion on the image side, so that of `shared` networks it adjusts f, cx, cy, k1, k2 of its model RADIAL,
on the object side.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pycolmap

sys.path.insert(0, str(Path(__file__).parents[1]))
from watched import forget_peak, peak_mb

TURNED = np.diag([1.0, -1.0, -1.0])
"""From a camera that looks along −z with y up to one that looks along z with y down."""


def numbers(path: Path) -> np.ndarray:
    return np.fromfile(path, sep=" ")


def pose(rotation: np.ndarray, shift: np.ndarray) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift)


def turn(vector: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def camera(number: int, f: float, cx: float, cy: float, k1: float, k2: float) -> pycolmap.Camera:
    made = pycolmap.Camera(model="RADIAL", width=4000, height=4000, params=[f, cx, cy, k1, k2])
    made.camera_id = number
    return made


def read(kind: str, path: Path) -> pycolmap.Reconstruction:
    words = numbers(path)
    m, p, n = (int(v) for v in words[:3])
    at, interior = 3, None
    if kind == "shared":
        pitch, interior, at = float(words[3]), words[4:9], 9
    seen, at = words[at : at + 4 * n].reshape(n, 4), at + 4 * n
    width = 6 if kind == "shared" else 9
    poses, xyz = words[at : at + width * m].reshape(m, width), words[at + width * m :].reshape(p, 3)
    image_of, point_of, xy = seen[:, 0].astype(int), seen[:, 1].astype(int), seen[:, 2:] * [1.0, -1.0]
    made = pycolmap.Reconstruction()
    if interior is not None:
        # On the object side a distortion has nearly the opposite coefficients, of directions at z = 1.
        c, k1, k2 = interior[0], -interior[3] * interior[0] ** 2, -interior[4] * interior[0] ** 4
        xy = xy / pitch
        made.add_camera_with_trivial_rig(
            camera(1, c / pitch, interior[1] / pitch, -interior[2] / pitch, k1, k2)
        )
    rows: list[list[int]] = [[] for _ in range(m)]
    for k, i in enumerate(image_of):
        rows[i].append(k)
    place = np.zeros(n, dtype=int)
    for i in range(m):
        if interior is None:
            made.add_camera_with_trivial_rig(camera(i + 1, poses[i, 6], 0.0, 0.0, poses[i, 7], poses[i, 8]))
            rotation, shift = TURNED @ turn(poses[i, :3]), TURNED @ poses[i, 3:6]
        else:
            rotation = turn(poses[i, :3])
            shift = -rotation @ poses[i, 3:6]
        place[rows[i]] = np.arange(len(rows[i]))
        image = pycolmap.Image(
            name=str(i), keypoints=xy[rows[i]], camera_id=1 if interior is not None else i + 1, image_id=i + 1
        )
        made.add_image_with_trivial_frame(image, pose(rotation, shift))
    tracks: list[pycolmap.Track] = [pycolmap.Track() for _ in range(p)]
    for k in range(n):
        tracks[point_of[k]].add_element(int(image_of[k]) + 1, int(place[k]))
    for track, where in zip(tracks, xyz, strict=True):
        if track.length():
            made.add_point3D(where, track, np.zeros(3, dtype=np.uint8))
    return made


def main() -> int:
    kind, path = sys.argv[1], Path(sys.argv[2])
    network = read(kind, path)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = kind == "shared"
    solver = options.ceres.solver_options
    solver.num_threads, solver.function_tolerance, solver.max_num_iterations = 2, 1e-6, 200
    config = pycolmap.BundleAdjustmentConfig()
    for image in network.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    before = forget_peak()
    begun = time.process_time()
    summary = pycolmap.create_default_bundle_adjuster(options, config, network).solve()
    spent = time.process_time() - begun
    ceres = getattr(summary, "ceres_summary", summary)
    steps = ceres.num_successful_steps + ceres.num_unsuccessful_steps
    how = ceres.linear_solver_type_used.name
    print(f"{spent:.6f} {ceres.final_cost:.10g} {steps} {how} {before:.1f} {peak_mb():.1f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
