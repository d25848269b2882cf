"""What an acquisition goes on for: ``sigma_c < 0.5 um``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self

from ..core.errors import UsageError

__all__ = ["Goal"]

_LENGTHS = {"mm": 1.0, "um": 1e-3, "µm": 1e-3, "nm": 1e-6}
_FORM = re.compile(r"\s*sigma_(\w+)\s*<=?\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(\S*)\s*")


@dataclass(frozen=True)
class Goal:
    """A standard deviation to be reached.

    Parameters
    ----------
    parameter : str
        Of what.
    limit : float
        In millimetres where `unit` is a length, else as it was given.
    unit : str
        ``mm``, ``px``, or nothing.

    Examples
    --------
    >>> Goal.parse("sigma_c < 0.5 um")
    Goal(parameter='c', limit=0.0005, unit='mm')
    """

    parameter: str
    limit: float
    unit: str

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a goal.

        Raises
        ------
        UsageError
            When it is none.
        """
        found = _FORM.fullmatch(text)
        if found is None or found[3] not in (*_LENGTHS, "px", "") or not 0 < float(found[2]) < 1e9:
            raise UsageError("is no goal", where=repr(text), do="write it like 'sigma_c < 0.5 um'")
        scale = _LENGTHS.get(found[3])
        if scale is None:
            return cls(found[1], float(found[2]), found[3])
        return cls(found[1], float(found[2]) * scale, "mm")

    def __str__(self) -> str:
        return f"sigma_{self.parameter} < {self.limit:g} {self.unit}".rstrip()
