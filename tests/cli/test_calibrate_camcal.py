"""`reseau calibrate` on the 21 photographs of a sheet of disks, beside what another program made of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ..measure import camcal

Run = Callable[..., tuple[int, str, str]]

OPTIONS = (
    "--pitch-mm", "0.0031911032863849768", "--side", "image", "--free", "c,x0,y0,K1,K2,K3,P1,P2",
    "--sigma-px", 0.1,
)  # fmt: skip
"""Those of the published network: one sigma for all, no affinity, residuals of the corrected point."""
PUBLISHED = 1.68901
"""Sigma naught of the published adjustment, of 0.1 px."""


@pytest.fixture
def sheet(reference_data: Callable[[str], Path], tmp_path: Path) -> tuple[object, ...]:
    """The design and the four control points of the sheet, as options."""
    folder = reference_data("testfield_camcal")
    camcal.design(folder).write(tmp_path / "sheet.json")
    lines = (folder / "camcal-fixed.txt").read_text().splitlines()
    known = [
        line.split(",")[:1] + line.split(",")[2:5]
        for line in lines
        if line[:4] in ("1001", "1002", "1003", "1004")
    ]
    assert len(known) == 4
    rows = [",".join(word.strip() for word in words) for words in known]
    (tmp_path / "control.csv").write_text("id,x,y,z\n" + "\n".join(rows) + "\n")
    return ("-d", tmp_path / "sheet.json", "--control", tmp_path / "control.csv")


@pytest.mark.slow
def test_the_published_marks_give_the_published_sigma_naught(
    reseau: Run, reference_data: Callable[[str], Path], sheet: tuple[object, ...], tmp_path: Path
) -> None:
    files = []
    for k, marks in enumerate(camcal.marks(reference_data("testfield_camcal"))):
        files.append(tmp_path / f"{k:02d}.csv")
        rows = [f"{name},{float(xy[0]) - 0.5!r},{float(xy[1]) - 0.5!r}" for name, xy in marks.items()]
        files[-1].write_text("id,x,y\n" + "\n".join(rows) + "\n")
    status, out, err = reseau("calibrate", *files, *sheet, *OPTIONS, "--image-size", "2272x1704", "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)
    # Without marks that are declined it would be 3726; the other program declines none.
    assert 3700 <= found["redundancy"] <= 3726
    assert f"{found['sigma0']:.5f}" == f"{PUBLISHED:.5f}"
    # A posteriori: the published 0.00109 mm, which is of the sigma naught found and not of the 0.1 px given.
    assert f"{found['parameters']['c']['sigma']:.3g}" == "0.00109"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_from_pixels_the_same_marks_give_a_smaller_sigma_naught(
    reseau: Run, reference_data: Callable[[str], Path], sheet: tuple[object, ...]
) -> None:
    folder = reference_data("testfield_camcal")
    images, theirs = camcal.photographs(folder), camcal.marks(folder)

    def calibrate(*more: object) -> dict[str, Any]:
        status, out, err = reseau(
            "calibrate", *images, *sheet, *OPTIONS, "--channel", "green", *more, "--json"
        )
        assert (status, err) == (0, "")
        found: dict[str, Any] = json.loads(out)
        return found

    # Two marks that the other program has not, and that stand in for none that it has.
    more = []
    for image, point in (("P8250026.JPG", "95"), ("P8250030.JPG", "80")):
        assert point not in theirs[[path.name for path in images].index(image)]
        more += ["--leave-out", f"{image}:{point}"]
    found = calibrate(*more)
    # Without marks that are declined it would be 3726; the other program declines none.
    assert 3700 <= found["redundancy"] <= 3726
    assert found["sigma0"] < PUBLISHED
