"""Mappings fitted to points: recovery, covariance, elimination, and failures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from reseau.adjust import Adjustment, Options, adjust
from reseau.adjust.differences import differences
from reseau.adjust.elimination import Elimination
from reseau.core.data import ImagePoints
from reseau.core.errors import UsageError
from reseau.core.failure import Failure
from reseau.measure.fitting import fit_mapping, mapping_problem, reduce_mapping, residual_field
from reseau.optics import RationalPolynomial
from reseau.optics.composition import Chain, Similarity
from reseau.optics.mapping import PlaneMapping

X, Y = np.meshgrid(np.linspace(-60.0, 60.0, 9), np.linspace(-50.0, 50.0, 8))
XY = np.stack([X.ravel(), Y.ravel()], axis=1)
NAMES = tuple(f"m{i}" for i in range(len(XY)))


def families() -> dict[str, PlaneMapping]:
    camera = {"a1": 0.99, "b1": 2e-3, "c1": 0.3, "a2": -1e-3, "b2": 1.01, "c2": -0.2, "a0": 1e-4, "b0": -5e-5}
    film = {"d1": 5e-5, "d2": -4e-5, "k": 8e-7, "h1": 2e-8, "h2": -3e-8}
    radial = {"A6": 7e-7, "B6": 7e-7, "A3": 1e-5, "B5": -1e-5, "A7": 4e-9, "B7": -2e-9, "A0": 0.5, "A2": 1e-3}
    cubic = RationalPolynomial.polynomial(3, offset=(3.0, -2.0), scale=60.0)
    bent = cubic.values + np.random.default_rng(3).normal(0.0, 0.2, len(cubic.names))
    return {
        "similarity": RationalPolynomial.similarity().with_values(
            {"X0": 1.0, "Y0": 2.0, "a": 1.1, "b": 0.02}
        ),
        "affine": RationalPolynomial.affine().with_values({"a1": 1.1, "b1": 0.01, "c1": 3.0, "a2": -0.02}),
        "bilinear": RationalPolynomial.bilinear().with_values({"a1": 0.9, "d1": 2e-4, "d2": -1e-4}),
        "projective": RationalPolynomial.projective().with_values(camera),
        "camera": RationalPolynomial.camera().with_values(camera | film),
        "ultrasonic": RationalPolynomial.ultrasonic().with_values(radial),
        "ultrasonic reduced": RationalPolynomial.ultrasonic(reduced=True).with_values(
            {"A0": 0.5, "A6": 7e-7, "B2": 1e-3, "B7": -2e-9}
        ),
        "polynomial of degree 3": cubic.with_values(bent),
        "an own table of terms": RationalPolynomial(
            {"p": {"X": "x2 + 2y2"}, "q": {"Y": "x3"}, "r": {"D": "y"}, "s": {"NX": "x", "NY": "y"}},
        ).with_values({"p": 1e-4, "q": 2e-7, "r": 1e-4, "s": 1.02}),
        "a chain with a similarity": Chain(
            Similarity([0.0, 0.0, 1.0, 0.0]),
            RationalPolynomial({"k": {"X": "x3 + xy2", "Y": "y3 + yx2"}}, fixed={"X": "x", "Y": "y"}),
        ).with_values({"X0": 0.1, "a": 1.01, "b": -0.01, "k": 1e-6}),
    }


def approximate(model: PlaneMapping) -> PlaneMapping:
    """The same family at the approximate values a user begins from."""
    if isinstance(model, RationalPolynomial):
        if set(model.names) >= {"X_00", "Y_00"}:
            return RationalPolynomial.polynomial(3, offset=model.offset, scale=model.scale)
        one = {name: 1.0 for name in ("a1", "b2", "a", "A1", "B1", "s") if name in model.names}
        return RationalPolynomial(model.terms, fixed=model.fixed).with_values(one)
    return model.with_values({"X0": 0.0, "Y0": 0.0, "a": 1.0, "b": 0.0, "k": 0.0})


def points(xy, sigma=0.01) -> ImagePoints:
    return ImagePoints.with_sigma(NAMES[: len(xy)], xy, sigma)


def noisy(seed, sigma, target_sigma=0.0, model=None):
    rng = np.random.default_rng(seed)
    model = families()["camera"] if model is None else model
    seen = points(XY + rng.normal(0, 1, XY.shape) * sigma, sigma)
    return seen, model(XY) + rng.normal(0, 1, XY.shape) * target_sigma


@pytest.mark.parametrize("name", families())
def test_every_family_is_recovered_from_points_without_noise(name):
    model = families()[name]
    fit = fit_mapping(approximate(model), points(XY), model(XY)).required()
    # What a coefficient does to the outermost mark must be right to a nanometre.
    effect = np.abs(model.derivatives(XY).d_parameters).max(axis=(0, 1))
    assert np.abs((fit.values - model.values) * effect).max() < 1e-6
    assert fit.redundancy == 2 * len(XY) - len(model.names)
    assert np.abs(fit.residuals).max() < 1e-6


@pytest.mark.parametrize("name", families())
def test_the_jacobians_of_the_conditions_are_correct(name):
    model = families()[name]
    problem, at = mapping_problem(approximate(model), points(XY), model(XY)), np.array(model.values)
    by_parameters = differences(lambda x: problem.conditions(XY, x), at)
    # All points are shifted alike: each condition depends on its own only.
    by_points = differences(lambda shift: problem.conditions(XY + shift, at), np.zeros(2))
    for own, numeric in zip(problem.jacobians(XY, at), (by_parameters, by_points), strict=True):
        size = np.abs(numeric).max(axis=(0, 1))
        assert (np.abs(own - numeric) <= 1e-7 * np.where(size > 0, size, 1.0)).all()


def test_adding_the_residuals_moves_the_points_onto_the_model():
    seen, target = noisy(1, 0.05)
    fit = fit_mapping(RationalPolynomial.camera(), seen, target).required()
    adjusted = RationalPolynomial.camera().with_values(fit.values)(seen.xy + fit.residuals)
    np.testing.assert_allclose(adjusted, target, atol=1e-9)
    assert np.abs(fit.residuals).max() > 0.05


def test_points_with_larger_sigmas_have_less_weight():
    seen, target = noisy(2, 0.01)
    wrong = seen.xy.copy()
    wrong[7] += (3.0, -2.0)
    cov = seen.cov.copy()
    affected = fit_mapping(RationalPolynomial.camera(), ImagePoints(NAMES, wrong, cov), target).required()
    cov[7] *= 1e8
    spared = fit_mapping(RationalPolynomial.camera(), ImagePoints(NAMES, wrong, cov), target).required()
    without = np.arange(len(XY)) != 7
    truth = fit_mapping(RationalPolynomial.camera(), seen.select(without), target[without]).required()
    assert np.abs((spared.values - truth.values) / truth.sigma).max() < 1e-2
    assert np.abs((affected.values - truth.values) / truth.sigma).max() > 10


def test_the_sigma_of_the_target_is_used():
    """Points and target of a thousandth and a hundredth: as if the points had the root of both squared."""
    model = RationalPolynomial.affine().with_values({"a1": 2.0, "b2": 2.0})
    seen, target = noisy(3, 0.003, 0.008, model)
    one = fit_mapping(model, seen, target, 0.008).required()
    # The model doubles lengths: 0.008 there is 0.004 here.
    both = fit_mapping(model, ImagePoints.with_sigma(NAMES, seen.xy, 0.005), target).required()
    # To the noise of the derivatives the sigma is carried with.
    np.testing.assert_allclose(one.values, both.values, atol=1e-5)
    size = np.sqrt(np.outer(np.diag(both.cofactor), np.diag(both.cofactor)))
    np.testing.assert_allclose(one.cofactor / size, both.cofactor / size, atol=1e-4)
    assert one.cost == pytest.approx(both.cost, rel=1e-4)
    neglected = fit_mapping(model, seen, target).required()
    assert neglected.cost > 2 * one.cost


def test_the_sigmas_of_targets_may_differ_by_mark_and_axis():
    seen, target = noisy(4, 0.003)
    spread = np.zeros_like(target)
    spread[5, 1] = 10.0
    target[5, 1] += 5.0
    fit = fit_mapping(RationalPolynomial.camera(), seen, target, spread).required()
    assert fit.global_test(1e-4).passed
    spread[5] = spread[5, ::-1]
    assert (
        not fit_mapping(RationalPolynomial.camera(), seen, target, spread).required().global_test(1e-4).passed
    )


@pytest.mark.slow
def test_the_covariance_is_that_of_repeated_fits():
    model, sigma = families()["camera"], np.array([0.01, 0.03])
    runs = []
    for seed in range(120):
        rng = np.random.default_rng([seed, 5])
        seen = ImagePoints.with_sigma(NAMES, XY + rng.normal(0, 1, XY.shape) * sigma, sigma)
        runs.append(fit_mapping(model, seen, model(XY) + rng.normal(0, 0.01, XY.shape), 0.01).required())
    errors = np.array([fit.values - model.values for fit in runs])
    squares = np.einsum("ri,ij,rj->r", errors, np.linalg.inv(runs[0].cofactor), errors)
    low, high = chi2.ppf([0.0005, 0.9995], len(runs) * len(model.names))
    assert low < squares.sum() < high
    assert np.mean([fit.global_test(0.05).passed for fit in runs]) == pytest.approx(0.95, abs=0.06)


def test_too_few_coordinates_are_a_failure_that_counts_them():
    six = points(XY[:6])
    for found in (
        fit_mapping(RationalPolynomial.camera(), six, XY[:6]),
        reduce_mapping(RationalPolynomial.camera(), six, XY[:6]),
    ):
        assert not found
        assert isinstance(found, Failure)
        assert "6 points give 12 coordinates" in found.reason
        assert "13 parameters" in found.reason


def test_marks_on_one_line_are_a_failure_that_names_what_they_do_not_determine():
    line = np.stack([np.linspace(-60, 60, 20), np.zeros(20)], axis=1)
    found = fit_mapping(RationalPolynomial.affine(), points(line), line)
    assert isinstance(found, Failure)
    assert {name for vector in found.null_space for name in vector} == {"b1", "b2"}
    assert "b1" in found.reason
    assert "b2" in found.reason


def test_a_wrong_number_of_targets_is_an_error():
    with pytest.raises(UsageError, match="72 points"):
        mapping_problem(RationalPolynomial.affine(), points(XY), XY[:-1])


def test_reduction_drops_absent_terms_and_keeps_the_others():
    model = families()["camera"].with_values({"d2": 0.0, "h1": 0.0, "a0": 0.0})
    seen, target = noisy(6, 0.01, model=model)
    found = reduce_mapping(RationalPolynomial.camera(), seen, target, alpha=0.001).required()
    assert set(found.dropped) == {"d2", "h1", "a0"}
    assert all(step.test.distribution == "chi2" for step in found.steps)
    assert found.criterion == "chi2"
    again = adjust(
        mapping_problem(RationalPolynomial.camera().without(*found.dropped), seen, target)
    ).required()
    for name in again.names:
        assert found.adjustment[name] == pytest.approx(again[name], abs=1e-6 * again.sigma_of(name))


def test_reduction_keeps_the_requested_terms_and_passes_options_on():
    model = families()["camera"].with_values({"d2": 0.0, "h1": 0.0})
    seen, target = noisy(7, 0.01, model=model)
    found = reduce_mapping(
        RationalPolynomial.camera(),
        seen,
        target,
        alpha=0.001,
        criterion="t",
        keep=["d2"],
        options=Options(scale="a-priori"),
    )
    assert isinstance(found, Elimination)
    assert found.dropped == ("h1",)
    assert found.steps[0].test.distribution == "t"
    assert found.adjustment.scale == "a-priori"
    np.testing.assert_array_equal(found.adjustment.covariance, found.adjustment.cofactor)


def test_a_fit_contains_a_complete_adjustment():
    seen, target = noisy(8, 0.01)
    fit = fit_mapping(RationalPolynomial.camera(), seen, target)
    assert isinstance(fit, Adjustment)
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy)
    assert fit.names == RationalPolynomial.camera().names


def test_a_projectivity_needs_no_approximate_values():
    """Pixels, y down, far from the origin: the identity is of no use there."""
    model = RationalPolynomial.projective().with_values(
        {"a1": 9.0, "b1": 0.3, "c1": 800.0, "a2": 0.2, "b2": -9.1, "c2": 600.0, "a0": 1e-3, "b0": -7e-4}
    )
    fit = fit_mapping(RationalPolynomial.projective(), points(XY), model(XY)).required()
    np.testing.assert_allclose(fit.values, model.values, rtol=1e-9)
    near = fit_mapping(model, points(XY), model(XY)).required()
    np.testing.assert_allclose(near.values, model.values, rtol=1e-9)


def test_one_uncertain_point_needs_no_local_model():
    sigma = np.full(XY.shape, 0.01)
    sigma[-1] = 0.2
    needs, hills = [], []
    for seed in range(8):
        error = np.random.default_rng(seed).normal(0, 1, XY.shape) * sigma
        error[-1] = 0.6, -0.6
        model = RationalPolynomial.affine()
        seen = ImagePoints.with_sigma(NAMES, XY + error, sigma)
        fitted = model.with_values(fit_mapping(model, seen, XY).values)
        field = residual_field(fitted, seen, XY, fitted(seen.xy) - XY, trials=99)
        needs.append(field.need)
        hills.append(np.abs(field(XY[-1:])).max())
    assert np.median(needs) > 0.1
    assert np.median(hills) < 0.1
