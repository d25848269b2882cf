"""How-to pages: their commands, in the order of the page, print what the page shows.

Pages continue in the folder of a tour, or draw what they need. Not followed are pages without output, and
commands that need another machine, an instrument or an archive of months (`APART`).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from reseau.cli import run

from .touring import DOCS, draw_demo, follow, steps

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

CAMERA = {
    "calibrate-a-camera": ("photos",),
    "choose-a-camera-model": ("photos", "board.json"),
    "exchange-calibrations": ("camera.json",),
    "flat-target": ("photos", "board.json"),
    "print-a-target": ("photos",),
    "results-in-a-program": ("photos", "board.json"),
    "see-what-was-measured": ("photos", "board.json"),
    "uncertainty-budget": ("camera.json",),
    "undistort": ("photos", "camera.json"),
    "use-your-own-board": ("photos", "board.json"),
}
"""Pages that use what the tour of a camera has made."""
ALONE = (
    "coded-testfield", "fiducial-marks", "n-wire-phantom", "reseau-on-film", "sensor-from-files",
    "several-cameras", "sharpness", "sheet-of-disks", "turntable",
)  # fmt: skip
"""Pages that draw what they need."""
OF_TOURS = {"blurred-network": "blurred-under-water", "through-water-or-glass": "underwater"}
"""Pages that show commands of a tour, with their output."""
APART = {
    "live-picture": "needs a camera",
    "several-machines": "needs a cluster",
    "temperature-zoom-focus": "needs an archive of months",
    "when-an-adjustment-fails": "needs a network that fails",
}
"""Pages whose output is not made anew here."""
NOT_HERE = ("tele/", "points/")
"""Folders of single commands on other pages that only their authors have."""


def test_every_page_with_output_is_followed_or_named() -> None:
    shown = {page.stem for page in (DOCS / "howto").glob("*.md") if "```console" in page.read_text("utf-8")}
    followed = {*CAMERA, *ALONE, "film-frames", "micmac-and-metashape"}
    followed |= {"correct-your-own-instrument", "measure-a-reseau", "coordinates-from-elsewhere"}
    assert shown == followed | set(APART) | set(OF_TOURS)


@pytest.mark.parametrize("page", OF_TOURS)
def test_pages_that_show_a_command_of_a_tour_show_its_output(page: str) -> None:
    followed = {step.text: step.shown for step in steps(f"tours/{OF_TOURS[page]}")}
    for step in steps(f"howto/{page}"):
        assert step.kind != "command" or set(step.shown) <= {*followed[step.text], "..."}


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the tour of a camera."""
    folder = tmp_path_factory.mktemp("camera")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        follow("tours/camera", folder)
    return folder


@pytest.mark.parametrize("page", CAMERA)
def test_pages_that_continue_the_tour_of_a_camera(
    page: str, camera: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in CAMERA[page]:
        copy: Callable[..., object] = shutil.copytree if (camera / name).is_dir() else shutil.copy
        copy(camera / name, tmp_path / name)
    (tmp_path / "empty").mkdir()
    follow(f"howto/{page}", tmp_path, instead=lambda words: any(each in words for each in NOT_HERE))


@pytest.mark.parametrize("page", ALONE)
def test_pages_that_draw_what_they_need(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    follow(f"howto/{page}", tmp_path)


def test_pages_that_continue_the_tour_of_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (drawn,) = (step for step in steps("tours/film") if step.kind == "python")
    exec(compile(drawn.text, "film.md", "exec"), {})
    follow("howto/film-frames", tmp_path)
    follow("howto/micmac-and-metashape", tmp_path)


def test_pages_that_continue_the_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the photographs of the demo's world, without its bench."""
    monkeypatch.chdir(tmp_path)
    draw_demo()
    follow("howto/measure-a-reseau", tmp_path)
    follow("howto/correct-your-own-instrument", tmp_path)
    lying = ["--not-mirrored", "--max-rotation-deg", "45", "--out", "marks.csv"]
    assert run(["measure", "reseau", "out/photo_i.png", "--design", "out/reseau.json", *lying]) == 0
    follow("howto/coordinates-from-elsewhere", tmp_path)
