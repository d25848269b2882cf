"""Curves between grey values and light: a power, that of sRGB, or a table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ToneCurve:
    """Light as a function of grey values, both relative to their largest values.

    Parameters
    ----------
    exponent : float or None
        Exponent of a power; None for the curve of sRGB (IEC 61966-2-1), or of a table.
    table : tuple of float
        Light, 0 to 1, at equally spaced grey values from 0 to full scale; linear in between.
    source : str
        Where the curve comes from, in words: "colour profile 'Display P3'".

    Examples
    --------
    >>> ToneCurve(2.0).light(np.array([0.0, 127.5, 255.0]), 255.0).tolist()
    [0.0, 63.75, 255.0]
    >>> ToneCurve(None, (0.0, 0.2, 1.0)).light(np.array([0.25, 0.5]), 1.0).tolist()
    [0.1, 0.2]
    """

    exponent: float | None
    table: tuple[float, ...] = ()
    source: str = ""

    def light(self, grey: NDArray[Any], full_scale: float) -> NDArray[Any]:
        """Light in the scale of the grey values, and of their type."""
        part = np.clip(grey / full_scale, 0.0, None)
        light: Any
        if self.table:
            light = np.interp(part, np.linspace(0.0, 1.0, len(self.table)), self.table)
        elif self.exponent is not None:
            light = part**self.exponent
        else:
            light = np.where(part > 0.04045, ((part + 0.055) / 1.055) ** 2.4, part / 12.92)
        return np.asarray(light * full_scale, dtype=grey.dtype)

    def grey(self, light: NDArray[Any]) -> NDArray[Any]:
        """Grey values of light, both relative to their largest values, of which none is exceeded.

        Examples
        --------
        >>> ToneCurve(2.0).grey(np.array([0.0, 0.25, 1.1])).tolist()
        [0.0, 0.5, 1.0]
        """
        part, grey = np.clip(light, 0.0, 1.0), np.asarray(light)
        if self.table:
            grey = np.interp(part, self.table, np.linspace(0.0, 1.0, len(self.table)))
        elif self.exponent is not None:
            grey = part if self.exponent == 1 else part ** (1 / self.exponent)
        else:
            grey = np.where(part > 0.04045 / 12.92, 1.055 * part ** (1 / 2.4) - 0.055, part * 12.92)
        return np.asarray(grey)

    @property
    def linear(self) -> bool:
        """Whether grey values are proportional to the light, to a hundredth of full scale."""
        grey = np.linspace(0.0, 1.0, 65)
        return bool(np.abs(self.light(grey, 1.0) - grey).max() < 0.01)

    def __str__(self) -> str:
        if self.table:
            return "a table"
        return "that of sRGB" if self.exponent is None else f"a power of {1 / self.exponent:.2f}"
