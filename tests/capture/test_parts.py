"""Poses from tables, goals from text, and checks of focus, vibration and drift."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.special
from hypothesis import given, settings
from hypothesis import strategies as st

from reseau.capture import Goal
from reseau.capture.checks import Limits, edge_sigma, exposure_fault, readiness, shift_between
from reseau.capture.steps import read_steps
from reseau.core.data import Frame
from reseau.core.errors import FormatError, UsageError


def scene(shift: tuple[float, float] = (0.0, 0.0), sigma: float = 1.0, noise: float = 0.5, seed: int = 0,
          level: float = 1.0) -> Frame:  # fmt: skip
    """Bright disks with Gaussian edges, moved by a shift."""
    y, x = np.mgrid[:120, :160].astype(float)
    light = np.full(x.shape, 40.0)
    for cx, cy in ((40, 30), (110, 40), (60, 90), (125, 95)):
        r = np.hypot(x - cx - shift[0], y - cy - shift[1])
        light += 120 * scipy.special.ndtr((12 - r) / sigma)
    rng = np.random.default_rng(seed)
    return Frame(
        np.clip(level * light + rng.normal(0, noise, x.shape), 0, 255).round().astype(np.uint8), 255.0
    )


@pytest.mark.parametrize("sigma", [0.8, 1.5, 3.0])
def test_the_width_of_edges_is_measured(sigma: float) -> None:
    # Sampled at points: the scene has no pixels to integrate over. Curvature and noise leave a tenth.
    assert edge_sigma(scene(sigma=sigma)) == pytest.approx(sigma, abs=0.12 * sigma)


@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.0, 4.0])
def test_the_width_includes_the_pixel_and_does_not_depend_on_noise(sigma: float, noise: float) -> None:
    """The peak that is held while the focus is turned must not be one of noise."""
    inside = (np.arange(8) + 0.5) / 8 - 0.5
    x = np.arange(200.0)[:, None] + inside
    edges = (np.abs((x[None] + 0.1 * np.arange(120)[:, None, None]) % 80 - 40) - 20) / max(sigma, 1e-9)
    light = 60 + 120 * scipy.special.ndtr(edges).mean(axis=2)
    for seed in range(5):
        picture = np.random.default_rng(seed).normal(light, noise or 1e-9).round().astype(np.uint8)
        # A pixel's own 0.29 px is the least. Of narrower edges the slope lies within a pixel.
        expected = pytest.approx(np.hypot(sigma, 0.29), abs=0.2 if sigma < 0.5 else 0.1 * sigma)
        assert edge_sigma(Frame(picture, 255.0)) == expected


def test_a_frame_without_edges_has_no_focus_value() -> None:
    flat = np.random.default_rng(0).normal(100, 3, (60, 60)).round().astype(np.uint8)
    assert edge_sigma(Frame(flat, 255.0)) == float("inf")


@given(dx=st.floats(-0.4, 0.4), dy=st.floats(-0.4, 0.4), seed=st.integers(0, 5))
@settings(deadline=None)
def test_a_shift_is_found_within_its_sigma(dx: float, dy: float, seed: int) -> None:
    found, sigma = shift_between(scene(seed=seed), scene((dx, dy), seed=seed + 100))
    assert np.all(np.abs(found - [dx, dy]) < 5 * sigma + 0.004)  # the linearisation leaves thousandths
    assert np.all(sigma < 0.01)


def test_a_scene_without_edges_gives_a_fault_without_nan() -> None:
    """JSON knows no infinity; PostgreSQL refuses it."""
    flat = [Frame(np.full((60, 60), 90, np.uint8), 255.0)] * 2
    found = readiness(flat)
    assert found.faults == ("no edges found: focus, or point the camera at a target",)
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["edge_px"] is None


def test_a_bench_without_faults_is_ready() -> None:
    found = readiness([scene(seed=k) for k in range(4)])
    assert found
    assert found.vibration_px < 3 * found.vibration_sigma_px


@pytest.mark.parametrize(
    ("frames", "fault"),
    [
        ([scene((0.3 * (k % 2), 0), seed=k) for k in range(4)], "find its source"),
        ([scene((0.06 * k, 0), seed=k) for k in range(5)], "drift of 0.24 px: let the camera warm up"),
        ([scene(level=1 - 0.01 * k, seed=k) for k in range(5)], "brightness drift of -4 %"),
        ([scene(sigma=4, seed=k) for k in range(3)], "focus"),
        ([scene(level=3, seed=k) for k in range(3)], "expose less"),
        ([scene(level=0.1, seed=k) for k in range(3)], "expose more"),
    ],
)
def test_faults_before_an_acquisition_are_reported(frames: list[Frame], fault: str) -> None:
    assert fault in "; ".join(readiness(frames).faults)


def test_checks_need_two_frames_of_one_scene() -> None:
    with pytest.raises(UsageError, match="two frames"):
        readiness([scene()])
    with pytest.raises(UsageError, match="differs in size"):
        readiness([scene(), Frame(np.zeros((9, 9), np.uint8), 255.0)])


def test_limits_can_be_chosen() -> None:
    assert exposure_fault(scene(level=0.3)) == ""
    assert "expose more" in exposure_fault(scene(level=0.3), Limits(darkest=0.5))


def test_poses_of_a_table_are_read(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("name,tilt,roll\nfirst, 0,0\n,10.5,-90\n\n")
    first, second = read_steps(path)
    assert (first.name, dict(first.position)) == ("first", {"tilt": 0.0, "roll": 0.0})
    assert (second.name, dict(second.position)) == ("tilt 10.5 roll -90", {"tilt": 10.5, "roll": -90.0})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "has no poses"),
        ("tilt\n", "has no poses"),
        ("tilt\nx\n", "line 2 has a value that is not a number"),
        ("tilt\nnan\n", "line 2 has a value that is not a number"),
        ("tilt,roll\n1\n", "line 2 has 1 cells, not 2"),
        ("tilt\n1\n1\n", "line 3: duplicate pose 'tilt 1'"),
    ],
)
def test_an_invalid_table_of_poses_is_refused_with_its_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=says):
        read_steps(path)


def test_goals_are_read_in_their_units() -> None:
    assert Goal.parse("sigma_c < 0.5 um").limit == pytest.approx(5e-4, abs=1e-12)
    assert Goal.parse("sigma_fx<=0.02 px") == Goal("fx", 0.02, "px")
    assert str(Goal.parse("sigma_K1 < 1e-7")) == "sigma_K1 < 1e-07"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "c < 1",
        "sigma_c > 1 um",
        "sigma_c < um",
        "sigma_c < 1 parsec",
        "sigma_c < 0 um",
        "sigma_c < 1.2.3 um",
        "sigma_c < .",
        "sigma_c < 1e999 um",
    ],
)
def test_invalid_goals_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"write it like 'sigma_c < 0\.5 um'"):
        Goal.parse(text)
