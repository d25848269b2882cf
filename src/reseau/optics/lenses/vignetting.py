r"""The part of the stop that the other apertures leave open, seen from points of the object.

Apertures cut the stop with sharp edges, which move across it from one point of the object to the next.
Elements of the whole stop, each of which an aperture stops or not, converge slowly to the light of such a
point, and an element that is open for a part of a target only forms the image of another target. Elements are
therefore those of the open part: along each direction in the stop it reaches from an inner to an outer
radius, between which the elements are distributed as in the whole stop. So each of them is open for all of a
target, and moves with the edges.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Mask
from .prescription import Aperture, Prescription
from .pupils import Aiming
from .trace import Tracer

_DEGREE = 8
"""Of the polynomials of where rays pass an aperture, by where they pass the stop."""
_RADII = 9
"""Places along a radius of the stop at which edges of apertures are looked for."""
_STEPS = 12
"""Bisections towards such an edge."""
_POWERS = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]


def _nodes() -> Array:
    """Points (n, 2) of the stop from which polynomials are fitted: rings, dense at the rim."""
    found = [np.zeros((1, 2))]
    for k in range(6):
        count = 8 + 3 * (5 - k)
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
        found.append(np.cos(np.pi * k / 12) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(found)


_NODES = _nodes()
_DESIGN = np.stack([_NODES[:, 0] ** i * _NODES[:, 1] ** j for i, j in _POWERS], axis=1)
_FIT = np.linalg.pinv(_DESIGN)


class Vignetting:
    """The open part of the stop of a lens at one wavelength.

    Parameters
    ----------
    lens : Prescription
    aiming : Aiming
        What aims rays at its stop, at the same wavelength.
    wavelength_nm : float, optional
        By default that of the corresponding rays.

    Examples
    --------
    A rim in front of the stop cuts it from below for points below the axis:

    >>> from dataclasses import replace
    >>> from reseau.optics.lenses import AIR, Aperture, glass, in_order
    >>> first, *rest = in_order([(0.02, 5.0, glass("N-BK7")), (-0.02, 9.0, AIR), (0.0, 40.0, AIR)])
    >>> rim = replace(first, apertures=(Aperture("circle", (5.0, 0.0)),))
    >>> lens = Prescription((rim, *rest), stop=2, stop_radius=3.0)
    >>> up_and_down = np.array([[0.0, 1.0], [0.0, -1.0]])
    >>> edges = Vignetting(lens, Aiming(lens)).edges(np.array([[0.0, -60.0, -200.0]]), up_and_down)
    >>> edges[1].round(2)
    array([[1.  , 0.16]])
    """

    def __init__(self, lens: Prescription, aiming: Aiming, wavelength_nm: float | None = None) -> None:
        self._aiming, self._tracer = aiming, Tracer(lens, wavelength_nm, apertures=False)
        self._apertures = [(k, each) for k, surface in enumerate(lens.surfaces) for each in surface.apertures]

    def edges(self, points: Array, directions: Array) -> tuple[Array, Array]:
        """Inner and outer radius (n, e) of the open part of the stop, in its radii.

        Parameters
        ----------
        points : ndarray (n, 3)
            Points of the object in the axes of the lens.
        directions : ndarray (e, 2)
            Unit vectors in the stop. Where no light passes along one, both radii are 0.
        """
        shape = len(points), len(directions)
        rays = self._aiming(np.repeat(points, len(_NODES), axis=0), np.tile(_NODES, (len(points), 1))).rays
        traced = self._tracer.trace(rays, seen=True)
        lost = (~traced.arrived).reshape(len(points), len(_NODES))
        assert traced.seen is not None
        # Of a polynomial of both coordinates of the stop, one of the radius along each direction.
        turns = np.zeros((len(_POWERS), len(directions), _DEGREE + 1))
        for term, (i, j) in enumerate(_POWERS):
            turns[term, :, i + j] = directions[:, 0] ** i * directions[:, 1] ** j
        limiting: list[Aperture] = []
        fits: list[Array] = []
        for k, aperture in self._apertures:
            at = traced.seen[k][:, :2].reshape(*lost.shape, 2)
            fit = np.tensordot(_fitted(at, lost), turns, 1).reshape(2, -1, _DEGREE + 1)
            at_rim = aperture.passes(*fit.sum(axis=2))
            if not (at_rim.all() and (lost | aperture.passes(at[..., 0], at[..., 1])).all()):
                limiting.append(aperture)
                fits.append(np.moveaxis(fit, 2, 0))
        if not limiting:
            return np.zeros(shape), np.ones(shape)
        along = np.stack(fits, axis=2)
        radii = np.linspace(0, 1, _RADII)
        opened = np.stack([_passes(limiting, along, radius) for radius in radii], axis=1)
        some = opened.any(axis=1)
        ends = opened.argmax(axis=1), _RADII - 1 - opened[:, ::-1].argmax(axis=1)
        found = []
        for edge, step, whole in zip(ends, (-1, 1), (0, _RADII - 1), strict=True):
            radius, cut = np.where(some, radii[edge], 0.0), np.flatnonzero(some & (edge != whole))
            inside, outside, those = radii[edge[cut]], radii[edge[cut] + step], along[..., cut]
            for _ in range(_STEPS):
                middle = (inside + outside) / 2
                there = _passes(limiting, those, middle)
                inside, outside = np.where(there, middle, inside), np.where(there, outside, middle)
            radius[cut] = inside
            found.append(radius.reshape(shape))
        return found[0], found[1]


def _fitted(values: Array, lost: Mask) -> Array:
    """Coefficients (2, n, t) of polynomials through points (n, nodes, 2), some of which are lost."""
    found = np.einsum("tp,npx->xnt", _FIT, np.where(lost[..., None], 0.0, values))
    for k in np.flatnonzero(lost.any(axis=1)):
        found[:, k] = np.linalg.lstsq(_DESIGN[~lost[k]], values[k, ~lost[k]], rcond=1e-6)[0].T
    return np.asarray(found)


def _passes(apertures: list[Aperture], along: Array, radius: Array) -> Mask:
    """Whether all apertures let light pass at radii (m,), by polynomials (degree, 2, a, m) of the radius."""
    at = along[-1]
    for coefficients in along[-2::-1]:
        at = at * radius + coefficients
    passed = [aperture.passes(*at[:, k]) for k, aperture in enumerate(apertures)]
    return np.asarray(np.logical_and.reduce(passed))
