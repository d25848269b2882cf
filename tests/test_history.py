"""`make bench-compare`: what counts as a loss, and what explains one."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import history

BEFORE = {"time": 10.0, "spread": 0.01, "seconds": 0.1, "memory": 200.0, "rms_px": 0.005}


@pytest.fixture
def compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Compare figures of the job `film` with records of it, given some explanations; return the status."""
    monkeypatch.setattr(history, "HISTORY", tmp_path / "history.jsonl")
    monkeypatch.setattr(history, "EXPLAINED", tmp_path / "explained.toml")

    def compare(now: dict[str, float], records: list[dict[str, float]], explained: str = "") -> int:
        lines = [
            json.dumps({"commit": f"000000{k}", "jobs": {"film": each}}) for k, each in enumerate(records)
        ]
        history.HISTORY.write_text("\n".join(lines))
        history.EXPLAINED.write_text(explained)
        monkeypatch.setattr(history, "measured", lambda jobs: dict.fromkeys(jobs, now))
        monkeypatch.setattr(sys, "argv", ["history.py", "compare", "film"])
        return history.main()

    return compare


def entry(figure: str = "time", commit: str = "0000001", reason: str = "it does more") -> str:
    return f'[[explained]]\njob = "film"\nfigure = "{figure}"\ncommit = "{commit}"\nreason = "{reason}"\n'


@pytest.mark.parametrize(
    ("changed", "failed"),
    [
        ({}, 0),
        ({"time": 10.9}, 0),
        ({"time": 11.2}, 1),
        ({"time": 11.2, "spread": 1.0}, 0),
        ({"time": 5.0}, 0),
        ({"memory": 230.0}, 1),
        ({"rms_px": 0.006}, 1),
        ({"seconds": 9.0}, 0),
    ],
)
def test_a_tenth_more_beyond_the_noise_is_a_loss(
    compared: Any, changed: dict[str, float], failed: int
) -> None:
    assert compared(BEFORE | changed, [BEFORE, BEFORE]) == failed


@pytest.mark.parametrize(
    ("explained", "failed"),
    [
        (entry(), 0),
        (entry(figure="memory"), 1),
        (entry(commit="0000000"), 1),
        ("", 1),
    ],
    ids=["explained", "another figure", "another commit", "nothing"],
)
def test_only_the_loss_that_is_named_is_explained(
    compared: Any, capsys: pytest.CaptureFixture[str], explained: str, failed: int
) -> None:
    # An explanation of the first record holds for what was recorded after it.
    assert compared(BEFORE | {"time": 11.5}, [BEFORE, BEFORE], explained) == failed
    said = capsys.readouterr().out
    assert ("explained: film: time 10 -> 11.5 (since 0000001): it does more" in said) is not bool(failed)
    assert ("LOSS: film: time 10 -> 11.5" in said) is bool(failed)


def test_a_loss_that_was_explained_and_recorded_is_the_new_measure(compared: Any) -> None:
    slower = BEFORE | {"time": 11.5}
    records = [BEFORE, BEFORE, slower]
    assert compared(slower, records) == 1
    assert compared(slower, records, entry()) == 0
    assert compared(BEFORE | {"time": 13.0}, records, entry()) == 1


@pytest.mark.parametrize(
    ("explained", "said"),
    [
        (entry(reason=""), "entry 1 has no reason"),
        (entry().replace("film", "films"), "entry 1 names no job: films"),
    ],
)
def test_an_incomplete_explanation_is_refused(compared: Any, explained: str, said: str) -> None:
    with pytest.raises(SystemExit, match=said):
        compared(BEFORE, [BEFORE], explained)


def test_nothing_recorded_is_a_failure(compared: Any) -> None:
    assert compared(BEFORE, []) == 1
