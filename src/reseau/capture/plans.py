"""Acquisitions that every laboratory makes; who needs another writes a generator, of these or of bluesky's.

Each takes the :class:`~reseau.capture.Acquisition` that carries it out, and yields messages.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from ..core.errors import EstimationError, StateError
from ..instruments import UltrasonicScanner
from .acquisition import Acquisition, Plan
from .goal import Goal
from .step import Step

__all__ = ["frames", "homed", "oscilloscope", "poses", "scan", "until"]

_WORTH = 0.01
"""By what share a standard deviation must be lowered for a pose to help."""


def homed(run: Acquisition, plan: Plan) -> Plan:
    """A plan before which axes without a reference find it."""
    yield from run.home()
    return (yield from plan)


def _ready(run: Acquisition, checks: int) -> Plan:
    """Look before anything is taken; raises when pictures would be worth nothing."""
    if checks and not run.kept.frames(kind="check"):
        found = yield from run.check(checks)
        if not found:
            raise StateError("; ".join(found.faults), where="checks", do="or go on with --checks 0")


def frames(run: Acquisition, count: int, average: int = 1, checks: int = 0) -> Plan:
    """Frames one after the other, each the mean of `average` exposures."""
    yield from _ready(run, checks)
    for k in range(count):
        yield from run.at(Step(f"{k:05d}"), average)


def poses(run: Acquisition, steps: Sequence[Step], average: int = 1, checks: int = 0) -> Plan:
    """A frame from each of some poses: a testfield recorded for a calibration."""
    yield from _ready(run, checks)
    for step, after in itertools.zip_longest(steps, steps[1:]):
        yield from run.at(step, average)
        if after is not None:
            yield from run.outlook(after)


def until(
    run: Acquisition,
    goal: Goal,
    first: Sequence[Step],
    candidates: Sequence[Step],
    average: int = 1,
    checks: int = 0,
) -> Plan:
    """Poses to begin with, then always that which lowers a standard deviation most, until it is reached.

    Returns
    -------
    str
        Empty when the goal was reached; or why it was not.
    """
    yield from poses(run, first, average, checks)
    left = [step for step in candidates if step.name not in {each.name for each in first}]
    while True:
        reached = run.reached(goal.parameter)
        if reached is not None and reached < goal.limit:
            return ""
        chosen = (yield from run.choose(left, goal.parameter)) if left else None
        if chosen is None:
            return f"no pose is left that would help to reach {goal}"
        step, predicted = chosen
        if reached is not None and predicted is not None and predicted > (1 - _WORTH) * reached:
            return f"no pose lowers {reached:.3g} by more than {100 * _WORTH:g} %; {goal} is not reached"
        left.remove(step)
        yield from run.at(step, average)


def scan(run: Acquisition, count: int = 1) -> Plan:
    """Sections by the scanner, and beside each the oscilloscope's own screen where there is one."""
    for k in range(count):
        step = Step(f"section {k:03d}")
        yield from run.pictures(step, "scan")
        yield from run.pictures(step, "screen")


def oscilloscope(run: Acquisition, body: bool = True, average: int = 1, checks: int = 0) -> Plan:
    """PHOTO I of the reseau alone, II with a section of the test object behind it, III with one of a body.

    Where the bench has no scanner, the operator sweeps.
    """
    sweeps = run.has(UltrasonicScanner)
    photos = {"PHOTO I": "blank the screen; nothing but the reseau is photographed"}
    photos["PHOTO II"] = "put the test object into the tank" + ("" if sweeps else ", and sweep")
    if body:
        photos["PHOTO III"] = "put the body into the tank" + ("" if sweeps else ", and sweep")
    for name, what in photos.items():
        step = Step(name)
        yield from run.ask(what, step)
        if name == "PHOTO I":
            yield from _ready(run, checks)
        elif sweeps:
            yield from run.pictures(step, "scan")
        found = yield from run.at(step, average)
        verdict = run.verdict(found)
        if not verdict.ok:
            raise EstimationError(verdict.why, where=name)
        yield from run.pictures(step, "screen")
