"""What is found in a network: blunders, needless parameters, variance components, what nothing determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.adjust import variance_components
from reseau.bundle import Network, Options, Result, adjust_network, calibration_of
from reseau.bundle.modelling.search import Selection, cross_validation, eliminate_parameters
from reseau.bundle.solver.problem import BundleFit, BundleProblem
from reseau.calibration import Calibration
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure

from ..montecarlo import slowly
from . import networks

SIMPLE = networks.camera(free=("c", "x0", "y0", "K1", "K2"))


def required(result: object) -> Result:
    assert isinstance(result, Result), result
    return result


def disturbed(network: Network, part: float, seed: int) -> tuple[Network, set[int]]:
    """A part of the image points moved by 5 to 60 pixels in both coordinates."""
    rng = np.random.default_rng(seed)
    n = len(network.xy)
    bad = rng.choice(n, int(part * n), replace=False)
    xy = network.xy.copy()
    xy[bad] += rng.uniform(5, 60, (len(bad), 2)) * rng.choice([-1, 1], (len(bad), 2))
    return replace(network, xy=xy), set(bad.tolist())


@pytest.mark.slow
@pytest.mark.parametrize("control", [0, pytest.param(6, marks=pytest.mark.slow)])
def test_of_forty_percent_gross_errors_nearly_all_are_found_from_no_approximate_values(control: int) -> None:
    datum = "control" if control else "free"
    world = networks.world(images=10, points=60, seed=4, cameras=(SIMPLE,), control=control, datum=datum)
    network = world.noisy(1)
    rng = np.random.default_rng(5)
    bad = rng.random(len(network.xy)) < 0.4
    anywhere = rng.uniform(0, 1, network.xy.shape) * [640, 480]
    network = replace(network, xy=np.where(bad[:, None], anywhere, network.xy))
    result = adjust_network(network, Options(outliers="reject")).required()
    (camera,) = result.cameras.values()
    true = [dict(zip(SIMPLE.names, SIMPLE.values, strict=True))[name] for name in camera.parameters]
    assert (np.abs(camera.values - true) < 6 * camera.sigma).all()
    enough = np.bincount(network.point_of[~bad], minlength=60)[network.point_of] >= 3
    assert (result.rejected & bad & enough).sum() >= 0.95 * (bad & enough).sum()
    assert (result.rejected & ~bad & enough).sum() <= 0.02 * (~bad & enough).sum()


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.01, *slowly(0.1), 0.2])
def test_gross_errors_are_found_with_few_false_rejections(part: float) -> None:
    world = networks.world(images=8, points=60, seed=2, cameras=(SIMPLE,))
    network, bad = disturbed(world.noisy(1), part, 1)
    result = required(adjust_network(network, Options(outliers="reject", max_fraction=0.4)))
    found = set(np.flatnonzero(result.rejected).tolist())
    # What is left of a point by other blunders may control nothing: then its own are left out with the point.
    controlled = np.nan_to_num(result.redundancy_numbers).sum(axis=1) > 0.1
    assert all(not controlled[k] for k in bad - found)
    # At a level of 0.001, and with few rays left to many points, some good ones are lost.
    assert len(found - bad) <= 0.02 * len(network.xy)
    assert 0.85 < result.sigma0 < 1.1


@pytest.mark.slow
def test_gross_errors_that_are_kept_are_named() -> None:
    world = networks.world(images=8, points=60, seed=2, cameras=(SIMPLE,))
    network, bad = disturbed(world.noisy(1), 0.01, 1)
    result = required(adjust_network(network))
    remark = next(w.text for w in result.warnings if "gross errors are likely in" in w.text)
    named = networks.points_of(remark)
    for k in bad:
        assert (network.images[network.image_of[k]], network.points[network.point_of[k]]) in named


@pytest.mark.slow
def test_too_many_gross_errors_are_refused() -> None:
    world = networks.world(images=8, points=60, seed=2, cameras=(SIMPLE,))
    network, _ = disturbed(world.noisy(1), 0.2, 1)
    result = adjust_network(network, Options(outliers="reject", max_fraction=0.1))
    assert not result
    assert isinstance(result, Failure)
    assert result.code is Code.TOO_MANY_OUTLIERS
    assert "check the model" in result.reason


def test_variance_components_distinguish_rows_from_columns() -> None:
    world = networks.world(images=8, points=60, seed=2)
    noise = np.random.default_rng(3).normal(size=world.network.xy.shape) * [0.05, 0.08]
    cov = np.tile(np.diag([0.05, 0.05]) ** 2, (len(noise), 1, 1))
    problem = world.problem(replace(world.network, xy=world.network.xy + noise, cov=cov))
    rows = np.tile([False, True], len(noise))
    found = variance_components(problem, {"columns": ~rows, "rows": rows}).required()
    assert abs(found["columns"] - 1.0) < 3 * found.sigma[0]
    assert abs(found["rows"] - 1.6) < 3 * found.sigma[1]


@pytest.mark.slow
def test_unnecessary_parameters_are_dropped_and_necessary_ones_kept() -> None:
    cam = networks.camera(free=("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "B1", "B2"))
    values = cam.values.copy()
    values[4:] = 0.0
    world = networks.world(images=8, points=60, seed=2, cameras=(replace(cam, values=values),))
    network = world.noisy(5)
    found = eliminate_parameters(network, alpha=0.001)
    assert isinstance(found, Selection)
    assert found.network.cameras[0].free == ("c", "x0", "y0", "K1")
    full, reduced = cross_validation(network), cross_validation(found.network)
    assert isinstance(full, float)
    assert isinstance(reduced, float)
    assert reduced < full


def undetermined_camera() -> BundleProblem:
    """Affinity B1 and the principal distance with the scale of y are one and the same in one view only."""
    cam = networks.camera(free=("c", "K1"))
    world = networks.world(images=4, points=20, cameras=(cam,), control=20)
    # All points seen at one radius alone: c and K1 cannot be distinguished.
    flat = replace(world.network, sigma=np.zeros((20, 3)), xyz=world.xyz)
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(20)])
    rotation = np.tile(np.diag([1.0, -1.0, -1.0]), (4, 1, 1))
    x0 = np.tile([0.0, 0.0, 4.0], (4, 1))
    xy = np.concatenate([networks.image_points(replace(cam, values=_centred(cam.values)), r, x, ring)
                         for r, x in zip(rotation, x0, strict=True)])  # fmt: skip
    centred = replace(cam, values=_centred(cam.values))
    network = replace(
        flat, cameras=(centred,), xyz=ring, xy=xy, image_of=np.repeat(np.arange(4), 20),
        point_of=np.tile(np.arange(20), 4), cov=np.tile(np.eye(2), (80, 1, 1)),
    )  # fmt: skip
    return networks.World(network, rotation, x0, ring).problem()


def test_an_undetermined_camera_is_named() -> None:
    fit = undetermined_camera().adjusted()
    assert not isinstance(fit, BundleFit)
    assert "rank defect" in fit.reason
    assert "K1 of camera cam" in fit.reason


def test_nothing_is_named_where_the_full_matrix_exceeds_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reseau.bundle.solver.problem._FULL_COPIES", 10**8)
    fit = replace(undetermined_camera(), memory=1e9).adjusted()
    assert isinstance(fit, Failure)
    assert fit.code is Code.SINGULAR
    assert "With more memory" in fit.reason


def _centred(values: np.ndarray) -> np.ndarray:
    centred = np.zeros(10)
    centred[0], centred[3] = values[0], values[3]
    return centred


@pytest.mark.slow
@pytest.mark.parametrize("datum", ["control", "free"])
def test_predicted_covariances_cover(datum: str) -> None:
    """Mean squares of normalised errors of 60 networks; the benchmark has 400 of them."""
    world = networks.world(datum=datum, control=5 if datum == "control" else 0)
    table = []
    for seed in range(60):
        fit = world.problem(world.noisy(seed)).adjusted()
        assert isinstance(fit, BundleFit)
        table.append(networks.normalised_errors(world, fit))
    for name in table[0]:
        squares = np.array([row[name] for row in table])
        assert abs(squares.mean() - 1.0) < 4 * squares.std() / np.sqrt(60), name


def test_check_points_are_compared_and_do_not_change_the_result() -> None:
    world = networks.world(images=6, points=25)
    network = world.noisy(4)
    role = tuple("check" if k in (20, 21) else r for k, r in enumerate(network.role))
    xyz = network.xyz.copy()
    xyz[[20, 21]] = world.xyz[[20, 21]]
    plain = required(adjust_network(network))
    checked = required(adjust_network(replace(network, role=role, xyz=xyz)))
    rows, off = checked.check_points
    assert rows.tolist() == [20, 21]
    assert np.abs(off / checked.point_sigma[rows]).max() < 4
    np.testing.assert_allclose(plain.fit.values.xyz, checked.fit.values.xyz, atol=1e-8)


def test_the_calibration_of_a_camera_is_a_document_with_its_covariance() -> None:
    world = networks.world(images=8, points=60, seed=2, cameras=(SIMPLE,))
    result = required(adjust_network(world.noisy(1)))
    calibration = calibration_of(result, "cam", name="bench")
    again = Calibration.parse(calibration.to_json(), where="calibration")
    assert again == calibration
    assert again.covariance.names == SIMPLE.free
    assert again.parameters["c"].sigma == pytest.approx(np.sqrt(result.camera_covariance(0)[0, 0]))
    assert again.parameters["K3"].sigma == 0
    with pytest.raises(UsageError, match="other"):
        calibration_of(result, "other", name="bench")


def said(result: object) -> str:
    """The warnings of a result, or the reason of a failure."""
    return " ".join(map(str, result.warnings)) if isinstance(result, Result) else result.reason  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_mirrored_control_is_found() -> None:
    world = networks.world(images=8, points=40, control=6, cameras=(SIMPLE,))
    network = world.noisy(1)
    mirrored = replace(network, xyz=network.xyz * [1.0, -1.0, 1.0])
    assert "mirrored" in said(adjust_network(mirrored))


@pytest.mark.slow
def test_two_exchanged_control_points_are_named() -> None:
    world = networks.world(images=8, points=40, control=6, cameras=(SIMPLE,))
    network = world.noisy(1)
    xyz = network.xyz.copy()
    xyz[[1, 4]] = xyz[[4, 1]]
    assert "control points p1 and p4 look exchanged" in said(adjust_network(replace(network, xyz=xyz)))


def test_a_wrong_control_point_is_named() -> None:
    world = networks.world(images=8, points=40, control=7, cameras=(SIMPLE,))
    network = world.noisy(1)
    xyz = network.xyz.copy()
    xyz[3, 2] += 0.3
    assert "control point p3 (by 0.3 m, w " in said(adjust_network(replace(network, xyz=xyz)))


def test_swapped_names_in_an_image_are_left_out() -> None:
    world = networks.world(images=8, points=40, control=6, cameras=(SIMPLE,))
    network = world.noisy(1)
    xy = network.xy.copy()
    rows = np.flatnonzero(network.image_of == 2)[[10, 20]]
    xy[rows] = xy[rows[::-1]]
    result = required(adjust_network(replace(network, xy=xy), Options(outliers="reject")))
    assert set(rows.tolist()) <= set(np.flatnonzero(result.rejected).tolist())


@pytest.mark.parametrize("sigma", [2.0, 20.0, 200.0])
def test_highly_correlated_distortion_has_covariances_and_is_not_called_singular(sigma: float) -> None:
    """All coefficients of a rational distortion: their normal equations lose most of their digits."""
    free = ("fx", "fy", "k1", "k2", "k3", "k4", "k5", "k6")
    camera = networks.camera("opencv", free, sigma=dict.fromkeys(free[2:], sigma))
    camera = replace(camera, values=np.array([800.0, 800.0, 319.5, 239.5, -0.1, 0.02, *6 * [0.0]]))
    world = networks.world(images=3, points=20, control=6, cameras=(camera,), sigma_px=0.003)
    result = required(adjust_network(world.noisy(0)))
    tie = np.array([role == "tie" for role in world.network.role])
    off, cov = (result.points.xyz - world.xyz)[tie], result.points.cov[tie]
    normalised = np.einsum("pi,pij,pj->p", off, np.linalg.inv(cov), off).mean() / 3
    assert 0.7 < normalised < 1.3
    assert 1.3e-5 < np.sqrt(np.trace(cov, axis1=1, axis2=2) / 3).mean() < 1.6e-5
