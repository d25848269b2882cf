"""PHOTO II and III from frames of the simulated bench: pins behind the wires of a reseau."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from reseau.designs import standard_reseau
from reseau.refine import measure_reseau
from reseau_sims import World


@pytest.fixture(scope="module")
def world() -> World:
    return World.standard(1)


def test_the_shadow_of_a_reseau_lies_on_its_wires_and_nowhere_else(world):
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
