"""A camera calibrated on an exact turntable: points seen only with camera rotation have no depth."""

from dataclasses import dataclass

import numpy as np
import pytest

from reseau.capture import paper_steps, spread
from reseau.core.data import Array, ImagePoints
from reseau.core.failure import Code, Failure
from reseau.optics import Brown, PixelGrid
from reseau.optics.poses import project
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.testfield import Mount

from ..montecarlo import slowly

SIGMA = 0.006
CAMERA = Brown(side="object", grid=PixelGrid(240, 240, (0.027, 0.027))).with_values({"c": 57.5, "K1": 1.2e-3})
MOUNT = Mount(1, (1.0, 1.0, 1.0), 1.0, np.diag([1.0, -1.0, -1.0]), np.array([3.0, -2.0, 5000.0]), 0.0)


@dataclass(frozen=True)
class Board:
    """A raster of points."""

    ids: tuple[str, ...]
    xy: Array
    unit: str = "mm"


def board() -> Board:
    x, y = np.meshgrid(np.arange(-480, 481, 40.0), np.arange(-480, 481, 40.0))
    return Board(tuple(f"P{k}" for k in range(x.size)), np.column_stack([x.ravel(), y.ravel()]))


def recordings(seed: int) -> list[tuple[str, ImagePoints]]:
    """Its images in twelve poses of the paper, with noise."""
    rng, target, seen = np.random.default_rng(seed), board(), []
    for step in spread(paper_steps(), 12):
        xy = project(CAMERA, MOUNT.pose(step.position), np.pad(target.xy, ((0, 0), (0, 1)))).xy
        inside = np.flatnonzero(((xy > 6) & (xy < 233)).all(axis=1))
        noisy = xy[inside] + rng.normal(0, SIGMA, (len(inside), 2))
        seen.append((step.name, ImagePoints.with_sigma([target.ids[k] for k in inside], noisy, SIGMA)))
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *slowly(1, 2)])
def test_points_without_depth_do_not_prevent_convergence(seed: int) -> None:
    model = CameraOptions("brown", ("c", "x0", "y0", "K1"), (0.027, 0.027))
    found = calibrate_camera(
        recordings(seed), board(), lambda frame: Failure("", Code.NOT_FOUND), (240, 240), model
    )
    assert not isinstance(found, Failure)
    names, _, values = found.result.camera_columns(0)
    sigma = np.sqrt(np.diag(found.result.camera_covariance(0)))
    errors = (values - [CAMERA.values[CAMERA.names.index(name)] for name in names]) / sigma
    assert np.abs(errors).max() < 4
    assert abs(found.result.sigma0 - 1) < 0.06
