"""What the forms of arcs leave out: the blur of bent lines, and the course of an arc far from its middle."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import scipy

from ...core.data import Array, Rows
from ...optics import Arcs
from ..matching.shapes import Window
from .arcs import ArcMatches, Windows
from .shapes import ACROSS_SIGMA, ArcShape, Form, ends_of, lines_with

_MOST_OF_WIDTH = 0.8
"""Largest variance of a blur as a share of those of an arc across and of its ends."""
_SAMPLES = 2
"""Samples per pixel along each axis, to form a blurred arc."""


@dataclass(frozen=True, eq=False)
class Details:
    """What the forms of k arcs leave out, and how it shifts them.

    Parameters
    ----------
    blur_px : ndarray (k, 2)
        Shift due to the blur of a bent line, whose image is not the bent image of a blurred line.
    course_px : ndarray (k, 2)
        Shift if κ² is replaced by cκ² in the course of the arc, for each unit of c - 1: the course is a
        hyperbola for c = 1, and a parabola for c = 0.
    score, information : ndarray (k,)
        Derivative of the logarithm of the likelihood with respect to c, all other unknowns eliminated, and
        the information about c.
    """

    blur_px: Array
    course_px: Array
    score: Array
    information: Array


def details_of(work: Windows, rows: Rows, found: ArcMatches, form: Form, blur: Array) -> Details:
    """What forms leave out, and how it shifts the arcs `rows`, to first order.

    Parameters
    ----------
    work : Windows
        The arcs and their windows.
    rows : ndarray of int (k,)
        Which ones.
    found : ArcMatches
        The matches.
    form : Form
        What was unknown of the form.
    blur : ndarray (m,)
        Width of a camera's blur, pixels, for each of all arcs.
    """
    parts = []
    for part in work.of_like_size(rows):
        parts.append((np.searchsorted(rows, part), _of_one_size(work, part, found, form, blur[part])))
    columns: dict[str, Any] = {}
    for f in fields(Details):
        columns[f.name] = np.zeros((len(rows), 2) if f.name.endswith("_px") else len(rows))
        for at, one in parts:
            columns[f.name][at] = getattr(one, f.name)
    return Details(**columns)


def _of_one_size(work: Windows, rows: Rows, found: ArcMatches, form: Form, blur: Array) -> Details:
    """The same for arcs of one size."""
    arcs, xy, noise = found.arcs.select(rows), found.xy[rows], found.noise[rows]
    columns, lines = work.window(rows, xy)
    shape = ArcShape(arcs, tuple(form.sigma))
    window = Window(columns, lines, work.options.response)
    none = np.zeros((len(rows), shape.parameters))
    image, parts = shape.derivatives(xy, arcs.across, none, np.arange(len(rows)), window)
    c, s = np.cos(arcs.tilt)[:, None, None], np.sin(arcs.tilt)[:, None, None]
    x, y = (columns - xy[:, :1])[:, None, :], (lines - xy[:, 1:])[:, :, None]
    u2 = (c * x + s * y) ** 2
    bend = arcs.curvature[:, None, None]
    # From -(dI/dv) u²/(r(1 + r)), r² = 1 + κ²u², to the derivative by c where κ² is replaced by cκ².
    by_bend = parts[:, 3 + shape.free.index("curvature")] * arcs.along[:, None, None]
    by_course = -by_bend * bend**3 * u2 / (2 * (1 + np.sqrt(1 + bend**2 * u2)))
    count = len(rows)
    flat = (count, 1, image[0].size)
    used = work.usable(rows, columns, lines).reshape(flat)
    contrast = found.contrast[rows][:, None, None]
    parts[:, 2] *= arcs.across[:, None, None]
    plane = np.stack(
        np.broadcast_arrays(1.0 + 0 * x, x / columns.shape[1] + 0 * y, y / lines.shape[1] + 0 * x), axis=1
    )
    design = used * np.concatenate(
        [
            contrast * parts.reshape(count, parts.shape[1], -1),
            image.reshape(flat),
            plane.reshape(count, 3, -1),
        ],
        axis=1,
    )
    known = np.zeros(design.shape[1])
    known[2 : parts.shape[1]] = 1 / np.array([ACROSS_SIGMA, *form.sigma.values()]) ** 2
    normal = design @ design.swapaxes(1, 2)
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-12))
    normal += noise[:, None, None] ** 2 * np.diag(known)
    normal /= scale[:, :, None] * scale[:, None, :]
    normal += 1e-9 * np.eye(len(known))
    grey = work.grey_in(columns, lines)
    columns_of = (
        np.stack(
            [
                contrast * (_blurred(arcs, xy, columns, lines, blur) - image),
                contrast * by_course,
                grey - contrast * image,
            ],
            axis=1,
        ).reshape(count, 3, -1)
        * used
    )
    right = (design @ columns_of.swapaxes(1, 2)) / scale[:, :, None]
    solved = np.linalg.solve(normal, right) / scale[:, :, None]
    left = columns_of - (solved.swapaxes(1, 2) @ design)
    limit = (work.options.rejection * noise)[:, None]
    rest = np.clip(left[:, 2] - left[:, 0], -limit, limit)
    variance = noise**2 * found.inflation[rows]
    return Details(
        blur_px=solved[:, :2, 0],
        course_px=solved[:, :2, 1],
        score=(left[:, 1] * rest).sum(axis=1) / variance,
        information=(left[:, 1] ** 2).sum(axis=1) / variance,
    )


def _blurred(arcs: Arcs, xy: Array, columns: Array, lines: Array, blur: Array) -> Array:
    """Images (k, r, c) of sharper arcs that a blur (k,) makes as wide as these, as bright as these."""
    half, soft = ends_of(arcs)
    variance = np.minimum(blur**2, _MOST_OF_WIDTH * np.minimum(arcs.across, soft) ** 2)
    sharp = replace(
        lines_with(half, np.sqrt(soft**2 - variance), arcs), across=np.sqrt(arcs.across**2 - variance)
    )
    pad, n = int(np.ceil(4 * np.sqrt(variance.max()))), _SAMPLES
    x, y = (
        axis[:, :1] - pad + np.arange((axis.shape[1] + 2 * pad) * n - n + 1) / n for axis in (columns, lines)
    )
    light = sharp.image(xy, x, y)
    inner = slice(pad * n, -pad * n if pad else None, n)
    found = np.stack(
        [
            scipy.ndimage.gaussian_filter(one, n * width, mode="nearest", truncate=4.0)[inner, inner]
            for one, width in zip(light, np.sqrt(variance), strict=True)
        ]
    )
    image = arcs.image(xy, columns, lines)
    bright = (image * found).sum(axis=(1, 2)) / np.maximum((found * found).sum(axis=(1, 2)), 1e-300)
    return np.asarray(bright[:, None, None] * found)
