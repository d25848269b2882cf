"""Zones in which the axes of a table must not be together: a camera beside the tilted table, a cable."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager

from reseau.core.errors import SettingError, StateError

Span = tuple[float, float]
"""Lowest and highest position."""
EVERYWHERE: Span = (-math.inf, math.inf)
NOWHERE: Span = (math.nan, math.nan)


class KeepOut:
    """Zones of a table, and the movements that are under way.

    Parameters
    ----------
    zones : sequence of mapping
        For each zone the lowest and highest position of some axes; other axes may be anywhere.
    axes : collection of str
        Axes of the table.

    Raises
    ------
    SettingError
        If a zone has no axis of the table, or a range that is none.

    Examples
    --------
    >>> zones = KeepOut([{"tilt": (-50, -20), "roll": (80, 100)}], ["tilt", "roll"])
    >>> with zones.crossed("tilt", (0.0, -30.0), lambda axis: (10.0, 10.0)):
    ...     pass
    >>> with zones.crossed("tilt", (0.0, -30.0), lambda axis: (90.0, 90.0)):
    ...     pass
    Traceback (most recent call last):
    reseau.core.errors.SettingError: axis tilt: would enter the zone to be kept out of (tilt -50…-20, roll
    80…100); move roll out of 80…100 first
    """

    def __init__(self, zones: Sequence[Mapping[str, Sequence[float]]], axes: Collection[str]) -> None:
        self.zones: list[dict[str, Span]] = []
        for zone in zones:
            right = all(len(span) == 2 and span[0] <= span[1] for span in zone.values())
            if not zone or not set(zone) <= set(axes) or not right:
                what = f"{dict(zone)} does not give lowest and highest positions of {', '.join(axes)}"
                raise SettingError(what, where="keep_out")
            self.zones.append({axis: (float(span[0]), float(span[1])) for axis, span in zone.items()})
        self._underway: dict[str, Span] = {}
        self._lock = threading.Lock()

    @contextmanager
    def crossed(
        self, axis: str, positions: Sequence[float], stands: Callable[[str], Span | None]
    ) -> Iterator[None]:
        """Hold an axis' way against movements of the others, while it moves.

        Parameters
        ----------
        axis : str
            The axis that is to move.
        positions : sequence of float
            Where it is, and where it goes.
        stands : callable
            Where another axis stands; None if that is not known.

        Raises
        ------
        SettingError
            If the way enters a zone in which the other axes are, or go; nothing moves then.
        StateError
            If it is not known where they are.
        """
        way = (min(positions), max(positions))
        with self._lock:
            self._require_free(axis, way, stands)
            self._underway[axis] = way
        try:
            yield
        finally:
            self._underway.pop(axis, None)

    def _require_free(self, axis: str, way: Span, stands: Callable[[str], Span | None]) -> None:
        for zone in self.zones:
            if axis not in zone or not _meet(way, zone[axis]):
                continue
            others = [each for each in zone if each != axis]
            there = {each: self._underway.get(each) or stands(each) for each in others}
            if any(span is not None and not _meet(span, zone[each]) for each, span in there.items()):
                continue
            text = ", ".join(f"{each} {span[0]:g}…{span[1]:g}" for each, span in zone.items())
            unknown = [each for each, span in there.items() if span is None]
            if unknown:
                what = f"may enter the zone to be kept out of ({text}): where {unknown[0]} is, is not known"
                raise StateError(what, where=f"axis {axis}", do=f"home {unknown[0]} first")
            what = f"would enter the zone to be kept out of ({text})"
            away = [f"move {each} out of {zone[each][0]:g}…{zone[each][1]:g} first" for each in others[:1]]
            raise SettingError(what, where=f"axis {axis}", do=away[0] if away else None)


def _meet(one: Span, other: Span) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]
