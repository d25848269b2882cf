"""Control points compared with the shape that the images determine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, Options, adjust_network
from reseau.bundle.diagnostics.control_check import control_shape
from reseau.core.data import Array
from reseau.core.failure import Code

from . import networks
from .networks import seen_from

# Half the side of a plane figure of 49 points, m, and its deflection at the middle of an edge.
HALF, DEFLECTION = 1.0, 0.02


def plane(deflection: Array | float) -> Network:
    """A square of points seen obliquely, held in a plane; the images show it with the deflection given."""
    side = np.linspace(-HALF, HALF, 7)
    flat = np.column_stack([*(part.ravel() for part in np.meshgrid(side, side)), np.zeros(49)])
    angle = 2 * np.pi * np.arange(8) / 8
    centres = np.column_stack([1.8 * np.cos(angle), 1.8 * np.sin(angle), np.full(8, 2.6)])
    network = seen_from(centres, np.zeros((8, 3)), flat + np.outer(deflection * np.ones(49), [0, 0, 1]), 49)
    return replace(network, xyz=flat)


def parabolic() -> Array:
    side = np.linspace(-1.0, 1.0, 7)
    u = np.meshgrid(side, side)[0].ravel()
    return DEFLECTION * u**2


@pytest.mark.slow
@pytest.mark.parametrize("outliers", ["keep", "reject"])
def test_a_bent_figure_that_is_given_as_plane_is_reported_with_its_deflection(outliers: str) -> None:
    found = adjust_network(plane(parabolic()), Options(outliers=outliers))  # type: ignore[arg-type]
    assert found
    said = [remark for remark in found.warnings if remark.code is Code.DOUBTFUL_CONTROL]
    assert "given in a plane, but the images show them bent by 0.02" in said[0].text
    # Points where the plane is bent most are not gross errors.
    assert not found.rejected.any()


def test_neither_a_plane_nor_a_wrong_point_of_it_is_reported_as_bent() -> None:
    for off in (np.zeros(49), np.where(np.arange(49) == 24, DEFLECTION, 0.0)):
        shape = control_shape(plane(off))
        assert shape is not None
        assert shape.bent() == 0.0


def test_points_that_agree_are_found_wherever_the_wrong_ones_stand_in_the_list() -> None:
    world = networks.world(images=8, points=40, control=30)
    xyz = world.network.xyz.copy()
    xyz[0] += 0.5 * np.ptp(world.xyz, axis=0)
    shape = control_shape(replace(world.noisy(1), xyz=xyz))
    assert shape is not None
    assert np.flatnonzero(~shape.agree).tolist() == [0]
    assert shape.doubt() == "control point p0 contradicts the others"
