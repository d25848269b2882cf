"""The lattice of a testfield: where its lines are, and the mapping through its targets."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.measure import measure_testfield
from reseau.measure.plane.lattice_mapping import second_order, slope_of
from reseau.measure.plane.polynomial import refit
from reseau.measure.testfield.lattice import LatticeFit
from reseau.measure.testfield.measure import TestfieldOptions
from reseau_sims import FieldBench, Station

from ..montecarlo import slowly


def fitted(bench: FieldBench, station: Station) -> LatticeFit:
    found = measure_testfield(bench.record(station), bench.design, TestfieldOptions(fill=0.8))
    assert found, found.reason
    return found.lattice


def off_the_lines(bench: FieldBench, station: Station, fit: LatticeFit) -> Array:
    """Distances in the plane of the board (mm) of the fitted lines from the nearest true ones."""
    i, j = np.meshgrid(fit.across, np.linspace(fit.along.min(), fit.along.max(), 41))
    j2, i2 = np.meshgrid(fit.along, np.linspace(fit.across.min(), fit.across.max(), 41))
    found = []
    truth = bench.truth(station)
    for at in (np.stack([i.ravel(), j.ravel()], 1), np.stack([i2.ravel(), j2.ravel()], 1)):
        xy = fit.mapping(at.astype(float))
        xy = xy[((xy > 0) & (xy < 239)).all(axis=1)]
        board = bench.design.xy[np.hypot(*(xy[:, None] - truth.xy).transpose(2, 0, 1)).argmin(axis=1)]
        for _ in range(6):
            seen, slope = truth.view(board)
            board = board + np.linalg.solve(slope, (xy - seen)[..., None])[..., 0]
        found.append(np.abs(board - 125 * np.rint(board / 125)).min(axis=1))
    return np.concatenate(found)


@pytest.mark.parametrize("station", [*slowly((Station(0),), (Station(30, 90),)), Station(45, 180, 37)])
def test_lines_are_where_the_targets_say_to_a_hundredth_of_a_pixel(station: Station) -> None:
    bench = FieldBench(seed=2)
    fit = fitted(bench, station)
    off = off_the_lines(bench, station, fit)
    # A pixel sees 2.35 mm of the board.
    assert np.sqrt((off**2).mean()) / 2.35 < 0.02
    assert min(len(fit.across), len(fit.along)) >= 5


def test_the_lattice_is_right_handed() -> None:
    bench = FieldBench()
    for station in (Station(0), Station(30, 90, 180)):
        fit = fitted(bench, station)
        slope = second_order(fit.mapping, np.array([[fit.across.mean(), fit.along.mean()]]))[1]
        assert np.linalg.det(slope)[0] < 0


def test_second_order_is_the_derivative_of_the_mapping() -> None:
    fit = fitted(FieldBench().distorted(10), Station(30))
    at = np.array([[1.3, 2.1], [2.7, 0.6]])
    value, slope, bend = second_order(fit.mapping, at)
    step = np.array([[0.05, -0.03]])
    expected = value + slope @ step[0] + 0.5 * np.einsum("kabc,b,c->ka", bend, step[0], step[0])
    np.testing.assert_allclose(fit.mapping(at + step), expected, rtol=0, atol=2e-3)  # px; the third order
    analytic = fit.mapping.derivatives(at).d_xy
    np.testing.assert_allclose(slope, analytic, rtol=0, atol=1e-9)
    np.testing.assert_allclose(value, fit.mapping(at), rtol=0, atol=1e-9)
    h = 1e-4
    for axis in (0, 1):
        forwards, backwards = (slope_of(fit.mapping, at + sign * h * np.eye(2)[axis]) for sign in (1, -1))
        np.testing.assert_allclose(bend[..., axis], (forwards - backwards) / (2 * h), rtol=0, atol=1e-5)


def test_a_mapping_passes_through_its_points() -> None:
    bench, station = FieldBench(), Station(45)
    fit = fitted(bench, station)
    at = np.random.default_rng(0).uniform(-1, 2, (60, 2))
    moved = fit.mapping(at) + 0.02 * np.sin(at)
    again = refit(fit.mapping, at, moved, 0.01)
    np.testing.assert_allclose(again(at), moved, rtol=0, atol=0.003)


def test_a_mapping_follows_a_region_that_deviates_and_not_single_points() -> None:
    fit = fitted(FieldBench(seed=5), Station(30))
    at = np.stack(np.meshgrid(np.linspace(-2, 2, 25), np.linspace(-2, 2, 25)), axis=-1).reshape(-1, 2)
    # Towards one corner, points deviate by up to 2 px; single points anywhere by 1 px.
    corner = np.clip(at / 2, 0, None).prod(axis=1)
    true = fit.mapping(at) + 2.0 * corner[:, None] ** 2 * [1.0, -0.5]
    rng = np.random.default_rng(3)
    seen = true + rng.normal(0, 0.01, true.shape)
    seen[rng.choice(len(at), 20, replace=False)] += 1.0
    again = refit(fit.mapping, at, seen, 0.03)
    off = np.abs(again(at) - true)
    assert off[corner > 0.5].max() < 0.15
    assert np.median(off) < 0.02
