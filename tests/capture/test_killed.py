"""`kill -9` at random moments, resumed each time: no frame lost, none doubled, the same calibration.

The kills are shared between a session that measures, one that only stores, where most time is spent between
file and index, and one over real protocols with one fault in a hundred answers. `RESEAU_KILLS` says how many.
"""

import json
import os
import random
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive, verify
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry, carry_out, paper_steps, plans
from reseau.capture.bench import built
from reseau.instruments import Instrument
from reseau_drivers.camera import v4l2
from reseau_sims.serving import FaultScript
from reseau_sims.serving.bench import SimulatedBench
from reseau_sims.serving.imaging import LaboratoryScene, SimulatedCamera
from reseau_sims.serving.v4l2 import VideoCamera

from .fieldrig import FieldRig
from .killing import Ended, ended

KILLS = int(os.environ.get("RESEAU_KILLS", "200"))
POSES = paper_steps()[:12]
FRAMES = 40
HEAVY = (
    "reseau.optics.compiled",
    "reseau.bundle.solver.compiled",
    "reseau.measure.testfield.measure",
    "reseau.bundle.modelling.adjustment",
)
"""Modules that take long to import."""


def work(place: Path, kind: str, seed: int) -> None:
    """As `reseau capture` on a new bench: begin or resume, and continue to the end."""
    with Archive.open(place, create=True) as archive, ExitStack() as stack:
        names = [each.name for each in archive.sessions()]
        kept = archive.session("s") if "s" in names else archive.begin("s", kind, {})
        kept.recover()
        rig = FieldRig()
        procedure = None if kind == "frames" else rig.procedure()
        if kind == "faults":
            bench = stack.enter_context(faulty(seed))
            run = Acquisition(bench, kept, procedure)
            carry_out(run, plans.homed(run, plans.poses(run, POSES)))
        else:
            run = rig.acquisition(kept, procedure)
            carry_out(run, plans.frames(run, FRAMES) if procedure is None else plans.poses(run, POSES))


@contextmanager
def faulty(seed: int) -> Iterator[Bench]:
    """Table and camera of the simulated bench; one answer in a hundred suffers a fault, and one frame."""
    with SimulatedBench(3, repeatable=True, flat=True) as simulated:
        simulated.scripts["table"].at_random(0.01, seed=seed)
        script = FaultScript(rate=0.01, seed=seed + 1)
        camera = VideoCamera(
            SimulatedCamera(LaboratoryScene(simulated.laboratory, "testfield"), 240, 240, script)
        )
        file = BenchFile.parse_toml(simulated.toml, where="simulated")
        table = file.instruments["table"]
        entries = {"table": table.model_copy(update={"settings": {"speed": 1000.0}})}
        entries["camera"] = InstrumentEntry(driver="v4l2", address="in process")

        def build(name: str, entry: InstrumentEntry) -> Instrument:
            if name == "table":
                return built(name, entry)
            return v4l2(name, camera.open, settings={"exposure_us": 10_000.0})

        with Bench(file.model_copy(update={"instruments": entries}), build) as bench:
            yield bench


def run(place: Path, kind: str, after_s: float | None, seed: int = 0) -> Ended:
    """A process that comes to its end, is killed before, or is ended by an instrument."""
    found = ended(work, (place, kind, seed), after_s, HEAVY)
    assert found.code in ((0, 1, -signal.SIGKILL) if kind == "faults" else (0, -signal.SIGKILL))
    return found


def held(place: Path, kind: str) -> tuple[list[tuple[str, int, str]], list[Any]]:
    """Good frames in their order, and the results of the session."""
    with Archive.open(place) as archive:
        assert verify(archive)
        kept = archive.session("s")
        assert kept.status == "done"
        frames = [f for f in kept.frames(kind="frame") if f.verdict is not None and f.verdict.ok]
        if kind != "faults":
            assert len(frames) == len(kept.frames(kind="frame"))
            contents = [kept.content(result) for result in kept.results()]
            return [(f.step, f.take, f.sha256) for f in frames], contents
        # Of a frame that came damaged there is a second take, with a name and a hash of its own.
        assert all(np.isfinite(kept.picture(f).pixels).all() for f in frames)
        documents = [json.loads(kept.content(result)) for result in kept.results()]
        kept_of = [{key: d[key] for key in ("parameters", "covariance", "sigma0")} for d in documents]
        return [(f.step, 0, "") for f in frames], kept_of


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["testfield", "frames", "faults"])
@pytest.mark.timeout(7200)
def test_a_killed_and_resumed_session_gives_the_same_result(kind: str, tmp_path: Path) -> None:
    rng = random.Random(kind)
    while (found := run(tmp_path / "undisturbed", kind, None)).code != 0:
        assert kind == "faults"  # those of the instruments end a session; it is resumed
    seconds = found.seconds
    undisturbed = held(tmp_path / "undisturbed", kind)
    assert len(undisturbed[0]) == (FRAMES if kind == "frames" else len(POSES))
    kills = sessions = 0
    while kills < KILLS // 3:
        place = tmp_path / f"killed {sessions}"
        # Half of an undisturbed run on average: each session is killed a few times.
        while (found := run(place, kind, rng.uniform(0, seconds), seed=kills + 7)).code != 0:
            kills += found.code == -signal.SIGKILL
        assert held(place, kind) == undisturbed
        sessions += 1
