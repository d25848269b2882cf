"""Gross errors among rods and marks, O, S, M and N too, are found and named; other misfits enlarge sigmas."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Array, ImagePoints
from reseau.core.failure import Code
from reseau.designs import regular_reseau
from reseau.io import Mark, ReseauDesign
from reseau.procedures.oscilloscope import photo_i, photo_ii

from ..montecarlo import slowly

RESEAU = regular_reseau(9, 7, 11.0, Mark(shape="disk", size=2.0))
RODS = regular_reseau(7, 6, 13.0, Mark(shape="rod", size=1.0))
SIGMA = 0.02


def imaged(
    design: ReseauDesign, seed: int, wrong: dict[str, tuple[float, float]] | None = None
) -> ImagePoints:
    """Images at 8 px/mm, y down, slightly bent, with noise and gross errors (px)."""
    xy = [700, 500] + design.xy * [8, -8] * (1 + 1e-6 * (design.xy**2).sum(axis=1, keepdims=True))
    xy = xy + SIGMA * np.random.default_rng(seed).standard_normal(xy.shape)
    for name, off in (wrong or {}).items():
        xy[design.ids.index(name)] += off
    return ImagePoints.with_sigma(design.ids, xy, SIGMA)


def true_of(rods: ImagePoints, seed: int = 1) -> tuple[Array, tuple[str, ...], tuple[Code, ...]]:
    """Errors (mm) of rods that were imaged soundly, with the instrument that other images of them give."""
    first = photo_i(imaged(RESEAU, seed), RESEAU)
    second = photo_ii(rods, RESEAU, RODS, first.camera).required()
    sound = imaged(RODS, seed + 50)
    return (
        second.instrument.apply(sound).xy - RODS.xy,
        second.instrument.gross,
        tuple(note.code for note in second.notes),
    )


@pytest.mark.slow
@pytest.mark.parametrize("which", ["origin", *slowly("axis", "inner"), "several"])
def test_wrong_rods_are_left_out_and_named_also_those_that_define_the_axis(which: str):
    m, n = RODS.ids[0], RODS.ids[6]
    names = {"origin": [m], "axis": [n], "inner": [RODS.ids[17]], "several": [n, RODS.ids[11], RODS.ids[30]]}
    wrong = dict.fromkeys(names[which], (0.0, 13.0))
    error, gross, codes = true_of(imaged(RODS, 5, wrong))
    assert sorted(gross) == sorted(wrong)
    assert Code.GROSS_ERRORS in codes
    assert np.abs(error).max() < 8 * SIGMA / 8


def test_wrong_marks_of_the_reseau_are_left_out_also_o_and_s():
    first = photo_i(imaged(RESEAU, 1), RESEAU)
    assert first.notes == ()
    o, s = (RESEAU.ids[i] for i in (31, 35))
    found = photo_i(imaged(RESEAU, 1, {o: (3.0, 0.0), s: (0.0, -2.0)}), RESEAU)
    assert set(found.camera.gross) == {o, s}
    assert found.notes[0].code is Code.GROSS_ERRORS


def test_residuals_beyond_chance_enlarge_sigmas_and_are_said():
    sound, rough = imaged(RODS, 5), imaged(RODS, 6)
    rough = ImagePoints(
        rough.names, rough.xy + np.random.default_rng(2).normal(0, 0.1, rough.xy.shape), rough.cov
    )
    first = photo_i(imaged(RESEAU, 1), RESEAU)
    made = [photo_ii(each, RESEAU, RODS, first.camera).required() for each in (sound, rough)]
    assert made[0].instrument.enlarged == 1.0
    assert made[1].instrument.enlarged == pytest.approx(5, rel=0.3)
    assert Code.SIGMAS_DOUBTFUL in {note.code for note in made[1].notes}
    sigma = [np.sqrt(np.diagonal(each.instrument.covariance))[-16:] for each in made]
    assert (sigma[1] > 2 * sigma[0]).all()
