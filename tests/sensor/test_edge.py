"""Measured edges: agreement of the free curve with the truth, levels of the tests, and plain ISO 12233."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq
from scipy.stats import binom

from reseau.core.data import Array, Frame
from reseau.core.failure import Code, Failure
from reseau.sensor import EdgeSpread, FreeCurve, measure_edge
from reseau.sensor.edge import _weighed
from reseau.sensor.free_curve import FREQUENCIES
from reseau.sensor.gaussian_edge import EdgePixels

from ..montecarlo import slowly
from .edges import KINDS, STEP, Edge, edge_of, plain_iso

SHOWN = FREQUENCIES[1:]
"""At zero all curves are one."""


def measured(edge: Edge, known: bool = False) -> tuple[EdgeSpread, FreeCurve]:
    found = measure_edge(edge.frame, variance=edge.variance if known else None)
    assert isinstance(found, EdgeSpread)
    assert isinstance(found.free, FreeCurve)
    return found, found.free


@cache
def errors(kind: str, count: int) -> tuple[Array, Array, Array, Array]:
    """Of the curves of some edges: errors, sigmas, errors of the plain ISO 12233; over sigma those of MTF50
    and of the modulation at half a cycle per pixel.
    """
    rows = []
    for seed in range(count):
        edge = edge_of(kind, np.random.default_rng([seed, KINDS.index(kind)]), shot=bool(seed % 2))
        _, free = measured(edge)
        value, sigma = free.mtf(SHOWN)
        assert free.mtf50 is not None
        half, half_sigma = free.mtf50
        nyquist, nyquist_sigma = free.nyquist
        reported = (
            (half - edge.half()) / half_sigma,
            (nyquist - edge.truth(np.array([0.5]))[0]) / nyquist_sigma,
        )
        truth = edge.truth(SHOWN)
        rows.append((value - truth, sigma, plain_iso(edge.frame, SHOWN) - truth, reported))
    first, second, third, fourth = (np.array(column) for column in zip(*rows, strict=True))
    return first, second, third, fourth


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def check(kind: str, count: int, within: tuple[float, float], bias: float) -> None:
    error, sigma, plain, reported = errors(kind, count)
    over = error / sigma
    assert within[0] < rms(over) < within[1], kind
    # Next to a zero of the curve, which every pixel has at one cycle, a modulus cannot be free of bias: 0.8.
    assert np.abs(over.mean(axis=0)).max() < bias, kind
    assert np.abs(over[:, :20].mean()) < bias / 3, kind
    assert rms(error) < 0.8 * rms(plain), kind
    # rms of as many normalised errors: 1 ± 1/√(2·count), here by four of these; 1.3 for the tail of coma.
    assert np.abs(np.sqrt(np.mean(reported**2, axis=0)) - 1).max() < max(4 / np.sqrt(2 * count), 0.42), kind


@pytest.mark.slow
def test_the_free_curve_is_true_within_its_sigmas() -> None:
    check("coma", 8, (0.7, 1.35), 1.8)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_free_curve_is_true_within_its_sigmas_over_many_edges(kind: str) -> None:
    check(kind, 80, (0.9, 1.1), 1.0)
    over = errors(kind, 80)[0] / errors(kind, 80)[1]
    # Every frequency by itself: rms 1 ± 0.08 of 80, three of these beyond what is asked of all; where the
    # solutions that are averaged differ, sigmas are too large.
    assert 0.5 < np.sqrt((over**2).mean(axis=0)).min() < np.sqrt((over**2).mean(axis=0)).max() < 1.33


@pytest.mark.slow
def test_with_little_noise_there_is_no_bias() -> None:
    for kind in KINDS:
        edge = edge_of(kind, np.random.default_rng(7), decibels=100.0)
        _, free = measured(edge)
        # What knots a quarter of a pixel apart leave of a disk's rim; and 32768 rays are no more than that.
        assert np.abs(free.mtf(SHOWN)[0] - edge.truth(SHOWN)).max() < 2e-3
        assert np.abs(plain_iso(edge.frame, SHOWN) - edge.truth(SHOWN)).max() > 2e-3


@pytest.mark.slow
def test_the_test_of_the_gaussian_keeps_its_level() -> None:
    found = [measured(edge_of("gaussian", np.random.default_rng([k, 99])))[0].gaussian for k in range(30)]
    p = np.array([test.p for test in found if test is not None])
    assert len(p) == 30
    # Of a level of 10 % at most as many as happens once in a thousand times, and none of 1e-4.
    assert (p < 0.1).sum() <= binom.isf(1e-3, 30, 0.1)
    assert p.min() > 1e-4
    assert 0.3 < p.mean() < 0.7


@pytest.mark.slow
def test_the_tests_keep_their_levels_over_many_edges() -> None:
    many = [
        measured(edge_of("gaussian", np.random.default_rng([k, 98]), shot=k % 2 == 0)) for k in range(400)
    ]
    for p in (
        np.array([found.gaussian.p for found, _ in many if found.gaussian is not None]),
        np.array([found.bent.p for found, _ in many if found.bent is not None]),
        np.array([free.ends()[1] for _, free in many]),
    ):
        for level in (0.01, 0.05, 0.2):
            expected, scatter = 400 * level, np.sqrt(400 * level * (1 - level))
            assert abs((p < level).sum() - expected) < 3.5 * scatter, level


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*slowly("defocus"), "flare", "coma"])
def test_a_non_gaussian_edge_is_reported(kind: str) -> None:
    for seed in range(3):
        found, _ = measured(edge_of(kind, np.random.default_rng([seed, 5]), decibels=46.0))
        assert found.gaussian is not None
        assert found.gaussian.significant
        assert {test["name"]: test["passed"] for test in found.tests()}["Gaussian edge"] is False


@pytest.mark.slow
def test_a_bent_edge_is_detected_and_modelled() -> None:
    bow, over, curves = 4e-4, [], []
    sag = bow * 24**2
    for seed in range(8):
        edge = edge_of("gaussian", np.random.default_rng([seed, 3]), bow=bow)
        found, free = measured(edge)
        assert found.bent is not None
        assert found.bent.significant
        # Seen from the other side of the diagonal it is the same bow, to the cube of the slope.
        over.append((abs(free.fit["bow"]) - sag) / free.fit.sigma_of("bow"))
        value, sigma = free.mtf(SHOWN)
        curves.append((value - edge.truth(SHOWN)) / sigma)
        assert found.gaussian is not None
        assert found.gaussian.p > 1e-4
    assert rms(np.array(over)) < 1.7
    assert 0.75 < rms(np.array(curves)) < 1.3


@pytest.mark.slow
def test_an_edge_blurred_only_by_the_pixels_is_measured() -> None:
    over = []
    for seed in range(8):
        edge = edge_of("none", np.random.default_rng([seed, 9]))
        found, free = measured(edge)
        value, sigma = free.mtf(SHOWN)
        over.append((value - edge.truth(SHOWN)) / sigma)
        # The width takes part by its square: where noise would have that negative it is held, with no sigma.
        width, scatter = abs(found.fit["psf"]), found.fit.sigma_of("psf")
        assert width == pytest.approx(0.02) if scatter == 0 else width < 0.3
        assert found.mtf50[0] == pytest.approx(edge.half(), abs=0.03)
    assert 0.7 < rms(np.array(over)) < 1.3


@pytest.mark.slow
def test_known_noise_determines_the_weights() -> None:
    over = []
    for seed in range(8):
        edge = edge_of("gaussian", np.random.default_rng([seed, 4]), shot=True)
        found, free = measured(edge, known=True)
        value, sigma = free.mtf(SHOWN)
        over.append((value - edge.truth(SHOWN)) / sigma)
        assert free.fit.sigma0 == pytest.approx(1.0, abs=4 / np.sqrt(2 * free.fit.redundancy))
        assert abs(abs(found.fit["bright"] - found.fit["dark"]) - STEP) < 6 * found.fit.sigma_of("bright") + 1
    assert 0.75 < rms(np.array(over)) < 1.3


def test_blur_beyond_the_region_is_reported() -> None:
    edge = edge_of("gaussian", np.random.default_rng(0), decibels=46.0)
    y, x = np.mgrid[:48, :48]
    uneven = Frame(edge.frame.pixels * (1 + 1e-3 * x + 1e-3 * y), 1e4)
    for frame, flat in ((edge.frame, True), (uneven, False)):
        found = measure_edge(frame)
        assert isinstance(found, EdgeSpread)
        assert {test["name"]: test["passed"] for test in found.tests()}["flat beside the edge"] is flat


def test_frequencies_that_are_not_resolved_are_not_reported() -> None:
    y, x = np.mgrid[:40, :40] - 19.5
    noise = np.random.default_rng(1).normal(0, 1.0, (40, 40))
    for slope, limit in ((0.25, 1.0), (0.5, 0.56)):
        # Rows one and the same distance apart again and again: as few distances as there are phases.
        frame = Frame(100 + 80 * np.tanh((x - slope * y) / 1.2) + noise, 255.0)
        found = measure_edge(frame)
        assert isinstance(found, EdgeSpread)
        assert isinstance(found.free, FreeCurve)
        assert found.free.limit == pytest.approx(limit, abs=0.01)
        frequency = np.array(found.to_model()["mtf"]["frequency"])
        assert frequency.max() <= found.free.limit < frequency.max() + 1 / 32 + 1e-9 or limit == 1.0
    steep = Frame(100 + 80 * np.tanh((x - 0.025 * y)[:16] / 1.2) + noise[:16], 255.0)
    found = measure_edge(steep)
    assert isinstance(found, EdgeSpread)
    assert isinstance(found.free, Failure)
    assert "too few pixels" in found.free.reason
    assert "no free curve" in found.validity()["edge"]
    assert set(found.quantities()) == {"psf", "mtf50"}


def test_noise_is_not_an_edge() -> None:
    for seed in range(20):
        found = measure_edge(Frame(np.random.default_rng(seed).normal(100, 3, (40, 20)), 255.0))
        assert isinstance(found, Failure)
        assert "no edge above the noise" in found.reason


def gaussian_edge(rng: np.random.Generator, psf: float, turned: bool) -> Frame:
    """An edge formed by ten by ten points to a pixel, blurred, and averaged; of whole grey values."""
    fine, n = 10, 48
    angle = np.deg2rad(rng.uniform(3, 12)) * rng.choice([-1, 1])
    y, x = (np.mgrid[: n * fine, : n * fine] + 0.5) / fine - 0.5
    d = (x - n / 2 - rng.uniform(-1, 1) - np.tan(angle) * (y - n / 2)) * np.cos(angle)
    light = gaussian_filter(np.clip(d * fine + 0.5, 0, 1), psf * fine, mode="nearest")
    pixels = 40 + 160 * light.reshape(n, fine, n, fine).mean(axis=(1, 3))
    pixels = np.rint((pixels.T if turned else pixels) + rng.normal(0, 1.0, pixels.shape))
    return Frame(np.clip(pixels, 0, 255).astype(np.uint8), 255.0)


@pytest.mark.slow
def test_the_sharpness_of_an_edge_is_recovered_within_its_sigmas() -> None:
    widths, halves = [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        psf = rng.uniform(0.4, 1.5)
        found = measure_edge(gaussian_edge(rng, psf, bool(seed % 2)), (4, 4, 40, 40))
        assert isinstance(found, EdgeSpread)
        widths.append((abs(found.fit["psf"]) - psf) / found.fit.sigma_of("psf"))
        half, sigma = found.mtf50
        true = brentq(lambda f, m=found, w=psf: float(m.mtf(f, w)) - 0.5, 1e-6, 0.99)
        halves.append((half - true) / sigma)
        assert sigma < 0.002
    # rms of 24 normalised errors: 1 ± 0.14; of their mean 0 ± 0.2.
    for normalised in (widths, halves):
        assert 0.6 < rms(np.array(normalised)) < 1.45
        assert abs(np.mean(normalised)) < 0.7


@pytest.mark.parametrize(
    ("pixels", "code"),
    [
        (np.zeros((8, 8)), Code.TOO_SMALL),
        (np.zeros((40, 40)), Code.NOT_FOUND),
        (np.repeat([[0.0] * 20 + [100.0] * 20], 40, axis=0) + np.eye(40), Code.SLANT),
        (
            np.clip(100 + 300 * np.tanh(np.add.outer(np.arange(40) / 10, np.arange(-22, 18))), 0, 255),
            Code.SATURATED,
        ),
    ],
)
def test_regions_without_a_slanted_edge_are_declined(pixels: Array, code: Code) -> None:
    found = measure_edge(Frame(pixels, 255.0))
    assert isinstance(found, Failure)
    assert found.code is code
    assert found.reason


def test_the_modulation_of_the_gaussian_is_that_of_its_width_and_the_pixel() -> None:
    fit: Any = {"slope": 0.0, "psf": 0.8}
    f = np.array([0.1, 0.25, 0.5])
    found = EdgeSpread(fit, Failure("", Code.NOT_IDENTIFIED)).mtf(f)
    np.testing.assert_allclose(found, np.exp(-2 * (np.pi * 0.8 * f) ** 2) * np.sinc(f), rtol=1e-12)


def test_variances_of_grey_values_are_weighted_by_their_own_size() -> None:
    """Squares of residuals of 1, 4 and 4 in the dark, between, and in the light: Σ (r² − m) ∂m / m² = 0."""
    share, size = np.repeat([0.0, 0.5, 1.0], 4), np.repeat([1.0, 2.0, 2.0], 4)
    free: Any = SimpleNamespace(
        base=(0, 0, 0, 10.0, 110.0, 1), fit=SimpleNamespace(residuals=size, redundancy=12)
    )
    pixels = EdgePixels(share, share, 10 + 100 * share - size, np.ones(12), (3, 4))
    mean = _weighed(free, pixels).sigma ** 2
    by = np.stack([1 - share, share])
    # Two steps of the iteration leave 0.18; all weights alike leave 0.67.
    assert np.abs(by @ ((size**2 - mean) / mean**2)).max() < 0.3
