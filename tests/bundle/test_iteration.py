"""Steps of the iteration."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.adjust import Options
from reseau.bundle.solver.implicit import normal_of
from reseau.bundle.solver.linear import Linear, linearised
from reseau.bundle.solver.problem import _Run

from . import networks

CAMERAS = {
    "one": (networks.camera(),),
    "several": (networks.camera(), networks.camera("opencv")),
    "correlated": (
        networks.camera("opencv-8", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "k5", "k6")),
    ),
    "of images": (networks.with_ebner("image"),),
    "observed": (networks.camera(sigma={"c": 0.01, "K1": 1e-4}),),
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_a_correction_for_other_misfits_is_that_of_new_normal_equations(kind: str) -> None:
    """Of second-order steps: with the factors of the first, for the curvature of the misfits."""
    world = networks.world(images=8, points=60, cameras=CAMERAS[kind], control=12)
    run = _Run(world.problem(), Options())
    linear, rng = linearised(run.system, run.start()), np.random.default_rng(1)
    other = rng.normal(size=linear.misfits.shape), rng.normal(size=linear.other_misfits.shape)
    normal = normal_of(linear, 1e-4)
    normal.correction()
    found = normal.correction_for(*other)
    expected = normal_of(Linear(run.system, linear.values, linear.rows, *other), 1e-4).correction()
    size = np.abs(expected.reduced).max()
    assert np.abs(found.reduced - expected.reduced).max() < 1e-8 * size
    assert np.abs(found.points - expected.points).max() < 1e-8 * np.abs(expected.points).max()
    assert found.length == pytest.approx(expected.length, rel=1e-8)
