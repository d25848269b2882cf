"""Images of the targets of a testfield, formed as they stand on the board and as the frame shows that."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np

from ...data import Array, Rows
from ...formats import TestfieldDesign
from ...optics import Chain
from ...optics.formation import Outline
from ...optics.targets import target_outline
from ..matching import Window
from .lattice import second_order

__all__ = ["TargetImages", "flat_outline", "form_targets", "stacked"]

_SPACING = 1.1
"""Distance of nodes on an outline in widths of the point-spread function: good to 1e-4 of the light."""


@dataclass(frozen=True, eq=False)
class TargetImages:
    """Images of unlike targets; a shape for the matcher.

    Parameters
    ----------
    nodes : Outline
        Outlines (k, j, 2) of the targets in single precision; where one has fewer nodes, the rest is nought.
    """

    nodes: Outline

    @classmethod
    def of(cls, outline: Outline) -> TargetImages:
        """Those of outlines (k, j, 2) in pixels."""
        xy, dxy = (np.asarray(nodes, dtype=np.float32) for nodes in (outline.xy, outline.dxy))
        return cls(Outline(cast(Array, xy), cast(Array, dxy)))

    @property
    def parameters(self) -> int:
        """One: all grow by a share."""
        return 1

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.refine.matching.Shape`."""
        return self._formed(xy, width, form, at, window, 1)[:, 0]

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.refine.matching.Shape`."""
        parts = self._formed(xy, width, form, at, window, 5)
        return parts[:, 0], parts[:, 1:]

    def _formed(self, xy: Array, width: Array, form: Array, at: Rows, window: Window, parts: int) -> Array:
        """Share, and what derivatives there is room for, (m, parts, r, c)."""
        from ...optics.single import formed  # takes half a second, which not every command needs

        # Reckoned from the corner of each window.
        corner = np.stack([window.columns[:, 0], window.rows[:, 0]], axis=1)
        nodes, grown = self.nodes.xy[at], (1 + form[:, :1, None]).astype(np.float32)
        images: Any = np.empty((len(at), parts, window.rows.shape[1], window.columns.shape[1]), np.float32)
        formed(
            nodes * grown + (xy - corner)[:, None].astype(np.float32),
            self.nodes.dxy[at] * grown,
            nodes,
            (window.columns - corner[:, :1]).astype(np.float32),
            (window.rows - corner[:, 1:]).astype(np.float32),
            width.astype(np.float32),
            window.response.fill,
            images,
        )
        return np.asarray(images)


@lru_cache(maxsize=256)
def flat_outline(shape: str, size: float, angle: float, spacing: float) -> Outline:
    """A target's outline in millimetres: the same for all frames, as near as the number of nodes goes."""
    return target_outline(shape, size, angle, spacing)


def form_targets(
    design: TestfieldDesign, rows: Rows, mapping: Chain, frame: Array, at: Array, psf_px: float
) -> tuple[TargetImages, Array, Array]:
    """The images of targets around the images of their centroids.

    Parameters
    ----------
    rows : ndarray of int (k,)
        Targets of the design.
    mapping : Chain
        From lattice coordinates to the image.
    frame : ndarray (2, 2)
        Lattice coordinates of a millimetre along x and y of the design, in columns.
    at : ndarray (k, 2)
        Lattice coordinates of the centroids.

    Returns
    -------
    images : TargetImages
    xy : ndarray (k, 2)
        Images of the centroids.
    reach : ndarray (k, 2)
        Half the width and half the height of each image.
    """
    value, slope, bend = second_order(mapping, at)
    # Nodes are as near to each other as they must be where a millimetre is longest in the image.
    scale = float(np.linalg.norm(slope @ frame, ord=2, axis=(1, 2)).max())
    targets = design.targets
    keys = [(targets.shape[k], targets.size[k], targets.angle[k]) for k in rows]
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    kind = np.array([number[key] for key in keys], dtype=np.intp)
    spacing = float(f"{_SPACING * psf_px / scale:.2g}")
    flat = stacked([flat_outline(*key, spacing) for key in number])
    # F(s + d) − F(s) = J d + ½ d H d and its derivative J + H d, as polynomials of each target.
    (x, y), (u, v) = (np.moveaxis(part @ frame.T, 2, 0) for part in (flat.xy, flat.dxy))
    ways = np.concatenate(
        [
            np.swapaxes(slope, 1, 2),
            np.stack([bend[..., 0, 0] / 2, bend[..., 0, 1], bend[..., 1, 1] / 2], axis=1),
        ],
        axis=1,
    ).astype(np.float32)
    xy, dxy = (
        np.stack(monomials, axis=2).astype(np.float32)[kind] @ ways
        for monomials in ((x, y, x * x, x * y, y * y), (u, v, 2 * x * u, x * v + y * u, 2 * y * v))
    )
    image = Outline(cast(Array, xy), cast(Array, dxy)).oriented()
    reach: Array = np.abs(xy).max(axis=1).astype(np.float64)
    return TargetImages.of(image), value, reach


def stacked(outlines: list[Outline]) -> Outline:
    """Single outlines as one of many (k, j, 2), the shorter ones filled up with nodes of no weight."""
    most = max(len(outline.xy) for outline in outlines)
    xy, dxy = np.zeros((2, len(outlines), most, 2))
    for k, outline in enumerate(outlines):
        xy[k, : len(outline.xy)], dxy[k, : len(outline.dxy)] = outline.xy, outline.dxy
    return Outline(xy, dxy)
