"""`--overlay` of the measuring commands: pictures of what was found, declined, and why."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reseau.io.images import write_image

Run = Callable[..., tuple[int, str, str]]


def shape(path: Path) -> tuple[int, ...]:
    return cv2.imread(str(path)).shape


def test_the_overlay_of_a_measurement_has_every_pixel_and_a_legend(
    reseau: Run, photo: Any, tmp_path: Path
) -> None:
    status, out, err = reseau(
        "measure", "reseau", photo.image, "-d", photo.design, "--overlay", tmp_path / "o.png"
    )
    assert (status, err) == (0, "")
    assert "63 of 63 marks measured" in out
    height, width, _ = shape(tmp_path / "o.png")
    assert width == 4 * 360
    assert 4 * 300 < height < 1.2 * 4 * 300


def test_a_design_that_is_not_found_has_an_overlay_too(reseau: Run, photo: Any, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(90, 110, (300, 360)).astype(np.uint8)
    write_image(tmp_path / "noise.png", noise)
    status, out, err = reseau(
        "measure", "reseau", tmp_path / "noise.png", "-d", photo.design, "--overlay", tmp_path / "o.png"
    )
    assert (status, out) == (1, "")
    assert "was not found" in err
    assert shape(tmp_path / "o.png")[1] == 4 * 360


def test_image_coordinates_have_no_overlay(reseau: Run, photo: Any, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("id,x,y\nA1,1,2\n")
    arguments = ("measure", "reseau", tmp_path / "m.csv", "-d", photo.design, "--overlay", tmp_path / "o.png")
    assert "needs an image" in reseau(*arguments)[2]


@pytest.mark.slow
@pytest.mark.parametrize(("where", "file"), [("o.png", "o.png"), ("all", "all/photo-overlay.png")])
def test_refine_draws_its_photographs(reseau: Run, photo: Any, tmp_path: Path, where: str, file: str) -> None:
    status, _, err = reseau(
        "refine", "--photo-i", photo.image, "--reseau", photo.design, "--overlay", tmp_path / where
    )
    assert (status, err) == (0, "")
    assert shape(tmp_path / file)[1] == 4 * 360


def test_several_scans_have_one_picture_each(reseau: Run, tmp_path: Path) -> None:
    scan = np.full((300, 400), 235, dtype=np.uint8)
    for name in ("a", "b"):
        write_image(tmp_path / f"{name}.png", scan)
    arguments = ("orient", tmp_path / "a.png", tmp_path / "b.png", "--jobs", "1")
    assert reseau(*arguments, "--overlay", tmp_path / "o.png")[0] == 1
    assert {path.name for path in tmp_path.glob("o*")} == {"o-a.png", "o-b.png"}
    reseau(*arguments, "--overlay", tmp_path / "folder")
    assert {path.name for path in (tmp_path / "folder").iterdir()} == {"a-overlay.png", "b-overlay.png"}


@pytest.mark.slow
def test_a_mirrored_frame_is_numbered_as_the_option_says(reseau: Run, photo: Any, tmp_path: Path) -> None:
    write_image(tmp_path / "back.png", np.ascontiguousarray(np.rint(photo.pixels[:, ::-1]).astype(np.uint8)))
    found = {}
    for option in ("--mirrored", "--not-mirrored"):
        status, out, _ = reseau(
            "measure", "reseau", tmp_path / "back.png", "-d", photo.design, option, "--json"
        )
        assert status == 0
        found[option] = {p["id"]: (p["x"], p["y"]) for p in json.loads(out)["points"] if p["ok"]}
    # Seen from behind, the first column is on the right.
    assert found["--mirrored"]["A1"][0] > found["--mirrored"]["A9"][0]
    assert found["--not-mirrored"]["A1"][0] < found["--not-mirrored"]["A9"][0]


@pytest.mark.slow
def test_a_rotated_frame_is_found_with_a_larger_maximum(reseau: Run, photo: Any, tmp_path: Path) -> None:
    write_image(tmp_path / "on-its-side.png", np.rot90(np.rint(photo.pixels).astype(np.uint8)).copy())
    arguments = ("measure", "reseau", tmp_path / "on-its-side.png", "-d", photo.design)
    status, out, _ = reseau(*arguments, "--max-rotation-deg", "100", "--not-mirrored", "--json")
    assert status == 0
    assert json.loads(out)["found"] == 63


def test_refine_takes_a_reseau_that_is_seen_from_behind(reseau: Run, photo: Any, tmp_path: Path) -> None:
    write_image(tmp_path / "back.png", np.ascontiguousarray(np.rint(photo.pixels[:, ::-1]).astype(np.uint8)))
    residuals = []
    for image, option in ((photo.image, "--not-mirrored"), (tmp_path / "back.png", "--mirrored")):
        status, out, err = reseau("refine", "--photo-i", image, "--reseau", photo.design, option)
        assert (status, err) == (0, "")
        residuals.append(float(out.split("residuals ")[1].split()[0]))
    assert residuals[1] == pytest.approx(residuals[0], rel=0.3)
