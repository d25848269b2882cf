"""The comparison with the truth: correct numbers, and points identified by their positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from reseau.core.data import Array, ImagePoints
from reseau.report.factors import FACTORS, factor_by_factor, identified
from reseau.report.summary import comparison_table

from .conftest import NOISE_PX, Bench


@dataclass(frozen=True, eq=False)
class Points:
    """Known points."""

    names: tuple[str, ...]
    object_xy: Array
    xy: Array


@pytest.mark.slow
def test_truth_and_group_a_agree_within_the_noise(bench: Bench) -> None:
    camera = bench.truth.camera
    assert camera.position_px == pytest.approx((NOISE_PX, NOISE_PX), rel=0.2)
    assert camera.position_normalised == pytest.approx((1.0, 1.0), rel=0.2)
    stages = [max(stage.check) for stage in camera.stages]
    assert stages == sorted(stages, reverse=True)
    assert stages[-1] < 0.005 < 0.05 < stages[0]  # millimetres
    assert max(camera.approximation) < 0.002


def test_rods_and_points_are_compared_with_their_true_positions(bench: Bench) -> None:
    rods, (body,) = bench.truth.rods, bench.truth.bodies
    assert rods is not None
    assert (rods.rods, rods.known) == (38, 38)
    assert rods.position_px == pytest.approx((NOISE_PX, NOISE_PX), rel=0.35)
    assert rods.made == pytest.approx((0.25, 0.25), rel=0.35)  # what the design says of them
    assert (body.points, body.known, body.strays) == (24, 24, 0)
    assert body.position_px == pytest.approx((NOISE_PX, NOISE_PX), rel=0.4)
    assert all(name == known for name, known in body.identity.items())


def test_each_group_removes_its_part_if_the_rods_have_no_errors(bench: Bench) -> None:
    left = {factor.name: np.hypot(*factor.ideal) for factor in bench.truth.factors if factor.ideal}
    raw, a, b, both, alone = (left[name] for name in FACTORS)
    assert both < 0.25 * min(raw, a, b)
    assert max(a, b) < raw
    assert both < 1.2 * alone


def test_without_the_truth_rods_are_compared_with_their_design(bench: Bench) -> None:
    factors = factor_by_factor(bench.second, bench.world.test_object)
    assert [factor.name for factor in factors] == list(FACTORS)
    assert all(factor.body is None and factor.ideal is None and factor.check is None for factor in factors)
    rods = [factor.rods for factor in factors]
    assert rods == [factor.rods for factor in bench.truth.factors]


def test_stray_points_are_ignored_and_the_nearest_point_is_matched() -> None:
    known = Points(("P", "Q"), np.array([[0.0, 0.0], [10.0, 0.0]]), np.zeros((2, 2)))
    found = np.array([[0.3, 0.0], [0.1, 0.0], [5.0, 40.0], [10.0, 0.5]])
    true = ImagePoints.with_sigma(("1", "2", "3", "4"), found, 0.1)
    assert identified(true, known).tolist() == [-1, 0, -1, 1]


def test_the_text_table_is_narrow_and_contains_the_numbers(bench: Bench) -> None:
    lines = comparison_table(bench.truth).splitlines()
    assert max(map(len, lines)) <= 84
    assert not any(line.endswith(" ") for line in lines)
    last = next(line for line in lines if "groups A and B" in line).split()
    factor = next(factor for factor in bench.truth.factors if factor.name == "groups A and B")
    assert factor.ideal is not None
    assert [float(cell) for cell in last[-2:]] == pytest.approx(factor.ideal, abs=6e-4)
