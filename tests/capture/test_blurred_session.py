"""Targets on a frame under water over the real protocols: captured, measured by rays, and adjusted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau import sessions
from reseau.archive import Archive, Session
from reseau.bundle import Camera, Network
from reseau.bundle.network import network_document
from reseau.capture import Bench, BenchFile, InstrumentEntry
from reseau.capture.bench import built
from reseau.core.data import Frame
from reseau.core.errors import FormatError, UsageError
from reseau.instruments import Instrument
from reseau.io.network import Network1
from reseau.io.refraction import RefractionEntry
from reseau.optics.poses import matrix_to_vector
from reseau_drivers.camera import v4l2
from reseau_sims import Water
from reseau_sims.frame import SpaceFrame
from reseau_sims.laboratory import Laboratory
from reseau_sims.serving import SimulatedBench

POSES = {
    "left": {"tilt": 30.0, "roll": 0.0, "camera_roll": 0.0},
    "right": {"tilt": 30.0, "roll": 180.0, "camera_roll": 180.0},
    "below": {"tilt": 35.0, "roll": 90.0, "camera_roll": 0.0},
}
CAMERA = '\n[instruments.camera]\ndriver = "v4l2"\naddress = "in process"\n'
CONTROL = 8
SIGMA_PX = 0.3


def project(laboratory: Laboratory, water: Water) -> str:
    """The network before the session: poses to some millimetres, coordinates to some pixels."""
    frame, rng = laboratory.field.frame, np.random.default_rng(3)
    assert frame is not None
    names, targets = tuple(POSES), frame.targets.targets.id
    places, known = frame.xyz, np.arange(len(targets)) < CONTROL
    turns, centres, image_of, point_of, xy = [], [], [], [], []
    for i, position in enumerate(POSES.values()):
        pose = laboratory.pose_at(position)
        turns.append(matrix_to_vector(pose.matrix) + rng.normal(0, 2e-3, 3))
        centres.append(pose.x0 + rng.normal(0, 3.0, 3))
        # A camera only knows its own water roughly: as designed, not as made.
        seen = frame.seen_by(water).corresponding(pose(places))
        inside = ((seen > 20) & (seen < np.array([639, 479]) - 20)).all(axis=1)
        xy.append(np.rint(seen[inside]))
        image_of.append(np.full(int(inside.sum()), i))
        point_of.append(np.flatnonzero(inside))
    near = frame.lens.corresponding(np.array([[0.0, 0.0, 1e5], [1e3, 0.0, 1e5]]))
    c = float(near[1, 0] - near[0, 0]) * 0.02 * 100.0
    n = sum(map(len, xy))
    network = Network(
        cameras=(
            Camera("camera", 640, 480, (0.02, 0.02), "brown", np.array([c, *9 * [0.0]]), ("c", "K1", "K2"),
                   {"side": "object"}),
        ),
        images=names, camera_of=np.zeros(3, np.intp), x0=np.array(centres), rotation=np.array(turns),
        points=targets, xyz=np.where(known[:, None], places, np.nan),
        sigma=np.where(known[:, None], 0.0, np.nan) * np.ones(3),
        role=tuple("control" if each else "tie" for each in known), image_of=np.concatenate(image_of),
        point_of=np.concatenate(point_of), xy=np.concatenate(xy),
        cov=np.tile(np.eye(2) * SIGMA_PX**2, (n, 1, 1)), distance_of=np.zeros((0, 2), np.intp),
        distance=np.zeros((0, 2)), datum="control", datum_points=np.ones(len(targets), dtype=bool),
        groups=(None,) * 3, files=(None,) * 3, unit="mm",
    )  # fmt: skip
    x, y = np.tan(np.deg2rad(water.tilt_deg))
    described = {
        "media": {
            "air": 1.0,
            "glass": {"medium": "N-BK7", "wavelength_nm": 546.1},
            "water": {
                "medium": {"water": {"temperature_c": water.temperature_c}}, "wavelength_nm": 546.1
            },
        },
        "windows": [{
            "id": "port", "shape": "plane", "on": "camera", "media": ["air", "glass", "water"],
            "parameters": {
                "tilt_X": y, "tilt_Y": -x, "distance": water.distance_mm, "thickness": water.thickness_mm
            },
            "free": ["tilt_X", "tilt_Y", "distance"],
            "sigma": {"tilt_X": 0.005, "tilt_Y": 0.005, "distance": 0.5},
        }],
    }  # fmt: skip
    entry = RefractionEntry.model_validate_json(json.dumps(described))
    return network_document(network).model_copy(update={"refraction": entry}).to_json()


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
        inputs = {"network.json": project(simulated.laboratory, water), **simulated.documents}
        parameters = {"steps": [[name, dict(at)] for name, at in POSES.items()], "home": True, "psf": 0.7}
        archive = Archive.open(folder, create=True)
        session = sessions.begin(archive, "wet", "blurred", parameters, inputs, bench=text)
        with Bench(file.model_copy(update={"instruments": used}), build) as bench:
            sessions.capture(session, bench)
        assert not any(simulated.violations.values())
        return session, simulated.laboratory, sessions.procedure_of(session)


def test_a_session_measures_blurred_targets_under_water_by_rays(tmp_path: Path) -> None:
    session, laboratory, _ = captured(tmp_path / "archive")
    assert session.status == "done"
    results = {each.name: session.content(each) for each in session.results()}
    assert {"round-0.json", "round-1.json", "result.json", "network.json", "report.html"} <= set(results)
    # The same frames of the archive give the same bytes.
    assert all(each.same for each in sessions.rerun(session))

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
    inputs = {"network.json": project(laboratory, water), **laboratory.field.frame.documents}  # type: ignore[union-attr]
    parameters = {"steps": [[name, dict(at)] for name, at in POSES.items()]}
    archive = Archive.open(tmp_path / "archive", create=True)
    session = sessions.begin(archive, "dry", "blurred", parameters, inputs)
    procedure: Any = sessions.procedure_of(session)
    step = sessions.parameters_of(session).poses()[0]  # type: ignore[attr-defined]
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
        sessions.begin(archive, "mine", "blurred", {"steps": []}, {})
    frame = SpaceFrame()
    inputs = {"network.json": frame.documents["targets.json"], **frame.documents}
    with pytest.raises(FormatError, match=r"network\.json"):
        sessions.begin(archive, "mine", "blurred", {"steps": []}, inputs)
