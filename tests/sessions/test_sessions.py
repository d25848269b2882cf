"""Sessions in a program: checked, carried out and rerun without the command line."""

from __future__ import annotations

import html
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from reseau.archive import Archive
from reseau.capture import Bench, BenchFile, BenchLock, InstrumentEntry
from reseau.capture.bench import IN_PROCESS
from reseau.core.errors import FormatError, ReseauError, StateError, UsageError
from reseau.sessions import conducting, kinds
from reseau.sessions.parameters import PhotographsParameters, TestfieldParameters

from ..capture.fieldrig import DESIGN, FieldRig

STEPS = [[f"tilt {tilt} roll {roll}", {"tilt": tilt, "roll": roll, "camera_roll": roll}]
         for tilt, roll in ((0.0, 0.0), (30.0, 90.0), (30.0, 180.0), (30.0, 270.0))]  # fmt: skip
TESTFIELD = {
    "steps": STEPS,
    "pitch_mm": 0.027,
    "free": ["c", "x0", "y0"],
    "row_jitter_px": 0.0086,
    "fill": 0.8,
}


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return Archive.open(tmp_path / "archive", create=True)


@pytest.mark.slow
def test_a_program_captures_and_reruns_a_session(archive: Archive) -> None:
    rig, given = FieldRig(), {"design.json": DESIGN.to_json()}
    conducting.check("monday", "testfield", TESTFIELD, given, rig.bench)
    session = conducting.begin(archive, "monday", "testfield", TESTFIELD, given)
    assert session.parameters == TESTFIELD  # as given, without defaults
    assert conducting.capture(session, rig.bench) is None
    assert session.status == "done"
    done = conducting.rerun(archive.session("monday"))
    assert [each.result.name for each in done] == ["calibration.json", "report.html", "scene.json"]
    assert all(each.same for each in done)
    assert conducting.calibration_of(session).parameters["c"].unit == "mm"


@pytest.mark.slow
def test_the_report_of_a_session_lists_the_frames_that_were_left_out(archive: Archive) -> None:
    away = [["edge on", {"tilt": 88.0, "roll": 0.0, "camera_roll": 0.0}]]
    given = {"design.json": DESIGN.to_json()}
    session = conducting.begin(archive, "monday", "testfield", {**TESTFIELD, "steps": STEPS + away}, given)
    conducting.capture(session, FieldRig().bench)
    declined = session.frames(step="edge on", ok=False)[-1].verdict
    assert declined is not None
    results = {each.name: each for each in session.results()}
    page = session.content(results["report.html"]).decode()
    assert "edge on" in page
    assert declined.why in html.unescape(page)


@pytest.mark.slow
def test_a_rerun_does_not_import_the_command_line() -> None:
    code = """
        import sys
        from reseau.sessions import conducting, kinds, parameters
        assert not [name for name in sys.modules if name.startswith("reseau.cli") or name == "typer"]
        """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True)


@pytest.mark.parametrize(
    ("plan", "parameters", "text"),
    [
        ("sensor", {}, "mine: parameters of plan `sensor`: missing key `region`"),
        ("testfield", {**TESTFIELD, "fill": "full"}, "mine: parameters of plan `testfield`: `fill`: "),
        ("testfield", {**TESTFIELD, "pich": 1.0}, "mine: parameters of plan `testfield`: unknown key `pich`"),
        ("frames", {"count": 0}, "mine: parameters of plan `frames`: `count`: "),
        ("frames", {"camera": object()}, "mine: parameters of plan `frames`: not JSON ("),
    ],
)
def test_wrong_parameters_are_refused_in_one_line_that_names_the_key(
    archive: Archive, plan: str, parameters: dict[str, object], text: str
) -> None:
    with pytest.raises(FormatError) as error:
        conducting.begin(archive, "mine", plan, parameters, {"design.json": DESIGN.to_json()})
    assert str(error.value).startswith(text)
    assert "\n" not in str(error.value)
    assert not archive.sessions()


def test_parameters_that_were_archived_unchecked_are_refused_by_a_rerun(archive: Archive) -> None:
    with pytest.raises(FormatError, match="mine: parameters of plan `sensor`: missing key `region`"):
        conducting.rerun(archive.begin("mine", "sensor", {}))
    with pytest.raises(UsageError, match="mystery: unknown plan; use testfield, oscilloscope"):
        conducting.rerun(archive.begin("other", "mystery", {}))


def test_parameters_of_older_versions_are_read(archive: Archive) -> None:
    """Version 0.1 had neither `sigmas` nor `retreat`, and no names of instruments."""
    older = {**TESTFIELD, "until": "", "first": 5, "average": 1, "checks": 3, "retakes": 2, "home": False}
    session = archive.begin(
        "older", "testfield", {**older, "park": {}}, inputs={"design.json": DESIGN.to_json()}
    )
    found = conducting.parameters_of(session)
    assert isinstance(found, TestfieldParameters)
    assert (found.sigmas, found.retreat, found.expected) == (None, None, 4)
    assert conducting.procedure_of(session) is not None


def test_a_missing_input_is_named(archive: Archive) -> None:
    with pytest.raises(UsageError, match=r"a: design\.json: missing input"):
        conducting.begin(archive, "a", "testfield", TESTFIELD)


def test_the_session_to_resume_is_found(archive: Archive) -> None:
    with pytest.raises(UsageError, match="frames: no session can be resumed"):
        conducting.resume(archive, "frames")
    first = conducting.begin(archive, "a", "frames", {})
    assert conducting.resume(archive, "frames").name == "a"
    conducting.begin(archive, "b", "frames", {})
    with pytest.raises(UsageError, match="a, b can be resumed; name one"):
        conducting.resume(archive, "frames")
    first.end("done")
    assert conducting.resume(archive, "frames").name == "b"


def _bench(*addresses: str) -> Bench:
    entries = {f"i{k}": InstrumentEntry(driver="sim", address=a) for k, a in enumerate(addresses)}
    rig = FieldRig()
    return Bench(BenchFile(name="bench", instruments=entries), lambda name, entry: rig.camera)


def test_two_benches_inside_processes_are_used_at_the_same_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    both = Barrier(2)

    def use(owner: str) -> str:
        with _bench(IN_PROCESS, f"sim-{owner}").lock(owner):
            both.wait(20)  # each holds its bench now
        return owner

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(use, ["the demo", "another demo"])) == ["the demo", "another demo"]


def test_an_instrument_outside_the_process_is_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with (
        BenchLock(["/dev/ttyUSB0"], "session monday"),
        pytest.raises(StateError, match="/dev/ttyUSB0: is in use by session monday"),
        _bench(IN_PROCESS, "/dev/ttyUSB0").lock("tuesday"),
    ):
        pass


@pytest.mark.slow
def test_two_demos_run_at_the_same_time(tmp_path: Path) -> None:
    """Each in its process, with the camera in that process, as on a machine without Aravis."""
    code = """
        import sys
        from pathlib import Path
        from reseau.sessions import demo
        demo._gige_available = lambda: False
        demo.run_demo(Path(sys.argv[1]))
        """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    runs = [subprocess.Popen([*command, str(tmp_path / name)]) for name in ("one", "two")]
    assert [run.wait(1200) for run in runs] == [0, 0]
    assert (tmp_path / "one/true.csv").read_bytes() == (tmp_path / "two/true.csv").read_bytes()


def test_errors_of_this_package_are_of_one_tree() -> None:
    with pytest.raises(ReseauError, match="unknown plan"):
        kinds.kind_of("mystery")


def test_archives_with_the_former_keys_are_read_as_before(tmp_path: Path) -> None:
    former = {"model": "", "pitch": 0.027, "free": ["c"], "row_jitter": 0.01, "fill": 0.8}
    with Archive.open(tmp_path, create=True) as archive:
        archive.begin("old", plan="photographs", parameters=former)
        given = conducting.parameters_of(archive.session("old"))
        assert archive.session("old").parameters == former
    assert isinstance(given, PhotographsParameters)
    assert (given.pitch_mm, given.row_jitter_px) == (0.027, 0.01)
    with pytest.raises(FormatError, match="unknown key `pitch`"):
        conducting.check("new", "photographs", former, {"design.json": ""})
