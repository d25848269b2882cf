"""First-order optics against a printed listing, rays through given points of the stop, images by rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.path import Path
from scipy.optimize import least_squares

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.measure.matching.shapes import GrownOutline, Window
from reseau.optics import Brown, PixelGrid
from reseau.optics.formation import Outline, PixelResponse, coverage, mark_outline
from reseau.optics.lenses import (
    AIR,
    Aperture,
    Paraxial,
    Prescription,
    PupilElements,
    RayMap,
    ThinLens,
    Tracer,
    aim,
    glass,
    in_order,
    ray_image,
)
from reseau.optics.lenses.images import PlaneTarget
from reseau.optics.lenses.prescription import Surface
from reseau.optics.lenses.ray_maps import CalibratedLens, LensCamera, SensorPlane
from reseau.optics.lenses.stand_ins import AberratedLens

from ..montecarlo import slowly

ROWS = (
    (0.01779284094091543, 8.75, "N-SSK2"),
    (0.006566600536925569, 0.5, ""),
    (0.02653743294670983, 12.5, "N-SK2"),
    (0.0, 3.8, "F5"),
    (0.04126892878570084, 16.36944492653564, ""),
    (0.0, 13.74795696388906, ""),
    (-0.03523942654429074, 3.8, "F5"),
    (0.0, 11.0, "N-SK16"),
    (-0.02636750828657709, 0.5, ""),
    (0.005636604951748545, 7.0, "N-SK16"),
    (-0.0125926458590576, 61.4875364179821, ""),
)
"""A double Gauss f/2 for 100 mm: curvature, distance, glass."""


def double_gauss(scale: float = 1.0, radius: float | None = None) -> Prescription:
    surfaces = list(in_order([(c / scale, d * scale, glass(g) if g else AIR) for c, d, g in ROWS]))
    surfaces[5] = replace(surfaces[5], kind="plain", name="stop")
    lens = Prescription(
        tuple(surfaces), 5, 1.0, (656.3, 587.6, 486.1), (0.5, 1.0, 0.5), 1, name="double Gauss"
    )
    return replace(lens, stop_radius=radius or 25 * scale / Paraxial(lens).entrance_pupil[1])


def camera(shift: float = 0.0, radius: float | None = None) -> LensCamera:
    """A camera of 25 mm, focused at 600 mm; the image plane is shifted from there."""
    lens = double_gauss(0.25, radius)
    behind = Paraxial(lens).image_distance(600.0) - Paraxial(lens).back_focus
    return LensCamera(lens.moved((0, 0, behind + shift)), SensorPlane((0.006, 0.006), (799.5, 599.5)))


def test_first_order_optics_are_those_of_the_listing_of_code_v() -> None:
    first = Paraxial(double_gauss())
    printed = {
        "EFL": 100.0038,
        "BFL": 61.4875,
        "FNO": 2.0001,
        "entrance": 57.9120,
    }
    found = {
        "EFL": first.focal_length,
        "BFL": first.back_focus,
        "FNO": first.f_number,
        "entrance": first.entrance_pupil[0],
    }
    assert found == pytest.approx(printed, abs=6e-5)


def test_a_mirror_has_half_its_radius_as_focal_length() -> None:
    surfaces = (Surface(-0.01, kind="mirror"), Surface(kind="plain", vertex=np.array([0, 0, -50.0])))
    first = Paraxial(Prescription(surfaces, 0, 5.0))
    assert abs(first.focal_length) == pytest.approx(50.0)


def test_aimed_rays_pass_the_real_stop_at_their_points() -> None:
    lens = double_gauss()
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-200, 200, 50), rng.uniform(-200, 200, 50), np.full(50, -900.0)], axis=1)
    pupil = rng.uniform(-0.7, 0.7, (50, 2))
    aimed = aim(lens, points, pupil)
    assert aimed.found.all()
    hit = Tracer(lens, last=5).trace(aimed.rays).xy
    assert np.abs(hit - pupil * lens.stop_radius).max() < 1e-8


def test_elements_of_the_stop_have_equal_areas_and_quadrature_is_exact() -> None:
    equal, gauss = PupilElements.equal_areas(8), PupilElements.gauss(5)
    assert len(equal.xy) == 169
    for elements in (equal, gauss):
        assert elements.weights.sum() == pytest.approx(1.0)
    radius = np.hypot(*gauss.xy.T)
    for power in (2, 4, 6, 8):
        assert gauss.weights @ radius**power == pytest.approx(2 / (power + 2), rel=1e-12)


def target(x: float, y: float, z: float, pixels: float, shape: str = "disk") -> PlaneTarget:
    c, s = np.cos(0.4), np.sin(0.4)
    size = pixels * 0.006 * z / 25.7
    axes = np.array([[c, 0.0], [0.0, 1.0], [s, 0.0]])
    return PlaneTarget(np.array([x, y, z]), axes, mark_outline(shape, size, None, size / pixels * 0.6))


def shift_between(one: Array, other: Array) -> Array:
    """Shift (2,) by which the first image is matched with the second, with contrast and background."""
    down, right = np.gradient(other)
    design = np.stack([right.ravel(), down.ravel(), other.ravel(), np.ones(other.size)], axis=1)
    return np.linalg.lstsq(design, (other - one).ravel(), rcond=None)[0][:2]


def formed(view: RayMap, at: PlaneTarget, elements: PupilElements, middle: Array, half: int) -> Array:
    """Image of a target in the pixels around `middle`, which images to be compared must have in common."""
    image = ray_image(view, at, elements)
    across = middle + np.arange(-half, half + 1.0)[:, None]
    nodes = Outline(image.outline.xy[None], image.outline.dxy[None]).single()
    window = Window(across[None, :, 0], across[None, :, 1], PixelResponse())
    place = image.point[None], np.array([0.45]), np.zeros((1, 0)), np.zeros(1, np.intp)
    return GrownOutline(nodes, np.zeros((0, 2, 2))).image(*place, window)[0]


def counted_image(
    view: RayMap, small: PlaneTarget, elements: PupilElements, side: int, columns: Array, rows: Array
) -> Array:
    """Light in the pixels by counting rays, as Meid 1992, section 3.1.4, describes it."""
    middle = (np.arange(side) + 0.5) * 2 / side - 1
    uv = small.extent * np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    uv = uv[Path(small.outline.xy).contains_points(uv)]
    image, ends = (
        np.zeros((len(rows), len(columns))),
        [np.append(at - 0.5, at[-1] + 0.5) for at in (rows, columns)],
    )
    for at, weight in zip(elements.xy, elements.weights, strict=True):
        xy, light = view.spots(small.points(uv), PupilElements(at[None], weight[None]))
        xy, light = xy.reshape(-1, 2), np.abs(np.nan_to_num(light) @ small.normal).ravel()
        image += np.histogram2d(xy[:, 1], xy[:, 0], bins=ends, weights=light)[0]
    return image


@pytest.mark.slow
@pytest.mark.parametrize("colours", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_the_formed_image_is_that_of_counted_rays(colours: int) -> None:
    view, small = camera(0.05), target(30.0, -20.0, 600.0, 10.0)
    if colours == 1:
        view = replace(view, lens=replace(view.lens, wavelengths_nm=(587.6,), weights=(), reference=0))
    image = ray_image(view, small, PupilElements.gauss(8))
    middle = np.rint(image.point)
    pixels = middle + np.arange(-16, 17.0)[:, None]
    counted = counted_image(view, small, PupilElements.equal_areas(14), 40, pixels[:, 0], pixels[:, 1])
    placed = Outline(image.outline.xy + image.point, image.outline.dxy)
    exact = coverage(placed, pixels[:, 0], pixels[:, 1], 0.03)
    # 547 elements of the stop and 1250 of the target leave 0.01 px.
    assert np.abs(shift_between(counted / counted.sum(), exact / exact.sum())).max() < 0.012


def seen_from_the_sensor(lens: ThinLens, target: PlaneTarget, xy: Array) -> Array:
    """Share (n,) of the light of places (n, 2) of the sensor, in pixels, that the plane of a target sends.

    Rays are followed backwards, from the sensor through points of the lens; their weights are those of solid
    angles at the sensor, to which the target is of no concern.
    """
    k = np.arange(400) + 0.5
    turn = k * np.pi * (3 - np.sqrt(5))
    stop = 0.5 * lens.diameter * np.sqrt(k / len(k))[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
    stop = np.concatenate([stop, -stop])
    mm = (xy - lens.sensor.principal_px) * lens.sensor.pitch_mm
    c, depth = lens.image_distance, 1 / (1 / lens.focal_length - 1 / lens.image_distance)
    # The object point of a place of the sensor, upright: in the sensor's pixels the image is turned back.
    conjugate = np.concatenate([mm * depth / c, np.full((len(mm), 1), depth)], axis=1)
    seen, all_ = np.zeros(len(xy)), np.zeros(len(xy))
    for x, y in stop:
        start = np.array([x, y, 0.0])
        way = conjugate - start
        t = (target.centre - start) @ target.normal / (way @ target.normal)
        uv = (start + t[:, None] * way - target.centre) @ target.axes
        light = c**4 / (((mm + start[:2]) ** 2).sum(axis=1) + c**2) ** 2
        seen += light * (np.hypot(*uv.T) <= target.extent)
        all_ += light
    return np.asarray(seen / all_)


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [*slowly(0.0), 0.7])
def test_light_within_a_blurred_image_is_that_seen_from_the_sensor(tilt: float) -> None:
    # Blurred over 25 px; without the change of scale over the stop the image of a target tilted by 0.7 is
    # displaced by 0.03 px. On the axis, where a thin lens sends as much light as a real one.
    lens, c, s = ThinLens(25.0, 12.5, 26.6, SensorPlane((0.006,) * 2, (0.0, 0.0))), np.cos(tilt), np.sin(tilt)
    axes = np.array([[c, 0.0], [0.0, 1.0], [s, 0.0]])
    disk = PlaneTarget(np.array([0.0, 0.0, 500.0]), axes, Outline.circle(2.0, 0.02))
    image = ray_image(lens, disk, PupilElements.gauss(8))
    offsets = (np.arange(150) - 74.5) * 0.4
    places = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    share = seen_from_the_sensor(lens, disk, image.point + places)
    centroid = share @ places / share.sum()
    assert np.abs(image.centroid - centroid).max() < 0.002


@pytest.mark.parametrize("place", [(0.0, 0.0), (60.0, 40.0), (-95.0, 60.0)])
@pytest.mark.parametrize("shift", [0.0, 0.06, -0.1])
def test_an_image_of_few_rays_is_matched_with_many_to_a_two_hundredth_of_a_pixel(
    place: tuple[float, float], shift: float
) -> None:
    at, view, few = target(*place, 600.0, 20.0), camera(shift), PupilElements.gauss(5)
    middle = np.rint(ray_image(view, at, few).point)
    one = formed(view, at, few, middle, 34)
    many = formed(view, at, PupilElements.gauss(16), middle, 34)
    assert np.abs(shift_between(one, many)).max() < 1 / 200


def test_a_thin_lens_is_the_limit_of_a_slow_lens_near_the_axis() -> None:
    view = camera(0.02, radius=0.4)
    first = Paraxial(view.lens)
    pupil = 2 * first.entrance_pupil_radius
    at = target(0.5, 0.3, 600.0 + first.entrance_pupil[0], 12.0)
    true = ray_image(view, at, PupilElements.gauss(6))
    principal = first.focal_length * (1 + first.focal_length / (600.0 - first.focal_length))
    thin = ThinLens(first.focal_length, pupil, principal, view.sensor)
    other = ray_image(thin, at, PupilElements.gauss(6))
    assert abs(true.blur - other.blur) < 0.1
    assert np.abs(true.point - other.point).max() < 0.5


def test_a_lens_with_aberrations_follows_the_rays_of_its_design() -> None:
    view, elements = camera(0.02, radius=0.6), PupilElements.gauss(3)
    first = Paraxial(view.lens)
    distance = 600.0 + first.entrance_pupil[0]
    behind = first.focal_length * (1 + first.focal_length / (600.0 - first.focal_length))
    focal = 1 / (1 / behind + 1 / distance)
    thin = AberratedLens(focal, 2 * first.entrance_pupil_radius, behind, view.sensor, ((587.6, 1.0),))
    # Third order: at a small stop, coefficients from two rays predict all others.
    at = np.tile([60.0, 40.0, distance], (len(elements.xy), 1))
    names = ("spherical", "coma", "astigmatism", "curvature")

    def spot(lens: LensCamera | AberratedLens) -> Array:
        return lens.rays(at, elements.xy, 587.6)[0] - lens.corresponding(at)

    def beside(values: Array) -> Array:
        moved = replace(thin, **dict(zip(names, values, strict=True)))
        return (spot(moved) - spot(view)).ravel()

    found = least_squares(beside, np.zeros(4), x_scale=1e-3)
    assert np.abs(found.fun).max() < 0.05 * np.abs(spot(view)).max()
    assert np.abs(found.fun).max() < 0.2 * np.abs(beside(np.zeros(4))).max()


def test_a_calibrated_lens_forms_the_image_of_the_lens_where_the_calibration_has_it() -> None:
    view, elements = camera(0.05), PupilElements.gauss(4)
    at = target(60.0, 40.0, 600.0, 20.0)
    near = view.corresponding(np.array([[0.0, 0.0, 600.0], [1.0, 0.0, 600.0]]))
    grid = PixelGrid(1600, 1200, (0.006, 0.006))
    principal = float(near[1, 0] - near[0, 0]) * 600.0 * 0.006
    # Displaced by 20 and 8 pixels, and with decentring distortion.
    calibrated = Brown(side="object", grid=grid).with_values(
        {"c": principal, "x0": 0.12, "y0": -0.048, "P1": 1e-4, "P2": -2e-4}
    )
    own, placed = (ray_image(each, at, elements) for each in (view, CalibratedLens(view, calibrated)))
    assert np.hypot(*(placed.point - own.point)) > 15
    assert np.abs(placed.point - calibrated(at.centre[None, :2] / at.centre[2])[0]).max() < 1e-9
    # Of 4.2 px: the calibration spreads the light a little otherwise over the image, and with it its centre.
    assert abs(placed.blur - own.blur) < 5e-4
    assert 1e-4 < np.abs(placed.centroid - own.centroid).max() < 0.05  # the distortion within the target


def vignetted_camera(view: LensCamera) -> LensCamera:
    """The lens with rims that cut its stop towards the corners of the photograph."""
    surfaces = list(view.lens.surfaces)
    surfaces[0] = replace(surfaces[0], apertures=(Aperture("circle", (5.2, 0.0)),))
    surfaces[10] = replace(surfaces[10], apertures=(Aperture("circle", (4.4, 0.0)),))
    return replace(view, lens=replace(view.lens, surfaces=tuple(surfaces)))


def test_light_that_an_aperture_stops_is_missing_from_the_image() -> None:
    view = camera(0.1)
    vignetted = vignetted_camera(view)
    at = target(-110.0, 70.0, 600.0, 12.0)
    whole, part = (ray_image(each, at, PupilElements.gauss(8)) for each in (view, vignetted))
    assert part.blur < 0.97 * whole.blur
    assert np.hypot(*(part.centroid - whole.centroid)) > 0.05


def test_the_light_of_a_small_vignetted_target_is_that_of_its_rays() -> None:
    view = vignetted_camera(camera(0.1))
    at = target(-110.0, 70.0, 600.0, 0.5)
    image, pixels = ray_image(view, at, PupilElements.gauss(11)), np.arange(-40.0, 41.0)
    columns, rows = pixels + np.rint(image.point)[:, None]
    light = image.formed(image.point, 0.5, columns, rows, PixelResponse(), bright=True)
    formed = np.array([light.sum(axis=0) @ columns, light.sum(axis=1) @ rows]) / light.sum()
    # Rays through all of the stop, stopped or not.
    count = 20_000
    turn, radius = np.arange(count) * np.pi * (3 - np.sqrt(5)), np.sqrt((np.arange(count) + 0.5) / count)
    stop, centre = (
        radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1),
        np.tile(at.centre, (count, 1)),
    )
    sums = np.zeros(3)
    for wavelength, weight in view.wavelengths:
        xy, carried = view.rays(centre, stop, wavelength)
        share = weight * np.linalg.norm(carried, axis=1)
        assert (share == 0).mean() > 0.05
        sums += [*(share @ np.nan_to_num(xy)), share.sum()]
    assert (
        np.abs(formed - sums[:2] / sums[2]).max() < 0.002
    )  # px; 0.03 if elements had the same light everywhere


def test_edges_of_the_open_part_are_those_between_rays_that_pass_and_that_are_stopped() -> None:
    view = vignetted_camera(camera(0.1))
    points, angle = np.array([[-110.0, 70.0, 600.0], [0.0, 0.0, 600.0]]), np.linspace(0, 2 * np.pi, 40)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    within, area = view.open_part(points, along, 546.0)
    assert np.ptp(area[1]) < 1e-3  # the rear rim limits the light of the axis evenly
    assert np.ptp(area[0]) > 0.2
    cut = area[0] < 1
    passes = [
        view.rays(np.tile(points[0], (cut.sum(), 1)), scale * within[0, cut], 546.0)[1].any(axis=1)
        for scale in (0.9995, 1.0005)
    ]
    assert passes[0].all()
    assert not passes[1].any()


def test_a_target_out_of_the_field_is_said() -> None:
    with pytest.raises(UsageError, match=r"no light of the target reaches the sensor|lies behind"):
        ray_image(camera(), target(9000.0, 0.0, 600.0, 10.0), PupilElements.gauss(3))
