"""Formed images: against closed forms, brute force and known shifts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erf, ndtr

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.optics import RationalPolynomial
from reseau.optics.formation import (
    Outline,
    PixelResponse,
    coverage,
    coverage_derivatives,
    draw,
    mark_outline,
    rectangles,
)
from reseau.optics.grids import Wires, wire_grid
from reseau_sims.wires import line_grid

SIGMA = 0.8
SPACING = 0.7 * SIGMA
EXACT = 2e-6  # share of a pixel's light; what the quadrature promises at this spacing is 1e-6
SHAPES = {"disk": (5.3, None), "square": (4.6, None), "cross": (9.0, 1.7), "line-grid": (0.0, 2.3)}
PIXELS = np.arange(-14.0, 15.0)


def outline_of(shape: str, *, reach: float = 9.0) -> Outline:
    size, width = SHAPES[shape]
    return mark_outline(shape, size, width, SPACING, reach)


def moved(outline: Outline, shift: Array) -> Outline:
    return Outline(outline.xy + shift, outline.dxy)


def inside(shape: str, x: Array, y: Array) -> Array:
    """Whether points lie on the shape; written down from its definition."""
    size, width = SHAPES[shape]
    if shape == "disk":
        return np.hypot(x, y) < size / 2
    if shape == "square":
        return np.maximum(np.abs(x), np.abs(y)) < size / 2
    reach = size / 2 if shape == "cross" else 9.0
    assert width is not None
    near, far = np.minimum(np.abs(x), np.abs(y)), np.maximum(np.abs(x), np.abs(y))
    return (near < width / 2) & (far < reach)


def response_matrix(pixels: Array, at: Array, sigma: float, fill: float, step: float) -> Array:
    """Light that a pixel gets from samples on an axis: Gaussian folded with the pixel, in closed form."""
    upper = (pixels[:, None] + fill / 2 - at) / (sigma * np.sqrt(2))
    lower = (pixels[:, None] - fill / 2 - at) / (sigma * np.sqrt(2))
    return step * (erf(upper) - erf(lower)) / (2 * fill)


def supersampled(shape: str, sigma: float, fill: float, per_pixel: int = 60) -> Array:
    step = 1 / per_pixel
    at = np.arange(-14 + step / 2, 14, step)
    weights = response_matrix(PIXELS, at, sigma, fill, step)
    return weights @ inside(shape, at[None, :], at[:, None]).astype(float) @ weights.T


def integral(a: float, b: float, pixels: Array, sigma: float) -> Array:
    """Light of the strip a < x < b on unit pixels: second integral of the Gaussian, in closed form."""

    def twice(t: Array) -> Array:
        z = t / (sigma * np.sqrt(2))
        return t * erf(z) / 2 + sigma / np.sqrt(2 * np.pi) * np.exp(-z * z)

    return (
        twice(pixels + 0.5 - a) - twice(pixels - 0.5 - a) - twice(pixels + 0.5 - b) + twice(pixels - 0.5 - b)
    )


@pytest.mark.parametrize("sigma", [0.4, 0.8, 1.5])
@pytest.mark.parametrize("at", [(0.0, 0.0), (0.31, -0.47)])
def test_a_square_is_the_product_of_two_error_functions(sigma: float, at: tuple[float, float]) -> None:
    square = moved(mark_outline("square", 4.6, None, 0.7 * sigma), np.array(at))
    x, y = (integral(c - 2.3, c + 2.3, PIXELS, sigma) for c in at)
    np.testing.assert_allclose(coverage(square, PIXELS, PIXELS, sigma), np.outer(y, x), rtol=0, atol=EXACT)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("sigma", "fill"), [(0.8, 1.0), (0.5, 0.8)])
def test_every_shape_agrees_with_supersampling(shape: str, sigma: float, fill: float) -> None:
    size, width = SHAPES[shape]
    outline = mark_outline(shape, size, width, 0.7 * sigma, 9.0)
    formed = coverage(outline, PIXELS, PIXELS, sigma, PixelResponse(fill))
    # The brute force has 60 samples per pixel: staircases of 1/60 px along the outlines.
    np.testing.assert_allclose(formed, supersampled(shape, sigma, fill), rtol=0, atol=3e-3)


@pytest.mark.parametrize("shape", ["disk", "square", "cross"])
def test_the_total_light_of_a_shape_is_preserved(shape: str) -> None:
    size, width = SHAPES[shape]
    area = {
        "disk": np.pi * size**2 / 4,
        "square": size**2,
        "cross": 2 * size * (width or 0) - (width or 0) ** 2,
    }
    formed = coverage(outline_of(shape), PIXELS, PIXELS, SIGMA)
    assert formed.sum() == pytest.approx(area[shape], abs=1e-5)
    assert formed.min() > -EXACT
    assert formed.max() < 1 + EXACT


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("shift", [(0.001, 0.0), (0.25, -0.4), (0.499, 0.777)])
def test_the_image_position_is_correct_to_a_thousandth_of_a_pixel(
    shape: str, shift: tuple[float, float]
) -> None:
    known = np.array(shift)
    formed = coverage(moved(outline_of(shape, reach=6.0), known), PIXELS, PIXELS, SIGMA)
    centroid = np.array([(formed * PIXELS).sum(), (formed * PIXELS[:, None]).sum()]) / formed.sum()
    # 0.4 px are narrow for unit pixels; the sum over pixels of a Gaussian of 0.8 px is exact to 1e-5.
    np.testing.assert_allclose(centroid, known, rtol=0, atol=5e-5)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("fill", [1.0, 0.6])
def test_derivatives_agree_with_central_differences(shape: str, fill: float) -> None:
    outline, response, step = moved(outline_of(shape), np.array([0.2, -0.3])), PixelResponse(fill), 1e-4
    bend = np.stack([outline.xy[:, 1] ** 2 / 20, outline.xy[:, 0] / 3 - outline.xy[:, 1] / 5], axis=-1)
    share, derivatives = coverage_derivatives(outline, PIXELS, PIXELS, SIGMA, response, bend[None])
    np.testing.assert_allclose(share, coverage(outline, PIXELS, PIXELS, SIGMA, response), rtol=0, atol=1e-13)

    def bent(amount: float) -> Outline:
        # d(bend) along the outline: its derivatives by x and y times the tangent.
        dx, dy = outline.dxy[:, 0], outline.dxy[:, 1]
        turn = np.stack([outline.xy[:, 1] / 10 * dy, dx / 3 - dy / 5], axis=-1)
        return Outline(outline.xy + amount * bend, outline.dxy + amount * turn)

    def difference(of: dict[float, tuple[Outline, float]]) -> Array:
        plus, minus = (coverage(o, PIXELS, PIXELS, s, response) for o, s in of.values())
        return (plus - minus) / (2 * step)

    expected = [
        difference({k: (moved(outline, k * step * np.array(axis)), SIGMA) for k in (1, -1)})
        for axis in ((1.0, 0.0), (0.0, 1.0))
    ]
    expected.append(difference({k: (outline, SIGMA + k * step) for k in (1, -1)}))
    expected.append(difference({k: (bent(k * step), SIGMA) for k in (1, -1)}))
    # Truncation of the differences (1e-8) and the quadrature, whose derivatives are a little less exact.
    np.testing.assert_allclose(derivatives, np.array(expected), rtol=0, atol=2e-5)


def test_a_batch_equals_its_single_patches() -> None:
    outline = outline_of("cross")
    shifts = np.array([[0.1, 0.2], [-0.3, 0.4], [0.0, 0.0]])
    turns = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.9, 0.1], [-0.1, 1.1]], [[1.2, 0.0], [0.2, 0.8]]])
    sigma = np.array([0.7, 0.8, 0.9])
    together = coverage(
        outline.affine(turns, shifts), np.tile(PIXELS, (3, 1)), np.tile(PIXELS, (3, 1)), sigma
    )
    for k in range(3):
        one = coverage(outline.affine(turns[k], shifts[k]), PIXELS, PIXELS, float(sigma[k]))
        np.testing.assert_allclose(together[k], one, rtol=0, atol=1e-13)


def scattered_disks() -> Outline:
    centres = np.array([[12.3, 9.7], [40.25, 30.5], [-1.0, 25.0], [63.4, 47.2], [90.0, 5.0]])
    return outline_of("disk").affine(np.tile(np.eye(2), (5, 1, 1)), centres)


def test_a_drawing_is_the_sum_of_its_patches_also_across_the_border() -> None:
    disks, shape = scattered_disks(), (48, 64)
    expected = sum(
        coverage(Outline(xy, dxy), np.arange(64.0), np.arange(48.0), SIGMA)
        for xy, dxy in zip(disks.xy, disks.dxy, strict=True)
    )
    np.testing.assert_allclose(draw(disks, shape, SIGMA), expected, rtol=0, atol=1e-7)


def test_rows_can_be_shifted_one_by_one() -> None:
    disks, shape = scattered_disks(), (48, 64)
    shifts = np.random.default_rng(5).uniform(-0.24, 0.24, 48)  # up to 0.3 widths
    drawn = draw(disks, shape, SIGMA, row_shifts=shifts)
    for row in (9, 12, 25, 31, 46):
        still = draw(moved(disks, np.array([shifts[row], 0.0])), shape, SIGMA)
        np.testing.assert_allclose(drawn[row], still[row], rtol=0, atol=1e-4)


PERSPECTIVE = RationalPolynomial.projective().with_values(
    {"a1": 9.0, "b1": 1.5, "c1": 0.3, "a2": -1.0, "b2": -8.0, "c2": -0.2, "a0": 0.09, "b0": -0.06}
)


@pytest.mark.slow
def test_a_disk_in_perspective_agrees_with_supersampling() -> None:
    disk = mark_outline("disk", 1.4, None, SPACING / 12).mapped(lambda xy: PERSPECTIVE.derivatives(xy)[:2])
    step = 1 / 60
    at = np.arange(-14 + step / 2, 14, step)
    grid = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    back = PERSPECTIVE.inverse(grid)
    on_disk = (np.hypot(*back.T) < 0.7).reshape(len(at), len(at)).astype(float)
    weights = response_matrix(PIXELS, at, SIGMA, 1.0, step)
    formed = coverage(disk.oriented(), PIXELS, PIXELS, SIGMA)
    np.testing.assert_allclose(formed, weights @ on_disk @ weights.T, rtol=0, atol=1e-3)
    # The mapping mirrors: without turning the direction of travel around, light would be negative.
    np.testing.assert_allclose(coverage(disk, PIXELS, PIXELS, SIGMA), -formed, rtol=0, atol=1e-15)
    # And the centre of the image is not the image of the centre.
    centroid = np.array([(formed * PIXELS).sum(), (formed * PIXELS[:, None]).sum()]) / formed.sum()
    assert np.hypot(*(centroid - PERSPECTIVE([[0.0, 0.0]])[0])) > 0.2


def test_rectangles_agree_with_the_product_of_their_edges() -> None:
    edges = np.array([[1.0, 2.0, 4.5, 3.0], [6.0, 1.0, 6.5, 9.0]])
    batch = rectangles(edges, SPACING)
    for k, (x0, y0, x1, y1) in enumerate(edges):
        single = Outline.polygon(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), SPACING)
        formed = coverage(Outline(batch.xy[k], batch.dxy[k]), PIXELS, PIXELS, SIGMA)
        np.testing.assert_allclose(formed, coverage(single, PIXELS, PIXELS, SIGMA), rtol=0, atol=EXACT)


def drawn_grid(broken: Array | None = None) -> Array:
    x, y = np.array([10.3, 25.1, 44.0]), np.array([8.2, 20.7])
    return sum(
        (draw(piece, (32, 56), SIGMA) for piece in line_grid(x, y, 2.4, SPACING, beyond=60.0, broken=broken)),
        np.zeros((32, 56)),
    )


def test_a_line_grid_is_the_union_of_its_wires() -> None:
    # Of wires that run across the whole frame, the light beside them is a product of strips.
    columns, rows = np.arange(56.0), np.arange(32.0)
    between_x = 1 - sum(integral(x - 1.2, x + 1.2, columns, SIGMA) for x in (10.3, 25.1, 44.0))
    between_y = 1 - sum(integral(y - 1.2, y + 1.2, rows, SIGMA) for y in (8.2, 20.7))
    np.testing.assert_allclose(drawn_grid(), 1 - np.outer(between_y, between_x), rtol=0, atol=EXACT)


def test_a_broken_crossing_leaves_a_gap_halfway_to_its_neighbours() -> None:
    broken = np.zeros((2, 3), dtype=bool)
    broken[1, 1] = True
    whole, gap = drawn_grid(), drawn_grid(broken)
    assert gap[21, 25] < EXACT < 0.9 < whole[21, 25]
    assert gap[21, 22] < EXACT < 0.8 < gap[21, 15]  # 17.7 is half way from 25.1 to 10.3
    np.testing.assert_allclose(gap[:, :12], whole[:, :12], rtol=0, atol=EXACT)
    np.testing.assert_allclose(gap[:9], whole[:9], rtol=0, atol=EXACT)


def test_a_line_grid_keeps_its_crossings_under_a_mapping() -> None:
    def bent(xy: Array) -> tuple[Array, Array]:
        x, y = xy.T
        value = np.stack([30 + 9 * x + 0.1 * y * y, 24 - 8 * y + 0.15 * x * y], axis=1)
        slope = np.stack([np.stack([0 * x + 9, 0.2 * y], -1), np.stack([0.15 * y, 0.15 * x - 8], -1)], 1)
        return value, slope

    grid = line_grid([-2.0, 0.0, 2.0], [-1.5, 0.5], 0.25, SPACING / 10, beyond=3.0)
    formed = sum((draw(piece.mapped(bent).oriented(), (48, 60), SIGMA) for piece in grid), np.zeros((48, 60)))
    at = bent(np.array([[0.0, 0.5]]))[0][0]
    column, row = np.rint(at).astype(int)
    columns, rows = np.arange(column - 5.0, column + 6), np.arange(row - 5.0, row + 6)
    cross = mark_outline("line-grid", 0.0, 0.25, SPACING / 10, 1.9)
    single = moved(cross, np.array([0.0, 0.5])).mapped(bent).oriented()
    np.testing.assert_allclose(
        formed[row - 5 : row + 6, column - 5 : column + 6],
        coverage(single, columns, rows, SIGMA),
        rtol=0,
        atol=EXACT,
    )


def test_impossible_shapes_are_refused() -> None:
    with pytest.raises(UsageError, match="no mark of shape"):
        mark_outline("star", 1.0, None, 0.1)
    with pytest.raises(UsageError, match="line_width"):
        mark_outline("cross", 1.0, None, 0.1)
    with pytest.raises(UsageError, match="wires of a line grid"):
        line_grid([0.0, 1.0, 0.5], [0.0, 1.0], 0.1, 0.1)
    with pytest.raises(UsageError, match="no crossing"):
        line_grid([0.0, 1.0], [0.0], 0.1, 0.1, broken=np.ones((1, 2), dtype=bool))


def union_of(upright: Wires, level: Wires, half: float, shape: tuple[int, int], fine: int = 16) -> Array:
    """Share of the pixels on wires, counted at fine points of wires drawn as distances from their lines."""
    row, column = ((np.arange(n * fine) + 0.5) / fine - 0.5 for n in shape)
    at = np.stack(np.meshgrid(column, row), axis=-1)
    covered = np.zeros(at.shape[:2], dtype=bool)
    for wires in (upright, level):
        for angle, offset, bend in zip(wires.angle, wires.offset, wires.bend, strict=True):
            u = np.array([np.cos(angle), np.sin(angle)])
            t, away = at @ u, at @ np.array([-u[1], u[0]])
            # To the second order of the bend, the distance from a parabola.
            covered |= np.abs(away - offset - bend * t**2 / 2) < half * np.sqrt(1 + (bend * t) ** 2)
    blurred = gaussian_filter(covered.astype(float), SIGMA * fine, mode="nearest", truncate=6)
    return blurred.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))


def slanted(bend: float = 0.0) -> tuple[Wires, Wires]:
    """Three wires along y and two along x, skew and turned by several degrees, in a frame of 32 × 56."""
    upright = Wires(np.deg2rad([94.0, 88.0, 97.0]), np.array([-9.0, -25.0, -40.0]), np.full(3, bend))
    level = Wires(np.deg2rad([-3.0, 5.0]), np.array([9.0, 18.0]), np.full(2, -bend))
    return upright, level


@pytest.mark.parametrize("bend", [0.0, 1e-3])
def test_wires_of_any_direction_are_the_union_of_their_strips(bend: float) -> None:
    upright, level = slanted(bend)
    pieces = wire_grid(upright, level, 2.4, SPACING, beyond=60.0)
    formed = sum((draw(piece.oriented(), (32, 56), SIGMA) for piece in pieces), np.zeros((32, 56)))
    inner = (slice(4, -4), slice(4, -4))  # the blur of the fine picture repeats its border
    np.testing.assert_allclose(
        formed[inner], union_of(upright, level, 1.2, (32, 56))[inner], rtol=0, atol=0.01
    )


def test_wires_along_the_axes_are_a_line_grid() -> None:
    zero = np.zeros(3)
    # The direction of an upright wire is y: its left side has smaller x.
    upright = Wires(np.full(3, np.pi / 2), -np.array([10.3, 25.1, 44.0]), zero)
    level = Wires(np.zeros(2), np.array([8.2, 20.7]), zero[:2])
    broken = np.zeros((2, 3), dtype=bool)
    broken[1, 1] = True
    for missing in (None, broken):
        pieces = wire_grid(upright, level, 2.4, SPACING, beyond=60.0, broken=missing)
        formed = sum((draw(piece.oriented(), (32, 56), SIGMA) for piece in pieces), np.zeros((32, 56)))
        np.testing.assert_allclose(formed, drawn_grid(missing), rtol=0, atol=EXACT)


def test_wires_in_another_order_or_without_a_crossing_are_refused() -> None:
    upright, level = slanted()
    turned = Wires(upright.angle[::-1], upright.offset[::-1], upright.bend)
    with pytest.raises(UsageError, match="ascend along each other"):
        wire_grid(turned, level, 2.4, SPACING)
    with pytest.raises(UsageError, match="no crossing"):
        wire_grid(upright, level, 2.4, SPACING, broken=np.ones((2, 3), dtype=bool))


def test_responses_of_adjacent_pixels_are_those_of_a_blurred_step():
    rng = np.random.default_rng(5)
    pixels = np.arange(27.0) + rng.integers(0, 900, (40, 1))
    points = pixels[:, :1] + rng.uniform(-12, 40, (40, 30))
    sigma = rng.uniform(0.05, 2.5, 40)[:, None, None]
    found = PixelResponse().orders(pixels, points, sigma, 1)
    far, near = (pixels[:, None] + end - points[..., None] for end in (0.5, -0.5))
    steps = [ndtr(t / sigma) for t in (far, near)]
    bells = [np.exp(-0.5 * (t / sigma) ** 2) / np.sqrt(2 * np.pi) for t in (far, near)]
    whole = [t * step + sigma * bell for t, step, bell in zip((far, near), steps, bells, strict=True)]
    for part, (after, before) in zip(found, (whole, steps, [b / sigma for b in bells]), strict=True):
        assert np.abs(part - (after - before)).max() < 3e-14 / sigma.min()
