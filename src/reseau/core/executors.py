"""Do the independent parts of a computation: in this process, or in several.

A part that ends its process (a crash of a library, or the system's, when memory is short) must not lose the
others. Those that were under way with it are done again, alone; one that ends its process twice then has a
failure with its name as its outcome.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import connection, parent_process
from typing import Any, Protocol, Self, TypeVar

from .failure import Code, Failure
from .processes import process_context
from .threads import always_one_thread, one_thread

J = TypeVar("J")
R = TypeVar("R")
_AHEAD = 2
"""Jobs that are queued for each process, so that none is idle."""

_TRIES = 2
"""How often a job that may have ended its process is done alone."""


class Executor(Protocol):
    """What does independent parts of a computation; a context that ends its processes.

    The outcomes do not depend on the executor: BLAS uses one thread in each.

    Examples
    --------
    >>> executor: Executor = Here()
    >>> list(executor.outcomes(len, [("a", "xyz"), ("b", "")]))
    [('a', 3), ('b', 0)]
    """

    @property
    def local(self) -> bool:
        """Whether all work is done on this machine, with its files and paths."""

    def __enter__(self) -> Self:
        """Return the executor."""

    def __exit__(self, *_: object) -> None:
        """End its processes."""

    def outcomes(
        self, work: Callable[[J], R], jobs: Iterable[tuple[str, J]]
    ) -> Iterator[tuple[str, R | Failure]]:
        """Yield the outcome of each job, in the order of the jobs.

        Parameters
        ----------
        work : callable
            Computes the outcome of a job; picklable, unless this process does the work. It may be called
            more than once for a job, and must therefore not change what another call reads.
        jobs : iterable of (str, object)
            Names, and arguments of `work`. They are asked for when they are needed: a few for each process
            are in memory at once.

        Returns
        -------
        iterator of (str, object)
            Names with what `work` returned; a failure of the code ``crashed`` if it ended its process
            twice.

        Raises
        ------
        Exception
            What `work` raises, at the place of the job.
        """


class Here:
    """This process does the work.

    Examples
    --------
    >>> with Here() as executor:
    ...     dict(executor.outcomes(abs, [("a", -1.5)]))
    {'a': 1.5}
    """

    local = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def outcomes(
        self, work: Callable[[J], R], jobs: Iterable[tuple[str, J]]
    ) -> Iterator[tuple[str, R | Failure]]:
        """Yield the outcome of each job; see :meth:`Executor.outcomes`."""
        for name, job in jobs:
            with one_thread():
                found = work(job)
            yield name, found


class Processes:
    """Processes of this machine do the work; they are started with the first job.

    Parameters
    ----------
    count : int
        Number of processes.
    modules : sequence of str
        Modules to import once for all of them.

    Examples
    --------
    >>> with Processes(2) as executor:  # doctest: +SKIP
    ...     dict(executor.outcomes(abs, [("a", -1.5)]))
    {'a': 1.5}
    """

    local = True

    def __init__(self, count: int, modules: Sequence[str] = ()) -> None:
        self.count, self._modules = count, (__name__, *modules)
        self._pool: ProcessPoolExecutor | None = None
        self._apart: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for pool in (self._pool, self._apart):
            if pool is not None:
                pool.shutdown(wait=True, cancel_futures=True)
        self._pool = self._apart = None

    def outcomes(
        self, work: Callable[[J], R], jobs: Iterable[tuple[str, J]]
    ) -> Iterator[tuple[str, R | Failure]]:
        """Yield the outcome of each job; see :meth:`Executor.outcomes`."""
        waiting = deque[tuple[str, J, Future[R]]]()
        try:
            for name, job in jobs:
                waiting.append((name, job, self._submit(work, job)))
                if len(waiting) > _AHEAD * self.count:
                    first, begun, future = waiting.popleft()
                    yield first, self._outcome(work, first, begun, future)
            while waiting:
                first, begun, future = waiting.popleft()
                yield first, self._outcome(work, first, begun, future)
        finally:
            for _, _, future in waiting:
                future.cancel()

    def _submit(self, work: Callable[[J], R], job: J) -> Future[R]:
        if self._pool is not None:
            with suppress(BrokenProcessPool):
                return self._pool.submit(work, job)
        self._pool = self._started(self.count)
        return self._pool.submit(work, job)

    def _started(self, count: int) -> ProcessPoolExecutor:
        context = process_context(self._modules)
        return ProcessPoolExecutor(count, mp_context=context, initializer=prepare_process)

    def _outcome(self, work: Callable[[J], R], name: str, job: J, future: Future[Any]) -> R | Failure:
        try:
            found: R = future.result()
            return found
        except BrokenProcessPool:
            # A process has died, and nobody knows of which job: each that was under way is done again, alone.
            return self._alone(work, name, job)

    def _alone(self, work: Callable[[J], R], name: str, job: J) -> R | Failure:
        for _ in range(_TRIES):
            if self._apart is None:
                self._apart = self._started(1)
            try:
                return self._apart.submit(work, job).result()
            except BrokenProcessPool:
                self._apart = None
        return crashed(name)


def crashed(name: str) -> Failure:
    """Return the outcome of a job that ended its process twice.

    Examples
    --------
    >>> crashed("photo.png").code
    <Code.CRASHED: 'crashed'>
    """
    reason = "ended its process twice; use fewer processes if memory is short, otherwise please report it"
    return Failure(reason, Code.CRASHED, where=name)


def prepare_process() -> None:
    """Use one core in this process, and end it with the process that started it."""
    import cv2

    cv2.setNumThreads(1)
    always_one_thread()
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: Any) -> None:
    connection.wait([sentinel])
    os._exit(1)
