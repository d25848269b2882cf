"""Photographs of a disk through a single lens, drawn without the code under test: own rays, own formation.

The lens has two spheres and its stop in front of it, so that coma and colour shift the centre of density. For
every point of the stop, polynomials give which point of the target a place of the sensor sees.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from reseau.core.data import Array

__all__ = [
    "CURVATURES", "FOCUS", "INDICES", "PITCH", "PRINCIPAL", "STOP_RADIUS", "THICKNESS", "drawn",
    "principal_pixel"
]  # fmt: skip

CURVATURES, THICKNESS = (0.012, -0.022), 4.0
INDICES = ((486.1, 1.5224), (587.6, 1.5168), (656.3, 1.5143))
"""Wavelengths and indices of the glass."""
STOP_Z, LENS_Z = 0.0, 6.0
STOP_RADIUS, PITCH = 3.5, 0.006
FOCUS = 69.9
"""Place of the image plane behind the stop, mm."""
SIZE = (321, 241)
PRINCIPAL = (-787.0, -468.0)
"""The frame shows a part of the image beside the axis."""


def _sphere(
    start: Array, direction: Array, vertex: float, curvature: float, ratio: float
) -> tuple[Array, Array]:
    """Points on a sphere and directions behind it, by the quadratic equation and Snell's law."""
    centre = np.array([0.0, 0.0, vertex + 1 / curvature])
    away = start - centre
    b, c = (away * direction).sum(axis=1), (away**2).sum(axis=1) - curvature**-2
    roots = -b[:, None] + np.sqrt(b**2 - c)[:, None] * [-1, 1]
    points = start[:, None] + roots[..., None] * direction[:, None]
    near = np.abs(points[..., 2] - vertex).argmin(axis=1)
    point = points[np.arange(len(near)), near]
    normal = (point - centre) * abs(curvature)
    cosine = -(normal * direction).sum(axis=1)
    normal, cosine = normal * np.sign(cosine)[:, None], np.abs(cosine)
    root = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return point, ratio * direction + (ratio * cosine - root)[:, None] * normal


def arrive(points: Array, at_stop: Array, index: float, focus: float) -> Array:
    """Pixels (n, 2) of rays from points (n, 3), in camera axes, through points (n, 2) of the stop."""
    start = points * [1, -1, -1]
    through = np.concatenate([at_stop, np.zeros((len(at_stop), 1))], axis=1)
    direction = through - start
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    place, direction = _sphere(through, direction, LENS_Z, CURVATURES[0], 1 / index)
    place, direction = _sphere(place, direction, LENS_Z + THICKNESS, CURVATURES[1], index)
    hit = place + (focus - place[:, 2:]) / direction[:, 2:] * direction
    return hit[:, :2] * [-1, 1] / PITCH + PRINCIPAL


def principal_pixel(centre: Array, focus: float = FOCUS) -> Array:
    """Pixel of the principal ray of 587.6 nm from a point (3,)."""
    return arrive(centre[None], np.zeros((1, 2)), INDICES[1][1], focus)[0]


def drawn(centre: Array, axes: Array, diameter: float, sigma: float, focus: float = FOCUS) -> Array:
    """A photograph (h, w), 200 bright with a disk of 50, in grey values."""
    count, fine = 400, 3
    k = np.arange(count) + 0.5
    turn = k * np.pi * (3 - np.sqrt(5))
    stop = STOP_RADIUS * np.sqrt(k / count)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    grid = 0.7 * diameter * np.array([[u, v] for u in (-1, 0, 1) for v in (-1, 0, 1)])
    points = centre + grid @ axes.T
    middle = principal_pixel(centre, focus)
    half = int(0.5 * diameter / PITCH * 0.1) + 26
    first = np.rint(middle) - half
    side = (2 * half + 1) * fine
    at = (np.arange(side) + 0.5) / fine - 0.5
    samples, total = np.zeros((side, side)), np.zeros((side, side))
    jitter = (0.5 + k[:, None] * [0.7548776662, 0.5698402910]) % 1.0 - 0.5
    for _, index in INDICES:
        xy = (
            arrive(np.repeat(points, count, axis=0), np.tile(stop, (9, 1)), index, focus).reshape(9, count, 2)
            - first
        )
        away = np.concatenate([stop, np.zeros((count, 1))], axis=1) * [1, -1, 1] - centre
        light = np.abs(away[:, 2] * (away @ np.cross(*axes.T))) / (away**2).sum(axis=1) ** 2
        for p in range(count):
            x, y = xy[:, p].T
            terms = np.stack([np.ones(9), x, y, x * x, x * y, y * y], axis=1)
            a, b = np.linalg.solve(terms.T @ terms, terms.T @ grid).T
            u, v = at + jitter[p, 0] / fine, (at + jitter[p, 1] / fine)[:, None]
            s = a[0] + a[1] * u + a[2] * v + a[3] * u * u + a[4] * u * v + a[5] * v * v
            t = b[0] + b[1] * u + b[2] * v + b[3] * u * u + b[4] * u * v + b[5] * v * v
            # What an area of the target sends through this point of the stop reaches the area of its image.
            s_x, s_y = a[1] + 2 * a[3] * u + a[4] * v, a[2] + a[4] * u + 2 * a[5] * v
            t_x, t_y = b[1] + 2 * b[3] * u + b[4] * v, b[2] + b[4] * u + 2 * b[5] * v
            arriving = light[p] * np.abs(s_x * t_y - s_y * t_x)
            samples += arriving * (s * s + t * t <= diameter**2 / 4)
            total += arriving
    blurred = gaussian_filter(samples / total, sigma * fine, truncate=5)
    share = blurred.reshape(2 * half + 1, fine, -1, fine).mean(axis=(1, 3))
    image = np.full((SIZE[1] + 400, SIZE[0] + 400), 200.0)
    left, top = first.astype(int) + 200
    image[top : top + 2 * half + 1, left : left + 2 * half + 1] -= 150 * share
    return image[200:-200, 200:-200]
