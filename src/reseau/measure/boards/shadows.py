r"""Corners across which edges of shadows run.

Light falls on paper and ink alike: with the share S of a pixel's light that the corner takes, a polynomial P
of second degree, light o that the camera adds, and for each edge of a shadow its direction n, distance ρ and
depth d,

.. math:: I = o + P\,(1 - a S) \prod_j \left(1 - d_j\,E(n_j \cdot \xi - \rho_j)\right) .

E rises from 0 to 1: linearly over a length 2b, as behind an edge before a lamp of some size, and blurred by a
normal distribution of width s.
The corner alone, with one edge and with two are explanations of the same pixels; the one with the least
Bayesian information criterion is taken (Schwarz 1978).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from ...adjust import adjust_batch
from ...adjust.batch import BatchAdjustment, BatchOptions
from ...core.data import Array, Mask, Rows
from ..matching import Matches, Shape
from ..matching.shapes import Window

_EDGES, _PER_EDGE = 2, 5
"""Most edges of shadows in a window, and their parameters: direction, distance, ln s, ln b, depth."""
_DIRECTIONS, _DISTANCES, _PIXELS = 24, 13, 500
"""Edges that are tried first, and about how many pixels of a window show them."""
_OUTSIDE = 0.25
"""Share of corners without an objection that are in no shadow, at least."""
_WIDER = np.array([0.3, 1.5])
"""Standard deviations of ln s and ln b, over the width of the point-spread function."""
_ADDED = 0.1
"""Standard deviation of the light that a camera adds, over that of the paper."""
_ITERATIONS = 40


@dataclass(frozen=True, eq=False)
class Shaded:
    """Corners with as many edges of shadows as explain their windows best, in columns.

    Parameters
    ----------
    edges : ndarray of int (k,)
        Number of edges.
    xy, cov : ndarray (k, 2), (k, 2, 2)
        Positions and covariances, which contain what the edges leave unknown.
    psf_px, ink, noise : ndarray (k,)
        Width of the point-spread function, share of the light that ink takes, standard deviation of the
        residuals.
    converged : ndarray of bool (k,)
        Whether one of the explanations leaves nothing that one edge more would explain.
    residuals : ndarray (k, rows, columns)
        Adjusted minus observed; NaN where a pixel was not used.
    """

    edges: Rows
    xy: Array
    cov: Array
    psf_px: Array
    ink: Array
    noise: Array
    converged: Mask
    residuals: Array

    def instead_of(self, found: Matches, rows: Rows) -> Matches:
        """The matches of which those of corners in `rows` that edges of shadows cross are these.

        Parameters
        ----------
        found : Matches
            Of more corners.
        rows : ndarray of int (k,)
            Which of them these are.
        """
        n = np.isfinite(self.residuals).sum(axis=(1, 2))
        # Without an edge these have the light that the camera adds, which may explain more, too.
        with np.errstate(invalid="ignore", divide="ignore"):
            better = 2 * n * np.log(found.noise[rows] / self.noise) > _PER_EDGE * np.log(n)
        new = (self.edges > 0) | ~self.converged | better
        at = rows[new]
        high, wide = (
            (n - m) // 2 for n, m in zip(found.residuals.shape[1:], self.residuals.shape[1:], strict=True)
        )
        mine = {
            "xy": self.xy, "cov": self.cov, "psf_px": self.psf_px, "contrast": self.ink, "noise": self.noise,
            "converged": self.converged, "rejected": np.zeros(len(rows)), "seen": np.ones(len(rows)),
            "correlation": np.ones(len(rows)), "t": self.ink * found.level[rows] / self.noise,
        }  # fmt: skip
        columns = {name: np.array(getattr(found, name)) for name in (*mine, "residuals")}
        for name, values in mine.items():
            columns[name][at] = values[new]
        inner = np.s_[high : high + self.residuals.shape[1], wide : wide + self.residuals.shape[2]]
        columns["residuals"][at] = np.nan
        columns["residuals"][at, *inner] = self.residuals[new]
        return replace(found, **columns)


def pixels_alike(residuals: Array) -> float:
    """Number of pixels that have the same error, from residuals (k, rows, columns), NaN where unknown.

    Cameras that sharpen and compress make the errors of neighbours alike, so that a model explains more of
    them by chance. Shadows do, too: of all windows those count in which neighbours are least alike.
    """
    v, together = np.nan_to_num(residuals), []
    for a, b in ((v[:, 1:], v[:, :-1]), (v[:, :, 1:], v[:, :, :-1])):
        r = (a * b).sum(axis=(1, 2)) / np.maximum((v * v).sum(axis=(1, 2)), 1e-9)
        together.append((1 + r) / np.maximum(1 - r, 1e-3))
    return max(1.0, float(np.quantile(together[0] * together[1], _OUTSIDE)))


def shaded(
    grey: Array, used: Mask, shape: Shape, window: Window, xy: Array, ink: float, psf: tuple[float, float],
    form_sigma: Array, noise: float, alike: float,
) -> Shaded:  # fmt: skip
    """Explain the windows of corners with edges of shadows, and without.

    Parameters
    ----------
    grey, used : ndarray (k, rows, columns)
        Grey values, linear in light, and the pixels that may be used.
    shape : Shape
        The corners.
    window : Window
        Their windows.
    xy : ndarray (k, 2)
        Approximate positions.
    ink : float
        Approximate share of the light that ink takes.
    psf : (float, float)
        Width of the point-spread function, and its relative standard deviation.
    form_sigma : ndarray (f,)
        Standard deviations of the form.
    noise : float
        Approximate standard deviation of the grey values.
    alike : float
        Number of pixels that have the same error; see :func:`pixels_alike`.
    """
    problem = _Windows(grey, used, shape, window, xy, ink, psf, form_sigma, noise)
    k, n = len(xy), used.sum(axis=(1, 2))
    found = Shaded(
        edges=np.zeros(k, dtype=np.intp),
        xy=xy.copy(),
        cov=np.full((k, 2, 2), np.nan),
        psf_px=np.full(k, np.nan),
        ink=np.full(k, np.nan),
        noise=np.full(k, np.nan),
        converged=np.zeros(k, dtype=bool),
        residuals=np.full(used.shape, np.nan),
    )
    x, rows, criterion = problem.start(), np.arange(k), np.full(k, np.inf)
    unlike = np.zeros(k, dtype=bool)
    for count in range(_EDGES + 1):
        fit = problem.adjusted(x, rows)
        x, residuals = fit.estimates, np.where(problem.used[rows], fit.residuals, 0.0)
        squares = np.maximum((residuals**2).sum(axis=1), 1e-9)
        own = n[rows] * np.log(squares / n[rows]) + alike * _PER_EDGE * count * np.log(n[rows])
        better = fit.converged & (own < criterion[rows])
        at, sigma = rows[better], np.sqrt(squares / np.maximum(n[rows] - x.shape[1], 1))[better]
        criterion[at], found.edges[at], found.converged[at] = own[better], count, True
        found.xy[at], found.noise[at], found.psf_px[at] = x[better, :2], sigma, x[better, 2]
        found.ink[at] = x[better, problem.light.start - 2]
        found.cov[at] = fit.cofactor[better, :2, :2] * (sigma / noise)[:, None, None] ** 2
        found.residuals[at] = np.where(used[at], residuals[better].reshape(-1, *used.shape[1:]), np.nan)
        x, gain = problem.with_edge(x, rows)
        gain = n[rows] * np.log(squares / np.maximum(squares - gain, 1e-3 * squares))
        # What an edge explains to first order must be worth its parameters.
        worth = gain > alike * _PER_EDGE * np.log(n[rows])
        unlike[rows] = worth
        x, rows = x[worth & (better | (count == 0))], rows[worth & (better | (count == 0))]
        if not len(rows):
            break
    return replace(found, converged=found.converged & ~unlike)


class _Windows:
    """Windows of corners with their models; see :func:`shaded`."""

    def __init__(
        self, grey: Array, used: Mask, shape: Shape, window: Window, xy: Array, ink: float,
        psf: tuple[float, float], form_sigma: Array, noise: float,
    ) -> None:  # fmt: skip
        k = len(xy)
        self.grey, self.used = grey.reshape(k, -1).astype(np.float64), used.reshape(k, -1)
        self.shape, self.window, self.noise = shape, window, noise
        self.xy, self.ink, self.psf, self.form_sigma = xy, ink, psf, form_sigma
        self.half = max(grey.shape[1:]) / 2
        x = (window.columns - np.rint(xy[:, :1]))[:, None, :] / self.half
        y = (window.rows - np.rint(xy[:, 1:]))[:, :, None] / self.half
        self.at = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(k, -1, 2)
        u, v = np.moveaxis(self.at, 2, 0)
        one, none = np.ones_like(u), np.zeros_like(u)
        self.terms = np.stack([one, u, v, u * u, u * v, v * v], axis=2)
        by_u, by_v = (none, one, none, 2 * u, v, none), (none, none, one, none, u, 2 * v)
        self.slopes = np.stack([np.stack(by, axis=2) for by in (by_u, by_v)], axis=3)
        self.variance = psf[0] ** 2 + window.response.fill**2 / 12
        self.light = slice(3 + len(form_sigma) + 2, 3 + len(form_sigma) + 8)

    def start(self) -> Array:
        """Parameters without an edge: x, y, width, form, ink, added light, polynomial."""
        k = len(self.xy)
        none = np.zeros((k, len(self.form_sigma)))
        x = np.column_stack([self.xy, np.full(k, self.psf[0]), none, np.full(k, self.ink), np.zeros((k, 7))])
        share = self._share(x, np.arange(k))[0]
        design = self.terms * (1 - self.ink * share)[..., None] * self.used[..., None]
        normal = np.swapaxes(design, 1, 2) @ design + 1e-6 * np.eye(6)
        right = np.swapaxes(design, 1, 2) @ (self.grey * self.used)[..., None]
        x[:, self.light] = np.linalg.solve(normal, right)[..., 0]
        return x

    def _share(self, x: Array, rows: Rows) -> tuple[Array, Array]:
        """Share (m, n) of the corner, and derivatives (m, n, 3 + f)."""
        window, first = self.window.select(rows), self.light.start - 2
        share, slopes = self.shape.derivatives(x[:, :2], x[:, 2], x[:, 3:first], rows, window)
        return share.reshape(len(x), -1), np.moveaxis(slopes.reshape(*slopes.shape[:2], -1), 1, 2)

    def image(self, x: Array, rows: Rows) -> tuple[Array, Array]:
        """Grey values (m, n) and derivatives (m, n, u)."""
        share, slopes = self._share(x, rows)
        ink, added = x[:, self.light.start - 2, None], x[:, self.light.start - 1, None]
        paper = np.einsum("mnt,mt->mn", self.terms[rows], x[:, self.light])
        slope = np.einsum("mntd,mt->mnd", self.slopes[rows], x[:, self.light])
        kept, shade, edges = 1 - ink * share, np.ones_like(paper), []
        for first in range(self.light.stop, x.shape[1], _PER_EDGE):
            edge, by_edge, by_place = self._edge(x[:, first : first + _PER_EDGE], rows)
            edges.append((edge, by_edge))
            slope = slope * edge[..., None] + (paper * shade)[..., None] * by_place
            shade = shade * edge
        lit = paper * shade
        # The lens and the pixels blur light and ink together: where light has a slope, edges of ink move.
        moved = ink * (self.variance / self.half) * (slope * slopes[..., :2]).sum(axis=2)
        columns = [
            (-ink * lit)[..., None] * slopes,
            -(lit * share)[..., None],
            np.ones((*lit.shape, 1)),
            (kept * shade)[..., None] * self.terms[rows],
        ]
        for edge, by_edge in edges:
            columns.append(by_edge * (lit * kept / np.where(np.abs(edge) < 1e-3, 1e-3, edge))[..., None])
        return added + lit * kept + moved, np.concatenate(columns, axis=2)

    def _edge(self, x: Array, rows: Rows) -> tuple[Array, Array, Array]:
        """Light (m, n) that the edge of a shadow leaves; derivatives (m, n, 5), and by place (m, n, 2)."""
        angle, distance, log_s, log_b, depth = x.T[..., None]
        c, s, blur, ramp = np.cos(angle), np.sin(angle), np.exp(log_s) / self.half, np.exp(log_b) / self.half
        u, v = np.moveaxis(self.at[rows], 2, 0)
        off = c * u + s * v - distance
        z = np.clip(np.stack([(off + ramp) / blur, (off - ramp) / blur]), -1e3, 1e3)
        below, density = scipy.special.ndtr(z), np.exp(-0.5 * np.minimum(z * z, 1e3)) / np.sqrt(2 * np.pi)
        half = 0.5 / ramp
        (high, low), by_off = z * below + density, half * (below[0] - below[1])
        edge = blur * half * (high - low)
        by = [
            by_off * (c * v - s * u),
            -by_off,
            blur * half * (density[0] - density[1]),
            0.5 * (below[0] + below[1]) - edge,
        ]
        by_place = -depth[..., None] * by_off[..., None] * np.stack([c, s], axis=2)
        return 1 - depth * edge, -np.stack([*(depth * each for each in by), edge], axis=2), by_place

    def with_edge(self, x: Array, rows: Rows) -> tuple[Array, Array]:
        """Parameters (m, u) with the edge that explains most of what is left, and the squares it explains."""
        image, slopes = self.image(x, rows)
        every = max(1, int(self.used[rows].sum(axis=1).min(initial=_PIXELS) // _PIXELS))
        image, slopes, used = image[:, ::every], slopes[:, ::every], self.used[rows, ::every]
        base, _ = np.linalg.qr(slopes[:, :, self.light] * used[..., None])
        across = np.swapaxes(base, 1, 2)
        left = np.where(used, self.grey[rows][:, ::every] - image, 0.0)
        left = left - (base @ (across @ left[..., None]))[..., 0]
        gain, found = np.zeros(len(x)), np.zeros((len(x), _PER_EDGE))
        width = np.log(self.psf[0])
        for angle in np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS:
            along = self.at[rows, ::every] @ np.array([np.cos(angle), np.sin(angle)])
            for distance in np.linspace(-0.9, 0.9, _DISTANCES):
                edge = -image * used * scipy.special.ndtr((along - distance) * (self.half / self.psf[0]))
                edge -= (base @ (across @ edge[..., None]))[..., 0]
                size = np.maximum((edge**2).sum(axis=1), 1e-9)
                depth = (edge * left).sum(axis=1) / size
                better = np.maximum(depth, 0.0) ** 2 * size > gain
                gain[better] = (depth**2 * size)[better]
                here = np.tile([angle, distance, width, width], (len(x), 1))
                found[better] = np.column_stack([here, np.clip(depth, 0.05, 0.9)])[better]
        return np.column_stack([x, found]), gain * every

    def adjusted(self, x: Array, rows: Rows) -> BatchAdjustment:
        """The adjustment of windows from these parameters."""
        first, last = self.light.start - 2, self.light.stop
        free, mean = np.full(x.shape[1], np.inf), x.copy()
        free[2], free[3:first] = self.psf[0] * self.psf[1], self.form_sigma
        free[first + 1] = _ADDED * float(np.abs(x[:, self.light.start]).mean())
        mean[:, 2], mean[:, 3:first], mean[:, first + 1] = self.psf[0], 0.0, 0.0
        for k, sigma in enumerate(_WIDER):
            free[last + 2 + k :: _PER_EDGE], mean[:, last + 2 + k :: _PER_EDGE] = sigma, np.log(self.psf[0])
        return adjust_batch(
            lambda x, at: self.image(x, rows[at]), x, self.grey[rows],
            weights=self.used[rows] / self.noise**2, prior=(mean, free),
            options=BatchOptions(max_iterations=_ITERATIONS, share=0.1),
        )  # fmt: skip
