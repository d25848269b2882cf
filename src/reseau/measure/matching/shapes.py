"""Shapes of marks: the interface through which the matcher forms images of marks.

The image of a shape depends on its position, the width of the point-spread function, and parameters of form
that start at 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...core.data import Array, Mask, Rows
from ...core.threads import one_thread
from ...optics.compiled import formed
from ...optics.formation import Outline, PixelResponse, coverage, coverage_derivatives


@dataclass(frozen=True, eq=False)
class Window:
    """Pixels in which images are formed: one window for each mark.

    Parameters
    ----------
    columns, rows : ndarray (k, c), (k, r)
        Coordinates of the columns and rows, pixels.
    response : PixelResponse
        Response of a pixel.
    needed : ndarray of bool (k, r, c), optional
        Pixels whose values are needed; the others may have any. By default all.

    Examples
    --------
    >>> columns, rows = np.arange(10.0)[None] + [[0], [30]], np.arange(8.0)[None] + [[0], [20]]
    >>> Window(columns, rows, PixelResponse()).select(np.array([1])).columns[:, 0]
    array([30.])
    """

    columns: Array
    rows: Array
    response: PixelResponse
    needed: Mask | None = None

    def select(self, at: Rows) -> Window:
        """Windows of the marks `at`."""
        needed = None if self.needed is None else self.needed[at]
        return Window(self.columns[at], self.rows[at], self.response, needed)


class Shape(Protocol):
    """Images of marks as functions of position (px), width of the point-spread function (px) and form.

    Examples
    --------
    >>> disk = Outline.circle(2.0, 0.5)
    >>> shape: Shape = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> window = Window(np.arange(9.0)[None], np.arange(9.0)[None], PixelResponse())
    >>> one = np.array([0])
    >>> image = shape.image(np.array([[4.0, 4.0]]), np.ones(1), np.zeros((1, 0)), one, window)
    >>> image.shape, bool(image[0, 4, 4] > 0.8)
    ((1, 9, 9), True)
    """

    @property
    def parameters(self) -> int:
        """Number of parameters of the form, all of which start at 0."""

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """Share (m, r, c) of each pixel covered by the marks `at` at (m, 2), widths (m,), forms (m, p)."""

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """Image, and its derivatives (m, 3 + p, r, c) with respect to x, y, width and the form."""


@dataclass(frozen=True, eq=False)
class GrownOutline:
    """Plane shapes whose outlines are multiplied by 1 + Σ p_i F_i.

    Parameters
    ----------
    nodes : Outline
        Outlines (k, j, 2) in pixels around the point to be measured, padded with zeros where an outline has
        fewer nodes. Outlines in single precision are formed in single precision, about eight times faster.
    generators : ndarray (p, 2, 2) or (k, p, 2, 2)
        The generators F_i, of all shapes or of each.

    Examples
    --------
    A disk whose diameter is an unknown, at 10 % more than its nominal size:

    >>> disk = Outline.circle(2.0, 0.5)
    >>> shape = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.eye(2)[None])
    >>> window = Window(np.arange(15.0)[None], np.arange(15.0)[None], PixelResponse())
    >>> image = shape.image(np.array([[7.0, 7.0]]), np.ones(1), np.array([[0.1]]), np.array([0]), window)
    >>> round(float(image.sum() / np.pi), 3)
    4.84
    """

    nodes: Outline
    generators: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return int(self.generators.shape[-3])

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`Shape`."""
        if self.nodes.xy.dtype == np.float32:
            return self._compiled(xy, width, form, at, window, 1)[:, 0]
        outline = self._placed(xy, form, at)
        return coverage(outline, window.columns, window.rows, width, window.response)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`Shape`."""
        if self.nodes.xy.dtype == np.float32:
            parts = self._compiled(xy, width, form, at, window, 4 + self.parameters)
            return parts[:, 0], parts[:, 1:]
        motions = None
        if self.parameters:
            motions = np.einsum("kpij,knj->kpni", self._generators(at), self.nodes.xy[at])
        outline = self._placed(xy, form, at)
        return coverage_derivatives(outline, window.columns, window.rows, width, window.response, motions)

    def _placed(self, xy: Array, form: Array, at: Rows) -> Outline:
        nodes, tangents = self.nodes.xy[at], self.nodes.dxy[at]
        if self.parameters:
            grown = np.swapaxes(np.eye(2) + np.einsum("kp,kpij->kij", form, self._generators(at)), 1, 2)
            nodes, tangents = nodes @ grown, tangents @ grown
        return Outline(nodes + xy[:, None, :], tangents)

    def _generators(self, at: Rows) -> Array:
        """Generators (m, p, 2, 2) of the shapes `at`."""
        if self.generators.ndim == 4:
            return self.generators[at]
        return np.broadcast_to(self.generators, (len(at), *self.generators.shape))

    def _compiled(self, xy: Array, width: Array, form: Array, at: Rows, window: Window, parts: int) -> Array:
        """Share and as many of its derivatives as `parts` asks for, (m, parts, r, c)."""
        corner = np.stack([window.columns[:, 0], window.rows[:, 0]], axis=1)
        images: Any = np.empty((len(at), parts, window.rows.shape[1], window.columns.shape[1]), np.float32)
        place, forms, sigma = (v.astype(np.float32) for v in (xy - corner, form, width))
        # A step of an adjustment may lead to values without an image.
        finite = np.isfinite(place).all(axis=1) & np.isfinite(forms).all(axis=1) & np.isfinite(sigma)
        # Another layout would be compiled by itself.
        nodes, tangents = (np.ascontiguousarray(each) for each in (self.nodes.xy, self.nodes.dxy))
        outlines = nodes, tangents, self.generators.astype(np.float32)
        with one_thread():
            if finite.all():
                formed(*outlines, at, place, forms, sigma, window.response.fill, images)
            else:
                some = np.empty((int(finite.sum()), *images.shape[1:]), np.float32)
                given = at[finite], place[finite], forms[finite], sigma[finite]
                formed(*outlines, *given, window.response.fill, some)
                images[:], images[finite] = np.nan, some
        return np.asarray(images)


@dataclass(frozen=True, eq=False)
class ShapeSubset:
    """A subset of the marks of a shape, itself a shape.

    Parameters
    ----------
    whole : Shape
        Shape of all marks.
    rows : ndarray of int (k,)
        Indices of the marks in the subset.

    Examples
    --------
    >>> disk = Outline.circle(2.0, 0.5)
    >>> nodes = Outline(np.stack([disk.xy, 1.5 * disk.xy]), np.stack([disk.dxy, 1.5 * disk.dxy]))
    >>> large = ShapeSubset(GrownOutline(nodes, np.zeros((0, 2, 2))), np.array([1]))
    >>> window = Window(np.arange(15.0)[None], np.arange(15.0)[None], PixelResponse())
    >>> image = large.image(np.array([[7.0, 7.0]]), np.ones(1), np.zeros((1, 0)), np.array([0]), window)
    >>> round(float(image.sum() / np.pi), 3)
    9.0
    """

    whole: Shape
    rows: Rows

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return self.whole.parameters

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`Shape`."""
        return self.whole.image(xy, width, form, self.rows[at], window)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`Shape`."""
        return self.whole.derivatives(xy, width, form, self.rows[at], window)


@dataclass(frozen=True, eq=False)
class FormedShape:
    """A shape whose images have already been formed at one position, in the windows of the matching.

    Parameters
    ----------
    shape : Shape
        The k marks.
    xy, width : ndarray (k, 2), (k,)
        Position and width at which the images were formed; the form was 0.
    share, slopes : ndarray (k, r, c), (k, 3 + p, r, c)
        Images and their derivatives.

    Examples
    --------
    >>> disk = Outline.circle(2.0, 0.5)
    >>> shape = GrownOutline(Outline(disk.xy[None], disk.dxy[None]), np.zeros((0, 2, 2)))
    >>> window = Window(np.arange(9.0)[None], np.arange(9.0)[None], PixelResponse())
    >>> at = np.array([[4.0, 4.0]]), np.ones(1), np.zeros((1, 0)), np.array([0]), window
    >>> formed = FormedShape(shape, *at[:2], *shape.derivatives(*at))
    >>> np.array_equal(formed.derivatives(*at)[0], formed.share), formed.parameters
    (True, 0)
    """

    shape: Shape
    xy: Array
    width: Array
    share: Array
    slopes: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return self.shape.parameters

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`Shape`."""
        return self.shape.image(xy, width, form, at, window)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`Shape`."""
        every = len(at) == len(self.xy) and bool((at == np.arange(len(at))).all())
        some: Any = slice(None) if every else at  # no copy of all
        wide = self.width[some]
        same = (xy == self.xy[some]).all() and not form.any()
        if same and (np.abs(width - wide) <= 1e-9 * wide).all():
            return self.share[some], self.slopes[some]
        return self.shape.derivatives(xy, width, form, at, window)
