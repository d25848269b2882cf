"""Limit BLAS to one thread for small dense matrices, and let freed memory be used again."""

from __future__ import annotations

from contextlib import ContextDecorator
from functools import cache
from threading import local
from typing import Any

import threadpoolctl  # type: ignore[import-untyped]

_KEPT = 32 * 2**20
"""Largest block, in bytes, by which the C library of Linux adapts to a program."""


@cache
def _controller() -> Any:
    import scipy.linalg  # noqa: F401  # loads a library of its own beside that of NumPy

    _keep_freed_memory()
    # Finding the libraries takes a millisecond, setting their limit a hundredth of that; find them once.
    return threadpoolctl.ThreadpoolController()


def _keep_freed_memory() -> None:
    """Let arrays use the memory of those before them.

    The C library of Linux gives freed memory back to the system when it exceeds twice the largest block that
    was ever freed, and its pages must then be mapped again: a sixth of the time for a frame of one megapixel.
    Such a block is never written to, and so takes neither memory nor time.
    """
    import numpy as np

    np.empty(_KEPT - 2**14, np.uint8)


class _OneThread(local, ContextDecorator):
    """The limit of each thread: set when its first context is entered, removed when that is left."""

    def __init__(self) -> None:
        self.depth = 0
        self.limit: Any = None

    def __enter__(self) -> None:
        self.depth += 1
        if self.depth == 1:
            self.limit = _controller().limit(limits=1, user_api="blas")

    def __exit__(self, *_: object) -> None:
        self.depth -= 1
        limit, self.limit = (self.limit, None) if self.depth == 0 else (None, self.limit)
        if limit is not None:
            limit.__exit__(*_)


_ONE_THREAD = _OneThread()


def one_thread() -> _OneThread:
    """A context, or decorator of a function, in which BLAS uses one thread.

    On a busy machine two threads wait for each other: an adjustment of 3000 observations and 200 parameters
    took 0.1 s with one thread and 7.7 s with two. Entering the context takes about ten microseconds, within
    another one less than one.

    Examples
    --------
    >>> with one_thread():
    ...     pass
    >>> @one_thread()
    ... def adjusted() -> None: ...
    """
    return _ONE_THREAD


def always_one_thread() -> None:
    """Limit BLAS to one thread permanently, in worker processes."""
    threadpoolctl.threadpool_limits(1, user_api="blas")
