"""`reseau schema`: the formats of all documents as JSON Schema."""

from __future__ import annotations

import json
from importlib import import_module
from typing import TYPE_CHECKING, Annotated

import typer

from ..core.errors import UsageError

if TYPE_CHECKING:
    from ..io.document import Document


_MODULES = (
    "bundle.document", "calibration.document", "capture.bench", "io.board", "io.design", "io.edges",
    "io.fiducials", "io.frame", "io.lens", "io.measurement", "io.network", "io.refraction", "io.targets",
    "io.testfield", "report.scene", "service.audit", "service.certificates.data", "service.covariates",
    "service.recalibration", "service.rules", "service.schedule", "sessions.parameters",
)  # fmt: skip
"""Modules of the project that define documents."""


def documents() -> dict[str, type[Document]]:
    """Every kind of document by the name of its schema, in the order of the names."""
    from ..io.document import Document

    found = {}
    for name in _MODULES:
        module = import_module(f"reseau.{name}")
        for kind in vars(module).values():
            if isinstance(kind, type) and issubclass(kind, Document) and kind.__module__ == module.__name__:
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
