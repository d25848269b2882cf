"""`reseau export CALIBRATION --to FORMAT`: calibrations for other programs, and theirs for us."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.calibration import Calibration
from reseau.calibration.assessment import Assessment, Use
from reseau.io.images import write_image

from ..exchange.test_calibrations import SIZE, calibration

Run = Callable[..., tuple[int, str, str]]


def test_the_command_writes_and_reads_all_of_them(reseau: Run, tmp_path: Path) -> None:
    calibration("five").write(tmp_path / "K.json")
    status, out, _ = reseau("export", tmp_path / "K.json", "--to", "ros", "-o", tmp_path / "K.yaml")
    assert (status, out) == (0, f"{tmp_path / 'K.yaml'}: ros, model opencv\n")
    status, out, _ = reseau("export", tmp_path / "K.yaml", "--to", "colmap", "-o", tmp_path / "cameras.txt")
    assert status == 0
    assert reseau("export", tmp_path / "cameras.txt", "--to", "reseau", "-o", tmp_path / "again.json")[0] == 0
    again = Calibration.read(tmp_path / "again.json")
    assert again.values() == pytest.approx(calibration("five").values(), abs=1e-9)
    calibration("fisheye").write(tmp_path / "F.json")
    _, out, _ = reseau("export", tmp_path / "F.json", "--to", "matlab", "-o", tmp_path / "F.m")
    assert "differs from the calibration by" in out
    assert "matlab has no model that describes this camera well; these formats have its own" in out
    status, _, err = reseau("export", tmp_path / "K.json", "--to", "ros")
    assert status == 2
    assert err.count("\n") == 1


def test_what_is_usable_for_nothing_is_not_passed_on(reseau: Run, tmp_path: Path) -> None:
    good = calibration("five")
    bad = Assessment(use=Use.NOTHING, lines=("not usable: …",), centre_px=0.16, corners_px=50.0)
    good.model_copy(update={"assessment": bad}).write(tmp_path / "K.json")
    write_image(tmp_path / "photo.png", np.full((SIZE[1], SIZE[0]), 90, np.uint8))
    export = ("export", tmp_path / "K.json", "--to", "ros", "-o", tmp_path / "K.yaml")
    apply = ("apply", tmp_path / "K.json", tmp_path / "photo.png", "-o", tmp_path / "flat.png")
    for command, written in ((export, "K.yaml"), (apply, "flat.png")):
        status, _, err = reseau(*command)
        assert status == 2
        assert "is not usable: 0.16 px at the centre, 50 px in the corners; it is not" in err
        assert err.count("\n") == 1
        assert not (tmp_path / written).exists()
        status, _, err = reseau(*command, "--anyway")
        assert status == 0
        assert err.startswith("note: calibration five is not usable")
        assert (tmp_path / written).exists()
    assert (tmp_path / "K.yaml").read_text("utf-8").startswith("# five: not usable: 0.16 px at the centre")
    # The camera of the undistorted image is as good.
    assert Calibration.read(tmp_path / "flat.json").assessment == bad
    good.write(tmp_path / "K.json")
    status, _, err = reseau(*export)
    assert (status, err.count("\n")) == (0, 1)
    assert "has no verdict: it was imported, computed from others, or made by an earlier" in err
