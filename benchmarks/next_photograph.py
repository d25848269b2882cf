"""The photograph that a calibration proposes, beside the best of thousands that a person could take.

    python benchmarks/next_photograph.py [--seeds 12] [--target free] [--jobs 2]

For every seed, another camera has seen another board in a few photographs, taken by one of the habits in
`HABITS`. Image points are those of OpenCV's projection, with noise. Derivatives, normal equations, and the
largest standard deviation in the corners of the image are computed here from OpenCV's derivatives, at the
true parameters: nothing is used of the project but the proposal and the calibrations before and after it.
`--target flat` holds the points of the board as designed; by default they are unknowns.

The gain of a photograph is the logarithm of the factor by which it lowers that standard deviation. A row
shows that of the proposal as a share of the gain of the best pose that can be taken, which is looked for by
brute force: board at most 45° from the image plane, at the distances of the photographs so far up to a factor
of 1.6, at least 75 % of its points in the image. It also shows what was predicted, what the calibration with
the photograph states, and the errors of both calibrations in the worst corner.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from worlds import prints

from reseau.bundle.diagnostics.fields import camera_mapping
from reseau.calibration import projection_field
from reseau.core.data import Array, ImagePoints
from reseau.core.failure import Failure
from reseau.designs import board
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CalibrationOptions, CameraOptions

FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
HABITS = {
    "all around": (0.8, (20.0, 40.0), 0.16),
    "hardly tilted": (0.8, (3.0, 15.0), 0.16),
    "in the middle": (0.6, (20.0, 40.0), 0.03),
    "far away": (0.45, (20.0, 40.0), 0.25),
}
"""Share of the image that the board extends over, tilts (degrees), and how far it is from the middle."""
MOST_TILT_DEG, FURTHER, LEAST, MARGIN_PX = 45.0, 1.6, 0.75, 6.0
POSES, CHANGES = 1200, 400
SIGMA_PX, UNKNOWN_MM = 0.02, 10.0


class Taken(NamedTuple):
    """A pose of the camera: x_c = R X + t."""

    rotation: Array
    shift: Array


@dataclass(frozen=True, eq=False)
class World:
    """A camera, a board, and the photographs so far."""

    size: tuple[int, int]
    matrix: Array
    distortion: Array
    names: tuple[str, ...]
    design: Any
    xyz: Array
    taken: list[Taken]
    habit: str

    def seen(self, pose: Taken) -> tuple[Array, Array, Array, Array]:
        """Images of the points inside the image, their rows, derivatives by pose and by the camera."""
        turn = cv2.Rodrigues(pose.rotation)[0]
        xy, slopes = cv2.projectPoints(self.xyz, turn, pose.shift, self.matrix, self.distortion)[:2]
        xy, depth = xy[:, 0], (self.xyz @ pose.rotation.T + pose.shift)[:, 2]
        inside = ((xy >= MARGIN_PX) & (xy <= np.array(self.size) - 1 - MARGIN_PX)).all(axis=1) & (depth > 0)
        slopes = slopes.reshape(-1, 2, slopes.shape[1])[inside]
        return xy[inside], np.flatnonzero(inside), slopes[:, :, :6], slopes[:, :, 6:14]

    def measured(self, pose: Taken, rng: np.random.Generator) -> ImagePoints:
        """Points as they would be measured."""
        xy, rows, _, _ = self.seen(pose)
        return ImagePoints.with_sigma(
            [self.names[k] for k in rows], xy + rng.normal(0, SIGMA_PX, xy.shape), SIGMA_PX
        )

    def away(self, pose: Taken) -> float:
        """Distance of the camera from the middle of the board."""
        return float(np.linalg.norm(pose.rotation @ self.xyz.mean(axis=0) + pose.shift))

    def can_be_taken(self, pose: Taken) -> bool:
        """Whether a person could take this photograph like the others."""
        away = [self.away(each) for each in self.taken]
        tilt = np.degrees(np.arccos(min(abs(pose.rotation[2, 2]), 1.0)))
        if tilt > MOST_TILT_DEG + 0.1 or not min(away) / FURTHER < self.away(pose) * 1.001:
            return False
        if not self.away(pose) < max(away) * FURTHER * 1.001:
            return False
        return len(self.seen(pose)[1]) >= LEAST * len(self.xyz)


def world_of(seed: int) -> World:
    """The camera, the board and the habit of a seed."""
    rng = np.random.default_rng([seed, 2026])
    size = [(960, 720), (1280, 720), (720, 960), (1000, 1000)][rng.integers(4)]
    habit = [*HABITS][seed % len(HABITS)]
    focal = max(size) * rng.uniform(0.6, 1.5)
    middle = (np.array(size) - 1) / 2 + rng.normal(0, 8, 2)
    matrix = np.array([[focal, 0, middle[0]], [0, focal * (1 + 1e-3 * rng.normal()), middle[1]], [0, 0, 1]])
    corner = np.hypot(*size) / 2 / focal
    bend = rng.uniform(-0.15, 0.03) / corner**2
    distortion = np.array([bend, 0.25 * bend * bend, *rng.normal(0, 4e-4, 2)])
    columns, rows = [(9, 6), (7, 10), (11, 8)][rng.integers(3)]
    printed = prints.charuco(columns, rows, 28.0, 20.0, "DICT_5X5_250")
    xyz = np.column_stack([printed.xy, np.zeros(len(printed.xy))])
    world = World(
        size, matrix, distortion, printed.ids, board("charuco", columns, rows, 28.0), xyz, [], habit
    )
    fill, tilts, aside = HABITS[habit]
    for k in range(int(rng.integers(4, 10))):
        turn = 360 * rng.uniform()
        world.taken.append(
            posed(
                world, rng.uniform(0.85, 1.1) * fill, rng.uniform(*tilts), turn,
                90 * (k % 4) + rng.uniform(-10, 10), rng.uniform(-aside, aside, 2),
            )
        )  # fmt: skip
    return world


def posed(world: World, fill: float, tilt: float, towards: float, roll: float, aside: Array) -> Taken:
    """A pose: the board extends over a share of the image, its middle lies aside of that of the image."""
    axis = np.deg2rad(tilt) * np.array([np.cos(np.deg2rad(towards)), np.sin(np.deg2rad(towards)), 0])
    spin = cv2.Rodrigues(np.array([0, 0, np.deg2rad(roll)]))[0] @ np.diag([1.0, -1.0, -1.0])
    rotation = cv2.Rodrigues(axis)[0] @ spin
    half = np.abs(spin[:2, :2]) @ np.ptp(world.xyz, axis=0)[:2]
    away = float((world.matrix[0, 0] * half / (fill * np.array(world.size))).max())
    pixel = (np.array(world.size) - 1) / 2 + aside * world.size
    ray = cv2.undistortPoints(pixel[None, None], world.matrix, world.distortion)[0, 0]
    return Taken(rotation, away * np.append(ray, 1.0) - rotation @ world.xyz.mean(axis=0))


def changed(world: World, pose: Taken, rng: np.random.Generator) -> Taken:
    """A pose nearby."""
    size = float(10 ** rng.uniform(-2, -0.5))
    turn = cv2.Rodrigues(size * rng.normal(size=3))[0] @ pose.rotation
    centre = pose.rotation @ world.xyz.mean(axis=0) + pose.shift
    centre = centre + size * 0.4 * centre[2] * rng.normal(size=3) * [1, 1, 0.7]
    return Taken(turn, centre - turn @ world.xyz.mean(axis=0))


def possible(world: World, rng: np.random.Generator) -> Iterator[Taken]:
    """Poses that a person can take: of a raster first, then by chance."""
    for fill in (0.55, 0.75, 0.95, 1.15):
        for tilt in (0.0, 25.0, 42.0):
            for towards in range(0, 360, 45) if tilt else (0,):
                for roll in (0, 90):
                    for x in (-0.25, 0.0, 0.25):
                        for y in (-0.25, 0.0, 0.25):
                            yield posed(world, fill, tilt, towards, roll, np.array([x, y]))
    while True:
        yield posed(
            world, rng.uniform(0.4, 1.3), MOST_TILT_DEG * np.sqrt(rng.uniform()), 360 * rng.uniform(),
            90 * rng.integers(4), rng.uniform(-0.35, 0.35, 2),
        )  # fmt: skip


class Judge:
    """The largest standard deviation in the corners, by dense normal equations at the true parameters."""

    def __init__(self, world: World, target: str) -> None:
        self.world, count = world, len(world.xyz)
        free = np.ones((count, 3), dtype=np.bool_)
        # A free network has a datum of seven coordinates, of three points in the corners of the board.
        low, far = int(world.xyz.sum(axis=1).argmin()), int(world.xyz.sum(axis=1).argmax())
        beside = int((world.xyz[:, 0] - world.xyz[:, 1]).argmax())
        free[low], free[far, [0, 2]], free[beside, 2] = False, False, False
        free &= target == "free"
        free[far, 1] &= target == "free"
        self.columns = np.concatenate([np.ones(8, dtype=np.bool_), free.ravel()])
        # Points that no photograph shows, or one, are unknown to a centimetre.
        known = np.concatenate([np.zeros(8), np.full(3 * count, 1 / UNKNOWN_MM**2)])[self.columns]
        self.normal = np.diag(known) + sum(self.of(pose) for pose in world.taken)
        size = np.array(world.size)
        corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (size - 1)).astype(np.float64)
        raster = np.stack(np.meshgrid(*[np.linspace(0, n - 1, 13) for n in size]), axis=-1).reshape(-1, 2)
        self.slope = self.referred(np.concatenate([corners, raster]))[:4]
        self.before = self.sigma(self.normal)

    def directions(self, xy: Array) -> Array:
        """Rays (n, 3) through pixels."""
        world, none = self.world, np.zeros(3)
        focal = world.matrix[[0, 1], [0, 1]]
        uv = (xy - world.matrix[:2, 2]) / focal
        for _ in range(100):
            rays = np.column_stack([uv, np.ones(len(uv))])
            off = cv2.projectPoints(rays, none, none, world.matrix, world.distortion)[0][:, 0] - xy
            uv = uv - off / focal
        assert np.abs(off).max() < 1e-6
        return np.column_stack([uv, np.ones(len(uv))])

    def referred(self, xy: Array) -> Array:
        """Derivatives of pixels by the camera, without what a rotation explains over all of them."""
        none = np.zeros(3)
        slopes = cv2.projectPoints(self.directions(xy), none, none, self.world.matrix, self.world.distortion)[
            1
        ]
        around, own = slopes[:, :3], slopes[:, 6:14]
        own = own - around @ np.linalg.lstsq(around, own, rcond=None)[0]
        return np.asarray(own.reshape(-1, 2, 8))

    def of(self, pose: Taken) -> Array:
        """Normal matrix of camera and points from a photograph, its pose eliminated."""
        _, rows, by_pose, by_camera = self.world.seen(pose)
        m = len(rows)
        slopes = np.zeros((m, 2, 8 + 3 * len(self.world.xyz)))
        slopes[:, :, :8] = by_camera
        by_point = by_pose[:, :, 3:6] @ pose.rotation
        for k in range(3):
            slopes[np.arange(m), :, 8 + 3 * rows + k] = by_point[:, :, k]
        flat, around = slopes.reshape(2 * m, -1)[:, self.columns], by_pose.reshape(2 * m, 6)
        q = np.linalg.qr(around)[0]
        flat = flat - q @ (q.T @ flat)
        return np.asarray(flat.T @ flat) / SIGMA_PX**2

    def sigma(self, normal: Array) -> float:
        """Standard deviation in the worst corner, along the worst direction, px."""
        cov = np.linalg.inv(normal)[:8, :8]
        return float(np.sqrt(np.linalg.eigvalsh(self.slope @ cov @ np.swapaxes(self.slope, 1, 2)).max()))

    def after(self, pose: Taken) -> float:
        """The same with another photograph."""
        return self.sigma(self.normal + self.of(pose))

    def error(self, done: Calibrated) -> float:
        """Error of a calibration in the worst corner, after the rotation that fits best, px."""
        size = np.array(self.world.size) - 1
        raster = np.stack(np.meshgrid(*[np.linspace(0, n, 13) for n in size]), axis=-1).reshape(-1, 2)
        rays = self.directions(raster)
        none = np.zeros(3)
        true, slopes = cv2.projectPoints(rays, none, none, self.world.matrix, self.world.distortion)[:2]
        off = (camera_mapping(done.result, 0).mapping(rays[:, :2]) - true[:, 0]).ravel()
        off -= slopes[:, :3] @ np.linalg.lstsq(slopes[:, :3], off, rcond=None)[0]
        return float(np.linalg.norm(off.reshape(13, 13, 2)[[0, 0, -1, -1], [0, -1, 0, -1]], axis=1).max())


def calibrated(world: World, photographs: list[tuple[str, ImagePoints]], target: str) -> Calibrated | Failure:
    """Calibrate with the project."""
    options = CalibrationOptions(target=target)  # type: ignore[arg-type]
    return calibrate_camera(
        photographs,
        world.design,
        lambda frame: None,
        world.size,
        CameraOptions("opencv", FREE),
        options,  # type: ignore[arg-type, return-value]
    )


def as_taken(world: World, done: Calibrated) -> Taken:
    """The proposed pose, in the system of the true coordinates."""
    then = done.assessments["camera"].next_photograph
    assert then is not None
    assert then.pose is not None
    names, points = list(done.result.network.points), done.result.fit.values.xyz
    ours = np.array([points[names.index(name)] for name in world.names if name in names])
    true = np.array([xyz for name, xyz in zip(world.names, world.xyz, strict=True) if name in names])
    # Helmert transformation (Umeyama 1991): ours = middle + scale · turn · (true - centre).
    middle, centre = ours.mean(axis=0), true.mean(axis=0)
    u, s, vt = np.linalg.svd((ours - middle).T @ (true - centre))
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn, scale = u @ proper @ vt, (s * np.diag(proper)).sum() / np.square(true - centre).sum()
    rotation = then.pose.matrix
    shift = rotation @ (middle - scale * turn @ centre - then.pose.x0)
    return Taken(rotation @ turn, shift / scale)


@dataclass(frozen=True)
class Row:
    """What became of the proposal of a seed; `after` and the following are NaN without a proposal."""

    seed: int
    habit: str
    images: int
    before: float
    best: float
    median: float
    after: float
    predicted: float
    stated: float
    error_before: float
    error_after: float
    words: str
    can: bool
    seconds: float

    @property
    def share(self) -> float:
        """Share of the gain of the best pose; none without a proposal."""
        if not np.isfinite(self.after):
            return 0.0
        return float(np.log(self.before / self.after) / np.log(self.before / self.best))

    @property
    def line(self) -> str:
        """The row as printed."""
        return (
            f"{self.seed:3d} {self.habit:<14} {self.images:3d} {self.before:8.4f} {self.best:8.4f} "
            f"{self.median:8.4f} {self.after:9.4f} {self.share:6.2f} {self.predicted:10.4f} "
            f"{self.stated:8.4f} {self.error_before:7.4f} {self.error_after:7.4f} {self.seconds:5.2f} "
            f" {self.words}" + ("" if self.can else "  (cannot be taken)")
        )


def judged(target: str, seed: int) -> Row | str:
    """Calibrate, take the proposed photograph, and judge it; or why there is no calibration."""
    rng, world = np.random.default_rng([seed, 7]), world_of(seed)
    photographs = [(f"{k}.png", world.measured(pose, rng)) for k, pose in enumerate(world.taken)]
    done = calibrated(world, photographs, target)
    if isinstance(done, Failure):
        return f"{seed:3d} {world.habit:<14} {len(photographs):3d} declined: {done.reason}"
    judge = Judge(world, target)
    begun = time.process_time()
    then = done.assessments["camera"].next_photograph
    seconds = time.process_time() - begun
    others = []
    for pose in possible(world, rng):
        if world.can_be_taken(pose):
            others.append((judge.after(pose), pose))
        if len(others) == POSES:
            break
    median = float(np.median([sigma for sigma, _ in others]))
    best, pose = min(others, key=lambda each: each[0])
    for _ in range(CHANGES):
        more = changed(world, pose, rng)
        if world.can_be_taken(more):
            best, pose = min((best, pose), (judge.after(more), more), key=lambda each: each[0])
    nothing = float("nan")
    if then is None:
        words, can = done.assessments["camera"].lines[1], True
        return Row(seed, world.habit, len(photographs), judge.before, best, median, nothing, nothing, nothing,
                   judge.error(done), nothing, words, can, seconds)  # fmt: skip
    pose = as_taken(world, done)
    again = calibrated(world, [*photographs, ("next.png", world.measured(pose, rng))], target).required()
    corners = camera_mapping(again.result, 0)
    return Row(
        seed, world.habit, len(photographs), judge.before, best, median, judge.after(pose), then.worst_px,
        float(projection_field(corners, 13).worst_px), judge.error(done), judge.error(again), then.text,
        world.can_be_taken(pose), seconds,
    )  # fmt: skip


def main() -> None:
    """Print a row for every seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--target", choices=("free", "flat"), default="free")
    add_options(parser)
    given = parser.parse_args()
    print(
        "standard deviation in the worst corner, px; share of the gain of the best pose; errors, px; time, s"
    )
    print(f"{'seed habit':<18} {'n':>3} {'before':>8} {'best':>8} {'median':>8} {'proposed':>9} {'share':>6} "
          f"{'predicted':>10} {'stated':>8} {'errors':>15} {'time':>5}")  # fmt: skip
    rows = []
    with executor_of(given) as executor:
        for row in outcomes(
            executor, partial(judged, given.target), range(given.first, given.first + given.seeds)
        ):
            print(row if isinstance(row, str) else row.line, flush=True)
            if isinstance(row, Row):
                rows.append(row)
    share = np.array([row.share for row in rows])
    print(
        f"share of the gain: median {np.median(share):.2f}, mean {share.mean():.2f}, least {share.min():.2f}"
    )
    record("share of the gain of the best pose", f"{given.target} points", share)


if __name__ == "__main__":
    main_of(__file__)
