"""Curves between light and grey values: recognised in the images of targets, and undone.

Phones and webcams write grey values that are not proportional to the light (sRGB, IEC 61966-2-1, or a power).
At the edges of targets, pixels are mixtures of dark and bright light. A curve makes them brighter, so that
dark targets seem smaller than designed. Where they do, the curve is estimated: it is the one with which the
formed images fit best, if the residuals are clearly smaller than without a curve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["SHRUNK", "ToneCurve", "best_curve"]

SHRUNK = 0.015
"""Apparent shrinking of dark targets (of bright ones growth) from which a curve is searched for."""
_EXPONENTS = (1.0, 1.4, 1.8, 2.2, 2.6)
_WELL = 0.8
"""The residuals must fall below this multiple of those without a curve."""


@dataclass(frozen=True)
class ToneCurve:
    """Light as a function of grey values, both relative to their largest values.

    Parameters
    ----------
    exponent : float or None
        Exponent of a power; None for the curve of sRGB.

    Examples
    --------
    >>> ToneCurve(2.0).light(np.array([0.0, 127.5, 255.0]), 255.0).tolist()
    [0.0, 63.75, 255.0]
    """

    exponent: float | None

    def light(self, grey: NDArray[Any], full_scale: float) -> NDArray[Any]:
        """Light in the scale of the grey values."""
        part = np.clip(grey / full_scale, 0.0, None)
        if self.exponent is not None:
            light = part**self.exponent
        else:
            light = np.where(part > 0.04045, ((part + 0.055) / 1.055) ** 2.4, part / 12.92)
        return np.asarray(light * full_scale, dtype=grey.dtype)

    def __str__(self) -> str:
        return "that of sRGB" if self.exponent is None else f"a power of {1 / self.exponent:.2f}"


def best_curve(misfit: Callable[[ToneCurve], float]) -> ToneCurve | None:
    """The curve with the smallest misfit; None if none is clearly better than a straight line.

    Parameters
    ----------
    misfit : callable
        Usual residuals, relative to the contrast, of images formed with a curve.
    """
    tried = {exponent: misfit(ToneCurve(exponent)) for exponent in _EXPONENTS}
    best = min(tried, key=tried.__getitem__)
    place = min(max(_EXPONENTS.index(best), 1), len(_EXPONENTS) - 2)
    three = np.array(_EXPONENTS[place - 1 : place + 2])
    # Squares of the residuals are nearly a parabola.
    a, b, _ = np.polyfit(three, [tried[e] ** 2 for e in three], 2)
    curves = [ToneCurve(None), ToneCurve(best)]
    if a > 0:
        curves.append(ToneCurve(round(float(np.clip(-b / (2 * a), three[0], three[2])), 2)))
    values = [misfit(curve) for curve in curves]
    chosen = int(np.argmin(values))
    return curves[chosen] if values[chosen] < _WELL * tried[1.0] else None
