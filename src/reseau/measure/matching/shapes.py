"""What a mark looks like: the door through which the matcher has images formed.

A shape has a place, a width of the point-spread function, and parameters of its form, all 0 to begin with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...core.data import Array, Rows
from ...optics.formation import Outline, PixelResponse, coverage, coverage_derivatives

__all__ = ["FormedShape", "GrownOutline", "Shape", "Some", "Window"]


@dataclass(frozen=True, eq=False)
class Window:
    """Pixels in which images are formed, a window for each mark.

    Parameters
    ----------
    columns, rows : ndarray (k, c), (k, r)
        Their coordinates.
    response : PixelResponse
        The pixel.
    """

    columns: Array
    rows: Array
    response: PixelResponse

    def select(self, at: Rows) -> Window:
        """Windows of some of the marks."""
        return Window(self.columns[at], self.rows[at], self.response)


class Shape(Protocol):
    """Images of marks as functions of place (px), width of the point-spread function (px) and form."""

    @property
    def parameters(self) -> int:
        """Number of parameters of the form; all are 0 to begin with."""

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """Share (m, r, c) of each pixel that the marks `at` take, at (m, 2), of widths (m,), forms (m, p)."""

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """The same, and its derivatives (m, 3 + p, r, c) by x, y, width and the parameters of the form."""


@dataclass(frozen=True, eq=False)
class GrownOutline:
    """Plane shapes, whose outlines are multiplied by 1 + Σ p_i F_i.

    Parameters
    ----------
    nodes : Outline
        Outlines (k, j, 2) in pixels around the point that is to be measured; where one has fewer nodes, the
        rest is nought. Those in single precision have their images formed in it, some eight times as fast.
    generators : ndarray (p, 2, 2)
        The F.
    """

    nodes: Outline
    generators: Array

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return len(self.generators)

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
            motions = np.einsum("pij,knj->kpni", self.generators, self.nodes.xy[at])
        outline = self._placed(xy, form, at)
        return coverage_derivatives(outline, window.columns, window.rows, width, window.response, motions)

    def _placed(self, xy: Array, form: Array, at: Rows) -> Outline:
        nodes, tangents = self.nodes.xy[at], self.nodes.dxy[at]
        if self.parameters:
            grown = np.swapaxes(np.eye(2) + np.einsum("kp,pij->kij", form, self.generators), 1, 2)
            nodes, tangents = nodes @ grown, tangents @ grown
        return Outline(nodes + xy[:, None, :], tangents)

    def _compiled(self, xy: Array, width: Array, form: Array, at: Rows, window: Window, parts: int) -> Array:
        """Share, and what derivatives there is room for, (m, parts, r, c)."""
        from ...optics.single import formed  # takes half a second, which not every command needs

        corner = np.stack([window.columns[:, 0], window.rows[:, 0]], axis=1)
        images: Any = np.empty((len(at), parts, window.rows.shape[1], window.columns.shape[1]), np.float32)
        formed(
            self.nodes.xy,
            self.nodes.dxy,
            self.generators.astype(np.float32),
            at,
            *((xy - corner).astype(np.float32), form.astype(np.float32), width.astype(np.float32)),
            window.response.fill,
            images,
        )
        return np.asarray(images)


@dataclass(frozen=True, eq=False)
class Some:
    """Some marks of a shape, as a shape.

    Parameters
    ----------
    whole : Shape
        All of them.
    rows : ndarray of int (k,)
        Which ones.
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
    """A shape whose images have been formed at one place already, in the windows in which it is matched.

    Parameters
    ----------
    shape : Shape
        The k marks.
    xy, width : ndarray (k, 2), (k,)
        Where and how wide; the form was nought.
    share, slopes : ndarray (k, r, c), (k, 3 + p, r, c)
        The image and its derivatives.
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
        same = np.array_equal(xy, self.xy[at]) and not form.any()
        if same and np.allclose(width, self.width[at], rtol=1e-9, atol=0):
            return self.share[at], self.slopes[at]
        return self.shape.derivatives(xy, width, form, at, window)
