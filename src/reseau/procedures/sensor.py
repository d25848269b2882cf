"""Calibration of a sensor during the acquisition; frames are added to sums and not kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from ..archive import Verdict
from ..calibration.document import Calibration
from ..core.data import Frame
from ..core.environment import Surroundings
from ..core.errors import EstimationError, UsageError
from ..core.provenance import Provenance
from ..sensor import Level, SensorSeries, calibrate_sensor
from ..sensor.sensor import SensorResult, with_edge
from ..sensor.series import LevelSums

_SATURATED = 0.01
"""Largest share of pixels of an edge at full scale."""


class Exposed(Protocol):
    """A step of the series; see :class:`reseau.capture.Step`."""

    @property
    def name(self) -> str:
        """Name that starts with light, dark or edge."""

    @property
    def exposure_us(self) -> float | None:
        """Exposure time (µs)."""


@dataclass(frozen=True)
class Exposure:
    """One frame of a series that is not taken on a bench.

    Parameters
    ----------
    name : str
        ``light``, ``dark`` or ``edge``, the number of the level, and a name of the frame: "light 03 a.tif".
    exposure_us : float
        Exposure time (µs).
    light : float, optional
        Amount of light in any unit, if not the exposure time alone varies.

    Examples
    --------
    >>> Exposure("light 03 a.tif", 5000.0).light is None
    True
    """

    name: str
    exposure_us: float
    light: float | None = None


P = TypeVar("P", bound=Exposed)


class SensorProcedure:
    """Calibration of a sensor during an acquisition, with two images in memory for each exposure.

    Parameters
    ----------
    name : str
        Name of the session, for messages.
    region : (left, top, width, height), optional
        Region of the slanted edge (px).
    options : mapping
        Parameters, for the provenance.

    Examples
    --------
    >>> SensorProcedure(name="monday").progress()
    {}
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
        self._surroundings = Surroundings()
        self._inputs: dict[str, str] = {}
        self._full_scale = 0.0
        self._made: tuple[int, SensorResult] | None = None

    def on_frame(self, frame: Frame, step: Exposed) -> Verdict:
        """Add a frame to the sums of its level; levels follow one another."""
        key, exposure = " ".join(step.name.split(" ")[:2]), step.exposure_us
        if key.partition(" ")[0] not in self._levels or exposure is None:
            return Verdict(False, f"{step.name} is not a step of a sensor series")
        if key.startswith("edge") and (frame.pixels >= frame.full_scale).mean() > _SATURATED:
            return Verdict(False, "the edge is saturated: expose less")
        if self._open is None or self._open[0] != key:
            self._close()
            self._open = key, LevelSums(exposure, step.light if isinstance(step, Exposure) else None)
        try:
            self._open[1].add(frame.pixels)
        except UsageError as error:
            return Verdict(False, error.what)
        self._full_scale, self._inputs[step.name] = frame.full_scale, frame.sha256
        self._surroundings.add(step.name, step)
        return Verdict(True, facts={"mean": round(float(frame.pixels.mean()), 3)})

    def _close(self) -> None:
        if self._open is not None and self._open[1].count > 1:
            self._levels[self._open[0].partition(" ")[0]].append(self._open[1].level())
        self._open = None

    def progress(self) -> dict[str, float]:
        """Return nothing: results are known at the end only."""
        return {}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """Return None: the frames are taken from one position."""
        return None

    def result(self) -> SensorResult:
        """Return the calibration from all frames.

        Raises
        ------
        EstimationError
            If frames are missing, or gain and noise cannot be determined.
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
        """Inputs and parameters of the calibration."""
        return Provenance(self._inputs, self._options, environment=self._surroundings.summary())

    def calibration(self, name: str) -> Calibration:
        """Return the calibration with a name; see :meth:`calibrated`.

        Raises
        ------
        EstimationError
            If it fails.
        """
        return self.result().calibration(name, self.provenance.to_dict(), {})

    def calibrated(self, name: str) -> dict[str, str]:
        """Return the calibration with the name of the camera; ``times`` are empty, the archive stores them.

        Raises
        ------
        EstimationError
            If it fails.
        """
        return {"calibration.json": self.calibration(name).to_json()}

    def finish(self) -> dict[str, str]:
        """Return the calibration with the name of the session; see :meth:`calibrated`."""
        return self.calibrated(self.name)
