"""Oriented frames: correct corners and sigmas, and refusal instead of a guess."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.special import logsumexp

from reseau.core.data import Array
from reseau.core.failure import Code
from reseau.core.tone import ToneCurve
from reseau.io.scans import scan_of
from reseau.measure.film import channel, orient_frames
from reseau.measure.film.adjacent_lines import Softness, softness_of
from reseau.measure.film.curves import curves_of_roll
from reseau.measure.film.lines import (
    EdgeData,
    FrameShape,
    Lines,
    departing_line,
    departures_of,
    explained_shape,
    mixed,
    robust_line,
)
from reseau.measure.film.orientation import FrameOptions, FrameResult
from reseau.measure.film.roll import corner_files, rolls_of
from reseau.procedures.film_frame import reorient_scan
from reseau_sims.filmframe import HASSELBLAD, RICOH, Beside, FilmFrame

from ..montecarlo import slowly

BUSY = Beside(perforations=True, print=True, neighbours=True, dust=40, scratches=3)


def oriented(frame: FilmFrame, **options: object) -> FrameResult:
    known = FrameOptions(formats=(frame.format[:2],), **options)  # type: ignore[arg-type]
    results = orient_frames(scan_of(frame.scan(), dpi=frame.dpi), known)
    assert len(results) == 1
    return results[0]


def errors(result: FrameResult, frame: FilmFrame) -> Array:
    assert result.lines is not None, result.why
    return np.asarray(result.lines.corners - frame.truth.corners)


def covered(result: FrameResult, frame: FilmFrame) -> bool:
    """Whether errors of corners are less than 5 sigma, or 0.25 px."""
    assert result.lines is not None
    sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    return bool((np.abs(errors(result, frame)) < np.maximum(5 * sigma, 0.25)).all())


@pytest.mark.slow
@pytest.mark.parametrize(
    "frame",
    [
        FilmFrame(3, tilt_deg=-14.0, mirrored=True, format=HASSELBLAD, dpi=400),
        FilmFrame(4, negative=True, beside=BUSY),
        *slowly(
            FilmFrame(1),
            FilmFrame(2, tilt_deg=14.0, beside=BUSY),
            FilmFrame(5, beside=Beside(lines=1)),
            FilmFrame(6, beside=Beside(rods=1)),
            FilmFrame(7, beside=Beside(blown=True)),
            FilmFrame(8, bow_mm=0.1),
            FilmFrame(9, format=RICOH._replace(radius=1.5)),
            FilmFrame(10, bits=16),
            FilmFrame(11, contrast=0.3),
        ),
    ],
    ids=lambda frame: f"seed {frame.seed}",
)
def test_corners_are_found_despite_disturbances(frame: FilmFrame) -> None:
    result = oriented(frame)
    assert result.status == "oriented", result.why
    assert np.abs(errors(result, frame)).max() < 0.35


@pytest.mark.slow
def test_corners_of_an_upright_frame_are_named_as_seen() -> None:
    frame = FilmFrame(12, tilt_deg=90.0)
    result = oriented(frame)
    assert result.format_mm == (24.0, 36.0)
    assert result.lines is not None
    seen = np.roll(frame.truth.corners, -1, axis=0)  # the frame's upper right corner is at the upper left
    np.testing.assert_allclose(result.lines.corners, seen, rtol=0, atol=0.35)


@pytest.mark.slow
def test_predicted_sigmas_cover() -> None:
    normalised = []
    for seed in range(14):
        frame = FilmFrame(seed + 50, dpi=400)
        result = oriented(frame)
        assert result.lines is not None
        normalised.append(errors(result, frame).ravel() / np.sqrt(np.diag(result.lines.covariance)))
    # 112 values in fives that go together: their rms is 1 ± 0.15.
    assert 0.65 < np.sqrt(np.mean(np.square(normalised))) < 1.4


@pytest.mark.slow
def test_a_bowed_edge_is_measured_and_its_chord_gives_the_corner() -> None:
    frame = FilmFrame(21, bow_mm=0.15)
    result = oriented(frame)
    assert result.lines is not None
    np.testing.assert_allclose(result.lines.bow, frame.bows_px, rtol=0, atol=0.25)
    reported = [edge.curvature_px for edge in result.edges.values()]
    assert any(bow for bow in reported)


@pytest.mark.slow
def test_a_line_that_touches_an_edge_makes_its_end_uncertain() -> None:
    # A bright line within half a pixel of the upper edge at one end: told by the width of its steps alone.
    frame = FilmFrame(320035, beside=Beside(lines=1))
    result = oriented(frame)
    assert result.status == "oriented"
    assert np.abs(errors(result, frame)).max() > 0.35
    assert covered(result, frame)


@pytest.mark.slow
def test_a_bright_line_that_leaves_the_edge_is_told_from_it_or_stated() -> None:
    frame = FilmFrame(300088, beside=Beside(lines=1))  # by steps alone its corners were 1.2 px off
    result = oriented(frame)
    assert result.status == "oriented", result.why
    assert covered(result, frame)
    rivals = [edge.rival for edge in result.edges.values() if edge.rival is not None]
    assert max(rival.probability for rival in rivals) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "frame",
    [
        pytest.param(FilmFrame(320006, beside=Beside(lines=2)), id="contrast 0.7", marks=pytest.mark.slow),
        pytest.param(FilmFrame(320023, contrast=0.5, beside=Beside(lines=2)), id="contrast 0.5"),
    ],
)
def test_lines_beside_two_edges_are_not_taken_for_a_scan_that_is_less_sharp_there(frame: FilmFrame) -> None:
    result = oriented(frame)  # corners were wrong by 3 px and 5 px, with sigmas of 0.1 px
    assert result.status == "oriented", result.why
    assert covered(result, frame)


@pytest.mark.slow
def test_a_line_beside_an_edge_is_suspected_where_another_line_crosses_its_end() -> None:
    frame = FilmFrame(320035, beside=Beside(lines=2))  # it was wrong by 1.1 px at 14 sigma
    assert covered(oriented(frame), frame)


@pytest.mark.slow
@pytest.mark.parametrize(
    "frame", [FilmFrame(320035, contrast=0.3), FilmFrame(320035, contrast=0.3, colour=True)]
)
@pytest.mark.parametrize("lines", [0, 1, 2])
def test_a_line_all_along_an_edge_is_suspected_in_a_picture_of_little_contrast(
    frame: FilmFrame, lines: int
) -> None:
    lined = replace(frame, beside=Beside(lines=lines))
    result = oriented(lined)  # they were wrong by 1 px at 14 to 30 sigma
    assert covered(result, lined)
    assert lines or np.abs(errors(result, frame)).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("fade", [0.0, 0.75])
def test_a_trunk_as_dark_as_film_at_one_end_of_an_edge_is_not_its_bow(fade: float) -> None:
    frame = FilmFrame(700011, scene="trees", fade=fade)  # a corner was wrong by 2.2 px at 13 sigma
    result = oriented(frame)
    if result:
        sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)  # type: ignore[union-attr]
        assert (np.abs(errors(result, frame)) < 2 * sigma + 0.1).all()


@pytest.mark.slow
@pytest.mark.parametrize("lines", [1, 2])
def test_a_channel_of_less_contrast_does_not_overrule_a_line_that_another_suspects(lines: int) -> None:
    frame = FilmFrame(320035, colour=True, beside=Beside(lines=lines))  # green and blue were wrong by 1 px
    result = oriented(frame)
    if result:
        sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)  # type: ignore[union-attr]
        assert (np.abs(errors(result, frame)) < 3 * sigma + 0.1).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [700003, 700019])
@pytest.mark.parametrize("stated", [True, False], ids=["resolution stated", "not stated"])
def test_a_trunk_in_the_picture_is_no_edge_of_a_frame_that_stands_upright(seed: int, stated: bool) -> None:
    frame = FilmFrame(seed, scene="trees")  # three of its edges and a trunk formed a frame of 24x36
    options = FrameOptions(formats=((36.0, 24.0),))
    (result,) = orient_frames(scan_of(frame.scan(), dpi=600.0 if stated else None), options)
    assert not result or np.abs(errors(result, frame)).max() < 0.5
    assert bool(result) or not stated


def squares(count: int = 7) -> list[FrameResult]:
    """Oriented frames of 56 × 56 mm, 4 px/mm."""
    corners = np.array([[20.0, 20.0], [244.0, 20.0], [244.0, 244.0], [20.0, 244.0]])
    lines = [Lines(corners + k, 0.01 * np.eye(8), *np.zeros((7, 4)), 1.0, 8) for k in range(count)]
    return [
        FrameResult(f"{k}", "oriented", "", (56.0, 56.0), "grey", each, {}) for k, each in enumerate(lines)
    ]


def test_each_format_in_a_folder_makes_a_roll_of_its_own() -> None:
    wide = [replace(each, format_mm=(56.0, 41.5)) for each in squares(4)]
    few = [replace(each, format_mm=(36.0, 24.0)) for each in squares(3)]
    found = rolls_of([*few, *wide, *squares()])
    assert [(each.format_mm, each.frames) for each in found] == [((56.0, 56.0), 7), ((56.0, 41.5), 4)]
    assert list(corner_files(found)) == ["corners-56x56.json", "corners-56x41.5.json"]
    assert list(corner_files(found[:1])) == ["corners.json"]


@pytest.mark.slow
def test_scans_of_a_roll_decide_together_about_a_curve_that_none_of_them_shows_for_sure() -> None:
    alone = [oriented(FilmFrame(seed, dpi=300, srgb=True)).curves for seed in (0, 2, 4)]
    together = curves_of_roll(alone)
    assert min(each.share[1] for each in together if each) > max(each.share[1] for each in alone if each)
    assert min(each.share[1] for each in together if each) > 0.95


@pytest.mark.slow
def test_an_edge_hidden_by_a_line_is_no_unflagged_error_with_the_shape_of_its_roll() -> None:
    """The line is parallel to the edge: in a single frame they cannot be distinguished."""
    frame = FilmFrame(320035, beside=Beside(lines=1))
    alone = oriented(frame)
    rolls = (*rolls_of([oriented(FilmFrame(seed)) for seed in range(6)], 600.0), *rolls_of(squares()))
    assert [each.format_mm for each in rolls] == [(36.0, 24.0), (56.0, 56.0)]
    scan, options = scan_of(frame.scan(), dpi=600.0), FrameOptions(((36.0, 24.0),))
    (found,) = reorient_scan(scan, rolls, [alone], options)
    # The roll of another format says nothing about it.
    (other,) = reorient_scan(scan, rolls[1:], [alone], options)
    assert (other.status, other.why) == (alone.status, alone.why)
    assert found.status == "oriented", found.why
    assert covered(found, frame)


@pytest.mark.slow
@pytest.mark.parametrize(
    "frame",
    [
        # Its lower edge was found 1.5 px outside.
        pytest.param(
            FilmFrame(6002, blur_px=1.5, noise=0.5, grain=0.5), id="hardly noise", marks=pytest.mark.slow
        ),
        # A picture's forms were taken for a line along the edge.
        pytest.param(FilmFrame(6003, dpi=1200, blur_px=2.5), id="fine", marks=pytest.mark.slow),
        # The steps of its darkest edge were looked for beside them.
        pytest.param(FilmFrame(1019, grain=10.0), id="grain"),
    ],
)
def test_edges_of_any_softness_and_grain_are_found(frame: FilmFrame) -> None:
    result = oriented(frame)
    assert result.status == "oriented", result.why
    assert np.abs(errors(result, frame)).max() < 0.4


@pytest.mark.slow
def test_a_curve_that_leaves_a_dark_edge_is_not_measured_as_its_bow() -> None:
    frame = FilmFrame(
        6010, dpi=1200, blur_px=2.5, beside=Beside(rods=1)
    )  # it was 1.2 px off with sigmas of 0.2
    result = oriented(frame)
    assert not result or np.abs(errors(result, frame)).max() < 0.5


@pytest.mark.slow
def test_edge_positions_are_unbiased_in_noise() -> None:
    """With a noise of a tenth of the contrast the mean of eight frames was 0.04 px, five standard errors."""
    inwards = []
    for seed in range(8):
        frame = FilmFrame(300 + seed, noise=8.0)
        middle = frame.truth.corners.mean(axis=0)
        away = frame.truth.corners - middle
        inwards.append(-(errors(oriented(frame), frame) * np.sign(away)).mean())
    assert abs(np.mean(inwards)) < 0.025


@pytest.mark.slow
def test_a_scratch_parallel_to_an_edge_is_ignored() -> None:
    frame = FilmFrame(300017, beside=Beside(scratches=8))
    result = oriented(frame)
    assert result.status == "oriented", result.why
    assert np.abs(errors(result, frame)).max() < 0.35


def test_a_frame_cropped_on_one_side_has_three_edges_and_a_sigma_for_the_fourth() -> None:
    frame = FilmFrame(31, crop="right")
    result = oriented(frame)
    assert result.status == "three-edges"
    assert result.why.startswith("right edge: ")
    assert result.lines is not None
    error, sigma = errors(result, frame), np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    assert np.abs(error[[0, 3]]).max() < 0.3
    assert (np.abs(error) < 4 * sigma).all()
    assert sigma[1, 0] > 1.0
    assert not result.edges["right"].found


def test_the_channel_with_the_highest_contrast_is_used() -> None:
    frame = FilmFrame(42, colour=True, dpi=400)
    result = oriented(frame)
    assert result.channel == "red"
    assert np.abs(errors(result, frame)).max() < 0.3


@pytest.mark.slow
def test_another_channel_is_used_if_that_with_the_highest_contrast_hides_an_edge() -> None:
    frame = FilmFrame(320035, colour=True)
    pixels = frame.scan()
    pixels[..., 0] = FilmFrame(320035, colour=True, beside=Beside(lines=1)).scan()[..., 0]
    result = orient_frames(scan_of(pixels, dpi=frame.dpi), FrameOptions(formats=((36.0, 24.0),)))[0]
    assert result.status == "oriented"
    assert result.channel == "green"
    assert np.abs(errors(result, frame)).max() < 0.3


def moved_at_its_corners(frame: FilmFrame, by: Array) -> tuple[FrameResult, Array]:
    """A scan warped so that its corners (4, 2) move by given amounts; and the true corners of the frame."""
    pixels = frame.scan()
    h, w = pixels.shape
    square = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]], dtype=np.float32)
    moved = cv2.getPerspectiveTransform(square, (square + by).astype(np.float32))
    seen = cv2.warpPerspective(pixels, moved, (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    options = FrameOptions(formats=((36.0, 24.0),))
    (result,) = orient_frames(scan_of(seen, dpi=frame.dpi), options)
    return result, cv2.perspectiveTransform(frame.truth.corners[None], moved)[0]


@pytest.mark.slow
def test_a_frame_seen_at_an_angle_is_oriented_with_a_remark() -> None:
    # Left and right edge converge by two degrees.
    by = np.array([[-14.0, 0.0], [14.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    result, corners = moved_at_its_corners(FilmFrame(51), by)
    assert result.status == "oriented", result.why
    assert result.code is Code.TILTED
    assert "opposite edges converge by" in result.why
    assert result.lines is not None
    np.testing.assert_allclose(result.lines.corners, corners, rtol=0, atol=0.3)


@pytest.mark.slow
def test_four_edges_without_a_perspective_frame_are_declined() -> None:
    # One corner moved alone: its edges are turned by a degree and more.
    by = np.array([[24.0, 16.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    result, _ = moved_at_its_corners(FilmFrame(52), by)
    assert result.status == "declined"
    assert result.code is Code.INCONSISTENT
    assert "do not form a frame" in result.why


@pytest.mark.slow
def test_images_without_a_frame_are_declined_with_a_remedy() -> None:
    rng = np.random.default_rng(0)
    blank = np.full((500, 700), 12, dtype=np.uint8)
    noise = rng.integers(0, 255, (250, 350)).astype(np.uint8)
    inner = FilmFrame(1, margin_mm=-1.0).scan()
    for pixels, code in ((blank, Code.LOW_CONTRAST), (noise, Code.NOT_FOUND), (inner, Code.NOT_FOUND)):
        (result,) = orient_frames(scan_of(pixels))
        assert not result
        assert result.code is code
        assert ";" in result.why
        document = result.document()
        assert document.status == "declined"
        assert document.corners is None


@pytest.mark.slow
def test_a_wrong_format_is_declined() -> None:
    (result,) = orient_frames(scan_of(FilmFrame(1).scan()), FrameOptions(formats=((56.0, 56.0),)))
    assert not result


@pytest.mark.slow
def test_the_document_contains_principal_point_axes_and_scale() -> None:
    frame = FilmFrame(51, tilt_deg=3.0)
    document = oriented(frame).document()
    ul, ur, lr, ll = frame.truth.corners
    point, angle = document.principal_point, document.angle_deg
    assert point is not None
    assert angle is not None
    assert document.px_per_mm is not None
    way = lr - ll
    assert angle == pytest.approx(-np.rad2deg(np.arctan2(way[1], way[0])), abs=0.02)
    s, t = np.linalg.solve(np.stack([lr - ul, -(ll - ur)], axis=1), ur - ul)
    np.testing.assert_allclose([point.x, point.y], ul + s * (lr - ul), rtol=0, atol=0.15)
    assert document.px_per_mm == pytest.approx((600 / 25.4, 600 / 25.4), rel=0.005)
    assert 0 < t < 1


@pytest.mark.slow
def test_a_sharp_edge_is_not_displaced_by_the_grid_of_the_pixels() -> None:
    """Its pixels are smoothed with their neighbours; by a Gaussian step it was displaced by up to 0.4 px."""
    frame = FilmFrame(31, tilt_deg=-0.05, blur_px=0.2, noise=0.7, grain=0.3, contrast=0.6)
    light = cv2.GaussianBlur(frame.scan(), (3, 3), 0.47)
    result = orient_frames(scan_of(light, dpi=600.0), FrameOptions(((36.0, 24.0),)))[0]
    assert result.status == "oriented", result.why
    assert np.abs(errors(result, frame)).max() < 0.15


@pytest.mark.slow
def test_the_resolution_of_the_file_decides_between_rectangles() -> None:
    frame = FilmFrame(32, dpi=300.0)
    scan, options = frame.scan(), FrameOptions(((36.0, 24.0),))
    (other,) = orient_frames(scan_of(scan, dpi=250.0), options)
    assert other.status == "declined"
    assert other.code is Code.INCONSISTENT
    (mount,) = orient_frames(scan_of(scan, dpi=309.0), options)
    assert mount.status == "oriented"
    assert mount.px_per_mm == (309 / 25.4, 309 / 25.4)
    assert "opening of a mount" in mount.why


@pytest.mark.slow
def test_a_picture_that_fades_on_one_side_is_no_frame_of_three_edges() -> None:
    frame = FilmFrame(33, dpi=300.0, noise=0.7, grain=0.3)
    fading = np.clip(np.linspace(2.5, -0.8, frame.shape[1]), 0, 1)
    scan = np.rint(14 + (frame.scan() - 14.0) * fading).clip(0, 255).astype(np.uint8)
    assert not orient_frames(scan_of(scan), FrameOptions(((36.0, 24.0),)))[0]


@pytest.mark.slow
def test_a_scan_that_is_sharper_in_one_direction_has_no_lines_beside_its_edges() -> None:
    frame = FilmFrame(31, blur_px=0.5, carriage_px=0.45)
    result = oriented(frame)
    assert result.status == "oriented", result.why
    assert result.lines is not None
    assert np.sqrt(np.diag(result.lines.covariance)).max() < 0.1
    assert np.abs(errors(result, frame)).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("negative", [False, True])
def test_grey_values_are_measured_with_the_curve_that_the_file_states_or_the_edges_show(
    negative: bool,
) -> None:
    frame = FilmFrame(32, srgb=True, blur_px=1.2, negative=negative)
    coded = scan_of(frame.scan(), dpi=frame.dpi)
    options = FrameOptions(formats=(frame.format[:2],))
    outwards = []
    for curve in (ToneCurve(None), None):
        (result,) = orient_frames(replace(coded, curve=curve), options)
        outwards.append(np.mean(errors(result, frame) * [[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    assert np.abs(outwards).max() < 0.05


def test_ends_of_a_wavy_edge_are_as_uncertain_as_it_departs_from_a_line() -> None:
    place, sigma = np.linspace(-1, 1, 300), np.full(300, 0.05)
    noise = np.random.default_rng(0).normal(0, 0.05, 300)

    def line(offset: Array) -> tuple[Array, Array, float]:
        none = np.zeros((300, 0)), np.zeros(300), np.zeros((300, 1))
        values, covariance, log = (each[:, 0] for each in departing_line(place, offset, sigma, *none))
        values, covariance = mixed(np.exp(log - logsumexp(log)), values, covariance)
        rest = offset - (values[0] * (1 - place) + values[1] * (1 + place)) / 2 + values[2] * (1 - place**2)
        return values, covariance, departures_of(place, rest, sigma)

    _, covariance, departs = line(noise)
    assert departs < 0.03
    assert np.sqrt(np.diag(covariance))[:2].max() < 0.03
    # A line through one wave of 0.5 px, weighted evenly, misses its ends by 0.48 px.
    values, covariance, departs = line(noise + 0.5 * np.sin(np.pi * place))
    assert 0.1 < departs < 0.5
    assert (np.abs(values[:2]) < 2 * np.sqrt(np.diag(covariance))[:2]).all()
    assert np.abs(values[:2]).max() < 0.2


@pytest.mark.parametrize(("moved", "tilted"), [((0, 15), False), ((0, 0), False), ((-8, 8), True)])
def test_an_edge_off_the_format_is_another_line_unless_the_camera_was_tilted(
    moved: tuple[float, float], tilted: bool
) -> None:
    corners = np.array([[20.0, 20.0], [920.0, 20.0], [920.0, 620.0], [20.0, 620.0]])
    ends = np.zeros((4, 2))
    ends[3] = moved
    if tilted:
        ends[1] = moved[::-1]  # a trapezium
    none = np.zeros((0, 2)), np.zeros(0)
    edges = [EdgeData(np.append(each, 0.0), 0.01 * np.eye(3), *none) for each in ends]
    (first, *_), seen = explained_shape(corners, edges, FrameShape(36.0, 24.0), None)
    if tilted:
        assert seen > 0.9
    elif moved[1]:
        assert first.edge == 3
        assert first.probability > 0.5
        assert 0 < first.inwards < 15
    else:
        assert first.probability < 0.01
        assert seen < 0.05


def test_a_line_is_found_through_profiles_of_which_half_may_be_displaced() -> None:
    place = np.linspace(-1, 1, 200)
    offset = 1 - 0.5 * place + np.random.default_rng(0).normal(0, 0.03, 200)
    found = robust_line(place, offset, np.where(place < 0, 2.0, 0.03), 0.05)
    assert found is not None
    assert found[1].all()
    np.testing.assert_allclose(found[0][:2], [1.5, 0.5], rtol=0, atol=0.1)


@pytest.mark.slow
def test_frames_of_a_strip_are_delivered_in_order() -> None:
    frames = [FilmFrame(40, tilt_deg=0.0).scan(), FilmFrame(41, tilt_deg=0.0).scan()]
    rows = min(len(each) for each in frames)
    found = orient_frames(scan_of(np.hstack([each[:rows] for each in frames]), dpi=FilmFrame(40).dpi))
    assert [each.frame for each in found] == [1, 2]
    assert all(found)


def test_edges_whose_softness_too_few_profiles_show_are_measured_without_lines(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(channel, "soft_steps", lambda profiles, side: [Softness(0.0)] * len(profiles))
    frame = FilmFrame(1, dpi=100)
    result = oriented(frame)
    assert result.status == "oriented", result.why
    assert np.abs(errors(result, frame)).max() < 0.35


def test_the_softness_of_edges_is_explained_together() -> None:
    alike, wide, sharp, two = (
        softness_of([(float(np.log(width)), 0.02) for width in widths], 700.0)
        for widths in (
            (0.75, 0.76, 0.75, 0.77),
            (0.75, 0.75, 1.2, 0.76),
            (0.29, 0.63, 0.61, 0.64),  # a scratch beside the first edge
            (0.45, 0.61, 0.46, 0.60),  # sharper in one direction
        )
    )
    assert max(each.lined for each in (*alike, *two)) < 0.05
    assert wide[2].lined > 0.5
    assert abs(wide[2].width - 0.75) < 0.05
    assert sharp[0].sharpened > 0.5
    assert max(each.lined for each in sharp[1:]) < 0.05
