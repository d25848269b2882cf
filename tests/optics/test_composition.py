"""Mappings to build with: the common system of a reseau, chains."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.optics import RationalPolynomial
from reseau.optics.composition import Chain, Similarity


def test_common_system_has_its_origin_and_axis_in_the_two_marks() -> None:
    o, s = np.array([30.0, 40.0]), np.array([130.0, 90.0])
    for mirrored in (False, True):
        system = Similarity.common_system(o, s, mirrored=mirrored)
        np.testing.assert_allclose(system([o, s]), [[0, 0], [np.hypot(100, 50), 0]], atol=1e-12)
        assert np.linalg.det(system.derivatives([o]).d_xy[0]) == pytest.approx(-1 if mirrored else 1)
    with pytest.raises(UsageError, match="coincide"):
        Similarity.common_system(o, o)


def test_chain_reports_a_duplicate_name() -> None:
    with pytest.raises(UsageError, match="a1"):
        Chain(RationalPolynomial.camera(), RationalPolynomial.camera())


def test_a_similarity_has_a_scale_and_an_angle() -> None:
    turn = Similarity([1.0, 2.0, 0.6, 0.8])
    assert (turn.scale, turn.angle) == (pytest.approx(1.0), pytest.approx(np.arctan2(0.8, 0.6)))
