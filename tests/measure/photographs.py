"""Small photographs with fiducial marks, drawn with distances to lines and circles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from reseau.core.data import Array
from reseau.io import FiducialDesign, FiducialMark, FiducialPoint, MarkPart

__all__ = ["PLACES", "UNEVEN", "camera", "photograph"]

PLACES = {"1": (20.0, -15.0), "2": (-20.0, -15.0), "3": (-20.0, 15.0), "4": (20.0, 15.0)}
UNEVEN = {"1": (20.0, -15.0), "2": (-20.0, -15.0), "3": (-20.0, 12.0), "4": (17.0, 15.0)}
"""Marks of a camera, mm; those of the second fit in one orientation."""
_CROSS = MarkPart(shape="cross", size=3.0, line_width=0.3, gap=0.8)


def camera(places: dict[str, tuple[float, float]] = PLACES, sigma: float = 0.002) -> FiducialDesign:
    """A camera with dots in crosses."""
    mark = FiducialMark(polarity="bright", parts=(_CROSS, MarkPart(shape="disk", size=0.4)), margin=0.6)
    points = tuple(FiducialPoint(id=k, x=x, y=y, sigma=sigma, mark="x") for k, (x, y) in places.items())
    return FiducialDesign(name="test camera", marks={"x": mark}, points=points)


def photograph(
    places: dict[str, tuple[float, float]] = PLACES,
    rotation: int = 0,
    mirrored: bool = False,
    tilt_deg: float = 1.0,
    without: tuple[str, ...] = (),
    seed: int = 0,
    size: tuple[int, int] = (520, 520),
) -> tuple[NDArray[np.uint8], Array]:
    """Grey values of a scan at 10 px/mm, and the places of all marks (n, 2)."""
    over, k = 4, 10.0
    angle = np.deg2rad(rotation + tilt_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = k * np.diag([-1.0 if mirrored else 1.0, -1.0]) @ turn @ np.diag([1.001, 0.999])
    shift = np.array([size[0] / 2 + 3.3, size[1] / 2 - 4.6])
    rng = np.random.default_rng(seed)
    grey = np.full(size[::-1], 30.0)
    inner = gaussian_filter(rng.standard_normal(size[::-1]), 3.0)
    film = (_positions(size, 1) - shift) @ np.linalg.inv(linear).T
    picture = (np.abs(film[..., 0]) < 17) & (np.abs(film[..., 1]) < 12)
    grey[picture] = (130 + 120 * inner / np.abs(inner).max())[picture]
    xy = np.array(list(places.values())) @ linear.T + shift
    for name, at in zip(places, xy, strict=True):
        first = np.rint(at).astype(int) - 24
        if name in without:
            continue
        u, v = np.moveaxis((_positions((48, 48), over) + first - at) @ np.linalg.inv(linear).T, -1, 0)
        arms = (np.minimum(np.abs(u), np.abs(v)) < 0.15) & (np.maximum(np.abs(u), np.abs(v)) < 1.5)
        light = (arms & (np.maximum(np.abs(u), np.abs(v)) > 0.4)) | (np.hypot(u, v) < 0.2)
        share = light.reshape(48, over, 48, over).mean(axis=(1, 3))
        grey[first[1] : first[1] + 48, first[0] : first[0] + 48] = 30 + 170 * share
    grey = gaussian_filter(grey, 0.9) + rng.normal(0, 2.0, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), xy


def _positions(size: tuple[int, int], over: int) -> NDArray[Any]:
    x, y = (np.arange(n * over) / over + (1 / over - 1) / 2 for n in size)
    return np.stack(np.meshgrid(x, y), axis=-1)
