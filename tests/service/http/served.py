"""A service in this process, asked without a network; and one in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

with warnings.catch_warnings():  # of the name of another package of the same library
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient

from reseau.service.http.app import create_app
from reseau.service.http.options import ServeOptions
from reseau.service.http.service import Service

ORIGIN = "http://127.0.0.1:8480"
PASSWORD = "correct horse battery"


class Served:
    """A service, and clients of it."""

    def __init__(self, service: Service) -> None:
        self.service, self.app = service, create_app(service)

    def client(self, scope: str | None = None) -> TestClient:
        """A client with a token of this scope, the local one, or none (empty)."""
        headers = {}
        if scope is None:
            headers["Authorization"] = f"Bearer {self.service.state.local_token()}"
        elif scope:
            from datetime import timedelta

            name = f"{scope} {len(self.service.accounts.tokens())}"
            made = self.service.accounts.create_token(name, scope, timedelta(days=1))  # type: ignore[arg-type]
            headers["Authorization"] = f"Bearer {made}"
        return TestClient(
            self.app, ORIGIN, raise_server_exceptions=False, follow_redirects=False, headers=headers,
            client=("127.0.0.1", 50000),
        )  # fmt: skip

    def browser(self, name: str, password: str = PASSWORD) -> TestClient:
        """A browser in which somebody has logged in."""
        browser = self.client("")
        answer = browser.post(
            "/api/1/login", json={"name": name, "password": password}, headers={"Origin": ORIGIN}
        )
        assert answer.status_code == 200, answer.text
        return browser


@contextmanager
def served(folder: Path, **options: Any) -> Iterator[Served]:
    with Service(ServeOptions(str(folder / "archive"), **options)) as service:
        yield Served(service)


@contextmanager
def process(folder: Path, *arguments: str) -> Iterator[tuple[str, str, subprocess.Popen[str]]]:
    """`reseau serve` in a process: address, local token, and the process."""
    errors = (folder / "serve.log").open("a+")
    begun = errors.tell()
    running = subprocess.Popen(
        [sys.executable, "-c", "from reseau.cli import main; main()", "serve", "--port", "0", *arguments],
        cwd=folder, stderr=errors, text=True,
    )  # fmt: skip
    try:
        end = time.monotonic() + 300  # a second or two, unless others take the processors
        while True:
            text = (folder / "serve.log").read_text()[begun:]
            found = [line for line in text.splitlines() if line.endswith("(Ctrl-C ends)")]
            if found and "reseau service link" in text:
                break
            assert running.poll() is None, text
            assert time.monotonic() < end, text
            time.sleep(0.02)
        address = found[0].partition("/  (")[0]
        token = folder / "archive-service" / "local-token"
        yield address, token.read_text().strip(), running
    finally:
        running.terminate()
        running.wait(20)
        errors.close()
