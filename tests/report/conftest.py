"""The three photographs of one bench, from true positions with noise of known size: nothing is measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from reseau.core.data import ImagePoints
from reseau.procedures.oscilloscope import PhotoI, PhotoII, PhotoIII, photo_i, photo_ii, photo_iii
from reseau.report.comparison import compare_with_truth
from reseau.report.truth import Comparison, Known
from reseau_sims import Truth, World

NOISE_PX = 0.01


@dataclass(frozen=True, eq=False)
class Bench:
    """A bench, the results from its photographs, and the true values."""

    world: World
    first: PhotoI
    second: PhotoII
    third: PhotoIII
    known: Known
    truth: Comparison


def _seen(truth: Truth, seed: int) -> ImagePoints:
    noise = np.random.default_rng(seed).normal(0, NOISE_PX, truth.xy.shape)
    return ImagePoints.with_sigma(truth.names, truth.xy + noise, NOISE_PX)


@pytest.fixture(scope="session")
def bench() -> Bench:
    world = World.standard(6)
    first = photo_i(_seen(world.truth(), 1), world.design, check=world.check_marks())
    assert isinstance(first, PhotoI)
    rods, body = world.truth_ii(), world.truth_iii()
    second = photo_ii(
        _seen(rods, 2), world.design, world.test_object, first.camera, marks=_seen(world.truth("PHOTO II"), 3)
    )
    assert isinstance(second, PhotoII)
    third = photo_iii(
        _seen(body, 4), second.instrument, world.design, marks=_seen(world.truth("PHOTO III"), 5)
    )
    assert isinstance(third, PhotoIII)
    known = Known(world.view(), rods, (body,))
    truth = compare_with_truth(known, first, world.design, second, world.test_object, (third,))
    return Bench(world, first, second, third, known, truth)
