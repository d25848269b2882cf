"""Rays through lenses: against Zemax, batoid and closed forms; derivatives against differences; lost rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reseau.optics.lenses import AIR, Aperture, Medium, Prescription, Tracer, glass, in_order
from reseau.optics.lenses.media import Constant
from reseau.optics.lenses.prescription import Surface
from reseau.optics.lenses.trace import Rays

from .batoid_lenses import prescription

Data = Callable[[str], Path]

AHEAD = np.array([0.0, 0.0, 1.0])


# Zemax ---------------------------------------------------------------------------------------------------

LSST_ROWS = [5, 6, 8, *range(10, 19)]
DECAM_ROWS = [2, 3, 5, 7, 9, 10, 11, *range(13, 24), *range(28, 41)]


def printed(path: Path) -> np.ndarray:
    """Points and direction cosines of the real rays that Zemax printed, (surfaces, 6), without the object."""
    text = path.read_text("utf-16").split("Real Ray Trace Data:")[1].split("Paraxial Ray Trace Data:")[0]
    rows = [line.split() for line in text.splitlines() if line[:3].strip().isdigit()]
    return np.array([[float(word) for word in row[1:7]] for row in rows])


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize(
    ("lens", "trace", "rows", "wavelength"),
    [
        ("LSST_g_500.yaml", "LSST_trace_{}.txt", LSST_ROWS, 500.0),
        ("DECam.yaml", "DECam_raytrace_{}.txt", DECAM_ROWS, 700.0),
    ],
)
def test_rays_meet_every_surface_where_zemax_printed_them(
    reference_data: Data, lens: str, trace: str, rows: list[int], wavelength: float, number: int
) -> None:
    pytest.importorskip("yaml")
    folder = reference_data("raytrace")
    optic = prescription(folder / "prescriptions" / lens, wavelength)
    points = printed(folder / "traces" / trace.format(number)) * [1, 1, -1, 1, 1, -1]
    start, direction = points[0, :3], points[0, 3:]
    direction = -np.sign(direction[2]) * direction  # towards -z
    traced = Tracer(optic, apertures=False).trace(Rays(start[None], direction[None]), seen=True)
    assert traced.arrived.all()
    assert traced.seen is not None
    vertices = np.array([surface.vertex for surface in optic.surfaces])
    found = traced.seen[:, 0, :3] + vertices
    # The printed direction has ten decimals, of which the 15 m of the light path make 1e-6 mm.
    np.testing.assert_allclose(found, points[np.array(rows) - 1, :3], rtol=0, atol=1e-6)


# batoid --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "DECam/DECam.yaml",
        "LSST/LSST_g_500.yaml",
        "LSST/LSST_r.yaml",
        "LSST/ComCam_g.yaml",
        "LSST/LSST_i.yaml",
    ],
)
def test_rays_and_vignetting_agree_with_batoid_on_its_own_prescriptions(name: str) -> None:
    batoid = pytest.importorskip("batoid")
    path = Path(batoid.datadir) / name
    optic = batoid.Optic.fromYaml(str(path))
    lens = prescription(path)
    for x, y in ((0.0, 0.0), (0.4, 0.6), (-0.2, 0.1)):
        theirs = batoid.RayVector.asPolar(
            optic,
            theta_x=np.radians(x),
            theta_y=np.radians(y),
            wavelength=500e-9,
            nrad=40,
            naz=160,
            inner=0.0,
            outer=0.51 * optic.pupilSize,
        )
        velocity = np.stack([theirs.vx, theirs.vy, theirs.vz], axis=1)
        n0 = lens.before.index(500.0)
        ours = Rays(1e3 * np.stack([theirs.x, theirs.y, theirs.z], axis=1), velocity * n0)
        end = optic.trace(theirs.copy())
        traced = Tracer(lens, apertures=False).trace(ours)
        good = ~end.failed
        np.testing.assert_array_equal(traced.arrived, good)
        np.testing.assert_allclose(
            traced.xy[good], 1e3 * np.stack([end.x, end.y], axis=1)[good], rtol=0, atol=1e-9
        )
        stopped = ~Tracer(lens).trace(ours).arrived
        np.testing.assert_array_equal(stopped, end.vignetted | end.failed)
        assert stopped.mean() > 0.1


def test_silica_has_the_indices_of_an_independent_table(reference_data: Data) -> None:
    table = np.loadtxt(reference_data("raytrace") / "traces" / "silicaDispersion.csv", delimiter=",")
    found = [glass("SILICA").index(1e3 * um) for um in table[:-1, 0]]
    np.testing.assert_allclose(found, table[:-1, 1], rtol=0, atol=1e-12)


# Closed forms --------------------------------------------------------------------------------------------


def test_a_plane_plate_displaces_a_ray_and_keeps_its_direction() -> None:
    n, thickness, angle = 1.5, 10.0, np.radians(np.arange(0.0, 85.0, 5.0))
    surfaces = in_order([(0.0, thickness, Constant(n)), (0.0, 5.0, AIR)])
    lens = Prescription(surfaces, stop=0, stop_radius=1.0)
    directions = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    traced = Tracer(lens).trace(Rays(np.zeros((len(angle), 3)), directions))
    np.testing.assert_allclose(traced.rays.directions, directions, atol=1e-15)
    inside = np.arcsin(np.sin(angle) / n)
    expected = thickness * np.tan(inside) + 5 * np.tan(angle)
    np.testing.assert_allclose(traced.xy[:, 0], expected, atol=1e-12)


def test_rays_parallel_to_the_axis_of_a_sphere_cross_it_where_trigonometry_says() -> None:
    radius, n, height = 20.0, 1.6, np.linspace(0.5, 19.5, 39)
    lens = Prescription(in_order([(1 / radius, 40.0, Constant(n))]), stop=0, stop_radius=1.0)
    start = np.stack([height, np.zeros_like(height), np.full_like(height, -1.0)], axis=1)
    traced = Tracer(lens).trace(Rays(start, np.tile(AHEAD, (len(height), 1))))
    incidence = np.arcsin(height / radius)
    refracted = np.arcsin(height / radius / n)
    crossing = radius + radius * np.sin(refracted) / np.sin(incidence - refracted)
    d = traced.rays.directions
    np.testing.assert_allclose(40 - traced.xy[:, 0] * d[:, 2] / d[:, 0], crossing, atol=1e-11)


@pytest.mark.parametrize("n", [1.3, 1.5, 1.9])
def test_an_aplanatic_sphere_images_its_point_sharply_and_meets_the_sine_condition(n: float) -> None:
    radius = 10.0
    # From glass into air; distances of object and image from the centre are R n'/n and R n/n'.
    at, image = -radius - radius / n, -radius - radius * n
    surfaces = (
        Surface(-1 / radius, medium=AIR),
        Surface(kind="plain", vertex=np.array([0.0, 0.0, image])),
    )
    lens = Prescription(surfaces, stop=0, stop_radius=1.0, before=Constant(n))
    angle = np.radians(np.linspace(0.5, 80.0, 50))
    directions = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    traced = Tracer(lens).trace(Rays(np.tile([0.0, 0.0, at], (50, 1)), directions))
    assert traced.arrived.all()
    np.testing.assert_allclose(traced.xy, 0.0, atol=1e-12)
    # Abbe: n sin U = β n' sin U' with the magnification β = (n/n')².
    np.testing.assert_allclose(np.sin(angle) / traced.rays.directions[:, 0], n, rtol=1e-13)


@pytest.mark.parametrize("kind", ["mirror", "refracting"])
def test_conics_without_spherical_aberration_unite_parallel_rays_in_one_point(kind: str) -> None:
    n, radius = 1.5, 50.0
    medium: Medium
    if kind == "mirror":  # a paraboloid; its focus is in front of it
        conic, focus, medium = -1.0, -radius / 2, AIR
        first = Surface(-1 / radius, conic, kind="mirror")
    else:  # an ellipsoid with the eccentricity 1/n
        conic, focus, medium = -1 / n**2, radius * n / (n - 1), Constant(n)
        first = Surface(1 / radius, conic, medium=medium)
    last = Surface(kind="plain", vertex=np.array([0.0, 0.0, focus]))
    lens = Prescription((first, last), stop=0, stop_radius=1.0)
    start = np.random.default_rng(1).uniform(-25, 25, (200, 3)) * [1, 1, 0] - 60 * AHEAD
    traced = Tracer(lens).trace(Rays(start, np.tile(AHEAD, (200, 1))))
    assert traced.arrived.all()
    np.testing.assert_allclose(traced.xy, 0.0, atol=1e-12)


def test_an_asphere_is_where_its_sag_says() -> None:
    surface = Surface(0.02, -1.3, (1e-5, -2e-8, 3e-11, 1e-14), kind="plain", name="asphere")
    lens = Prescription((Surface(kind="mirror", vertex=-50 * AHEAD), surface), stop=0, stop_radius=1.0)
    rng = np.random.default_rng(2)
    start = rng.uniform(-15, 15, (500, 3)) * [1, 1, 0] - 60 * AHEAD
    away = rng.normal(0, 0.02, (500, 3)) * [1, 1, 0] + AHEAD
    traced = Tracer(lens).trace(Rays(start, away / np.linalg.norm(away, axis=1)[:, None]))
    good = traced.arrived
    assert good.all()
    xyz = traced.rays.xyz
    np.testing.assert_allclose(xyz[:, 2], surface.sag(xyz[:, 0], xyz[:, 1]), atol=1e-12)


# Derivatives ---------------------------------------------------------------------------------------------


def _turned(*rotation: float) -> np.ndarray:
    return Rotation.from_rotvec(rotation).as_matrix()


FOLDED = (
    Surface(0.02, -0.5, (1e-5, -2e-8), medium=Constant(1.5), name="asphere"),
    Surface(-0.01, 0.3, vertex=np.array([0.3, -0.2, 6.0]), axes=_turned(0.05, -0.03, 0.2), name="ellipsoid"),
    Surface(
        -0.004,
        -1.0,
        kind="mirror",
        vertex=60 * AHEAD,
        axes=_turned(0.3, 0.1, 0),
        name="mirror",
    ),
    Surface(
        0.0,
        0.0,
        (2e-6,),
        "mirror",
        vertex=np.array([4.0, -30.0, 20.0]),
        axes=_turned(0.2, 0, 0),
        name="plate",
    ),
    Surface(0.0, medium=Constant(1.4), vertex=np.array([5.0, -40.0, 50.0]), name="plane"),
    Surface(kind="plain", vertex=np.array([5.0, -45.0, 70.0]), axes=_turned(0.02, 0.01, 0.3), name="image"),
)
"""A folded lens of every kind of surface, decentred and tilted."""


def folded(surfaces: tuple[Surface, ...] = FOLDED) -> Prescription:
    return Prescription(surfaces, stop=1, stop_radius=10.0, name="folded")


@pytest.fixture(scope="module")
def bundle() -> Rays:
    rng = np.random.default_rng(1)
    start = rng.uniform(-2, 2, (20, 3)) - 50 * AHEAD
    return Rays.between(start, rng.uniform(-5, 5, (20, 3)) * [1, 1, 0])


# Lost rays -----------------------------------------------------------------------------------------------


def ball(*apertures: Aperture) -> Tracer:
    rows = [(0.1, 20.0, glass("N-BK7")), (-0.1, 5.0, AIR)]
    first, *rest = in_order(rows)
    lens = Prescription((replace(first, apertures=apertures), *rest), stop=0, stop_radius=5.0, name="ball")
    return Tracer(lens)


def test_a_ray_that_misses_a_surface_is_lost_there() -> None:
    tracer = ball()
    traced = tracer.trace(Rays(np.array([[0.0, 10.5, -30.0], [0.0, 1.0, -30.0]]), np.tile(AHEAD, (2, 1))))
    assert traced.lost.tolist() == [1, 0]
    assert tracer.reason(1) == "misses surface 1"
    assert np.isnan(traced.xy[0]).all()
    assert np.isfinite(traced.xy[1]).all()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_ray_that_is_not_finite_is_lost_and_disturbs_no_other(wrong: float) -> None:
    start, directions = np.tile([0.0, 1.0, -30.0], (600, 1)), np.tile(AHEAD, (600, 1))
    expected = ball().trace(Rays(start, directions)).xy[0]
    start[300, 1], directions[450, 2] = wrong, wrong
    traced = ball().trace(Rays(start, directions))
    assert np.flatnonzero(~traced.arrived).tolist() == [300, 450]
    np.testing.assert_array_equal(np.delete(traced.xy, [300, 450], axis=0), np.tile(expected, (598, 1)))


def test_a_ray_does_not_meet_the_second_branch_of_a_hyperboloid() -> None:
    lens = Prescription(
        (
            Surface(0.1, -4.0, medium=Constant(1.5), name="hyperboloid"),
            Surface(kind="plain", vertex=50 * AHEAD),
        ),
        stop=0,
        stop_radius=1.0,
    )
    # Through the gap between the branches at z = 0 and z = -20/3, towards the second only.
    start, directions = (
        np.array([[0.0, 0.0, -4.0], [0.0, 0.0, -4.0]]),
        np.array([[0.0, 0.9, -1.0], [0.0, 0.1, 1.0]]),
    )
    tracer = Tracer(lens)
    traced = tracer.trace(Rays(start, directions / np.linalg.norm(directions, axis=1)[:, None]))
    sag = lens.surfaces[0].sag
    at = (
        Tracer(lens, last=0)
        .trace(Rays(start, directions / np.linalg.norm(directions, axis=1)[:, None]))
        .rays.xyz
    )
    good = traced.arrived
    assert good[1]
    np.testing.assert_allclose(at[good, 2], sag(at[good, 0], at[good, 1]), atol=1e-12)


def test_a_ray_beyond_the_critical_angle_is_totally_reflected() -> None:
    lens = Prescription(in_order([(0.0, 5.0, Constant(1.5)), (0.0, 5.0, AIR)]), stop=0, before=Constant(1.5))
    critical = np.arcsin(1 / 1.5)
    angle = critical + np.array([-1e-9, 1e-9])
    directions = np.stack([np.sin(angle), np.zeros(2), np.cos(angle)], axis=1)
    tracer = Tracer(lens)
    traced = tracer.trace(Rays(np.zeros((2, 3)), directions))
    assert traced.arrived.tolist() == [True, False]
    assert tracer.reason(int(traced.lost[1])) == "is totally reflected at surface 2"


@pytest.mark.parametrize(
    ("aperture", "passes"),
    [
        (Aperture("circle", (2.0, 1.0)), [False, True, False]),
        (Aperture("circle", (2.0, 1.0), blocks=True), [True, False, True]),
        (Aperture("rectangle", (0.2, 2.0)), [True, True, False]),
        (Aperture("rectangle", (2.0, 0.2), turn=np.pi / 2), [True, True, False]),
        (Aperture("polygon", corners=np.array([[-1.0, 1.0], [1.0, 1.0], [0.0, 2.0]])), [False, True, False]),
        (Aperture("circle", (1.0, 0.0), centre=(0.0, 2.6)), [False, False, True]),
    ],
)
def test_apertures_stop_what_is_outside_them(aperture: Aperture, passes: list[bool]) -> None:
    tracer = ball(aperture)
    y = np.array([0.0, 1.5, 3.0])
    start = np.stack([np.zeros(3), y, np.full(3, -30.0)], axis=1)
    traced = tracer.trace(Rays(start, np.tile(AHEAD, (3, 1))))
    assert traced.arrived.tolist() == passes
    assert {tracer.reason(int(code)) for code in traced.lost[traced.lost != 0]} == {"is stopped at surface 1"}
    at = Tracer(tracer.lens, last=0, apertures=False).trace(Rays(start, np.tile(AHEAD, (3, 1)))).xy
    assert aperture.passes(*at.T).tolist() == passes


def test_a_ray_for_which_an_asphere_has_no_point_is_lost_and_not_somewhere() -> None:
    surfaces = (
        Surface(0.05, 0.0, (1e-3, 1e-4, -1e-5), medium=Constant(1.5), name="wild"),
        Surface(kind="plain", vertex=50 * AHEAD),
    )
    lens = Prescription(surfaces, stop=0, stop_radius=1.0)
    rng = np.random.default_rng(3)
    start = rng.uniform(-40, 40, (2000, 3)) * [1, 1, 0] - 60 * AHEAD
    away = rng.normal(0, 0.5, (2000, 3)) * [1, 1, 0] + AHEAD
    rays = Rays(start, away / np.linalg.norm(away, axis=1)[:, None])
    tracer = Tracer(lens, last=0)
    traced = tracer.trace(rays)
    good = traced.arrived
    assert 10 < good.sum() < 2000
    assert np.isfinite(traced.rays.xyz[good]).all()
    on = Tracer(Prescription((replace(surfaces[0], kind="plain"), *in_order([(0.01, 1.0, glass("N-BK7"))])),
                             stop=0, stop_radius=1.0), last=0).trace(rays)  # fmt: skip
    x, y, z = on.rays.xyz[good].T
    np.testing.assert_allclose(z, surfaces[0].sag(x, y), rtol=1e-9, atol=1e-9)


def test_a_ray_does_not_depend_on_those_traced_with_it_nor_on_threads(bundle: Rays) -> None:
    tracer = Tracer(folded())
    pairs = zip(bundle.xyz, bundle.directions, strict=True)
    alone = [tracer.trace(Rays(p[None], d[None])).xy[0] for p, d in pairs]
    np.testing.assert_allclose(alone, tracer.trace(bundle).xy, rtol=0, atol=1e-12)
    many = Rays(np.tile(bundle.xyz, (4000, 1)), np.tile(bundle.directions, (4000, 1)))
    one, two = (Tracer(folded(), threads=k).trace(many) for k in (1, 2))
    np.testing.assert_array_equal(one.xy, two.xy)
