"""A camera calibrated with any function that measures a frame."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.measure.points import Measured
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CameraOptions
from reseau_sims import FieldBench, Station

BENCH = FieldBench(seed=8, bend_mm=0.0)
STATIONS = {s.name: s for s in (Station(45), Station(45, 90, 90), Station(45, 180, 180), Station(30, 270))}
SIGMA = 0.005


def blank(name: str) -> Frame:
    return Frame(np.zeros((240, 240), dtype=np.uint8), 255.0, name, "0")


def measure(frame: Frame) -> Measured | Failure:
    """The true positions of the large targets with noise, or nothing."""
    if frame.name not in STATIONS:
        return Failure("no target", Code.NOT_FOUND, where=frame.name)
    truth = BENCH.truth(STATIONS[frame.name])
    rng = np.random.default_rng(len(frame.name))
    n, ok = len(truth.names), BENCH.inside(truth, 8.0) & BENCH.design.large
    xy = truth.xy + SIGMA * rng.normal(size=(n, 2))
    nothing = np.full(n, np.nan)
    return Measured(
        frame.name, "0", truth.names, xy, np.tile(np.eye(2) * SIGMA**2, (n, 1, 1)), ok, ("",) * n, xy, 0 * xy,
        nothing, nothing, nothing,
    )  # fmt: skip


@pytest.mark.slow
def test_any_function_that_measures_a_frame_is_accepted() -> None:
    frames = [blank(name) for name in (*STATIONS, "empty")]
    model = CameraOptions("brown", ("c",), (0.027, 0.027))
    found = calibrate_camera(frames, BENCH.design, measure, model=model)
    assert isinstance(found, Calibrated)
    assert found.declined == {"empty": "no target"}
    _, _, (c,) = found.result.camera_columns(0)
    assert abs(c - 57.5) < 4 * np.sqrt(found.result.camera_covariance(0)[0, 0])


def test_photographs_of_one_name_are_refused() -> None:
    twice = [blank(next(iter(STATIONS)))] * 2
    with pytest.raises(UsageError, match="two photographs have this name"):
        calibrate_camera(twice, BENCH.design, measure)


def test_photographs_of_another_size_or_that_cannot_be_read_do_not_end_the_others() -> None:
    last = list(STATIONS)[-1]
    small = Frame(np.zeros((120, 240), dtype=np.uint8), 255.0, last, "0")
    lost = ("lost", Failure("is a truncated image", Code.DECLINED, where="lost"))
    frames = [small, lost, *(blank(name) for name in list(STATIONS)[:-1])]
    model = CameraOptions(pitch_mm=(0.027, 0.027), free=("c",))
    found = calibrate_camera(frames, BENCH.design, measure, model=model)
    assert isinstance(found, Calibrated)
    assert found.declined == {"lost": "is a truncated image", last: "is 240×120 pixels, not 240×240"}
    assert len(found.measured) == 3
