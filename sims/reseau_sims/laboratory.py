"""The world in motion: what the scanner sweeps is on the screen that oscilloscope and camera see; where the
turntable stands is where the camera sees the testfield.

All simulators of one bench share one laboratory; it may be asked from several threads. Its axes are asked
where they stand whenever someone looks: a table that moves is seen moving. An exposure is taken to be short.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array, Frame
from reseau.core.errors import UsageError
from reseau.optics import Pose, matrix_to_vector, rotation_matrix

from .reflectors import Reflectors
from .scanner import Video
from .screen import Screen
from .testfield import FieldBench, FieldTruth, Station
from .world import World

__all__ = ["AXES", "GRADIANS", "Laboratory", "Room"]

AXES = ("tilt", "roll", "camera_roll", "z")
"""Of the turntable: the board's tilt and its turn in its mount, the camera's turn (degrees), and the way of
the table away from the camera (mm)."""
GRADIANS = 400
"""Of a turn of the scanner's head; 200 looks straight down into the tank."""
_AHEAD = 200
_NOISE = 1.5
"""Of an echo's samples, of 255."""


@dataclass(frozen=True)
class Room:
    """What changes of itself while the clock runs.

    Parameters
    ----------
    light_per_hour : float
        By which share the lamp gets brighter.
    drift_mm_per_hour : (float, float, float)
        How the camera creeps on its stand: along x, y and its axis.
    """

    light_per_hour: float = 0.0
    drift_mm_per_hour: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Room:
        """A room as one meets it: half a per cent, and hundredths of a millimetre, in an hour."""
        x, y, z = rng.normal(0.0, 0.02, 3)
        return cls(float(rng.normal(0.0, 0.005)), (float(x), float(y), float(z)))


@dataclass(frozen=True, eq=False)
class _Mounted(FieldBench):
    """The testfield on its turntable: set up once, then moved; the paper's stations are set up anew."""

    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, field: FieldBench, shift: Array) -> _Mounted:
        """The same bench, with the camera elsewhere by so much."""
        same = {each.name: getattr(field, each.name) for each in fields(FieldBench)}
        return cls(**same, shift_mm=(float(shift[0]), float(shift[1]), float(shift[2])))

    def pose(self, station: Station) -> Pose:
        """Of the camera in the system of the board: that of the first setup, carried along."""
        first = super().pose(Station(0.0))
        phi, kappa, camera = np.deg2rad([station.phi, station.kappa, station.camera_kappa])
        board = rotation_matrix(np.array([0.0, phi, 0.0])) @ rotation_matrix(np.array([0.0, 0.0, kappa]))
        matrix = rotation_matrix(np.array([0.0, 0.0, camera])) @ first.matrix @ board
        place = board.T @ (first.x0 + np.array(self.shift_mm))
        return Pose(matrix_to_vector(matrix), place - self._lift(station))


def _same_camera(one: World, two: World) -> bool:
    a, b = one.camera, two.camera
    same = a.lens is b.lens and a.film is b.film and a.scan is b.scan
    same = same and (a.sensor, a.psf_px, a.response) == (b.sensor, b.psf_px, b.response)
    return same and bool((a.pose.x0 == b.pose.x0).all() and (a.pose.matrix == b.pose.matrix).all())


class Laboratory:
    """A world, and what its instruments have done to it so far.

    Parameters
    ----------
    world : World
        Screen, scanner, camera and tank.
    field : FieldBench, optional
        Testfield and camera on the turntable; by default those of the paper, of the world's seed.
    room : Room, optional
        By default drawn from the world's seed.
    clock : callable
        Seconds.
    repeatable : bool
        Whether the same state gives the same picture to the bit: nothing drifts, and noise is that of the
        state, not of the exposure.

    Examples
    --------
    >>> laboratory = Laboratory(World.standard(seed=7))
    >>> echoes = laboratory.line(200, 200, 2e-6)
    >>> len(echoes), int(laboratory.swept.sum())
    (200, 1)
    >>> laboratory.attach("tilt", lambda: 30.0)
    >>> laboratory.axes["tilt"], laboratory.expose("testfield").pixels.shape
    (30.0, (240, 240))
    """

    def __init__(
        self,
        world: World,
        field: FieldBench | None = None,
        *,
        room: Room | None = None,
        clock: Callable[[], float] = time.monotonic,
        repeatable: bool = False,
    ) -> None:
        self.world, self.repeatable = world, repeatable
        self.field = field or FieldBench(seed=world.seed)
        self.room = room or (Room() if repeatable else Room.drawn(world.rng("room")))
        self.lock = threading.RLock()
        self.swept = np.zeros(GRADIANS, dtype=bool)
        """Head angles of which echoes have been drawn."""
        self.echoes: NDArray[np.uint8] = np.zeros(0, np.uint8)
        """The last line of echoes; the oscilloscope's first channel shows it."""
        self._axes: dict[str, Callable[[], float]] = {}
        self._clock, self._began = clock, clock()
        self._tank = world.rods
        self._drawn: tuple[bytes, Screen] | None = None
        self._stood: World | None = None
        self._lines, self._exposures = 0, 0

    @property
    def hours(self) -> float:
        """Since it was opened."""
        return (self._clock() - self._began) / 3600

    def attach(self, axis: str, where: Callable[[], float]) -> None:
        """Have an axis of :data:`AXES` stand where this says (degrees or millimetres)."""
        if axis not in AXES:
            raise UsageError(f"is none of {', '.join(AXES)}", where=axis)
        self._axes[axis] = where

    @property
    def axes(self) -> dict[str, float]:
        """Where the axes stand at this moment; one that nothing moves stands at 0."""
        return {name: self._axes[name]() if name in self._axes else 0.0 for name in AXES}

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
            purpose = ("line", angle, self._state()) if self.repeatable else ("line", self._lines)
            noise = self.world.rng(*purpose).normal(0.0, _NOISE, samples)
            self.swept[angle % GRADIANS] = True
            self._drawn = None
            self.echoes = np.clip(gain * 255 * signal + noise, 0, 255).astype(np.uint8)
            return self.echoes

    SECTION_MM = (0.2, 0.25)
    """Size of a pixel of :meth:`section`, along and in depth."""

    def section(self) -> NDArray[np.uint8]:
        """A section as the scanner itself hands it over, no tube between; pixels of :attr:`SECTION_MM`."""
        with self.lock:
            scanner = self.world.scanner
            along, down = self.SECTION_MM
            columns, rows = round(2 * scanner.half_sweep_mm / along), round(scanner.depth_mm / down)
            place: Array = (np.arange(columns, dtype=np.float64) - (columns - 1) / 2) * along
            depth: Array = (np.arange(rows, dtype=np.float64) + 0.5) * down
            x = scanner.middle_mm + scanner.scale[0] * place
            y = scanner.top_mm - scanner.scale[1] * depth
            self._lines += 1
            video = scanner.sweep(self._tank, x, y, self.world.rng("section", self._lines))
            return np.clip(np.rint(255 * video.signal), 0, 255).astype(np.uint8)

    def pulse(self, place_mm: float) -> NDArray[np.uint8]:
        """Echoes of a transducer that stands so far along the tank, from its left end, on an oscilloscope.

        1000 samples of a microsecond, the pulse in their middle; 128 is nothing.
        """
        with self.lock:
            scanner, tank = self.world.scanner, self._tank
            half = scanner.speed / 2
            range_mm = (np.arange(1000.0) - 500) * half
            off = place_mm - scanner.half_sweep_mm - tank.xy[:, 0]
            distance, width = np.hypot(off, tank.xy[:, 1]), scanner.beam_mm(-tank.xy[:, 1])
            strength = scanner.brightness * tank.strength * np.exp(-0.5 * (off / width) ** 2)
            late = (range_mm[:, None] - distance) / np.hypot(scanner.pulse_mm, half / 2)
            self._lines += 1
            noise = self.world.rng("pulse", self._lines).normal(0.0, _NOISE, len(range_mm))
            signal = 120 * (np.exp(-0.5 * late**2) * strength).sum(axis=1) + noise
            return np.asarray(np.clip(np.rint(128 + signal), 0, 255), np.uint8)

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
        """What the camera sees now of the reseau before the tube; the same name has the same noise."""
        with self.lock:
            return self._standing().photograph(name, self.screen())

    def field_truth(self) -> FieldTruth:
        """Where the targets of the testfield are now, in space and in the image."""
        with self.lock:
            station, bench = self._moved()
            return bench.truth(station)

    def expose(self, sight: Literal["screen", "testfield"], light: float = 1.0, gain: float = 1.0) -> Frame:
        """A frame of what a camera sees now; no two have the same noise.

        Parameters
        ----------
        sight : {"screen", "testfield"}
            The reseau before the tube, or the testfield on the turntable.
        light : float
            Exposure, of the nominal one.
        gain : float
            Factor of the amplifier.
        """
        with self.lock:
            self._exposures += 1
            name = f"exposure {self._state() if self.repeatable else self._exposures}"
            level = light * gain * max(0.0, 1 + self.room.light_per_hour * self.hours)
            if sight == "screen":
                screen = copy.copy(self.screen())
                screen.light = screen.light * np.float32(level)
                return self._standing().photograph(name, screen)
            rng = self.world.rng(name)
            station, bench = self._moved()
            sensor = bench.sensor
            shifts = sensor.row_shifts(rng) if sensor.row_jitter_px else None
            pixels = sensor.expose(level * bench.light(station, shifts), rng)
            return Frame(pixels, sensor.full_scale, name, sha256(pixels.tobytes()).hexdigest())

    def _state(self) -> str:
        """All that a picture shows, as a name."""
        axes = " ".join(f"{name} {value:.6f}" for name, value in self.axes.items())
        tank = sha256(self._tank.xy.tobytes() + np.packbits(self.swept).tobytes()).hexdigest()
        return f"{axes} {tank}"

    def _drift(self) -> Array:
        """How far the cameras have crept (mm), to a micrometre: no frame shows less."""
        crept: Array = np.round(self.hours * np.array(self.room.drift_mm_per_hour), 3)
        return crept

    def _standing(self) -> World:
        """The world with the camera where it stands now."""
        drift = self._drift()
        if not drift.any():
            return self.world
        crept = replace(self.world, camera=self.world.camera.moved(drift, 0.0))
        # What was computed of a camera holds as long as it stands there.
        if self._stood is None or not _same_camera(self._stood, crept):
            self._stood = crept
        return replace(crept, camera=self._stood.camera)

    def _moved(self) -> tuple[Station, FieldBench]:
        """How the table stands, and the testfield on it."""
        axes = self.axes
        station = Station(axes["tilt"], axes["roll"], axes["camera_roll"])
        return station, _Mounted.of(self.field, self._drift() + np.array([0.0, 0.0, axes["z"]]))

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
