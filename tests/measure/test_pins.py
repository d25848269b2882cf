"""Pins: formed arcs with known truth, declined echoes with reasons, real B-mode frames compared with PLUS."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reseau.core.data import Array, Frame
from reseau.core.errors import UsageError
from reseau.core.failure import Code
from reseau.io import ReseauDesign
from reseau.io.images import read_image
from reseau.measure import find_pins, measure_pins
from reseau.measure.pins.detection import PinOptions
from reseau.measure.pins.wires import Wires, lay_wires
from reseau.optics import Arcs

from ..montecarlo import slowly

GROUND, NOISE = 8.0, 2.55
"""Noise of 40 dB below full scale."""


def arcs(
    count: int, along: float = 7.0, across: float = 1.7, curvature: float = 0.015, tilt: float = 0.0
) -> Arcs:
    return Arcs(*(np.full(count, v) for v in (along, across, curvature, tilt)))


def picture(
    xy: Array,
    shown: Arcs,
    shape: tuple[int, int],
    light: Array | float = 140.0,
    noise: float = NOISE,
    seed: int = 0,
) -> Array:
    """A frame of arcs whose light adds up; pixels integrate."""
    fine = (np.arange(3) - 1) / 3
    canvas = np.full(shape, GROUND)
    for k, brightness in enumerate(np.broadcast_to(light, len(xy))):
        reach = int(5 * shown.along[k] + 10)
        low = np.maximum(np.rint(xy[k]).astype(int) - reach, 0)
        high = np.minimum(np.rint(xy[k]).astype(int) + reach + 1, shape[::-1])
        if (low >= high).any():
            continue
        columns, rows = ((np.arange(a, b)[:, None] + fine).ravel() for a, b in zip(low, high, strict=True))
        image = shown.select(np.array([k])).image(xy[k : k + 1], columns[None], rows[None])[0]
        image = image.reshape(len(rows) // 3, 3, len(columns) // 3, 3).mean(axis=(1, 3))
        canvas[low[1] : high[1], low[0] : high[0]] += brightness * image
    return canvas + noise * np.random.default_rng(seed).standard_normal(shape)


def frame(pixels: Array) -> Frame:
    return Frame(pixels, 255.0, "formed")


def nearest(xy: Array, truth: Array) -> Array:
    """Row of the point nearest to each of the truth."""
    return np.hypot(*np.moveaxis(truth[:, None] - xy[None], -1, 0)).argmin(axis=1)


def bound(xy: Array, shown: Arcs, light: float) -> Array:
    """Cramér–Rao bound (k, 2) of the sigmas of positions, with all that is estimated beside them."""
    offset = np.arange(-35, 36.0)
    image, d = shown.derivatives(xy, np.rint(xy[:, :1]) + offset, np.rint(xy[:, 1:]) + offset)
    k, plane = len(xy), np.broadcast_to(offset, (len(offset), len(offset)))
    ground = np.stack([np.ones_like(plane), plane, plane.T]).reshape(1, 3, -1).repeat(k, axis=0)
    design = np.concatenate([light * d[:, :6].reshape(k, 6, -1), image.reshape(k, 1, -1), ground], axis=1)
    fisher = design @ np.swapaxes(design, 1, 2) / NOISE**2
    return np.sqrt(np.diagonal(np.linalg.inv(fisher), axis1=1, axis2=2)[:, :2])


@given(
    start=st.tuples(st.floats(3.0, 20.0), st.floats(0.8, 5.0), st.floats(-0.03, 0.03), st.floats(-1.5, 1.5)),
    at=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
)
def test_the_derivatives_of_images_are_correct(start: tuple[float, ...], at: tuple[float, float]):
    pixels = np.arange(-20, 21.0)[None]
    values = np.array([*at, start[1], np.log(start[0]), *start[2:]])

    def of(p: Array) -> Arcs:
        return Arcs(np.exp(p[3:4]), p[2:3], p[4:5], p[5:6])

    _, derivatives = of(values).derivatives(values[None, :2], pixels, pixels)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        ahead, behind = (
            of(values + side * step).image((values + side * step)[None, :2], pixels, pixels)
            for side in (1, -1)
        )
        difference = (ahead - behind)[0] / 2e-6
        assert np.abs(difference - derivatives[0, k]).max() < 1e-6 * max(1.0, np.abs(difference).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("along", "across", "curvature", "tilt"),
    [(7.0, 1.7, 0.015, 0.0), (10.0, 1.4, 0.02, 0.5), (5.0, 2.2, -0.01, -0.7)],
)
def test_positions_reach_the_cramer_rao_bound(along: float, across: float, curvature: float, tilt: float):
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(60 + 75 * np.arange(8), 55 + 60 * np.arange(7)), axis=-1).reshape(-1, 2)
    deviation, limits, own = [], [], []
    for seed in range(4):
        truth = grid + rng.uniform(-0.5, 0.5, grid.shape)
        shown = arcs(len(truth), along, across, curvature, tilt)
        found = find_pins(frame(picture(truth, shown, (480, 650), seed=seed)))
        assert found.ok.sum() == len(truth)
        rows = nearest(found.xy, truth)
        deviation.append(found.xy[rows] - truth)
        limits.append(bound(truth, shown, 140.0))
        own.append(np.sqrt(np.diagonal(found.cov[rows], axis1=1, axis2=2)))
    off, limit, sigma = (np.concatenate(parts) for parts in (deviation, limits, own))
    ratio = np.sqrt(((off / limit) ** 2).mean(axis=0))
    assert (ratio <= 1.15).all()
    assert (ratio >= 0.85).all()
    assert (np.abs(off.mean(axis=0)) < 4 * limit.mean(axis=0) / np.sqrt(len(off))).all()
    normalised = np.sqrt(((off / sigma) ** 2).mean(axis=0))
    assert (np.abs(normalised - 1) < 0.15).all()


def test_positions_are_unbiased_and_the_form_is_estimated():
    grid = np.stack(np.meshgrid(60 + 75 * np.arange(6), 55 + 60 * np.arange(5)), axis=-1).reshape(-1, 2)
    truth = grid + np.random.default_rng(1).uniform(-0.5, 0.5, grid.shape)
    found = find_pins(frame(picture(truth, arcs(len(truth), 8.0, 1.7, 0.015, 0.2), (360, 500), noise=0.02)))
    rows = nearest(found.xy, truth)
    assert np.abs(found.xy[rows] - truth).max() < 0.003
    assert np.allclose(found.curvature[rows], 0.015, atol=1e-3)
    assert np.allclose(found.tilt[rows], 0.2, atol=5e-3)
    assert np.allclose(found.length[rows], 32.0, rtol=0.02)


@pytest.mark.parametrize("apart", [22.0, 26.0, 30.0, 40.0])
def test_touching_neighbours_are_measured_within_their_sigmas_or_declined(apart: float):
    truth = np.array([[150.3, 120.2], [150.3 + apart, 121.1]])
    found = find_pins(frame(picture(truth, arcs(2), (240, 400))))
    rows = nearest(found.xy, truth)
    assert len(set(rows)) == 2
    if apart < 25:
        assert [found.codes[k] for k in rows] == [Code.UNCERTAIN] * 2
    else:
        sigma = np.sqrt(np.diagonal(found.cov[rows], axis1=1, axis2=2))
        assert found.ok[rows].all()
        assert (np.abs(found.xy[rows] - truth) < 3.5 * sigma).all()
        assert sigma.max() < 0.5


def test_faint_echoes_are_declined_and_the_others_measured_correctly():
    truth = np.stack([60.0 + 70 * np.arange(8), np.full(8, 80.25)], axis=1)
    light = 150 * np.array([1.0, 0.8, 0.6, 0.45, 0.35, 0.28, 0.17, 0.06])
    found = find_pins(frame(picture(truth, arcs(8), (160, 620), light)))
    rows = nearest(found.xy, truth)
    assert found.ok[rows[:6]].all()
    assert found.ok.sum() == 6
    assert np.abs(found.xy[rows[:6]] - truth[:6]).max() < 0.4
    assert found.codes[rows[6]] is Code.LOW_CONTRAST


@pytest.mark.parametrize("wire", [148, 151, 154])
@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_wire_across_an_echo_is_detected_and_excluded(wire: int, width: int):
    truth = np.array([[150.3, 100.2]])
    pixels = picture(truth, arcs(1, 9.0), (200, 300), noise=0.0)
    pixels[:, wire : wire + width] *= 0.1
    pixels += NOISE * np.random.default_rng(wire + width).standard_normal(pixels.shape)
    found = find_pins(frame(pixels))
    k = nearest(found.xy, truth)[0]
    assert found.ok[k]
    assert (np.abs(found.xy[k] - truth[0]) < 0.4).all()
    assert (np.abs(found.xy[k] - truth[0]) < 4.5 * found.points.sigma[0]).all()


def test_a_wire_at_a_known_position_causes_no_bias_even_at_the_end_of_an_echo():
    truth = np.array([[150.3, 100.2]])
    hidden = np.zeros((200, 300), dtype=bool)
    hidden[:, 159:163] = True
    pixels = picture(truth, arcs(1, 9.0), (200, 300))
    pixels[hidden] = 0.0
    reported, untold = find_pins(frame(pixels), hidden=hidden), find_pins(frame(pixels))
    assert np.abs(reported.xy[0] - truth[0]).max() < 0.3
    assert np.abs(reported.xy[0] - truth[0]).max() < np.abs(untold.xy[0] - truth[0]).max()


@pytest.mark.parametrize("x", [-8.0, -2.0, 3.0, 8.0, 20.0])
def test_echoes_at_the_edge_of_the_screen_are_measured_correctly_or_declined(x: float):
    truth = np.array([[x + 0.3, 100.2], [150.0, 60.0]])
    found = find_pins(frame(picture(truth, arcs(2), (200, 300))))
    k = nearest(found.xy, truth[:1])[0]
    near = np.hypot(*(found.xy[k] - truth[0])) < 12
    if x >= 3:
        assert near
        assert found.ok[k]
        assert (np.abs(found.xy[k] - truth[0]) < 5 * np.sqrt(np.diagonal(found.cov[k]))).all()
    elif near:
        assert not found.ok[k]
        assert found.codes[k] is Code.OUTSIDE


def test_nothing_is_found_in_noise():
    rng = np.random.default_rng(2)
    assert not find_pins(frame(GROUND + NOISE * rng.standard_normal((300, 400)))).ok.any()


@pytest.mark.slow
@pytest.mark.parametrize("quality", [*slowly(None), 60])
@pytest.mark.parametrize("scale", [0.4, *slowly(0.6), 1.0])
def test_graphics_of_the_instrument_are_not_measured_as_pins(scale: float, quality: int | None):
    truth = np.array([[100.3, 160.2], [300.0, 160.0]])
    pixels = picture(truth, arcs(2, 9.0), (250, 480), noise=0.0).astype(np.uint8)
    cv2.putText(pixels, "GAIN: 20 dB  DEPTH-7 cm il1|/", (10, 40), cv2.FONT_HERSHEY_SIMPLEX, scale, 180, 1)
    cv2.putText(
        pixels, "FR:NORM 12/04/88", (10, 80), cv2.FONT_HERSHEY_PLAIN, 1.6 * scale, 180, 2, cv2.LINE_AA
    )
    cv2.line(pixels, (10, 200), (470, 200), 170, 1)
    cv2.ellipse(pixels, (240, 460), (260, 260), 0, 225, 315, 120, 5, cv2.LINE_AA)
    for x in range(20, 470, 50):
        cv2.line(pixels, (x, 200), (x, 206), 170, 1)
        cv2.circle(pixels, (x, 225), 2, 170, -1, cv2.LINE_AA)
    cv2.polylines(pixels, [np.array([[440, 100], [452, 92], [452, 108]])], True, 250, 1, cv2.LINE_AA)
    if quality is not None:
        coded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        pixels = cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)
    found = find_pins(Frame(pixels, 255.0))
    assert found.ok.sum() == 2
    assert np.abs(found.xy[nearest(found.xy, truth)] - truth).max() < 0.3


def test_static_spots_of_a_sequence_are_not_echoes():
    still, moving = np.array([[90.0, 60.0]]), np.array([[100.0, 140.0], [200.0, 140.0]])
    frames = [
        frame(
            picture(
                np.concatenate([still, moving + np.array([0.0, 9.0 * k])]),
                arcs(3),
                (240, 320),
                noise=0.5,
                seed=k,
            )
        )
        for k in range(3)
    ]
    alone, together = find_pins(frames[0]), find_pins(frames[0], others=frames[1:])
    assert alone.ok.sum() == 3
    assert together.ok.sum() == 2
    assert together.why[nearest(together.xy, still)[0]] == "the same in all frames"


OBJECT = np.array(
    [(0, y) for y in range(0, 101, 20)]
    + [(x, y) for y in (0, 100) for x in range(25, 101, 25)]
    + [(100, y) for y in (20, 40, 60, 80)]
    + [(30, 70), (36, 62), (43, 55)],
    dtype=float,
)
SYMMETRIC = OBJECT[:-3]


def rods(xy: Array = OBJECT, shape: str = "rod", unknown: int | None = None) -> ReseauDesign:
    points = [
        {"id": f"R{k}", "x": None if k == unknown else x, "y": None if k == unknown else y}
        for k, (x, y) in enumerate(xy.tolist())
    ]
    mark = {"shape": shape, "size": 0.75}
    text = json.dumps(
        {
            "schema": "reseau-design/1",
            "name": "object",
            "unit": "mm",
            "mark": mark,
            "polarity": "bright",
            "points": points,
        }
    )
    return ReseauDesign.parse(text, where="test")


def on_screen(matrix: Array) -> Array:
    """The test object in the image, bent as by a display."""
    centred = (OBJECT - 50) @ matrix.T
    return centred * (1 + 0.03 * (centred**2).sum(axis=1, keepdims=True) / 300**2) + [400.2, 300.3]


@pytest.mark.parametrize(
    "matrix",
    [
        *slowly([[5, 0], [0, -5]], [[-5, 0], [0, 5]], [[-5, 0], [0, -5.2]]),
        [[4.95, -0.5], [-0.5, -4.95]],
    ],
)
def test_rods_are_identified_also_if_mirrored_or_rotated(matrix: list[list[float]]):
    truth = on_screen(np.array(matrix))
    inside = ((truth > 12) & (truth < [788, 588])).all(axis=1)
    result = measure_pins(frame(picture(truth, arcs(len(truth), 6.0), (600, 800))), rods())
    assert result
    assert result.ok[inside].all()
    assert np.abs(result.xy - truth)[result.ok].max() < 0.25
    assert len(result.points) == result.found == result.measurement().found


def test_a_symmetric_pattern_is_assumed_upright_and_reported_as_ambiguous():
    truth = (SYMMETRIC - 50) @ np.diag([5.0, -5.0]) + [400.2, 300.3]
    result = measure_pins(frame(picture(truth, arcs(len(truth), 6.0), (600, 800))), rods(SYMMETRIC))
    assert result
    assert np.abs(result.xy - truth).max() < 0.25
    assert len(result.notes) == 1
    assert "symmetric" in result.notes[0].text


def test_missing_shared_and_unknown_rods_are_declined_with_the_reason():
    close = np.concatenate([OBJECT, [[50.0, 50.0], [51.5, 50.0], [70.0, 50.0]]])
    truth = (close - 50) @ np.diag([5.0, -5.0]) + [400.2, 300.3]
    light = np.full(len(truth), 140.0)
    light[3] = 0.0
    shown = picture(truth, arcs(len(truth), 6.0), (600, 800), light)
    result = measure_pins(frame(shown), rods(close, unknown=len(close) - 1))
    assert result
    assert result.codes[3] is Code.NOT_FOUND
    pair = [len(close) - 3, len(close) - 2]
    assert [result.ok[k] for k in pair] == [False, False]
    assert all(result.codes[k] is Code.OVERLAPPING for k in pair)
    assert result.codes[-1] is Code.NO_COORDINATES
    assert result.found == len(close) - 4
    assert not [note for note in result.notes if note.code is Code.AMBIGUOUS]


@pytest.mark.slow
def test_deviations_far_above_the_sigmas_are_said_if_tolerances_do_not_explain_them():
    matrix = np.diag([5.0, -5.0])
    made = OBJECT + np.random.default_rng(3).normal(0, 0.2, OBJECT.shape)
    shown = frame(picture((made - 50) @ matrix + [400.2, 300.3], arcs(len(OBJECT), 6.0), (600, 800)))
    design = rods()
    toleranced = tuple(point.model_copy(update={"sigma": 0.2}) for point in design.points)
    codes = []
    for used in (design, design.model_copy(update={"points": toleranced})):
        result = measure_pins(shown, used)
        assert result
        codes.append([note.code for note in result.notes])
    assert codes == [[Code.INCONSISTENT], []]


def test_a_missing_pattern_is_a_failure_with_the_reason():
    truth = np.random.default_rng(4).uniform([40, 40], [600, 440], (5, 2))
    result = measure_pins(frame(picture(truth, arcs(5), (480, 640))), rods())
    assert not result
    assert result.code is Code.NOT_FOUND, result.reason
    blank = measure_pins(frame(GROUND + NOISE * np.random.default_rng(0).standard_normal((200, 300))), rods())
    assert not blank
    assert "0 echoes" in blank.reason


FOUR = np.array([[0.0, 0.0], [30.1, 0.9], [0.7, -15.1], [30.5, -16.0]])


@pytest.mark.parametrize("seed", range(6))
def test_four_rods_are_not_laid_over_echoes_of_other_things(seed: int):
    others = np.random.default_rng(seed).uniform([15, 15], [585, 385], (16, 2))
    layout = lay_wires(Wires(tuple("abcd"), FOUR, FOUR), others)
    assert not layout
    if layout.code is Code.AMBIGUOUS:
        assert "by chance" in layout.reason


def test_four_rods_that_fit_exactly_are_found_among_others():
    truth = FOUR @ np.array([[5.0, 0.3], [-0.3, 5.0]]) * [1, -1] + [220.3, 150.2]
    others = np.random.default_rng(3).uniform([15, 15], [585, 385], (5, 2))
    layout = lay_wires(Wires(tuple("abcd"), FOUR, FOUR), np.concatenate([others, truth]))
    assert layout
    assert (np.sort(layout.row) == [5, 6, 7, 8]).all()


@pytest.mark.slow
def test_four_rods_of_a_turned_phantom_are_found_or_declined(reference_data: Callable[[str], Path]):
    folder = reference_data("independent") / "pins"
    reference = json.loads((folder / "reference.json").read_text("utf-8"))
    design = ReseauDesign.read(folder / "wires.design.json")
    for record in reference["frames"]:
        wires = dict(zip(("R1", "N1", "L1", "R2", "N2", "L2"), record["points"], strict=True))
        for turn in (12.0, 30.0):
            found = measure_pins(
                read_image(folder / record["image"]), design, PinOptions(max_rotation_deg=turn)
            )
            if found:
                truth = np.array([wires[name] for name in design.ids])
                assert np.abs(found.xy - truth)[found.ok].max() < 3


def test_misuse_is_reported():
    shown = frame(picture(np.array([[100.0, 100.0]]), arcs(1), (200, 200)))
    with pytest.raises(UsageError, match="cross"):
        measure_pins(shown, ReseauDesign.parse(rods().to_json().replace('"rod"', '"cross"'), where="test"))
    with pytest.raises(UsageError, match="fewer than four"):
        measure_pins(shown, rods(OBJECT[:3]))


def test_slanted_wires_are_derived_from_their_segments():
    start = np.array(
        [[30, 20], [55, 20], [60, 20], [30, 10], [35, 10], [60, 10], [35, 0], [55, 0], [60, 0.0]]
    )
    end = start.copy()
    end[[1, 4, 7], 0] = [35, 55, 40]
    wires = Wires(tuple("abcdefghi"), start, end)
    cut = start + 0.3 * (end - start)
    seen = cut @ np.array([[-12.7, -0.6], [0.6, -13.3]]) + [950.0, 460.0]
    order = np.random.default_rng(3).permutation(9)
    shown = np.concatenate([seen[order], [[500.0, 520.0], [250.0, 530.0]]])
    layout = lay_wires(wires, shown + 0.5 * np.random.default_rng(1).standard_normal(shown.shape))
    assert layout
    assert (order[layout.row] == np.arange(9)).all()
    assert np.abs(layout.inverse(seen)[wires.fixed] - start[wires.fixed]).max() < 0.15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sequence", "every"), [("VLCUS_6pt", 5), ("fCal20_3NWires_cal", 6)], ids=["characters", "plain"]
)
def test_in_real_frames_every_wire_found_by_plus_is_measured(
    sequence: str, every: int, reference_data: Callable[[str], Path]
):
    folder = reference_data("ultrasound_nwire")
    reference = json.loads((folder / f"{sequence}.reference.json").read_text("utf-8"))
    deviation = []
    for record in reference["frames"][::every]:
        seen = find_pins(read_image(folder / record["image"]), PinOptions())
        points = record["points"]
        wires = np.array(list(points.values()) if isinstance(points, dict) else points, float).reshape(-1, 2)
        known = np.concatenate([wires, np.array(record.get("candidates", []), float).reshape(-1, 3)[:, :2]])
        xy = seen.xy[seen.ok]
        away = np.hypot(*np.moveaxis(xy[:, None] - known[None], -1, 0))
        assert (away.min(axis=1) > 10).sum() <= 2
        if len(wires):
            assert (away.min(axis=0)[: len(wires)] < 10).all()
            deviation.append(xy[nearest(xy, wires)] - wires)
        if "phantom_wires" in reference:
            ends = np.array([reference["phantom_wires"][name] for name in points], float)
            layout = lay_wires(Wires(tuple(points), ends[:, 0][:, [0, 2]], ends[:, 1][:, [0, 2]]), xy)
            assert layout
            assert (np.hypot(*(xy[layout.row] - wires).T) < 10).all()
    assert (np.sqrt(np.mean(np.concatenate(deviation) ** 2, axis=0)) < [1.5, 0.7]).all()
