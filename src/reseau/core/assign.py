"""Assignment of arrays in compiled functions.

``out[:] = values`` would compile a check of shapes with its message, which takes longer than the assignment.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from .compiled import kernel


@kernel
def assign(out: NDArray[Any], values: NDArray[Any]) -> None:
    """Fill `out` (n,) with values (n,), of which the number is not checked.

    Examples
    --------
    >>> import numpy as np
    >>> row = np.zeros(2)
    >>> assign(row, np.array([1.0, 2.0]))
    >>> row
    array([1., 2.])
    """
    for i in range(len(out)):
        out[i] = values[i]
