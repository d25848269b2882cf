"""What instruments hand over: who they are, pictures, waveforms, sections, the state of an axis."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Frame
from ..core.errors import ImageError
from ..core.provenance import sha256_of

__all__ = ["AxisState", "BScan", "Identity", "ScreenPicture", "Waveform", "now"]


def now() -> datetime:
    """The time, in UTC."""
    return datetime.now(UTC)


@dataclass(frozen=True)
class Identity:
    """Who an instrument says it is."""

    maker: str
    model: str
    serial: str = ""
    firmware: str = ""

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.model, self.serial, self.firmware) if part)


@dataclass(frozen=True)
class ScreenPicture:
    """The picture of an instrument's own screen, as the file that it sent.

    Parameters
    ----------
    data : bytes
        PNG or BMP.
    taken : datetime
        When it had been asked for.
    """

    data: bytes
    taken: datetime = field(default_factory=now)

    @property
    def suffix(self) -> str:
        """Of a file that holds it."""
        return ".bmp" if self.data[:2] == b"BM" else ".png"

    def frame(self, name: str = "screen") -> Frame:
        """The grey image, 8 bits.

        Raises
        ------
        ImageError
            When the picture cannot be decoded.
        """
        try:
            grey = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        except cv2.error:
            grey = None
        if grey is None:
            raise ImageError("is no picture that can be decoded", where=name)
        return Frame(grey, 255.0, name, sha256_of(self.data))


@dataclass(frozen=True, eq=False)
class Waveform:
    """Samples of one channel.

    Parameters
    ----------
    volts : ndarray (n,)
        At equal distances of time.
    start_s, step_s : float
        Time of the first sample after the trigger, and from one to the next.
    channel : int
        Which one.
    """

    volts: Array
    start_s: float
    step_s: float
    channel: int = 1
    taken: datetime = field(default_factory=now)

    @property
    def seconds(self) -> Array:
        """Times of the samples (n,)."""
        times: Array = self.start_s + self.step_s * np.arange(len(self.volts), dtype=np.float64)
        return times


@dataclass(frozen=True, eq=False)
class BScan:
    """A section by ultrasound.

    Parameters
    ----------
    pixels : ndarray (height, width)
        Echoes, 0 to 255; depth down.
    mm_per_px : (float, float) or None
        Along x and along y; None where the instrument does not tell: never guessed.
    origin_px : (float, float)
        Where the transducer is.
    speed_m_s : float
        Of sound, that the millimetres were computed with.
    frequency_khz, gain : float
        That it was taken with; NaN where nobody tells.
    region_px : (int, int, int, int), optional
        Left, top, right and bottom pixel of where the millimetres hold; by default everywhere.
    """

    pixels: NDArray[np.uint8]
    mm_per_px: tuple[float, float] | None
    origin_px: tuple[float, float]
    speed_m_s: float
    frequency_khz: float
    gain: float
    taken: datetime = field(default_factory=now)
    region_px: tuple[int, int, int, int] | None = None

    def frame(self, name: str = "scan") -> Frame:
        """The section as an image."""
        return Frame(self.pixels, 255.0, name, sha256_of(self.pixels.tobytes()))


@dataclass(frozen=True)
class AxisState:
    """How an axis stands.

    Parameters
    ----------
    position : float
        In the unit of the axis.
    moving : bool
        Whether it moves.
    homed : bool
        Whether the position means anything.
    faults : tuple of str
        What went wrong: stalled, a limit met, the driver off.
    """

    position: float
    moving: bool
    homed: bool
    faults: tuple[str, ...] = ()
