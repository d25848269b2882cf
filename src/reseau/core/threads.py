"""BLAS held to one thread around small dense work."""

from __future__ import annotations

from functools import cache
from typing import Any

import threadpoolctl  # type: ignore[import-untyped]

__all__ = ["always_one_thread", "one_thread"]


@cache
def _controller() -> Any:
    # Looking for the libraries takes a millisecond, setting their limit a hundredth of that: look once.
    return threadpoolctl.ThreadpoolController()


def one_thread() -> Any:
    """A context in which BLAS has one thread.

    Two threads of a busy machine wait for each other: an adjustment of 3000 observations and 200 parameters
    that takes 0.1 s with one took 7.7 s with two. Entering takes some ten microseconds, so that the outermost
    public calls do it, once each.
    """
    return _controller().limit(limits=1, user_api="blas")


def always_one_thread() -> None:
    """Hold BLAS to one thread for good, in a process that is one of several."""
    threadpoolctl.threadpool_limits(1, user_api="blas")
