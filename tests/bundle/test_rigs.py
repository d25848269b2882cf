"""Rigs: cameras fixed to each other have one exterior orientation for each exposure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.bundle import Camera, Network, Options, Result, ResultDocument, adjust_network
from reseau.bundle.network.rig import Rig
from reseau.bundle.network.settings import network_document
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.core.failure import Failure
from reseau.io.network import CameraEntry
from reseau.optics.poses import matrix_to_vector, rotation_matrix

from ..montecarlo import tolerance
from .rigs import PLACES, drawn


def relative(network: Network, result: Result, camera: int, exposure: int) -> tuple[Array, Array]:
    """Rotation and centre of a camera in the axes of the first."""
    rows = {
        (int(c), int(e)): k
        for k, (c, e) in enumerate(zip(network.rig.camera, network.rig.exposure, strict=True))  # type: ignore[union-attr]
    }
    a, b, values = rows[0, exposure], rows[camera, exposure], result.fit.values
    turn = values.rotation[b] @ values.rotation[a].T
    return matrix_to_vector(turn), values.rotation[a] @ (values.x0[b] - values.x0[a])


def test_the_relative_orientation_is_the_same_in_all_exposures() -> None:
    network = drawn()
    result = adjust_network(network).required()
    assert result.sigma0 == pytest.approx(1.0, abs=0.15)
    turns, bases = zip(*(relative(network, result, 1, e) for e in range(8)), strict=True)
    assert np.ptp(turns, axis=0).max() < 1e-9
    assert np.ptp(bases, axis=0).max() < 1e-6
    found = result.rig
    assert found is not None
    assert found.cameras == ("camera 1",)
    assert np.abs(found.base[0] - PLACES[1][1]).max() < 4 * found.sigma[0, 3:].max()
    free = adjust_network(replace(network, rig=None)).required()
    assert result.redundancy == free.redundancy + 6 * 7


@pytest.mark.slow
@pytest.mark.parametrize("control", [False, True])
def test_errors_of_places_cameras_and_points_have_their_covariances(control: bool) -> None:
    q, points, principal, runs = [], [], [], 200
    for seed in range(runs):
        network = drawn(seed, cameras=3, left_out=((2, 0), (0, 1), (1, 2)), control=control)
        result = adjust_network(network).required()
        found = result.rig
        assert found is not None
        for k, (vector, base) in enumerate(PLACES[1:]):
            turn = matrix_to_vector(found.rotation[k] @ rotation_matrix(vector).T)
            error = np.concatenate([turn, found.base[k] - base])
            q.append(error @ np.linalg.solve(found.cov[k], error) / 6)
        if control:
            off = result.points.xyz[1:6] - network.xyz[1:6]
            points += [
                d @ np.linalg.solve(c, d) / 3 for d, c in zip(off, result.points.cov[1:6], strict=True)
            ]
        cameras = zip(result.cameras.values(), (6.0, 6.2, 5.9), strict=True)
        principal += [(each.values[0] - c) / each.sigma[0] for each, c in cameras]
    # Of two places of six coordinates, and of five points of three, ten vary as if independent.
    assert np.mean(q) == pytest.approx(1.0, abs=tolerance(10 * runs))
    assert not control or np.mean(points) == pytest.approx(1.0, abs=tolerance(10 * runs))
    assert np.mean(np.square(principal)) == pytest.approx(1.0, abs=tolerance(len(principal)))


def test_places_are_found_from_images_without_poses() -> None:
    network = drawn(cameras=3, left_out=((2, 0), (0, 1), (1, 2)), control=True)
    cold = replace(
        network, x0=np.full_like(network.x0, np.nan), rotation=np.full_like(network.rotation, np.nan)
    )
    one, other = (adjust_network(each).required().rig for each in (network, cold))
    assert one is not None
    assert other is not None
    assert np.abs(one.base - other.base).max() < 1e-4
    assert np.abs(one.rotation - other.rotation).max() < 1e-7


def test_cameras_that_share_no_exposure_are_connected_by_a_third() -> None:
    apart = tuple((2, e) for e in range(4)) + tuple((0, e) for e in range(4, 8))
    network = drawn(cameras=3, left_out=apart)
    found = adjust_network(network).required().rig
    assert found is not None
    assert found.references == ("camera 0",) * 2
    assert np.abs(found.base - [base for _, base in PLACES[1:]]).max() < 5 * found.sigma[:, 3:].max()


def test_cameras_that_nothing_connects_are_rigs_of_their_own() -> None:
    network = drawn(cameras=2, left_out=tuple((0, e) for e in range(4)) + tuple((1, e) for e in range(4, 8)))
    with_rig, without = (adjust_network(each).required() for each in (network, replace(network, rig=None)))
    assert with_rig.rig is not None
    assert with_rig.rig.cameras == ()
    assert np.abs(with_rig.images.x0 - without.images.x0).max() < 1e-3
    assert with_rig.redundancy == without.redundancy


def test_two_images_of_a_camera_in_one_exposure_are_refused() -> None:
    with pytest.raises(UsageError, match="two images of one exposure"):
        Rig(np.array([0, 0]), np.array([3, 3]))


def test_a_rig_is_a_column_of_the_document() -> None:
    network = drawn(cameras=3, left_out=((2, 0), (0, 1)))
    again = Network.from_document(network_document(network))
    assert again.rig is not None
    assert (again.rig.exposure == network.rig.exposure).all()  # type: ignore[union-attr]
    one, other = (adjust_network(each).required().rig for each in (network, again))
    assert np.abs(one.base - other.base).max() < 1e-9  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("cold", [False, True])
def test_an_image_that_was_not_taken_at_once_is_named_and_left_out_of_the_rig(cold: bool) -> None:
    network = drawn(cameras=3, control=True)
    odd, later = network.images.index("1-3"), network.images.index("1-6")
    # Camera 1 was late: in exposure 3 it has the image of exposure 6, which is not used itself.
    images = np.array([odd if i == later else -1 if i == odd else i for i in range(len(network.images))])
    at = images[network.image_of]
    x0, rotation = network.x0.copy(), network.rotation.copy()
    x0[odd], rotation[odd] = x0[later], rotation[later]
    if cold:
        x0[:], rotation[:] = np.nan, np.nan
    moved = replace(network.select(at >= 0), image_of=at[at >= 0], x0=x0, rotation=rotation)
    result = adjust_network(moved, Options(outliers="reject")).required()
    said = "images 1-3 were not taken at once with the others of their exposure; adjusted apart from the rig"
    assert said in [str(warning) for warning in result.warnings]
    assert result.rig is not None
    assert np.abs(result.rig.base[0] - PLACES[1][1]).max() < 5 * result.rig.sigma[0, 3:].max()
    assert result.sigma0 == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_exposures_that_are_all_shifted_are_no_rig() -> None:
    network = drawn()
    rig = Rig(network.camera_of, (np.arange(len(network.images)) // 2 + network.camera_of) % 8)
    result = adjust_network(replace(network, rig=rig))
    said = result.reason if isinstance(result, Failure) else " ".join(map(str, result.warnings))
    assert "were the images of an exposure taken at once?" in said


def with_bases(network: Network, *bases: tuple[int, int, float, float]) -> Network:
    """The network with known bases (camera, camera, error, sigma), and without the distance of its points."""
    centres = np.array([base for _, base in PLACES])
    true = [float(np.linalg.norm(centres[b] - centres[a])) for a, b, *_ in bases]
    rig = replace(
        network.rig or Rig(network.camera_of, network.camera_of),
        base_of=np.array([(a, b) for a, b, *_ in bases]),
        base=np.array([(length + off, sigma) for length, (*_, off, sigma) in zip(true, bases, strict=True)]),
    )
    return replace(network, rig=rig, distance_of=np.zeros((0, 2), np.intp), distance=np.zeros((0, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("cold", [False, True])
def test_a_known_base_gives_the_scale(cold: bool) -> None:
    """Of two cameras that share no exposure: a third connects them."""
    apart = tuple((2, e) for e in range(4)) + tuple((0, e) for e in range(4, 8))
    network = with_bases(drawn(cameras=3, left_out=apart), (0, 2, 0.0, 0.01))
    if cold:
        nothing = np.full_like(network.x0, np.nan)
        unknown = np.full_like(network.xyz, np.nan)
        network = replace(network, x0=nothing, rotation=nothing, xyz=unknown)
    result = adjust_network(network).required()
    assert result.rig is not None
    assert result.rig.length[1] == pytest.approx(np.linalg.norm(PLACES[2][1]), abs=1e-6)
    assert result.rig.length_sigma[1] == pytest.approx(0.01 * max(1.0, result.sigma0), rel=0.3)
    without = Rig(network.camera_of, network.rig.exposure)  # type: ignore[union-attr]
    free = adjust_network(replace(network, rig=without)).required()
    assert result.redundancy == free.redundancy


@pytest.mark.slow
def test_errors_with_known_bases_have_their_covariances() -> None:
    q, rng = [], np.random.default_rng(9)
    for seed in range(25):
        bases = [(a, b, float(0.05 * rng.normal()), 0.05) for a, b in ((0, 1), (0, 2), (1, 2))]
        network = with_bases(drawn(seed, cameras=3, left_out=((2, 0), (0, 1), (1, 2))), *bases)
        result = adjust_network(network).required()
        found = result.rig
        assert found is not None
        for k, (vector, base) in enumerate(PLACES[1:]):
            turn = matrix_to_vector(found.rotation[k] @ rotation_matrix(vector).T)
            error = np.concatenate([turn, found.base[k] - base])
            q.append(error @ np.linalg.solve(found.cov[k], error) / 6)
    # 50 places of 6 coordinates: a mean square of 1 ± 0.08.
    assert np.mean(q) == pytest.approx(1.0, abs=0.3)


def test_a_wrong_base_is_named_and_reported_in_the_result() -> None:
    network = with_bases(drawn(cameras=3, control=True), (0, 1, 2.0, 0.05), (0, 2, 0.0, 0.05))
    result = adjust_network(network).required()
    said = "the distance camera camera 0 to camera camera 1 (152.266 mm, by "
    assert any(str(warning).startswith(said) for warning in result.warnings)
    table = ResultDocument.of(result).to_dict()["bases"]
    assert (table["from"], table["to"]) == (["camera 0", "camera 0"], ["camera 1", "camera 2"])
    assert table["w"][0] > 5 > table["w"][1]


def test_bases_are_part_of_the_document() -> None:
    network = with_bases(drawn(), (0, 1, 0.0, 0.05))
    again = Network.from_document(network_document(network))
    assert again.rig is not None
    assert network.rig is not None
    assert (again.rig.base_of == network.rig.base_of).all()
    assert (again.rig.base == network.rig.base).all()


@pytest.mark.parametrize(
    ("bases", "said"),
    [
        (((0, 0, 10.0, 0.1),), "cameras that exposures connect"),
        (((0, 1, 10.0, 0.0),), "above zero"),
    ],
)
def test_bases_that_are_none_are_refused(bases: tuple[tuple[int, int, float, float], ...], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        with_bases(drawn(), *bases)


def interior(matrix: Array, distortion: Array) -> Array:
    """fx, fy, cx, cy, k1, k2, p1, p2, k3 of OpenCV's calibration."""
    return np.array([*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *distortion.ravel()[:5]])


@pytest.mark.slow
def test_a_stereo_pair_is_that_of_opencv_on_the_same_corners(
    reference_data: Callable[[str], Path],
) -> None:
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 25.0
    board = np.concatenate([grid, np.zeros((54, 1))], axis=1)
    corners: list[list[Array]] = [[], []]
    for k in (1, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14):  # 02 has corners that are wrong
        for side, name in enumerate(("left", "right")):
            file = reference_data("chessboard_stereo") / f"{name}{k:02d}.jpg"
            image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            seen, found = cv2.findChessboardCorners(image, (9, 6))
            assert seen, file
            refined = cv2.cornerSubPix(image, found, (5, 5), (-1, -1), (3, 30, 1e-4))
            corners[side].append(refined.reshape(-1, 2).astype(np.float64))
    size, count = (640, 480), len(corners[0])
    object_points = [board.astype(np.float32)] * count
    pixels = [[c.astype(np.float32) for c in one] for one in corners]
    start = [cv2.calibrateCamera(object_points, one, size, None, None) for one in pixels]
    ends = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
    rms, a, da, b, db, turn, base, *_ = cv2.stereoCalibrate(
        object_points, *pixels, start[0][1], start[0][2], start[1][1], start[1][2], size,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=ends,
    )  # fmt: skip
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    cameras = tuple(
        Camera.from_entry(CameraEntry.model_validate({
            "id": name, "width": 640, "height": 480, "model": "opencv", "free": names,
            "parameters": dict(zip(names, interior(*s[1:3]), strict=True)),
        }))
        for name, s in zip(("left", "right"), start, strict=True)
    )  # fmt: skip
    m, n = 2 * count, 2 * count * 54
    network = Network(
        cameras=cameras, images=tuple(f"{side}{e}" for e in range(count) for side in "lr"),
        camera_of=np.tile([0, 1], count), x0=np.full((m, 3), np.nan), rotation=np.full((m, 3), np.nan),
        points=tuple(str(k) for k in range(54)), xyz=board, sigma=np.zeros((54, 3)), role=("control",) * 54,
        image_of=np.repeat(np.arange(m), 54), point_of=np.tile(np.arange(54), m),
        xy=np.concatenate([corners[k % 2][k // 2] for k in range(m)]),
        cov=np.tile(0.01 * np.eye(2), (n, 1, 1)), distance_of=np.zeros((0, 2), np.intp),
        distance=np.zeros((0, 2)), datum="control", datum_points=np.ones(54, dtype=bool), groups=(None,) * m,
        files=(None,) * m, rig=Rig(np.tile([0, 1], count), np.repeat(np.arange(count), 2)),
    )  # fmt: skip
    result = adjust_network(network).required()
    rig = result.rig
    assert rig is not None
    # OpenCV's corners are of single precision, and its iterations end early: 0.01 sigma.
    assert np.abs(rig.base[0] + turn.T @ base.ravel()).max() < 0.02 * rig.sigma[0, 3:].min()
    assert np.abs(rig.rotation[0] - turn).max() < 0.02 * rig.sigma[0, :3].min()
    for found, k, d in zip(result.cameras.values(), (a, b), (da, db), strict=True):
        assert (np.abs(found.values - interior(k, d)) < 0.05 * found.sigma).all()
    residuals = result.fit.residuals[: 2 * n]
    assert np.sqrt((residuals**2).sum() / n) == pytest.approx(rms, rel=1e-4)
