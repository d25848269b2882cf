"""A regular grid does not tell its orientation; an uneven one does; a foreign picture shows neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from reseau.core.data import Array, Frame
from reseau.core.failure import Code
from reseau.designs import regular_reseau
from reseau.io import Mark, ReseauDesign
from reseau.measure import measure_reseau
from reseau.measure.reseau.marks import ReseauOptions
from reseau.measure.reseau.measure import misfit

from ..montecarlo import slowly
from .formed import MARKS, PX_PER_MM, Scene, form


class Uneven(Scene):
    """Marks half a pixel beside a regular grid."""

    def design(self) -> ReseauDesign:
        rng, even = np.random.default_rng(3), super().design()
        off = rng.normal(0, 0.5 / PX_PER_MM, (len(even.points), 2))
        points = [
            point.model_copy(update={"x": point.x + dx, "y": point.y + dy})
            for point, (dx, dy) in zip(even.points, off, strict=True)
        ]
        return even.model_copy(update={"points": tuple(points)})


SCENE = Scene(columns=11, rows=9, width=700, height=600)


@pytest.fixture(scope="module")
def pixels() -> Array:
    return np.asarray(form(SCENE, np.random.default_rng(0)).frame.pixels)


def shown(pixels: Array) -> Frame:
    return Frame(np.ascontiguousarray(pixels), 255.0, "turned.png")


@pytest.mark.parametrize("quarters", [2, *slowly(0, 1)])
def test_a_regular_grid_is_found_at_any_turn_and_called_ambiguous(pixels, quarters):
    found = measure_reseau(shown(np.rot90(pixels, quarters)), SCENE.design()).required()
    assert found.found == 99
    assert [note.code for note in found.notes] == [Code.AMBIGUOUS]
    assert "turned by 180°" in found.notes[0].text


def test_nothing_is_ambiguous_where_handedness_and_turn_are_known(pixels):
    known = ReseauOptions(mirrored=False, max_rotation_deg=12.0)
    found = measure_reseau(shown(pixels), SCENE.design(), known).required()
    assert found.found == 99
    assert found.notes == ()


@pytest.mark.slow
def test_a_grid_of_which_columns_and_rows_are_cropped_is_found(pixels):
    found = measure_reseau(shown(pixels[110:, 165:]), SCENE.design()).required()
    assert found.found == 72


@pytest.mark.slow
def test_a_cropped_grid_of_wires_is_not_laid_over_what_lies_along_them():
    scene = Scene(mark=MARKS["line-grid"], columns=11, rows=9, width=700, height=600)
    formed = form(scene, np.random.default_rng(0))
    known = ReseauOptions(mirrored=False, max_rotation_deg=12.0)
    found = measure_reseau(shown(formed.frame.pixels[110:, 165:]), scene.design(), known).required()
    assert found.found == 72
    assert np.abs(found.xy - (formed.xy - [165, 110]))[found.ok].max() < 0.05


def test_a_reseau_seen_from_behind_is_mirrored_and_keeps_its_design(pixels):
    known = ReseauOptions(mirrored=True, max_rotation_deg=12.0)
    design, behind = SCENE.design(), shown(np.ascontiguousarray(pixels[:, ::-1]))
    found = measure_reseau(behind, design, known).required()
    front = measure_reseau(shown(pixels), design, replace(known, mirrored=False)).required()
    assert np.abs(found.xy - (front.xy * [-1, 1] + [behind.width - 1, 0])).max() < 0.01
    assert np.abs(found.field(design.xy) - found.xy).max() < 0.1


@pytest.mark.slow
def test_nominal_positions_from_before_the_frame_was_cropped_are_not_followed():
    formed = form(Uneven(columns=11, rows=9, width=700, height=600), np.random.default_rng(1))
    before = formed.design.expected_at(formed.xy)
    found = measure_reseau(shown(formed.frame.pixels[110:, 180:]), before).required()
    assert found.found == 72
    assert np.abs(found.xy - (formed.xy - [180, 110]))[found.ok].max() < 0.05
    assert "nominal positions do not agree" in found.notes[0].text


def test_nominal_positions_wrong_by_one_pitch_are_noticed():
    formed = form(SCENE, np.random.default_rng(1))
    design = SCENE.design()
    truth = measure_reseau(formed.frame, design, ReseauOptions(mirrored=False)).required()
    wrong = design.expected_at(truth.xy + np.array([52.0, 0.0]))
    found = measure_reseau(formed.frame, wrong).required()
    assert found.found == 99
    assert np.abs(found.xy - truth.xy).max() < 0.05
    assert [note.code for note in found.notes] == [Code.DEVIATES]
    assert "wrong by about 52 px" in found.notes[0].text


def screen_behind_wires(ends: float = 32.0) -> tuple[Frame, Array]:
    """A bright screen behind 9 × 7 wires at 44 px, which ends `ends` pixels beyond them; and its crossings.

    It shares nothing with the project's formation of images. Wires across the edge look like crossings there.
    """
    x, y, pitch, at = np.arange(440.0), np.arange(360.0), 44.0, np.array([46.0, 48.0])

    def wires(p: Array, first: float, count: int) -> Array:
        away = p - np.clip(np.rint((p - first) / pitch), 0, count - 1) * pitch - first
        return np.asarray(1 - 0.94 * (ndtr((away + 1.5) / 0.9) - ndtr((away - 1.5) / 0.9)))

    def screen(p: Array, first: float, count: int) -> Array:
        last = first + (count - 1) * pitch
        return np.asarray(ndtr((p - first + ends) / 5) * ndtr((last + ends - p) / 5))

    light = screen(x, at[0], 9) * screen(y, at[1], 7)[:, None]
    grey = 8 + 190 * light * wires(x, at[0], 9) * wires(y, at[1], 7)[:, None]
    noisy = grey + np.random.default_rng(0).normal(0, 1.5, grey.shape)
    crossings = at + pitch * np.stack(np.meshgrid(np.arange(9), np.arange(7)), axis=-1).reshape(-1, 2)
    return shown(np.clip(np.rint(noisy), 0, 255)), crossings


def test_wires_that_end_at_the_edge_of_a_screen_are_no_crossings_with_it():
    frame, crossings = screen_behind_wires()
    design = regular_reseau(9, 7, 10.0, Mark(shape="line-grid", size=0.7, line_width=0.7))
    in_order = crossings[np.lexsort((crossings[:, 0], -crossings[:, 1] * np.sign(design.xy[-1, 1])))]
    for step in ([44.0, 0.0], [0.0, -44.0]):
        found = measure_reseau(frame, design.expected_at(in_order + step)).required()
        away = np.hypot(*(found.xy[found.ok][:, None] - crossings).transpose(2, 0, 1)).min(axis=1)
        assert found.found == 63
        assert away.max() < 0.1
        assert "wrong by about 44 px" in found.notes[0].text


@pytest.mark.slow
def test_names_of_a_part_of_a_regular_grid_are_said_to_be_open():
    frame, crossings = screen_behind_wires()
    design = regular_reseau(11, 7, 10.0, Mark(shape="line-grid", size=0.7, line_width=0.7))
    upright = ReseauOptions(mirrored=False, max_rotation_deg=12.0)
    found = measure_reseau(frame, design, upright).required()
    away = np.hypot(*(found.xy[found.ok][:, None] - crossings).transpose(2, 0, 1)).min(axis=1)
    assert found.found == 63
    assert away.max() < 0.1
    assert any("off by a row or column" in note.text for note in found.notes)


@pytest.mark.slow
def test_a_picture_of_something_else_is_not_the_reseau():
    rng = np.random.default_rng(2)
    light = rng.normal(0, 1, (500, 600)).cumsum(axis=0).cumsum(axis=1)
    scene = 128 + 100 * (light - light.mean()) / np.abs(light - light.mean()).max()
    specks = rng.integers(20, 480, (60, 2))
    scene[specks[:, 0], specks[:, 1]] -= 40
    found = measure_reseau(Frame(scene + rng.normal(0, 2, scene.shape), 255.0, "foreign.png"), SCENE.design())
    assert not found
    assert found.code == Code.NOT_FOUND


def test_an_uneven_grid_fits_its_own_names_only():
    rng = np.random.default_rng(3)
    source = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(-1, 2)
    uneven = source + rng.normal(0, 0.02, source.shape)
    seen, every = 50 * uneven, np.ones(63, dtype=bool)
    turned = 8 - source[:, 0] + 9 * (6 - source[:, 1])
    assert misfit(uneven, seen, every) < 1e-9
    assert misfit(uneven[turned.astype(int)], seen, every) > 0.5
    assert misfit(uneven, seen, four_of(every)) == np.inf


def four_of(every: Array) -> Array:
    """Only four points known."""
    return np.asarray(np.arange(len(every)) < 4)


def plate_in_perspective(tilt_deg: float, pan_deg: float) -> tuple[Array, Array]:
    """A frame of 8 × 6 disks on a plate that a camera sees at an angle, and their centres.

    It shares nothing with the project's formation of images: each pixel has 25 samples, traced to the plate.
    """
    (c, s), (d, e) = ((np.cos(a), np.sin(a)) for a in np.deg2rad([tilt_deg, pan_deg]))
    turned = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ np.array([[d, 0, e], [0, 1, 0], [-e, 0, d]])
    camera = np.array([[300.0, 0, 200], [0, 300, 160], [0, 0, 1]])
    to_image = camera @ np.column_stack([turned[:, 0], -turned[:, 1], [0, 0, 80]])
    y, x = (np.mgrid[: 320 * 5, : 400 * 5] + 0.5) / 5 - 0.5
    u, v, w = np.tensordot(np.linalg.inv(to_image), np.stack([x, y, np.ones_like(x)]), 1)
    u, v = u / w, v / w
    column, row = (np.clip(np.rint(p / 10 + n / 2), 0, n) - n / 2 for p, n in ((u, 7), (v, 5)))
    dark = (np.hypot(u - 10 * column, v - 10 * row) < 2).reshape(320, 5, 400, 5).mean(axis=(1, 3))
    grey = gaussian_filter(200 - 150 * dark, 0.9) + np.random.default_rng(0).normal(0, 1.5, dark.shape)
    plane = np.stack(np.meshgrid(np.arange(8) * 10 - 35.0, np.arange(6) * 10 - 25.0), -1).reshape(-1, 2)
    at = np.column_stack([plane, np.ones(48)]) @ to_image.T
    return np.clip(np.rint(grey), 0, 255), at[:, :2] / at[:, 2:]


@pytest.mark.slow
@pytest.mark.parametrize("angles", [*slowly(((30.0, 0.0),)), (20.0, 15.0)])
def test_a_regular_plate_in_perspective_is_not_numbered_a_row_or_column_off(angles):
    # Fields through the marks found first do not reach the last row: shifted by a row, 40 of 48 fit as well.
    grey, centres = plate_in_perspective(*angles)
    design = regular_reseau(8, 6, 10.0, Mark(shape="disk", size=4.0))
    upright = ReseauOptions(mirrored=False, max_rotation_deg=12.0)
    found = measure_reseau(shown(grey), design, upright).required()
    assert found.found == 48
    names = np.lexsort((design.xy[:, 0], design.xy[:, 1]))
    # The centre of a disk of 13 px is imaged beside the centre of its ellipse, here by up to 0.2 px.
    assert np.abs(found.xy[names] - centres).max() < 0.5
