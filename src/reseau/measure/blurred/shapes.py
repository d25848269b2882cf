"""Images by rays as a shape of the matcher."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...core.data import Array, Rows
from ...core.errors import UsageError
from ...optics.formation import Outline
from ...optics.gridded import GriddedOutline
from ...optics.lenses import RayImage
from ..matching import Window

__all__ = ["RayShapes"]


class RayShapes:
    """Images by rays as a shape of the matcher; its parameters of form are those of the optics.

    Parameters
    ----------
    images : tuple of RayImage
    motions : tuple of Outline (p, j)
        Changes of the nodes and tangents of each image with each varied parameter; or none.
    """

    def __init__(self, images: tuple[RayImage, ...], motions: tuple[Outline, ...] = ()) -> None:
        self.images, self.motions = images, motions
        self._last: dict[int, tuple[Array, GriddedOutline]] = {}

    @property
    def parameters(self) -> int:
        """See :class:`reseau.measure.matching.Shape`."""
        return len(self.motions[0].xy) if self.motions else 0

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.Shape`."""
        found = np.full((len(at), window.rows.shape[1], window.columns.shape[1]), np.nan)
        for k, gridded, *place in self._each(xy, width, form, at, window):
            found[k] = gridded.image(*place)
        return found

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        size = window.rows.shape[1], window.columns.shape[1]
        found = np.full((len(at), 4 + self.parameters, *size), np.nan)
        for k, gridded, *place in self._each(xy, width, form, at, window):
            found[k] = gridded.derivatives(*place)
        return found[:, 0], found[:, 1:]

    def _each(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> Iterator[tuple[Any, ...]]:
        """Number, outline, place, width, columns, rows, response of each image.

        A step of an adjustment may lead to values without an image: these are left out. A width beyond the
        window is one of them; its response would need memory in proportion to it.
        """
        widest = max(window.rows.shape[1], window.columns.shape[1])
        for k, row in enumerate(at):
            if not (np.isfinite(xy[k]).all() and width[k] <= widest and np.isfinite(form[k]).all()):
                continue
            try:
                gridded = self.at(int(row), form[k])
            except UsageError:
                continue
            yield k, gridded, xy[k], float(width[k]), window.columns[k], window.rows[k], window.response

    def at(self, k: int, form: Array) -> GriddedOutline:
        """The image `k` with changed parameters of the optics."""
        image = self.images[k]
        if not self.motions:
            return image.gridded
        if k in self._last and np.array_equal(self._last[k][0], form):
            return self._last[k][1]
        nodes, motion = image.outline, self.motions[k]
        moved = Outline(
            nodes.xy + np.tensordot(form, motion.xy, 1), nodes.dxy + np.tensordot(form, motion.dxy, 1)
        )
        self._last[k] = form.copy(), GriddedOutline.of(moved, motion.xy)
        return self._last[k][1]
