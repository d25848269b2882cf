"""A photograph is referred to PHOTO I, and a camera that moved is noticed."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import ImagePoints
from reseau.core.failure import Failure
from reseau.optics.composition import Similarity
from reseau.refine import correct_camera, register

from .oscilloscope import RESEAU, SIGMA_PX, measured, pixels, reseau_marks


def _camera(seed: int = 0):
    return correct_camera(reseau_marks(np.random.default_rng(seed)), RESEAU, trials=0).required()


@pytest.mark.slow
def test_a_stationary_camera_is_not_reported_as_moved():
    # PHOTO I anew for each: its own errors are part of the test's level.
    found = [register(reseau_marks(np.random.default_rng(100 + s)), RESEAU, _camera(s)) for s in range(40)]
    assert not any(r.moved for r in found)
    assert max(r.displacement_px for r in found) < 0.02
    # At level 0.05 more than 8 of 40 have a probability of 1e-4.
    assert sum(r.p < 0.05 for r in found) <= 8


def test_a_moved_camera_is_detected_and_its_photograph_registered():
    moved = Similarity(np.array([0.5, -0.3, 1.0002, 0.0003]))
    marks = measured(RESEAU.ids, moved(pixels(RESEAU.xy)), np.random.default_rng(1))
    found = register(marks, RESEAU, _camera())
    assert found.moved
    back = found.apply(marks).xy - pixels(RESEAU.xy)
    # 165 marks carry the photograph back to a tenth of what one of them scatters.
    assert np.abs(back.mean(axis=0)).max() < 0.3 * SIGMA_PX
    assert np.abs(back).max() < 5 * SIGMA_PX


def test_a_tilted_photograph_is_registered():
    xy = pixels(RESEAU.xy)
    tilted = measured(RESEAU.ids, xy * (1 + 2e-5 * (xy[:, :1] - 800)), np.random.default_rng(2))
    found = register(tilted, RESEAU, _camera())
    assert found.moved
    assert not found.similar
    assert found.left_px < 2 * SIGMA_PX
    assert np.abs(found.apply(tilted).xy - xy).max() < 5 * SIGMA_PX


def test_inconsistent_marks_increase_the_residuals():
    rng = np.random.default_rng(2)
    apart = measured(RESEAU.ids, pixels(RESEAU.xy) + rng.normal(0, 0.5, RESEAU.xy.shape), rng)
    assert 0.3 < register(apart, RESEAU, _camera()).left_px < 0.8


def test_three_marks_are_too_few_to_register_a_photograph():
    marks = reseau_marks(np.random.default_rng(3))
    found = register(marks.select(marks.names[:3]), RESEAU, _camera())
    assert isinstance(found, Failure)
    assert "3 marks" in found.reason


def test_marks_that_contradict_the_others_do_not_pull_the_photograph():
    """Echoes beside crossings move single marks of PHOTO II."""
    marks = reseau_marks(np.random.default_rng(4))
    pulled = marks.xy.copy()
    pulled[[7, 30, 90]] += [0.1, 1.0]
    found = register(ImagePoints(marks.names, pulled, marks.cov), RESEAU, _camera())
    assert set(found.rejected) == {marks.names[k] for k in (7, 30, 90)}
    assert not found.moved
    assert found.displacement_px < 0.02


@pytest.mark.slow
def test_the_errors_of_the_marks_are_part_of_the_registered_points():
    body = ImagePoints.with_sigma(["p", "q"], [[400.0, 300.0], [1300.0, 900.0]], 1e-6)
    off = []
    for seed in range(60):
        rng, camera = np.random.default_rng(200 + seed), _camera(seed)
        found = register(reseau_marks(rng), RESEAU, camera)
        there = found.apply(body)
        moved = found.moves(body.xy)
        cov = there.cov + moved @ camera.cofactor @ np.swapaxes(moved, 1, 2)
        root = np.linalg.cholesky(cov)
        off.append(np.linalg.solve(root, (there.xy - body.xy)[..., None])[..., 0])
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.2)
