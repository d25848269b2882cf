"""Parts that take long where what is done with their results is tested."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

import pytest
from matplotlib.figure import Figure

from reseau.core import figures
from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.core.figures import to_bytes
from reseau.io import TestfieldDesign
from reseau.measure.points import Measured
from reseau.measure.testfield.measure import TestfieldOptions, measure_testfield
from reseau.procedures import next_pose, target_measurement

from . import kept


@contextmanager
def few_poses() -> Iterator[None]:
    """Compare few photographs that could be proposed."""
    every = next_pose._candidates
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(next_pose, "_candidates", lambda: islice(every(), 0, None, 9))
        monkeypatch.setattr(next_pose, "_STEPS", ())
        yield


@contextmanager
def few_results() -> Iterator[None]:
    """The same; measure each photograph once, and draw no figures of pages."""
    with few_poses(), pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(target_measurement, "measure_testfield", _measured_once)
        monkeypatch.setattr(figures, "to_bytes", _blank)
        yield


def _measured_once(
    frame: Frame, design: TestfieldDesign, options: TestfieldOptions | None = None
) -> Measured | Failure:
    return kept.once(measure_testfield, frame, design, options)


def _blank(figure: Figure, kind: str, **options: Any) -> bytes:
    """Figures of pages are made, but not drawn: what they show is tested with the reports."""
    return b"<svg viewBox='0 0 1 1'></svg>" if kind == "svg" else to_bytes(figure, kind, **options)
