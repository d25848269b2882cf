"""Where in a frame there may be marks."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.measure.reseau.candidates import find_candidates
from reseau.optics.formation import Outline, coverage, draw, mark_outline

SHAPE, SIGMA = (220, 260), 3.0
_ROWS, _COLUMNS = np.meshgrid(np.arange(30, 200, 34), np.arange(30, 240, 38), indexing="ij")
PLACES = np.stack([_COLUMNS, _ROWS], axis=-1).reshape(-1, 2) + np.random.default_rng(5).uniform(
    -0.5, 0.5, (30, 2)
)


def template(polarity: int = -1, diameter: float = 7.0) -> np.ndarray:
    at = np.arange(-8, 9.0)
    return polarity * coverage(mark_outline("disk", diameter, None, 0.4), at, at, 0.8)


def frame(amplitude: float, seed: int = 0, diameter: float = 7.0) -> np.ndarray:
    outline = mark_outline("disk", diameter, None, 0.4)
    disks = Outline(outline.xy + PLACES[:, None, :], np.tile(outline.dxy, (len(PLACES), 1, 1)))
    shading = 100 + 0.2 * np.arange(SHAPE[1])
    return shading + amplitude * draw(disks, SHAPE, 0.8) + np.random.default_rng(seed).normal(0, SIGMA, SHAPE)


def everywhere() -> np.ndarray:
    return np.ones(SHAPE, dtype=bool)


@pytest.mark.parametrize("polarity", [-1, 1])
def test_every_mark_is_among_the_strongest_candidates_at_its_position(polarity):
    found = find_candidates(frame(40.0 * polarity), everywhere(), template(polarity))
    distance = np.hypot(*(found.xy[:30, None] - PLACES[None]).transpose(2, 0, 1))
    assert set(distance.argmin(axis=1)) == set(range(30))
    assert distance.min(axis=1).max() < 0.3
    assert np.all(np.diff(found.t) <= 0)


def test_a_mark_of_the_other_polarity_is_not_a_candidate():
    found = find_candidates(frame(40.0), everywhere(), template(-1))
    near = np.hypot(*(found.xy[:, None] - PLACES[None]).transpose(2, 0, 1)).min(axis=1) < 2
    assert not near.any()


def test_noise_is_rarely_as_significant_as_a_weak_mark():
    counts = [len(find_candidates(frame(0.0, seed), everywhere(), template(), 5.5)) for seed in range(5)]
    # 286 000 pixels with neighbours of like content: about one in 50 000 000 beyond 5.5.
    assert sum(counts) <= 1


def test_the_significance_is_the_amplitude_over_its_standard_deviation():
    t = []
    for seed in range(6):
        found = find_candidates(frame(-20.0, seed), everywhere(), template())
        near = np.hypot(*(found.xy[:, None] - PLACES[None]).transpose(2, 0, 1)).min(axis=1) < 1
        t.append(np.median(found.t[near]))
    kernel = template() - template().mean()
    expected = 20.0 / (SIGMA / np.sqrt((kernel**2).sum()))
    # Off the pixel's centre the template fits a little less well, and a maximum is sought.
    assert np.mean(t) == pytest.approx(expected, rel=0.1)


def test_pixels_without_an_image_give_no_candidates_and_lost_lines_no_errors():
    pixels, valid = frame(-40.0), everywhere()
    pixels[:, :60] = 0
    valid[:, :60] = False
    pixels[95:97] = 0
    valid[95:97] = False
    found = find_candidates(pixels, valid, template())
    assert (found.xy[:, 0] > 56).all()
    whole = PLACES[PLACES[:, 0] > 64]
    distance = np.hypot(*(found.xy[:, None] - whole[None]).transpose(2, 0, 1)).min(axis=0)
    assert distance.max() < 0.5


def test_at_most_the_requested_number_of_strongest_candidates_is_returned():
    pixels = frame(-40.0)
    every, few = (find_candidates(pixels, everywhere(), template(), 3.0, most) for most in (4000, 12))
    assert len(few) == 12
    assert few.t == pytest.approx(every.t[:12])
