"""Sheets of disks with coded rings: measurement of their disks, once they are found and numbered.

The image of every disk is formed with the mapping through all disks, to second order, and matched. The
estimate is therefore the image of its centre, not the centre of its ellipse.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Frame, Rows
from ...core.failure import Code, Failure
from ...core.threads import one_thread
from ...io import ReseauDesign, Rings
from ...optics.composition import Chain
from ...optics.formation import Outline, PixelResponse, side_rule
from ..marks.judging import Objection
from ..matching import Matches, Shape
from ..matching.shapes import GrownOutline, Window
from ..plane.lattice_mapping import images_of, second_order, slope_of
from ..plane.plane_mapping import plane_through
from ..screening import Screened, screen
from .disks import Disks, find_disks
from .mark_windows import Located
from .marks import ReseauOptions
from .plane_marks import PlaneMarks
from .sheet_placement import MOST_DISKS, SheetPlacement, lay_sheet

_FORM = np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])
"""Growth, stretch along an axis, stretch along a diagonal: paper is not plane. None moves the centre."""
_FORM_SIGMA = np.array([0.1, 0.03, 0.03])
_LARGE_PX, _MANY = 4_000_000, 64
"""Size of a frame from which disks are searched at half its size first; largest grey value from which grey
values may be rounded for it."""
_ALIKE_WIDTH = 0.03
"""Relative change of the sharpness from which the rings are formed anew."""
_FAR_PX = 1e5
"""Coordinates from which the mapping is not used: it is extrapolated far beyond the disks."""
_RIM = 1.5
"""Half the width of the edge of a disk, in widths of the point-spread function."""
_SIZE_SIGMA = 0.03
"""Spread of relative size over the disks of one frame."""
_GROWN, _BENT = 0.2, 0.12
"""Tolerances of size and shape (shares) of a disk."""
_SIDES = 12
"""Sides of a polygon whose centroid is that of the image of a disk."""
_NODES_PX = 1.1
"""Distance of nodes on an outline, in widths of the point-spread function."""
_POINTS = 17
"""Points of an outline that are mapped; see :meth:`reseau.optics.formation.Outline.through`."""
_CIRCLE = Outline.circle(0.5, np.pi / (_POINTS - 0.5))


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
    if isinstance(screened, Failure):
        return screened
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
    screened = replace(screened, valid=screened.valid & (clipped == 0))
    del grey, clipped  # of large frames they take much memory
    return _Sheet(frame, screened, disks, design, placed, options).columns()


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
            mapping = plane_through(at[found], disks.xy[placed.disk[found]], (h, w))
            return replace(placed, mapping=mapping), disks
    disks = find_disks(grey, screened.valid, screened.noise)
    return lay_sheet(grey, disks, design, mirrored), disks


class DiskMarks(PlaneMarks):
    """Disks, without anything else in their windows."""

    word = "disk"
    form_sigma = _FORM_SIGMA
    learnt_form_sigma = np.array([_SIZE_SIGMA, *_FORM_SIGMA[1:]])

    def _images(self, rows: Rows) -> tuple[Shape, Array]:
        """Images of the disks around the images of their centres."""
        at = self.at[rows]
        scale = float(np.linalg.norm(slope_of(self.mapping, at) @ self.frame, ord=2, axis=(1, 2)).max())
        count = max(_POINTS, int(np.ceil(np.pi * self.look.size * scale / (_NODES_PX * self.look.psf_px))))
        around = np.concatenate([np.zeros((1, 2)), _CIRCLE.xy * self.look.size]) @ self.frame.T
        images = images_of(self.mapping, (at[:, None] + around).reshape(-1, 2)).reshape(len(at), -1, 2)
        outline = Outline.through(images[:, 1:] - images[:, :1], count).oriented().single()
        return GrownOutline(outline, _FORM), np.abs(outline.xy).max(axis=1)

    def settle(self, first: Matches) -> Matches:
        """Learn sharpness and size; the form of the matches refers to the new size."""
        growth = float(np.median(first.form[:, 0]))
        self.look = replace(
            self.look, psf_px=float(np.median(first.psf_px)), size=self.look.size * (1 + growth)
        )
        return replace(first, form=(first.form - np.array([growth, 0.0, 0.0])) / (1 + growth))

    def _edge_seen(self, rows: Rows, found: Matches) -> Array:
        """Share (k,) of the pixels on the blurred edge of each disk that were used."""
        used = np.isfinite(found.residuals)
        high, wide = (n // 2 for n in used.shape[1:])
        x, y = self.pixels(rows, (wide, high))
        radii = second_order(self.mapping, self.at[rows])[1] @ self.frame * (self.look.size / 2)
        off = np.stack(np.broadcast_arrays(x, y), axis=-1) - found.xy[:, None, None]
        # The unit circle is the edge.
        distance = np.linalg.norm(np.einsum("kij,krcj->krci", np.linalg.inv(radii), off), axis=-1)
        width = _RIM * self.look.blur_px / np.sqrt(np.abs(np.linalg.det(radii)))
        rim = np.abs(distance - 1) < width[:, None, None]
        return np.asarray((used & rim).sum(axis=(1, 2)) / np.maximum(rim.sum(axis=(1, 2)), 1))

    def radius(self, rows: Rows) -> Array:
        """See :class:`PlaneMarks`."""
        slope = second_order(self.mapping, self.at[rows])[1] @ self.frame
        return np.asarray(self.look.size / 2 * np.sqrt(np.abs(np.linalg.det(slope))))

    def _off_centre(self, rows: Rows, images: Callable[[Array], Array] | None = None) -> Array:
        """See :class:`PlaneMarks`: the centroids of the images of disks."""
        circle = Outline.circle(self.look.size / 2, np.pi * self.look.size / _SIDES).xy @ self.frame.T
        around = np.concatenate([np.zeros((1, 2)), circle])
        at = (self.at[rows][:, None] + around).reshape(-1, 2)
        nodes = images_of(self.mapping, at) if images is None else images(at)
        nodes = nodes.reshape(*nodes.shape[:-2], len(rows), -1, 2)
        a = nodes[..., 1:, :] - nodes[..., :1, :]
        b = np.roll(a, -1, axis=-2)
        twice = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        return np.asarray(((a + b) * twice[..., None]).sum(axis=-2) / (3 * twice.sum(axis=-1)[..., None]))

    def _misshapen(self, found: Matches) -> list[Objection]:
        """See :class:`PlaneMarks`."""
        bent = np.hypot(found.form[:, 1], found.form[:, 2]) > _BENT
        return [
            (np.abs(found.form[:, 0]) > _GROWN, "size differs from the other disks", Code.UNLIKE),
            (bent, "the outline is not that of a disk", Code.UNLIKE),
        ]


class _Sheet(DiskMarks):
    """Disks, some of them with coded rings."""

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
        located = Located(
            design.ids,
            design.xy,
            design.polarity,
            placed.mapping,
            placed.frame,
            placed.origin,
            placed.disk >= 0,
            disks.xy[placed.disk],
        )
        super().__init__(image, screened, located, options, design.mark.size)
        self.design = design
        self.ring: tuple[Array, Chain, float, Array | None] | None = None

    @property
    def surrounded(self) -> bool:
        """See :class:`MarkWindows`."""
        return self.design.rings is not None

    def beside(self) -> Array | None:
        """Share (h, w) of each pixel that the coded rings take; formed anew when they have changed."""
        look, rings = self.look, self.design.rings
        if rings is None:
            return None
        if self.ring is not None:
            share, mapping, psf_px, kernel = self.ring
            alike = abs(psf_px / look.psf_px - 1) < _ALIKE_WIDTH
            if alike and mapping is self.mapping and kernel is look.kernel:
                return share
        share = np.zeros(self.screened.grey.shape, dtype=np.float32)
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
