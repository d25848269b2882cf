"""Worker processes; without heavy imports, so that they can start before heavy modules are imported."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from multiprocessing.context import BaseContext


def cores() -> int:
    """Number of cores available to this process.

    Examples
    --------
    >>> cores() >= 1
    True
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def process_context(modules: Sequence[str]) -> BaseContext:
    """Context for processes that share no threads with this one.

    Parameters
    ----------
    modules : sequence of str
        Modules to import once for all of them.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(modules))
    return context


def start_early(modules: Sequence[str]) -> None:
    """Import the modules for later processes in the background."""
    if process_context(modules).get_start_method() == "forkserver":
        from multiprocessing import forkserver

        forkserver.ensure_running()
