"""Coefficients that a chosen model does not have: what they could do is in the covariance of the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Camera, Result
from reseau.bundle.diagnostics.considered import Rival
from reseau.bundle.diagnostics.fields import camera_mapping
from reseau.calibration import CameraMapping, calibration_difference, projection_field
from reseau.core.data import Array
from reseau.optics import PixelGrid
from reseau.optics.cameras.registry import camera_model

from . import networks

RUNS = 20
FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
NAMES = networks.camera("opencv").names


def lens(k3: float, free: tuple[str, ...] = FREE) -> Camera:
    values = np.array([420.0, 418.0, 321.0, 238.0, -0.2, 0.05, 4e-4, -3e-4, k3, 0.0, 0.0, 0.0])
    return Camera("cam", 640, 480, (0.01, 0.01), "opencv", values, free)


def result(true: Camera, seed: int, *, considers: bool, free: tuple[str, ...] = FREE) -> Result:
    """An adjustment without k3 of images that show points in their middle."""
    world = networks.world(images=6, points=30, cameras=(true,), seed=seed, datum="free", control=0, size=1.6)
    network = replace(world.noisy(seed), cameras=(replace(lens(0.0), free=free),))
    fit = world.problem(network).adjusted().required()
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool), rivals=((),) if considers else None)


def ratio(k3: float, seed: int, *, considers: bool) -> float:
    """Mean square error in the corners by the variance that is claimed there."""
    true = lens(k3, FREE)
    found = camera_mapping(result(true, seed, considers=considers), 0)
    truth = replace(found, mapping=true.bare_mapping(), covariance=np.zeros_like(found.covariance))
    off = calibration_difference(found, truth, 9)
    variance = np.trace(off.cov, axis1=2, axis2=3)
    corners = np.ix_([0, -1], [0, -1])
    square: Array = (off.difference**2).sum(axis=2)
    return float(square[corners].sum() / variance[corners].sum())


@pytest.mark.slow
def test_a_coefficient_that_was_not_estimated_is_in_the_uncertainty_of_the_corners() -> None:
    # Each term is a quarter of the one before it, of either sign: k1, k2 and this k3 are such a series.
    k3 = 0.0125 * np.random.default_rng(11).normal(size=RUNS)
    with_it, without = (
        np.array([ratio(k, seed, considers=considers) for seed, k in enumerate(k3)])
        for considers in (True, False)
    )
    assert without.mean() > 2
    assert 0.1 < with_it.mean() < 1.5
    assert with_it.max() < 4


def test_no_more_is_claimed_than_where_the_coefficient_is_estimated() -> None:
    """Points up to the corners: they say as much of a coefficient that is held."""
    true = lens(0.0)
    world = networks.world(images=12, points=300, cameras=(true,), datum="free", control=0, size=2.4)
    sigma = []
    for free, considers in ((FREE, False), (FREE, True), ((*FREE, "k3"), False)):
        network = replace(world.noisy(1), cameras=(replace(true, free=free),))
        fit = world.problem(network).adjusted().required()
        rejected, rivals = np.zeros(len(network.xy), dtype=bool), ((),) if considers else None
        result = Result(network, fit, rejected, rivals=rivals)
        sigma.append(projection_field(camera_mapping(result, 0), 9).sigma)
    held, considered, estimated = sigma
    assert (considered >= held - 1e-12).all()
    assert (considered < 1.1 * np.maximum(estimated, held)).all()


def test_denominators_that_repeat_the_powers_are_not_considered() -> None:
    found = camera_mapping(result(lens(0.0), 2, considers=True), 0)
    assert found.names == (*FREE, "k3")
    every = result(lens(0.0), 2, considers=True, free=(*FREE, "k3"))
    assert camera_mapping(every, 0).names == (*FREE, "k3")
    assert every.uncertainty(every.camera_columns(0)[1]).covariance == pytest.approx(
        replace(every, rivals=None).uncertainty(every.camera_columns(0)[1]).covariance
    )


def test_a_model_of_another_kind_is_in_the_uncertainty_as_probable_as_it_is() -> None:
    """Points up to the corners: parameters describe the other model where points are seen."""
    true, grid = lens(0.0), PixelGrid(640, 480, (0.01, 0.01))
    world = networks.world(images=12, points=300, cameras=(true,), datum="free", control=0, size=2.4)
    fit = world.problem(world.noisy(3)).adjusted().required()
    alone = Result(world.network, fit, np.zeros(len(world.network.xy), dtype=bool), rivals=((),))
    chosen, model = camera_mapping(alone, 0), camera_model("division")
    values = np.zeros(len(model.names))
    values[:5] = *chosen.mapping.values[:4], -0.2
    other = CameraMapping(model.mapping(values, grid), 640, 480, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))
    between = calibration_difference(replace(chosen, covariance=0 * chosen.covariance), other, 9).difference
    with_it = replace(alone, rivals=((Rival(0.25, other),),))
    more = projection_field(camera_mapping(with_it, 0), 9).cov - projection_field(chosen, 9).cov
    claimed, inner = np.sqrt(np.trace(more, axis1=2, axis2=3))[1:-1, 1:-1], between[1:-1, 1:-1]
    off = np.hypot(*np.moveaxis(inner, -1, 0))
    assert off.max() > 1
    # What no parameters of the chosen model describe is less than a fifth of the difference.
    assert claimed == pytest.approx(0.5 * off, abs=0.1 * off.max())
