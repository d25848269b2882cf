"""Ordinary coordinates of single bright or dark targets: centre of gravity, or an ellipse through the edge.

They say where the image of a target is, not where its point is imaged: blur, perspective and lens shift them.
:mod:`reseau.measure.blurred` begins with them.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from ..core.data import Array, Frame

_WINDOW_PX = 64
_ANGLES = 72
"""Profiles across the edge."""
_SHARE = 0.2
"""Part of the contrast below which light is no part of a target."""
_SOLID = 0.9
"""Least part of its convex hull that a target fills: less is two that touch."""
_BORDER = 1.9
"""Radius around a target, in radii of it, within which its light is summed."""


def ordinary_coordinates(
    frame: Frame,
    xy: Array,
    *,
    polarity: Literal["dark", "bright"],
    method: Literal["centroid", "edge"] = "centroid",
) -> Array:
    """Measure targets without a model of their blur.

    Parameters
    ----------
    frame : Frame
        The photograph.
    xy : ndarray (n, 2)
        Approximate coordinates, inside the images of the targets.
    polarity : {"dark", "bright"}
        Whether targets are darker or brighter than what is around them.
    method : {"centroid", "edge"}
        Centre of gravity of the light above a fifth of the contrast, or centre of the ellipse fitted to the
        places where profiles cross half of it.

    Returns
    -------
    ndarray (n, 2)
        NaN where nothing stands out, it does not end within 64 px, or two targets touch.

    Examples
    --------
    >>> y, x = np.mgrid[0:80, 0:100]
    >>> disk = 1 / (1 + np.exp(np.hypot(x - 51.3, y - 40.6) - 9))
    >>> frame = Frame(40 + 150 * disk, 255.0)
    >>> ordinary_coordinates(frame, np.array([[49.0, 42.0]]), polarity="bright").round(1)
    array([[51.3, 40.6]])
    >>> ordinary_coordinates(frame, np.array([[49.0, 42.0]]), polarity="bright", method="edge").round(1)
    array([[51.3, 40.6]])
    """
    grey = np.asarray(frame.pixels, dtype=np.float64) * (1.0 if polarity == "bright" else -1.0)
    return np.array([_measured(grey, at, method) for at in np.asarray(xy, dtype=np.float64)]).reshape(-1, 2)


def _measured(grey: Array, at: Array, method: str) -> Array:
    """One target; NaN where it is not measured."""
    nowhere: Array = np.full(2, np.nan)
    h, w = grey.shape
    if not (np.isfinite(at).all() and 0 <= at[0] <= w - 1 and 0 <= at[1] <= h - 1):
        return nowhere
    x, y = np.rint(at).astype(int)
    left, top = max(0, x - _WINDOW_PX), max(0, y - _WINDOW_PX)
    part = grey[top : y + _WINDOW_PX + 1, left : x + _WINDOW_PX + 1]
    own = np.array([x - left, y - top])
    background = float(np.median(part))
    around = part[max(0, own[1] - 1) : own[1] + 2, max(0, own[0] - 1) : own[0] + 2]
    contrast = float(np.median(around)) - background
    noise = 1.4826 * float(np.median(np.abs(part - background)))
    if contrast <= max(4 * noise, 1e-9):
        return nowhere
    above = (part > background + 0.5 * contrast).astype(np.uint8)
    _, labels = cv2.connectedComponents(above, connectivity=4)
    label = labels[own[1], own[0]]
    inside = labels == label
    rows, columns = np.nonzero(inside)
    edges = rows.min() == 0 or columns.min() == 0
    if label == 0 or edges or rows.max() == len(part) - 1 or columns.max() == part.shape[1] - 1:
        return nowhere
    hull = cv2.convexHull(np.column_stack([columns, rows]).astype(np.float32))
    # The hull of the centres of pixels lacks half a pixel all around.
    if inside.sum() < _SOLID * (cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True)):
        return nowhere
    centre, radius = np.array([columns.mean(), rows.mean()]), float(np.sqrt(inside.sum() / np.pi))
    light = part - background
    if method == "edge":
        found = _ellipse(light, centre, radius, contrast)
    else:
        down, right = np.mgrid[0 : part.shape[0], 0 : part.shape[1]]
        near = np.hypot(right - centre[0], down - centre[1]) < _BORDER * radius + 3
        weight = np.where(near & (light > _SHARE * contrast), light, 0.0)
        found = np.array([(weight * right).sum(), (weight * down).sum()]) / weight.sum()
    return np.asarray(found + np.array([left, top]), dtype=np.float64)


def _ellipse(light: Array, centre: Array, radius: float, contrast: float) -> Array:
    """Centre of the ellipse through the places where profiles cross half of the contrast."""
    angle = np.arange(_ANGLES) * 2 * np.pi / _ANGLES
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    t = np.linspace(0.2 * radius, _BORDER * radius + 3, 160)
    at = (centre + t[:, None, None] * out).astype(np.float32)
    values = cv2.remap(light.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    below = values < 0.5 * contrast
    first = below.argmax(axis=0)
    crossed = np.flatnonzero(below.any(axis=0) & (first > 0))
    if len(crossed) < _ANGLES // 2:
        return np.full(2, np.nan)
    k = first[crossed]
    a, b = values[k - 1, crossed], values[k, crossed]
    place = t[k - 1] + (a - 0.5 * contrast) / np.maximum(a - b, 1e-12) * (t[1] - t[0])
    edge = centre + place[:, None] * out[crossed]
    (cx, cy), _, _ = cv2.fitEllipseDirect(edge.astype(np.float32))
    return np.array([cx, cy], dtype=np.float64)
