"""Calibrations of OpenPTV: folders of orientations, parameters and detections without names."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle import Options, adjust_network
from reseau.core.data import Array
from reseau.core.errors import FormatError, InputError
from reseau.exchange.networks import read_foreign

from .scene import residuals, scene

CAVITY = Path(os.environ.get("RESEAU_DATA", "../shared/data")) / "multimedia_cavity"
SIZE, PITCH = (1200, 900), 0.01
INTERIOR = (9.0, 0.06, -0.04)
ADDITIONAL = (-6e-4, 2e-6, 0.0, 3e-5, -2e-5, 1.0004, 3e-4)


def pixels(directions: Array) -> Array:
    """OpenPTV's lens: principal point, distortion about the middle of the image, affinity."""
    c, xh, yh = INTERIOR
    k1, k2, k3, p1, p2, scale, shear = ADDITIONAL
    # x right, y up, in millimetres.
    x, y = c * directions[..., 0] + xh, -c * directions[..., 1] + yh
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    a = x * radial + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y
    b = y * radial + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y
    a, b = scale * a - np.sin(shear) * b, np.cos(shear) * b
    return np.stack([a / PITCH + SIZE[0] / 2, SIZE[1] / 2 - b / PITCH], axis=-1)


def written(folder: Path, media: str = "1\n1\n1\n5", flags: str = "1 0 0 0") -> Path:
    """The scene as a calibration in air, with detections of particles beside those of the points."""
    every, rng = scene(), np.random.default_rng(3)
    count = len(every.x0)
    for name in ("parameters", "cal"):
        (folder / name).mkdir()
    names = [f"cal/cam{k + 1}.tif" for k in range(count)]
    images = "".join(f"img/cam{k + 1}.0\n{name}\n" for k, name in enumerate(names))
    (folder / "parameters" / "ptv.par").write_text(
        f"{count}\n{images}1\n0\n1\n{SIZE[0]}\n{SIZE[1]}\n{PITCH}\n{PITCH}\n0\n{media}\n"
    )
    orientations = "".join(f"{name}\n{name}.ori\n" for name in names)
    (folder / "parameters" / "cal_ori.par").write_text(f"cal/target.txt\n{orientations}1\n0\n0\n")
    (folder / "parameters" / "sortgrid.par").write_text("12\n")
    (folder / "parameters" / "orient.par").write_text("0\n" + "\n".join(flags.split()) + "\n")
    rows = [f"{j + 1} {x:.9f} {y:.9f} {z:.9f}" for j, (x, y, z) in enumerate(every.xyz)]
    (folder / "cal" / "target.txt").write_text("\n".join(rows) + "\n")
    for k, name in enumerate(names):
        turn = (np.diag([1.0, -1.0, -1.0]) @ every.turns[k]).T
        text = " ".join(f"{v:.9f}" for v in [*every.x0[k], 0, 0, 0])
        text += "\n\n" + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in turn)
        c, xh, yh = INTERIOR
        (folder / f"{name}.ori").write_text(f"{text}\n\n{xh} {yh}\n{c}\n\n0 0 -4\n")
        (folder / f"{name}.addpar").write_text(" ".join(map(str, ADDITIONAL)))
        seen = pixels(every.directions[k])
        seen = np.concatenate([seen, rng.uniform([0, 0], SIZE, (40, 2))])
        seen = seen[rng.permutation(len(seen))]
        lines = [f"{i} {x:.5f} {y:.5f} 20 5 4 900 -1" for i, (x, y) in enumerate(seen)]
        (folder / f"{name}_targets").write_text(f"{len(lines)}\n" + "\n".join(lines) + "\n")
    return folder


def test_a_calibration_in_air_is_the_network_and_particles_are_no_points(tmp_path: Path) -> None:
    network = read_foreign(written(tmp_path))
    assert network.images == ("cam1", "cam2", "cam3", "cam4")
    assert network.refraction is None
    # Of 60 points few have a particle nearly as near.
    assert len(network.xy) >= 55
    # The file has five decimals.
    assert np.abs(residuals(network)).max() < 1e-4
    assert all(camera.free == ("c",) for camera in network.cameras)
    result = adjust_network(network, Options(outliers="keep")).required()
    assert abs(result.cameras["cam1"].values[0] - INTERIOR[0]) < 1e-4


def test_glass_on_the_side_of_the_camera_is_refused(tmp_path: Path) -> None:
    folder = written(tmp_path, media="1\n1.33\n1.46\n5")
    with pytest.raises(FormatError, match=r"cam1\.tif\.ori: the camera is not outside the glass"):
        read_foreign(folder)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("parameters/ptv.par", "2\ncam\n", "numbers of cameras, images and media"),
        ("cal/cam2.tif.ori", "1 2 3", "is not 21 numbers"),
        ("cal/cam2.tif.addpar", "0 0 0 0 0 1 x", "not 7"),
        ("cal/cam3.tif_targets", "1\n0 1 2\n", "line 2"),
        ("cal/target.txt", "1 0 0 0\n1 0 0 1\n", "a point twice"),
        ("parameters/sortgrid.par", "", "is not 1 numbers"),
    ],
)
def test_a_file_that_is_wrong_is_named(file: str, content: str, message: str, tmp_path: Path) -> None:
    folder = written(tmp_path)
    (folder / file).write_text(content)
    with pytest.raises(FormatError, match=message) as error:
        read_foreign(folder)
    assert Path(file).stem in str(error.value)


def test_without_detections_it_is_said_that_detection_comes_first(tmp_path: Path) -> None:
    (written(tmp_path) / "cal" / "cam2.tif_targets").unlink()
    with pytest.raises(InputError, match=r"cam2\.tif_targets: .*not been detected yet; run Detection"):
        read_foreign(tmp_path)


@pytest.mark.skipif(not CAVITY.exists(), reason="needs the cavity of RESEAU_DATA")
def test_cameras_before_a_cavity_fit_as_well_as_published() -> None:
    """Real data: residuals of the orientations alone, known from exact rays of another program."""
    network = read_foreign(CAVITY)
    assert len(network.xy) >= 220
    result = adjust_network(network).required()
    for image, sigma0 in ((2, 0.749), (3, 0.755)):
        v = result.residuals[network.image_of == image]
        own = np.sqrt((v**2).sum() / (v.size - 6))
        assert own == pytest.approx(sigma0, abs=0.002)
