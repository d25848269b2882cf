"""Reverberations are told from points behind others, and rods from what is beside their places."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from reseau.core.data import Array, Frame
from reseau.core.failure import Code
from reseau.designs import regular_reseau
from reseau.io import Mark
from reseau.measure import find_pins, measure_reseau
from reseau.measure.pins.measure import assign
from reseau.measure.pins.reverberations import Reverberations, find_reverberations

from .test_pins import arcs, frame, nearest, picture

OPEN = np.zeros((600, 800), dtype=bool)


def scattered(count: int, seed: int) -> Array:
    """Places that are at least 40 px apart."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        at = rng.uniform([30, 30], [770, 540])
        if all(np.abs(at - other).max() > 40 for other in found):
            found.append(at)
    return np.array(found)


def decided(xy: Array, height: Array) -> Reverberations:
    every = np.ones(len(xy), dtype=bool)
    return find_reverberations(xy, height, np.full(len(xy), 25.0), every, OPEN, 5.0, 60.0)


@pytest.mark.parametrize("seed", range(4))
def test_every_second_echo_is_named_and_no_first_one(seed: int):
    rng, first = np.random.default_rng(seed), scattered(25, seed)
    spacing, ratio = rng.uniform(8, 35), rng.uniform(0.15, 0.55)
    second = np.add(first, [0.0, spacing]) + rng.normal(0, 0.3, first.shape)
    height = 100 * np.exp(rng.normal(0, 0.1, 25))
    found = decided(np.concatenate([first, second]), np.concatenate([height, ratio * height]))
    assert found.of[25:].tolist() == list(range(25))
    assert (found.of[:25] == -1).all()
    assert found.spacing == pytest.approx(spacing, abs=0.5)


@pytest.mark.parametrize("seed", range(4))
def test_points_behind_some_others_are_no_reverberations(seed: int):
    first = scattered(24, seed)
    xy = np.concatenate([first, np.add(first[::3], [0.0, 24.0])])
    found = decided(xy, np.concatenate([np.full(24, 100.0), np.full(8, 50.0)]))
    assert (found.of == -1).all()


def test_rods_at_equal_spacings_are_no_reverberations():
    grid = np.stack(np.meshgrid(np.arange(50.0, 751, 100), np.arange(50.0, 551, 45)), axis=-1).reshape(-1, 2)
    height = 100 * np.exp(np.random.default_rng(0).normal(0, 0.15, len(grid)))
    assert (decided(grid, height).of == -1).all()


@pytest.mark.slow
def test_reverberations_in_a_frame_are_declined_with_their_code():
    first = np.stack(np.meshgrid(60 + 90.0 * np.arange(6), 50 + 70.0 * np.arange(5)), axis=-1).reshape(-1, 2)
    truth = np.concatenate([first, np.add(first, [0.0, 18.0])])
    light = np.repeat([140.0, 50.0], len(first))
    found = find_pins(frame(picture(truth, arcs(len(truth)), (400, 600), light)))
    rows = nearest(found.xy, truth)
    assert found.ok[rows[: len(first)]].all()
    assert {found.codes[k] for k in rows[len(first) :]} == {Code.REVERBERATION}


@pytest.mark.slow
def test_a_photograph_turned_by_90_degrees_gives_the_same_echoes():
    first = np.stack(np.meshgrid(60 + 90.0 * np.arange(4), 50 + 70.0 * np.arange(3)), axis=-1).reshape(-1, 2)
    upright = frame(picture(first, arcs(len(first), tilt=0.1), (240, 400)))
    lying = find_pins(upright)
    turned = find_pins(Frame(np.rot90(upright.pixels), 255.0))
    there = np.stack([lying.xy[:, 1], 399 - lying.xy[:, 0]], axis=1)  # of what `rot90` does
    rows = nearest(turned.xy, there)
    assert turned.ok.sum() == lying.ok.sum() == len(first)
    assert np.abs(turned.xy[rows] - there).max() < 1e-3
    assert np.allclose(turned.cov[rows][:, 0, 0], lying.cov[:, 1, 1], rtol=1e-3)
    assert abs(abs(turned.direction) - (np.pi / 2 - 0.1)) < 0.02


def test_rods_of_a_hidden_row_do_not_take_what_lies_behind_them():
    rods = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 100
    echoes = rods * 1.1 + 3e-5 * rods**2
    echoes[7:14] += [0.0, 13.0]
    echoes[40] += [9.0, 0.0]
    wrong = [*range(7, 14), 40]
    cov = np.tile(0.01 * np.eye(2), (42, 1, 1))
    noisy = echoes + 0.1 * np.random.default_rng(1).standard_normal(echoes.shape)
    found = assign(rods, noisy, cov, np.arange(42), rods * 1.1, 16.0, np.zeros(42))
    assert np.flatnonzero(found.row < 0).tolist() == wrong
    assert sorted(found.excluded) == wrong


def test_a_bowed_wire_hides_what_lies_behind_its_middle():
    bow, width, px = 0.6, 0.4, 8.0
    x, y = np.meshgrid(np.linspace(-24, 24, 7), np.linspace(-18, 18, 6))

    def course(place: Array, along: Array) -> Array:
        return np.asarray(place + bow * (1 - (along / 18) ** 2))

    design = regular_reseau(7, 6, 8.0, Mark(shape="line-grid", line_width=width))
    crossings = np.stack([course(x.ravel(), y.ravel()), y.ravel()], axis=1)
    points = tuple(
        point.model_copy(update={"x": a, "y": b})
        for point, (a, b) in zip(design.points, crossings.tolist(), strict=True)
    )
    u, v = np.meshgrid((np.arange(480) - 240) / px, -(np.arange(380) - 190) / px)
    away = np.minimum(
        np.abs(u[..., None] - course(x[0], v[..., None])).min(axis=-1),
        np.abs(v[..., None] - y[:, 0]).min(axis=-1),
    )
    pixels = cv2.GaussianBlur(60 + 110 * np.clip((away - width / 2) * px + 0.5, 0, 1), (0, 0), 0.8)
    pixels = pixels + np.random.default_rng(0).normal(0, 1, pixels.shape)
    made = design.model_copy(update={"points": points, "polarity": "dark"})
    hidden = measure_reseau(Frame(pixels, 255.0), made).required().shadow(made, pixels.shape)
    middle = y[1:, 0] - 3.6
    column, row = (
        np.rint(c).astype(int)
        for c in np.broadcast_arrays(240 + px * course(x[0], middle[:, None]), 190 - px * middle[:, None])
    )
    assert hidden[row, column].all()
    for side in (-5, 5):  # the wire is 3.2 px wide, and its blur 2 px on either side
        assert not hidden[row, column + side].any()
