"""Wires are found whatever the axes of the design's coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.measure.reseau.wires import cover, grid_wires


def crossings(columns, rows, slopes, turn, seed=0):
    """Crossings (rows, columns, 2) of wires with offsets and slopes of their own, in turned axes."""
    rng = np.random.default_rng(seed)
    x, y = 9.4 * np.arange(columns) + rng.normal(0, 0.1, columns), 7.4 * np.arange(rows)
    level, upright = slopes[0] + rng.normal(0, 0.003, rows), slopes[1] + rng.normal(0, 0.003, columns)
    down = (y[:, None] + level[:, None] * x) / (1 - level[:, None] * upright)
    flat = np.stack([x + upright * down, down], axis=-1)
    c, s = np.cos(turn), np.sin(turn)
    return flat @ np.array([[c, s], [-s, c]])


@pytest.mark.parametrize("turn", np.deg2rad([0.0, 1.0, 30.0, 45.0, 91.0, 200.0]))
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.1, -0.1), (-0.05, 0.1)])
def test_every_crossing_lies_on_two_wires_of_its_row_and_column(slopes, turn):
    xy = crossings(11, 9, slopes, turn)
    wires = grid_wires(xy.reshape(-1, 2))
    rows, columns = sorted(wires.marks, key=len)
    assert {frozenset(chain // 11) for chain in rows} == {frozenset([k]) for k in range(9)}
    assert {frozenset(chain % 11) for chain in columns} == {frozenset([k]) for k in range(11)}
    assert all(len(chain) == 11 for chain in rows)
    assert all(len(chain) == 9 for chain in columns)


def test_directions_are_those_of_the_single_wires():
    xy = crossings(7, 5, (0.08, -0.03), 0.3)
    found = grid_wires(xy.reshape(-1, 2)).directions.reshape(5, 7, 2, 2)
    level = (xy[:, -1] - xy[:, 0]) / np.linalg.norm(xy[:, -1] - xy[:, 0], axis=1, keepdims=True)
    assert np.abs(found[..., 0] - level[:, None]).max() < 1e-9
    assert (np.linalg.det(found) > 0.9).all()


def test_missing_crossings_do_not_interrupt_a_wire():
    xy = crossings(9, 8, (0.02, 0.02), 0.1).reshape(-1, 2)
    there = np.random.default_rng(3).random(len(xy)) > 0.12
    wires = grid_wires(xy[there])
    place = np.flatnonzero(there)
    for chain in wires.marks[0]:
        assert len(set(place[chain] // 9)) == 1
    for chain in wires.marks[1]:
        assert len(set(place[chain] % 9)) == 1
    assert sum(map(len, wires.marks[0])) >= there.sum() - 1


@pytest.mark.parametrize("angle", np.deg2rad([0.0, 3.0, 40.0, 50.0, 91.0, 183.0, 270.0]))
def test_a_wire_covers_the_pixels_whose_centres_are_within_its_reach(angle):
    hidden = np.zeros((80, 100), np.uint8)
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    cover(hidden, np.array([50.3, 41.7]) + np.linspace(-150, 150, 30)[:, None] * along, 4.21)
    y, x = np.indices(hidden.shape)
    away = np.abs((x - 50.3) * across[0] + (y - 41.7) * across[1])
    assert ((away < 4.21) == (hidden > 0)).all()
