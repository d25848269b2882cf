"""Images formed in single precision, compared with double precision."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.optics.compiled import formed
from reseau.optics.formation import Outline, PixelResponse, coverage_derivatives
from reseau.optics.targets import target_outline


@pytest.mark.parametrize(("size", "wide", "high"), [(9.0, 17, 19), (26.0, 43, 45)])
@pytest.mark.parametrize("fill", [1.0, 0.8])
@pytest.mark.parametrize("shape", ["square", "triangle", "cross", "circle"])
def test_images_and_derivatives_are_those_in_double_precision(shape, fill, size, wide, high):
    rng = np.random.default_rng(5)
    flat = target_outline(shape, size, 20.0, 0.6)
    count, columns, rows, forms = 20, np.arange(float(wide)), np.arange(float(high)), 2
    nodes = flat.affine(np.eye(2) + 0.2 * rng.normal(size=(count, 2, 2))).oriented()
    place, sigma = rng.uniform(wide / 2 - 1, wide / 2 + 2, (count, 2)), rng.uniform(0.5, 1.5, count)
    generators, form = rng.normal(size=(forms, 2, 2)), 0.1 * rng.normal(size=(count, forms))
    placed = nodes.affine(np.eye(2) + np.einsum("kp,pij->kij", form, generators), place)
    motions = np.einsum("pij,knj->kpni", generators, nodes.xy)
    share, slopes = coverage_derivatives(placed, columns, rows, sigma, PixelResponse(fill), motions)
    outlines = [a.astype(np.float32) for a in (nodes.xy, nodes.dxy, generators)]
    given = [a.astype(np.float32) for a in (place, form, sigma)]
    parts, alone = (np.empty((count, n, high, wide), np.float32) for n in (6, 1))
    formed(*outlines, np.arange(count), *given, fill, parts)
    formed(*outlines, np.arange(count), *given, fill, alone)
    # Of a signal of 200 grey values 5e-6 are a thousandth.
    np.testing.assert_allclose(parts[:, 0], share, rtol=0, atol=5e-6)
    np.testing.assert_allclose(alone[:, 0], share, rtol=0, atol=5e-6)
    # Derivatives by forms are proportional to the size.
    np.testing.assert_allclose(parts[:, 1:], slopes, rtol=0, atol=3.5e-6 * size)


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


@pytest.mark.parametrize("sigma", [2.0, 4.0, 30.0, 1e4])
def test_wide_point_spread_functions_are_formed_as_in_double_precision(sigma):
    circle = Outline.circle(3.0, 0.5)
    parts = np.empty((1, 5, 13, 15), np.float32)
    outline = [nodes[None].astype(np.float32) for nodes in (circle.xy, circle.dxy, np.eye(2))]
    given = np.array([[6.3, 5.2]], np.float32), np.zeros((1, 1), np.float32), np.array([sigma], np.float32)
    formed(*outline, np.zeros(1, np.intp), *given, 0.8, parts)
    placed = Outline(circle.xy[None] + [6.3, 5.2], circle.dxy[None])
    motions = circle.xy[None, None]
    share, slopes = coverage_derivatives(
        placed, np.arange(15.0), np.arange(13.0), np.array([sigma]), PixelResponse(0.8), motions
    )
    np.testing.assert_allclose(parts[:, 0], share, rtol=0, atol=5e-6)
    np.testing.assert_allclose(parts[:, 1:], slopes, rtol=0, atol=3e-5)
