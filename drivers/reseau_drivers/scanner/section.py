"""A section from single lines: a transducer that is carried along, its echoes side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array
from reseau.core.errors import ProtocolError
from reseau.instruments import Waveform

__all__ = ["envelope", "section"]


def envelope(volts: Array) -> Array:
    """Amplitude (n,) of an oscillation: the modulus of its analytic signal, its mean taken off."""
    count = len(volts)
    weights = np.zeros(count)
    weights[0] = 1.0
    weights[1 : (count + 1) // 2] = 2.0
    if count % 2 == 0:
        weights[count // 2] = 1.0
    amplitude: Array = np.abs(np.fft.ifft(np.fft.fft(volts - volts.mean()) * weights))
    return amplitude


def section(lines: Sequence[Waveform], full_scale_v: float) -> tuple[NDArray[np.uint8], float, float]:
    """Lines as the columns of a picture.

    Parameters
    ----------
    lines : sequence of Waveform
        Each taken at the next place; time 0 is the pulse.
    full_scale_v : float
        Amplitude that is shown as 255.

    Returns
    -------
    pixels : ndarray (samples, lines)
        From the pulse on.
    row : float
        Of the pulse: between −1 and 0.
    step_s : float
        Time from row to row.

    Raises
    ------
    ProtocolError
        When the lines are not alike, or end before the pulse.
    """
    first = lines[0]
    begin = max(0, int(np.ceil(-first.start_s / first.step_s - 1e-9)))
    for line in lines:
        same = len(line.volts) == len(first.volts) and np.allclose(
            (line.start_s, line.step_s), (first.start_s, first.step_s), rtol=1e-6, atol=1e-12
        )
        if not same:
            raise ProtocolError("its digitiser changed the time base within a section")
    if len(first.volts) - begin < 2:
        raise ProtocolError("its digitiser shows nothing behind the pulse", do="move the trigger")
    amplitudes = np.column_stack([envelope(line.volts)[begin:] for line in lines])
    pixels = np.clip(np.rint(255 * amplitudes / full_scale_v), 0, 255).astype(np.uint8)
    return pixels, -(first.start_s / first.step_s + begin), first.step_s
