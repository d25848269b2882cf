"""The tube: derivatives of its corrections, lines and spot, and the positions of what it draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.optics import RationalPolynomial
from reseau.optics.mapping import PlaneMapping
from reseau_sims import Bending, Display, Instrument, Scanner, Screen, Video, World

POINTS = np.array([[12.0, -31.0], [-60.0, 44.0], [3.0, 2.0], [55.0, 20.0]])


def waves() -> Bending:
    x, y = np.arange(-90.0, 91.0), np.arange(-70.0, 71.0)
    shift = np.stack(np.meshgrid(0.2 * np.sin(x / 9), 0.3 * np.cos(y / 11)), axis=-1)
    return Bending(x, y, shift)


def mappings() -> list[PlaneMapping]:
    tube = Display.drawn(np.random.default_rng(1)).correction
    return [Instrument(tube, 4e-3, -3e-3), Instrument(RationalPolynomial.affine()), waves()]


@pytest.mark.parametrize("mapping", mappings(), ids=["wong", "ideal", "bending"])
def test_derivatives_and_inverse(mapping: PlaneMapping) -> None:
    _, d_xy, d_parameters = mapping.derivatives(POINTS)
    step = 1e-4
    for axis, way in enumerate(np.eye(2)):
        numeric = (mapping(POINTS + step * way) - mapping(POINTS - step * way)) / (2 * step)
        np.testing.assert_allclose(d_xy[:, :, axis], numeric, rtol=0, atol=1e-8)
    assert d_parameters.shape == (4, 2, len(mapping.names))
    for k, name in enumerate(mapping.names):
        value = mapping.value_of(name)
        h = 1e-3 * max(1e-6, abs(value))
        ends = [mapping.with_values({name: value + sign * h})(POINTS) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(
            d_parameters[:, :, k], numeric, rtol=1e-6, atol=1e-5 * np.abs(numeric).max()
        )
    np.testing.assert_allclose(mapping.inverse(mapping(POINTS)), POINTS, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_random_tube_has_thirteen_parameters_and_distorts_by_millimetres() -> None:
    world = World.standard(0)
    instrument = Instrument(world.display.correction, world.scanner.m1, world.scanner.m2)
    assert len(instrument.names) == 13
    corners = np.array([[70.0, 50.0], [-70.0, 50.0], [70.0, -50.0], [-70.0, -50.0]])
    amounts = []
    for seed in range(20):
        values = World.standard(seed).display.correction
        centre = values(np.zeros((1, 2)))
        amounts.append(np.hypot(*(values(corners) - corners - centre).T).max())
    assert 0.8 < np.median(amounts) < 4
    assert len({round(a, 9) for a in amounts}) == 20


def test_the_polynomial_tube_has_the_sixteen_of_equation_7() -> None:
    display = Display.polynomial(np.random.default_rng(2))
    assert display.correction.names == RationalPolynomial.ultrasonic().names
    assert np.all(display.correction.values != RationalPolynomial.ultrasonic().values)


def video_of(display: Display, screen: Screen, signal: Array) -> Video:
    x, y = display.raster(screen)
    return Video(x, y, np.broadcast_to(signal, (len(y), len(x))).astype(np.float32))


def plain(**settings: float) -> Display:
    identity = RationalPolynomial.affine()
    return Display(identity, grain=0.0, gradient=(0.0, 0.0), falloff=0.0, **settings)  # type: ignore[arg-type]


@pytest.mark.slow
def test_black_has_a_glow_and_white_is_brighter_by_the_contrast() -> None:
    screen, display = Screen(), plain(glow=40.0, contrast=150.0)
    for signal, grey in ((0.0, 40.0), (0.5, 115.0), (1.0, 190.0)):
        display.show(video_of(display, screen, np.array(signal)), screen, np.random.default_rng(0))
        rows, columns = (n // 2 for n in screen.light.shape)
        middle = screen.light[rows - 200 : rows + 200, columns - 200 : columns + 200]
        assert middle.mean() == pytest.approx(grey, rel=1e-3)


@pytest.mark.slow
def test_raster_lines_are_visible_depending_on_the_spot_size() -> None:
    screen = Screen()
    for spot in (0.12, 0.18, 0.22):
        display = plain(spot_mm=spot)
        display.show(video_of(display, screen, np.array(0.5)), screen, np.random.default_rng(0))
        rows, columns = (n // 2 for n in screen.light.shape)
        profile = screen.light[rows - 200 : rows + 200, columns].astype(float)
        spectrum = 2 * np.abs(np.fft.rfft(profile)) / 400 / profile.mean()
        # 400 samples of 0.1 mm hold 100 lines of 0.4 mm; a Gaussian spot leaves exp(−2π²s²/p²) of them.
        expected = 2 * np.exp(-2 * np.pi**2 * (spot / display.line_mm) ** 2)
        assert spectrum[1:].argmax() + 1 == 100
        assert spectrum[100] == pytest.approx(expected, rel=0.02)


def test_a_point_is_drawn_at_the_inverse_of_the_correction() -> None:
    """What is displayed at p belongs at C(p): a point that belongs at q is drawn at the inverse of C."""
    display = replace(plain(), correction=RationalPolynomial.affine().with_values({"a1": 1.02, "c2": -1.5}))
    screen = Screen()
    x, y = display.raster(screen)
    spot = np.exp(-0.5 * ((x[None, :] - 20.4) ** 2 + (y[:, None] - 9.5) ** 2) / 0.5**2)
    display.show(Video(x, y, spot.astype(np.float32)), screen, np.random.default_rng(0), (0.0, 0.02))
    at_x, at_y = screen.raster()
    light = np.maximum(screen.light - 1.05 * display.glow, 0)
    centre = np.array([(light.sum(axis=0) * at_x).sum(), (light.sum(axis=1) * at_y).sum()]) / light.sum()
    np.testing.assert_allclose(centre, [(20.4 - 0.02 * 11.0) / 1.02, 11.0], rtol=0, atol=2e-3)


@pytest.mark.slow
def test_photo_i_does_not_depend_on_scanner_and_display() -> None:
    one = World.standard(3)
    other = World.standard(3, display="polynomial", scanner=Scanner(), rods=one.test_object)
    other.photo_ii()
    assert other.photo_i().sha256 == one.photo_i().sha256
