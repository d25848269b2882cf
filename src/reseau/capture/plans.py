"""The plans of the package. For others write a generator, of these or of bluesky's plans.

Each plan takes the :class:`~reseau.capture.Acquisition` that carries it out, and yields messages.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from bluesky import preprocessors as bpp

from ..core.errors import EstimationError, StateError, UsageError
from ..instruments import UltrasonicScanner
from .acquisition import Acquisition, Plan
from .checks import Limits
from .steps import Step

_LEAST_GAIN = 0.01
"""Least relative decrease of a standard deviation for which another pose is taken."""
_LEAST_POSES, _MOST_SCATTER = 6, 2.0
"""Poses from which on images show whether they agree; factor of their scatter above which they do not."""
_LENGTHS = {"mm": 1.0, "um": 1e-3, "µm": 1e-3, "nm": 1e-6}
_GOAL = re.compile(r"\s*sigma_(\w+)\s*<=?\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(\S*)\s*")


@dataclass(frozen=True)
class Goal:
    """A standard deviation to reach.

    Parameters
    ----------
    parameter : str
        Name of the parameter.
    limit : float
        In millimetres if `unit` is a length, else as given.
    unit : str
        ``mm``, ``px``, or empty.

    Examples
    --------
    >>> Goal.parse("sigma_c < 0.5 um")
    Goal(parameter='c', limit=0.0005, unit='mm')
    """

    parameter: str
    limit: float
    unit: str

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a goal from text.

        Raises
        ------
        UsageError
            If the text is not a goal.
        """
        found = _GOAL.fullmatch(text)
        if found is None or found[3] not in (*_LENGTHS, "px", "") or not 0 < float(found[2]) < 1e9:
            raise UsageError("is not a goal", where=repr(text), do="write it like 'sigma_c < 0.5 um'")
        scale = _LENGTHS.get(found[3])
        if scale is None:
            return cls(found[1], float(found[2]), found[3])
        return cls(found[1], float(found[2]) * scale, "mm")

    def __str__(self) -> str:
        return f"sigma_{self.parameter} < {self.limit:g} {self.unit}".rstrip()


def homed(run: Acquisition, plan: Plan) -> Plan:
    """Home the axes without a reference, then run a plan."""
    yield from run.home()
    return (yield from plan)


def _check(run: Acquisition, checks: int) -> Plan:
    """Check the scene before any frame is taken; raises if frames would be useless."""
    if checks and not run.session.frames(kind="check"):
        found = yield from run.check(checks)
        if not found:
            raise StateError("; ".join(found.faults), where="checks", do="or continue with --checks 0")


def frames(run: Acquisition, count: int, average: int = 1, checks: int = 0) -> Plan:
    """Take frames one after the other, each the mean of `average` exposures."""
    yield from _check(run, checks)
    for k in range(count):
        yield from run.at(Step(f"{k:05d}"), average)


def poses(run: Acquisition, steps: Sequence[Step], average: int = 1, checks: int = 0) -> Plan:
    """Take a frame at each pose: record a testfield for a calibration."""
    yield from _check(run, checks)
    for step, after in itertools.zip_longest(steps, steps[1:]):
        yield from run.at(step, average)
        if after is not None:
            yield from run.predict(after)


def until(
    run: Acquisition,
    goal: Goal,
    first: Sequence[Step],
    candidates: Sequence[Step],
    average: int = 1,
    checks: int = 0,
) -> Plan:
    """Take the first poses, then always the pose that lowers a standard deviation most, until the goal.

    The goal is reached by at least six poses whose images do not contradict each other: those of a target
    that bends scatter by more than their standard deviations say.

    Returns
    -------
    str
        Empty if the goal was reached; else the reason.
    """
    yield from poses(run, first, average, checks)
    left = [step for step in candidates if step.name not in {each.name for each in first}]
    taken = len(first)
    while True:
        reached, scatter = run.reached(goal.parameter), run.scatter()
        agree, enough = scatter <= _MOST_SCATTER, taken >= _LEAST_POSES
        if enough and agree and reached is not None and reached < goal.limit:
            return ""
        because = "" if agree else f"; {_CONTRADICTION.format(scatter)}"
        chosen = (yield from run.choose(left, goal.parameter)) if left else None
        if chosen is None:
            return f"{goal} not reached: no pose is left{because}"
        step, predicted = chosen
        little = predicted is not None and reached is not None and predicted > (1 - _LEAST_GAIN) * reached
        if enough and little:
            least = f"{100 * _LEAST_GAIN:g} %"
            return (
                f"{goal} not reached: no pose lowers {reached:.2g} {goal.unit} by more than {least}{because}"
            )
        left.remove(step)
        taken += 1
        yield from run.at(step, average)


_CONTRADICTION = (
    "the images contradict each other by {:.1f} times their precision: the target bends, or it or the camera "
    "changed between them"
)


def scan(run: Acquisition, count: int = 1) -> Plan:
    """Take sections with the scanner, and with each the screenshot of the oscilloscope, if there is one."""
    for k in range(count):
        step = Step(f"section {k:03d}")
        yield from run.pictures(step, "scan")
        yield from run.pictures(step, "screen")


def oscilloscope(run: Acquisition, body: bool = True, average: int = 1, checks: int = 0) -> Plan:
    """Take PHOTO I (reseau alone), II (with a section of the test object) and III (with one of a body).

    If the bench has no scanner, the operator sweeps.
    """
    sweeps = run.has(UltrasonicScanner)
    photos = {"PHOTO I": "blank the screen: only the reseau is photographed"}
    photos["PHOTO II"] = "put the test object into the tank" + ("" if sweeps else ", and sweep")
    if body:
        photos["PHOTO III"] = "put the body into the tank" + ("" if sweeps else ", and sweep")
    for name, request in photos.items():
        step = Step(name)
        yield from run.ask(request, step)
        if name == "PHOTO I":
            yield from _check(run, checks)
        elif sweeps:
            yield from run.pictures(step, "scan")
        frame = yield from run.at(step, average)
        if not frame.verdict.ok:
            raise EstimationError(frame.verdict.why, where=name)
        yield from run.pictures(step, "screen")


_COVER = "cover the lens"
_LIGHT = "provide constant, even light on the whole sensor: without lens, or through a diffuser"
_EDGE = "show a straight edge between dark and bright, slanted by a few degrees"
NO_EXPOSURE_LIMITS = Limits(saturated=1.0, darkest=0.0)
"""Limits for the sensor series, which needs dark and saturated frames."""
_SATURATED = 0.97
"""Share of full scale that counts as saturated."""
_GROWTH = 1.3
"""Growth of the signal at twice the exposure below which the sensor counts as saturated, too."""
_BRIGHT = 0.25
_BEYOND = 1.25
"""Longest exposure of the levels, relative to the one that saturates."""
_FIRST_US, _SHORTEST_US = 1000.0, 100.0


@dataclass(frozen=True)
class SensorSeriesPlan:
    """Frames of a sensor calibration.

    Parameters
    ----------
    levels : int
        Number of exposures in light; three of them are also taken in the dark.
    frames : int
        Frames of each exposure; four times as many in the dark.
    longest_us : float
        Longest exposure (µs).
    edge_us : float, optional
        Exposure of the slanted edge (µs); no edge is taken without it.

    Examples
    --------
    >>> SensorSeriesPlan(levels=5, frames=2).count
    34
    """

    levels: int = 14
    frames: int = 8
    longest_us: float = 1e6
    edge_us: float | None = None

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.frames * (self.levels + 12 + (self.edge_us is not None))


def sensor(run: Acquisition, plan: SensorSeriesPlan) -> Plan:
    """Take a sensor series: even light at growing exposures, dark, and an edge; then restore the exposure.

    Steps are named light, dark and edge, with the numbers of level and frame.

    Raises
    ------
    StateError
        If there is no light, or if the shortest exposure saturates.
    """
    yield from bpp.finalize_wrapper(_series(run, plan), run.restore_exposure())  # type: ignore[no-untyped-call]


def _series(run: Acquisition, plan: SensorSeriesPlan) -> Plan:
    light = [_steps("light", k, plan.frames) for k in range(plan.levels)]
    yield from run.ask(_LIGHT, light[-1][-1])
    exposures = yield from _ladder(run, plan)
    for steps, exposure in zip(light, exposures, strict=True):
        yield from run.series([Step(step.name, exposure_us=exposure) for step in steps])
    covered = [exposures[0], exposures[len(exposures) // 2], exposures[-1]]
    dark = [_steps("dark", k, 4 * plan.frames, exposure) for k, exposure in enumerate(covered)]
    yield from run.ask(_COVER, dark[-1][-1])
    for steps in dark:
        yield from run.series(steps)
    if plan.edge_us is not None:
        steps = _steps("edge", 0, plan.frames, plan.edge_us)
        yield from run.ask(_EDGE, steps[-1])
        yield from run.series(steps)


def _steps(name: str, level: int, frames: int, exposure_us: float | None = None) -> list[Step]:
    return [Step(f"{name} {level:02d} {k:03d}", exposure_us=exposure_us) for k in range(frames)]


def _ladder(run: Acquisition, plan: SensorSeriesPlan) -> Plan:
    """Exposures from a small part of saturation to beyond it; long ones are multiples of 100 µs."""
    exposure = _FIRST_US
    level = yield from _probed(run, exposure)
    while level > _BRIGHT and exposure > _SHORTEST_US:
        shorter = max(_SHORTEST_US, exposure / 4)
        lower = yield from _probed(run, shorter)
        # Pixels may also be full below the full scale of the converter.
        if level <= _SATURATED and level > _GROWTH * lower:
            break
        exposure, level = shorter, lower
    # With little light, the first frame shows mainly its bias.
    least = level if 2 * exposure <= plan.longest_us else 0.0
    while 2 * exposure <= plan.longest_us:
        exposure *= 2
        brighter = yield from _probed(run, exposure)
        if exposure == 2 * _SHORTEST_US and level > _BRIGHT and brighter < _GROWTH * level:
            raise StateError("is saturated at its shortest exposure", where="light", do="reduce the light")
        if brighter > _SATURATED or _BRIGHT < brighter < _GROWTH * level:
            break
        level = brighter
    if level - least < 0.01 and exposure * 2 > plan.longest_us:
        raise StateError(
            f"gives almost no signal at {exposure / 1000:g} ms", where="light",
            do="provide more light, or a longer --longest-ms",
        )  # fmt: skip
    # Saturation is between the last two exposures.
    top = min(exposure * _BEYOND, plan.longest_us)
    steps = np.linspace(top / plan.levels / 2, top, plan.levels)
    unit = 100.0 if top > 200 * plan.levels else 1.0
    return [math.ceil(step / unit) * unit if step > 10 * unit else float(step) for step in steps]


def _probed(run: Acquisition, exposure_us: float) -> Plan:
    """Mean of a frame, relative to full scale."""
    found = yield from run.pictures(Step(f"probe {exposure_us:g} us", exposure_us=exposure_us), "probe")
    frame = run.session.picture(found)
    return float(frame.pixels.mean()) / frame.full_scale
