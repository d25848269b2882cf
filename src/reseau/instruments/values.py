"""Values that instruments return: identity, screen picture, waveform, section, state of an axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Frame
from ..core.environment import Condition
from ..core.errors import ImageError
from ..core.provenance import sha256_of


def now() -> datetime:
    """Return the current time in UTC."""
    return datetime.now(UTC)


@dataclass(frozen=True)
class Identity:
    """Identity that an instrument reports.

    Parameters
    ----------
    maker, model : str
        Manufacturer and type.
    serial, firmware : str, optional
        Serial number and firmware version; empty if not reported.

    Examples
    --------
    >>> str(Identity("Blue Robotics", "Ping360", firmware="3.1.1"))
    'Blue Robotics Ping360 3.1.1'
    """

    maker: str
    model: str
    serial: str = ""
    firmware: str = ""

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.model, self.serial, self.firmware) if part)


@dataclass(frozen=True)
class Finding:
    """One thing found on the way to an instrument.

    Parameters
    ----------
    fine : bool or None
        True if it is as it should be, False if the instrument cannot work, None if it may not.
    text, do : str
        What was found, and what to do.

    Examples
    --------
    >>> print(Finding(False, "/dev/ttyUSB0 does not exist", "plug it in"))
    /dev/ttyUSB0 does not exist; plug it in
    """

    fine: bool | None
    text: str
    do: str = ""

    def __str__(self) -> str:
        return f"{self.text}; {self.do}" if self.do else self.text


@dataclass(frozen=True)
class ScreenPicture:
    """Picture of an instrument's own screen, as the file that the instrument sent.

    Parameters
    ----------
    data : bytes
        PNG or BMP file.
    taken : datetime
        Time of the request, UTC.

    Examples
    --------
    >>> data = cv2.imencode(".png", np.zeros((4, 6), np.uint8))[1].tobytes()
    >>> picture = ScreenPicture(data)
    >>> picture.suffix, picture.frame().pixels.shape
    ('.png', (4, 6))
    """

    data: bytes
    taken: datetime = field(default_factory=now)

    @property
    def suffix(self) -> str:
        """Suffix for a file with this picture: ``.png`` or ``.bmp``."""
        return ".bmp" if self.data[:2] == b"BM" else ".png"

    def frame(self, name: str = "screen") -> Frame:
        """Decode the picture to a grey image with 8 bits.

        Raises
        ------
        ImageError
            If the picture cannot be decoded.
        """
        try:
            grey = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        except cv2.error:
            grey = None
        if grey is None:
            raise ImageError("cannot be decoded as PNG or BMP", where=name)
        return Frame(grey, 255.0, name, sha256_of(self.data))


@dataclass(frozen=True, eq=False)
class Waveform:
    """Samples of one channel of an oscilloscope.

    Parameters
    ----------
    volts : ndarray (n,)
        Samples (V) at equal time steps.
    start_s, step_s : float
        Time of the first sample relative to the trigger, and the time step (s).
    channel : int
        Number of the channel.
    taken : datetime
        Time of the request, UTC.

    Examples
    --------
    >>> Waveform(np.array([0.0, 0.5, 0.1]), start_s=-1e-6, step_s=1e-6).seconds
    array([-1.e-06,  0.e+00,  1.e-06])
    """

    volts: Array
    start_s: float
    step_s: float
    channel: int = 1
    taken: datetime = field(default_factory=now)

    @property
    def seconds(self) -> Array:
        """Times of the samples relative to the trigger (n,), in seconds."""
        return self.start_s + self.step_s * np.arange(len(self.volts), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class BScan:
    """Ultrasonic section (B-mode image).

    Parameters
    ----------
    pixels : ndarray (height, width)
        Echo amplitudes, 0 to 255; depth increases downwards.
    mm_per_px : (float, float) or None
        Pixel size along x and y (mm); None if the instrument does not report it. It is never guessed.
    origin_px : (float, float)
        Position of the transducer (px).
    speed_m_s : float
        Speed of sound (m/s) from which the pixel size was computed.
    frequency_khz, gain : float
        Frequency (kHz) and gain of the acquisition; NaN if unknown.
    taken : datetime
        Time of the request, UTC.
    region_px : (int, int, int, int), optional
        First and last column and row of the region where the pixel size is valid, as left, top, right,
        bottom; by default the whole image.

    Examples
    --------
    >>> scan = BScan(np.zeros((40, 60), np.uint8), (0.2, 0.25), (29.5, 0.0), 1540.0, 6000.0, 57.0)
    >>> scan.frame().pixels.shape
    (40, 60)
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
        """Return the section as an image."""
        return Frame(self.pixels, 255.0, name, sha256_of(self.pixels.tobytes()))


@dataclass(frozen=True)
class AxisState:
    """State of an axis.

    Parameters
    ----------
    position : float
        Position in the unit of the axis.
    moving : bool
        Whether the axis moves.
    homed : bool
        Whether the axis has found its reference; otherwise the position is meaningless.
    faults : tuple of str
        Reported faults: stalled, limit switch reached, driver off.
    reference : str
        How the reference is known, or why there is none.

    Examples
    --------
    >>> AxisState(30.0, moving=False, homed=True)
    AxisState(position=30.0, moving=False, homed=True, faults=(), reference='')
    """

    position: float
    moving: bool
    homed: bool
    faults: tuple[str, ...] = ()
    reference: str = ""


@dataclass(frozen=True)
class Environment:
    """What a sensor of the environment measures.

    Parameters
    ----------
    conditions : mapping of str to Condition
        Temperature, humidity, pressure and the like, by name.
    taken : datetime
        Time of the measurement, UTC.

    Examples
    --------
    >>> Environment({"temperature": Condition(21.5, "°C", 0.2)}).conditions["temperature"].value
    21.5
    """

    conditions: Mapping[str, Condition]
    taken: datetime = field(default_factory=now)
