"""Conversion of a camera to another model: best fitting parameters over the image, and the differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...core.data import Array, Mask
from ...core.errors import UsageError
from ..mapping import PlaneMapping
from .grid import PixelGrid
from .registry import camera_model

__all__ = ["Converted", "convert"]

# Points along the longer side of the image.
_POINTS = 41
# Greatest number of steps, and damping of the first one (columns have unit length).
_ITERATIONS, _DAMPING = 200, 1e-3


class Converted(NamedTuple):
    """A camera in another model.

    Parameters
    ----------
    mapping : PlaneMapping
        From ideal directions to pixels.
    rms_px, greatest_px : float
        Differences from the original over the image: root mean square, and largest.
    share : float
        Share of the image where the original has directions; the rest was not compared.

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> camera = Brown(grid=grid).with_values({"c": 8.0})
    >>> found = Converted(camera, rms_px=0.01, greatest_px=0.03, share=1.0)
    >>> found.mapping is camera, found.greatest_px
    (True, 0.03)
    """

    mapping: PlaneMapping
    rms_px: float
    greatest_px: float
    share: float


def convert(
    camera: PlaneMapping,
    grid: PixelGrid,
    model: str,
    options: Mapping[str, Any] | None = None,
    *,
    free: tuple[str, ...] = (),
) -> Converted:
    """Convert a camera to another registered model, by least squares over the image.

    Parameters
    ----------
    camera : PlaneMapping
        From ideal directions to pixels.
    grid : PixelGrid
        Pixels of the image.
    model : str
        Name of the model wanted.
    options : mapping, optional
        Options of that model.
    free : tuple of str
        Parameters to be estimated, the others are zero; all by default.

    Returns
    -------
    Converted
        The camera, and its differences from the original.

    Raises
    ------
    UsageError
        When the model or a parameter is unknown, or the original has no directions over most of the image.

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> camera = Brown(grid=grid).with_values({"c": 8.0, "K1": 1e-3})
    >>> found = convert(camera, grid, "opencv", free=("fx", "fy", "cx", "cy", "k1"))
    >>> found.greatest_px < 1e-6, round(found.mapping.value_of("k1"), 6)
    (True, 0.064)
    """
    wanted = camera_model(model)
    unknown = [name for name in free if name not in wanted.names]
    if unknown:
        raise UsageError(f"is not one of {', '.join(wanted.names)}", where=unknown[0])
    step = max(grid.width, grid.height) / _POINTS
    columns = np.linspace(0, grid.width - 1, max(2, round(grid.width / step)))
    rows = np.linspace(0, grid.height - 1, max(2, round(grid.height / step)))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    directions = camera.inverse(pixels)
    known: Mask = np.asarray(np.isfinite(directions).all(axis=1))
    if 2 * known.sum() <= len(known):
        raise UsageError("has no directions over most of the image", where="camera to be converted")
    uv, target = directions[known], pixels[known]
    # Focal length along the rows, in the middle of the image.
    centre = camera.inverse(grid.centre[None])
    f = float(camera.derivatives(centre if np.isfinite(centre).all() else uv[:1]).d_xy[0, 0, 0])
    at = np.array([not free or name in free for name in wanted.names])
    found = _fitted(wanted.mapping(wanted.start_values(f, grid), grid, options), uv, target, at)
    off = np.hypot(*(found(uv) - target).T)
    return Converted(found, float(np.sqrt((off**2).mean())), float(off.max()), float(known.mean()))


def _fitted(mapping: PlaneMapping, uv: Array, target: Array, at: Array) -> PlaneMapping:
    """Levenberg–Marquardt in columns of unit length; undetermined corrections have least norm."""
    cost, damping, slow = _cost(mapping, uv, target), _DAMPING, 0
    for _ in range(_ITERATIONS):
        seen = mapping.derivatives(uv)
        design = seen.d_parameters[:, :, at].reshape(2 * len(uv), -1)
        size = np.linalg.norm(design, axis=0)
        size[size == 0] = 1.0
        left, values, right = np.linalg.svd(design / size, full_matrices=False)
        along = np.where(values > 1e-13 * values[0], left.T @ (target - seen.value).ravel(), 0.0)
        before = cost
        while True:
            full = np.zeros(len(at))
            full[at] = right.T @ (along * values / (values**2 + damping)) / size
            trial = mapping.with_values(mapping.values + full)
            after = _cost(trial, uv, target)
            if after < cost:
                mapping, cost, damping = trial, after, max(damping / 10, 1e-24)
                break
            damping *= 10
            if damping > 1e6:
                return mapping
        slow = slow + 1 if before - cost < 1e-9 * before else 0
        if slow == 3:
            break
    return mapping


def _cost(mapping: PlaneMapping, uv: Array, target: Array) -> float:
    with np.errstate(all="ignore"):
        cost = float(((mapping(uv) - target) ** 2).sum())
    return cost if np.isfinite(cost) else np.inf
