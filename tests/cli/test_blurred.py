"""`reseau measure blurred`: from a lens file, a design and a photograph to places of corresponding rays."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reseau.designs import regular_reseau
from reseau.io import LensDocument, Mark, ReseauDesign
from reseau.io.images import write_image
from reseau.io.lens import LensSensor
from reseau.optics import Pose
from reseau.optics.formation import Outline, coverage
from reseau.optics.lenses import AIR, Prescription, PupilElements, glass, in_order, ray_image
from reseau.optics.lenses.ray_maps import LensCamera
from reseau.procedures.blurred import focused, targets_of

Run = Callable[..., tuple[int, str, str]]

SIZE = (640, 480)
DESIGN = regular_reseau(6, 4, 20.0, Mark(shape="disk", size=5.0))
TURN = Pose.from_angles(0.25, -0.2, 0.05, np.zeros(3))
POSE = Pose(TURN.rotation, np.append(DESIGN.xy.mean(axis=0), 0.0) - 480.0 * TURN.matrix[2])
SENSOR = LensSensor(pitch_um=(13.0, 13.0), size_px=SIZE)


def lens() -> Prescription:
    rows = [(0.03, 3.0, glass("N-BK7")), (-0.03, 2.0, AIR), (0.0, 34.0, AIR)]
    surfaces = list(in_order(rows))
    surfaces[2] = replace(surfaces[2], kind="plain", name="stop")
    wavelengths = (486.1, 546.1, 632.8)
    return focused(
        Prescription(tuple(surfaces), 2, 2.0, wavelengths, (0.5, 1.0, 0.5), 1, name="singlet"), 470.0
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Photograph, design, lens, and the true places."""
    folder = tmp_path_factory.mktemp("blurred")
    camera = LensCamera(lens(), SENSOR.plane())
    names, targets = targets_of(DESIGN, POSE, camera)
    image, truth = np.full(SIZE[::-1], 200.0), {}
    for name, target in zip(names, targets, strict=True):
        formed = ray_image(camera, target, PupilElements.gauss(4))
        placed = Outline(formed.outline.xy + formed.point, formed.outline.dxy)
        left, top = np.rint(formed.point).astype(int) - 25
        share = coverage(placed, left + np.arange(51.0), top + np.arange(51.0), 0.5)
        image[top : top + 51, left : left + 51] -= 150 * share
        truth[name] = formed.point.tolist()
    image += np.random.default_rng(0).normal(0, 1.0, image.shape)
    paths = {name: folder / name for name in ("photo.png", "design.json", "lens.toml", "truth.json")}
    write_image(paths["photo.png"], np.clip(np.rint(image), 0, 255).astype(np.uint8))
    DESIGN.write(paths["design.json"])
    LensDocument.of(lens(), SENSOR).write(paths["lens.toml"])
    paths["truth.json"].write_text(json.dumps(truth))
    return paths


def measured(files: dict[str, Path], document: str) -> float:
    """Largest error of the measured places, pixels."""
    truth = json.loads(files["truth.json"].read_text())
    points = [point for point in json.loads(document)["points"] if point["ok"]]
    assert len(points) >= 22
    return float(max(np.hypot(p["x"] - truth[p["id"]][0], p["y"] - truth[p["id"]][1]) for p in points))


@pytest.mark.slow
def test_targets_are_measured_and_the_image_is_oriented_by_them(files, tmp_path: Path, reseau: Run) -> None:
    status, out, _ = reseau(
        "measure", "blurred", files["photo.png"], "-d", files["design.json"], "-l", files["lens.toml"],
        "--not-mirrored", "--max-rotation-deg", 40, "-o", tmp_path / "m.json",
        "--overlay", tmp_path / "o.png",
    )  # fmt: skip
    assert status == 0
    assert "of 24 targets measured" in out
    assert "centres of density lie up to" in out
    assert (tmp_path / "o.png").exists()
    assert measured(files, (tmp_path / "m.json").read_text()) < 0.1


@pytest.mark.slow
def test_a_focus_that_was_stated_wrong_is_estimated(files, tmp_path: Path, reseau: Run) -> None:
    block = network(tmp_path / "network.json", POSE.x0.tolist())
    status, out, err = reseau(
        "measure", "blurred", files["photo.png"], "-d", files["design.json"], "-l", files["lens.toml"],
        "--network", block, "--focus", 460, "--focus-sigma-mm", 0.5, "-o", tmp_path / "m.json",
    )  # fmt: skip
    assert status == 0, err
    stated = focused(lens(), 460.0).surfaces[-1].vertex - lens().surfaces[-1].vertex
    found = float(out.split("the focus was estimated: ")[1].split(" ±")[0])
    assert abs(found + stated[2]) < 0.02
    assert measured(files, (tmp_path / "m.json").read_text()) < 0.1


def principal_distance() -> float:
    """Of the lens, mm."""
    near = LensCamera(lens(), SENSOR.plane()).corresponding(np.array([[0.0, 0, 480.0], [1.0, 0, 480.0]]))
    return float((near[1] - near[0])[0] * 480.0 * 0.013)


def network(path: Path, x0: list[float]) -> Path:
    """A file with the orientation of the photograph, and with the points of the design."""
    plane = np.concatenate([DESIGN.xy, np.zeros((24, 1))], axis=1)
    content = {
        "schema": "reseau-network/1",
        "unit": "mm",
        "cameras": [
            {
                "id": "c", "width": SIZE[0], "height": SIZE[1], "pitch_mm": [0.013, 0.013], "model": "brown",
                "side": "object", "parameters": {"c": principal_distance()}, "free": [],
            }
        ],
        "images": {"id": ["photo"], "camera": ["c"], "X0": [x0], "rotation": [POSE.rotation.tolist()]},
        "points": {
            "id": list(DESIGN.ids), "xyz": plane.tolist(), "sigma": [[0.0, 0.0, 0.0]] * 24,
            "role": ["control"] * 24,
        },
        "observations": {
            "image": ["photo"] * 4, "point": list(DESIGN.ids[:4]), "x": [1.0, 2.0, 3.0, 4.0],
            "y": [1.0, 2.0, 3.0, 4.0], "sx": [0.1] * 4, "sy": [0.1] * 4,
        },
        "datum": "control",
    }  # fmt: skip
    path.write_text(json.dumps(content))
    return path


@pytest.mark.slow
def test_a_network_gives_the_orientation(files, tmp_path: Path, reseau: Run) -> None:
    block = network(tmp_path / "network.json", POSE.x0.tolist())
    status, out, err = reseau(
        "measure", "blurred", files["photo.png"], "-d", files["design.json"], "-l", files["lens.toml"],
        "--network", block, "--json",
    )  # fmt: skip
    assert (status, err) == (0, "")
    assert measured(files, out) < 0.1


SECOND = "curvature = -0.03"
STOP = 'name = "stop"'
NAME = 'name = "singlet"'


@pytest.mark.parametrize(
    ("old", "new", "towards", "said"),
    [
        (SECOND, f"{SECOND}\ntilt_deg = [60.0, 0.0, 0.0]", 1.0, "is totally reflected at surface 2"),
        (STOP, f"{STOP}\ndecentre = [80.0, 0.0, 0.0]", 1.0, "no ray passes the stop"),
        ("wavelengths_nm = [486.1, 546.1, 632.8]", "wavelengths_nm = []", 1.0, "wavelengths_nm"),
        (NAME, f"{NAME}\nfocal_length = 50000.0", 1.0, "states a focal length of 50000 mm"),
        (SECOND, SECOND, -1.0, "a point of the object lies behind the lens"),
        (SECOND, SECOND, 30.0, "none of 24 targets was measured; 24: no light of the target reaches"),
    ],
    ids=["total reflection", "no ray", "no wavelength", "50 m", "behind the window", "out of the field"],
)
def test_light_that_cannot_reach_the_sensor_is_one_line_and_nothing_is_written(
    files, tmp_path: Path, reseau: Run, old: str, new: str, towards: float, said: str
) -> None:
    text = files["lens.toml"].read_text()
    assert old in text
    lens_file = tmp_path / "lens.toml"
    lens_file.write_text(text.replace(old, new, 1))
    x0 = POSE.x0 * [1.0, 1.0, np.sign(towards)] + [40.0 * (abs(towards) - 1), 0.0, 0.0]
    block = network(tmp_path / "network.json", x0.tolist())
    before = sorted(tmp_path.iterdir())
    status, out, err = reseau(
        "measure", "blurred", files["photo.png"], "-d", files["design.json"], "-l", lens_file,
        "--network", block, "-o", tmp_path / "m.json", "--figure", tmp_path / "f.svg",
    )  # fmt: skip
    assert status in (1, 2), out
    assert said in err
    assert err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--pitch-mm", "0.01"], "has a sensor; its pitch is not needed"),
        (["--focus", "5"], "forms no real image of an object at 5 mm"),
    ],
)
def test_contradictory_options_are_one_line(files, reseau: Run, options: list[str], said: str) -> None:
    image, design, lens_file = (files[name] for name in ("photo.png", "design.json", "lens.toml"))
    status, _, err = reseau("measure", "blurred", image, "-d", design, "-l", lens_file, *options)
    assert status == 2
    assert said in err
    assert err.count("\n") == 1


def test_a_file_that_is_no_lens_is_one_line(files, reseau: Run) -> None:
    status, _, err = reseau(
        "measure", "blurred", files["photo.png"], "-d", files["design.json"], "-l", files["design.json"]
    )
    assert status == 2
    assert "is not a lens" in err
    assert ReseauDesign.read(files["design.json"]).ids == DESIGN.ids
