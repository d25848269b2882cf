"""Exposures of a camera: one after the other, their mean, and what is told of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..core.data import Frame
from ..instruments import Camera, Exposure

__all__ = ["clock_of", "following", "mean_frame", "told"]


def following(camera: Camera, count: int) -> Callable[[], Exposure]:
    """What gives a fresh frame, then those that follow it, fresh too; after a failure it begins anew."""
    stream: Iterator[Exposure] = iter(())

    def next_one() -> Exposure:
        nonlocal stream
        # An iterator that has raised is at its end.
        if (found := next(stream, None)) is None:
            found, stream = camera.expose(), camera.frames(count)
        return found

    return next_one


def mean_frame(frames: list[Frame], name: str) -> Frame:
    """The mean of frames of one scene, under the name of its step."""
    first = frames[0]
    if len(frames) == 1:
        return Frame(first.pixels, first.full_scale, name)
    total = np.zeros(first.pixels.shape, dtype=np.float64)
    for frame in frames:
        total += frame.pixels
    return Frame((total / len(frames)).astype(np.float32), first.full_scale, name)


def told(value: float) -> float | None:
    """A value of an instrument; None where it does not tell."""
    return value if math.isfinite(value) else None


def clock_of(exposures: list[Exposure]) -> dict[str, Any]:
    """Times, and what a camera counts."""
    return {
        "taken": [each.taken.isoformat() for each in exposures],
        "taken_within_s": [each.taken_within_s for each in exposures],
        "sequence": [each.sequence for each in exposures],
        "dropped": exposures[-1].dropped,
    }
