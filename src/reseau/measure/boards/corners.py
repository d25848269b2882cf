"""Matching of corners where squares meet, once they are found and numbered.

The image of a corner is formed from its two edges, with the directions and the curvature that the mapping
through all corners gives them; the directions are adjusted with the position. A window extends half a square
to all sides, and shows nothing but the four squares that meet; the markers of a ChArUco board are formed as
what lies beside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code
from ...optics import Chain
from ...optics.corners import Corners, corner_images
from ...optics.formation import PixelResponse, polygons
from ..matching import GrownOutline, Matches, Shape, Window
from ..points import Reason
from ..reseau.marks import ReseauOptions
from ..reseau.plane_marks import Located, PlaneMarks
from ..screening import Screened
from ..testfield.lattice_mapping import images_of, second_order

__all__ = ["CornerMarks", "CornerShape", "Sectors"]

_TURN = 0.1
"""Standard deviation of the directions of edges before the mapping is known, radians."""
_TURNED = 0.02
_MOST_PX = 32
"""Largest distance of a pixel used from its corner along an axis, pixels."""
_LEARNING_PX = 9
"""The same while the appearance of corners is learnt, beside widths of the point-spread function."""
_CURVED_FROM = 20
"""Least number of corners that determine the curvature of edges in the whole of their windows."""
_SURE_CURVES = 60
"""Number of corners up to which curvatures are adjusted, too: a mapping through few has few terms."""
_BENT = 3e-4
"""Standard deviation of these curvatures beside those of the mapping, 1/px."""
_EDGE = 1.5
"""Half the width of an edge in widths of the point-spread function."""
_ALIKE_WIDTH = 0.05
"""Relative change of the sharpness from which markers are formed anew."""
_BORDER = 2.0
"""Least distance of a corner from the outermost pixels, in widths of the point-spread function."""
_FLAT = 0.6
"""Least sine of the angle between the edges of a corner."""
_FAR_PX, _FIGURES_PX = 1e5, 8
"""Coordinates from which a mapping is not used; step of the window sizes of figures."""
_NODES_PX = 1.1
"""Distance of nodes on an outline, in widths of the point-spread function."""


@dataclass(frozen=True, eq=False)
class CornerShape:
    """Images of corners as functions of position, blur, and the directions of their edges.

    Parameters
    ----------
    corners : Corners
        The corners, with the directions and curvatures that are expected.
    parameters : int
        Number of parameters of the form: a turn of each edge, or (4) a turn and a curvature.

    Examples
    --------
    >>> shape: Shape = CornerShape(Corners(np.eye(2)[None], np.zeros((1, 2)), np.array([True])))
    >>> window = Window(np.arange(9.0)[None], np.arange(9.0)[None], PixelResponse())
    >>> place = np.array([[4.0, 4.0]]), np.ones(1), np.zeros((1, 2)), np.array([0]), window
    >>> float(shape.image(*place)[0, 4, 4]), shape.derivatives(*place)[1].shape
    (0.5, (1, 5, 9, 9))
    """

    corners: Corners
    parameters: int = 2

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.Shape`."""
        place = self.corners.select(at), xy, width, form, window.columns, window.rows
        return corner_images(*place, fill=window.response.fill, derivatives=False)[:, 0]

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        place = self.corners.select(at), xy, width, form, window.columns, window.rows
        parts = corner_images(*place, fill=window.response.fill)
        return parts[:, 0], parts[:, 1:]


@dataclass(frozen=True, eq=False)
class Sectors:
    """What surrounds the corners of a board, in the plane of its design.

    Parameters
    ----------
    dark : ndarray (n, 2)
        Signs of x and y in a sector of each corner that is dark.
    opposite : ndarray of bool (n,)
        Whether the opposite sector is dark, too.
    reach : float
        Distance up to which edges are straight and their sides even.
    along : float
        The same along the edges, on the side of the sector `dark`.
    outlines : ndarray (m, j, 2)
        Corners of figures that lie in the sectors.
    ink : ndarray (m,)
        1 for dark figures in bright sectors, -1 for bright ones in dark sectors.
    """

    dark: Array
    opposite: Mask
    reach: float
    along: float
    outlines: Array
    ink: Array


class CornerMarks(PlaneMarks):
    """Corners of squares."""

    word = "corner"
    form_sigma = np.array([_TURN, _TURN])
    learnt_form_sigma = np.array([_TURNED, _TURNED])
    learnt_from = 24
    precise_start = True
    curve_first = True
    even = True
    formed_px = 0.0007
    least_seen = 0.15

    def __init__(
        self, image: Frame, screened: Screened, located: Located, options: ReseauOptions, sectors: Sectors
    ) -> None:
        super().__init__(image, screened, located, options, sectors.reach)
        self.sectors = sectors
        self.figures: tuple[Array, Chain, float, Array | None] | None = None

    def _steps(self, rows: Rows) -> tuple[Array, Array]:
        """Derivatives of the image by coordinates of the design, first (k, 2, 2), and second along each."""
        _, slope, bend = second_order(self.mapping, self.at[rows])
        along = np.einsum("kabc,bi,ci->kai", bend, self.frame, self.frame)
        return slope @ self.frame, along

    def _images(self, rows: Rows) -> tuple[Shape, Array]:
        """See :class:`PlaneMarks`."""
        slope, bend = self._steps(rows)
        length = np.linalg.norm(slope, axis=1)  # of a unit along x and y
        tangent = slope / length[:, None]
        # An edge along x has the dark sector on the side of ±y, and one along y on that of ±x.
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1).transpose(0, 2, 1)  # (k, edge, xy)
        towards = slope[:, :, ::-1] * self.sectors.dark[rows][:, None, ::-1]
        side = np.sign(np.einsum("kei,kie->ke", normal, towards))
        normal = normal * side[..., None]
        curvature = np.einsum("kei,kie->ke", normal, bend) / length**2
        corners = Corners(
            np.ascontiguousarray(normal), np.ascontiguousarray(curvature), self.sectors.opposite[rows]
        )
        reach = np.abs(slope).sum(axis=2) * self.sectors.reach
        if self.sectors.along > self.sectors.reach:
            # The edges end on one side; a window has both.
            sides = np.abs(slope) @ np.array([[self.sectors.along, 0], [0, self.sectors.along]])
            reach = np.maximum(reach, sides.max(axis=2))
        # A few corners do not show how a lens bends their edges.
        small = self.learning or self.found.sum() < _CURVED_FROM
        most = _LEARNING_PX + 2 * self.look.blur_px if small else _MOST_PX
        return CornerShape(corners, 4 if self._curved else 2), np.minimum(reach, most) - self._ground

    @property
    def _curved(self) -> bool:
        """Whether the curvatures of edges are adjusted; a wrong one of c shifts an edge by c L²/6."""
        return not self.learning and _CURVED_FROM <= self.found.sum() <= _SURE_CURVES

    def _form_sigma(self) -> Array:
        """See :class:`PlaneMarks`."""
        return np.append(self.look.form_sigma, 2 * [_BENT] if self._curved else [])

    @property
    def _ground(self) -> float:
        """What :meth:`_windows` adds to the reach of a mark."""
        return float(max(5, int(np.ceil(3.0 * self.look.blur_px))))

    def _region(self, rows: Rows, half: tuple[int, int]) -> Mask | None:
        """See :class:`PlaneMarks`: the half squares around a corner, and what lies along its edges."""
        slope, _ = self._steps(rows)
        centre = np.rint(self.start[rows])
        x = centre[:, :1] + np.arange(-half[0], half[0] + 1) - self.start[rows, :1]
        y = centre[:, 1:] + np.arange(-half[1], half[1] + 1) - self.start[rows, 1:]
        back = np.linalg.inv(slope)[..., None, None]
        one, two = (back[:, k, 0] * x[:, None, :] + back[:, k, 1] * y[:, :, None] for k in (0, 1))
        near_one, near_two = np.abs(one) < self.sectors.reach, np.abs(two) < self.sectors.reach
        inside: Mask = near_one & near_two
        if self.sectors.along > self.sectors.reach:
            for near, at, sign in ((near_two, one, 0), (near_one, two, 1)):
                side = at * self.sectors.dark[rows, sign, None, None]
                inside |= near & (side > 0) & (side < self.sectors.along)
        return inside

    def _beside(self) -> Array | None:
        """See :class:`PlaneMarks`: the markers in bright squares, as solid figures; bright cells of tags."""
        outlines, look = self.sectors.outlines, self.look
        if not len(outlines):
            return None
        if self.figures is not None:
            share, mapping, psf_px, kernel = self.figures
            alike = abs(psf_px / look.psf_px - 1) < _ALIKE_WIDTH
            if alike and mapping is self.mapping and kernel is look.kernel:
                return share
        h, w = self.screened.grey.shape
        share = np.zeros((h, w), dtype=np.float32)
        corners = images_of(self.mapping, outlines.reshape(-1, 2) @ self.frame.T + self.origin)
        reach = 0 if look.kernel is None else len(look.kernel) // 2
        margin = int(np.ceil(6 * look.psf_px)) + 2 + reach
        corners = corners.reshape(outlines.shape)
        low = np.floor(np.nan_to_num(corners.min(axis=1), nan=-_FAR_PX)) - margin
        size = np.ceil(np.ptp(np.nan_to_num(corners), axis=1)) + 2 * margin + 2
        seen = np.isfinite(corners).all(axis=(1, 2)) & (np.abs(corners) < _FAR_PX).all(axis=(1, 2))
        seen &= (low + size > 0).all(axis=1) & (low < (w, h)).all(axis=1)
        classes, of = np.unique(np.ceil(size / _FIGURES_PX), axis=0, return_inverse=True)
        for k, (wide, high) in enumerate((classes * _FIGURES_PX).astype(np.intp)):
            part = np.flatnonzero((of.ravel() == k) & seen)
            if not len(part):
                continue
            nodes = polygons(corners[part], _NODES_PX * look.psf_px).oriented().single()
            x, y = (low[part, i, None] + np.arange(n) for i, n in ((0, wide), (1, high)))
            taken = GrownOutline(nodes, np.zeros((0, 2, 2))).image(
                np.zeros((len(part), 2)),
                np.full(len(part), look.psf_px),
                np.zeros((len(part), 0)),
                np.arange(len(part)),
                Window(x, y, PixelResponse(self.options.fill)),
            )
            if look.kernel is not None:
                taken = np.stack([cv2.filter2D(image, -1, look.kernel) for image in taken])
            taken = taken * self.sectors.ink[part, None, None].astype(np.float32)
            for image, (left, top) in zip(taken, low[part].astype(np.intp), strict=True):
                a, b = max(left, 0), max(top, 0)
                place = share[b : top + high, a : left + wide]
                place += image[b - top : b - top + len(place), a - left : a - left + place.shape[1]]
        self.figures = share, self.mapping, look.psf_px, look.kernel
        return share

    def _settle(self, first: Matches) -> Matches:
        """See :class:`PlaneMarks`."""
        self.look = replace(self.look, psf_px=float(np.median(first.psf_px)))
        return first

    def _objections(self, rows: Rows, found: Matches) -> list[tuple[Mask, Reason]]:
        """See :class:`PlaneMarks`: where edges nearly coincide, small errors of their directions shift it."""
        slope, _ = self._steps(rows)
        tangent = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        flat = np.abs(np.linalg.det(tangent)) < _FLAT
        seen = Reason("seen at too flat an angle", Code.UNCERTAIN)
        # Of a corner on the border two sectors are not seen, and nothing shows an error of its edges.
        h, w = self.screened.grey.shape
        gap = np.minimum(found.xy, np.array([w - 1, h - 1]) - found.xy).min(axis=1)
        border = gap < _BORDER * self.look.blur_px, Reason("on the border of the frame", Code.OUTSIDE)
        return [border, *super()._objections(rows, found), (flat, seen)]

    def _edge_seen(self, rows: Rows, found: Matches) -> Array:
        """See :class:`PlaneMarks`."""
        used = np.isfinite(found.residuals)
        high, wide = (n // 2 for n in used.shape[1:])
        x, y = self._pixels(rows, (wide, high))
        slope, _ = self._steps(rows)
        tangent = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        rim = np.zeros(used.shape, dtype=bool)
        for k in range(2):
            across = tangent[:, 0, k, None, None] * (y - found.xy[:, 1, None, None])
            across = across - tangent[:, 1, k, None, None] * (x - found.xy[:, 0, None, None])
            rim |= np.abs(across) < _EDGE * self.look.blur_px
        region = self._region(rows, (wide, high))
        assert region is not None
        rim &= region
        return np.asarray((used & rim).sum(axis=(1, 2)) / np.maximum(rim.sum(axis=(1, 2)), 1))

    def _radius(self, rows: Rows) -> Array:
        """See :class:`PlaneMarks`: corners do not bulge."""
        return np.zeros(len(rows))
