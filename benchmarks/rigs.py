"""Coverage of covariances of cameras that are fixed to each other: a sphere of cameras, a stereo pair.

Run from the checkout: ``python benchmarks/rigs.py [--part sphere|stereo] [--seeds 200] [--jobs N]``. Image
coordinates are drawn with OpenCV's ``projectPoints`` and noise of a known size; none of the project's
projections takes part. Printed are root mean squares of errors over standard deviations, one by one and
jointly, each with its standard error over the seeds.

sphere
    Twelve cameras on the vertices of an icosahedron look inwards at a ball with 80 points, of which each
    camera sees those that face it, in 8 exposures. Cameras on opposite sides never see the same point. Three
    distances between points give the scale; all points and fx, fy, cx, cy, k1, k2 of the cameras are unknown.
stereo
    The geometry of ``$RESEAU_DATA/chessboard_stereo``: the photographs are measured and adjusted once with
    OpenCV (``stereoCalibrate``), its estimates are the truth of the draws.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from parts import add_options, executor_of, main_of, outcomes

from reseau.bundle import Camera, Network, adjust_network
from reseau.bundle.network.rig import Rig
from reseau.core.data import Array
from reseau.execution import Executor
from reseau.io.network import CameraEntry

DATA = (
    Path(os.environ.get("RESEAU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    / "chessboard_stereo"
)
SIGMA = 0.1
Drawn = tuple[Network, list[Array], list[Array], Array]


def camera_of(name: str, size: tuple[int, int], values: dict[str, float]) -> Camera:
    entry = {"id": name, "width": size[0], "height": size[1], "model": "opencv", "free": tuple(values),
             "parameters": values}  # fmt: skip
    return Camera.from_entry(CameraEntry.model_validate(entry))


def projected(xyz: Array, rotation: Array, x0: Array, values: dict[str, float]) -> Array:
    matrix = np.diag([values["fx"], values["fy"], 1.0])
    matrix[:2, 2] = values["cx"], values["cy"]
    distortion = np.array([values.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])
    vector, _ = cv2.Rodrigues(rotation)
    return cv2.projectPoints(xyz, vector, -rotation @ x0, matrix, distortion)[0].reshape(-1, 2)


def vector(rotation: Array) -> Array:
    return cv2.Rodrigues(rotation)[0].ravel()


def network_of(
    cameras: list[Camera], places: list[tuple[Array, Array]], exposures: list[tuple[Array, Array]],
    seen: Callable[[int, Array, Array], Array], xyz: Array, sigma: Array, rng: np.random.Generator,
) -> Network:  # fmt: skip
    """Images of all cameras in all exposures, of the points that `seen` chooses."""
    of, exposure, x0, turns, image_of, point_of, xy = ([] for _ in range(7))
    for e, (turn, at) in enumerate(exposures):
        for c, (own, base) in enumerate(places):
            rotation, centre = own @ turn, at + turn.T @ base
            rows = seen(c, rotation, centre)
            if len(rows) < 6:
                continue
            values = {name: cameras[c].parameters[name] for name in cameras[c].free}
            image_of.append(np.full(len(rows), len(of)))
            point_of.append(rows)
            xy.append(projected(xyz[rows], rotation, centre, values))
            of.append(c)
            exposure.append(e)
            x0.append(centre)
            turns.append(vector(rotation))
    m, p, n = len(of), len(xyz), sum(map(len, xy))
    bars = np.array([[0, p // 2], [p // 3, p - 1], [1, p - 2]])
    known = np.linalg.norm(xyz[bars[:, 1]] - xyz[bars[:, 0]], axis=1)
    free = np.isnan(sigma).any()
    return Network(
        cameras=tuple(cameras), images=tuple(f"{c}-{e}" for c, e in zip(of, exposure, strict=True)),
        camera_of=np.array(of), x0=np.array(x0), rotation=np.array(turns),
        points=tuple(str(k) for k in range(p)), xyz=xyz, sigma=sigma,
        role=("tie" if free else "control",) * p, image_of=np.concatenate(image_of),
        point_of=np.concatenate(point_of), xy=np.concatenate(xy) + SIGMA * rng.normal(size=(n, 2)),
        cov=np.tile(np.eye(2) * SIGMA**2, (n, 1, 1)),
        distance_of=bars if free else np.zeros((0, 2), np.intp),
        distance=np.column_stack([known + 0.02 * rng.normal(size=3), np.full(3, 0.02)])[: 3 * free],
        datum="free" if free else "control", datum_points=np.ones(p, dtype=bool), groups=(None,) * m,
        files=(None,) * m, rig=Rig(np.array(of), np.array(exposure)),
    )  # fmt: skip


def icosahedron() -> Array:
    golden = (1 + 5**0.5) / 2
    signs = [(a, b) for a in (1, -1) for b in (1, -1)]
    corners = [row for a, b in signs for row in ((0, a, b * golden), (a, b * golden, 0), (b * golden, 0, a))]
    return np.array(corners) / np.hypot(1, golden)


def rotation_about(vector: Array) -> Array:
    return cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0]


def sphere(seeds: int) -> Iterator[Drawn]:
    world = np.random.default_rng(11)
    corners, size = icosahedron(), (1200, 1000)
    turns = []
    for corner in corners:
        z = -corner
        x = np.cross(z, np.roll(corner, 1) + 0.1)
        x /= np.linalg.norm(x)
        turns.append(np.array([x, np.cross(z, x), z]))
    stand = [(turn, 900.0 * corner) for turn, corner in zip(turns, corners, strict=True)]
    # Places in the axes of the first camera.
    first, origin = stand[0]
    places = [(turn @ first.T, first @ (at - origin)) for turn, at in stand]
    values = [
        {
            "fx": 1300.0 + 10 * k,
            "fy": 1302.0 + 10 * k,
            "cx": 600.0 + k,
            "cy": 500.0 - k,
            "k1": -0.1 + 0.01 * k,
            "k2": 0.02,
        }
        for k in range(12)
    ]
    cameras = [camera_of(f"camera {k:02d}", size, each) for k, each in enumerate(values)]
    ball = world.normal(size=(80, 3))
    normals = ball / np.linalg.norm(ball, axis=1, keepdims=True)
    xyz = 180.0 * normals * world.uniform(0.9, 1.1, (80, 1))
    exposures = []
    for e in range(8):
        # The ball is moved and turned; the same is told of the rig.
        turn, at = rotation_about(world.normal(size=3)), world.uniform(-90, 90, 3)
        exposures.append((first @ turn, turn.T @ (origin - at)) if e else (first, origin))

    def seen(c: int, rotation: Array, centre: Array) -> Array:
        towards = centre - xyz
        facing = (normals * towards).sum(axis=1) > 0.35 * np.linalg.norm(towards, axis=1)
        own = {name: cameras[c].parameters[name] for name in cameras[c].free}
        xy = projected(xyz, rotation, centre, own)
        return np.flatnonzero(facing & ((xy > 5) & (xy < np.array(size) - 6)).all(axis=1))

    for seed in range(seeds):
        network = network_of(cameras, places, exposures, seen, xyz, np.full((80, 3), np.nan),
                             np.random.default_rng(seed))  # fmt: skip
        yield network, [place[0] for place in places], [place[1] for place in places], xyz


def stereo(seeds: int) -> Iterator[Drawn]:
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 25.0
    board = np.concatenate([grid, np.zeros((54, 1))], axis=1)
    corners: list[list[Array]] = [[], []]
    for k in (1, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14):  # 02 has corners that are wrong
        for side, name in enumerate(("left", "right")):
            image = cv2.imread(str(DATA / f"{name}{k:02d}.jpg"), cv2.IMREAD_GRAYSCALE)
            _, found = cv2.findChessboardCorners(image, (9, 6))
            refined = cv2.cornerSubPix(image, found, (5, 5), (-1, -1), (3, 30, 1e-4))
            corners[side].append(refined.reshape(-1, 2))
    size, objects = (640, 480), [board.astype(np.float32)] * 12
    one, other = (cv2.calibrateCamera(objects, side, size, None, None) for side in corners)
    _, a, da, b, db, turn, shift, *_ = cv2.stereoCalibrate(
        objects, *corners, one[1], one[2], other[1], other[2], size, flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = [
        dict(zip(names, [*m[[0, 1, 0, 1], [0, 1, 2, 2]], *d.ravel()[:5]], strict=True))
        for m, d in ((a, da), (b, db))
    ]
    cameras = [camera_of(name, size, each) for name, each in zip(("left", "right"), values, strict=True)]
    places = [(np.eye(3), np.zeros(3)), (turn, (-turn.T @ shift).ravel())]
    exposures = []
    for seen_left in corners[0]:
        _, pose, away = cv2.solvePnP(board, seen_left.astype(np.float64), a, da)
        rotation = rotation_about(pose)
        exposures.append((rotation, (-rotation.T @ away).ravel()))
    every = np.arange(54)
    for seed in range(seeds):
        network = network_of(cameras, places, exposures, lambda *_: every, board, np.zeros((54, 3)),
                             np.random.default_rng(seed))  # fmt: skip
        yield network, [place[0] for place in places], [place[1] for place in places], board


def printed(what: str, squares: list[Array]) -> None:
    """Root mean square over seeds of mean squares (s,), with its standard error."""
    means = np.array([np.mean(each) for each in squares])
    rms = np.sqrt(means.mean())
    print(f"  {what:<34} {rms:.3f} ± {means.std(ddof=1) / np.sqrt(len(means)) / (2 * rms):.3f}")


class Squares(NamedTuple):
    """Squared errors of one network over their variances, and its size: images, image points, seconds."""

    rotations: Array
    bases: Array
    joint: Array
    interior: Array
    points: Array | None
    images: int
    seen: int
    seconds: float


def squares_of(drawn: Drawn) -> Squares:
    """Adjust a drawn network, and compare it with the truth."""
    start, (network, turns, centres, xyz) = time.process_time(), drawn
    result = adjust_network(network).required()
    found = result.rig
    assert found is not None
    off, away, whole = [], [], []
    for k, name in enumerate(found.cameras):
        c = [camera.id for camera in network.cameras].index(name)
        error = np.concatenate([vector(found.rotation[k] @ turns[c].T), found.base[k] - centres[c]])
        off.append((error[:3] / found.sigma[k, :3]) ** 2)
        away.append((error[3:] / found.sigma[k, 3:]) ** 2)
        whole.append(error @ np.linalg.solve(found.cov[k], error) / 6)
    interior = np.concatenate([
        ((each.values - [camera.parameters[name] for name in each.parameters]) / each.sigma) ** 2
        for each, camera in zip(result.cameras.values(), network.cameras, strict=True)
    ])  # fmt: skip
    points = ((result.points.xyz - xyz) / result.points.sigma) ** 2 if network.datum == "free" else None
    return Squares(
        np.array(off), np.array(away), np.array(whole), interior, points,
        len(network.images), len(network.xy), time.process_time() - start,
    )  # fmt: skip


def cover(title: str, drawn: Iterator[Drawn], executor: Executor) -> None:
    done = list(outcomes(executor, squares_of, drawn))
    print(f"{title}: {done[-1].images} images, {done[-1].seen} image points, {len(done)} seeds, "
          f"{sum(each.seconds for each in done) / len(done):.2f} s of processor time each")  # fmt: skip
    printed("relative rotations", [each.rotations for each in done])
    printed("bases", [each.bases for each in done])
    printed("rotation and base jointly", [each.joint for each in done])
    printed("interior orientations", [each.interior for each in done])
    points = [each.points for each in done if each.points is not None]
    if points:
        printed("object points", points)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=("sphere", "stereo"))
    parser.add_argument("--seeds", type=int, default=200)
    add_options(parser)
    options = parser.parse_args()
    with executor_of(options) as executor:
        if options.part != "stereo":
            cover("sphere of twelve cameras", sphere(options.seeds), executor)
        if options.part != "sphere":
            if DATA.exists():
                cover("stereo pair of OpenCV's chessboards", stereo(options.seeds), executor)
            else:
                print(f"no reference data {DATA}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
