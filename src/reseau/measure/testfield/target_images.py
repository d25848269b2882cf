"""Formed images of the targets of a testfield, in the perspective of a frame."""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import numpy as np

from ...core.data import Array, Rows
from ...io import TestfieldDesign
from ...optics import Chain
from ...optics.formation import Outline
from ...optics.targets import target_outline
from ..matching import SIZE, GrownOutline
from .lattice_fit import second_order

__all__ = ["flat_outline", "form_targets", "stacked"]

_SPACING = 1.1
"""Distance of nodes on an outline in widths of the point-spread function; accurate to 1e-4 of the light."""


@lru_cache(maxsize=256)
def flat_outline(shape: str, size: float, angle: float, spacing: float) -> Outline:
    """Outline of a target in millimetres, cached by kind and spacing of the nodes."""
    return target_outline(shape, size, angle, spacing)


def form_targets(
    design: TestfieldDesign, rows: Rows, mapping: Chain, frame: Array, at: Array, psf_px: float
) -> tuple[GrownOutline, Array, Array]:
    """Images of targets around the images of their centroids.

    Parameters
    ----------
    rows : ndarray of int (k,)
        Indices of targets of the design.
    mapping : Chain
        From lattice coordinates to the image.
    frame : ndarray (2, 2)
        Lattice coordinates of one millimetre along x and y of the design, in columns.
    at : ndarray (k, 2)
        Lattice coordinates of the centroids.

    Returns
    -------
    images : GrownOutline
        Shapes with a common parameter of scale.
    xy : ndarray (k, 2)
        Images of the centroids.
    reach : ndarray (k, 2)
        Half the width and half the height of each image.
    """
    value, slope, bend = second_order(mapping, at)
    # The spacing of nodes is determined where a millimetre is largest in the image.
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
    return GrownOutline(image, SIZE), value, reach


def stacked(outlines: list[Outline]) -> Outline:
    """Outlines stacked to one (k, j, 2), padded with nodes of zero weight."""
    most = max(len(outline.xy) for outline in outlines)
    xy, dxy = np.zeros((2, len(outlines), most, 2))
    for k, outline in enumerate(outlines):
        xy[k, : len(outline.xy)], dxy[k, : len(outline.dxy)] = outline.xy, outline.dxy
    return Outline(xy, dxy)
