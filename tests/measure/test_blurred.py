"""Blurred targets: places of the corresponding rays in photographs drawn with other rays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from reseau.core.data import Array, Frame
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.measure.blurred import BlurredOptions, estimate_optics, measure_blurred
from reseau.measure.blurred.estimate import EstimatedOptics
from reseau.measure.blurred.likeness import Residuals, widths_differ
from reseau.measure.blurred.measure import Varied
from reseau.measure.blurred.motion import Kind, Motion, Moving, _Compared, explained, measure_explained
from reseau.measure.blurred.shapes import RayShapes
from reseau.measure.matching.shapes import Window
from reseau.optics.formation import Outline, PixelResponse
from reseau.optics.lenses import AIR, Prescription, PupilElements, ThinLens, ray_image
from reseau.optics.lenses.images import PlaneTarget
from reseau.optics.lenses.media import Cauchy
from reseau.optics.lenses.prescription import Surface
from reseau.optics.lenses.ray_maps import LensCamera, SensorPlane
from reseau.procedures.blurred import refocused

from . import blurs

CENTRE = np.array([66.0, 41.0, 700.0])
AXES = np.array([[0.9, 0.0], [0.0, 1.0], [np.sqrt(1 - 0.81), 0.0]])
DIAMETER = 2.4
SIGMA = 0.5


def camera(focus: float = blurs.FOCUS, index: float = 0.0) -> LensCamera:
    """The lens; with another focus, and with a glass of which the index is another one."""
    wavelengths = tuple(w for w, _ in blurs.INDICES)
    terms = np.array([[1, 1e6 / w**2, 1e12 / w**4] for w in wavelengths])
    glass = Cauchy(tuple(np.linalg.solve(terms, [n + index for _, n in blurs.INDICES])), "glass")
    surfaces = (
        Surface(kind="plain", name="stop"),
        Surface(blurs.CURVATURES[0], medium=glass, vertex=np.array([0, 0, blurs.LENS_Z])),
        Surface(blurs.CURVATURES[1], medium=AIR, vertex=np.array([0, 0, blurs.LENS_Z + blurs.THICKNESS])),
        Surface(kind="plain", vertex=np.array([0, 0, focus])),
    )
    lens = Prescription(surfaces, 0, blurs.STOP_RADIUS, wavelengths, (1.0, 1.0, 1.0), 1, name="singlet")
    return LensCamera(lens, SensorPlane((blurs.PITCH, blurs.PITCH), blurs.PRINCIPAL))


def target(centre: Array = CENTRE, diameter: float = DIAMETER) -> PlaneTarget:
    return PlaneTarget(centre, AXES, Outline.circle(diameter / 2, 0.05))


@cache
def drawn(focus: float = blurs.FOCUS) -> Array:
    return blurs.drawn(CENTRE, AXES, DIAMETER, SIGMA, focus)


def photograph(noise: float = 1.0, seed: int = 0, focus: float = blurs.FOCUS) -> Frame:
    image = drawn(focus)
    return Frame(image + np.random.default_rng(seed).normal(0.0, noise, image.shape), 255.0)


@pytest.mark.slow
def test_the_place_of_the_corresponding_ray_is_found_where_the_centre_of_density_is_not() -> None:
    found = measure_blurred(photograph(), camera(), ["1"], [target()])
    error = found.xy[0] - blurs.principal_pixel(CENTRE)
    sigma = np.sqrt(np.diagonal(found.cov[0]))
    assert (np.abs(error) < 4 * sigma + 0.003).all()  # the drawing is exact to 0.003 px
    assert sigma.max() < 0.02
    assert np.hypot(*found.offset[0]) > 0.5


def test_pixels_of_principal_rays_agree_with_those_of_other_rays() -> None:
    points = CENTRE + np.array([[0, 0, 0], [10, 0, 50], [-60, -40, 300], [5, 30, -200.0]])
    other = [blurs.principal_pixel(point) for point in points]
    assert np.abs(camera().corresponding(points) - other).max() < 1e-8


@pytest.mark.slow
def test_the_focus_is_estimated_with_the_place() -> None:
    frame = photograph(focus=blurs.FOCUS + 0.15)
    focus = Varied(("focus_mm",), (0.2,), lambda by: camera(blurs.FOCUS + by[0]))
    options = BlurredOptions(varied=focus)
    found = measure_blurred(frame, camera(), ["1"], [target()], options)
    assert found.ok.all()
    assert abs(found.varied[0, 0] - 0.15) < 4 * found.varied_sigma[0, 0] + 0.005


@pytest.mark.slow
def test_an_index_is_estimated_with_the_place() -> None:
    glass = Varied(("index",), (0.01,), lambda by: camera(index=0.004 + by[0]))
    wrong = glass.camera(np.zeros(1))
    found = measure_blurred(photograph(), wrong, ["1"], [target()], BlurredOptions(varied=glass))
    assert found.ok.all()
    assert abs(found.varied[0, 0] + 0.004) < 4 * found.varied_sigma[0, 0] + 1e-4
    error = found.xy[0] - blurs.principal_pixel(CENTRE)
    assert (np.abs(error) < 4 * np.sqrt(np.diagonal(found.cov[0])) + 0.005).all()
    assert not any("times the noise" in str(note) for note in found.notes)
    left = measure_blurred(photograph(), wrong, ["1"], [target()])
    assert any("times the noise" in str(note) for note in left.notes)


def test_focus_and_index_are_estimated_from_all_targets_of_a_frame() -> None:
    both = Varied(
        ("focus_mm", "index"), (0.3, 0.001), lambda by: camera(blurs.FOCUS - 0.2 + by[0], 0.0005 + by[1])
    )
    found = estimate_optics(photograph(), [target()], both)
    assert isinstance(found, EstimatedOptics)
    assert found.used == 1
    # One target tells their sum only; the index is held by what was known of it.
    sharp = found.values - [0.2, -0.0005]
    assert (np.abs(sharp) < 3 * found.sigma).all()
    error = measure_blurred(photograph(), found.camera, ["1"], [target()]).xy[0]
    assert np.abs(error - blurs.principal_pixel(CENTRE)).max() < 0.02


def test_optics_of_which_no_target_is_an_image_are_not_estimated() -> None:
    focus = Varied(("focus_mm",), (0.1,), lambda by: camera(blurs.FOCUS + by[0]))
    elsewhere = CENTRE + np.array([4.0, 2.0, 0.0])
    found = estimate_optics(photograph(), [target(elsewhere)], focus)
    assert isinstance(found, Failure)
    assert found.code == Code.NOT_FOUND


@pytest.mark.parametrize(("names", "sigma"), [(("a", "b"), (1.0,)), (("a",), (0.0,)), (("a",), (np.inf,))])
def test_parameters_without_a_standard_deviation_are_refused(
    names: tuple[str, ...], sigma: tuple[float, ...]
) -> None:
    with pytest.raises(UsageError, match="standard deviations"):
        Varied(names, sigma, lambda by: camera())


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "said"), [(np.arange(-3, 4), "moved over "), (np.zeros(1), "")])
def test_motion_explains_what_a_lens_at_rest_does_not(steps: Array, said: str) -> None:
    """Seven images, each a pixel from the next, have the second moments of a steady motion over √48 px."""
    moved = np.mean([np.roll(drawn(), int(step), axis=1) for step in steps], axis=0)
    frame = Frame(moved + np.random.default_rng(1).normal(0, 1.0, moved.shape), 255.0)
    found, reason = measure_explained(frame, camera(), ["1"], [target()], BlurredOptions())
    assert [said in note.text for note in found.notes] == [True] * bool(said)
    assert (reason is not None) == bool(said)
    assert reason is None or abs(reason.extent_px - np.sqrt(48)) < 0.05  # its sigma is 0.04
    assert np.abs(found.xy[0] - blurs.principal_pixel(CENTRE)).max() < 0.02


@pytest.mark.slow
def test_a_motion_is_told_where_no_target_is_like_its_image_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with motions over 37 px, which take minutes."""
    fitted = _Compared.fitted
    monkeypatch.setattr(
        _Compared, "fitted", lambda own, kind, *rest: fitted(own, kind, *rest) if kind != Kind() else None
    )
    moved = np.mean([np.roll(drawn(), step, axis=1) for step in range(-3, 4)], axis=0)
    frame = Frame(moved + np.random.default_rng(1).normal(0, 1.0, moved.shape), 255.0)
    reason = explained(frame, camera(), [target()])
    assert reason is not None
    assert abs(reason.extent_px - np.sqrt(48)) < 0.1


@pytest.mark.slow
def test_a_stop_that_is_stated_too_wide_is_told_by_the_form_of_an_image() -> None:
    reason = explained(photograph(), refocused(camera(), 0.0, np.log(1.1)), [target()], altered=refocused)
    assert reason is not None
    assert reason.kind.lens == ("stop",)
    optics = reason.optics
    assert abs(optics.values[0] + np.log(1.1)) < 3 * optics.sigma[0] < 0.1


def test_widths_that_differ_by_more_than_their_sigmas_are_not_one_width() -> None:
    width = 0.45 * np.exp(0.01 * np.random.default_rng(0).normal(size=12))
    assert not widths_differ(width, np.full(12, 0.01), 20000)
    assert widths_differ(width + np.linspace(0, 0.05, 12), np.full(12, 0.01), 20000)


def test_lines_that_are_exposed_later_see_the_target_where_it_is_then() -> None:
    still, point = camera(), CENTRE[None]
    motion = Motion(np.array([0.0, 1e-3, 0.0, 0.0, 0.0, 0.0]), np.zeros(6), per_line=0.01)
    line = still.corresponding(point)[0, 1]
    late = Moving(still, replace(motion, middle=line - 50), 5).corresponding(point)
    assert late == pytest.approx(still.corresponding(motion.moved(point, np.array([[0.5]]))[0]), abs=1e-9)
    at_middle = Moving(still, replace(motion, middle=line), 5).corresponding(point)
    assert at_middle == pytest.approx(still.corresponding(point), abs=1e-9)


def test_a_thin_lens_in_place_of_the_true_one_misses_the_place_and_its_sigma_says_so() -> None:
    true = camera()
    centre = true.corresponding(CENTRE[None])[0]
    thin = ThinLens(65.0, 2 * blurs.STOP_RADIUS, blurs.FOCUS, true.sensor)
    shift = CENTRE.copy()
    for _ in range(5):  # seen in the same direction through the other lens
        off = thin.corresponding(shift[None])[0] - centre
        shift[:2] -= off * blurs.PITCH * CENTRE[2] / blurs.FOCUS
    found = measure_blurred(photograph(), thin, ["1"], [target(shift)], BlurredOptions(psf_log_sigma=1.0))
    error = found.xy[0] - blurs.principal_pixel(CENTRE)
    assert found.ok[0]
    assert 0.1 < np.hypot(*error) < 3 * np.sqrt(np.linalg.eigvalsh(found.cov[0])[0])


@pytest.mark.parametrize(
    ("centre", "code"),
    [
        (CENTRE + np.array([30.0, 0, 0]), Code.OUTSIDE),
        (CENTRE + np.array([4.0, 2.0, 0]), Code.NOT_FOUND),
    ],
)
def test_what_is_not_there_is_declined_with_the_reason(centre: Array, code: Code) -> None:
    found = measure_blurred(photograph(), camera(), ["1"], [target(centre)])
    assert not found.ok.any()
    assert found.codes == (code,)


def test_another_target_is_declined() -> None:
    found = measure_blurred(photograph(), camera(), ["1"], [target(diameter=2.2 * DIAMETER)])
    assert not found.ok.any()


def test_a_step_to_a_blur_wider_than_the_window_forms_no_image() -> None:
    """Its response would need memory in proportion to the width, here 60 GB."""
    shapes = RayShapes((ray_image(camera(), target(), PupilElements.gauss(4)),))
    pixels = np.arange(40.0)[None]
    window, one = Window(pixels, pixels, PixelResponse()), np.zeros(1, np.intp)
    for width, formed in ((0.5, True), (1e9, False), (np.nan, False)):
        place = np.full((1, 2), 20.0), np.full(1, width), np.zeros((1, 0))
        assert np.isfinite(shapes.image(*place, one, window)).all() == formed
        assert np.isfinite(shapes.derivatives(*place, one, window)[1]).all() == formed


def test_a_target_behind_the_lens_is_one_line() -> None:
    found = measure_blurred(photograph(), camera(), ["1"], [target(np.array([0.0, 0.0, -100.0]))])
    assert "behind" in found.why[0]


def test_names_and_targets_must_be_as_many() -> None:
    with pytest.raises(UsageError, match="2 names were given for 1 targets"):
        measure_blurred(photograph(), camera(), ["1", "2"], [target()])


@pytest.mark.slow
def test_errors_are_as_large_as_sigmas_say() -> None:
    errors = []
    for seed in range(60):
        found = measure_blurred(photograph(2.0, seed), camera(), ["1"], [target()])
        errors.append((found.xy[0] - blurs.principal_pixel(CENTRE)) / np.sqrt(np.diagonal(found.cov[0])))
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.2


@pytest.mark.slow
def test_photon_noise_is_not_a_wrong_lens_and_a_wrong_focus_is() -> None:
    view, at = ThinLens(50.0, 12.5, 52.9, SensorPlane((0.01, 0.01), (40.0, 40.0))), np.arange(81.0)
    wrong = replace(view, image_distance=52.95)
    disk = PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(2.0, 0.05))
    image = ray_image(view, disk, PupilElements.gauss(8))
    light = 5 + 150 * image.formed(image.point, 0.5, at, at, PixelResponse(), bright=True)
    right, other = [], []
    for seed in range(40):
        # 5.6 times as much noise in the middle of the disk as beside it.
        noise = np.random.default_rng(seed).normal(size=light.shape) * np.sqrt(light / 20)
        options = BlurredOptions("bright", rings=8)
        for lens, notes in ((view, right), (wrong, other)):
            found = measure_blurred(Frame(light + noise, 255.0), lens, ["1"], [disk], options)
            assert found.ok.all()
            notes.append(any("lens, focus or aperture" in str(note) for note in found.notes))
    assert sum(right) <= 3  # of 40; 2 % are expected, and more than three with a probability of 0.8 %
    assert sum(other) >= 38


def test_the_variance_of_grey_values_is_that_of_the_residuals() -> None:
    grey = np.tile(np.linspace(20, 200, 96), (8, 96, 1))
    off = np.random.default_rng(0).normal(size=grey.shape) * np.sqrt(0.5 + grey / 20)
    found = Residuals(grey, off).variance()
    assert found is not None
    assert found[0] + 100 * found[1] == pytest.approx(5.5, rel=0.06)
