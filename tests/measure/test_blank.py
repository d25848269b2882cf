"""A frame in which nothing can be seen is a failure of every measurement, not an exception."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import reseau
from reseau.core.data import Frame
from reseau.core.failure import Code, Failure
from reseau.designs import board, coded_testfield, regular_reseau
from reseau.io import Mark
from reseau.measure import find_pins
from reseau.measure.blurred import BlurredOptions, measure_blurred
from reseau.measure.boards.single_tags import measure_tags
from reseau.optics.formation import Outline
from reseau.optics.lenses import ThinLens
from reseau.optics.lenses.images import PlaneTarget
from reseau.optics.lenses.ray_maps import SensorPlane

GREY = Frame(np.full((240, 320), 128, np.uint8), 255.0, "grey")
RODS = regular_reseau(4, 2, 10.0, Mark(shape="rod", size=1.0), polarity="bright")
CROSSES = regular_reseau(4, 3, 10.0, Mark(shape="cross", size=3.0, line_width=0.5))
DISKS = (PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(2.0, 0.05)),)
CAMERA = ThinLens(50.0, 12.5, 52.9, SensorPlane((0.01, 0.01), (160.0, 120.0)))


@pytest.mark.parametrize(
    "measure",
    [
        lambda: reseau.measure(GREY, board("chess", 7, 6, 26.0)),
        lambda: reseau.measure(GREY, coded_testfield()),
        lambda: reseau.measure(GREY, CROSSES),
        lambda: reseau.measure(GREY, RODS),
        lambda: find_pins(GREY),
        lambda: reseau.calibrate([GREY]),
    ],
    ids=["board", "testfield", "reseau", "rods", "pins", "calibrate"],
)
def test_one_grey_is_a_failure_that_says_what_to_do(measure: Callable[[], Any]) -> None:
    found = measure()
    assert isinstance(found, Failure)
    assert found.code in (Code.LOW_CONTRAST, Code.NOT_FOUND)


def test_tags_and_blurred_targets_say_it_too() -> None:
    assert not measure_tags(GREY, "DICT_4X4_50")
    found = measure_blurred(GREY, CAMERA, ["1"], DISKS, BlurredOptions())
    assert found.why == ("is all of one grey; check exposure and shutter",)
