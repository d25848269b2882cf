"""`reseau calibrate --rig …`: cameras that are fixed to each other."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.api import calibrate
from reseau.calibration import Calibration
from reseau.core.errors import UsageError
from reseau.designs import regular_reseau
from reseau.io import Mark
from reseau.optics import OpenCV, PixelGrid, Pose, camera_model, project
from reseau.optics.mapping import PlaneMapping
from reseau.optics.poses import matrix_to_vector, rotation_matrix
from reseau.procedures.calibration_options import CameraOptions

Run = Callable[..., tuple[int, str, str]]

SIGMA, EXPOSURES = 0.05, 8
TURN, BASE = np.array([0.02, 0.1, -0.01]), np.array([90.0, 2.0, -4.0])
CAMERAS = {
    "left": {"fx": 530.0, "fy": 531.0, "cx": 322.0, "cy": 235.0, "k1": -0.28, "k2": 0.08},
    "right": {"fx": 545.0, "fy": 544.0, "cx": 314.0, "cy": 241.0, "k1": -0.25, "k2": 0.06},
}
FREE = ("--image-size", "640x480", "--free", "fx,fy,cx,cy,k1,k2")


def drawn(folder: Path, lenses: dict[str, tuple[PlaneMapping, tuple[int, int]]]) -> Path:
    """A design, and the coordinates that cameras saw, in a folder each."""
    rng = np.random.default_rng(2)
    design = regular_reseau(9, 7, 25.0, Mark(shape="disk", size=5.0), name="disks")
    design.write(folder / "disks.json")
    xyz = np.column_stack([design.xy, np.zeros(len(design.ids))])
    for e in range(EXPOSURES):
        about = 2 * np.pi * e / EXPOSURES
        first = rotation_matrix(np.array([0.0, 0.0, 0.8 * e])) @ rotation_matrix(
            np.array([np.pi + 0.5 * np.cos(about), 0.5 * np.sin(about), 0.0])
        )
        at = -first.T @ np.array([-40.0, 5.0 * np.cos(3 * about), 330.0])
        places = {"left": (first, at), "right": (rotation_matrix(TURN) @ first, at + first.T @ BASE)}
        for camera, (turn, centre) in places.items():
            lens, size = lenses[camera]
            seen = project(lens, Pose(matrix_to_vector(turn), centre), xyz)
            xy = seen.xy + SIGMA * rng.normal(size=seen.xy.shape)
            inside = ((xy > 0) & (xy < size)).all(axis=1)
            rows = [
                f"{name},{x!r},{y!r},{SIGMA},{SIGMA}"
                for name, (x, y), ok in zip(design.ids, xy.tolist(), inside, strict=True)
                if ok
            ]
            (folder / camera).mkdir(exist_ok=True)
            (folder / camera / f"{e:02d}.csv").write_text("id,x,y,sx,sy\n" + "\n".join(rows) + "\n")
    return folder


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What two cameras with wide lenses saw."""
    lenses = {name: (OpenCV.from_parameters(values), (640, 480)) for name, values in CAMERAS.items()}
    return drawn(tmp_path_factory.mktemp("stereo"), lenses)


def both(folder: Path) -> tuple[object, ...]:
    return ("--rig", f"left={folder / 'left'}", "--rig", f"right={folder / 'right' / '*.csv'}")


@pytest.mark.slow
def test_each_camera_and_its_place_are_within_their_sigmas(
    reseau: Run, measured: Path, tmp_path: Path
) -> None:
    files = ("-o", tmp_path / "K.json", "--report", tmp_path / "F.html")
    status, out, err = reseau("calibrate", *both(measured), "-d", measured / "disks.json", *FREE, *files)
    assert (status, err) == (0, "")
    assert "camera right from left: base " in out
    for name, true in CAMERAS.items():
        found = Calibration.read(tmp_path / f"K-{name}.json")
        assert found.sigma0 == pytest.approx(1.0, abs=0.1)
        for key, value in true.items():
            assert abs(found.parameters[key].value - value) < 4.5 * found.parameters[key].sigma
    assert Calibration.read(tmp_path / "K-left.json").place is None
    place = Calibration.read(tmp_path / "K-right.json").place
    assert place is not None
    assert place.reference == "left"
    off = matrix_to_vector(rotation_matrix(np.array(place.rotation)) @ rotation_matrix(TURN).T)
    error = np.concatenate([off, np.array(place.base) - BASE])
    # Chi square of six degrees of freedom, 1e-5. The scale is that of the design.
    assert error @ np.linalg.solve(np.array(place.covariance), error) < 33.0
    report = (tmp_path / "F.html").read_text()
    assert "Cameras fixed to each other" in report
    assert "right/00.csv" in report


@pytest.mark.slow
def test_a_folder_has_the_rig_for_other_programs_and_maps_of_rectified_images(
    reseau: Run, measured: Path, tmp_path: Path
) -> None:
    command = ("calibrate", *both(measured), "-d", measured / "disks.json", *FREE)
    status, out, err = reseau(*command, "-o", tmp_path / "rig")
    assert (status, err) == (0, "")
    names = {path.name for path in (tmp_path / "rig").iterdir()}
    assert {"camchain.yaml", "rig_config.json", "rectified.npz"} < names
    assert "rectified images, maps for cv2.remap: rows off by " in out


@pytest.fixture
def exchanged(measured: Path, tmp_path: Path) -> Path:
    """The same, with two files of the right camera exchanged."""
    folder = tmp_path / "exchanged"
    shutil.copytree(measured, folder)
    for name, source in (("02.csv", "05.csv"), ("05.csv", "02.csv")):
        shutil.copy(measured / "right" / source, folder / "right" / name)
    return folder


@pytest.mark.slow
def test_images_that_were_not_taken_at_once_are_named(reseau: Run, exchanged: Path, tmp_path: Path) -> None:
    said = "images left/02.csv, left/05.csv, right/02.csv, right/05.csv were not taken at once"
    command = ("calibrate", *both(exchanged), "-d", exchanged / "disks.json", *FREE)
    _, out, err = reseau(*command)
    assert said in out + err
    status, out, err = reseau(*command, "--reject", "-o", tmp_path / "K.json")
    assert (status, err) == (0, "")
    assert f"{said} with the others of their exposure; adjusted apart from the rig" in out
    place = Calibration.read(tmp_path / "K-right.json").place
    assert place is not None
    assert np.abs(np.array(place.base) - BASE).max() < 0.5


@pytest.mark.parametrize("of_all", ["opencv", pytest.param("auto", marks=pytest.mark.slow)])
def test_each_camera_may_have_a_model_and_a_size_of_its_own(reseau: Run, of_all: str, tmp_path: Path) -> None:
    true = np.array([420.0, 421.0, 513.0, 380.0, 0.03, -0.01, 0.0, 0.0, 0.0, 0.0])
    fisheye = camera_model("fisheye").mapping(true, PixelGrid(1024, 768, (1.0, 1.0)))
    left = OpenCV.from_parameters(CAMERAS["left"]), (640, 480)
    drawn(tmp_path, {"left": left, "right": (fisheye, (1024, 768))})
    rig = ("--rig", f"left={tmp_path / 'left'}", "--rig")
    own = f"right={tmp_path / 'right'},model=fisheye,free=fx,fy,cx,cy,k1,k2,image-size=1024x768"
    files = ("-d", tmp_path / "disks.json", "-o", tmp_path / "K.json")
    status, _, err = reseau("calibrate", *rig, own, *files, "--model", of_all, "--image-size", "640x480")
    assert (status, err) == (0, "")
    one, other = (Calibration.read(tmp_path / f"K-{name}.json") for name in ("left", "right"))
    assert one.sigma0 == pytest.approx(1.0, abs=0.1)
    assert (one.model["model"], other.model["model"]) == ("opencv", "fisheye")
    for key, value in zip(("fx", "fy", "cx", "cy", "k1", "k2"), true.tolist(), strict=False):
        assert abs(other.parameters[key].value - value) < 4.5 * other.parameters[key].sigma
    both = {name: [tmp_path / name] for name in ("left", "right")}
    lenses = {"left": of_all, "right": CameraOptions("fisheye", ("fx", "fy", "cx", "cy", "k1", "k2"))}
    sizes = {"left": (640, 480), "right": (1024, 768)}
    again = calibrate(both, tmp_path / "disks.json", model=lenses, image_size=sizes).required()
    assert again.cameras["right"]["k1"] == other.parameters["k1"].value
    assert again.rectified("right").greatest_px < 0.5
    with pytest.raises(UsageError, match="is none of left, right"):
        again.rectified("front")
    wrong = own.replace("model=", "pitch-mm=1,focus=")
    assert reseau("calibrate", *rig, wrong, *files)[0] == 2
