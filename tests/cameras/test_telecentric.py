"""Parallel rays: an implementation of their own, what one image does not determine, and the datum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Camera, adjust_network
from reseau.bundle.solver.approximation import resect_parallel
from reseau.core.data import Array
from reseau.core.failure import Code
from reseau.optics.cameras.telecentric import Telecentric
from reseau.optics.poses import rotation_matrix

from ..bundle import networks

VALUES = np.array([8.0, 0.05, -0.04, -2e-4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def camera(*free: str, values: Array = VALUES) -> Camera:
    return Camera("cam", 640, 480, (0.01, 0.01), "telecentric", values, free)


def image(xyz: Array, rotation: Array, x0: Array, values: Array = VALUES) -> Array:
    """Pixels by formulas written out here: y up in millimetres, y down in pixels."""
    m, px, py, k1 = values[:4]
    x, y = m * (rotation[0] @ (xyz - x0).T), -m * (rotation[1] @ (xyz - x0).T)
    r2 = x**2 + y**2
    return np.column_stack([(px + x * (1 + k1 * r2)) / 0.01 + 319.5, 239.5 - (py + y * (1 + k1 * r2)) / 0.01])


def test_the_projection_is_that_of_its_formulas() -> None:
    rng = np.random.default_rng(1)
    xyz = rng.uniform(-0.3, 0.3, (50, 3))
    rotation = rotation_matrix(np.array([0.3, -0.5, 1.2]))
    x0 = np.array([0.1, -0.2, 4.0])
    seen = networks.image_points(camera(), rotation, x0, xyz)
    np.testing.assert_allclose(seen, image(xyz, rotation, x0), rtol=0, atol=1e-9)
    moved = networks.image_points(camera(), rotation, x0 + 7.0 * rotation[2], xyz)
    np.testing.assert_allclose(moved, seen, rtol=0, atol=1e-9)


def test_a_network_is_adjusted_and_says_what_images_do_not_determine() -> None:
    world = networks.world(cameras=(camera("m", "x0", "y0", "K1"),), size=0.28, sigma_px=0.02)
    result = adjust_network(world.noisy(3)).required()
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    estimate = result.cameras["cam"]
    assert (np.abs(estimate.values - VALUES[:4]) < 4 * estimate.sigma).all()
    told = [str(remark) for remark in result.warnings if remark.code is Code.NOT_IDENTIFIED]
    assert len(told) == 1
    assert "the distance of the camera along its axis is not determined" in told[0]
    # Distances from the true projection centres are arbitrary along the axis, and noise across it.
    off = np.einsum("nij,nj->ni", world.rotation, result.fit.values.x0 - world.x0)
    assert np.abs(off[:, :2]).max() < 0.02
    # Six unknowns of each image less one.
    assert result.fit.counts[1] == 4 + 5 * 6 + 3 * 20
    along = np.einsum(
        "ni,nij,nj->n", world.rotation[:, 2], result.pose_covariance[:, 3:, 3:], world.rotation[:, 2]
    )
    assert np.abs(along).max() < 1e-9


def test_without_distortion_the_principal_point_is_named_as_undetermined() -> None:
    values = VALUES.copy()
    values[3] = 0.0
    world = networks.world(cameras=(camera("m", "x0", "y0", values=values),), size=0.28)
    failure = adjust_network(world.noisy(1))
    assert failure.code is Code.RANK_DEFECT
    assert "x0 of camera cam" in failure.reason
    assert "y0 of camera cam" in failure.reason


@pytest.mark.parametrize("free", [("m", "K1"), ("K1",)])
def test_the_magnification_gives_the_scale_of_a_free_network(free: tuple[str, ...]) -> None:
    """Known, the magnification determines the scale; free, the scale is part of the datum."""
    world = networks.world(cameras=(camera(*free),), size=0.28, sigma_px=0.02)
    network = world.noisy(2)
    network = replace(
        network, datum="free", sigma=np.full_like(network.sigma, np.nan), xyz=world.xyz,
        role=("tie",) * len(network.points),
    )  # fmt: skip
    fit = adjust_network(network).required().fit
    assert fit.freedom.defect == 6 + ("m" in free)
    assert fit.sigma0 == pytest.approx(1.0, abs=0.2)


def test_two_tilts_of_a_plane_have_the_same_image() -> None:
    rng = np.random.default_rng(2)
    xyz = np.column_stack([rng.uniform(-1, 1, (20, 2)), np.zeros(20)])
    rotation = rotation_matrix(np.array([0.6, 0.2, -0.4]))
    uv = (xyz @ rotation.T)[:, :2]
    found = resect_parallel(xyz, uv, 1e-3)
    assert found is not None
    np.testing.assert_allclose(((xyz - found.x0) @ found.rotation.T)[:, :2], uv, atol=1e-9)
    mirrored = rotation * [[1, 1, -1], [1, 1, -1], [-1, -1, 1]]
    near = min(np.abs(found.rotation - each).max() for each in (rotation, mirrored))
    assert near < 1e-9
    gross = uv.copy()
    gross[:3] += 1.0
    robust = resect_parallel(xyz, gross, 1e-3)
    assert robust is not None
    assert robust.agree.tolist() == [False] * 3 + [True] * 17
    assert resect_parallel(xyz[:3], uv[:3], 1e-3) is None


def test_the_class_has_its_own_names() -> None:
    assert Telecentric().with_values({"m": 2.0}).value_of("m") == 2.0
