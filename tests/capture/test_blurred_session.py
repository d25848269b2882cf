"""Targets on a frame under water over the real protocols: captured, measured by rays, and adjusted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive, Session
from reseau.capture import Bench, BenchFile, InstrumentEntry
from reseau.capture.bench import built
from reseau.core.data import Frame
from reseau.core.errors import FormatError, UsageError
from reseau.instruments import Instrument
from reseau.io.network import Network1
from reseau.sessions import conducting
from reseau_drivers.camera import v4l2
from reseau_sims import Water
from reseau_sims.frame import PROJECT_POSES, SpaceFrame, project
from reseau_sims.laboratory import Laboratory
from reseau_sims.serving import SimulatedBench

CAMERA = '\n[instruments.camera]\ndriver = "v4l2"\naddress = "in process"\n'


def captured(folder: Path) -> tuple[Session, Laboratory, Any]:
    """A session of three poses."""
    water = Water(tilt_deg=(0.0, 1.0))
    with SimulatedBench(2, camera="frame", repeatable=True, in_process=True, water=water) as simulated:
        text, video = simulated.toml.replace("speed = 50.0", "speed = 1000.0") + CAMERA, simulated.video
        assert video is not None

        def build(name: str, entry: InstrumentEntry) -> Instrument:
            if name == "table":
                return built(name, entry)
            return v4l2(name, video.open, settings={"exposure_us": 10_000.0}, seconds=60.0)

        file = BenchFile.parse_toml(text, where="bench.toml")
        used = {name: file.instruments[name] for name in ("table", "camera")}
        inputs = {
            "network.json": simulated.documents["project.json"],
            **{name: simulated.documents[name] for name in ("targets.json", "lens.toml")},
        }
        parameters = {
            "steps": [[name, dict(at)] for name, at in PROJECT_POSES.items()],
            "home": True,
            "psf_px": 0.7,
        }
        archive = Archive.open(folder, create=True)
        session = conducting.begin(archive, "wet", "blurred", parameters, inputs, bench=text)
        with Bench(file.model_copy(update={"instruments": used}), build) as bench:
            conducting.capture(session, bench)
        assert not any(simulated.violations.values())
        return session, simulated.laboratory, conducting.procedure_of(session)


@pytest.mark.slow
def test_a_session_measures_blurred_targets_under_water_by_rays(tmp_path: Path) -> None:
    session, laboratory, _ = captured(tmp_path / "archive")
    assert session.status == "done"
    results = {each.name: session.content(each) for each in session.results()}
    assert {"round-0.json", "round-1.json", "result.json", "network.json", "report.html"} <= set(results)
    # The same frames of the archive give the same bytes.
    assert all(each.same for each in conducting.rerun(session))

    frame = laboratory.field.frame
    assert frame is not None
    first, last = (json.loads(results[name]) for name in ("round-0.json", "result.json"))
    errors = []
    for document in (first, last):
        points = document["points"]
        rows = [k for k, role in enumerate(points["role"]) if role == "tie"]
        found = np.array([points["xyz"][k] for k in rows], dtype=float)
        true = frame.xyz[[frame.targets.targets.id.index(points["id"][k]) for k in rows]]
        errors.append(float(np.sqrt(np.nanmean((found - true) ** 2))))
    # By rays, points are at least three times better than by centres of gravity.
    assert errors[1] < errors[0] / 3
    assert errors[1] < 0.1
    final = Network1.parse(results["network.json"].decode(), where="network.json")
    assert max(final.observations.sx) < 0.1


def test_frames_without_the_targets_are_declined(tmp_path: Path) -> None:
    water = Water()
    laboratory = SimulatedBench(2, camera="frame", repeatable=True, in_process=True).laboratory
    frame = laboratory.field.frame
    assert frame is not None
    poses = {name: laboratory.pose_at(position) for name, position in PROJECT_POSES.items()}
    inputs = {"network.json": project(frame, poses, water), **frame.documents}
    parameters = {"steps": [[name, dict(at)] for name, at in PROJECT_POSES.items()]}
    archive = Archive.open(tmp_path / "archive", create=True)
    session = conducting.begin(archive, "dry", "blurred", parameters, inputs)
    procedure: Any = conducting.procedure_of(session)
    step = conducting.parameters_of(session).poses()[0]  # type: ignore[attr-defined]
    blank = Frame(np.random.default_rng(0).normal(200.0, 1.0, (480, 640)), 255.0, "blank")
    assert not procedure.on_frame(blank, step).ok
    assert "stand out" in procedure.on_frame(blank, step).why
    small = Frame(np.zeros((240, 240)), 255.0, "small")
    assert "240×240 pixels, not 640×480" in procedure.on_frame(small, step).why
    assert "not an image" in procedure.on_frame(blank, replace(step, name="nowhere")).why
    assert procedure.next_pose([step], "c") == (step, None)


def test_an_input_of_another_kind_is_refused(tmp_path: Path) -> None:
    archive = Archive.open(tmp_path / "archive", create=True)
    with pytest.raises(UsageError, match="missing input"):
        conducting.begin(archive, "mine", "blurred", {"steps": []}, {})
    frame = SpaceFrame()
    inputs = {"network.json": frame.documents["targets.json"], **frame.documents}
    with pytest.raises(FormatError, match=r"network\.json"):
        conducting.begin(archive, "mine", "blurred", {"steps": []}, inputs)
