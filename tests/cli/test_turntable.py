"""`reseau bundle` and `reseau calibrate` with a turntable."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle.network.settings import network_document
from reseau.calibration import Calibration
from reseau.designs import regular_reseau
from reseau.io import Mark
from reseau.optics import OpenCV, Pose, project
from reseau.optics.poses import matrix_to_vector, rotation_matrix

from ..bundle.turntables import turned

Run = Callable[..., tuple[int, str, str]]

SIGMA, SIGMA_DEG = 0.05, 0.05
CAMERA = {"fx": 900.0, "fy": 901.0, "cx": 322.0, "cy": 235.0, "k1": -0.28, "k2": 0.08}
FREE = ("--image-size", "640x480", "--free", "fx,fy,cx,cy,k1,k2")
AXIS, POINT = np.array([0.1, 1.0, 0.05]), np.array([20.0, 0.0, -30.0])
ANGLES = (-40, -25, -10, 5, 20, 35)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A design, and what a camera at two places saw of it while it turned; with the angles."""
    folder, rng = tmp_path_factory.mktemp("turntable"), np.random.default_rng(3)
    design = regular_reseau(9, 7, 25.0, Mark(shape="disk", size=5.0), name="disks")
    design.write(folder / "disks.json")
    xyz, axis = np.column_stack([design.xy, np.zeros(len(design.ids))]), AXIS / np.linalg.norm(AXIS)
    table = ["image,angle_deg,sigma_deg,pose"]
    for p, about in enumerate(([np.pi - 0.5, 0.1, 0.0], [np.pi + 0.3, -0.1, 0.9])):
        rest = rotation_matrix(np.array(about))
        for angle in ANGLES:
            turn = rotation_matrix(np.radians(angle) * axis)
            at = POINT + turn.T @ (-rest.T @ np.array([0.0, 0.0, 450.0]) - POINT)
            seen = project(OpenCV.from_parameters(CAMERA), Pose(matrix_to_vector(rest @ turn), at), xyz)
            xy = seen.xy + SIGMA * rng.normal(size=seen.xy.shape)
            inside = ((xy > 0) & (xy < [640, 480])).all(axis=1)
            rows = [
                f"{name},{x!r},{y!r},{SIGMA},{SIGMA}"
                for name, (x, y), ok in zip(design.ids, xy.tolist(), inside, strict=True)
                if ok
            ]
            name = f"{p}at{angle}.csv"
            (folder / name).write_text("id,x,y,sx,sy\n" + "\n".join(rows) + "\n")
            table.append(f"{name},{angle + SIGMA_DEG * rng.normal():.4f},{SIGMA_DEG},{p}")
    (folder / "angles.txt").write_text("\n".join(table) + "\n")
    return folder


def photographs(folder: Path) -> list[Path]:
    return sorted(folder.glob("*at*.csv"))


@pytest.mark.slow
def test_a_calibration_estimates_the_axis_of_a_turntable(reseau: Run, measured: Path, tmp_path: Path) -> None:
    status, out, err = reseau(
        "calibrate", *photographs(measured), "-d", measured / "disks.json", *FREE, "-o", tmp_path / "K.json",
        "--turntable", measured / "angles.txt", "--report", tmp_path / "F.html",
    )  # fmt: skip
    assert (status, err) == (0, "")
    axis = np.array(
        [float(word) for word in out.partition("turntable: axis ")[2].replace(",", "").split()[0:7:3]]
    )
    assert np.abs(axis - AXIS / np.linalg.norm(AXIS)).max() < 1e-3
    assert "12 angles estimated" in out
    found = Calibration.read(tmp_path / "K.json")
    assert found.sigma0 == pytest.approx(1.0, abs=0.15)
    for key, value in CAMERA.items():
        assert abs(found.parameters[key].value - value) < 4.5 * found.parameters[key].sigma
    assert "anticlockwise" in (tmp_path / "F.html").read_text()


def test_angles_in_radians_are_reported(reseau: Run, measured: Path, tmp_path: Path) -> None:
    lines = [line.split(",") for line in (measured / "angles.txt").read_text().split()]
    rows = [f"{name},{np.radians(float(angle))},,{pose}" for name, angle, _, pose in lines[1:]]
    known = [row.replace(",,", ",0,") for row in rows]
    (tmp_path / "table.csv").write_text("\n".join([",".join(lines[0]), *known]) + "\n")
    status, out, err = reseau(
        "calibrate", *photographs(measured), "-d", measured / "disks.json", *FREE,
        "--turntable", tmp_path / "table.csv",
    )  # fmt: skip
    assert status == 1
    assert "the angles of the turntable are in radians where degrees are expected" in out + err


def test_a_network_with_a_turntable_is_adjusted(reseau: Run, tmp_path: Path) -> None:
    drawn = turned(sigma=0.002, control=True, angles_deg=(0, 60, 120, 200))
    network_document(drawn.network).write(tmp_path / "network.json")
    status, out, err = reseau("bundle", tmp_path / "network.json", "-o", tmp_path / "out.json")
    assert (status, err) == (0, "")
    assert "turntable: axis 0.04" in out
    assert "8 angles estimated" in out
    found = json.loads((tmp_path / "out.json").read_text())["turntable"]
    assert found["position"][0] == pytest.approx(13.26, abs=0.1)
