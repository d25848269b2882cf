"""The model of the target: flat, bent, or free, with boards seen through a camera of OpenCV."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from reseau.bundle import Network, choose_board
from reseau.bundle.modelling.board import BoardChoice, held_as_designed
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.io.network import Network1

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
lenses = importlib.import_module("worlds.lenses")

MATRIX = np.array([[1200.0, 0, 645.0], [0, 1203.0, 475.0], [0, 0, 1]])
TRUE = {"fx": 1200.0, "fy": 1203.0, "cx": 645.0, "cy": 475.0, "k1": -0.1}


def network_of(warp: tuple[float, float] = (0.0, 0.0), rough: float = 0.0, seed: int = 4) -> Network:
    """Fifteen views of a board of 210 mm, bent by `warp` (mm), its points off by `rough` mm."""
    lens = lenses.Lens(1280, 960, MATRIX, np.array([-0.1, 0, 0, 0, 0]), widest=0.8)
    flat, _ = lenses.board(8, 6, 30.0)
    x = 2 * flat[:, :2] / np.ptp(flat[:, :2], axis=0) - 1
    true = flat + rough * np.random.default_rng(99).normal(size=flat.shape)
    true[:, 2] += (1 - x**2) @ warp
    seen = lenses.views(lens, flat, true, 15, 0.1, seed)
    start = {"fx": 1250.0, "fy": 1250.0, "cx": 639.5, "cy": 479.5}
    document = lenses.document(lens, flat, seen, start, list(TRUE), 0.1, "opencv")
    count = len(flat)
    document["points"] |= {"sigma": [None] * count, "role": ["tie"] * count}
    content = json.loads(json.dumps(document | {"datum": "free"}))
    return Network.from_document(Network1.from_content(content, where="test"))


def chosen(**arguments: float | tuple[float, float] | int) -> BoardChoice:
    found = choose_board(network_of(**arguments))  # type: ignore[arg-type]
    assert isinstance(found, BoardChoice)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("warp", "rough", "name"),
    [((0.0, 0.0), 0.0, "flat"), ((0.1, -0.04), 0.0, "warp"), ((0.5, 0.2), 0.1, "free")],
)
def test_the_simplest_sufficient_model_is_chosen(warp: tuple[float, float], rough: float, name: str) -> None:
    found = chosen(warp=warp, rough=rough)
    assert found.chosen.name == name
    assert [each.name for each in found.models] == ["flat", "warp", "free"]
    flat, bent, free = found.models
    assert flat.cost >= bent.cost >= free.cost
    assert (flat.p < 0.01) == (name != "flat")
    assert (bent.p < 0.01) == (name == "free")
    assert bool(found.network.held.all()) == (name == "flat")
    assert json.loads(json.dumps(found.entries()))["chosen"] == name


@pytest.mark.slow
def test_deflection_and_camera_are_covered_by_their_sigmas() -> None:
    """Ten draws of seven numbers; the interval has a probability of 0.9999 for independent ones."""
    warp, off = np.array([0.3, -0.1]), list[Array]()
    for seed in range(10):
        bent = chosen(warp=(0.3, -0.1), seed=seed).models[1]
        camera = [(bent.values[name] - true) / bent.sigma[name] for name, true in TRUE.items()]
        off.append(np.concatenate([(bent.warp - warp) / bent.warp_sigma, camera]))
    low, high = scipy.stats.chi2.ppf([5e-5, 1 - 5e-5], 70) / 70
    assert low < (np.array(off) ** 2).mean() < high


def test_a_bent_target_held_flat_has_a_wrong_camera() -> None:
    """What the test protects from: the focal length is off by more than its sigma says."""
    flat, bent, _ = chosen(warp=(1.0, -0.4)).models
    assert abs(flat.values["fx"] - 1200.0) > 2 * flat.sigma["fx"]
    assert abs(bent.values["fx"] - 1200.0) < 4 * bent.sigma["fx"]


def test_networks_of_other_kinds_are_refused() -> None:
    network = network_of()
    with pytest.raises(UsageError, match="inner constraints"):
        choose_board(held_as_designed(network))
    deep = network.xyz + np.arange(len(network.points))[:, None] * [0.0, 0.0, 1.0]
    with pytest.raises(UsageError, match="points of a plane"):
        choose_board(replace(network, xyz=deep))
