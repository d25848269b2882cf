"""The world in motion: what the scanner sweeps is drawn on the screen that oscilloscope and camera see.

All simulators of one bench share one laboratory; it may be asked from several threads.
"""

from __future__ import annotations

import threading
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.data import Array, Frame

from .reflectors import Reflectors
from .scanner import Video
from .screen import Screen
from .world import World

__all__ = ["GRADIANS", "Laboratory"]

GRADIANS = 400
"""Of a turn of the scanner's head; 200 looks straight down into the tank."""
_AHEAD = 200
_NOISE = 1.5
"""Of an echo's samples, of 255."""


class Laboratory:
    """A world, and what its instruments have done to it so far.

    Parameters
    ----------
    world : World
        Screen, scanner, camera and tank.

    Examples
    --------
    >>> laboratory = Laboratory(World.standard(seed=7))
    >>> echoes = laboratory.line(200, 200, 2e-6)
    >>> len(echoes), int(laboratory.swept.sum())
    (200, 1)
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.lock = threading.RLock()
        self.swept = np.zeros(GRADIANS, dtype=bool)
        """Head angles of which echoes have been drawn."""
        self.axes: dict[str, float] = {}
        """Where the axes of the turntable stand."""
        self.echoes: NDArray[np.uint8] = np.zeros(0, np.uint8)
        """The last line of echoes; the oscilloscope's first channel shows it."""
        self._tank = world.rods
        self._drawn: tuple[bytes, Screen] | None = None
        self._lines = 0

    @property
    def tank(self) -> Reflectors:
        """What stands in the tank."""
        return self._tank

    @tank.setter
    def tank(self, reflectors: Reflectors) -> None:
        with self.lock:
            self._tank, self._drawn = reflectors, None
            self.swept[:] = False

    def line(self, angle: int, samples: int, period_s: float, gain: float = 1.0) -> NDArray[np.uint8]:
        """Send a pulse, and listen; the line appears on the screen.

        Parameters
        ----------
        angle : int
            Of the head (gradians).
        samples : int
            How many.
        period_s : float
            From one sample to the next.
        gain : float
            Factor of the amplifier.

        Returns
        -------
        ndarray (samples,)
            Amplitude of the echoes, from the head outwards.
        """
        with self.lock:
            scanner, tank = self.world.scanner, self._tank
            step = scanner.speed * 1e6 * period_s / 2
            ranges: Array = (np.arange(samples, dtype=np.float64) + 0.5) * step
            x, depth = tank.xy[:, 0], -tank.xy[:, 1]
            distance = np.hypot(x, depth)
            off = np.arctan2(x, depth) - (angle - _AHEAD) * 2 * np.pi / GRADIANS
            width = scanner.beam_mm(depth) / distance
            strength = scanner.brightness * tank.strength * np.exp(-0.5 * (off / width) ** 2)
            # A sample is a mean over its time: an echo is never narrower than that.
            pulse = np.hypot(scanner.pulse_mm, step / 2)
            late = (ranges[:, None] - distance[None, :]) / pulse
            signal = (np.exp(-0.5 * late**2) * strength).sum(axis=1)
            self._lines += 1
            noise = self.world.rng("line", self._lines).normal(0.0, _NOISE, samples)
            self.swept[angle % GRADIANS] = True
            self._drawn = None
            self.echoes = np.clip(gain * 255 * signal + noise, 0, 255).astype(np.uint8)
            return self.echoes

    def screen(self) -> Screen:
        """The tube as it glows now: of the section, what has been swept."""
        with self.lock:
            key = np.packbits(self.swept).tobytes()
            if self._drawn is None or self._drawn[0] != key:
                self._drawn = (key, self._draw())
            return self._drawn[1]

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """The tube as a grey picture, as the oscilloscope's own screen shows it."""
        light = self.screen().light
        return np.clip(cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA), 0, 255).astype(
            np.uint8
        )

    def photograph(self, name: str) -> Frame:
        """What the camera sees now: the reseau in front of the tube."""
        with self.lock:
            return self.world.photograph(name, self.screen())

    def _draw(self) -> Screen:
        world = self.world
        if not self.swept.any():
            return world.screen
        screen = replace(world.screen)
        x, y = world.display.raster(screen)
        video = world.scanner.sweep(self._tank, x, y, world.rng("receiver", "laboratory"))
        place = (x[None, :] - world.scanner.middle_mm) / world.scanner.scale[0]
        depth = (world.scanner.top_mm - y[:, None]) / world.scanner.scale[1]
        angle = (
            np.rint(np.arctan2(place, np.maximum(depth, 1e-9)) * GRADIANS / (2 * np.pi)).astype(int) + _AHEAD
        )
        shown = np.where(self.swept[angle % GRADIANS], video.signal, np.float32(0.0))
        beam = world.scanner.m1, world.scanner.m2
        world.display.show(Video(x, y, shown), screen, world.rng("phosphor", "laboratory"), beam)
        return screen
