"""Regular targets, printed with errors, whose points photographs name in different ways: turned, shifted."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from reseau.core.data import ImagePoints
from reseau.core.failure import Failure
from reseau.designs import board
from reseau.io import BoardDesign
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.exposures import Taken
from reseau.procedures.target_measurement import MeasuredPhotograph, Photograph
from reseau.procedures.told_target import ways_to_turn

from ..montecarlo import slowly

SIGMA, TRUE = 0.01, {"fx": 700.0, "fy": 702.0, "cx": 402.0, "cy": 297.0}
SIZE = (800, 600)


def photographs(design: BoardDesign, print_mm: float, shifted: int = 0) -> list[tuple[str, ImagePoints]]:
    """Points by OpenCV's projection; each photograph names them as the target turned by chance is named.

    In every third photograph the last points are hidden, and names are shifted by as many.
    """
    rng, found = np.random.default_rng(3), []
    middle = (design.xy.max(axis=0) + design.xy.min(axis=0)) / 2
    printed = design.xy - middle + rng.normal(0, print_mm, design.xy.shape)
    xyz = np.column_stack([printed * [1, -1], np.zeros(len(printed))])
    matrix = np.array([[TRUE["fx"], 0, TRUE["cx"]], [0, TRUE["fy"], TRUE["cy"]], [0, 0, 1]])
    ways = ways_to_turn(design)
    for k in range(12):
        axis = np.deg2rad(30) * np.array([np.cos(1.3 * k), np.sin(1.3 * k), 0])
        roll = cv2.Rodrigues(np.array([0, 0, np.pi / 2 * k]))[0]
        place = np.array([rng.uniform(-40, 40), rng.uniform(-30, 30), 260.0 + 20 * (k % 3)])
        turn = cv2.Rodrigues(cv2.Rodrigues(axis)[0] @ roll)[0]
        xy = cv2.projectPoints(xyz, turn, place, matrix, np.array([-0.2, 0.05, 0, 0]))[0][:, 0]
        seen = np.all((xy > 5) & (xy < np.array(SIZE) - 6), axis=1)
        way = ways[int(rng.integers(len(ways)))]
        rows = way.rows
        if k % 3 == 1:
            seen[len(design.ids) - shifted :] = False
            rows = np.roll(rows, -shifted)
        names = [design.ids[row] for row in rows[seen]]
        xy = xy[seen] + rng.normal(0, SIGMA, (int(seen.sum()), 2))
        found.append((f"{k}.png", ImagePoints.with_sigma(names, xy, SIGMA)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("print_mm", [0.03, *slowly(0.0, 0.15)])
@pytest.mark.parametrize(
    ("design", "ways"),
    [
        (board("circles", 7, 10, 20.0), 2),
        (board("circles", 9, 9, 20.0), 4),
        (board("circles", 4, 10, 15.0, asymmetric=True), 2),
        *slowly((board("chess", 8, 10, 20.0), 2)),
    ],
    ids=["circles", "square", "asymmetric", "chess"],
)
def test_photographs_that_name_points_differently_give_the_accuracy_of_those_that_do_not(
    design: BoardDesign, ways: int, print_mm: float
) -> None:
    assert len(ways_to_turn(design)) == ways
    model = CameraOptions("opencv", ("fx", "fy", "cx", "cy", "k1", "k2"))
    done = calibrate_camera(photographs(design, print_mm), design, lambda frame: None, SIZE, model)  # type: ignore[arg-type, return-value]
    assert isinstance(done, Calibrated)
    assert 0.85 < done.sigma0 < 1.15
    camera = done.cameras["camera"]
    for name, value, sigma in zip(camera.parameters, camera.values, camera.sigma, strict=True):
        if name in TRUE:
            assert abs(value - TRUE[name]) < 4 * sigma < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("design", [*slowly(board("chess", 7, 10, 20.0)), board("circles", 7, 10, 20.0)])
def test_photographs_of_a_part_that_name_its_points_shifted_are_named_alike(design: BoardDesign) -> None:
    two_rows = 2 * (6 if design.kind == "chess" else 7)
    images = photographs(design, 0.1, two_rows)
    model = CameraOptions("opencv", ("fx", "fy", "cx", "cy", "k1", "k2"))
    done = calibrate_camera(images, design, lambda frame: None, SIZE, model)  # type: ignore[arg-type, return-value]
    assert isinstance(done, Calibrated)
    assert 0.85 < done.sigma0 < 1.15


@pytest.mark.parametrize(
    "design",
    [
        board("circles", 4, 11, 15.0, asymmetric=True),
        board("chess", 7, 10, 20.0),
        board("charuco", 7, 9, 20.0),
    ],
    ids=["asymmetric", "chess", "charuco"],
)
def test_a_target_that_tells_which_way_is_up_is_never_turned(design: BoardDesign) -> None:
    assert len(ways_to_turn(design)) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("tells", [True, False], ids=["told by the other camera", "told by none"])
def test_names_that_are_not_certain_are_those_that_the_other_camera_of_a_rig_predicts(tells: bool) -> None:
    design, rng = board("chess", 8, 10, 20.0), np.random.default_rng(5)
    xyz = np.column_stack([design.xy * [1, -1], np.zeros(len(design.xy))])
    matrix = np.array([[TRUE["fx"], 0, TRUE["cx"]], [0, TRUE["fy"], TRUE["cy"]], [0, 0, 1]])
    images, taken = list[Photograph](), dict[str, Taken]()
    for k in range(7):
        turn = cv2.Rodrigues(0.5 * np.array([np.cos(1.3 * k), np.sin(1.3 * k), 0.8 * k]))[0]
        place = np.array([0.0, 0.0, 330.0]) - turn @ xyz.mean(axis=0)
        for camera, shift in (("left", 0.0), ("right", -30.0)):
            xy = cv2.projectPoints(xyz, turn, place + np.array([shift, 0, 0]), matrix, np.zeros(4))[0][:, 0]
            points = ImagePoints.with_sigma(design.ids, xy + rng.normal(0, SIGMA, xy.shape), SIGMA)
            name = f"{camera}{k}"
            if k == 6 and camera == "right":
                # The last two rows are hidden, and the others named as if they were the last ones.
                seen, count = design.nodes[:, 1] < 7, int((design.nodes[:, 1] < 2).sum())
                part = points.select(np.asarray(seen))
                shifted = ImagePoints(design.ids[count:], part.xy, part.cov)
                images.append(MeasuredPhotograph(name, shifted, certain=False))
            elif tells or k < 6:
                images.append((name, points))
            taken[name] = Taken(camera, str(k))
    model = CameraOptions("opencv", ("fx", "fy", "cx", "cy", "k1", "k2"))
    done = calibrate_camera(images, design, lambda frame: Failure("never"), SIZE, model, taken=taken)
    assert isinstance(done, Calibrated)
    assert 0.9 < done.sigma0 < 1.1
    if tells:
        assert done.measured["right6"].names == tuple(design.ids[: len(done.measured["right6"].names)])
    else:
        assert "right6" not in done.measured
        assert done.declined["right6"].startswith("which part of the target it shows is not certain")
