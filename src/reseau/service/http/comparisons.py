"""Comparison of two calibrations over the image: of configurations, and of sessions."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Query, Request, Response

from .access import Here, NotFound, Reading
from .answers import Answer, refusals
from .calibrations import SVG, decision_row, known_configurations, the_configuration, the_decision
from .service import Service
from .sessions import the_session
from .stored import picture_answer

if TYPE_CHECKING:
    from ...calibration import Calibration


router = APIRouter(tags=["calibrations"], responses=refusals(400, 401, 403, 404, 409, 422, 503))

One = Annotated[
    str,
    Query(min_length=1, max_length=300, description="`CONFIGURATION/KEY`, or a session with a calibration."),
]
_MOST_CHOICES = 100
"""Latest sessions among which those with a calibration can be chosen on the page."""


class Comparison(Answer):
    """Difference of two calibrations over the image."""

    first: str
    second: str
    greatest: float
    rms: float
    unit: str
    p: float
    parameters: list[tuple[str, float | None, float | None]]


@dataclass(frozen=True)
class Chosen:
    """A calibration that is compared: its key or session, what people call it, and its page."""

    key: str
    title: str
    page: str
    calibration: Calibration


def chosen(service: Service, text: str) -> Chosen:
    """Return a calibration: `CONFIGURATION/KEY`, or the name of a session that has one.

    Raises
    ------
    NotFound
        If there is none.
    """
    from ...sessions import conducting

    name, slash, key = text.rpartition("/")
    if not slash:
        session = the_session(service, text)
        return Chosen(text, text, f"/sessions/{quote(text, safe='')}", conducting.calibration_of(session))
    known = the_configuration(service, name)
    decision = the_decision(known, name, key)
    page = f"/calibrations/{quote(name, safe='')}/{decision.key}"
    title = f"{name}: {decision_row(decision).name}"
    return Chosen(decision.key, title, page, known.calibration(name, decision.key))


def choices(service: Service) -> list[tuple[str, str]]:
    """Return what can be compared: the text that :func:`chosen` takes, and what people call it."""

    def compute() -> list[tuple[str, str]]:
        found, judged = list[tuple[str, str]](), set[str | None]()
        known = known_configurations(service)
        for name in known.names():
            rows = [decision_row(each) for each in reversed(known.history(name))]
            found += [(f"{name}/{each.key}", f"{name}: {each.name}") for each in rows]
            judged |= {each.session for each in rows}
        others = [each for each in calibrated(service) if each not in judged]
        return found + [(each, f"session {each}") for each in others]

    return service.current("choices", compute)


def calibrated(service: Service) -> list[str]:
    """Return the latest sessions with a calibration."""
    found = service.archive.sessions(last=_MOST_CHOICES, result="calibration.json")
    return [each.name for each in reversed(found)]


def comparison(first: Chosen, second: Chosen) -> tuple[Comparison, Any]:
    """Return the difference of two calibrations, and its field if they are cameras."""
    import numpy as np

    from ...calibration import CameraMapping, calibration_difference
    from ..fields import difference

    old, new = first.calibration, second.calibration
    found = difference(new, old)
    field = None
    rms, p = found.greatest, float(getattr(found, "p", float("nan")))
    if new.kind == old.kind == "camera":
        field = calibration_difference(
            CameraMapping.from_calibration(old), CameraMapping.from_calibration(new)
        )
        rms, p = float(np.sqrt(np.nanmean((field.difference**2).sum(axis=-1)))), field.p
    every = dict.fromkeys([*old.parameters, *new.parameters])
    values = [
        (
            each,
            old.parameters[each].value if each in old.parameters else None,
            new.parameters[each].value if each in new.parameters else None,
        )
        for each in every
    ]
    answer = Comparison(
        first=first.key, second=second.key, greatest=found.greatest, rms=rms, unit=found.unit, p=p,
        parameters=values,
    )  # fmt: skip
    return answer, field


@router.get("/comparisons")
def compare(first: One, second: One, who: Reading, service: Here) -> Comparison:
    """The difference of any two calibrations over the image, and its significance."""
    return comparison(chosen(service, first), chosen(service, second))[0]


@router.get("/comparisons/figure.svg", response_class=Response, responses=SVG)
def compare_figure(request: Request, first: One, second: One, who: Reading, service: Here) -> Response:
    """The difference of two calibrations of cameras, as arrows over its uncertainty."""
    from ...report.fields import difference_figure

    one, two = chosen(service, first), chosen(service, second)
    _, field = comparison(one, two)
    if field is None:
        raise NotFound("are not of cameras", where=f"{first}, {second}")
    tag = hashlib.sha256(f"{one.calibration.to_json()}{two.calibration.to_json()}".encode()).hexdigest()[:32]
    return picture_answer(request, lambda: difference_figure(field), "image/svg+xml", tag)
