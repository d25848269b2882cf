"""People at the pages: Chromium drives the service in its own process, over a simulated bench.

`RESEAU_AXE` names axe.min.js of axe-core, whose findings are asked for then; `RESEAU_SCREENSHOTS` a folder
for pictures of the pages. Run with `python -m pytest -m slow tests/service/http/test_browser.py`.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import httpx
import pytest

from reseau.archive import Archive
from reseau_sims.serving.bench import SimulatedBench

from ...capture.fieldrig import DESIGN
from .browser import Browser, chromium
from .driver import bench_of, install
from .populated import FIELD_RULES, PARAMETERS
from .test_benches import ROOT, until

pytestmark = pytest.mark.slow


class Place:
    """A folder with an archive, a bench and a service in a process."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder, self.environment, self.port = folder, environment, 0
        self.running: subprocess.Popen[str] | None = None

    def start(self) -> str:
        """Start the service; return the address that lets a browser in."""
        log = (self.folder / "serve.log").open("a")
        before = (self.folder / "serve.log").stat().st_size
        command = [
            sys.executable,
            "-c",
            "from reseau.cli import main; main()",
            "serve",
            "--bench",
            "bench.toml",
        ]
        self.running = subprocess.Popen(
            [*command, "--port", str(self.port)], cwd=self.folder, env=self.environment, stderr=log, text=True
        )
        log.close()

        def opened() -> str:
            assert self.running is not None
            assert self.running.poll() is None
            text = (self.folder / "serve.log").read_text()[before:]
            ready = "reseau service link" in text
            return next((line for line in text.splitlines() if line.endswith("(Ctrl-C ends)") and ready), "")

        address: str = until(opened)
        self.port = int(address.partition("/  (")[0].rpartition(":")[2])
        return self.link()

    def link(self) -> str:
        """An address that lets a browser in."""
        program = [sys.executable, "-c", "from reseau.cli import main; main()"]
        done = subprocess.run(
            [*program, "service", "link", "--port", str(self.port)], cwd=self.folder, env=self.environment,
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return done.stdout.strip()

    def kill(self) -> None:
        assert self.running is not None
        self.running.send_signal(signal.SIGKILL)
        self.running.wait(10)

    def end(self) -> None:
        if self.running is not None and self.running.poll() is None:
            self.running.terminate()
            self.running.wait(20)


@pytest.fixture(scope="module")
def place(archived: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("browser")
    shutil.copytree(archived, folder, dirs_exist_ok=True)
    install(folder / "drivers")
    paths = [str(folder / "drivers"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(folder)}
    (folder / "field.json").write_text(DESIGN.to_json())
    (folder / "design.json").write_text(DESIGN.to_json())
    with Archive.open(folder / "archive") as archive:
        session = archive.session("monday")
        for each in session.frames(kind="frame"):
            if each.verdict is not None and each.verdict.ok:
                cv2.imwrite(str(folder / f"{each.step}.png"), session.picture(each).pixels)
    with SimulatedBench(seed=3) as sim:
        (folder / "bench.toml").write_text(bench_of(sim.toml))
        made = Place(folder, environment)
        yield made
        made.end()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


def shot(browser: Browser, name: str) -> None:
    """Keep a picture of the page for the documentation: its upper part, that of a desk at half its size."""
    folder = os.environ.get("RESEAU_SCREENSHOTS")
    if folder:
        path = Path(folder) / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        browser.screenshot(path)
        picture = cv2.imread(str(path))
        assert picture is not None
        wide = picture.shape[1] > 500
        picture = picture[: 2200 if wide else 1300]
        if wide:
            picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def axe(browser: Browser) -> list[str]:
    """Serious findings of axe-core on the page; none are looked for without it."""
    file = os.environ.get("RESEAU_AXE")
    if not file:
        return []
    browser.run(Path(file).read_text())
    found = browser.run_async(_AXE)
    serious = [each for each in found if each["impact"] in ("serious", "critical")]
    return [f"{each['id']}: {[n['html'][:120] for n in each['nodes'][:3]]}" for each in serious]


_AXE = """
const back = arguments[arguments.length - 1];
axe.run(document, {iframes: false}).then(
  r => back(r.violations), e => back([{id: String(e), impact: 'critical', nodes: []}]));
"""


def chosen(browser: Browser, css: str, *paths: Path) -> None:
    element = browser.find(css)
    browser.command("POST", f"/element/{element}/value", {"text": "\n".join(str(path) for path in paths)})


def written(browser: Browser, css: str, text: str) -> None:
    browser.run("document.querySelector(arguments[0]).value = arguments[1]", css, text)


def test_from_the_first_start_to_a_roll_back(place: Place, browser: Browser) -> None:
    begun = time.monotonic()
    entry = place.start()
    assert time.monotonic() - begun < 60  # on a loaded machine; alone under 3 s
    base = entry.partition("/enter")[0]
    browser.open(f"{base}/sessions")
    browser.until("Log in")
    browser.open(entry)
    browser.until("Overview")
    shot(browser, "service-overview")

    # The bench: live picture, jog, stop.
    browser.open(f"{base}/benches/cellar")
    browser.until("ready")
    browser.until("sharpest edges", seconds=60)
    for axis in ("tilt", "roll", "camera_roll"):
        browser.click(f'button[aria-label="Home {axis}"]')
        until(lambda: "done" in browser.text("#message") or browser.text("#message"))
        time.sleep(0.5)
    browser.until("tilt")
    browser.click('button[aria-label="+10 deg, tilt"]')
    until(lambda: "10.0" in browser.text("#axes-title + div"))
    browser.click("button.stop")
    shot(browser, "service-bench")

    # A session from a plan: begun, paused, the service killed and started again, resumed, done.
    browser.fill("[name=name]", "tuesday")
    browser.run("document.querySelector('[name=plan]').value = 'testfield'")
    written(browser, "[name=parameters]", json.dumps(PARAMETERS))
    chosen(browser, "input[data-inputs]", place.folder / "design.json")
    browser.click("form[data-api$='/sessions'] button")
    browser.until("Session tuesday")
    browser.until("1 of 4 poses", seconds=60)
    browser.click("button[data-api$='/pause']")
    browser.until("paused", "#state", 60)
    place.kill()
    browser.until("connection to the service is lost", "#connection", 20)
    place.start()
    browser.until("paused", "#state", 60)  # the login and the page are still there
    until(lambda: browser.text("#connection") == "", 20)
    browser.click("button[data-api$='/resume']")
    browser.until("4 of 4 poses", "#state", 120)
    browser.until("done", "#state", 60)
    browser.open(f"{base}/sessions/tuesday")
    browser.until("calibration.json", seconds=60)
    shot(browser, "service-session")

    # Another one, aborted and resumed from the page.
    browser.open(f"{base}/benches/cellar")
    browser.fill("[name=name]", "wednesday")
    browser.run("document.querySelector('[name=plan]').value = 'testfield'")
    written(browser, "[name=parameters]", json.dumps(PARAMETERS))
    chosen(browser, "input[data-inputs]", place.folder / "design.json")
    browser.click("form[data-api$='/sessions'] button")
    browser.until("Session wednesday")
    browser.click("button[data-api$='/abort']")
    browser.accept()
    browser.until("Can be resumed", "#state", 60)

    # The calibration is judged, accepted, and shown.
    browser.open(f"{base}/calibrations/vidicon")
    browser.run("document.querySelector('[name=session]').value = 'tuesday'")
    written(browser, "[name=rules]", FIELD_RULES.to_json())
    browser.click("form[data-api$='/decisions'] button")
    until(lambda: browser.text("#configuration").count("needs review") == 2)
    browser.click("#configuration tbody a")
    browser.fill("form[data-api$='/review'] [name=comment]", "first calibration")
    browser.click("form[data-api$='/review'] button")
    browser.until("in force", seconds=30)
    time.sleep(2.0)
    browser.until("4 images")
    before = browser.run("return document.querySelector('canvas').dataset.view")
    browser.run("document.querySelector('canvas').focus()")
    keys = [{"type": kind, "value": "\ue014"} for kind in ("keyDown", "keyUp")]  # the arrow to the right
    browser.command("POST", "/actions", {"actions": [{"type": "key", "id": "keys", "actions": keys}]})
    until(lambda: browser.run("return document.querySelector('canvas').dataset.view") != before)
    browser.click("button[data-turn=top]")
    until(lambda: browser.run("return document.querySelector('canvas').dataset.view").startswith("-90 90"))
    browser.click("button[data-turn=down]")
    browser.click("button[data-turn=down]")
    browser.click("button[data-turn=down]")
    shot(browser, "service-calibration")

    # The drift alarm is acknowledged; an earlier calibration applies again.
    browser.open(f"{base}/history")
    browser.until("c increases")
    browser.click("button[data-api$='/acknowledge']")
    until(lambda: "1 acknowledged" in browser.text())
    shot(browser, "service-history")
    browser.open(f"{base}/calibrations/left")
    shot(browser, "service-charts")
    key = browser.run("return document.querySelectorAll('#configuration tbody a')[5].getAttribute('href')")
    browser.open(base + key)
    browser.click("button[data-api$='/return']")
    browser.accept()
    browser.until("in force", "#calibration", 20)

    # Photographs are dropped.
    browser.open(f"{base}/files")
    browser.fill("[name=name]", "dropped, March")
    chosen(browser, "[name=photographs]", *sorted(place.folder.glob("*.png")))
    chosen(browser, "[name=design]", place.folder / "field.json")
    browser.click("summary")
    browser.fill("[name=pitch]", "0.027")
    browser.fill("[name=free]", "c,x0,y0,K1")
    shot(browser, "service-files")
    browser.click("form button.primary")
    browser.until("usable", seconds=120)
    browser.open(f"{base}/audit")
    browser.until("whole")
    assert [each for each in browser.complaints() if "Content Security Policy" in each] == []


def test_pages_fit_a_phone_and_have_no_serious_finding_of_axe(place: Place, browser: Browser) -> None:
    if place.running is None or place.running.poll() is not None:
        browser.open(place.start())
    base = f"http://127.0.0.1:{place.port}"
    browser.open(f"{base}/calibrations/left")
    key = browser.run("return document.querySelector('#configuration tbody a').getAttribute('href')")
    found: dict[str, Any] = {}
    paths = {
        "overview": "/", "bench": "/benches/cellar", "sessions": "/sessions", "session": "/sessions/monday",
        "frame": "/sessions/monday/frames/2", "calibrations": "/calibrations", "charts": "/calibrations/left",
        "calibration": key, "files": "/files", "history": "/history", "account": "/account",
        "audit": "/audit", "login": "/login",
    }  # fmt: skip
    for width in (1280, 390):
        browser.resize(width, 844)
        for name, path in paths.items():
            browser.open(base + path)
            time.sleep(0.3)
            over = browser.run("return document.documentElement.scrollWidth - innerWidth")
            assert over <= 0, (path, width, over)
            if findings := axe(browser):
                found[f"{path} {width}"] = findings
            if width == 390:
                time.sleep(1.0)
                shot(browser, f"service-{name}-phone")
    assert found == {}, json.dumps(found, indent=1)


class Cutting:
    """A proxy on the address ::1 that cuts every connection again and again."""

    def __init__(self, port: int, seconds: float) -> None:
        self._port, self._seconds, self._pairs = port, seconds, set[tuple[socket.socket, socket.socket]]()
        self._over, self.cut = threading.Event(), 0
        self._server = socket.create_server(("::1", port), family=socket.AF_INET6)
        for work in (self._accept, self._cut):
            threading.Thread(target=work, daemon=True).start()

    def _accept(self) -> None:
        while not self._over.is_set():
            with suppress(OSError):
                here, _ = self._server.accept()
                there = socket.create_connection(("127.0.0.1", self._port))
                self._pairs.add((here, there))
                for a, b in ((here, there), (there, here)):
                    threading.Thread(target=self._pass, args=(a, b), daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while part := source.recv(1 << 16):
                target.sendall(part)
        for each in (source, target):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _cut(self) -> None:
        while not self._over.wait(self._seconds):
            for pair in list(self._pairs):
                self._pairs.discard(pair)
                self.cut += 1
                for each in pair:
                    with suppress(OSError):
                        each.shutdown(socket.SHUT_RDWR)
                    each.close()

    def close(self) -> None:
        self._over.set()
        self._server.close()


def position(browser: Browser) -> str:
    """The tilt as the page shows it."""
    rows = browser.text("#axes-title + div").splitlines()
    return next((row.split("\t")[1] for row in rows if row.startswith("tilt")), "")


def test_two_browsers_show_the_same_bench_also_where_connections_are_cut(
    place: Place, browser: Browser
) -> None:
    if place.running is None or place.running.poll() is not None:
        browser.open(place.start())
    seconds = float(os.environ.get("RESEAU_CUT_S", "4"))
    proxy = Cutting(place.port, seconds)
    try:
        with chromium() as other:
            other.open(place.link().replace("127.0.0.1", "[::1]"))
            other.open(f"http://[::1]:{place.port}/benches/cellar")
            browser.resize(1280, 900)
            browser.open(f"http://127.0.0.1:{place.port}/benches/cellar")
            for page in (browser, other):
                page.until("tilt", "#state", 60)
            for number in range(4):
                jogs = browser if number % 2 else other
                before = position(browser)
                button = "+1 deg, tilt" if number < 2 else "-1 deg, tilt"
                until(lambda jogs=jogs: jogs.text("#state").startswith("ready"), 60)
                jogs.click(f'button[aria-label="{button}"]')
                until(lambda before=before: position(browser) not in ("", before), 60)
                until(lambda: position(other) == position(browser), 60)
                time.sleep(seconds)
            cut = proxy.cut
            browser.click("button.stop")
            until(lambda: proxy.cut > cut, 60)
            until(lambda: position(other) == position(browser), 60)
            assert other.text("#state").startswith("ready")
    finally:
        proxy.close()


def test_a_login_that_ends_leads_to_the_login(place: Place, browser: Browser) -> None:
    if place.running is None or place.running.poll() is not None:
        browser.open(place.start())
    base = f"http://127.0.0.1:{place.port}"
    browser.resize(1280, 900)
    browser.open(f"{base}/sessions")
    cookie = browser.command("GET", f"/cookie/reseau-{place.port}")["value"]
    csrf = browser.run("return document.querySelector('meta[name=csrf]').content")
    headers = {"Cookie": f"reseau-{place.port}={cookie}", "X-CSRF-Token": csrf}
    assert httpx.post(f"{base}/api/1/logout", headers=headers).status_code == 200
    browser.run("document.dispatchEvent(new Event('visibilitychange'))")
    browser.until("Log in", seconds=30)
