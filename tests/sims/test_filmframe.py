"""Simulated scans of film frames: edges are at their true positions despite disturbances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.core.data import Array
from reseau_sims.filmframe import HASSELBLAD, RICOH, Beside, FilmFrame

QUIET = FilmFrame(7, noise=0.0, grain=0.0, bow_mm=0.0)


def crossing(light: Array, column: int, row: float, reach: int = 4) -> float:
    """Where a column passes half way from the film above an edge to the picture below."""
    rows = np.arange(int(row) - reach, int(row) + reach + 1)
    grey = light[rows, column]
    half = (grey[:2].mean() + grey[-2:].mean()) / 2
    k = int(np.argmax(grey > half))
    return float(rows[k - 1] + (half - grey[k - 1]) / (grey[k] - grey[k - 1]))


@pytest.mark.parametrize("tilt", [0.0, 0.7, -12.0])
def test_the_upper_edge_lies_on_the_chord_between_its_true_corners(tilt: float) -> None:
    frame = replace(QUIET, tilt_deg=tilt)
    light, (ul, ur) = frame.light(), frame.truth.corners[:2]
    columns = np.linspace(ul[0] + 60, ur[0] - 60, 80).astype(int)
    chord = ul[1] + (columns - ul[0]) * (ur[1] - ul[1]) / (ur[0] - ul[0])
    off = [crossing(light, c, row) - row for c, row in zip(columns, chord, strict=True)]
    # The picture's own slope moves the crossing, either way; its median does not go with it.
    assert abs(np.median(off)) < 0.05


def test_a_bowed_edge_deviates_by_its_sagitta_in_the_middle() -> None:
    frame = replace(QUIET, bow_mm=0.12, seed=3)
    straight, bowed = replace(frame, bow_mm=0.0).light(), frame.light()
    ul, ur = frame.truth.corners[:2]
    middle = (ul + ur) / 2
    columns = np.arange(int(middle[0]) - 30, int(middle[0]) + 30)
    rows = ul[1] + (columns - ul[0]) * (ur[1] - ul[1]) / (ur[0] - ul[0])
    moved = np.median(
        [crossing(straight, c, r) - crossing(bowed, c, r) for c, r in zip(columns, rows, strict=True)]
    )
    assert moved == pytest.approx(frame.bows_px[0], abs=0.1)


def test_corners_are_named_as_seen_also_in_mirrored_scans() -> None:
    for mirrored in (False, True):
        ul, ur, lr, ll = replace(QUIET, mirrored=mirrored, tilt_deg=5.0).truth.corners
        assert ul[0] < ur[0]
        assert ll[0] < lr[0]
        assert ul[1] < ll[1]
        assert ur[1] < lr[1]


def test_a_cropped_scan_lacks_exactly_one_edge() -> None:
    for tilt in (0.5, 8.0):
        frame = replace(QUIET, crop="right", tilt_deg=tilt)
        corners, (h, w) = frame.truth.corners, frame.shape
        assert (corners[[1, 2], 0] > w - 1).all()
        assert (corners[[0, 3]] > 0).all()
        assert (corners[:, 1] < h - 1).all()


def test_scans_depend_only_on_the_seed() -> None:
    busy = Beside(True, True, True, lines=1, rods=1, blown=True, dust=5, scratches=3)
    frame = FilmFrame(1, format=RICOH, dpi=200, beside=busy)
    np.testing.assert_array_equal(frame.scan(), replace(frame).scan())
    assert (frame.scan() != frame.with_seed(2).scan()).mean() > 0.2


def test_scans_come_in_eight_and_sixteen_bit_grey_and_colour() -> None:
    frame = FilmFrame(1, format=HASSELBLAD, dpi=100, colour=True, bits=16)
    assert frame.scan().shape == (*frame.shape, 3)
    assert frame.scan().dtype == np.uint16
    assert replace(frame, colour=False, bits=8).scan().dtype == np.uint8
