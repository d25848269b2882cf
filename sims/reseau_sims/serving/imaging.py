"""Common part of all simulated cameras: a scene, and settings that affect the image."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array, Frame

from ..laboratory import Laboratory, Seat
from ..pixels import PixelSensor
from ..streams import stream
from .faults import FaultScript

NOMINAL_US = 10_000.0
"""Exposure time at which a scene has its nominal brightness (µs)."""
_KEPT = 16


@dataclass(frozen=True)
class View:
    """Settings of a camera.

    Parameters
    ----------
    exposure_us : float
        Exposure time (µs).
    gain_db : float
        Gain of the amplifier (dB).
    offset : float
        Grey values added at the end.
    left, top, width, height : int
        Region of the sensor (px).
    full_scale : float
        Grey value at saturation.

    Examples
    --------
    >>> view = View(5000.0, 6.0, 0.0, 0, 0, 96, 64, 255.0)
    >>> view.light, round(view.gain, 3)
    (0.5, 1.995)
    """

    exposure_us: float
    gain_db: float
    offset: float
    left: int
    top: int
    width: int
    height: int
    full_scale: float

    @property
    def light(self) -> float:
        """Exposure relative to the nominal one."""
        return self.exposure_us / NOMINAL_US

    @property
    def gain(self) -> float:
        """Gain factor."""
        return float(10 ** (self.gain_db / 20))

    def seen(self, whole: NDArray[Any]) -> NDArray[Any]:
        """Return the region of a complete image that already contains exposure and gain, plus the offset."""
        part = whole[self.top : self.top + self.height, self.left : self.left + self.width]
        if not self.offset:
            return part
        return np.clip(part + self.offset, 0, self.full_scale).astype(whole.dtype)


class Scene(Protocol):
    """Scene in front of a camera.

    Examples
    --------
    >>> scene: Scene = StripeScene(96, 64)
    >>> scene(View(10_000.0, 0.0, 0.0, 0, 0, 96, 64, 255.0)).shape
    (64, 96)
    """

    def __call__(self, view: View) -> NDArray[Any]:
        """Return the image of a view; equal views give equal images."""


@dataclass(frozen=True)
class StripeScene:
    """Slanted stripes that encode a shift: every shift has a unique image.

    Parameters
    ----------
    width, height : int
        Size of the sensor (px).
    shift : int
        Shift of the stripes.

    Examples
    --------
    >>> int(StripeScene(shift=1)(View(10_000.0, 0.0, 0.0, 0, 0, 96, 64, 255.0))[0, 0])
    27
    """

    width: int = 96
    height: int = 64
    shift: int = 0

    def __call__(self, view: View) -> NDArray[Any]:
        """Return the image of a view."""
        y, x = np.mgrid[: self.height, : self.width]
        stripes = (3 * x + 5 * y + 7 * self.shift) % 101 + 20
        grey = np.minimum(stripes * (view.full_scale / 255 * view.light * view.gain), view.full_scale)
        return view.seen(grey.astype(np.uint8 if view.full_scale <= 255 else np.uint16))


@dataclass(frozen=True, eq=False)
class StillScene:
    """Image taken at the nominal exposure; other settings scale it.

    Parameters
    ----------
    frame : Frame
        The image.

    Examples
    --------
    >>> scene = StillScene(Frame(np.full((4, 6), 100, np.uint8), 255.0))
    >>> int(scene(View(5_000.0, 0.0, 0.0, 0, 0, 6, 4, 255.0))[0, 0])
    50
    """

    frame: Frame

    def __call__(self, view: View) -> NDArray[Any]:
        """Return the image of a view."""
        return view.seen(_levelled(self.frame, view, view.light * view.gain))


@dataclass(frozen=True, eq=False)
class LaboratoryScene:
    """Current scene of a camera in the laboratory; each image has its own noise.

    Parameters
    ----------
    laboratory : Laboratory
        Laboratory with the camera.
    scene : {"screen", "testfield"}
        Object in front of the camera.
    seat : Seat, optional
        Camera of a rig before the testfield.

    Examples
    --------
    >>> LaboratoryScene.__dataclass_fields__["scene"].default
    'screen'
    """

    laboratory: Laboratory
    scene: Literal["screen", "testfield"] = "screen"
    seat: Seat | None = None

    def __call__(self, view: View) -> NDArray[Any]:
        """Return the image of a view."""
        frame = self.laboratory.expose(self.scene, view.light, view.gain, self.seat)
        return view.seen(_levelled(frame, view, 1.0))


@dataclass(eq=False)
class LampScene:
    """Sensor with non-uniform pixels in front of a lamp, without a lens; each image has its own noise.

    Parameters
    ----------
    sensor : PixelSensor
        Forms the image; gain and scale of a view are those of the sensor.
    light : ndarray or float
        Grey values per microsecond; 0 if the sensor is covered.
    seed : int
        Seed of the noise.

    Examples
    --------
    >>> LampScene.__dataclass_fields__["light"].default
    0.25
    """

    sensor: PixelSensor
    light: Array | float = 0.25
    seed: int = 0
    _taken: int = field(default=0, init=False)

    def __call__(self, view: View) -> NDArray[Any]:
        """Return the image of a view."""
        self._taken += 1
        rng = stream(self.seed, "lamp", self._taken)
        return view.seen(self.sensor.expose(self.light, view.exposure_us, rng))


def _levelled(frame: Frame, view: View, factor: float) -> NDArray[Any]:
    """Convert the grey values of a frame to the scale of a view: from 8 to 16 bits, each step is 257."""
    factor *= view.full_scale / frame.full_scale
    dtype = np.uint8 if view.full_scale <= 255 else np.uint16
    if factor == 1.0 and frame.pixels.dtype == dtype:
        return frame.pixels
    return np.clip(np.rint(frame.pixels * factor), 0, view.full_scale).astype(dtype)


class SimulatedCamera:
    """Simulated sensor with a scene; it is connected through a Video4Linux or GigE Vision interface.

    Parameters
    ----------
    scene : Scene
        Initial scene.
    width, height : int
        Size of the sensor (px).
    script : FaultScript, optional
        Faults of frames.

    Attributes
    ----------
    violations : list of str
        Protocol violations of the client.
    drawn : deque of ndarray
        The last images.
    before_change : list of callable
        Called before the scene changes, so that exposures started earlier show the previous scene.

    Examples
    --------
    >>> camera = SimulatedCamera()
    >>> camera.draw(View(10_000.0, 0.0, 0.0, 0, 0, 96, 64, 255.0)).shape
    (64, 96)
    """

    def __init__(
        self, scene: Scene | None = None, width: int = 96, height: int = 64, script: FaultScript | None = None
    ) -> None:
        self.lock = threading.RLock()
        self.width, self.height = width, height
        self.script = script or FaultScript()
        self.violations: list[str] = []
        self.drawn: deque[NDArray[Any]] = deque(maxlen=_KEPT)
        self.before_change: list[Callable[[], None]] = []
        self._scene: Scene = scene or StripeScene(width, height)

    @property
    def scene(self) -> Scene:
        """Current scene."""
        return self._scene

    def point_at(self, scene: Scene) -> None:
        """Change the scene."""
        with self.lock:
            for each in self.before_change:
                each()
            self._scene = scene

    def draw(self, view: View) -> NDArray[Any]:
        """Return the current image."""
        with self.lock:
            picture = self._scene(view)
            self.drawn.append(picture)
            return picture
