"""Cameras of a network from calibration files: priors with their joint covariance, or held."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.bundle import Network, Result, adjust_network, calibrated_camera, calibration_of, example_network
from reseau.bundle.network.camera import Additional
from reseau.calibration import Calibration, FilmFrameMapping, calibration_of_frame
from reseau.core.errors import FormatError, UsageError
from reseau.exchange import read_network
from reseau.exchange.networks import calibration_files
from reseau.io import FrameOrientation
from reseau.io.network import Network1


def as_document(network: Network, camera: dict[str, Any]) -> dict[str, Any]:
    nothing = [None] * len(network.points)
    sigma = np.sqrt(network.cov[:, 0, 0]).tolist()
    return {
        "schema": "reseau-network/1", "unit": network.unit, "cameras": [camera],
        "images": {"id": list(network.images), "camera": [camera["id"]] * len(network.images),
                   "X0": [None] * len(network.images), "rotation": [None] * len(network.images)},
        "points": {"id": list(network.points), "xyz": network.xyz.tolist(), "sigma": nothing,
                   "role": list(network.role)},
        "observations": {"image": [network.images[i] for i in network.image_of],
                         "point": [network.points[j] for j in network.point_of],
                         "x": network.xy[:, 0].tolist(), "y": network.xy[:, 1].tolist(),
                         "sx": sigma, "sy": sigma},
        "datum": "free",
    }  # fmt: skip


@pytest.fixture
def first() -> Result:
    found = adjust_network(example_network())
    assert isinstance(found, Result)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("use", ["observed", "held"])
def test_a_camera_entry_names_its_calibration(first: Result, use: str, tmp_path: Path) -> None:
    calibration_of(first, "camera", name="front").write(tmp_path / "front.json")
    entry = {"id": "cam", "calibration": "front.json", "use": use}
    path = tmp_path / "network.json"
    path.write_text(json.dumps(as_document(example_network(seed=1), entry)))
    assert calibration_files(path) == (tmp_path / "front.json",)
    network = read_network(path)
    found = adjust_network(network)
    assert isinstance(found, Result)
    camera, before = network.cameras[0], first.cameras["camera"]
    np.testing.assert_array_equal(camera.values[:4], before.values)
    if use == "held":
        assert found.cameras["cam"].parameters == ()
        assert found.redundancy == first.redundancy + 4
        return
    np.testing.assert_array_equal(np.array(camera.covariance)[:4, :4], before.covariance)
    assert found.redundancy == first.redundancy + 4
    assert (found.cameras["cam"].sigma < 0.85 * before.sigma).all()


def test_a_given_calibration_replaces_the_entry_of_a_camera(first: Result, tmp_path: Path) -> None:
    calibration_of(first, "camera", name="front").write(tmp_path / "front.json")
    entry = {"id": "cam", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01], "model": "brown",
             "side": "object", "parameters": {"c": 7.7}, "free": ["c"]}  # fmt: skip
    path = tmp_path / "network.json"
    path.write_text(json.dumps(as_document(example_network(seed=1), entry)))
    assert read_network(path, {"cam": tmp_path / "front.json"}).cameras[0].free == ("c", "x0", "y0", "K1")
    with pytest.raises(UsageError, match="other: is not a camera of the network"):
        read_network(path, {"other": tmp_path / "front.json"})


def test_a_calibration_with_additional_parameters_keeps_them() -> None:
    network = example_network()
    extra = Additional(1.2)
    camera = replace(network.cameras[0], free=("c", "x0", "y0"), additional=extra)
    result = adjust_network(replace(network, cameras=(camera,)))
    assert isinstance(result, Result)
    calibration = calibration_of(result, "camera", name="front")
    again = calibrated_camera("front", calibration)
    assert again.free == ("c", "x0", "y0", *extra.names)
    uv = np.array([[0.1, -0.2], [0.3, 0.2]])
    mapping = again.plane_mapping()
    np.testing.assert_array_equal(mapping(uv), calibration.mapping().mapping(uv))


def test_entries_that_cannot_be_read_are_refused(first: Result) -> None:
    document = as_document(example_network(), {"id": "cam", "calibration": "front.json"})
    with pytest.raises(UsageError, match=r"camera cam.*needs its calibration front\.json"):
        Network.from_document(Network1.parse(json.dumps(document), where="network"))
    document["cameras"][0]["width"] = 640
    with pytest.raises(FormatError, match=r"unknown key `cameras\[0\]\.width`"):
        Network1.parse(json.dumps(document), where="network")


PRINCIPAL_POINT = (321.5, 240.5)
"""Pixel coordinates of x0 = 0.02 mm, y0 = -0.01 mm in the example, with pixels of 0.01 mm."""


def orientation(
    turned: float = 0.0, mirrored: bool = False, px_per_mm: tuple[float, float] = (100.0, 100.0)
) -> FrameOrientation:
    """A frame of 6 mm × 4.4 mm around the principal point, rotated clockwise by an angle in degrees."""
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    half = np.array([3.0, 2.2]) * px_per_mm
    xy = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half * ([-1, 1] if mirrored else [1, 1])
    xy = xy @ np.array([[c, s], [-s, c]]) + PRINCIPAL_POINT
    corner = {"sx": 0.4, "sy": 0.3, "rho": 0.1}
    return FrameOrientation.model_validate({
        "image": "scan.tif", "status": "oriented", "why": "", "format_mm": (6.0, 4.4), "channel": "grey",
        "corners": {name: corner | {"x": x, "y": y}
                    for name, (x, y) in zip(("ul", "ur", "lr", "ll"), xy.tolist(), strict=True)},
        "principal_point": {"x": PRINCIPAL_POINT[0], "y": PRINCIPAL_POINT[1],
                            "sx": 0.2, "sy": 0.1, "rho": 0.5},
        "angle_deg": -turned, "angle_sigma_deg": 0.01, "px_per_mm": px_per_mm, "edges": {}})  # fmt: skip


FILM = {"id": "cam", "calibration": "frame.json", "width": 640, "height": 480,
        "parameters": {"c": 7.9}, "free": ["c", "K1"]}  # fmt: skip


def written(folder: Path, entry: dict[str, Any], frame: FrameOrientation | Calibration) -> Path:
    frame.write(folder / "frame.json")
    path = folder / "network.json"
    path.write_text(json.dumps(as_document(example_network(seed=1), entry)))
    return path


def test_a_camera_on_film_takes_pixel_size_and_principal_point_from_its_frame(tmp_path: Path) -> None:
    path = written(tmp_path, FILM, orientation())
    assert calibration_files(path) == (tmp_path / "frame.json",)
    camera = read_network(path).cameras[0]
    assert camera.pitch_mm == pytest.approx((0.01, 0.01), rel=1e-12)
    assert camera.free == ("c", "x0", "y0", "K1")
    assert camera.parameters["c"] == 7.9
    np.testing.assert_allclose(camera.values[1:3], [0.02, -0.01], atol=1e-12)
    covariance = np.array(camera.covariance)
    np.testing.assert_allclose(covariance[1:3, 1:3], [[4e-6, -1e-6], [-1e-6, 1e-6]], rtol=1e-9)
    assert np.count_nonzero(covariance) == 4
    observed = adjust_network(read_network(path)).required()
    free = adjust_network(example_network(seed=1)).required()
    assert observed.redundancy == free.redundancy + 2
    estimate, before = observed.cameras["cam"], free.cameras["camera"]
    assert estimate.parameters == before.parameters
    assert (np.abs(estimate.values - [8.0, 0.02, -0.01, 1e-3]) < 4 * estimate.sigma).all()
    assert (estimate.sigma[1:3] < before.sigma[1:3]).all()


def test_the_principal_point_of_a_film_frame_can_be_held(tmp_path: Path) -> None:
    entry = FILM | {"use": "held", "sigma": {"c": 0.2}}
    network = read_network(written(tmp_path, entry, orientation()))
    camera = network.cameras[0]
    assert camera.free == ("c", "K1")
    assert camera.sigma == {"c": 0.2}
    assert camera.covariance is None
    np.testing.assert_allclose(camera.values[1:3], [0.02, -0.01], atol=1e-12)
    assert adjust_network(network).required().cameras["cam"].parameters == ("c", "K1")


def test_other_parameters_of_a_camera_on_film_can_be_observed_too(tmp_path: Path) -> None:
    entry = FILM | {"sigma": {"c": 0.2}}
    camera = read_network(written(tmp_path, entry, orientation())).cameras[0]
    assert camera.sigma == {}
    np.testing.assert_allclose(np.diag(np.array(camera.covariance))[:4], [0.04, 4e-6, 1e-6, 0.0])


@pytest.mark.parametrize("turned", [0.0, 0.4, 90.0, 180.0])
def test_the_frame_may_be_rotated_in_the_scan(turned: float, tmp_path: Path) -> None:
    frame = orientation(turned, px_per_mm=(100.0, 98.0))
    entry = FILM | {"width": 800, "height": 800}
    camera = read_network(written(tmp_path, entry, frame)).cameras[0]
    expected = (1 / 98, 1 / 100) if turned == 90 else (1 / 100, 1 / 98)
    assert camera.pitch_mm == pytest.approx(expected, rel=1e-5)
    at = camera.grid.to_pixels(camera.values[None, 1:3])
    np.testing.assert_allclose(at, [PRINCIPAL_POINT], atol=1e-9)


def test_the_calibration_of_a_film_frame_is_accepted_as_its_orientation(tmp_path: Path) -> None:
    frame = orientation()
    calibration = calibration_of_frame(frame, size=(640, 480))
    camera = read_network(written(tmp_path, FILM, calibration)).cameras[0]
    np.testing.assert_allclose(camera.values[1:3], [0.02, -0.01], atol=1e-12)
    # The covariance is that of the corners, by numerical derivatives of the intersection of the diagonals.
    cov = np.array(camera.covariance)[1:3, 1:3]
    moved = np.zeros((2, 4, 2))
    for k in range(8):
        step = np.zeros((4, 2))
        step.flat[k] = 0.01
        shifted = [FilmFrameMapping(frame.image_points().xy + sign * step, np.eye(8), (6.0, 4.4))
                   .to_pixels(np.zeros((1, 2)))[0] for sign in (1, -1)]  # fmt: skip
        moved[:, k // 2, k % 2] = (shifted[0] - shifted[1]) / 0.02
    expected = np.einsum("ikc,kcd,jkd->ij", moved, frame.image_points().cov, moved)
    np.testing.assert_allclose(cov, expected * 1e-4 * np.array([[1, -1], [-1, 1]]), rtol=1e-6)
    with pytest.raises(UsageError, match=r"camera cam.*640×480"):
        read_network(written(tmp_path, FILM | {"width": 600}, calibration))


def test_the_orientation_of_a_film_frame_replaces_the_entry_of_a_camera(tmp_path: Path) -> None:
    entry = {"id": "cam", "width": 640, "height": 480, "pitch_mm": [0.02, 0.02], "model": "brown",
             "side": "image", "parameters": {"c": 7.7, "x0": 0.1, "K1": 1e-3}, "free": ["c", "x0"],
             "sigma": {"c": 0.1, "x0": 0.2}}  # fmt: skip
    path = written(tmp_path, entry, orientation())
    camera = read_network(path, {"cam": tmp_path / "frame.json"}).cameras[0]
    assert camera.pitch_mm == pytest.approx((0.01, 0.01), rel=1e-12)
    assert camera.free == ("c", "x0", "y0")
    assert camera.options["side"] == "image"
    np.testing.assert_allclose(camera.values[:4], [7.7, 0.02, -0.01, 1e-3], atol=1e-12)
    np.testing.assert_allclose(np.diag(np.array(camera.covariance))[:4], [0.01, 4e-6, 1e-6, 0.0])


REFUSED_ON_FILM: dict[str, tuple[dict[str, Any], FrameOrientation, str]] = {
    "mirrored": (FILM, orientation(mirrored=True), "mirror the scan"),
    "another size": (FILM | {"width": 300, "height": 200}, orientation(), "does not contain the frame"),
    "no principal distance": (FILM | {"parameters": {}}, orientation(), "parameter 'c' is missing"),
    "no parameters": (
        {"id": "cam", "calibration": "frame.json"}, orientation(), "does not give the principal distance"
    ),
    "a principal point": (FILM | {"parameters": {"c": 8.0, "x0": 0.1}}, orientation(), "'x0' follows from"),
    "a pixel size": (FILM | {"pitch_mm": [0.01, 0.01]}, orientation(), "`pitch_mm` follows from"),
    "a model in pixels": (
        FILM | {"model": "opencv", "parameters": {"fx": 800.0, "fy": 800.0, "cx": 320.0, "cy": 240.0},
                "free": [], "side": None},
        orientation(),
        "no pixel size",
    ),
    "a declined frame": (
        FILM,
        FrameOrientation.model_validate({
            "image": "scan.tif", "status": "declined", "why": "no edge", "format_mm": None, "channel": None,
            "corners": None, "principal_point": None, "angle_deg": None, "angle_sigma_deg": None,
            "px_per_mm": None, "edges": {}}),
        "not oriented: no edge",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED_ON_FILM)
def test_film_frames_that_cannot_be_used_are_refused(case: str, tmp_path: Path) -> None:
    entry, frame, words = REFUSED_ON_FILM[case]
    with pytest.raises((UsageError, FormatError), match=words):
        read_network(written(tmp_path, entry, frame))


def test_an_entry_on_film_refuses_the_calibration_of_a_camera(first: Result, tmp_path: Path) -> None:
    calibration = calibration_of(first, "camera", name="front")
    with pytest.raises(UsageError, match=r"camera cam: frame\.json is a calibration of a camera"):
        read_network(written(tmp_path, FILM, calibration))


def test_a_network_with_a_camera_on_film_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    path = written(tmp_path, FILM | {"use": "held"}, orientation())
    document = Network1.read(path)
    assert Network1.parse(document.to_json(), where="network") == document
    with pytest.raises(UsageError, match=r"camera cam.*needs its calibration frame\.json"):
        Network.from_document(document)


def test_a_network_without_pixel_size_takes_no_film_frame(tmp_path: Path) -> None:
    block = tmp_path / "block.txt"
    block.write_text("1 1 1\n0 0 1.0 2.0\n0 0 0 0 0 0 800 0 0\n0 0 -5\n")
    orientation().write(tmp_path / "frame.json")
    with pytest.raises(UsageError, match="does not give the principal distance"):
        read_network(block, {"0": tmp_path / "frame.json"})
