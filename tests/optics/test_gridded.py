"""Gridded outlines: their images are those of the outlines themselves."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.optics.formation import Outline, PixelResponse, coverage_derivatives, mark_outline
from reseau.optics.gridded import GriddedOutline

COLUMNS, ROWS = np.arange(-12.0, 14.0), np.arange(-13.0, 12.0)


@pytest.mark.parametrize("shape", ["disk", "square"])
@pytest.mark.parametrize(("sigma", "fill", "share"), [(0.4, 1.0, 2e-5), (0.5, 0.6, 2e-5), (0.8, 1.0, 5e-7)])
def test_images_and_derivatives_are_those_of_the_outline(
    shape: str, sigma: float, fill: float, share: float
) -> None:
    outline = mark_outline(shape, 12.3, None, 0.4 * sigma)
    motions = np.stack([outline.xy, outline.xy[:, ::-1] * [0.3, 1.0]])
    gridded, response = GriddedOutline.of(outline, motions), PixelResponse(fill)
    for place in np.random.default_rng(0).uniform(-2, 2, (4, 2)):
        placed = Outline(outline.xy + place, outline.dxy)
        image, slopes = coverage_derivatives(placed, COLUMNS, ROWS, sigma, response, motions)
        found = gridded.derivatives(place, sigma, COLUMNS, ROWS, response)
        assert np.abs(found[0] - image).max() < share
        assert np.abs(found[1:] - slopes).max() < 60 * share  # motions are of up to 9 px
        assert np.abs(gridded.image(place, sigma, COLUMNS, ROWS, response) - found[0]).max() < 1e-12


def test_pixels_beside_the_outline_see_nothing_of_it() -> None:
    gridded = GriddedOutline.of(Outline.circle(3.0, 0.2))
    for far in (40.0, -60.0):
        image = gridded.image(np.zeros(2), 0.6, COLUMNS + far, ROWS, PixelResponse())
        assert np.abs(image).max() < 1e-6  # as exact as the quadrature
        image = gridded.image(np.zeros(2), 0.6, COLUMNS, ROWS + far, PixelResponse())
        assert np.abs(image).max() < 1e-6  # as exact as the quadrature
