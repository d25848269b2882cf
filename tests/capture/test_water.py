"""A testfield under water over the real protocols: the bench describes the port, the session adjusts it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive
from reseau.bundle import Result
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry, Step, carry_out, plans
from reseau.capture.bench import built
from reseau.designs import coded_testfield
from reseau.instruments import Instrument
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CalibrationOptions, CameraOptions
from reseau.procedures.target_measurement import measurer_of
from reseau.sessions import conducting
from reseau_drivers.camera import v4l2
from reseau_sims import Water
from reseau_sims.serving import SimulatedBench

FREE = ("c", "x0", "y0", "K1")
POSES = ((45.0, 0.0, 0.0), (45.0, 90.0, 90.0), (45.0, 180.0, 180.0), (45.0, 270.0, 270.0))
STEPS = tuple(
    Step(f"tilt {tilt:g} roll {roll:g}", {"tilt": tilt, "roll": roll, "camera_roll": camera})
    for tilt, roll, camera in POSES
)
TESTFIELD = {"steps": [[each.name, dict(each.position)] for each in STEPS], "pitch_mm": 0.027,
             "free": list(FREE), "row_jitter_px": 0.0086, "fill": 0.8, "home": True}  # fmt: skip
CAMERA = '\n[instruments.camera]\ndriver = "v4l2"\naddress = "in process"\n'


def described(simulated: SimulatedBench) -> str:
    """The bench with the camera of this process."""
    return simulated.toml.replace("speed = 50.0", "speed = 1000.0") + CAMERA + simulated.refraction


@pytest.mark.slow
def test_a_session_under_water_gives_the_calibration_of_the_camera_in_air(tmp_path: Path) -> None:
    design = coded_testfield()
    with SimulatedBench(
        2, camera="testfield", repeatable=True, flat=True, in_process=True, water=Water(tilt_deg=(0.0, 1.0))
    ) as simulated:
        text, video = described(simulated), simulated.video
        assert video is not None

        def build(name: str, entry: InstrumentEntry) -> Instrument:
            if name == "table":
                return built(name, entry)
            return v4l2(name, video.open, settings={"exposure_us": 10_000.0}, seconds=60.0)

        file = BenchFile.parse_toml(text, where="bench.toml")
        used = {name: file.instruments[name] for name in ("table", "camera")}
        archive = Archive.open(tmp_path / "archive", create=True)
        session = conducting.begin(
            archive, "wet", "testfield", TESTFIELD, {"design.json": design.to_json()}, bench=text
        )
        procedure: Any = conducting.procedure_of(session)
        with Bench(file.model_copy(update={"instruments": used}), build) as bench:
            acquisition = Acquisition(bench, session, procedure)
            carry_out(acquisition, plans.homed(acquisition, plans.poses(acquisition, STEPS)))
        assert session.status == "done"
        assert not any(simulated.violations.values())
        field = simulated.laboratory.field
    assert field.water is not None

    adjusted = procedure.procedure.calibrated().required()
    result: Result = adjusted.result
    assert 0.8 < result.sigma0 < 1.1
    # c, x0, y0 and K1 are those in air, the port and the water those drawn.
    camera, truth = result.cameras["camera"], dict(zip(field.camera.names, field.camera.values, strict=True))
    for name, value, sigma in zip(camera.parameters, camera.values, camera.sigma, strict=True):
        assert abs(value - truth[name]) < 4 * sigma
    bent = result.refraction
    assert bent is not None
    tilt = np.tan(np.deg2rad(field.water.tilt_deg))
    found = dict(zip(bent.parameters, bent.values, strict=True))
    assert found["tilt_X of port"] == pytest.approx(tilt[1], abs=1e-3)
    assert found["index of water"] == pytest.approx(field.water.index, abs=4e-4)

    # The next pose is predicted through the port.
    more = Step("more", {"tilt": 40.0, "roll": 0.0, "camera_roll": 90.0})
    step, predicted = procedure.procedure.next_pose((more,), "c")
    assert step is more
    assert 0.5 * camera.sigma[0] < predicted < camera.sigma[0]

    # The same image points with straight rays: no camera of Brown's model explains them.
    full = CameraOptions("brown", (*FREE, "K2", "P1", "P2"), (0.027, 0.027))
    size, measured = (240, 240), adjusted.measured.items()
    ignored = calibrate_camera(measured, design, measurer_of(design), size, full, CalibrationOptions())
    assert ignored.required().sigma0 > 1.2
    assert any("global test" in str(each) for each in ignored.required().result.warnings)
