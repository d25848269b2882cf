"""Targets of a testfield matched with their formed images, all of a frame together.

A target's image is formed as the mapping through the lines has it there, to second order: the image of its
centroid is estimated, so that the perspective, which puts the centroid of the image elsewhere, does no harm.
What its neighbours and the lines take of the light in its window is formed too, and taken off.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ...data import Array, Mask, Rows
from ...formats import TestfieldDesign
from ...optics import Chain
from ...optics.formation import Outline, PixelResponse, coverage, coverage_derivatives
from ...optics.targets import target_outline
from ..matching import Matches, MatchOptions, Some, Window, match
from .lattice import second_order
from .light import Light
from .profiles import blur_of, crossings, strip

__all__ = ["Scene", "TargetImages", "match_targets", "merged"]

_SPACING = 1.1
"""Distance of nodes on an outline in widths of the point-spread function: good to 1e-4 of the light."""


@dataclass(frozen=True, eq=False)
class TargetImages:
    """Images of unlike targets, each kind with as many nodes as it needs; a shape for the matcher.

    Parameters
    ----------
    kinds : tuple of Outline
        Outlines (m, j, 2) of the targets of each kind, in single precision.
    kind, row : ndarray of int (k,)
        Of which kind each target is, and which of that kind.
    """

    kinds: tuple[Outline, ...]
    kind: Rows
    row: Rows

    @property
    def parameters(self) -> int:
        """One: all grow by a share."""
        return 1

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.refine.shapes.Shape`."""
        share = np.empty((len(at), window.rows.shape[1], window.columns.shape[1]))
        for k, of in self.sorted(at):
            outline, _, columns, rows = self._placed(k, xy[of], form[of], self.row[at[of]], window.select(of))
            share[of] = coverage(outline, columns, rows, width[of], window.response)
        return share

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.refine.shapes.Shape`."""
        share = np.empty((len(at), window.rows.shape[1], window.columns.shape[1]))
        slopes = np.empty((len(at), 3 + self.parameters, *share.shape[1:]))
        for k, of in self.sorted(at):
            outline, nodes, columns, rows = self._placed(
                k, xy[of], form[of], self.row[at[of]], window.select(of)
            )
            share[of], slopes[of] = coverage_derivatives(
                outline, columns, rows, width[of], window.response, nodes[:, None]
            )
        return share, slopes

    def _placed(
        self, kind: int, xy: Array, form: Array, row: Rows, window: Window
    ) -> tuple[Outline, Array, Array, Array]:
        """Outlines in place and not, and the pixels, reckoned from the corner of each window."""
        corner = np.stack([window.columns[:, 0], window.rows[:, 0]], axis=1)
        nodes, tangents = self.kinds[kind].xy[row], self.kinds[kind].dxy[row]
        grown = (1 + form[:, :1, None]).astype(nodes.dtype)
        outline = Outline(nodes * grown + (xy - corner)[:, None].astype(nodes.dtype), tangents * grown)
        columns, rows = window.columns - corner[:, :1], window.rows - corner[:, 1:]
        return outline, nodes, columns.astype(nodes.dtype), rows.astype(nodes.dtype)

    def sorted(self, at: Rows) -> list[tuple[int, Rows]]:
        """The kinds of the targets `at`, and which of these are of each."""
        kind = self.kind[at]
        return [(int(k), np.flatnonzero(kind == k)) for k in np.unique(kind)]


@lru_cache(maxsize=256)
def _outline(shape: str, size: float, angle: float, spacing: float) -> Outline:
    """Outlines are the same for all frames, as near as the number of nodes goes."""
    return target_outline(shape, size, angle, spacing)


def form_targets(
    design: TestfieldDesign, rows: Rows, mapping: Chain, frame: Array, at: Array, psf_px: float
) -> tuple[TargetImages, Array, Array]:
    """The images of targets around the images of their centroids.

    Parameters
    ----------
    rows : ndarray of int (k,)
        Targets of the design.
    mapping : Chain
        From lattice coordinates to the image.
    frame : ndarray (2, 2)
        Lattice coordinates of a millimetre along x and y of the design, in columns.
    at : ndarray (k, 2)
        Lattice coordinates of the centroids.

    Returns
    -------
    images : TargetImages
    xy : ndarray (k, 2)
        Images of the centroids.
    reach : ndarray (k, 2)
        Half the width and half the height of each image.
    """
    value, slope, bend = second_order(mapping, at)
    # Nodes are as near to each other as they must be where a millimetre is longest in the image.
    scale = float(np.linalg.norm(slope @ frame, ord=2, axis=(1, 2)).max())
    targets = design.targets
    keys = [(targets.shape[k], targets.size[k], targets.angle[k]) for k in rows]
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    kind = np.array([number[key] for key in keys], dtype=np.intp)
    row, reach, kinds = np.empty(len(rows), dtype=np.intp), np.empty((len(rows), 2)), []
    for key, i in number.items():
        of = np.flatnonzero(kind == i)
        row[of] = np.arange(len(of))
        flat = _outline(*key, float(f"{_SPACING * psf_px / scale:.2g}"))
        step, tangent = flat.xy @ frame.T, flat.dxy @ frame.T
        # F(s + d) − F(s) = J d + ½ d H d, and its derivative J + H d.
        ways = np.swapaxes(slope[of], 1, 2)
        # (k, a, c, j): what H does with the first of its two arguments.
        curved = bend[of] @ step.T
        nodes = step @ ways + 0.5 * np.swapaxes((curved * step.T).sum(axis=2), 1, 2)
        tangents = tangent @ ways + np.swapaxes((curved * tangent.T).sum(axis=2), 1, 2)
        image = Outline(nodes, tangents).oriented()
        kinds.append(Outline(image.xy.astype(np.float32), image.dxy.astype(np.float32)))
        reach[of] = np.abs(nodes).max(axis=1)
    return TargetImages(tuple(kinds), kind, row), value, reach


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame, and what is known of the testfield in it when targets are matched.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    noise : float
        Standard deviation of the grey values.
    design : TestfieldDesign
        What stands on the board.
    mapping : Chain
        From lattice coordinates to the image.
    frame, origin : ndarray (2, 2), (2,)
        Lattice coordinates are `frame` times those of the design, plus `origin`.
    light : Light
        How it is lit.
    psf_px : float
        Width of the point-spread function.
    response : PixelResponse
        The pixel.
    row_jitter_px : float
        Standard deviation of the shift of a row.
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

    def lattice(self, xy: Array) -> Array:
        """Lattice coordinates (n, 2) of points of the design (n, 2)."""
        return np.asarray(xy @ self.frame.T + self.origin)


def match_targets(scene: Scene, rows: Rows, inside: Mask, background: int = 1) -> Matches:
    """Match targets of the design.

    Parameters
    ----------
    scene : Scene
        The frame.
    rows : ndarray of int (k,)
        All targets whose light falls into the frame.
    inside : ndarray of bool (k,)
        Which of them are wanted.
    background : int
        Degree of the polynomial that the ground around each is.

    Returns
    -------
    Matches
        Of the n that are wanted, in their order; residuals are in windows of the largest size.
    """
    if not inside.all():
        rows, inside = _around(scene, rows, inside)
    at = scene.lattice(scene.design.xy[rows])
    images, xy, reach = form_targets(scene.design, rows, scene.mapping, scene.frame, at, scene.psf_px)
    canvas = _Canvas(scene, images, xy, reach, scene.design.large[rows])
    return merged(*canvas.match(inside, background))


def _around(scene: Scene, rows: Rows, inside: Mask) -> tuple[Rows, Mask]:
    """Of the targets those that are wanted, and those whose light falls into the windows of these."""
    # Two windows overlap no farther than targets stand apart in their squares, and half as far again.
    xy = scene.lattice(scene.design.xy[rows])
    step = np.abs(scene.frame).max() * np.sqrt(scene.design.pitch**2 / 16)
    size = max(scene.design.targets.size) * np.abs(scene.frame).max()
    slope = second_order(scene.mapping, xy[inside])[1]
    blur = 7 * scene.psf_px / np.sqrt(np.abs(np.linalg.det(slope)).min())
    far = max(1.5 * step, 1.2 * size + blur)
    gap = np.abs(xy[:, None] - xy[inside]).max(axis=2).min(axis=1)
    keep = inside | (gap < far)
    return rows[keep], inside[keep]


class _Canvas:
    """Light that the marks of a testfield take or add, and the matching of each without the others."""

    def __init__(self, scene: Scene, images: TargetImages, xy: Array, reach: Array, large: Mask) -> None:
        self.scene, self.images, self.xy = scene, images, xy
        self.total = _line_light(scene)
        h, w = self.total.shape
        self.parts: list[tuple[Rows, Rows, Array]] = []
        amplitude = scene.light.at(xy)[1][:, None, None]
        for size in (False, True):
            part = np.flatnonzero(large == size)
            if not len(part):
                continue
            half = np.ceil(reach[part].max(axis=0) + 2.5 * scene.psf_px + 1.0).astype(np.intp)
            centre = np.rint(xy[part])
            right, down = (np.arange(-n, n + 1.0) for n in half)
            window = Window(centre[:, :1] + right, centre[:, 1:] + down, scene.response)
            width, form = np.full(len(part), scene.psf_px), np.zeros((len(part), 1))
            own = amplitude[part] * images.image(xy[part], width, form, part, window)
            column, row = window.columns.astype(np.intp), window.rows.astype(np.intp)
            seen = ((row >= 0) & (row < h))[:, :, None] & ((column >= 0) & (column < w))[:, None, :]
            flat = (row[:, :, None] * w + column[:, None, :])[seen]
            self.total += np.bincount(flat, own[seen], minlength=h * w).reshape(h, w)
            self.parts.append((part, half, own))

    def match(self, inside: Mask, background: int) -> tuple[list[Rows], list[Matches]]:
        """Match small and large targets in windows of one size each: their rows, and what was found."""
        rows, found = [], []
        for part, half, own in self.parts:
            keep = inside[part]
            if keep.any():
                rows.append(part[keep])
                found.append(self._match(part[keep], half, own[keep], background))
        return rows, found

    def _match(self, part: Rows, half: Rows, own: Array, background: int) -> Matches:
        scene, (h, w) = self.scene, self.total.shape
        centre = np.rint(self.xy[part]).astype(np.intp)
        column, row = (
            (centre[:, k, None] + np.arange(-half[k], half[k] + 1)).clip(0, size - 1)
            for k, size in ((0, w), (1, h))
        )
        others = self.total[row[:, :, None], column[:, None, :]] - own
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
        )
        level, amplitude = scene.light.at(centre.astype(np.float64))
        # Slopes across half a window, in the order of the matcher's monomials: 1, v, u.
        right, down = (
            scene.light.at(centre + step)[0] - level
            for step in (np.array([half[0], 0.0]), np.array([0.0, half[1]]))
        )
        dark = scene.design.polarity == "dark"
        contrast = amplitude / level if dark else amplitude
        return match(
            scene.grey,
            scene.valid,
            Some(self.images, part),
            self.xy[part],
            options,
            noise=scene.noise,
            form_sigma=np.array([0.05]),
            others=-others if dark else others,
            light=(contrast, np.stack([level, down, right], axis=1)) if background == 1 else None,
        )


def _line_light(scene: Scene) -> Array:
    """Grey values that the lines take or add, (h, w)."""
    h, w = scene.grey.shape
    lines, free = scene.design.lines, np.ones((h, w))
    x0, y0, x1, y1 = lines.extent
    blur, count = blur_of(scene.psf_px, scene.response), max(h, w) // 4
    reach = int(4 * blur + 3)
    for axis, places in ((0, lines.vertical_x), (1, lines.horizontal_y)):
        along = np.linspace(*((y0, y1) if axis == 0 else (x0, x1)), count)
        on = np.empty((len(places), 2, count, 2))
        on[..., 1 - axis] = along
        on[..., axis] = np.array(places)[:, None, None] + np.array([0.0, lines.width])[:, None]
        images = scene.mapping(scene.lattice(on.reshape(-1, 2))).reshape(on.shape)
        for middle, beside in images:
            line = crossings(middle, np.arange(count, dtype=float), (h, w), 4 * blur)
            if (
                line is None
                or not ((line.place > -reach) & (line.place < (w, h)[1 - line.axis] + reach)).any()
            ):
                continue
            width = (beside - middle)[np.rint(line.along).astype(np.intp)]
            half = 0.5 * np.abs((width * line.normal).sum(axis=1))
            row, column, distance = line.around(reach)
            share = strip(distance, half[:, None], blur)
            # Its ends are blurred likewise.
            ends = np.sort(middle[[0, -1], line.axis])
            share *= (ndtr((line.step - ends[0]) / blur) * ndtr((ends[1] - line.step) / blur))[:, None]
            keep = (row >= 0) & (row < h) & (column >= 0) & (column < w)
            free[row[keep], column[keep]] *= 1 - share[keep]
    taken: Array = scene.light.contrast_over((h, w)) * (1 - free)
    return taken


def merged(parts: list[Rows], found: list[Matches]) -> Matches:
    """Matches of several parts in the order of their rows; smaller windows are filled up with NaN."""
    order = np.argsort(np.concatenate(parts), kind="stable")
    most = np.max([matches.residuals.shape[1:] for matches in found], axis=0)
    columns: dict[str, Any] = {}
    for name in Matches.__dataclass_fields__:
        values = [getattr(matches, name) for matches in found]
        if name == "residuals":
            values = [
                np.pad(
                    v,
                    [(0, 0), *([(n - m) // 2] * 2 for m, n in zip(v.shape[1:], most, strict=True))],
                    constant_values=np.nan,
                )
                for v in values
            ]
        columns[name] = np.concatenate(values)[order]
    return Matches(**columns)
