"""Echoes of several forms behind the wires of a reseau, drawn without the project's formation."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.measure import find_pins
from reseau.measure.pins.screenlight import blur_of_wires
from reseau.optics import Arcs

from .echoes import KINDS, Drawn, draw


def errors(drawn: Drawn) -> tuple[Array, Array, int]:
    """Errors and sigmas (k, 2) of the echoes that are hidden by less than one half, and their number."""
    points = find_pins(drawn.frame, hidden=drawn.hidden).points
    wanted = np.flatnonzero(drawn.share < 0.5)
    off = points.xy[None] - drawn.truth[wanted][:, None]
    nearest = np.hypot(off[..., 0], off[..., 1]).argmin(axis=1)
    error = off[np.arange(len(wanted)), nearest]
    found = np.hypot(*error.T) < 12
    return error[found], points.sigma[nearest][found], len(wanted)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [KINDS[0], *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[1:])]
)
def test_echoes_of_every_kind_are_found_behind_wires_and_within_their_sigmas(kind: str):
    error, sigma, wanted = errors(draw(kind, seed=0, turn=0.02))
    assert len(error) >= 0.85 * wanted
    normalised = error / sigma
    assert np.abs(normalised).max() < 5
    assert (np.sqrt((normalised**2).mean(axis=0)) < 1.6).all()
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.2


@pytest.mark.slow
def test_lines_cut_by_turned_wires_are_measured_as_well_as_whole_ones():
    error, sigma, wanted = errors(draw("even", seed=1, turn=-0.1))
    assert len(error) >= 0.85 * wanted
    assert np.median(sigma[:, 0]) < 0.04
    # The blur moves the ridges of these bent lines by 0.013 px.
    assert abs(error[:, 1].mean()) < 0.006
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.06


@pytest.mark.slow
def test_lines_along_a_wire_that_hides_parts_of_both_ends_are_measured():
    error, sigma, wanted = errors(draw("even", seed=3))
    assert len(error) >= 0.9 * wanted
    assert np.abs(error / sigma).max() < 4


@pytest.mark.slow
def test_lines_without_a_reseau_are_measured_within_their_sigmas():
    drawn = draw("even", seed=2, wires=False)
    points = find_pins(drawn.frame).points
    off = points.xy[None] - drawn.truth[:, None]
    error = off[np.arange(36), np.hypot(off[..., 0], off[..., 1]).argmin(axis=1)]
    assert len(points) == 36
    assert np.abs(error).max() < 0.1


@pytest.mark.slow
def test_the_blur_of_the_camera_follows_from_the_wires():
    drawn = draw("even", seed=0, turn=0.05, blur=1.2)
    found = blur_of_wires(drawn.frame.pixels.astype(np.float32), drawn.hidden, 1.5)
    assert found is not None
    # The pixel has a variance of 1/12 of its own.
    assert abs(found[0] - np.sqrt(1.2**2 + 1 / 12)) < 0.1
    assert blur_of_wires(np.full((300, 300), 40.0, np.float32), drawn.hidden[:300, :300], 1.5) is None


def test_the_profile_of_a_flat_arc_is_a_line_with_half_brightness_at_its_ends():
    line = Arcs.lines(*np.array([[30.0], [1.8], [0.0], [0.0]]), softness=np.array([2.0]))
    image = line.image(np.zeros((1, 2)), np.array([[-15.0, -5.0, 0.0, 5.0, 15.0]]), np.zeros((1, 1)))[0, 0]
    assert np.allclose(image, [0.5, 1, 1, 1, 0.5], atol=2e-6)


@pytest.mark.parametrize("name", ["flatness", "fading", "tapering", "thickening", "saturation"])
def test_the_derivatives_by_the_form_are_correct(name: str):
    pixels = np.arange(-25, 26.0)[None]
    values = {"flatness": 0.7, "fading": -0.3, "tapering": -0.2, "thickening": 0.05, "saturation": 1.5}
    names = tuple(values)

    def image(step: float) -> Array:
        columns = {key: np.array([value]) for key, value in values.items()}
        if name == "flatness":
            odds = 0.7 / 0.3 * np.exp(step)
            columns[name] = np.array([odds / (1 + odds)])
        else:
            columns[name] = columns[name] + step
        arc = Arcs(*np.array([[8.0], [1.9], [0.02], [0.3]]), **columns)
        return arc.image(np.array([[0.3, -0.4]]), pixels, pixels)

    arc = Arcs(*np.array([[8.0], [1.9], [0.02], [0.3]]), **{key: np.array([v]) for key, v in values.items()})
    formed, parts = arc.derivatives(np.array([[0.3, -0.4]]), pixels, pixels)
    assert np.abs(formed - arc.image(np.array([[0.3, -0.4]]), pixels, pixels)).max() < 1e-12
    difference = (image(1e-6) - image(-1e-6)) / 2e-6
    assert np.abs(difference - parts[:, 6 + names.index(name)]).max() < 1e-6
