"""Curves between light and grey values: taken from the file, or estimated from the edges of marks.

Phones and webcams write grey values that are not proportional to the light (sRGB, or a power). At the edges
of marks, pixels are mixtures of dark and bright light. A curve, grey = F (light / F)^(1/γ), makes such an
edge steeper on its dark side than on its bright side. No blur does that: what is left in the windows of marks
that were matched with images linear in the light determines γ.

Many programs tag files as sRGB whatever they contain. The curve that a file states is used unless a straight
line fits the marks better, or what is left shows another curve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Mask
from ..core.failure import Code, Remark
from ..core.tone import ToneCurve
from .response import Samples, unexplained

_LEAST_GAIN, _STRONG = 0.995, 0.9
"""Ratios of mean square residuals below which a curve matters, and is beyond doubt."""
_CERTAIN, _CORRELATED = 6.0, 0.12
"""Least significance of a curve; correlation of residuals from which they have another cause."""
_USUAL, _KNOWN = 2.2, 0.1
"""Exponent of most cameras; its standard deviation up to which one that agrees with it is no accident."""
_LINEAR = 0.15
"""Deviation of an exponent from 1 that does no harm."""
_ATTEMPTS = 6
"""Iterations of the exponent."""
_SETTLED, _SHRINKS = 0.01, 0.7
"""Change of the exponent from which it is not iterated; ratio of the last two from which it drifts."""
_LEAST, _MOST = 0.35, 3.5
"""Exponents that cameras have."""
_LIKE_SRGB = 0.5
"""Deviation of an exponent from 2.2 within which the curve of sRGB is tried, too."""
_BROUGHT = 0.5
"""Share of the decrease of residuals that the first estimate predicts, which a curve must bring; what a curve
leaves of the residuals of compression is by chance."""
_DOUBTFUL = 1.03
"""Ratio of the residuals with the curve that the file states to those with a straight line up to which marks
do not contradict the file; in strongly compressed pictures they do not tell."""
_STRAIGHT = ToneCurve(1.0)

Matched = Callable[[ToneCurve], "tuple[Samples, Array] | None"]
"""Marks matched in grey values linearised with a curve, and their images (k, r, c) as adjusted; None if they
cannot be matched."""


@dataclass(frozen=True)
class Exponent:
    """Exponent of a tone curve, grey = F (light / F)^(1/γ), estimated from the residuals of marks.

    Parameters
    ----------
    gamma : float
        The exponent γ.
    sigma : float
        Its standard deviation, from the scatter of the marks.
    gain : float
        Mean square of the residuals with the exponent over that before.
    correlation : float
        Largest correlation of the residuals of neighbouring pixels that remains.

    Examples
    --------
    >>> Exponent(1.6, 0.04, 0.97, 0.02).certain, Exponent(1.6, 0.04, 0.97, 0.25).certain
    (True, False)
    >>> Exponent(2.2, 0.04, 0.97, 0.25).certain  # one that cameras have
    True
    """

    gamma: float
    sigma: float
    gain: float
    correlation: float

    @property
    def certain(self) -> bool:
        """Whether there is a curve; correlated residuals, as of compression, can look like a weak one."""
        significant = self.gain < _LEAST_GAIN and abs(self.gamma - 1) > _CERTAIN * self.sigma
        usual = abs(self.gamma - _USUAL) < 3 * self.sigma and self.sigma < _KNOWN
        return significant and (self.gain < _STRONG or self.correlation < _CORRELATED or usual)


@dataclass(frozen=True)
class FoundCurve:
    """The curve of a frame, and how it was found; truthy if grey values are to be linearised.

    Parameters
    ----------
    curve : ToneCurve or None
        The curve; None if grey values are proportional to the light.
    sigma : float or None
        Standard deviation of its exponent, if that was estimated.
    stated : str
        What the file states, if this is not used.

    Examples
    --------
    >>> FoundCurve(ToneCurve(None, source="sRGB tag")).remark("disks").text[-24:]
    "with the file's sRGB tag"
    >>> bool(FoundCurve(None)), FoundCurve(None).remark("disks")
    (False, None)
    """

    curve: ToneCurve | None
    sigma: float | None = None
    stated: str = ""

    def __bool__(self) -> bool:
        return self.curve is not None

    def remark(self, marks: str) -> Remark | None:
        """What a user should know; None if the file states nothing and nothing was found."""
        if self.curve is not None and self.curve.source:
            text = "grey values are not proportional to the light; they were linearised with the file's "
            return Remark(text + self.curve.source, Code.NONLINEAR)
        other = f"; the file's {self.stated} does not describe them" if self.stated else ""
        if self.curve is None:
            text = f"grey values are proportional to the light{other}"
            return Remark(text, Code.NONLINEAR) if other else None
        curve = str(self.curve)
        if self.sigma is not None and self.curve.exponent is not None:
            spread = self.sigma / self.curve.exponent**2
            digits = 2 if spread >= 0.005 else 3
            curve = f"a power of {1 / self.curve.exponent:.{digits}f} (± {spread:.{digits}f})"
        text = (
            "grey values are not proportional to the light; they were linearised with a curve estimated from "
            f"the edges of {marks}, {curve}{other}"
        )
        return Remark(text, Code.NONLINEAR)


def find_curve(
    matched: Matched,
    full_scale: float,
    stated: ToneCurve | None,
    *,
    suspected: bool = True,
    beside: float = 1.0,
) -> FoundCurve:
    """Find the curve between light and grey values of a frame.

    Parameters
    ----------
    matched : callable
        Matches marks in linearised grey values.
    full_scale : float
        Grey value at which the sensor saturates.
    stated : ToneCurve, optional
        The curve that the file states.
    suspected : bool
        Whether to search for a curve where the file states none.
    beside : float
        Ratio of mean square residuals that another explanation leaves: a curve is searched for if it leaves
        less.

    Notes
    -----
    Curves are compared by the residuals of marks in grey values as they are in the file, where noise is alike
    for all curves. The exponent is estimated by Gauss–Newton steps, :func:`estimate_gamma`.
    """
    if stated is None and not suspected:
        return FoundCurve(None)
    straight = matched(_STRAIGHT)
    if straight is None:
        return FoundCurve(None)
    unused = "" if stated is None else stated.source
    best, its_own, at = FoundCurve(None, stated=unused), _STRAIGHT, straight
    given = None if stated is None else matched(stated)
    if stated is not None and given is not None:
        with_it, without = (_misfit(*one, full_scale) for one in ((stated, given), (_STRAIGHT, straight)))
        if with_it < _DOUBTFUL * without:
            best, its_own, at = FoundCurve(stated), stated, given
    rest = estimate_gamma(*at, 1.0, full_scale)
    if not rest.certain or abs(rest.gamma - 1) < _LINEAR or not rest.gain < beside:
        return best
    least = _misfit(its_own, at, full_scale) * (1 - _BROUGHT * (1 - np.sqrt(rest.gain)))
    power = _estimated(matched, rest if at is straight else None, straight, full_scale)
    if power is None:
        return best
    gamma, sigma, there = power
    tried: list[tuple[FoundCurve, tuple[Samples, Array] | None]]
    tried = [(FoundCurve(ToneCurve(gamma), sigma, unused), there)]
    if abs(gamma - 2.2) < _LIKE_SRGB:
        tried.append((FoundCurve(ToneCurve(None), None, unused), matched(ToneCurve(None))))
    for found, its in tried:
        if its is not None and (misfit := _misfit(found.curve or _STRAIGHT, its, full_scale)) < least:
            best, least = found, misfit
    return best


def _misfit(curve: ToneCurve, at: tuple[Samples, Array], full_scale: float) -> float:
    """Usual residuals of marks in grey values as they are in the file, as a share of full scale."""
    samples, formed = at
    both = (curve.grey(values / full_scale) for values in (formed, samples.grey))
    off = np.where(samples.used, np.subtract(*both), 0.0)
    square = (off**2).sum(axis=(1, 2)) / np.maximum(samples.used.sum(axis=(1, 2)), 1)
    return float(np.median(np.sqrt(square)))


def _estimated(
    matched: Matched, first: Exponent | None, at: tuple[Samples, Array], full_scale: float
) -> tuple[float, float, tuple[Samples, Array]] | None:
    """Exponent with its standard deviation, and the marks matched with it; None if cameras have no such, or
    it does not settle.

    `first` is the exponent estimated `at` marks matched in grey values as they are.
    """
    gamma, change = 1.0, [np.inf, np.inf]
    for attempt in range(_ATTEMPTS):
        found = first if first and not attempt else estimate_gamma(*at, gamma, full_scale)
        if attempt and abs(found.gamma - gamma) < max(found.sigma, _SETTLED):
            break
        before, gamma = gamma, float(np.clip(found.gamma, 0.3, 4.0))
        change = [change[1], abs(gamma - before)]
        again = matched(ToneCurve(gamma))
        if again is None:
            return None
        at = again
    else:
        # The exponent of a camera settles; that of correlated residuals, as of compression, drifts.
        if change[1] > _SHRINKS * change[0]:
            return None
    usable = _LEAST < gamma < _MOST and abs(gamma - 1) > _LINEAR
    return (gamma, found.sigma, at) if usable else None


def estimate_gamma(samples: Samples, formed: Array, gamma: float, full_scale: float) -> Exponent:
    """Correct the exponent of a tone curve by the residuals of marks in linearised grey values.

    Parameters
    ----------
    samples : Samples
        Marks that were matched in grey values linearised with `gamma`.
    formed : ndarray (k, r, c)
        Their images as adjusted, with whatever else was formed in their windows.
    gamma : float
        The exponent so far; 1 at first.
    full_scale : float
        Grey value at which the sensor saturates.

    Returns
    -------
    Exponent
        The corrected exponent.

    Examples
    --------
    >>> from reseau.measure.matching.shapes import GrownOutline, Window
    >>> from reseau.optics.formation import Outline, PixelResponse
    >>> disk = Outline.circle(4.0, 0.5)
    >>> plain = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> window = Window(np.arange(25.0)[None], np.arange(25.0)[None], PixelResponse())
    >>> place = np.array([[12.2, 11.9]]), np.full(1, 0.8), np.zeros((1, 0)), np.array([0]), window
    >>> light = 200 - 150 * plain.image(*place)
    >>> grey = 255 * (light / 255) ** (1 / 1.2) + np.random.default_rng(0).normal(0, 0.1, (1, 25, 25))
    >>> one = Samples(plain, *place[:3], np.array([-150.0]), window, grey, grey > 0)
    >>> adjusted = np.polyval(np.polyfit(light.ravel(), grey.ravel(), 1), light)
    >>> curve = estimate_gamma(one, adjusted, 1.0, 255.0)
    >>> bool(abs(curve.gamma - 1.2) < 0.03), bool(curve.gain < 0.9)
    (True, True)
    """
    k = len(samples.xy)
    every = np.arange(k)
    share, slopes = samples.shape.derivatives(samples.xy, samples.psf_px, samples.form, every, samples.window)
    light = np.clip(np.where(samples.used, formed, full_scale) / full_scale, 1e-3, None)
    coded = light ** (1 / gamma)
    # The noise is that of the coded grey values: its slope weights the light.
    weight = np.where(samples.used, light ** (1 / gamma - 1), 0.0).reshape(k, -1)
    change = full_scale * light * np.log(coded)
    both = np.where(samples.used[:, None], np.stack([samples.grey - formed, change], axis=1), 0.0)
    left = unexplained(both.reshape(k, 2, -1), samples.basis(share, slopes), weight)
    observed, change = left[:, 0], left[:, 1]
    square = float((change**2).sum())
    step = -float((change * observed).sum()) / max(square, 1e-300)
    rest = observed + step * change
    # Residuals of a window may be correlated, those of different windows are not (White's estimator).
    scores = (change * rest).sum(axis=1)
    sigma = np.sqrt(k / max(k - 1, 1) * float((scores**2).sum())) / max(square, 1e-300)
    before, after = float((observed**2).sum()), float((rest**2).sum())
    correlation = _correlation(rest.reshape(samples.grey.shape), samples.used)
    return Exponent(gamma + step, float(sigma), after / max(before, 1e-300), correlation)


def _displaced(values: NDArray[Any], down: int, right: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Two views of windows (..., rows, columns), the second displaced against the first.

    Examples
    --------
    >>> here, there = _displaced(np.arange(6).reshape(2, 3), 1, -1)
    >>> here.tolist(), there.tolist()
    ([[1, 2]], [[3, 4]])
    """
    rows, columns = values.shape[-2:]
    return (
        values[..., : rows - down, max(0, -right) : columns - max(0, right)],
        values[..., down:, max(0, right) : columns + min(0, right)],
    )


def _correlation(rest: Array, used: Mask) -> float:
    """Largest correlation of the residuals (k, r, c) of neighbouring pixels."""
    square = float((rest**2).sum()) / max(float(used.sum()), 1)
    found = []
    for lag in ((0, 1), (1, 0), (1, 1), (1, -1)):
        (a, b), both = _displaced(rest, *lag), np.logical_and(*_displaced(used, *lag))
        found.append(abs(float((a * b)[both].sum())) / max(float(both.sum()), 1))
    return max(found) / max(square, 1e-300)
