"""What `reseau capture` and `reseau archive` share: a session's procedure, made of its parameters alone.

Live and offline it is made here, of what the archive holds, so that both do the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import parsed_design

if TYPE_CHECKING:
    from ..archive import Archive, Session, Verdict
    from ..capture import Procedure, Step
    from ..core.data import Frame
    from ..procedures.calibration import CameraOptions
    from ..procedures.live import LiveOscilloscope, LiveTestfield
    from ..procedures.live_sensor import LiveSensor

__all__ = [
    "ArchivePlace",
    "ObjectsPlace",
    "SessionName",
    "model_of",
    "opened",
    "oscilloscope_of",
    "procedure_of",
    "steps_of",
    "testfield_of",
]

ArchivePlace = Annotated[
    str, typer.Option("--archive", "-a", envvar="RESEAU_ARCHIVE", help="Folder, or URL of a database.")
]
ObjectsPlace = Annotated[
    str | None, typer.Option("--objects", help="Folder or URL of the files, where the archive is a database.")
]
SessionName = Annotated[str, typer.Argument(help="Name of the session.")]


def opened(place: str, objects: str | None, *, create: bool = False) -> Archive:
    """The archive at a place."""
    from ..archive import Archive

    return Archive.open(place, objects, create=create)


def steps_of(parameters: Mapping[str, Any]) -> tuple[Step, ...]:
    """The poses of a session."""
    from ..capture import Step

    return tuple(Step(name, position) for name, position in parameters["steps"])


def procedure_of(kept: Session) -> Procedure | None:
    """What becomes of a session's frames; None where they are only kept."""
    made: dict[str, Callable[[Session], Procedure]] = {
        "testfield": testfield_of,
        "oscilloscope": oscilloscope_of,
        "sensor": _sensor_of,
    }
    return made[kept.plan](kept) if kept.plan in made else None


def oscilloscope_of(kept: Session) -> LiveOscilloscope:
    """The procedure of a session of `capture oscilloscope`."""
    from ..io import ReseauDesign
    from ..procedures.live import LiveOscilloscope

    reseau, rods = (
        ReseauDesign.parse(kept.input(name), where=name) for name in ("reseau.json", "object.json")
    )
    given = kept.parameters
    return LiveOscilloscope(
        reseau, rods, name=kept.name, options=given, inputs=_inputs(kept), check=given.get("check", ())
    )


def testfield_of(kept: Session) -> _Reported:
    """The procedure of a session of `capture testfield`."""
    from ..measure import TestfieldOptions
    from ..procedures.live import LiveTestfield
    from ..procedures.measuring import measurer_of

    given = kept.parameters
    design = parsed_design(kept.input("design.json"), "design.json")
    options = {key: value for key, value in given.items() if key not in ("steps", "until")}
    measure = measurer_of(design, TestfieldOptions(row_jitter_px=given["row_jitter"], fill=given["fill"]))
    sigmas = given.get("sigmas")
    live = LiveTestfield(
        design,
        measure,
        model_of(given),
        name=kept.name,
        options=options,
        inputs=_inputs(kept),
        sigmas=None if sigmas is None else (sigmas[0], sigmas[1], sigmas[2]),
    )
    return _Reported(live)


def _sensor_of(kept: Session) -> _Sensor:
    from ..procedures.live_sensor import LiveSensor

    region = kept.parameters["region"]
    chosen = None if region is None else tuple(region)
    return _Sensor(LiveSensor(name=kept.name, region=chosen, options=kept.parameters), kept)


def model_of(parameters: Mapping[str, Any]) -> CameraOptions:
    """What a testfield's session estimates of its camera."""
    from ..procedures.calibration import CameraOptions

    pitch, free = parameters["pitch"], tuple(parameters["free"])
    return CameraOptions(free=free, pitch_mm=None if pitch is None else (pitch, pitch))


def _inputs(kept: Session) -> dict[str, str]:
    """SHA-256 of what a session was given, by name."""
    return {name: given.sha256 for name, given in kept.given().items()}


class _Measured:
    """A procedure, up to what comes of it."""

    def __init__(self, live: Procedure) -> None:
        self._measures = live

    def on_frame(self, frame: Frame, step: Step) -> Verdict:
        return self._measures.on_frame(frame, step)

    def progress(self) -> Mapping[str, float]:
        return self._measures.progress()

    def next_pose(self, candidates: Sequence[Step], wanted: str) -> tuple[Step, float | None] | None:
        return self._measures.next_pose(candidates, wanted)


class _Reported(_Measured):
    """A testfield procedure whose results have a report beside them."""

    def __init__(self, live: LiveTestfield) -> None:
        super().__init__(live)
        self.live = live

    def finish(self) -> dict[str, str]:
        from ..procedures.calibration import Calibrated
        from ..report.bundle import bundle_report

        made = self.live.finish()
        found = self.live.calibrated()
        assert isinstance(found, Calibrated)
        title = f"Calibration, session {self.live.name}"
        report = bundle_report(found.searched, title=title, provenance=self.live.provenance)
        return made | {"report.html": report}


class _Sensor(_Measured):
    """A sensor's calibration under the name of its camera, with a report beside it."""

    def __init__(self, live: LiveSensor, kept: Session) -> None:
        super().__init__(live)
        self.live, self._kept = live, kept

    def finish(self) -> dict[str, str]:
        from ..report.sensor import sensor_report

        probes = self._kept.frames(kind="probe")
        camera = probes[0].facts["identity"] if probes else self._kept.name
        report = sensor_report(
            self.live.result(), title=f"Sensor of {camera}", provenance=self.live.provenance
        )
        return self.live.calibrated(camera) | {"report.html": report}
