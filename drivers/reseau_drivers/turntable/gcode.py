"""What tables with G-code controllers have in common: lines, and the words that end their answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from reseau.core.errors import DeadlineError, SettingError

from ..codecs.gcode import AXES, AnswerDecoder, Message
from ..link import Link, MessageLink
from .table import AxisPlan

__all__ = ["Lines", "letter_of", "until"]


class Lines(MessageLink[Message]):
    """Exchange of lines with a controller.

    Parameters
    ----------
    link : Link
        Link to the controller.
    overhear : callable
        Called with each message that is not an answer.
    profile : mapping
        What is known of the controller.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> from reseau_drivers.profiles import known
    >>> Lines(link_to("/dev/ttyUSB0"), lambda message: None, known("marlin")).ignored
    0
    """

    def __init__(self, link: Link, overhear: Callable[[Message], None], profile: Mapping[str, Any]) -> None:
        super().__init__(link, AnswerDecoder(profile), overhear)


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
