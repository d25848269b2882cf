"""Types of the arrays that are passed between packages, and rows by their groups."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]


def rows_of_groups(group: Rows, groups: int) -> list[Rows]:
    """Return the rows of each group, in ascending order.

    One sort serves all groups: a comparison of all rows for each of thousands of groups takes longer than
    what is done with them.

    Parameters
    ----------
    group : ndarray of int (n,)
        Group of each row, from 0 on.
    groups : int
        Number of groups.

    Examples
    --------
    >>> rows_of_groups(np.array([1, 0, 1]), 3)
    [array([1]), array([0, 2]), array([], dtype=int64)]
    """
    order = np.argsort(group, kind="stable").astype(np.intp)
    ends = np.cumsum(np.bincount(group, minlength=groups))
    return np.split(order, ends[:-1]) if groups else []
