"""PHOTO II and III from frames of the simulated bench: pins behind the wires of a reseau."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from reseau.core.data import ImagePoints
from reseau.designs import standard_reseau
from reseau.measure import measure_reseau
from reseau.procedures.oscilloscope import PhotoI, PhotoII, photo_i, photo_ii, photo_iii, still_standard_in
from reseau_sims import Faults, World, swapped


@pytest.fixture(scope="module")
def world() -> World:
    return World.standard(1)


@pytest.mark.slow
def test_the_shadow_of_a_reseau_covers_only_its_wires(world):
    frame = world.photo_i()
    found = measure_reseau(frame, world.design)
    hidden = found.shadow(world.design, frame.pixels.shape, margin_px=1.0)
    wires = world.truth()
    # Along each wire, between two crossings, the middle of the wire is hidden; the middle of a mesh is not.
    x, y = (np.unique(c) for c in wires.object_xy.T)
    on = np.array([(a, (b + c) / 2) for a in x for b, c in itertools.pairwise(y)])
    off = np.array(
        [((a + d) / 2, (b + c) / 2) for a, d in itertools.pairwise(x) for b, c in itertools.pairwise(y)]
    )
    for plane, value in ((on, True), (off, False)):
        column, row = np.rint(wires.view(plane)).astype(int).T
        assert (hidden[row, column] == value).all()
    assert 0.03 < hidden.mean() < 0.2
    assert world.design == standard_reseau()


@pytest.fixture(scope="module")
def bench(world) -> tuple[PhotoI, PhotoII]:
    first = photo_i(world.photo_i(), world.design).required()
    return first, photo_ii(world.photo_ii(), world.design, world.test_object, first.camera).required()


def at_fault(**faults: float | str) -> World:
    """The same world with faults."""
    return World.standard(1, faults=Faults(**faults))


def errors(found: ImagePoints, world: World) -> np.ndarray:
    """True coordinates less the world's (n, 2), for points that the world has."""
    truth = world.truth_iii()
    row = np.hypot(*np.moveaxis(found.xy[:, None] - truth.object_xy[None], -1, 0)).argmin(axis=1)
    return found.xy - truth.object_xy[row]


@pytest.mark.slow
def test_a_bench_without_faults_gives_no_remarks(bench):
    _, second = bench
    assert second.notes == ()
    assert len(second.pins) >= 30


@pytest.mark.slow
def test_true_coordinates_of_a_body_lie_within_their_sigmas(world, bench):
    _, second = bench
    third = photo_iii(world.photo_iii(), second.instrument, world.design).required()
    off = errors(third.true, world)
    assert len(off) >= 20
    assert np.abs(off).max() < 0.5
    assert (np.abs(off) < 4 * third.true.sigma).all()


@pytest.mark.slow
def test_a_missing_row_of_rods_is_reported(bench):
    found = photo_of(at_fault(missing_row="C"), bench)
    assert [str(note) for note in found.notes] == ["the whole row of rods at y = -60 mm is missing"]


@pytest.mark.slow
def test_a_rotated_test_object_is_reported(bench):
    found = photo_of(at_fault(object_turned_deg=3.0), bench)
    assert len(found.notes) == 1
    assert "turned by" in found.notes[0].text
    # The beam and the display turn the section as well, by a few tenths.
    assert np.rad2deg(found.instrument.plane.rotation) == pytest.approx(3.0, abs=0.5)


def photo_of(world: World, bench: tuple[PhotoI, PhotoII]) -> PhotoII:
    """PHOTO II of a world with the camera of another."""
    first, _ = bench
    return photo_ii(world.photo_ii(), world.design, world.test_object, first.camera).required()


@pytest.mark.slow
@pytest.mark.parametrize("pushed", [0.4, pytest.param(20.0, marks=pytest.mark.slow)])
def test_a_displaced_camera_is_detected_and_corrected(pushed: float, bench):
    _, before = bench
    found = photo_of(at_fault(camera_moved_mm=pushed), bench)
    assert any("the camera has moved since PHOTO I" in note.text for note in found.notes)
    common = [name for name in found.pins.names if name in before.pins.names]
    off = found.pins.select(common).xy - before.pins.select(common).xy
    assert np.abs(off.mean(axis=0)).max() < 0.02
    assert np.abs(off).max() < 0.6


@pytest.mark.slow
def test_swapped_marks_of_the_common_system_are_reported(world, bench):
    confused = swapped(world.design)
    first = photo_i(world.photo_i(), confused).required()
    found = photo_ii(world.photo_ii(), confused, world.test_object, first.camera).required()
    assert any("are O and S swapped?" in note.text for note in found.notes)


@pytest.mark.slow
def test_a_gap_between_reseau_and_screen_has_no_effect_from_one_position():
    world = at_fault(parallax_mm=2.0)
    first = photo_i(world.photo_i(), world.design).required()
    second = photo_ii(world.photo_ii(), world.design, world.test_object, first.camera).required()
    third = photo_iii(world.photo_iii(), second.instrument, world.design).required()
    assert second.notes == ()
    assert (np.abs(errors(third.true, world)) < 4 * third.true.sigma).all()


@pytest.mark.slow
def test_a_gap_between_reseau_and_screen_is_reported_from_two_positions():
    still = at_fault(parallax_mm=2.0)
    first = photo_i(still.photo_i(), still.design).required()
    second = photo_ii(still.photo_ii(), still.design, still.test_object, first.camera).required()
    pushed = at_fault(parallax_mm=2.0, camera_moved_mm=5.0)
    found = still_standard_in(
        pushed.photo_ii(), second.instrument, still.design, still.test_object
    ).required()
    assert not found.test.holds
    # Two millimetres behind a plane 264 mm away, seen from 5 mm beside.
    assert np.hypot(*found.test.shift) == pytest.approx(2.0 * 5.0 / 264, abs=0.004)
    assert any("a gap between reseau and screen (parallax)" in note.text for note in found.notes)


@pytest.mark.slow
def test_stored_coefficients_are_valid_in_a_new_photograph_of_the_same_bench(world, bench):
    _, second = bench
    again = world.photograph("PHOTO II anew", world.show(world.rods, "PHOTO II anew"))
    found = still_standard_in(again, second.instrument, world.design, world.test_object).required()
    assert found.test.p > 0.001
    assert found.test.largest[1] < 0.05
