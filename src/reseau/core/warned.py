"""Warnings that name the line of the user's program, however deep in this package they arise."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable
from pathlib import Path

_OWN = str(Path(__file__).parents[1])


def warn_user(lines: Iterable[str]) -> None:
    """Warn of each line, where the program calls this package.

    Examples
    --------
    >>> with warnings.catch_warnings(record=True) as seen:
    ...     warnings.simplefilter("always")
    ...     warn_user(["is usable to remove visible distortion only"])
    >>> [str(each.message) for each in seen]
    ['is usable to remove visible distortion only']
    """
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_OWN):
        level, frame = level + 1, frame.f_back
    for line in lines:
        warnings.warn(line, stacklevel=level)
