"""`kill -9` at random moments, resumed each time: no frame lost, none doubled, the same calibration.

The kills are shared between a session that measures, one that only stores, where most time is spent between
file and index, one over real protocols with one fault in a hundred answers, and one of a rig of two cameras,
of which one frame in a hundred suffers a fault. `RESEAU_KILLS` says how many.
"""

import json
import os
import random
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive, Session
from reseau.archive.records import ArchivedFrame
from reseau.archive.verification import verify
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry, carry_out, paper_steps, plans
from reseau.capture.bench import built
from reseau.instruments import Instrument
from reseau_drivers.camera import rig, v4l2
from reseau_sims.serving import FaultScript
from reseau_sims.serving.bench import SimulatedBench
from reseau_sims.serving.imaging import LaboratoryScene, SimulatedCamera, StripeScene, View
from reseau_sims.serving.v4l2 import VideoCamera

from .fieldrig import FieldRig
from .killing import Ended, ended

KILLS = int(os.environ.get("RESEAU_KILLS", "200"))
POSES = paper_steps()[:12]
FRAMES = 40
FAULTY = ("faults", "two cameras")
SIDES = ("left", "right")
HEAVY = ("reseau.bundle.modelling.adjustment", "tests.capture.loaded")
"""Modules that take long to import, and one that loads compiled loops: a session that is killed while it
loads them makes no progress."""


def work(place: Path, kind: str, seed: int) -> None:
    """As `reseau capture` on a new bench: begin or resume, and continue to the end."""
    with Archive.open(place, create=True) as archive, ExitStack() as stack:
        names = [each.name for each in archive.sessions()]
        kept = archive.session("s") if "s" in names else archive.begin("s", kind, {})
        kept.recover()
        field = FieldRig()
        procedure = None if kind in ("frames", "two cameras") else field.procedure()
        if kind == "two cameras":
            pair = stack.enter_context(two_cameras(seed))
            taking = Acquisition(pair, kept, camera="rig")
            carry_out(taking, plans.frames(taking, FRAMES))
        elif kind == "faults":
            bench = stack.enter_context(faulty(seed))
            run = Acquisition(bench, kept, procedure)
            carry_out(run, plans.homed(run, plans.poses(run, POSES)))
        else:
            run = field.acquisition(kept, procedure)
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


@contextmanager
def two_cameras(seed: int) -> Iterator[Bench]:
    """Two cameras that expose at once; one frame in a hundred of each suffers a fault."""
    videos = {
        name: VideoCamera(
            SimulatedCamera(
                StripeScene(shift=k), script=FaultScript(rate=0.01, seed=2 * seed + k, seconds=0.05)
            )
        )
        for k, name in enumerate(SIDES)
    }
    entries = {name: InstrumentEntry(driver="v4l2", address="in this process") for name in SIDES}
    entries["rig"] = InstrumentEntry(driver="rig", address=", ".join(SIDES))

    def build(name: str, entry: InstrumentEntry) -> Instrument:
        if name == "rig":
            return rig(name, entry.address)
        return v4l2(name, videos[name].open, settings={"exposure_us": 10_000.0}, seconds=1.0)

    with Bench(BenchFile(name="two", instruments=entries), build) as bench:
        yield bench


def run(place: Path, kind: str, after_s: float | None, seed: int = 0) -> Ended:
    """A process that comes to its end, is killed before, or is ended by an instrument."""
    found = ended(work, (place, kind, seed), after_s, HEAVY)
    assert found.code in ((0, 1, -signal.SIGKILL) if kind in FAULTY else (0, -signal.SIGKILL))
    return found


def held(place: Path, kind: str) -> tuple[list[tuple[str, int, str]], list[Any]]:
    """Good frames in their order, and the results of the session."""
    with Archive.open(place) as archive:
        assert verify(archive)
        kept = archive.session("s")
        assert kept.status == "done"
        frames = [f for f in kept.frames(kind="frame") if f.verdict is not None and f.verdict.ok]
        if kind == "two cameras":
            return held_sets(kept), []
        if kind != "faults":
            assert len(frames) == len(kept.frames(kind="frame"))
            contents = [kept.content(result) for result in kept.results()]
            return [(f.step, f.take, f.sha256) for f in frames], contents
        # Of a frame that came damaged there is a second take, with a name and a hash of its own.
        assert all(np.isfinite(kept.picture(f).pixels).all() for f in frames)
        documents = [json.loads(kept.content(result)) for result in kept.results()]
        kept_of = [{key: d[key] for key in ("parameters", "covariance", "sigma0")} for d in documents]
        return [(f.step, 0, "") for f in frames], kept_of


def held_sets(kept: Session) -> list[tuple[str, int, str]]:
    """Good exposures in their order; both frames of each are there once, each of its own camera."""
    frames = kept.frames(kind="frame")
    exposures: dict[tuple[str, int], list[ArchivedFrame]] = {}
    for frame in frames:
        exposures.setdefault((frame.facts["exposure"], frame.take), []).append(frame)
    for (exposure, _), members in exposures.items():
        assert [frame.step for frame in members] == [f"{side}/{exposure}" for side in SIDES]
        assert len({frame.facts["set"] for frame in members}) == 1
        for k, frame in enumerate(members):
            view = View(10_000.0, 0.0, 0.0, 0, 0, 96, 64, 255.0)
            assert (kept.picture(frame).pixels == StripeScene(shift=k)(view)).all()
    good = [e for e, members in exposures.items() if all(f.verdict and f.verdict.ok for f in members)]
    # As many as were asked for, each once.
    return [(exposure, 0, "") for exposure, _ in good]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["testfield", "frames", "faults", "two cameras"])
@pytest.mark.timeout(3600)
def test_a_killed_and_resumed_session_gives_the_same_result(kind: str, tmp_path: Path) -> None:
    rng, attempts = random.Random(kind), count(7)
    # The same faults again would end a session at the same place for ever.
    parts = [run(tmp_path / "undisturbed", kind, None, next(attempts))]
    while parts[-1].code != 0:
        assert kind in FAULTY  # those of the instruments end a session; it is resumed
        parts.append(run(tmp_path / "undisturbed", kind, None, next(attempts)))
    # Of all parts: the last one may be so short that a session killed within it never makes progress.
    seconds = sum(part.seconds for part in parts)
    undisturbed = held(tmp_path / "undisturbed", kind)
    assert len(undisturbed[0]) == (FRAMES if kind in ("frames", "two cameras") else len(POSES))
    kills = sessions = 0
    while kills < KILLS // 4:
        place = tmp_path / f"killed {sessions}"
        # Half of an undisturbed run on average: each session is killed a few times.
        while (found := run(place, kind, rng.uniform(0, seconds), next(attempts))).code != 0:
            kills += found.code == -signal.SIGKILL
        assert held(place, kind) == undisturbed
        sessions += 1
