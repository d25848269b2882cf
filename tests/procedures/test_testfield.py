"""The testfield procedure: labelled coordinates of each image, and the reason for declined images."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.measure.testfield.measure import TestfieldOptions
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.target_measurement import measured_in_order, measurer_of
from reseau_sims import FieldBench, Station


@pytest.mark.slow
def test_each_image_is_measured_or_declined_by_name() -> None:
    bench, stations = FieldBench(), (Station(30), Station(45, 90))
    empty = Frame(np.tile(np.arange(240, dtype=np.uint8), (240, 1)), 255.0, "empty")
    frames = [bench.record(stations[0]), empty, bench.record(stations[1])]
    measure = measurer_of(bench.design, TestfieldOptions(fill=0.8))
    found = {each.name: each.found for each in measured_in_order(frames, measure)}
    assert list(found) == [stations[0].name, "empty", stations[1].name]
    declined = found.pop("empty")
    assert isinstance(declined, Failure)
    assert (declined.code, declined.where) == (Code.NOT_FOUND, "empty")
    for (name, points), station in zip(found.items(), stations, strict=True):
        assert not isinstance(points, Failure)
        truth = bench.truth(station)
        rows = [truth.names.index(target) for target in points.names]
        assert name == station.name
        assert np.abs(points.xy - truth.xy[rows]).max() < 0.05  # px


def test_an_image_that_cannot_be_measured_does_not_end_the_others() -> None:
    def measure(frame: Frame) -> Failure:
        if frame.name == "dark":
            return Failure("is all black", Code.LOW_CONTRAST, where=frame.name)
        raise np.linalg.LinAlgError

    frames = [Frame(np.zeros((9, 9), np.uint8), 255.0, name) for name in ("dark", "other")]
    found = {each.name: each.found for each in measured_in_order(frames, measure)}
    assert all(isinstance(each, Failure) for each in found.values())
    assert [each.reason[:19] for each in found.values()] == ["is all black", "could not be measur"]


def test_two_images_of_one_name_are_refused() -> None:
    frame = FieldBench().record(Station(30))
    design = FieldBench().design
    with pytest.raises(UsageError, match="two photographs have this name"):
        calibrate_camera([frame, frame], design, measurer_of(design), None, CameraOptions())
