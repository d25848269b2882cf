"""`--design auto`: the target that photographs show, among known ones; photographs with another zoom."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import reseau
from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.designs import board, coded_sheet, coded_testfield
from reseau.designs.dots import dot_signs
from reseau.designs.known import known_designs
from reseau.io import BoardDesign
from reseau.io.photographs import read_exif
from reseau.procedures.exposures import of_another_lens
from reseau.procedures.target_measurement import Measurer, measurer_of
from reseau.procedures.which_target import Design, designs_beside, which_target

from .. import kept
from ..measure.board_pictures import picture

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from worlds import prints
from worlds.sheets import View, pose


@pytest.mark.slow
def test_a_charuco_board_is_found_among_other_targets() -> None:
    charuco = board("charuco", 7, 6, 24.0)
    frame, _ = picture(charuco)
    candidates = {
        "sheet": coded_sheet(8, 7, 20.0), "chess": board("chess", 7, 6, 24.0),
        "other": board("charuco", 9, 6, 24.0), "mine": charuco,
    }  # fmt: skip
    found = which_target([frame], candidates)
    assert not isinstance(found, Failure)
    assert found[0] == "mine"
    assert isinstance(found[1], BoardDesign)
    # One that is not among the candidates is described, without its size.
    found = which_target([frame], {"sheet": candidates["sheet"]})
    assert not isinstance(found, Failure)
    assert found[0] == "a ChArUco board of 7 × 6 squares with markers of DICT_5X5_50"


def test_a_lattice_that_few_photographs_show_is_said_where_no_target_is_found() -> None:
    frame, _ = picture(board("chess", 7, 6, 24.0))
    wall = Frame(np.random.default_rng(0).normal(100, 2, (200, 300)), 255.0)
    found = which_target([wall, frame, wall], {})
    assert isinstance(found, Failure)
    assert "seen; the photographs show a lattice of 7 × 6 squares without markers; describe" in found.reason


@pytest.mark.slow
def test_all_targets_that_fit_alike_are_named() -> None:
    frame, _ = picture(board("chess", 7, 6, 24.0))
    found = which_target(
        [frame], {"mine": board("chess", 7, 6, 24.0), "his": board("chess", 6, 7, 30.0)} | known_designs()
    )
    assert not isinstance(found, Failure)
    assert found[0] == "mine or his"


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the designs that are measured."""
    names = []

    def measuring(design: Design) -> Measurer:
        names.append(design.name)
        return measurer_of(design)

    monkeypatch.setattr("reseau.procedures.which_target.measurer_of", measuring)
    return names


@pytest.mark.slow
def test_where_a_lattice_is_seen_no_testfield_is_looked_for(tried: list[str]) -> None:
    frame, _ = picture(board("chess", 9, 8, 24.0))
    designs: dict[str, Design] = {"field": coded_testfield(4, 4, 30.0)}
    for kind in ("deltille", "circles", "chess"):
        designs[kind] = board(kind, 5, 6, 24.0, name=kind)
    found = which_target([frame], designs)
    assert not isinstance(found, Failure)
    assert found[0] == "a chessboard of 9 × 8 squares"
    assert set(tried) == {"chess", board("chess", 9, 8, 24.0).name}


@pytest.mark.slow
def test_lines_are_not_looked_for_where_markers_are_read(tried: list[str]) -> None:
    charuco = board("charuco", 7, 6, 24.0, name="mine")
    frame, _ = picture(charuco)
    large = Frame(np.kron(frame.pixels, np.ones((8, 8), np.uint8)), 255.0)
    designs = {"field": coded_testfield(4, 4, 30.0), "chess": board("chess", 7, 6, 24.0), "mine": charuco}
    found = which_target([large, large], designs)
    assert not isinstance(found, Failure)
    assert found[0] == "mine"
    assert tried == ["mine", "mine"]


@pytest.mark.slow
@pytest.mark.parametrize("start", [pytest.param((100, 7), marks=pytest.mark.slow), (333, 492)])
def test_a_puzzleboard_is_found_by_the_parts_that_photographs_show(start: tuple[int, int]) -> None:
    signs = dot_signs(board("puzzle", 12, 9, 22.0, start=start))
    bits = signs[1::2, 2:-1:2].T > 0, signs[2:-1:2, 1::2].T > 0
    printed = prints.puzzle(22.0, *bits, dark_first=sum(start) % 2 == 0)
    view = View(printed, *pose(3, printed, nearer=0.7), seed=3)
    whole, parts = Frame(kept.picture(view), 255.0), []
    # Columns of corners 0 to 6, and 4 to 10.
    for columns in (slice(0, 7), slice(4, 11)):
        xy = view.truth.reshape(8, 11, 2)[:, columns].reshape(-1, 2)
        (left, top), (right, bottom) = xy.min(axis=0).astype(int) - 12, xy.max(axis=0).astype(int) + 12
        parts.append(Frame(whole.pixels[max(top, 0) : bottom, max(left, 0) : right].copy(), 255.0))
    candidates: dict[str, Design] = {
        "chess": board("chess", 12, 9, 22.0),
        "charuco": board("charuco", 7, 6, 24.0),
    }
    found = which_target(iter(parts), candidates, tried=1)
    assert not isinstance(found, Failure)
    name, design = found
    assert isinstance(design, BoardDesign)
    assert (design.kind, design.columns, design.rows, design.start) == ("puzzle", 12, 9, start)
    assert f"11 × 8 corners from column {start[0]} and row {start[1]}" in name
    # A given design of the same part comes first, and tells the size of the squares.
    given = board("puzzle", 12, 9, 15.0, start=start)
    assert which_target([whole], candidates | {"given": given}) == ("given", given)
    moved = which_target([whole], candidates | {"given": given.model_copy(update={"start": (0, 0)})})
    assert not isinstance(moved, Failure)
    assert isinstance(moved[1], BoardDesign)
    assert (moved[1].start, moved[1].pitch) == (start, 15.0)


@pytest.mark.slow
def test_boards_that_are_drawn_by_default_are_known() -> None:
    boards = {name: design for name, design in known_designs().items() if isinstance(design, BoardDesign)}
    for printed, name in (
        (prints.markers(7, 10, 18.4, 4.6, "DICT_5X5_100"), "markers on A4"),
        (prints.Deltille(7, 10, 20.0), "deltille on A4"),
    ):
        frame = Frame(kept.picture(View(printed, *pose(3, printed), seed=3)), 255.0)
        found = which_target([frame], boards)
        assert not isinstance(found, Failure)
        # The same on other paper differs in its size alone.
        kind = name.partition(" ")[0]
        assert found == (f"{name}, {kind} on A3, {kind} on Letter or {kind} on Tabloid", boards[name])


def test_boards_of_other_programs_beside_photographs_are_candidates(tmp_path: Path) -> None:
    text = "target_type: 'checkerboard'\ntargetCols: 9\ntargetRows: 6\nrowSpacingMeters: 0.1\n"
    text += "colSpacingMeters: 0.1\n"
    (tmp_path / "chess.yaml").write_text(text)
    (tmp_path / "camchain.yaml").write_text("cam0:\n  camera_model: pinhole\n")
    found = designs_beside([tmp_path])
    assert found[str(tmp_path / "chess.yaml")] == board("chess", 10, 7, 100.0, name="chess")
    assert str(tmp_path / "camchain.yaml") not in found


@pytest.mark.slow
def test_parts_of_a_larger_chessboard_are_not_taken_for_a_smaller_one() -> None:
    larger, smaller = board("chess", 9, 8, 24.0), board("chess", 7, 7, 24.0)
    frame, xy = picture(larger)
    corners = xy.reshape(7, 8, 2)[:6, :6].reshape(-1, 2)
    (left, top), (right, bottom) = np.rint(corners.min(axis=0)), np.rint(corners.max(axis=0))
    part = Frame(frame.pixels[int(top) - 9 : int(bottom) + 10, int(left) - 9 : int(right) + 10].copy(), 255.0)
    assert measurer_of(smaller)(part)
    assert which_target([part, part, part], {"smaller": smaller}) == ("smaller", smaller)
    # Of three photographs that show a part of it, and others, also those after the first three tell.
    found = which_target([part, part, part, frame, frame], {"smaller": smaller})
    assert not isinstance(found, Failure)
    assert found[0] == "a chessboard of 9 × 8 squares"
    assert which_target([part, part, part, frame], {"smaller": smaller, "larger": larger})


@pytest.mark.slow
def test_a_sheet_of_dots_without_a_design_is_declined(reference_data: Callable[[str], Path]) -> None:
    files = sorted(reference_data("testfield_camcal").glob("*.JPG"))[:2]
    found = which_target(map(reseau.read_image, files), dict(known_designs()), tried=2)
    assert not found
    assert found.reason.startswith("none of the known targets is seen")


def test_photographs_with_another_zoom_are_named(tmp_path: Path) -> None:
    files = {}
    for name, focal in (("a.jpg", 24.0), ("b.jpg", 24.0), ("c.jpg", 35.0), ("d.jpg", 24.0)):
        exif = Image.Exif()
        inner = exif.get_ifd(0x8769)
        inner[0x920A], inner[0xA405] = focal, int(1.5 * focal)
        exif[0x010F], exif[0x0110] = "Canon", "Canon EOS 5D"
        Image.new("L", (8, 8)).save(tmp_path / name, exif=exif)
        files[name] = tmp_path / name
    said, others = of_another_lens(files)
    assert said == pytest.approx(36)
    assert read_exif(files["a.jpg"]).camera == "Canon EOS 5D"
    assert others == {"c.jpg": "was taken with a focal length of 35 mm, most with 24 mm"}
