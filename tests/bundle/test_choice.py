"""The choice of a camera model, with boards drawn by OpenCV's cameras: sufficient and not excessive."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle import Camera, Candidate, Network, Options, choose_model
from reseau.bundle.modelling import choice
from reseau.bundle.modelling.candidates import camera_candidates
from reseau.bundle.modelling.choice import ModelChoice
from reseau.core.errors import UsageError
from reseau.io.network import Network1
from reseau.optics.cameras.registry import camera_model
from reseau.optics.poses import rotation_matrix

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
lenses = importlib.import_module("worlds.lenses")

MATRIX = np.array([[1200.0, 0, 645.0], [0, 1203.0, 475.0], [0, 0, 1]])
FRAME = ("fx", "fy", "cx", "cy")
LADDER = [
    Candidate("opencv", (*FRAME, *more.split()))
    for more in ("", "k1", "k1 k2", "k1 k2 p1 p2", "k1 k2 p1 p2 k3", "k1 k2 p1 p2 k3 k4 k5 k6")
]
WIDE = [
    Candidate("fisheye", (*FRAME, "k1", "k2")),
    Candidate("fisheye", (*FRAME, "k1", "k2", "k3", "k4")),
    Candidate("division", (*FRAME, "lambda")),
]


def network_of(lens: lenses.Lens, seed: int = 4, gross: int = 0, noise: float = 0.2) -> Network:
    """Fifteen views of a board that is held, with a rough focal length."""
    flat, true = lenses.board(8, 6, 1.0)
    seen = lenses.views(lens, flat, true, 15, noise, seed)
    rng = np.random.default_rng(seed)
    for _ in range(gross):
        view = seen[rng.integers(len(seen))][1]
        view[rng.integers(len(view))] += rng.choice([-1, 1], 2) * rng.uniform(5, 30, 2)
    f = 1.05 * float(lens.matrix[0, 0])
    start = {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}
    free = [*FRAME, "k1", "k2", "p1", "p2"]
    document = lenses.document(lens, flat, seen, start, free, noise, "opencv")
    return Network.from_document(Network1.from_content(json.loads(json.dumps(document)), where="test"))


def lens_of(*k: float) -> lenses.Lens:
    return lenses.Lens(1280, 960, MATRIX, np.array([*k, *np.zeros(8 - len(k))]))


def chosen(lens: lenses.Lens, more: list[Candidate], **arguments: int) -> ModelChoice:
    found = choose_model(network_of(lens, **arguments), [*LADDER, *more])
    assert isinstance(found, ModelChoice)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k", "label"),
    [
        ((), "opencv: no distortion"),
        ((-0.1,), "opencv: k1"),
        ((-0.2, 0.1, 1e-3, -5e-4), "opencv: k1 k2 p1 p2"),
    ],
)
def test_the_model_of_the_lens_is_chosen(k: tuple[float, ...], label: str) -> None:
    found = chosen(lens_of(*k), [])
    assert found.chosen.candidate.label == label
    by_label = {each.candidate.label: each for each in found.compared}
    richer = by_label["opencv: k1 k2 p1 p2 k3"]
    assert richer.cost < found.chosen.cost
    assert richer.length > 2
    for each in found.alternatives:
        if each.reason.startswith("not adjusted"):
            assert not k
        elif each.candidate.within(found.chosen.candidate):
            assert each.p < 0.01
            assert each.reason.startswith("too simple")
        elif found.chosen.candidate.within(each.candidate):
            assert each.reason.startswith(("too many", "the images do not determine"))


@pytest.mark.slow
def test_what_the_wrong_model_costs_at_the_corners_is_what_it_costs() -> None:
    """The reported difference of the model without k2, beside that from the lens itself."""
    k = (-0.2, 0.1, 0.0, 0.0)
    found = chosen(lens_of(*k), [])
    simple = next(each for each in found.compared if each.candidate.label == "opencv: k1")
    assert found.chosen.candidate.label == "opencv: k1 k2"
    assert simple.corner_px > 5 * simple.corner_sigma_px
    assert simple.share > 0.2


@pytest.mark.slow
def test_a_wide_lens_gets_a_projection_of_wide_lenses() -> None:
    found = chosen(lenses.fisheye(70), WIDE)
    assert found.chosen.candidate.label == "fisheye: k1 k2"
    standard = next(each for each in found.compared if each.candidate.label == "opencv: k1 k2 p1 p2")
    assert standard.length > 1000


@pytest.mark.slow
def test_a_tilted_sensor_is_a_step_of_the_ladder_and_competes_with_a_thin_prism() -> None:
    tilt = (-0.11, 0.1, 0.0025, -0.0018, -0.02, *np.zeros(7), np.radians(7.0), np.radians(-3.0))
    found = choose_model(network_of(lenses.Lens(1280, 960, MATRIX, np.array(tilt))))
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.label == "opencv_full: k1 k2 p1 p2 k3 tau_x tau_y"
    assert found.camera.values[-2:] == pytest.approx(tilt[-2:], abs=0.02)
    prism = next(each for each in found.compared if each.candidate.label.endswith("k3 s1 s2 s3 s4"))
    assert prism.length > 100


def test_images_that_differ_do_not_make_a_model_richer() -> None:
    """Every image of a phone that focuses anew has a principal distance of its own."""
    network = network_of(lens_of(-0.1), noise=0.05)
    factor = np.random.default_rng(5).normal(1, 2e-2, len(network.images))[network.image_of]
    centre = MATRIX[:2, 2]
    found = choose_model(replace(network, xy=centre + factor[:, None] * (network.xy - centre)), LADDER)
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.label == "opencv: k1"
    assert found.chosen.sigma0 > 1.5


def test_two_images_are_too_few_to_choose() -> None:
    network = network_of(lens_of(-0.1))
    found = choose_model(network.select(network.image_of < 2), LADDER)
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.label.startswith("opencv: k1 k2 p1 p2")
    assert "too few" in found.chosen.reason


def test_a_large_network_is_represented_by_some_of_its_images(monkeypatch: pytest.MonkeyPatch) -> None:
    network = network_of(lens_of(-0.1))
    monkeypatch.setattr(choice, "_IMAGES", 8)
    monkeypatch.setattr(choice, "_POINTS", 30)
    found = choose_model(network, LADDER[:3])
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.label == "opencv: k1"


@pytest.mark.slow
def test_gross_errors_do_not_change_the_choice() -> None:
    lens = lens_of(-0.2, 0.1, 1e-3, -5e-4)
    found = choose_model(network_of(lens, gross=12), LADDER, Options(outliers="reject"))
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.label == "opencv: k1 k2 p1 p2"
    assert found.chosen.sigma0 == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_the_comparison_is_written_as_json() -> None:
    found = chosen(lens_of(-0.1), [])
    entries = json.loads(json.dumps(found.entries()))
    assert [entry["reason"].startswith("chosen") for entry in entries].count(True) == 1
    assert entries[0]["length"] == 0
    assert "reseau" not in repr(found)


def test_candidates_are_of_the_model_that_the_pixel_size_allows() -> None:
    assert not {"brown", "brown_higher"} & {each.model for each in camera_candidates(pitch_known=False)}
    pitch = camera_candidates(pitch_known=True)
    assert pitch[0].model == "brown"
    assert all(each.coefficients > 6 for each in pitch if each.model in ("opencv", "opencv_full"))
    with pytest.raises(UsageError, match="there are none"):
        choose_model(network_of(lens_of()), [])


def waved(network: Network, length_px: float = 560.0) -> Network:
    """Image points moved by waves of 1 px over the image, as no polynomial of low degree does."""
    waves = np.sin(2 * np.pi * network.xy[:, ::-1] / length_px)
    return replace(network, xy=network.xy + waves)


def in_millimetres(network: Network) -> Network:
    """The same with Brown's model and pixels of 5 µm."""
    old, model = network.cameras[0], camera_model("brown")
    values = np.zeros(len(model.names))
    values[0] = 0.005 * old.values[0]
    camera = Camera("A", old.width, old.height, (0.005, 0.005), "brown", values, model.usual)
    return replace(network, cameras=(camera,))


SPLINE = "splined_stereographic_order=3_Nx=10_Ny=8_fov_x_deg=60"


@pytest.mark.slow
def test_a_spline_surface_is_chosen_where_no_polynomial_describes_the_lens() -> None:
    spline = Candidate(SPLINE, camera_model(SPLINE).usual)
    plain = network_of(lens_of(-0.1))
    found = choose_model(waved(plain), [LADDER[1], LADDER[4], spline])
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate == spline
    assert found.chosen.sigma0 < 0.5 * found.alternatives[0].sigma0
    assert set(found.camera.sigma) == set(spline.free)
    found = choose_model(plain, [LADDER[1], spline])
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.label == "opencv: k1"


@pytest.mark.slow
def test_series_are_compared_and_predict_images() -> None:
    frame = ("c", "x0", "y0")
    series = Candidate("brown", (*frame, "K1"), additional="fourier1")
    plain = Candidate("brown", (*frame, "K1"))
    assert plain.within(series)
    assert not series.within(plain)
    found = choose_model(in_millimetres(waved(network_of(lens_of(-0.1)), 1280.0)), [plain, series])
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.label == "brown: K1 fourier1"
    assert found.alternatives[0].p < 1e-6
    assert found.chosen.predicted < 0.8 * found.alternatives[0].predicted
    assert found.camera.additional is not None


@pytest.mark.slow
def test_what_the_usual_models_give_no_reason_for_is_left_out_and_said() -> None:
    found = choose_model(in_millimetres(network_of(lens_of(-0.1))))
    assert isinstance(found, ModelChoice)
    # The lens has different scales along x and y.
    assert found.chosen.candidate.label == "brown: K1 B1"
    reasons = {each.candidate.model: each.reason for each in found.compared if np.isnan(each.sigma0)}
    assert "perspective is significant" in reasons["telecentric"]
    assert any("no residual pattern" in reason for reason in reasons.values())


@pytest.mark.slow
def test_what_the_usual_models_leave_is_taken_up_by_a_surface_or_a_series() -> None:
    found = choose_model(in_millimetres(waved(network_of(lens_of(-0.1)))))
    assert isinstance(found, ModelChoice)
    assert "spline" in found.chosen.candidate.model or found.chosen.candidate.additional is not None


@pytest.mark.slow
def test_a_lens_without_perspective_is_telecentric() -> None:
    rng = np.random.default_rng(3)
    network = in_millimetres(network_of(lens_of()))
    turn = rng.uniform(-0.6, 0.6, (len(network.images), 3))
    shift = np.array([640, 480]) + rng.uniform(-40, 40, (len(network.images), 2))
    xy = np.empty_like(network.xy)
    for k, (i, j) in enumerate(zip(network.image_of, network.point_of, strict=True)):
        xy[k] = 100 * (rotation_matrix(turn[i][None])[0] @ network.xyz[j])[:2] * [1, -1] + shift[i]
    found = choose_model(replace(network, xy=xy + rng.normal(0, 0.2, xy.shape)))
    assert isinstance(found, ModelChoice)
    assert found.chosen.candidate.model == "telecentric"
    assert found.camera.values[0] == pytest.approx(0.5, rel=1e-3)
