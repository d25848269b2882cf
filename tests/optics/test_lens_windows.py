"""A lens behind windows: its rays are those of the lens, continued through the windows by Snell's law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.optics.lenses import AIR, Prescription, PupilElements, ThinLens, glass, in_order
from reseau.optics.lenses.media import Constant, Water
from reseau.optics.lenses.pupils import Aiming
from reseau.optics.lenses.ray_maps import LensCamera, SensorPlane
from reseau.optics.lenses.windows import behind_windows
from reseau.optics.refraction import Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex

# A lens of two glasses with its stop behind; f = 48 mm.
ROWS = [(0.025, 6.0, glass("N-BK7")), (-0.02, 2.0, glass("SF2")), (-0.004, 4.0, AIR), (0.0, 44.0, AIR)]
LENS = Prescription(in_order(ROWS), stop=3, stop_radius=3.0, wavelengths_nm=(546.1, 480.0, 640.0))
BARE = LensCamera(LENS, SensorPlane((0.005, 0.005), (799.5, 599.5)))
MEDIA = RefractiveIndex("air", 1.0), RefractiveIndex("glass", 1.52), RefractiveIndex("water", 1.334)
PANE = ("air", "glass", "water")
PORT = Window("port", "plane", "camera", {"distance": 40.0, "thickness": 25.0, "tilt_X": 0.02}, PANE)
WINDOWS = {
    "plane": PORT,
    "bent": replace(PORT, values={**PORT.values, "curvature": 0.002}),
    "dome": Window("dome", "sphere", "camera", {"X": 1.0, "Z": 3.0, "radius": 60.0, "thickness": 8.0}, PANE),
    "ball": Window(
        "ball", "sphere", "object", {"Z": 500.0, "radius": 200.0, "thickness": 8.0}, PANE,
        camera_side="outside",
    ),
    "wall": Window("wall", "plane", "object", {"distance": 300.0, "thickness": 10.0}, PANE),
}  # fmt: skip


def through(name: str, values: Array | None = None) -> tuple[Refraction, LensCamera]:
    refraction = Refraction(MEDIA, (WINDOWS[name],), ((0,),), np.array([0]))
    if values is not None:
        refraction = refraction.with_values(values)
    return refraction, behind_windows(BARE, refraction, 0, np.eye(3), np.zeros(3))


def continued(refraction: Refraction, at: Array, ray: Array) -> Array:
    """A point (n, 3) in the water on rays that come from the camera, in camera axes."""
    window = refraction.windows[0]
    index = 1.0
    for (_, row, _), behind in zip(window.surfaces(window.start), (1.52, 1.334), strict=True):
        u, v, r = row[:3], row[3:6], row[6]
        centre, radius = v, r
        if window.shape == "plane":
            centre, radius = (v + u / r, 1 / r) if r else (v, 0.0)
        if radius:
            away = at - centre
            b = (away * ray).sum(axis=1)
            root = np.sqrt(b**2 - (away**2).sum(axis=1) + radius**2)
            near = window.shape == "plane" or window.camera_side == "outside"
            at = at + ((-b - root) if near else (-b + root))[:, None] * ray
            normal = (at - centre) / radius
        else:
            at = at + (((v - at) @ u) / (ray @ u))[:, None] * ray
            normal = np.broadcast_to(u, ray.shape)
        normal = normal * np.sign((normal * ray).sum(axis=1, keepdims=True))
        flat = index / behind * (ray - (ray * normal).sum(axis=1, keepdims=True) * normal)
        ray = flat + np.sqrt(1 - (flat**2).sum(axis=1, keepdims=True)) * normal
        index = behind
    return at + 150.0 * ray


@pytest.mark.parametrize("name", WINDOWS)
def test_principal_rays_of_the_lens_are_continued_through_the_window(name: str) -> None:
    refraction, wet = through(name)
    rng = np.random.default_rng(0)
    near = np.column_stack([rng.uniform(-5, 5, (20, 2)), np.full(20, 25.0)])
    aimed = Aiming(LENS)(near @ BARE.rotation.T + BARE.projection_centre, np.zeros((20, 2)))
    away = -aimed.rays.directions @ BARE.rotation
    points = continued(refraction, near, away)
    np.testing.assert_allclose(wet.corresponding(points), BARE.corresponding(near), rtol=0, atol=1e-7)


def test_the_projection_centre_stays_where_it_was() -> None:
    _, wet = through("plane")
    np.testing.assert_array_equal(wet.projection_centre, BARE.projection_centre)


def test_water_of_known_dispersion_colours_the_rim() -> None:
    grey, _ = through("plane")
    coloured = replace(
        grey, media=(*MEDIA[:2], replace(MEDIA[2], dispersion=Water().index)), windows=grey.windows
    )
    one, other = (behind_windows(BARE, r, 0, np.eye(3), np.zeros(3)) for r in (grey, coloured))
    point = np.array([[300.0, 0.0, 1000.0]])
    np.testing.assert_allclose(other.corresponding(point), one.corresponding(point), rtol=0, atol=1e-9)
    spread = [
        np.ptp(view.spots(point, PupilElements.gauss(2))[0][:, 0, :, 0].mean(axis=1)) for view in (one, other)
    ]
    assert spread[1] > spread[0] + 1.0


def test_an_image_in_air_keeps_its_lens_and_a_cylinder_is_refused() -> None:
    refraction, _ = through("plane")
    assert behind_windows(BARE, refraction, -1, np.eye(3), np.zeros(3)) is BARE
    tank = Window("tank", "cylinder", "object", {"radius": 100.0, "thickness": 5.0}, PANE)
    with pytest.raises(UsageError, match="cylinders"):
        behind_windows(BARE, Refraction(MEDIA, (tank,), ((0,),), np.array([0])), 0, np.eye(3), np.zeros(3))


def test_a_thin_lens_behind_windows_defocuses_like_a_lens_that_is_traced() -> None:
    """A weak singlet near the axis, at f/40: the tracing of the design knows nothing of the thin lens."""
    lens = Prescription(in_order([(0.02, 0.01, Constant(1.5)), (0.0, 104.0, AIR)]), stop=0, stop_radius=1.25)
    sensor = SensorPlane((0.001, 0.001), (0.0, 0.0))
    traced, thin = LensCamera(lens, sensor), ThinLens(100.0, 2.5, 104.0, sensor)
    media = (RefractiveIndex("air", 1.0), RefractiveIndex("glass", 1.52), RefractiveIndex("water", 1.333))
    port = Window("port", "plane", "camera", {"distance": 30.0, "thickness": 25.0}, ("air", "glass", "water"))
    wall = Window(
        "port", "plane", "object", {"distance": -30.0, "thickness": 25.0}, port.media, direction=(0, 0, 1)
    )
    points = np.array([[0.0, 0.0, 1500.0], [6.0, 0.0, 1500.0], [0.0, -4.0, 900.0]])
    ring = np.repeat([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]], 3, axis=0)
    wide = []
    for window, x0 in ((port, np.zeros(3)), (wall, np.array([0.0, 0.0, -60.0]))):
        refraction = Refraction(media, (window,), ((0,),), np.array([0]))
        both = [behind_windows(each, refraction, 0, np.eye(3), x0) for each in (traced, thin)]
        spots = [
            each.rays(np.tile(points, (3, 1)), ring, 550.0)[0].reshape(3, 3, 2) - each.corresponding(points)
            for each in both
        ]
        # Of 65 and 141 px, all but the singlet's own aberrations.
        np.testing.assert_allclose(spots[1], spots[0], rtol=0, atol=1.0)
        wide.append(spots[1])
        places = [each.corresponding(points) for each in both]
        np.testing.assert_allclose(places[1], places[0], rtol=0, atol=2.0)
    np.testing.assert_allclose(wide[0], wide[1], rtol=0, atol=1e-6)
    assert np.abs(wide[0]).max() > 15
