"""`reseau schema`: the formats of all documents as JSON Schema."""

from __future__ import annotations

import json
from importlib import import_module
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.errors import UsageError

if TYPE_CHECKING:
    from ..io.document import Document

__all__ = ["documents", "schema"]

_WHERE = {
    "bundle.document": ("ResultDocument",),
    "calibration.document": ("Calibration",),
    "capture.bench": ("BenchFile",),
    "io.board": ("BoardDesign",),
    "io.design": ("ReseauDesign",),
    "io.fiducials": ("FiducialDesign", "FiducialOrientation"),
    "io.frame": ("FrameCorners", "FrameOrientation", "RollSummary"),
    "io.lens": ("LensDocument",),
    "io.measurement": ("ReseauMeasurement",),
    "io.network": ("Network1",),
    "io.refraction": ("RefractionFile",),
    "io.targets": ("SpaceTargets",),
    "io.testfield": ("TestfieldDesign",),
    "service.certificates.data": ("CertificateData",),
    "service.covariates": ("CalibrationFunction",),
    "service.recalibration": ("Recalibration",),
    "service.rules": ("AcceptanceRules", "Judgement"),
    "service.schedule": ("Schedule",),
    "sessions.parameters": (
        "BlurredParameters",
        "FramesParameters",
        "OscilloscopeParameters",
        "OwnParameters",
        "ScanParameters",
        "SensorParameters",
        "SessionParameters",
        "TestfieldParameters",
    ),
}
"""Modules of the project, and their documents."""


def documents() -> dict[str, type[Document]]:
    """Every kind of document by the name of its schema, in the order of the names."""
    found = {}
    for module, names in _WHERE.items():
        for name in names:
            kind = getattr(import_module(f"reseau.{module}"), name)
            found[kind.SCHEMA] = kind
    return dict(sorted(found.items()))


def schema(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", help="Name of the schema, as in reseau-network/1; by default a list."),
    ] = None,
) -> None:
    """Print the format of a document as JSON Schema (draft 2020-12), or list all."""
    known = documents()
    if name is None:
        for each, kind in known.items():
            about = (kind.__doc__ or "").strip().splitlines()[0]
            about = about.replace(f"``{each}``: ", "").replace(f", ``{each}``", "")
            print(f"{each:36} {about[:1].upper()}{about[1:]}")
        return
    if name not in known:
        raise UsageError(
            f"{name!r} is not the name of a schema", where="reseau schema", do="run it without a name for all"
        )
    print(json.dumps(known[name].json_schema(), indent=1, ensure_ascii=False))
