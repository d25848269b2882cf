"""`reseau compile`: compile for this processor what the commands would compile at their first call."""

from __future__ import annotations

import time

import typer

from ..core import vocabulary as v
from .common import progress, say

__all__ = ["compile_loops"]


def compile_loops(jobs: v.Jobs | None = None) -> None:
    """Compile for this processor, once, what commands compile at their first call otherwise."""
    from ..core.ahead import by_module, compile_ahead, main_loops
    from ..execution import executor_at

    begun, modules = time.perf_counter(), by_module(main_loops())
    with executor_at(jobs, parts=len(modules)) as executor, progress("compiling", len(modules)) as step:
        done = compile_ahead(executor, modules, step)
    if done.compiled:
        typer.echo(f"compiled {done.compiled} loops in {time.perf_counter() - begun:.0f} s", err=True)
    size = sum(path.stat().st_size for path in done.folder.glob("*")) / 1e6
    say(f"{done.compiled + done.found} loops for this processor, {size:.1f} MB, are in {done.folder}\n")
