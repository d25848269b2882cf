"""Matching of the targets of a testfield with their formed images, all of a frame together.

The image of a target is formed with the mapping through the lines, to second order. The estimate is the image
of its centroid, so the offset of the centroid of the image caused by perspective does no harm. The light
attenuated or added by neighbours and lines within a window is formed, too, and subtracted. The illumination
of the board is modelled by polynomials over the frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...io import TestfieldDesign
from ...optics.composition import Chain
from ...optics.formation import PixelResponse
from ..matching import Matches, Shape, match
from ..matching.patches import MatchOptions, add_windows
from ..matching.shapes import FormedShape, ShapeSubset, Window
from ..plane.lattice_images import shade_lines
from ..plane.lattice_mapping import images_of, slope_of
from ..plane.polynomial import median
from .light import attenuate, bends, illumination, without_own
from .motion import MovedShape, steps_of
from .target_images import form_targets


@dataclass(frozen=True, eq=False)
class Light:
    """Illumination of a testfield, as polynomials of second degree over the frame.

    Parameters
    ----------
    level, contrast : ndarray (6,)
        Coefficients of the grey value of the background, and of the contrast of a mark.
    size : (float, float)
        Width and height of the frame.
    """

    level: Array
    contrast: Array
    size: tuple[float, float]

    @classmethod
    def through(cls, xy: Array, level: Array, contrast: Array, size: tuple[float, float]) -> Light:
        """Fit to values at points (n, 2), twice: the second time without outliers."""
        level, contrast = illumination(_quadratic(xy, size), np.stack([level, contrast]), _UNDETERMINED)
        return cls(level, contrast, size)

    def at(self, xy: Array) -> tuple[Array, Array]:
        """Level and contrast (n,) at points (n, 2)."""
        design = _quadratic(xy, self.size)
        return design @ self.level, design @ self.contrast


def _quadratic(xy: Array, size: tuple[float, float]) -> Array:
    u, v = xy[:, 0] * (2 / size[0]) - 1, xy[:, 1] * (2 / size[1]) - 1
    design = np.ones((6, len(xy)))
    design[1], design[2] = u, v
    np.multiply(u, design[1:3], out=design[3:5])
    np.multiply(v, v, out=design[5])
    return design.T


_UNDETERMINED = 1e-12
"""Weight of the coefficients of the illumination as observations of zero, relative to that of the points."""
_AT_ONCE = 160_000
"""Number of pixels in the windows of targets matched together; their images fit into the cache of a
processor."""
_FOREIGN, _SHADE, _SHIFT_PX = 4.0, 0.03, 0.25
"""A pixel shows something else if it differs from the predicted image by more than this multiple of the
noise, this share of the light, and the effect of a shift by this distance."""
_FLAT, _LEAST_FLAT = 0.2, 500
"""A pixel is flat if the jitter of rows is at most this share of the noise; minimum number of flat pixels."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame and everything known about the testfield in it, for matching targets.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    noise : float
        Standard deviation of the grey values.
    design : TestfieldDesign
        The testfield.
    mapping : Chain
        From lattice coordinates to the image.
    frame, origin : ndarray (2, 2), (2,)
        Lattice coordinates are `frame` times those of the design, plus `origin`.
    light : Light
        Illumination.
    psf_px : float
        Width of the point-spread function.
    response : PixelResponse
        Response of a pixel.
    row_jitter_px : float
        Standard deviation of the shift of a row.
    path : ndarray (2,)
        Path of the images during the exposure, pixels.
    """

    grey: NDArray[np.float32]
    valid: Mask
    noise: float
    design: TestfieldDesign
    mapping: Chain
    frame: Array
    origin: Array
    light: Light
    psf_px: float
    response: PixelResponse
    row_jitter_px: float
    path: Array = field(default_factory=lambda: np.zeros(2))

    def lattice(self, xy: Array) -> Array:
        """Lattice coordinates (n, 2) of points of the design (n, 2)."""
        return np.asarray(xy @ self.frame.T + self.origin)

    def through(self, valid: Mask) -> Scene:
        """The same with other pixels that may be used."""
        scene = replace(self, valid=valid)
        scene.__dict__["line_light"] = self.line_light
        return scene

    @cached_property
    def line_light(self) -> NDArray[np.float32]:
        """Grey values that the lines attenuate or add, (h, w)."""
        return _line_light(self)


def match_targets(
    scene: Scene,
    rows: Rows,
    inside: Mask,
    background: int = 1,
    *,
    searching: bool = True,
    contrast_slope: float | None = None,
    residuals: bool = False,
) -> Matches:
    """Match targets of the design.

    Parameters
    ----------
    scene : Scene
        The frame.
    rows : ndarray of int (k,)
        All targets whose light falls into the frame.
    inside : ndarray of bool (k,)
        Which of them to measure.
    background : int
        Degree of the polynomial of the background around each target.
    searching : bool
        Whether to search for blunders in windows with large residuals; see
        :func:`reseau.measure.matching.match`.
    contrast_slope : float, optional
        Standard deviation of the change of contrast over half a window; by default it is constant.
    residuals : bool
        Whether the residuals are wanted.

    Returns
    -------
    Matches
        The n measured targets, in their order; residuals have the size of the largest window, or of none.
    """
    parts, found = _Canvas.of(scene, rows, inside).match(background, searching, contrast_slope)
    if not residuals:
        # For all targets of a frame they take more memory, and time, than everything else.
        found = [replace(matches, residuals=np.empty((len(matches), 0, 0))) for matches in found]
    return merged(parts, found)


def pixels_of_targets(scene: Scene, rows: Rows, inside: Mask, level: Array) -> tuple[Mask, Array]:
    """Pixels (h, w) to be used in the windows of targets, and the share (n,) of each target on such pixels.

    Pixels that show something in front of the targets are not used.

    Parameters
    ----------
    scene, rows, inside
        As for :func:`match_targets`.
    level : ndarray (n,)
        Grey value of the background at each of the n targets.
    """
    canvas = _Canvas.of(scene, rows, inside)
    differing, seen = canvas.differing(level)
    foreign = cv2.morphologyEx(differing, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    reach = int(np.ceil(2 * scene.psf_px + np.hypot(*scene.path) / 2))
    foreign = cv2.dilate(foreign, np.ones((2 * reach + 1,) * 2, np.uint8))
    valid = np.asarray(scene.valid & ~((foreign > 0) & seen))
    return valid, canvas.shares(valid)


def _around(scene: Scene, rows: Rows, inside: Mask) -> tuple[Rows, Mask]:
    """Targets to measure, and those whose light falls into the windows of these."""
    at = scene.lattice(scene.design.xy[rows])
    xy, slope = images_of(scene.mapping, at), slope_of(scene.mapping, at) @ scene.frame
    # No outline reaches farther from its centroid than 0.6 of its size.
    reach = np.abs(slope).sum(axis=2) * (0.6 * scene.design.sizes[rows, None])
    keep, large = inside.copy(), scene.design.large[rows]
    for one, other in product((large, ~large), repeat=2):
        mine, others = one & inside, np.flatnonzero(other & ~keep)
        if mine.any() and len(others):
            # Windows have the size of the largest one, and begin at whole pixels; see `_Canvas`.
            far = _half(scene, reach[mine].max(axis=0)) + _half(scene, reach[others]) + 1.0
            across, down = (np.abs(xy[others, k, None] - xy[mine, k]) < far[:, k, None] for k in (0, 1))
            keep[others] = (across & down).any(axis=1)
    return rows[keep], inside[keep]


def _half(scene: Scene, reach: Array) -> Rows:
    """Half the width and height (..., 2) of the windows of targets that reach so far."""
    wide = np.ceil(reach + np.abs(scene.path) / 2 + 2.5 * scene.psf_px + 1.0)
    return np.asarray(wide, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class _Part:
    """Targets of similar size: those to measure (n,), half windows, light of each, formed images."""

    rows: Rows
    half: Rows
    own: Array
    formed: Shape


class _Canvas:
    """Light that the marks of a testfield attenuate or add, and matching of each without the others."""

    def __init__(
        self, scene: Scene, images: Shape, xy: Array, reach: Array, large: Mask, wanted: Mask
    ) -> None:
        self.scene, self.images, self.xy = scene, images, xy
        self.total = scene.line_light.copy()
        self.parts: list[_Part] = []
        for size in (False, True):
            of = large == size
            if of.any():
                half = _half(scene, reach[of].max(axis=0))
                self._lay(np.flatnonzero(of & ~wanted), half)
                mine = np.flatnonzero(of & wanted)
                parts = -(-len(mine) * int(np.prod(2 * half + 1)) // _AT_ONCE)
                for some in np.array_split(mine, parts) if len(mine) else []:
                    self.parts.append(self._lay(some, half, wanted=True))

    @classmethod
    def of(cls, scene: Scene, rows: Rows, inside: Mask) -> _Canvas:
        """The canvas of some targets and of all whose light falls into their windows."""
        if not inside.all():
            rows, inside = _around(scene, rows, inside)
        at = scene.lattice(scene.design.xy[rows])
        formed, xy, reach = form_targets(scene.design, rows, scene.mapping, scene.frame, at, scene.psf_px)
        images: Shape = formed
        if scene.path.any():
            images = MovedShape(formed, scene.path)
        return cls(scene, images, xy, reach, scene.design.large[rows], inside)

    def differing(self, level: Array) -> tuple[NDArray[np.uint8], Mask]:
        """Pixels (h, w) of windows that differ from the predicted image, and all pixels of windows."""
        scene, sign = self.scene, -1.0 if self.scene.design.polarity == "dark" else 1.0
        differ, seen = np.zeros(self.total.shape, np.uint8), np.zeros(self.total.shape, dtype=bool)
        order = np.sort(np.concatenate([part.rows for part in self.parts]))
        for part in self.parts:
            column, row = self._pixels(part)
            y, x = row[:, :, None], column[:, None, :]
            light = level[np.searchsorted(order, part.rows), None, None]
            ink = self.total[y, x]
            tolerance = _FOREIGN * scene.noise + _SHADE * np.abs(light)
            tolerance = tolerance + _SHIFT_PX * np.hypot(*np.gradient(ink, axis=(1, 2)))
            np.maximum.at(differ, (y, x), np.abs(scene.grey[y, x] - light - sign * ink) > tolerance)
            seen[y, x] = True
        return differ, seen

    def shares(self, valid: Mask) -> Array:
        """Share (n,) of each measured target on valid pixels."""
        found: list[Array] = []
        for part in self.parts:
            column, row = self._pixels(part)
            used = part.own * valid[row[:, :, None], column[:, None, :]]
            found.append(used.sum(axis=(1, 2)) / part.own.sum(axis=(1, 2)))
        return np.concatenate(found)[np.argsort(np.concatenate([part.rows for part in self.parts]))]

    def _pixels(self, part: _Part) -> tuple[Rows, Rows]:
        """Columns (k, c) and rows (k, r) of the windows of targets, in the frame."""
        (h, w), half, centre = self.total.shape, part.half, np.rint(self.xy[part.rows]).astype(np.intp)
        column, row = (
            (centre[:, k, None] + np.arange(-half[k], half[k] + 1)).clip(0, size - 1)
            for k, size in ((0, w), (1, h))
        )
        return column, row

    def _lay(self, part: Rows, half: Rows, *, wanted: bool = False) -> _Part:
        """Add the light of some targets to the sum; derivatives are formed for those to be measured."""
        xy = self.xy[part]
        centre = np.rint(xy)
        right, down = (np.arange(-n, n + 1.0) for n in half)
        window = Window(centre[:, :1] + right, centre[:, 1:] + down, self.scene.response)
        width, form = np.full(len(part), self.scene.psf_px), np.zeros((len(part), 1))
        formed: Shape = ShapeSubset(self.images, part)
        if wanted:
            share, slopes = self.images.derivatives(xy, width, form, part, window)
            formed = FormedShape(formed, xy, width, share, slopes)
        else:
            share = self.images.image(xy, width, form, part, window)
        own = self.scene.light.at(xy)[1].astype(np.float32)[:, None, None] * share
        add_windows(self.total, own, centre.astype(np.intp) - half)
        return _Part(part, half, own, formed)

    def match(
        self, background: int, searching: bool, contrast_slope: float | None
    ) -> tuple[list[Rows], list[Matches]]:
        """Match small and large targets in windows of one size each: their indices and matches."""
        noise = self._noise()
        return [part.rows for part in self.parts], [
            self._match(part, background, noise, searching, contrast_slope) for part in self.parts
        ]

    def _noise(self) -> float:
        """Noise where the image is flat; elsewhere the jitter of rows would add to it."""
        scene = self.scene
        if scene.row_jitter_px == 0:
            return scene.noise
        sign = 1.0 if scene.design.polarity == "dark" else -1.0
        limit = 2 * _FLAT * scene.noise / scene.row_jitter_px
        near = np.zeros(self.total.shape, dtype=bool)
        for part in self.parts:
            column, row = self._pixels(part)
            near[row[:, :, None], column[:, None, :]] = True
        bend = bends(scene.grey, self.total, near & scene.valid, sign, limit)
        if len(bend) < _LEAST_FLAT:
            return scene.noise
        # The median of normal deviates is 0.6745 of their σ; the variance of such a difference is 3/2 σ².
        return median(bend) / (0.6745 * float(np.sqrt(1.5)))

    def _match(
        self,
        part: _Part,
        background: int,
        noise: float,
        searching: bool,
        contrast_slope: float | None,
    ) -> Matches:
        scene, half = self.scene, part.half
        centre = np.rint(self.xy[part.rows]).astype(np.intp)
        others = np.empty(part.own.shape, np.float32)
        dark = scene.design.polarity == "dark"
        without_own(self.total, centre - half, part.own, -1.0 if dark else 1.0, others)
        options = MatchOptions(
            half_px=(int(half[0]), int(half[1])),
            psf_px=scene.psf_px,
            psf_log_sigma=0.3,
            response=scene.response,
            polarity=scene.design.polarity,
            row_jitter_px=scene.row_jitter_px,
            start_px=0.3,
            settled=0.1,
            background=background,
            contrast_slope=contrast_slope,
        )
        # Slopes across half a window, in the order of the matcher's monomials: 1, v, u.
        steps = np.array([[0.0, 0.0], [half[0], 0.0], [0.0, half[1]]])
        levels, amplitudes = scene.light.at((centre + steps[:, None]).reshape(-1, 2))
        (level, right, down), amplitude = levels.reshape(3, -1), amplitudes[: len(centre)]
        right, down = right - level, down - level
        contrast = amplitude / level if dark else amplitude
        return match(
            scene.grey,
            scene.valid,
            part.formed,
            self.xy[part.rows],
            options,
            noise=noise,
            form_sigma=np.array([0.05]),
            others=others,
            light=(contrast, np.stack([level, down, right], axis=1)) if background == 1 else None,
            searching=np.inf if searching else 0.0,
        )


def _line_light(scene: Scene) -> NDArray[np.float32]:
    """Grey values that the lines attenuate or add, (h, w)."""
    h, w = scene.grey.shape
    lines, free = scene.design.lines, np.ones((h, w), np.float32)
    x0, y0, x1, y1 = lines.extent
    count = max(h, w) // 4
    # The square of a pixel has the same variance in all directions.
    blur = float(np.hypot(scene.psf_px, scene.response.fill / np.sqrt(12)))
    steps, longest = steps_of(scene.path), float(np.hypot(*scene.path)) / 2
    for axis, places in ((0, lines.vertical_x), (1, lines.horizontal_y)):
        # Points of the board on every line, and beside it.
        on = np.empty((2, len(places), count, 2))
        on[..., 1 - axis] = np.linspace(*((y0, y1) if axis == 0 else (x0, x1)), count)
        on[..., axis] = np.array(places)[:, None] + np.array([0.0, lines.width])[:, None, None]
        nodes, beside = images_of(scene.mapping, scene.lattice(on.reshape(-1, 2))).reshape(on.shape)
        shade_lines(free, nodes, beside, steps, longest, blur)
    attenuate(free, scene.light.contrast, np.array(scene.light.size))
    return free


def merged(parts: list[Rows], found: list[Matches]) -> Matches:
    """Matches of several parts in the order of their rows; smaller windows are padded."""
    order = np.argsort(np.concatenate(parts), kind="stable")
    # Windows of large marks take much memory: they are copied only where it is necessary.
    ordered = bool((np.diff(order) > 0).all())
    columns: dict[str, Any] = {}
    for name in Matches.__dataclass_fields__:
        values = [getattr(matches, name) for matches in found]
        if len({v.shape[1:] for v in values}) > 1:
            values = _padded(values, np.nan if name == "residuals" else 0.0)
        joined = values[0] if len(values) == 1 else np.concatenate(values)
        columns[name] = joined if ordered else joined[order]
    return Matches(**columns)


def _padded(values: list[Array], outside: float) -> list[Array]:
    """Images (n, r, c) of different sizes in the middle of images of one size."""
    shape = tuple(max(sides) for sides in zip(*(v.shape[1:] for v in values), strict=True))
    padded = []
    for v in values:
        column = np.full((len(v), *shape), outside, v.dtype)
        inner = tuple(slice((m - n) // 2, (m + n) // 2) for m, n in zip(shape, v.shape[1:], strict=True))
        column[(slice(None), *inner)] = v
        padded.append(column)
    return padded


def replaced(found: Matches, keep: Mask, others: Matches) -> Matches:
    """The matches to keep (n,), and others in the places of the remaining ones."""
    return merged([np.flatnonzero(keep), np.flatnonzero(~keep)], [found.select(keep), others])
