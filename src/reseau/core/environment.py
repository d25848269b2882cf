"""What surrounded a measurement: temperature, humidity, pressure and the like, of one frame and of many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Condition:
    """One measured quantity.

    Parameters
    ----------
    value : float
        Value in `unit`.
    unit : str
        Unit.
    sigma : float, optional
        Standard uncertainty of the sensor, in `unit`; None if it is not known.

    Examples
    --------
    >>> str(Condition(21.53, "°C", 0.2)), str(Condition(1013.2, "hPa"))
    ('21.53 °C ± 0.2', '1013.2 hPa')
    """

    value: float
    unit: str
    sigma: float | None = None

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}" + ("" if self.sigma is None else f" ± {self.sigma:g}")

    def to_dict(self) -> dict[str, Any]:
        """Return value, unit and sigma, as they are stored with a frame."""
        return {"value": self.value, "unit": self.unit, "sigma": self.sigma}

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any]) -> dict[str, Condition]:
        """Return the conditions that are stored with a frame, as ``air.temperature``.

        Examples
        --------
        >>> stored = {"air": {"temperature": {"value": 21.5, "unit": "°C", "sigma": None}},
        ...           "wall": {"error": "wall (measure): did not answer"}}
        >>> Condition.from_facts({"environment": stored})
        {'air.temperature': Condition(value=21.5, unit='°C', sigma=None)}
        """
        return {
            f"{sensor}.{name}": cls(float(each["value"]), str(each["unit"]), each["sigma"])
            for sensor, conditions in facts.get("environment", {}).items()
            if "error" not in conditions
            for name, each in conditions.items()
        }


class Surroundings:
    """Conditions of the frames of which a result is made.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> found = Surroundings()
    >>> for frame, value in (("first", 20.5), ("second", 21.5)):
    ...     found.add(frame, SimpleNamespace(environment={"air.temperature": Condition(value, "°C", 0.2)}))
    >>> found.summary()
    {'air.temperature': {'mean': 21.0, 'low': 20.5, 'high': 21.5, 'unit': '°C', 'sigma': 0.2, 'frames': 2}}
    """

    def __init__(self) -> None:
        self._of: dict[str, Mapping[str, Condition]] = {}

    def add(self, frame: str, step: object) -> None:
        """Take over the conditions of a frame from its step; steps that are made of files have none."""
        self._of[frame] = getattr(step, "environment", {})

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return mean and range of each condition, its unit and sigma, and the number of frames.

        Conditions are sorted by name. One whose unit changed among the frames is left out: its mean would
        mean nothing. `sigma` is the largest that its sensor states; it does not become smaller in a mean.
        """
        found = {}
        for name in sorted({name for each in self._of.values() for name in each}):
            there = [each[name] for each in self._of.values() if name in each]
            values = np.array([each.value for each in there])
            sigmas = [each.sigma for each in there]
            if len({each.unit for each in there}) == 1:
                known = [each for each in sigmas if each is not None]
                found[name] = {
                    "mean": round(float(values.mean()), 6),
                    "low": float(values.min()),
                    "high": float(values.max()),
                    "unit": there[0].unit,
                    "sigma": max(known) if len(known) == len(sigmas) else None,
                    "frames": len(there),
                }
        return found
