"""`--evidence FILE` writes the outcomes of the fault tests as a table: driver × transport × fault."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from reseau.core.memory import keep_loaded
from reseau_sims.serving import KINDS

from .rigs import aravis_is_missing, left_open, rig

HEAD = """\
# Faults and reactions of drivers

Written by `python benchmarks/faults.py --exchanges 10000`; each cell is one or more tests of
`test_battery_*.py`. A fault affects an answer during the work of the driver: in process the 1st, 2nd, 3rd and
5th answer, otherwise the 3rd. A cell contains the outcome and the longest time until it was known: *right*
(the work succeeded as without the fault), or the class of the error, which names instrument and command. Time
limits are short in these tests: 0.5 s for an answer of Zaber, SMC100, Ping360 and CompactPulser, 0.5 s for a
call of BK and of a camera, 0.7 s for an oscilloscope. Every test also asserts that no answer was taken for
the answer to another query, that the instrument could be recovered, that the following work was right, and
that the numbers of file descriptors, sockets and threads are unchanged.

Faults of the line: late (0.6 s), dropped, truncated, repeated, corrupted, disconnected; faults of the
instrument: stuck, wrong state, out of range, power-cycled. `test_endurance` continues with one fault in a
hundred answers.

Fakes that are written from threads and manuals are worked on, too: `pytest -m slow
tests/drivers/test_profiles.py` spoils 10 000 answers of all profiles of oscilloscopes, of GRBL and its kin,
Zaber and T-Cubes at random (truncated, delayed, dropped, repeated, stale, reordered, reset, wrong checksum);
no picture, waveform or position that is returned is wrong.

For cameras an answer is a frame. Late: it is sent late; dropped: it is lost completely; truncated: half of
its packets are lost (GigE Vision) or half of its data are missing (V4L2); corrupted: the same, because
packets with a wrong checksum are discarded, or its buffer is marked as damaged; repeated: the previous frame
is sent again. Disconnected: the cable is pulled, and on GigE Vision plugged in again 0.2 s later; stuck: no
more frames until the next start; wrong state: control is lost, or the kernel's queue reports an error; out of
range: the time stamp is one hour ahead; power-cycled: the camera loses control and settings. No returned
frame was damaged, stale or repeated.

"""


@pytest.fixture(autouse=True, scope="module")
def _other_tests_garbage() -> None:
    """Answers have half a second; to look through what earlier tests keep takes as long, and all wait."""
    keep_loaded()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--evidence", metavar="FILE", help="write the table of faults to this file (Markdown)")


_LOG: list[pytest.TestReport] = []


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _LOG.append(report)


def pytest_sessionfinish(session: pytest.Session) -> None:
    path = session.config.getoption("--evidence", None)
    if not path or hasattr(session.config, "workerinput"):
        return
    cells: dict[tuple[str, str], dict[str, list[tuple[str, float]]]] = {}
    for report in _LOG:
        found = dict(report.user_properties)
        if report.when != "teardown" or "fault" not in found:
            continue
        outcome = found["outcome"] if found.get("nothing left open") else "LEFT SOMETHING OPEN"
        row = cells.setdefault((str(found["driver"]), str(found["transport"])), {})
        row.setdefault(str(found["fault"]), []).append((str(outcome), float(found["seconds"])))
    endured = [
        dict(report.user_properties)
        for report in _LOG
        if report.when == "teardown" and "exchanges" in dict(report.user_properties)
    ]
    failed = {report.nodeid for report in _LOG if report.failed}
    Path(path).write_text(
        HEAD + _table(cells) + _endurance(endured) + "".join(f"\nFAILED: {name}\n" for name in sorted(failed))
    )


def _table(cells: dict[tuple[str, str], dict[str, list[tuple[str, float]]]]) -> str:
    rows = [["driver", "transport", *KINDS], ["---"] * (2 + len(KINDS))]
    for (driver, transport), row in sorted(cells.items()):
        rows.append([driver, transport, *(_cell(row.get(kind, [])) for kind in KINDS)])
    count = sum(len(cell) for row in cells.values() for cell in row.values())
    lines = "".join("| " + " | ".join(row) + " |\n" for row in rows)
    return f"{lines}\n{count} tests in {len(cells) * len(KINDS)} cells.\n"


def _endurance(found: list[dict[str, object]]) -> str:
    """Table of the outcomes of many exchanges with random faults."""
    if not found:
        return ""
    keys = ("driver", "transport", "exchanges", "faults", "errors", "longest")
    rows = [
        ["driver", "transport", "exchanges", "faults", "typed errors", "longest work"],
        ["---"] * len(keys),
        *sorted([f"{f[key]:.1f} s" if key == "longest" else str(f[key]) for key in keys] for f in found),
    ]
    return (
        "\n## Endurance\n\nOne fault in a hundred answers, of all kinds; all other results were right.\n\n"
        + "".join("| " + " | ".join(row) + " |\n" for row in rows)
    )


def _cell(found: list[tuple[str, float]]) -> str:
    """Outcomes of a fault, each with the longest time it took."""
    longest: dict[str, float] = {}
    for outcome, seconds in found:
        longest[outcome] = max(longest.get(outcome, 0.0), seconds)
    return "; ".join(f"{outcome} {seconds:.1f} s" for outcome, seconds in sorted(longest.items())) or "–"


@pytest.fixture(scope="session")
def libraries_are_loaded() -> None:
    """What libraries open once for the process (libusb, GLib) is not counted."""
    with rig("oscilloscope", "vxi-11"), rig("oscilloscope", "hislip"):
        pass
    if not aravis_is_missing():
        with rig("aravis", "gige"):
            pass


@pytest.fixture
def nothing_is_left_open(libraries_are_loaded: None, request: pytest.FixtureRequest) -> Iterator[None]:
    before = left_open()
    yield
    deadline = time.monotonic() + 5.0
    while left_open() != before and time.monotonic() < deadline:
        time.sleep(0.01)
    request.node.user_properties.append(("nothing left open", left_open() == before))
    assert left_open() == before
