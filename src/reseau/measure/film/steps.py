r"""The form of a step from film to picture: how optics, pixels and processing of the scanner spread it.

A step that is wider than a pixel is the integral of a Gaussian. In a sharp one the form of the pixel is seen,
and what was done on the grid of the pixels afterwards: smoothing or sharpening with the neighbours. Across
the edge, at the distance t, with half the side 2h of a pixel, the width σ of the optics, and the share a of
either neighbour (negative after sharpening):

.. math::
    E(t) = (1 - 2a)\,B(t) + a\,B(t - 2h) + a\,B(t + 2h), \qquad
    B(t) = \frac{\sigma}{2h}\Bigl[I\Bigl(\frac{t + h}{\sigma}\Bigr) - I\Bigl(\frac{t - h}{\sigma}\Bigr)\Bigr],
    \quad I(u) = u\,\Phi(u) + \varphi(u) .

Its variance is w² = σ² + h²/3 + 8ah². A model without the pixels is displaced from one phase of the edge on
the grid to the next, by up to 0.1 px, and neighbouring profiles alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from ...core.data import Array, Rows
from ...core.tone import ToneCurve

SHIFTS = (3.0,)
"""Distances behind the edge, in widths of the step, at which the tone of the picture may change."""
_FORMED = 1.3
"""Width in pixels from which the pixels are no longer seen in a step."""
_LEAST_VARIANCE = 0.01
"""Softening of the limit of σ² at zero, square pixels."""
_ROOT = float(np.sqrt(2 * np.pi))


_LEAST_LIGHT = 1e-4
"""Least light, as a share of full scale, so that noise about zero has a grey value."""
SRGB = 2.4, 0.055
"""Exponent of the curve of sRGB above its linear part, and the grey value that is added before."""
_POWER = 0.01
"""The same for powers."""
_WITHIN = 1e-3, 1 - 1e-3
"""Range of the share of light at the half of a step."""


@dataclass(frozen=True)
class Tone:
    """Curve between light, which a scanner spreads, and grey values times the polarity.

    Parameters
    ----------
    gamma : float
        Light is the grey value to the power of this; 1: proportional.
    added : float
        Grey value, as a share of full scale, that is added before.
    scale : float
        Grey value of full scale.
    polarity : int
        1 if film is darker than the picture, −1 if brighter.
    """

    gamma: float = 1.0
    added: float = _POWER
    scale: float = 1.0
    polarity: int = 1

    @classmethod
    def of_file(cls, curve: ToneCurve | None, full_scale: float, polarity: int) -> Tone:
        """The curve that a file states; a table is replaced by the power that agrees at its middle."""
        if curve is None or curve.linear:
            return STRAIGHT
        if curve.exponent is None and not curve.table:
            return cls(*SRGB, full_scale, polarity)
        middle = float(curve.light(np.array([0.5]), 1.0)[0])
        exponent = curve.exponent or float(np.log(max(middle, 1e-3)) / np.log(0.5))
        return cls(exponent, _POWER, full_scale, polarity)

    @property
    def linear(self) -> bool:
        """Whether grey values are proportional to the light."""
        return self.gamma == 1.0

    def _part(self, grey: Array) -> Array:
        least = _LEAST_LIGHT ** (1 / self.gamma)
        return np.asarray(
            np.maximum((self.polarity * grey / self.scale + self.added) / (1 + self.added), least)
        )

    def light(self, grey: Array) -> Array:
        """Light in the scale of grey values."""
        return np.asarray(self.polarity * self.scale * self._part(grey) ** self.gamma)

    def slope(self, grey: Array) -> Array:
        """Derivative of the light by the grey value."""
        return np.asarray(self.gamma / (1 + self.added) * self._part(grey) ** (self.gamma - 1))

    def grey(self, light: Array) -> Array:
        """Grey values of light."""
        part = np.maximum(self.polarity * light / self.scale, _LEAST_LIGHT) ** (1 / self.gamma)
        return np.asarray(self.polarity * self.scale * ((1 + self.added) * part - self.added))

    def displaced(self, level: Array, contrast: Array) -> tuple[Array, Array]:
        """How far inwards the half of a step is displaced, and the width it shows, in widths of the light."""
        low, middle, high = (self.light(level + part * contrast) for part in (0.0, 0.5, 1.0))
        rise = np.maximum(high - low, 1e-9)
        away = scipy.special.ndtri(np.clip((middle - low) / rise, *_WITHIN))
        shown = contrast * self.slope(level + contrast / 2) / rise * np.exp(away**2 / 2)
        return np.asarray(away), np.asarray(shown)


STRAIGHT = Tone()
"""Grey values that are proportional to the light."""


@dataclass(frozen=True)
class Developed:
    """A blur that the film itself has developed, by the penumbra of the gate or halation.

    It acts on the exposure E. Film has the density 3 / (1 + E^1.6) as a slide, darker than the picture, or
    2 / (1 + E^−0.95) as a negative: typical curves, of which the unit of E cancels.

    Parameters
    ----------
    share : float
        Width of this blur, in those of the step.
    scale, polarity
        As of :class:`Tone`.
    """

    share: float
    scale: float
    polarity: int

    def displaced(self, level: Array, contrast: Array) -> tuple[Array, Array]:
        """See :meth:`Tone.displaced`."""
        half, whole = (self._exposure(level, part * contrast) for part in (0.5, 1.0))
        away = scipy.special.ndtri(np.clip(half / whole, *_WITHIN))
        return np.asarray(self.share * away), np.ones_like(away)

    def _exposure(self, level: Array, contrast: Array) -> Array:
        """Exposure of a picture, but for its unit."""
        through = contrast / self.scale if self.polarity > 0 else 1 - contrast / np.abs(level)
        density = -np.log10(np.clip(through, 2e-3, 0.98))
        if self.polarity > 0:
            return np.asarray(np.maximum(3.0 / density - 1, 1e-3) ** (1 / 1.6))
        return np.asarray(np.maximum(2.0 / density - 1, 1e-3) ** (-1 / 0.95))


class StepForm(NamedTuple):
    """Form of the steps of an edge.

    Parameters
    ----------
    width : float
        Width w, one sigma, pixels.
    lobes : float
        Share a of either neighbouring pixel.
    half : float
        Half the side of a pixel across the edge, h.
    weight : float
        Inverse variance of the lobes; zero if they were not estimated.
    tone : Tone
        Curve between light, which is spread, and grey values.
    """

    width: float
    lobes: float = 0.0
    half: float = 0.5
    weight: float = 0.0
    tone: Tone = STRAIGHT

    @property
    def gaussian(self) -> bool:
        """Whether the pixels are not seen in the step."""
        return self.width > _FORMED


def profile_function(distance: Array, form: StepForm | None = None) -> Any:
    """Model of a profile and its derivatives for :func:`adjust_batch`.

    Parameters
    ----------
    distance : ndarray (k, n)
        Distances of the pixels of k profiles.
    form : StepForm, optional
        Form of the step; Gaussian without it.

    Returns
    -------
    callable
        Function of the parameters p, b, log w, A and the c, and of a if there is one column more.
    """
    linear = _linear(distance, form)
    if form is None or form.tone.linear:
        return linear
    tone = form.tone

    def function(x: Array, rows: Rows) -> tuple[Array, Array]:
        grey = np.cumsum(x[:, [1, 3, 4]], axis=1)
        light, slope = tone.light(grey), tone.slope(grey)
        inner = x.copy()
        inner[:, 1], inner[:, 3:5] = light[:, 0], np.diff(light, axis=1)
        value, jacobian = linear(inner, rows)
        first, second = jacobian[..., 3].copy(), jacobian[..., 4].copy()
        # Each grey level is that of film and the steps up to it.
        s0, s1, s2 = (slope[:, k, None] for k in range(3))
        jacobian[..., 4] = s2 * second
        jacobian[..., 3] = s1 * (first - second) + jacobian[..., 4]
        jacobian[..., 1] = s0 * (1 - first) + jacobian[..., 3]
        grey_of = tone.grey(value)
        return grey_of, jacobian / tone.slope(grey_of)[..., None]

    return function


def _linear(distance: Array, form: StepForm | None) -> Any:
    """The model in light."""
    shifts = np.array([0.0, *SHIFTS])
    plain = form is None or form.gaussian

    def function(x: Array, rows: Rows) -> tuple[Array, Array]:
        last = 3 + len(shifts)
        p, b, w, steps = x[:, 0, None], x[:, 1, None], np.exp(x[:, 2, None]), x[:, None, 3:last]
        away = distance[rows] - p
        first = 0 if plain else 1
        u = (away / w)[:, :, None] - shifts[first:]
        phi, bell = scipy.special.ndtr(u), np.exp(-0.5 * u * u) / _ROOT
        height = steps[..., first:]
        jacobian = np.empty((*away.shape, x.shape[1]))
        jacobian[..., 0] = -(height * bell).sum(axis=2) / w
        jacobian[..., 1] = 1.0
        # The further steps move with the width; u + shift is their position without it.
        jacobian[..., 2] = -(height * bell * (u + shifts[first:])).sum(axis=2)
        jacobian[..., 3 + first : last] = phi
        value = b + (height * phi).sum(axis=2)
        lobed = x.shape[1] > last
        if not plain:
            assert form is not None
            lobes = x[:, last, None] if lobed else np.full((len(x), 1), form.lobes)
            step, along, by_width, by_lobes = _formed(away, w, lobes, form.half)
            top = steps[..., 0]
            value = value + top * step
            jacobian[..., 0] -= top * along
            jacobian[..., 2] += top * by_width
            jacobian[..., 3] = step
            if lobed:
                jacobian[..., last] = top * by_lobes
        elif lobed:
            jacobian[..., last] = 0.0
        return value, jacobian

    return function


def _formed(t: Array, w: Array, a: Array, h: float) -> tuple[Array, Array, Array, Array]:
    """The step E, and its derivatives by t, log w and a, at distances t (k, n); w and a are (k, 1)."""
    variance = w**2 - h**2 / 3 - 8 * a * h**2
    root = np.sqrt(variance**2 + 4 * _LEAST_VARIANCE**2)
    sigma, soft = np.sqrt((variance + root) / 2), (1 + variance / root) / 2
    u = (t[..., None] + h * np.array([-3.0, -1.0, 1.0, 3.0])) / sigma[..., None]
    phi, bell = scipy.special.ndtr(u), np.exp(-0.5 * u * u) / _ROOT
    integral = sigma[..., None] * (u * phi + bell)
    share = np.concatenate([-a, 3 * a - 1, 1 - 3 * a, a], axis=1)[:, None, :] / (2 * h)
    step, along, by_sigma = ((part * share).sum(axis=2) for part in (integral, phi, bell))
    by_lobes = integral @ (np.array([-1.0, 3.0, -3.0, 1.0]) / (2 * h)) - by_sigma * 4 * h**2 * soft / sigma
    return step, along, by_sigma * w**2 * soft / sigma, by_lobes
