"""The demo: the whole way, the same to the byte, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from reseau.calibration import Calibration
from reseau.cli import demo, run
from reseau.formats import ReseauDesign, ReseauMeasurement
from reseau.refine import CameraCorrection

FILES = {
    "report.html",
    "calibration.json",
    "measurement.json",
    "design.json",
    "comparison.json",
    "photo_i.png",
    "overview.png",
}
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "out"
    assert run(["demo", "--out", str(folder), "--seed", "2"]) == 0
    return folder


def test_all_files_are_there_and_can_be_read(out: Path) -> None:
    assert {path.name for path in out.iterdir()} == FILES
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    correction = CameraCorrection.from_calibration(Calibration.read(out / "calibration.json"))
    measured = ReseauMeasurement.read(out / "measurement.json")
    assert measured.found == measured.expected == 165
    design = ReseauDesign.read(out / "design.json")
    corrected = correction.apply(measured.image_points())
    origin = design.xy[design.ids.index(design.origin or "")]
    assert abs(corrected.xy - (design.xy - origin)).max() < 0.02  # millimetres


def test_the_correction_takes_the_distortion_off(out: Path) -> None:
    truth = json.loads((out / "comparison.json").read_text())
    check = {stage["name"]: max(stage["check"]) for stage in truth["stages"]}
    assert check["best similarity"] > 0.05
    assert check["corrected"] < 0.003
    assert max(truth["position_px"]) < 0.012
    assert max(truth["approximation"]) < 0.003


def test_same_seed_same_bytes_but_for_the_clock(out: Path, reseau: Run, tmp_path: Path) -> None:
    status, text, err = reseau("demo", "--out", tmp_path / "again", "--seed", 2, "--json")
    assert (status, err) == (0, "")
    assert text == (out / "comparison.json").read_text()
    for name in FILES - {"calibration.json"}:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name
    one, other = (
        json.loads((folder / "calibration.json").read_text()) for folder in (out, tmp_path / "again")
    )
    assert set(one.pop("times")) == set(other.pop("times")) == {"computed"}
    assert one == other


def test_an_error_leaves_what_was_there_before(
    reseau: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "mine.txt").write_text("keep")

    class Dark:
        """A bench whose shutter stays shut."""

        def __init__(self) -> None:
            from reseau_sims import World

            self.world = World.standard(1)
            self.design = self.world.design
            self.world.screen.light *= 0

        def photo_i(self) -> object:
            return self.world.photo_i()

        def check_marks(self) -> tuple[str, ...]:
            return ()

    monkeypatch.setattr(demo, "_bench", lambda seed: Dark())
    status, text, err = reseau("demo", "--out", folder)
    assert status in (1, 2)
    assert text == ""
    assert err.startswith("reseau: PHOTO I")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "mine.txt"]


def test_a_folder_that_cannot_be_is_refused_at_once(reseau: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "none" / "out"):
        status, _, err = reseau("demo", "--out", place)
        assert status == 2
        assert err.count("\n") == 1
