"""`reseau demo`, `reseau schema`, `reseau compile`: what is about this program."""

from __future__ import annotations

import json
import time
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from .common import compile_first, progress, say, say_json, say_notes

if TYPE_CHECKING:
    from ..io.document import Document
    from ..sessions.demo import TestfieldSession


def demo(
    out: v.Out = Path("out"),
    seed: v.Seed = 1,
    as_json: v.AsJson = False,
) -> None:
    """Capture, correct and adjust on a simulated bench with real protocols; compare with the true values."""
    from ..report.summary import comparison_table
    from ..sessions.demo import STEPS, run_demo

    compile_first("demo")
    with progress("taking photographs", STEPS) as step:
        done = run_demo(out, seed, step)
    if as_json:
        say_json(done.to_dict())
    else:
        say(comparison_table(done.comparison))
        say(_camera_table(done.testfield))
        say(f"\n{done.oscilloscope.way}; all frames are in {out / 'archive'}\nopen {out / 'report.html'}\n")


def _camera_table(field: TestfieldSession) -> str:
    """Parameters of the camera with their errors, one line each."""
    from ..core.numbers import measured
    from ..optics.cameras.registry import unit_of

    facts = field.to_dict()
    lines = [f"\ntestfield, {facts['poses']} poses: sigma0 {facts['sigma0']:.3f}"]
    for name, row in facts["parameters"].items():
        unit, off = unit_of(name, "brown"), (row["value"] - row["true"]) / row["sigma"]
        found = measured(row["value"], row["sigma"], unit)
        lines.append(f"  {name:<4} {found:<32} true {row['true']:.6g} {unit:<6} error {off:+.1f} sigma")
    return "\n".join(lines) + "\n"


_MODULES = (
    "bundle.document", "calibration.document", "capture.bench", "io.board", "io.design", "io.edges",
    "io.fiducials", "io.frame", "io.lens", "io.measurement", "io.network", "io.refraction", "io.targets",
    "io.testfield", "report.scene", "service.audit", "service.certificates.data", "service.covariates",
    "service.delivering", "service.recalibration", "service.rules", "service.schedule", "sessions.parameters",
)  # fmt: skip
"""Modules of the project that define documents."""


def documents(missing: set[str] | None = None) -> dict[str, type[Document]]:
    """Every kind of document by the name of its schema, in the order of the names.

    What is not installed for some of them is added to `missing`, where it is given.
    """
    from ..core.optional import optional
    from ..io.document import Document

    found = {}
    for name in _MODULES:
        try:
            with optional():
                module = import_module(f"reseau.{name}")
        except UsageError as error:
            if missing is None:
                raise
            missing.add(str(error))
            continue
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
    missing = set[str]()
    known = documents(missing)
    if name not in known:
        say_notes(f"documents are left out: {why}" for why in sorted(missing))
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


def compile_loops(
    only: Annotated[
        list[str] | None, typer.Argument(help="Jobs to compile for, e.g. demo; by default all.")
    ] = None,
    jobs: v.Jobs | None = None,
) -> None:
    """Compile for this processor, once, what commands compile at their first call otherwise."""
    from ..core.ahead import by_module, compile_ahead, main_loops
    from ..execution import executor_at

    known = {job for loop in main_loops() for job in loop.jobs}
    wanted = set(only or known)
    if wanted - known:
        unknown, names = min(wanted - known), ", ".join(sorted(known))
        raise UsageError(f"{unknown} is unknown", where="JOBS", do=f"name some of {names}")
    begun = time.perf_counter()
    modules = by_module(loop for loop in main_loops() if wanted.intersection(loop.jobs))
    with executor_at(jobs, parts=len(modules)) as executor, progress("compiling", len(modules)) as step:
        done = compile_ahead(executor, modules, step)
    if done.compiled:
        typer.echo(f"compiled {done.compiled} loops in {time.perf_counter() - begun:.0f} s", err=True)
    size = sum(path.stat().st_size for path in done.folder.glob("*")) / 1e6
    say(f"{done.compiled + done.found} loops for this processor, {size:.1f} MB, are in {done.folder}\n")
