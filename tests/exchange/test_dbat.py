"""Projects of DBAT: script and tables are one network, with the lens of photogrammetry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import FormatError, InputError
from reseau.exchange.dbat import read_dbat
from reseau.exchange.networks import read_foreign
from reseau.optics.poses import matrix_to_angles

from .scene import residuals, scene

WIDTH, HEIGHT, PITCH = 1600, 1200, 0.005
C, PP, K, P = 7.9, (4.05, 2.94), (4e-4, -2e-6, 1e-8), (3e-5, -2e-5)


def ideal(pixel: np.ndarray, aspect: float) -> np.ndarray:
    """Directions x/c, y/c (y up) of pixel coordinates from the corner: corrections at the measured place."""
    x, y = pixel[..., 0] * PITCH - PP[0], PP[1] - pixel[..., 1] * PITCH
    x = x / aspect
    r2 = x * x + y * y
    radial = 1 + K[0] * r2 + K[1] * r2**2 + K[2] * r2**3
    xc = x * radial + P[0] * (r2 + 2 * x * x) + 2 * P[1] * x * y
    yc = y * radial + P[1] * (r2 + 2 * y * y) + 2 * P[0] * x * y
    return np.stack([xc, yc], axis=-1) / C


def pixels(aspect: float) -> np.ndarray:
    """Pixel coordinates (m, p, 2) from the corner of the image, by fixed-point iteration."""
    wanted = scene().directions * [1.0, -1.0]
    at = np.full(wanted.shape, [WIDTH / 2, HEIGHT / 2])
    for _ in range(200):
        at = at + (wanted - ideal(at, aspect)) * [1.0, -1.0] * C / PITCH
    assert np.abs(wanted - ideal(at, aspect)).max() < 1e-13
    return np.asarray(at)


CAMERA = (
    "<camera><id>1</id><name>Lens</name><unit>mm</unit><sensor>auto,6.0</sensor><image>1600,1200</image>"
    "<aspect>{aspect}</aspect><focal>8</focal><model>3</model><nK>3</nK><nP>2</nP><cc>7.9</cc>"
    "<pp>4.05,2.94</pp><skew>0</skew><K>4e-4,-2e-6,1e-8</K><P>3e-5,-2e-5</P></camera>"
)
SCRIPT = """<?xml version="1.0" encoding="UTF-8"?>
<document dbat_script_version="1.0">
<meta><project_unit>m</project_unit></meta>
<input base_dir="$HERE/in">
<ctrl_pts><file format="id,label,x,y,z,sxy,sz">control.txt</file><filter id="1,2">remove</filter></ctrl_pts>
<check_pts><file format="id,label,x,y,z,sxy,sz">control.txt</file><filter id="1,2">keep</filter></check_pts>
<images image_base_dir="$DBAT"><file format="id,path">images.txt</file></images>
<prior_eo><file format="id,x,y,z,omega,phi,kappa" units="gon">poses.txt</file></prior_eo>
<image_pts><file format="im,id,x,y" sxy="0.25">marks.txt</file></image_pts>
<cameras>CAMERA</cameras>
</input>
<operations><operation min_rays="2">check_ray_count</operation><operation><set_bundle_estimate_params>
<io><all>true</all><skew>false</skew><K3>false</K3><aspect>false</aspect></io>
</set_bundle_estimate_params></operation></operations>
</document>"""


def project(folder: Path, script: str = SCRIPT, aspect: float = 1.0) -> Path:
    """The scene as a project; all points are in the table of control."""
    every, inside = scene(), folder / "in"
    inside.mkdir()
    angles = matrix_to_angles(every.turns) * 200 / np.pi
    tables = {
        "control": [
            f"{j}, P{j}, {x!r}, {y!r}, {z!r}, 0.02, 0.04" for j, (x, y, z) in enumerate(every.xyz.tolist())
        ],
        "images": [f" {i}, some/where/im{i}.jpg" for i in range(1, 5)],
        "poses": [
            f"{i}, {', '.join(map(repr, row))}"
            for i, row in enumerate(np.column_stack([every.x0, angles]).tolist(), start=1)
        ],
        "marks": [
            f"{i + 1}, {j}, {x!r}, {y!r}"
            for i, image in enumerate(pixels(aspect).tolist())
            for j, (x, y) in enumerate(image)
        ],
    }
    for name, lines in tables.items():
        (inside / f"{name}.txt").write_text("\n".join(["# a comment", *lines, ""]))
    (folder / "project.xml").write_text(script.replace("CAMERA", CAMERA.format(aspect=aspect)))
    return folder / "project.xml"


@pytest.mark.parametrize("aspect", [1.0, 0.9996])
def test_lens_poses_and_points_are_those_of_the_tables(aspect: float, tmp_path: Path) -> None:
    network = read_foreign(project(tmp_path, aspect=aspect))
    assert network.images == ("im1.jpg", "im2.jpg", "im3.jpg", "im4.jpg")
    assert network.unit == "m"
    assert np.abs(residuals(network)).max() < 1e-6


def test_control_check_points_sigmas_and_free_parameters(tmp_path: Path) -> None:
    network = read_dbat(project(tmp_path))
    assert network.role[:4] == ("control", "check", "check", "control")
    assert network.datum == "control"
    np.testing.assert_array_equal(network.sigma[:2], [[0.02, 0.02, 0.04], [np.nan] * 3])
    np.testing.assert_array_equal(network.cov[0], np.diag([0.0625, 0.0625]))
    assert network.cameras[0].free == ("c", "x0", "y0", "K1", "K2", "P1", "P2")


def test_without_poses_they_are_left_to_be_computed(tmp_path: Path) -> None:
    start, end = SCRIPT.index("<prior_eo>"), SCRIPT.index("<image_pts>")
    network = read_dbat(project(tmp_path, SCRIPT[:start] + SCRIPT[end:]))
    assert not network.posed.any()


def test_a_camera_may_be_in_a_file_of_its_own(tmp_path: Path) -> None:
    script = SCRIPT.replace("<cameras>CAMERA</cameras>", "<cameras><file>cam.xml</file></cameras>")
    path = project(tmp_path, script)
    camera = CAMERA.format(aspect=1)
    (tmp_path / "in" / "cam.xml").write_text(f"<document><cameras>{camera}</cameras></document>")
    assert np.abs(residuals(read_dbat(path))).max() < 1e-6


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (' sxy="0.25"', "", "without a positive standard deviation; add `sxy`"),
        ('format="im,id,x,y"', 'format="im,x,y"', r"marks\.txt: line 2: has 4 fields, not 3 \(im,x,y\)"),
        ('format="id,path"', 'format="no,path"', "has no column `id`"),
        ('units="gon"', 'units="turns"', "has angles in `turns`"),
        ("$HERE/in", "$DBAT/in", "which is not known here"),
        ("<skew>false</skew>", "", "has skew, or estimates it"),
        ("<K3>false</K3>", "<K4>true</K4>", "estimates `K4`"),
        ("<cameras>CAMERA</cameras>", "<cameras></cameras>", "defines no camera"),
        ("<cameras>CAMERA</cameras>", "", "has no element <cameras>"),
        ('<filter id="1,2">keep', '<filter id="1,2,3">keep', "has the point 3 as control and as check point"),
        ("</document>", "", "is not well-formed XML"),
    ],
)
def test_broken_projects_are_refused_in_one_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in SCRIPT
    with pytest.raises(FormatError, match=message) as caught:
        read_dbat(project(tmp_path, SCRIPT.replace(old, new)))
    assert "\n" not in str(caught.value)


def test_a_lens_of_computer_vision_and_a_missing_table_are_refused(tmp_path: Path) -> None:
    path = project(tmp_path)
    text = path.read_text()
    path.write_text(text.replace("<model>3</model>", "<model>4</model>"))
    with pytest.raises(FormatError, match="has the lens model 4, only 3 is read"):
        read_dbat(path)
    path.write_text(text)
    (tmp_path / "in" / "marks.txt").unlink()
    with pytest.raises(InputError, match=r"marks\.txt: cannot be read"):
        read_dbat(path)
