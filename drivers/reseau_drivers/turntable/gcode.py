"""What tables with G-code controllers have in common: letters of axes, and a start that takes time."""

from __future__ import annotations

from collections.abc import Callable

from reseau.core.errors import DeadlineError, SettingError

from ..codecs.gcode import AXES
from .table import AxisPlan


def letter_of(plan: AxisPlan) -> str:
    """Return the letter of an axis: 1 is X.

    Raises
    ------
    SettingError
        If there is none.

    Examples
    --------
    >>> letter_of(AxisPlan(axis=4))
    'A'
    """
    if not 1 <= plan.axis <= len(AXES):
        raise SettingError(f"{plan.axis} is not 1…{len(AXES)}", where=f"number of axis {plan.name}")
    return AXES[plan.axis - 1]


def until(attempt: Callable[[], None], expired: Callable[[], bool]) -> None:
    """Repeat what gets no answer: boards with a USB converter start anew when their port is opened."""
    while True:
        try:
            attempt()
            return
        except DeadlineError:
            if expired():
                raise
