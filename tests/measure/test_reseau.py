"""Marks of a reseau measured in a frame: accuracy, correct sigmas, and refused input."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.designs import regular_reseau
from reseau.io import DesignPoint, Mark, ReseauMeasurement
from reseau.measure import measure_reseau
from reseau.measure.reseau.marks import ReseauOptions
from reseau.measure.reseau.measure import ReseauResult
from reseau.optics.formation import Outline, PixelResponse, coverage_derivatives, draw, mark_outline
from reseau.optics.sensor import sigma_of_snr

from ..montecarlo import slowly
from .formed import MARKS, Scene, bounds, form, measure_many, measured

SMALL = Scene(columns=8, rows=6, width=460, height=350)


def small(**changes):
    return replace(SMALL, **changes)


def rng(seed=0):
    return np.random.default_rng(seed)


def other(formed, pixels, **changes):
    return replace(formed, frame=Frame(pixels, 255.0, "other.png"), **changes)


CASES = {
    "40 dB": {},
    "30 dB": {"sigma": sigma_of_snr(30)},
    "50 dB": {"sigma": sigma_of_snr(50)},
    "bright": {"polarity": "bright"},
    "fill factor": {"fill": 0.8, "psf_px": 0.6},
    "shot noise, gradient, 8 bits": {"gain": 12.0, "sigma": 1.0, "gradient": (0.2, -0.1), "quantise": True},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "case"),
    [
        # Every shape, and every case, once; all pairs as slow ones.
        pytest.param(shape, case, marks=() if (k - j) % len(CASES) == 0 else pytest.mark.slow)
        for k, shape in enumerate(sorted(MARKS))
        for j, case in enumerate(sorted(CASES))
    ],
)
def test_errors_reach_the_cramer_rao_bound_and_agree_with_their_sigmas(shape, case):
    s = measure_many(small(mark=MARKS[shape], **CASES[case]), 1 if shape == "line-grid" else 2, seed=2)
    count = s.error.size
    assert len(s.error) == s.expected
    slack = 2.5 / np.sqrt(2 * count)
    # Both axes of 48 or 96 marks together: a standard error of the rms of 7 or 5 per cent.
    assert np.sqrt((s.ratio**2).mean()) < 1.15 + slack
    assert np.abs(s.bias).max() < 0.002 + 3 * s.bias_sigma.max()
    assert np.sqrt((s.normalised**2).mean()) == pytest.approx(1.0, abs=0.1 + slack)


@pytest.mark.slow
@pytest.mark.parametrize("shape", sorted(MARKS))
def test_the_bias_is_below_two_thousandths_of_a_pixel_at_every_subpixel_position(shape):
    s = measure_many(small(mark=MARKS[shape], sigma=sigma_of_snr(46)), 40, seed=3)
    assert np.abs(s.bias).max() < 0.002 - 2 * s.bias_sigma.max()
    assert s.ratio.max() < 1.15
    worst, sigma = s.bias_by_phase()
    assert worst < 0.002 + 3.5 * sigma


@pytest.mark.slow
def test_with_known_row_jitter_sigmas_are_not_too_small():
    s = measure_many(small(mark=MARKS["square"], jitter_px=0.1), 10, seed=4)
    # Eight marks of a row share its jitter: 60 groups.
    assert s.normalised == pytest.approx([1.0, 1.0], abs=0.25)
    assert s.ratio.max() < 1.15 + 0.25


@pytest.mark.slow
@pytest.mark.parametrize("quality", [60, 10])
def test_sigmas_contain_the_errors_of_compression(quality):
    scene = Scene(mark=MARKS["cross"], columns=11, rows=9, width=700, height=600)
    formed = form(scene, np.random.default_rng(0))
    pixels = np.clip(np.rint(formed.frame.pixels * (255 / formed.frame.full_scale)), 0, 255).astype(np.uint8)
    _, coded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    found = measure_reseau(Frame(cv2.imdecode(coded, 0), 255.0, "coded.jpg"), scene.design())
    assert isinstance(found, ReseauResult)
    assert found.ok.all()
    error = (found.xy - formed.xy) / np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    # With independent errors 1.6 and 3.3.
    assert 0.7 < np.sqrt((error**2).mean()) < 1.25


def test_the_bound_agrees_with_an_independent_estimator():
    """The bound of a disk from its edges, against the sum of squared slopes of a finely sampled image."""
    scene = small(sigma=2.0)
    formed = form(scene, rng())
    outline = mark_outline("disk", 8.0, None, 0.2)
    ahead, behind = (
        draw(Outline((outline.xy + formed.xy[0] + [d, 0])[None], outline.dxy[None]), (350, 460), 0.8)
        for d in (5e-4, -5e-4)
    )
    slope = 170.0 * 0.7 * (ahead - behind) / 1e-3
    known_all_else = 2.0 / np.sqrt((slope**2).sum())
    bound = np.sqrt(bounds(scene, formed)[0, 0, 0])
    assert known_all_else <= bound < 1.2 * known_all_else


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["disk", "cross", *slowly("line-grid")])
def test_an_absent_mark_is_never_measured_and_the_reason_is_given(shape):
    for seed, sigma in ((0, 2.5), (2, 8.0)):
        gone = frozenset(rng(seed).choice(48, 14, replace=False).tolist())
        scene = small(mark=MARKS[shape], sigma=sigma, missing=gone)
        formed = form(scene, rng(seed))
        result = measured(scene, formed)
        absent = np.isin(np.arange(48), list(gone))
        assert not result.ok[absent].any()
        assert result.ok[~absent].all()
        assert all(result.why[i] for i in gone)
        assert np.isnan(result.xy[absent]).all()
        assert np.isnan(result.cov[absent]).all()


@pytest.mark.slow
def test_of_thousands_of_absent_marks_none_is_measured():
    false = 0
    for seed in range(70):
        gone = frozenset(rng(seed).choice(48, 16, replace=False).tolist())
        scene = small(sigma=[2.5, 5.0, 8.0][seed % 3], missing=gone)
        false += int(measured(scene, form(scene, rng(seed))).ok[list(gone)].sum())
    # None of 1120: fewer than 0.3 per cent with 95 per cent confidence.
    assert false == 0


def test_without_nominal_positions_the_same_marks_have_the_same_positions():
    gone = frozenset({9})  # no symmetry is left
    scene = small(missing=gone)
    formed = form(scene, rng(5))
    points = tuple(p for i, p in enumerate(formed.design.points) if i not in gone)
    design = formed.design.model_copy(update={"points": points, "origin": None, "axis": None})
    with_them, without = (
        measure_reseau(formed.frame, design, ReseauOptions(nominal=n)) for n in (True, False)
    )
    assert with_them.found == without.found == 47
    assert without.xy == pytest.approx(with_them.xy, abs=2e-3)


@pytest.mark.parametrize("shift", [(30.0, -22.0), (-25.0, 35.0)])
def test_nominal_positions_may_be_wrong_by_tens_of_pixels(shift):
    formed = form(SMALL, rng(6))
    points = tuple(
        p.model_copy(update={"nominal_px": (float(x), float(y))})
        for p, (x, y) in zip(formed.design.points, formed.design.nominal_px + shift, strict=True)
    )
    result = measure_reseau(formed.frame, formed.design.model_copy(update={"points": points}))
    assert result.found == 48
    assert np.abs(result.xy - formed.xy).max() < 0.1


@pytest.mark.parametrize(("columns", "rows"), [(3, 2), (3, 3), (4, 3)])
def test_a_reseau_of_few_marks_is_measured(columns, rows):
    scene = small(columns=columns, rows=rows, width=52 * columns + 60, height=52 * rows + 60)
    formed = form(scene, rng(7))
    result = measured(scene, formed)
    assert result.ok.all()
    assert np.abs(result.xy - formed.xy).max() < 0.08
    assert result.rms().shape == (2,)


@pytest.mark.slow
def test_a_design_of_unknown_size_and_unknown_coordinates_of_some_marks():
    formed = form(SMALL, rng(8))
    points = tuple(
        DesignPoint(id=p.id, x=None, y=None) if i in (0, 20) else p
        for i, p in enumerate(formed.design.points)
    )
    mark = formed.design.mark.model_copy(update={"size": None})
    design = formed.design.model_copy(update={"points": points, "mark": mark})
    result = measure_reseau(formed.frame, design, ReseauOptions(nominal=False))
    assert result.found == 46
    assert {result.codes[0], result.codes[20]} == {Code.NO_COORDINATES}
    error = (result.xy - formed.xy)[result.ok]
    assert np.abs(error).max() < 0.08


def test_a_design_without_coordinates_uses_its_nominal_positions():
    formed = form(SMALL, rng(8))
    points = tuple(p.model_copy(update={"x": None, "y": None}) for p in formed.design.points)
    mark = formed.design.mark.model_copy(update={"size": 8.0})
    result = measure_reseau(formed.frame, formed.design.model_copy(update={"points": points, "mark": mark}))
    assert result.found == 48
    assert np.abs(result.xy - formed.xy).max() < 0.08


def test_a_scene_behind_the_marks_hides_few_of_them_and_adds_no_false_ones():
    y, x = np.mgrid[:350, :460]
    light = 1 - 0.55 / (1 + np.exp(-(np.hypot(x - 250, y - 160) - 90) / 2.0))
    light *= 1 + 0.15 * np.sin(x / 17.0) * np.cos(y / 23.0)
    scene = small(light=light, level=210.0)
    formed = form(scene, rng(9))
    result = measured(scene, formed)
    error = np.hypot(*(result.xy - formed.xy)[result.ok].T)
    assert result.found >= 46
    assert np.median(error) < 0.03
    assert error.max() < 0.35


def test_lost_lines_and_bit_errors_affect_only_the_marks_they_cover():
    formed = form(SMALL, rng(10))
    pixels = formed.frame.pixels.copy()
    y = formed.xy[:, 1]
    row = round(formed.xy[20, 1])
    pixels[row - 12 : row + 12] = 0.0
    at = rng(1).choice(pixels.size, 400, replace=False)
    pixels.reshape(-1)[at] = np.where(pixels.reshape(-1)[at] > 128, pixels.reshape(-1)[at] - 128, 255.0)
    result = measured(SMALL, other(formed, pixels))
    covered = np.abs(y - row) < 6
    assert not result.ok[covered].any()
    assert {result.why[i] for i in np.flatnonzero(covered)} == {
        "on lost lines or beyond the edge of the frame"
    }
    clear = np.abs(y - row) > 20
    assert result.ok[clear].mean() > 0.95
    assert np.abs(result.xy - formed.xy)[result.ok & clear].max() < 0.1


def test_marks_outside_the_frame_are_reported_as_such():
    formed = form(SMALL, rng(11))
    result = measured(SMALL, other(formed, formed.frame.pixels[:, :250]))
    beyond = formed.xy[:, 0] > 256
    assert result.ok[formed.xy[:, 0] < 240].all()
    assert {result.why[i] for i in np.flatnonzero(beyond)} == {"outside the frame"}


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.zeros((350, 460), np.uint8), "is all black"),
        (np.full((350, 460), 255, np.uint8), "is all saturated"),
    ],
)
def test_a_frame_without_an_image_is_a_failure_in_one_line(pixels, message):
    found = measure_reseau(Frame(pixels, 255.0, "dark.png"), SMALL.design())
    assert not found
    assert str(found) == f"dark.png: {message}; check exposure and shutter"


def clutter(kind: str, seed: int) -> np.ndarray:
    random = rng(seed)
    if kind == "noise":
        return random.normal(150, 3, (350, 460))
    one = mark_outline("disk", 8.0, None, 0.4)
    at = random.uniform([8, 8], [452, 342], (160, 2))
    share = draw(Outline(one.xy + at[:, None], np.tile(one.dxy, (160, 1, 1))), (350, 460), 0.8)
    return np.clip(170 * (1 - 0.7 * np.clip(share, 0, 1)) + random.normal(0, 2.5, share.shape), 0, 255)


@pytest.mark.slow
@pytest.mark.parametrize("nominal", [True, False])
@pytest.mark.parametrize("kind", ["noise", "specks"])
def test_a_frame_without_the_reseau_is_a_failure_with_the_reason(kind, nominal):
    for seed in range(2 if nominal else 1):
        frame = Frame(clutter(kind, seed), 255.0, "clutter.png")
        result = measure_reseau(frame, form(SMALL, rng(seed)).design, ReseauOptions(nominal=nominal))
        assert not result
        assert isinstance(result, Failure)
        assert result.code is Code.NOT_FOUND
        assert str(result).startswith("clutter.png: design 'reseau' was not found")
        assert "\n" not in result.reason


@pytest.mark.slow
def test_the_wrong_design_is_a_failure():
    formed = form(SMALL, rng(12))
    wrong = replace(SMALL, columns=5, rows=5).design()
    moved = tuple(p.model_copy(update={"x": p.x * (1 + 0.1 * p.y)}) for p in wrong.points)
    result = measure_reseau(formed.frame, wrong.model_copy(update={"points": moved, "name": "wrong"}))
    assert not result
    assert "'wrong'" in result.reason


def test_a_design_with_too_few_coordinates_is_refused():
    design = SMALL.design()
    points = tuple(p if i < 3 else DesignPoint(id=p.id, x=None, y=None) for i, p in enumerate(design.points))
    with pytest.raises(UsageError, match="fewer than four points with coordinates"):
        measure_reseau(form(SMALL, rng()).frame, design.model_copy(update={"points": points}))


def test_a_design_on_one_line_is_refused():
    design = SMALL.design()
    points = tuple(p for p in design.points if p.y == design.points[0].y)
    with pytest.raises(UsageError, match="all its points on one line"):
        measure_reseau(form(SMALL, rng()).frame, design.model_copy(update={"points": points}))


def test_the_document_contains_the_measurement_and_is_read_back_unchanged():
    scene = small(missing=frozenset({5}))
    result = measured(scene, form(scene, rng(13)))
    document = ReseauMeasurement.parse(result.measurement().to_json(), where="test")
    assert (document.found, document.expected) == (47, 48)
    assert document.points[5].ok is False
    assert document.points[5].why == result.why[5] != ""
    assert document.points[7].x == pytest.approx(result.xy[7, 0])
    assert document.points[7].sx == pytest.approx(np.sqrt(result.cov[7, 0, 0]))
    assert len(result.points) == 47


def test_the_same_frame_gives_the_same_bytes():
    formed = form(SMALL, rng(14))
    first, second = (measured(SMALL, formed).measurement().to_json() for _ in range(2))
    assert first == second


@pytest.mark.slow
@pytest.mark.parametrize("arm_px", [7.5, 8.5, 10.0])
def test_crossings_of_short_arms_reach_the_bound_of_what_lies_near_them(arm_px):
    """Two bars of 2.2 px; the bound of their crossing within 5 px, whatever the ends of the arms are."""
    generator, angle, sigma, psf = rng(5), np.deg2rad(12.0), 1.0, 0.9
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    design = regular_reseau(7, 6, 28.0, Mark(shape="line-grid", line_width=2.2))
    centres = (design.xy * [1, -1]) @ turn.T + [140, 125] + generator.uniform(-0.5, 0.5, design.xy.shape)
    bars = mark_outline("cross", 2 * arm_px, 2.2, 0.5).affine(turn)
    outlines = Outline(centres[:, None] + bars.xy, np.broadcast_to(bars.dxy, (len(centres), *bars.dxy.shape)))
    grey = 180 * (1 - 0.6 * draw(outlines, (250, 280), psf))
    found = measure_reseau(Frame(grey + generator.normal(0, sigma, grey.shape), 255.0), design)
    assert found.ok.all()

    window = np.arange(-7.0, 8.0)[None]
    _, slopes = coverage_derivatives(
        Outline(bars.xy[None] + 0.0, bars.dxy[None]), window, window, np.full(1, psf), PixelResponse()
    )
    near = np.hypot(*np.meshgrid(window[0], window[0])) < 5
    cov = np.linalg.inv(np.einsum("ihw,jhw->ij", *(2 * [np.where(near, 180 * 0.6 * slopes[0, :2], 0)])))
    error = found.xy - centres
    assert np.sqrt((error**2).mean()) < 1.1 * sigma * np.sqrt(np.trace(cov) / 2)
    variance = np.diagonal(found.cov, axis1=1, axis2=2)
    assert np.sqrt((error**2 / variance).mean()) == pytest.approx(1, abs=0.25)


def test_weak_wires_are_known_to_be_continuous_though_blur_is_brighter_where_they_cross():
    """Thin wires of 17 grey values, blurred to half of that beside crossings, in noise of two."""
    scene = small(
        mark=Mark(shape="line-grid", line_width=0.18), polarity="bright", contrast=0.12, psf_px=1.8, sigma=2.0
    )
    s = measure_many(scene, 1, seed=3)
    assert len(s.error) == s.expected
    assert np.sqrt((s.ratio**2).mean()) < 1.05
    assert np.sqrt((s.normalised**2).mean()) == pytest.approx(1.0, abs=0.25)
