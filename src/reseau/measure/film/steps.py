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

from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from ...core.data import Array, Rows

__all__ = ["SHIFTS", "StepForm", "profile_function"]

SHIFTS = (3.0,)
"""Distances behind the edge, in widths of the step, at which the tone of the picture may change."""
_FORMED = 1.3
"""Width in pixels from which the pixels are no longer seen in a step."""
_LEAST_VARIANCE = 0.01
"""Softening of the limit of σ² at zero, square pixels."""
_ROOT = float(np.sqrt(2 * np.pi))


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
    """

    width: float
    lobes: float = 0.0
    half: float = 0.5
    weight: float = 0.0

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
    shifts = np.array([0.0, *SHIFTS])
    plain = form is None or form.gaussian

    def function(x: Array, rows: Rows) -> tuple[Array, Array]:
        last = 3 + len(shifts)
        p, b, w, steps = x[:, 0, None], x[:, 1, None], np.exp(x[:, 2, None]), x[:, None, 3:last]
        away = distance[rows] - p
        first = 0 if plain else 1
        u = (away / w)[:, :, None] - shifts[first:]
        phi, bell = ndtr(u), np.exp(-0.5 * u * u) / _ROOT
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
    phi, bell = ndtr(u), np.exp(-0.5 * u * u) / _ROOT
    integral = sigma[..., None] * (u * phi + bell)
    share = np.concatenate([-a, 3 * a - 1, 1 - 3 * a, a], axis=1)[:, None, :] / (2 * h)
    step, along, by_sigma = ((part * share).sum(axis=2) for part in (integral, phi, bell))
    by_lobes = integral @ (np.array([-1.0, 3.0, -3.0, 1.0]) / (2 * h)) - by_sigma * 4 * h**2 * soft / sigma
    return step, along, by_sigma * w**2 * soft / sigma, by_lobes
