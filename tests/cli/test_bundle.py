"""`reseau bundle`: the result, and the messages for networks that cannot be adjusted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.bundle import ResultDocument, adjust_network, calibration_of
from reseau.exchange import read_network
from reseau.io import FiducialOrientation, FrameOrientation, FrameTransform
from reseau.io.network import Network1
from reseau.optics import Brown, PixelGrid
from reseau.optics.poses import Pose, matrix_to_vector, project

from ..montecarlo import slowly

Run = Callable[..., tuple[int, str, str]]
Change = Callable[[dict[str, Any]], None]


def looking_at(x0: np.ndarray, roll: float) -> np.ndarray:
    """Rotation vector of a camera at x0 that looks at the middle of the points."""
    z = np.array([0.0, 0.0, 0.4]) - x0
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    upright = np.stack([x, np.cross(z, x), z])
    c, s = np.cos(roll), np.sin(roll)
    return matrix_to_vector(np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ upright)


def content(noise: float = 0.05) -> dict[str, Any]:
    """Four images of a grid of fifteen points on two levels, four of them control."""
    rng = np.random.default_rng(7)
    grid = PixelGrid(640, 480, (0.01, 0.01))
    camera = Brown(grid=grid).with_values({"c": 8.0, "x0": 0.02, "K1": 1e-3})
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-0.7, 0.7, 3)))
    xyz = np.column_stack([x, y, 0.3 * ((np.arange(15) * 7) % 4)])
    centres = [(-2.2, -1.8, 4.0), (2.3, -1.6, 4.3), (2.0, 2.1, 3.8), (-1.9, 2.0, 4.4)]
    poses = [(looking_at(np.array(x0), 1.5 * i), x0) for i, x0 in enumerate(centres)]
    table: dict[str, list[Any]] = {key: [] for key in ("image", "point", "x", "y", "sx", "sy")}
    for i, (rotation, x0) in enumerate(poses):
        for j, xy in enumerate(project(camera, Pose(np.array(rotation), np.array(x0)), xyz).xy):
            if (np.abs(xy - [319.5, 239.5]) < [319, 239]).all():
                u, v = (xy + noise * rng.normal(size=2)).tolist()
                row = (f"i{i}", f"p{j}", u, v, 0.05, 0.05)
                for key, value in zip(table, row, strict=True):
                    table[key].append(value)
    control = (0, 4, 10, 14, 7)
    return {
        "schema": "reseau-network/1",
        "unit": "m",
        "cameras": [
            {"id": "cam", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01], "model": "brown",
             "side": "object", "parameters": {"c": 7.7}, "free": ["c", "x0", "y0", "K1"]},
        ],
        "images": {
            "id": [f"i{i}" for i in range(4)], "camera": ["cam"] * 4,
            "X0": [None] * 4, "rotation": [None] * 4,
        },
        "points": {
            "id": [f"p{j}" for j in range(15)],
            "xyz": [xyz[j].tolist() if j in control else None for j in range(15)],
            "sigma": [[0, 0, 0] if j in control else None for j in range(15)],
            "role": ["control" if j in control else "tie" for j in range(15)],
        },
        "observations": table,
        "datum": "control",
    }  # fmt: skip


@pytest.fixture
def network(tmp_path: Path) -> Callable[..., Path]:
    """A network as a file, changed or not."""

    def write(change: Change | None = None) -> Path:
        document = content()
        if change is not None:
            change(document)
        path = tmp_path / "network.json"
        path.write_text(json.dumps(document))
        return path

    return write


def test_the_result_has_the_columns_of_its_schema(reseau: Run, network: Callable[..., Path]) -> None:
    status, out, err = reseau("bundle", network(), "--json", "--cov")
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert next(iter(found)) == "schema"
    assert found["schema"] == "reseau-bundle/1"
    n = found["observations"]
    assert found["redundancy"] == n - found["unknowns"] + found["constraints"]
    assert found["unknowns"] == 4 + 24 + 30
    table = found["image_points"]
    assert sum(table["rx"]) + sum(table["ry"]) == pytest.approx(found["redundancy"], abs=1e-6)
    w = abs(table["vx"][0]) / (found["sigma0"] * 0.05 * table["rx"][0] ** 0.5)
    assert table["wx"][0] == pytest.approx(w, rel=1e-9)
    assert 0.6 < found["sigma0"] < 1.4
    c = found["cameras"][0]["parameters"]["c"]
    assert abs(c["value"] - 8.0) < 4 * c["sigma"]
    assert np.array(found["points"]["cov"]).shape == (15, 3, 3)
    assert np.array(found["images"]["sigma"]).shape == (4, 6)
    assert {len(column) for column in found["images"].values()} == {4}
    assert {len(column) for column in found["points"].values()} == {15}
    assert {len(column) for column in table.values()} == {n // 2}
    assert found["points"]["sigma"][0] == [0, 0, 0]


def test_the_summary_lists_the_estimates(reseau: Run, network: Callable[..., Path], tmp_path: Path) -> None:
    status, out, _ = reseau("bundle", network(), "-o", tmp_path / "result.json")
    assert status == 0
    assert "redundancy" in out
    assert "camera cam" in out
    assert json.loads((tmp_path / "result.json").read_text())["schema"] == "reseau-bundle/1"


def test_the_report_is_self_contained_and_lists_the_warnings(
    reseau: Run, network: Callable[..., Path], tmp_path: Path
) -> None:
    status, _, err = reseau("bundle", network(idle_camera), "--report", tmp_path / "report.html")
    assert (status, err) == (0, "")
    page = (tmp_path / "report.html").read_text()
    assert "camera spare has no image" in page
    assert page.count("<svg") == 6
    assert "http://" not in page.replace("http://www.w3.org", "").replace(
        "http://creativecommons", ""
    ).replace("http://purl", "")
    again = tmp_path / "again.html"
    reseau("bundle", network(idle_camera), "--report", again)
    assert again.read_text() == page


def test_the_same_network_gives_the_same_bytes(reseau: Run, network: Callable[..., Path]) -> None:
    path = network()
    assert reseau("bundle", path, "--json") == reseau("bundle", path, "--json")


@pytest.mark.slow
def test_gross_errors_are_named_and_rejected(reseau: Run, network: Callable[..., Path]) -> None:
    def blunder(document: dict[str, Any]) -> None:
        document["observations"]["x"][17] += 40.0

    path = network(blunder)
    table = json.loads(path.read_text())["observations"]
    where = (table["image"][17], table["point"][17])
    status, out, _ = reseau("bundle", path, "--json")
    found = json.loads(out)
    # The result is written, and contradicts itself.
    assert (status, found["status"]) == (3, "contradictory")
    assert any(f"in image {where[0]}: point {where[1]}" in warning for warning in found["warnings"])
    status, out, _ = reseau("bundle", path)
    assert (status, out.splitlines()[2][:15]) == (3, "contradictory: ")
    status, out, _ = reseau("bundle", path, "--reject", "--json")
    assert status == 0
    found = json.loads(out)
    assert [k for k, r in enumerate(found["image_points"]["rejected"]) if r] == [17]
    assert found["sigma0"] < 1.4


def swap(column: str, a: int, b: int) -> Change:
    def change(document: dict[str, Any]) -> None:
        values = document["points"][column]
        values[a], values[b] = values[b], values[a]

    return change


def without_control(document: dict[str, Any]) -> None:
    document["points"]["xyz"] = document["points"]["sigma"] = [None] * 15


def two_points(document: dict[str, Any]) -> None:
    table = document["observations"]
    keep = [k for k, image in enumerate(table["image"]) if image != "i3" or table["point"][k] in ("p1", "p2")]
    for key in table:
        table[key] = [table[key][k] for k in keep]


def idle_camera(document: dict[str, Any]) -> None:
    document["cameras"].append(document["cameras"][0] | {"id": "spare"})


REFUSED = {
    "no datum": (without_control, 1, "rank defect 7"),
    "an unknown key": (lambda d: d.update(colour="red"), 2, "unknown key `colour`"),
    "a missing key": (lambda d: d.pop("datum"), 2, "missing key `datum`"),
    "a point that is not there": (lambda d: d["observations"]["point"].__setitem__(0, "x9"), 2, "'x9'"),
    "a camera that is not there": (lambda d: d["images"]["camera"].__setitem__(0, "none"), 2, "'none'"),
    "a negative sigma": (lambda d: d["observations"]["sx"].__setitem__(0, -1.0), 2, "above zero"),
    "columns of different length": (lambda d: d["observations"]["x"].pop(), 2, "entries"),
    "a parameter of another model": (lambda d: d["cameras"][0]["free"].append("k1"), 2, "'k1'"),
    "a coordinate that is no number": (lambda d: d["observations"]["x"].__setitem__(0, float("nan")), 2, ""),
    "points of one image twice": (lambda d: d["observations"]["point"].__setitem__(1, "p0"), 2, "twice"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_networks_that_cannot_be_adjusted_are_refused_in_one_line(
    case: str, reseau: Run, network: Callable[..., Path]
) -> None:
    change, expected, words = REFUSED[case]
    status, out, err = reseau("bundle", network(change), "--json")
    assert (status, out) == (expected, "")
    assert err.count("\n") == 1
    assert words in err


WARNED = {
    "an image with two points": (two_points, "image i3 has fewer than three points"),
    "a camera without image": (idle_camera, "camera spare has no image"),
}


@pytest.mark.parametrize("case", WARNED)
def test_unused_images_and_cameras_are_named(case: str, reseau: Run, network: Callable[..., Path]) -> None:
    change, words = WARNED[case]
    status, out, _ = reseau("bundle", network(change), "--json")
    assert status == 0
    assert any(words in warning for warning in json.loads(out)["warnings"])


def test_the_document_is_read_back_as_it_was_written() -> None:
    document = Network1.parse(json.dumps(content()), where="network")
    again = Network1.parse(document.to_json(), where="network")
    assert again == document
    assert next(iter(document.to_dict())) == "schema"


@pytest.mark.slow
@pytest.mark.parametrize("pair", [(4, 10), *slowly(((0, 4),), ((0, 14),))])
def test_swapped_control_points_are_reported(
    pair: tuple[int, int], reseau: Run, network: Callable[..., Path]
) -> None:
    status, out, err = reseau("bundle", network(swap("xyz", *pair)), "--json")
    message = " ".join(json.loads(out)["warnings"]) if status == 3 else err
    # The control is a symmetric plane figure: the other pair would do as well.
    assert f"p{pair[0]} and p{pair[1]}" in message
    assert "exchanged" in message


def test_the_document_is_read_back_with_its_provenance(
    reseau: Run, network: Callable[..., Path], tmp_path: Path
) -> None:
    out = tmp_path / "result.json"
    assert reseau("bundle", network(), "--out", out, "--cov")[0] == 0
    document = ResultDocument.read(out)
    assert document.to_json() == out.read_text("utf-8")
    assert document.provenance is not None
    assert list(document.provenance["inputs"]) == ["network.json"]
    older = json.loads(out.read_text("utf-8"))
    assert list(older)[-1] == "provenance"
    del older["provenance"], older["warning_codes"], older["status"]
    assert ResultDocument.parse(json.dumps(older), where="older").to_dict() == older


def test_a_calibration_on_the_command_line_replaces_the_camera_of_the_network(
    reseau: Run, network: Callable[..., Path], tmp_path: Path
) -> None:
    path, result = network(), tmp_path / "result.json"
    assert reseau("bundle", path, "-o", tmp_path / "first.json")[0] == 0
    calibration = calibration_of(
        adjust_network(read_network(path)).required(), "cam", name="cam of an earlier block"
    )
    calibration.write(tmp_path / "cam.json")
    status, _, err = reseau(
        "bundle", path, "--camera-calibration", f"cam={tmp_path / 'cam.json'}", "-o", result
    )
    assert (status, err) == (0, "")
    first, again = (ResultDocument.read(tmp_path / name) for name in ("first.json", "result.json"))
    assert again.redundancy == first.redundancy + 4
    assert again.cameras[0].correlation.names == ("c", "x0", "y0", "K1")
    for name in ("c", "x0", "y0", "K1"):
        assert 0 < again.cameras[0].parameters[name].sigma < first.cameras[0].parameters[name].sigma
    assert again.provenance is not None
    assert list(again.provenance["inputs"]) == ["cam.json", "network.json"]


def test_a_film_frame_on_the_command_line_gives_pixel_size_and_principal_point(
    reseau: Run, network: Callable[..., Path], tmp_path: Path
) -> None:
    corner = {"sx": 0.2, "sy": 0.2, "rho": 0.0}
    at = {"ul": (21.5, 19.5), "ur": (621.5, 19.5), "lr": (621.5, 459.5), "ll": (21.5, 459.5)}
    frame = FrameOrientation.model_validate({
        "image": "scan.tif", "status": "oriented", "why": "", "format_mm": (6.0, 4.4), "channel": "grey",
        "corners": {name: corner | {"x": x, "y": y} for name, (x, y) in at.items()},
        "principal_point": corner | {"x": 321.5, "y": 239.5}, "angle_deg": 0.0, "angle_sigma_deg": 0.01,
        "px_per_mm": (100.0, 100.0), "edges": {}})  # fmt: skip
    frame.write(tmp_path / "frame.json")
    result = tmp_path / "result.json"
    status, _, err = reseau(
        "bundle", network(), "--camera-calibration", f"cam={tmp_path / 'frame.json'}", "-o", result
    )
    assert (status, err) == (0, "")
    camera = ResultDocument.read(result).cameras[0]
    assert camera.correlation.names == ("c", "x0", "y0", "K1")
    for name, true in (("c", 8.0), ("x0", 0.02), ("y0", 0.0)):
        assert abs(camera.parameters[name].value - true) < 4 * camera.parameters[name].sigma
    assert camera.parameters["x0"].sigma < 0.002 * 1.5


def test_fiducial_marks_on_the_command_line_give_pixel_size_and_principal_point(
    reseau: Run, network: Callable[..., Path], tmp_path: Path
) -> None:
    values = {"a1": 1.0, "b1": 0.0, "c1": -0.02, "a2": 0.0, "b2": 1.0, "c2": 0.0}
    cov = tuple(tuple(4e-6 * float(i == j) for j in range(6)) for i in range(6))
    transform = FrameTransform(
        kind="affine",
        residuals_mm={},
        sigma_mm=(0.002, 0.002),
        parameters={key: {"value": value, "sigma": 0.002} for key, value in values.items()},
    )
    found = FiducialOrientation(
        image="scan.tif",
        sha256="",
        camera="film",
        status="oriented",
        why="",
        size=(640, 480),
        px_per_mm=100.0,
        rotation_deg=0,
        mirrored=False,
        marks=(),
        extent=(-3.0, -2.2, 3.0, 2.2),
        covariance=cov,
        transform=transform,
    )
    found.write(tmp_path / "photo.json")
    result = tmp_path / "result.json"
    photo = f"cam={tmp_path / 'photo.json'}"
    status, _, err = reseau("bundle", network(), "--camera-calibration", photo, "-o", result)
    assert (status, err) == (0, "")
    camera = ResultDocument.read(result).cameras[0]
    for name, true in (("c", 8.0), ("x0", 0.02), ("y0", 0.0)):
        assert abs(camera.parameters[name].value - true) < 4 * camera.parameters[name].sigma
    assert camera.parameters["x0"].sigma < 0.002 * 1.5
