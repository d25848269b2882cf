"""Sheets of disks with coded rings: measurement of their disks, once they are found and numbered.

The image of every disk is formed with the mapping through all disks, to second order, and matched. The
estimate is therefore the image of its centre, not the centre of its ellipse.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...core.threads import one_thread
from ...core.tone import ToneCurve
from ...io import ReseauDesign, Rings
from ...optics import Chain
from ...optics.field import SmoothField
from ...optics.formation import Outline, PixelResponse, side_rule
from ..matching import (
    GrownOutline,
    Matches,
    MatchOptions,
    Shape,
    Window,
    grey_variance,
    match,
    with_alike_errors,
)
from ..points import Reason
from ..response import FilteredShape, Samples, estimate_kernel
from ..screening import Screened, screen
from ..testfield.lattice_mapping import second_order
from ..testfield.targets import merged, replaced
from ..tone import find_curve
from .disks import Disks, find_disks
from .marks import ReseauOptions
from .sheet_placement import MOST_DISKS, SheetPlacement, lay_sheet, through

__all__ = ["measure_sheet"]

_FORM = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])
"""Growth, stretch along an axis, stretch along a diagonal: paper is not plane. None moves the centre."""
_FORM_SIGMA = np.array([0.1, 0.03, 0.03])
_CLASS_PX = 4
"""Step of the window sizes."""
_GROUND_PX, _GROUND_WIDTHS = 5, 3.0
"""Background shown by a window around its disk: pixels, and widths of the point-spread function."""
_LARGE_PX, _MANY = 4_000_000, 64
"""Size of a frame from which disks are searched at half its size first; largest grey value from which grey
values may be rounded for it."""
_LEARNT_FROM = 120
"""Most disks from which mapping and appearance are learnt first."""
_AT_ONCE_PX = 60_000
"""Number of pixels of windows matched together; what is formed in them fits into the cache of a processor."""
_RING = 0.05
"""Share of a pixel from which a ring hides it from the matching; the light of fainter tails is subtracted."""
_ALIKE_WIDTH = 0.03
"""Relative change of the sharpness from which the rings are formed anew."""
_FAR_PX = 1e5
"""Coordinates from which the mapping is not used: it is extrapolated far beyond the disks."""
_SLOPE = 0.3
"""Standard deviation of the change of contrast from the centre of a disk to the edge of its window, caused by
reflected light."""
_SEEN = 0.6
"""Least share of a disk on pixels that can be used."""
_RIM, _LEAST_RIM = 1.5, 0.25
"""Half the width of the edge of a disk, in widths of the point-spread function; share of it below which the
level of the paper is hardly seen, and has no slope."""
_HIGH_RESIDUALS = 1.25
"""Multiple of the usual residuals from which something is suspected in front of a disk."""
_DISTURBED = 1.6
"""Multiple of the usual residuals from which a disk is declined."""
_FOREIGN, _SHADE, _SHIFT_PX = 4.0, 0.03, 0.25
"""Tolerances of the prediction of a disk by its neighbours: noise, share of the light, and shift."""
_NEIGHBOURS = 6
"""Number of neighbours whose light is taken."""
_ENOUGH_LIKE, _SAMPLE = 6, 20
"""Least number of reliable disks from which something is learnt, and most that show the camera's response."""
_FEW = 3
"""One in so many of these shows whether a kernel is needed."""
_KERNELS = 2
"""Number of times a kernel is estimated."""
_FILTERED = 0.85
"""Ratio of mean square residuals below which a kernel is used."""
_PSF_LOG_SIGMA, _SIZE_SIGMA = 0.2, 0.03
"""Spread of sharpness (logarithm) and relative size over the disks of one frame."""
_BLURRED, _GROWN, _BENT = 1.8, 0.2, 0.12
"""Tolerances of sharpness (factor), size and shape (shares) of a disk."""
_BULGED = 0.3
"""Largest deviation of a disk from its neighbours' prediction, in radii: paper bulges."""
_UNMODELLED_PX = 0.05
"""Scatter of positions beyond their own sigmas: the sheet is not plane."""
_FORMED_PX = 0.002
"""Standard deviation of what no formed image contains: edges of prints, unequal pixels."""
_NODES_PX = 1.1
"""Distance of nodes on an outline, in widths of the point-spread function."""


def measure_sheet(frame: Frame, design: ReseauDesign, options: ReseauOptions) -> dict[str, Any] | Failure:
    """Measure the disks of a sheet with coded rings, at any rotation and tilt.

    Parameters
    ----------
    frame : Frame
        A photograph.
    design : ReseauDesign
        The sheet.
    options : ReseauOptions
        Options of the measurement.

    Returns
    -------
    dict or Failure
        Columns of :class:`reseau.measure.reseau.ReseauResult`.
    """
    with one_thread():
        return _measured(frame, design, options)


def _measured(frame: Frame, design: ReseauDesign, options: ReseauOptions) -> dict[str, Any] | Failure:
    screened = screen(frame, None)
    grey = screened.grey if design.polarity == "dark" else -screened.grey
    placed, disks = _placed(grey, screened, design, options.mirrored)
    if isinstance(placed, Failure):
        return Failure(
            f"design {design.name!r} was not found in the frame: {placed.reason}",
            placed.code,
            where=frame.name,
            places=disks.strongest(MOST_DISKS * len(design.ids)).xy,
        )
    # Whether a pixel beside a clipped one is itself clipped depends on its noise.
    clipped = cv2.dilate((frame.pixels >= frame.full_scale).astype(np.uint8), np.ones((3, 3), np.uint8))
    valid = screened.valid & (clipped == 0)
    return _Sheet(frame, replace(screened, valid=valid), disks, design, placed, options).columns()


def _placed(
    grey: NDArray[np.float32], screened: Screened, design: ReseauDesign, mirrored: bool | None
) -> tuple[SheetPlacement | Failure, Disks]:
    """Position of the sheet, and the disks of the frame; a large frame is first tried at half its size."""
    h, w = grey.shape
    if h * w > _LARGE_PX:
        half: Any = cv2.resize(
            grey[: h // 2 * 2, : w // 2 * 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA
        )
        half = np.rint(half) if float(np.abs(half).max()) > _MANY else half
        valid = screened.valid[: h // 2 * 2 : 2, : w // 2 * 2 : 2]
        disks = find_disks(half, valid, screened.noise / 2)
        placed = lay_sheet(half, disks, design, mirrored)
        if not isinstance(placed, Failure):
            # Pixel 0 at half the size covers pixels 0 and 1.
            disks = Disks(2 * disks.xy + 0.5, 2 * disks.form, disks.t)
            at, found = design.xy @ placed.frame.T + placed.origin, placed.disk >= 0
            mapping = through(at[found], disks.xy[placed.disk[found]], (h, w))
            return replace(placed, mapping=mapping), disks
    disks = find_disks(grey, screened.valid, screened.noise)
    return lay_sheet(grey, disks, design, mirrored), disks


def _with_all_errors(found: Matches) -> Matches:
    """Matches with covariances that contain what errors of pixels have in common, and errors of forming."""
    found = with_alike_errors(found)
    return replace(found, cov=found.cov + _FORMED_PX**2 * np.eye(2))


@dataclass(frozen=True, eq=False)
class _Appearance:
    """Appearance of the disks of this frame."""

    psf_px: float
    psf_log_sigma: float
    size: float
    form_sigma: Array
    variance: tuple[float, float] | None
    kernel: Array | None
    """Of motion or sharpening, see :mod:`reseau.measure.response`."""
    blur_px: float
    """Width of the point-spread function with the kernel."""
    contrast: Array | None
    """Contrast (n,) of each disk of the design."""
    light: Array | None
    """Grey values (n,) that full ink adds at each disk of the design; negative for dark ink."""


class _Sheet:
    """The two rounds of matching, and the tests of every disk."""

    def __init__(
        self,
        image: Frame,
        screened: Screened,
        disks: Disks,
        design: ReseauDesign,
        placed: SheetPlacement,
        options: ReseauOptions,
    ) -> None:
        assert design.mark.size is not None
        self.image, self.screened, self.design, self.options = image, screened, design, options
        self.frame, self.mapping = placed.frame, placed.mapping
        self.origin = placed.origin
        self.at = design.xy @ placed.frame.T + placed.origin
        self.found = placed.disk >= 0
        self.start = np.where(self.found[:, None], disks.xy[placed.disk], self.mapping(self.at))
        self.look = _Appearance(
            options.psf_px, 0.5, design.mark.size, _FORM_SIGMA, None, None, options.psf_px, None, None
        )
        self.hidden = np.zeros(screened.grey.shape, dtype=bool)
        self.dazzled = np.zeros(len(self.at), dtype=bool)
        self.ring: tuple[Array, Chain, float, Array | None] | None = None
        self.notes: tuple[Remark, ...] = ()

    def columns(self) -> dict[str, Any]:
        """Columns of the result."""
        rows = np.flatnonzero(self.found)
        if len(rows) > _LEARNT_FROM:
            rows = rows[np.linspace(0, len(rows) - 1, _LEARNT_FROM).astype(np.intp)]
        first = self._match(rows)
        sure = first.converged & (first.t > 8) & (first.rejected < 0.2)
        if sure.sum() >= _ENOUGH_LIKE:
            self._respond(self._learn(first.select(sure), rows[sure]), rows[sure])
        rows = self._in_sight()
        found = self._match_all(rows)
        why, field = self._judged(rows, found)
        # Where paper is saturated, neighbours do not predict the light.
        doubtful = ((why != "") | self._uneasy(found)) & ~self.dazzled[rows]
        if doubtful.any() and (~doubtful & ~self.dazzled[rows]).sum() >= _NEIGHBOURS and field is not None:
            # Look again where their neighbours predict them, without what lies in front of them.
            self._uncover(rows, found, doubtful, field)
            found = replaced(found, ~doubtful, self._match_all(rows[doubtful]))
        found = _with_all_errors(found)
        why, field = self._judged(rows, found)
        return self._spread(rows, found, why, field)

    def _straight(self, rows: Rows) -> Array:
        """Images by the projectivity alone, the source coordinates of smooth fields."""
        return self.mapping.first(self.at[rows])

    def _in_sight(self) -> Rows:
        """Indices of disks whose centres lie in the frame."""
        h, w = self.screened.grey.shape
        inside = ((self.start > 0) & (self.start < (w - 1, h - 1))).all(axis=1)
        return np.flatnonzero(inside)

    def _outline(self, rows: Rows) -> Outline:
        """Images of the disks around the images of their centres."""
        _, slope, bend = second_order(self.mapping, self.at[rows])
        scale = float(np.linalg.norm(slope @ self.frame, ord=2, axis=(1, 2)).max())
        flat = Outline.circle(self.look.size / 2, _NODES_PX * self.look.psf_px / scale)
        step, tangent = flat.xy @ self.frame.T, flat.dxy @ self.frame.T
        # F(s + d) − F(s) = J d + ½ d H d, and its derivative J + H d.
        nodes = np.einsum("kab,jb->kja", slope, step) + 0.5 * np.einsum("kabc,jb,jc->kja", bend, step, step)
        tangents = np.einsum("kab,jb->kja", slope, tangent) + np.einsum(
            "kabc,jb,jc->kja", bend, step, tangent
        )
        return Outline(nodes, tangents).oriented().single()

    def _match_all(self, rows: Rows) -> Matches:
        """Match disks; on even paper where paper is saturated all around."""
        found = self._match(rows, influence=True)
        dim = found.converged & (self._edge_seen(rows, found) < _LEAST_RIM)
        self.dazzled[rows] |= dim
        if not dim.any():
            return found
        return replaced(found, ~dim, self._match(rows[dim], background=0, influence=True))

    def _match(self, rows: Rows, background: int = 2, influence: bool = False) -> Matches:
        """Match disks, grouped by window size."""
        outline, ring = self._outline(rows), self._rings()
        valid = self.screened.valid & (ring < _RING) & ~self.hidden
        parts, found = [], []
        for part, half in self._windows(outline):
            options = MatchOptions(
                half_px=half,
                psf_px=self.look.psf_px,
                psf_log_sigma=self.look.psf_log_sigma,
                response=PixelResponse(self.options.fill),
                polarity=self.design.polarity,
                row_jitter_px=self.options.row_jitter_px,
                settled=0.05,
                influence=influence,
                contrast=None if self.look.contrast is None else self.look.contrast[rows[part]],
                contrast_slope=_SLOPE,
                background=background,
                variance=self.look.variance,
            )
            found.append(
                match(
                    self.screened.grey,
                    valid,
                    self._shape(outline, part),
                    self.start[rows[part]],
                    options,
                    noise=self.screened.noise,
                    form_sigma=self.look.form_sigma,
                    others=self._light_of(ring, rows[part], half),
                )
            )
            parts.append(part)
        return merged(parts, found)

    def _shape(self, outline: Outline, part: Rows) -> Shape:
        """Images of some of the disks."""
        plain = GrownOutline(Outline(outline.xy[part], outline.dxy[part]), _FORM)
        return plain if self.look.kernel is None else FilteredShape(plain, self.look.kernel)

    def _windows(self, outline: Outline) -> Iterator[tuple[Rows, tuple[int, int]]]:
        """Disks with windows of one size, not too many, and half their width and height."""
        ground = max(_GROUND_PX, int(np.ceil(_GROUND_WIDTHS * self.look.blur_px)))
        reach = np.abs(outline.xy).max(axis=1)
        sizes, of = np.unique(np.ceil(reach / _CLASS_PX).astype(np.intp), axis=0, return_inverse=True)
        for k, size in enumerate(sizes):
            half = size * _CLASS_PX + ground
            part = np.flatnonzero(of.ravel() == k)
            some = max(1, int(_AT_ONCE_PX // (2 * half + 1).prod()))
            for piece in np.array_split(part, -(-len(part) // some)):
                yield piece, (int(half[0]), int(half[1]))

    def _pixels(self, rows: Rows, half: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns (k, 1, c) and rows (k, r, 1) of the windows of disks, within the frame."""
        h, w = self.screened.grey.shape
        centre = np.rint(self.start[rows]).astype(np.intp)
        x, y = (centre[:, k, None] + np.arange(-half[k], half[k] + 1) for k in (0, 1))
        return np.clip(x, 0, w - 1)[:, None, :], np.clip(y, 0, h - 1)[:, :, None]

    def _rings(self) -> Array:
        """Share (h, w) of each pixel that the coded rings take; formed anew when they have changed."""
        look = self.look
        if self.ring is not None:
            share, mapping, psf_px, kernel = self.ring
            alike = abs(psf_px / look.psf_px - 1) < _ALIKE_WIDTH
            if alike and mapping is self.mapping and kernel is look.kernel:
                return share
        share = np.zeros(self.screened.grey.shape, dtype=np.float32)
        rings = self.design.rings
        assert rings is not None
        reach = 0 if look.kernel is None else len(look.kernel) // 2
        for name, sectors in rings.sectors.items():
            centre = self.design.xy[self.design.ids.index(name)]
            for start, end in sectors:
                outline = self._sector(rings, start, end, centre)
                if outline is None or not np.abs(outline.xy).max() < _FAR_PX:
                    continue  # the mapping is extrapolated far beyond the disks
                margin = int(np.ceil(6 * look.psf_px)) + 2 + reach
                low = np.maximum(np.floor(outline.xy.min(axis=0)).astype(np.intp) - margin, 0)
                high = np.ceil(outline.xy.max(axis=0)).astype(np.intp) + margin + 1
                place = share[low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
                if min(place.shape) <= 2 * reach:
                    continue
                x, y = (low[k] + np.arange(place.shape[1 - k], dtype=np.float64)[None] for k in (0, 1))
                window = Window(x, y, PixelResponse(self.options.fill))
                nodes = Outline(outline.xy[None], outline.dxy[None]).oriented().single()
                one = np.zeros(1, dtype=np.intp)
                width = np.full(1, look.psf_px)
                taken = GrownOutline(nodes, np.zeros((0, 2, 2))).image(
                    np.zeros((1, 2)), width, np.zeros((1, 0)), one, window
                )[0]
                place += taken if look.kernel is None else cv2.filter2D(taken, -1, look.kernel)
        self.ring = share, self.mapping, look.psf_px, look.kernel
        return share

    def _sector(self, rings: Rings, start: float, end: float, centre: Array) -> Outline | None:
        """Image of a sector of a ring, from one angle to another, degrees."""
        _, slope, _ = second_order(self.mapping, (centre @ self.frame.T + self.origin)[None])
        scale = float(np.linalg.norm(slope[0] @ self.frame, ord=2))
        spacing = _NODES_PX * self.look.psf_px / scale
        a, b = np.deg2rad([start, end])
        nodes, tangents = [], []
        for radius, first, last in ((rings.outer / 2, a, b), (rings.inner / 2, b, a)):
            along, weight = side_rule(abs(b - a) * radius, spacing)
            angle = first + along * (last - first)
            nodes.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
            turning = radius * (last - first) * weight[:, None]
            tangents.append(turning * np.stack([-np.sin(angle), np.cos(angle)], axis=1))
        for angle, first, last in (
            (b, rings.outer / 2, rings.inner / 2),
            (a, rings.inner / 2, rings.outer / 2),
        ):
            along, weight = side_rule(abs(last - first), spacing)
            ray = np.array([np.cos(angle), np.sin(angle)])
            nodes.append((first + along * (last - first))[:, None] * ray)
            tangents.append(((last - first) * weight)[:, None] * ray)
        at = (np.concatenate(nodes) + centre) @ self.frame.T + self.origin
        xy, slopes, _ = second_order(self.mapping, at)
        found = Outline(xy, np.einsum("nij,nj->ni", slopes, np.concatenate(tangents) @ self.frame.T))
        return found if np.isfinite(xy).all() else None

    def _light_of(self, ring: Array, rows: Rows, half: tuple[int, int]) -> Array | None:
        """Light (k, rows, columns) that the blurred edges of rings take in the windows of disks."""
        light = self.look.light
        if light is None:
            return None
        x, y = self._pixels(rows, half)
        return np.asarray(ring[y, x] * light[rows, None, None])

    def _learn(self, first: Matches, rows: Rows) -> Matches:
        """Learn mapping, sharpness, size and noise from reliable disks; their form refers to the new size."""
        self.mapping = through(self.at[rows], first.xy, self.screened.grey.shape)
        self._weigh(first, rows)
        first = self._settle(first)
        self.look = replace(
            self.look,
            psf_log_sigma=_PSF_LOG_SIGMA,
            form_sigma=np.array([_SIZE_SIGMA, *_FORM_SIGMA[1:]]),
            blur_px=self.look.psf_px,
        )
        self.start = np.where(self.found[:, None], self.start, self.mapping(self.at))
        self.start[rows] = first.xy
        return first

    def _depth(self, found: Matches) -> Array:
        """Grey values (k,) that ink adds."""
        return np.asarray(found.contrast * (-found.level if self.design.polarity == "dark" else 1))

    def _respond(self, first: Matches, rows: Rows) -> None:
        """Learn what motion, sharpening and the curve of the camera make of the images."""
        some = np.unique(np.linspace(0, len(rows) - 1, _SAMPLE).astype(np.intp))
        first, rows = first.select(np.isin(np.arange(len(rows)), some)), rows[some]
        # The first match began far from the sharpness of these images.
        first = self._settle(self._match(rows))
        self._weigh(first, rows)
        few = np.arange(len(rows)) % _FEW == 0
        kernel, sharper, gain = estimate_kernel(self._samples(first.select(few), rows[few])[0])
        if gain < _FILTERED:
            for _ in range(_KERNELS):
                # Position and form were those of images without the kernel, or with the one before.
                self.look = replace(self.look, kernel=None)
                kernel, sharper, _ = estimate_kernel(self._samples(first, rows)[0])
                self.look = replace(self.look, kernel=kernel, psf_px=sharper * self.look.psf_px)
                first = self._settle(self._match(rows))
                self._weigh(first, rows)
            text = "the images are smeared by motion or sharpened: this was estimated and is modelled"
            self.notes += (Remark(text, Code.FILTERED),)
        straight, full_scale = ToneCurve(1.0), self.image.full_scale
        tried = {straight: (self.screened, self.look, first)}

        def matched(curve: ToneCurve) -> tuple[Samples, Array] | None:
            if curve not in tried:
                self.screened = replace(self.screened, grey=self._linear(curve))
                # The noise of grey values is alike, that of light grows with it where curves are steeper.
                bent = float(curve.light(np.array(0.5), 1.0)) < 0.5
                variance = (0.02 * full_scale, 1.0) if bent else None
                self.look = replace(self.look, variance=variance, light=None)
                again = self._settle(self._match(rows))
                self.screened = replace(self.screened, noise=float(np.median(again.noise)))
                tried[curve] = self.screened, self.look, again
            self.screened, self.look, again = tried[curve]
            return self._samples(again, rows) if again.converged.all() else None

        found = find_curve(matched, full_scale, self.image.curve)
        self.screened, self.look, first = tried[found.curve or straight]
        if found:
            self._weigh(first, rows)
        if (note := found.remark("disks")) is not None:
            self.notes += (note,)

    def _weigh(self, first: Matches, rows: Rows) -> None:
        """Learn noise, contrast and light from some of the disks; those of the others change as much."""

        def renewed(known: Array | None, values: Array) -> Array:
            whole = np.full(len(self.at), np.median(values))
            if known is not None:
                whole = known * np.median(values / known[rows])
            whole[rows] = values
            return np.asarray(whole)

        look = self.look
        self.look = replace(
            look,
            variance=grey_variance(self.screened.grey, self.start[rows], first.residuals),
            contrast=renewed(look.contrast, first.contrast),
            light=renewed(look.light, self._depth(first)),
        )

    def _linear(self, curve: ToneCurve) -> NDArray[np.float32]:
        """Grey values of the frame that are proportional to the light."""
        pixels, full_scale = self.image.pixels, self.image.full_scale
        if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
            return curve.light(pixels.astype(np.float32), full_scale)
        levels = np.arange(np.iinfo(pixels.dtype).max + 1, dtype=np.float32)
        return np.asarray(curve.light(levels, full_scale)[pixels])

    def _settle(self, first: Matches) -> Matches:
        """Learn sharpness and size; the form of the matches refers to the new size."""
        growth = float(np.median(first.form[:, 0]))
        self.look = replace(
            self.look, psf_px=float(np.median(first.psf_px)), size=self.look.size * (1 + growth)
        )
        return replace(first, form=(first.form - np.array([growth, 0.0, 0.0])) / (1 + growth))

    def _samples(self, first: Matches, rows: Rows) -> tuple[Samples, Array]:
        """Matched disks in windows of one size, and their adjusted images."""
        outline = self._outline(rows)
        high, wide = (n // 2 for n in first.residuals.shape[1:])
        size = np.max([half for _, half in self._windows(outline)], axis=0)
        half = int(min(size[0], wide)), int(min(size[1], high))
        x, y = self._pixels(rows, half)
        centre = slice(high - half[1], high + half[1] + 1), slice(wide - half[0], wide + half[0] + 1)
        residuals = first.residuals[:, *centre]
        grey = self.screened.grey[y, x].astype(np.float64)
        if (others := self._light_of(self._rings(), rows, half)) is not None:
            grey -= others
        window = Window(x[:, 0].astype(float), y[:, :, 0].astype(float), PixelResponse(self.options.fill))
        every = np.arange(len(rows))
        samples = Samples(
            self._shape(outline, every),
            first.xy,
            first.psf_px,
            first.form,
            self._depth(first),
            window,
            grey,
            np.isfinite(residuals),
        )
        return samples, grey + np.nan_to_num(residuals)

    def _uneasy(self, found: Matches) -> Mask:
        """Disks with larger residuals than the others, or that did not converge."""
        known = found.noise[found.converged]
        ordinary = np.median(known) if len(known) else np.inf
        spread = 1.4826 * np.median(np.abs(known / ordinary - 1)) if len(known) else 0.0
        return ~found.converged | (found.noise > max(_HIGH_RESIDUALS, 1 + 4 * spread) * ordinary)

    def _uncover(self, rows: Rows, found: Matches, uneasy: Mask, field: SmoothField) -> None:
        """Mask the pixels of windows that show neither paper nor ink, but something in front of them.

        The images of disks are predicted from their neighbours. The tolerance contains what a shift of a
        quarter of a pixel makes of them.
        """
        good = ~uneasy & ~self.dazzled[rows]
        near = KDTree(self.at[rows[good]]).query(self.at[rows], k=min(_NEIGHBOURS, int(good.sum())))[1]
        level, depth = (np.median(values[good][near], axis=1) for values in (found.level, self._depth(found)))
        noise = float(np.median(found.noise[good]))
        some = rows[uneasy]
        xy = field(self._straight(some))
        self.start[some] = xy
        outline = self._outline(some)
        foreign: NDArray[Any] = np.zeros(self.screened.grey.shape, dtype=np.uint8)
        seen = np.zeros(foreign.shape, dtype=bool)
        for part, half in self._windows(outline):
            x, y = self._pixels(some[part], half)
            window = Window(x[:, 0].astype(float), y[:, :, 0].astype(float), PixelResponse(self.options.fill))
            shape = self._shape(outline, part)
            width, form = np.full(len(part), self.look.psf_px), np.zeros((len(part), len(_FORM)))
            share, slopes = shape.derivatives(xy[part], width, form, np.arange(len(part)), window)
            here, ink = (values[uneasy][part, None, None] for values in (level, depth))
            off = self.screened.grey[y, x] - here - ink * share
            tolerance = _FOREIGN * noise + _SHADE * np.abs(here)
            tolerance = tolerance + _SHIFT_PX * np.abs(ink) * np.hypot(slopes[:, 0], slopes[:, 1])
            np.maximum.at(foreign, (y, x), np.abs(off) > tolerance)
            seen[y, x] = True
        foreign = cv2.morphologyEx(foreign, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        reach = int(np.ceil(2 * self.look.psf_px)) + 1
        foreign = cv2.dilate(foreign, np.ones((2 * reach + 1,) * 2, np.uint8))
        self.hidden |= (foreign > 0) & seen

    def _edge_seen(self, rows: Rows, found: Matches) -> Array:
        """Share (k,) of the pixels on the blurred edge of each disk that were used."""
        used = np.isfinite(found.residuals)
        high, wide = (n // 2 for n in used.shape[1:])
        x, y = self._pixels(rows, (wide, high))
        radii = second_order(self.mapping, self.at[rows])[1] @ self.frame * (self.look.size / 2)
        off = np.stack(np.broadcast_arrays(x, y), axis=-1) - found.xy[:, None, None]
        # The unit circle is the edge.
        distance = np.linalg.norm(np.einsum("kij,krcj->krci", np.linalg.inv(radii), off), axis=-1)
        width = _RIM * self.look.blur_px / np.sqrt(np.abs(np.linalg.det(radii)))
        rim = np.abs(distance - 1) < width[:, None, None]
        return np.asarray((used & rim).sum(axis=(1, 2)) / np.maximum(rim.sum(axis=(1, 2)), 1))

    def _objections(self, rows: Rows, found: Matches) -> list[tuple[Mask, Reason]]:
        """Objections to disks from their own images, the most serious first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        strong = found.converged & (found.t > 8)
        ordinary = float(np.median(found.psf_px[strong])) if strong.any() else self.look.psf_px
        usual = float(np.median(found.noise[strong])) if strong.any() else np.inf
        return [
            (found.seen < _SEEN, Reason("hidden, saturated or beyond the edge of the frame", Code.HIDDEN)),
            (~found.converged, Reason("the match did not converge", Code.NOT_CONVERGED)),
            (
                ~(found.t >= o.least_t) | (found.contrast <= 0),
                Reason("no disk is distinct from its surroundings", Code.LOW_CONTRAST),
            ),
            (found.psf_px > _BLURRED * ordinary, Reason("less sharp than the other disks", Code.BLURRED)),
            (np.abs(found.form[:, 0]) > _GROWN, Reason("size differs from the other disks", Code.UNLIKE)),
            (
                np.hypot(found.form[:, 1], found.form[:, 2]) > _BENT,
                Reason("the outline is not that of a disk", Code.UNLIKE),
            ),
            # Without paper, the reflection in a disk is all that is left to compare.
            (
                (found.correlation < 0.8) & ~self.dazzled[rows],
                Reason("the image is not that of a disk", Code.UNLIKE),
            ),
            (
                (found.rejected > 0.25) | (found.noise > _DISTURBED * usual),
                Reason("partly hidden or disturbed", Code.DISTURBED),
            ),
            (~(sigma <= o.most_sigma_px), Reason("too uncertain", Code.UNCERTAIN)),
        ]

    def _judged(self, rows: Rows, found: Matches) -> tuple[Array, SmoothField | None]:
        """Reason why each disk is rejected, and the field through the others."""
        why = np.full(len(rows), "", dtype=object)
        for mask, reason in self._objections(rows, found):
            why[mask & (why == "")] = reason
        source, field = self._straight(rows), None
        variance = np.trace(found.cov, axis1=1, axis2=2) / 2 + _UNMODELLED_PX**2
        slope = second_order(self.mapping, self.at[rows])[1] @ self.frame
        radius = self.look.size / 2 * np.sqrt(np.abs(np.linalg.det(slope)))
        while (good := np.flatnonzero(why == "")).size >= 10:
            relative = np.sqrt(variance[good] / np.median(variance[good]))
            length = field.length if field is not None and np.isfinite(field.length) else None
            field = SmoothField.fit(source[good], found.xy[good], sigma=relative, length=length)
            deviation, sigma = field.leave_one_out()
            limit = np.maximum(np.maximum(self.options.neighbour_px, _BULGED * radius[good, None]), 4 * sigma)
            excess = (np.abs(deviation) / limit).max(axis=1)
            worst = int(excess.argmax())
            if excess[worst] <= 1:
                break
            distance = np.hypot(*deviation[worst])
            why[good[worst]] = Reason(
                f"{distance:.1f} px from the position predicted by its neighbours", Code.DEVIATES
            )
        return why, field

    def _spread(self, rows: Rows, found: Matches, why: Array, field: SmoothField | None) -> dict[str, Any]:
        """Columns over all disks of the design."""
        n, good = len(self.at), why == ""
        ok, reasons = (
            np.zeros(n, dtype=bool),
            Reason("outside the frame", Code.OUTSIDE).repeated(n),
        )
        ok[rows], reasons[rows] = good, why
        predicted, deviation = self.mapping(self.at), np.full((n, 2), np.nan)
        if field is not None:
            predicted[rows] = field(self._straight(rows))
            deviation[rows[good]] = field.leave_one_out()[0]

        def spread(values: Array, keep: Mask | slice = slice(None)) -> Array:
            full = np.full((n, *values.shape[1:]), np.nan)
            full[rows[keep]] = values[keep]
            return full

        if field is not None and good.sum() >= 10:
            design = SmoothField.fit(self.design.xy[rows[good]], found.xy[good])
        else:
            design = SmoothField.fit(self.design.xy, self.mapping(self.at), local=False)
        return {
            "image": self.image.name,
            "sha256": self.image.sha256,
            "ids": self.design.ids,
            "field": design,
            "xy": spread(found.xy, good),
            "cov": spread(found.cov, good),
            "ok": ok,
            "why": tuple(reasons),
            "predicted": predicted,
            "deviation": deviation,
            "notes": self.notes,
        } | {name: spread(getattr(found, name)) for name in ("psf_px", "contrast", "t", "noise")}
