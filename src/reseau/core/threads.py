"""Limit BLAS to one thread for small dense matrices."""

from __future__ import annotations

from functools import cache
from typing import Any

import threadpoolctl  # type: ignore[import-untyped]

__all__ = ["always_one_thread", "one_thread"]


@cache
def _controller() -> Any:
    # Finding the libraries takes a millisecond, setting their limit a hundredth of that; find them once.
    return threadpoolctl.ThreadpoolController()


def one_thread() -> Any:
    """A context in which BLAS uses one thread.

    On a busy machine two threads wait for each other: an adjustment of 3000 observations and 200 parameters
    took 0.1 s with one thread and 7.7 s with two. Entering the context takes about ten microseconds; only the
    outermost public calls do it.

    Examples
    --------
    >>> with one_thread():
    ...     pass
    """
    return _controller().limit(limits=1, user_api="blas")


def always_one_thread() -> None:
    """Limit BLAS to one thread permanently, in worker processes."""
    threadpoolctl.threadpool_limits(1, user_api="blas")
