"""What is wrong in an adjusted network: the right explanation wins, and a sound network has none."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import pytest

from reseau.bundle import explain
from reseau.bundle.explanations.names import misnamed
from reseau.bundle.explanations.sentences import EACH
from reseau.core.data import Array, ImagePoints
from reseau.designs import coded_sheet
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CalibrationOptions, CameraOptions

DESIGN = coded_sheet(9, 7, 20.0)
SIZE, SIGMA = (800, 600), 0.03
LENS = np.array([-0.2, 0.05, 3e-4, -2e-4, 0.0])
OPENCV = CameraOptions("opencv")


def world(
    *,
    seed: int = 1,
    lens: Array = LENS,
    focus: float = 0.0,
    speed: float = 0.0,
    scale: float = 1.0,
    bent: float = 0.0,
    creased: float = 0.0,
    noise: float = 1.0,
    blunders: int = 0,
) -> dict[str, ImagePoints]:
    """Image coordinates by OpenCV's projection, of twelve photographs."""
    rng, found = np.random.default_rng(seed), {}
    at = DESIGN.xy - DESIGN.xy.mean(axis=0)
    xyz = np.column_stack([at * [scale, -1.0], bent * (1 - (at[:, 0] / at[:, 0].max()) ** 2)])
    for k in range(12):
        if creased:
            wave = rng.uniform(-1.0, 1.0, 2) * 4 * np.pi / np.ptp(at[:, 0])
            xyz[:, 2] = creased * np.sin(at @ wave + rng.uniform(0, 2 * np.pi))
        axis = np.deg2rad(rng.uniform(15, 40)) * np.array([np.cos(1.3 * k), np.sin(1.3 * k), 0])
        turn = cv2.Rodrigues(axis)[0] @ cv2.Rodrigues(np.array([0, 0, np.pi / 2 * k]))[0]
        place = np.array([rng.uniform(-30, 30), rng.uniform(-20, 20), 190.0 + 10 * (k % 3)])
        f = 700.0 + focus * rng.normal()
        matrix = np.array([[f, 0, 402.0], [0, f, 297.0], [0, 0, 1]])
        motion, xy = speed * rng.normal(size=6) * [1e-3, 1e-3, 1e-3, 0.2, 0.2, 0.2], np.zeros((len(at), 2))
        for _ in range(3 if speed else 1):
            time = xy[:, 1] / SIZE[1] - 0.5
            for j in range(len(at)) if speed else ():
                one = cv2.Rodrigues(cv2.Rodrigues(motion[:3] * time[j])[0] @ turn)[0]
                xy[j] = cv2.projectPoints(xyz[j : j + 1], one, place + motion[3:] * time[j], matrix, lens)[0][
                    0, 0
                ]
            if not speed:
                xy = cv2.projectPoints(xyz, cv2.Rodrigues(turn)[0], place, matrix, lens)[0][:, 0]
        xy = xy + noise * SIGMA * rng.normal(size=xy.shape)
        if k < blunders:
            xy[rng.integers(len(xy))] += [1.0, -0.8]
        inside = ((xy > 3) & (xy < np.array(SIZE) - 4)).all(axis=1)
        names = tuple(name for name, good in zip(DESIGN.ids, inside, strict=True) if good)
        found[f"{k}"] = ImagePoints.with_sigma(names, xy[inside], SIGMA)
    return found


def calibrated(
    measured: Mapping[str, ImagePoints], target: str = "flat", model: CameraOptions | None = OPENCV
) -> Calibrated:
    # Gross errors are looked at, not left out.
    options = CalibrationOptions(target=target, reject=False)  # type: ignore[arg-type]
    return calibrate_camera(measured.items(), DESIGN, lambda _: None, SIZE, model, options).required()  # type: ignore[arg-type, return-value]


def test_a_target_that_is_held_wrongly_does_not_choose_the_model_of_the_lens() -> None:
    found = calibrated(world(scale=1.003), model=None)
    assert {"k1", "k2"} <= set(found.result.network.cameras[0].free)
    assert found.explanation.causes[0].code == "target-scale"


@pytest.mark.parametrize("target", [pytest.param("flat", marks=pytest.mark.slow), "free"])
def test_nothing_is_wrong_in_sound_networks(target: str) -> None:
    found = [calibrated(world(seed=seed), target).explanation for seed in range(2)]
    assert [each.causes for each in found] == [()] * 2
    assert all(each.sound for each in found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "changes"),
    [
        ("lens", {"lens": np.array([-0.2, 0.05, 3e-4, -2e-4, 0.02])}),
        pytest.param("refocus", {"focus": 3.0}, marks=pytest.mark.slow),
        ("rolling-shutter", {"speed": 3.0}),
        pytest.param("target-scale", {"scale": 1.002}, marks=pytest.mark.slow),
        pytest.param("target-shape", {"bent": 0.4}, marks=pytest.mark.slow),
        ("target-shape", {"creased": 0.5}),
        ("noise", {"noise": 1.5}),
        pytest.param("blunders", {"blunders": 4}, marks=pytest.mark.slow),
    ],
)
def test_the_cause_is_named_first(code: str, changes: dict[str, float]) -> None:
    found = calibrated(world(**changes)).explanation  # type: ignore[arg-type]
    first = found.causes[0]
    assert first.code == code
    assert first.probability > 0.5
    assert first.do
    assert first.form.startswith(EACH) == ("creased" in changes)
    assert found.sound == (code == "noise")


@pytest.mark.slow
def test_what_a_cause_explains_is_stated_in_pixels() -> None:
    found = calibrated(world(noise=1.0, focus=3.0)).explanation.causes[0]
    rms = np.sqrt(np.mean(calibrated(world(focus=3.0)).result.residuals ** 2))
    assert 0.5 * rms < found.amount_px < rms
    assert 0.3 < found.share < 1.0


@pytest.mark.slow
def test_errors_of_the_projection_contain_what_the_lens_could_have() -> None:
    sound = calibrated(world()).explanation.projection_variance(0, 9)
    wrong = calibrated(world(lens=np.array([-0.2, 0.05, 3e-4, -2e-4, 0.05]))).explanation.projection_variance(
        0, 9
    )
    assert np.linalg.eigvalsh(sound[0, 0]).min() >= 0
    assert np.trace(wrong[0, 0]) > 10 * np.trace(sound[0, 0]) > 0
    # In the middle, where the points are, it is less than in the corners.
    assert np.trace(wrong[3, 4]) < 0.1 * np.trace(wrong[0, 0])


def test_names_that_were_exchanged_are_left_out_and_named() -> None:
    measured = world()
    points = measured["4"]
    names = list(points.names)
    names[3], names[30] = names[30], names[3]
    measured["4"] = ImagePoints(tuple(names), points.xy, points.cov)
    done = calibrated(measured)
    first = done.explanation.causes[0]
    assert first.code == "names"
    assert " in 4" in first.where
    assert done.sigma0 == pytest.approx(1.0, abs=0.06)


def test_an_image_numbered_as_seen_from_behind_is_not_believed() -> None:
    measured = world()
    columns, points = 9, measured["7"]
    row = {name: k for k, name in enumerate(DESIGN.ids)}
    names = []
    for name in points.names:
        k = row[name]
        names.append(DESIGN.ids[k - k % columns + columns - 1 - k % columns])
    measured["7"] = ImagePoints(tuple(names), points.xy, points.cov)
    first = calibrated(measured).explanation.causes[0]
    assert first.code == "names"
    assert first.form == f"{len(names)}"


def test_without_known_points_no_name_is_doubted() -> None:
    result = calibrated(world()).result
    network = result.network
    from dataclasses import replace

    assert misnamed(replace(network, xyz=np.full_like(network.xyz, np.nan))) is None
    assert explain(result).causes == ()
