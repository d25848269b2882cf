"""Rational polynomials: the paper's formulas, folds, files."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reseau.core.errors import FormatError, UsageError
from reseau.optics import RationalPolynomial

# Millimetres on a Polaroid, reseau system: tilt of some minutes, barrel distortion of 1 mm at the corner.
CAMERA = RationalPolynomial.camera().with_values(
    [1.01, 0.003, 0.4, -0.002, 0.99, -0.3, 2e-4, -1e-4, 1e-5, -2e-5, 8e-6, -2e-8, 3e-8]
)
ULTRASONIC = RationalPolynomial.ultrasonic().with_values(
    [0.3, 1.02, -0.01, 2e-4, -1e-4, 5e-5, 4e-6, 2e-8, -0.2, 0.98, 0.02, -1e-4, 2e-4, 1e-4, 3e-6, -1e-8]
)
POINTS = np.random.default_rng(7).uniform(-50, 50, (40, 2))


@settings(max_examples=60)
@given(
    st.lists(st.floats(-1, 1), min_size=13, max_size=13),
    st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=20),
)
def test_inverse_of_any_plausible_camera_is_correct_or_nan(
    turns: list[float], points: list[tuple[float, float]]
) -> None:
    size = [0.2, 0.2, 5, 0.2, 0.2, 5, 2e-3, 2e-3, 1e-3, 1e-3, 1e-4, 1e-6, 1e-6]
    camera = RationalPolynomial.camera()
    camera = camera.with_values(camera.values + np.array(turns) * size)
    found = camera.inverse(camera(points))
    known = np.isfinite(found).all(axis=1)
    assert np.abs(camera(found[known]) - camera(np.array(points))[known]).max(initial=0) < 1e-7
    # Within the region around the centre there is one such point only, and it is the one we began with.
    inside = known & camera.one_to_one(points)
    assert np.abs(found[inside] - np.array(points)[inside]).max(initial=0) < 1e-6


def test_camera_is_wishahy_equation_5() -> None:
    v = CAMERA
    p = {name: v.value_of(name) for name in v.names}
    x, y = 31.0, -17.0
    d = p["a0"] * x + p["b0"] * y + 1
    expected = [
        (p["a1"] * x + p["b1"] * y + p["c1"]) / d
        + p["d1"] * x * y
        + p["k"] * (x**3 + x * y**2)
        + p["h1"] * x**4,
        (p["a2"] * x + p["b2"] * y + p["c2"]) / d
        + p["d2"] * x * y
        + p["k"] * (y**3 + y * x**2)
        + p["h2"] * y**4,
    ]
    np.testing.assert_allclose(v([[x, y]]), [expected], rtol=1e-14)
    assert v.names == ("a1", "b1", "c1", "a2", "b2", "c2", "a0", "b0", "d1", "d2", "k", "h1", "h2")


def test_ultrasonic_is_wishahy_equation_7() -> None:
    a, b = ULTRASONIC.values[:8], ULTRASONIC.values[8:]
    x, y = 31.0, -17.0
    r4 = (x**2 + y**2) ** 2
    expected = [
        a @ [1, x, y, x * y, x**2, y**2, x**3 + x * y**2, r4],
        b @ [1, y, x, x * y, y**2, x**2, y**3 + y * x**2, r4],
    ]
    np.testing.assert_allclose(ULTRASONIC([[x, y]]), [expected], rtol=1e-14)


def test_a_reduced_model_lacks_only_the_named_parameters() -> None:
    reduced = CAMERA.without("h1", "h2", "k")
    assert reduced.names == CAMERA.names[:10]
    full = CAMERA.with_values({"h1": 0.0, "h2": 0.0, "k": 0.0})
    points = POINTS
    np.testing.assert_allclose(reduced(points), full(points), rtol=1e-14)
    with pytest.raises(UsageError, match="h3"):
        reduced.without("h3")


def test_inverse_is_nan_where_the_polynomial_has_folded() -> None:
    barrel = RationalPolynomial({"k": {"X": "x3 + xy2", "Y": "y3 + yx2"}}, [-1e-6], {"X": "x", "Y": "y"})
    fold = (1 / 3e-6) ** 0.5  # 577.35: radius at which r − 1e-6 r³ turns back
    assert np.isfinite(barrel.inverse(barrel([[fold * 0.999, 0.0], [0.0, -fold * 0.999]]))).all()
    beyond = barrel([[fold * 1.3, 0.0]])  # has a second origin, inside
    back = barrel.inverse(beyond)
    assert np.hypot(*back[0]) < fold
    np.testing.assert_allclose(barrel(back), beyond, atol=1e-9)
    assert np.isnan(barrel.inverse([[fold * 2 / 3 + 1.0, 0.0]])).all()  # larger than any image
    assert np.isnan(barrel.inverse([[-1000.0, 0.0]])).all()  # has an origin beyond the fold only


def test_inverse_does_not_cross_the_horizon_of_a_projectivity() -> None:
    strong = RationalPolynomial.projective().with_values({"a0": 0.01})
    across = strong([[-150.0, 20.0]])  # 1 + D = −0.5
    assert np.isnan(strong.inverse(across)).all()


@pytest.mark.parametrize("text", ["x3 ++ y", "z", "x3 y + ", "", "2..x"])
def test_unreadable_terms_are_refused(text: str) -> None:
    if not text:
        assert RationalPolynomial({"k": {"X": text}})([[1.0, 2.0]]).tolist() == [[0.0, 0.0]]
        return
    with pytest.raises(FormatError, match="monomials"):
        RationalPolynomial({"k": {"X": text}})


def test_invalid_models_in_a_file_are_refused() -> None:
    for content in ({}, {"terms": {"k": "x"}}, {"terms": {"k": {"Q": "x"}}}, {"terms": {}, "more": 1}):
        with pytest.raises(FormatError):
            RationalPolynomial.from_dict(content)


def test_a_model_split_into_its_monomials_is_the_same_mapping_with_more_parameters():
    rng = np.random.default_rng(4)
    whole = RationalPolynomial.ultrasonic()
    whole = whole.with_values(whole.values + rng.normal(0, 1e-4, len(whole.names)))
    split, points = whole.split(), rng.uniform(-5, 5, (50, 2))
    assert np.abs(split(points) - whole(points)).max() < 1e-12
    assert len(split.names) == 22
    assert {"A0", "A6.x3", "A6.xy2", "A7.x4", "A7.2x2y2", "A7.y4", "B6.yx2"} <= set(split.names)
