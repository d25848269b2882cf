"""The calibration file: consistent, round trip, clock times apart."""

from __future__ import annotations

import json

import numpy as np
import pytest

from reseau.calibration import Calibration
from reseau.calibration.document import Covariance, Quantity
from reseau.core.errors import FormatError


def calibration(**changes: object) -> Calibration:
    content = {
        "kind": "oscilloscope",
        "name": "c",
        "model": {
            "name": "oscilloscope group A",
            "unit": "mm",
            "mapping": {},
            "photo_system": {},
            "object_system": {},
        },
        "parameters": {
            "a": Quantity(value=1.0, sigma=0.1, unit="1"),
            "b": Quantity(value=2.0, sigma=0.0, unit="mm"),
            "c": Quantity(value=0.1 + 0.2, sigma=0.3, unit="mm^-1"),
        },
        "covariance": Covariance(names=("c", "a"), matrix=((0.09, 0.01), (0.01, 0.01))),
        "sigma0": 1.1,
        "redundancy": 12,
    }
    return Calibration(**(content | changes))  # type: ignore[arg-type]


def test_a_calibration_is_read_back_unchanged() -> None:
    first = calibration(times={"computed": "2024-01-01T00:00:00+00:00"})
    again = Calibration.parse(first.to_json(), where="c.json")
    assert again == first
    assert again.values()["c"] == 0.1 + 0.2  # to the last bit


def test_the_matrix_is_in_the_order_of_the_parameters_with_zeros_for_held_ones() -> None:
    np.testing.assert_array_equal(
        calibration().matrix(), [[0.01, 0.0, 0.01], [0.0, 0.0, 0.0], [0.01, 0.0, 0.09]]
    )


def test_clock_times_are_separate_from_other_content() -> None:
    one = json.loads(calibration(times={"computed": "then"}).to_json())
    other = json.loads(calibration(times={"computed": "now"}).to_json())
    assert one.pop("times") != other.pop("times")
    assert one == other


@pytest.mark.parametrize(
    ("covariance", "complaint"),
    [
        ({"names": ["a"], "matrix": [[1.0, 2.0]]}, "1 names but no 1×1 matrix"),
        ({"names": ["a", "q"], "matrix": [[1.0, 0.0], [0.0, 1.0]]}, "names 'q'"),
    ],
)
def test_a_covariance_of_the_wrong_size_is_refused(covariance: dict[str, object], complaint: str) -> None:
    content = json.loads(calibration().to_json()) | {"covariance": covariance}
    with pytest.raises(FormatError, match=complaint):
        Calibration.parse(json.dumps(content), where="c.json")


def test_the_verdict_of_an_earlier_version_is_read_from_the_validity() -> None:
    content = json.loads(calibration().to_json())
    content["validity"]["assessment"] = {
        "use": "nothing", "lines": ["not usable: …"], "centre_px": 0.157, "corners_px": 49.8,
        "fits": False, "misfit_px": 0.027, "uncovered": [],
    }  # fmt: skip
    found = Calibration.parse(json.dumps(content), where="c.json")
    assert found.assessment is not None
    assert found.assessment.short == "not usable: 0.16 px at the centre, 50 px in the corners"
    assert "assessment" not in found.validity
    assert Calibration.parse(found.to_json(), where="c.json") == found
