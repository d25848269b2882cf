"""The testfield: correct numbers and positions from every side; a failure with a reason if it is absent."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from reseau.core.data import Array, Frame
from reseau.core.failure import Code, Failure
from reseau.core.tone import ToneCurve
from reseau.designs import coded_testfield
from reseau.designs.topology import TopologicalCode
from reseau.io import TestfieldDesign
from reseau.measure import measure_testfield
from reseau.measure.testfield.measure import TestfieldOptions, TestfieldResult
from reseau.measure.testfield.recognition import Placement, Reading, locate
from reseau.optics import Brown, PixelGrid, Sensor
from reseau_sims import FieldBench, Stain, Station
from reseau_sims.testfield import DISTANCE_MM, JITTER_PX

from .. import kept
from ..montecarlo import slowly
from .fields import bounds

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from worlds.boards import Field
from worlds.sheets import views

DESIGN = coded_testfield()
OPTIONS = TestfieldOptions(row_jitter_px=JITTER_PX, fill=0.8)


def measured(bench: FieldBench, station: Station) -> tuple[TestfieldResult, Array]:
    """The result, and its errors (n, 2), NaN for missing targets."""
    result = measure_testfield(bench.record(station), bench.design, OPTIONS)
    assert isinstance(result, TestfieldResult), result.reason
    return result, result.xy - bench.truth(station).xy


def test_row_jitter_increases_the_bound_of_x_by_a_third() -> None:
    bench, station = FieldBench(), Station(0)
    inside = bench.inside(bench.truth(station), 8.0)
    variance = np.diagonal(bounds(bench, station, inside)[inside], axis1=1, axis2=2).mean(axis=0)
    assert np.sqrt(variance[0] / variance[1]) == pytest.approx(1.3, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("station", [*slowly((Station(0),), (Station(45, 90, 180),)), Station(60, 180, 90)])
def test_targets_are_numbered_and_measured_at_the_cramer_rao_bound(station: Station) -> None:
    bench = FieldBench(seed=11)
    result, error = measured(bench, station)
    expected = bench.inside(bench.truth(station), 9.0)
    assert result.ok[expected].all()
    # A target of another number is a dozen pixels away.
    assert np.abs(error[result.ok]).max() < 0.06
    bound = np.diagonal(bounds(bench, station, result.ok), axis1=1, axis2=2)
    for large in (False, True):
        of = result.ok & (bench.design.large == large)
        ratio = np.sqrt((error[of] ** 2).mean() / bound[of].mean())
        # 300 coordinates tell it to 4 %.
        assert 0.85 < ratio < 1.18
    normalised = error[result.ok] ** 2 / np.diagonal(result.cov[result.ok], axis1=1, axis2=2)
    assert np.sqrt(normalised.mean()) == pytest.approx(1.0, abs=0.13)


CASES: dict[str, tuple[FieldBench, Station, int]] = {
    "the camera turned by 37°": (FieldBench(), Station(45, 0, 37), 380),
    "pincushion distortion of 10 px": (FieldBench().distorted(10), Station(30), 250),
    "barrel distortion of 10 px": (FieldBench().distorted(-10), Station(30), 350),
    "blurred by 1.5 px": (FieldBench(psf_px=1.5), Station(0), 250),
    "blurred by 2 px": (FieldBench(psf_px=2.0), Station(0), 250),
    "blurred by 1.7 px, and tilted": (FieldBench(psf_px=1.7), Station(45, 90, 180), 200),
    "a tenth of the contrast": (FieldBench(contrast=0.1), Station(30), 340),
    "uneven light": (FieldBench(gradient=(0.4, -0.3), level=140.0), Station(30), 340),
    "bright on dark": (FieldBench(design=coded_testfield(polarity="bright")), Station(30), 340),
    "targets turned at random": (FieldBench(design=coded_testfield(turn_seed=3)), Station(0), 300),
    "from afar": (FieldBench(distance_mm=8000), Station(0), 760),
}
QUICK = (
    "the camera turned by 37°", "barrel distortion of 10 px", "blurred by 2 px", "uneven light",
    "from afar"
)  # fmt: skip
"""What the suite measures; the others take as long, and are run by `make slow`."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=() if c in QUICK else pytest.mark.slow) for c in CASES]
)
def test_there_are_no_unflagged_errors(case: str) -> None:
    bench, station, least = CASES[case]
    result, error = measured(bench, station)
    assert result.found >= least
    sigma = np.sqrt(np.diagonal(result.cov, axis1=1, axis2=2))
    assert np.nanmax(np.abs(error) / np.hypot(sigma, 0.01)) < 5.0


@pytest.mark.slow
def test_grey_values_that_follow_a_curve_are_linearised_with_a_note() -> None:
    frame, truth = PLAIN.record(STATION), PLAIN.truth(STATION)
    first = answer(frame.pixels)
    coded = np.rint(255 * (frame.pixels / 255.0) ** (1 / 2.2)).astype(np.uint8)
    found = answer(coded)
    assert (first.notes, found.notes[0].code) == ((), "nonlinear")
    assert found.found >= 0.97 * first.found
    both = found.ok & first.ok
    error, least = ((each.xy - truth.xy)[both].std() for each in (found, first))
    assert error < 1.15 * least


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gamma", "says"),
    [
        (2.2, "with the file's sRGB tag"),
        (1.6, "estimated from the edges of targets, a power of 0.6"),
        (1.0, "proportional to the light; the file's sRGB tag does not describe them"),
    ],
)
def test_the_curve_that_a_file_states_is_used_unless_targets_contradict_it(gamma: float, says: str) -> None:
    frame, truth = PLAIN.record(STATION), PLAIN.truth(STATION)
    coded = np.rint(255 * (frame.pixels / 255.0) ** (1 / gamma)).astype(np.uint8)
    stated = ToneCurve(None, source="sRGB tag")
    found = measure_testfield(Frame(coded, 255.0, curve=stated), DESIGN, OPTIONS)
    assert isinstance(found, TestfieldResult)
    assert says in found.notes[0].text
    error = (found.xy - truth.xy)[found.ok]
    assert error.std() < 0.01
    assert abs(error.mean(axis=0)).max() < 0.002


@pytest.mark.slow
@pytest.mark.parametrize(
    ("farther", "station", "read"),
    [
        pytest.param(2.6, Station(30), 35, id="140 px", marks=pytest.mark.slow),
        pytest.param(3.0, Station(45), 0, id="97 px"),
    ],
)
def test_a_small_field_whose_lines_cannot_be_seen_is_read_by_its_targets(
    farther: float, station: Station, read: int
) -> None:
    result, error = measured(FieldBench(seed=3, distance_mm=farther * DISTANCE_MM), station)
    assert result.ok.sum() > 1000
    assert abs(sum(map(bool, result.reading.decoded)) - read) < 5
    normalised = error[result.ok] ** 2 / np.diagonal(result.cov[result.ok], axis1=1, axis2=2)
    assert not ((np.abs(error[result.ok]) > 0.15) & (normalised > 5**2)).any()
    assert 0.8 < np.sqrt(normalised.mean()) < 1.15
    assert np.abs(result.reading.xy - 120).max() < 130


def test_motion_during_the_exposure_is_formed_and_sigmas_stay_right() -> None:
    still = FieldBench(sensor=Sensor(240, 240, shot_noise=False, read_noise=0.0))
    frame, truth = still.record(STATION), still.truth(STATION)
    moved = uniform_filter1d(frame.pixels.astype(np.float64), 5, axis=0)
    moved += np.random.default_rng(1).normal(0, 1.2, moved.shape)
    found = measure_testfield(Frame(np.rint(moved).clip(0, 255).astype(np.uint8), 255.0), DESIGN)
    assert isinstance(found, TestfieldResult)
    assert found.found > 330
    error = (found.xy - truth.xy)[found.ok]
    sigma = np.sqrt(np.diagonal(found.cov[found.ok], axis1=1, axis2=2))
    assert np.sqrt(((error / sigma) ** 2).mean()) == pytest.approx(1.0, abs=0.25)


def test_hidden_and_saturated_targets_are_flagged_or_correct() -> None:
    stains = (Stain(80, 80, 30, 200.0), Stain(180, 170, 20, 90.0), Stain(100, 170, 20, 300.0, opaque=False))
    bench, station = FieldBench(stains=stains), Station(30)
    result, error = measured(bench, station)
    away = np.hypot(*(bench.truth(station).xy - [80, 80]).T)
    assert not result.ok[away < 30].any()
    assert result.ok.sum() > 260
    sigma = np.sqrt(np.diagonal(result.cov, axis1=1, axis2=2))
    assert np.nanmax(np.abs(error) / np.hypot(sigma, 0.01)) < 5.0
    assert np.nanmax(np.abs(error)) < 0.15
    assert all(why for why, ok in zip(result.why, result.ok, strict=True) if not ok)


def test_a_board_bend_does_not_affect_the_measurement() -> None:
    _, error = measured(FieldBench(bend_with="board", bend_mm=1.6), Station(45, 90))
    assert np.nanmax(np.abs(error)) < 0.05


@pytest.mark.slow
def test_a_frame_of_more_pixels_shows_every_target() -> None:
    camera = Brown(side="object", grid=PixelGrid(480, 480, (0.027, 0.027))).with_values({"c": 57.5})
    sensor = Sensor(480, 480, shot_noise=False, read_noise=1.2)
    result, error = measured(FieldBench(distance_mm=5500, sensor=sensor, camera=camera), Station(30))
    assert (result.found, result.squares) == (1024, 64)
    assert np.abs(error).max() < 0.05


@pytest.mark.parametrize(("right", "placed"), [(0.35, True), (0.0, False)], ids=["a third", "none"])
@pytest.mark.parametrize("quarters", range(4))
def test_squares_that_cannot_be_read_are_placed_by_all_targets_together(
    right: float, placed: bool, quarters: int
) -> None:
    rng, code = np.random.default_rng(quarters), TopologicalCode.of(DESIGN)
    # The squares in rows from the upper left, as they are seen.
    grid = np.rot90(np.lexsort((DESIGN.centres[:, 0], -DESIGN.centres[:, 1])).reshape(8, 8), quarters)
    row, column = np.indices((8, 8)).reshape(2, -1)
    seen = code.appearances[quarters, grid.ravel()]
    wrong = rng.random(seen.shape) > right
    seen = np.where(wrong, rng.integers(0, 8, seen.shape), seen)
    none = np.zeros((64, 16))
    decoded = tuple(code.decode(one) for one in seen)
    cell = np.column_stack([column, 7 - row])
    reading = Reading(cell, seen, seen, decoded, np.zeros((64, 16, 2)), none, none, 0.8)
    found = locate(reading, DESIGN)
    assert bool(found) is placed
    if placed:
        assert isinstance(found, Placement)
        assert found.squares > 51
        at = DESIGN.centres[grid.ravel()] @ found.frame.T + found.origin
        assert np.abs(at - cell - 0.5).max() < 0.01
        # Half of the squares in other places contradict the others.
        mixed = np.concatenate([seen[:32], rng.permutation(seen[32:])])
        assert not locate(replace(reading, joint=mixed), DESIGN)


def answer(pixels: Array, design: TestfieldDesign = DESIGN) -> Any:
    return measure_testfield(Frame(pixels, 255.0, "frame"), design, OPTIONS)


PLAIN, STATION = FieldBench(), Station(30)
FRAME = PLAIN.record(STATION).pixels


@pytest.mark.parametrize(
    ("pixels", "design", "codes"),
    [
        (np.random.default_rng(0).integers(0, 255, (240, 240)), DESIGN, "not-found"),
        (np.tile(np.arange(240), (240, 1)), DESIGN, "not-found"),
        (FRAME[:6, :6], DESIGN, "not-found"),
        (
            np.kron(np.indices((8, 8)).sum(axis=0) % 2, np.ones((30, 30))) * 200,
            DESIGN,
            "other-design",
        ),
        (FRAME[:, ::-1], DESIGN, "mirrored"),
        (FRAME, coded_testfield(4, 4), "other-design"),
        (FRAME, coded_testfield(12, 14), "inconsistent"),
    ],
    ids=[
        "noise",
        "ramp",
        "tiny",
        "chessboard",
        "mirrored",
        "another",
        "a larger one",
    ],
)
def test_images_without_the_testfield_are_failures_with_a_reason(
    pixels: Array, design: Any, codes: str
) -> None:
    found = answer(np.ascontiguousarray(pixels).astype(np.uint8), design)
    assert isinstance(found, Failure)
    assert found.where == "frame"
    assert found.code in codes.split("|"), found.reason
    assert found.reason


@pytest.mark.slow
@pytest.mark.parametrize(
    ("left", "right"),
    [
        pytest.param(STATION, STATION, id="alike", marks=pytest.mark.slow),
        pytest.param(Station(0), Station(0), id="at right angles", marks=pytest.mark.slow),
        pytest.param(Station(30, 0, 37), Station(30, 90), id="from other sides"),
    ],
)
def test_of_two_testfields_one_is_measured_as_if_it_were_alone(left: Station, right: Station) -> None:
    halves = [PLAIN.record(station).pixels for station in (left, right)]
    found, wide = answer(np.hstack(halves)), halves[0].shape[1]
    assert Code.SEVERAL_TARGETS in [note.code for note in found.notes]
    beyond = found.xy[found.ok, 0] > wide - 0.5
    side = int(beyond.mean() > 0.5)
    assert (beyond == side).mean() > 0.99
    alone = answer(halves[side])
    both = alone.ok & found.ok
    assert both.sum() > 0.97 * alone.found
    np.testing.assert_allclose(found.xy[both] - [side * wide, 0], alone.xy[both], rtol=0, atol=0.01)


def test_a_testfield_is_found_beside_a_larger_one_whose_code_begins_alike() -> None:
    design = coded_testfield(4, 4)
    near, far = FieldBench(design=design), FieldBench(distance_mm=2.2 * DISTANCE_MM)
    frames = [bench.record(station).pixels for bench, station in ((far, Station(20)), (near, Station(0)))]
    found, alone = answer(np.hstack(frames), design), answer(frames[1], design)
    assert found.ok.all()
    np.testing.assert_allclose(found.xy - [frames[0].shape[1], 0], alone.xy, rtol=0, atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("condition", [*slowly("gamma", "sharpened"), "jpeg60"])
def test_cameras_that_process_their_pictures_leave_sigmas_of_the_size_of_errors(condition: str) -> None:
    """Residuals are then larger than noise, but displace targets less."""
    design = coded_testfield()
    (view,) = views(condition, 1, Field(json.loads(design.to_json())))
    found = measure_testfield(Frame(kept.picture(view), 255.0), design)
    assert found.ok.all()
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert np.sqrt((((found.xy - view.truth) / sigma) ** 2).mean()) == pytest.approx(1.0, abs=0.15)


def test_a_mirrored_frame_is_measured_with_the_design_from_behind() -> None:
    found, first = answer(np.ascontiguousarray(FRAME[:, ::-1]), DESIGN.from_behind()), answer(FRAME)
    both = first.ok & found.ok
    assert both.sum() > 330
    np.testing.assert_allclose(found.xy[both] * [-1, 1] + [239, 0], first.xy[both], rtol=0, atol=0.02)


@pytest.mark.parametrize(("corners", "squares"), [([[-250, 250], [125, 125]], 3), ([[-125, 125], [0, 0]], 1)])
def test_a_part_of_the_testfield_suffices(corners: Any, squares: int) -> None:
    truth = PLAIN.truth(STATION)
    ends = truth.view(np.array(corners, dtype=float))[0]
    (x0, y0), (x1, y1) = np.floor(ends.min(axis=0) - 4), np.ceil(ends.max(axis=0) + 4)
    part = FRAME[max(0, int(y0)) : int(y1) + 1, max(0, int(x0)) : int(x1) + 1]
    found = answer(part)
    assert isinstance(found, TestfieldResult)
    assert (found.squares, found.found) == (squares, 16 * squares)
    error = found.xy - truth.xy + [max(0, x0), max(0, y0)]
    assert np.nanmax(np.abs(error)) < 0.05


def test_numbers_follow_a_quarter_turn_of_the_frame() -> None:
    first = answer(FRAME)
    turned = answer(np.ascontiguousarray(np.rot90(FRAME)))
    both = first.ok & turned.ok
    assert both.sum() > 330
    # (x, y) of a frame turned counter-clockwise is (y, 239 − x) of the frame.
    back = np.stack([239 - turned.xy[:, 1], turned.xy[:, 0]], axis=1)
    np.testing.assert_allclose(back[both], first.xy[both], rtol=0, atol=0.02)


def test_the_result_is_a_document_of_all_targets() -> None:
    result, _ = measured(replace(PLAIN, missing=frozenset({"28.06"})), STATION)
    document = result.measurement()
    assert (document.found, document.expected) == (result.found, 1024)
    assert not result.ok[DESIGN.ids.index("28.06")]
    assert len(result.points) == result.found
    assert (result.rms() < 0.02).all()
