"""Rays through windows: Snell's law traced forwards, closed forms, derivatives against differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.optics.poses import rotation_matrix
from reseau.optics.refraction import RefractedRays, Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex, window_parameters

MEDIA = (
    RefractiveIndex("air", 1.0, free=True),
    RefractiveIndex("glass", 1.52, free=True),
    RefractiveIndex("water", 1.333, free=True),
)
PANE = ("air", "glass", "water")


def window(name: str, shape: Any, on: Any, values: dict[str, float], **more: Any) -> Window:
    media = more.pop("media", PANE)
    return Window(name, shape, on, values, media, free=window_parameters(shape, pane=len(media) == 3), **more)


PORT = window("port", "plane", "camera", {"distance": 0.3, "thickness": 0.1, "tilt_X": 0.1, "tilt_Y": -0.05})
BENT = window("bent", "plane", "camera", {"distance": 0.3, "thickness": 0.1, "curvature": -0.5})
SURFACE = window("surface", "plane", "object", {"distance": 1.5, "tilt_X": 0.03}, media=("air", "water"))
DOME = window("dome", "sphere", "camera", {"X": 0.03, "Z": 0.1, "radius": 0.5, "thickness": 0.1})
WALL = window(
    "wall", "plane", "object", {"distance": 2.0, "thickness": 0.1, "curvature": 0.1, "tilt_Y": -0.05}
)
ROUND = window(
    "round", "cylinder", "object", {"X": 0.2, "Y": 4.1, "radius": 1.6, "thickness": 0.1, "tilt_X": 0.02},
    direction=(1.0, 0.0, 0.0), camera_side="outside",
)  # fmt: skip
BALL = window(
    "ball", "sphere", "object", {"X": 0.1, "Y": 0.1, "Z": 4.0, "radius": 1.6, "thickness": 0.1},
    camera_side="outside",
)  # fmt: skip
HOUSED = window(
    "housed", "plane", "camera", {"distance": 0.2, "thickness": 0.05}, media=("air", "glass", "air")
)
PATHS = {w.name: (w,) for w in (PORT, BENT, SURFACE, DOME, WALL, ROUND, BALL)} | {
    "a housed camera before a tank": (HOUSED, WALL),
    "three panes": (HOUSED, replace(WALL, media=("air", "glass", "water")), window(
        "second", "plane", "object", {"distance": 2.5, "thickness": 0.2}, media=("water", "glass", "air"))),
}  # fmt: skip


def refraction(*windows: Window, images: int = 2) -> Refraction:
    return Refraction(MEDIA, windows, (tuple(range(len(windows))),), np.zeros(images, np.intp))


class Scene:
    """Two cameras near the origin that look along z, and points some 4 before them."""

    def __init__(self, *windows: Window, seed: int = 0, points: int = 12) -> None:
        rng = np.random.default_rng(seed)
        self.refraction = refraction(*windows)
        self.rotation = rotation_matrix(0.05 * rng.normal(size=(2, 3)))
        self.x0 = 0.1 * rng.normal(size=(2, 3))
        self.xyz = rng.uniform(-0.6, 0.6, (points, 3)) + np.array([0.0, 0.0, 4.0])
        self.image = np.repeat(np.arange(2), points)
        self.point = np.tile(np.arange(points), 2)

    def rays(
        self, *, derivatives: bool = False, origin: Any = (0.0, 0.0, 0.0), **change: Any
    ) -> RefractedRays:
        r = self.refraction
        return RefractedRays.of(
            r.columns(change.get("values", r.values), origin), r.path_of,
            change.get("rotation", self.rotation), change.get("x0", self.x0), change.get("xyz", self.xyz),
            self.image, self.point, derivatives=derivatives,
        )  # fmt: skip


def traced(w: list[Window], rotation: Array, x0: Array, uv: Array, length: float) -> Array:
    """End of a ray (3,), traced forwards by Snell's law in vectors; the last segment reaches z = `length`."""
    ray = rotation.T @ np.array([*uv, 1.0])
    ray, at = ray / np.linalg.norm(ray), x0
    index = {medium.name: medium.value for medium in MEDIA}
    for part in w:
        turn, shift = (rotation.T, x0) if part.on == "camera" else (np.eye(3), np.zeros(3))
        v = {name: part.values.get(name, 0.0) for name in part.names}
        layers = [0.0, v["thickness"]] if part.is_pane else [0.0]
        if part.camera_side == "outside":
            layers.reverse()
        for layer, before, after in zip(layers, part.media, part.media[1:], strict=False):
            if part.shape == "plane":
                m = part.frame[0] + v["tilt_X"] * part.frame[1] + v["tilt_Y"] * part.frame[2]
                m = turn @ (m / np.linalg.norm(m))
                if v["curvature"]:
                    centre = shift + (v["distance"] + 1 / v["curvature"]) * m
                    radius = abs(1 / v["curvature"] - layer)
                    at = on_round(at, ray, centre, None, radius, -np.sign(v["curvature"]))
                    normal = (at - centre) / radius
                else:
                    at = at + (v["distance"] + layer - m @ (at - shift)) / (m @ ray) * ray
                    normal = m
            else:
                axis = None
                centre = shift + turn @ np.array([v.get(name, 0.0) for name in "XYZ"])
                if part.shape == "cylinder":
                    axis = part.frame[0] + v["tilt_X"] * part.frame[1] + v["tilt_Y"] * part.frame[2]
                    axis = turn @ (axis / np.linalg.norm(axis))
                    centre = shift + turn @ (v["X"] * part.frame[1] + v["Y"] * part.frame[2])
                at = on_round(
                    at, ray, centre, axis, v["radius"] + layer, 1 if part.camera_side == "inside" else -1
                )
                normal = at - centre
                if axis is not None:
                    normal = normal - (normal @ axis) * axis
                normal = normal / np.linalg.norm(normal)
            normal = normal * np.sign(normal @ ray)
            # n₁ r × m = n₂ r' × m: the tangential component is scaled by n₁/n₂.
            flat = index[before] / index[after] * (ray - (ray @ normal) * normal)
            ray = flat + np.sqrt(1 - flat @ flat) * normal
    return at + (length - at[2]) / ray[2] * ray


def on_round(at: Array, ray: Array, centre: Array, axis: Array | None, radius: float, sign: float) -> Array:
    flat = np.eye(3) if axis is None else np.eye(3) - np.outer(axis, axis)
    a, b = flat @ ray, flat @ (at - centre)
    root = np.sqrt((a @ b) ** 2 - a @ a * (b @ b - radius**2))
    end: Array = at + (-(a @ b) + sign * root) / (a @ a) * ray
    return end


@pytest.mark.parametrize("name", PATHS)
def test_a_ray_traced_forwards_by_snell_s_law_ends_in_the_object_point(name: str) -> None:
    scene = Scene(*PATHS[name])
    rays = scene.rays()
    assert rays.reached.all()
    for k, (i, j) in enumerate(zip(scene.image, scene.point, strict=True)):
        end = traced(list(PATHS[name]), scene.rotation[i], scene.x0[i], rays.uv[k], scene.xyz[j, 2])
        assert np.abs(end - scene.xyz[j]).max() < 1e-10


def difference(function: Callable[[float], Array], h: float = 1e-4) -> Array:
    derivative: Array = (8 * (function(h) - function(-h)) - (function(2 * h) - function(-2 * h))) / (12 * h)
    return derivative


@pytest.mark.parametrize("name", PATHS)
def test_derivatives_agree_with_differences(name: str) -> None:
    scene = Scene(*PATHS[name])
    ours = scene.rays(derivatives=True).by
    eye, free = np.eye(3), np.flatnonzero(scene.refraction.free)
    columns = [
        lambda h, k=k: scene.rays(rotation=rotation_matrix(h * eye[k]) @ scene.rotation).uv for k in range(3)
    ]
    columns += [lambda h, k=k: scene.rays(x0=scene.x0 + h * eye[k]).uv for k in range(3)]
    columns += [lambda h, k=k: scene.rays(xyz=scene.xyz + h * eye[k]).uv for k in range(3)]
    unit = np.eye(len(scene.refraction.values))
    columns += [lambda h, k=k: scene.rays(values=scene.refraction.values + h * unit[k]).uv for k in free]
    assert ours.shape[2] == len(columns) > 9
    for k, column in enumerate(columns):
        np.testing.assert_allclose(ours[:, :, k], difference(column), rtol=0, atol=1e-8)


def flat_polynomial(heights: Array, indices: Array, x: float, z: float) -> Array:
    """Polynomial in t = the tangent of the ray of the camera, from a planar refraction problem.

    In the plane of refraction a ray with the tangent t leaves a layer of the index n with the sine
    s = n₀ t / (n √(1 + t²)), and so x = Σ h_j s_j / √(1 − s_j²). The radicals are removed by multiplying over
    all their signs (Agrawal et al. 2012): degree 4 with one other medium, 12 with two.
    """
    polynomial = np.polynomial.polynomial
    first, others = np.flatnonzero(indices == indices[0]), np.flatnonzero(indices != indices[0])
    kinds = np.unique(indices[others])
    # x − h₀ t − Σ_k H_k n₀ t/√(n_k² + (n_k² − n₀²) t²) = 0
    base = np.array([x, -float(heights[first].sum())])
    terms = [float(heights[others][indices[others] == n].sum()) * indices[0] for n in kinds]
    roots = [np.array([n**2, 0.0, n**2 - indices[0] ** 2]) for n in kinds]
    if len(kinds) == 1:
        return polynomial.polysub(
            polynomial.polymul(polynomial.polymul(base, base), roots[0]), [0, 0, terms[0] ** 2]
        )
    square = polynomial.polymul
    one, two = roots
    t2 = np.array([0.0, 0.0, 1.0])
    # a² d₁ d₂ = p² t² d₂ + q² t² d₁ + 2 p q t² √(d₁ d₂)
    left = square(square(base, base), square(one, two))
    left = polynomial.polysub(left, terms[0] ** 2 * square(t2, two))
    left = polynomial.polysub(left, terms[1] ** 2 * square(t2, one))
    right = 4 * (terms[0] * terms[1]) ** 2 * square(square(t2, t2), square(one, two))
    return polynomial.polysub(square(left, left), right)


@pytest.mark.parametrize(
    ("media", "degree"),
    [(("air", "water"), 4), (("air", "glass", "air"), 4), (("air", "glass", "water"), 12)],
)
def test_flat_windows_agree_with_the_closed_forms_of_agrawal(media: tuple[str, ...], degree: int) -> None:
    values = {"distance": 0.4} | ({"thickness": 0.1} if len(media) == 3 else {})
    scene = Scene(window("flat", "plane", "camera", values, media=media))
    scene.rotation[:], scene.x0[:] = np.eye(3), 0.0
    rays = scene.rays()
    index = {medium.name: medium.value for medium in MEDIA}
    indices = np.array([index[name] for name in media])
    for k, j in enumerate(scene.point):
        x, z = float(np.hypot(*scene.xyz[j, :2])), scene.xyz[j, 2]
        pane = 0.1 if len(media) == 3 else 0.0
        heights = np.array([0.4, pane, z - 0.4 - pane] if pane else [0.4, z - 0.4])
        polynomial = flat_polynomial(heights, indices, x, z)
        assert len(polynomial) == degree + 1
        own = np.hypot(*rays.uv[k])
        slope = np.polynomial.polynomial.polyder(polynomial)
        value = np.polynomial.polynomial.polyval(own, polynomial)
        # The distance from the root, by one Newton step.
        assert abs(value / np.polynomial.polynomial.polyval(own, slope)) < 1e-12


def test_a_dome_around_the_projection_centre_bends_no_ray() -> None:
    scene = Scene(window("dome", "sphere", "camera", {"radius": 0.5, "thickness": 0.1}))
    x = np.einsum("nij,nj->ni", scene.rotation[scene.image], scene.xyz[scene.point] - scene.x0[scene.image])
    np.testing.assert_allclose(scene.rays().uv, x[:, :2] / x[:, 2:], rtol=0, atol=1e-14)


def test_a_curved_window_becomes_flat_with_its_curvature() -> None:
    flat = Scene(PORT)
    bent = Scene(replace(PORT, values={**PORT.values, "curvature": 1e-9}))
    np.testing.assert_allclose(flat.rays().uv, bent.rays().uv, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", PATHS)
def test_coordinates_may_be_counted_from_any_point(name: str) -> None:
    scene, origin = Scene(*PATHS[name]), np.array([3.0, -2.0, 5.0])
    shifted = scene.rays(origin=origin, x0=scene.x0 - origin, xyz=scene.xyz - origin)
    np.testing.assert_allclose(shifted.uv, scene.rays().uv, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", PATHS)
def test_a_similarity_of_object_space_with_its_windows_changes_no_image(name: str) -> None:
    scene = Scene(*PATHS[name])
    scale, turn, shift = 1.7, rotation_matrix([0.1, -0.2, 0.15]), np.array([0.3, -0.1, 0.2])
    moved = scene.refraction.transformed(scene.refraction.values, scale, turn, shift)
    rays = scene.rays(
        values=moved, rotation=scene.rotation @ turn.T, x0=scale * scene.x0 @ turn.T + shift,
        xyz=scale * scene.xyz @ turn.T + shift,
    )  # fmt: skip
    np.testing.assert_allclose(rays.uv, scene.rays().uv, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", PATHS)
def test_small_changes_of_the_datum_are_those_of_the_similarity(name: str) -> None:
    scene, origin = Scene(*PATHS[name]), np.array([0.3, -0.2, 0.5])
    r, eye = scene.refraction, np.eye(3)
    ours = r.changes(r.values, origin)
    for k in range(7):

        def moved(h: float, k: int = k) -> Array:
            scale = 1.0 + (h if k == 6 else 0.0)
            turn = rotation_matrix(h * eye[k - 3]) if 3 <= k < 6 else eye
            shift = h * eye[k] if k < 3 else np.zeros(3)
            return r.transformed(r.values, scale, turn, shift + origin - scale * turn @ origin)

        np.testing.assert_allclose(ours[:, k], difference(moved), rtol=0, atol=1e-9)


def test_a_point_before_the_window_is_not_reached_through_it() -> None:
    scene = Scene(WALL)
    scene.xyz[0] = [0.1, 0.1, 1.5]
    rays = scene.rays(derivatives=True)
    assert rays.reached.tolist() == [j != 0 for j in scene.point]
    x = np.einsum("ij,j->i", scene.rotation[0], scene.xyz[0] - scene.x0[0])
    np.testing.assert_allclose(rays.uv[0], x[:2] / x[2], rtol=0, atol=1e-15)
    assert np.isfinite(rays.by).all()


def test_values_can_be_replaced() -> None:
    r = refraction(PORT)
    values = r.values + 0.001
    np.testing.assert_array_equal(r.with_values(values).values, values)


def test_only_parameters_that_rays_depend_on_are_free() -> None:
    other = Window("other", "plane", "object", {"distance": 1.0}, ("air", "oil"), free=("distance",))
    media = (*MEDIA, RefractiveIndex("oil", 1.46, free=True))
    r = Refraction(media, (PORT, other), ((0,), (1,)), np.array([0, 0, -1]))
    assert not [n for n, free in zip(r.names, r.free, strict=True) if free and ("other" in n or "oil" in n)]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: RefractiveIndex("x", 0.0), "refractive index"),
        (lambda: RefractiveIndex("x", 1.3, sigma=0.1), "and the index free"),
        (lambda: replace(PORT, shape="cone"), "cone"),
        (lambda: replace(PORT, media=("air",)), "has 1 media"),
        (lambda: replace(PORT, values={"distance": 1.0}), "thickness"),
        (lambda: replace(PORT, values={"thickness": 1.0}), "distance"),
        (lambda: replace(PORT, values={**PORT.values, "radius": 1.0}), "radius"),
        (lambda: replace(PORT, free=("height",)), "height"),
        (lambda: replace(PORT, sigma={"distance": -1.0}), "positive"),
        (lambda: replace(PORT, values={**PORT.values, "tilt_X": np.nan}), "not a number"),
        (lambda: replace(DOME, values={"thickness": 0.1}), "radius"),
        (lambda: replace(PORT, direction=(0.0, 0.0, 0.0)), "zero"),
        (lambda: refraction(PORT, PORT), "twice"),
        (lambda: refraction(replace(PORT, media=("air", "glass", "oil"))), "oil"),
        (lambda: refraction(PORT, WALL), "begins in air"),
        (
            lambda: refraction(replace(WALL, media=("air", "glass", "air")), PORT),
            "behind wall",
        ),
    ],
)
def test_what_is_no_window_is_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        make()
