"""What a program says before it makes its user wait; without heavy imports."""

from __future__ import annotations

from collections.abc import Callable

_told: list[Callable[[], object]] = []


def before_compiling(tell: Callable[[], object]) -> None:
    """Call a function once, when this process is about to compile its first loop.

    Examples
    --------
    >>> before_compiling(lambda: print("compiling for this processor, once"))
    >>> compiles()
    compiling for this processor, once
    >>> compiles()
    """
    _told[:] = [tell]


def compiles() -> None:
    """Say that a loop is about to be compiled, if nobody has said it yet."""
    while _told:
        _told.pop()()
