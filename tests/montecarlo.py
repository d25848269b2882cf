"""Two tiers: at each commit a case of each kind, and draws that show a factor of 1.3; all in `make slow`."""

from __future__ import annotations

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet

_SHOWN = 1 - 1 / 1.3**2
"""What a mean square of normalised errors lacks when sigma is 1.3 times too large."""
_BOUND = 3.5
"""Standard deviations within which a mean square must lie."""


def draws(few: int, every: int) -> pytest.MarkDecorator:
    """Run a test with few draws, and as a slow one with every draw: its parameter `runs`."""
    return pytest.mark.parametrize("runs", [few, pytest.param(every, marks=pytest.mark.slow)])


def slowly(*cases: object) -> list[ParameterSet]:
    """Cases for `make slow`: they repeat in kind what others show."""
    each = (case if isinstance(case, tuple) else (case,) for case in cases)
    return [pytest.param(*case, marks=pytest.mark.slow) for case in each]


def tolerance(degrees: float) -> float:
    """Tolerance of a mean square with expectation 1, from its degrees of freedom, which must be enough.

    Examples
    --------
    >>> round(tolerance(200), 2)
    0.35
    """
    found = float(_BOUND * np.sqrt(2 / degrees))
    assert found < _SHOWN, f"{degrees:.0f} degrees of freedom do not show a factor of 1.3"
    return found
