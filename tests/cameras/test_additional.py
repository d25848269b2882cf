"""One battery for every model of additional parameters; none of its tests knows a model by its name."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import scipy.stats

from reseau.bundle import Camera, Network, Result, adjust_network
from reseau.bundle.network.camera import Additional
from reseau.bundle.solver.system import residuals
from reseau.bundle.solver.unknowns import Unknowns
from reseau.core.data import Array
from reseau.core.failure import Failure
from reseau.io.network import AdditionalParameters
from reseau.optics import PixelGrid, additional_models
from reseau.optics.cameras.registry import AdditionalModel
from reseau.optics.cameras.series import ChebyshevCorrection, FourierCorrection

from ..bundle import networks

BASE = 3.2
"""Half of the longer side of the image of the camera, mm."""
CENTRE = np.array([0.03, -0.02])
GRID = PixelGrid(640, 480, (0.01, 0.01))
EVERY = pytest.mark.parametrize("model", [pytest.param(m, id=m.name) for m in additional_models()])
# Those of a size that some hundred image points determine.
FEW = pytest.mark.parametrize(
    "model", [pytest.param(m, id=m.name) for m in additional_models() if len(m.names) <= 24]
)


def values_of(model: AdditionalModel, seed: int = 0) -> Array:
    """Random values with an effect of some hundredths of a millimetre."""
    effect = model.build(np.zeros(len(model.names)), BASE).derivatives([[2.5, -1.9]]).d_parameters[0]
    scale = np.maximum(np.abs(effect).max(axis=0), 0.3)
    return np.random.default_rng(seed).uniform(-0.02, 0.02, len(model.names)) / scale


def photo(n: int = 30) -> Array:
    return np.random.default_rng(1).uniform(-1, 1, (n, 2)) * [3.2, 2.4]


@EVERY
def test_derivatives_agree_with_finite_differences(model: AdditionalModel) -> None:
    mapping, xy, h = model.build(values_of(model), BASE), photo(), 1e-3
    found = mapping.derivatives(xy)
    np.testing.assert_allclose(mapping(xy), found.value, rtol=0, atol=1e-14)
    for axis in (0, 1):
        step = h * np.eye(2)[axis]
        near = mapping(xy + step) - mapping(xy - step)
        far = mapping(xy + 2 * step) - mapping(xy - 2 * step)
        np.testing.assert_allclose(found.d_xy[:, :, axis], (8 * near - far) / (12 * h), rtol=0, atol=1e-9)
    # They are linear in their parameters.
    np.testing.assert_allclose(found.value, xy + found.d_parameters @ mapping.values, rtol=0, atol=1e-14)
    np.testing.assert_allclose(mapping.inverse(mapping(xy)), xy, rtol=0, atol=1e-10)


def bent_world(
    model: AdditionalModel, images: int = 8, points: int = 60, sigma_px: float = 0.02
) -> tuple[networks.World, Array]:
    """A world whose camera has these additional parameters, and their values."""
    extra = Additional(BASE, model=model.name)
    free = ("c", "x0", "y0")
    lens = np.array([8.0, 0.03, -0.02] + 7 * [0.0])
    camera = Camera("cam", 640, 480, (0.01, 0.01), "brown", lens, free, {"side": "object"})
    world = networks.world(images=images, points=points, cameras=(camera,), sigma_px=sigma_px, size=1.2)
    values = values_of(model)
    ideal = GRID.to_photo(world.network.xy) - CENTRE
    moved = GRID.to_pixels(model.build(values, BASE)(ideal) + CENTRE)
    network = replace(world.network, xy=moved, cameras=(replace(camera, additional=extra),))
    return replace(world, network=network), values


@EVERY
def test_the_kernel_of_the_bundle_agrees_with_the_mapping(model: AdditionalModel) -> None:
    world, values = bent_world(model, images=2, points=15)
    problem = world.problem()
    unknowns = Unknowns.of(world.network, np.ones(2, dtype=bool))
    rows = np.arange(len(world.network.xy))
    off = residuals(world.network, unknowns, rows, replace(problem.start, extra=values[None]))
    np.testing.assert_allclose(off, 0.0, rtol=0, atol=1e-9)


def result_of(world: networks.World, values: Array, seed: int) -> Result:
    network: Network = world.noisy(seed)
    problem = world.problem(network)
    fit = replace(problem, start=replace(problem.start, extra=values[None].copy())).adjusted()
    assert not isinstance(fit, Failure)
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool), ())


def normalised(model: AdditionalModel, seeds: range) -> Array:
    """Squares of the errors of all parameters in their joint covariance, over their number."""
    # With many parameters first order suffices only with little noise.
    world, values = bent_world(model, sigma_px=0.02 if len(model.names) <= 24 else 0.001)
    true, squares = np.array([8.0, 0.03, -0.02, *values]), []
    for seed in seeds:
        result = result_of(world, values, seed)
        off = result.camera_columns(0)[2] - true
        squares.append(off @ np.linalg.solve(result.formal_camera_covariance(0), off) / len(off))
    return np.array(squares)


@FEW
def test_covariances_cover_the_errors(model: AdditionalModel) -> None:
    u = 3 + len(model.names)
    low, high = scipy.stats.chi2.ppf([5e-5, 1 - 5e-5], 4 * u) / (4 * u)
    assert low < normalised(model, range(4)).mean() < high


@pytest.mark.slow
@EVERY
def test_standard_deviations_are_right_to_five_percent(model: AdditionalModel) -> None:
    assert 0.95 < np.sqrt(normalised(model, range(100, 300)).mean()) < 1.05


@pytest.mark.slow
@FEW
def test_each_parameter_is_tested(model: AdditionalModel) -> None:
    """From approximate values found by the adjustment; parameters that are not there are not significant."""
    world, values = bent_world(model)
    result = adjust_network(world.noisy(1)).required()
    assert result.sigma0 == pytest.approx(1.0, abs=0.15)
    tests = {test.name: test for test in result.camera_tests(0)}
    assert set(tests) == set(model.names)
    assert sum(test.significant for test in tests.values()) > 0.6 * len(tests)
    plain = replace(world.network, xy=GRID.to_pixels(unbent(world, model, values)))
    none = adjust_network(replace(world, network=plain).noisy(1)).required()
    # At 5 % one of twenty is significant by chance.
    assert sum(test.significant for test in none.camera_tests(0)) < 4 + 0.05 * len(tests)


def unbent(world: networks.World, model: AdditionalModel, values: Array) -> Array:
    back = model.build(values, BASE).inverse(GRID.to_photo(world.network.xy) - CENTRE)
    return back + CENTRE


@EVERY
def test_files_know_the_model(model: AdditionalModel) -> None:
    entry = AdditionalParameters(model=model.name, base_mm=BASE, free=True)
    assert Additional(entry.base_mm, model=entry.model).names == model.names


def test_chebyshev_is_orthogonal_to_itself_and_to_the_orientations() -> None:
    """With Chebyshev's weight: sums over the zeros of a polynomial of higher degree are exact."""
    nodes = np.cos(np.pi * (np.arange(20) + 0.5) / 20)
    xy = np.array(list(product(nodes, nodes)))
    x, y = xy.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    orientations = [(one, zero), (zero, one), (x, y), (y, -x), (1 + x * x, x * y), (x * y, 1 + y * y)]
    # Shifts are part of the tilts.
    fields = np.array([np.column_stack(each).ravel() for each in orientations])
    own = ChebyshevCorrection(base_mm=1.0, degree=5).derivatives(xy).d_parameters
    own = own.reshape(-1, own.shape[2])
    gram = own.T @ own
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-9)
    np.testing.assert_allclose(fields @ own, 0.0, atol=1e-9)
    # Together they span all polynomials of this degree.
    assert np.linalg.matrix_rank(np.vstack([fields, own.T])) == 2 * 21


def test_chebyshev_and_fourier_are_those_of_numpy() -> None:
    xy = photo() / BASE
    cheb = ChebyshevCorrection(base_mm=1.0, degree=4).derivatives(xy).d_parameters
    products = np.polynomial.chebyshev.chebvander2d(*xy.T, [4, 4])
    # Degree 3 begins with the seventh: T3(X), T2(X)T1(Y), …
    for k, (m, n) in enumerate([(3, 0), (2, 1), (1, 2), (0, 3), (4, 0), (3, 1), (2, 2), (1, 3), (0, 4)]):
        np.testing.assert_allclose(cheb[:, 0, 6 + 2 * k], products[:, 5 * m + n], atol=1e-13)
        np.testing.assert_allclose(cheb[:, 1, 7 + 2 * k], products[:, 5 * m + n], atol=1e-13)
    four = FourierCorrection(base_mm=1.0, degree=1).derivatives(xy).d_parameters
    u, v = np.pi * xy.T
    for k, angle in enumerate((v, u - v, u, u + v)):
        wave = np.exp(1j * angle)
        np.testing.assert_allclose(four[:, 0, 4 * k], wave.real, atol=1e-13)
        np.testing.assert_allclose(four[:, 1, 4 * k + 3], wave.imag, atol=1e-13)
