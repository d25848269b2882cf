"""The series of a sensor: streamed, retried, killed and resumed; memory use of its procedure."""

from __future__ import annotations

import json
import os
import random
import signal
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive, Session
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry, Step, carry_out
from reseau.capture.engine import Decision, rerun
from reseau.capture.plans import NO_EXPOSURE_LIMITS, SensorSeriesPlan, sensor
from reseau.core.data import Frame
from reseau.core.errors import DeadlineError, EstimationError, StateError
from reseau.procedures.sensor import SensorProcedure
from reseau_drivers.camera import v4l2
from reseau_sims.pixels import PixelSensor
from reseau_sims.serving import LampScene, SimulatedCamera, VideoCamera

from ..montecarlo import slowly
from .killing import Ended, ended

PLAN = SensorSeriesPlan(levels=10, frames=3, longest_us=40_000.0)


class Rig:
    """A camera in front of a lamp; the operator covers it on request."""

    def __init__(self, light: float = 1.0, noise: int = 0) -> None:
        drawn = PixelSensor.drawn(np.random.default_rng(2), 48, 32, full_well=12_000.0)
        self.light, self.lamp = light, LampScene(drawn, light, seed=noise)
        camera = VideoCamera(SimulatedCamera(self.lamp, 48, 32))
        camera.controls[0x980900] = 128
        self.settings = {"format": "Y12", "exposure_us": 1000.0, "buffers": 16}
        self.camera = v4l2("eye", camera.open, settings=self.settings)
        entry = InstrumentEntry(driver="v4l2", address="in process")
        file = BenchFile(name="sensor", instruments={"eye": entry})
        self.bench = Bench(file, lambda name, entry: self.camera)
        self.events: list[tuple[str, dict[str, Any]]] = []

    def operator(self, what: str) -> None:
        self.lamp.light = 0.0 if "cover" in what else self.light

    def carry_out(self, kept: Session, plan: SensorSeriesPlan = PLAN, decision: Decision = "stop") -> None:
        run = Acquisition(
            self.bench, kept, SensorProcedure(name="eye"), limits=NO_EXPOSURE_LIMITS, operator=self.operator,
            watch=lambda kind, facts: self.events.append((kind, facts)),
        )  # fmt: skip
        carry_out(run, sensor(run, plan), paused=lambda: decision)


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Session]:
    with Archive.open(tmp_path / "archive", create=True) as archive:
        yield archive.begin("s", "sensor", {})


def test_a_series_is_streamed_and_the_camera_settings_are_restored(kept: Session) -> None:
    rig = Rig()
    with rig.bench:
        rig.carry_out(kept)
        assert rig.camera.settings.to_dict()["exposure_us"] == 1000.0
    frames = kept.frames(kind="frame")
    assert len(frames) == PLAN.count == len({frame.step for frame in frames})
    assert all(frame.verdict is not None and frame.verdict.ok for frame in frames)
    # Light at growing exposures, then the dark at three of them, as reported by the camera.
    exposures = {frame.step.rpartition(" ")[0]: frame.facts["exposure_us"] for frame in frames}
    light = [exposure for step, exposure in exposures.items() if step.startswith("light")]
    assert light == sorted(set(light))
    dark = [exposure for step, exposure in exposures.items() if step.startswith("dark")]
    assert dark == [light[0], light[5], light[9]]
    assert kept.frames(kind="probe")[0].facts["identity"] == str(rig.camera.connect())
    # Of a stream only the first of a level is waited for: numbers follow one another.
    numbers = [frame.clock["sequence"][0] for frame in frames]
    gaps = np.diff(np.array(numbers).reshape(-1, PLAN.frames), axis=1)
    assert (gaps == 1).mean() > 0.9


def test_a_missing_frame_is_requested_again(kept: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, fails = Rig(), [3, 17, 30]
    taken, frames = [0], type(rig.camera).frames

    def failing(self: Any, count: int, seconds: float | None = None) -> Iterator[Any]:
        for shot in frames(self, count, seconds):
            taken[0] += 1
            if taken[0] in fails:
                raise DeadlineError("delivered no new frame", where="eye")
            yield shot

    monkeypatch.setattr(type(rig.camera), "frames", failing)
    with rig.bench:
        rig.carry_out(kept)
    assert [kind for kind, _ in rig.events].count("again") == len(fails)
    assert len(kept.frames(kind="frame")) == PLAN.count
    assert kept.results()


@pytest.mark.slow
@pytest.mark.parametrize("decision", ["resume", "stop"])
def test_a_series_is_resumed_where_it_was_interrupted(
    kept: Session, monkeypatch: pytest.MonkeyPatch, decision: Decision
) -> None:
    rig = Rig()
    taken, frames = [0], type(rig.camera).frames

    def interrupted(self: Any, count: int, seconds: float | None = None) -> Iterator[Any]:
        for shot in frames(self, count, seconds):
            taken[0] += 1
            if taken[0] == 9:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.02)
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.2)
            yield shot

    monkeypatch.setattr(type(rig.camera), "frames", interrupted)
    with rig.bench:
        rig.carry_out(kept, decision=decision)
        if decision == "stop":
            assert kept.status == "stopped"
            assert not kept.results()
            assert rig.camera.settings.to_dict()["exposure_us"] == 1000.0
            rig.carry_out(kept)
    assert kept.status == "done"
    steps = [frame.step for frame in kept.frames(kind="frame")]
    assert len(steps) == len(set(steps)) == PLAN.count
    (again,) = rerun(kept, SensorProcedure(name="eye"))
    assert again.same


def test_missing_and_excessive_light_are_reported(tmp_path: Path) -> None:
    for light, message in (
        (0.0, "gives almost no signal at 8 ms"),
        (1e4, "saturated at its shortest exposure"),
    ):
        with Archive.open(tmp_path / f"{light:g}", create=True) as archive, (rig := Rig(light)).bench:
            kept = archive.begin("s", "sensor", {})
            with pytest.raises(StateError, match=message):
                rig.carry_out(kept, SensorSeriesPlan(5, 2, 8000.0))
            assert rig.camera.settings.to_dict()["exposure_us"] == 1000.0
            assert not kept.frames(kind="frame")


@pytest.mark.parametrize("light", [*slowly(0.1), 3.0])
def test_exposures_range_from_little_light_to_saturation(kept: Session, light: float) -> None:
    rig = Rig(light)
    with rig.bench:
        rig.carry_out(kept, SensorSeriesPlan(10, 2, 60_000.0))
    validity = json.loads(kept.content(kept.results()[-1]))["validity"]
    assert validity["saturated"]


def test_the_procedure_keeps_no_frames_in_memory() -> None:
    rng, peaks = np.random.default_rng(0), []
    for count in (10, 200):
        live = SensorProcedure(name="eye")
        tracemalloc.start()
        for k in range(count):
            frame = Frame(rng.integers(0, 4095, (200, 300)).astype(np.uint16), 4095.0)
            assert live.on_frame(frame, Step(f"light 00 {k:03d}", exposure_us=100.0)).ok
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # Two images of the sums, and what one frame needs on its way into them.
    assert peaks[1] < peaks[0] + 100_000
    assert peaks[1] < 9 * 8 * 200 * 300


def test_frames_that_are_not_part_of_the_series_are_rejected() -> None:
    live = SensorProcedure(name="eye")
    frame = Frame(np.full((8, 8), 100, dtype=np.uint8), 255.0)
    assert not live.on_frame(frame, Step("00000")).ok
    assert live.on_frame(frame, Step("light 00 000", exposure_us=1.0)).ok
    other = Frame(np.zeros((8, 9), dtype=np.uint8), 255.0)
    assert "frames of" in live.on_frame(other, Step("light 00 001", exposure_us=1.0)).why
    white = Frame(np.full((8, 8), 255, dtype=np.uint8), 255.0)
    assert "saturated" in live.on_frame(white, Step("edge 00 000", exposure_us=1.0)).why
    with pytest.raises(EstimationError, match="eye: 0 dark and 0 bright"):
        live.finish()


def work(place: Path) -> None:
    """As `reseau capture sensor`: begin or resume, and continue to the end."""
    # The variance within a level is measured: no frame repeats the noise of one that a killed process stored.
    with Archive.open(place, create=True) as archive, (rig := Rig(noise=os.getpid())).bench:
        names = [each.name for each in archive.sessions()]
        kept = archive.session("s") if "s" in names else archive.begin("s", "sensor", {})
        kept.recover()
        rig.carry_out(kept)


def run(place: Path, after_s: float | None) -> Ended:
    """A process that comes to its end, or is killed before."""
    found = ended(work, (place,), after_s, ["reseau.procedures.sensor"])
    assert found.code in (0, -signal.SIGKILL)
    return found


def stored(place: Path) -> dict[str, str]:
    """Good frames of a session, each once."""
    with Archive.open(place, create=True) as archive:
        frames = [] if not archive.sessions() else archive.session("s").frames(kind="frame")
    assert len(frames) == len({frame.step for frame in frames})
    return {frame.step: frame.sha256 for frame in frames}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_frame_is_lost_or_duplicated_when_the_process_is_killed(tmp_path: Path) -> None:
    rng, kills = random.Random(1), 0
    code, seconds = run(tmp_path / "undisturbed", None)
    assert code == 0
    for number in range(12):
        place, held = tmp_path / f"killed {number}", dict[str, str]()
        while run(place, rng.uniform(0, 0.7) * seconds).code != 0:
            kills, before, held = kills + 1, held, stored(place)
            assert before.items() <= held.items()
        assert held.items() <= stored(place).items()
        with Archive.open(place) as archive:
            kept = archive.session("s")
            assert kept.status == "done"
            assert len(stored(place)) == PLAN.count
            (again,) = rerun(kept, SensorProcedure(name="eye"))
            assert again.same
            inputs = json.loads(kept.content(kept.results()[-1]))["provenance"]["inputs"]
            assert inputs == stored(place)
    assert kills > 6
