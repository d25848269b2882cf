"""Turntables: their axis and angles as unknowns, and what is said of angles that are wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reseau.bundle import Network, Options, Result, ResultDocument, adjust_network, problem_of
from reseau.bundle.diagnostics.estimates import StageEstimate
from reseau.bundle.network.settings import network_document
from reseau.bundle.network.stage import Stage, perpendicular
from reseau.bundle.solver.constraints import Constraints, Placed
from reseau.bundle.solver.unknowns import Unknowns
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.optics.poses import matrix_to_vector, rotation_matrix

from ..montecarlo import slowly
from .turntables import AXIS, POINT, Table, turned

STEPS_DEG = (0, 40, 100, 150, 220, 300)


def adjusted(network: Network, outliers: Any = "keep") -> tuple[Result, StageEstimate]:
    result = adjust_network(network, Options(outliers=outliers)).required()
    assert result.stage is not None
    return result, result.stage


def axis_errors(result: Result, found: StageEstimate) -> tuple[Array, Array]:
    """Errors (4,) of direction and position across the axis, and their covariance."""
    across = perpendicular(found.direction)
    true = POINT + AXIS * (AXIS @ (result.points.xyz.mean(axis=0) - POINT))
    both = np.block([[across, np.zeros((3, 2))], [np.zeros((3, 2)), across]])
    errors = np.concatenate([AXIS - found.direction, true - found.position])
    return both.T @ errors, both.T @ found.cov @ both


def stage_of(network: Network) -> Stage:
    assert network.stage is not None
    return network.stage


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("kind", ["rotary", "linear"])
@pytest.mark.parametrize("carries", ["object", "camera"])
def test_derivatives_are_those_of_differences(cameras: int, kind: Any, carries: Any) -> None:
    network = turned(cameras=cameras, angles_deg=(0, 50, 200), sigma=0.01, control=True, noise=0.0).network
    stage = replace(stage_of(network), axis=AXIS, kind=kind, carries=carries)
    network = replace(network, stage=stage)
    unknowns = Unknowns.of(network, np.ones(len(network.images), dtype=bool))
    constraints = Constraints.of(unknowns)
    assert constraints is not None
    rotation = rotation_matrix(network.rotation)
    places = None
    if network.rig is not None:
        places, _, _ = network.rig.approximate(rotation, network.x0)
    moved, rotation, x0 = stage.approximate(rotation, network.x0, network.camera_of)
    if network.rig is not None:
        places, rotation, x0 = network.rig.approximate(rotation, x0)
    at = Placed(rotation, x0, places, moved)
    t = constraints.matrix(at)
    rows = unknowns.pose[:, None] + np.arange(6)
    for column in range(constraints.size):
        q = np.zeros(constraints.size)
        q[column] = 1e-6
        ahead, back = constraints.stepped(at, q), constraints.stepped(at, -q)
        turn = matrix_to_vector(ahead.rotation @ np.swapaxes(back.rotation, 1, 2))
        numeric = np.concatenate([turn, ahead.x0 - back.x0], axis=1) / 2e-6
        if not np.abs(t[rows, column]).max() and not np.abs(numeric).max():
            continue  # of a camera or a point
        assert np.abs(t[rows, column] - numeric).max() < 2e-6 * max(1.0, np.abs(numeric).max())


@pytest.mark.parametrize("cameras", [1, 2])
def test_derivatives_of_an_observed_axis_are_those_of_differences(cameras: int) -> None:
    network = turned(cameras=cameras, sigma=0.01, angles_deg=STEPS_DEG, control=True).network
    axis, point = AXIS + np.array([0.02, 0.01, 0.0]), POINT + 5 * AXIS + np.array([0.5, 0.0, 0.0])
    stage = replace(stage_of(network), axis=axis, axis_sigma=0.03, point=point, point_sigma=1.0)
    fit = problem_of(replace(network, stage=stage))[0].adjusted()
    assert not isinstance(fit, Failure)
    linear, constraints = fit.linear, fit.linear.system.constraints
    assert constraints is not None
    others, slopes = linear.system.others, linear.constraint_slopes
    assert len(slopes) == len(STEPS_DEG) * 2 + 4
    for column in range(constraints.size - 4, constraints.size):
        q = np.zeros(constraints.size)
        q[column] = 1e-6
        one, other = (
            others.computed(
                replace(linear.values, stage=constraints.stepped(linear.values.placed, step).stage)
            )
            for step in (q, -q)
        )
        numeric = ((one - other) / 2e-6 * linear.system.sigma_root)[others.readings.start :]
        assert np.abs(slopes[:, column] - numeric).max() < 1e-5 * np.abs(slopes[:, column]).max()


@pytest.mark.parametrize(
    ("sigma", "cameras", "more"),
    [(0.0, 1, 6 * 12 - 12 - 4), (0.002, 1, 6 * 12 - 12 - 4), (None, 1, 6 * 12 - 12 - 4 - 10),
     (0.002, 2, 6 * 12 - 12 - 4)],
)  # fmt: skip
@pytest.mark.parametrize("datum", ["control", "free", "minimal"])
def test_the_axis_replaces_orientations(sigma: float | None, cameras: int, more: int, datum: Any) -> None:
    drawn = turned(sigma=sigma, cameras=cameras, angles_deg=STEPS_DEG, control=datum == "control")
    network = replace(drawn.network, datum=datum)
    result, found = adjusted(network)
    free = adjust_network(replace(network, stage=None)).required()
    assert result.redundancy == free.redundancy + more
    assert result.sigma0 == pytest.approx(1.0, abs=0.1)
    if datum != "minimal":
        errors, cov = axis_errors(result, found)
        assert errors @ np.linalg.solve(cov, errors) < 30
    turn = result.fit.values.rotation
    # The rotations of all images of a camera are about one axis.
    about = matrix_to_vector(np.swapaxes(turn[0:1], 1, 2) @ turn[cameras : 6 * cameras : cameras])
    assert np.abs(np.cross(about, found.direction)).max() < 1e-9


def test_all_datums_give_the_same_shape_and_angles() -> None:
    drawn = turned(sigma=0.002, angles_deg=STEPS_DEG)
    (one, axis), (other, second) = (
        adjusted(replace(drawn.network, datum=datum)) for datum in ("free", "minimal")
    )
    assert one.sigma0 == pytest.approx(other.sigma0, rel=1e-9)
    assert np.abs(axis.reading - second.reading).max() < 1e-8
    assert np.abs(axis.reading_sigma - second.reading_sigma).max() < 1e-6
    span = [np.linalg.norm(each.points.xyz[3] - each.points.xyz[9]) for each in (one, other)]
    assert span[0] == pytest.approx(span[1], abs=1e-6)


@pytest.mark.parametrize(
    "how",
    [
        {},
        *slowly(*({"control": True} | more for more in ({}, {"sigma": None}, {"cameras": 2}))),
    ],
)
def test_the_axis_is_found_from_images_without_poses(how: dict[str, Any]) -> None:
    warm, cold = (adjusted(turned(cold=cold, **how).network)[0] for cold in (False, True))
    assert warm.sigma0 == pytest.approx(cold.sigma0, rel=1e-6)
    assert warm.redundancy == cold.redundancy


@pytest.mark.parametrize("carries", ["object", "camera"])
def test_angles_increase_about_the_axis_whatever_the_table_carries(carries: str) -> None:
    result, found = adjusted(turned(carries=carries, control=True).network)
    errors, cov = axis_errors(result, found)
    assert errors @ np.linalg.solve(cov, errors) < 30


def test_a_known_axis_is_held_and_an_observed_one_is_improved() -> None:
    network = turned(control=True, angles_deg=STEPS_DEG).network
    stage = stage_of(network)
    held = replace(stage, axis=AXIS, axis_sigma=0.0, point=POINT, point_sigma=0.0)
    weak = replace(stage, axis=AXIS, axis_sigma=1e-4, point=POINT + 3 * AXIS, point_sigma=1e-2)
    (known, fixed), (_, both), (plain, free) = (
        adjusted(replace(network, stage=each)) for each in (held, weak, stage)
    )
    assert known.redundancy == plain.redundancy + 4
    assert fixed.direction_sigma == fixed.position_sigma == 0.0
    assert np.abs(fixed.direction - AXIS).max() < 1e-15
    assert both.direction_sigma < min(free.direction_sigma, 1e-4 * known.sigma0)
    assert both.position_sigma < min(free.position_sigma, 1.02e-2)


@pytest.mark.parametrize("angles", [(0.0,), (0.0, 360.0)])
def test_without_two_angles_the_axis_is_not_determined(angles: tuple[float, ...]) -> None:
    failure = adjust_network(turned(angles_deg=angles).network)
    assert isinstance(failure, Failure)
    assert failure.code is Code.RANK_DEFECT
    assert "rank defect 4: direction of the axis and position of the axis" in failure.reason
    assert "no pose has images at two different angles" in failure.reason


def test_with_two_angles_the_axis_is_determined_whether_they_are_known_or_not() -> None:
    for sigma, more in ((0.0, 2), (None, 1)):
        network = turned(angles_deg=(0, 90), setups=1, sigma=sigma).network
        result, found = adjusted(network)
        assert result.redundancy == adjust_network(replace(network, stage=None)).required().redundancy + more
        errors, cov = axis_errors(result, found)
        assert errors @ np.linalg.solve(cov, errors) < 30


def test_a_held_axis_needs_one_angle_only() -> None:
    network = turned(angles_deg=(0.0,), control=True).network
    held = replace(stage_of(network), axis=AXIS, axis_sigma=0.0, point=POINT, point_sigma=0.0)
    assert adjust_network(replace(network, stage=held)).required().sigma0 == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (np.radians, "in radians where degrees are expected"),
        (np.degrees, "in degrees where radians are expected"),
        (lambda angle: angle / 0.9, "in gon where degrees are expected"),
        (lambda angle: angle[::-1] * np.arange(len(angle)), "are the angles in the order of the images?"),
        (lambda angle: np.concatenate([angle[:6], -angle[6:]]), "increase in the opposite sense to"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("outliers", ["keep", "reject"])
def test_angles_in_another_unit_sense_or_order_are_refused(change: Any, said: str, outliers: Any) -> None:
    network = turned(angles_deg=STEPS_DEG, cold=outliers == "reject").network
    stage = stage_of(network)
    failure = adjust_network(
        replace(network, stage=replace(stage, reading=change(stage.reading))), Options(outliers=outliers)
    )
    assert isinstance(failure, Failure)
    assert failure.code is Code.READINGS
    assert said in failure.reason


@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_a_turntable_that_turns_the_other_way_about_a_given_axis_is_refused(sigma: float) -> None:
    network = turned(angles_deg=STEPS_DEG, control=True).network
    stage = replace(stage_of(network), axis=AXIS, axis_sigma=sigma, reading=-stage_of(network).reading)
    failure = adjust_network(replace(network, stage=stage))
    assert isinstance(failure, Failure)
    assert failure.code is Code.READINGS
    assert "turns about the given axis in the opposite sense" in failure.reason


def test_the_sense_about_an_approximate_axis_is_reported() -> None:
    network = turned(angles_deg=STEPS_DEG).network
    result, found = adjusted(replace(network, stage=replace(stage_of(network), axis=-AXIS)))
    assert found.direction @ AXIS > 0.99
    assert any("in the opposite sense" in str(warning) for warning in result.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_wrong_angle_is_named_and_estimated_where_outliers_are_rejected(cameras: int) -> None:
    network = turned(cameras=cameras, cold=True).network
    stage = stage_of(network)
    wrong = replace(stage, reading=stage.reading + np.where(network.same_reading == 4, 0.2, 0.0))
    kept, _ = adjusted(replace(network, stage=wrong))
    said = f"the angle of the turntable is wrong in image 0-{4 // cameras}-0 (11 deg)"
    assert str(kept.warnings[0]).startswith(said)
    result, found = adjusted(replace(network, stage=wrong), "reject")
    assert result.sigma0 == pytest.approx(1.0, abs=0.1)
    assert found.reading[4] == pytest.approx(stage.reading[4], abs=5 * found.reading_sigma[4])


def test_a_turntable_is_part_of_the_documents() -> None:
    network = turned(sigma=0.002, cameras=2, control=True, angles_deg=STEPS_DEG).network
    stage = replace(stage_of(network), axis=AXIS, axis_sigma=0.01, point=POINT, point_sigma=0.5)
    network = replace(network, stage=stage)
    again = Network.from_document(network_document(network))
    for name in ("pose", "reading", "sigmas", "axis", "point"):
        assert np.abs(getattr(again.stage, name) - getattr(stage, name)).max() < 1e-14
    result, found = adjusted(again)
    entry = ResultDocument.of(result).to_dict()["turntable"]
    assert np.abs(np.radians(entry["angle_deg"]) - found.reading).max() < 1e-12
    assert entry["direction_sigma_deg"] == pytest.approx(np.degrees(found.direction_sigma))
    assert len(entry["covariance"]) == 6


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"axis": AXIS, "axis_sigma": 0.1}, "requires the datum `control`"),
        ({"axis_sigma": 0.1}, "has a standard deviation, but is not given"),
        ({"kind": "linear"}, "requires a direction"),
        ({"sigma": -1.0}, "must be 0, above 0, or NaN"),
        ({"pose": np.full(12, -1)}, "requires an image"),
    ],
)
def test_stages_that_are_none_are_refused(change: dict[str, Any], said: str) -> None:
    network = turned(angles_deg=STEPS_DEG).network
    with pytest.raises(UsageError, match=said):
        replace(network, stage=replace(stage_of(network), **change))


def test_images_of_an_exposure_have_one_angle() -> None:
    network = turned(cameras=2, angles_deg=STEPS_DEG).network
    stage = stage_of(network)
    with pytest.raises(UsageError, match="images 0-0-0 and 0-0-1 were taken at once"):
        replace(network, stage=replace(stage, reading=np.arange(len(stage.reading)) * 0.1))


def _normalised(drawn: Table) -> tuple[list[float], list[float]]:
    result, found = adjusted(drawn.network)
    errors, cov = axis_errors(result, found)
    free = found.reading_sigma > 0
    angles = (found.reading - drawn.angle)[free] / found.reading_sigma[free]
    return [float(errors @ np.linalg.solve(cov, errors) / 4)], list(angles**2)


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize(("sigma", "cameras"), [(0.0, 1), (0.002, 1), (None, 1), (0.002, 2)])
@pytest.mark.parametrize(("seeds", "tolerance"), [(10, 0.5), pytest.param(400, 0.05, marks=pytest.mark.slow)])
def test_errors_of_axis_and_angles_have_their_covariances(
    control: bool, sigma: float | None, cameras: int, seeds: int, tolerance: float
) -> None:
    axis, angles = list[float](), list[float]()
    for seed in range(seeds):
        drawn = turned(seed, sigma=sigma, cameras=cameras, control=control, angles_deg=STEPS_DEG, setups=1)
        one, other = _normalised(drawn)
        axis += one
        angles += other
    # 4 errors of each axis: 400 seeds give a root mean square of 1 ± 0.018.
    assert np.sqrt(np.mean(axis)) == pytest.approx(1.0, abs=tolerance)
    assert not angles or np.sqrt(np.mean(angles)) == pytest.approx(1.0, abs=tolerance)
