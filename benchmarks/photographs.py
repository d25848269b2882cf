"""PHOTO I, II and III of simulated worlds, measured by the procedure from the frames, and timed.

Measurements can be stored in a folder and read from there: an interrupted run continues where it stopped, and
tables can be made again without the frames.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, TypeVar

from reseau.core.data import ImagePoints
from reseau.core.failure import Failure
from reseau.procedures.oscilloscope import photo_i, photo_ii, photo_iii
from reseau.refine import Registration
from reseau_sims import Display, World

__all__ = ["ECHOES", "Measured", "Physics", "measured"]

Physics = Literal["wong", "polynomial"]
ECHOES: dict[str, dict[str, float]] = {
    "beam": {},
    "even": {"evenness": 0.85},
    "fading": {"evenness": 0.8, "fading": 0.25},
    "tapering": {"evenness": 0.7, "tapering": 0.5},
    "saturated": {"saturation": 130.0},
}
"""Echoes of other forms: parameters of :class:`reseau_sims.Scanner`, and of its display."""
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements in the three photographs of a world.

    Parameters
    ----------
    seed : int
        Of the world.
    physics : {"wong", "polynomial"}
        Of its display.
    marks, pins, body : ImagePoints
        Marks of the reseau in PHOTO I, rods in PHOTO II, echoes in PHOTO III; all in pixels of PHOTO I.
    seconds : tuple of float
        Wall time of `photo_i`, `photo_ii`, `photo_iii`.
    cpu : float
        Processor time of the three together.
    moved : tuple of bool
        Whether PHOTO II and III are said to be of a camera that has moved. It has not.
    similar : tuple of bool
        Whether a similarity referred them to PHOTO I.
    """

    seed: int
    physics: Physics
    marks: ImagePoints
    pins: ImagePoints
    body: ImagePoints
    seconds: tuple[float, float, float]
    cpu: float
    moved: tuple[bool, bool]
    similar: tuple[bool, bool]


def measured(seed: int, physics: Physics, folder: Path | None = None, echoes: str = "beam") -> Measured | str:
    """Measure the photographs of a world, or read the stored measurements; a text if it failed."""
    file = None if folder is None else folder / f"{physics}-{echoes}-{seed}.pickle"
    if file is not None and file.exists():
        kept: Measured = pickle.loads(file.read_bytes())
        return kept
    found = _from_frames(seed, physics, ECHOES[echoes])
    if isinstance(found, Failure):
        return f"seed {seed}: {found.reason}"
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        draft = file.with_suffix(".draft")
        draft.write_bytes(pickle.dumps(found))
        draft.replace(file)
    return found


def _from_frames(seed: int, physics: Physics, form: dict[str, float]) -> Measured | Failure:
    world = World.standard(seed, display=physics)
    tube = {name: value for name, value in form.items() if name in {f.name for f in fields(Display)}}
    if form:
        scanner = replace(world.scanner, **{name: form[name] for name in form if name not in tube})
        world = World.standard(seed, display=replace(world.display, **tube), scanner=scanner)
    one, two, three = world.photo_i(), world.photo_ii(), world.photo_iii()
    seconds: list[float] = []

    def timed(step: Callable[[], _T]) -> _T:
        begun = time.perf_counter()
        done = step()
        seconds.append(time.perf_counter() - begun)
        return done

    cpu = time.process_time()
    first = timed(lambda: photo_i(one, world.design))
    if isinstance(first, Failure):
        return first
    camera = first.camera
    second = timed(lambda: photo_ii(two, world.design, world.test_object, camera))
    if isinstance(second, Failure):
        return second
    instrument = second.instrument
    third = timed(lambda: photo_iii(three, instrument, world.design))
    if isinstance(third, Failure):
        return third
    cpu = time.process_time() - cpu
    registrations = [r for r in (second.registration, third.registration) if isinstance(r, Registration)]
    (moved_ii, similar_ii), (moved_iii, similar_iii) = ((r.moved, r.similar) for r in registrations)
    return Measured(
        seed,
        physics,
        first.points,
        second.pins,
        third.points,
        (seconds[0], seconds[1], seconds[2]),
        cpu,
        (moved_ii, moved_iii),
        (similar_ii, similar_iii),
    )
