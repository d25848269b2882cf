"""Bad input: one line that names the file and the reason, exit status 1 or 2, nothing left behind."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from reseau.io.images import write_image

Run = Callable[..., tuple[int, str, str]]


def changed(design: Path, where: Path, **changes: Any) -> Path:
    where.write_text(json.dumps(json.loads(design.read_text()) | changes))
    return where


def make(case: str, photo: Any, folder: Path) -> tuple[Path, Path]:
    """Image and design of a case."""
    image, design = folder / "bad.png", photo.design
    good, pixels = photo.image, np.rint(photo.pixels).astype(np.uint8)
    points = json.loads(design.read_text())["points"]
    match case:
        case "text instead of an image":
            image.write_text("not an image")
        case "truncated image":
            image.write_bytes(good.read_bytes()[:2000])
        case "empty file":
            image.write_bytes(b"")
        case "no such image":
            pass
        case "folder instead of an image":
            image.mkdir()
        case "all black":
            write_image(image, np.zeros((300, 360), dtype=np.uint8))
        case "saturated":
            write_image(image, np.full((300, 360), 255, dtype=np.uint8))
        case "black of 16 bit":
            image = folder / "bad.tif"
            tifffile.imwrite(image, np.zeros((300, 360), dtype=np.uint16))
        case "noise alone":
            write_image(image, np.random.default_rng(0).integers(90, 110, (300, 360)).astype(np.uint8))
        case "a corner of the image":
            write_image(image, np.ascontiguousarray(pixels[:40, :40]))
        case "nominal positions of a larger frame":
            moved = [
                p | {"nominal_px": [3000.0 + 100 * i, 2000.0 + 100 * (i % 3)]} for i, p in enumerate(points)
            ]
            design = changed(design, folder / "bad.json", points=moved)
            image = good
        case "wrong key":
            image, design = good, changed(design, folder / "bad.json", colour="red")
        case "duplicate ids":
            image, design = good, changed(design, folder / "bad.json", points=points + points[:1])
        case "no json":
            (folder / "bad.json").write_text("{")
            image, design = good, folder / "bad.json"
        case "another document":
            image, design = good, changed(design, folder / "bad.json", schema="reseau-calibration/1")
        case "no such design":
            image, design = good, folder / "bad.json"
        case "image for a design":
            image, design = good, good
    return image, design


CASES = [
    ("text instead of an image", "bad.png", "is not a PNG, JPEG, TIFF or BMP image"),
    ("truncated image", "bad.png", "truncated"),
    ("empty file", "bad.png", "is empty"),
    ("no such image", "bad.png", "No such file"),
    ("folder instead of an image", "bad.png", "Is a directory"),
    ("all black", "bad.png", "black"),
    ("saturated", "bad.png", "saturated"),
    ("black of 16 bit", "bad.tif", "black"),
    ("noise alone", "bad.png", "was not found"),
    ("a corner of the image", "bad.png", "was not found in the frame of 40×40"),
    ("nominal positions of a larger frame", "photo.png", "was not found in the frame of 360×300"),
    ("wrong key", "bad.json", "unknown key `colour`"),
    ("duplicate ids", "bad.json", "duplicate id 'A1'"),
    ("no json", "bad.json", "is not JSON"),
    ("another document", "bad.json", "'reseau-design/1' was expected"),
    ("no such design", "bad.json", "No such file"),
    ("image for a design", "photo.png", "is not UTF-8 text"),
]


@pytest.mark.parametrize(("case", "named", "reason"), CASES, ids=[case for case, *_ in CASES])
@pytest.mark.parametrize("command", ["measure", "refine"])
def test_bad_input_is_reported_in_one_line_and_writes_nothing(
    reseau: Run, photo: Any, tmp_path: Path, command: str, case: str, named: str, reason: str
) -> None:
    image, design = make(case, photo, tmp_path)
    before = sorted(tmp_path.rglob("*"))
    arguments = {
        "measure": ("measure", "reseau", image, "--design", design, "--out", tmp_path / "out.json"),
        "refine": ("refine", "--photo-i", image, "--reseau", design, "--out", tmp_path / "out.json"),
    }[command]
    status, out, err = reseau(*arguments)
    assert status in (1, 2)
    assert out == ""
    assert err.startswith("reseau: ")
    assert err.count("\n") == 1
    assert named in err
    assert reason in err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("count", [1, 3, 5])
def test_fewer_marks_than_parameters_is_a_failure(
    reseau: Run, photo: Any, tmp_path: Path, count: int
) -> None:
    truth = photo.view(photo.grid.xy)
    path = tmp_path / "few.csv"
    rows = (f"{name},{x},{y}" for name, (x, y) in zip(photo.grid.ids[:count], truth, strict=False))
    path.write_text("id,x,y\n" + "\n".join(rows) + "\n")
    status, out, err = reseau(
        "refine", "--photo-i", path, "--reseau", photo.design, "--out", tmp_path / "k.json"
    )
    assert (status, out) == (1, "")
    assert err.startswith(f"reseau: {path}: ")
    assert err.count("\n") == 1
    assert not (tmp_path / "k.json").exists()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["nonsense"], "nonsense"),
        (["measure", "reseau"], "Missing argument"),
        (["measure", "reseau", "a.png"], "design"),
        (["measure", "reseau", "a.png", "-d", "d.json", "--out", "a.bmp"], "use .json, .csv"),
        (["measure", "reseau", "a.png", "-d", "d.json", "--out", "none/a.json"], "folder does not exist"),
        (["design", "reseau", "--columns", "many"], "'--columns'"),
        (["design", "reseau", "--columns", "1"], "1 × 11 marks"),
        (["design", "reseau", "--svg", "a.png"], "use .svg"),
        (["design", "reseau", "--pitch", "0.2"], "do not fit a pitch"),
        (["refine", "--photo-i", "a.png", "--reseau", "d.json", "--alpha", "2"], "--alpha"),
        (["demo", "--seed", "-1"], "'--seed'"),
        (["apply", "none.json", "a.png"], "none.json"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_wrong_use_is_reported_in_one_line_with_status_two(
    reseau: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = reseau(*arguments)
    assert (status, out) == (2, "")
    assert err.startswith("reseau: ")
    assert err.count("\n") == 1
    assert reason in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda c: c | {"model": "brown"}, "`model`: is not the model of a calibration"),
        (lambda c: c | {"model": c["model"] | {"mapping": {}}}, "missing key `terms`"),
        (lambda c: c | {"parameters": {}, "covariance": {"names": [], "matrix": []}}, ""),
        (lambda c: {k: v for k, v in c.items() if k != "sigma0"}, "missing key `sigma0`"),
    ],
    ids=["other model", "no terms", "no parameters", "missing key"],
)
def test_a_damaged_calibration_corrects_nothing(
    reseau: Run, photo: Any, calibration: Path, tmp_path: Path, change: Any, reason: str
) -> None:
    bad = tmp_path / "bad.json"
    bad.write_text(json.dumps(change(json.loads(calibration.read_text()))))
    status, out, err = reseau("apply", bad, photo.image, "--out", tmp_path / "o.png")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert reason in err
    assert not (tmp_path / "o.png").exists()


def test_an_image_that_a_file_cannot_hold_is_refused(
    reseau: Run, photo: Any, calibration: Path, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "deep.tif", np.rint(photo.pixels * 100).astype(np.uint16))
    status, _, err = reseau("apply", calibration, tmp_path / "deep.tif", "--out", tmp_path / "o.jpg")
    assert status == 2
    assert "o.jpg: cannot hold grey values of type uint16" in err
    assert [path.name for path in tmp_path.iterdir()] == ["deep.tif"]


def test_the_program_itself_exits_without_a_traceback(photo: Any, tmp_path: Path) -> None:
    code = f"from reseau.cli import main; main(['measure', 'reseau', 'x.png', '-d', {str(photo.design)!r}])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "reseau: x.png: cannot be read (No such file or directory)\n"
