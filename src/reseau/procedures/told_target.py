"""A board that was told and the photographs contradict: the one that they show is measured in its place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

from ..core.data import Frame
from ..core.errors import ImageError
from ..core.failure import Code, Failure
from ..designs.boards import unusual_size
from ..execution import Executor, Outputs
from ..io import BoardDesign
from .target_measurement import (
    MeasuredPhotograph,
    Measurer,
    Photograph,
    Unread,
    measured_in_order,
    measurer_with,
)
from .which_target import corrected, described

_CONTRADICT = (Code.OTHER_DESIGN, Code.NOT_FOUND, Code.INCONSISTENT, Code.AMBIGUOUS)
"""Why a target is not measured, where a wrong design may be the reason."""


@dataclass(frozen=True)
class TargetMeasured:
    """What was measured in photographs, and of which target.

    Parameters
    ----------
    photographs : tuple of MeasuredPhotograph
        What was measured.
    corrected : BoardDesign, optional
        The board that was measured in place of the target that was told.
    notes : tuple of str
        What the user should know of the design.
    shown : str
        What the photographs show in place of the target, in words; empty where they show it.
    """

    photographs: tuple[MeasuredPhotograph, ...]
    corrected: BoardDesign | None = None
    notes: tuple[str, ...] = ()
    shown: str = ""


def measured_as_shown(
    photographs: Iterable[Photograph],
    design: object,
    measure: Measurer,
    executor: Executor | None = None,
    outputs: Outputs | None = None,
) -> TargetMeasured:
    """Measure a target in photographs; where they contradict its design, the board that they show.

    A board whose design is contradicted by more photographs than show it is compared with boards of the same
    kind that the photographs show; see :func:`~reseau.procedures.which_target.corrected`.

    Parameters
    ----------
    photographs, measure, executor, outputs
        See :func:`~reseau.procedures.target_measurement.measured_in_order`.
    design : BoardDesign or object
        The target. Designs of other kinds are not corrected.

    Examples
    --------
    >>> measured_as_shown([], None, print).photographs
    ()
    """
    seen = list[Photograph]()
    done = list(measured_in_order(_remembered(photographs, seen), measure, executor, outputs))
    if not isinstance(design, BoardDesign):
        return TargetMeasured(tuple(done))
    notes = tuple(filter(None, [unusual_size(design)]))
    against = {
        each.name for each in done if isinstance(each.found, Failure) and each.found.code in _CONTRADICT
    }
    if len(against) <= sum(not isinstance(each.found, Failure) for each in done):
        return TargetMeasured(tuple(done), None, notes)
    other = corrected(_frames(seen, against), design)
    if isinstance(other, Failure):
        return TargetMeasured(tuple(done), None, notes, other.reason)
    again = measurer_with(measure, other)
    if again is None:  # the caller's own
        return TargetMeasured(tuple(done), None, notes, f"the photographs show {described(other)}")
    # What is kept is kept for the design that was told.
    done = list(measured_in_order(seen, again, executor))
    shown, told = f"the photographs show {described(other)}", described(design)
    shown += (
        f", not {told} as was told" if told != described(other) else " in other proportions than was told"
    )
    said = f"{shown}: {_difference(other, design)}; calibrated with what they show, correct the design"
    return TargetMeasured(tuple(done), other, (*notes, said), shown)


def _difference(other: BoardDesign, told: BoardDesign) -> str:
    """What of the design to change."""
    new, old = other.to_dict(), told.to_dict()
    fields = [key for key in BoardDesign.model_fields if new.get(key) != old.get(key)]
    return ", ".join(f"{key} {getattr(other, key)} in place of {getattr(told, key)}" for key in fields)


def _remembered(photographs: Iterable[Photograph], seen: list[Photograph]) -> Iterator[Photograph]:
    for each in photographs:
        seen.append(each)
        yield each


def _frames(photographs: Iterable[Photograph], names: set[str]) -> Iterator[Frame]:
    """Frames of some photographs."""
    for each in photographs:
        if isinstance(each, Frame | Unread) and each.name in names:
            with suppress(ImageError):
                yield each.read() if isinstance(each, Unread) else each
