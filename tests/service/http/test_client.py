"""The client in Python and `reseau remote`, with a service in a process of its own."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from reseau.archive import Archive
from reseau.cli import run
from reseau.core.errors import ConnectionLost, UsageError
from reseau.service.client import Client

from ...capture.fieldrig import DESIGN
from .served import process


@pytest.fixture(scope="module")
def place(archived: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, str]]:
    folder = tmp_path_factory.mktemp("client")
    shutil.copytree(archived, folder, dirs_exist_ok=True)
    with process(folder) as (address, token, _):
        yield folder, address, token


@pytest.mark.slow
def test_sessions_and_files_are_read(place: tuple[Path, str, str]) -> None:
    with Client(place[1], place[2]) as client:
        assert [each["name"] for each in client.sessions()] == ["monday"]
        frame = client.get("/sessions/monday/frames")[0]
        assert len(client.file(f"/sessions/monday/frames/{frame['id']}/file")) == frame["size"]
        with pytest.raises(UsageError, match="tuesday: is not a session"):
            client.get("/sessions/tuesday")
    with Client(place[1], "wrong") as client, pytest.raises(UsageError, match="needs a token or a login"):
        client.get("/sessions")


@pytest.mark.slow
def test_the_commands_print_what_the_service_says(
    place: tuple[Path, str, str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("RESEAU_SERVER", place[1])
    monkeypatch.setenv("RESEAU_TOKEN", place[2])
    assert run(["remote", "sessions"]) == 0
    assert "monday  testfield  5 frames  done" in capsys.readouterr().out
    assert run(["remote", "show", "monday", "--out", str(tmp_path / "results")]) == 0
    assert "rejected right" in capsys.readouterr().out
    assert json.loads((tmp_path / "results" / "calibration.json").read_text())["kind"] == "camera"
    assert run(["remote", "calibrations", "--json"]) == 0
    assert {each["name"] for each in json.loads(capsys.readouterr().out)} == {"left", "vidicon"}
    assert run(["remote", "alarms"]) == 1
    assert "c increases" in capsys.readouterr().out
    assert run(["remote", "benches"]) == 0
    assert run(["remote", "call", "GET", "/about"]) == 0
    assert '"software"' in capsys.readouterr().out
    assert run(["remote", "stop", "none"]) == 2
    assert "is not a bench" in capsys.readouterr().err
    assert run(["remote", "sessions", "--server", "http://192.0.2.1"]) == 2
    assert "without TLS" in capsys.readouterr().err


@pytest.mark.slow
def test_photographs_are_uploaded(place: tuple[Path, str, str], tmp_path: Path) -> None:
    import cv2

    design = tmp_path / "field.json"
    design.write_text(DESIGN.to_json())
    with Archive.open(place[0] / "archive") as archive:
        session = archive.session("monday")
        for each in session.frames(kind="frame"):  # a good one follows the rejected one of its step
            cv2.imwrite(str(tmp_path / f"{each.step}.png"), session.picture(each).pixels)
    with Client(place[1], place[2]) as client:
        found = client.upload(
            "sent", sorted(tmp_path.glob("*.png")), design, pitch_mm="0.027", free="c,x0,y0"
        )
    assert (found["status"], found["good"]) == ("done", 4)


@pytest.mark.slow
def test_events_are_resumed_after_a_restart_of_the_service(archived: Path, tmp_path: Path) -> None:
    shutil.copytree(archived, tmp_path, dirs_exist_ok=True)
    found: list[tuple[str, str]] = []

    def listen(client: Client) -> None:
        try:
            for each in client.events():
                found.append((each.kind, each.about))
                if ("archive", "sessions") in found and ("reset", "") in found:
                    return
        except ConnectionLost:
            return

    with process(tmp_path) as (address, token, _):
        port = address.rpartition(":")[2]
        client = Client(address, token)
        listener = threading.Thread(target=listen, args=(client,))
        listener.start()
        end = time.monotonic() + 30
        while not found and time.monotonic() < end:
            with Archive.open(tmp_path / "archive") as archive:
                archive.begin(f"s {time.time_ns()}", "frames", {"count": 1})
            time.sleep(0.5)
        assert ("archive", "sessions") in found
    with process(tmp_path, "--port", port):
        listener.join(30)
        assert not listener.is_alive()
    client.close()
    assert ("reset", "") in found


@pytest.mark.slow
def test_the_service_is_ready_in_less_than_3_s_of_processor_time(tmp_path: Path) -> None:
    import psutil

    begun = time.monotonic()
    with process(tmp_path) as (address, token, running):
        waited = time.monotonic() - begun
        spent = psutil.Process(running.pid).cpu_times()
        assert httpx.get(f"{address}/api/1/health/ready").json()["status"] == "ready"
        headers = {"Authorization": f"Bearer {token}"}
        metrics = httpx.get(f"{address}/api/1/metrics", headers=headers).text
        assert 'reseau_requests_total{method="GET",route="/health/ready",status="200"} 1.0' in metrics
    assert spent.user + spent.system < 3.0
    assert waited < 60
    lines = [line for line in (tmp_path / "serve.log").read_text().splitlines() if line.startswith("{")]
    assert json.loads(lines[0])["event"] == "started"
    assert json.loads(lines[-1])["event"] == "ended"


@pytest.mark.slow
def test_requests_are_answered_beside_50_streams(place: tuple[Path, str, str]) -> None:
    headers = {"Authorization": f"Bearer {place[2]}"}
    limits = httpx.Limits(max_connections=300)
    with httpx.Client(base_url=f"{place[1]}/api/1", headers=headers, limits=limits, timeout=60) as client:
        streams = [client.stream("GET", "/events") for _ in range(50)]
        opened = [each.__enter__() for each in streams]
        try:
            assert all(each.status_code == 200 for each in opened)
            assert [client.get("/sessions").status_code for _ in range(20)] == [200] * 20
        finally:
            for each in streams:
                each.__exit__(None, None, None)
