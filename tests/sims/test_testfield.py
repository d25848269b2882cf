"""The testfield on its turntable: recordings agree with the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.designs import coded_testfield
from reseau.optics import Sensor, project, rotation_matrix
from reseau_sims import FieldBench, Photograph, Stain, Station, paper_stations

QUIET = Sensor(240, 240, shot_noise=False, quantise=False)


def test_the_paper_made_36_recordings_from_nine_positions() -> None:
    stations = paper_stations()
    assert len(stations) == len(set(stations)) == 36
    assert len({(s.phi, s.kappa) for s in stations}) == 9
    assert {s.phi for s in stations} == {0.0, 30.0, 45.0}


def test_the_pixel_footprint_is_that_of_the_paper() -> None:
    truth = FieldBench().truth(Station(0))
    step = np.hypot(*(truth.xy[1] - truth.xy[0]))
    # 57.5 mm over 5 m and 27 µm: 0.426 px/mm, within what the setting up leaves open.
    assert step / 30.0 == pytest.approx(57.5 / 5000 / 0.027, abs=0.002)


@pytest.mark.slow
def test_the_same_seed_and_station_give_the_same_frame_in_any_order() -> None:
    bench, station = FieldBench(seed=3), Station(30, 90)
    first = bench.record(station)
    bench.record(Station(45))
    assert first.sha256 == bench.record(station).sha256
    assert first.sha256 != FieldBench(seed=4).record(station).sha256


def darkness_centroid(light: Array, level: float, at: Array, half: int) -> Array:
    x, y = np.rint(at).astype(int)
    dark = level - light[y - half : y + half + 1, x - half : x + half + 1]
    columns, rows = np.meshgrid(np.arange(x - half, x + half + 1), np.arange(y - half, y + half + 1))
    return np.array([(dark * columns).sum(), (dark * rows).sum()]) / dark.sum()


@pytest.mark.parametrize("station", [Station(0), Station(30, 180, 90), Station(45, 270, 180)])
def test_an_isolated_target_is_at_its_true_position(station: Station) -> None:
    field = coded_testfield()
    only = "28.06"  # somewhere in the middle, so that no line is near
    bench = FieldBench(design=field, missing=frozenset(field.ids) - {only}, sensor=QUIET)
    truth = bench.truth(station)
    at = truth.xy[field.ids.index(only)]
    found = darkness_centroid(bench.light(station), bench.level, at, 9)
    # The centroid of an image is off the image of the centroid by the perspective only: 1e-3 px here.
    np.testing.assert_allclose(found, at, rtol=0, atol=2e-3)


def test_the_truth_follows_from_its_pose_and_points() -> None:
    bench, station = FieldBench().distorted(10.0), Station(45, 90, 270)
    truth = bench.truth(station)
    np.testing.assert_allclose(project(bench.camera, truth.pose, truth.xyz).xy, truth.xy, rtol=0, atol=1e-9)


def heights_in_mount(bench: FieldBench, station: Station) -> Array:
    """Heights over a cross of points along the axes of the mount, (2, 5)."""
    turn = rotation_matrix(np.array([0, 0, np.deg2rad(station.kappa)]))[:2, :2]
    at = np.linspace(-250, 250, 5)
    mount = np.stack([np.stack([at, 0 * at], -1), np.stack([0 * at, at], -1)])
    return bench.surface(station)((mount @ turn).reshape(-1, 2))[0][:, 2].reshape(2, 5)


def test_the_mount_bend_does_not_rotate_with_the_board() -> None:
    bench = FieldBench()
    for kappa in (0, 90, 180, 270):
        across, along = heights_in_mount(bench, Station(45, kappa))
        np.testing.assert_allclose(across, [-0.8, -0.2, 0, -0.2, -0.8], rtol=0, atol=1e-9)
        np.testing.assert_allclose(along, 0, rtol=0, atol=1e-9)


def test_a_board_bend_rotates_with_the_board() -> None:
    bench = FieldBench(bend_with="board")
    across, along = heights_in_mount(bench, Station(45, 90))
    np.testing.assert_allclose(across, 0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(along, [-0.8, -0.2, 0, -0.2, -0.8], rtol=0, atol=1e-9)


def test_the_bend_grows_with_the_tilt() -> None:
    bench = FieldBench()
    low = [heights_in_mount(bench, Station(phi)).min() for phi in (0, 30, 45, 60)]
    np.testing.assert_allclose(low, [0, -0.8 / np.sqrt(2), -0.8, -0.8 * np.sqrt(1.5)], rtol=0, atol=1e-9)


def test_noise_is_that_of_46_db() -> None:
    bench = FieldBench(sensor=replace(FieldBench().sensor, row_jitter_px=0.0))
    noise = bench.record(Station(0)).pixels - bench.light(Station(0))
    # 57600 pixels tell a standard deviation to 0.3 %.
    assert 20 * np.log10(255 / noise.std()) == pytest.approx(46.0, abs=0.1)


def test_the_lens_distortion_at_the_middle_of_an_edge_is_as_requested() -> None:
    plain, bent = FieldBench(), FieldBench().distorted(-10.0)
    at = np.array([[120 * 0.027 / 57.5, 0.0]])
    np.testing.assert_allclose(bent.camera(at) - plain.camera(at), [[-10.0, 0.0]], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_stains_hide_or_saturate_targets_and_a_mirror_reflects_the_field() -> None:
    plain = FieldBench(sensor=QUIET)
    stained = replace(plain, stains=(Stain(60, 50, 20, 90.0), Stain(180, 190, 12, 300.0, opaque=False)))
    light = stained.light(Station(0))
    assert light[50, 60] == pytest.approx(90.0, abs=1e-6)
    assert light[190, 180] > 255
    assert stained.record(Station(0)).pixels.max() == 255.0
    mirrored = replace(plain, mirrored=True)
    np.testing.assert_allclose(
        mirrored.light(Station(30)), plain.light(Station(30))[:, ::-1], rtol=0, atol=1e-4
    )
    turned = replace(plain, design=coded_testfield(polarity="bright")).light(Station(0))
    np.testing.assert_allclose(turned + plain.light(Station(0)), 200 * (2 - 0.85), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_blur_of_other_forms_does_not_move_the_centroid_of_a_target() -> None:
    field = coded_testfield()
    only = "28.06"
    shaken = Photograph(defocus_px=1.5, motion_px=3.0, motion_bend=0.2, motion_speed=0.4)
    bench = FieldBench(
        design=field, missing=frozenset(field.ids) - {only}, sensor=QUIET, photograph=shaken, waves_mm=1.0
    )
    at = bench.truth(Station(30.0)).xy[field.ids.index(only)]
    found = darkness_centroid(bench.light(Station(30.0)), bench.level, at, 11)
    np.testing.assert_allclose(found, at, rtol=0, atol=2e-3)


def test_a_finger_hides_what_is_beside_its_axis() -> None:
    bench = FieldBench(stains=(Stain(60.0, 60.0, 10.0, 90.0, end=(60.0, 180.0), texture=5.0),), sensor=QUIET)
    light = bench.light(Station(0.0))
    assert np.abs(light[60:180, 53:68] - 90).max() <= 5.5
    np.testing.assert_allclose(light[:, 100:], FieldBench(sensor=QUIET).light(Station(0.0))[:, 100:])


def test_curve_sharpening_and_compression_change_grey_values_as_they_say() -> None:
    grey = np.tile(np.array([64, 255], dtype=np.uint8), (16, 8))
    assert Photograph(gamma=2.0).processed(grey, 255.0)[0, :2].tolist() == [128, 255]
    edge = np.where(np.arange(16) < 8, 100, 150).astype(np.uint8)[None].repeat(16, axis=0)
    sharp = Photograph(sharpening=1.0).processed(edge, 255.0)
    assert sharp[0, 7] < 100
    assert sharp[0, 8] > 150
    coded = Photograph(jpeg=60).processed(edge, 255.0)
    assert (coded != edge).any()
    assert np.abs(coded.astype(int) - edge).max() < 20
