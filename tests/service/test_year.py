"""A simulated year of recalibrations; see `benchmarks/year.py`, which says what is expected."""

from __future__ import annotations

import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import pytest

from reseau.archive import Archive

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from year import BAD, WEEKS, live


def lived(place: Path, weeks: int, seed: int = 1) -> list[str]:
    """The log of a year whose calibrations are drawn; all that was expected holds."""
    log: list[str] = []

    def opened(clock: Callable[[], datetime]) -> Archive:
        return Archive.open(place, create=True, clock=clock)

    assert live(opened, set(), seed, log.append, weeks), "\n".join(log)
    return log


@pytest.mark.slow
def test_weeks_with_a_bench_in_use_a_computer_off_summer_time_and_a_bad_run_go_as_expected(
    tmp_path: Path,
) -> None:
    log = "\n".join(lived(tmp_path / "archive", BAD + 1))
    assert "blocked: " in log
    assert "done: rejected: " in log
    assert log.count("ok  ") == 8


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_year_of_recalibrations_goes_as_expected(seed: int, tmp_path: Path) -> None:
    lived(tmp_path / "archive", WEEKS, seed)
