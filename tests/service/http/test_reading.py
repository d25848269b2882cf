"""What the archive has is read through the API and the pages; each endpoint asks who it is."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import shutil
import subprocess
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from reseau.archive import Archive
from reseau.calibration.reader import parse_calibration
from reseau.service import Configurations
from reseau.service.http.events import Events

from .populated import temperature
from .served import Served, TestClient, process, served

LEFT = "/api/1/configurations/left"


@pytest.fixture(scope="module")
def client(one: Served) -> TestClient:
    return one.client()


def operations(one: Served) -> list[tuple[str, str, dict[str, Any]]]:
    document = one.client().get("/api/1/openapi.json").json()
    return [
        (method.upper(), path, operation)
        for path, item in document["paths"].items()
        for method, operation in item.items()
    ]


def filled(path: str) -> str:
    return re.sub(r"\{(number|figure)\}", "1", re.sub(r"\{(session|name|key|bench)\}", "x", path))


@pytest.mark.slow
def test_every_operation_refuses_nobody_a_wrong_token_and_too_weak_a_token(one: Served) -> None:
    nobody, wrong, weak = one.client(""), one.client(""), one.client("read")
    wrong.headers["Authorization"] = "Bearer reseau_wrong"
    checked, mine = 0, ["/api/1/logout", "/api/1/configurations/{name}/drift"]
    mine += [f"/api/1/{each}" for each in ("me/password", "me/one-time", "me/one-time/confirm")]
    mine += ["/api/1/tokens", "/api/1/tokens/{name}"]
    for method, path, _ in operations(one):
        if path.startswith("/api/1/health") or path == "/api/1/login":
            continue
        for each in (nobody, wrong):
            answer = each.request(method, filled(path))
            assert answer.status_code == 401, (method, path, answer.text)
        if method != "GET" and path not in mine:
            answer = weak.request(method, filled(path))
            assert answer.status_code == 403, (method, path, answer.text)
        checked += 1
    assert checked > 40


def test_the_api_is_described_with_examples_and_statuses(one: Served) -> None:
    for method, path, operation in operations(one):
        assert operation["summary"], path
        statuses = set(operation["responses"])
        if "health" not in path:
            assert {"401", "403", "422"} <= statuses, (method, path)
        assert not re.search(r"\b[0-9a-f]{40}\b", json.dumps(operation))


def test_sessions_are_listed_latest_first_in_pages(client: TestClient) -> None:
    found = client.get("/api/1/sessions").json()
    assert [each["name"] for each in found["sessions"]] == ["monday"]
    assert found["before"] is None
    assert client.get("/api/1/sessions", params={"like": "tues"}).json()["sessions"] == []
    assert client.get("/api/1/sessions", params={"count": 0}).status_code == 422


def test_a_session_says_what_was_rejected_and_why(client: TestClient) -> None:
    found = client.get("/api/1/sessions/monday").json()
    assert (found["status"], found["expected"], found["good"], found["taken"]) == ("done", 4, 4, 5)
    assert [each["step"] for each in found["rejected"]] == ["right"]
    assert "expose more" in found["rejected"][0]["why"]
    assert found["to_come"] == []
    assert {each["name"] for each in found["results"]} == {"calibration.json", "report.html", "scene.json"}
    missing = client.get("/api/1/sessions/tuesday")
    assert (missing.status_code, missing.json()["error"]["code"]) == (404, "not_found")


def test_frames_are_downloaded_whole_and_in_ranges(client: TestClient) -> None:
    row = client.get("/api/1/sessions/monday/frames").json()[0]
    path = f"/api/1/sessions/monday/frames/{row['id']}/file"
    whole = client.get(path)
    assert hashlib.sha256(whole.content).hexdigest() == row["sha256"]
    parts = []
    for start in range(0, row["size"], 20_000):
        part = client.get(path, headers={"Range": f"bytes={start}-{start + 19_999}"})
        assert part.status_code == 206
        parts.append(part.content)
    assert b"".join(parts) == whole.content
    assert client.get(path, headers={"Range": "bytes=-10"}).content == whole.content[-10:]
    assert client.get(path, headers={"Range": f"bytes={row['size']}-"}).status_code == 416
    assert client.get(path, headers={"If-None-Match": whole.headers["etag"]}).status_code == 304


def test_documents_of_bluesky_are_read(client: TestClient) -> None:
    found = client.get("/api/1/sessions/monday/documents").json()
    kinds = [each["name"] for each in found]
    assert (kinds[0], kinds[-1], kinds.count("event")) == ("start", "stop", 4)
    assert client.get("/api/1/sessions/monday/documents", params={"after": 3}).json() == found[3:]


def test_documents_of_all_sessions_are_streamed_and_resumed(one: Served) -> None:
    archive, kinds = one.service.archive, ["start", "descriptor", *["event"] * 4, "stop"]

    async def read(last: int, count: int) -> list[dict[str, Any]]:
        stream, found = one.service.events.documents(archive, last, lambda: True), list[dict[str, Any]]()
        async for text in stream:
            fields = dict(line.split(": ", 1) for line in text.strip().splitlines())
            if "id" in fields:
                found.append(
                    {"id": int(fields["id"]), "event": fields["event"], **json.loads(fields["data"])}
                )
            if len(found) == count:
                break
            if len(found) == 7:  # what follows is stored by another process while the stream is read
                with Archive.open(archive.place) as other:
                    made = other.begin(f"streamed {time.time_ns()}", "frames", {"count": 1})
                    made.note("start", "start", {"uid": "1"})
        await stream.aclose()  # type: ignore[attr-defined]
        return found

    found = asyncio.run(read(0, 8))
    assert [each["event"] for each in found[:7]] == kinds
    assert {each["session"] for each in found[:7]} == {"monday"}
    assert found[7]["document"] == {"uid": "1"}
    again = asyncio.run(read(found[2]["id"], 5))
    assert again == found[3:8]


def test_a_preview_is_a_picture_of_the_frame(client: TestClient) -> None:
    row = client.get("/api/1/sessions/monday/frames").json()[0]
    coded = client.get(
        f"/api/1/sessions/monday/frames/{row['id']}/preview.jpg", params={"width": 120}
    ).content
    picture = cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert picture.shape[1] == 120
    assert np.ptp(picture) > 200


def test_marks_are_found_again_and_drawn(client: TestClient) -> None:
    row = client.get("/api/1/sessions/monday/frames").json()[0]
    base = f"/api/1/sessions/monday/frames/{row['id']}"
    found = client.get(f"{base}/marks").json()
    assert len(found["names"]) == row["measured"]["points"]
    xy = np.array(found["xy"])
    assert (xy >= -0.5).all()
    assert (xy < [found["width"], found["height"]]).all()
    drawn = client.get(f"{base}/overlay.svg")
    assert drawn.headers["content-type"].startswith("image/svg+xml")
    assert drawn.text.count("<circle") == len(xy)


def test_reports_are_in_a_sandbox(client: TestClient) -> None:
    results = client.get("/api/1/sessions/monday").json()["results"]
    report = next(each for each in results if each["name"] == "report.html")
    headers = client.get(f"/api/1/sessions/monday/results/{report['id']}/file").headers
    assert headers["content-security-policy"].startswith("sandbox;")
    assert "script" not in headers["content-security-policy"]
    assert headers["x-frame-options"] == "SAMEORIGIN"


def test_a_calibration_has_parameters_with_sigmas_correlations_and_findings(client: TestClient) -> None:
    row = client.get("/api/1/configurations/vidicon").json()["history"][0]
    found = client.get(f"/api/1/configurations/vidicon/decisions/{row['key']}").json()
    assert found["decision"]["session"] == "monday"
    c = next(each for each in found["parameters"] if each["name"] == "c")
    assert c["value"] == pytest.approx(57.5, abs=0.05)
    assert c["sigma"] > 0
    assert all(abs(each["correlation"]) <= 1 + 1e-9 for each in found["correlations"])
    assert len(found["correlations"]) == 6
    document = client.get(f"/api/1/configurations/vidicon/decisions/{row['key']}/calibration.json").text
    assert parse_calibration(document, where="answer").values()["c"] == c["value"]
    for figure in found["figures"]:
        svg = client.get(f"/api/1/configurations/vidicon/decisions/{row['key']}/figures/{figure}.svg")
        assert svg.text.startswith("<svg"), figure


def test_cameras_and_target_are_reported_in_space(client: TestClient) -> None:
    found = client.get("/api/1/sessions/monday/scene").json()
    assert [each["name"] for each in found["cameras"]] == ["frontal", "right", "down", "left"]
    assert len(found["points"]) == len(found["xyz"]) > 300
    frontal = found["cameras"][0]
    assert np.linalg.norm(frontal["position"]) == pytest.approx(5000, rel=0.01)  # mm
    # It looks at the middle of the target.
    toward = -np.array(frontal["position"]) / np.linalg.norm(frontal["position"])
    assert np.dot(frontal["axes"][2], toward) > 0.999
    assert "scene.js" in client.get("/sessions/monday").text
    assert client.get("/api/1/sessions/dropped/scene").status_code == 404


def test_any_two_calibrations_are_compared(client: TestClient) -> None:
    history = client.get(LEFT).json()["history"]
    two = {"first": f"left/{history[2]['key']}", "second": f"left/{history[1]['key']}"}
    found = client.get("/api/1/comparisons", params=two).json()
    assert found["unit"] == "px"
    # c changes by about 2e-3 mm of 8 mm: at the corner of the image, 400 px from its centre, by 0.1 px.
    assert found["greatest"] == pytest.approx(0.1, abs=0.02)
    assert found["p"] < 1e-6
    assert client.get("/api/1/comparisons/figure.svg", params=two).text.startswith("<svg")
    key = client.get("/api/1/configurations/vidicon").json()["history"][0]["key"]
    # The session, and the decision on its calibration: the same calibration.
    same = {"first": "monday", "second": f"vidicon/{key}"}
    assert client.get("/api/1/comparisons", params=same).json()["greatest"] == pytest.approx(0.0, abs=1e-9)
    for wrong in ("left/ffff", "nowhere/ffff", "tuesday"):
        assert client.get("/api/1/comparisons", params=two | {"first": wrong}).status_code == 404
    page = client.get("/compare", params=two).text
    assert "They differ by at most" in page
    assert page.count("selected") == 2
    assert "left: " in client.get("/compare").text


@pytest.mark.slow
def test_drift_is_charted_and_an_alarm_until_it_is_acknowledged(one: Served) -> None:
    client = one.client("operate")
    found = client.get(f"{LEFT}/drift").json()
    assert {each["parameter"] for each in found["signals"]} >= {"c"}
    assert client.get(f"{LEFT}/drift.svg").text.startswith("<svg")
    table = {key: {"temperature [°C]": 20.0 + k} for k, key in enumerate(found["calibrations"])}
    explained = client.post(f"{LEFT}/drift", json={"table": table})
    assert explained.status_code == 200, explained.text
    # What a sensor measured with the calibrations explains as much as a table of the same values.
    assert found["recorded"] == {"air.temperature": "°C"}
    table = {key: {"t [°C]": temperature(k)} for k, key in enumerate(found["calibrations"])}
    (by_table, by_sensor) = (
        client.post(f"{LEFT}/drift", json=given).json()["explained"]
        for given in ({"table": table}, {"recorded": ["air.temperature"]})
    )
    assert by_sensor == by_table != []
    for wrong in ({}, {"recorded": ["humidity"]}, {"recorded": ["air.temperature"], "table": table}):
        refused = client.post(f"{LEFT}/drift", json=wrong)
        assert (refused.status_code, refused.json()["error"]["code"]) == (422, "usage")
    assert "air.temperature [°C]" in client.get("/calibrations/left").text
    alarm = next(
        each for each in client.get("/api/1/alarms").json() if each["key"].startswith("drift left c")
    )
    assert client.post("/api/1/alarms/acknowledge", json={"keys": ["none"]}).status_code == 404
    assert client.post("/api/1/alarms/acknowledge", json={"keys": [alarm["key"]]}).status_code == 200
    assert alarm["key"] not in {each["key"] for each in client.get("/api/1/alarms").json()}
    seen = {each["key"]: each for each in client.get("/api/1/alarms", params={"all": True}).json()}
    assert seen[alarm["key"]]["acknowledged"] == "local"


def test_a_calibration_is_reviewed_returned_to_and_recorded(one: Served) -> None:
    client = one.client("administer")
    base = "/api/1/configurations/vidicon/decisions"
    key = client.get("/api/1/configurations/vidicon").json()["history"][0]["key"]
    assert client.post(f"{base}/{key}/return", json={}).status_code == 422
    reviewed = client.post(f"{base}/{key}/review", json={"outcome": "accepted", "comment": "first one"})
    assert reviewed.json()["outcome"] == "accepted"
    assert (
        client.post(f"{base}/{key}/review", json={"outcome": "accepted", "comment": "again"}).status_code
        == 422
    )
    assert client.get("/api/1/configurations/vidicon").json()["in_force"]["key"] == key
    older = client.get(LEFT).json()["history"][5]["key"]
    assert client.post(f"{LEFT}/decisions/{older}/return", json={"comment": "drift"}).status_code == 200
    with Archive.open(one.service.archive.place) as archive:
        applied = Configurations(archive).applied("left", datetime.now(UTC) + timedelta(seconds=1))
    assert applied is not None
    assert (applied.key, applied.why) == (older, "return")
    audit = client.get("/api/1/audit").json()
    assert [(each["action"], each["about"]) for each in audit[:1]] == [("return", f"left {older}")]
    assert "review failed" in {each["action"] for each in audit}
    assert client.get("/api/1/audit/state").json()["whole"]


def test_a_session_is_judged_by_rules_through_the_api(one: Served) -> None:
    client = one.client("administer")
    new = {"name": "judged", "parts": {"camera": "vidicon", "lens": "57 mm"}}
    assert client.post("/api/1/configurations", json=new).status_code == 201
    rules = {
        "schema": "reseau-acceptance/1",
        "version": 1,
        "image": {"warning": 0.2, "action": 0.5},
        "coverage": 0.3,
    }
    given = {"session": "monday", "rules": rules}
    made = client.post("/api/1/configurations/judged/decisions", json=given)
    assert (made.status_code, made.json()["outcome"], made.json()["session"]) == (
        201,
        "needs review",
        "monday",
    )
    # A comment is no proof of a session; the session is named and has the calibration.
    document = client.get(f"/api/1/configurations/judged/decisions/{made.json()['key']}/calibration.json")
    forged = document.json()
    forged["parameters"]["c"]["value"] = 99.0
    given = {"calibration": forged, "rules": rules, "comment": "session monday"}
    answer = client.post("/api/1/configurations/judged/decisions", json=given).json()
    assert (answer["session"], answer["comment"]) == (None, "session monday")
    pairs = [["judged", made.json()["key"]], ["judged", "ffff"]]
    bulk = client.post(
        "/api/1/reviews", json={"decisions": pairs, "outcome": "rejected", "comment": "a test"}
    )
    assert list(bulk.json()["failed"]) == ["judged ffff"]
    history = client.get("/api/1/configurations/judged").json()["history"]
    assert history[-1]["outcome"] == "rejected"
    wrong = client.post(
        "/api/1/configurations/judged/decisions", json={"session": "monday", "rules": {"a": 1}}
    )
    assert (wrong.status_code, wrong.json()["error"]["code"]) == (422, "input")
    event = client.post("/api/1/configurations/judged/events", json={"what": "lens changed"})
    assert event.status_code == 201


def test_a_calibration_has_the_name_that_somebody_gives_it(one: Served) -> None:
    client = one.client("administer")
    history = client.get(LEFT).json()["history"]
    unnamed, key = history[3]["name"], history[3]["key"]
    assert unnamed.endswith("2026 08:00 UTC")
    assert client.get("/api/1/configurations/vidicon").json()["history"][0]["name"] == "monday"
    named = client.post(f"{LEFT}/decisions/{key}/name", json={"name": "after the new lens"})
    assert named.json()["name"] == "after the new lens"
    assert client.get(f"{LEFT}/decisions/after the new lens").json()["decision"]["key"] == key
    # Names are no keys, whose calibration is asked for by programs.
    other = history[4]["key"]
    as_key = client.post(f"{LEFT}/decisions/{key}/name", json={"name": other})
    assert (as_key.status_code, as_key.json()["error"]["where"]) == (422, f"name '{other}'")
    taken = {"name": "after the new lens"}
    assert client.post(f"{LEFT}/decisions/{history[4]['key']}/name", json=taken).status_code == 422
    assert "after the new lens" in client.get("/calibrations/left").text
    assert one.client("operate").post(f"{LEFT}/decisions/{key}/name", json=taken).status_code == 403


_LAB = {"name": "Institute of Photogrammetry", "city": "Bonn", "country": "DE", "email": "lab@example.org"}
_CERTIFICATE = {
    "schema": "reseau-certificate-data/1", "laboratory": _LAB, "customer": _LAB,
    "item": {"name": "camera", "serial": "4711"}, "responsible": ["Ada Byron"],
}  # fmt: skip


def test_a_certificate_is_created_for_an_accepted_calibration(one: Served) -> None:
    pytest.importorskip("lxml")
    client = one.client("administer")
    history = client.get(LEFT).json()["history"]
    base = f"{LEFT}/decisions/{history[4]['key']}/certificate"
    made = client.post(base, json={"form": "html", "data": _CERTIFICATE})
    assert made.status_code == 200, made.text
    assert "4711" in made.text
    assert made.headers["content-disposition"].startswith("attachment")


def test_a_certificate_is_signed_with_the_key_of_the_service(
    one: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xmlsec")
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the key, is not installed")
    from reseau.service.certificates.signature import signatures

    key, pem = tmp_path / "signer.key", tmp_path / "signer.pem"
    given = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=signer"]
    openssl = ["openssl", "req", "-x509", *given, "-keyout", key, "-out", pem]
    subprocess.run(openssl, check=True, capture_output=True)
    options = replace(one.service.options, signing_key=key, signing_certificate=pem)
    monkeypatch.setattr(one.service, "options", options)
    client = one.client("administer")
    decision = client.get(LEFT).json()["history"][4]["key"]
    order = {"form": "xml", "data": _CERTIFICATE}
    made = client.post(f"{LEFT}/decisions/{decision}/certificate", json=order)
    assert made.status_code == 200, made.text
    (found,) = signatures(made.content, [pem])
    assert found[0] == "passed", found
    assert signatures(made.content.replace(b"4711", b"4712"), [pem])[0][0] == "failed"
    assert client.get("/api/1/audit").json()[0]["facts"] == {"form": "xml", "signed": True}


def test_pages_show_what_the_api_says(one: Served) -> None:
    client = one.client()
    left = client.get(LEFT).json()["history"]
    vidicon = client.get("/api/1/configurations/vidicon").json()["history"][0]["key"]
    pages = {
        "/": "monday", "/sessions": "monday", "/sessions/monday": "Rejected frames",
        "/sessions/monday/frames/2": "overlay.svg", "/calibrations": "DMK 33", "/calibrations/left": "drift",
        f"/calibrations/vidicon/{vidicon}": "57.", "/history": "c increases",
        "/account": "Tokens", "/audit": "whole",
        f"/compare?first=left/{left[1]['key']}&second=left/{left[2]['key']}": "significant",
    }  # fmt: skip
    for path, text in pages.items():
        answer = client.get(path)
        assert answer.status_code == 200, (path, answer.text)
        assert text in answer.text, path
        assert not re.search(
            r"<script(?![^>]*\bsrc=)|\bstyle=|<style|\bon[a-z]+=|javascript:", answer.text
        ), path
    assert client.get("/sessions/nothing").status_code == 404
    assert client.get("/sessions/nothing").headers["content-type"].startswith("text/html")


def test_names_are_escaped_in_pages(one: Served) -> None:
    with Archive.open(one.service.archive.place) as archive:
        archive.begin("<img src=x onerror=alert(1)>", "frames", {"count": 1})
    text = one.client().get("/sessions").text
    assert "<img src=x" not in text
    assert "&lt;img" in text
    path = re.search(r'href="(/sessions/%3Cimg[^"]*)"', text)
    assert path is not None
    assert one.client().get(path[1]).status_code == 200


def test_no_path_from_outside_reaches_the_file_system(client: TestClient) -> None:
    for path in ("..%2f..%2fetc%2fpasswd", "%2e%2e/%2e%2e/etc/passwd", "....//etc/passwd", "index.sqlite"):
        assert client.get(f"/static/{path}").status_code == 404
        assert client.get(f"/api/1/sessions/monday/inputs/{path}/file").status_code == 404


def test_events_tell_what_another_process_stores_and_are_resumed(one: Served) -> None:
    service = one.service
    before = f"{service.events.start}-{service.events.publish('test', 'mark').number}"
    with Archive.open(service.archive.place) as archive:
        archive.begin(f"session {time.time_ns()}", "frames", {"count": 1})
    end = time.monotonic() + 10
    while not any(e.about == "sessions" for e in service.events.after(before)[0]):
        assert time.monotonic() < end
        time.sleep(0.02)
    found, complete = service.events.after(before)
    assert complete
    assert [each.number for each in found] == sorted({each.number for each in found})
    assert service.events.after("other-1") == ([], False)


def test_events_published_at_the_same_time_arrive_once_and_in_their_order() -> None:
    events, count = Events(), 100

    async def read() -> list[str]:
        stream, found = events.stream("", lambda: True), list[str]()
        assert "retry" in await anext(stream)
        found.append(await anext(stream))
        threads = [threading.Thread(target=publish) for _ in range(8)]
        for each in threads:
            each.start()
        while len(found) < 8 * count + 1:
            found.append(await anext(stream))
        await asyncio.to_thread(lambda: [each.join() for each in threads])
        await stream.aclose()  # type: ignore[attr-defined]
        return found

    def publish() -> None:
        for _ in range(count):
            events.publish("test", "order")

    numbers = [int(re.findall(r"id: \w+-(\d+)", text)[0]) for text in asyncio.run(read())]
    assert numbers == list(range(8 * count + 1))


@pytest.mark.slow
def test_answers_do_not_wait_for_acknowledgements_of_tcp(tmp_path: Path) -> None:
    with process(tmp_path) as (address, token, _), httpx.Client(base_url=address) as http:
        headers = {"Authorization": f"Bearer {token}"}
        for _ in range(3):
            http.get("/api/1/me", headers=headers)
        times = []
        for _ in range(15):
            begun = time.monotonic()
            http.get("/api/1/me", headers=headers).raise_for_status()
            times.append(time.monotonic() - begun)
        # Head and body are two packets: without TCP_NODELAY each answer takes 40 ms.
        assert min(times) < 0.035


def test_the_overview_of_10_000_sessions_takes_less_than_a_second(tmp_path: Path) -> None:
    from reseau.archive import schema

    with served(tmp_path) as found:
        engine = found.service.archive._engine
        at = datetime(2026, 3, 2, tzinfo=UTC)
        with engine.begin() as connection:
            row = {"plan": "frames", "parameters": {}, "bench": "", "software": "reseau", "begun": at}
            connection.execute(
                sa.insert(schema.sessions), [{"name": f"session {k}", **row} for k in range(10_000)]
            )
            ends = [{"session_id": k + 1, "status": "done", "why": "", "at": at} for k in range(10_000)]
            connection.execute(sa.insert(schema.ends), ends)
        client = found.client()
        client.get("/")
        begun = time.process_time()
        for path in ("/", "/sessions", "/sessions?before=session 5000"):
            assert "session " in client.get(path).text
        assert (time.process_time() - begun) / 3 < 0.1
