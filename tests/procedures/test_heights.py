"""A plane target seen frontally at several heights: coordinates alone, no images."""

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Result
from reseau.core.data import ImagePoints
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.designs import coded_testfield
from reseau.optics import Brown, PixelGrid, Pose, project
from reseau.optics.poses import matrix_to_vector, rotation_matrix
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CalibrationOptions, CameraOptions
from reseau.procedures.z_stage import Heights

DESIGN = coded_testfield()
READINGS = (0.0, 250.0, 500.0)
SIGMA_PX, SIGMA_MM, SIGMA_AXIS, SIGMA_FIELD = 0.02, 0.05, 5e-3, 0.05
TRUE = {"c": 57.5, "x0": 0.05, "y0": -0.03}
MODEL = CameraOptions("brown", tuple(TRUE), (0.027, 0.027))
CAMERA = Brown(side="object", grid=PixelGrid(240, 240, (0.027, 0.027))).with_values(TRUE)
Seen = list[tuple[str, ImagePoints]]


def recorded(seed: int, poses: int = 2, away: float = 1.0) -> tuple[Seen, Heights]:
    """Every fourth target from poses at right angles to within some mrad, as the stage really moved."""
    rng = np.random.default_rng(seed)
    names, plane = DESIGN.ids[::4], DESIGN.xy[::4]
    field = np.column_stack([plane, np.zeros(len(plane))]) + rng.normal(0, SIGMA_FIELD, (len(plane), 3))
    axis = np.array([*rng.normal(0, SIGMA_AXIS, 2), away])
    seen: Seen = []
    pose, reading = dict[str, int](), dict[str, float]()
    for p in range(poses):
        looks = rotation_matrix(rng.normal(0, 3e-3, 3)) @ np.diag([1.0, -1.0, -1.0])
        x0 = np.array([*rng.normal(0, 10, 2), 5000.0 + rng.normal(0, 20)])
        for height in READINGS:
            moved = (height + rng.normal(0, SIGMA_MM)) * axis / np.linalg.norm(axis)
            xy = project(CAMERA, Pose(matrix_to_vector(looks), x0 - moved), field).xy
            inside = np.flatnonzero(((xy > 3) & (xy < 236)).all(axis=1))
            xy = xy[inside] + rng.normal(0, SIGMA_PX, (len(inside), 2))
            cov = np.tile(np.eye(2) * SIGMA_PX**2, (len(inside), 1, 1))
            name = f"{p} at {height:g}"
            seen.append((name, ImagePoints(tuple(names[k] for k in inside), xy, cov)))
            pose[name], reading[name] = p, height
    return seen, Heights(pose, reading, SIGMA_MM, SIGMA_AXIS, SIGMA_FIELD)


def calibrated(seen: Seen, heights: Heights | None) -> Calibrated | Failure:
    options = CalibrationOptions(heights=heights)
    return calibrate_camera(
        seen, DESIGN, lambda frame: Failure("", Code.NOT_FOUND), (240, 240), MODEL, options
    )


def camera_of(found: Calibrated | Failure) -> tuple[np.ndarray, np.ndarray, Result]:
    assert isinstance(found, Calibrated)
    result = found.result
    return result.camera_columns(0)[2], np.sqrt(np.diag(result.camera_covariance(0))), result


@pytest.mark.slow
def test_errors_of_the_interior_orientation_are_as_large_as_their_sigmas() -> None:
    ratios, sigma0 = [], []
    for seed in range(150):
        values, sigma, result = camera_of(calibrated(*recorded(seed)))
        ratios.append((values - list(TRUE.values())) / sigma)
        sigma0.append(result.sigma0)
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert rms.shape == (3,)
    assert (np.abs(rms - 1) < 0.17).all()  # three sigmas of an rms of 150
    assert 0.9 < np.sqrt(np.mean(np.square(ratios))) < 1.1
    assert abs(np.mean(sigma0) - 1) < 0.01


@pytest.mark.slow
def test_without_heights_the_same_images_do_not_determine_the_principal_distance() -> None:
    seen, heights = recorded(1)
    _, sigma, _ = camera_of(calibrated(seen, heights))
    plane = calibrated(seen, None)
    assert not plane or camera_of(plane)[1][0] > 30 * sigma[0]
    assert sigma[0] < 0.03


@pytest.mark.parametrize("away", [1.0, -1.0])
def test_the_direction_of_the_stage_is_determined(away: float) -> None:
    values, sigma, result = camera_of(calibrated(*recorded(5, away=away)))
    stage = result.fit.values.stage
    assert stage is not None
    assert np.sign(stage.axis[2]) == away
    assert (np.abs(values - list(TRUE.values())) < 4 * sigma).all()


def test_images_of_a_pose_differ_only_by_the_stage() -> None:
    _, _, result = camera_of(calibrated(*recorded(2)))
    values, stage = result.fit.values, result.fit.values.stage
    assert stage is not None
    for rows in ([0, 1, 2], [3, 4, 5]):
        assert (values.rotation[rows] == values.rotation[rows[0]]).all()
        at_rest = values.x0[rows] + stage.reading[rows, None] * stage.axis
        assert np.abs(at_rest - at_rest[0]).max() < 1e-9
    assert np.abs(stage.reading - np.tile(READINGS, 2)).max() < 5 * SIGMA_MM
    own = 2 * 6 + 6 + 2  # poses, readings, axis
    assert result.fit.counts[1] == 3 + own + 3 * len(result.network.points)


def test_sigmas_of_zero_are_refused() -> None:
    with pytest.raises(UsageError, match="standard deviation of a height"):
        Heights({}, {}, 0.0, 1e-3, 0.05)


def test_a_stage_needs_control() -> None:
    _, _, result = camera_of(calibrated(*recorded(2)))
    with pytest.raises(UsageError, match="requires the datum `control`"):
        replace(result.network, datum="free")
