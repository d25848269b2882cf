"""The procedure of the testfield: labelled coordinates recording by recording, and what was declined."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.errors import UsageError
from reseau.measure import TestfieldOptions
from reseau.procedures.testfield import measure_recordings
from reseau_sims import FieldBench, Station


def test_every_recording_is_measured_or_declined_by_its_name() -> None:
    bench, stations = FieldBench(), (Station(30), Station(45, 90))
    empty = Frame(np.tile(np.arange(240, dtype=np.uint8), (240, 1)), 255.0, "empty")
    found = measure_recordings(
        [bench.record(stations[0]), empty, bench.record(stations[1])],
        bench.design,
        TestfieldOptions(fill=0.8),
    )
    assert list(found.measured) == [station.name for station in stations]
    assert found.declined == {"empty": "empty: no straight lines were found"}
    for (name, points), station in zip(found.points(), stations, strict=True):
        truth = bench.truth(station)
        rows = [truth.names.index(target) for target in points.names]
        assert name == station.name
        assert np.abs(points.xy - truth.xy[rows]).max() < 0.05  # px


def test_two_recordings_of_one_name_are_refused() -> None:
    frame = FieldBench().record(Station(30))
    with pytest.raises(UsageError, match="name of two recordings"):
        measure_recordings([frame, frame], FieldBench().design)
