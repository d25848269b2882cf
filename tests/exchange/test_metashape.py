"""Metashape's XML and projects: cameras, poses and markers are those of the program's own equations."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import FormatError
from reseau.exchange.metashape import read_metashape
from reseau.exchange.networks import read_foreign

from .scene import residuals, scene

WIDTH, HEIGHT = 1600, 1200
PLAIN = {"f": 1500.0, "cx": 12.0, "cy": -7.0}
BROWN = {**PLAIN, "k1": -0.11, "k2": 0.04, "k3": -0.01, "p1": 0.0021, "p2": -0.0013}
# The system of the chunk against that of the markers.
SCALE, SHIFT = 2.5, np.array([100.0, 200.0, 50.0])
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def projected(values: dict[str, float], kind: str = "frame") -> np.ndarray:
    """Image coordinates (m, p, 2) from the corner of the image, as the manual of Metashape has them."""
    value = {
        name: values.get(name, 0.0) for name in ("b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
    } | values
    x, y = np.moveaxis(scene().directions, -1, 0)
    if kind == "fisheye":
        tangent = np.hypot(x, y)
        x, y = x * np.arctan(tangent) / tangent, y * np.arctan(tangent) / tangent
    r2 = x * x + y * y
    radial = 1 + value["k1"] * r2 + value["k2"] * r2**2 + value["k3"] * r2**3 + value["k4"] * r2**4
    xd = x * radial + value["p1"] * (r2 + 2 * x * x) + 2 * value["p2"] * x * y
    yd = y * radial + value["p2"] * (r2 + 2 * y * y) + 2 * value["p1"] * x * y
    u = WIDTH / 2 + value["cx"] + xd * value["f"] + xd * value["b1"] + yd * value["b2"]
    return np.stack([u, HEIGHT / 2 + value["cy"] + yd * value["f"]], axis=-1)


def words(values: np.ndarray) -> str:
    return " ".join(map(repr, np.ravel(values).tolist()))


def document(
    values: dict[str, float] = BROWN,
    kind: str = "frame",
    *,
    version: str = "2.0.0",
    calibration: str = "",
    extra: str = "",
    system: str = "",
    points: str = "",
    seen: int = 15,
) -> str:
    """The scene as an XML file; markers have coordinates in a system of their own."""
    every, xy = scene(), projected(values, kind)
    inside = calibration or "".join(f"<{name}>{value!r}</{name}>" for name, value in values.items())
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    cameras, markers, frames = "", "", ""
    for i, (turn, x0) in enumerate(zip(every.turns, every.x0, strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T, x0
        cameras += (
            f'<camera id="{i}" sensor_id="0" label="im{i}"><transform>{words(pose)}</transform></camera>'
        )
    for j, point in enumerate((SCALE * every.xyz @ TURN.T + SHIFT).tolist()):
        at = f'x="{point[0]!r}" y="{point[1]!r}" z="{point[2]!r}"'
        more = 'sxy="0.02" sz="0.04" enabled="true"' if j else 'sxyz="0.01" enabled="false"'
        markers += f'<marker id="{j}" label="P{j}"><reference {at} {more}/></marker>'
    for j in range(seen):
        at = "".join(
            f'<location camera_id="{i}" pinned="true" x="{x!r}" y="{y!r}"/>'
            for i, (x, y) in enumerate(xy[:, j].tolist())
        )
        frames += f'<marker marker_id="{j}">{at}</marker>'
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="{version}">\n<chunk label="one">'
        f'<sensors><sensor id="0" label="Lens 1" type="{kind}">{size}{extra}'
        f'<calibration type="{kind}" class="adjusted">{size}{inside}</calibration></sensor></sensors>'
        f"<cameras>{cameras}</cameras><markers>{markers}</markers>"
        f"<frames><frame id='0'><markers>{frames}</markers>{points}</frame></frames>{system}"
        f"<transform><rotation>{words(TURN)}</rotation><translation>{words(SHIFT)}</translation>"
        f"<scale>{SCALE}</scale></transform>"
        '<settings><property name="accuracy_projections" value="0.2"/></settings></chunk></document>'
    )


def written(folder: Path, text: str, name: str = "cameras.xml") -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(
    ("values", "kind", "model"),
    [
        (PLAIN, "frame", "opencv"),
        (BROWN, "frame", "opencv"),
        ({**BROWN, "b1": 3.5}, "frame", "opencv"),
        ({**BROWN, "k4": 0.02}, "frame", "brown_higher"),
        ({**PLAIN, "b1": -2.0, "k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": 0.001}, "fisheye", "fisheye"),
    ],
)
def test_cameras_and_poses_project_as_in_the_manual(
    values: dict[str, float], kind: str, model: str, tmp_path: Path
) -> None:
    network = read_foreign(written(tmp_path, document(values, kind)))
    assert network.cameras[0].model == model
    # The coordinates of the markers were transformed with more than 12 digits.
    assert np.abs(residuals(network)).max() < 1e-8


def test_an_old_file_has_the_principal_point_from_the_corner_and_tangential_terms_as_opencv(
    tmp_path: Path,
) -> None:
    old = {"fx": 1500.0, "fy": 1500.0, "cx": WIDTH / 2 + 12, "cy": HEIGHT / 2 - 7, "k1": -0.11, "k2": 0.04,
           "k3": -0.01, "p1": -0.0013, "p2": 0.0021}  # fmt: skip
    inside = "".join(f"<{name}>{value!r}</{name}>" for name, value in old.items())
    network = read_metashape(written(tmp_path, document(version="1.2.0", calibration=inside)))
    assert np.abs(residuals(network)).max() < 1e-8


def test_markers_are_control_points_with_their_accuracies_and_check_points_where_not_enabled(
    tmp_path: Path,
) -> None:
    network = read_metashape(written(tmp_path, document()))
    assert network.points[:2] == ("P0", "P1")
    assert network.role == ("check", *("control",) * 14)
    np.testing.assert_array_equal(network.sigma[:2], [[np.nan] * 3, [0.02, 0.02, 0.04]])
    assert network.datum == "control"
    assert network.unit == "m"
    np.testing.assert_allclose(network.cov[0], np.diag([0.04, 0.04]), atol=1e-12)
    assert network.cameras[0].free == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def test_a_fixed_sensor_and_disabled_cameras_are_respected(tmp_path: Path) -> None:
    text = document(extra='<property name="fixed" value="true"/>')
    text = text.replace('label="im3"', 'label="im3" enabled="false"')
    network = read_metashape(written(tmp_path, text))
    assert network.cameras[0].free == ()
    assert network.images == ("im0", "im1", "im2")


def test_control_without_a_transformation_of_the_chunk_leaves_poses_unknown(tmp_path: Path) -> None:
    text = document()
    start, end = text.index("<transform><rotation>"), text.index("<settings>")
    network = read_metashape(written(tmp_path, text[:start] + text[end:]))
    assert not network.posed.any()
    assert np.isfinite(network.xyz).all()


def ply(columns: dict[str, np.ndarray]) -> bytes:
    kinds = {"f": "float", "i": "int", "u": "uint"}
    table = np.rec.fromarrays(list(columns.values()), names=list(columns))
    lines = [f"property {kinds[column.dtype.kind]} {name}" for name, column in columns.items()]
    head = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(table)}", *lines, "end_header", ""
    ]  # fmt: skip
    return "\n".join(head).encode() + table.tobytes()


def test_a_project_has_tie_points_too(tmp_path: Path) -> None:
    every, xy = scene(), projected(BROWN)
    paths = "".join(f'<projections camera_id="{i}" path="p{i}.ply"/>' for i in range(len(xy)))
    text = document(points=f'<point_cloud><points path="points.ply"/>{paths}</point_cloud>', seen=0)
    number = np.arange(15, dtype="<u4") + 40
    with zipfile.ZipFile(tmp_path / "a.psz", "w") as archive:
        archive.writestr("doc.xml", text)
        x, y, z = every.xyz.T.astype("<f4")
        archive.writestr("points.ply", ply({"x": x, "y": y, "z": z, "id": number}))
        for i, at in enumerate(xy.astype("<f4")):
            columns = {"x": at[:, 0], "y": at[:, 1], "size": at[:, 0], "id": number.astype("<i4")}
            archive.writestr(f"p{i}.ply", ply(columns))
    network = read_foreign(tmp_path / "a.psz")
    assert len(network.xy) == 60
    assert set(network.role) == {"tie"}
    # Coordinates of 32 bit.
    assert np.abs(residuals(network)).max() < 2e-3


@pytest.mark.parametrize(
    ("values", "kind", "message"),
    [
        ({**BROWN, "b2": 0.5}, "frame", r"calibration 1: has skew \(b2\), which no camera"),
        ({**BROWN, "p3": 0.5}, "frame", "p3 and p4"),
        ({**BROWN, "k4": 0.1, "b1": 1.0}, "frame", r"k4 together with affinity \(b1\)"),
        (BROWN, "fisheye", "tangential distortion of a fisheye"),
        (PLAIN, "spherical", "the projection `spherical`"),
    ],
)
def test_what_no_camera_describes_is_refused(
    values: dict[str, float], kind: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match=message):
        read_metashape(written(tmp_path, document(values, kind)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</document>", "", "is not well-formed XML .*export it again"),
        ("<f>1500.0</f>", "<f>abc</f>", "calibration 1, f: `abc` is not a number"),
        ("<f>1500.0</f>", "", "has no focal length in pixels"),
        ('width="1600"', 'width="1600.5"', "width: is 1600.5, not a number of pixels"),
        ('height="1200"', 'height="-3"', "height: is -3, not a number of pixels"),
        ('sensor_id="0"', 'sensor_id="9"', "camera im0 has no sensor"),
        ('<marker marker_id="3">', '<marker marker_id="99">', "is not in the list of markers"),
        ('sxy="0.02"', 'sxy="-1"', "has an accuracy that is not positive"),
        ("<transform>", "<transform>7 ", "is not 16 numbers"),
        ("<location", "<elsewhere", "contains no image points of markers"),
        ("<cameras>", "<cameras><camera id='7' master_id='0'/>", "belongs to a multi-camera system"),
        ("<transform><rotation>", '<reference>GEOGCS["WGS 84"]</reference><transform><rotation>',
         "markers in a geographic system"),
        ("<chunk", "<!DOCTYPE a [<!ENTITY b 'c'>]><chunk", "declares XML entities"),
        ("<cameras>", "<other>", "is not well-formed"),
    ],
)  # fmt: skip
def test_broken_files_are_refused_in_one_line(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = document()
    assert old in text
    with pytest.raises(FormatError, match=message) as caught:
        read_metashape(written(tmp_path, text.replace(old, new)))
    assert "\n" not in str(caught.value)
    assert "cameras.xml" in str(caught.value)


def test_an_archive_without_a_project_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.psz", "w") as archive:
        archive.writestr("other.txt", "text")
    with pytest.raises(FormatError, match=r"has no readable part doc\.xml"):
        read_foreign(tmp_path / "a.psz")
    (tmp_path / "a.psz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(FormatError, match=r"is not a whole \.psz project"):
        read_foreign(tmp_path / "a.psz")
