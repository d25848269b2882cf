"""Cameras of a network from calibration files: priors with their joint covariance, or held."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.bundle import (
    Additional,
    Network,
    Result,
    adjust_network,
    calibrated_camera,
    calibration_of,
    example_network,
)
from reseau.core.errors import FormatError, UsageError
from reseau.exchange import calibration_files, read_network
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


def test_the_command_line_gives_the_calibration_of_a_camera(first: Result, tmp_path: Path) -> None:
    calibration_of(first, "camera", name="front").write(tmp_path / "front.json")
    entry = {"id": "cam", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01], "model": "brown",
             "side": "object", "parameters": {"c": 7.7}, "free": ["c"]}  # fmt: skip
    path = tmp_path / "network.json"
    path.write_text(json.dumps(as_document(example_network(seed=1), entry)))
    assert read_network(path, {"cam": tmp_path / "front.json"}).cameras[0].free == ("c", "x0", "y0", "K1")
    with pytest.raises(UsageError, match="no camera of the network"):
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
