"""The compiled cameras against those of optics, and all derivatives against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.adjust.stochastic import Weighting
from reseau.bundle.solver.imaging import _turned
from reseau.bundle.solver.linear import Linear, linearised
from reseau.bundle.solver.observations import OtherObservations
from reseau.bundle.solver.system import System, residuals
from reseau.bundle.solver.unknowns import Unknowns
from reseau.bundle.solver.values import Correction, Values
from reseau.core.data import Array
from reseau.optics.cameras.ebner import EbnerCorrection
from reseau.optics.poses import Pose, matrix_to_vector, project, rotation_matrix

from . import networks

MODELS = ("brown-object", "opencv", "opencv-8")


def system_of(world: networks.World) -> tuple[System, Values]:
    network = world.network
    unknowns = Unknowns.of(network, np.ones(len(network.images), dtype=bool))
    others = OtherObservations.of(network, np.ones(len(network.points), dtype=bool), world.xyz)
    system = System(
        unknowns,
        others,
        Weighting([network.cov]),
        np.ones(len(others.value)),
        np.zeros(unknowns.size, bool),
        np.zeros(3),
    )
    return system, Values.of_cameras(unknowns, world.rotation, world.x0, world.xyz)


def dense(linear: Linear) -> Array:
    """The weighted derivatives of the image coordinates by all unknowns, points last."""
    unknowns, pattern = linear.system.unknowns, linear.system.pattern
    n, last = len(linear.misfits), linear.rows.shape[2] - 3
    full = np.zeros((n, 2, unknowns.size + 3 * len(linear.prior)))
    for k in range(n):
        for start, width, column in zip(pattern.start[k], pattern.width[k], pattern.column[k], strict=True):
            full[k, :, start : start + width] = linear.rows[k, :, column : column + width]
        j = linear.system.seen.point[k]
        if pattern.eliminated[j]:
            full[k, :, unknowns.size + 3 * j : unknowns.size + 3 * j + 3] = linear.rows[k, :, last:]
    return full.reshape(2 * n, -1)


def by_differences(system: System, values: Values) -> Array:
    u, p = system.unknowns.size, len(values.xyz)
    columns = []
    kept = system.unknowns.kept
    movable = np.where(kept[:, None] >= 0, 0.0, system.movable)
    at = np.flatnonzero(kept >= 0)
    still = (kept[at, None] + np.arange(3))[system.movable[at] == 0]
    size = np.abs(dense(linearised(system, values))).max(axis=0)
    for k in range(u + 3 * p):
        h = 1e-2 / size[k] if size[k] > 0 else 1.0

        def moved(times: float, k: int = k, h: float = h) -> Array:
            step = np.zeros(u + 3 * p)
            step[k] = times * h
            step[still] = 0.0
            points = step[u:].reshape(p, 3) * movable
            return system.misfits(values.moved(system.unknowns, Correction(step[:u], points, 0.0)))[0].ravel()

        columns.append((8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("model", MODELS)
def test_image_points_agree_with_optics(model: str) -> None:
    world = networks.world(cameras=(networks.camera(model),))
    network = replace(world.network, xy=np.zeros_like(world.network.xy))
    system, values = system_of(replace(world, network=network))
    ours = residuals(network, system.unknowns, np.arange(len(network.xy)), values)
    np.testing.assert_allclose(ours, world.network.xy, rtol=0, atol=1e-9)


def test_image_side_uses_the_corrected_image_point() -> None:
    """The published convention: v = xs − (xm + Δ(xm)), so that the true image has no residual."""
    world = networks.world(cameras=(networks.camera("brown-image"),))
    system, values = system_of(world)
    rows = np.arange(len(world.network.xy))
    assert np.abs(residuals(world.network, system.unknowns, rows, values)).max() < 1e-9
    # A measured point moved by a pixel moves the corrected one by 1 + dΔ/dx of it.
    moved = replace(world.network, xy=np.add(world.network.xy, [1e-3, 0.0]))
    cam = world.network.cameras[0]
    lens = networks.mapping_of(cam).distortion
    photo = (world.network.xy - [319.5, 239.5]) * [0.01, -0.01] - cam.values[1:3]
    slope = lens.derivatives(photo).d_xy
    off = residuals(moved, system.unknowns, rows, values)
    np.testing.assert_allclose(off[:, 0], -1e-3 * slope[:, 0, 0], rtol=0, atol=1e-8)


CASES = {
    "brown on the object side": (networks.camera("brown-object"),),
    "brown on the image side": (networks.camera("brown-image", options={"balance_radius_mm": 2.0}),),
    "opencv": (networks.camera("opencv"),),
    "opencv rational": (networks.camera("opencv-8", ("fx", "fy", "cx", "k1", "k3", "k4", "k5", "k6")),),
    "ebner for all": (networks.with_ebner("camera"),),
    "ebner per group": (networks.with_ebner("group"),),
    "ebner per image, image side": (replace(networks.with_ebner("image"), options={"side": "image"}),),
    "any mapping": (networks.mapped(networks.camera("opencv")),),
    "a mapping, image side": (networks.mapped(networks.camera("brown-image")),),
    "wong's display behind a lens": (networks.wong(),),
    "a polynomial behind a lens": (networks.polynomial(),),
    "opencv with k3": (networks.BATTERY["opencv-5"],),
    "a mapping beside a compiled camera": (networks.mapped(networks.camera("opencv")), networks.camera()),
    "two cameras": (networks.camera("brown-image"), networks.camera("opencv", ("fx", "k1"))),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_by_every_unknown_agree_with_differences(name: str) -> None:
    world = networks.world(images=4, points=8, cameras=CASES[name])
    network = replace(
        world.network, distance_of=np.array([[0, 6], [6, 7]]), distance=np.array([[1.0, 0.1], [1.0, 0.1]])
    )
    system, values = system_of(replace(world, network=network))
    values = replace(values, extra=np.random.default_rng(1).normal(0, 1e-4, values.extra.shape))
    analytic, numeric = dense(linearised(system, values)), by_differences(system, values)
    size = np.maximum(np.abs(numeric).max(axis=0), 1e-30)
    assert np.abs((analytic - numeric) / size).max() < 1e-8


BEHIND_WINDOWS = {
    **{f"opencv behind: {kind}": ((networks.camera("opencv"),), kind) for kind in networks.WINDOWS},
    "brown on the image side behind a port": ((networks.camera("brown-image"),), "plane port"),
    "ebner behind a dome": ((networks.with_ebner("group"),), "dome"),
    "a mapping beside a compiled camera behind a port": (
        (networks.mapped(networks.camera("opencv")), networks.camera()),
        "plane port",
    ),
}


@pytest.mark.parametrize("name", BEHIND_WINDOWS)
def test_derivatives_through_windows_agree_with_differences(name: str) -> None:
    cameras, kind = BEHIND_WINDOWS[name]
    world = networks.refracted(networks.world(images=4, points=8, cameras=cameras), kind)
    # One image in air beside the others.
    refraction = world.network.refraction
    assert refraction is not None
    refraction = replace(refraction, path_of=np.array([0, -1, 0, 0]))
    system, values = system_of(replace(world, network=replace(world.network, refraction=refraction)))
    analytic, numeric = dense(linearised(system, values)), by_differences(system, values)
    # A plate in one medium may be at any distance: that derivative is zero but for rounding.
    size = np.maximum(np.abs(numeric).max(axis=0), 1.0)
    assert np.abs((analytic - numeric) / size).max() < 1e-7


@pytest.mark.parametrize("kind", networks.WINDOWS)
def test_image_points_through_windows_have_no_residual_in_the_truth(kind: str) -> None:
    world = networks.refracted(networks.world(), kind)
    system, values = system_of(world)
    rows = np.arange(len(world.network.xy))
    assert np.abs(residuals(world.network, system.unknowns, rows, values)).max() < 1e-9


def test_ebner_is_orthogonal_over_its_grid_and_as_defined() -> None:
    """On the 3×3 grid of base b all twelve effects are orthogonal; b3 shifts by −(2x² − 4b²/3) there."""
    world = networks.world(images=1, points=9, cameras=(networks.with_ebner("camera", 1.0),), control=9)
    system, values = system_of(world)
    pixels = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
    # Cameras without any distortion, c = 1 mm, and points that are seen at the grid.
    plain = replace(world.network.cameras[0], values=np.array([1.0] + 9 * [0.0]), pitch_mm=(1.0, 1.0))
    network = replace(
        world.network,
        cameras=(plain,),
        image_of=np.zeros(9, dtype=np.intp),
        point_of=np.arange(9),
        xy=pixels * [1, -1] + [319.5, 239.5],
        cov=np.tile(np.eye(2), (9, 1, 1)),
    )
    xyz = np.column_stack([pixels * [1, -1], np.ones(9)])
    system, values = system_of(
        networks.World(network, np.eye(3)[None], np.zeros((1, 3)), xyz),
    )
    linear = linearised(system, values)
    at = system.unknowns.extra[0]
    effects = dense(linear)[:, at : at + 12]
    gram = effects.T @ effects
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-12
    x = pixels[:, 0]
    np.testing.assert_allclose(effects.reshape(9, 2, 12)[:, 0, 2], -(2 * x**2 - 4 / 3), atol=1e-12)


def test_ebner_of_the_bundle_agrees_with_optics() -> None:
    values = np.random.default_rng(2).normal(0, 1e-4, 12)
    camera = networks.with_ebner("camera", 1.2)
    world = networks.world(images=3, points=10, cameras=(camera,))
    system, start = system_of(world)
    rows = np.arange(len(world.network.xy))
    bent = residuals(world.network, system.unknowns, rows, replace(start, extra=values[None]))
    plain = networks.mapping_of(replace(camera, values=np.array([camera.values[0]] + 9 * [0.0])))
    poses = Pose(matrix_to_vector(world.rotation)[world.network.image_of], world.x0[world.network.image_of])
    ideal = project(plain, poses, world.xyz[world.network.point_of]).xy
    photo = (ideal - [319.5, 239.5]) * [0.01, -0.01]
    off = (EbnerCorrection(values, 1.2)(photo) - photo) / [0.01, -0.01]
    np.testing.assert_allclose(bent, off, rtol=0, atol=1e-9)


def test_a_moving_camera_turns_points_by_the_rotation_of_its_rate() -> None:
    x = np.array([0.3, -0.7, 1.9])
    for rate in ([0.2, -0.5, 0.3], [1e-5, 2e-5, -1e-5]):
        y, z = np.empty(3), np.empty(3)
        _turned(0.8, np.array([[0.0, 0.0, 0.0, *rate]]), 0, x, y, z)
        np.testing.assert_allclose(y, rotation_matrix(0.8 * np.array(rate)) @ x, rtol=0, atol=1e-14)
        np.testing.assert_allclose(z, np.cross(rate, y), rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", ["opencv", "brown-object"])
def test_few_image_points_give_by_mappings_what_they_give_in_loops(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    for few in (0, 5000):
        monkeypatch.setattr("reseau.bundle.network.network._FEW", few)
        world = networks.world(images=4, points=8, cameras=(networks.camera(model),))
        assert (world.network.kernels == (None,)) == (few > 0)
        system, values = system_of(world)
        linear = linearised(system, values)
        results.append((dense(linear), linear.misfits, system.misfits(values)[0]))
    for loops, mappings in zip(*results, strict=True):
        np.testing.assert_allclose(mappings, loops, rtol=0, atol=1e-9 * max(1.0, np.abs(loops).max()))
