"""Wide cameras beside OpenCV's and beside their published formulas: projections, calibrations, limits."""

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
from reseau.optics.cameras.opencv import OpenCV
from reseau.optics.cameras.projections import (
    Division,
    DoubleSphere,
    EnhancedUnified,
    Equisolid,
    Fisheye,
    Omni,
    Orthographic,
    Stereographic,
)

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


@pytest.mark.slow
def test_a_calibration_of_board_views_is_that_of_opencv() -> None:
    """The same corners, model and noise: the parameters differ by less than a tenth of their sigmas."""
    lens = lenses.fisheye(76)
    flat, true = lenses.board(8, 6, 1.0)
    seen = lenses.views(lens, flat, true, 15, 0.2, 4)
    f = 1.05 * float(lens.matrix[0, 0])
    start = {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    free = list(Fisheye.names[:8])
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


@pytest.mark.parametrize("count", [8, 12, 14])
def test_all_coefficients_project_as_opencv(count: int) -> None:
    """Eight, twelve and fourteen coefficients; the last two tilt the sensor."""
    k = np.array([0.2, -0.05, 4e-4, -3e-4, 0.01, 0.4, 0.03, -0.005, 2e-3, -1e-3, 3e-3, 5e-4, 0.04, -0.07])
    k[count:] = 0.0
    x, (fx, fy, cx, cy) = rays(50.0), FRAME
    matrix, none = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    theirs, _ = cv2.projectPoints(x[:, None], none, none, matrix, k)
    camera = OpenCV([*FRAME, *k])
    np.testing.assert_allclose(camera(x[:, :2] / x[:, 2:]), theirs[:, 0], rtol=0, atol=1e-9)


def published(kind: str, x: Array, shape: tuple[float, ...]) -> Array:
    """The plane of each publication, from points in space and with its own quantities."""
    unit = x / np.linalg.norm(x, axis=1, keepdims=True)
    angle = np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
    way = x[:, :2] / np.hypot(x[:, 0], x[:, 1])[:, None]
    if kind in ("equisolid", "orthographic", "stereographic"):
        radius = {"equisolid": 2 * np.sin(angle / 2), "orthographic": np.sin(angle),
                  "stereographic": 2 * np.tan(angle / 2)}[kind]  # fmt: skip
        return radius[:, None] * way
    if kind == "omni":
        return unit[:, :2] / (unit[:, 2:] + shape[0])
    if kind == "double_sphere":
        xi, alpha = shape
        d1 = np.linalg.norm(x, axis=1)
        d2 = np.sqrt((x[:, :2] ** 2).sum(axis=1) + (xi * d1 + x[:, 2]) ** 2)
        return x[:, :2] / (alpha * d2 + (1 - alpha) * (xi * d1 + x[:, 2]))[:, None]
    if kind == "eucm":
        alpha, beta = shape
        d = np.sqrt(beta * (x[:, :2] ** 2).sum(axis=1) + x[:, 2] ** 2)
        return x[:, :2] / (alpha * d + (1 - alpha) * x[:, 2])[:, None]
    # Division: the ideal radius as a function of that in the image, solved by bisection.
    low, high = np.zeros(len(x)), np.minimum(np.tan(angle) * 1.001, (1 - 1e-12) / np.sqrt(-shape[0]))
    for _ in range(200):
        middle = (low + high) / 2
        below = middle / (1 + shape[0] * middle**2) < np.tan(angle)
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return middle[:, None] * way


@pytest.mark.parametrize(
    ("camera", "kind", "shape"),
    [
        (Equisolid, "equisolid", ()),
        (Orthographic, "orthographic", ()),
        (Stereographic, "stereographic", ()),
        (Omni, "omni", (0.9,)),
        (Omni, "omni", (1.6,)),
        (DoubleSphere, "double_sphere", (-0.18, 0.59)),
        (DoubleSphere, "double_sphere", (0.6, 0.3)),
        (EnhancedUnified, "eucm", (0.59, 1.13)),
        (EnhancedUnified, "eucm", (0.25, 0.6)),
        (Division, "division", (-0.3,)),
    ],
)
def test_projections_are_those_of_their_publications(
    camera: type, kind: str, shape: tuple[float, ...]
) -> None:
    x = rays(85.0)[1:]
    expected = published(kind, x, shape) * FRAME[:2] + FRAME[2:]
    lens = camera([*FRAME, *shape])
    uv = x[:, :2] / x[:, 2:]
    np.testing.assert_allclose(lens(uv), expected, rtol=0, atol=1e-9)
    bent = camera([*FRAME, *shape, 0.02, -0.004, 0.0, 0.0, 1e-3, -8e-4])
    size = 1 + (uv**2).sum(axis=1, keepdims=True)
    inside = bent.one_to_one(uv)
    assert inside.mean() > 0.8
    for each, rows in ((lens, np.full(len(uv), True)), (bent, inside)):
        off = (each.inverse(each(uv[rows])) - uv[rows]) / size[rows]
        np.testing.assert_allclose(off, 0.0, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("lens", "angle_deg"),
    [
        (Omni([*FRAME, -0.8]), np.degrees(np.arccos(0.8))),
        (DoubleSphere([*FRAME, -0.7, 0.4]), 80.0),
        (EnhancedUnified([*FRAME, -0.8, 1.2]), np.degrees(np.arctan(np.sqrt((2.25**2 - 1) / 1.2)))),
        (EnhancedUnified([*FRAME, 1.5, 2.0]), np.degrees(np.arctan(2.0))),
        (Division([*FRAME, 0.3]), np.degrees(np.arctan(np.sqrt(1 / 1.2)))),
    ],
)
def test_rays_outside_the_domain_have_no_image(lens: Omni, angle_deg: float) -> None:
    """Where a denominator vanishes or a root is imaginary the camera ends; the image grows up to there."""
    if isinstance(lens, DoubleSphere):
        w1, xi = 0.4 / 0.6, -0.7
        angle_deg = np.degrees(np.arccos(-(w1 + xi) / np.sqrt(2 * w1 * xi + xi**2 + 1)))
    inside, outside = np.tan(
        np.radians(angle_deg * np.array([np.linspace(0, 0.999, 300), np.linspace(1.001, 1.1, 300)]))
    )
    radii = lens(np.column_stack([inside, 0 * inside]))[:, 0]
    assert (np.diff(radii) > 0).all()
    assert lens.one_to_one(np.column_stack([inside, 0 * inside])).all()
    beyond = np.column_stack([outside, 0 * outside])[np.tan(np.radians(angle_deg)) < outside]
    assert np.isnan(lens(beyond)).all()
    assert not lens.one_to_one(beyond).any()
