"""`reseau compile`: compile for this processor what the commands would compile at their first call."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from .common import progress, say


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
