"""Boards that were told otherwise than photographs show them: corrected, with a note, or refused in words."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

import reseau
from reseau.core.data import Frame
from reseau.core.failure import Code, Failure
from reseau.designs import board
from reseau.io import BoardDesign
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.target_measurement import drawing_overlays, measurer_of
from reseau.procedures.told_target import TargetMeasured, measured_as_shown
from reseau.procedures.which_target import corrected

from .. import kept
from ..measure.board_pictures import picture
from ..montecarlo import slowly

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from worlds import prints
from worlds.sheets import View, pose

CHESS = board("chess", 7, 6, 24.0)
LONG = board("chess", 10, 7, 24.0)
CHARUCO = board("charuco", 7, 6, 24.0)
LEGACY = board("charuco", 7, 6, 24.0, legacy=True)
APRIL = board("aprilgrid", 5, 4, 30.0, border_bits=2)
CIRCLES = board("circles", 7, 5, 24.0)
SHIFTED = board("circles", 3, 5, 24.0, asymmetric=True)


@cache
def photographs(design: BoardDesign) -> tuple[Frame, ...]:
    """Three photographs of a board."""
    dark = design.model_copy(update={"polarity": "dark"})
    frames = []
    for k, (tilt, turn) in enumerate(((10.0, 5.0), (25.0, 100.0), (30.0, 190.0))):
        frame = picture(dark, tilt, turn, seed=k)[0]
        pixels = frame.pixels if design is dark or design.polarity == "dark" else 255 - frame.pixels
        frames.append(replace(frame, pixels=pixels, name=f"{k}.png"))
    return tuple(frames)


def measured(printed: BoardDesign, told: BoardDesign) -> TargetMeasured:
    return measured_as_shown(photographs(printed), told, measurer_of(told))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("printed", "told", "said"),
    [
        (CHESS, {"columns": 8, "rows": 7}, "columns 7 in place of 8, rows 6 in place of 7"),
        (APRIL, {"pitch": 40.0}, "in other proportions than was told: pitch 30.0 in place of 40.0"),
        (CIRCLES.model_copy(update={"polarity": "bright"}), {"polarity": "dark"}, "bright in place of dark"),
        *slowly(
                (CHARUCO, {"dictionary": "DICT_4X4_50"}, "dictionary DICT_5X5_50 in place of DICT_4X4_50"),
                (LEGACY, {"legacy": False}, "legacy True in place of False"),
                (CIRCLES, {"rows": 4}, "rows 5 in place of 4; calibrated"),
                (SHIFTED, {"columns": 2}, "columns 3 in place of 2; calibrated"),
                (CHESS, {"columns": 6, "rows": 5}, "columns 7 in place of 6, rows 6 in place of 5"),
                (CHARUCO, {"columns": 6, "rows": 7}, "columns 7 in place of 6, rows 6 in place of 7"),
                (CHARUCO, {"rows": 5}, "rows 6 in place of 5; calibrated"),
                (LEGACY, {"rows": 5}, "rows 6 in place of 5; calibrated"),
                (APRIL, {"rows": 3}, "rows 4 in place of 3; calibrated"),
                (CIRCLES, {"columns": 8}, "columns 7 in place of 8; calibrated"),
                (SHIFTED, {"rows": 6}, "rows 5 in place of 6; calibrated"),
                (LONG, {"columns": 9}, "columns 10 in place of 9; calibrated"),
                (LONG, {"rows": 6}, "rows 7 in place of 6; calibrated"),
                (CIRCLES, {"columns": 6}, "columns 7 in place of 6; calibrated"),
                (SHIFTED, {"rows": 4}, "rows 5 in place of 4; calibrated"),
        ),
    ],
)  # fmt: skip
def test_the_board_that_photographs_show_is_measured_in_place_of_the_told_one(
    printed: BoardDesign, told: dict[str, object], said: str
) -> None:
    found = measured(printed, printed.model_copy(update=told))
    assert found.corrected is not None
    for key in ("columns", "rows", "legacy", "polarity", "border_bits"):
        assert getattr(found.corrected, key) == getattr(printed, key)
    assert found.corrected.pitch == pytest.approx(printed.pitch, rel=0.01)
    assert len(found.notes) == 1
    assert said in found.notes[0]
    for each in found.photographs:
        assert not isinstance(each.found, Failure)
        assert len(each.found) > 0.9 * len(printed.ids)


@pytest.mark.slow
@pytest.mark.parametrize("told", [(7, 9), (7, 7), (6, 8)], ids=["too large", "a row less", "a column less"])
def test_a_deltille_told_wrongly_is_measured_as_it_is_printed(told: tuple[int, int]) -> None:
    printed = prints.Deltille(7, 8, 20.0)
    frames = [
        replace(Frame(kept.picture(View(printed, *pose(k, printed, nearer=0.7), seed=k)), 255.0), name=str(k))
        for k in (1, 2)
    ]
    design = board("deltille", *told, 20.0)
    found = measured_as_shown(frames, design, measurer_of(design))
    assert found.corrected == design.model_copy(update={"columns": 7, "rows": 8})
    for each in found.photographs:
        assert not isinstance(each.found, Failure)
        assert 40 < len(each.found) <= 56


def test_a_right_design_is_compared_with_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reseau.procedures.told_target.corrected", None)
    turned = CHESS.model_copy(update={"columns": 6, "rows": 7})
    for design in (CHESS, turned):
        found = measured(CHESS, design)
        assert found.corrected is None
        assert not found.notes
        assert all(not isinstance(each.found, Failure) for each in found.photographs)


def test_what_photographs_show_in_place_of_another_kind_of_board_is_said() -> None:
    found = calibrate_camera(photographs(CHESS), CHARUCO, measurer_of(CHARUCO))
    assert isinstance(found, Failure)
    assert found.code is Code.TOO_FEW_IMAGES
    assert "; the photographs show a lattice of 7 × 6 squares without markers; " in found.reason
    # All are declined for one reason, which is said once.
    assert found.reason.count("no marker of the board was read") == 1
    assert "; 0.png, 1.png, 2.png: board" in found.reason


def test_a_frame_that_contradicts_the_design_says_what_it_shows() -> None:
    told = CHESS.model_copy(update={"columns": 8})
    found = reseau.measure(photographs(CHESS)[0], told)
    assert not found
    assert found.reason.endswith(
        "; the photograph shows a chessboard of 7 × 6 squares: columns 7 in place of 8; correct the design"
    )
    other = reseau.measure(photographs(CHESS)[0], CIRCLES)
    assert not other
    assert other.reason.endswith("; the photograph shows a lattice of 7 × 6 squares without markers")


def test_all_of_a_board_may_be_shown_where_a_part_is_recognised(
    reference_data: Callable[[str], Path],
) -> None:
    case = reference_data("cases") / "reports1" / "light-circles-on-dark"
    told = BoardDesign.read(case / "asym.json")
    found = corrected([reseau.read_image(case / "thermal.png")], told)
    assert found == told.model_copy(update={"polarity": "bright"})


def test_photographs_that_show_a_target_are_named_where_there_are_too_few() -> None:
    frames = photographs(CHESS)
    wall = replace(frames[0], pixels=frames[0].pixels // 8 + 90, name="wall.png")
    found = calibrate_camera(
        [*frames[:2], replace(wall, pixels=wall.pixels[:60, :60])], CHESS, measurer_of(CHESS)
    )
    assert isinstance(found, Failure)
    assert found.reason.startswith("2 images (0.png, 1.png) show the target, 3 are needed")
    assert "; wall.png: " in found.reason


def test_a_refusal_says_what_was_corrected() -> None:
    told = CHESS.model_copy(update={"columns": 8, "rows": 7})
    found = calibrate_camera(photographs(CHESS)[:1], told, measurer_of(told))
    assert isinstance(found, Failure)
    assert "; the photographs show a chessboard of 7 × 6 squares, not a chessboard of 8 × 7" in found.reason


def test_a_size_in_another_unit_is_asked_about() -> None:
    told = CHESS.model_copy(update={"pitch": 0.024})
    (note,) = measured(CHESS, told).notes
    assert "0.024 mm (24 µm): is it 0.024 m, which is 24 mm?" in note


@pytest.mark.slow
def test_a_measurer_that_draws_overlays_draws_the_corrected_board(tmp_path) -> None:  # type: ignore[no-untyped-def]
    told = CHESS.model_copy(update={"columns": 6, "rows": 5})
    measure = drawing_overlays(measurer_of(told), {"0.png": tmp_path / "0.png"})
    assert measured_as_shown(photographs(CHESS), told, measure).corrected is not None
    assert (tmp_path / "0.png").is_file()
