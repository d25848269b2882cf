"""Rectified images of two cameras: rows of both agree, and their error is what it is said to be."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from reseau.bundle import adjust_network
from reseau.bundle.diagnostics.fields import pair_of
from reseau.calibration import CameraMapping
from reseau.calibration.rectification import Pair, Rectification, rectified
from reseau.core.errors import UsageError
from reseau.optics import OpenCV, PixelGrid, camera_model
from reseau.optics.mapping import PlaneMapping
from reseau.optics.poses import rotation_matrix

from ..montecarlo import tolerance
from . import rigs

TURN, BASE = rotation_matrix(np.array([0.02, 0.12, -0.03])), np.array([90.0, 4.0, -6.0])
LEFT = OpenCV.from_parameters({"fx": 520.0, "fy": 522.0, "cx": 322.0, "cy": 236.0, "k1": -0.2, "k2": 0.05})
WIDE = camera_model("fisheye").mapping(
    np.array([300.0, 301.0, 405.0, 310.0, 0.02, -0.01, 0.0, 0.0, 0.0, 0.0]), PixelGrid(800, 600, (1.0, 1.0))
)


def known(mapping: PlaneMapping, size: tuple[int, int]) -> CameraMapping:
    return CameraMapping(mapping, *size, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))


def pair(second: CameraMapping, turn: np.ndarray = TURN, base: np.ndarray = BASE) -> Pair:
    return Pair((known(LEFT, (640, 480)), second), turn, base, "mm", np.zeros((6, 6)))


@pytest.mark.parametrize("second", [known(LEFT, (640, 480)), known(WIDE, (800, 600))])
@pytest.mark.parametrize("base", [BASE, np.array([3.0, -120.0, 10.0])])
def test_an_object_point_is_in_the_same_row_of_both_images_and_its_disparity_tells_where_it_is(
    second: CameraMapping, base: np.ndarray
) -> None:
    found = rectified(pair(second, base=base), np.inf)
    along = int(np.argmax(np.abs(base[:2])))
    points = np.random.default_rng(3).uniform([-60, -60, 500], [60, 60, 900], (50, 3))
    turned = points @ found.rotations[0].T
    one, two = (
        (p[:, :2] / p[:, 2:])
        for p in (np.column_stack([turned, np.ones(50)]) @ matrix.T for matrix in found.projections)
    )
    assert np.abs(one[:, 1 - along] - two[:, 1 - along]).max() < 1e-9
    # Where the maps say that these pixels are, the camera has the point.
    maps = np.nan_to_num(found.maps, nan=-1e4)
    for k, (lens, pixels) in enumerate(zip(pair(second).lenses, (one, two), strict=True)):
        axes = points if k == 0 else (points - base) @ TURN.T
        seen = lens.mapping(axes[:, :2] / axes[:, 2:])
        at = np.stack(
            [
                cv2.remap(maps[k, :, :, c], *pixels.T.astype(np.float32), cv2.INTER_LINEAR).ravel()
                for c in (0, 1)
            ],
            axis=1,
        )
        inside = (at > 0).all(axis=1)
        assert inside.sum() > 20
        # The map is linear between pixels, and OpenCV knows 1/32 of a pixel.
        assert np.abs(at - seen)[inside].max() < 0.06
    disparity = (one - two)[:, along]
    again = np.column_stack([one, disparity, np.ones(50)]) @ found.to_points.T
    np.testing.assert_allclose(again[:, :3] / again[:, 3:], turned, atol=1e-7)


def test_the_maps_are_those_of_opencv_for_its_models() -> None:
    found = rectified(pair(known(LEFT, (640, 480))), np.inf)
    k = np.array([[520.0, 0.0, 322.0], [0.0, 522.0, 236.0], [0.0, 0.0, 1.0]])
    coefficients = np.array([-0.2, 0.05, 0.0, 0.0])
    x, y = cv2.initUndistortRectifyMap(
        k, coefficients, found.rotations[0], found.matrix, found.size, cv2.CV_32FC1
    )
    seen = np.isfinite(found.maps[0]).all(axis=2)
    assert seen.mean() > 0.6
    assert np.abs(found.maps[0] - np.stack([x, y], axis=2))[seen].max() < 1e-3


def rows_off(estimate: Pair, found: Rectification, true: Pair, at: np.ndarray, distance: float) -> np.ndarray:
    """How much the rows differ in which the first camera has a point at places (n, 2), and the second."""
    focal, centre = found.matrix[0, 0], found.matrix[:2, 2]
    pixels = estimate.lenses[0].mapping(turned((at - centre) / focal, found.rotations[0].T))
    ray = true.lenses[0].mapping.inverse(pixels)
    point = np.column_stack([ray, np.ones(len(ray))])
    point *= (distance / (point @ found.rotations[0][2]))[:, None]
    other = (point - true.base) @ true.rotation.T
    uv = estimate.lenses[1].mapping.inverse(true.lenses[1].mapping(other[:, :2] / other[:, 2:]))
    return np.asarray(focal * turned(uv, found.rotations[1])[:, 1] + centre[1] - at[:, 1])


def turned(uv: np.ndarray, turn: np.ndarray) -> np.ndarray:
    ray = np.column_stack([uv, np.ones(len(uv))]) @ turn.T
    return np.asarray(ray[:, :2] / ray[:, 2:])


def places(found: Rectification) -> np.ndarray:
    """Places at which the error is known."""
    (width, height), (rows, columns) = found.size, found.sigma.shape
    grid = np.meshgrid(np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows))
    return np.stack(grid, axis=-1)[np.isfinite(found.sigma)]


@pytest.mark.parametrize("unknown", range(10))
def test_the_error_of_rows_is_what_each_unknown_makes_of_it(unknown: int) -> None:
    names, step = np.array([0, 3]), [0.25, 0.25, 0.25, 0.25, *3 * [1e-3], *3 * [0.5]][unknown]
    lenses = [
        CameraMapping(m.with_values(np.r_[m.values[:4] / 4, m.values[4:]]), *size, names, np.zeros((2, 2)))
        for m, size in ((LEFT, (160, 120)), (WIDE, (200, 150)))
    ]
    only = np.zeros((10, 10))
    only[unknown, unknown] = step**2
    estimate = Pair((lenses[0], lenses[1]), TURN, BASE, "mm", only)
    found, off = rectified(estimate, 700.0), np.zeros(10)
    off[unknown] = step
    # The truth is off by this: parameters of the lenses, rotation about the axes of the second, base.
    true = [
        replace(lens, mapping=lens.mapping.with_values(
            {lens.names[k]: lens.mapping.values[names[k]] + part[k] for k in (0, 1)}
        ))
        for lens, part in zip(lenses, (off[:2], off[2:4]), strict=True)
    ]  # fmt: skip
    truth = Pair((true[0], true[1]), rotation_matrix(off[4:7]) @ TURN, BASE + off[7:], "mm", only)
    there = rows_off(estimate, found, truth, places(found), 700.0)
    said = found.sigma[np.isfinite(found.sigma)]
    assert np.abs(np.abs(there) - said).max() < 0.02 * said.max() + 1e-6


@pytest.mark.slow
def test_rows_differ_as_much_as_is_said() -> None:
    squares, runs = [], 100
    lenses = [known(camera.bare_mapping(), (camera.width, camera.height)) for camera in rigs.drawn().cameras]
    truth = Pair(
        (lenses[0], lenses[1]), rotation_matrix(rigs.PLACES[1][0]), rigs.PLACES[1][1], "mm", np.zeros((6, 6))
    )
    for seed in range(runs):
        estimate = pair_of(adjust_network(rigs.drawn(seed)).required(), 1)
        found = rectified(estimate, 500.0)
        off = rows_off(estimate, found, truth, places(found), 500.0)
        squares.append(float(np.mean((off / found.sigma[np.isfinite(found.sigma)]) ** 2)))
    # The differences over the image are about three independent ones; shared errors by chance widen them.
    assert np.mean(squares) == pytest.approx(0.93, abs=0.07 + tolerance(3 * runs))


def test_cameras_that_cannot_be_rectified_are_refused() -> None:
    lens = known(LEFT, (640, 480))
    with pytest.raises(UsageError, match="at one place"):
        rectified(pair(lens, base=np.zeros(3)), np.inf)
    with pytest.raises(UsageError, match="no field in common"):
        rectified(pair(lens, rotation_matrix(np.array([0.0, 2.5, 0.0]))), np.inf)
    result = adjust_network(rigs.drawn(exposures=5)).required()
    with pytest.raises(UsageError, match="has no place"):
        pair_of(result, 0)
