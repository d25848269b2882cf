"""The description of the API is true: schemathesis sends what it allows, and what it does not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from .populated import populate
from .served import PASSWORD, process

pytestmark = pytest.mark.slow

_CONFIG = """[parameters]
"path.bench" = "cellar"
"path.session" = "monday"
"path.name" = "left"
"""
_CHECKS = ("not_a_server_error", "status_code_conformance", "content_type_conformance",
           "response_schema_conformance")  # fmt: skip


def _program() -> str:
    beside = Path(sys.executable).with_name("schemathesis")
    found = str(beside) if beside.is_file() else shutil.which("schemathesis")
    found = os.environ.get("RESEAU_SCHEMATHESIS", found or "")
    if not found:
        pytest.skip("needs schemathesis (pip install schemathesis, or RESEAU_SCHEMATHESIS)")
    return found


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_schemathesis_finds_no_error_of_the_server_and_nothing_undocumented(tmp_path: Path) -> None:
    program = _program()
    populate(tmp_path)
    (tmp_path / "bench.toml").write_text('schema = "reseau-bench/1"\nname = "cellar"\n[instruments]\n')
    (tmp_path / "schemathesis.toml").write_text(_CONFIG)
    add = [sys.executable, "-c", "from reseau.cli import main; main()", "service", "user", "add", "Ada"]
    subprocess.run([*add, "--scope", "administer"], cwd=tmp_path, input=PASSWORD, text=True, check=True)
    with process(tmp_path, "--bench", "bench.toml") as (address, token, _), httpx.Client() as http:
        given = {"name": "Ada", "password": PASSWORD}
        login = http.post(f"{address}/api/1/login", json=given, headers={"Origin": address})
        cookie = "; ".join(f"{name}={value}" for name, value in login.cookies.items())
        csrf = http.get(f"{address}/api/1/me", headers={"Cookie": cookie}).json()["csrf"]
        # What ends a login is tried last, by a browser; streams, which do not end, by their own test.
        mine = ("me/password", "me/one-time", "me/one-time/confirm", "logout")
        own = [f"--include-path=/api/1/{each}" for each in mine]
        others = ["--exclude-path-regex=^/api/1/(events|documents|logout|me/.*)$"]
        browser = ["-H", f"Cookie: {cookie}", "-H", f"X-CSRF-Token: {csrf}"]
        for options in ([*others, "-H", f"Authorization: Bearer {token}"], [*own, *browser]):
            command = [program, "--config-file", "schemathesis.toml", "run", f"{address}/api/1/openapi.json"]
            command += ["--max-examples", os.environ.get("RESEAU_EXAMPLES", "5"), "--request-timeout", "60"]
            command += [f"--checks={','.join(_CHECKS)}", *options]
            done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stdout[-6000:]
            assert "passed" in done.stdout


def test_the_stream_of_events_answers_as_it_is_described(tmp_path: Path) -> None:
    with process(tmp_path) as (address, token, _), httpx.Client(timeout=20) as http:
        mine = {"Authorization": f"Bearer {token}"}
        documented = http.get(f"{address}/api/1/openapi.json", headers=mine).json()
        statuses = set(documented["paths"]["/api/1/documents"]["get"]["responses"])
        for last in ("", "x", "0", "-1", "9" * 19, "9" * 40, "9" * 41):
            headers = mine | {"Last-Event-ID": last}
            with http.stream("GET", f"{address}/api/1/documents", headers=headers) as answer:
                assert str(answer.status_code) in statuses
                assert answer.status_code == (422 if len(last) > 40 else 200)
        path = f"{address}/api/1/events"
        statuses = set(documented["paths"]["/api/1/events"]["get"]["responses"])
        for last in ("", "x", "0-0", "-", "a-999999999999999999999", "\x80", "9" * 40, "9" * 41):
            for given in ({"headers": {"Last-Event-ID": last.encode("latin-1")}}, {"params": {"last": last}}):
                headers = mine | given.pop("headers", {})
                with http.stream("GET", path, headers=headers, **given) as answer:
                    assert str(answer.status_code) in statuses
                    assert answer.status_code == (422 if len(last) > 40 else 200)
                    if answer.status_code == 200:
                        assert answer.headers["content-type"].startswith("text/event-stream")
                        assert next(answer.iter_lines()) == "retry: 1000"
