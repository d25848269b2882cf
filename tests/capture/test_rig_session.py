"""Sessions of a rig: sets of frames as one exposure, live calibration, resumption and rerun."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive, Session
from reseau.archive.verification import verify
from reseau.calibration import Calibration
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry, Step, carry_out, paper_steps, plans
from reseau.capture.bench import built
from reseau.core.errors import UsageError
from reseau.instruments import CameraRig, ExposureSet, Instrument
from reseau.optics.poses import matrix_to_vector, rotation_matrix
from reseau.sessions import conducting
from reseau.sessions.parameters import (
    BlurredParameters,
    FramesParameters,
    SensorParameters,
    TestfieldParameters,
)
from reseau_drivers.camera import Rig, RigSettings, v4l2
from reseau_sims.serving import SimulatedCamera, StripeScene, VideoCamera, View
from reseau_sims.serving.bench import SEATS, SimulatedBench
from reseau_sims.serving.imaging import LaboratoryScene

SIDES = ("left", "right")
POSES = tuple(step for step in paper_steps() if step.position["camera_roll"] in (0.0, 90.0))[:10]


def pair(bodies: dict[str, SimulatedCamera], **settings: Any) -> Bench:
    """A bench of cameras in this process, and their rig."""
    videos = {name: VideoCamera(body) for name, body in bodies.items()}
    entries = {name: InstrumentEntry(driver="v4l2", address="in this process") for name in bodies}
    entries["rig"] = InstrumentEntry(driver="rig", address=", ".join(bodies))

    def build(name: str, entry: InstrumentEntry) -> Instrument:
        if name == "rig":
            return Rig(name, list(bodies), RigSettings(**settings), seconds=20.0)
        return v4l2(name, videos[name].open, settings={"exposure_us": 10_000.0}, seconds=20.0)

    return Bench(BenchFile(name="two", instruments=entries), build)


def striped() -> dict[str, SimulatedCamera]:
    return {name: SimulatedCamera(StripeScene(shift=k)) for k, name in enumerate(SIDES)}


@pytest.fixture
def archive(tmp_path: Path) -> Iterator[Archive]:
    with Archive.open(tmp_path / "archive", create=True) as opened:
        yield opened


def taken(session: Session) -> list[tuple[str, int, bool]]:
    return [(f.step, f.take, f.verdict is not None and f.verdict.ok) for f in session.frames(kind="frame")]


def test_frames_of_a_rig_are_stored_by_exposure_with_their_skew(archive: Archive) -> None:
    session = archive.begin("monday", "frames", {"count": 3, "camera": "rig"})
    with pair(striped()) as bench:
        conducting.capture(session, bench)
    assert session.status == "done"
    assert taken(session) == [(f"{side}/{k:05d}", 0, True) for k in range(3) for side in SIDES]
    view = View(10_000.0, 0.0, 0.0, 0, 0, 96, 64, 255.0)
    for frame in session.frames(kind="frame"):
        shift = SIDES.index(frame.facts["camera"])
        assert (session.picture(frame).pixels == StripeScene(shift=shift)(view)).all()
        (skew,), (within,) = frame.clock["skew_s"], frame.clock["skew_within_s"]
        assert 0 <= skew < 10
        assert within > 0
    assert verify(archive)


def test_a_stopped_session_of_a_rig_is_resumed_without_another_exposure(archive: Archive) -> None:
    session = archive.begin("monday", "frames", {"count": 4, "camera": "rig"})
    with pair(striped()) as bench:
        run = Acquisition(bench, session, camera="rig")

        def half(run: Acquisition) -> Any:
            yield from run.at(Step("00000"))
            yield from run.at(Step("00001"))
            raise UsageError("enough")

        with pytest.raises(UsageError):
            carry_out(run, half(run))
        before = [frame.sha256 for frame in session.frames(kind="frame")]
        conducting.capture(session, bench)
    frames = session.frames(kind="frame")
    assert [frame.sha256 for frame in frames][:4] == before
    assert taken(session) == [(f"{side}/{k:05d}", 0, True) for k in range(4) for side in SIDES]


def test_a_set_that_is_exposed_too_far_apart_is_declined_and_repeated(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = archive.begin("monday", "frames", {})
    skews = iter([(0.010, 0.001), (0.0005, 0.001)])
    monkeypatch.setattr(ExposureSet, "skew", property(lambda self: next(skews)))
    with pair(striped(), skew_us=2000.0) as bench:
        run = Acquisition(bench, session, camera="rig", retakes=2)
        carry_out(run, plans.frames(run, 1))
    assert [ok for _, _, ok in taken(session)] == [False, False, True, True]
    verdict = session.frames(kind="frame")[0].verdict
    assert verdict is not None
    assert verdict.why == "the cameras exposed 1e+04 µs apart: more than the rig allows"


def test_a_rig_is_refused_by_plans_of_one_camera() -> None:
    bench = pair(striped())
    assert isinstance(bench["rig"], CameraRig)
    FramesParameters(camera="rig").check_bench(bench)
    for parameters in (
        SensorParameters(region=None, camera="rig"),
        BlurredParameters(steps=(("a", {}),), camera="rig"),
    ):
        with pytest.raises(UsageError, match="rig: is no camera"):
            parameters.check_bench(bench)


def given(**more: Any) -> TestfieldParameters:
    steps = tuple((step.name, dict(step.position)) for step in POSES)
    known = {
        "pitch_mm": 0.027,
        "free": ("c", "x0", "y0", "K1"),
        "row_jitter_px": 0.0086,
        "fill": 0.8,
        "checks": 0,
    }
    return TestfieldParameters(steps=steps, camera="rig", home=True, **(known | more))


@contextmanager
def before_field(count: int) -> Iterator[tuple[Bench, SimulatedBench]]:
    """A testfield on its table before cameras of a rig."""
    with SimulatedBench(3, repeatable=True, flat=True) as simulated:
        file = BenchFile.parse_toml(simulated.toml, where="simulated")
        table = file.instruments["table"].model_copy(update={"settings": {"speed": 1000.0}})
        seats = dict(list(SEATS.items())[:count])
        bodies = {
            name: SimulatedCamera(LaboratoryScene(simulated.laboratory, "testfield", seat), 240, 240)
            for name, seat in seats.items()
        }
        inner = pair(bodies)
        entries = {"table": table, **inner.file.instruments}

        def build(name: str, entry: InstrumentEntry) -> Instrument:
            return built(name, entry) if name == "table" else inner[name]

        with Bench(file.model_copy(update={"instruments": entries}), build) as bench:
            yield bench, simulated


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("count", [2, 4])
def test_a_rig_is_calibrated_live_and_computed_again_to_the_byte(count: int, archive: Archive) -> None:
    events: list[tuple[str, dict[str, Any]]] = []
    with before_field(count) as (bench, simulated):
        design = simulated.laboratory.field.design.to_json()
        session = conducting.begin(archive, "monday", "testfield", given(), {"design.json": design})
        assert conducting.capture(session, bench, watch=lambda k, v: events.append((k, v))) is None
        distance = simulated.laboratory.field.distance_mm
    names = list(SEATS)[:count]
    assert len(session.frames(kind="frame")) == count * len(POSES)
    assert {result.name for result in session.results()} == {
        "report.html", "scene.json", *(f"calibration-{name}.json" for name in names),
    }  # fmt: skip
    reached = [facts for kind, facts in events if kind == "precision"]
    assert 0 < reached[-1]["sigma_c"] < reached[0]["sigma_c"]
    contents = {result.name: session.content(result).decode() for result in session.results()}
    found = {name: Calibration.parse(contents[f"calibration-{name}.json"], where=name) for name in names}
    for name, seat in list(SEATS.items())[:count]:
        c = found[name].parameters["c"]
        assert abs(c.value - 57.5 * (1 + seat.longer)) < 4.5 * c.sigma
        place = found[name].place
        if not seat.number:
            assert place is None
            continue
        assert place is not None
        assert place.reference == "left"
        turned = rotation_matrix(place.rotation), seat.matrix(distance)
        off = matrix_to_vector(turned[0] @ turned[1].T)
        error = np.concatenate([off, np.array(place.base) - seat.base_mm])
        # Chi square of six degrees of freedom, 1e-5.
        assert error @ np.linalg.solve(np.array(place.covariance), error) < 33.0
    assert all(each.same for each in conducting.rerun(session))


def test_poses_are_not_chosen_and_heights_not_used_for_a_rig() -> None:
    with before_field(2) as (bench, _):
        given().check_bench(bench)
        with pytest.raises(UsageError, match="--until: requires one camera"):
            given(until="sigma_c < 20 um").check_bench(bench)
        with pytest.raises(UsageError, match="--heights: requires one camera"):
            given(sigmas=(0.01, 0.01, 0.05)).check_bench(bench)
