"""Matching of corners where squares or triangles meet, once they are found and numbered.

The image of a corner is formed from its two or three edges, with the directions and the curvature that the
mapping through all corners gives them; the directions are adjusted with the position. A window extends half
a square to all sides, and shows only the squares that meet; the markers of a ChArUco board are formed as
what lies beside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code
from ...optics.composition import Chain
from ...optics.corners import Corners, corner_images
from ...optics.formation import PixelResponse, polygons
from ..marks.judging import Objection
from ..matching import Matches, Shape
from ..matching.patches import add_windows, filtered
from ..matching.shapes import GrownOutline, Window
from ..plane.lattice_mapping import images_of, second_order
from ..plane.lens_mapping import UNFIT, mapping_through
from ..plane.levels import levels_around
from ..reseau.mark_windows import BESIDE, ENOUGH, Located
from ..reseau.marks import ReseauOptions
from ..reseau.plane_marks import PlaneMarks, intact
from ..response import sharpened_from_px
from ..screening import Screened
from .candidates import ended
from .shadows import Shaded, pixels_alike, shaded

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
_BENT_SIGMA = 1.5
"""Shift of an edge by another curvature, in sigmas, from which corners are matched again."""
_UNLIKE_WIDTH, _NEAR = 0.1, 4
"""Relative difference of the sharpness of corners from which figures have that of so many near them."""
_EDGE = 1.5
"""Half the width of an edge in widths of the point-spread function."""
_ALIKE_WIDTH, _ALIKE_PX = 0.05, 0.05
"""Relative change of the sharpness, and shift, from which markers are formed anew."""
_LEAST_EDGE = 0.1
"""Share of the pixels of an edge below which it is not seen."""
BORDER_PX = 2
"""Outermost lines of a frame that are not used: filters of cameras and programs do not know what is beyond
the frame, and displace edges there."""
_BORDER = 2.0
"""Least distance of a corner from the outermost pixels used, in widths of the point-spread function."""
_SAMPLED_OF_TAGS = 20
"""Most corners of single tags that show the camera's response."""
_SHOWS_GROWTH = 12
"""Least number of corners that show the growth of ink."""
_FLAT = 0.35
"""Least sine of the angle between the edges of a corner."""
_FAR_PX, _FIGURES_PX = 1e5, 24
"""Coordinates from which a mapping is not used; step of the window sizes of figures."""
_BRIGHT_AT, _DARK_AT = 0.2, 0.6
"""Where bright and dark sectors are looked at, as shares of the reach along both edges."""
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
        Number of parameters of the form: a turn of each edge, or twice as many, a turn and a curvature.

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
        needed, fill = window.needed, window.response.fill
        return corner_images(*place, fill=fill, derivatives=False, needed=needed)[:, 0]

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        place = self.corners.select(at), xy, width, form, window.columns, window.rows
        parts = corner_images(*place, fill=window.response.fill, needed=window.needed)
        return parts[:, 0], parts[:, 1:]


@dataclass(frozen=True, eq=False)
class Sectors:
    """What surrounds the corners of a board, in the plane of its design.

    Parameters
    ----------
    normal : ndarray (n, e, 2)
        Unit normals of the e edges of each corner, see :class:`reseau.optics.corners.Corners`: of two edges,
        which are those along x and along y, towards a dark sector.
    opposite : ndarray of bool (n,)
        Whether the sector opposite to this one is dark, too.
    reach : float
        Distance up to which edges are straight and their sides even.
    along : float
        The same along two edges, on the side of the dark sector.
    outlines : ndarray (m, j, 2)
        Corners of figures that lie in the sectors.
    ink : ndarray (m,)
        1 for dark figures in bright sectors, -1 for bright ones in dark sectors.
    """

    normal: Array
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
    sampled = 8
    precise_start = True
    bounded = True
    curve_first = True
    even = True
    formed_px = 0.0007
    least_seen = 0.15

    def __init__(
        self, image: Frame, screened: Screened, located: Located, options: ReseauOptions, sectors: Sectors
    ) -> None:
        super().__init__(image, screened, located, options, sectors.reach)
        self.sectors = sectors
        self.figures: tuple[Array, Array, Array, Array | None] | None = None
        if not self.balanced:
            # What is not known of the camera shifts them: it is learnt from more.
            self.sampled = _SAMPLED_OF_TAGS
        self.crossed = np.zeros(len(self.xy), dtype=bool)  # by edges that nothing explains
        self.widths = np.full(len(self.xy), np.nan)  # of the point-spread function at corners, if it varies

    def _curvature(self, mapping: Chain, rows: Rows) -> Array:
        """Curvatures (k, e) of the edges with a mapping, 1/px; their signs are those of the normals."""
        _, along, bend = self._steps(rows, mapping)
        length = np.linalg.norm(along, axis=1)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
        return np.asarray(np.einsum("kie,kie->ke", normal, bend) / length**2)

    def _steps(self, rows: Rows, mapping: Chain | None = None) -> tuple[Array, Array, Array]:
        """Derivatives of the image by coordinates of the design (k, 2, 2); along edges, and second ones."""
        _, slope, bend = second_order(mapping or self.mapping, self.at[rows])
        # A normal turned by 90°.
        along = (self.sectors.normal[rows][..., ::-1] * [-1, 1]) @ self.frame.T
        return (
            slope @ self.frame,
            np.einsum("kab,keb->kae", slope, along),
            np.einsum("kabc,keb,kec->kae", bend, along, along),
        )

    def _images(self, rows: Rows) -> tuple[Shape, Array]:
        """See :class:`PlaneMarks`."""
        slope, along, bend = self._steps(rows)
        length = np.linalg.norm(along, axis=1)  # of a unit along each edge
        tangent = along / length[:, None]
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1).transpose(0, 2, 1)  # (k, edge, xy)
        towards = np.einsum("kij,kej->kei", slope, self.sectors.normal[rows])
        side = np.sign(np.einsum("kei,kei->ke", normal, towards))
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
        edges = self.sectors.normal.shape[1]
        return CornerShape(corners, 2 * edges if self._curved else edges), np.minimum(
            reach, most
        ) - self._ground

    @property
    def _curved(self) -> bool:
        """Whether the curvatures of edges are adjusted; a wrong one of c shifts an edge by c L²/6."""
        few = self.found.sum() <= _SURE_CURVES
        return not self.learning and self.found.sum() >= _CURVED_FROM and (few or self.misfit > UNFIT)

    def _bent(self, rows: Rows, found: Matches) -> bool:
        """See :class:`PlaneMarks`: whether the mapping through all corners bends edges otherwise."""
        if len(rows) < ENOUGH:
            return False
        h, w = self.screened.grey.shape
        sigma = np.sqrt(found.variance)
        other = mapping_through(self.at[rows], found.xy, sigma, (h, w)).mapping
        self.precise = other, rows
        reach = self._images(rows)[1].max(axis=1, keepdims=True) + self._ground
        change = np.abs(self._curvature(other, rows) - self._curvature(self.mapping, rows)) * reach**2 / 6
        unlike = np.quantile(np.abs(np.log(found.psf_px / self.look.psf_px)), 0.9) > _UNLIKE_WIDTH
        if unlike and len(self.sectors.outlines):
            self.widths[rows] = found.psf_px
            return True
        return bool(np.quantile(change / sigma[:, None], 0.95) > _BENT_SIGMA) or super()._bent(rows, found)

    def _form_sigma(self) -> Array:
        """See :class:`PlaneMarks`."""
        return np.append(self.look.form_sigma, self.sectors.normal.shape[1] * [_BENT] if self._curved else [])

    @property
    def _ground(self) -> float:
        """What :meth:`_windows` adds to the reach of a mark."""
        return float(max(5, int(np.ceil(3.0 * self.look.blur_px))))

    def _region(self, rows: Rows, half: tuple[int, int]) -> Mask | None:
        """See :class:`PlaneMarks`: the half squares around a corner, and what lies along its edges."""
        back = np.linalg.inv(self._steps(rows)[0])
        across = np.einsum("kei,kij->kej", self.sectors.normal[rows], back)
        return _pixels_around(self.start[rows], across, half, self.sectors.reach, self.sectors.along)

    @property
    def balanced(self) -> bool:
        """See :class:`MarkWindows`: with a dark sector opposite, or three of six."""
        return bool(self.sectors.opposite.all())

    @property
    def surrounded(self) -> bool:
        """See :class:`MarkWindows`."""
        return len(self.sectors.outlines) > 0

    def beside(self) -> Array | None:
        """See :class:`PlaneMarks`: the markers in bright squares, as solid figures; bright cells of tags."""
        outlines, look = self.sectors.outlines, self.look
        if not len(outlines):
            return None
        lattice = outlines @ self.frame.T + self.origin
        corners, width = images_of(self.mapping, lattice.reshape(-1, 2)), self._width(lattice.mean(axis=1))
        if self.figures is not None:
            share, before, psf_px, kernel = self.figures
            alike = np.abs(psf_px / width - 1).max() < _ALIKE_WIDTH and kernel is look.kernel
            with np.errstate(invalid="ignore"):
                if alike and np.nanmax(np.abs(corners - before)) < _ALIKE_PX:
                    return share
        at = corners
        h, w = self.screened.grey.shape
        share = np.zeros((h, w), dtype=np.float32)
        reach = 0 if look.kernel is None else len(look.kernel) // 2
        margin = int(np.ceil(6 * width.max())) + 2 + reach
        corners = corners.reshape(outlines.shape)
        low = np.floor(np.nan_to_num(corners.min(axis=1), nan=-_FAR_PX)) - margin
        size = np.ceil(np.ptp(np.nan_to_num(corners), axis=1)) + 2 * margin + 2
        seen = np.isfinite(corners).all(axis=(1, 2)) & (np.abs(corners) < _FAR_PX).all(axis=(1, 2))
        # Far from the corners found a polynomial may have any size.
        most = 2 * max(h, w)
        seen &= (low + size > 0).all(axis=1) & (low < (w, h)).all(axis=1) & (size < most).all(axis=1)
        classes, of = np.unique(np.ceil(np.minimum(size, most) / _FIGURES_PX), axis=0, return_inverse=True)
        for k, (wide, high) in enumerate((classes * _FIGURES_PX).astype(np.intp)):
            part = np.flatnonzero((of.ravel() == k) & seen)
            if not len(part):
                continue
            nodes = polygons(corners[part], _NODES_PX * width[part].min()).oriented()
            x, y = (low[part, i, None] + np.arange(n) for i, n in ((0, wide), (1, high)))
            taken = GrownOutline(nodes, np.zeros((0, 2, 2))).image(
                np.zeros((len(part), 2)),
                width[part],
                np.zeros((len(part), 0)),
                np.arange(len(part)),
                Window(x, y, PixelResponse(self.options.fill)),
            )
            if look.kernel is not None:
                wider = np.pad(taken, ((0, 0), (reach, reach), (reach, reach)))
                taken = filtered(wider, look.kernel.astype(np.float32))
            add_windows(share, self.sectors.ink[part, None, None] * taken, low[part].astype(np.intp))
        self.figures = share, at, width, look.kernel
        return share

    def _without_growth(self, rows: Rows, found: Matches) -> Matches:
        """See :class:`PlaneMarks`: corners of single tags without a shift of their edges.

        Ink spreads on paper, and an error of the curve or the kernel of the camera looks similar: the edges
        of all tags are shifted. Opposite corners of a tag are images of each other turned by 180° and move in
        opposite directions, which no smooth mapping does. The shifts along x and y of both pairs are
        estimated, with a polynomial, from what the mapping leaves.
        """
        mapping, known = self._best_known(rows)
        good = intact(found) & known
        if self.balanced or good.sum() < _SHOWS_GROWTH:
            return found
        shape = self._images(rows)[0]
        assert isinstance(shape, CornerShape)
        shift = np.linalg.inv(shape.corners.normal)  # (k, xy, edge): of the point, by that of each edge
        pair = self.sectors.normal[rows].sum(axis=1).prod(axis=1) > 0
        shift = np.concatenate([np.where(of[:, None, None], shift, 0.0) for of in (pair, ~pair)], axis=2)
        terms = self._smooth_terms(rows[good])
        if terms is None:
            at = self._straight(rows[good])
            terms = np.column_stack([np.ones(len(at)), at - at.mean(axis=0)])
        none = np.zeros_like(terms)
        design = np.block([[terms, none, shift[good, 0]], [none, terms, shift[good, 1]]])
        if len(design) <= design.shape[1]:
            return found
        sigma = np.sqrt(np.diagonal(found.cov[good], axis1=1, axis2=2)).T.ravel()
        bent = (found.xy[good] - mapping(self.at[rows[good]])).T.ravel() / sigma
        weighted = design / sigma[:, None]
        inverse = np.linalg.pinv(weighted.T @ weighted, hermitian=True)
        values = inverse @ (weighted.T @ bent)
        square = float(((weighted @ values - bent) ** 2).sum()) / (len(design) - design.shape[1])
        cofactor = max(square, 1.0) * inverse[-4:, -4:]
        return replace(
            found,
            xy=found.xy - shift @ values[-4:],
            cov=found.cov + shift @ cofactor @ np.swapaxes(shift, 1, 2),
        )

    def _in_shadows(self, rows: Rows, found: Matches) -> Matches:
        """See :class:`PlaneMarks`: shadows make objections to some corners, and displace others."""
        objected = np.any([mask for mask, *_ in self._objections(rows, found)], axis=0)
        plain = intact(found) & ~objected
        if not (objected & (found.rejected > 0)).any() or plain.sum() < ENOUGH or not self.balanced:
            return found
        noise, ink = float(np.median(found.noise[plain])), float(np.median(found.contrast[plain]))
        alike = pixels_alike(found.residuals[plain])
        start = self.start[rows] = np.where(plain[:, None], found.xy, self.mapping(self.at[rows]))
        images, reach = self._images(rows)
        high, wide = (n // 2 for n in found.residuals.shape[1:])
        beside, psf = self.beside(), (self.look.psf_px, self.look.psf_log_sigma)

        def looked_at(part: Rows, half: tuple[int, int]) -> Shaded:
            half = min(half[0], wide), min(half[1], high)
            x, y = self.pixels(rows[part], half)
            window, region = self.window(rows[part], half), self._region(rows[part], half)
            used = (
                self.screened.valid[y, x] & (x == window.columns[:, None, :]) & (y == window.rows[:, :, None])
            )
            used &= True if region is None else region
            if beside is not None:
                used &= np.abs(beside[y, x]) < BESIDE
            return shaded(
                self.screened.grey[y, x].astype(np.float64), used, self._shape(images, part), window,
                start[part], ink, psf, self._form_sigma(), noise, alike,
            )  # fmt: skip

        # Where no corner that is objected to lies in a shadow, none does.
        suspected = objected & (found.rejected > 0)
        for chosen in (suspected, ~suspected):
            some = False
            for part, half in self._windows(reach):
                part = part[chosen[part]]
                if len(part):
                    own = looked_at(part, half)
                    found = own.instead_of(found, part)
                    self.crossed[rows[part]] = ~own.converged
                    some |= bool((own.edges > 0).any() or not own.converged.all())
            if not some:
                break
        return found

    def _width(self, at: Array) -> Array:
        """Widths (m,) of the point-spread function at places of the lattice; if it varies, those near."""
        known = np.flatnonzero(np.isfinite(self.widths))
        if len(known) < _NEAR:
            return np.full(len(at), self.look.psf_px)
        near = scipy.spatial.KDTree(self.at[known]).query(at, k=_NEAR)[1]
        return np.asarray(np.median(self.widths[known][near], axis=1))

    def settle(self, first: Matches) -> Matches:
        """See :class:`PlaneMarks`."""
        self.look = replace(self.look, psf_px=float(np.median(first.psf_px)))
        return first

    def _objections(self, rows: Rows, found: Matches) -> list[Objection]:
        """See :class:`PlaneMarks`: where edges nearly coincide, small errors of their directions shift it."""
        _, along, _ = self._steps(rows)
        tangent = along / np.linalg.norm(along, axis=1, keepdims=True)
        # Sines of the angles between each edge and the next.
        other = np.roll(tangent, 1, axis=2)
        sine = tangent[:, 0] * other[:, 1] - tangent[:, 1] * other[:, 0]
        flat = np.abs(sine).max(axis=1) < _FLAT
        # Of a corner on the border two sectors are not seen, and nothing shows an error of its edges.
        h, w = self.screened.grey.shape
        gap = np.minimum(found.xy, np.array([w - 1, h - 1]) - found.xy).min(axis=1)
        # What the kernel takes from beyond the frame is unknown.
        beyond = 0 if self.look.kernel is None else sharpened_from_px(self.look.kernel)
        near = gap < max(BORDER_PX + _BORDER * self.look.blur_px, beyond)
        # Without its pixels an edge is where faint tails of its blur have it.
        part = found.converged & (np.isfinite(found.residuals).sum(axis=(1, 2)) < self.own_px[rows])
        unseen = part.copy()
        unseen[part] = self._edges_seen(rows[part], found.select(part)).min(axis=1) < _LEAST_EDGE
        ends = "the pattern ends there: paper is where a dark square should be"
        return [
            (near, "on the border of the frame", Code.OUTSIDE),
            (self._single(rows), ends, Code.OTHER_DESIGN),
            (self.crossed[rows], "edges of shadows, or of something else, cross it", Code.DISTURBED),
            (unseen, "an edge is hidden or saturated", Code.HIDDEN),
            *super()._objections(rows, found),
            (flat, "seen at too flat an angle", Code.UNCERTAIN),
        ]

    def _single(self, rows: Rows) -> Mask:
        """Which corners, not found before, are those of a single square where two should meet."""
        single: Mask = ~self.found[rows] & self.sectors.opposite[rows]
        if self.sectors.normal.shape[1] != 2 or not single.any():
            return np.zeros(len(rows), dtype=bool)
        one, two = np.moveaxis(self.sectors.normal[rows[single]], 1, 0)
        # Markers lie in bright squares, at some distance from their corners.
        shares = np.array([_BRIGHT_AT, _BRIGHT_AT, _DARK_AT, _DARK_AT])[:, None, None] * self.sectors.reach
        around = shares * np.stack([one - two, two - one, one + two, -one - two])
        around = np.moveaxis(around, 0, 1) @ self.frame.T
        levels = levels_around(self.screened.grey, self.mapping, self.at[rows[single]], around)
        single[single] = ended(levels, np.ones(len(levels), dtype=bool))
        return single

    def _edge_seen(self, rows: Rows, found: Matches) -> Array:
        """See :class:`PlaneMarks`."""
        return np.asarray(self._edges_seen(rows, found).mean(axis=1))

    def _edges_seen(self, rows: Rows, found: Matches) -> Array:
        """Share (k, e) of the pixels on each blurred edge that were used."""
        used = np.isfinite(found.residuals)
        high, wide = (n // 2 for n in used.shape[1:])
        x, y = self.pixels(rows, (wide, high))
        _, along, _ = self._steps(rows)
        tangent = along / np.linalg.norm(along, axis=1, keepdims=True)
        region = self._region(rows, (wide, high))
        assert region is not None
        shares = []
        for k in range(tangent.shape[2]):
            across = tangent[:, 0, k, None, None] * (y - found.xy[:, 1, None, None])
            across = across - tangent[:, 1, k, None, None] * (x - found.xy[:, 0, None, None])
            rim = region & (np.abs(across) < _EDGE * self.look.blur_px)
            shares.append((used & rim).sum(axis=(1, 2)) / np.maximum(rim.sum(axis=(1, 2)), 1))
        return np.stack(shares, axis=1)

    def radius(self, rows: Rows) -> Array:
        """See :class:`PlaneMarks`: corners do not bulge."""
        return np.zeros(len(rows))


class DeltilleMarks(CornerMarks):
    """Corners of triangles."""

    form_sigma = np.full(3, _TURN)
    learnt_form_sigma = np.full(3, _TURNED)
    even = False


def _pixels_around(start: Array, across: Array, half: tuple[int, int], reach: float, along: float) -> Mask:
    """Pixels (k, r, c) of windows that belong to corners: those near all edges, and along each of two.

    Parameters
    ----------
    start : ndarray (k, 2)
        Corners; windows are centred on the nearest pixels.
    across : ndarray (k, e, 2)
        Distances on the plane of the board from each edge, positive on its dark side, per pixel along x, y.
    half : (int, int)
        Half the width and height of the windows.
    reach, along : float
        Distance from the edges, and that along them on the dark side; `along` counts for two edges only,
        where it is larger.
    """
    off = np.rint(start) - start
    x, y = (off[:, i, None] + np.arange(-half[i], half[i] + 1.0) for i in range(2))
    away = across[:, :, :1, None] * x[:, None, None] + across[:, :, 1:, None] * y[:, None, :, None]
    beside = np.abs(away) < reach
    near: Mask = np.asarray(beside.all(axis=1))
    if along > reach:
        ahead = (away > 0) & (away < along)
        near |= (beside[:, 0] & ahead[:, 1]) | (beside[:, 1] & ahead[:, 0])
    return near
