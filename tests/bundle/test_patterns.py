"""Common residual patterns of images: found where there are any, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, Result
from reseau.bundle.diagnostics import patterns
from reseau.bundle.diagnostics.patterns import by_place, by_point, common_pattern
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.core.failure import Code

from . import networks
from .test_testfield import adjusted, paper


def kinds(network: Network) -> list[str | None]:
    """Images of the same turn of the board and of the camera: pairs, of two tilts."""
    return [name.partition("-")[2] for name in network.images]


def with_pattern(network: Network, size_px: float) -> Network:
    """The network with common errors of each point in the images of one kind."""
    rng = np.random.default_rng(77)
    names = sorted(set(kinds(network)), key=str)
    pattern = rng.normal(0, size_px, (len(names), len(network.points), 2))
    of = np.array([names.index(kind) for kind in kinds(network)])[network.image_of]
    return replace(network, xy=network.xy + pattern[of, network.point_of])


@pytest.mark.slow
def test_noise_has_no_common_pattern() -> None:
    """The test keeps its level: of thirty small networks with a level of 5 % not more than six fail it."""
    world = networks.world(points=30, images=8)
    p = []
    for seed in range(30):
        fit = world.problem(world.noisy(seed)).adjusted().required()
        result = Result(world.network, fit, np.zeros(len(world.network.xy), dtype=bool))
        p.append(common_pattern(result, by_point(result, ["a", "b"] * 4)).p)
    assert (np.array(p) < 0.05).sum() <= 6
    assert 0.3 < np.mean(p) < 0.7


@pytest.mark.slow
def test_a_pattern_of_pairs_of_images_is_found_and_measured() -> None:
    """Common shifts of 0.02 px with noise of 0.04 px: 0.02 px are found, and sigma0 is one with them."""
    network = with_pattern(paper(seed=4), 0.02)
    result = adjusted(network)
    found = common_pattern(result, by_point(result, kinds(network)))
    assert result.sigma0 > 1.06
    assert found.p < 1e-4
    assert found.count.tolist() == [2] * (16 * 32)
    assert found.rms == pytest.approx(0.02, abs=0.003)
    assert found.sigma0 == pytest.approx(1.0, abs=0.06)


def test_the_statistic_is_that_of_an_adjustment_with_the_shifts_as_parameters() -> None:
    """Shifts of one class, estimated by correcting its observations for them, lower vᵀPv by T."""
    world = networks.world(points=30, images=8, control=8)
    network = world.noisy(3)
    fit = world.problem(network).adjusted().required()
    result = Result(network, fit, np.zeros(len(network.xy), dtype=bool))
    key = np.where((network.point_of == 12) & (network.image_of < 4), 0, -1)
    found = common_pattern(result, key)
    assert found.degrees[0] == 2
    explained = fit.cost - found.sigma0**2 * found.degrees[1]

    def cost(shift: np.ndarray) -> float:
        moved = replace(network, xy=network.xy - np.where(key[:, None] == 0, shift, 0.0))
        return world.problem(moved).adjusted().required().cost

    # A quadratic function of the two shifts, from six values of it.
    h = 0.02
    points = [(0, 0), (h, 0), (0, h), (-h, 0), (0, -h), (h, h)]
    design = np.array([[1, x, y, x * x, x * y, y * y] for x, y in points])
    c0, cx, cy, cxx, cxy, cyy = np.linalg.solve(design, [cost(np.array(at)) for at in points])
    hessian = np.array([[2 * cxx, cxy], [cxy, 2 * cyy]])
    least = c0 - 0.5 * np.array([cx, cy]) @ np.linalg.solve(hessian, [cx, cy])
    assert c0 - least == pytest.approx(explained, rel=0.01)


def test_a_pattern_of_the_frame_is_found_by_position() -> None:
    network = paper()
    offset = 0.03 * np.sign(np.sin(network.xy / 20.0))
    result = adjusted(replace(network, xy=network.xy + offset))
    found = common_pattern(result, by_place(result, 0, 16))
    assert found.p < 1e-4
    clean = adjusted(network)
    assert common_pattern(clean, by_place(clean, 0, 16)).p > 0.001


def test_classes_of_single_points_are_ignored() -> None:
    result = adjusted(paper())
    with pytest.raises(UsageError, match="no class has two image points"):
        common_pattern(result, np.arange(len(result.network.xy)))


def test_a_network_of_any_size_is_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the eliminated points as by all unknowns at once; columns in parts or whole make no difference."""
    world = networks.world(points=40, images=8, datum="free", control=0)
    fit = world.problem(world.noisy(4)).adjusted().required()
    result = Result(world.network, fit, np.zeros(len(world.network.xy), dtype=bool))
    key = by_place(result, 0, 6)
    found = common_pattern(result, key)
    monkeypatch.setattr(patterns, "_AT_ONCE", 5)
    again = common_pattern(result, key)
    assert again.statistic == pytest.approx(found.statistic, rel=1e-9)
    # Of all unknowns at once: M = N − H Q Hᵀ with the whole cofactor matrix.
    points = np.flatnonzero(fit.usable.points)
    joint = fit.cofactors.joint(np.arange(fit.unknowns.size), points)
    h = np.zeros((2 * len(found.count), fit.unknowns.size + 3 * len(points)))
    rows = np.flatnonzero(fit.usable.observations)[fit.unknowns.order]
    normal = np.zeros((2 * len(found.count),) * 2)
    linear, last = fit.linear, fit.linear.rows.shape[2] - 3
    for k, row in enumerate(rows):
        at = found.key[row]
        if at < 0:
            continue
        full = np.zeros((2, h.shape[1]))
        pattern = linear.system.pattern
        for start, width, column in zip(pattern.start[k], pattern.width[k], pattern.column[k], strict=True):
            full[:, start : start + width] += linear.rows[k, :, column : column + width]
        j = int(np.flatnonzero(points == linear.system.seen.point[k])[0])
        full[:, fit.unknowns.size + 3 * j : fit.unknowns.size + 3 * j + 3] = linear.rows[k, :, last:]
        root = linear.system.seen.root[k]
        h[2 * at : 2 * at + 2] += root.T @ full
        normal[2 * at : 2 * at + 2, 2 * at : 2 * at + 2] += root.T @ root
    m = normal - h @ joint @ h.T
    own = np.arange(len(found.count))
    blocks = np.linalg.inv(normal) @ m @ np.linalg.inv(normal) * found.sigma0**2
    whole = blocks.reshape(len(own), 2, len(own), 2)[own, :, own, :]
    np.testing.assert_allclose(found.cov, whole, rtol=0, atol=1e-9 * np.abs(whole).max())


def test_a_pattern_of_the_frame_gives_a_warning() -> None:
    network = paper()
    offset = 0.05 * np.sign(np.sin(network.xy / 20.0))
    result = adjusted(replace(network, xy=network.xy + offset))
    assert any(warning.code is Code.UNMODELLED for warning in result.warnings)
    assert not any(warning.code is Code.UNMODELLED for warning in adjusted(network).warnings)


@pytest.mark.parametrize("datum", ["free", "control"])
def test_joint_cofactors_are_the_same_where_points_are_not_eliminated(
    datum: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With fewer points than images these are unknowns beside the cameras."""
    world = networks.world(points=12, images=14, datum=datum, control=0 if datum == "free" else 4)

    def joint() -> tuple[Array, int]:
        fit = world.problem(world.noisy(4)).adjusted().required()
        columns, points = fit.unknowns.camera[0] + np.arange(3), np.flatnonzero(fit.usable.points)[::2]
        return fit.cofactors.joint(columns, points), int((fit.unknowns.kept >= 0).sum())

    (eliminated, none), _ = joint(), monkeypatch.setattr("reseau.bundle.solver.unknowns._BANDS", ((0, 2.0),))
    kept, count = joint()
    assert none == 0 < count
    scale = np.sqrt(np.maximum(np.diag(eliminated), np.diag(eliminated).max() * 1e-12))
    np.testing.assert_allclose(kept / np.outer(scale, scale), eliminated / np.outer(scale, scale), atol=1e-6)
