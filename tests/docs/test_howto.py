"""How-to pages: their commands, in the order of the page, print what the page shows.

Pages continue in the folder of a tour, or draw what they need; the camera of the live picture is simulated,
and the workers of other machines run on this one. Not followed are blocks without output.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from reseau.cli import run
from reseau.io.images import read_image
from reseau_sims.serving import SimulatedCamera, StillScene, VideoCamera, View

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
    "coded-testfield", "fiducial-marks", "learnt-marks", "n-wire-phantom", "reseau-on-film",
    "sensor-from-files", "several-cameras", "sharpness", "sheet-of-disks", "temperature-zoom-focus",
    "turntable", "when-an-adjustment-fails",
)  # fmt: skip
"""Pages that draw what they need."""
OF_TOURS = {"blurred-network": "blurred-under-water", "through-water-or-glass": "underwater"}
"""Pages that show commands of a tour, with their output."""


def test_every_page_with_output_is_followed_or_named() -> None:
    shown = {page.stem for page in (DOCS / "howto").glob("*.md") if "```console" in page.read_text("utf-8")}
    followed = {*CAMERA, *ALONE, "film-frames", "micmac-and-metashape"}
    followed |= {"correct-your-own-instrument", "measure-a-reseau", "coordinates-from-elsewhere"}
    followed |= {"live-picture", "several-machines"}
    assert shown == followed | set(OF_TOURS)


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
    follow(f"howto/{page}", tmp_path)


class _Held:
    """The photographs of the tour before a camera: the next one as soon as a frame was taken."""

    def __init__(self, photographs: Path, taken: Path) -> None:
        self.scenes = [StillScene(read_image(path)) for path in sorted(photographs.glob("*.png"))]
        self.taken = taken

    def __call__(self, view: View) -> Any:
        return self.scenes[min(len(list(self.taken.glob("*.png"))), len(self.scenes) - 1)](view)


def test_the_page_of_the_live_picture(camera: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(camera / "board.json", tmp_path)
    device = VideoCamera(SimulatedCamera(_Held(camera / "photos", tmp_path / "photos"), 720, 480))
    monkeypatch.setattr("reseau_drivers.camera.KernelNode", lambda path: device.open())
    follow("howto/live-picture", tmp_path)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_page_of_several_machines(camera: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed", reason="needs the extra `scale`")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(camera / "photos", "photos")
    shutil.copy(camera / "board.json", tmp_path)
    local = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with distributed.LocalCluster(**local) as cluster:
        here = {
            "HOST:8786": lambda: str(cluster.scheduler_address).removeprefix("tcp://"),
            "shared/store": lambda: str(tmp_path / "store").lstrip("/"),
        }
        follow("howto/several-machines", tmp_path, values=here)
    assert list(Path("store").iterdir())


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
