"""Exposure and gain by rule: a percentile of the grey values is brought to a share of full scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Frame
from ..core.errors import RefusedError, SettingError, UsageError
from ..instruments import Camera

_SATURATED, _DARK = 0.25, 4.0
"""Factors on the exposure where the percentile is saturated, and where it is black: no more is known then."""
_NEARER = 5
"""Attempts with a value that the camera refuses, each half way back to the last one."""
_MOST = 8
"""Largest number of frames."""


@dataclass(frozen=True)
class LightRule:
    """How bright frames are to be.

    Parameters
    ----------
    percentile : float
        Percentile of the grey values.
    share : float
        Its share of full scale.
    within : float
        Largest relative deviation from it.
    longest_us : float
        Longest exposure (µs); beyond it the gain is raised.
    most_gain : float
        Largest gain (dB), for cameras whose gain is in dB.

    Raises
    ------
    UsageError
        If a value is not possible.

    Examples
    --------
    >>> LightRule().share
    0.8
    """

    percentile: float = 99.5
    share: float = 0.8
    within: float = 0.05
    longest_us: float = 50_000.0
    most_gain: float = 12.0

    def __post_init__(self) -> None:
        if not (0 < self.percentile <= 100 and 0 < self.share < 1 and 0 < self.within < 1):
            raise UsageError(
                "is not possible", where=f"percentile {self.percentile:g} at {self.share:g} of full scale",
                do="use a percentile up to 100 and a share between 0 and 1",
            )  # fmt: skip

    def met(self, level: float) -> bool:
        """Whether a share of full scale is that of the rule."""
        return abs(level / self.share - 1) <= self.within


@dataclass(frozen=True)
class Steered:
    """What exposure and gain a rule led to.

    Parameters
    ----------
    exposure_us, gain : float
        Exposure (µs) and gain of the last frame.
    level : float
        Share of full scale that the percentile reached.
    frames : int
        Number of frames taken.
    why : str
        Why the rule could not be met; empty if it was.

    Examples
    --------
    >>> bool(Steered(5000.0, 0.0, 0.79, 3))
    True
    """

    exposure_us: float
    gain: float
    level: float
    frames: int
    why: str = ""

    def __bool__(self) -> bool:
        return not self.why


def level_of(frame: Frame, percentile: float) -> float:
    """Return a percentile of the grey values, relative to full scale.

    Examples
    --------
    >>> level_of(Frame(np.full((10, 10), 51, np.uint8), 255.0), 99.5)
    0.2
    """
    return float(np.percentile(frame.pixels, percentile)) / frame.full_scale


def next_light(rule: LightRule, level: float, exposure_us: float, gain: float) -> tuple[float, float]:
    """Return exposure (µs) and gain (dB) for the next frame; those given if the rule is met.

    The grey value is taken as proportional to the exposure, and to 10^(gain/20).

    Examples
    --------
    >>> next_light(LightRule(), 0.4, 5000.0, 0.0)
    (10000.0, 0.0)
    >>> next_light(LightRule(longest_us=5000.0), 0.4, 5000.0, 0.0)[1]
    6.02
    """
    if rule.met(level):
        return exposure_us, gain
    factor = _SATURATED if level >= 1.0 else min(rule.share / level, _DARK) if level > 0 else _DARK
    # The product of exposure and gain changes; the gain is as small as the longest exposure allows.
    light = factor * exposure_us * 10 ** (gain / 20)
    longer = min(light, rule.longest_us)
    more = 20 * float(np.log10(light / longer))
    return float(f"{longer:.6g}"), round(min(more, rule.most_gain), 2)


def steer(camera: Camera, rule: LightRule | None = None) -> Steered:
    """Set exposure and gain of a camera by a rule, with at most eight frames.

    Raises
    ------
    UsageError
        If the camera has no setting for its exposure, or does not report it.
    InstrumentError
        If the camera fails.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> steer(SimpleNamespace(name="eye", settings=SimpleNamespace(to_dict=dict)))
    Traceback (most recent call last):
        ...
    reseau.core.errors.UsageError: eye: has no setting for its exposure
    """
    rule = rule or LightRule()
    if "exposure_us" not in camera.settings.to_dict():
        raise UsageError("has no setting for its exposure", where=camera.name)
    shot = camera.expose()
    for number in range(1, _MOST + 1):
        level = level_of(shot.frame, rule.percentile)
        exposure, gain = shot.exposure_us, shot.gain if np.isfinite(shot.gain) else 0.0
        if not np.isfinite(exposure):
            raise UsageError("does not report its exposure", where=camera.name, do="set it by hand")
        if rule.met(level):
            return Steered(exposure, gain, level, number)
        wanted = next_light(rule, level, exposure, gain)
        if number == _MOST or wanted == (exposure, gain):
            break
        refusal = _set(camera, wanted, (exposure, gain), has_gain=bool(np.isfinite(shot.gain)))
        if refusal:
            return Steered(exposure, gain, level, number, f"{camera.name}: {refusal}")
        shot = camera.expose()
    reached = f"{100 * level:.0f} % of full scale at {exposure / 1000:.4g} ms and {gain:g} dB"
    what = "add light" if level < rule.share else "reduce the light"
    return Steered(exposure, gain, level, number, f"the rule is not met: {reached}: {what}")


def _set(camera: Camera, wanted: tuple[float, float], before: tuple[float, float], *, has_gain: bool) -> str:
    """Set exposure and gain, nearer to those before where they are refused; return why nothing was set."""
    (exposure, gain), (last, last_gain) = wanted, before
    refusal = ""
    for _ in range(_NEARER):
        changes = {"exposure_us": float(f"{exposure:.6g}")} | ({"gain": round(gain, 2)} if has_gain else {})
        try:
            camera.configure(changes)
            return ""
        except (RefusedError, SettingError) as error:
            refusal = error.what
        exposure, gain = float(np.sqrt(exposure * last)), (gain + last_gain) / 2
    return refusal
