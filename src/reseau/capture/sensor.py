"""The acquisition that tells about a camera's sensor: even light at growing exposures, the dark, an edge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from bluesky import preprocessors as bpp

from ..core.errors import StateError
from .acquisition import Acquisition, Plan
from .checks import Limits
from .step import Step

__all__ = ["ALL_LIMITS", "SensorPlan", "sensor"]

COVER = "cover the lens"
LIGHT = "have even light on the whole sensor, without lens or through a diffuser; it must not change"
EDGE = "show a straight edge between dark and bright, slanted by some degrees"
ALL_LIMITS = Limits(saturated=1.0, darkest=0.0)
"""Frames in the dark and beyond saturation are what is wanted."""
_SATURATED = 0.97
"""Of the full scale; and less growth than by this factor, for twice the exposure, is saturation too."""
_GROWS = 1.3
_BRIGHT = 0.25
_BEYOND = 1.25
"""Up to which exposure the levels reach, of the one that saturates."""
_FIRST_US, _SHORTEST_US = 1000.0, 100.0


@dataclass(frozen=True)
class SensorPlan:
    """What is taken.

    Parameters
    ----------
    levels : int
        Exposures in light; three of them in the dark, too.
    frames : int
        Of each; four times as many in the dark.
    longest_us : float
        Beyond which no exposure goes.
    edge_us : float, optional
        Exposure of the edge; without it none is taken.
    """

    levels: int = 14
    frames: int = 8
    longest_us: float = 1e6
    edge_us: float | None = None

    @property
    def count(self) -> int:
        """Frames that are taken."""
        return self.frames * (self.levels + 12 + (self.edge_us is not None))


def sensor(run: Acquisition, plan: SensorPlan) -> Plan:
    """Take the series, and set the camera back to its exposure.

    Steps are called light, dark and edge, with the numbers of level and frame.

    Raises
    ------
    StateError
        When there is no light, or so much that the shortest exposure saturates.
    """
    yield from bpp.finalize_wrapper(_series(run, plan), run.set_back())  # type: ignore[no-untyped-call]


def _series(run: Acquisition, plan: SensorPlan) -> Plan:
    light = [_steps("light", k, plan.frames) for k in range(plan.levels)]
    yield from run.ask(LIGHT, light[-1][-1])
    exposures = yield from _ladder(run, plan)
    for steps, exposure in zip(light, exposures, strict=True):
        yield from run.series([Step(step.name, exposure_us=exposure) for step in steps])
    covered = [exposures[0], exposures[len(exposures) // 2], exposures[-1]]
    dark = [_steps("dark", k, 4 * plan.frames, exposure) for k, exposure in enumerate(covered)]
    yield from run.ask(COVER, dark[-1][-1])
    for steps in dark:
        yield from run.series(steps)
    if plan.edge_us is not None:
        steps = _steps("edge", 0, plan.frames, plan.edge_us)
        yield from run.ask(EDGE, steps[-1])
        yield from run.series(steps)


def _steps(name: str, level: int, frames: int, exposure_us: float | None = None) -> list[Step]:
    return [Step(f"{name} {level:02d} {k:03d}", exposure_us=exposure_us) for k in range(frames)]


def _ladder(run: Acquisition, plan: SensorPlan) -> Plan:
    """Exposures from a small part of saturation to beyond it; multiples of 100 µs where they are long."""
    exposure = _FIRST_US
    level = yield from _probed(run, exposure)
    while level > _BRIGHT and exposure > _SHORTEST_US:
        shorter = max(_SHORTEST_US, exposure / 4)
        lower = yield from _probed(run, shorter)
        # Full pixels, too, may be what is seen, below the converter's full scale.
        if level <= _SATURATED and level > _GROWS * lower:
            break
        exposure, level = shorter, lower
    # The first frame's grey values are its bias above all, where there is little light.
    least = level if 2 * exposure <= plan.longest_us else 0.0
    while 2 * exposure <= plan.longest_us:
        exposure *= 2
        brighter = yield from _probed(run, exposure)
        if exposure == 2 * _SHORTEST_US and level > _BRIGHT and brighter < _GROWS * level:
            raise StateError("is saturated at its shortest exposure", where="light", do="take light away")
        if brighter > _SATURATED or _BRIGHT < brighter < _GROWS * level:
            break
        level = brighter
    if level - least < 0.01 and exposure * 2 > plan.longest_us:
        raise StateError(
            f"sees nearly nothing at {exposure / 1000:g} ms", where="light",
            do="give it light, or a longer --longest-ms",
        )  # fmt: skip
    # Saturated somewhere between the last two.
    top = min(exposure * _BEYOND, plan.longest_us)
    steps = np.linspace(top / plan.levels / 2, top, plan.levels)
    unit = 100.0 if top > 200 * plan.levels else 1.0
    return [math.ceil(step / unit) * unit if step > 10 * unit else float(step) for step in steps]


def _probed(run: Acquisition, exposure_us: float) -> Plan:
    """Mean of a frame, of the full scale."""
    found = yield from run.pictures(Step(f"probe {exposure_us:g} us", exposure_us=exposure_us), "probe")
    frame = run.kept.picture(found)
    return float(frame.pixels.mean()) / frame.full_scale
