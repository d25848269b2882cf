"""Lines one pixel wide: points along their images, and the blur of their edges.

Along a line the image changes slowly, so that it is the image of a strip: the difference of two blurred steps
as a function of the distance from the line, in each row that it crosses, or in each column for lines that are
nearly horizontal (:mod:`reseau.measure.testfield.compiled_lattice`).
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array
from ...optics import Chain
from ...optics.formation import PixelResponse
from .lattice_mapping import images_of

__all__ = ["blur_of", "line_nodes"]


def blur_of(psf_px: float, response: PixelResponse) -> float:
    """Width (one sigma) of a blurred edge; the square of a pixel has the same variance in all directions."""
    return float(np.hypot(psf_px, response.fill / np.sqrt(12)))


def line_nodes(mapping: Chain, axis: int, numbers: Array, width: float, along: Array) -> tuple[Array, Array]:
    """Images (l, m, 2) of points on lattice lines, and of points beside them at the distance of their width.

    Parameters
    ----------
    mapping : Chain
        From lattice coordinates to the image.
    axis : int
        Which of both lattice coordinates is constant on a line.
    numbers : ndarray (l,)
        Its values.
    width : float
        Width of the lines in lattice steps.
    along : ndarray (m,)
        The other lattice coordinate of the points.
    """
    on = np.empty((2, len(numbers), len(along), 2))
    on[..., 1 - axis] = along
    on[..., axis] = numbers[:, None] + np.array([0.0, width])[:, None, None]
    nodes, beside = images_of(mapping, on.reshape(-1, 2)).reshape(on.shape)
    return nodes, beside
