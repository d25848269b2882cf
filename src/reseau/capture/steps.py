"""Steps of an acquisition: positions of the table and the names of the pictures taken there."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..core.environment import Condition
from ..core.errors import FormatError
from ..io import read_text

TILT, ROLL, CAMERA_ROLL, HEIGHT = "tilt", "roll", "camera_roll", "z"
"""Axes of the testfield mount: φ, κ, κ of the camera (degrees), and the height of the board (mm)."""


@dataclass(frozen=True)
class Step:
    """One pose.

    Parameters
    ----------
    name : str
        Unique in a session; pictures are stored under it.
    position : mapping of str to float
        Positions of the axes of the table, in their units. Axes that are not named do not move.
    exposure_us : float, optional
        Exposure of the camera (µs). Default: unchanged.
    environment : mapping of str to Condition
        Of a step that was taken: what the sensors of the bench measured with its frame.
    camera, exposure : str
        Of a frame of a rig: its camera, and what it has in common with the others that were exposed at once.

    Examples
    --------
    >>> Step("tilted", {"tilt": 30.0}).position["tilt"]
    30.0
    """

    name: str
    position: Mapping[str, float] = field(default_factory=dict)
    exposure_us: float | None = None
    environment: Mapping[str, Condition] = field(default_factory=dict)
    camera: str = ""
    exposure: str = ""


def as_taken(step: Step, facts: Mapping[str, Any]) -> Step:
    """Return a step with what is known of its frame.

    These are the conditions that the sensors measured, the camera and exposure of a frame of a rig, and, if
    the step sets it, the exposure time: as reported by the camera, else as set.
    """
    step = replace(step, environment=Condition.from_facts(facts))
    if "set" in facts:
        step = replace(step, camera=facts["camera"], exposure=facts["exposure"])
    if facts.get("set_exposure_us") is None:
        return step
    return replace(step, exposure_us=facts.get("exposure_us") or facts["set_exposure_us"])


def _named(position: Mapping[str, float]) -> Step:
    return Step(" ".join(f"{axis} {value:g}" for axis, value in position.items()), dict(position))


def paper_steps(tilts: Sequence[float] = (0.0, 30.0, 45.0), axes: Sequence[str] = ()) -> tuple[Step, ...]:
    """Return the 36 poses of Vosselman and Förstner: nine positions, each with four camera rotations.

    Parameters
    ----------
    tilts : sequence of float
        φ (degrees). The board without tilt is recorded from one position, with tilt from four.
    axes : sequence of str, optional
        Axes of the table. Default: those of the paper. Axes that the table lacks are left out.

    Examples
    --------
    >>> len(paper_steps())
    36
    >>> [step.name for step in paper_steps(axes=("tilt",))]
    ['tilt 0', 'tilt 30', 'tilt 45']
    """
    quarters = (0.0, 90.0, 180.0, 270.0)
    have = set(axes or (TILT, ROLL, CAMERA_ROLL))
    steps: dict[str, Step] = {}
    for phi in tilts if TILT in have else (0.0,):
        for kappa in quarters if phi and ROLL in have else (0.0,):
            for camera in quarters if CAMERA_ROLL in have else (0.0,):
                position = {TILT: phi, ROLL: kappa, CAMERA_ROLL: camera}
                step = _named({axis: value for axis, value in position.items() if axis in have})
                steps.setdefault(step.name, step)
    return tuple(steps.values())


def at_heights(steps: Sequence[Step], heights: Sequence[float]) -> tuple[Step, ...]:
    """Return each pose at each height of the board (mm) on a z-stage; without heights, the poses.

    The heights of a pose follow one another: only the stage moves between them, so their images have one
    exterior orientation.

    Examples
    --------
    >>> [step.name for step in at_heights([Step("a")], (0.0, 50.0))]
    ['a z 0', 'a z 50']
    """
    lifted = [
        Step(f"{step.name} {HEIGHT} {height:g}", {**step.position, HEIGHT: height})
        for step in steps
        for height in heights
    ]
    return tuple(lifted or steps)


def read_steps(path: Path) -> tuple[Step, ...]:
    """Read poses from a CSV file; see :func:`parse_steps`.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If it is not such a table; the message names the line.
    """
    return parse_steps(read_text(path), path)


def parse_steps(text: str, where: object) -> tuple[Step, ...]:
    """Return the poses of a CSV table. Its header names axes of the table, and optionally a column `name`.

    Raises
    ------
    FormatError
        If it is not such a table; the message names the line.

    Examples
    --------
    >>> [step.name for step in parse_steps("name,tilt\\nfirst,0\\n,30\\n", "poses.csv")]
    ['first', 'tilt 30']
    """
    rows = list(csv.reader(io.StringIO(text)))
    if len(rows) < 2 or not rows[0]:
        raise FormatError("has no poses", where=where, do="write a header of axes and a line for each pose")
    header = [cell.strip() for cell in rows[0]]
    steps: dict[str, Step] = {}
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise FormatError(f"line {number} has {len(row)} cells, not {len(header)}", where=where)
        cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
        name = cells.pop("name", None)
        try:
            position = {axis: float(value) for axis, value in cells.items()}
        except ValueError:
            raise FormatError(f"line {number} has a value that is not a number", where=where) from None
        if not all(math.isfinite(value) for value in position.values()):
            raise FormatError(f"line {number} has a value that is not a number", where=where)
        step = Step(name, position) if name else _named(position)
        if step.name in steps:
            raise FormatError(f"line {number}: duplicate pose {step.name!r}", where=where, do="rename it")
        steps[step.name] = step
    return tuple(steps.values())


def spread(steps: Sequence[Step], count: int) -> tuple[Step, ...]:
    """Select poses far from one another: each next pose is the one farthest from all selected before.

    Parameters
    ----------
    steps : sequence of Step
        The first one is always selected. Among equally distant ones, the first is.
    count : int
        Number of poses.

    Examples
    --------
    >>> line = [Step(f"{x:g}", {"z": x}) for x in (0.0, 1.0, 2.0)]
    >>> [step.name for step in spread(line, 2)]
    ['0', '2']
    """
    chosen: list[Step] = []
    left = list(steps)
    while left and len(chosen) < count:
        next_ = max(left, key=lambda step: min((_apart(step, other) for other in chosen), default=0.0))
        left.remove(next_)
        chosen.append(next_)
    return tuple(chosen)


def _apart(one: Step, other: Step) -> float:
    """Distance of two poses; a rotation of one degree counts as much as a motion of one millimetre."""
    total = 0.0
    for axis in one.position.keys() | other.position.keys():
        gap = abs(one.position.get(axis, 0.0) - other.position.get(axis, 0.0))
        total += (gap if axis == HEIGHT else min(gap % 360, 360 - gap % 360)) ** 2
    return math.sqrt(total)
