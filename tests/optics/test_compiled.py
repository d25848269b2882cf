"""Images formed in single precision, compared with double precision."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.optics.compiled import formed
from reseau.optics.formation import Outline, PixelResponse, coverage_derivatives
from reseau.optics.targets import target_outline


@pytest.mark.parametrize("fill", [1.0, 0.8])
@pytest.mark.parametrize("shape", ["square", "triangle", "cross", "circle"])
def test_images_and_derivatives_are_those_in_double_precision(shape, fill):
    rng = np.random.default_rng(5)
    flat = target_outline(shape, 9.0, 20.0, 0.6)
    count, columns, rows, forms = 20, np.arange(17.0), np.arange(19.0), 2
    nodes = flat.affine(np.eye(2) + 0.2 * rng.normal(size=(count, 2, 2))).oriented()
    place, sigma = rng.uniform(7, 10, (count, 2)), rng.uniform(0.5, 1.5, count)
    generators, form = rng.normal(size=(forms, 2, 2)), 0.1 * rng.normal(size=(count, forms))
    placed = nodes.affine(np.eye(2) + np.einsum("kp,pij->kij", form, generators), place)
    motions = np.einsum("pij,knj->kpni", generators, nodes.xy)
    share, slopes = coverage_derivatives(placed, columns, rows, sigma, PixelResponse(fill), motions)
    outlines = [a.astype(np.float32) for a in (nodes.xy, nodes.dxy, generators)]
    given = [a.astype(np.float32) for a in (place, form, sigma)]
    parts, alone = (np.empty((count, n, 19, 17), np.float32) for n in (6, 1))
    formed(*outlines, np.arange(count), *given, fill, parts)
    formed(*outlines, np.arange(count), *given, fill, alone)
    # Of a signal of 200 grey values 5e-6 are a thousandth.
    np.testing.assert_allclose(parts[:, 0], share, rtol=0, atol=5e-6)
    np.testing.assert_allclose(alone[:, 0], share, rtol=0, atol=5e-6)
    np.testing.assert_allclose(parts[:, 1:], slopes, rtol=0, atol=3e-5)


def test_nodes_of_zero_weight_and_outside_light_have_no_effect():
    circle = Outline.circle(2.0, 0.5)
    xy, dxy = np.zeros((2, 1, len(circle.xy) + 7, 2), np.float32)
    xy[:, : len(circle.xy)], dxy[:, : len(circle.xy)] = circle.xy, circle.dxy
    place = np.array([[6.0, 6.0], [-60.0, -60.0], [6.0, 60.0], [60.0, 6.0], [-60.0, 6.0]], np.float32)
    count, parts = len(place), np.empty((len(place), 1, 13, 13), np.float32)
    width, at = np.full(count, 0.7, np.float32), np.zeros(count, np.intp)
    formed(
        xy,
        dxy,
        np.zeros((0, 2, 2), np.float32),
        at,
        place,
        np.zeros((count, 0), np.float32),
        width,
        1.0,
        parts,
    )
    assert parts[0].sum() == pytest.approx(np.pi * 4, abs=1e-4)
    assert np.abs(parts[1:]).max() < 1e-5
