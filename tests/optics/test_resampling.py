"""Resampling: exact positions, bounded memory, types kept."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.optics import RationalPolynomial
from reseau.optics.formation import draw, mark_outline
from reseau.optics.resampling import on_lattice, resample

BARREL = RationalPolynomial(
    {"k": {"X": "x3 + xy2", "Y": "y3 + yx2"}},
    [0.06],
    {"X": "x", "Y": "y"},
    offset=(300.0, 200.0),
    scale=300.0,
)


def barrel(xy: Array) -> Array:
    """Pixels to pixels, up to 40 px of distortion."""
    return BARREL(xy) * 300.0 + [300.0, 200.0]


def test_interpolation_between_lattice_points_is_accurate_to_a_millionth_of_a_pixel() -> None:
    columns, rows = np.arange(20.0, 600.0), np.arange(0.0, 400.0)
    x, y = on_lattice(barrel, columns, rows)
    exact = barrel(np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)).reshape(400, 580, 2)
    np.testing.assert_allclose(np.stack([x, y], -1), exact, rtol=0, atol=1e-6)


def test_near_undefined_values_every_pixel_is_evaluated() -> None:
    def half(xy: Array) -> Array:
        return np.where(xy[:, :1] < 30.4, xy, np.nan)

    x, _ = on_lattice(half, np.arange(60.0), np.arange(20.0))
    assert np.isfinite(x[:, :31]).all()
    assert np.isnan(x[:, 31:]).all()


def test_a_disk_is_resampled_to_its_mapped_position() -> None:
    disk = mark_outline("disk", 12.0, None, 0.5)
    at = np.array([[420.3, 300.6]])
    source = 1000 + 50000 * draw(disk.affine(np.eye(2)[None], at), (400, 600), 1.2)
    corrected = np.concatenate(list(resample(source, barrel, (400, 600))))
    weight = corrected - 1000
    weight[corrected < 1500] = 0  # beyond the reach of the source there are zeros
    rows, columns = np.mgrid[:400, :600]
    centroid = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    # The disk is sheared a little; its centre of gravity moves by second derivatives, 0.003 px here.
    np.testing.assert_allclose(barrel(centroid[None])[0], at[0], rtol=0, atol=0.01)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32])
def test_types_are_kept_and_the_identity_changes_nothing(dtype: type) -> None:
    pixels = (np.random.default_rng(1).random((70, 1100)) * 127).astype(dtype)
    bands = list(resample(pixels, lambda xy: xy, pixels.shape, band=32))
    assert [len(b) for b in bands] == [32, 32, 6]
    result = np.concatenate(bands)
    assert result.dtype == dtype
    np.testing.assert_allclose(result, pixels, rtol=0, atol=0 if np.dtype(dtype).kind in "ui" else 1e-4)


def test_values_are_clipped_to_the_type_and_zero_outside_the_image() -> None:
    edge = np.zeros((40, 40), dtype=np.uint8)
    edge[:, 20:] = 255
    shifted = np.concatenate(list(resample(edge, lambda xy: xy + np.array([0.5, 0.0]), (40, 60))))
    assert shifted[:, 18].max() < 40  # the spline's undershoot does not wrap around
    assert shifted[:, 25:39].min() > 200
    assert not shifted[:, 40:].any()


@pytest.mark.slow
def test_memory_is_limited_to_one_band() -> None:
    pixels = np.zeros((3000, 3000), dtype=np.uint16)
    tracemalloc.start()
    for _ in resample(pixels, lambda xy: xy + 0.25, pixels.shape):
        pass
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 40e6  # a float copy of the whole has 72 MB
