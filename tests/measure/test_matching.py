"""Patches matched with formed images: derivatives, known positions, and disturbances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from reseau.adjust import adjust_batch
from reseau.measure import MatchOptions, match
from reseau.measure.matching import matcher
from reseau.measure.matching.correlation import with_alike_errors
from reseau.measure.matching.iteration import Iteration
from reseau.measure.matching.matcher import SIZE
from reseau.measure.matching.matches import Matches
from reseau.measure.matching.patches import Patches
from reseau.measure.matching.shapes import GrownOutline, Window
from reseau.optics.formation import Outline, PixelResponse, draw, mark_outline

SHAPE, LEVEL, NOISE = (150, 190), 170.0, 2.0
MARKS = {"disk": (7.0, None), "square": (5.0, None), "cross": (13.0, 2.4), "line-grid": (0.0, 3.0)}


def places(seed: int = 0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(25, 180, 35), np.arange(25, 140, 33))
    xy = np.stack([x, y], axis=-1).reshape(-1, 2)
    return xy + np.random.default_rng(seed).uniform(-0.5, 0.5, xy.shape)


def outlines(shape: str, count: int) -> Outline:
    size, width = MARKS[shape]
    one = mark_outline(shape, size, width, 0.35, 14.0)
    turned = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    return one.affine(np.tile(turned, (count, 1, 1)))


def formed(shape, xy, *, bright=False, psf=0.8, fill=1.0, contrast=0.7, slope=0.0, shifts=None):
    outline = outlines(shape, len(xy))
    share = draw(
        Outline(outline.xy + xy[:, None, :], outline.dxy), SHAPE, psf, PixelResponse(fill), row_shifts=shifts
    )
    light = LEVEL * (1 + slope * (np.arange(SHAPE[1]) - 95) / 95)
    return 0.4 * light + 100 * share if bright else light * (1 - contrast * share)


def noise(seed: int, sigma: float = NOISE) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, sigma, SHAPE)


def matched(pixels, xy, shape="disk", valid=None, sigma=NOISE, **options):
    off = np.random.default_rng(9).uniform(-0.6, 0.6, xy.shape)
    return match(
        pixels,
        np.ones(SHAPE, dtype=bool) if valid is None else valid,
        outlines(shape, len(xy)),
        xy + off,
        MatchOptions(**{"half_px": 9, "psf_px": 0.7} | options),
        noise=sigma,
        form=SIZE,
        form_sigma=np.array([0.1]),
    )


@pytest.mark.parametrize("polarity", ["dark", "bright"])
@pytest.mark.parametrize("background", [1, 2])
@pytest.mark.parametrize("fill", [1.0, 0.8])
@pytest.mark.parametrize("shape", sorted(MARKS))
def test_the_derivatives_are_those_of_the_formed_image(shape, polarity, background, fill):
    xy = places()[:3]
    options = MatchOptions(
        half_px=8, polarity=polarity, background=background, response=PixelResponse(fill), psf_px=0.8
    )
    form = GrownOutline(outlines(shape, 3), SIZE)
    patch = Patches(noise(0) + LEVEL, np.ones(SHAPE, dtype=bool), form, xy, options)
    rng, rows = np.random.default_rng(1), np.arange(3)
    x = patch.start(NOISE)
    x[:, :2], x[:, 2], x[:, -1] = rng.uniform(-0.4, 0.4, (3, 2)), np.log(0.75), 0.03
    x[:, 3] = 0.6 if polarity == "dark" else 90.0
    _, jacobian = patch.form_image(x, rows)
    for column in range(x.shape[1]):
        step = np.zeros(x.shape[1])
        step[column] = 1e-5 * max(1.0, abs(x[0, column]))
        ahead, behind = (patch.form_image(x + sign * step, rows)[0] for sign in (1, -1))
        numeric = (ahead - behind) / (2 * step[column])
        assert jacobian[:, :, column] == pytest.approx(numeric, abs=1e-5 * max(1.0, np.abs(numeric).max()))


@pytest.mark.parametrize("fill", [1.0, 0.8])
@pytest.mark.parametrize("polarity", ["dark", "bright"])
@pytest.mark.parametrize("shape", sorted(MARKS))
def test_without_noise_positions_are_exact_to_a_thousandth_of_a_pixel(shape, polarity, fill):
    xy = places()
    pixels = formed(shape, xy, bright=polarity == "bright", fill=fill, slope=0.1)
    found = matched(pixels, xy, shape, sigma=0.05, polarity=polarity, response=PixelResponse(fill))
    assert found.converged.all()
    assert np.abs(found.xy - xy).max() < 1e-3
    assert found.psf_px == pytest.approx(0.8, abs=0.01)
    assert found.contrast == pytest.approx(np.full(len(xy), 100.0 if polarity == "bright" else 0.7), rel=0.02)
    assert np.abs(found.form).max() < 0.01


def test_a_shift_of_a_thousandth_of_a_pixel_is_measured():
    xy = places()
    first, second = (matched(formed("square", xy + d), xy, "square", sigma=0.05).xy for d in (0.0, 0.001))
    assert second - first == pytest.approx(0.001, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("polarity", ["dark", "bright"])
def test_covariances_are_those_of_the_errors(polarity):
    xy, errors = places(), []
    clean = formed("disk", xy, bright=polarity == "bright")
    for seed in range(25):
        found = matched(clean + noise(seed), xy, polarity=polarity)
        errors.append((found.xy - xy) / np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2)))
    # 1000 normalised errors: a standard error of 0.022.
    assert np.std(errors) == pytest.approx(1.0, abs=0.09)
    assert np.mean(errors) == pytest.approx(0.0, abs=0.13)


@pytest.mark.slow
def test_known_row_jitter_enters_weights_and_covariances():
    jitter, xy, errors, plain = 0.15, places(), [], []
    for seed in range(20):
        shifts = np.random.default_rng(seed).normal(0, jitter, SHAPE[0])
        pixels = formed("square", xy, shifts=shifts) + noise(seed)
        for known, into in ((jitter, errors), (0.0, plain)):
            found = matched(pixels, xy, "square", row_jitter_px=known)
            into.append(np.stack([found.xy - xy, np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))]))
    error, sigma = np.stack(errors, axis=1)
    # The five marks of a row share its jitter: 80 independent groups, a standard error of 0.08.
    assert np.sqrt(np.mean((error / sigma) ** 2, axis=(0, 1))) == pytest.approx([1.0, 1.0], abs=0.24)
    blind, blind_sigma = np.stack(plain, axis=1)
    assert np.sqrt(np.mean((blind[..., 0] / blind_sigma[..., 0]) ** 2)) > 1.3
    assert np.sqrt(np.mean(error[..., 1] ** 2)) < np.sqrt(np.mean(blind[..., 1] ** 2))


@pytest.mark.slow
def test_the_noise_model_gives_correct_weights_and_covariances():
    a, b, xy, runs = 0.5, 0.2, places(), {}
    clean = formed("disk", xy, contrast=0.9)
    for variance in (None, (a, b)):
        found = [
            matched(
                clean + noise(seed, 1.0) * np.sqrt(a + b * clean),
                xy,
                sigma=5.0,
                variance=variance,
                contrast=0.9,
            )
            for seed in range(25)
        ]
        error = np.array([f.xy - xy for f in found])
        sigma = np.sqrt([np.diagonal(f.cov, axis1=1, axis2=2) for f in found])
        runs[variance] = np.sqrt((error**2).mean()), np.sqrt(((error / sigma) ** 2).mean())
    assert runs[a, b][1] == pytest.approx(1.0, abs=0.09)
    assert runs[None][1] < 0.92
    assert runs[a, b][0] < runs[None][0]


def test_bit_errors_in_a_mark_do_not_move_it():
    xy = places()
    pixels = formed("disk", xy) + noise(3)
    column, row = np.rint(xy).astype(int).T
    pixels[row - 2, column + 1] += 128
    pixels[row + 5, column - 3] -= 64
    found, undisturbed = matched(pixels, xy), matched(formed("disk", xy) + noise(3), xy)
    assert found.converged.all()
    sigma = np.sqrt(np.diagonal(undisturbed.cov, axis1=1, axis2=2))
    assert (np.abs(found.xy - undisturbed.xy) / sigma).max() < 2.0
    assert np.isnan(found.residuals).any(axis=(1, 2)).all()
    assert found.psf_px == pytest.approx(undisturbed.psf_px, abs=0.05)


def test_a_disturbance_beside_a_mark_at_most_increases_its_sigma():
    xy = places()
    pixels = formed("disk", xy) + noise(4)
    column, row = np.rint(xy).astype(int).T
    for c, r in zip(column, row, strict=True):
        pixels[r - 8 : r - 4, c + 4 : c + 9] = 20.0
    found = matched(pixels, xy)
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert (np.abs(found.xy - xy) / sigma).max() < 5.0
    assert np.abs(found.xy - xy).max() < 0.15


def test_a_mark_partly_on_lost_pixels_is_measured_from_the_rest():
    xy = places()
    pixels, valid = formed("disk", xy) + noise(5), np.ones(SHAPE, dtype=bool)
    for row in range(25, 140, 33):
        valid[row - 1 : row + 1] = False
    pixels[~valid] = 0
    found = matched(pixels, xy, valid=valid)
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert found.seen == pytest.approx(np.full(len(xy), 0.7), abs=0.12)
    assert (np.abs(found.xy - xy) / sigma).max() < 4.5
    assert np.sqrt(((found.xy - xy) ** 2).mean()) < 0.1


def test_a_mark_cut_by_the_edge_of_the_frame_has_a_larger_sigma():
    xy = np.array([[0.5, 60.2], [94.3, 147.8], [94.4, 75.1]])
    found = matched(formed("disk", xy) + noise(6), xy)
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert found.seen[:2].max() < 0.85
    assert found.seen[2] == pytest.approx(1.0)
    assert (np.abs(found.xy - xy) / sigma).max() < 4.5
    assert sigma[:2].max() > 1.5 * sigma[2].max()


def test_the_result_of_a_mark_does_not_depend_on_the_others():
    xy = places()
    pixels = formed("disk", xy) + noise(7)
    together = matched(pixels, xy)
    options = MatchOptions(half_px=9, psf_px=0.7)
    off = np.random.default_rng(9).uniform(-0.6, 0.6, xy.shape)
    alone = match(
        pixels,
        np.ones(SHAPE, dtype=bool),
        outlines("disk", 1),
        (xy + off)[4:5],
        options,
        noise=NOISE,
        form=SIZE,
        form_sigma=np.array([0.1]),
    )
    assert alone.xy[0] == pytest.approx(together.xy[4], abs=1e-6)
    assert alone.cov[0] == pytest.approx(together.cov[4], rel=1e-4)
    kept = together.select(np.arange(len(xy)) == 4)
    assert len(kept) == 1
    assert together.replaced(np.array([2]), kept).xy[2] == pytest.approx(together.xy[4])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"polarity": "bright"},
        {"row_jitter_px": 0.1},
        {"contrast_slope": 0.3},
        {"row_jitter_px": 0.1, "polarity": "bright", "response": PixelResponse(0.8)},
    ],
)
def test_matches_from_known_light_are_those_of_the_general_adjustment(options, monkeypatch):
    xy, bright = places(), options.get("polarity") == "bright"
    pixels = formed("square", xy, bright=bright, fill=options.get("response", PixelResponse()).fill) + noise(
        8
    )
    pixels[20:24, 20:60] += 40.0  # one is searched for blunders
    level = np.zeros((len(xy), 3))
    level[:, 0] = 0.4 * LEVEL if bright else LEVEL
    given = pixels, pixels > -np.inf, GrownOutline(outlines("square", len(xy)).single(), SIZE), xy + 0.2
    settings = MatchOptions(**{"half_px": 9, "psf_px": 0.75, "settled": 0.1} | options)
    known = {"noise": NOISE, "form_sigma": np.array([0.1]), "searching": 0.0}
    light = np.full(len(xy), 102.0 if bright else 0.68), level
    single = match(*given, settings, light=light, **known)
    iterated = matcher._iterated

    def by_general(patch, rows, start, mean, formed, weights, free, iteration, noise=None):
        if noise is None:  # of blunders
            return iterated(patch, rows, start, mean, formed, weights, free, iteration)
        images = {"values": patch.form_values, "weights": weights, "prior": (mean, free)}
        for _ in range(4):  # each time with derivatives where the last one ended
            if settings.row_jitter_px > 0:
                patch.whiten(start, np.full((len(start), 1), noise), settings.row_jitter_px)
            found = adjust_batch(patch.form_image, start, patch.grey, **images, options=iteration)
            start = found.estimates
        return found

    monkeypatch.setattr(matcher, "_iterated", by_general)
    general = match(*given, settings, light=light, **known)
    assert single.converged.sum() > len(xy) - 5
    for name in ("converged", "seen", "rejected"):
        np.testing.assert_allclose(getattr(single, name), getattr(general, name), rtol=0, atol=1e-6)
    single, general = single.select(general.converged), general.select(general.converged)
    sigma = np.sqrt(np.diagonal(general.cov, axis1=1, axis2=2))
    # Iterations end at corrections of a tenth of a sigma, which is 0.01 px.
    np.testing.assert_allclose((single.xy - general.xy) / sigma, 0, rtol=0, atol=settings.settled)
    scaled = (single.cov - general.cov) / (sigma[:, :, None] * sigma[:, None])
    np.testing.assert_allclose(scaled, 0, rtol=0, atol=0.05)
    off = np.linalg.norm((single.residuals - general.residuals).reshape(len(sigma), -1), axis=1)
    np.testing.assert_allclose(off / NOISE, 0, rtol=0, atol=3 * settings.settled)
    np.testing.assert_allclose(single.form_sigma, general.form_sigma, rtol=0.05, atol=0)
    for name in ("psf_px", "contrast", "level", "noise", "correlation", "t"):
        np.testing.assert_allclose(getattr(single, name), getattr(general, name), rtol=5e-3, atol=5e-3)


@pytest.mark.parametrize("trials", [4, 6, 8])
def test_marks_that_have_no_trials_left_are_never_corrected_with_derivatives_of_others(trials, monkeypatch):
    """Of some the image changes, so that they are linearised again, when others are still far away."""
    xy = places()
    pixels = formed("square", xy) + noise(8)
    off = np.where(np.arange(len(xy))[:, None] % 3 == 0, 2.5, 0.3)
    linearise, batches = Iteration.linearise, []

    def linearised(work, rows, share, slopes):
        batches.append(len(rows))
        linearise(work, rows, share, slopes)

    monkeypatch.setattr(Iteration, "linearise", linearised)
    monkeypatch.setattr(matcher, "_FIRST", trials)
    level = np.zeros((len(xy), 3))
    level[:, 0] = LEVEL
    shape = GrownOutline(outlines("square", len(xy)).single(), SIZE)
    settings = MatchOptions(half_px=9, psf_px=1.4, settled=0.02, influence=True)
    known = {"noise": NOISE, "form_sigma": np.array([0.1]), "searching": 0.0}
    found = match(
        pixels, pixels > -np.inf, shape, xy + off, settings, light=(np.full(len(xy), 0.68), level), **known
    )
    assert len(batches) > 1
    assert batches[-1] < batches[0]
    good = found.converged
    assert good.any()
    assert np.abs(found.xy - xy)[good].max() < 0.2


@pytest.mark.parametrize("polarity", ["dark", "bright"])
def test_searches_in_single_precision_are_those_of_the_general_adjustment(polarity, monkeypatch):
    xy, bright = places(), polarity == "bright"
    pixels = formed("square", xy, bright=bright) + noise(8)
    pixels[20:24, 20:60] += 40.0
    given = pixels, pixels > -np.inf, GrownOutline(outlines("square", len(xy)).single(), SIZE), xy + 0.7
    settings = MatchOptions(half_px=9, psf_px=1.5, settled=0.05, polarity=polarity, influence=True)
    known = {"noise": NOISE, "form_sigma": np.array([0.1])}
    single = match(*given, settings, **known)
    start = Patches.start

    def general_start(patch, noise):
        found = start(patch, noise)
        patch.single = False
        return found

    monkeypatch.setattr(Patches, "start", general_start)
    general = match(*given, settings, **known)
    assert single.converged.sum() > len(xy) - 3
    np.testing.assert_array_equal(single.converged, general.converged)
    sigma = np.sqrt(np.diagonal(general.cov, axis1=1, axis2=2))
    # Iterations end at corrections of a twentieth of a sigma.
    np.testing.assert_allclose((single.xy - general.xy) / sigma, 0, rtol=0, atol=0.1)
    # Of a pixel at the limit of rejection either may be right; its residual is a part of the covariance.
    alike = (np.isfinite(single.residuals) == np.isfinite(general.residuals)).all(axis=(1, 2))
    assert alike.sum() >= len(xy) - 1
    single, general = single.select(alike), general.select(alike)
    np.testing.assert_allclose(single.cov, general.cov, rtol=0.05, atol=1e-9)
    most = np.abs(general.influence).max()
    np.testing.assert_allclose(single.influence, general.influence, rtol=0, atol=0.05 * most)


def test_a_match_of_precise_positions_finds_the_light_and_keeps_large_residuals():
    xy = places()
    pixels = formed("square", xy) + noise(8)
    pixels[20:24, 20:60] += 40.0
    given = pixels, pixels > -np.inf, GrownOutline(outlines("square", len(xy)).single(), SIZE), xy + 0.2
    settings = MatchOptions(half_px=9, psf_px=0.75, settled=0.05)
    found = match(*given, settings, noise=NOISE, form_sigma=np.array([0.1]), precise=True)
    plain = found.noise < 1.5 * np.median(found.noise)
    assert found.converged[plain].all()
    assert 0 < (~plain).sum() < 5
    assert (found.rejected == 0).all()
    np.testing.assert_allclose(found.xy[plain], xy[plain], rtol=0, atol=0.05)
    np.testing.assert_allclose(found.contrast[plain], 0.68, rtol=0, atol=0.03)


def test_values_without_an_image_do_not_disturb_other_marks():
    shape = GrownOutline(outlines("disk", 2).single(), SIZE)
    window = Window(np.tile(np.arange(17.0), (2, 1)), np.tile(np.arange(17.0), (2, 1)), PixelResponse())
    given = np.full((2, 2), 8.0), np.array([0.8, np.inf]), np.zeros((2, 1)), np.arange(2), window
    image = shape.image(*given)
    assert np.isnan(image[1]).all()
    assert image[0].sum() == pytest.approx(np.pi * 3.5**2, abs=1e-3)


def test_a_mark_without_a_finite_influence_leaves_the_covariances_of_the_others():
    rng = np.random.default_rng(0)
    one, none, window = np.ones(30), np.zeros((30, 0)), np.ones((30, 17, 17))
    alike = 3 * uniform_filter(rng.standard_normal(window.shape), (0, 3, 3))
    cov, influence = np.tile(np.eye(2), (30, 1, 1)), np.stack([window, window], axis=1) / 17
    columns = (one, one, one, one, none, one, one, one, 0 * one)
    rest = (one > 0, alike, none, np.zeros((30, 2, 0)), influence, 0 * window, one)
    found = Matches(np.zeros((30, 2)), cov, *columns, *rest)
    others = np.setdiff1d(np.arange(30), 3)
    usual = with_alike_errors(found.select(others))
    influence = influence.copy()
    influence[3], influence[7] = np.nan, 1e6 * influence[7]
    unusual = with_alike_errors(replace(found, influence=influence)).select(others)
    assert usual.cov[0, 0, 0] > 5
    plain = others != 7
    np.testing.assert_allclose(unusual.cov[plain], usual.cov[plain], atol=1e-3)
