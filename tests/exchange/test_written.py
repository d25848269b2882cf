"""Adjusted networks in files of other programs: the peers project the same points to the same pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle import Options, Result, adjust_network, example_network
from reseau.bundle.network.settings import network_document
from reseau.calibration import CameraMapping
from reseau.cli import run
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.exchange import read_network
from reseau.exchange.calibrations import calibration_formats
from reseau.exchange.calibrations.formats import exported_lens
from reseau.exchange.networks import write_network
from reseau.optics import PixelGrid
from reseau.optics.cameras.registry import camera_model

from .scene import residuals

EXACT_PX = 0.01


@pytest.fixture(scope="module", params=["one camera", "two cameras and blunders"])
def result(request: pytest.FixtureRequest) -> Result:
    network = example_network()
    if request.param == "one camera":
        return adjust_network(network).required()
    (camera,), xy = network.cameras, network.xy.copy()
    xy[[17, 90]] += [[25.0, -8.0], [0.0, 31.0]]
    cameras = (camera, replace(camera, id="other"))
    network = replace(network, cameras=cameras, camera_of=np.arange(8) % 2, xy=xy)
    found = adjust_network(network, Options(outliers="reject")).required()
    assert found.rejected[[17, 90]].all()
    assert found.rejected.sum() < 6
    return found


def projected(result: Result) -> Array:
    """Image coordinates (n, 2) of the adjusted network."""
    return np.asarray(result.network.xy + result.residuals)


def test_the_residuals_are_computed_minus_observed(result: Result) -> None:
    from reseau.bundle.modelling.calibration import with_estimates

    assert np.abs(residuals(with_estimates(result)) - result.residuals).max() < 1e-6


def test_a_camera_that_colmap_has_is_written_as_it_is_although_it_folds_beyond_the_points() -> None:
    model = camera_model("opencv")
    given = {"fx": 900.0, "fy": 905.0, "cx": 320.0, "cy": 240.0, "k1": -0.05, "k2": -8.0}
    grid = PixelGrid(1280, 960, (1.0, 1.0))
    mapping = model.mapping([given.get(name, 0.0) for name in model.names], grid)
    lens = CameraMapping(mapping, 1280, 960, np.zeros(0, np.intp), np.zeros((0, 0)))
    assert np.isnan(lens.mapping.inverse(np.array([[1279.0, 959.0]]))).any()
    form, stored = calibration_formats()["colmap"], {"model": "opencv", "pitch_mm": (1.0, 1.0)}
    written = exported_lens(form, "camera", lens, stored)
    assert written.greatest_px == 0.0
    assert {name: value for name, value in written.camera.parameters.items() if value} == given


@pytest.mark.parametrize("kind", ["SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"])
@pytest.mark.parametrize("binary", [False, True])
def test_fisheyes_of_colmap_with_one_focal_length_are_read(kind: str, binary: bool, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap (extra `peers`)")
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=3)
    options.num_points3D, options.camera_model_id = 30, getattr(pycolmap.CameraModelId, kind)
    options.camera_width, options.camera_height = 640, 480
    options.camera_params = [400.0, 320.0, 240.0, 0.02, -0.01][: 4 + (kind == "RADIAL_FISHEYE")]
    scene = pycolmap.synthesize_dataset(options)
    (scene.write_binary if binary else scene.write_text)(str(tmp_path))
    network = read_network(tmp_path)
    assert network.cameras[0].model == "fisheye"
    assert np.abs(residuals(network)).max() < EXACT_PX


def test_colmap_projects_the_same_points(result: Result, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap (extra `peers`)")
    written = write_network(result, tmp_path / "sparse")
    assert len(written) == len(result.network.cameras)
    assert max(done.greatest_px for done in written.values()) < EXACT_PX
    peer = pycolmap.Reconstruction(str(tmp_path / "sparse"))
    network, own, count = result.network, projected(result), 0
    for image in peer.images.values():
        i = network.images.index(image.name)
        for mark in image.points2D:
            if not mark.has_point3D():
                continue
            xyz = peer.points3D[mark.point3D_id].xyz
            j = int(
                np.flatnonzero((network.image_of == i) & (np.abs(network.xy + 0.5 - mark.xy).max(1) < 1e-9))[
                    0
                ]
            )
            assert np.abs(image.project_point(xyz) - 0.5 - own[j]).max() < EXACT_PX
            count += 1
    assert count == (~result.rejected).sum()
    assert len(peer.cameras) == len(network.cameras)


def test_bal_has_the_same_residuals_by_its_own_formula(result: Result, tmp_path: Path) -> None:
    write_network(result, tmp_path / "block.bal")
    cv2 = pytest.importorskip("cv2")
    words = (tmp_path / "block.bal").read_text().split()
    cameras, points, count = map(int, words[:3])
    table = np.array(words[3 : 3 + 4 * count], dtype=float).reshape(-1, 4)
    values = np.array(words[3 + 4 * count :], dtype=float)
    view, xyz = values[: 9 * cameras].reshape(-1, 9), values[9 * cameras :].reshape(-1, 3)
    assert len(xyz) == points
    for row, expected in zip(table, result.residuals[~result.rejected], strict=True):
        of = view[int(row[0])]
        x = cv2.Rodrigues(of[:3])[0] @ xyz[int(row[1])] + of[3:6]
        p = -x[:2] / x[2]
        f, k1, k2 = of[6:]
        r2 = p @ p
        off = f * (1 + k1 * r2 + k2 * r2 * r2) * p - row[2:]
        assert np.abs(off * [1, -1] - expected).max() < EXACT_PX


@pytest.mark.parametrize("name", ["block.json", "block.bal", "sparse"])
def test_what_is_written_is_read_back(result: Result, tmp_path: Path, name: str) -> None:
    write_network(result, tmp_path / name)
    again = read_network(tmp_path / name)
    size = np.linalg.norm(residuals(again), axis=1)
    kept = ~result.rejected
    assert len(again.xy) == kept.sum()
    assert abs(size.mean() - np.linalg.norm(result.residuals[kept], axis=1).mean()) < EXACT_PX


@pytest.mark.slow
def test_the_command_exports_and_refuses_other_suffixes(
    result: Result, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network_document(result.network).write(tmp_path / "network.json")
    # Gross errors that are kept contradict the rest, and everything is written.
    assert run(["bundle", str(tmp_path / "network.json"), "--export", str(tmp_path / "sparse")]) in (0, 3)
    assert {file.name for file in (tmp_path / "sparse").iterdir()} == {
        "cameras.txt", "images.txt", "points3D.txt"
    }  # fmt: skip
    capsys.readouterr()
    assert run(["bundle", str(tmp_path / "network.json"), "--export", str(tmp_path / "block.ply")]) == 2
    assert "block.ply: has the suffix" in capsys.readouterr().err
    with pytest.raises(UsageError):
        write_network(result, tmp_path / "block.ply")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "model"),
    [("SIMPLE_RADIAL 1280 960 900 640 480 0.01", "SIMPLE_RADIAL"),
     ("RADIAL 1280 960 900 640 480 0.01 -0.002", "RADIAL"),
     ("OPENCV 1280 960 900 905 640 480 0.01 -0.002 1e-4 2e-4", "OPENCV")],
)  # fmt: skip
def test_a_model_of_colmap_is_written_back_as_that_model(tmp_path: Path, line: str, model: str) -> None:
    (tmp_path / "in").mkdir()
    write_network(adjust_network(example_network()).required(), tmp_path / "in")
    (tmp_path / "in" / "cameras.txt").write_text(f"1 {line}\n")
    network = read_network(tmp_path / "in")
    (camera,) = network.cameras
    network = replace(network, cameras=(replace(camera, free=camera.free[:1]),))
    written = write_network(adjust_network(network).required(), tmp_path / "out")
    assert [each.greatest_px for each in written.values()] == [0.0]
    assert (tmp_path / "out" / "cameras.txt").read_text().split()[1] == model
