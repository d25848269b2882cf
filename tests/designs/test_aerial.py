"""Aerial cameras by name: nominal coordinates agree with published calibration reports."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.designs import aerial_camera, aerial_cameras
from reseau.io import FiducialDesign

REPORTS = {
    # USGS R3547, 2010, camera 3298.
    "wild-rc10": {
        "1": (-105.993, -105.996), "2": (106.008, 106.014),
        "3": (-105.988, 106.000), "4": (106.013, -105.996),
        "5": (-109.993, 0.003), "6": (110.008, 0.010),
        "7": (0.003, 110.007), "8": (0.003, -109.987),
    },
    # File of lens 13180; marks 1 to 8 of it are 4, 1, 3, 2, 8, 5, 7, 6 here.
    "wild-rc20": {
        "4": (106.001, -106.001), "1": (-106.001, -106.001),
        "3": (-106.002, 106.003), "2": (106.005, 106.006),
        "8": (0.003, -110.000), "5": (-109.997, -0.001),
        "7": (0.003, 110.001), "6": (110.006, 0.000),
    },
    # USGS R3457, 2009, lens UAg270.
    "wild-rc8-crosses": {
        "1": (-105.982, -105.981), "2": (106.006, 106.024),
        "3": (-106.020, 106.005), "4": (105.995, -105.981),
        "5": (-109.995, 0.012), "6": (109.998, 0.028),
        "7": (-0.005, 110.018), "8": (0.000, -109.986),
    },
    # Carl Zeiss Oberkochen, 1980, RMK A 15/23, 21163.
    "zeiss-rmk-a": {
        "5": (-113.012, -0.031), "6": (112.997, -0.025),
        "7": (-0.002, 112.980), "8": (-0.009, -113.025),
    },
    # USGS OSL/2432, 1998, RMK TOP 30, 144163.
    "zeiss-rmk-top": {
        "1": (-112.996, -112.980), "2": (113.005, 113.013),
        "3": (-112.998, 113.009), "4": (113.001, -112.980),
        "5": (-112.992, 0.010), "6": (113.004, 0.015),
        "7": (0.013, 113.009), "8": (0.006, -112.989),
    },
    # USGS OSL/1551, 1990, camera 271826C, lens Lamegon PI/D 7390036D.
    "jena-lmk-crosses": {
        "1": (-109.997, -110.006), "2": (110.000, 110.000),
        "3": (-110.005, 109.998), "4": (109.999, -110.006),
        "5": (-112.006, -0.002), "6": (111.998, 0.001),
        "7": (0.000, 111.998), "8": (0.004, -112.007),
    },
}  # fmt: skip
DISTANCES = {
    # Of two opposite marks, as these reports print them, mm.
    "wild-rc10": {"12": 299.820, "34": 299.810, "56": 220.000, "78": 219.994},
    "wild-rc8-crosses": {"12": 299.808, "34": 299.814, "56": 219.993, "78": 220.004},
    "zeiss-rmk-top": {"12": 319.607, "34": 319.604, "56": 225.996, "78": 225.998},
    "jena-lmk-crosses": {"12": 311.129, "34": 311.133, "56": 224.004, "78": 224.005},
}


@pytest.mark.parametrize("name", list(REPORTS))
def test_the_coordinates_of_a_report_differ_from_the_nominal_ones_as_their_sigmas_say(name: str) -> None:
    design, found = aerial_camera(name), REPORTS[name]
    assert set(found) == set(design.ids)
    off = np.array([found[key] for key in design.ids]) - design.xy
    off /= design.sigma[:, None]
    assert np.abs(off).max() < 4.0
    assert 0.1 < np.sqrt((off**2).mean()) < 2.0


@pytest.mark.parametrize("name", list(DISTANCES))
def test_opposite_marks_are_as_far_apart_as_reports_print(name: str) -> None:
    design = aerial_camera(name)
    at = dict(zip(design.ids, design.xy, strict=True))
    for (a, b), printed in ((tuple(key), value) for key, value in DISTANCES[name].items()):
        assert np.hypot(*(at[a] - at[b])) == pytest.approx(printed, abs=3 * design.sigma.max())


@pytest.mark.parametrize("name", list(aerial_cameras()))
def test_the_marks_of_a_camera_are_symmetric_and_its_file_comes_back(name: str) -> None:
    design = aerial_camera(name)
    turned = {tuple(at) for at in (design.xy @ [[0.0, 1.0], [-1.0, 0.0]]).round(6) + 0.0}
    assert turned == {tuple(at) for at in design.xy.round(6) + 0.0}
    assert design.source
    assert FiducialDesign.parse(design.to_json(), where=name) == design


def test_a_name_that_is_not_known_is_refused_with_those_that_are() -> None:
    with pytest.raises(UsageError, match="no camera has the name 'wild-rc11'; known are wild-rc8, "):
        aerial_camera("wild-rc11")
