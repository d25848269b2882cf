"""Compiled loops over observations, in parallel threads.

Whole-array NumPy allocates an array for every product; for a hundred thousand image points that takes ten
times as long as the arithmetic (``docs/decisions/0002-numba.md``).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar, cast

import numba
import numpy as np

from ...core.data import Rows

__all__ = ["called", "chunks_of", "compiled", "in_parallel"]

F = TypeVar("F", bound=Callable[..., Any])

# Sums are formed in this many parts for any number of processors, so that results do not depend on it.
_PARTS = 4
# Minimum number of observations in a part.
_PART_SIZE = 2000


def compiled(function: F) -> F:
    """Compile a function at its first call, cached on disk, without the global interpreter lock."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def called(function: F) -> F:
    """Compile a function that compiled ones call, and that allocates no array: without reference counts.

    Counting the references to the arrays that it is given takes longer than short loops over their elements.
    It is not cached on disk, from where it could not be inlined; what calls it is.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
    return cast(F, numba.njit(**options)(function))


def chunks_of(starts: Rows) -> list[tuple[int, int]]:
    """Divide groups into ranges with about the same number of observations.

    Parameters
    ----------
    starts : ndarray of int (g + 1,)
        First observation of each group, and the total.
    """
    groups, total = len(starts) - 1, int(starts[-1])
    parts = min(_PARTS, max(1, total // _PART_SIZE))
    bounds = np.searchsorted(starts, np.linspace(0, total, parts + 1)[1:-1])
    edges = [0, *bounds.tolist(), groups]
    return [(a, b) for a, b in pairwise(edges) if b > a]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=processors(), thread_name_prefix="reseau-bundle")


def processors() -> int:
    """Number of processors available to this process, at most eight."""
    return max(
        1, min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    )


def in_parallel(function: Callable[[int, int, int], None], chunks: Sequence[tuple[int, int]]) -> None:
    """Call `function(part, begin, end)` for each chunk, in parallel threads."""
    if len(chunks) == 1 or processors() == 1:
        for part, (begin, end) in enumerate(chunks):
            function(part, begin, end)
        return
    jobs = [_pool().submit(function, part, begin, end) for part, (begin, end) in enumerate(chunks)]
    for job in jobs:
        job.result()
