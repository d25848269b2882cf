"""`make bench`: what benchmarks record, what is run again, and that the page shows what was recorded."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import all as bench
import figures
from figures import Figure


@pytest.fixture
def rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "rows"
    monkeypatch.setenv("RESEAU_FIGURES", str(path))
    return path


def test_of_several_values_median_least_and_greatest_are_kept(rows: Path) -> None:
    figures.record("ladybug", "reseau", [0.5, 0.4, 0.9, np.nan], "s")
    figures.record("marks", "found", 3, of=4)
    figures.record("marks", "rms", [], "px")
    assert figures.read(rows) == [
        Figure("", "ladybug", "reseau", 0.5, 0.4, 0.9, 3, None, "s"),
        Figure("", "marks", "found", 3.0, of=4),
        Figure("", "marks", "rms", None, count=0, unit="px"),
    ]


def test_a_cell_that_is_recorded_twice_has_the_last_figure(rows: Path) -> None:
    figures.record("a", "b", 1.0)
    figures.record("a", "b", 2.0)
    assert [each.value for each in figures.read(rows)] == [2.0]


def test_nothing_is_kept_without_a_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("RESEAU_FIGURES", raising=False)
    monkeypatch.chdir(tmp_path)
    figures.record("a", "b", 1.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("figure", "shown"),
    [
        (Figure("", "", "", 0.4593, 0.441, 0.4789, 7, unit="s"), "0.459 s (0.441 to 0.479)"),
        (Figure("", "", "", 192.0, of=196), "192 of 196"),
        (Figure("", "", "", 17286.79), "17287"),
        (Figure("", "", "", 4.5e-13, unit="px"), "4.5e-13 px"),
        (Figure("", "", "", None), "–"),
    ],
)
def test_a_cell_has_three_digits_and_its_spread(figure: Figure, shown: str) -> None:
    assert str(figure) == shown


def test_a_table_has_rows_and_columns_in_the_order_in_which_they_came() -> None:
    cells = [Figure("", "b", "ours", 1.0), Figure("", "a", "ours", 2.0), Figure("", "a", "theirs", 3.0)]
    lines = figures.markdown(cells, "what").splitlines()
    assert lines == ["| what | ours | theirs |", "|---|---|---|", "| b | 1 | – |", "| a | 2 | 3 |"]


PROGRAM = """
import sys
from pathlib import Path
sys.path.insert(0, {benchmarks!r})
from figures import record
Path({log!r}).open("a").write("run\\n")
record("network", "reseau", [1.0, 3.0, 2.0], "s")
"""


@pytest.fixture
def entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """An entry whose program notes each run, and the folder of its results."""
    (tmp_path / "benchmarks").mkdir()
    log, folder = tmp_path / "log", tmp_path / "out"
    folder.mkdir()
    text = PROGRAM.format(benchmarks=str(Path(bench.__file__).parent), log=str(log))
    (tmp_path / "benchmarks" / "small.py").write_text(text)
    monkeypatch.setattr(bench, "ROOT", tmp_path)
    entries = (bench.Entry("small", "A small one", "small.py", ("SciPy",)),)
    monkeypatch.setattr(bench, "ENTRIES", entries)
    return entries[0], folder, log


def test_what_has_ended_well_for_the_same_code_is_not_run_again(entry: Any) -> None:
    one, folder, log = entry
    became = [bench.run(one, folder, at) for at in ("abc", "abc", "def", "def-dirty", "def-dirty")]
    assert [each.endswith("earlier") for each in became] == [False, True, False, False, False]
    assert log.read_text().count("run") == 4
    document = json.loads((folder / "small.json").read_text())
    assert document["figures"][0]["value"] == 2.0
    assert document["peers"]["SciPy"]


def test_an_entry_without_its_data_says_so_and_keeps_what_was_recorded(
    entry: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one, folder, _ = entry
    recorded = tmp_path / "figures.json"
    bench.run(one, folder, "abc")
    bench.keep(folder, recorded)
    before = recorded.read_text()
    monkeypatch.setattr(bench, "DATA", tmp_path / "none")
    without = bench.Entry("small", "A small one", "small.py", ("SciPy",), data="photographs")
    assert bench.run(without, folder, "def") == "skipped: photographs is not in RESEAU_DATA"
    bench.keep(folder, recorded)
    assert recorded.read_text() == before


def test_the_page_names_versions_and_what_is_missing(
    entry: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one, folder, _ = entry
    recorded = tmp_path / "figures.json"
    bench.run(one, folder, "abc")
    bench.keep(folder, recorded)
    version = bench.found("SciPy")
    text = bench.page({"small"}, recorded)
    assert f"s; SciPy {version}\n" in text
    assert "| network | 2 s (1 to 3) |" in text
    assert "Missing" not in bench.overview(recorded)
    monkeypatch.setattr(bench, "found", lambda peer: "")
    monkeypatch.setattr(bench, "ENTRIES", (one, bench.Entry("other", "Another", "other.py")))
    bench.run(one, folder, "def")
    bench.keep(folder, recorded)
    text = bench.overview(recorded)
    assert "- SciPy in “A small one”: scipy was not installed" in text
    assert "- Another: not recorded" in text


def test_docs_show_the_figures_that_were_recorded() -> None:
    shown = {name: (bench.PAGES / name).read_text("utf-8") for name in bench.pages()}
    assert shown == bench.pages(), "python benchmarks/all.py --list --write"


def test_every_entry_is_on_one_page() -> None:
    on_pages = [name for _, names in bench.SUBJECTS.values() for name in names]
    assert sorted(on_pages) == sorted(entry.name for entry in bench.ENTRIES)


def test_every_recorded_entry_is_one_of_make_bench() -> None:
    recorded = json.loads(figures.RECORDED.read_text())
    known = {each.name: each.command for each in bench.ENTRIES}
    assert {name: each["command"] for name, each in recorded.items()} == {
        name: known.get(name) for name in recorded
    }
