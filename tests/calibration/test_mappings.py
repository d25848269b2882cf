"""Mappings of calibrations: covariances by Monte Carlo, inverses, validity, files of earlier versions."""

from __future__ import annotations

import json

import numpy as np
import pytest

from reseau.calibration import (
    Calibration,
    CameraCorrection,
    CameraMapping,
    CorrectedImage,
    FilmFrameMapping,
    calibration_of_frame,
)
from reseau.calibration.camera import Rival
from reseau.calibration.document import Covariance, Quantity
from reseau.calibration.reader import parse_calibration
from reseau.calibration.sensor import Fields, SensorCorrection
from reseau.core.data import Array, ImagePoints
from reseau.core.errors import FormatError, UsageError
from reseau.io import CORNERS, FrameOrientation
from reseau.optics import RationalPolynomial
from reseau.optics.composition import Similarity

DRAWS = 4000
# Of a variance from 4000 draws: sqrt(2 / 4000) = 2.2 %; four of them.
TOLERANCE = 0.09
VALUES = {"fx": 800.0, "fy": 802.0, "cx": 322.0, "cy": 238.0, "k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -5e-4}
SIGMA = {"fx": 0.5, "fy": 0.5, "cx": 0.4, "cy": 0.3, "k1": 1e-3}


def camera(**changes: object) -> Calibration:
    """A camera of 640 × 480 pixels, calibrated with fx and fy correlated by 0.8."""
    matrix = np.diag(np.square(list(SIGMA.values())))
    matrix[0, 1] = matrix[1, 0] = 0.8 * SIGMA["fx"] * SIGMA["fy"]
    content: dict[str, object] = {
        "kind": "camera",
        "name": "front",
        "model": {"model": "opencv", "width": 640, "height": 480, "pitch_mm": [1.0, 1.0]},
        "parameters": {
            key: Quantity(value=value, sigma=SIGMA.get(key, 0.0), unit="px") for key, value in VALUES.items()
        },
        "covariance": Covariance(names=tuple(SIGMA), matrix=tuple(tuple(row) for row in matrix.tolist())),
        "sigma0": 1.0,
        "redundancy": 100,
        "validity": {"extent": [100.0, 80.0, 540.0, 400.0], "unit": "px"},
    }
    return Calibration(**(content | changes))  # type: ignore[arg-type]


def test_models_of_other_kinds_are_read_as_they_were_written_and_refused_if_they_are_none() -> None:
    given = camera()
    model = {**given.model, "model": "fisheye"}
    lens = CameraMapping.from_calibration(
        camera(model=model, parameters=dict(list(given.parameters.items())[:6]))
    )
    entry = Rival(0.3, lens, model).entry()
    again = CameraMapping.from_calibration(camera(validity={"rivals": [entry]})).rivals[0]
    xy = np.array([[0.1, 0.2], [-0.3, 0.1]])
    np.testing.assert_array_equal(again.lens.mapping(xy), lens.mapping(xy))
    np.testing.assert_array_equal(again.lens.covariance, lens.covariance)
    broken: list[object] = [
        7, [3], [{**entry, "probability": 1.2}], [{**entry, "covariance": [[1.0]]}],
        [{**entry, "model": {**model, "model": "none"}}], [{**entry, "estimated": ["k9"]}],
        [{**entry, "model": {**model, "width": 320}}],
    ]  # fmt: skip
    for rivals in broken:
        with pytest.raises(FormatError, match="damaged or unknown model"):
            CameraMapping.from_calibration(camera(validity={"rivals": rivals}))


def orientation(transform: dict[str, object] | None = None) -> FrameOrientation:
    """A frame of 36 × 24 mm at 10 px/mm, turned by 2 degrees."""
    turn = np.deg2rad(2.0)
    frame = np.array([[-18.0, 12.0], [18.0, 12.0], [18.0, -12.0], [-18.0, -12.0]]) * [10.0, -10.0]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    xy = frame @ rotation.T + [210.0, 150.0]
    content = {
        "schema": "reseau-orientation/1", "image": "scan.tif", "status": "oriented", "why": "",
        "format_mm": [36.0, 24.0], "channel": "grey",
        "corners": {
            name: {"x": x, "y": y, "sx": 0.1, "sy": 0.2, "rho": 0.3}
            for name, (x, y) in zip(CORNERS, xy.tolist(), strict=True)
        },
        "principal_point": {"x": 210.0, "y": 150.0, "sx": 0.1, "sy": 0.1, "rho": 0.0},
        "angle_deg": -2.0, "angle_sigma_deg": 0.02, "px_per_mm": [10.0, 10.0], "edges": {},
        "transform": transform,
    }  # fmt: skip
    return FrameOrientation.parse(json.dumps(content), where="orientation")


def projective() -> dict[str, object]:
    """A transformation of eight parameters that goes through the calibrated corners."""
    values = dict.fromkeys(("a1", "b1", "c1", "a2", "b2", "c2", "a0", "b0"), 0.0)
    values |= {"a1": 1.001, "b2": 0.999, "b1": 1e-3, "c1": 0.02, "a0": 1e-5}
    return {
        "kind": "projective",
        "parameters": {name: {"value": value, "sigma": None} for name, value in values.items()},
        "residuals_mm": {name: [0.0, 0.0] for name in CORNERS},
        "sigma_mm": None,
    }


def compare(found: ImagePoints, drawn: Array) -> None:
    """Covariances of points against the scatter of draws (draws, n, 2)."""
    for cov, sample in zip(found.cov, np.swapaxes(drawn, 0, 1), strict=True):
        root = np.linalg.cholesky(cov)
        white = np.linalg.solve(root, (sample - sample.mean(axis=0)).T)
        np.testing.assert_allclose(white @ white.T / len(drawn), np.eye(2), atol=TOLERANCE)


@pytest.mark.slow
def test_directions_of_a_camera_have_the_covariance_of_points_and_calibration() -> None:
    calibration, rng = camera(), np.random.default_rng(1)
    mapping = calibration.mapping()
    assert isinstance(mapping, CameraMapping)
    points = ImagePoints.with_sigma(["a", "b"], [[150.0, 120.0], [400.0, 300.0]], 0.2)
    root = np.linalg.cholesky(mapping.covariance)
    drawn = []
    for _ in range(DRAWS):
        values = np.array([VALUES[name] for name in SIGMA]) + root @ rng.standard_normal(len(SIGMA))
        other = mapping.mapping.with_values(dict(zip(SIGMA, values, strict=True)))
        drawn.append(other.inverse(points.xy + 0.2 * rng.standard_normal((2, 2))))
    found = mapping.apply(points)
    np.testing.assert_allclose(mapping.to_pixels(found.xy), points.xy, atol=1e-9)
    compare(found, np.array(drawn))


@pytest.mark.slow
@pytest.mark.parametrize("transform", [None, projective()], ids=["corners", "projective"])
def test_photo_coordinates_have_the_covariance_of_points_and_corners(
    transform: dict[str, object] | None,
) -> None:
    mapping, rng = calibration_of_frame(orientation(transform)).mapping(), np.random.default_rng(2)
    assert isinstance(mapping, FilmFrameMapping)
    points = ImagePoints.with_sigma(["a", "b"], [[60.0, 80.0], [300.0, 200.0]], 0.3)
    calibrated = None if mapping.transform is None else mapping._mapped(mapping.corners)
    root = np.linalg.cholesky(mapping.covariance)
    drawn = []
    for _ in range(DRAWS):
        corners = mapping.corners + (root @ rng.standard_normal(8)).reshape(4, 2)
        xy = mapping._photo(points.xy + 0.3 * rng.standard_normal((2, 2)), corners)
        if mapping.transform is not None:
            at, model = mapping._photo(corners, corners), mapping.transform
            for _ in range(3):
                seen = model.derivatives(at)
                step = np.linalg.solve(seen.d_parameters.reshape(8, 8), (calibrated - seen.value).ravel())
                model = model.with_values(model.values + step)
            xy = model(xy)
        drawn.append(xy)
    found = mapping.apply(points)
    np.testing.assert_allclose(mapping.to_pixels(found.xy), points.xy, atol=1e-8)
    compare(found, np.array(drawn))


def test_the_inverse_mapping_to_pixels_includes_both_covariances() -> None:
    mapping = camera().mapping()
    points = ImagePoints.with_sigma(["a"], [[150.0, 120.0]], 0.2)
    back = mapping.inverse(mapping.apply(points))
    np.testing.assert_allclose(back.xy, points.xy, atol=1e-9)
    # The calibration enters twice: once each way.
    own = mapping.inverse(mapping.apply(ImagePoints.with_sigma(["a"], points.xy, 0.0))).cov
    np.testing.assert_allclose(back.cov, points.cov + own, rtol=1e-9)


def test_points_outside_the_validity_get_a_reason() -> None:
    mapping = camera().mapping()
    xy = [[300.0, 200.0], [560.0, 200.0], [620.0, 200.0], [700.0, 200.0]]
    inside, near, far, outside = mapping.why_not(ImagePoints.with_sigma("abcd", xy, 0.1))
    assert (inside, near) == ("", "")  # 20 px beyond are 5 % of the extent
    assert far == "lies 18 % of the extent beyond the observations: the correction is unreliable there"
    assert outside == "lies outside the image"


def test_every_kind_states_what_it_applies_to() -> None:
    flat = np.ones((4, 5), dtype=np.float32)
    sensor = SensorCorrection(Fields(flat, 0 * flat, flat, flat == 0), 0.0, 0.0, 255.0, 1e3)
    plane = CameraCorrection(
        RationalPolynomial.camera(), np.zeros((13, 13)), Similarity(), Similarity(), "mm"
    )
    assert camera().mapping().applies_to == ("points", "images")
    assert plane.calibration(name="c").mapping().applies_to == ("points", "images")
    assert calibration_of_frame(orientation()).mapping().applies_to == ("points", "images", "scans")
    assert sensor.applies_to == ("frames",)


def test_files_of_earlier_versions_are_read_as_the_kind_they_are_now() -> None:
    flat = np.ones((4, 5), dtype=np.float32)
    correction = SensorCorrection(Fields(8 * flat, 0 * flat, flat, flat == 0), 0.0, 0.0, 255.0, 1e3)
    sensor = json.loads(camera().to_json()) | {"kind": "camera", "model": correction.to_model()}
    found = parse_calibration(json.dumps(sensor), where="sensor.json")
    assert found.kind == "sensor"
    assert isinstance(found.mapping(), SensorCorrection)
    frame = json.loads(calibration_of_frame(orientation()).to_json()) | {"kind": "frame"}
    assert parse_calibration(json.dumps(frame), where="frame.json").kind == "film_frame"
    text = orientation().to_json()
    assert parse_calibration(text, where="scan.json") == calibration_of_frame(orientation())


def test_a_kind_with_the_model_of_another_and_a_declined_frame_are_refused() -> None:
    wrong = json.loads(camera().to_json()) | {"kind": "oscilloscope"}
    with pytest.raises(FormatError, match="'oscilloscope' has a model of 'camera'"):
        parse_calibration(json.dumps(wrong), where="c.json")
    unknown = json.loads(camera().to_json())
    unknown["model"]["model"] = "no such model"
    with pytest.raises(FormatError, match="no such model"):
        parse_calibration(json.dumps(unknown), where="c.json").mapping()
    declined = json.loads(orientation().to_json()) | {"status": "declined", "why": "of one tone"}
    declined |= {"corners": None}
    with pytest.raises(FormatError, match="not oriented: of one tone"):
        parse_calibration(json.dumps(declined), where="scan.json")


def test_the_field_of_view_is_kept_complete_or_has_the_given_angle() -> None:
    mapping = camera().mapping()
    assert isinstance(mapping, CameraMapping)
    keep = CorrectedImage.undistorted(mapping, "keep")
    assert (keep.width, keep.height) == (640, 480)
    pinhole = [keep.pinhole[key] for key in ("fx", "fy", "cx", "cy")]
    np.testing.assert_allclose(pinhole, [800.0, 802.0, 322.0, 238.0], atol=1e-9)
    everything = CorrectedImage.undistorted(mapping, "all")
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
    seen = everything.of_system(mapping.mapping.inverse(corners))
    assert seen.min() >= -1e-6
    assert (seen <= np.array([everything.width, everything.height])).all()
    wide = CorrectedImage.undistorted(mapping, 60.0, 2.0)
    assert (wide.width, wide.height) == (1280, 960)
    assert 2 * np.rad2deg(np.arctan(wide.width / 2 / wide.pinhole["fx"])) == pytest.approx(60.0)
    for fov in (0.0, 180.0):
        with pytest.raises(UsageError, match="not between"):
            CorrectedImage.undistorted(mapping, fov)
