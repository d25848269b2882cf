"""Formed images of the targets of a testfield, in the perspective of a frame."""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import numpy as np

from ...core.data import Array, Rows
from ...io import TestfieldDesign
from ...optics.composition import Chain
from ...optics.formation import Outline
from ...optics.targets import target_outline
from ..matching.matcher import SIZE
from ..matching.shapes import GrownOutline
from ..plane.lattice_mapping import second_order, stretches
from .light import curved

_SPACING = 1.3
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
    scale = float(stretches(slope @ frame)[0].max())
    kinds, each = design.kinds
    there, kind = np.unique(each[rows], return_inverse=True)
    spacing = float(f"{_SPACING * psf_px / scale:.2g}")
    flat = stacked([flat_outline(*kinds[k], spacing) for k in there])
    # F(s + d) − F(s) = J d + ½ d H d with d = frame · (x, y), as polynomials of each target.
    slope = np.swapaxes(slope @ frame, 1, 2)
    bend = frame.T @ bend @ frame / 2
    ways = np.stack(
        [slope[:, 0], slope[:, 1], bend[..., 0, 0], bend[..., 0, 1] + bend[..., 1, 0], bend[..., 1, 1]],
        axis=1,
    )
    xy, dxy = np.empty((2, len(rows), *flat.xy.shape[1:]), np.float32)
    reach = np.empty((len(rows), 2))
    curved(flat.xy, flat.dxy, kind, ways, xy, dxy, reach)
    return GrownOutline(Outline(cast(Array, xy), cast(Array, dxy)), SIZE), value, reach


def stacked(outlines: list[Outline]) -> Outline:
    """Outlines stacked to one (k, j, 2), padded with nodes of zero weight."""
    most = max(len(outline.xy) for outline in outlines)
    xy, dxy = np.zeros((2, len(outlines), most, 2))
    for k, outline in enumerate(outlines):
        xy[k, : len(outline.xy)], dxy[k, : len(outline.dxy)] = outline.xy, outline.dxy
    return Outline(xy, dxy)
