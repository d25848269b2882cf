"""`reseau capture sensor` on a simulated camera; its calibration applied before something is measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from scipy.special import ndtr

from reseau.calibration import Calibration
from reseau.cli import run
from reseau.images import write_image
from reseau.refine.sensor import Level, SensorSeries, calibrate_sensor
from reseau_sims import World
from reseau_sims.pixels import PixelSensor
from reseau_sims.serving import CameraBody, Lamp, VideoCamera

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
def bench(tmp_path: Path, sensor: PixelSensor, monkeypatch: pytest.MonkeyPatch) -> Path:
    lamp = Lamp(sensor, 1.0)
    camera = VideoCamera(CameraBody(lamp, 96, 64))
    camera.controls[0x980900] = 128
    monkeypatch.setattr("reseau_drivers.camera.KernelNode", lambda address: camera.open())

    def by_hand(text: str, **_: Any) -> str:
        return text

    def said(text: str = "", err: bool = False, **_: Any) -> None:
        # Whoever is asked covers the lens, or takes the cover off.
        if "cover" in text:
            lamp.light = 0.0
        elif "even light" in text:
            lamp.light = 1.0
        elif "edge" in text:
            y, x = np.mgrid[:64, :96]
            lamp.light = ndtr((x - 48 - 0.1 * (y - 32)) / 0.6)

    monkeypatch.setattr(typer, "prompt", by_hand)
    monkeypatch.setattr(typer, "echo", said)
    path = tmp_path / "bench.toml"
    path.write_text(BENCH)
    return path


def test_a_sensor_is_calibrated_on_the_bench(
    bench: Path, sensor: PixelSensor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sensor.json"
    command = ["capture", "sensor", "--bench", str(bench), "--out", str(out), "--frames", "4", "--edge"]
    assert run([*command, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    for name in ("gain", "read_noise", "full_well"):
        found = said["parameters"][name]
        assert abs(found["value"] - getattr(sensor, name)) < 4 * found["sigma"], name
    # 0.6 px along x are less along the normal; 1/12 of them is the pixel's own square.
    psf = said["parameters"]["psf"]
    assert psf["value"] == pytest.approx(np.sqrt(0.6**2 / 1.01 - 1 / 12), abs=0.03)
    assert said["validity"]["defects"] < 12
    calibration = Calibration.read(out)
    assert calibration.times
    assert calibration.values()["gain"] == said["parameters"]["gain"]["value"]
    assert run(command[:-1]) == 0
    assert "full_well" in capsys.readouterr().out


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


def test_wrong_use_is_said(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "sensor.json")
    for options in (["--camera", "none"], ["--bench", str(tmp_path / "none.toml")], ["--levels", "1"]):
        base = ["capture", "sensor", "--bench", str(bench), "--out", out]
        assert run([*base, *options]) == 2
    assert "none is no camera" not in capsys.readouterr().out
    assert not (tmp_path / "sensor.json").exists()
