"""The world over time: oscilloscope and camera see the sweep of the scanner; the camera sees the testfield as
the turntable positions it.

All simulators of one bench share one laboratory; it is safe for use by several threads. The positions of its
axes are read at each exposure, so that a moving table is seen moving; exposures are regarded as short.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
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

AXES = ("tilt", "roll", "camera_roll", "z")
"""Axes of the turntable: tilt of the board, its roll in the mount, roll of the camera (degrees), and
displacement of the table away from the camera (mm)."""
GRADIANS = 400
"""Gradians in a full turn of the scanner's head; 200 points straight down into the tank."""
_AHEAD = 200
_NOISE = 1.5
"""Standard deviation of the noise of an echo's samples, of 255."""


@dataclass(frozen=True)
class Room:
    """Drift of the environment with time.

    Parameters
    ----------
    light_per_hour : float
        Relative increase of the light per hour.
    drift_mm_per_hour : (float, float, float)
        Drift of the camera on its stand: along x, y and its axis.
    warming_c_per_hour : float
        Warming of the water (°C per hour), if the testfield is under water.

    Examples
    --------
    >>> Room(light_per_hour=0.005).drift_mm_per_hour
    (0.0, 0.0, 0.0)
    """

    light_per_hour: float = 0.0
    drift_mm_per_hour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    warming_c_per_hour: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Room:
        """A random room: about 0.5 %, some hundredths of a millimetre, and 0.1 °C per hour."""
        x, y, z = rng.normal(0.0, 0.02, 3)
        light, warming = float(rng.normal(0.0, 0.005)), float(rng.normal(0.0, 0.1))
        return cls(light, (float(x), float(y), float(z)), warming)


@dataclass(frozen=True)
class Seat:
    """Place of a camera on a rig: its projection centre in the axes of the first camera, and its lens.

    Parameters
    ----------
    number : int
        Number of the camera, from 0; each has its own noise.
    base_mm : (float, float, float)
        Projection centre. The camera looks at the middle of the board.
    longer : float
        Relative difference of its principal distance to that of the first camera.

    Examples
    --------
    >>> Seat(1, (80.0, 0.0, 0.0)).matrix(800.0).round(3).tolist()[2]
    [-0.1, 0.0, 0.995]
    """

    number: int = 0
    base_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    longer: float = 0.0

    def matrix(self, distance_mm: float) -> Array:
        """Rotation (3, 3) from the axes of the first camera, which looks at a board at this distance."""
        z = np.array([0.0, 0.0, distance_mm]) - self.base_mm
        z /= np.linalg.norm(z)
        x = np.array([1.0, 0.0, 0.0]) - z[0] * z
        x /= np.linalg.norm(x)
        return np.array([x, np.cross(z, x), z])


@dataclass(frozen=True, eq=False)
class _Mounted(FieldBench):
    """The testfield on its turntable: one set-up for all stations, unlike :class:`FieldBench`."""

    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seat: Seat = field(default_factory=Seat)

    @classmethod
    def of(cls, field: FieldBench, shift: Array, seat: Seat | None = None) -> _Mounted:
        """The same bench with a displaced camera, or another one of its rig."""
        same = {each.name: getattr(field, each.name) for each in fields(FieldBench)}
        seat = seat or Seat()
        if seat.number:
            c = float(field.camera.values[field.camera.names.index("c")])
            same["camera"] = field.camera.with_values({"c": (1 + seat.longer) * c})
        return cls(**same, shift_mm=(float(shift[0]), float(shift[1]), float(shift[2])), seat=seat)

    def pose(self, station: Station) -> Pose:
        """Pose of the camera in the system of the board, from that of the first set-up."""
        first = super().pose(Station(0.0))
        phi, kappa, camera = np.deg2rad([station.phi, station.kappa, station.camera_kappa])
        board = rotation_matrix(np.array([0.0, phi, 0.0])) @ rotation_matrix(np.array([0.0, 0.0, kappa]))
        matrix = rotation_matrix(np.array([0.0, 0.0, camera])) @ first.matrix @ board
        place = board.T @ (first.x0 + np.array(self.shift_mm))
        # A rig turns with its first camera.
        place = place + matrix.T @ np.array(self.seat.base_mm)
        turned = self.seat.matrix(self.distance_mm) @ matrix if self.seat.number else matrix
        return Pose(matrix_to_vector(turned), place - self._lift(station))


def _same_camera(one: World, two: World) -> bool:
    a, b = one.camera, two.camera
    same = a.lens is b.lens and a.film is b.film and a.scan is b.scan
    same = same and (a.sensor, a.psf_px, a.response) == (b.sensor, b.psf_px, b.response)
    return same and bool((a.pose.x0 == b.pose.x0).all() and (a.pose.matrix == b.pose.matrix).all())


class Laboratory:
    """A world and its present state, changed by its instruments.

    Parameters
    ----------
    world : World
        Screen, scanner, camera and tank.
    field : FieldBench, optional
        Testfield and camera on the turntable; by default those of the paper, of the world's seed.
    room : Room, optional
        Drift; by default random, from the world's seed.
    clock : callable
        Time in seconds.
    repeatable : bool
        Whether the same state gives the same picture to the bit: without drift, and with noise that depends
        on the state and not on the exposure.

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
        """Head angles whose echoes have been drawn."""
        self.echoes: NDArray[np.uint8] = np.zeros(0, np.uint8)
        """The last line of echoes; the oscilloscope's first channel shows it."""
        self._axes: dict[str, Callable[[], float]] = {}
        self._clock, self._began = clock, clock()
        self._tank = world.rods
        self._drawn: tuple[bytes, Screen] | None = None
        self._exposed: dict[int, tuple[tuple[FieldBench, str], Frame]] = {}
        self._stood: World | None = None
        self._lines, self._exposures = 0, 0

    @property
    def hours(self) -> float:
        """Hours since it was created."""
        return (self._clock() - self._began) / 3600

    def attach(self, axis: str, where: Callable[[], float]) -> None:
        """Connect an axis of :data:`AXES` to a function that returns its position (degrees or mm)."""
        if axis not in AXES:
            raise UsageError(f"is not one of {', '.join(AXES)}", where=axis)
        self._axes[axis] = where

    @property
    def axes(self) -> dict[str, float]:
        """Present positions of the axes; 0 for an axis that is not connected."""
        return {name: self._axes[name]() if name in self._axes else 0.0 for name in AXES}

    @property
    def tank(self) -> Reflectors:
        """Reflectors in the tank."""
        return self._tank

    @tank.setter
    def tank(self, reflectors: Reflectors) -> None:
        with self.lock:
            self._tank, self._drawn = reflectors, None
            self.swept[:] = False

    def line(self, angle: int, samples: int, period_s: float, gain: float = 1.0) -> NDArray[np.uint8]:
        """Send a pulse and record its echoes; the line appears on the screen.

        Parameters
        ----------
        angle : int
            Angle of the head (gradians).
        samples : int
            Number of samples.
        period_s : float
            Sampling period.
        gain : float
            Gain of the amplifier.

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
            # A sample is a mean over its period, which limits the width of an echo.
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
        """A section directly from the scanner, without a tube; pixels of :attr:`SECTION_MM`."""
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
        """Echoes on an oscilloscope of a transducer at `place_mm` from the left end of the tank.

        1000 samples of a microsecond with the pulse in the middle; 128 is zero.
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
        """The present screen, with the part of the section that has been swept."""
        with self.lock:
            key = np.packbits(self.swept).tobytes()
            if self._drawn is None or self._drawn[0] != key:
                self._drawn = (key, self._draw())
            return self._drawn[1]

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """The tube as a grey picture, as on the oscilloscope's own screen."""
        light = self.screen().light
        return np.clip(cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA), 0, 255).astype(
            np.uint8
        )

    def photograph(self, name: str) -> Frame:
        """Photograph the reseau in front of the tube; the same name gives the same noise."""
        with self.lock:
            return self._standing().photograph(name, self.screen())

    def field_truth(self, seat: Seat | None = None) -> FieldTruth:
        """Present true positions of the targets of the testfield, in space and in the image."""
        with self.lock:
            station, bench = self._moved(seat)
            return bench.truth(station)

    def expose(
        self,
        sight: Literal["screen", "testfield"],
        light: float = 1.0,
        gain: float = 1.0,
        seat: Seat | None = None,
    ) -> Frame:
        """Take a frame; each has its own noise, unless `repeatable`.

        Parameters
        ----------
        sight : {"screen", "testfield"}
            The reseau in front of the tube, or the testfield on the turntable.
        light : float
            Exposure relative to the nominal one.
        gain : float
            Gain of the amplifier.
        seat : Seat, optional
            Camera of a rig before the testfield.
        """
        with self.lock:
            self._exposures += 1
            if not self.repeatable or sight == "screen":
                return self._expose(sight, light, gain, seat)
            # A video camera exposes all the time, and a frame under water takes a second to draw.
            number = 0 if seat is None else seat.number
            key = self.field, f"{light} {gain} {self._state()}"
            if number not in self._exposed or self._exposed[number][0] != key:
                self._exposed[number] = key, self._expose(sight, light, gain, seat)
            return self._exposed[number][1]

    def _expose(
        self, sight: Literal["screen", "testfield"], light: float, gain: float, seat: Seat | None
    ) -> Frame:
        with self.lock:
            name = f"exposure {self._state() if self.repeatable else self._exposures}"
            name += "" if seat is None or not seat.number else f" of camera {seat.number}"
            level = light * gain * max(0.0, 1 + self.room.light_per_hour * self.hours)
            if sight == "screen":
                screen = copy.copy(self.screen())
                screen.light = screen.light * np.float32(level)
                return self._standing().photograph(name, screen)
            rng = self.world.rng(name)
            station, bench = self._moved(seat)
            sensor = bench.sensor
            shifts = sensor.row_shifts(rng) if sensor.row_jitter_px else None
            pixels = sensor.expose(level * bench.light(station, shifts), rng)
            return Frame(pixels, sensor.full_scale, name, sha256(pixels.tobytes()).hexdigest())

    def _state(self) -> str:
        """The state that determines a picture, as a string."""
        axes = " ".join(f"{name} {value:.6f}" for name, value in self.axes.items())
        tank = sha256(self._tank.xy.tobytes() + np.packbits(self.swept).tobytes()).hexdigest()
        return f"{axes} {tank}"

    def _drift(self) -> Array:
        """Drift of the cameras (mm), rounded to a micrometre, which no frame resolves."""
        crept: Array = np.round(self.hours * np.array(self.room.drift_mm_per_hour), 3)
        return crept

    def _standing(self) -> World:
        """The world with the camera at its present position."""
        drift = self._drift()
        if not drift.any():
            return self.world
        crept = replace(self.world, camera=self.world.camera.moved(drift, 0.0))
        # Reuse cached mappings of the camera while it does not move.
        if self._stood is None or not _same_camera(self._stood, crept):
            self._stood = crept
        return replace(crept, camera=self._stood.camera)

    def pose_at(self, position: Mapping[str, float]) -> Pose:
        """Pose of the camera in the system of the board, at a position of the axes, without drift."""
        at = dict.fromkeys(AXES, 0.0) | dict(position)
        station = Station(at["tilt"], at["roll"], at["camera_roll"])
        return _Mounted.of(self.field, np.array([0.0, 0.0, at["z"]])).pose(station)

    def _moved(self, seat: Seat | None = None) -> tuple[Station, FieldBench]:
        """Present station of the table, and the testfield on it, before a camera of a rig."""
        axes = self.axes
        station = Station(axes["tilt"], axes["roll"], axes["camera_roll"])
        field = self.field
        if field.water is not None:
            warmer = field.water.temperature_c + self.hours * self.room.warming_c_per_hour
            field = replace(field, water=replace(field.water, temperature_c=warmer))
        return station, _Mounted.of(field, self._drift() + np.array([0.0, 0.0, axes["z"]]), seat)

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
