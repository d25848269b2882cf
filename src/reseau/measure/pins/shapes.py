"""Forms of echoes: arcs as functions of what is unknown of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.data import Array, Rows
from ...optics import Arcs
from ..matching.shapes import Window

BOLD = 5.0
"""Bound of the logarithm of a width, for steps that an iteration tries and refuses."""
ACROSS_SIGMA = 0.5
"""Prior standard deviation of the logarithm of the width across."""


@dataclass(frozen=True)
class Form:
    """What is unknown about the form of an arc, beside its position and its width across.

    Parameters
    ----------
    sigma : mapping of str to float
        Prior standard deviations of the corrections to the start values: of the logarithm of `along`, or of
        those of the `length` of a line and the `softness` of its ends; of the sag at the width along over
        that width (`curvature`), of `tilt` (rad), and of `fading`, `tapering`, `thickening` and `saturation`,
        see :class:`reseau.optics.Arcs`. What is not named is kept at its start value.
    """

    sigma: Mapping[str, float]

    def with_(self, **sigma: float) -> Form:
        """The same form with further unknowns, or with other standard deviations."""
        return Form({**self.sigma, **sigma})

    def tightened(self, factor: float) -> Form:
        """The same form with priors that are tighter by a factor."""
        return Form({name: factor * value for name, value in self.sigma.items()})


BEAM = Form({"along": 0.5, "curvature": 0.05, "tilt": 0.3})
"""The Gaussian profile of a beam."""
LINE = Form({"length": 1.0, "softness": 1.0, "curvature": 0.15, "tilt": 0.3})
"""An even line with soft ends."""
FURTHER = {"fading": 0.5, "tapering": 0.4, "thickening": 0.2, "saturation": 2.0}
"""Deviations from these and their prior standard deviations."""
_COLUMNS = ("along", "curvature", "tilt", "flatness", *FURTHER)
"""Order of the derivatives of :class:`reseau.optics.Arcs`, after x, y and `across`."""
_ALONG, _CURVATURE, _FLATNESS = (3 + _COLUMNS.index(name) for name in ("along", "curvature", "flatness"))


@dataclass(frozen=True, eq=False)
class ArcShape:
    """Arcs as functions of the corrections that a form leaves free.

    The width of the point-spread function is that of the arc across.

    Parameters
    ----------
    start : Arcs (k,)
        Approximate arcs, with all their columns.
    free : tuple of str
        Names of the unknowns of the form.
    """

    start: Arcs
    free: tuple[str, ...]

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return len(self.free)

    def arcs(self, width: Array, form: Array, at: Rows) -> Arcs:
        """The arcs `at` with widths across (m,) and corrections (m, p)."""
        s = self.start.select(at)
        columns = {name: getattr(s, name) for name in _COLUMNS}
        values = dict(zip(self.free, form.T, strict=True))
        if "along" in values:
            columns["along"] = s.along * np.exp(np.clip(values.pop("along"), -BOLD, BOLD))
        if "curvature" in values:
            columns["curvature"] = s.curvature + values.pop("curvature") / s.along
        if "length" in values:
            half, soft = ends_of(s)
            half = half * np.exp(np.clip(values.pop("length"), -BOLD, BOLD))
            soft = soft * np.exp(np.clip(values.pop("softness"), -BOLD, BOLD))
            columns["along"] = np.sqrt(half**2 / 3 + soft**2)
            columns["flatness"] = half**2 / 3 / columns["along"] ** 2
        for name, value in values.items():
            columns[name] = columns[name] + value
        return Arcs(across=width, **columns)

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.shapes.Shape`."""
        return self.arcs(width, form, at).image(xy, window.columns, window.rows)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.shapes.Shape`."""
        arcs = self.arcs(width, form, at)
        image, parts = arcs.derivatives(xy, window.columns, window.rows)
        rows = []
        assert arcs.flatness is not None
        flat = arcs.flatness[:, None, None]
        for name in self.free:
            if name == "length":
                rows.append(flat * parts[:, _ALONG] + 2 * parts[:, _FLATNESS])
            elif name == "softness":
                rows.append((1 - flat) * parts[:, _ALONG] - 2 * parts[:, _FLATNESS])
            elif name == "curvature":
                rows.append(parts[:, _CURVATURE] / self.start.along[at, None, None])
            else:
                rows.append(parts[:, 3 + _COLUMNS.index(name)])
        return image, np.concatenate([parts[:, :3], np.stack(rows, axis=1)], axis=1)


def ends_of(arcs: Arcs) -> tuple[Array, Array]:
    """Half lengths of lines, and widths of their ends, (k,)."""
    assert arcs.flatness is not None
    return arcs.along * np.sqrt(3 * arcs.flatness), arcs.along * np.sqrt(1 - arcs.flatness)


def reach_of(arcs: Arcs) -> Array:
    """Root mean square distance from the middle of the light that tells an arc's place along it, (k,).

    With the light I along the arc, it is the root of ∫u²I'²du / ∫I'²du.
    """
    half, soft = ends_of(arcs)
    ratio = (half / np.maximum(soft, 1e-12)) ** 2
    # h²/(1 − exp(−h²/s²)), which is s² for h = 0
    apart = soft**2 * np.where(ratio > 1e-9, ratio / -np.expm1(-np.maximum(ratio, 1e-9)), 1.0)
    return np.asarray(np.sqrt(apart + soft**2 / 2))


def lines_with(half: Array, soft: Array, arcs: Arcs) -> Arcs:
    """The arcs as lines of half lengths (k,) with ends of widths (k,)."""
    along = np.sqrt(half**2 / 3 + soft**2)
    return replace(arcs, along=along, flatness=half**2 / 3 / along**2)
