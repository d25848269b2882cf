r"""Exact formation of images of plane shapes: smooth mapping, point-spread function, pixel integration.

A shape is given by its outline. With the pixel response :math:`h` along an axis (a Gaussian point-spread
function convolved with the light-sensitive width of the pixel) and :math:`H` its integral, the share of a
pixel's light that falls on the shape R is, by Green's theorem, an integral along the outline alone,

.. math:: a(p) = \iint_R h(p_x - q_x)\,h(p_y - q_y)\,dq = -\oint H(p_x - q_x)\,h(p_y - q_y)\,dq_y ,

so that Gauss–Legendre nodes on the outline give all pixels of a patch as one product of two small matrices.
Nothing is sampled in the image plane: a shift of the shape by 1/1000 px is a shift of its image by 1/1000 px.
The derivative for a motion :math:`v` of the outline is :math:`\oint h\,h\,(v_x dq_y - v_y dq_x)`; that for
the width of the Gaussian follows from the heat equation, :math:`\partial a/\partial s = s\,\nabla^2 a`.

The simulators draw with this module; the measurement matches with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import cast

import numpy as np
import scipy

from ..core.data import Array
from ..core.errors import UsageError
from .compiled import responses

_MOST_NODES = 20
"""Maximum number of nodes of a panel; longer sides are divided."""
_REACH = 5.5
"""Gaussian widths beyond which a response counts as zero: 4e-8 of the light."""
_BATCH = 5e4
"""Number of values processed at a time."""


def side_rule(length: float, spacing: float) -> tuple[Array, Array]:
    """Nodes and weights on [0, 1] of a Gauss–Legendre rule for a side; long sides have several panels.

    Examples
    --------
    >>> along, weight = side_rule(3.0, 0.5)
    >>> len(along), round(float(weight @ along**2), 12)
    (8, 0.333333333333)
    """
    nodes = max(2.0, length / spacing + 2)  # two more compensate for the ends of a short side
    panels = int(np.ceil(nodes / _MOST_NODES))
    t, w = _panel(int(np.ceil(nodes / panels)))
    return (np.arange(panels)[:, None] + t).ravel() / panels, np.tile(w / panels, panels)


@cache
def _panel(nodes: int) -> tuple[Array, Array]:
    t, w = np.polynomial.legendre.leggauss(nodes)
    return (t + 1) / 2, w / 2


@dataclass(frozen=True, eq=False)
class Outline:
    """Closed outlines as nodes of a quadrature rule.

    Parameters
    ----------
    xy : ndarray (..., j, 2)
        Points on the outline.
    dxy : ndarray (..., j, 2)
        Tangents times quadrature weights: :math:`(dq_x, dq_y)` at each node. The interior is on the left of
        the direction of travel, with x turning into y.
    """

    xy: Array
    dxy: Array

    @classmethod
    def polygon(cls, corners: Array, spacing: float) -> Outline:
        """Outline of a polygon.

        Parameters
        ----------
        corners : ndarray (k, 2)
            Corners in the direction that turns x into y.
        spacing : float
            Largest mean distance of two nodes, in the unit of the corners; 0.7 widths of the point-spread
            function make the quadrature exact to 1e-6 of the light.
        """
        xy, dxy = [], []
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            side = end - start
            along, weight = side_rule(float(np.hypot(*side)), spacing)
            xy.append(start + along[:, None] * side)
            dxy.append(weight[:, None] * side)
        return cls(np.concatenate(xy), np.concatenate(dxy))

    @classmethod
    def circle(cls, radius: float, spacing: float) -> Outline:
        """Outline of a circle around the origin; the trapezoidal rule is spectrally exact on it."""
        count = max(12, int(np.ceil(2 * np.pi * radius / spacing)))
        angle = 2 * np.pi * (np.arange(count) + 0.5) / count
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return cls(radius * unit, radius * 2 * np.pi / count * np.stack([-unit[:, 1], unit[:, 0]], axis=-1))

    @classmethod
    def through(cls, xy: Array, count: int) -> Outline:
        """Smooth outlines through points at equal steps of a parameter, by trigonometric interpolation.

        Where a mapping of a circle has no visible part of more than 8 waves around it, 17 points are as good
        as any number: there is no need to map each node.

        Parameters
        ----------
        xy : ndarray (..., m, 2)
            An odd number of points; those of a circle as :meth:`circle` places them.
        count : int
            Number of nodes.

        Examples
        --------
        >>> few, many = Outline.circle(2.0, 0.75), Outline.circle(2.0, 0.1)
        >>> again = Outline.through(few.xy, len(many.xy))
        >>> len(few.xy), len(many.xy), bool(np.abs(again.xy - many.xy).max() < 1e-12)
        (17, 126, True)
        >>> bool(np.abs(again.dxy - many.dxy).max() < 1e-12)
        True
        """
        flat = np.moveaxis(xy, -2, 0).reshape(xy.shape[-2], -1)
        nodes = (matrix @ flat for matrix in _interpolation(xy.shape[-2], count))
        shape = count, *xy.shape[:-2], 2
        return cls(*(np.ascontiguousarray(np.moveaxis(each.reshape(shape), 0, -2)) for each in nodes))

    def mapped(self, mapping: Callable[[Array], tuple[Array, Array]]) -> Outline:
        """Map the outline with a smooth mapping; after a mirroring one, call :meth:`oriented`.

        Parameters
        ----------
        mapping : callable
            Function of points (n, 2) that returns their images (n, 2) and the Jacobians (n, 2, 2).
        """
        flat = self.xy.reshape(-1, 2)
        xy, jacobian = mapping(flat)
        dxy = np.einsum("nij,nj->ni", jacobian, self.dxy.reshape(-1, 2))
        return Outline(xy.reshape(self.xy.shape), dxy.reshape(self.dxy.shape))

    def oriented(self) -> Outline:
        """Each outline with its interior on the left, also after a mirroring mapping."""
        doubled_area = (self.xy[..., 0] * self.dxy[..., 1] - self.xy[..., 1] * self.dxy[..., 0]).sum(axis=-1)
        return Outline(self.xy, self.dxy * np.where(doubled_area < 0, -1.0, 1.0)[..., None, None])

    def single(self) -> Outline:
        """The outline in single precision."""
        xy, dxy = (cast(Array, nodes.astype(np.float32)) for nodes in (self.xy, self.dxy))
        return Outline(xy, dxy)

    def affine(self, matrix: Array, shift: Array | None = None) -> Outline:
        """Outlines transformed by matrices (..., 2, 2) and shifts (..., 2), one for each."""
        turned = np.swapaxes(matrix, -1, -2)
        xy = self.xy @ turned
        return Outline(xy if shift is None else xy + shift[..., None, :], self.dxy @ turned)


@lru_cache(maxsize=32)
def _interpolation(points: int, count: int) -> tuple[Array, Array]:
    """Matrices (count, points) by which values at points become those, and weighted slopes, at nodes."""
    waves = np.arange(1, points // 2 + 1)
    there, here = (2 * np.pi * np.outer((np.arange(n) + 0.5) / n, waves) for n in (count, points))
    cosine, sine = np.cos(here).T, np.sin(here).T
    value = (1 + 2 * (np.cos(there) @ cosine + np.sin(there) @ sine)) / points
    slope = (np.cos(there) * waves) @ sine - (np.sin(there) * waves) @ cosine
    return np.asarray(value), np.asarray(slope * (4 * np.pi / (points * count)))


def polygons(corners: Array, spacing: float) -> Outline:
    """Outlines of polygons with equally many corners, in columns.

    Parameters
    ----------
    corners : ndarray (k, c, 2)
        Corners in the direction that turns x into y.
    spacing : float
        Largest mean distance of two nodes; see :meth:`Outline.polygon`.

    Returns
    -------
    Outline (k, j, 2)
        Every side has as many nodes as the longest one needs.

    Examples
    --------
    >>> square = np.array([[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]])
    >>> outline = polygons(square, 0.5)
    >>> doubled = outline.xy[..., 0] * outline.dxy[..., 1] - outline.xy[..., 1] * outline.dxy[..., 0]
    >>> float(doubled.sum().round(6))
    8.0
    """
    side = np.roll(corners, -1, axis=1) - corners
    longest = float(np.hypot(side[..., 0], side[..., 1]).max(initial=0.0))
    along, weight = side_rule(longest, spacing)
    xy = corners[:, :, None] + along[:, None] * side[:, :, None]
    dxy = weight[:, None] * side[:, :, None]
    flat = len(corners), corners.shape[1] * len(along), 2
    return Outline(xy.reshape(flat), dxy.reshape(flat))


def rectangles(edges: Array, spacing: float) -> Outline:
    """Outlines of upright rectangles, in columns.

    Parameters
    ----------
    edges : ndarray (k, 4)
        x and y of one corner, then of the opposite corner, both larger.
    spacing : float
        Largest mean distance of two nodes; see :meth:`Outline.polygon`.

    Returns
    -------
    Outline (k, j, 2)
    """
    size = edges[:, 2:] - edges[:, :2]
    # Sides of the unit square with as many panels as the largest rectangle needs.
    unit, turn = Outline(np.empty((0, 2)), np.empty((0, 2))), np.array([[0.0, 1.0], [-1.0, 0.0]])
    for side in range(4):
        along, weight = side_rule(float(size[:, side % 2].max(initial=0.0)), spacing)
        # The lower side; each further one is rotated by 90° about the centre.
        quarter = np.linalg.matrix_power(turn, side)
        xy = (np.stack([along, np.zeros_like(along)], axis=-1) - 0.5) @ quarter + 0.5
        dxy = np.stack([weight, np.zeros_like(along)], axis=-1) @ quarter
        unit = Outline(np.concatenate([unit.xy, xy]), np.concatenate([unit.dxy, dxy]))
    return Outline(edges[:, None, :2] + unit.xy * size[:, None], unit.dxy * size[:, None])


def mark_outline(
    shape: str, size: float, line_width: float | None, spacing: float, reach: float = 0.0
) -> Outline:
    """Outline of a mark of a design around its point, in the unit of `size`.

    Parameters
    ----------
    shape : {"cross", "disk", "rod", "square", "line-grid"}
        As in ``reseau-design/1``: `size` is the tip-to-tip length of a cross, the diameter of a disk or a
        rod, the side of a square; a crossing of a line grid has no size but arms of `line_width` that extend
        to `reach`.
    spacing : float
        Largest distance of two nodes of the quadrature.

    Raises
    ------
    UsageError
        When the shape is unknown, or a cross or a grid has no line width.
    """
    if shape in ("disk", "rod"):
        return Outline.circle(size / 2, spacing)
    if shape == "square":
        return Outline.polygon(size / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]]), spacing)
    if shape in ("cross", "line-grid"):
        if line_width is None:
            raise UsageError(f"a mark of shape {shape!r} needs its `line_width`")
        w, r = line_width / 2, (size / 2 if shape == "cross" else reach)
        arm = np.array([[r, -w], [r, w], [w, w]])
        turn = np.array([[0.0, 1.0], [-1.0, 0.0]])  # rotates a row vector by +90°
        corners = np.concatenate([arm @ np.linalg.matrix_power(turn, k) for k in range(4)])
        return Outline.polygon(corners, spacing)
    raise UsageError(f"there is no mark of shape {shape!r}")


@dataclass(frozen=True)
class PixelResponse:
    """Response of a pixel to light along an axis: a Gaussian convolved with its light-sensitive width.

    Parameters
    ----------
    fill : float
        Light-sensitive share of the pitch along the axis, 0 to 1; 0.8 for 21.6 of 27 µm.
    """

    fill: float = 1.0

    def orders(
        self, pixels: Array, points: Array, sigma: Array | float, highest: int, *, integral: bool = True
    ) -> list[Array]:
        """Integral, value and derivatives of the response of pixels to light at points.

        Parameters
        ----------
        pixels : ndarray (..., c)
            Pixel coordinates along the axis.
        points : ndarray (..., j)
            Coordinates of the points along the axis.
        sigma : ndarray or float
            Width of the Gaussian in pixels, broadcasting with (..., j, c).
        highest : int
            Highest derivative to compute.
        integral : bool
            Whether to compute the integral; without it and without derivatives this is twice as fast.

        Returns
        -------
        list of ndarray (..., j, c)
            :math:`H, h, h', …` up to the derivative `highest`; without :math:`H` if not requested.
        """
        half = max(self.fill, 1e-6) / 2
        if self.fill == 1.0 and (np.diff(pixels) == 1.0).all():
            if highest <= 1 and pixels.ndim == points.ndim == 2 and points.dtype == np.float64:
                return _compiled_orders(pixels, points, sigma)[0 if integral else 1 : 2 + highest]
            # Adjacent pixels share an edge, which halves the work.
            edges = np.concatenate([pixels[..., :1] - half, pixels + half], axis=-1)
            found = _steps(edges[..., None, :] - points[..., None], sigma, highest, integral)
            return [np.diff(order, axis=-1) for order in found]
        offset = pixels[..., None, :] - points[..., None]
        ends = [_steps(offset + edge, sigma, highest, integral) for edge in (half, -half)]
        return [(right - left) / (2 * half) for right, left in zip(*ends, strict=True)]


def _compiled_orders(pixels: Array, points: Array, sigma: Array | float) -> list[Array]:
    """Integral, value and derivative of the response of adjacent pixels (k, c) to light at points (k, j)."""
    count = np.broadcast_shapes(pixels.shape[:1], points.shape[:1])[0]
    width = np.broadcast_to(np.asarray(sigma, dtype=np.float64), (count, 1, 1))[:, 0, 0].copy()
    out = np.empty((3, count, points.shape[1], pixels.shape[1]))
    first = np.broadcast_to(pixels[:, 0], (count,)).astype(np.float64)
    # Of one layout: another one would be compiled again.
    responses(np.broadcast_to(points, (count, points.shape[1])).copy(), first, width, out)
    return list(out)


def _steps(t: Array, sigma: Array | float, highest: int, integral: bool) -> list[Array]:
    """Integral of the blurred step, the step, and its derivatives at offsets `t`."""
    z = t / sigma
    step, bell = (
        scipy.special.ndtr(z),
        np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) if integral or highest else z,
    )
    found: list[Array] = [step]
    if integral:
        found.insert(0, t * found[0] + sigma * bell)
    # Derivatives of a Gaussian by Hermite polynomials: He_{k+1} = z He_k - k He_{k-1}.
    before: Array | float = 0.0
    hermite: Array | float = 1.0
    for k in range(highest):
        found.append(hermite * bell / (-sigma) ** k / sigma)
        before, hermite = hermite, z * hermite - k * before
    return found


def coverage(
    outline: Outline,
    columns: Array,
    rows: Array,
    sigma: Array | float,
    response: PixelResponse = PixelResponse(),
) -> Array:
    """Share of each pixel's light that falls on the shape, 0 to 1.

    Parameters
    ----------
    outline : Outline
        Outline in pixels, (..., j, 2).
    columns, rows : ndarray (..., c), (..., r)
        Pixel coordinates of the patch.
    sigma : float or ndarray (...)
        Width of the point-spread function in pixels.

    Returns
    -------
    ndarray (..., r, c)
    """
    width = np.asarray(sigma, dtype=outline.xy.dtype)[..., None, None]
    h_x = response.orders(columns, outline.xy[..., 0], width, 0)[0]
    h_y = response.orders(rows, outline.xy[..., 1], width, 0, integral=False)[0]
    return np.swapaxes(h_y * -outline.dxy[..., :, 1:], -1, -2) @ h_x


def coverage_derivatives(
    outline: Outline,
    columns: Array,
    rows: Array,
    sigma: Array | float,
    response: PixelResponse = PixelResponse(),
    motions: Array | None = None,
) -> tuple[Array, Array]:
    """Compute the share of light and its derivatives with respect to position, width and form.

    Parameters
    ----------
    outline, columns, rows, sigma, response
        As for `coverage`.
    motions : ndarray (..., m, j, 2), optional
        Velocities of the nodes for m further parameters of the form.

    Returns
    -------
    share : ndarray (..., r, c)
    derivatives : ndarray (..., 3 + m, r, c)
        With respect to a shift along x, a shift along y, `sigma`, and the further parameters.
    """
    width = np.asarray(sigma, dtype=outline.xy.dtype)[..., None, None]
    big_x, h_x, d_x = response.orders(columns, outline.xy[..., 0], width, 1)
    h_y, d_y = response.orders(rows, outline.xy[..., 1], width, 1, integral=False)
    dx, dy = outline.dxy[..., :, :1], outline.dxy[..., :, 1:]
    t_y, td_y = np.swapaxes(h_y, -1, -2), np.swapaxes(d_y, -1, -2)
    flat_x, flat_y = np.swapaxes(dx, -1, -2), np.swapaxes(dy, -1, -2)
    share = (t_y * -flat_y) @ big_x
    along_x = (t_y * flat_y) @ h_x
    along_y = (t_y * -flat_x) @ h_x
    # a_xx and a_yy are minus the derivatives of the two above with respect to the pixel.
    heat = -((t_y * flat_y) @ d_x) + ((td_y * flat_x) @ h_x)
    parts = [along_x, along_y, width * heat]
    if motions is not None:
        normal = motions[..., 0] * dy[..., None, :, 0] - motions[..., 1] * dx[..., None, :, 0]
        parts += [(t_y * normal[..., k, None, :]) @ h_x for k in range(normal.shape[-2])]
    return share, np.stack(parts, axis=-3)


def draw(
    outline: Outline,
    shape: tuple[int, int],
    sigma: float,
    response: PixelResponse = PixelResponse(),
    row_shifts: Array | None = None,
) -> Array:
    """Draw many disjoint shapes into one frame.

    Parameters
    ----------
    outline : Outline
        Outlines in pixels, (k, j, 2), one for each shape.
    shape : tuple
        Height and width of the frame.
    sigma : float
        Width of the point-spread function in pixels.
    row_shifts : ndarray (height,), optional
        Shift of the content of each row along x in pixels (row jitter), by a series of fourth order, accurate
        to 1e-4 of the light for shifts below 0.3 `sigma`.

    Returns
    -------
    ndarray (height, width)
        Share of each pixel's light that falls on the shapes, 0 to 1.
    """
    canvas = np.zeros(shape)
    margin = _REACH * sigma + 1
    first = np.maximum(np.floor(outline.xy.min(axis=1) - margin), 0).astype(np.intp)
    last = np.minimum(np.ceil(outline.xy.max(axis=1) + margin), np.array(shape[::-1]) - 1).astype(np.intp)
    seen = np.flatnonzero((last >= first).all(axis=1))
    # Process shapes of similar extent together, so that batches are compact and fit into the cache.
    extent = last - first + 1
    seen = seen[np.lexsort((extent[seen, 0], extent[seen, 1]))]
    while len(seen):
        step = max(1, int(_BATCH / (outline.xy.shape[1] * max(extent[seen[-1]]))))
        batch, seen = seen[-step:], seen[:-step]
        wide, high = extent[batch].max(axis=0)
        columns = first[batch, :1] + np.arange(wide)
        rows = first[batch, 1:] + np.arange(high)
        part = Outline(outline.xy[batch], outline.dxy[batch])
        inside = rows < shape[0]
        shifts = (
            None if row_shifts is None else np.where(inside, row_shifts[np.minimum(rows, shape[0] - 1)], 0)
        )
        share = _shifted_coverage(part, columns, rows, sigma, response, shifts)
        keep = inside[:, :, None] & (columns < shape[1])[:, None, :]
        at = np.broadcast_to(rows[:, :, None] * shape[1] + columns[:, None, :], keep.shape)
        np.add.at(canvas.reshape(-1), at[keep], share[keep])
    return canvas


def _shifted_coverage(
    outline: Outline, columns: Array, rows: Array, sigma: float, response: PixelResponse, shifts: Array | None
) -> Array:
    """Coverage with a small shift (..., r) for every row."""
    if shifts is None:
        return coverage(outline, columns.astype(float), rows.astype(float), sigma, response)
    highest = 4
    along = response.orders(columns, outline.xy[..., 0], sigma, highest - 1)
    h_y = response.orders(rows, outline.xy[..., 1], sigma, 0, integral=False)[0]
    weighted = np.swapaxes(h_y * -outline.dxy[..., :, 1:], -1, -2)
    share, factor = np.zeros((*rows.shape, columns.shape[-1])), np.ones_like(shifts)
    for order, h_x in enumerate(along):
        share += factor[..., None] * (weighted @ h_x)
        factor = factor * -shifts / (order + 1)
    return share
