"""A testfield on a z-stage: the heights of a pose have one orientation, and frontal views give c."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from reseau.archive import Archive, Session
from reseau.capture import Step, carry_out, plans
from reseau.capture.engine import rerun
from reseau.capture.steps import at_heights
from reseau.core.errors import EstimationError
from reseau.procedures.calibrated import Calibrated
from reseau_sims import FieldBench

from .fieldrig import AXES, FieldRig

HEIGHTS = (0.0, 200.0, 400.0, 600.0)
TILT, SIGMAS = (4e-3, -3e-3), (0.05, 5e-3, 1e-3)
FRONTAL = at_heights((Step("frontal", dict.fromkeys(AXES, 0.0)),), HEIGHTS)


def make_rig() -> FieldRig:
    field = FieldBench(seed=3, bend_mm=0.0, stage_tilt=TILT, stage_sigma_mm=SIGMAS[0])
    return FieldRig(field, (*AXES, "z"))


def new_session(folder: Path) -> Session:
    return Archive.open(folder, create=True).begin("monday", "testfield", {"design": "field"})


@pytest.mark.slow
def test_frontal_frames_at_several_heights_give_the_principal_distance(tmp_path: Path) -> None:
    rig, session, live = make_rig(), new_session(tmp_path / "archive"), make_rig().procedure(sigmas=SIGMAS)
    run = rig.acquisition(session, live)
    carry_out(run, plans.poses(run, FRONTAL))
    found = live.calibrated()
    assert isinstance(found, Calibrated)
    result = found.result
    assert len(np.unique(result.fit.values.rotation, axis=0)) == 1  # one orientation
    # Sigmas contain what formed images lack of real ones (0.002 px); the simulated ones lack nothing.
    assert 0.85 < result.sigma0 < 1.1
    c = json.loads(session.content(session.results()[-1]))["parameters"]["c"]
    assert abs(c["value"] - 57.5) < 3 * c["sigma"] < 0.15
    assert all(again.same for again in rerun(session, rig.procedure(sigmas=SIGMAS)))

    with pytest.raises(EstimationError):  # each height an image of its own: a plane leaves c and the distance
        rerun(session, rig.procedure())


@pytest.mark.slow
def test_a_session_stopped_between_heights_is_resumed_with_the_same_result(tmp_path: Path) -> None:
    rig, session, straight = make_rig(), new_session(tmp_path / "archive"), new_session(tmp_path / "straight")
    rig.camera.during = lambda number: os.kill(os.getpid(), signal.SIGTERM) if number == 3 else None
    run = rig.acquisition(session, rig.procedure(sigmas=SIGMAS))
    carry_out(run, plans.poses(run, FRONTAL))
    assert session.status == "stopped"
    rig.camera.during = lambda number: None
    again = rig.acquisition(session, rig.procedure(sigmas=SIGMAS))
    carry_out(again, plans.poses(again, FRONTAL))
    other = make_rig()
    run = other.acquisition(straight, other.procedure(sigmas=SIGMAS))
    carry_out(run, plans.poses(run, FRONTAL))
    assert session.content(session.results()[-1]) == straight.content(straight.results()[-1])


@pytest.mark.slow
def test_the_predicted_gain_of_another_height_is_reached() -> None:
    rig = make_rig()
    live = rig.procedure(sigmas=SIGMAS)
    for step in FRONTAL[:3]:
        rig.table.stands.update(step.position)
        assert live.on_frame(rig.camera.expose().frame, step)
    chosen = live.next_pose(FRONTAL[3:], "c")
    assert chosen is not None
    step, predicted = chosen
    before = live.progress()["sigma_c"]
    rig.table.stands.update(step.position)
    live.on_frame(rig.camera.expose().frame, step)
    assert predicted is not None
    assert predicted < before
    # What images have in common is estimated anew with each: here it changes by a tenth.
    assert abs(live.progress()["sigma_c"] / predicted - 1) < 0.2
