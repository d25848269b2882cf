"""Images by rays as a shape of the matcher."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...core.data import Array, Rows
from ...core.errors import UsageError
from ...optics.formation import Outline
from ...optics.gridded import GriddedOutline
from ...optics.lenses.images import RayImage
from ..matching.shapes import Window


class RayShapes:
    """Images by rays as a shape of the matcher; its parameters of form are those of the optics.

    Parameters
    ----------
    images : tuple of RayImage
    motions : tuple of Outline (p, j)
        Changes of the nodes and tangents of each image with each varied parameter; or none.
    bright : bool
        Whether the light of the targets falls off as that of an even ground; what a dark target takes is a
        share of that light.
    """

    def __init__(
        self, images: tuple[RayImage, ...], motions: tuple[Outline, ...] = (), *, bright: bool = False
    ) -> None:
        self.images, self.motions, self.bright = images, motions, bright
        self._last: dict[int, tuple[Array, tuple[GriddedOutline, ...]]] = {}

    @property
    def parameters(self) -> int:
        """See :class:`reseau.measure.matching.Shape`."""
        return len(self.motions[0].xy) if self.motions else 0

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.Shape`."""
        found = np.full((len(at), window.rows.shape[1], window.columns.shape[1]), np.nan)
        for k, image, parts, where in self._each(xy, width, form, at, window):
            found[k] = image.formed(*where, bright=self.bright, parts=parts)
        return found

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        size = window.rows.shape[1], window.columns.shape[1]
        found = np.full((len(at), 4 + self.parameters, *size), np.nan)
        for k, image, parts, where in self._each(xy, width, form, at, window):
            found[k] = image.formed(*where, bright=self.bright, derivatives=True, parts=parts)
        return found[:, 0], found[:, 1:]

    def _each(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> Iterator[tuple[int, RayImage, tuple[GriddedOutline, ...], Any]]:
        """Number, image and its parts, and place, width, columns, rows, response of each image.

        A step of an adjustment may lead to values without an image: these are left out. A width beyond the
        window is one of them; its response would need memory in proportion to it.
        """
        widest = max(window.rows.shape[1], window.columns.shape[1])
        for k, row in enumerate(at):
            if not (np.isfinite(xy[k]).all() and width[k] <= widest and np.isfinite(form[k]).all()):
                continue
            try:
                parts = self.at(int(row), form[k])
            except UsageError:
                continue
            where = xy[k], float(width[k]), window.columns[k], window.rows[k], window.response
            yield k, self.images[row], parts, where

    def at(self, k: int, form: Array) -> tuple[GriddedOutline, ...]:
        """The image `k` with changed parameters of the optics, and its changes by pixel along x and y."""
        image = self.images[k]
        if not self.motions:
            return image.gridded
        if k in self._last and np.array_equal(self._last[k][0], form):
            return self._last[k][1]
        nodes, motion = image.outline, self.motions[k]
        xy, by = nodes.xy + np.tensordot(form, motion.xy, 1), np.tensordot(form, motion.dxy, 1)
        parts = tuple(
            GriddedOutline.of(Outline(xy, dxy), motion.xy) for dxy in (nodes.dxy + by, *image.uneven)
        )
        self._last[k] = form.copy(), parts
        return parts
