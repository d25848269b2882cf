"""`reseau capture sensor` on a simulated camera; its calibration applied before something is measured."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from scipy.special import ndtr

from reseau.archive import Archive, Session
from reseau.calibration import Calibration
from reseau.cli import run
from reseau.core.errors import ArchiveError
from reseau.io.images import write_image
from reseau.sensor import Level, SensorSeries, calibrate_sensor
from reseau_sims import World
from reseau_sims.pixels import PixelSensor
from reseau_sims.serving import LampScene, SimulatedCamera, VideoCamera

BENCH = """\
schema = "reseau-bench/1"
[instruments.eye]
driver = "v4l2"
address = "/dev/video-simulated"
settings = {format = "Y12", exposure_us = 1000.0, buffers = 16}
"""


@pytest.fixture
def sensor() -> PixelSensor:
    return PixelSensor.drawn(np.random.default_rng(2), full_well=12_000.0)


@pytest.fixture
def lamp(sensor: PixelSensor) -> LampScene:
    return LampScene(sensor, 1.0)


@pytest.fixture
def camera(lamp: LampScene) -> VideoCamera:
    camera = VideoCamera(SimulatedCamera(lamp, 96, 64))
    camera.controls[0x980900] = 128
    return camera


@pytest.fixture
def asked(lamp: LampScene, camera: VideoCamera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A folder with a bench file; and the requests to the operator, who carries them out at once."""
    asked: list[str] = []

    def message(text: str = "", err: bool = False, **_: Any) -> None:
        asked.append(text)
        if "cover" in text:
            lamp.light = 0.0
        elif "even light" in text:
            lamp.light = 1.0
        elif "edge" in text:
            y, x = np.mgrid[:64, :96]
            step = 0.1 + 0.9 * ndtr((x - 48 - 0.1 * (y - 32)) / 0.6)
            lamp.light = step * float(os.environ.get("LIGHT_OF_THE_EDGE", "2"))

    monkeypatch.setattr("reseau_drivers.camera.KernelNode", lambda address: camera.open())
    monkeypatch.setattr(typer, "echo", message)
    monkeypatch.setattr("sys.stdin", io.StringIO("\n" * 99))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # locks of parallel tests are apart
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(BENCH)
    return asked


def capture(*options: str) -> int:
    return run(["capture", "sensor", "--name", "monday", "--frames", "4", *options])


def frames_of(name: str = "monday") -> list[tuple[str, str]]:
    with Archive.open("archive") as archive:
        return [(frame.step, frame.sha256) for frame in archive.session(name).frames(kind="frame")]


@pytest.mark.slow
def test_a_sensor_is_calibrated_on_the_bench(
    asked: list[str], sensor: PixelSensor, capsys: pytest.CaptureFixture[str]
) -> None:
    assert capture("--mtf", "--out", "sensor.json", "--json") == 0
    message = capsys.readouterr().out
    events = [json.loads(line) for line in message.splitlines()]
    assert [event["event"] for event in events].count("frame") == 4 * (14 + 12 + 1)
    assert [event["event"] for event in events[-4:]] == ["result", "result", "end", "calibration"]
    found = events[-1]["parameters"]
    for name in ("gain", "read_noise", "full_well"):
        assert abs(found[name]["value"] - getattr(sensor, name)) < 4 * found[name]["sigma"], name
    # 0.6 px along x are less along the normal; 1/12 of them is the pixel's own square.
    assert found["psf"]["value"] == pytest.approx(np.sqrt(0.6**2 / 1.01 - 1 / 12), abs=0.03)
    # The light has the pixel's square in it already as a Gaussian: half is at √(ln 2 / 2) / (π σ).
    half = np.sqrt(np.log(2) / 2) / (np.pi * 0.6 / np.sqrt(1.01))
    assert abs(found["mtf50_free"]["value"] - half) < 4 * found["mtf50_free"]["sigma"] < 0.04
    assert {test["name"] for test in events[-1]["tests"]} >= {"Gaussian edge", "straight edge"}
    assert events[-1]["validity"]["defects"] < 12
    assert len(asked) == 3

    calibration = Calibration.read(Path("sensor.json"))
    assert calibration.times
    assert calibration.values()["gain"] == found["gain"]["value"]
    curve = calibration.model["mtf"] if isinstance(calibration.model, dict) else {}
    assert curve["frequency"][16] == 0.5
    assert curve["mtf"][16] == pytest.approx(found["mtf_nyquist_free"]["value"], abs=1e-12)
    assert len(curve["sigma"]) == len(curve["gaussian"]) == len(curve["mtf"])


@pytest.mark.slow
def test_every_raw_frame_is_archived_and_the_calibration_can_be_recomputed(
    asked: list[str], camera: VideoCamera, capsys: pytest.CaptureFixture[str]
) -> None:
    assert capture("--mtf") == 0
    message = capsys.readouterr().out
    assert "108/108 edge 00 003: good" in message
    assert "monday: done, 108 frames in archive\n  calibration.json\n  report.html\n" in message
    assert "mtf50_free" in message
    kept = frames_of()
    assert len(kept) == len({step for step, _ in kept}) == 108
    assert run(["archive", "show", "monday", "--out", "results"]) == 0
    inputs = json.loads(Path("results/calibration.json").read_text())["provenance"]["inputs"]
    assert inputs == dict(kept)
    assert "Modulation transfer along the normal" in Path("results/report.html").read_text()
    capsys.readouterr()
    assert run(["archive", "rerun", "monday", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in document["results"]] == ["calibration.json", "report.html"]
    assert document["same"]
    assert run(["archive", "verify"]) == 0


@pytest.mark.slow
def test_an_interrupted_session_is_resumed_where_it_stopped(
    asked: list[str], lamp: LampScene, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, left = Session.store, [20]

    def full(self: Session, *arguments: Any, **more: Any) -> Any:
        left[0] -= 1
        if left[0] == 0:
            raise ArchiveError("cannot be kept (No space left on device)", where="archive", do="make room")
        return store(self, *arguments, **more)

    monkeypatch.setattr(Session, "store", full)
    assert capture() == 1
    assert "No space left" in capsys.readouterr().err
    before = frames_of()
    assert 0 < len(before) < 20
    monkeypatch.setattr(Session, "store", store)
    asked.clear()
    assert run(["capture", "sensor", "--resume"]) == 0
    assert [text.split()[0] for text in asked] == ["provide", "cover"]
    assert frames_of()[: len(before)] == before
    assert len(frames_of()) == 4 * (14 + 12)
    assert run(["archive", "rerun", "monday"]) == 0
    assert capsys.readouterr().out.count("identical") == 2
    assert run(["capture", "sensor", "--resume"]) == 2


@pytest.mark.slow
def test_an_edge_that_cannot_be_measured_affects_the_sharpness_only(
    asked: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert capture("--mtf", "--region", "0,0,20,40", "--out", "sensor.json") == 1
    found = capsys.readouterr()
    assert "gain" in found.out
    assert found.err.strip().splitlines()[-1].startswith("reseau: edge: ")
    assert "psf" not in Calibration.read(Path("sensor.json")).parameters


@pytest.mark.slow
def test_a_saturated_edge_is_reported(
    asked: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LIGHT_OF_THE_EDGE", "40")
    assert capture("--mtf") == 1
    found = capsys.readouterr()
    assert found.err.strip().splitlines()[-1] == (
        "reseau: edge: its bright side is saturated: reduce the exposure"
    )
    with Archive.open("archive") as archive:
        results = [result.name for result in archive.session("monday").results()]
    assert results == ["calibration.json", "report.html"]


@pytest.mark.slow
def test_the_correction_is_applied_before_a_reseau_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = World.standard(seed=4)
    frame = world.photo_i()
    rng = np.random.default_rng(7)
    shape = frame.pixels.shape
    uneven = PixelSensor(
        np.full(shape, 9.0), np.zeros(shape), rng.normal(1.0, 0.04, shape), np.zeros(shape, bool),
        np.zeros(shape, bool), gain=40.0, read_noise=0.6, full_well=1e9, bits=8,
    )  # fmt: skip
    dark = (Level.of(1.0, [uneven.expose(0.0, 1.0, rng) for _ in range(6)]),)
    bright = tuple(
        Level.of(t, [uneven.expose(20.0, t, rng) for _ in range(6)]) for t in (1.0, 3.0, 5.0, 7.0, 9.0)
    )
    sensor = tmp_path / "sensor.json"
    sensor.write_text(calibrate_sensor(SensorSeries(dark, bright, 255.0)).calibration("s", {}, {}).to_json())
    write_image(tmp_path / "photo.png", uneven.expose(frame.pixels.astype(float) * 0.9, 1.0, rng))
    (tmp_path / "design.json").write_text(world.design.to_json())
    truth = world.truth()
    where = dict(zip(truth.names, truth.xy, strict=True))

    def rms(*options: str) -> float:
        command = ["measure", "reseau", str(tmp_path / "photo.png"), "-d", str(tmp_path / "design.json")]
        assert run([*command, *options, "--json"]) == 0
        points = json.loads(capsys.readouterr().out)["points"]
        errors = [np.subtract((p["x"], p["y"]), where[p["id"]]) for p in points if p["ok"]]
        assert len(errors) > 150
        return float(np.sqrt(np.mean(np.square(errors))))

    raw, corrected = rms(), rms("--sensor", str(sensor))
    assert corrected < 0.8 * raw
    assert run(["measure", "reseau", str(tmp_path / "photo.png"), "-d", str(tmp_path / "design.json"),
                "--sensor", str(tmp_path / "design.json")]) == 2  # fmt: skip


def test_wrong_use_is_reported(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for options in (["--camera", "none"], ["--bench", "none.toml"], ["--levels", "1"], ["--out", "no/where"]):
        assert capture(*options) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not Path("sensor.json").exists()
    assert run(["archive", "list"]) == 1
    assert "monday" not in capsys.readouterr().out
