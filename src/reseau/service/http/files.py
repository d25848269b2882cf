"""Operations on files that people bring: photographs of a target, of an oscilloscope; and computations."""

from __future__ import annotations

import json
from typing import Annotated, Any

from fastapi import APIRouter, File, Form, Path, UploadFile

from ...core import vocabulary as v
from ...core.errors import InputError, UsageError
from ...io.photographs import PHOTOGRAPHS
from ..decoding import PHOTOGRAPH
from .access import Here, NotFound, Operating, Reading
from .answers import Answer, refusals
from .service import Job
from .sessions import SessionName, new_name, the_session

router = APIRouter(tags=["files"], responses=refusals(400, 401, 403, 404, 413, 422, 503))

WORDS = v.names()
MOST_FILES, MOST_BYTES = 200, 200 << 20
"""Photographs of an upload, and bytes of one."""
_MOST_DESIGN = 4 << 20


class Uploaded(Answer, json_schema_extra={"example": {"session": "left, March", "job": 1}}):
    """The session that the photographs became, and the computation that has begun."""

    session: str
    job: int


def _label(name: str | None, number: int) -> str:
    """Name of a photograph: what follows the last slash of its file's name, printable, and short."""
    last = (name or "").replace("\\", "/").rpartition("/")[2]
    plain = "".join(c if c.isprintable() else "_" for c in last)[-100:]
    return plain or f"photograph {number}"


def _suffix(name: str) -> str:
    suffix = "." + name.rpartition(".")[2].lower()
    if suffix not in PHOTOGRAPHS or suffix == ".dcm":
        raise InputError("is not a photograph", where=name, do=f"use {', '.join(PHOTOGRAPHS[:5])}, …")
    return suffix


@router.post("/uploads", status_code=202)
def upload(
    who: Operating,
    service: Here,
    name: Annotated[str, Form(min_length=1, max_length=200, description="Name of the session.")],
    photographs: Annotated[list[UploadFile], File(description="Photographs, or scans of film.")],
    design: Annotated[
        UploadFile | None,
        File(description="Design of the target, or of the reseau of an oscilloscope (JSON)."),
    ] = None,
    test_object: Annotated[
        UploadFile | None, File(description="For an oscilloscope: design of the test object (JSON).")
    ] = None,
    corners: Annotated[
        UploadFile | None, File(description="For film: calibrated corners of the camera (`frame-corners/1`).")
    ] = None,
    subject: Annotated[v.Subject, Form()] = "camera",
    model: Annotated[v.Model, Form(max_length=40)] = "",
    pitch_mm: Annotated[v.PitchMm | None, Form()] = None,
    free: Annotated[str, Form(max_length=400, description=f"{WORDS['free'].help} As c,x0,y0,K1.")] = "",
    format_mm: Annotated[
        str,
        Form(
            pattern=r"^([0-9]{1,3}(\.[0-9]{1,3})?x[0-9]{1,3}(\.[0-9]{1,3})?)?$",
            description=WORDS["format_mm"].help,
        ),
    ] = "",
    dpi: Annotated[v.Dpi | None, Form()] = None,
) -> Uploaded:
    """Calibrate from photographs: they are archived as they come, decoded, measured and adjusted.

    Photographs of an oscilloscope are taken in the order PHOTO I, II, III. The frames of film are oriented by
    their edges, with what the frames of the roll have in common.
    """
    from ...io import FrameCorners
    from ...sessions import conducting, kinds

    if len(photographs) > MOST_FILES:
        raise UsageError(f"are more than {MOST_FILES}", where="photographs")
    labels = [_label(each.filename, k) for k, each in enumerate(photographs, start=1)]
    suffixes = [_suffix(each) for each in labels]
    for each, label in zip(photographs, labels, strict=True):
        if (each.size or 0) > MOST_BYTES:
            raise UsageError(f"is larger than {MOST_BYTES >> 20} MiB", where=label)
        if not each.size:
            raise InputError("is empty", where=label)
    if subject != "oscilloscope" and len(set(labels)) < len(labels):
        raise UsageError("have names that occur twice", where="photographs")
    if subject != "film" and design is None:
        raise UsageError("is missing", where="design", do="give the design of the target")
    plan, inputs = "photographs", dict[str, str]()
    given: dict[str, Any] = {"model": model, "pitch_mm": pitch_mm}
    if subject == "camera":
        assert design is not None
        inputs["design.json"] = _text(design)
        given["free"] = [each.strip() for each in free.split(",") if each.strip()]
    elif subject == "film":
        plan, given = "film", {}
        if format_mm:
            given["format_mm"] = [float(each) for each in format_mm.split("x")]
        if dpi is not None:
            given["dpi"] = dpi
        if corners is not None:
            inputs[kinds.CORNERS] = _text(corners)
            FrameCorners.parse(inputs[kinds.CORNERS], where=_label(corners.filename, 0))
    else:
        if test_object is None or len(photographs) < 2:
            raise UsageError("needs PHOTO I and II, and the design of the test object", where=name)
        if len(photographs) > 3:
            raise UsageError("are more than PHOTO I, II and III", where="photographs")
        assert design is not None
        plan, inputs = "oscilloscope", {"reseau.json": _text(design), "object.json": _text(test_object)}
        given = {"body": len(photographs) > 2}
        labels = [f"PHOTO {'I' * k}" for k in range(1, len(photographs) + 1)]
    with service.audited(who, "upload", name, {"photographs": len(photographs), "plan": plan}):
        new_name(service, name)
        conducting.check(name, plan, given, inputs)
        session = conducting.begin(service.archive, name, plan, given, inputs)
        for each, label, suffix in zip(photographs, labels, suffixes, strict=True):
            session.store(label, each.file.read(), kind=PHOTOGRAPH, suffix=suffix)
    return Uploaded(session=name, job=service.jobs.add("finish", name).number)


def _text(file: UploadFile) -> str:
    if (file.size or 0) > _MOST_DESIGN:
        raise UsageError(f"is larger than {_MOST_DESIGN >> 20} MiB", where="design")
    try:
        text = file.file.read().decode("utf-8")
        json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("is not JSON", where=_label(file.filename, 0)) from None
    return text


@router.post("/sessions/{session}/rerun", status_code=202)
def rerun(session: SessionName, who: Operating, service: Here) -> Job:
    """Compute the results of a session again from its frames, and compare them byte by byte."""
    kept = the_session(service, session)
    if not kept.results():
        raise UsageError(f"has no results (status: {kept.status})", where=session)
    return service.jobs.add("rerun", session)


@router.get("/jobs/{number}")
def job(
    number: Annotated[int, Path(ge=1, le=1 << 31, description="Number of the computation.")], who: Reading,
    service: Here,
) -> Job:  # fmt: skip
    """A computation: its state, and what it found. The session has the results."""
    found = service.jobs.get(number)
    if found is None:
        raise NotFound("is no computation of this service since its start", where=number)
    return found
