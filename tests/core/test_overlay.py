"""Overlays: every pixel of the frame, symbols at their places, and a legend that names the reasons."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.failure import Code, Failure
from reseau.core.overlay import FOUND, Layer, declined_layers, draw_overlay


def coloured(picture: np.ndarray, colour: str) -> np.ndarray:
    """Mean place of the pixels that have nearly this colour, in columns and rows."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    rows, columns = np.nonzero(np.abs(picture.astype(int) - rgb).max(axis=2) < 30)
    return np.array([columns.mean(), rows.mean()])


def flat(height: int, width: int, level: int) -> np.ndarray:
    noise = np.random.default_rng(0).integers(-3, 4, (height, width))
    return (level + noise).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "zoom"), [((60, 90), 14), ((600, 800), 2), ((1200, 1700), 1)])
@pytest.mark.parametrize("level", [4, 250])
def test_a_symbol_lies_on_its_pixel_in_frames_of_every_size(
    size: tuple[int, int], zoom: int, level: int
) -> None:
    h, w = size
    at = np.array([[w / 3, h / 2]])
    picture = draw_overlay(flat(h, w, level), [Layer("measured, 1", at)], "a frame")
    assert picture.shape[1] == zoom * w
    assert picture.shape[0] > zoom * h
    # The pixel (0, 0) of the frame covers the pixels 0 to zoom − 1; its centre is at (zoom − 1) / 2.
    assert coloured(picture[: zoom * h], FOUND) == pytest.approx((at[0] + 0.5) * zoom - 0.5, abs=1.0)


def test_the_picture_is_that_of_the_frame_to_the_pixel() -> None:
    frame = np.random.default_rng(1).integers(0, 256, (900, 1300)).astype(np.uint8)
    picture = draw_overlay(frame, [], "a frame")
    assert picture.shape[1] == 1300
    assert np.abs(picture[:900, :, 0].astype(int) - frame).max() <= 2  # stretched between 0.1 and 99.9 %


def test_places_beyond_the_frame_are_not_drawn_into_the_legend() -> None:
    frame = flat(900, 1300, 100)
    inside = [Layer("measured, 1", np.array([[50.0, 50.0]]))]
    beyond = [Layer("measured, 1", np.array([[50.0, 50.0], [200.0, 905.0]]))]
    legend = [draw_overlay(frame, layers, "a frame")[900:] for layers in (inside, beyond)]
    assert (legend[0] == legend[1]).all()


def test_reasons_are_layers_of_their_own_with_names_and_counts() -> None:
    xy = np.array([[1.0, 2.0], [3.0, 4.0], [np.nan, np.nan]])
    why = ("too blurred", "covered", "too blurred")
    blurred, hidden = declined_layers(("A", "B", "C"), xy, why, ("blurred", "hidden", "blurred"))
    assert blurred.label == "blurred, 2: A, C (too blurred; 1 without a place in the frame)"
    assert hidden.label == "hidden, 1: B (covered)"
    assert blurred.symbol != hidden.symbol
    assert blurred.colour != hidden.colour


def test_a_failure_shows_the_frame_and_what_was_found_in_it(tmp_path: Path) -> None:
    frame = Frame(flat(700, 900, 60), 255.0, "a.png")
    failure = Failure("not found", Code.NOT_FOUND, where="a.png", places=np.array([[300.0, 200.0]]))
    picture = failure.overlay(frame, tmp_path / "o.png")
    assert (cv2.imread(str(tmp_path / "o.png"))[:, :, ::-1] == picture).all()
    assert coloured(picture[:1400], "#5cc8ff") == pytest.approx([600.5, 400.5], abs=1.0)
    assert bool(failure) is False


@pytest.mark.slow
def test_the_same_picture_is_drawn_to_the_same_bytes() -> None:
    layers = [Layer("measured, 1", np.array([[30.0, 20.0]]), ("A1",), np.array([1e-4 * np.eye(2)]))]
    first, second = (draw_overlay(flat(60, 90, 9), layers, "a frame") for _ in range(2))
    assert (first == second).all()
