"""Frames and image points: refused input, and selection in the requested order."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from reseau.core.data import Frame, ImagePoints
from reseau.core.errors import ImageError, UsageError
from reseau.io import MeasuredEdge
from reseau.measure.film.orientation import FrameResult


def test_a_frame_knows_its_size() -> None:
    frame = Frame(np.zeros((3, 5), dtype=np.uint8), 255.0)
    assert (frame.width, frame.height) == (5, 3)


@pytest.mark.parametrize("shape", [(3,), (3, 4, 3), (1, 5), (5, 1), (0, 0)])
def test_arrays_that_are_not_grey_images_are_refused_by_name(shape: tuple[int, ...]) -> None:
    with pytest.raises(ImageError, match=r"photo\.png: has the shape"):
        Frame(np.zeros(shape), 1.0, "photo.png")


def test_grey_values_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ImageError, match="not finite"):
        Frame(np.array([[0.0, np.nan], [1.0, 2.0]]), 1.0)


def test_points_with_sigma_have_diagonal_covariances() -> None:
    points = ImagePoints.with_sigma("ab", [[1, 2], [3, 4]], [[0.1, 0.2], [0.3, 0.4]])
    np.testing.assert_allclose(points.sigma, [[0.1, 0.2], [0.3, 0.4]], rtol=0, atol=1e-15)
    assert not points.cov[:, 0, 1].any()
    assert len(points) == 2


def test_selection_is_by_names_in_their_order_or_by_mask() -> None:
    points = ImagePoints.with_sigma(["a", "b", "c"], [[1, 1], [2, 2], [3, 3]], [[1.0], [2.0], [3.0]])
    some = points.select(["c", "a"])
    assert some.names == ("c", "a")
    np.testing.assert_array_equal(some.xy[:, 0], [3, 1])
    np.testing.assert_array_equal(some.sigma[:, 0], [3, 1])
    assert points.select(np.array([False, True, True])).names == ("b", "c")
    assert points.select([]).names == ()


def test_impossible_points_are_refused() -> None:
    with pytest.raises(UsageError, match="a: occurs twice"):
        ImagePoints.with_sigma(["a", "b", "a"], np.zeros((3, 2)), 1.0)
    with pytest.raises(UsageError, match="2 names with coordinates"):
        ImagePoints(("a", "b"), np.zeros((3, 2)), np.zeros((3, 2, 2)))
    with pytest.raises(UsageError, match="x: is not among the points"):
        ImagePoints.with_sigma(["a"], [[0, 0]], 1.0).select(["x"])


def test_axes_that_are_drawn_into_twice_keep_y_down() -> None:
    figure = Figure()
    axes = figure.subplots()
    points = ImagePoints.with_sigma(["a", "b"], [[1.0, 2.0], [30.0, 40.0]], 0.1)
    edges = {
        "upper": MeasuredEdge(found=False, points=0, rejected=0, rms_px=None, curvature_px=None),
    }
    declined = FrameResult("07.tif", "declined", "of one tone", None, None, None, edges)
    for draw in (points.plot, declined.plot, points.plot, declined.plot):
        draw(axes)
        assert axes.yaxis_inverted()
    assert not points.plot(Figure().subplots(), y_down=False).yaxis_inverted()
