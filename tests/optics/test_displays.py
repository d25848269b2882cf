"""Wong's display against the formulas that Wishahy prints."""

from __future__ import annotations

import numpy as np

from reseau.core.data import Array
from reseau.optics import RationalPolynomial
from reseau.optics.displays import wong_display

SYMMETRIC = {"k0": 0.01, "k1": 8e-6, "k2": -2e-9, "k3": 1e-13}
ORIENTATION = {"P0": 0.2, "P1": 1e-5, "P2": -2e-5, "P3": 4e-3, "P4": -0.1}
BEAM = {"m1": 5e-3, "m2": -2e-3}
G, THETA = (6e-5, -4e-9), 0.7
POINTS = np.random.default_rng(9).uniform(-50, 50, (50, 2))


def components(xy: Array) -> Array:
    """The sum of Wong's components, term by term."""
    k, p, m = SYMMETRIC, ORIENTATION, BEAM
    x, y = xy.T
    r = np.hypot(x, y)
    radial = k["k0"] + k["k1"] * r**2 + k["k2"] * r**4 + k["k3"] * r**6
    g = G[0] * r**2 + G[1] * r**4
    dx = x * radial - g * np.sin(THETA) + p["P0"] + p["P1"] * x * y + p["P2"] * x**2 - p["P3"] * y
    dy = y * radial + g * np.cos(THETA) + p["P4"] + p["P2"] * x * y + p["P3"] * x + p["P1"] * y**2
    return np.stack([x + dx + m["m1"] * x + m["m2"] * y, y + dy], axis=1)


def test_display_is_the_sum_of_its_components() -> None:
    sine, cosine = np.sin(THETA), np.cos(THETA)
    h = {"h'1": G[0] * sine, "h'2": G[1] * sine, "h'3": G[0] * cosine, "h'4": G[1] * cosine}
    display = wong_display().with_values(SYMMETRIC | h | ORIENTATION | BEAM)
    np.testing.assert_allclose(display(POINTS), components(POINTS), rtol=0, atol=1e-12)


def test_display_expands_to_the_ultrasonic_polynomials_as_wishahy_lists_them() -> None:
    """The list after eq. (7), with the primes that it leaves out."""
    k0, k1 = 0.01, 8e-6
    h1, h2, h3, h4 = 3e-5, 2e-9, 5e-5, -3e-9
    p0, p1, p2, p3, p4 = ORIENTATION.values()
    m1, m2 = BEAM.values()
    a = [p0, 1 + k0 + m1, m2 - p3, p1, p2 - h1, -h1, k1, -h2]
    b = [p4, 1 + k0, p3, p2, p1 + h3, h3, k1, h4]
    h = {"h'1": h1, "h'2": h2, "h'3": h3, "h'4": h4}
    display = wong_display().with_values({"k0": k0, "k1": k1} | h | ORIENTATION | BEAM)
    ultrasonic = RationalPolynomial.ultrasonic().with_values([*a, *b])
    np.testing.assert_allclose(display(POINTS), ultrasonic(POINTS), rtol=0, atol=1e-12)


def test_display_implies_three_conditions_among_the_ultrasonic_coefficients() -> None:
    """Of the 16 directions of (7) 13 can be reached: A4 − A5 = B3, B4 − B5 = A3 and A6 = B6 always hold."""
    display = wong_display().without("k2", "k3")
    ultrasonic = RationalPolynomial.ultrasonic()
    by_display = display.derivatives(POINTS / 50).d_parameters.reshape(-1, 13)
    by_ultrasonic = ultrasonic.derivatives(POINTS / 50).d_parameters.reshape(-1, 16)
    assert np.linalg.matrix_rank(by_display) == 13
    expansion, *_ = np.linalg.lstsq(by_ultrasonic, by_display)
    np.testing.assert_allclose(by_ultrasonic @ expansion, by_display, atol=1e-12)
    change = dict(zip(ultrasonic.names, expansion, strict=True))
    for broken in (
        change["A4"] - change["A5"] - change["B3"],
        change["B4"] - change["B5"] - change["A3"],
        change["A6"] - change["B6"],
    ):
        np.testing.assert_allclose(broken, 0, atol=1e-12)


def test_reduced_ultrasonic_model_is_the_final_model_of_the_paper() -> None:
    reduced = RationalPolynomial.ultrasonic(reduced=True)
    a0, a1, a6, a7, b0, b1, b2, b6, b7 = values = np.arange(1.0, 10.0)
    x, y = 0.7, -0.4
    expected = [
        a0 + a1 * x + a6 * x * y**2 + a7 * x**4,
        b0 + b1 * y + b2 * x + b6 * y * x**2 + b7 * y**4,
    ]
    np.testing.assert_allclose(reduced.with_values(values)([[x, y]]), [expected], rtol=1e-14)
