"""Loops over observations in parallel threads.

Whole-array NumPy allocates an array for every product; for a hundred thousand image points that takes ten
times as long as the arithmetic (``docs/decisions/0002-numba.md``).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numpy as np

from ...core.data import Rows

# Sums are formed in this many parts for any number of processors, so that results do not depend on it.
_PARTS = 4
# Minimum number of observations in a part.
_PART_SIZE = 2000


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
