"""What a camera had before it was changed, so that a setting that is left to it brings that back."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

__all__ = ["Found"]


class Found:
    """Values as they were found, by name.

    Examples
    --------
    >>> found, gain = Found(), 7
    >>> found.before("gain", True, lambda: gain)
    7
    >>> gain = 3
    >>> found.before("gain", True, lambda: gain), found.before("gain", False), found.before("gain", False)
    (7, 7, None)
    """

    def __init__(self) -> None:
        self._values: dict[Hashable, Any] = {}

    def before(self, name: Hashable, given: bool, now: Callable[[], Any] | None = None) -> Any:
        """What there was before it was changed; None where it was not.

        Parameters
        ----------
        name : hashable
            Of the setting.
        given : bool
            Whether it is changed now; otherwise what there was is to be brought back, and forgotten.
        now : callable, optional
            Asks for what there is, when it is changed for the first time.
        """
        if not given:
            return self._values.pop(name, None)
        if name not in self._values and now is not None:
            self._values[name] = now()
        return self._values.get(name)
