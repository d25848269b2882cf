"""Scenes of OpenMVG and AliceVision, written as these programs write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reseau.core.errors import FormatError
from reseau.exchange import read_network

from .scene import residuals

MATRIX = np.array([[800.0, 0.0, 322.0], [0.0, 800.0, 238.0], [0.0, 0.0, 1.0]])
RADIAL = (-0.12, 0.03, 0.01)
POINTS = np.random.default_rng(3).uniform(-1, 1, (12, 3))
TURNS = [cv2.Rodrigues(np.array(v))[0] for v in ([0.05, -0.1, 0.3], [-0.02, 0.2, -0.4])]
CENTRES = np.array([[0.5, 0.2, -4.0], [-1.0, 0.1, -4.5]])


def seen(k: int) -> Any:
    """Image points by OpenCV."""
    shift = -TURNS[k] @ CENTRES[k]
    coefficients = np.array([*RADIAL[:2], 0.0, 0.0, RADIAL[2]])
    return cv2.projectPoints(POINTS, cv2.Rodrigues(TURNS[k])[0], shift, MATRIX, coefficients)[0].reshape(
        -1, 2
    )


def openmvg() -> dict[str, Any]:
    data = {"value0": {"width": 640, "height": 480}, "focal_length": 800.0, "principal_point": [322.0, 238.0],
            "disto_k3": list(RADIAL)}  # fmt: skip
    return {
        "sfm_data_version": "0.3", "root_path": "",
        "views": [{"key": k, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": k, "data": {
            "local_path": "", "filename": f"{k}.jpg", "width": 640, "height": 480, "id_view": k,
            "id_intrinsic": 0, "id_pose": k}}}} for k in range(2)],
        "intrinsics": [{"key": 0, "value": {"polymorphic_id": 2147483649,
            "polymorphic_name": "pinhole_radial_k3", "ptr_wrapper": {"id": 9, "data": data}}}],
        "extrinsics": [{"key": k, "value": {"rotation": TURNS[k].tolist(), "center": CENTRES[k].tolist()}}
                       for k in range(2)],
        "structure": [{"key": j, "value": {"X": POINTS[j].tolist(), "observations": [
            {"key": k, "value": {"id_feat": 0, "x": seen(k)[j].tolist()}} for k in range(2)]}}
            for j in range(len(POINTS))],
    }  # fmt: skip


def alicevision(**lens: Any) -> dict[str, Any]:
    def words(values: Any) -> list[str]:
        return [repr(float(v)) for v in np.ravel(values)]

    return {
        "version": ["1", "2", "6"],
        "views": [{"viewId": f"5{k}", "poseId": f"5{k}", "intrinsicId": "77", "path": f"/photos/{k}.jpg"}
                  for k in range(2)],
        "intrinsics": [{"intrinsicId": "77", "width": "640", "height": "480", "type": "radial3",
                        "distortionParams": words(RADIAL), **lens}],
        "poses": [{"poseId": f"5{k}", "pose": {"locked": "0", "transform": {
            "rotation": words(TURNS[k].T), "center": words(CENTRES[k])}}} for k in range(2)],
        "structure": [{"landmarkId": str(j), "X": words(POINTS[j]), "observations": [
            {"observationId": f"5{k}", "x": words(seen(k)[j])} for k in range(2)]}
            for j in range(len(POINTS))],
    }  # fmt: skip


SCENES = {
    "sfm_data.json": openmvg(),
    "corner.sfm": alicevision(pxFocalLength="800", principalPoint=["322", "238"]),
    "middle.sfm": alicevision(pxFocalLength=["800", "800"], principalPoint=["2", "-2"]),
    "sensor.sfm": alicevision(focalLength="10", sensorWidth="8", principalPoint=["2", "-2"]),
}


@pytest.mark.parametrize("name", SCENES)
def test_the_points_are_projected_to_where_they_are_seen(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(json.dumps(SCENES[name]))
    network = read_network(path)
    assert network.images == ("0.jpg", "1.jpg")
    assert len(network.xy) == 24
    assert np.abs(residuals(network)).max() < 1e-6


def test_another_model_is_refused_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a.sfm"
    scene = alicevision(pxFocalLength="800", principalPoint=["0", "0"])
    scene["intrinsics"][0]["type"] = "3deanamorphic4"
    path.write_text(json.dumps(scene))
    with pytest.raises(FormatError, match="3deanamorphic4"):
        read_network(path)


def test_a_missing_part_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({key: value for key, value in openmvg().items() if key != "extrinsics"}))
    with pytest.raises(FormatError, match="lacks 'extrinsics'"):
        read_network(path)
