"""Targets on paper: they fit, in true size, and sheets that are joined show all of the target."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.designs import board, coded_sheet, coded_testfield, space_frame
from reseau.designs.drawing import Drawable, content_of, design_pdf
from reseau.designs.paper import PAPERS, largest_pitch, sheets_of


def pages(pdf: bytes) -> list[list[float]]:
    """Sizes of the pages, mm."""
    boxes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    return [[float(side) / 72 * 25.4 for side in box] for box in boxes]


@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize(
    "design", [coded_sheet(10, 13, 16.0), coded_testfield(8, 8, 18.0), board("charuco", 7, 10, 21)]
)
def test_a_target_that_fits_is_drawn_on_one_sheet_of_the_paper(design: Drawable, paper: str) -> None:
    (size,) = pages(design_pdf(design, paper))
    np.testing.assert_allclose(sorted(size), PAPERS[paper], rtol=0, atol=0.01)


def test_the_largest_pitch_fits_and_the_next_does_not() -> None:
    pitch = largest_pitch(lambda p: content_of(board("charuco", 7, 10, p)), "A4")
    assert len(pages(design_pdf(board("charuco", 7, 10, pitch), "A4"))) == 1
    assert len(pages(design_pdf(board("charuco", 7, 10, pitch + 1), "A4"))) > 1


def test_joined_sheets_show_every_disk_where_it_belongs() -> None:
    """Of a sheet over several papers, disks in the parts together have the coordinates of the design."""
    design = coded_sheet(12, 9, 37.0)
    content, shown = content_of(design), dict[tuple[float, float], int]()
    sheets = sheets_of(content, "A4")
    assert len(sheets) == 6
    (left, _), (_, high) = content.low, content.high
    for k, sheet in enumerate(sheets):
        x0, y0, x1, y1 = sheet.target
        assert 0 < x0 < x1 < sheet.width - 15  # with room for the flap
        assert 0 < y0 < y1 < sheet.height - 30
        row, column = (int(n) - 1 for n in re.findall(r"row (\d+), column (\d+)", sheet.texts[0][3])[0])
        assert k == row * 3 + column
        for x, y, radius in sheet.circles:
            if x0 <= x < x1 and y0 <= y < y1:
                shown[round(left + x - x0, 6), round(high - y + y0, 6)] = k
                assert x0 + radius < x < x1 - radius  # not cut through
                assert y0 + radius < y < y1 - radius
        left, high = (left + x1 - x0, high) if column < 2 else (content.low[0], high - (y1 - y0))
    assert sorted(shown) == sorted((round(x, 6), round(y, 6)) for x, y in design.xy.tolist())


@pytest.mark.parametrize(
    ("design", "free"),
    [
        (board("chess", 7, 10, 50.0), 25.0),
        (board("charuco", 9, 6, 40.0), 20.0),
        (board("circles", 7, 10, 50.0), 25.0),
        (board("circles", 4, 11, 45.0, asymmetric=True), 22.5),
        (board("aprilgrid", 6, 6, 70.0, border_bits=2), 8.0),
        (board("markers", 5, 7, 60.0), 6.0),
        (board("deltille", 7, 10, 50.0), 12.0),
        (coded_sheet(10, 13, 40.0), 20.0),
        (coded_testfield(8, 8, 60.0), 7.0),
    ],
)
@pytest.mark.parametrize("paper", ["A4", "Tabloid"])
def test_joints_lie_between_the_marks(design: Drawable, free: float, paper: str) -> None:
    content = content_of(design)
    sheets = sheets_of(content, paper)
    places = [re.findall(r"row (\d+), column (\d+)", sheet.texts[0][3])[0] for sheet in sheets]
    assert len(sheets) > 1
    for axis, start in ((0, content.low[0]), (1, content.high[1])):
        # Widths of the first row of sheets, heights of the first column.
        cut = start
        for sheet, place in zip(sheets, places, strict=True):
            if place[axis] != "1":
                continue
            x0, y0, x1, y1 = sheet.target
            assert x1 - x0 <= max(PAPERS[paper]) - 24
            cut = cut + x1 - x0 if axis == 0 else cut - (y1 - y0)
            if content.low[axis] + 1e-6 < cut < content.high[axis] - 1e-6:
                assert np.abs(design.xy[:, axis] - cut).min() >= free - 1e-6
        np.testing.assert_allclose(cut, (content.high[0], content.low[1])[axis], rtol=0, atol=1e-9)


def test_single_targets_are_never_divided() -> None:
    frame = space_frame((1200.0, 900.0, 400.0), 28, 20.0)
    drawn = 0
    for k, size in enumerate(pages(design_pdf(frame, "A4"))):
        np.testing.assert_allclose(sorted(size), PAPERS["A4"], rtol=0, atol=0.01)
        drawn = k + 1
    assert drawn == 5  # 2 × 3 cells of 66 mm on each


def test_what_cannot_be_printed_is_refused() -> None:
    with pytest.raises(UsageError, match="sheets of A4"):
        design_pdf(coded_testfield(8, 8, 1000.0), "A4")
    with pytest.raises(UsageError, match="not one of A4"):
        design_pdf(coded_testfield(), "A5")


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="pdftoppm (poppler-utils) is not installed")
def test_a_printed_bar_is_a_hundred_millimetres_long(tmp_path: Path) -> None:
    """Rasterised by a program that shares nothing with the drawing, at 10 pixels per millimetre."""
    import cv2

    (tmp_path / "b.pdf").write_bytes(design_pdf(board("chess", 7, 10, 20.0), "A4"))
    subprocess.run(
        ["pdftoppm", "-r", "254", "-gray", "-singlefile", "-png", tmp_path / "b.pdf", tmp_path / "b"],
        check=True,
    )
    pixels = cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_GRAYSCALE)
    assert abs(np.array(pixels.shape) - [2970, 2100]).max() <= 1
    bar = np.flatnonzero(pixels[2970 - 164 - 4 : 2970 - 164 + 5, :1090].min(axis=0) < 200)
    assert bar.max() - bar.min() == pytest.approx(1000, abs=2)
    # Ten rows of squares of 20 mm.
    dark = np.flatnonzero((pixels < 60).sum(axis=1) > 500)
    assert dark.max() - dark.min() + 1 == pytest.approx(2000, abs=2)
