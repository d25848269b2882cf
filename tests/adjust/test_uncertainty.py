"""Uncertainty budgets equal GTC where they are linear, closed forms, and Monte Carlo where they are not."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from reseau.adjust.uncertainty import Contribution, propagate, simulate, validate
from reseau.core.errors import UsageError


def test_linear_budgets_equal_gtc_to_1e_12() -> None:
    """Independent inputs with degrees of freedom, and inputs of one adjustment: GTC's ensembles."""
    gtc = pytest.importorskip("GTC")
    rng = np.random.default_rng(3)
    for _ in range(20):
        x, u, nu = rng.normal(size=6), rng.uniform(0.1, 2.0, 6), rng.uniform(2.0, 40.0, 6).round()
        r = rng.uniform(-0.8, 0.8)
        j = rng.normal(size=(2, 6))
        free = [gtc.ureal(x[k], u[k], nu[k]) for k in range(4)]
        pair = gtc.multiple_ureal([x[4], x[5]], [u[4], u[5]], nu[4], label_seq=["a", "b"])
        gtc.set_correlation(r, *pair)
        inputs = [*free, *pair]
        theirs = [sum(j[i, k] * inputs[k] for k in range(6)) for i in range(2)]
        ours = [Contribution(f"x{k}", np.diag(np.eye(6)[k] * u[k] ** 2), nu[k]) for k in range(4)]
        joint = np.zeros((6, 6))
        joint[4:, 4:] = [[u[4] ** 2, r * u[4] * u[5]], [r * u[4] * u[5], u[5] ** 2]]
        ours.append(Contribution("pair", joint, nu[4]))
        found = propagate(lambda a, j=j: a @ j.T, x, ours, names=("y", "z"), inputs=tuple("abcdef"),
                          sensitivities=j)  # fmt: skip
        for i in range(2):
            assert found.values[i] == pytest.approx(theirs[i].x, rel=1e-12, abs=1e-12)
            assert found.sigma[i] == pytest.approx(theirs[i].u, rel=1e-12)
            assert found.degrees[i] == pytest.approx(theirs[i].df, rel=1e-12)
            k = gtc.reporting.k_factor(theirs[i].df, 95)
            assert found.factor(0.95)[i] == pytest.approx(k, rel=1e-8)
            for k in range(4):
                component = abs(gtc.component(theirs[i], inputs[k]))
                assert found.by_contribution[k, i] == pytest.approx(component, rel=1e-12)
        covariance = gtc.get_covariance(*theirs)
        assert found.covariance[0, 1] == pytest.approx(covariance, rel=1e-12, abs=1e-12)


def test_the_end_gauge_of_the_gum() -> None:
    """JCGM 100:2008, H.1: 32 nm with 16 degrees of freedom, expanded by 2.92 to 93 nm at 99 %."""
    u_nm = np.array([25.0, 9.7, 2.9, 16.6])
    inputs = ("standard", "difference", "expansion", "temperature")
    nu = (18.0, 25.6, 50.0, 2.0)
    each = [Contribution(name, np.diag(np.eye(4)[k] * u_nm[k] ** 2), nu[k]) for k, name in enumerate(inputs)]
    found = propagate(lambda x: x.sum(axis=1, keepdims=True), np.zeros(4), each, names=("l",), inputs=inputs)
    assert round(found.sigma[0]) == 32
    assert int(found.degrees[0]) == 16
    assert scipy.stats.t.ppf(0.995, 16) == pytest.approx(2.92, abs=0.005)
    assert found.expanded(0.99)[0] == pytest.approx(93, abs=1.5)


def test_contributions_that_share_a_variance_factor_have_its_degrees_of_freedom() -> None:
    parts = [
        Contribution("a", np.array([[0.6]]), 7.0, group="s"),
        Contribution("b", np.array([[0.4]]), 7.0, group="s"),
    ]
    found = propagate(lambda x: x, np.zeros(1), parts, names=("y",), inputs=("x",))
    assert found.degrees[0] == pytest.approx(7.0)
    assert found.joint_degrees == pytest.approx(7.0)
    drawn = simulate(lambda x: x, np.zeros(1), parts, draws=200_000)
    assert drawn.high[0] == pytest.approx(scipy.stats.t.ppf(0.975, 7), abs=0.04)  # 5 standard errors


def test_the_ellipsoid_covers_what_it_promises() -> None:
    """Variances are estimated with 9 degrees of freedom: the ellipsoid holds the truth in 95 %."""
    rng = np.random.default_rng(8)
    shape = np.array([[1.0, 0.6, 0.0], [0.6, 2.0, 0.3], [0.0, 0.3, 0.5]])
    root, inside, trials = np.linalg.cholesky(shape), 0, 2000
    for _ in range(trials):
        off = root @ rng.standard_normal(3)
        scale = rng.chisquare(9) / 9
        found = propagate(
            lambda x: x, np.zeros(3), [Contribution("s", scale * shape, 9.0)], names="abc", inputs="abc"
        )
        inside += off @ np.linalg.solve(found.covariance, off) <= found.joint_factor(0.95) ** 2
    assert inside / trials == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / trials))


@pytest.mark.parametrize("distribution", ["normal", "rectangular", "triangular", "arcsine"])
def test_draws_have_the_stated_variance(distribution: str) -> None:
    c = np.array([[2.0, -0.5], [-0.5, 1.0]])
    found = simulate(lambda x: x, np.array([1.0, 2.0]), [Contribution("c", c, distribution=distribution)])  # type: ignore[arg-type]
    assert np.allclose(found.covariance, c, atol=0.04)  # 4 standard errors of 100 000 draws
    assert np.allclose(found.mean, [1.0, 2.0], atol=0.02)


def test_monte_carlo_agrees_with_closed_forms_and_the_difference_is_reported() -> None:
    """The sum of two squares (JCGM 101, 9.4) is linear far from zero, and not at zero."""
    noise = Contribution("noise", np.diag([0.005**2, 0.005**2]))
    for at, verdict in ((np.array([0.5, 0.0]), "linear"), (np.array([0.0, 0.0]), "not linear")):

        def square(x: np.ndarray) -> np.ndarray:
            return (x**2).sum(axis=1, keepdims=True)

        budget = propagate(square, at, [noise], names=("y",), inputs=("x1", "x2"))
        drawn = simulate(square, at, [noise], draws=200_000)
        told = validate(budget, drawn)
        assert told.verdicts == (verdict,)
        # Non-central χ² with two degrees of freedom.
        exact = scipy.stats.ncx2.ppf([0.025, 0.975], 2, (at @ at) / 0.005**2) * 0.005**2
        assert np.allclose([drawn.low[0], drawn.high[0]], exact, atol=5 * drawn.errors[2:].max())
        assert np.allclose(
            [told.low[0], told.high[0]], exact - budget.values[0] - np.array([-1, 1]) * budget.expanded()[0],
            atol=5 * drawn.errors[2:].max(),
        )  # fmt: skip


def test_the_mass_calibration_of_supplement_1_is_drawn_until_it_is_stable() -> None:
    """JCGM 101:2008, 9.3: u 0.0754 mg, shortest interval [1.0834, 1.3825] mg; by linear terms u 0.0539."""
    x = np.array([100_000.0, 1.234, 1.20, 8e3, 8e3])
    rectangular = (0.1, 1e3, 50.0)
    u = [0.05, 0.02, *(half / np.sqrt(3.0) for half in rectangular)]
    kinds = ("normal", "normal", "rectangular", "rectangular", "rectangular")
    inputs = [
        Contribution(f"x{k}", np.diag(np.eye(5)[k] * u[k] ** 2), distribution=kind)  # type: ignore[arg-type]
        for k, kind in enumerate(kinds)
    ]

    def difference(x: np.ndarray) -> np.ndarray:
        m, dm, air, w, r = x.T
        return ((m + dm) * (1 + (air - 1.2) * (1 / w - 1 / r)) - 100_000.0)[:, None]

    drawn = simulate(difference, x, inputs, draws=2_000_000, digits=2)
    assert drawn.stable
    assert drawn.draws < 2_000_000
    # Half of a unit of the second digit of u, as asked; our interval leaves out as much below as above.
    assert [drawn.sigma[0], drawn.high[0] - drawn.low[0]] == pytest.approx([0.0754, 0.2991], abs=5e-4)
    assert [drawn.low[0], drawn.high[0]] == pytest.approx([1.0834, 1.3825], abs=2e-3)
    budget = propagate(difference, x, inputs, names=("dm",), inputs=tuple("mdawr"))
    assert budget.sigma[0] == pytest.approx(0.0539, abs=5e-5)
    told = validate(budget, drawn, digits=2)
    assert told.verdicts == ("not linear",)
    # The differences of table 6.
    assert [-told.low[0], told.high[0]] == pytest.approx([0.0451, 0.0430], abs=2e-3)


def test_drawing_stops_when_asked_digits_are_stable_and_says_when_they_are_not() -> None:
    pair = [Contribution("c", np.array([[2.0, 0.5], [0.5, 3.0]]))]
    one, two = (
        simulate(lambda x: x, np.zeros(2), pair, draws=1_500_000, digits=digits, part=part)
        for digits, part in ((1, 1.0), (2, 0.2))
    )
    assert one.stable
    assert two.stable
    assert one.draws < two.draws < 1_500_000
    # Half of a unit of the last digit of 1.4, 1.7 and the joint factor √χ²(2) = 2.4, and a fifth of it.
    for found, off in ((one, 0.5), (two, 0.01)):
        assert np.abs(found.sigma - np.sqrt([2.0, 3.0])).max() < off
        assert found.joint_factor == pytest.approx(np.sqrt(scipy.stats.chi2.ppf(0.95, 2)), abs=off)
    few = simulate(lambda x: x, np.zeros(2), pair, draws=20_000, digits=3)
    assert few.stable is False
    assert few.draws == 20_000


def test_impossible_input_is_refused() -> None:
    def f(x: np.ndarray) -> np.ndarray:
        return x

    for covariance, said in (
        ([[1.0, 2.0], [2.0, 1.0]], "negative eigenvalues"),
        ([[1.0, 0.5], [0.0, 1.0]], "symmetric"),
    ):
        with pytest.raises(UsageError, match=said):
            propagate(f, np.zeros(2), [Contribution("c", np.array(covariance))], names="ab", inputs="ab")
    with pytest.raises(UsageError, match="no value"):
        propagate(lambda x: np.log(x), np.array([-1.0]), [], names="a", inputs="a")
    with pytest.raises(UsageError, match="degrees of freedom"):
        propagate(f, np.zeros(1), [Contribution("c", np.eye(1), 0.0)], names="a", inputs="a")
    with pytest.raises(UsageError, match="no result for"):
        simulate(lambda x: np.log(x), np.array([0.0]), [Contribution("c", np.eye(1))])
