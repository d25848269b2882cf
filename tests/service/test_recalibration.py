"""Recalibrations on a simulated bench, from the command line; alarms, which a mail server receives."""

from __future__ import annotations

import getpass
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from reseau.archive import Archive
from reseau.cli import run
from reseau.core.errors import InputError, StateError, UsageError
from reseau.service import (
    AcceptanceRules,
    Alarms,
    Configurations,
    Limits,
    Recalibrations,
    Schedule,
    Schedules,
)
from reseau.service.alarms import sender

from ..capture.fieldrig import TESTFIELD, FieldRig, enter, write_inputs
from .http.test_benches import until
from .test_inforce import RULES as CAMERA_RULES
from .test_inforce import camera

RULES = AcceptanceRules(version=1, image=Limits(warning=0.2, action=0.5), coverage=0.3)


@pytest.fixture(scope="module")
def defined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a first session, its calibration in force, and a recalibration that repeats it."""
    folder = tmp_path_factory.mktemp("defined")
    with pytest.MonkeyPatch.context() as monkeypatch:
        enter(folder, monkeypatch, FieldRig())
        write_inputs()
        RULES.write("rules.json")
        assert run(["capture", "testfield", *TESTFIELD, "--name", "first"]) == 0
        assert run(["archive", "show", "first", "--out", "first"]) == 0
        assert run(["calibrations", "define", "left", "-p", "camera=vidicon"]) == 0
        decide = ["calibrations", "decide", "left", "first/calibration.json", "--rules", "rules.json"]
        assert run([*decide, "--since", "2026-01-01T00:00Z"]) == 1
        with Archive.open("archive") as archive:
            known = Configurations(archive)
            known.review("left", known.history("left")[0].key, "accepted", comment="first")
        define = [
            "recalibrate", "left", "--repeats", "first", "--configuration", "left", "--rules",
            "rules.json"
        ]  # fmt: skip
        assert run(define) == 0
    return folder


@pytest.fixture
def rig(defined: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FieldRig:
    """The bench of a recalibration that is defined, in a folder of its own."""
    rig = FieldRig()
    shutil.copytree(defined, tmp_path, dirs_exist_ok=True)
    enter(tmp_path, monkeypatch, rig)
    return rig


@pytest.mark.slow
def test_a_recalibration_is_acquired_adjusted_compared_and_put_in_force(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run(["recalibrate", "left", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["judgement"]["outcome"].startswith("accepted")
    findings = {each["rule"]: each["level"] for each in made["judgement"]["findings"]}
    assert findings["image"] == findings["significance"] == "ok"
    with Archive.open("archive") as archive:
        assert len(archive.sessions()) == 2
        applied = Configurations(archive).applied("left", datetime.now(UTC))
        assert applied is not None
        assert applied.key == made["key"]
        assert made["by"] == f"{getpass.getuser()}, recalibration left"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_steps_of_a_recalibration_follow_one_another_to_the_certificate(
    rig: FieldRig, mailbox: tuple[str, list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("lxml", reason="needs lxml (extra `service`)")
    contact = {"name": "Institute of Photogrammetry", "city": "Bonn", "country": "DE"}
    data = {"schema": "reseau-certificate-data/1", "laboratory": contact, "customer": contact,
            "responsible": ["Ada Byron"], "item": {"name": "camera", "serial": "4711"}}  # fmt: skip
    Path("data.json").write_text(json.dumps(data))
    define = ["recalibrate", "left", "--repeats", "first", "--configuration", "left", "--rules", "rules.json"]
    steps = ["--warm-up-minutes", "0.01", "--self-test", "--data", "data.json", "--inside", "127.0.0.1"]
    assert run([*define, *steps, "--notify", mailbox[0]]) == 0
    with Archive.open("archive") as archive:
        said = list[str]()
        watch = lambda kind, facts: said.append(facts["text"]) if kind == "step" else None  # noqa: E731
        made = Recalibrations(archive).run("left", watch=watch)
        kept = {each.name for each in archive.session(made.session or "").results()}
    assert {"certificate.html", "certificate.xml"} <= kept
    warm, tested, decided, issued, notified = said
    assert (warm, tested) == ("warms up for 0.01 min", "self-test passed")
    assert decided.startswith("decided: accepted")
    assert (issued, notified) == ("certificate issued", "notified")
    assert str(made.session) in body(mailbox[1][0])


@pytest.mark.slow
def test_a_recalibration_that_stops_is_continued_where_it_stopped(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    moved: list[str] = []

    def stall(axis: str, position: float) -> None:
        moved.append(axis)
        if len(moved) == 6:
            raise StateError("is stalled", where="table")

    usual, rig.table.before = rig.table.before, stall
    assert run(["recalibrate", "left"]) == 1
    assert "is stalled" in capsys.readouterr().err
    rig.table.before = usual
    with Archive.open("archive") as archive:
        session = archive.session(archive.sessions()[-1].name)
        taken = {each.sha256 for each in session.frames(kind="frame")}
        assert 0 < len(taken) < 8
    assert run(["recalibrate", "left", "--resume"]) == 0
    with Archive.open("archive") as archive:
        assert len(archive.sessions()) == 2
        kept = {each.sha256 for each in archive.session(archive.sessions()[-1].name).frames(kind="frame")}
        assert taken <= kept
    assert run(["recalibrate", "left", "--resume"]) == 2
    assert "has no session that can be continued" in capsys.readouterr().err


@pytest.mark.slow
def test_a_schedule_carries_out_what_is_due_once_and_exports_a_calendar(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    start = datetime.now(UTC) - timedelta(minutes=1)
    content = Schedule(name="weekly", recalibration="left", configuration="left", rule="FREQ=WEEKLY;COUNT=52",
                       start=f"{start:%Y-%m-%dT%H:%M:%S}", zone="UTC")  # fmt: skip
    content.write("weekly.json")
    with Archive.open("archive") as archive:
        Schedules(archive).add(content, start - timedelta(hours=1))
    capsys.readouterr()
    assert run(["schedule", "run", "--once"]) == 0
    assert "done: accepted" in capsys.readouterr().out
    assert run(["schedule", "run", "--once"]) == 0
    assert capsys.readouterr().out == ""
    assert run(["schedule", "show", "weekly"]) == 0
    assert "done       accepted" in capsys.readouterr().out.splitlines()[0]
    assert run(["calibrations", "event", "left", "camera dropped"]) == 0
    assert run(["schedule", "show", "weekly"]) == 0
    assert "due        service event: camera dropped" in capsys.readouterr().out
    assert run(["schedule", "run", "--once"]) == 0
    assert "done: needs review" in capsys.readouterr().out
    assert run(["schedule", "export", "weekly", "--out", "weekly.ics"]) == 0
    assert Path("weekly.ics").read_text().count("BEGIN:VEVENT") > 50
    assert run(["alarms", "list"]) == 1
    assert "needs a review" in capsys.readouterr().out


@pytest.mark.slow
def test_a_bench_in_use_blocks_the_run_and_nothing_is_begun(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    from reseau.capture import BenchLock

    start = datetime.now(UTC) - timedelta(minutes=1)
    content = Schedule(name="weekly", recalibration="left", rule="FREQ=WEEKLY;COUNT=52",
                       start=f"{start:%Y-%m-%dT%H:%M:%S}", zone="UTC")  # fmt: skip
    with Archive.open("archive") as archive:
        Schedules(archive).add(content, start - timedelta(hours=1))
    with BenchLock(["sim-camera"], "somebody"):
        assert run(["schedule", "run", "--once"]) == 1
    assert "blocked: sim-camera: is in use by somebody" in capsys.readouterr().out
    with Archive.open("archive") as archive:
        assert len(archive.sessions()) == 1
    assert run(["schedule", "run", "--once"]) == 0


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["recalibrate", "left"], "left: is not a recalibration of this archive"),
        (["recalibrate", "left", "--repeats", "x"], "--repeats: needs --configuration and --rules"),
        (["schedule", "show", "weekly"], "weekly: is not a schedule of this archive"),
        (["schedule", "add", "endless.json"], "has no end"),
        (["schedule", "add", "weekly.json"], "left: is not a recalibration of this archive"),
        (["alarms", "acknowledge", "x", "--by", "Ada"], "'x': is no alarm"),
        (["schedule", "run", "--once", "--notify", "nowhere"], "address 1: cannot be used"),
        (["schedule", "units", "--archive", "my archive"], "--archive: contains characters"),
    ],
)
def test_impossible_requests_are_refused_in_one_line(
    arguments: list[str], part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    pytest.importorskip("apprise", reason="needs apprise (extra `service`)")
    monkeypatch.chdir(tmp_path)
    Archive.open("archive", create=True).close()
    content = {
        "schema": "reseau-schedule/1", "name": "weekly", "recalibration": "left",
        "rule": "FREQ=WEEKLY;COUNT=9", "start": "2026-03-02T08:00", "zone": "UTC",
    }  # fmt: skip
    Path("weekly.json").write_text(json.dumps(content))
    Path("endless.json").write_text(json.dumps(content | {"rule": "FREQ=WEEKLY"}))
    assert run(arguments) == 2
    error = capsys.readouterr().err
    assert part in error
    assert len(error.splitlines()) == 1


@pytest.mark.slow
def test_a_daemon_ends_when_it_is_asked_to(tmp_path: Path) -> None:
    Archive.open(tmp_path / "archive", create=True).close()
    code = "import sys; from reseau.cli import run; sys.exit(run(sys.argv[1:]))"
    arguments = ["schedule", "run", "--every", "1", "--archive", str(tmp_path / "archive")]
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True
    ) as daemon:
        assert daemon.stdout is not None
        assert "every 1 s" in daemon.stdout.readline()
        with pytest.raises(subprocess.TimeoutExpired):
            daemon.wait(3)
        daemon.terminate()
        assert daemon.wait(60) == 0


@pytest.fixture
def mailbox() -> Iterator[tuple[str, list[Any]]]:
    """Address of a mail server on this computer, and the messages that it received."""
    controller = pytest.importorskip("aiosmtpd.controller", reason="needs aiosmtpd")
    received: list[Any] = []

    class Handler:
        async def handle_DATA(self, server: Any, session: Any, envelope: Any) -> str:
            received.append(envelope)
            return "250 OK"

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = controller.Controller(Handler(), hostname="127.0.0.1", port=port, ready_timeout=30.0)
    server.start()
    yield f"mailto://127.0.0.1:{port}?from=bench@example.org&to=ada@example.org&mode=insecure", received
    server.stop()


def body(message: Any) -> str:
    import email

    parsed = email.message_from_bytes(message.content)
    parts = [each for each in parsed.walk() if each.get_content_maintype() == "text"]
    return "".join(each.get_payload(decode=True).decode() for each in parts)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("way", ["address", "name", "redirect", "rebinding"])
def test_alarms_reach_no_address_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    pytest.importorskip("apprise", reason="needs apprise (extra `service`)")
    asked: list[str] = []

    class Hook(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked.append(self.path)
            self.send_response(307 if self.path == "/moved" else 200)
            self.send_header("Location", f"http://127.0.0.2:{self.server.server_port}/inside")  # type: ignore[attr-defined]
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Nothing."""

    if way == "rebinding":  # a name that resolves to a public address first, and inside when it is used
        (tmp_path / "sitecustomize.py").write_text(_REBINDING)
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with ThreadingHTTPServer(("127.0.0.1", 0), Hook) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        port = server.server_port
        hosts = {"name": f"localhost:{port}/", "rebinding": f"alarms.example:{port}/"}
        url = f"json://{hosts.get(way, f'127.0.0.1:{port}/' + ('moved' if way == 'redirect' else ''))}"
        inside = ["127.0.0.1/32"] if way == "redirect" else []
        with pytest.raises(UsageError, match=r"127\.0\.0\..*--inside|::1.*--inside"):
            sender([url], inside)("title", "text")
        assert asked == (["/moved"] if way == "redirect" else [])
        if way == "address":
            assert sender([url], ["127.0.0.1"])("title", "text")
            assert asked == ["/"]
        server.shutdown()
    with pytest.raises(UsageError, match="is no network"):
        sender([url], ["example"])


_REBINDING = """
import socket

plain, count = socket.getaddrinfo, 0


def rebinding(host, port, *arguments, **options):
    global count
    if host == "alarms.example":
        count += 1
        host = "192.0.2.1" if count == 1 and not arguments else "127.0.0.1"
    return plain(host, port, *arguments, **options)


socket.getaddrinfo = rebinding
"""


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_alarms_are_sent_once_and_repeated_until_they_are_acknowledged(
    tmp_path: Path, mailbox: tuple[str, list[Any]]
) -> None:
    pytest.importorskip("apprise", reason="needs apprise (extra `service`)")
    address, received = mailbox
    start = datetime(2026, 3, 2, 8, tzinfo=UTC)
    with Archive.open(tmp_path / "archive", create=True) as archive:
        alarms, deliver, day = Alarms(archive), sender([address], ["127.0.0.1"]), timedelta(days=1)
        assert alarms.send(deliver, day, start) == []
        assert received == []
        known = Configurations(archive)
        known.define("left", {"camera": "DMK 33"})
        first = known.decide("left", camera(), CAMERA_RULES, since=start)
        assert [each.text for each in alarms.send(deliver, day, start)] == [
            f"left: the calibration of {first.since:%Y-%m-%d %H:%M}Z ({first.key}) needs a review"
        ]
        assert alarms.send(deliver, day, start + day / 2) == []
        assert len(alarms.send(deliver, day, start + day)) == 1
        assert len(received) == 2
        assert first.key in body(received[0])
        assert "(repeated)" in body(received[1])
        known.review("left", first.key, "accepted", comment="first")
        assert alarms.send(deliver, day, start + 3 * day) == []
        bad = known.decide("left", camera(c=8.2), CAMERA_RULES, since=start + day)
        schedule = Schedule(name="weekly", recalibration="left", rule="FREQ=WEEKLY;COUNT=9",
                            start="2026-03-04T08:00", zone="UTC")  # fmt: skip
        Schedules(archive).add(schedule, start)
        (one, other) = alarms.send(deliver, day, start + 3 * day)
        assert {one.text, other.text} == {
            f"left: the calibration of {bad.since:%Y-%m-%d %H:%M}Z ({bad.key}) was rejected",
            "weekly: the run of 2026-03-04 08:00Z was not carried out",
        }
        alarms.acknowledge(f"calibration left {bad.key}", "Ada")
        (again,) = alarms.send(deliver, day, start + 5 * day)
        assert again.key.startswith("run weekly")
        assert len(received) == 4
        with pytest.raises(UsageError, match="is no alarm"):
            alarms.acknowledge("something", "Ada")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_service_sends_alarms_where_an_administrator_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("apprise", reason="needs apprise (extra `service`)")
    from .http.served import served

    received: list[bytes] = []

    class Hook(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            received.append(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Nothing."""

    monkeypatch.setattr("reseau.service.http.service._ALARMS_S", 0.1)
    with ThreadingHTTPServer(("127.0.0.1", 0), Hook) as server, served(tmp_path) as one:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        address = f"json://127.0.0.1:{server.server_port}/alarms"
        known = Configurations(one.service.archive)
        known.define("left", {"camera": "DMK 33"})
        key = known.decide("left", camera(), CAMERA_RULES).key
        to = {"notify": [address], "inside": ["127.0.0.1"]}
        where = "/api/1/alarms/delivery"
        assert one.client("operate").put(where, json=to).status_code == 403
        wrong = one.client().put(where, json=to | {"notify": ["nothing"]})
        assert (wrong.status_code, wrong.json()["error"]["text"]) == (
            422, "address 1: cannot be used; see the URLs of apprise",
        )  # fmt: skip
        assert one.client().put(where, json=to).status_code == 200
        until(lambda: received, 60)
        assert key in received[0].decode()
        server.shutdown()
        assert address in one.client().get("/history").text
        assert address not in one.client("operate").get("/history").text


def test_calibrations_that_cannot_be_charted_together_are_an_alarm(tmp_path: Path) -> None:
    start, day = datetime(2026, 3, 2, 8, tzinfo=UTC), timedelta(days=1)
    with Archive.open(tmp_path / "archive", create=True) as archive:
        known = Configurations(archive)
        known.define("left", {"camera": "DMK 33"})
        first = known.decide("left", camera(), CAMERA_RULES, since=start)
        known.review("left", first.key, "accepted", comment="first")
        other = camera(name="other")
        update = {"covariance": other.covariance.model_copy(update={"names": (), "matrix": ()})}
        known.decide("left", other.model_copy(update=update), CAMERA_RULES, since=start + day)
        assert [each.key for each in Alarms(archive).open()] == ["charts left"]


def test_alarms_that_cannot_be_delivered_are_sent_later(tmp_path: Path) -> None:
    start, day = datetime(2026, 3, 2, 8, tzinfo=UTC), timedelta(days=1)
    with Archive.open(tmp_path / "archive", create=True) as archive:
        known, alarms = Configurations(archive), Alarms(archive)
        known.define("left", {"camera": "DMK 33"})
        known.decide("left", camera(), CAMERA_RULES, since=start)
        with pytest.raises(InputError, match="could not be delivered"):
            alarms.send(lambda title, text: False, day, start)
        assert len(alarms.send(lambda title, text: True, day, start)) == 1


_SENDER = """
import os, sys, time
from datetime import UTC, datetime, timedelta
from reseau.archive import Archive
from reseau.service import Alarms
place, told, begin, day = sys.argv[1:]
def deliver(title, text):
    if told == "killed":
        os._exit(9)
    time.sleep(0.05)
    with open(told, "a") as file:
        file.write(text + chr(10))
    return True
with Archive.open(place) as archive:
    alarms = Alarms(archive)
    time.sleep(max(0.0, float(begin) - time.time()))
    alarms.send(deliver, timedelta(days=1), datetime(2026, 3, int(day), tzinfo=UTC))
"""


@pytest.mark.slow
def test_two_services_on_one_archive_send_each_alarm_once(tmp_path: Path) -> None:
    place, day = tmp_path / "archive", timedelta(days=1)
    command = [sys.executable, "-c", _SENDER, place]
    with Archive.open(place, create=True) as archive:
        known, names = Configurations(archive), [f"camera {number}" for number in range(12)]
        for name in names:
            known.define(name, {"camera": name})
            known.decide(name, camera(), CAMERA_RULES, since=datetime(2026, 3, 1, tzinfo=UTC))
        at_once = [tmp_path / "told.txt", str(time.time() + 4), "3"]
        senders = [subprocess.Popen([*command, *at_once]) for _ in range(2)]
        assert [each.wait(60) for each in senders] == [0, 0]
        told = [each.partition(":")[0] for each in (tmp_path / "told.txt").read_text().splitlines()]
        assert sorted(told) == sorted(names)
        # What a process was sending when it was killed, another one sends once that must have ended.
        assert subprocess.run([*command, "killed", "0", "20"], check=False).returncode == 9
        alarms, killed = Alarms(archive), datetime(2026, 3, 20, tzinfo=UTC)
        assert alarms.send(lambda title, text: True, day, killed + timedelta(seconds=120)) == []
        assert len(alarms.send(lambda title, text: True, day, killed + timedelta(seconds=300))) == 12
