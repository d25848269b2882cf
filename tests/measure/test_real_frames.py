"""Real frames of Voyager and Viking: as many marks as NASA's program has, better ones, and none false."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.measure import measure_reseau

from ..montecarlo import slowly
from . import frames

VOYAGER = ("VGR1_NA_FDS0947106_flat", "VGR1_NA_FDS1636832_Io", "VGR2_NA_FDS2644554_Uranus")
JRINGS, IO, VIKING = "VGR2_WA_FDS2069302_JRings", VOYAGER[1], "VO1_F387A06"
# Its marks take eight times as long as those of the others.
FAINT = pytest.param(JRINGS, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def measured(reference_data):
    folder, known = reference_data("reseau"), {}

    def of(name):
        if name not in known:
            case = frames.load(name, folder)
            known[name] = case, measure_reseau(case.frame, case.design)
        return known[name]

    return of


def rms(deviation):
    return np.sqrt((deviation**2).mean(axis=0))


@pytest.mark.parametrize("name", [VOYAGER[0], *slowly(*VOYAGER[1:]), FAINT])
def test_at_least_as_many_marks_are_measured_as_by_nasa_s_program(measured, name):
    case, result = measured(name)
    assert result.found >= np.isfinite(case.others["vicar"][:, 0]).sum()


@pytest.mark.slow
def test_at_least_eighty_marks_of_viking_are_measured(measured):
    assert measured(VIKING)[1].found >= 80


@pytest.mark.slow
@pytest.mark.parametrize("name", [*VOYAGER, FAINT, VIKING])
def test_marks_agree_with_their_neighbours(measured, name):
    _, result = measured(name)
    off = np.abs(result.deviation[result.ok]).max(axis=1)
    # Beside Io's bright limb the image is bent by as much: one mark there, plainly seen, lies 1.2 px off.
    assert (off > 1.0).sum() <= (1 if name == IO else 0)
    assert off.max() <= 1.25


@pytest.mark.slow
@pytest.mark.parametrize("name", [*VOYAGER, FAINT])
def test_common_marks_agree_better_with_their_neighbours_than_those_of_nasa_s_program(measured, name):
    case, result = measured(name)
    theirs, source = case.others["vicar"], case.design.xy
    both = result.ok & np.isfinite(theirs[:, 0])
    assert both.sum() >= 74
    for degree in (None, 7) if both.sum() >= 110 else (None,):
        ours = rms(frames.leave_one_out(source[both], result.xy[both], degree))
        # Marks at the border deviate by the distortion there, in both measurements alike.
        assert np.hypot(*ours) < np.hypot(*rms(frames.leave_one_out(source[both], theirs[both], degree)))


def test_the_flat_frame_is_more_accurate_than_published(measured):
    case, result = measured(VOYAGER[0])
    theirs, source = case.others["vicar"], case.design.xy
    inner = result.ok & np.isfinite(theirs[:, 0]) & frames.inner_marks(case.design)
    assert inner.sum() == 118
    # Leave-one-out with a polynomial of 7th degree is the definition that gives RESLOC the published figure.
    assert rms(frames.leave_one_out(source[inner], theirs[inner], 7)) == pytest.approx(
        [0.093, 0.091], abs=5e-4
    )
    ours = rms(frames.leave_one_out(source[inner], result.xy[inner], 7))
    assert ours[0] < 0.078
    assert ours[1] < 0.081


@pytest.mark.slow
@pytest.mark.parametrize("name", [JRINGS, IO])
def test_the_frame_resampled_by_our_marks_agrees_with_nasa_s_corrected_frame(measured, name):
    case, result = measured(name)
    found = frames.agreement(case, frames.collocation(case.design.xy, result.xy))
    median, mad = (0.03, 0.10) if name == JRINGS else (0.06, 0.18)
    assert np.abs(found.median).max() <= median
    assert found.mad.max() <= mad


@pytest.mark.slow
def test_without_nominal_positions_the_same_marks_are_measured(measured):
    case, result = measured(JRINGS)
    points = tuple(p.model_copy(update={"nominal_px": None}) for p in case.design.points)
    blind = measure_reseau(case.frame, case.design.model_copy(update={"points": points}))
    assert blind
    assert (blind.ok & result.ok).sum() >= result.found - 1
    off = (blind.xy - result.xy)[blind.ok & result.ok]
    assert np.abs(off).max() < 0.15
