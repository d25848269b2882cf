"""A sensor calibrated while its frames come in; each is taken into sums and let go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeVar

from ..archive import Verdict
from ..core.data import Frame
from ..core.errors import EstimationError, UsageError
from ..core.failure import Failure
from ..core.provenance import Provenance
from ..sensor import Level, LevelSums, SensorResult, SensorSeries, calibrate_sensor, with_edge

__all__ = ["Exposed", "LiveSensor"]

_SATURATED = 0.01
"""Share of an edge's pixels at full scale."""


class Exposed(Protocol):
    """A step of the series; see :class:`reseau.capture.Step`."""

    @property
    def name(self) -> str:
        """Begins with light, dark or edge."""

    @property
    def exposure_us(self) -> float | None:
        """Exposure time."""


P = TypeVar("P", bound=Exposed)


class LiveSensor:
    """The calibration of a sensor; what it holds are two images of each exposure, however many frames come.

    Parameters
    ----------
    name : str
        Of the session, in messages.
    region : (left, top, width, height), optional
        Of the edge.
    options : mapping
        For the provenance.
    """

    def __init__(
        self,
        *,
        name: str,
        region: tuple[int, int, int, int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.name, self._region, self._options = name, region, dict(options or {})
        self._levels: dict[str, list[Level]] = {"light": [], "dark": [], "edge": []}
        self._open: tuple[str, LevelSums] | None = None
        self._inputs: dict[str, str] = {}
        self._full_scale = 0.0
        self._made: tuple[int, SensorResult] | None = None

    def on_frame(self, frame: Frame, step: Exposed) -> Verdict:
        """Take a frame into the sums of its level; levels come one after the other."""
        key, exposure = step.name.rpartition(" ")[0], step.exposure_us
        if key.partition(" ")[0] not in self._levels or exposure is None:
            return Verdict(False, f"{step.name} is no frame of a sensor's calibration")
        if key.startswith("edge") and (frame.pixels >= frame.full_scale).mean() > _SATURATED:
            return Verdict(False, "the edge is saturated; expose less")
        if self._open is None or self._open[0] != key:
            self._close()
            self._open = key, LevelSums(exposure)
        try:
            self._open[1].add(frame.pixels)
        except UsageError as error:
            return Verdict(False, error.what)
        self._full_scale, self._inputs[step.name] = frame.full_scale, frame.sha256
        return Verdict(True, facts={"mean": round(float(frame.pixels.mean()), 3)})

    def _close(self) -> None:
        if self._open is not None and self._open[1].count > 1:
            self._levels[self._open[0].partition(" ")[0]].append(self._open[1].level())
        self._open = None

    def progress(self) -> dict[str, float]:
        """Nothing: what is found, is found in the end."""
        return {}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """None: its frames are taken from one place."""
        return None

    def result(self) -> SensorResult:
        """The calibration by all that came.

        Raises
        ------
        EstimationError
            When frames are missing, or gain and noise cannot be had.
        """
        self._close()
        if self._made is None or self._made[0] != len(self._inputs):
            self._made = len(self._inputs), self._calibrated()
        return self._made[1]

    def _calibrated(self) -> SensorResult:
        light, dark, edge = (tuple(self._levels[name]) for name in ("light", "dark", "edge"))
        try:
            found = calibrate_sensor(SensorSeries(dark, light, self._full_scale))
        except UsageError as error:
            raise EstimationError(error.what, where=self.name, do="see the verdicts on its frames") from None
        return with_edge(found, edge[0], self._region) if edge else found

    @property
    def provenance(self) -> Provenance:
        """What the calibration was made of."""
        return Provenance(self._inputs, self._options)

    def calibrated(self, name: str) -> dict[str, str]:
        """The calibration under the camera's name; ``times`` stay empty, the archive knows them.

        Raises
        ------
        EstimationError
            When it fails.
        """
        made = self.result().calibration(name, self.provenance.to_dict(), {})
        return {"calibration.json": made.to_json()}

    def finish(self) -> dict[str, str]:
        """The calibration under the session's name; see :meth:`calibrated`."""
        return self.calibrated(self.name)

    def shortcoming(self) -> str:
        """Why there is no sharpness, where an edge was shown; empty where nothing is wrong."""
        edge = self.result().edge
        return edge.reason if isinstance(edge, Failure) else ""
