"""The design laid over candidates, with and without prior positions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from reseau.measure.reseau.assignment import assign
from reseau.measure.reseau.candidates import Candidates
from reseau.measure.reseau.grid_search import GridOptions, place_grid

from ..montecarlo import slowly

WIDTH, HEIGHT = 900, 700
VALID = np.ones((HEIGHT, WIDTH), dtype=bool)


def design() -> np.ndarray:
    """15 × 11 marks, millimetres, y up, without a mark of the second row: no symmetry is left."""
    x, y = np.meshgrid(np.arange(15) - 7.0, 5.0 - np.arange(11))
    xy = 5.0 * np.stack([x, y], axis=-1).reshape(-1, 2)
    return xy[[i for i in range(165) if i not in (17, 18, 33)]]


def seen(xy, scale=10.0, turn=0.0, mirrored=True, bend=0.0, shift=(0.0, 0.0)):
    """Positions of the marks in the image; `bend` is the radial distortion at its corner in pixels."""
    c, s = np.cos(turn), np.sin(turn)
    matrix = scale * np.array([[c, -s], [s, c]]) @ np.diag([1.0, -1.0 if mirrored else 1.0])
    q = xy @ matrix.T
    corner = np.hypot(WIDTH, HEIGHT) / 2
    q = q * (1 + bend / corner * (q**2).sum(axis=1, keepdims=True) / corner**2)
    return q + (np.array([WIDTH, HEIGHT]) - 1) / 2 + shift


def candidates(image, rng, *, missing=0.0, false=0.0, noise_px=0.2):
    """Candidates of the marks, shuffled among false ones that are a little weaker."""
    kept = image[rng.uniform(size=len(image)) >= missing]
    count = int(false * len(image))
    wrong = rng.uniform([0, 0], [WIDTH, HEIGHT], (count, 2))
    xy = np.concatenate([kept + rng.normal(0, noise_px, kept.shape), wrong])
    t = np.concatenate([rng.uniform(10, 60, len(kept)), rng.uniform(5, 25, count)])
    order = np.argsort(-t)
    return Candidates(xy[order], t[order])


def share_right(found, image) -> float:
    """Share of assigned candidates that are those of their mark."""
    has = found.candidate >= 0
    return float(np.mean(np.hypot(*(found.at - image)[has].T) < 1.5))


@pytest.mark.parametrize("shift", [(0, 0), (38, -27), (-30, 34)])
@pytest.mark.parametrize("bend", [-30.0, 25.0])
def test_prior_positions_may_be_wrong_by_tens_of_pixels(shift, bend):
    rng, xy = np.random.default_rng(1), design()
    image = seen(xy, bend=bend)
    start = seen(xy) + shift
    found = assign(xy, start, candidates(image, rng, missing=0.1, false=0.3), VALID)
    assert found is not None
    assert share_right(found, image) == 1.0
    assert (found.candidate >= 0).mean() > 0.85
    assert np.abs(found.predicted - image).max() < 1.5


@pytest.mark.slow
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(
    turn=st.floats(-10, 10),
    scale=st.floats(6.5, 11.0),
    mirrored=st.booleans(),
    bend=st.floats(-30, 30),
    seed=st.integers(0, 1000),
)
def test_without_prior_positions_shift_scale_rotation_and_handedness_are_found(
    turn, scale, mirrored, bend, seed
):
    rng, xy = np.random.default_rng(seed), design()
    image = seen(xy, scale, np.deg2rad(turn), mirrored, bend, rng.uniform(-40, 40, 2))
    found = place_grid(xy, candidates(image, rng, missing=0.05, false=0.3), VALID, GridOptions())
    assert found is not None
    inside = ((image > 2) & (image < [WIDTH - 3, HEIGHT - 3])).all(axis=1)
    assert share_right(found, image) > 0.99
    assert (found.candidate[inside] >= 0).mean() > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("bend", [-60.0, 60.0])
def test_a_strong_barrel_or_pincushion_is_followed(bend):
    rng, xy = np.random.default_rng(4), design()
    image = seen(xy, 9.0, 0.1, True, bend)
    found = place_grid(xy, candidates(image, rng), VALID, GridOptions())
    assert found is not None
    assert share_right(found, image) == 1.0
    assert np.abs(found.predicted - image).max() < 2.0


def test_missing_rows_and_a_hole_do_not_shift_the_names():
    rng, xy = np.random.default_rng(6), design()
    image = seen(xy, 10.0, -0.05)
    there = (np.abs(xy[:, 1] - 10) > 1) & (np.abs(xy[:, 1] + 15) > 1) & (np.hypot(*(xy - [10, 0]).T) > 11)
    found = place_grid(xy, candidates(image[there], rng, false=0.3), VALID, GridOptions())
    assert found is not None
    assert share_right(found, image) == 1.0
    assert (found.candidate[there] >= 0).mean() > 0.95
    assert (found.candidate[~there] >= 0).mean() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("row", [*slowly(0), 8])
def test_the_places_of_an_uneven_design_tell_which_row_at_the_border_is_not_seen(row):
    """Shifted by a row, as many marks are found, and one row lies largely beyond the frame."""
    rng = np.random.default_rng(9)
    x, y = np.meshgrid(np.arange(11) - 5.0 + rng.normal(0, 0.01, 11), 4.0 - np.arange(9))
    xy = 9.0 * np.stack([x, y + rng.normal(0, 0.01, (9, 1))], axis=-1).reshape(-1, 2)
    image = seen(xy, 8.6, 0.08)
    there = np.arange(99) // 11 != row
    found = place_grid(
        xy, candidates(image[there], rng, noise_px=0.03), VALID[:640], GridOptions(mirrored=True)
    )
    assert found is not None
    assert share_right(found, image) == 1.0
    assert (found.candidate[there] >= 0).all()


@pytest.mark.slow
def test_a_known_handedness_is_kept():
    rng, xy = np.random.default_rng(7), design()
    image = seen(xy)
    found = place_grid(xy, candidates(image, rng), VALID, GridOptions(mirrored=True))
    assert found is not None
    assert np.linalg.det(found.field.jacobian(xy[:1])[0]) < 0


def test_marks_outside_the_frame_or_on_lost_pixels_do_not_count_as_missing():
    rng, xy = np.random.default_rng(8), design()
    image = seen(xy, shift=(250, 120))
    valid = VALID.copy()
    valid[:, :330] = False
    inside = ((image > [330, 0]) & (image < [WIDTH, HEIGHT])).all(axis=1)
    found = assign(xy, seen(xy, shift=(260, 110)), candidates(image[inside], rng), valid)
    assert found is not None
    assert found.score == (found.candidate >= 0).sum()


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_candidates_give_no_grid(count):
    few = Candidates(np.full((count, 2), 50.0) + np.arange(count)[:, None], np.full(count, 9.0))
    assert assign(design(), seen(design()), few, VALID) is None
    assert place_grid(design(), few, VALID, GridOptions()) is None


def test_places_along_the_wires_do_not_hide_the_crossings_a_quarter_of_a_pitch_beside_them() -> None:
    """Nominal positions are off by (−7, 9) px; all along the wires weak places support other shifts."""
    pitch, rng = 97.0, np.random.default_rng(3)
    design = np.stack(np.meshgrid(np.arange(11.0), np.arange(9.0)), axis=-1).reshape(-1, 2)
    crossings = design * pitch + [90.0, 70.0]
    along = [crossings + np.array([step, 0.7]) for step in (20.0, 22.5, 25.0, 27.5, 30.0)]
    weak = np.concatenate(along) + rng.normal(0, 0.3, (5 * len(design), 2))
    xy = np.concatenate([crossings + rng.normal(0, 0.2, crossings.shape), weak])
    t = np.concatenate([np.linspace(290.0, 115.0, len(design)), np.linspace(34.0, 27.0, len(weak))])
    found = assign(
        design, crossings + np.array([-7.0, 9.0]), Candidates(xy, t), np.ones((954, 1156), dtype=bool)
    )
    assert found is not None
    assert np.abs(found.predicted - crossings).max() < 1.0
