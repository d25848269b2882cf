"""The network of Vosselman & Förstner (1988): Ebner's parameters per group, seven observed coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.adjust.fitted import compare
from reseau.bundle import Camera, Network, Result, adjust_network
from reseau.bundle.diagnostics.patterns import by_place, common_pattern
from reseau.bundle.modelling.search import Selection, eliminate_parameters
from reseau.bundle.network.camera import Additional
from reseau.bundle.solver.system import residuals
from reseau.core.data import Array
from reseau.optics.poses import matrix_to_vector

from . import networks

# A board of 1 m with 32 targets before a camera of 512×512 pixels of 27 µm with a lens of 16 mm.
PITCH, C, BASE = 0.027, 16.0, 3.0


def board() -> Array:
    """Thirty-two points of an 8×8 pattern, every other square."""
    x, y = np.meshgrid(np.arange(8), np.arange(8))
    chosen = (x + y) % 2 == 0
    return np.column_stack([125.0 * (x[chosen] - 3.5), 125.0 * (y[chosen] - 3.5), np.zeros(32)])


def about(axis: int, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return turn


def paper(
    all_images: bool = False,
    noise: float = 0.04,
    bend_mm: float = 0.0,
    seed: int = 0,
    shape: Array | None = None,
) -> Network:
    """32 or 36 images: the board tilted by 30° and 45° (and 0°), turned in its plane, the camera rolled."""
    rng, xyz = np.random.default_rng(seed), board()
    body = xyz if shape is None else np.column_stack([xyz[:, :2], shape])
    extra = Additional(BASE, True, "group")
    values = np.array([C] + 9 * [0.0])
    camera = Camera("ccd", 512, 512, (PITCH, PITCH), "brown", values, (), additional=extra)
    settings = [(phi, t, c) for phi in (30, 45) for t in range(4) for c in range(4)]
    settings += [(0, 0, c) for c in range(4)] if all_images else []
    x0, rotation, seen = [], [], []
    for phi, t, c in settings:
        board_to_mount = about(1, np.radians(phi)) @ about(2, np.pi / 2 * t)
        # The camera looks along −z of the mount from 1.9 m.
        view = about(2, np.pi / 2 * c) @ np.diag([1.0, -1.0, -1.0])
        turn = view @ board_to_mount
        where = board_to_mount.T @ np.array([0.0, 0.0, 1900.0])
        # A bend that turns with the mount, whatever way the board is turned in it.
        turned, tilt = body @ about(2, np.pi / 2 * t).T, about(1, np.radians(phi))
        turned[:, 2] += bend_mm * ((turned[:, 0] / 437.5) ** 2 - 0.5)
        bent = turned @ tilt.T
        seen.append(networks.image_points(camera, view, np.array([0.0, 0.0, 1900.0]), bent))
        x0.append(where)
        rotation.append(matrix_to_vector(turn))
    m, xy = len(settings), np.concatenate(seen)
    sigma = np.full((32, 3), np.nan)
    control = [0, 3, 28, 31]
    sigma[control[0]], sigma[control[3]] = [0.1, 0.1, 0.1], [0.1, 0.1, 0.1]
    sigma[control[1], 2] = 0.1
    return Network(
        cameras=(camera,),
        images=tuple(f"{phi}-{t}-{c}" for phi, t, c in settings),
        camera_of=np.zeros(m, dtype=np.intp),
        x0=np.array(x0),
        rotation=np.array(rotation),
        points=tuple(f"t{k}" for k in range(32)),
        xyz=body,
        sigma=sigma,
        role=tuple("control" if k in control else "tie" for k in range(32)),
        image_of=np.repeat(np.arange(m), 32),
        point_of=np.tile(np.arange(32), m),
        xy=xy + noise * rng.normal(size=xy.shape),
        cov=np.tile(np.eye(2) * noise**2, (len(xy), 1, 1)),
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum="control",
        datum_points=np.ones(32, dtype=bool),
        groups=tuple(f"{phi}-{c}" for phi, t, c in settings),
        files=(None,) * m,
        unit="mm",
    )


def adjusted(network: Network) -> Result:
    result = adjust_network(network)
    assert isinstance(result, Result), result
    return result


def test_observations_and_redundancy_are_those_of_the_paper() -> None:
    result = adjusted(paper())
    assert result.fit.counts == (2055, 384, 0)
    assert result.redundancy == 1671
    assert result.fit.redundancy_numbers.sum() == pytest.approx(1671, abs=1e-6)
    assert 0.94 < result.sigma0 < 1.06


def test_all_36_images_converge() -> None:
    result = adjusted(paper(all_images=True))
    assert result.fit.usable.images.all()
    assert 0.94 < result.sigma0 < 1.06


def test_a_bend_that_rotates_with_the_mount_is_removed_by_groups() -> None:
    """0.8 mm: significant with one set of parameters for all, gone with a set per group."""
    network = paper(bend_mm=0.8)
    camera = network.cameras[0]
    common = replace(network, cameras=(replace(camera, additional=Additional(BASE, True, "camera")),))
    one, groups = adjusted(common), adjusted(network)
    assert 0.94 < groups.sigma0 < 1.06 < one.sigma0
    assert compare(one.fit, groups.fit).p < 1e-12
    assert any(test.significant for test in groups.camera_tests(0, alpha=0.001))


@pytest.mark.slow
def test_the_bend_of_the_mount_appears_in_common_residuals_of_images() -> None:
    network = paper(bend_mm=0.8)
    camera = network.cameras[0]
    one = adjusted(replace(network, cameras=(replace(camera, additional=Additional(BASE, True, "camera")),)))
    # The same place of the mount is the same place of the frame, in all images of a group.
    names = list(dict.fromkeys(network.groups))
    group = np.array([names.index(name) for name in network.groups])[network.image_of]
    key = 1000 * group + by_place(one, 0, 16)
    assert common_pattern(one, key).p < 1e-12
    assert common_pattern(adjusted(network), key).p > 1e-4


def test_a_bend_of_the_board_itself_is_in_the_heights_within_their_sigma() -> None:
    """Half a millimetre: nothing in the residuals, all in the object, beside the plane of the control."""
    flat, bend = board(), 0.5
    height = bend * ((flat[:, 0] / 437.5) ** 2 + 0.6 * (flat[:, 1] / 437.5) - (flat[:, 1] / 437.5) ** 2)
    result = adjusted(paper(noise=0.005, shape=height))
    assert 0.94 < result.sigma0 < 1.06
    control = [0, 3, 31]
    plane = np.column_stack([np.ones(32), flat[:, :2]])
    true = height - plane @ np.linalg.solve(plane[control], height[control])
    found = result.fit.values.xyz[:, 2]
    found = found - plane @ np.linalg.solve(plane[control], found[control])
    off = found - true
    names = [f"Z of point t{k}" for k in range(32)]
    turn = np.eye(32) - plane @ np.linalg.solve(plane[control], np.eye(32)[control])
    sigma = np.sqrt(np.diag(turn @ result.covariance_of(*names) @ turn.T))
    free = sigma > 1e-9
    assert np.median(sigma[free]) < 0.1
    assert np.abs(off[free] / sigma[free]).max() < 4.5
    assert np.abs(true[free] / sigma[free]).max() > 8


@pytest.mark.slow
def test_additional_parameters_that_are_not_needed_are_dropped_one_by_one() -> None:
    """Of a lens with b3 and b7 alone these stay, and nothing else changes but the redundancy."""
    network = paper(noise=0.04)
    camera = network.cameras[0]
    free = replace(network, cameras=(replace(camera, additional=Additional(BASE, True, "camera")),))
    true = np.zeros((1, 12))
    true[0, 2], true[0, 6] = 2e-4, -1.5e-4
    plain = adjusted(free)
    system = plain.fit.linear.system
    values = replace(plain.fit.values, extra=true)
    rows = np.arange(len(network.xy))
    bent = residuals(network=free, unknowns=system.unknowns, rows=rows, values=values) - residuals(
        network=free, unknowns=system.unknowns, rows=rows, values=replace(values, extra=0 * true)
    )
    found = eliminate_parameters(replace(free, xy=free.xy + bent), alpha=1e-4)
    assert isinstance(found, Selection)
    extra = found.network.cameras[0].additional
    assert extra is not None
    assert {f"b{k + 1}" for k in range(12)} - extra.dropped == {"b3", "b7"}
    result = found.result
    assert result.redundancy == plain.redundancy + 10
    assert result.fit.redundancy_numbers.sum() == pytest.approx(result.redundancy, abs=1e-6)
    names, _, values_found = result.camera_columns(0)
    sigma = np.sqrt(np.diag(result.formal_camera_covariance(0)))
    kept = np.array([name in ("b3", "b7") for name in names])
    assert (values_found[~kept] == 0).all()
    assert (sigma[~kept] == 0).all()
    assert (np.abs(values_found - true[0])[kept] < 4 * sigma[kept]).all()
    assert 0.94 < result.sigma0 < 1.06
