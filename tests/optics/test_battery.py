"""One battery for every plane mapping: derivatives, inverse, values, files."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.optics import Brown, Equidistant, OpenCV, PixelGrid, RationalPolynomial
from reseau.optics.cameras.brown import BrownDistortion
from reseau.optics.cameras.ebner import EbnerCorrection
from reseau.optics.composition import Chain, Inverted, Similarity
from reseau.optics.displays import wong_display
from reseau.optics.mapping import PlaneMapping


class Case(NamedTuple):
    """A model at a realistic place.

    `extent` is half the side of the square of points it is used on.
    """

    mapping: PlaneMapping
    extent: float
    centre: tuple[float, float] = (0.0, 0.0)

    def points(self, n: int = 40, seed: int = 7) -> Array:
        spread = np.random.default_rng(seed).uniform(-1, 1, (n, 2))
        return np.asarray(self.centre) + self.extent * spread


def _camera() -> RationalPolynomial:
    # Millimetres on a Polaroid, reseau system: tilt of some minutes, barrel distortion of 1 mm at the corner.
    return RationalPolynomial.camera().with_values(
        [1.01, 0.003, 0.4, -0.002, 0.99, -0.3, 2e-4, -1e-4, 1e-5, -2e-5, 8e-6, -2e-8, 3e-8]
    )


def _ultrasonic() -> RationalPolynomial:
    a = [0.3, 1.02, -0.01, 2e-4, -1e-4, 5e-5, 4e-6, 2e-8]
    b = [-0.2, 0.98, 0.02, -1e-4, 2e-4, 1e-4, 3e-6, -1e-8]
    return RationalPolynomial.ultrasonic().with_values([*a, *b])


def _seventh() -> RationalPolynomial:
    mapping = RationalPolynomial.polynomial(7, offset=(511.5, 383.5), scale=512.0)
    noise = np.random.default_rng(3).normal(0, 0.5, len(mapping.names))
    return mapping.with_values(mapping.values + noise)


def _projective() -> RationalPolynomial:
    return RationalPolynomial.projective().with_values([0.9, 0.2, 30.0, -0.1, 1.1, -12.0, 2e-4, -3e-4])


# A 36×24 mm camera with 24 mm lens: barrel distortion of 0.5 mm at the corner, decentering, affinity.
BROWN = [24.36, 0.11, -0.07, 2.2e-4, -1.5e-7, 1e-10, 2e-5, -1e-5, 3e-4, -2e-4]
# Some hundredths of a millimetre at the corner each.
EBNER = [1e-3, -8e-4, 1e-4, -1e-4, 2e-4, 1e-4, 1e-5, -2e-5, 1e-5, 2e-5, 1e-6, -1e-6]
GRID = PixelGrid(5616, 3744, (0.00641, 0.00642))
OPENCV = [800.0, 805.0, 319.0, 241.0, -0.28, 0.09, 8e-4, -5e-4, -0.012]
# A screen of 100 mm: 2 % pincushion at the corner, decentering, tilt and beam of some tenths of a millimetre.
DISPLAY = [0.01, 8e-6, -2e-9, 1e-13, 3e-5, 2e-9, 5e-5, -3e-9, 0.2, 1e-5, -2e-5, 4e-3, -0.1, 5e-3, -2e-3]
RATIONAL = [*OPENCV[:4], 0.3, -0.1, 8e-4, -5e-4, 0.02, 0.55, 0.04, -0.01]


CASES: dict[str, Callable[[], Case]] = {
    "similarity": lambda: Case(Similarity([3.0, -4.0, 0.8, 0.6]), 500),
    "similarity-mirrored": lambda: Case(Similarity([3.0, -4.0, 0.8, 0.6], mirrored=True), 500),
    "polynomial-similarity": lambda: Case(
        RationalPolynomial.similarity().with_values([3, -4, 0.8, 0.6]), 500
    ),
    "affine": lambda: Case(RationalPolynomial.affine().with_values([1.1, 0.2, 3, -0.1, 0.9, 7]), 500),
    "bilinear": lambda: Case(
        RationalPolynomial.bilinear().with_values([1.1, 0.2, 3, -0.1, 0.9, 7, 1e-5, -2e-5]), 500
    ),
    "projective": lambda: Case(_projective(), 400, (500.0, 400.0)),
    "camera": lambda: Case(_camera(), 50),
    "ultrasonic": lambda: Case(_ultrasonic(), 50),
    "ultrasonic-reduced": lambda: Case(
        RationalPolynomial.ultrasonic(reduced=True).with_values(
            [0.3, 1.02, 4e-6, 2e-8, -0.2, 0.98, 0.02, 3e-6, -1e-8]
        ),
        50,
    ),
    "polynomial-7": lambda: Case(_seventh(), 512, (511.5, 383.5)),
    "chain": lambda: Case(Chain(_camera(), _ultrasonic()), 50),
    "chain-labelled": lambda: Case(Chain(_camera(), _camera(), ("first.", "second.")), 50),
    "display": lambda: Case(wong_display().with_values(DISPLAY), 50),
    "brown-distortion": lambda: Case(BrownDistortion(BROWN[3:], 12.0), 18),
    "ebner": lambda: Case(EbnerCorrection(EBNER, 9.0), 12),
    "equidistant": lambda: Case(Equidistant([1.8], (480.0, 350.0), 480.0), 500, (480.0, 350.0)),
    "brown-object": lambda: Case(Brown(BROWN, "object"), 0.6),
    "brown-image": lambda: Case(Brown(BROWN, "image"), 0.6),
    "brown-object-pixels": lambda: Case(Brown(BROWN, "object", 12.0, GRID), 0.6),
    "brown-image-pixels": lambda: Case(Brown(BROWN, "image", 12.0, GRID), 0.6),
    "opencv": lambda: Case(OpenCV(OPENCV), 0.4),
    "opencv-rational": lambda: Case(OpenCV(RATIONAL), 0.6),
    "camera-corrected": lambda: Case(Inverted(OpenCV(OPENCV)), 250, (319.0, 241.0)),
    "inverted": lambda: Case(Inverted(_camera()), 45),
}
EVERY = pytest.mark.parametrize("case", [pytest.param(make(), id=name) for name, make in CASES.items()])


def numeric_by_point(case: Case, points: Array) -> Array:
    """Central differences of fourth order: exact to about 1e-10 of the derivative."""
    h = 1e-3 * case.extent
    columns = []
    for unit in np.eye(2) * h:
        near = case.mapping(points + unit) - case.mapping(points - unit)
        far = case.mapping(points + 2 * unit) - case.mapping(points - 2 * unit)
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=2)


def steps(case: Case, points: Array) -> Array:
    """For each parameter the change that moves some point by a hundred-thousandth of the image."""
    effect = np.abs(case.mapping.derivatives(points).d_parameters).max(axis=(0, 1))
    assert (effect > 0).all(), "a parameter without any effect"
    return 1e-5 * size(case, points) / effect


def size(case: Case, points: Array) -> float:
    """Half the width of the image of the points, in its unit."""
    return float(np.ptp(case.mapping(points), axis=0).max() / 2)


def numeric_by_parameter(case: Case, points: Array) -> Array:
    mapping, columns = case.mapping, []
    for k, h in enumerate(steps(case, points)):
        unit = np.zeros(len(mapping.names))
        unit[k] = h

        def moved(times: float, unit: Array = unit) -> Array:
            return mapping.with_values(mapping.values + times * unit)(points)

        columns.append((8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h))
    return np.stack(columns, axis=2) if columns else np.zeros((len(points), 2, 0))


@EVERY
def test_is_a_mapping(case: Case) -> None:
    assert isinstance(case.mapping, PlaneMapping)
    assert len(set(case.mapping.names)) == len(case.mapping.names) == len(case.mapping.values)


@EVERY
def test_value_of_derivatives_is_that_of_the_call(case: Case) -> None:
    points = case.points()
    np.testing.assert_allclose(
        case.mapping.derivatives(points).value, case.mapping(points), rtol=1e-13, atol=1e-11
    )


@EVERY
def test_derivative_by_the_point_equals_the_numeric_one(case: Case) -> None:
    points = case.points()
    analytic, numeric = case.mapping.derivatives(points).d_xy, numeric_by_point(case, points)
    np.testing.assert_allclose(analytic, numeric, rtol=0, atol=1e-8 * np.abs(numeric).max())


@EVERY
def test_derivative_by_every_parameter_equals_the_numeric_one(case: Case) -> None:
    points = case.points()
    analytic, numeric = case.mapping.derivatives(points).d_parameters, numeric_by_parameter(case, points)
    assert analytic.shape == (len(points), 2, len(case.mapping.names))
    # In units of the image: the parameter's effect is off by less than 1e-8 of it.
    scale = steps(case, points) / (1e-5 * size(case, points))
    np.testing.assert_allclose(analytic * scale, numeric * scale, rtol=0, atol=1e-8)


@EVERY
def test_differential_holds_for_every_set_of_free_parameters(case: Case) -> None:
    """A joint change of any free set is predicted by its own columns: all sets of up to 8, pairs of more."""
    points, mapping = case.points(8), case.mapping
    columns, h = mapping.derivatives(points).d_parameters, 0.1 * steps(case, points)
    u = len(h)
    for free in [c for n in range(u + 1) if u <= 8 or n == 2 for c in combinations(range(u), n)][:256]:
        change = np.zeros(len(h))
        change[list(free)] = h[list(free)]
        difference = mapping.with_values(mapping.values + change)(points) - mapping.with_values(
            mapping.values - change
        )(points)
        np.testing.assert_allclose(columns @ change, difference / 2, rtol=0, atol=1e-10 * size(case, points))


@EVERY
def test_inverse_returns_to_the_point(case: Case) -> None:
    points = case.points(2000)
    assert np.abs(case.mapping.inverse(case.mapping(points)) - points).max() < 1e-9


@EVERY
def test_forward_of_inverse_returns_to_the_image(case: Case) -> None:
    images = case.mapping(case.points(500, seed=11))
    assert np.abs(case.mapping(case.mapping.inverse(images)) - images).max() < 1e-9


@EVERY
def test_mapping_is_finite_at_the_origin_and_at_its_centre(case: Case) -> None:
    for part in case.mapping.derivatives([[0.0, 0.0], case.centre]):
        assert np.isfinite(part).all()


@EVERY
def test_mapping_accepts_zero_points(case: Case) -> None:
    none = np.zeros((0, 2))
    assert case.mapping(none).shape == case.mapping.inverse(none).shape == (0, 2)
    assert case.mapping.derivatives(none).d_parameters.shape == (0, 2, len(case.mapping.names))


@EVERY
def test_mapping_is_one_to_one_in_the_image(case: Case) -> None:
    assert case.mapping.one_to_one(case.points(500)).all()


@EVERY
def test_mapping_returns_nan_for_non_finite_points(case: Case) -> None:
    assert np.isnan(case.mapping.inverse([[np.nan, 0.0], [np.inf, 1.0]])).any(axis=1).all()


@EVERY
def test_with_values_changes_only_values(case: Case) -> None:
    mapping = case.mapping
    zero = mapping.with_values(np.zeros(len(mapping.names)))
    assert type(zero) is type(mapping)
    assert not zero.values.any()
    back = zero.with_values(dict(zip(mapping.names, mapping.values, strict=True)))
    np.testing.assert_array_equal(back(case.points()), mapping(case.points()))


@EVERY
def test_values_are_read_only(case: Case) -> None:
    before = case.mapping.values.copy()
    given = before.copy()
    mapping = case.mapping.with_values(given)
    given += 1.0
    np.testing.assert_array_equal(mapping.values, before)


@EVERY
def test_mapping_refuses_unknown_names_wrong_numbers_and_shapes(case: Case) -> None:
    with pytest.raises(UsageError, match="nonsense"):
        case.mapping.with_values({"nonsense": 1.0})
    with pytest.raises(UsageError):
        case.mapping.with_values(np.zeros(len(case.mapping.names) + 1))
    with pytest.raises(UsageError, match="shape"):
        case.mapping([1.0, 2.0])


@EVERY
def test_inverted_derivatives_are_the_inverse_matrices(case: Case) -> None:
    points = case.points(20)
    forward = case.mapping.derivatives(points)
    backward = Inverted(case.mapping).derivatives(forward.value)
    np.testing.assert_allclose(
        backward.d_xy @ forward.d_xy, np.broadcast_to(np.eye(2), (20, 2, 2)), atol=1e-9
    )


POLYNOMIALS = [name for name, make in CASES.items() if isinstance(make().mapping, RationalPolynomial)]


@pytest.mark.parametrize("name", POLYNOMIALS)
def test_polynomial_is_restored_from_its_dictionary(name: str) -> None:
    case = CASES[name]()
    mapping = case.mapping
    assert isinstance(mapping, RationalPolynomial)
    content = mapping.to_dict()
    again = RationalPolynomial.from_dict(content)
    assert again.to_dict() == content
    np.testing.assert_array_equal(again(case.points()), mapping(case.points()))
    bare = RationalPolynomial.from_dict(mapping.to_dict(values=False))
    assert bare.names == mapping.names
    assert not bare.values.any()


@EVERY
@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1))
def test_derivatives_and_inverse_are_correct_for_other_values(case: Case, seed: int) -> None:
    """Parameters changed so that each moves the image by up to 2 % of its size."""
    rng, points = np.random.default_rng(seed), case.points(25)
    u = len(case.mapping.names)
    change = rng.uniform(-1, 1, u) * 2000 * steps(case, points)
    other = case._replace(mapping=case.mapping.with_values(case.mapping.values + change))
    points = points[other.mapping.one_to_one(points)]
    direction = rng.uniform(-1, 1, u) * steps(case, case.points(25))
    ahead, behind = (
        other.mapping.with_values(other.mapping.values + s * direction)(points) for s in (0.5, -0.5)
    )
    found = other.mapping.derivatives(points)
    sure = np.isfinite(ahead + behind).all(axis=1)
    np.testing.assert_allclose(
        (found.d_parameters @ direction)[sure], (ahead - behind)[sure], rtol=0, atol=1e-9 * size(case, points)
    )
    # The condition of the inverse is that of the derivatives: near a fold it magnifies the rounding error.
    well = np.linalg.cond(found.d_xy) < 1e3
    back = other.mapping.inverse(found.value[well])
    assert np.abs(back - points[well]).max(initial=0) < 1e-9 * max(1.0, case.extent)
