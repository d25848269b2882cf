"""What every simulated camera has: something to look at, and settings that act on the picture."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array, Frame

from ..laboratory import Laboratory
from ..pixels import PixelSensor
from ..streams import stream
from .faults import FaultScript

__all__ = ["LaboratoryScene", "LampScene", "Scene", "SimulatedCamera", "StillScene", "StripeScene", "View"]

NOMINAL_US = 10_000.0
"""Exposure at which a scene has its own brightness."""
_KEPT = 16


@dataclass(frozen=True)
class View:
    """How a camera is set.

    Parameters
    ----------
    exposure_us : float
        Exposure time.
    gain_db : float
        Of its amplifier.
    offset : float
        Grey values added at the end.
    left, top, width, height : int
        Region of the sensor.
    full_scale : float
        Grey value at which it saturates.
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
        """Light that is gathered, of that of the nominal exposure."""
        return self.exposure_us / NOMINAL_US

    @property
    def gain(self) -> float:
        """Factor of the amplifier."""
        return float(10 ** (self.gain_db / 20))

    def seen(self, whole: NDArray[Any]) -> NDArray[Any]:
        """The region of a whole picture that already has exposure and gain, with the offset."""
        part = whole[self.top : self.top + self.height, self.left : self.left + self.width]
        if not self.offset:
            return part
        return np.clip(part + self.offset, 0, self.full_scale).astype(whole.dtype)


class Scene(Protocol):
    """What a camera looks at."""

    def __call__(self, view: View) -> NDArray[Any]:
        """The picture; the same view gives the same one."""


@dataclass(frozen=True)
class StripeScene:
    """Slanted stripes that tell their shift: a picture that is no other's.

    Parameters
    ----------
    width, height : int
        Of the sensor.
    shift : int
        Of the stripes.
    """

    width: int = 96
    height: int = 64
    shift: int = 0

    def __call__(self, view: View) -> NDArray[Any]:
        """The picture of a view."""
        y, x = np.mgrid[: self.height, : self.width]
        stripes = (3 * x + 5 * y + 7 * self.shift) % 101 + 20
        grey = np.minimum(stripes * (view.full_scale / 255 * view.light * view.gain), view.full_scale)
        return view.seen(grey.astype(np.uint8 if view.full_scale <= 255 else np.uint16))


@dataclass(frozen=True, eq=False)
class StillScene:
    """A picture that was taken at the nominal exposure; other settings scale it.

    Parameters
    ----------
    frame : Frame
        The picture.
    """

    frame: Frame

    def __call__(self, view: View) -> NDArray[Any]:
        """The picture of a view."""
        return view.seen(_levelled(self.frame, view, view.light * view.gain))


@dataclass(frozen=True, eq=False)
class LaboratoryScene:
    """What a camera of the laboratory sees now; no two pictures have the same noise.

    Parameters
    ----------
    laboratory : Laboratory
        Where it stands.
    scene : {"screen", "testfield"}
        What stands before it.
    """

    laboratory: Laboratory
    scene: Literal["screen", "testfield"] = "screen"

    def __call__(self, view: View) -> NDArray[Any]:
        """The picture of a view."""
        return view.seen(_levelled(self.laboratory.expose(self.scene, view.light, view.gain), view, 1.0))


@dataclass(eq=False)
class LampScene:
    """A sensor of uneven pixels before a lamp, without a lens; no two pictures have the same noise.

    Parameters
    ----------
    sensor : PixelSensor
        What is seen is what it makes of the light; gain and scale of a view are the sensor's own.
    light : ndarray or float
        Grey values per microsecond; 0 when it is covered.
    seed : int
        Of the noise.
    """

    sensor: PixelSensor
    light: Array | float = 0.25
    seed: int = 0
    _taken: int = field(default=0, init=False)

    def __call__(self, view: View) -> NDArray[Any]:
        """The picture of a view."""
        self._taken += 1
        rng = stream(self.seed, "lamp", self._taken)
        return view.seen(self.sensor.expose(self.light, view.exposure_us, rng))


def _levelled(frame: Frame, view: View, factor: float) -> NDArray[Any]:
    """Grey values of a frame on the scale of a view: of eight bits in sixteen, each step is 257."""
    factor *= view.full_scale / frame.full_scale
    dtype = np.uint8 if view.full_scale <= 255 else np.uint16
    if factor == 1.0 and frame.pixels.dtype == dtype:
        return frame.pixels
    return np.clip(np.rint(frame.pixels * factor), 0, view.full_scale).astype(dtype)


class SimulatedCamera:
    """A sensor that looks at something; the doors in front of it are V4L2 or GigE Vision.

    Parameters
    ----------
    scene : Scene
        What it looks at first.
    width, height : int
        Of its sensor.
    script : FaultScript, optional
        Which frames suffer which fault.

    Attributes
    ----------
    violations : list of str
        What its client did wrong.
    drawn : deque of ndarray
        The last pictures.
    before_change : list of callable
        Called before it looks at something else, so that what was exposed until then is what was seen then.
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
        """What it looks at."""
        return self._scene

    def point_at(self, scene: Scene) -> None:
        """Turn it to something else."""
        with self.lock:
            for each in self.before_change:
                each()
            self._scene = scene

    def draw(self, view: View) -> NDArray[Any]:
        """The picture that it takes now."""
        with self.lock:
            picture = self._scene(view)
            self.drawn.append(picture)
            return picture
