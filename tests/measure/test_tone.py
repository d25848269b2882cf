"""The curve between light and grey values, by the marks of a frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from reseau.core.tone import ToneCurve
from reseau.measure import tone
from reseau.measure.matching.shapes import GrownOutline, Window
from reseau.measure.response import Samples
from reseau.measure.tone import Exponent, find_curve
from reseau.optics.formation import Outline, PixelResponse


def _disks(gamma: float) -> Callable[[ToneCurve], tuple[Samples, np.ndarray]]:
    """Twelve disks in grey values of a camera, matched by regression on their light."""
    disk, rng = Outline.circle(4.0, 0.5), np.random.default_rng(0)
    nodes = Outline(np.tile(disk.xy, (12, 1, 1)), np.tile(disk.dxy, (12, 1, 1)))
    plain = GrownOutline(nodes, np.zeros((0, 2, 2)))
    axis = np.tile(np.arange(25.0), (12, 1))
    window = Window(axis, axis, PixelResponse())
    place = 12 + rng.uniform(-0.5, 0.5, (12, 2)), np.full(12, 0.8), np.zeros((12, 0))
    share = plain.image(*place, np.arange(12), window)
    grey = 255 * ((200 - 150 * share) / 255) ** (1 / gamma) + rng.normal(0, 0.5, share.shape)

    def matched(curve: ToneCurve) -> tuple[Samples, np.ndarray]:
        light = np.asarray(curve.light(grey, 255.0))
        fit = np.polynomial.Polynomial.fit(share.ravel(), light.ravel(), 1)
        depth = np.full(12, float(fit(1.0) - fit(0.0)))
        return Samples(plain, *place, depth, window, light, light > 0), np.asarray(fit(share))

    return matched


def test_the_exponent_of_a_camera_is_found_within_three_sigmas() -> None:
    found = find_curve(_disks(2.0), 255.0, None)
    assert found.curve is not None
    assert found.curve.exponent is not None
    assert found.sigma is not None
    assert abs(found.curve.exponent - 2.0) < 3 * found.sigma < 0.03


def test_without_a_curve_none_is_found() -> None:
    assert not find_curve(_disks(1.0), 255.0, None)


def test_an_exponent_that_drifts_from_one_match_to_the_next_is_no_curve(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in a compressed picture, whose residuals are correlated."""
    drifting = iter([2.17, 3.04, 2.94, 2.85, 2.74, 2.64, 2.5])
    monkeypatch.setattr(tone, "estimate_gamma", lambda *_: Exponent(next(drifting), 0.05, 0.97, 0.25))
    assert not find_curve(_disks(1.0), 255.0, None)
