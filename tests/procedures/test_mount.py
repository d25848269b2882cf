"""The mount of a turntable from adjusted poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reseau.capture import paper_steps
from reseau.core.failure import Code, Failure
from reseau.optics.poses import rotation_matrix
from reseau.procedures.testfield import Mount

POSITIONS = [step.position | {"z": 10.0 * (k % 3)} for k, step in enumerate(paper_steps())]


@pytest.mark.slow
@given(
    about=st.sampled_from([0, 1]),
    signs=st.tuples(*[st.sampled_from([1.0, -1.0])] * 3),
    lifts=st.sampled_from([1.0, -1.0]),
    seed=st.integers(0, 99),
    count=st.integers(12, 36),
)
@settings(deadline=None, max_examples=30)
def test_poses_of_any_mount_are_predicted(
    about: int, signs: tuple[float, float, float], lifts: float, seed: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    looks = rotation_matrix(np.array([np.pi, 0, 0]) + rng.normal(0, 0.02, 3))
    true = Mount(about, signs, lifts, looks, np.array([*rng.normal(0, 5, 2), 5000.0]), 0.0)
    rows = rng.permutation(len(POSITIONS))[:count]
    poses = [true.pose(POSITIONS[k]) for k in rows]
    noise = [rotation_matrix(rng.normal(0, 1e-3, 3)) for _ in rows]
    rotations = np.array([n @ pose.matrix for n, pose in zip(noise, poses, strict=True)])
    found = Mount.of([POSITIONS[k] for k in rows], rotations, np.array([pose.x0 for pose in poses]))
    assert not isinstance(found, Failure)
    assert found.off_deg < 0.3
    for position in POSITIONS:
        pose, expected = found.pose(position), true.pose(position)
        assert np.degrees(np.arccos((np.trace(pose.matrix @ expected.matrix.T) - 1) / 2)) < 0.3
        assert np.abs(pose.x0 - expected.x0).max() < 1e-6


def test_axes_that_do_not_match_the_mount_are_refused() -> None:
    rng = np.random.default_rng(1)
    rotations = np.array([rotation_matrix(rng.normal(0, 1, 3)) for _ in POSITIONS])
    found = Mount.of(POSITIONS, rotations, np.zeros((len(POSITIONS), 3)))
    assert isinstance(found, Failure)
    assert found.code == Code.INCONSISTENT


@pytest.mark.parametrize("missing", ["tilt", "roll"])
def test_an_axis_that_did_not_move_is_harmless(missing: str) -> None:
    true = Mount(1, (1.0, 1.0, -1.0), 1.0, np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 900.0]), 0.0)
    positions = [{axis: v for axis, v in p.items() if axis != missing} for p in POSITIONS]
    poses = [true.pose(position) for position in positions]
    found = Mount.of(positions, np.array([p.matrix for p in poses]), np.array([p.x0 for p in poses]))
    assert not isinstance(found, Failure)
    assert found.off_deg < 1e-4
