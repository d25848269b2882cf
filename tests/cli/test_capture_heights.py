"""`reseau capture testfield --heights`: from the bench to the calibration, and again from the archive."""

import json
from pathlib import Path

import pytest

from reseau.cli import run
from reseau_sims import FieldBench

from ..capture.fieldrig import AXES, FieldRig, enter, write_inputs

HEIGHTS = (
    "--heights", "0,150,300", "--height-sigma", "0.05", "--axis-sigma-mrad", "5", "--field-sigma", "0.001"
)  # fmt: skip


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FieldRig:
    """A bench whose table lifts the board along an axis that is not its normal."""
    field = FieldBench(seed=4, bend_mm=0.0, stage_tilt=(4e-3, -3e-3), stage_sigma_mm=0.05)
    rig = FieldRig(field, (*AXES, "z"))
    enter(tmp_path, monkeypatch, rig)
    write_inputs("name,tilt,roll,camera_roll\nfrontal,0,0,0\n")
    return rig


@pytest.mark.slow
def test_one_frontal_pose_at_three_heights_gives_a_reproducible_calibration(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--design", "field.json", "--poses", "poses.csv", "--pitch-mm", "0.027", "--free", "c,x0,y0")
    assert run(["capture", "testfield", *given, *HEIGHTS, "--fill", "0.8", "--name", "lifted"]) == 0
    assert "3/3 frontal z 300" in capsys.readouterr().out
    assert run(["archive", "show", "lifted", "--out", "results"]) == 0
    parameters = json.loads(Path("results/calibration.json").read_text())["parameters"]
    for name, true, most in (("c", 57.5, 0.1), ("x0", 0.0, 1.0), ("y0", 0.0, 1.0)):
        assert abs(parameters[name]["value"] - true) < 4 * parameters[name]["sigma"] < most * 4
    capsys.readouterr()
    assert run(["archive", "rerun", "lifted", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["same"]


def test_a_sigma_of_zero_is_refused(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["capture", "testfield", "--design", "field.json", "--height-sigma", "0"]) == 2
    assert "--height-sigma" in capsys.readouterr().err
    assert rig.camera.exposures == 0
