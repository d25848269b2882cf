"""A session in a separate process that is killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import psutil


class Ended(NamedTuple):
    """How a process ended, and the processor time that it took."""

    code: int | None
    seconds: float


def ended(
    work: Callable[..., None], given: tuple[Any, ...], after_s: float | None, heavy: Sequence[str]
) -> Ended:
    """Do the work in a process, and kill it with -9 after so much processor time, if it has not ended before.

    Processor time, because the same time on a busy machine is another place in the work. `heavy` names what
    takes long to import; it is there when the process begins.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([work.__module__, *heavy])
    process = context.Process(target=work, args=given)
    process.start()
    assert process.pid is not None
    seconds = 0.0
    while process.is_alive():
        try:
            used = psutil.Process(process.pid).cpu_times()
        except psutil.Error:
            break
        seconds = used.user + used.system
        if after_s is not None and seconds >= after_s:
            # Somewhere in the hundredth of a second that the system counts in, also while it waits.
            time.sleep(0.01 * (after_s * 1000 % 1))
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL)
            break
        time.sleep(0.005)
    process.join(600)
    return Ended(process.exitcode, seconds)
