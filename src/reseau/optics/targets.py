"""Outlines of the targets of a testfield in the plane of its design."""

from __future__ import annotations

import numpy as np

from ..core.data import Array
from ..core.errors import UsageError
from .formation import Outline

_APEX = np.deg2rad([90.0, 210.0, 330.0])


def target_corners(shape: str, size: float, angle_deg: float = 0.0, arm: float | None = None) -> Array | None:
    """Corners of a target around its centroid, in the direction that turns x into y.

    Parameters
    ----------
    shape : {"square", "triangle", "cross", "circle"}
        As in ``testfield-design/1``.
    size : float
        Side of a square or an equilateral triangle; tip-to-tip length of a cross, whose arms have a width of
        one third of it; diameter of a circle.
    angle_deg : float
        Rotation from upright, x into y; the apex of the triangle points along y.
    arm : float, optional
        Width of the arms of a cross; by default one third of their length.

    Returns
    -------
    ndarray (k, 2) or None
        None for a circle, which has no corners.

    Raises
    ------
    UsageError
        When the shape is unknown.
    """
    if shape == "circle":
        return None
    if shape == "square":
        corners = size / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    elif shape == "triangle":
        corners = size / np.sqrt(3) * np.stack([np.cos(_APEX), np.sin(_APEX)], axis=1)
    elif shape == "cross":
        r, w = size / 2, (size / 3 if arm is None else arm) / 2
        end = np.array([[r, -w], [r, w], [w, w]])
        turn = np.array([[0.0, 1.0], [-1.0, 0.0]])  # rotates a row vector by +90°
        corners = np.concatenate([end @ np.linalg.matrix_power(turn, k) for k in range(4)])
    else:
        raise UsageError(f"there is no target of shape {shape!r}")
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    turned: Array = corners @ np.array([[c, s], [-s, c]])
    return turned


def target_outline(shape: str, size: float, angle_deg: float, spacing: float) -> Outline:
    """Outline (j, 2) of a target around its centroid; see :func:`target_corners`.

    Parameters
    ----------
    spacing : float
        Largest distance of two nodes of the quadrature, in the unit of `size`.
    """
    corners = target_corners(shape, size, angle_deg)
    return Outline.circle(size / 2, spacing) if corners is None else Outline.polygon(corners, spacing)
