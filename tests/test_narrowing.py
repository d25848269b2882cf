"""`if result:` tells a result from a failure, for mypy and, where it is installed, for pyright."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import assert_type

import pytest

import reseau
from reseau.api import Adjusted
from reseau.measure.points import Measured
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.refined import Refined


def narrowed() -> None:
    """Never called."""
    calibrated = reseau.calibrate("photos")
    if calibrated:
        assert_type(calibrated, Calibrated)
    else:
        assert_type(calibrated, reseau.Failure)
    measured = reseau.measure("photo.png", "board.json")
    if not measured:
        assert_type(measured, reseau.Failure)
        return
    assert_type(measured, Measured)
    refined = reseau.refine("photo.png", "reseau.json")
    assert_type(refined.required(), Refined)
    adjusted = reseau.adjust_network("network.json")
    assert_type(adjusted, Adjusted) if adjusted else assert_type(adjusted, reseau.Failure)


def test_results_are_truthy_and_failures_raise_when_required() -> None:
    failure = reseau.Failure("no solution", reseau.Code.NOT_FOUND)
    assert not failure
    with pytest.raises(reseau.ReseauError, match="no solution"):
        failure.required()


@pytest.mark.slow
@pytest.mark.parametrize("checker", ["mypy", "pyright"])
def test_type_checkers_narrow_results(checker: str) -> None:
    program = shutil.which(checker, path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if program is None:
        pytest.skip(f"{checker} is not installed")
    # Where reseau is not installed but on the path.
    environment = os.environ | {"MYPYPATH": os.environ.get("PYTHONPATH", "")}
    done = subprocess.run([program, __file__], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stdout
