"""What an instrument is, to those who use it; drivers keep to it without inheriting from it.

Every call has a total deadline in seconds and raises an :class:`~reseau.core.errors.InstrumentError` when it
was not done by then; `stop` works from any thread; `close` never raises. Each also satisfies bluesky's
protocols of the same names, so that bluesky's plans drive them as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any, Protocol, runtime_checkable

from ..core.data import Frame
from .settings import Settings
from .status import Status
from .values import AxisState, BScan, Identity, ScreenPicture, Waveform

__all__ = ["Camera", "Exposure", "Instrument", "Movable", "Oscilloscope", "Turntable", "UltrasonicScanner"]


@runtime_checkable
class Instrument(Protocol):
    """What all of them can do."""

    @property
    def name(self) -> str:
        """What it is called on the bench."""

    @property
    def settings(self) -> Settings:
        """As they were pushed last."""

    def connect(self, seconds: float | None = None) -> Identity:
        """Connect, push the settings, and ask who it is."""

    def check(self, seconds: float | None = None) -> dict[str, str]:
        """Test itself: what was tested, and what came out."""

    def close(self) -> None:
        """Let go of it; never raises."""

    def stop(self, *, success: bool = False) -> None:
        """Stop whatever it does, from any thread."""

    def configure(self, **changes: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Change settings; returns the readings of the old ones and of the new ones."""

    def stage(self) -> list[Any]:
        """Make it ready for a run."""

    def unstage(self) -> list[Any]:
        """Bring it back to rest."""

    def trigger(self) -> Status:
        """Take a reading."""

    def read(self) -> dict[str, Any]:
        """The last reading."""

    def describe(self) -> dict[str, Any]:
        """What a reading holds."""

    def read_configuration(self) -> dict[str, Any]:
        """The settings as a reading."""

    def describe_configuration(self) -> dict[str, Any]:
        """What that holds."""


@runtime_checkable
class Oscilloscope(Instrument, Protocol):
    """An oscilloscope."""

    def screen(self, seconds: float | None = None) -> ScreenPicture:
        """The picture of its screen."""

    def waveform(self, channel: int = 1, seconds: float | None = None) -> Waveform:
        """The samples of a channel."""


@runtime_checkable
class UltrasonicScanner(Instrument, Protocol):
    """An instrument that makes sections by ultrasound."""

    def scan(self, seconds: float | None = None) -> BScan:
        """One section."""


@runtime_checkable
class Movable(Protocol):
    """One axis of a turntable, as bluesky moves it."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def unit(self) -> str:
        """Of its positions and limits: degrees or millimetres."""

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest position that it may be moved to."""

    @property
    def position(self) -> float:
        """Where it stands."""

    def set(self, value: float) -> Status:
        """Begin to move there."""

    def stop(self, *, success: bool = False) -> None:
        """Stop it."""


@runtime_checkable
class Turntable(Instrument, Protocol):
    """Axes that move."""

    @property
    def axes(self) -> Mapping[str, Movable]:
        """By name."""

    def home(self, axis: str, seconds: float | None = None) -> AxisState:
        """Find the reference of an axis."""

    def move(self, axis: str, position: float, seconds: float | None = None) -> AxisState:
        """Move an axis there, and wait."""

    def state(self, axis: str, seconds: float | None = None) -> AxisState:
        """How an axis stands."""


class Exposure(Protocol):
    """A frame of a camera with what is known of it."""

    @property
    def frame(self) -> Frame:
        """The image; grey values as the camera sent them, of a mosaic of colours all of them."""

    @property
    def pattern(self) -> str:
        """Of colour that is kept raw: filters of the first two rows (RGGB …), YUYV, MJPEG; empty for grey."""

    @property
    def sequence(self) -> int:
        """Its number; a gap means that frames were lost."""

    @property
    def taken(self) -> datetime:
        """When its exposure began, UTC."""

    @property
    def taken_within_s(self) -> float:
        """How far from that it may have begun (s)."""

    @property
    def fresh(self) -> bool:
        """Whether its exposure surely began after it was asked for."""

    @property
    def exposure_us(self) -> float:
        """Exposure time; NaN where the camera does not tell."""

    @property
    def gain(self) -> float:
        """Gain, dB where the camera has a unit for it; NaN where it does not tell."""

    @property
    def dropped(self) -> int:
        """Frames lost or damaged since the camera was connected."""


@runtime_checkable
class Camera(Instrument, Protocol):
    """A camera."""

    def expose(self, seconds: float | None = None) -> Exposure:
        """A frame whose exposure began after this call."""

    def frames(self, count: int, seconds: float | None = None) -> Iterator[Exposure]:
        """Frames one after the other, as the camera delivers them; each says whether it is fresh."""
