"""`reseau export CALIBRATION --to FORMAT`: calibrations for other programs, and theirs for us."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from reseau.calibration import Calibration

from ..exchange.test_calibrations import calibration

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
