"""Networks of wide lenses from cold: lost images are found again, and cold and warm start agree."""

from __future__ import annotations

import importlib
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.bundle import Network, Options, adjust_network
from reseau.bundle.diagnostics.control_check import control_shape
from reseau.exchange import read_network
from reseau.io.network import Network1

from . import networks

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
lenses = importlib.import_module("worlds.lenses")

FIVE = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
EIGHT = [*FIVE, "k4", "k5", "k6"]
DATA = Path(os.environ.get("RESEAU_DATA", "../shared/data")) / "independent" / "networks"


def network(document: dict[str, Any]) -> Network:
    return Network.from_document(Network1.from_content(json.loads(json.dumps(document)), where="test"))


def cold(lens: Any) -> dict[str, float]:
    """What a user writes: a rough focal length, the middle of the image, no distortion."""
    f = 1.07 * float(lens.matrix[0, 0])
    return {"fx": f, "fy": f, "cx": (lens.width - 1) / 2, "cy": (lens.height - 1) / 2}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("half_diagonal", "free", "seed"),
    [*(pytest.param(half, FIVE, 2, marks=pytest.mark.slow) for half in (62, 70)), (70, EIGHT, 2)],
)
def test_cold_and_warm_start_of_a_wide_lens_agree(half_diagonal: float, free: list[str], seed: int) -> None:
    lens = lenses.fisheye(half_diagonal)
    flat, true = lenses.board(8, 6, 1.0)
    seen = lenses.views(lens, flat, true, 20, 0.3, seed)
    first = adjust_network(network(lenses.document(lens, flat, seen, cold(lens), free))).required()
    assert first.fit.usable.images.all()
    warm = dict(zip(first.network.cameras[0].names, first.cameras["A"].values.tolist(), strict=False))
    again = adjust_network(network(lenses.document(lens, flat, seen, warm, free))).required()
    assert again.fit.usable.observations.all()
    assert again.fit.cost == pytest.approx(first.fit.cost, rel=1e-6)
    sigma = first.cameras["A"].sigma
    assert (np.abs(first.cameras["A"].values - again.cameras["A"].values) < 0.01 * sigma).all()


@pytest.mark.slow
def test_eight_coefficients_of_a_bent_board_converge() -> None:
    """Coefficients with correlations beyond 0.999999; a board held as designed that is bent."""
    lens = lenses.fisheye(74)
    flat, true = lenses.board(7, 7, 1.4, 0.03)
    seen = lenses.views(lens, flat, true, 40, 0.1, 5)
    result = adjust_network(network(lenses.document(lens, flat, seen, cold(lens), EIGHT))).required()
    assert result.fit.usable.observations.all()
    assert result.fit.offset < 1e-3
    assert 0.3 < result.sigma0 < 0.8
    # The bend of the board is not in the model, and shows in the focal length.
    assert abs(result.cameras["A"].values[0] - lens.matrix[0, 0]) < 5.0


@pytest.mark.slow
def test_an_observed_point_without_rays_does_not_stop_the_adjustment() -> None:
    """Robust weights and data snooping leave out all rays of points with observed coordinates."""
    world = networks.world(points=25, control=0)
    rays = world.network.point_of == 3
    sigma = np.full((25, 3), 0.01)
    net = replace(
        world.noisy(0), xyz=world.xyz.copy(), sigma=sigma, role=("control",) * 25, xy=world.network.xy.copy()
    )
    problem = world.problem(net)
    weights = np.ones(len(problem.observations))
    weights[: 2 * len(net.xy)][np.repeat(rays, 2)] = 0.0
    fit = problem.with_weights(weights).adjusted()
    assert fit
    assert not fit.usable.points[3]


@pytest.mark.slow
def test_an_image_with_mostly_gross_errors_is_left_out_as_a_whole() -> None:
    world = networks.world(images=8, points=30)
    net = world.noisy(1)
    rng = np.random.default_rng(2)
    bad = (net.image_of == 5) & (rng.uniform(size=len(net.xy)) < 0.8)
    net = replace(net, xy=net.xy + np.where(bad[:, None], rng.uniform(-60, 60, net.xy.shape), 0.0))
    result = adjust_network(net, Options(outliers="reject")).required()
    assert not result.fit.usable.observations[net.image_of == 5].any()
    assert any("image i5" in str(remark) and "as a whole" in str(remark) for remark in result.warnings)
    assert result.sigma0 < 1.2


@pytest.mark.skipif(not DATA.exists(), reason="needs the networks of RESEAU_DATA")
def test_an_exchange_that_changes_nothing_is_not_a_finding() -> None:
    """Four corners of a square that disagree in shape: to exchange opposite corners is a rotation."""
    shape = control_shape(read_network(DATA / "riva3.json"))
    assert shape is not None
    found = shape.doubt()
    assert "exchanged" not in found
    assert all(name in found for name in ("1001", "1002", "1003", "1004"))


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="needs the networks of RESEAU_DATA")
@pytest.mark.parametrize("outliers", ["keep", "reject"])
def test_a_real_wide_lens_ends_in_the_same_place_from_cold_and_warm(outliers: Any) -> None:
    found = [
        adjust_network(read_network(DATA / f"gopro_{kind}.json"), Options(outliers=outliers)).required()
        for kind in ("held", "warm")
    ]
    cameras = [result.cameras["A"] for result in found]
    assert (found[0].fit.usable.images == found[1].fit.usable.images).all()
    assert (np.abs(cameras[0].values - cameras[1].values) < 0.01 * cameras[0].sigma).all()
    if outliers == "keep":
        assert found[0].fit.usable.images.all()
        assert cameras[0].values[0] == pytest.approx(560.04, abs=0.05)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="needs the networks of RESEAU_DATA")
def test_rejection_works_where_the_plain_adjustment_does() -> None:
    """Published network: sigma0 1.094 of plain least squares, of images 8 to 41."""
    content = read_network(DATA / "riva5good.json")
    plain, careful = (adjust_network(content, Options(outliers=o)).required() for o in ("keep", "reject"))
    assert plain.sigma0 == pytest.approx(1.094, abs=5e-4)
    assert [content.images[i] for i in np.flatnonzero(~plain.fit.usable.images)] == list("01234567")
    assert careful.sigma0 < plain.sigma0
    assert careful.rejected.sum() < 0.06 * len(content.xy)
