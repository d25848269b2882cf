"""Real frames of vidicon cameras, and what can be said about marks measured in them without a truth.

The frames (NASA, public domain) lie in $RESEAU_DATA/reseau with the positions that NASA's RESLOC found and,
for two of them, the frame as NASA corrected it. Object space there has 84.821428 px/mm and VICAR counts its
samples from 1, so that the pixel p, counted from 0, shows the point (p + 1)/84.821428 mm.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import map_coordinates

from reseau.core.data import Array, Frame, Mask
from reseau.io import ReseauDesign
from reseau.io.images import read_image
from reseau.measure.screening import screen
from reseau.optics.field import SmoothField
from reseau.optics.resampling import on_lattice

__all__ = [
    "Agreement", "RealFrame", "agreement", "collocation", "data_directory", "inner_marks", "leave_one_out",
    "load", "names", "piecewise_linear"
]  # fmt: skip

PX_PER_MM = 84.821428
NEAR_MARK_PX = 7
PATCH_PX, STEP_PX, SEARCH_PX = 41, 25, 3
LEAST_CORRELATION = 0.5
BAND_PX = (0.5, 3.0)
"""Widths of the Gaussians between which the texture lies. Finer, and the interpolation of either frame draws
the maxima towards whole pixels; coarser, and the dark frame that NASA took off is compared in the sky."""
ToFrame = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class RealFrame:
    """A frame, its design, positions (n, 2) by others (NaN where rejected), and NASA's corrected frame."""

    name: str
    frame: Frame
    design: ReseauDesign
    others: dict[str, Array]
    corrected: Array | None


@dataclass(frozen=True, eq=False)
class Agreement:
    """Displacements (m, 2) of patches of NASA's corrected frame against the frame resampled by marks."""

    patches: Array
    displacement: Array

    @property
    def median(self) -> Array:
        """Median per axis, object pixels."""
        return np.median(self.displacement, axis=0)

    @property
    def mad(self) -> Array:
        """Median absolute deviation per axis, not scaled, object pixels."""
        return np.median(np.abs(self.displacement - self.median), axis=0)


def data_directory() -> Path:
    root = os.environ.get("RESEAU_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data")
    return Path(root) / "reseau"


def names(directory: Path | None = None) -> list[str]:
    found = sorted((directory or data_directory()).glob("*.design.json"))
    return [path.name.removesuffix(".design.json") for path in found]


def load(name: str, directory: Path | None = None) -> RealFrame:
    import tifffile

    directory = directory or data_directory()
    design = ReseauDesign.read(directory / f"{name}.design.json")
    reference = json.loads((directory / f"{name}.reference.json").read_text("utf-8"))
    others = {
        key.removesuffix("_resloc"): np.array(
            [reference[key][mark] or [np.nan, np.nan] for mark in design.ids], dtype=float
        )
        for key in ("vicar_resloc", "pds_resloc")
        if reference.get(key)
    }
    corrected = next(directory.glob(f"{name}*GEOM*.tif"), None)
    return RealFrame(
        name,
        read_image(directory / f"{name}.png"),
        design,
        others,
        None if corrected is None else tifffile.imread(corrected).astype(float),
    )


def leave_one_out(design_xy: Array, xy: Array, degree: int | None = None) -> Array:
    """Deviations (n, 2) of points from what the others predict.

    By collocation, or by a polynomial of some degree alone.
    """
    if degree is None:
        return SmoothField.fit(design_xy, xy).leave_one_out()[0]
    return SmoothField.fit(design_xy, xy, degree=degree, local=False).leave_one_out()[0]


def inner_marks(design: ReseauDesign) -> Mask:
    """Those further from the border of the design than 0.65 mm: 118 of the 202 of Voyager."""
    low, high = design.xy.min(axis=0), design.xy.max(axis=0)
    return np.minimum(design.xy - low, high - design.xy).min(axis=1) > 0.65


def collocation(design_xy: Array, xy: Array) -> ToFrame:
    """From the design to the frame by a smooth field through the marks."""
    known = np.isfinite(xy).all(axis=1)
    return SmoothField.fit(design_xy[known], xy[known])


def piecewise_linear(design_xy: Array, xy: Array) -> ToFrame:
    """From the design to the frame, linear in each triangle of marks, as NASA's program interpolates."""
    known = np.isfinite(xy).all(axis=1)
    return LinearNDInterpolator(design_xy[known], xy[known])


def agreement(case: RealFrame, to_frame: ToFrame) -> Agreement:
    """Compare the frame, resampled into object space, with NASA's corrected frame by their texture.

    NASA's frame has its marks painted over and its grey values calibrated, but the grain of the raw frame
    survives in both. Normalised cross-correlation of band-passed patches, without the pixels near marks and
    those that are empty in either, has its maximum where the two agree; the displacement is where a patch of
    NASA's frame lies relative to that of ours. A displacement of 0.3 px is seen as 0.25 px: what is left of
    the draw towards whole pixels.
    """
    assert case.corrected is not None
    nasa = case.corrected
    height, width = nasa.shape
    ours, seen = _resampled(case.frame, to_frame, nasa.shape)
    filled = cv2.erode((nasa != 0).astype(np.uint8) ^ 1, np.ones((3, 3), np.uint8)) == 0
    away = np.ones(nasa.shape, dtype=np.uint8)
    for x, y in np.rint(case.design.xy * PX_PER_MM - 1).astype(int).tolist():
        cv2.circle(away, (x, y), NEAR_MARK_PX, 0, -1)
    clear = away.astype(bool)
    a, mask_a = _band_passed(nasa, filled & clear)
    b, mask_b = _band_passed(ours, seen & clear)
    half = PATCH_PX // 2 + SEARCH_PX
    rows, columns = np.arange(half, height - half, STEP_PX), np.arange(half, width - half, STEP_PX)
    shifts = np.arange(-SEARCH_PX, SEARCH_PX + 1)
    scores = np.array(
        [
            [_correlation(a, mask_a, b, mask_b, dx, dy)[np.ix_(rows, columns)] for dx in shifts]
            for dy in shifts
        ]
    )
    scores = np.moveaxis(scores, (0, 1), (2, 3)).reshape(-1, len(shifts), len(shifts))
    at = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return _peaks(scores, at)


def _resampled(frame: Frame, to_frame: ToFrame, shape: tuple[int, ...]) -> tuple[Array, Mask]:
    columns, rows = (np.arange(float(size)) for size in shape[::-1])

    def at_pixels(xy: Array) -> Array:
        return to_frame((xy + 1) / PX_PER_MM)

    if isinstance(to_frame, SmoothField):
        x, y = on_lattice(at_pixels, columns, rows)
    else:
        x, y = at_pixels(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)).T.reshape(2, *shape)
    at = np.nan_to_num(np.stack([y, x]), nan=-1e3)
    screened = screen(frame, run=15)
    grey = map_coordinates(frame.pixels.astype(float), at, order=3, mode="nearest")
    seen = map_coordinates(screened.valid.astype(float), at, order=1, cval=0.0) > 0.999
    return grey, seen


def _band_passed(image: Array, mask: Mask) -> tuple[Array, Array]:
    weight = mask.astype(float)
    fine, coarse = (
        cv2.GaussianBlur(image * weight, (0, 0), width)
        / np.maximum(cv2.GaussianBlur(weight, (0, 0), width), 1e-6)
        for width in BAND_PX
    )
    return (fine - coarse) * weight, weight


def _correlation(a: Array, mask_a: Array, b: Array, mask_b: Array, dx: int, dy: int) -> Array:
    """Normalised cross-correlation of the patches of `a`, displaced by (dx, dy), with those of `b`."""

    def box(image: Array) -> Array:
        return cv2.boxFilter(image, -1, (PATCH_PX, PATCH_PX), normalize=False)

    a, mask_a = (np.roll(image, (-dy, -dx), (0, 1)) for image in (a, mask_a))
    both = mask_a * mask_b
    n = np.maximum(box(both), 1.0)
    a, b = a * both, b * both
    mean_a, mean_b = box(a) / n, box(b) / n
    spread = (box(a * a) / n - mean_a**2) * (box(b * b) / n - mean_b**2)
    score = (box(a * b) / n - mean_a * mean_b) / np.sqrt(np.maximum(spread, 1e-12))
    return np.where(n > 0.6 * PATCH_PX**2, score, np.nan)


def _peaks(scores: Array, at: Array) -> Agreement:
    """Vertices of parabolas through the best displacement of each patch."""
    known = np.isfinite(scores).all(axis=(1, 2))
    scores, at = scores[known], at[known]
    row, column = np.divmod(scores.reshape(len(scores), -1).argmax(axis=1), scores.shape[2])
    each = np.arange(len(scores))
    last = scores.shape[1] - 1
    good = (scores[each, row, column] > LEAST_CORRELATION) & (row % last > 0) & (column % last > 0)
    scores, at, row, column, each = scores[good], at[good], row[good], column[good], each[: good.sum()]

    def vertex(before: Array, best: Array, after: Array) -> Array:
        return 0.5 * (before - after) / (before - 2 * best + after)

    best = scores[each, row, column]
    dx = vertex(scores[each, row, column - 1], best, scores[each, row, column + 1])
    dy = vertex(scores[each, row - 1, column], best, scores[each, row + 1, column])
    return Agreement(at, np.stack([column + dx, row + dy], axis=1) - SEARCH_PX)
