"""Images of corners: beside the integral along outlines, and numeric derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.optics.corners import Corners, corner_images
from reseau.optics.formation import Outline, PixelResponse, coverage

N = np.arange(31.0)[None]
XY = np.array([[15.3, 14.8]])


def directions(first: float, second: float) -> Array:
    """Normals (1, 2, 2) of edges whose normals have these directions, degrees."""
    angle = np.deg2rad([first, second])
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)[None]


def by_outline(normal: Array, sigma: float, opposite: bool) -> Array:
    """The same image by integrals along the outlines of sectors that end far outside."""
    (n1, n2), far = normal[0], 90.0
    # Rays along the edges into the dark sector.
    u, v = (np.array([-n[1], n[0]]) for n in (n1, n2))
    u, v = u * np.sign(u @ n2), v * np.sign(v @ n1)
    share = np.zeros((31, 31))
    for sign in (1, -1) if opposite else (1,):
        corners = XY[0] + sign * far * np.array([0 * u, u, u + v, v])
        outline = Outline.polygon(corners, 0.3 * sigma).oriented()
        share += coverage(outline, N[0], N[0], sigma, PixelResponse())
    return share


@pytest.mark.parametrize("opposite", [True, False])
@pytest.mark.parametrize("angles", [(10.0, 100.0), (30.0, 75.0), (200.0, 340.0)])
@pytest.mark.parametrize(("sigma", "within"), [(0.5, 2e-3), (0.8, 6e-4), (2.0, 5e-5)])
def test_image_is_that_of_the_sectors(
    opposite: bool, angles: tuple[float, float], sigma: float, within: float
) -> None:
    normal = directions(*angles)
    corners = Corners(normal, np.zeros((1, 2)), np.array([opposite]))
    image = corner_images(corners, XY, np.array([sigma]), np.zeros((1, 2)), N, N)[0, 0]
    assert np.abs(image - by_outline(normal, sigma, opposite)).max() < within


@pytest.mark.parametrize("opposite", [True, False])
@pytest.mark.parametrize("added", [[], [1e-3, 4e-3]])
def test_derivatives_are_those_of_the_image(opposite: bool, added: list[float]) -> None:
    corners = Corners(directions(25.0, 95.0), np.array([[3e-3, -2e-3]]), np.array([opposite]))
    place = np.array([*XY[0], 1.5, 0.02, -0.03, *added])

    def image(values: Array) -> Array:
        return corner_images(corners, values[None, :2], values[2:3], values[None, 3:], N, N)[0].astype(float)

    formed = image(place)
    for k in range(len(place)):
        step = 1e-2 if k < 5 else 1e-4
        shift = step * np.eye(len(place))[k]
        numeric = (image(place + shift)[0] - image(place - shift)[0]) / (2 * step)
        scale = np.abs(numeric).max()
        # The fourth cumulant of a pixel is not differentiated, nor the turn of a bent edge to second order.
        assert np.abs(formed[1 + k] - numeric).max() < 0.02 * scale
