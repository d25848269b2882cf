"""The fisheye camera beside OpenCV's: projections, calibrations of the same corners, limits."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.bundle import Network, adjust_network
from reseau.core.data import Array
from reseau.io.network import Network1
from reseau.optics.cameras import Fisheye

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
lenses = importlib.import_module("worlds.lenses")

FRAME = (402.0, 404.0, 641.3, 477.9)


def rays(most_deg: float, n: int = 500) -> Array:
    """Points at all angles up to a limit, some on the axis."""
    rng = np.random.default_rng(3)
    angle, round_ = np.radians(rng.uniform(0, most_deg, n)), rng.uniform(0, 2 * np.pi, n)
    angle[:5] = (0.0, 1e-9, 1e-5, 9.9e-3, 1.01e-2)
    across = np.column_stack([np.cos(round_), np.sin(round_)]) * np.sin(angle)[:, None]
    return np.column_stack([across, np.cos(angle)]) * rng.uniform(0.5, 3, (n, 1))


@pytest.mark.parametrize(
    "k", [(0.0, 0.0, 0.0, 0.0), (0.05, -0.02, 0.006, -0.001), (-0.03, 0.01, -0.004, 0.0006)]
)
def test_the_fisheye_projects_as_opencv(k: tuple[float, ...]) -> None:
    x = rays(89.0)
    fx, fy, cx, cy = FRAME
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    none = np.zeros(3)
    theirs, _ = cv2.fisheye.projectPoints(x[:, None], none, none, matrix, np.array(k))
    camera = Fisheye([*FRAME, *k])
    np.testing.assert_allclose(camera(x[:, :2] / x[:, 2:]), theirs[:, 0], rtol=0, atol=1e-9)


def test_directions_far_from_the_axis_are_found_again() -> None:
    camera, x = Fisheye([*FRAME, 0.05, -0.02, 0.006, -0.001]), rays(80.0)
    uv = x[:, :2] / x[:, 2:]
    again = camera.inverse(camera(uv))
    size = 1 + (uv**2).sum(axis=1, keepdims=True)
    np.testing.assert_allclose((again - uv) / size, 0.0, atol=1e-11)


def test_a_polynomial_that_turns_back_has_no_directions_beyond() -> None:
    """θ (1 − 0.4 θ²) is largest at 0.913 rad; no direction has an image farther out."""
    camera = Fisheye([*FRAME, -0.4, 0.0, 0.0, 0.0])
    edge = 402.0 * 0.9129 * (1 - 0.4 * 0.9129**2)
    found = camera.inverse([[641.3 + 0.99 * edge, 477.9], [641.3 + 1.01 * edge, 477.9]])
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


def test_a_calibration_of_board_views_is_that_of_opencv() -> None:
    """The same corners, model and noise: the parameters differ by less than a tenth of their sigmas."""
    lens = lenses.fisheye(76)
    flat, true = lenses.board(8, 6, 1.0)
    seen = lenses.views(lens, flat, true, 15, 0.2, 4)
    f = 1.05 * float(lens.matrix[0, 0])
    start = {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    free = list(Fisheye.names)
    document = lenses.document(lens, flat, seen, start, free, 0.2, "fisheye")
    network = Network.from_document(Network1.from_content(json.loads(json.dumps(document)), where="test"))
    result = adjust_network(network).required()
    assert result.fit.usable.images.all()
    points = [flat[rows][None] for rows, _ in seen]
    images = [xy[None] for _, xy in seen]
    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW | cv2.CALIB_USE_INTRINSIC_GUESS
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-12)
    _, k, d, *_ = cv2.fisheye.calibrate(
        points, images, (lens.width, lens.height), lens.matrix.copy(), np.zeros(4), flags=flags,
        criteria=until,
    )  # fmt: skip
    theirs = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()])
    camera = result.cameras["A"]
    assert (np.abs(camera.values - theirs) < 0.1 * camera.sigma).all()
    true_values = [*lens.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *lens.coefficients]
    assert (np.abs(camera.values - true_values) < 4.5 * camera.sigma).all()
