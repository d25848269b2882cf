"""Images whose lines follow each other: an implementation of their own, closed forms, covariances.

The image points are found by bisection of the time at which a point is seen, with SciPy's rotations and, for
frame cameras, OpenCV's projection: nothing of it is shared with the adjustment.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation

from reseau.bundle import Camera, Network, Result, adjust_network
from reseau.bundle.network.settings import network_document
from reseau.bundle.network.shutter import MOTION, Shutter
from reseau.bundle.solver.approximation import resect_line
from reseau.bundle.solver.linear import linearised
from reseau.bundle.solver.values import Correction
from reseau.cli import run
from reseau.core.data import Array
from reseau.core.errors import FormatError, UsageError
from reseau.core.failure import Code, Failure
from reseau.io.network import Network1
from reseau.optics.poses import matrix_to_vector
from reseau_sims import FieldBench, Station

from . import networks
from .test_imaging import dense, system_of

WIDTH, HEIGHT = 640, 480
OPENCV = np.array([810.0, 805.0, 321.0, 238.0, -0.2, 0.05, 4e-4, -3e-4, 0.01, 0.0, 0.0, 0.0])
FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
LINE = np.array([800.0, 321.0, 0.0, -0.12, 0.02, 0.0, 0.0, 0.0])
READ_S = 0.02
"""Time from the first to the last line."""


class Scene(NamedTuple):
    camera: Camera
    rotation: Array
    x0: Array
    motion: Array
    xyz: Array


def frame(camera: Camera, x: Array) -> Array:
    """Image point (2,) of a point in the system of the camera, by OpenCV."""
    if camera.model == "telecentric":
        m, px, py = camera.values[:3]
        return np.array([(px + m * x[0]) / 0.01 + 319.5, 239.5 - (py - m * x[1]) / 0.01])
    if camera.model == "line_scan":
        f, cx, cy, k1, k2, k3, p1, p2 = camera.values
        matrix, k = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]), np.array([k1, k2, p1, p2, k3])
    elif camera.model == "fisheye":
        fx, fy, cx, cy = camera.values[:4]
        matrix, k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), camera.values[4:8].copy()
        return cv2.fisheye.projectPoints(x[None, None], np.zeros(3), np.zeros(3), matrix, k)[0].ravel()
    else:
        fx, fy, cx, cy = camera.values[:4]
        matrix, k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), camera.values[4:9]
    return cv2.projectPoints(x[None], np.zeros(3), np.zeros(3), matrix, k)[0].ravel()


def image_point(scene: Scene, i: int, point: Array, height: int = HEIGHT) -> Array:
    """Image point (2,) by bisection of the line; NaN where there is none within the image."""
    shutter = scene.camera.shutter
    assert shutter is not None
    v, w = scene.motion[i, :3], scene.motion[i, 3:]

    def seen(line: float) -> Array:
        t = (line - (height - 1) / 2) * shutter.line_s
        x = Rotation.from_rotvec(t * w).as_matrix() @ (scene.rotation[i] @ (point - scene.x0[i]) - t * v)
        return frame(scene.camera, x)

    def missing(line: float) -> float:
        return float(seen(line)[1] - (line if shutter.mode == "rolling" else shutter.row))

    if missing(-20.0) * missing(HEIGHT + 20.0) > 0:
        return np.full(2, np.nan)
    line = scipy.optimize.brentq(missing, -20.0, HEIGHT + 20.0, xtol=1e-11)
    return np.array([seen(line)[0], line])


def scene_of(camera: Camera, images: int = 6, points: int = 30, seed: int = 0, size: float = 1.0) -> Scene:
    """Cameras on a ring that move by some per cent of the distance during an image, or by the line."""
    rng = np.random.default_rng(seed)
    world = networks.world(images=images, points=points, size=size)
    shutter = camera.shutter
    assert shutter is not None
    time = HEIGHT * abs(shutter.line_s)
    motion = rng.uniform(-1, 1, (images, 6)) * [0.1, 0.1, 0.1, 0.03, 0.03, 0.03] / time
    if camera.parallel:
        motion *= [size, size, 0.0, 0.0, 0.0, 1.0]
    if shutter.mode == "line":
        motion[:, 1] += (2.4 if camera.model == "line_scan" else 0.8) / time
    motion[:, [not free for free in shutter.is_free]] = 0.0
    return Scene(camera, world.rotation, world.x0, motion, world.xyz)


def world_of(scene: Scene, sigma_px: float = 0.02, control: int = 8) -> networks.World:
    m, p = len(scene.x0), len(scene.xyz)
    image_of, point_of = (a.ravel() for a in np.meshgrid(np.arange(m), np.arange(p), indexing="ij"))
    xy = np.array([image_point(scene, i, scene.xyz[j]) for i, j in zip(image_of, point_of, strict=True)])
    inside = np.isfinite(xy).all(axis=1) & (xy >= 0).all(axis=1) & (xy <= [WIDTH - 1, HEIGHT - 1]).all(axis=1)
    sigma = np.full((p, 3), np.nan)
    sigma[:control] = 0.0
    network = Network(
        cameras=(scene.camera,), images=tuple(f"i{k}" for k in range(m)),
        camera_of=np.zeros(m, dtype=np.intp),
        x0=np.full((m, 3), np.nan), rotation=np.full((m, 3), np.nan),
        points=tuple(f"p{k}" for k in range(p)), xyz=np.where(sigma == 0, scene.xyz, np.nan), sigma=sigma,
        role=tuple("control" if k < control else "tie" for k in range(p)), image_of=image_of[inside],
        point_of=point_of[inside], xy=xy[inside],
        cov=np.tile(np.array([[1.0, 0.3], [0.3, 1.5]]) * sigma_px**2, (int(inside.sum()), 1, 1)),
        distance_of=np.zeros((0, 2), dtype=np.intp), distance=np.zeros((0, 2)), datum="control",
        datum_points=np.ones(p, dtype=bool), groups=(None,) * m, files=(None,) * m, unit="m",
    )  # fmt: skip
    return networks.World(network, scene.rotation, scene.x0, scene.xyz)


def begun(world: networks.World, motion: Array, network: Network | None = None) -> Any:
    problem = world.problem(network)
    return replace(problem, start=replace(problem.start, motion=motion.copy()))


def camera_of(model: str, shutter: Shutter, free: tuple[str, ...] | None = None) -> Camera:
    values = {
        "opencv": OPENCV, "line_scan": LINE,
        "fisheye": np.array([400.0, 402.0, 320.0, 240.0, 0.02, -0.005, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        "telecentric": np.array([8.0] + 9 * [0.0]),
    }  # fmt: skip
    usual = {
        "opencv": FREE, "line_scan": ("f", "cx", "k1"), "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2"),
        "telecentric": ("m",),
    }  # fmt: skip
    return Camera(
        "cam", WIDTH, HEIGHT, (0.01, 0.01), model, values[model], usual[model] if free is None else free,
        shutter=shutter,
    )  # fmt: skip


ROLLING = Shutter("rolling", READ_S / HEIGHT)
KINDS = {
    "rolling": (camera_of("opencv", ROLLING), 1.0),
    "rolling, last line first": (camera_of("opencv", Shutter("rolling", -READ_S / HEIGHT)), 1.0),
    "rolling, shift only": (camera_of("opencv", Shutter("rolling", READ_S / HEIGHT, MOTION[:3])), 1.0),
    "rolling fisheye": (camera_of("fisheye", ROLLING), 1.0),
    "rolling telecentric": (camera_of("telecentric", Shutter("rolling", 1.0)), 0.28),
    "line": (camera_of("line_scan", Shutter("line", 1.0, MOTION[:3])), 0.8),
    "line with rotation": (camera_of("line_scan", Shutter("line", 1e-3)), 0.8),
    "line of a frame camera": (camera_of("opencv", Shutter("line", 1e-3, row=238.0), ("fx",)), 0.8),
}  # fmt: skip
EVERY = pytest.mark.parametrize("kind", KINDS)


def scene_of_kind(kind: str, **more: Any) -> Scene:
    camera, size = KINDS[kind]
    return scene_of(camera, size=size, **more)


@EVERY
def test_image_points_are_those_of_another_implementation(kind: str) -> None:
    scene = scene_of_kind(kind)
    world = world_of(scene)
    assert len(world.network.xy) > 100
    system, _ = system_of(world)
    off, _ = system.misfits(begun(world, scene.motion).start)
    root = np.linalg.inv(np.linalg.cholesky(world.network.cov[0]))
    np.testing.assert_allclose(off @ np.linalg.inv(root).T, 0.0, rtol=0, atol=2e-8)


@EVERY
def test_derivatives_agree_with_finite_differences(kind: str) -> None:
    scene = scene_of_kind(kind, images=2, points=12)
    world = world_of(scene)
    system, _ = system_of(world)
    unknowns, start = system.unknowns, begun(world, scene.motion).start
    linear = linearised(system, start)
    design = dense(linear)
    for column in range(unknowns.size):
        size = float(np.abs(design[:, column]).max())
        if unknowns.dropped[column]:
            continue
        if size == 0:
            pytest.fail(f"{unknowns.names[column]} has no effect")
        h = 0.3 / size
        misfits = []
        for step in (h, -h, 2 * h, -2 * h):
            y = np.zeros(unknowns.size)
            y[column] = step
            moved = start.moved(unknowns, Correction(y, np.zeros_like(start.xyz), 0.0))
            misfits.append(system.misfits(moved)[0].ravel())
        numeric = (8 * (misfits[0] - misfits[1]) - (misfits[2] - misfits[3])) / (12 * h)
        np.testing.assert_allclose(
            design[: len(numeric), column] / size, numeric / size, rtol=0, atol=2e-7,
            err_msg=unknowns.names[column],
        )  # fmt: skip


def test_without_motion_it_is_the_frame_camera() -> None:
    world = networks.world(cameras=(networks.camera("opencv"),))
    camera = world.network.cameras[0]
    held = Shutter("rolling", 1e-4, ())
    moving = replace(world, network=replace(world.network, cameras=(replace(camera, shutter=held),)))
    plain, still = (adjust_network(each.noisy(3)).required() for each in (world, moving))
    np.testing.assert_allclose(still.fit.values.cameras, plain.fit.values.cameras, rtol=1e-10)
    np.testing.assert_allclose(still.fit.values.x0, plain.fit.values.x0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        still.formal_camera_covariance(0), plain.formal_camera_covariance(0), rtol=1e-6
    )
    assert still.motion is None


def test_the_linear_pushbroom_camera_is_that_of_gupta_and_hartley() -> None:
    """x = (m1·X)/(m3·X), y = m2·X with their matrix, for a line without distortion and without rotation."""
    values = np.array([800.0, 321.0, 0, 0, 0, 0, 0, 0])
    camera = replace(camera_of("line_scan", Shutter("line", 1.0, MOTION[:3])), values=values)
    scene = scene_of(camera, size=0.8)
    world = world_of(scene)
    network = world.network
    for i in range(len(scene.x0)):
        rows = network.image_of == i
        v, r = scene.motion[i, :3], scene.rotation[i]
        # Their K·V⁻¹·R(I | −T): time from the second coordinate, the others less what moved until then.
        shear = np.array([[1, -v[0] / v[1], 0], [0, 1 / v[1], 0], [0, -v[2] / v[1], 1.0]])
        inner = np.array([[800.0, 0, 321.0], [0, 1, 0], [0, 0, 1]])
        matrix = inner @ shear @ r @ np.column_stack([np.eye(3), -scene.x0[i]])
        h = np.column_stack([scene.xyz[network.point_of[rows]], np.ones(rows.sum())]) @ matrix.T
        np.testing.assert_allclose(network.xy[rows, 0], h[:, 0] / h[:, 2], rtol=0, atol=1e-8)
        np.testing.assert_allclose(network.xy[rows, 1] - (HEIGHT - 1) / 2, h[:, 1], rtol=0, atol=1e-8)
        u = (network.xy[rows, 0] - 321.0) / 800.0
        found = resect_line(scene.xyz[network.point_of[rows]], u, network.xy[rows, 1] - (HEIGHT - 1) / 2)
        assert found is not None
        np.testing.assert_allclose(found.velocity, v, atol=1e-9)
        np.testing.assert_allclose(found.x0, scene.x0[i], atol=1e-6)
        np.testing.assert_allclose(found.rotation, r, atol=1e-6)


@pytest.mark.parametrize("kind", ["rolling", "rolling telecentric", "line", "line with rotation"])
def test_a_network_is_adjusted_from_its_observations_alone(kind: str) -> None:
    scene = scene_of_kind(kind)
    world = world_of(scene)
    result = adjust_network(world.noisy(2)).required()
    assert result.fit.usable.images.all()
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    found = result.motion
    assert found is not None
    free = np.isfinite(found.sigma) & (found.sigma > 0)
    off = (found.values - scene.motion)[free] / found.sigma[free]
    assert np.abs(off).max() < 4.5
    assert np.sqrt((off**2).mean()) < 1.5


def normalised(kind: str, seeds: range) -> Array:
    """Squares of errors of camera and motions, in their joint covariance, over their number."""
    # With fewer points, or more noise, first order does not suffice.
    scene = scene_of_kind(kind, images=6, points=50)
    world, squares = world_of(scene, 0.002), []
    for seed in seeds:
        network = world.noisy(seed)
        fit = begun(world, scene.motion, network).adjusted()
        assert not isinstance(fit, Failure)
        result = Result(network, fit, np.zeros(len(network.xy), dtype=bool), ())
        names, columns, values = result.camera_columns(0)
        true = scene.camera.parameters
        off = list(values - [true[name] for name in names])
        at = list(columns)
        for i, own in enumerate(fit.unknowns.motion):
            free = np.flatnonzero(network.motion_free[i])
            off += (fit.values.motion[i] - scene.motion[i])[free].tolist()
            at += (own + free).tolist()
        covariance = fit.cofactors.reduced.full[np.ix_(at, at)] * fit.variance
        scale = np.sqrt(np.diag(covariance))
        z = np.array(off) / scale
        squares.append(z @ np.linalg.solve(covariance / np.outer(scale, scale), z) / len(off))
    return np.array(squares)


@pytest.mark.slow
@EVERY
def test_standard_deviations_are_right_to_five_percent(kind: str) -> None:
    assert 0.95 < np.sqrt(normalised(kind, range(100, 300)).mean()) < 1.05


@pytest.mark.slow
def test_a_global_shutter_would_be_wrong_and_is_noticed() -> None:
    scene = scene_of_kind("rolling")
    world = world_of(scene)
    rolling = adjust_network(world.noisy(1)).required()
    plain = replace(world, network=replace(world.network, cameras=(replace(scene.camera, shutter=None),)))
    frozen = adjust_network(plain.noisy(1))
    assert rolling.sigma0 < 1.2
    assert isinstance(frozen, Failure) or frozen.sigma0 > 5.0


def test_motion_is_observed_held_and_tested() -> None:
    scene = scene_of_kind("rolling")
    sigma = dict(zip(MOTION, [0.05, 0.05, 0.05, 0.02, 0.02, 0.02], strict=True))
    observed = replace(scene.camera, shutter=replace(ROLLING, sigma=sigma))
    world = world_of(scene)
    network = replace(world.noisy(1), cameras=(observed,), motion=scene.motion)
    result = adjust_network(network).required()
    free = adjust_network(world.noisy(1)).required()
    # 36 more observations, smaller sigmas, and residuals of the motion.
    assert result.fit.counts[0] == free.fit.counts[0] + 36
    assert result.motion is not None
    assert free.motion is not None
    assert (result.motion.sigma < free.motion.sigma).all()
    held = replace(scene.camera, shutter=replace(ROLLING, free=()))
    fixed = adjust_network(replace(world.noisy(1), cameras=(held,), motion=scene.motion)).required()
    assert fixed.motion is None
    assert fixed.sigma0 == pytest.approx(1.0, abs=0.2)
    assert fixed.redundancy == free.redundancy + 36
    assert max(abs(test.statistic) for test in free.motion.tests) > 4


def test_what_a_shutter_cannot_be_combined_with_is_refused() -> None:
    with pytest.raises(UsageError, match="is not one of vx"):
        Shutter("rolling", 1.0, ("v",))
    with pytest.raises(UsageError, match="write a time other than 0"):
        Shutter("rolling", 0.0)
    with pytest.raises(UsageError, match="write `rolling` or `line`"):
        Shutter("global")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="needs the `side` object"):
        replace(networks.camera("brown-image"), shutter=Shutter("line"))
    with pytest.raises(UsageError, match="does not support a shutter"):
        replace(networks.mapped(networks.camera("opencv")), shutter=ROLLING)


def test_a_network_with_a_shutter_is_written_and_read() -> None:
    scene = scene_of_kind("line with rotation")
    network = replace(world_of(scene).noisy(1), motion=scene.motion)
    content = json.loads(network_document(network).to_json())
    again = Network.from_document(Network1.from_content(content, where="test"))
    assert again.cameras[0].shutter == scene.camera.shutter
    np.testing.assert_array_equal(again.motion, network.motion)
    content = json.loads(network_document(network).to_json())
    content["cameras"][0]["shutter"]["sigma"] = {"vx": -1.0}
    with pytest.raises(FormatError, match="must be above zero"):
        Network1.from_content(content, where="test")


@pytest.mark.slow
def test_points_in_a_plane_do_not_determine_pose_and_velocity_of_a_line() -> None:
    scene = scene_of_kind("line")
    flat = scene._replace(xyz=scene.xyz * [1, 1, 0])
    world = world_of(flat, control=30)
    failure = adjust_network(world.noisy(1))
    assert failure.code is Code.TOO_FEW_POINTS
    posed = replace(
        world.noisy(1), x0=scene.x0, rotation=matrix_to_vector(scene.rotation), motion=scene.motion
    )
    # Each image of a plane has nine unknowns, with the camera held, of which it determines eight.
    alone = replace(posed, cameras=(replace(scene.camera, free=()),))
    singular = adjust_network(alone)
    assert singular.code is Code.RANK_DEFECT
    assert "of image" in singular.reason


@pytest.mark.slow
def test_commands_take_shutters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`reseau bundle` of a network file, and `reseau calibrate --rolling-shutter` of a testfield."""
    scene = scene_of_kind("line")
    path = tmp_path / "network.json"
    network_document(world_of(scene).noisy(1)).write(path)
    assert (
        run(["bundle", str(path), "--report", str(tmp_path / "B.html"), "-o", str(tmp_path / "r.json")]) == 0
    )
    assert "motion of 6 images" in capsys.readouterr().out
    written = json.loads((tmp_path / "r.json").read_text())["motion"]
    off = (np.array(written["motion"]) - scene.motion)[:, :3] / np.array(written["sigma"])[:, :3]
    assert np.abs(off).max() < 5
    assert "Motion during the images" in (tmp_path / "B.html").read_text()

    bench, rng = FieldBench(seed=3, bend_mm=0.0), np.random.default_rng(0)
    bench.design.write(tmp_path / "field.json")
    # A wide lens near the board: in a narrow image rotations and shifts look alike.
    f, near = 220.0, 220.0 / (57.5 / 0.027)
    camera = replace(
        camera_of("opencv", Shutter("rolling", 1e-4)),
        values=np.array([f, f, 119.5, 119.5, 0, 0, 0, 0, 0, 0, 0, 0]), height=240, width=240,
    )  # fmt: skip
    truths = [
        bench.truth(Station(phi, kappa, kappa)) for phi in (0.0, 30.0, 45.0) for kappa in (0.0, 90.0, 180.0)
    ]
    motion = rng.uniform(-1, 1, (9, 6)) * [2000.0, 2000.0, 2000.0, 2.0, 2.0, 2.0]
    still = Scene(
        camera, np.array([t.pose.matrix for t in truths]), near * np.array([t.pose.x0 for t in truths]),
        motion,
        np.zeros((0, 3)),
    )  # fmt: skip
    for i, truth in enumerate(truths):
        lines = ["id,x,y,sx,sy"]
        for j in range(len(truth.names)):
            x, y = image_point(still, i, truth.xyz[j], 240) + 0.005 * rng.normal(size=2)
            if not (0 < x < 239 and 0 < y < 239):
                continue
            lines.append(f"{truth.names[j]},{float(x)!r},{float(y)!r},0.005,0.005")
        (tmp_path / f"{i:02d}.csv").write_text("\n".join(lines) + "\n")
    command = ["calibrate", *map(str, sorted(tmp_path.glob("*.csv"))), "-d", str(tmp_path / "field.json")]
    more = ["--image-size", "240x240", "--free", "fx,fy,cx,cy", "--target", "flat"]
    assert run([*command, *more, "--rolling-shutter", "1e-4", "-o", str(tmp_path / "K.json")]) == 0
    assert "motion of 9 images" in capsys.readouterr().out
    found = json.loads((tmp_path / "K.json").read_text())
    assert found["model"]["shutter"] == {"mode": "rolling", "line_s": 1e-4, "row": 0.0}
    assert found["sigma0"] == pytest.approx(1.0, abs=0.15)
    fx = found["parameters"]["fx"]
    assert abs(fx["value"] - f) < 4 * fx["sigma"]
    assert run([*command, *more]) == 0
    frozen = capsys.readouterr().out
    assert float(frozen.split("sigma0 ")[1].split(",")[0]) > 3


@pytest.mark.slow
def test_a_narrow_lens_does_not_tell_shifts_from_rotations_and_says_so() -> None:
    """Within half a degree of the axis; vx, vy, wz are found where the camera is known."""
    far, size = 200.0, 0.5
    camera = camera_of("opencv", ROLLING)
    values = camera.values.copy()
    values[:2], values[4:] = far * values[:2] * 0.35, 0.0
    scene = scene_of(replace(camera, values=values), points=20, size=size)
    x0 = scene.x0 * far
    motion = scene.motion * [1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    scene = scene._replace(x0=x0, motion=motion)
    network = replace(world_of(scene, sigma_px=0.1).network, xyz=scene.xyz, sigma=np.zeros((20, 3)),
                      x0=x0, rotation=matrix_to_vector(scene.rotation))  # fmt: skip
    noise = 0.1 * np.random.default_rng(0).normal(size=network.xy.shape)
    network = replace(network, xy=network.xy + noise)
    failure = adjust_network(network)
    assert isinstance(failure, Failure)
    assert failure.code is Code.NOT_IDENTIFIED
    assert "(wx, wy) have the effect of shifts (vy, vx)" in failure.reason
    fewer = Shutter("rolling", READ_S / HEIGHT, ("vx", "vy", "wz"))
    chosen = replace(network.cameras[0], shutter=fewer, free=())
    assert adjust_network(network.with_cameras({"cam": chosen})).required().sigma0 < 1.3
