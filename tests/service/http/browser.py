"""Chromium, driven over WebDriver (W3C) without a library; tests that need it are skipped without it."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

_ELEMENT = "element-6066-11e4-a52e-4f735466cecf"


class Browser:
    """One window."""

    def __init__(self, address: str, session: str) -> None:
        self._url = f"{address}/session/{session}"
        self._http = httpx.Client(timeout=300)

    def command(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        answer = self._http.request(method, self._url + path, json=body if method == "POST" else None)
        value = answer.json()["value"]
        assert answer.status_code == 200, value
        return value

    def open(self, url: str) -> None:
        self.command("POST", "/url", {"url": url})

    @property
    def url(self) -> str:
        return str(self.command("GET", "/url"))

    def run(self, script: str, *arguments: Any) -> Any:
        return self.command("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def run_async(self, script: str) -> Any:
        return self.command("POST", "/execute/async", {"script": script, "args": []})

    def find(self, css: str) -> str:
        return str(self.command("POST", "/element", {"using": "css selector", "value": css})[_ELEMENT])

    def click(self, css: str) -> None:
        self.command("POST", f"/element/{self.find(css)}/click", {})

    def fill(self, css: str, text: str) -> None:
        element = self.find(css)
        self.command("POST", f"/element/{element}/clear", {})
        self.command("POST", f"/element/{element}/value", {"text": text})

    def accept(self) -> None:
        self.command("POST", "/alert/accept", {})

    def text(self, css: str = "main") -> str:
        return str(self.run("return document.querySelector(arguments[0])?.innerText ?? ''", css))

    def until(self, text: str, css: str = "main", seconds: float = 240.0) -> str:
        end = time.monotonic() + seconds
        while text not in (found := self.text(css)):
            assert time.monotonic() < end, f"{text!r} is not in: {found[:2000]}"
            time.sleep(0.1)
        return found

    def resize(self, width: int, height: int) -> None:
        # Headless windows have a least width; the viewport has none.
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        body = {"cmd": "Emulation.setDeviceMetricsOverride", "params": metrics}
        self.command("POST", "/goog/cdp/execute", body)

    def prefer(self, theme: str) -> None:
        """Let the reader prefer a `light` or a `dark` page; with an empty text, none."""
        params = {"features": [{"name": "prefers-color-scheme", "value": theme}]}
        body = {"cmd": "Emulation.setEmulatedMedia", "params": params}
        self.command("POST", "/goog/cdp/execute", body)

    def screenshot(self, path: Path, whole: bool = True) -> None:
        if whole:
            size = self.run("return [innerWidth, Math.min(document.documentElement.scrollHeight, 4000)]")
            params = {
                "captureBeyondViewport": True,
                "clip": {"x": 0, "y": 0, "width": size[0], "height": size[1], "scale": 1},
            }
            found = self.command(
                "POST", "/goog/cdp/execute", {"cmd": "Page.captureScreenshot", "params": params}
            )
            path.write_bytes(base64.b64decode(found["data"]))
        else:
            path.write_bytes(base64.b64decode(self.command("GET", "/screenshot")))

    def complaints(self) -> list[str]:
        """What the console says: errors, and violations of the policy."""
        found = self.command("POST", "/se/log", {"type": "browser"})
        return [each["message"] for each in found if each["level"] == "SEVERE"]


@contextmanager
def chromium() -> Iterator[Browser]:
    driver, program = shutil.which("chromedriver"), shutil.which("chromium")
    if driver is None or program is None:
        pytest.skip("needs chromium and chromedriver (apt-get install chromium chromium-driver)")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    running = subprocess.Popen(
        [driver, f"--port={port}", "--allowed-ips=127.0.0.1"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(2000):
            try:
                if httpx.get(f"{address}/status").json()["value"]["ready"]:
                    break
            except httpx.HTTPError:
                time.sleep(0.05)
        options = {
            "binary": program,
            "args": [
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
                "--window-size=1280,900",
            ],
        }
        wanted = {
            "capabilities": {
                "alwaysMatch": {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
            }
        }
        made = httpx.post(f"{address}/session", content=json.dumps(wanted), timeout=300).json()["value"]
        assert "sessionId" in made, made
        browser = Browser(address, made["sessionId"])
        try:
            yield browser
        finally:
            browser.command("DELETE", "")
            browser._http.close()
    finally:
        running.terminate()
        running.wait(20)
