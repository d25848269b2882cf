"""Frames that tell about a camera's sensor: in the dark, in even light at growing exposures, of an edge."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data import Frame
from ..errors import StateError
from ..instruments import Camera
from ..refine.sensor import Level, SensorSeries

__all__ = ["SensorPlan", "capture_edge", "capture_sensor"]

Ready = Callable[[str], object]
Told = Callable[[str], object]

COVER = "cover the lens"
LIGHT = "have even light on the whole sensor, without lens or through a diffuser; it must not change"
EDGE = "show a straight edge between dark and bright, slanted by some degrees"
_SATURATED = 0.97
"""Of the full scale; and less growth than by this factor, for twice the exposure, is saturation too."""
_GROWS = 1.3
_BEYOND = 1.25
"""Up to which exposure the levels reach, of the one that saturates."""


@dataclass(frozen=True)
class SensorPlan:
    """What is taken.

    Parameters
    ----------
    levels : int
        Exposures in light.
    frames : int
        Of each; four times as many in the dark.
    longest_us : float
        Beyond which no exposure goes.
    """

    levels: int = 14
    frames: int = 8
    longest_us: float = 1e6


def capture_sensor(camera: Camera, plan: SensorPlan, ready: Ready, told: Told = str) -> SensorSeries:
    """Take the series.

    Parameters
    ----------
    camera : Camera
        Connected; what it was set to is set again in the end.
    plan : SensorPlan
        How much.
    ready : callable
        Called with what is to be done by hand; returns when it is.
    told : callable
        Called with each exposure that is taken.

    Raises
    ------
    StateError
        When there is no light, or so much that the shortest exposure saturates.
    InstrumentError
        When the camera fails.
    """
    before = camera.settings.to_dict()["exposure_us"]
    try:
        ready(LIGHT)
        exposures = _ladder(camera, plan)
        full_scale = camera.expose().frame.full_scale
        bright = tuple(_level(camera, exposure, plan.frames, told) for exposure in exposures)
        ready(COVER)
        covered = sorted({exposures[0], exposures[len(exposures) // 2], exposures[-1]})
        dark = tuple(_level(camera, exposure, 4 * plan.frames, told) for exposure in covered)
    finally:
        camera.configure(exposure_us=before)
    return SensorSeries(dark, bright, full_scale)


def capture_edge(camera: Camera, ready: Ready, frames: int = 8) -> Frame:
    """The mean of some frames of a slanted edge."""
    ready(EDGE)
    first = camera.expose().frame
    total = first.pixels.astype(np.float64)
    for shot in camera.frames(frames - 1):
        total += shot.frame.pixels
    return Frame((total / frames).astype(np.float32), first.full_scale, first.name, first.sha256)


def _level(camera: Camera, exposure_us: float, frames: int, told: Told) -> Level:
    camera.configure(exposure_us=exposure_us)
    told(f"{frames} frames of {exposure_us / 1000:g} ms")

    def taken() -> Iterator[NDArray[Any]]:
        # Those that follow a fresh one are fresh themselves.
        yield camera.expose().frame.pixels
        for shot in camera.frames(frames - 1):
            yield shot.frame.pixels

    return Level.of(exposure_us, taken())


def _ladder(camera: Camera, plan: SensorPlan) -> list[float]:
    """Exposures from a small part of saturation to beyond it; multiples of 100 µs where they are long."""

    def mean(exposure_us: float) -> tuple[float, float]:
        camera.configure(exposure_us=exposure_us)
        frame = camera.expose().frame
        return float(frame.pixels.mean()), frame.full_scale

    exposure = 1000.0
    level, full_scale = mean(exposure)
    while level > _SATURATED * full_scale:
        if exposure <= 100.0:
            raise StateError("is saturated at its shortest exposure", do="take light away")
        exposure = max(100.0, exposure / 4)
        level, full_scale = mean(exposure)
    while 2 * exposure <= plan.longest_us:
        exposure *= 2
        brighter, full_scale = mean(exposure)
        if brighter > _SATURATED * full_scale or (brighter > full_scale / 4 and brighter < _GROWS * level):
            break
        level = brighter
    if level < full_scale / 100 and exposure * 2 > plan.longest_us:
        raise StateError(
            f"sees nearly nothing at {exposure / 1000:g} ms", do="give it light, or a longer --longest-ms"
        )
    # Saturated somewhere between the last two.
    top = min(exposure * _BEYOND, plan.longest_us)
    steps = np.linspace(top / plan.levels / 2, top, plan.levels)
    return sorted({math.ceil(step / 100) * 100.0 if step > 1000 else float(step) for step in steps})
