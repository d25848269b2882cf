"""The examples of the pages for contributors run, found as in an installed package, in under 100 lines."""

from __future__ import annotations

import json
import re
import socketserver
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.capture.simple import CameraSettings, Simple, Taken

import reseau
from reseau.archive import Archive
from reseau.bundle import Camera, adjust_network, example_network
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry, carry_out
from reseau.core.data import Frame
from reseau.core.errors import RefusedError, SettingError, UsageError
from reseau.designs.drawing import design_pdf
from reseau.io import ReseauDesign
from reseau.optics import PixelGrid, Pose, Sensor, camera_model, project
from reseau.optics.cameras import registry
from reseau.optics.formation import Outline, draw
from reseau.optics.mapping import PlaneMapping
from reseau.sessions import conducting, kinds

EXAMPLES = Path(__file__).parents[2] / "docs" / "contributing" / "examples"
GRID = PixelGrid(640, 480, (0.01, 0.01))
ENTRY_POINTS = """
[reseau.cameras]
fov = camera:MODEL
[reseau.instruments]
lamp = instrument:lamp
[reseau.sessions]
flicker = procedure:KIND
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package with the examples, as pip would install it."""
    about = tmp_path / "site" / "example-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: example\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.setattr(registry, "_CAMERAS", dict(registry._CAMERAS))
    monkeypatch.syspath_prepend(str(about.parent))
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield
    for name in ("camera", "instrument", "procedure", "target"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("name", ["camera", "target", "instrument", "procedure"])
def test_an_example_has_less_than_100_lines_and_is_on_a_page(name: str) -> None:
    path = EXAMPLES / f"{name}.py"
    assert len(path.read_text("utf-8").splitlines()) < 100
    pages = "".join(page.read_text("utf-8") for page in EXAMPLES.parent.glob("*.md"))
    assert f"examples/{name}.py" in pages


def test_entry_points_in_the_docstrings_are_those_of_the_test() -> None:
    named = {
        line
        for path in EXAMPLES.glob("*.py")
        for line in re.findall(r'(\w+ = "\w+:\w+")', path.read_text("utf-8"))
    }
    assert {line.replace('"', "") for line in named} == set(re.findall(r"\w+ = \w+:\w+", ENTRY_POINTS))


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("omega", [0.0, 0.9, 1.7])
def test_derivatives_of_the_camera_are_those_of_its_values(omega: float) -> None:
    values, uv = np.array([500.0, 300.0, 220.0, omega]), np.array([[0.0, 0.0], [0.3, -0.2], [-0.9, 0.5]])
    model = camera_model("fov")

    def at(change: Any, moved: Any) -> Any:
        mapping: PlaneMapping = model.mapping(values + change, GRID)
        return mapping(uv + moved)

    found = model.mapping(values, GRID).derivatives(uv)
    step = 1e-5
    for k in range(2):
        e = step * np.eye(2)[k]
        numeric = (at(0, e) - at(0, -e)) / (2 * step)
        np.testing.assert_allclose(found.d_xy[:, :, k], numeric, atol=1e-4)
    for k in range(4):
        e = step * np.eye(4)[k]
        numeric = (at(e, 0) - at(-e, 0)) / (2 * step)
        np.testing.assert_allclose(found.d_parameters[:, :, k], numeric, atol=1e-2 if omega == 0 else 1e-4)


@pytest.mark.usefixtures("installed")
def test_a_network_is_adjusted_with_the_camera_of_another_package() -> None:
    network, true = example_network(), np.array([800.0, 321.0, 238.0, 0.6])
    known = adjust_network(network).required()
    lens = camera_model("fov").mapping(true, GRID)
    poses = map(Pose, known.images.rotation, known.images.x0)
    xy = np.concatenate([project(lens, pose, network.xyz).xy for pose in poses])
    noise = np.random.default_rng(3).normal(0, 0.05, xy.shape)
    start = camera_model("fov").start_values(790.0, GRID)
    camera = Camera("camera", 640, 480, (0.01, 0.01), "fov", start, ("f", "cx", "cy", "omega"))
    found = adjust_network(replace(network, cameras=(camera,), xy=xy + noise)).required()
    estimate = found.cameras["camera"]
    assert 0.8 < found.sigma0 < 1.2
    assert (np.abs(estimate.values - true) < 4 * estimate.sigma).all()


@pytest.mark.usefixtures("installed")
def test_the_target_is_drawn_written_and_measured(tmp_path: Path) -> None:
    from target import wheel

    design = wheel(4, 12.0)
    design.write(tmp_path / "wheel.json")
    assert isinstance(reseau.read_design(tmp_path / "wheel.json"), ReseauDesign)
    assert len(design.ids) == 1 + 6 + 12 + 18 + 24
    turn = 4.0 * np.array([[np.cos(0.1), -np.sin(0.1)], [-np.sin(0.1), -np.cos(0.1)]])
    at = design.xy @ turn.T + [240.0, 235.0]
    disk = Outline.circle(4.0 * design.mark.size / 2, 0.4)
    ink = draw(Outline(disk.xy[None] + at[:, None], np.repeat(disk.dxy[None], len(at), 0)), (470, 480), 0.8)
    grey = Sensor(480, 470, read_noise=1.5).expose(190 * (1 - 0.8 * ink), np.random.default_rng(1))
    near = {name: tuple(place) for name, place in zip(design.ids, (at + 2.0).tolist(), strict=True)}
    points = tuple(each.model_copy(update={"nominal_px": near[each.id]}) for each in design.points)
    found = reseau.measure(grey, design.model_copy(update={"points": points})).required()
    assert found.ok.all()
    assert np.abs(found.xy - at).max() < 0.06
    assert design_pdf(design, "A4").startswith(b"%PDF")


class _Lamp(socketserver.StreamRequestHandler):
    """A lamp that refuses levels above 90 %."""

    def handle(self) -> None:
        for line in self.rfile:
            words, answer = line.decode().split(), b"OK\n"
            if words[0] == "LEVEL" and float(words[1]) > 90:
                answer = b"ERR too hot\n"
            elif words[0] == "LEVEL":
                self.server.level = float(words[1])  # type: ignore[attr-defined]
            elif words[0] == "LEVEL?":
                answer = f"{self.server.level:.1f}\n".encode()  # type: ignore[attr-defined]
            elif words[0] == "IDN?":
                answer = b"L1\n"
            self.wfile.write(answer)


@pytest.mark.usefixtures("installed")
def test_the_instrument_is_found_configured_and_read() -> None:
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), _Lamp) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        text = f"""
        schema = "reseau-bench/1"
        [instruments.lamp]
        driver = "lamp"
        address = "tcp://127.0.0.1:{server.server_address[1]}"
        settings = {{level = 40.0}}
        limits = {{level = [0.0, 95.0]}}
        """
        with Bench(BenchFile.parse_toml(text, where="bench.toml")) as bench:
            lamp: Any = bench["lamp"]
            assert lamp.read()["level"]["value"] == 40.0
            lamp.configure(level=55.5)
            lamp.trigger().wait(5.0)
            assert lamp.read()["level"]["value"] == 55.5
            with pytest.raises(RefusedError, match=r"lamp \(LEVEL 92.0\): ERR too hot"):
                lamp.configure(level=92.0)
            with pytest.raises(SettingError, match="level"):
                lamp.configure(level=99.0)
        server.shutdown()


class _Flickering(Simple):
    """A camera before a lamp whose light varies by 2 %."""

    def expose(self, seconds: float | None = None) -> Taken:
        self.count = getattr(self, "count", 0) + 1
        level = 120 * (1 + 0.02 * np.random.default_rng(self.count).normal())
        taken = datetime(2026, 3, 1, tzinfo=UTC) + timedelta(seconds=self.count)
        grey = np.random.default_rng(99 + self.count).normal(level, 2.0, (48, 64))
        return Taken(Frame(np.rint(grey).astype(np.uint8), 255.0), self.count, taken, 1000.0)

    def frames(self, count: int, seconds: float | None = None) -> Iterator[Taken]:
        for _ in range(count):
            yield self.expose()


@pytest.mark.usefixtures("installed")
def test_a_session_runs_the_procedure_live_and_again_from_the_archive(tmp_path: Path) -> None:
    entry = InstrumentEntry(driver="a camera of the test", address="here")
    camera = _Flickering("camera", CameraSettings())
    bench = Bench(BenchFile(name="lamp", instruments={"camera": entry}), lambda name, entry: camera)
    with Archive.open(tmp_path / "archive", create=True) as archive, bench:
        session = conducting.begin(archive, "monday", "flicker", {"count": 40})
        given = conducting.parameters_of(session)
        kind = kinds.kind_of("flicker")
        run = Acquisition(bench, session, conducting.procedure_of(session), camera="camera")
        carry_out(run, kind.acquire(run, given))
        again = conducting.rerun(archive.session("monday"))
        assert [(each.result.name, each.same) for each in again] == [("flicker.json", True)]
        result = json.loads(again[0].content or "")
        assert result["frames"] == 40
        assert abs(result["flicker"] - 0.02) < 4 * result["sigma"]


def test_unknown_names_are_one_line_that_lists_what_there_is() -> None:
    with pytest.raises(UsageError, match="unknown plan; use testfield"):
        kinds.kind_of("nothing")
    with pytest.raises(UsageError, match="use one of brown"):
        camera_model("nothing")
