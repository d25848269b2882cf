"""The service trusts neither names, origins, cookies nor passwords: what is refused, and what is not."""

from __future__ import annotations

import hashlib
import re
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect

from reseau.core.errors import ArchiveError, UsageError
from reseau.service.accounts import Accounts, one_time_code
from reseau.service.http import app, guard
from reseau.service.http.app import create_app
from reseau.service.http.options import ServeOptions
from reseau.service.http.service import Service
from reseau.service.state import StateFolder

from .served import ORIGIN, PASSWORD, Served, served

NOW = datetime(2026, 3, 2, 8, 0, tzinfo=UTC)


class Clock:
    def __init__(self) -> None:
        self.now = NOW

    def __call__(self) -> datetime:
        return self.now


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("served")) as found:
        found.service.accounts.add_user("Ada", PASSWORD, "administer")
        found.service.accounts.add_user("Bob", PASSWORD, "read")
        yield found


@pytest.fixture
def accounts(tmp_path: Path) -> Iterator[tuple[Accounts, Clock]]:
    clock = Clock()
    with Accounts(tmp_path / "accounts.sqlite", clock) as found:
        found.add_user("Ada", PASSWORD, "operate")
        yield found, clock


@pytest.mark.parametrize(
    "host", ["evil.example:8480", "127.0.0.1.evil.example:8480", "127.0.0.1", "127.0.0.1:80"]
)
def test_a_request_for_another_name_is_refused(one: Served, host: str) -> None:
    for path in ("/", "/api/1/health/live", "/api/1/events", "/static/app.js"):
        answer = one.client().get(path, headers={"Host": host})
        assert answer.status_code == 403
        assert "name" in answer.json()["error"]["text"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:9999"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"},
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "cors"},
    ],
)
def test_a_request_of_a_foreign_page_is_refused(one: Served, headers: dict[str, str]) -> None:
    assert one.client().get("/api/1/me", headers=headers).status_code == 403
    assert one.client().get("/api/1/events", headers=headers).status_code == 403


def test_a_link_on_a_foreign_page_may_lead_to_a_page_but_do_nothing(one: Served) -> None:
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    browser = one.browser("Ada")
    assert browser.get("/", headers=link).status_code == 200
    assert browser.post("/api/1/logout", headers=link).status_code == 403


def test_websockets_are_not_offered(one: Served) -> None:
    with pytest.raises(WebSocketDisconnect) as closed, one.client().websocket_connect("/api/1/events"):
        pass
    assert closed.value.code == 1008


def test_every_answer_has_a_strict_policy(one: Served) -> None:
    for path in ("/", "/login", "/api/1/me", "/nowhere", "/static/app.js"):
        headers = one.client("").get(path).headers
        policy = headers["content-security-policy"]
        assert "unsafe" not in policy
        assert policy.startswith("default-src 'none'")
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert "server" not in headers


def test_pages_have_no_inline_script_or_style_and_nothing_from_outside(one: Served) -> None:
    browser = one.browser("Ada")
    for path in ("/", "/account", "/audit", "/login", "/nowhere"):
        text = browser.get(path).text
        assert not re.search(r"<script(?![^>]*\bsrc=)|\bstyle=|<style|\bon[a-z]+=|javascript:", text), path
        assert not re.findall(r'(?:src|href)="(?!/|#)', text), path


def test_without_a_token_the_api_refuses_and_pages_lead_to_the_login(one: Served) -> None:
    answer = one.client("").get("/api/1/me")
    assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
    page = one.client("").get("/account")
    assert (page.status_code, page.headers["location"]) == (303, "/login?next=/account")


@pytest.mark.parametrize("value", ["Bearer ", "Bearer x", "Basic QWRhOng=", "Bearer é".encode("latin-1")])
def test_a_wrong_token_is_refused(one: Served, value: Any) -> None:
    assert one.client("").get("/api/1/me", headers={"Authorization": value}).status_code == 401


def test_a_token_does_what_its_scope_allows(one: Served) -> None:
    for scope, status in (("read", 403), ("operate", 403), ("administer", 200)):
        client = one.client(scope)
        assert client.get("/api/1/me").json()["scope"] == scope
        assert client.get("/api/1/users").status_code == status


def test_a_login_needs_the_origin_and_changes_need_the_csrf_token(one: Served) -> None:
    given = {"name": "Ada", "password": PASSWORD}
    assert one.client("").post("/api/1/login", json=given).status_code == 403
    browser = one.browser("Ada")
    cookie = next(iter(browser.cookies.jar))
    assert cookie.has_nonstandard_attr("HttpOnly")
    assert cookie.get_nonstandard_attr("SameSite") == "strict"
    assert browser.post("/api/1/logout").status_code == 403
    assert browser.post("/api/1/logout", headers={"X-CSRF-Token": "0" * 64}).status_code == 403
    csrf = browser.get("/api/1/me").json()["csrf"]
    other = one.browser("Bob")
    assert other.post("/api/1/logout", headers={"X-CSRF-Token": csrf}).status_code == 403
    assert browser.post("/api/1/logout", headers={"X-CSRF-Token": csrf}).status_code == 200
    assert browser.get("/api/1/me").status_code == 401


def test_a_user_without_the_scope_may_not_administer(one: Served) -> None:
    browser = one.browser("Bob")
    csrf = browser.get("/api/1/me").json()["csrf"]
    new = {"name": "Eve", "password": PASSWORD, "scope": "administer"}
    answer = browser.post("/api/1/users", json=new, headers={"X-CSRF-Token": csrf})
    assert (answer.status_code, answer.json()["error"]["code"]) == (403, "forbidden")


def test_the_login_leads_only_to_pages_of_ours(one: Served) -> None:
    for given in ("//evil.example", "https://evil.example", "/\\evil.example"):
        assert "evil" not in one.client("").get("/login", params={"next": given}).text


def test_an_entry_code_lets_one_browser_in_once(one: Served) -> None:
    path = one.client().post("/api/1/entries").json()["path"]
    first = one.client("").get(path)
    assert (first.status_code, first.headers["location"]) == (303, "/")
    assert one.client("").get(path).headers["location"].startswith("/login")
    assert one.client("administer").post("/api/1/entries").status_code == 403


def test_a_large_request_is_refused(one: Served) -> None:
    def pieces() -> Iterator[bytes]:
        for _ in range(20):
            yield b"x" * 100_000

    assert one.client().post("/api/1/tokens", content=b"x" * 2_000_000).status_code == 413
    assert one.client().post("/api/1/tokens", content=pieces()).status_code == 413


def test_the_body_of_a_request_is_not_read_for_nobody(one: Served) -> None:
    read = 0

    def pieces() -> Iterator[bytes]:
        nonlocal read
        for _ in range(100):
            read += 1
            yield b"x" * 100_000

    answer = one.client("").post("/api/1/uploads", content=pieces())
    assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
    assert read == 0
    assert one.client("").post("/api/1/login", content=b"x" * 20_000).status_code == 413


@pytest.mark.slow
def test_requests_that_arrive_too_slowly_and_connections_without_any_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "_HEAD_S", 0.5)
    monkeypatch.setattr(app, "_MOST_WAITING", 5)
    monkeypatch.setattr(guard, "_BODY_S", 0.5)
    found: list[bytes] = []
    with served(tmp_path) as one, running(one) as port:
        token = one.service.state.local_token()
        head = f"Host: 127.0.0.1:{port}\r\nAuthorization: Bearer {token}\r\n"
        slow_head = b"GET /api/1/me HTTP/1.1\r\n"
        slow_body = f"POST /api/1/tokens HTTP/1.1\r\n{head}Content-Length: 50\r\n\r\n{{".encode()
        for sent in (b"", slow_head, slow_body):
            begun = time.monotonic()
            with socket.create_connection(("127.0.0.1", port)) as each:
                each.sendall(sent)
                found.append(each.recv(1000) if sent is slow_body else refused(each))
            assert time.monotonic() - begun < 8
        assert found[:2] == [b"", b""]
        assert b"arrives too slowly" in found[2] or found[2].startswith(b"HTTP/1.1 400")
        # Whoever opens many connections closes the own ones, and not those of others.
        held = [socket.create_connection(("127.0.0.1", port)) for _ in range(40)]
        with socket.create_connection(("127.0.0.1", port)) as each:
            each.sendall(f"GET /api/1/me HTTP/1.1\r\n{head}\r\n".encode())
            assert each.recv(100).startswith(b"HTTP/1.1 200")
        for each in held:
            each.close()


def test_connections_whose_answers_are_not_read_are_closed_and_keep_nobody_from_being_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "_MOST_WAITING", 5)
    with served(tmp_path) as one, running(one) as port:
        asked = f"GET /login HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
        held = []
        for _ in range(40):
            held.append(socket.create_connection(("127.0.0.1", port)))
            held[-1].sendall(asked)
            assert select.select([held[-1]], [], [], 60)[0], "is neither answered nor closed"
        with socket.create_connection(("127.0.0.1", port)) as each:
            each.sendall(asked)
            assert each.recv(100).startswith(b"HTTP/1.1 200")
            assert sum(not ended(other) for other in held) <= 6
        for each in held:
            each.close()


def ended(connection: socket.socket) -> bool:
    """Whether the service has ended a connection, after what is read before its end."""
    connection.settimeout(0.5)
    try:
        while connection.recv(65536):
            pass
    except TimeoutError:
        return False
    except ConnectionResetError:
        pass
    return True


def refused(connection: socket.socket) -> bytes:
    """What arrives before the end of a connection."""
    try:
        return connection.recv(1000)
    except ConnectionResetError:
        return b""


@contextmanager
def running(one: Served) -> Iterator[int]:
    """The service behind a socket, in a thread."""
    import uvicorn

    with socket.create_server(("127.0.0.1", 0)) as sock:
        port = sock.getsockname()[1]
        object.__setattr__(one.service.options, "port", port)
        config = uvicorn.Config(
            create_app(one.service), http=app.PatientProtocol, log_config=None, lifespan="off",
            timeout_keep_alive=300,
        )  # fmt: skip
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [sock]}, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.02)
        yield port
        server.should_exit = True
        thread.join(10)


def test_no_secret_is_in_log_archive_or_audit(one: Served, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "reseau.service"):
        made = one.client().post("/api/1/tokens", json={"name": "secretly", "scope": "read"}).json()["secret"]
        one.client("").get("/api/1/me", headers={"Authorization": f"Bearer {made}"})
        one.client("").get("/enter", params={"code": "a-code"})
    files = [path for path in Path(one.service.archive.place).rglob("*") if path.is_file()]
    texts = [caplog.text.encode(), *(path.read_bytes() for path in files)]
    for secret in (made, PASSWORD, "a-code", one.service.state.local_token()):
        assert not any(secret.encode() in text for text in texts)
    accounts = one.service.state.path("accounts.sqlite").read_bytes()
    assert made.encode() not in accounts
    assert PASSWORD.encode() not in accounts


def test_passwords_are_hashed_with_argon2id_and_19_mib_at_least(tmp_path: Path) -> None:
    import sqlite3

    import argon2

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(argon2, "PasswordHasher", argon2._password_hasher.PasswordHasher)
        with Accounts(tmp_path / "accounts.sqlite") as found:
            found.add_user("Ada", PASSWORD, "read")
    with sqlite3.connect(tmp_path / "accounts.sqlite") as raw:
        kept = raw.execute("SELECT password FROM users").fetchone()[0]
    raw.close()
    assert kept.startswith("$argon2id$")
    assert argon2.extract_parameters(kept).memory_cost >= 19 * 1024


@pytest.mark.parametrize(
    ("seconds", "digits"),
    [
        (59, "287082"),
        (1111111109, "081804"),
        (1111111111, "050471"),
        (1234567890, "005924"),
        (2000000000, "279037"),
    ],
)
def test_one_time_passwords_are_those_of_rfc_6238(seconds: int, digits: str) -> None:
    assert one_time_code("GEZDGNBVGY3TQOJQGEZDGNBVGY3TQOJQ", seconds // 30) == digits


def test_a_login_ends_when_idle_when_old_and_when_the_clock_is_set_back(
    accounts: tuple[Accounts, Clock],
) -> None:
    found, clock = accounts
    for later in (timedelta(hours=2, minutes=1), timedelta(hours=-1)):
        cookie = found.log_in("Ada", PASSWORD)
        clock.now += later
        assert found.of_cookie(cookie) is None
        clock.now -= later
        assert found.of_cookie(cookie) is None
    cookie = found.log_in("Ada", PASSWORD)
    for _ in range(11):
        clock.now += timedelta(hours=1)
        assert found.of_cookie(cookie) is not None
    clock.now += timedelta(hours=1)
    assert found.of_cookie(cookie) is None


def test_other_addresses_need_tls_and_users(tmp_path: Path) -> None:
    archive = str(tmp_path / "archive")
    with pytest.raises(UsageError, match="without TLS"):
        ServeOptions(archive, host="0.0.0.0")
    options = ServeOptions(archive, host="0.0.0.0", proxy="https://bench.example.org")
    with pytest.raises(UsageError, match="reseau service user add"):
        Service(options)
    with Accounts(StateFolder.beside(archive).path("accounts.sqlite")) as accounts:
        accounts.add_user("Ada", PASSWORD, "administer")
    with Service(options) as service:
        found = Served(service)
        browser = found.client("")
        assert browser.get("/login").status_code == 403  # only the public name
        public = {"Host": "bench.example.org"}
        assert "max-age" in browser.get("/login", headers=public).headers["strict-transport-security"]
        local = {"Authorization": f"Bearer {service.state.local_token()}", **public}
        assert browser.get("/api/1/me", headers=local).status_code == 401


def test_accounts_of_an_earlier_version_need_an_upgrade(tmp_path: Path) -> None:
    import sqlite3

    place = tmp_path / "accounts.sqlite"
    with sqlite3.connect(place) as raw:
        raw.execute("CREATE TABLE users (name TEXT PRIMARY KEY, password TEXT NOT NULL, scope TEXT NOT NULL,"
                    " secret TEXT, created DATETIME NOT NULL)")  # fmt: skip
        raw.execute("CREATE TABLE tokens (name TEXT PRIMARY KEY, hash TEXT NOT NULL, scope TEXT NOT NULL,"
                    " made_by TEXT NOT NULL, created DATETIME NOT NULL, expires DATETIME NOT NULL,"
                    " revoked DATETIME)")  # fmt: skip
        for name in ("console", "Gone"):
            raw.execute("INSERT INTO tokens VALUES (?, ?, 'read', ?, '2026-03-02', '2100-01-01', NULL)",
                        (name, hashlib.sha256(name.encode()).hexdigest(), name))  # fmt: skip
        raw.execute("CREATE TABLE failures (id INTEGER PRIMARY KEY, who TEXT, at DATETIME)")
    raw.close()
    with pytest.raises(ArchiveError, match="reseau service upgrade"):
        Accounts(place)
    with Accounts(place, upgrade=True) as found:
        assert found.upgraded_from == 1
        found.add_user("Ada", PASSWORD, "read")
        found.require_code("Ada")
        assert found.of_token("console") is not None
        assert found.of_token("Gone") is None  # whose it was is no user
    with Accounts(place) as found:
        assert found.upgraded_from is None


def test_a_state_folder_that_others_can_read_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    folder.mkdir(mode=0o755)
    with pytest.raises(UsageError, match="chmod 700"):
        StateFolder(folder)


def test_the_origin_of_the_page_is_accepted(one: Served) -> None:
    assert one.client().get("/api/1/me", headers={"Origin": ORIGIN}).status_code == 200
