"""People at the pages: Chromium drives the service in its own process, over a simulated bench.

The findings of axe-core are those of the release in the package `axe-core-python`, or of the axe.min.js that
`RESEAU_AXE` names; `RESEAU_SCREENSHOTS` names a folder for pictures of the pages. Run with
`python -m pytest -m slow tests/service/http/test_browser.py`.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
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
from .populated import FIELD_RULES, PARAMETERS, STEPS
from .proxy import Proxy
from .test_benches import ROOT, until
from .test_reading import _CERTIFICATE

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
            sys.executable, "-c", "from reseau.cli import main; main()", "serve", "--bench", "bench.toml"
        ]  # fmt: skip
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


@contextmanager
def placed(archived: Path, folder: Path, more: dict[str, str] | None = None) -> Iterator[Place]:
    """A copy of an archive, and the simulated bench `cellar`."""
    shutil.copytree(archived, folder, dirs_exist_ok=True)
    install(folder / "drivers")
    paths = [str(folder / "drivers"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(folder)} | (more or {})
    (folder / "field.json").write_text(DESIGN.to_json())
    (folder / "design.json").write_text(DESIGN.to_json())
    with SimulatedBench(seed=3) as sim:
        (folder / "bench.toml").write_text(bench_of(sim.toml))
        made = Place(folder, environment)
        try:
            yield made
        finally:
            made.end()


@pytest.fixture(scope="module")
def place(archived: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    with placed(archived, tmp_path_factory.mktemp("browser")) as made:
        with Archive.open(made.folder / "archive") as archive:
            session = archive.session("monday")
            for each in session.frames(kind="frame"):
                if each.verdict is not None and each.verdict.ok:
                    cv2.imwrite(str(made.folder / f"{each.step}.png"), session.picture(each).pixels)
        yield made


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


def shot(browser: Browser, name: str) -> None:
    """Keep the upper part of the page for both themes of the documentation, from a desk at half its size."""
    folder = os.environ.get("RESEAU_SCREENSHOTS")
    if not folder:
        return
    width, height = browser.run("return [innerWidth, innerHeight]")
    # What is below the window, such as the report in its frame, would not be drawn.
    browser.resize(width, 1600)
    for theme, suffix in (("light", ""), ("dark", "-dark")):
        path = Path(folder) / f"{name}{suffix}.png"
        path.parent.mkdir(exist_ok=True)
        browser.prefer(theme)
        time.sleep(1.0)
        browser.screenshot(path)
        picture = cv2.imread(str(path))
        assert picture is not None
        wide = picture.shape[1] > 500
        picture = picture[: 2200 if wide else 1300]
        if wide:
            picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    browser.prefer("")
    browser.resize(width, height)


@pytest.fixture
def axe_core() -> str:
    """axe.min.js."""
    if named := os.environ.get("RESEAU_AXE"):
        return Path(named).read_text(encoding="utf-8")
    package = find_spec("axe_core_python")
    if package is None or package.origin is None:
        pytest.skip("needs axe-core-python, or RESEAU_AXE with the path of axe.min.js")
    return Path(package.origin).with_name("axe.min.js").read_text(encoding="utf-8")


def axe(browser: Browser, script: str) -> list[str]:
    """Serious findings of axe-core on the page."""
    browser.run(script)
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


def filled(browser: Browser, prefix: str, content: Mapping[str, Any]) -> None:
    """Fill the fields of a form with the content of a document."""
    for key, value in content.items():
        if isinstance(value, dict):
            filled(browser, f"{prefix}{key}.", value)
        elif value is not None and key != "schema":
            text = "\n".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
            script = "const e = document.querySelector(`[name='${arguments[0]}']`); e.value = arguments[1];"
            browser.run(script, f"{prefix}{key}", text)


def enter(place: Place, browser: Browser) -> None:
    """Let the browser in, after the service was started if it does not run."""
    if place.running is None or place.running.poll() is not None:
        place.start()
    browser.open(place.link())
    browser.until("Overview")


def home(place: Place) -> None:
    """Have the tilt find its reference, if it has none."""
    token = (place.folder / "archive-service" / "local-token").read_text().strip()
    base, mine = f"http://127.0.0.1:{place.port}/api/1/benches/cellar", {"Authorization": f"Bearer {token}"}
    with httpx.Client(headers=mine, timeout=300) as http:
        until(lambda: http.get(base).json()["state"] == "ready")
        if not http.get(f"{base}/axes").json()["tilt"]["homed"]:
            http.post(f"{base}/home", json={"axis": "tilt"}).raise_for_status()


def press(browser: Browser, css: str) -> None:
    """Click a button as soon as it is there and enabled: those of axes are not while one moves."""
    find = "const b = document.querySelector(arguments[0]), on = b && !b.disabled;"
    script = f"{find} if (on) b.click(); return on"
    until(lambda: browser.run(script, css))


def begin_session(place: Place, browser: Browser, name: str) -> None:
    """Begin a session of the testfield on the page of the bench."""
    browser.fill("[name=name]", name)
    browser.run(
        "const plan = document.querySelector('[name=plan]'); plan.value = 'testfield';"
        "plan.dispatchEvent(new Event('change'))"
    )
    form = "fieldset[data-for=testfield]"
    for key in ("free", "pitch_mm", "row_jitter_px", "fill"):
        value: Any = PARAMETERS[key]
        written(browser, f"{form} [name='texts.{key}']", ",".join(value) if key == "free" else str(value))
    poses = place.folder / "poses.csv"
    rows = [",".join((step, *map(str, position.values()))) for step, position in STEPS]
    poses.write_text("\n".join(("name,tilt,roll,camera_roll", *rows)) + "\n")
    chosen(browser, f"{form} [data-text='texts.steps']", poses)
    chosen(browser, f"{form} [data-input]", place.folder / "design.json")
    browser.click("form[data-api$='/sessions'] button.primary")
    browser.until(f"Session {name}")


def test_from_the_first_start_to_a_roll_back(place: Place, browser: Browser) -> None:
    entry = place.start()
    base = entry.partition("/enter")[0]
    browser.open(f"{base}/sessions")
    browser.until("Log in")
    browser.open(entry)
    browser.until("Overview")
    shot(browser, "service-overview")

    # The bench: live picture, jog, stop.
    browser.open(f"{base}/benches/cellar")
    browser.until("ready")
    browser.until("sharpest edges")
    for axis in ("tilt", "roll", "camera_roll"):
        press(browser, f'button[aria-label="Home {axis}"]')
        until(lambda: "done" in browser.text("#message") or browser.text("#message"))
    browser.until("tilt")
    written(browser, "#step", "10")
    press(browser, 'button[aria-label="plus a step, tilt"]')
    until(lambda: "10.0" in browser.text("#axes-title ~ div"))
    browser.click("button.stop")
    shot(browser, "service-bench")

    # A session from a plan: begun, paused, the service killed and started again, resumed, done.
    begin_session(place, browser, "tuesday")
    browser.until("1 of 4 poses")
    browser.click("button[data-api$='/pause']")
    browser.until("paused", "#state")
    place.kill()
    browser.until("connection to the service is lost", "#connection")
    place.start()
    browser.until("paused", "#state")  # the login and the page are still there
    until(lambda: browser.text("#connection") == "")
    browser.click("button[data-api$='/resume']")
    browser.until("4 of 4 poses", "#state")
    browser.until("done", "#state")
    browser.open(f"{base}/sessions/tuesday")
    browser.until("calibration.json")
    shot(browser, "service-session")

    # Another one, aborted and resumed from the page.
    browser.open(f"{base}/benches/cellar")
    begin_session(place, browser, "wednesday")
    browser.click("button[data-api$='/abort']")
    browser.accept()
    browser.until("Can be resumed", "#state")

    # The calibration is judged, accepted, and shown.
    browser.open(f"{base}/calibrations/vidicon")
    browser.run("document.querySelector('[name=session]').value = 'tuesday'")
    filled(browser, "rules.", FIELD_RULES.to_dict())
    browser.click("form[data-api$='/decisions'] button")
    until(lambda: browser.text("#configuration").count("needs review") == 2)
    browser.click("#configuration tbody a")
    browser.fill("form[data-api$='/review'] [name=comment]", "first calibration")
    browser.click("form[data-api$='/review'] button")
    browser.until("in force")
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

    # Its certificate, and a comparison with another calibration.
    browser.run("document.querySelector('form[data-api$=certificate] [name=form]').value = 'html'")
    filled(browser, "data.", _CERTIFICATE)
    browser.click("form[data-api$=certificate] button")
    browser.until("saved as certificate.html", "#message")
    browser.open(f"{base}/compare")
    browser.run("document.querySelectorAll('select').forEach((s, k) => { s.selectedIndex = k; })")
    browser.click("form button.primary")
    browser.until("They differ by at most")

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
    browser.until("in force", "#calibration")

    # Photographs are dropped.
    browser.open(f"{base}/files")
    browser.fill("[name=name]", "dropped, March")
    chosen(browser, "[name=photographs]", *sorted(place.folder.glob("*.png")))
    chosen(browser, "[name=design]", place.folder / "field.json")
    browser.click("summary")
    browser.fill("[name=pitch_mm]", "0.027")
    browser.fill("[name=free]", "c,x0,y0,K1")
    shot(browser, "service-files")
    browser.click("form button.primary")
    browser.until("Usable")
    browser.open(f"{base}/audit")
    browser.until("whole")
    assert [each for each in browser.complaints() if "Content Security Policy" in each] == []


def every_page(place: Place, browser: Browser, *widths: int) -> Iterator[tuple[str, int]]:
    """Open every page in every width, and tell its name."""
    enter(place, browser)
    base = f"http://127.0.0.1:{place.port}"
    browser.open(f"{base}/calibrations/left")
    key = browser.run("return document.querySelector('#configuration tbody a').getAttribute('href')")
    paths = {
        "overview": "/", "bench": "/benches/cellar", "sessions": "/sessions", "session": "/sessions/monday",
        "frame": "/sessions/monday/frames/2", "calibrations": "/calibrations", "charts": "/calibrations/left",
        "calibration": key, "files": "/files", "history": "/history", "account": "/account",
        "audit": "/audit", "login": "/login",
    }  # fmt: skip
    for width in widths:
        browser.resize(width, 844)
        for name, path in paths.items():
            browser.open(base + path)
            time.sleep(0.3)
            yield name, width


def test_every_page_fits_a_phone(place: Place, browser: Browser) -> None:
    for name, width in every_page(place, browser, 390):
        over = browser.run("return document.documentElement.scrollWidth - innerWidth")
        assert over <= 0, (name, width, over)
        time.sleep(1.0)
        shot(browser, f"service-{name}-phone")


def test_axe_has_no_serious_finding_on_any_page(place: Place, browser: Browser, axe_core: str) -> None:
    found = {
        f"{name} {width}": findings
        for name, width in every_page(place, browser, 1280, 390)
        if (findings := axe(browser, axe_core))
    }
    assert found == {}, json.dumps(found, indent=1)


def position(browser: Browser) -> str:
    """The tilt as the page shows it."""
    rows = browser.text("#axes-title ~ div").splitlines()
    return next((row.split("\t")[1] for row in rows if row.startswith("tilt")), "")


@pytest.mark.parametrize("seconds", [4.0, 10.0])
def test_two_browsers_show_the_same_bench_also_where_connections_are_cut(
    place: Place, browser: Browser, seconds: float
) -> None:
    enter(place, browser)
    home(place)
    with Proxy(place.port, "::1", place.port, seconds) as proxy, chromium() as other:
        other.open(place.link().replace("127.0.0.1", "[::1]"))
        other.open(f"http://[::1]:{place.port}/benches/cellar")
        browser.resize(1280, 900)
        browser.open(f"http://127.0.0.1:{place.port}/benches/cellar")
        for page in (browser, other):
            page.until("tilt", "#state")
        for number in range(4):
            jogs = browser if number % 2 else other
            before = position(browser)
            button = "plus a step, tilt" if number < 2 else "minus a step, tilt"
            until(lambda jogs=jogs: jogs.text("#state").startswith("ready"))
            press(jogs, f'button[aria-label="{button}"]')
            until(lambda before=before: position(browser) not in ("", before))
            until(lambda: position(other) == position(browser))
            time.sleep(seconds)
        cut = proxy.cut
        browser.click("button.stop")
        until(lambda: proxy.cut > cut)
        until(lambda: position(other) == position(browser))
        assert other.text("#state").startswith("ready")


def test_a_connection_that_is_dead_without_an_end_is_reported_and_opened_again(
    place: Place, browser: Browser
) -> None:
    enter(place, browser)
    with Proxy(place.port, "::1", place.port) as proxy, chromium() as other:
        other.open(place.link().replace("127.0.0.1", "[::1]"))
        other.open(f"http://[::1]:{place.port}/sessions")
        other.until("monday")
        until(lambda: other.run("return document.getElementById('connection').hidden"))
        proxy.hold()
        other.until("connection to the service is lost", "#connection")
        with Archive.open(place.folder / "archive") as archive:
            archive.begin("while nobody heard", "frames", {"count": 1}).end("done")
        assert "while nobody heard" not in other.text()
        proxy.release()
        other.until("while nobody heard")
        until(lambda: other.run("return document.getElementById('connection').hidden"))


def test_a_login_that_ends_leads_to_the_login(place: Place, browser: Browser) -> None:
    enter(place, browser)
    base = f"http://127.0.0.1:{place.port}"
    browser.resize(1280, 900)
    browser.open(f"{base}/sessions")
    cookie = browser.command("GET", f"/cookie/reseau-{place.port}")["value"]
    csrf = browser.run("return document.querySelector('meta[name=csrf]').content")
    headers = {"Cookie": f"reseau-{place.port}={cookie}", "X-CSRF-Token": csrf}
    assert httpx.post(f"{base}/api/1/logout", headers=headers).status_code == 200
    browser.run("document.dispatchEvent(new Event('visibilitychange'))")
    browser.until("Log in")


class Clock:
    """The clock of the processes of a place, shifted by libfaketime; what measures durations is not."""

    def __init__(self, folder: Path) -> None:
        found = next(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"), None)
        if found is None:
            pytest.skip("needs libfaketime (apt-get install faketime)")
        self._file = folder / "clock"
        self.shift("+0")
        self.environment = {
            "LD_PRELOAD": str(found), "FAKETIME_TIMESTAMP_FILE": str(self._file), "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }  # fmt: skip

    def shift(self, by: str) -> None:
        self._file.write_text(f"{by}\n")


def test_pages_stay_true_when_the_clock_is_set_back_and_forth(
    archived: Path, tmp_path: Path, browser: Browser
) -> None:
    clock = Clock(tmp_path)
    with placed(archived, tmp_path, clock.environment) as place:
        entry = place.start()
        bench, sessions = (f"http://127.0.0.1:{place.port}/{name}" for name in ("benches/cellar", "sessions"))
        browser.resize(1280, 900)
        browser.open(entry)
        browser.open(bench)
        browser.until("ready", "#state")
        for axis in ("tilt", "roll", "camera_roll"):
            press(browser, f'button[aria-label="Home {axis}"]')
            until(lambda axis=axis: f"{axis}\t0.000 deg" in browser.text("#axes-title ~ div"))
            browser.until("ready", "#state")
        # Half a minute, as by a time server, also in the browser: the page goes on.
        clock.shift("-30")
        browser.run("const now = Date.now; Date.now = () => now() - 3600e3")
        press(browser, 'button[aria-label="plus a step, tilt"]')
        until(lambda: position(browser).startswith("1.0"))
        # Two days: the login is from the future, and ends.
        clock.shift("-2d")
        browser.until("Log in")
        browser.open(place.link())
        browser.open(bench)
        browser.until("ready", "#state")
        begin_session(place, browser, "in the past")
        browser.until("1 of 4 poses")
        # To the present, while the session runs: the login is older than twelve hours now.
        clock.shift("+0")
        browser.until("Log in")
        browser.open(place.link())
        browser.open(bench)
        browser.until("4 of 4 poses", "#state")
        browser.until("done", "#state")
        browser.open(sessions)
        first = browser.run("return document.querySelector('#sessions tbody tr').innerText")
        assert first.startswith("in the past")
        assert first.rstrip().endswith("done")
        assert Archive.open(place.folder / "archive").session("in the past").counts() == (4, 4)


def test_poses_are_filled_in_row_by_row_and_axes_that_are_left_empty_do_not_move(
    place: Place, browser: Browser
) -> None:
    enter(place, browser)
    home(place)
    browser.resize(1280, 844)
    browser.open(f"http://127.0.0.1:{place.port}/benches/cellar")
    hidden = "const i = document.querySelector('.picture img'); i.hidden = true;"
    assert browser.run(f"{hidden} return getComputedStyle(i).display") == "none"  # while a camera starts
    until(lambda: "deg" in browser.text("#axes-title ~ div"))
    browser.fill("[name=name]", "by hand")
    choose = "const plan = document.querySelector('[name=plan]'); plan.value = 'testfield';"
    browser.run(f"{choose} plan.dispatchEvent(new Event('change'))")
    form = "fieldset[data-for=testfield]"
    for _ in range(3):
        browser.click(f"{form} [data-add]")
    browser.click(f"{form} [data-add=here]")
    here = browser.run("return document.querySelector(arguments[0]).value",
                       f"{form} tr:nth-child(4) [data-column=roll]")  # fmt: skip
    shown = browser.text("[data-position=roll]").split()[0]
    assert float(here) == pytest.approx(float(shown), abs=0.01)
    browser.click(f"{form} tr:nth-child(4) [data-remove]")
    for row, tilt in ((1, 0), (2, 10), (3, 20)):
        written(browser, f"{form} tr:nth-child({row}) [data-column=tilt]", str(tilt))
    chosen(browser, f"{form} [data-input]", place.folder / "design.json")
    browser.click("form[data-api$='/sessions'] button.primary")
    until(lambda: "Session by hand" in browser.text("#state"))
    with Archive.open(place.folder / "archive") as archive:
        steps = archive.session("by hand").parameters["steps"]
    assert steps == [["pose 1", {"tilt": 0.0}], ["pose 2", {"tilt": 10.0}], ["pose 3", {"tilt": 20.0}]]
    home(place)
