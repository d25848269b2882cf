"""Protocols of instruments; drivers satisfy them without inheriting from them.

Every call has one total time limit in seconds and raises an :class:`~reseau.core.errors.InstrumentError` if
it does not finish within that limit. `stop` can be called from any thread; `close` never raises. The
protocols include bluesky's protocols of the same names, so that bluesky's plans can use every instrument.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Protocol, runtime_checkable

from ..core.data import Frame
from .settings import Settings
from .status import Status
from .values import AxisState, BScan, Environment, Identity, ScreenPicture, Waveform


@runtime_checkable
class Instrument(Protocol):
    """Methods that every instrument has.

    Examples
    --------
    >>> isinstance("a text", Instrument)
    False
    """

    @property
    def name(self) -> str:
        """Name on the bench."""

    @property
    def settings(self) -> Settings:
        """Settings as last sent to the instrument."""

    def connect(self, seconds: float | None = None) -> Identity:
        """Connect, send the settings, and return the identity."""

    def check(self, seconds: float | None = None) -> dict[str, str]:
        """Run the self-test; return results by name of the test."""

    def close(self) -> None:
        """Close the connection; never raises."""

    def stop(self, *, success: bool = False) -> None:
        """Stop any movement, transmission or recording, from any thread."""

    def configure(
        self, settings: Mapping[str, Any] | None = None, /, **changes: Any
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Change settings; return readings of the old and the new settings."""

    def stage(self) -> list[Any]:
        """Prepare for a run."""

    def unstage(self) -> list[Any]:
        """Stop after a run."""

    def trigger(self) -> Status:
        """Take a reading in the background."""

    def read(self) -> dict[str, Any]:
        """Return the last reading."""

    def describe(self) -> dict[str, Any]:
        """Return the contents of a reading: type, shape and unit by name."""

    def read_configuration(self) -> dict[str, Any]:
        """Return the settings as a reading."""

    def describe_configuration(self) -> dict[str, Any]:
        """Return the contents of the reading of the settings."""


@runtime_checkable
class Oscilloscope(Instrument, Protocol):
    """Oscilloscope.

    Examples
    --------
    >>> sorted(name for name in ("screen", "waveform") if hasattr(Oscilloscope, name))
    ['screen', 'waveform']
    """

    def screen(self, seconds: float | None = None) -> ScreenPicture:
        """Return the picture of the screen."""

    def waveform(self, channel: int = 1, seconds: float | None = None) -> Waveform:
        """Return the samples of a channel."""


@runtime_checkable
class UltrasonicScanner(Instrument, Protocol):
    """Instrument that makes ultrasonic sections (B-mode images).

    Examples
    --------
    >>> hasattr(UltrasonicScanner, "scan")
    True
    """

    def scan(self, seconds: float | None = None) -> BScan:
        """Return one section."""


@runtime_checkable
class EnvironmentSensor(Instrument, Protocol):
    """Sensor of temperature, humidity, pressure or the like.

    Examples
    --------
    >>> hasattr(EnvironmentSensor, "environment")
    True
    """

    def environment(self, seconds: float | None = None) -> Environment:
        """Return what it measures now."""


@runtime_checkable
class Movable(Protocol):
    """One axis of a turntable, as bluesky moves it.

    Examples
    --------
    >>> isinstance(3.0, Movable)
    False
    """

    @property
    def name(self) -> str:
        """Name of the axis."""

    @property
    def unit(self) -> str:
        """Unit of positions and limits: ``deg`` or ``mm``."""

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest allowed position."""

    @property
    def position(self) -> float:
        """Current position."""

    def set(self, value: float) -> Status:
        """Start to move to a position."""

    def stop(self, *, success: bool = False) -> None:
        """Stop the axis."""


@runtime_checkable
class Turntable(Instrument, Protocol):
    """Instrument with axes that move.

    Examples
    --------
    >>> sorted(name for name in ("axes", "home", "move", "state") if hasattr(Turntable, name))
    ['axes', 'home', 'move', 'state']
    """

    @property
    def axes(self) -> Mapping[str, Movable]:
        """Axes by name."""

    def home(self, axis: str, seconds: float | None = None) -> AxisState:
        """Find the reference of an axis."""

    def move(self, axis: str, position: float, seconds: float | None = None) -> AxisState:
        """Move an axis to a position, and wait until it has stopped."""

    def state(self, axis: str, seconds: float | None = None) -> AxisState:
        """Return the state of an axis."""


class Exposure(Protocol):
    """Frame of a camera with its time and settings.

    Examples
    --------
    >>> hasattr(Exposure, "taken_within_s")
    True
    """

    @property
    def frame(self) -> Frame:
        """Image with the grey values that the camera sent; of a colour mosaic, all raw pixels."""

    @property
    def pattern(self) -> str:
        """Colour pattern of raw pixels (filters of the first two rows, as RGGB; YUYV; MJPEG); else empty."""

    @property
    def sequence(self) -> int:
        """Frame number; a gap means lost frames."""

    @property
    def taken(self) -> datetime:
        """Start of the exposure, UTC."""

    @property
    def taken_within_s(self) -> float:
        """Half-width of the interval that contains the start of the exposure (s)."""

    @property
    def fresh(self) -> bool:
        """Whether the exposure certainly started after the request."""

    @property
    def exposure_us(self) -> float:
        """Exposure time (µs); NaN if the camera does not report it."""

    @property
    def gain(self) -> float:
        """Gain, in dB if the camera defines a unit; NaN if the camera does not report it."""

    @property
    def dropped(self) -> int:
        """Number of frames lost or damaged since the camera was connected."""


@runtime_checkable
class Camera(Instrument, Protocol):
    """Camera.

    Examples
    --------
    >>> sorted(name for name in ("expose", "frames") if hasattr(Camera, name))
    ['expose', 'frames']
    """

    def expose(self, seconds: float | None = None) -> Exposure:
        """Return a frame whose exposure started after this call."""

    def frames(self, count: int, seconds: float | None = None) -> Iterator[Exposure]:
        """Yield consecutive frames as the camera delivers them; each states whether it is fresh."""


@dataclass(frozen=True, eq=False)
class ExposureSet:
    """Frames of the cameras of a rig, exposed at once.

    Parameters
    ----------
    exposures : mapping of str to Exposure
        Frame of each camera.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> at = datetime(2026, 1, 5)
    >>> left = SimpleNamespace(taken=at, taken_within_s=2e-4)
    >>> right = SimpleNamespace(taken=at.replace(microsecond=1000), taken_within_s=1e-4)
    >>> ExposureSet({"left": left, "right": right}).skew
    (0.001, 0.0003)
    """

    exposures: Mapping[str, Exposure]

    @property
    def skew(self) -> tuple[float, float]:
        """Time from the first start of an exposure to the last, and its half-width (s).

        The true skew is within the half-width: the sum of the two largest half-widths of the starts.
        """
        starts = [each.taken for each in self.exposures.values()]
        widths = sorted(each.taken_within_s for each in self.exposures.values())
        within = sum(widths[-2:]) if len(widths) > 1 else 0.0
        return (max(starts) - min(starts)).total_seconds(), round(within, 9)


@runtime_checkable
class CameraRig(Instrument, Protocol):
    """Cameras that expose at once.

    Examples
    --------
    >>> hasattr(CameraRig, "expose_all")
    True
    """

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""

    @property
    def largest_skew_s(self) -> float:
        """Largest skew of a usable set of frames (s); infinite without a limit."""

    def expose_all(self, seconds: float | None = None) -> ExposureSet:
        """Return a frame of each camera, of one exposure that started after this call."""
