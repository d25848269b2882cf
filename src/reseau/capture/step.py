"""Steps of an acquisition: where the table stands, and what the pictures taken there are called."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..core.errors import FormatError
from ..io import read_text

__all__ = ["Step", "as_taken", "at_heights", "paper_steps", "read_steps", "spread"]

TILT, ROLL, CAMERA_ROLL, HEIGHT = "tilt", "roll", "camera_roll", "z"
"""Axes of the testfield's mount: φ, κ, κ of the camera (degrees), and the height of the board (mm)."""


@dataclass(frozen=True)
class Step:
    """One pose.

    Parameters
    ----------
    name : str
        Unique in a session; pictures are stored under it.
    position : mapping of str to float
        Where the axes of the table stand, in their units; axes that are not named stay where they are.
    exposure_us : float, optional
        That the camera is set to; by default it stays as it is.
    """

    name: str
    position: Mapping[str, float] = field(default_factory=dict)
    exposure_us: float | None = None


def as_taken(step: Step, facts: Mapping[str, Any]) -> Step:
    """A step with the exposure that its frame had, by the camera's word where it tells."""
    if facts.get("set_exposure_us") is None:
        return step
    return replace(step, exposure_us=facts.get("exposure_us") or facts["set_exposure_us"])


def _named(position: Mapping[str, float]) -> Step:
    return Step(" ".join(f"{axis} {value:g}" for axis, value in position.items()), dict(position))


def paper_steps(tilts: Sequence[float] = (0.0, 30.0, 45.0), axes: Sequence[str] = ()) -> tuple[Step, ...]:
    """The 36 recordings of Vosselman and Förstner: nine positions, each with the camera turned four times.

    Parameters
    ----------
    tilts : sequence of float
        φ (degrees). The board that is not tilted is recorded from one position, another from four.
    axes : sequence of str, optional
        Names of the axes that the table has; by default those of the paper. What it lacks is not turned.
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
    """Each pose at each height of the board (mm), as a z-stage lifts it; without heights, the poses alone.

    All heights of a pose come one after the other: only the stage moves between them, and the images have one
    exterior orientation.
    """
    lifted = [
        Step(f"{step.name} {HEIGHT} {height:g}", {**step.position, HEIGHT: height})
        for step in steps
        for height in heights
    ]
    return tuple(lifted or steps)


def read_steps(path: Path) -> tuple[Step, ...]:
    """Poses of a CSV: its header names axes of the table, and, where it has one, the column `name` the poses.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is no such table; says in which line.
    """
    rows = list(csv.reader(io.StringIO(read_text(path))))
    if len(rows) < 2 or not rows[0]:
        raise FormatError("has no poses", where=path, do="write a header of axes, and a line for each pose")
    header = [cell.strip() for cell in rows[0]]
    steps: dict[str, Step] = {}
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise FormatError(f"line {number} has {len(row)} cells, not {len(header)}", where=path)
        cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
        name = cells.pop("name", None)
        try:
            position = {axis: float(value) for axis, value in cells.items()}
        except ValueError:
            raise FormatError(f"line {number} holds what is no number", where=path) from None
        if not all(math.isfinite(value) for value in position.values()):
            raise FormatError(f"line {number} holds what is no number", where=path)
        step = Step(name, position) if name else _named(position)
        if step.name in steps:
            raise FormatError(f"line {number}: {step.name!r} stands twice", where=path, do="name poses apart")
        steps[step.name] = step
    return tuple(steps.values())


def spread(steps: Sequence[Step], count: int) -> tuple[Step, ...]:
    """Some of the poses, far from one another: each next one is that furthest from all before.

    Parameters
    ----------
    steps : sequence of Step
        The first is always taken. Of equally far ones the first is.
    count : int
        How many.
    """
    chosen: list[Step] = []
    left = list(steps)
    while left and len(chosen) < count:
        next_ = max(left, key=lambda step: min((_apart(step, other) for other in chosen), default=0.0))
        left.remove(next_)
        chosen.append(next_)
    return tuple(chosen)


def _apart(one: Step, other: Step) -> float:
    """Distance of two poses: axes turned by a degree count as much as those moved by a millimetre."""
    total = 0.0
    for axis in one.position.keys() | other.position.keys():
        gap = abs(one.position.get(axis, 0.0) - other.position.get(axis, 0.0))
        total += (gap if axis == HEIGHT else min(gap % 360, 360 - gap % 360)) ** 2
    return math.sqrt(total)
