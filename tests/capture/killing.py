"""A session in a separate process that is killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from typing import Any


def exit_code(
    work: Callable[..., None], given: tuple[Any, ...], after_s: float | None, heavy: Sequence[str]
) -> int | None:
    """How a process ended that was killed with -9 after so long, if it had not ended before.

    `heavy` names what takes long to import; it is there when the process begins.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([work.__module__, *heavy])
    process = context.Process(target=work, args=given)
    process.start()
    process.join(after_s)
    if process.is_alive():
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
    process.join(60)
    return process.exitcode
