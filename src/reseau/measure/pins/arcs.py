"""Matching of echoes with formed arcs: position, widths, curvature, tilt, brightness and background."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ...adjust import BatchOptions, adjust_batch
from ...core.data import Array, Mask, Rows
from ...optics import Arcs
from ..matching import MatchOptions, Window, match
from .echoes import Echoes

__all__ = [
    "BEAM",
    "FURTHER",
    "LINE",
    "ArcMatches",
    "ArcShape",
    "Details",
    "Form",
    "Windows",
    "ends_of",
    "lines_with",
    "reach_of",
]

_WINDOWS = np.array([6, 9, 13, 18, 25, 35, 50, 70])
"""Half sides of windows, pixels; arcs of similar size are matched in one batch."""
_RELIABLE = 8.0
"""Minimum contrast over its standard deviation of an arc whose light is subtracted from others."""
_MARGIN_PX = 4.0
"""Background shown by a window around an arc, pixels."""
_BOLD = 5.0
"""Bound of the logarithm of a width, for steps that an iteration tries and refuses."""
_ACROSS_SIGMA = 0.5
"""Prior standard deviation of the logarithm of the width across."""
_LAGS = 4
"""Distance in pixels, along both axes, up to which the autocorrelation of residuals is summed."""
_NUMBERS = (
    *("xy", "cov", "contrast", "t", "noise", "correlation", "seen", "rejected", "converged", "pixels"),
    "inflation",
)
_TIGHTENED = 0.2
"""Factor of these in a second attempt, where the first did not converge."""
_ROUND = 1.5
"""Length over thickness below which a spot has no direction."""
_OF_MOMENTS = 1.7
"""Approximate width of a Gaussian over that of its part above one third of its height."""
_OF_LINES = 1.1
"""The same of an even line."""
_FLAT = 0.8
"""Flatness with which the matching of a line starts."""
_REACH = 2.6
"""Half size of a window, in widths of the arc."""
_HALF_HIDDEN = 0.5
"""Hidden share of a flank from which the position of an arc depends on the other flank."""
_MOST_OF_WIDTH = 0.8
"""Largest variance of a blur as a share of those of an arc across and of its ends."""
_SAMPLES = 2
"""Samples per pixel along each axis, to form a blurred arc."""
_HELD_SHARE, _HELD_ITERATIONS = 0.05, 6
"""End of the iterations where an end of a line is held."""
_OTHER = 2.0
"""Factor of the limit of residuals where neither the end of a line nor its background are known."""
_WIDER_GAP_PX = 2
"""Width of the additional margin next to hidden pixels that is left out to test the position of an arc."""


@dataclass(frozen=True)
class Form:
    """What is unknown about the form of an arc, beside its position and its width across.

    Parameters
    ----------
    sigma : mapping of str to float
        Prior standard deviations of the corrections to the start values: of the logarithm of `along`, or of
        those of the `length` of a line and the `softness` of its ends; of the sag at the width along over
        that width (`curvature`), of `tilt` (rad), and of `fading`, `tapering`, `thickening` and `saturation`,
        see :class:`reseau.optics.Arcs`. What is not named is kept at its start value.
    """

    sigma: Mapping[str, float]

    def with_(self, **sigma: float) -> Form:
        """The same form with further unknowns, or with other standard deviations."""
        return Form({**self.sigma, **sigma})

    def tightened(self, factor: float) -> Form:
        """The same form with priors that are tighter by a factor."""
        return Form({name: factor * value for name, value in self.sigma.items()})


BEAM = Form({"along": 0.5, "curvature": 0.05, "tilt": 0.3})
"""The Gaussian profile of a beam."""
LINE = Form({"length": 1.0, "softness": 1.0, "curvature": 0.15, "tilt": 0.3})
"""An even line with soft ends."""
FURTHER = {"fading": 0.5, "tapering": 0.4, "thickening": 0.2, "saturation": 2.0}
"""Deviations from these and their prior standard deviations."""
_COLUMNS = ("along", "curvature", "tilt", "flatness", *FURTHER)
"""Order of the derivatives of :class:`reseau.optics.Arcs`, after x, y and `across`."""
_ALONG, _CURVATURE, _FLATNESS = (3 + _COLUMNS.index(name) for name in ("along", "curvature", "flatness"))


@dataclass(frozen=True, eq=False)
class ArcShape:
    """Arcs as functions of the corrections that a form leaves free.

    The width of the point-spread function is that of the arc across.

    Parameters
    ----------
    start : Arcs (k,)
        Approximate arcs, with all their columns.
    free : tuple of str
        Names of the unknowns of the form.
    """

    start: Arcs
    free: tuple[str, ...]

    @property
    def parameters(self) -> int:
        """Number of parameters of the form."""
        return len(self.free)

    def arcs(self, width: Array, form: Array, at: Rows) -> Arcs:
        """The arcs `at` with widths across (m,) and corrections (m, p)."""
        s = self.start.select(at)
        columns = {name: getattr(s, name) for name in _COLUMNS}
        values = dict(zip(self.free, form.T, strict=True))
        if "along" in values:
            columns["along"] = s.along * np.exp(np.clip(values.pop("along"), -_BOLD, _BOLD))
        if "curvature" in values:
            columns["curvature"] = s.curvature + values.pop("curvature") / s.along
        if "length" in values:
            half, soft = ends_of(s)
            half = half * np.exp(np.clip(values.pop("length"), -_BOLD, _BOLD))
            soft = soft * np.exp(np.clip(values.pop("softness"), -_BOLD, _BOLD))
            columns["along"] = np.sqrt(half**2 / 3 + soft**2)
            columns["flatness"] = half**2 / 3 / columns["along"] ** 2
        for name, value in values.items():
            columns[name] = columns[name] + value
        return Arcs(across=width, **columns)

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.shapes.Shape`."""
        return self.arcs(width, form, at).image(xy, window.columns, window.rows)

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.shapes.Shape`."""
        arcs = self.arcs(width, form, at)
        image, parts = arcs.derivatives(xy, window.columns, window.rows)
        rows = []
        assert arcs.flatness is not None
        flat = arcs.flatness[:, None, None]
        for name in self.free:
            if name == "length":
                rows.append(flat * parts[:, _ALONG] + 2 * parts[:, _FLATNESS])
            elif name == "softness":
                rows.append((1 - flat) * parts[:, _ALONG] - 2 * parts[:, _FLATNESS])
            elif name == "curvature":
                rows.append(parts[:, _CURVATURE] / self.start.along[at, None, None])
            else:
                rows.append(parts[:, 3 + _COLUMNS.index(name)])
        return image, np.concatenate([parts[:, :3], np.stack(rows, axis=1)], axis=1)


@dataclass(frozen=True, eq=False)
class ArcMatches:
    """Results of matching, in columns over the m echoes.

    Parameters
    ----------
    xy, cov, contrast, t, noise, correlation, seen, rejected, converged : ndarray
        As in :class:`reseau.measure.matching.Matches`; `cov` is corrected for correlated residuals.
    pixels : ndarray (m,)
        Number of pixels that are as good as independent.
    inflation : ndarray (m,)
        Factor of the variances for correlated residuals, 1 if these are white.
    arcs : Arcs
        The matched arcs.
    sigma : dict of str to ndarray (m,)
        Standard deviations of the unknowns of the form.
    """

    xy: Array
    cov: Array
    contrast: Array
    t: Array
    noise: Array
    correlation: Array
    seen: Array
    rejected: Array
    converged: Mask
    pixels: Array
    inflation: Array
    arcs: Arcs
    sigma: dict[str, Array]

    def replaced(self, rows: Rows, other: ArcMatches) -> ArcMatches:
        """These matches with `rows` replaced by others."""
        columns: dict[str, Any] = {}
        for name in _NUMBERS:
            columns[name] = getattr(self, name).copy()
            columns[name][rows] = getattr(other, name)
        sigma = {name: values.copy() for name, values in self.sigma.items()}
        for name in other.sigma:
            sigma.setdefault(name, np.zeros(len(self.xy)))
        for name, values in sigma.items():
            values[rows] = other.sigma.get(name, 0.0)
        return ArcMatches(**columns, arcs=_replaced(self.arcs, rows, other.arcs), sigma=sigma)

    def moved(self, before: ArcMatches, rows: Rows) -> Array:
        """Shifts (k, 2) from the `rows` of other matches to these; NaN where these did not converge."""
        return np.where(self.converged[:, None], self.xy - before.xy[rows], np.nan)


@dataclass(frozen=True, eq=False)
class Details:
    """What the forms of k arcs leave out, and how it shifts them.

    Parameters
    ----------
    blur_px : ndarray (k, 2)
        Shift due to the blur of a bent line, whose image is not the bent image of a blurred line.
    course_px : ndarray (k, 2)
        Shift if κ² is replaced by cκ² in the course of the arc, for each unit of c - 1: the course is a
        hyperbola for c = 1, and a parabola for c = 0.
    score, information : ndarray (k,)
        Derivative of the logarithm of the likelihood with respect to c, all other unknowns eliminated, and
        the information about c.
    """

    blur_px: Array
    course_px: Array
    score: Array
    information: Array


class Windows:
    """Arcs of a frame and the windows in which they are matched, grouped by size.

    Parameters
    ----------
    grey : ndarray (h, w)
        Frame.
    valid : ndarray (h, w) of bool
        Pixels that may be used.
    echoes : Echoes
        All echoes of the frame; pixels of the others are excluded.
    at : ndarray of int (m,)
        Indices of the echoes to match.
    options : MatchOptions
        Options of the matching; window and widths are set here.
    noise : float
        Standard deviation of the grey values.
    """

    def __init__(
        self,
        grey: NDArray[np.float32],
        valid: Mask,
        echoes: Echoes,
        at: Rows,
        options: MatchOptions,
        noise: float,
    ) -> None:
        self.grey, self.valid, self.echoes, self.at = grey, valid, echoes, at
        self.options, self.noise = options, noise
        self.start, self.start_of_lines = _starts(echoes, at)
        self.half = _half_sides(self.start)

    def resized(self, arcs: Arcs) -> None:
        """Let the windows have the size of these arcs (m,)."""
        self.half = _half_sides(arcs)

    @property
    def every(self) -> Rows:
        """Rows of all echoes to be matched."""
        return np.arange(len(self.at))

    def matched(
        self, rows: Rows, form: Form, start: Arcs, xy: Array, valid: Mask | None = None
    ) -> ArcMatches:
        """Match the arcs `rows`, excluding the pixels of others.

        Parameters
        ----------
        rows : ndarray of int (k,)
            Which ones.
        form : Form
            What is unknown of their form.
        start, xy : Arcs (k,), ndarray (k, 2)
            Where to start.
        valid : ndarray (h, w) of bool, optional
            Pixels that may be used, if these are others.
        """
        parts = []
        for part in self._of_like_size(rows):
            here = np.searchsorted(rows, part)
            found = self._adjusted(part, form, start.select(here), xy[here], valid=valid)
            # A round spot has no tilt: if it does not converge, tighten the prior of the form.
            again = np.flatnonzero(~found.converged)
            if len(again):
                which = here[again]
                found = found.replaced(
                    again,
                    self._adjusted(
                        part[again], form.tightened(_TIGHTENED), start.select(which), xy[which], valid=valid
                    ),
                )
            parts.append((here, found))
        return _merged(parts, len(rows))

    def shift_without_others(self, touching: Rows, found: ArcMatches, form: Form) -> Array:
        """Shifts (m, 2) of arcs if the light of others is subtracted instead of excluded."""
        modelled = found.converged & (found.t > _RELIABLE)
        pulled = np.zeros((len(touching), 2))
        for rows in self._of_like_size(touching):
            others = np.stack([self._light_of_others(k, found, modelled) for k in rows])
            again = self._adjusted(rows, form, found.arcs.select(rows), found.xy[rows], others, modelled)
            pulled[np.searchsorted(touching, rows)] = again.moved(found, rows)
        return pulled

    def hidden_flanks(self, found: ArcMatches) -> Array:
        """Hidden share of the information about the position of an arc, on its worse side, (m,)."""
        share = np.zeros(len(self.at))
        for rows in self._of_like_size(np.flatnonzero(found.converged)):
            window = self._window(rows, found.xy[rows])
            _, parts = found.arcs.select(rows).derivatives(found.xy[rows], *window)
            columns, lines = (np.rint(axis).astype(np.intp) for axis in window)
            height, width = self.valid.shape
            shown = self.valid[
                np.clip(lines, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None, :]
            ]
            for flank in (parts[:, :2].clip(0, None), -parts[:, :2].clip(None, 0)):
                hidden = (flank * ~shown[:, None]).sum(axis=(2, 3)) / flank.sum(axis=(2, 3))
                share[rows] = np.maximum(share[rows], hidden.max(axis=1))
        return share

    def hidden_ends(self, found: ArcMatches) -> Array:
        """Hidden shares of both ends of each arc, (m, 2)."""
        arcs = found.arcs
        half, soft = ends_of(arcs)
        across = np.linspace(-1.5, 1.5, 7)
        u, v = (grid.ravel() for grid in np.meshgrid(across, across))
        c, s = np.cos(arcs.tilt)[:, None], np.sin(arcs.tilt)[:, None]
        height, width = self.valid.shape
        share = np.zeros((len(self.at), 2))
        for k, side in enumerate((-1.0, 1.0)):
            along = side * half[:, None] + soft[:, None] * u
            down = 0.5 * arcs.curvature[:, None] * along**2 + arcs.across[:, None] * v
            x = found.xy[:, :1] + c * along - s * down
            y = found.xy[:, 1:] + s * along + c * down
            column, row = (np.nan_to_num(np.rint(at), nan=-1).astype(np.intp) for at in (x, y))
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            seen = inside & self.valid[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
            share[:, k] = 1 - seen.mean(axis=1)
        return share

    def with_end_at(
        self, found: ArcMatches, row: int, side: float, steps: Array, form: Form, start: Arcs
    ) -> tuple[Array, Array, Array]:
        """Lines adjusted anew with one end held, displaced by given steps along the curve.

        Parameters
        ----------
        found : ArcMatches
            The matches.
        row : int
            Which line.
        side : float
            1 for the end in the direction of the tilt, -1 for the other.
        steps : ndarray (n,)
            Displacements of the end outwards, pixels.
        form : Form
            What is unknown of the form.
        start : Arcs
            The means of its priors.

        Returns
        -------
        costs : ndarray (n,)
            -2 times the logarithm of the likelihood of each place of the end, the other unknowns integrated
            over; infinite where nothing would be left of the line.
        middles : ndarray (n, 2)
            The middle of the line.
        covs : ndarray (n, 2, 2)
            Its covariances for a given place of the end.
        """
        n, at = len(steps), np.full(len(steps), row)
        one, mean = found.arcs.select(at), start.select(at)
        half, soft = ends_of(one)
        half_of_mean, soft_of_mean = ends_of(mean)
        moved = 0.5 * side * steps
        course = one.tilt + 0.5 * one.curvature * moved
        base = found.xy[row] + moved[:, None] * np.stack([np.cos(course), np.sin(course)], axis=1)
        tilt = one.tilt + one.curvature * moved
        along, across = np.stack([[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]]).swapaxes(1, 2)
        left = half + steps / 2
        possible = left > soft
        left = np.maximum(left, soft)
        names = tuple(form.sigma)
        shape = ArcShape(mean, names)
        others = [name for name in names if name != "length"]
        begun = {name: getattr(one, name) - getattr(mean, name) for name in others if name in FURTHER}
        begun |= {
            "softness": np.log(soft / soft_of_mean),
            "curvature": (one.curvature - mean.curvature) * mean.along,
            "tilt": tilt - mean.tilt,
        }
        grey, columns, lines, used = self._seen(found, row)
        plane = np.stack([np.ones(used.sum()), *(g[used] for g in np.meshgrid(columns, lines))])
        plane[1:] -= plane[1:].mean(axis=1, keepdims=True)
        plane[1:] /= np.abs(plane[1:]).max(axis=1, keepdims=True)
        free = 3 + len(others)

        def placed(x: Array, k: Rows) -> tuple[Array, Array, Array]:
            """Positions, widths and corrections of the form."""
            xy = base[k] + x[:, :1] * across[k] - 0.5 * side * x[:, 1:2] * along[k]
            longer = np.log(np.maximum(left[k] + 0.5 * x[:, 1], 0.1) / half_of_mean[k])
            values = dict(zip(others, x[:, 3:free].T, strict=True)) | {"length": longer}
            return (
                xy,
                np.exp(np.clip(x[:, 2], -_BOLD, _BOLD)),
                np.stack([values[name] for name in names], axis=1),
            )

        def formed(x: Array, k: Rows) -> tuple[Array, Array]:
            xy, width, corrections = placed(x, k)
            window = Window(
                np.broadcast_to(columns, (len(k), len(columns))),
                np.broadcast_to(lines, (len(k), len(lines))),
                self.options.response,
            )
            image, parts = shape.derivatives(xy, width, corrections, k, window)
            image, parts = image[:, used], parts[:, :, used]
            contrast = x[:, free, None]
            by_along, by_across = (
                (parts[:, :2] * axis[k][:, :, None]).sum(axis=1) for axis in (along, across)
            )
            by_length = (
                parts[:, 3 + names.index("length")] / np.maximum(left[k] + 0.5 * x[:, 1], 0.1)[:, None]
            )
            jacobian = np.empty((len(k), image.shape[1], free + 4))
            jacobian[:, :, 0] = contrast * by_across
            jacobian[:, :, 1] = contrast * 0.5 * (by_length - side * by_along)
            jacobian[:, :, 2] = contrast * width[:, None] * parts[:, 2]
            for i, name in enumerate(others):
                jacobian[:, :, 3 + i] = contrast * parts[:, 3 + names.index(name)]
            jacobian[:, :, free] = image
            jacobian[:, :, free + 1 :] = plane.T
            return contrast * image + x[:, free + 1 :] @ plane, jacobian

        x = np.zeros((n, free + 4))
        x[:, 2] = np.log(one.across)
        for i, name in enumerate(others):
            x[:, 3 + i] = begun[name]
        x[:, free] = found.contrast[row]
        first, _ = formed(x, np.arange(n))
        x[:, free + 1] = np.median(grey - first, axis=1)
        sigma = np.full(free + 4, np.inf)
        sigma[2], sigma[3:free] = _ACROSS_SIGMA, [form.sigma[name] for name in others]
        expected = np.zeros(free + 4)
        expected[2] = np.log(mean.across[0])
        variance = found.noise[row] ** 2 * found.inflation[row]
        adjusted = adjust_batch(
            formed,
            x,
            np.broadcast_to(grey, (n, len(grey))),
            weights=np.full((n, len(grey)), 1 / variance),
            prior=(expected, sigma),
            options=BatchOptions(share=_HELD_SHARE, max_iterations=_HELD_ITERATIONS, damping=1e-6),
        )
        cofactor = adjusted.cofactor
        usable = possible & np.isfinite(cofactor).all(axis=(1, 2)) & np.isfinite(adjusted.sigma0)
        costs = adjusted.sigma0**2 * adjusted.redundancy
        costs[usable] -= np.linalg.slogdet(cofactor[usable])[1]
        middles, _, _ = placed(adjusted.estimates, np.arange(n))
        turned = np.stack([across, -0.5 * side * along], axis=2)
        covs = turned @ cofactor[:, :2, :2] @ turned.swapaxes(1, 2)
        return np.where(usable, costs, np.inf), middles, covs

    def details(self, rows: Rows, found: ArcMatches, form: Form, blur: Array) -> Details:
        """What forms leave out, and how it shifts the arcs `rows`, to first order.

        Parameters
        ----------
        rows : ndarray of int (k,)
            Which ones.
        found : ArcMatches
            The matches.
        form : Form
            What was unknown of the form.
        blur : ndarray (m,)
            Width of a camera's blur, pixels, for each of all arcs.
        """
        parts = []
        for part in self._of_like_size(rows):
            parts.append((np.searchsorted(rows, part), self._details(part, found, form, blur[part])))
        columns: dict[str, Any] = {}
        for f in fields(Details):
            columns[f.name] = np.zeros((len(rows), 2) if f.name.endswith("_px") else len(rows))
            for at, one in parts:
                columns[f.name][at] = getattr(one, f.name)
        return Details(**columns)

    def _details(self, rows: Rows, found: ArcMatches, form: Form, blur: Array) -> Details:
        """The same for arcs of one size."""
        arcs, xy, noise = found.arcs.select(rows), found.xy[rows], found.noise[rows]
        columns, lines = self._window(rows, xy)
        shape = ArcShape(arcs, tuple(form.sigma))
        window = Window(columns, lines, self.options.response)
        none = np.zeros((len(rows), shape.parameters))
        image, parts = shape.derivatives(xy, arcs.across, none, np.arange(len(rows)), window)
        c, s = np.cos(arcs.tilt)[:, None, None], np.sin(arcs.tilt)[:, None, None]
        x, y = (columns - xy[:, :1])[:, None, :], (lines - xy[:, 1:])[:, :, None]
        u2 = (c * x + s * y) ** 2
        bend = arcs.curvature[:, None, None]
        # From -(dI/dv) u²/(r(1 + r)), r² = 1 + κ²u², to the derivative by c where κ² is replaced by cκ².
        by_bend = parts[:, 3 + shape.free.index("curvature")] * arcs.along[:, None, None]
        by_course = -by_bend * bend**3 * u2 / (2 * (1 + np.sqrt(1 + bend**2 * u2)))
        count = len(rows)
        flat = (count, 1, image[0].size)
        used = self._usable(rows, columns, lines).reshape(flat)
        contrast = found.contrast[rows][:, None, None]
        parts[:, 2] *= arcs.across[:, None, None]
        plane = np.stack(
            np.broadcast_arrays(1.0 + 0 * x, x / columns.shape[1] + 0 * y, y / lines.shape[1] + 0 * x), axis=1
        )
        design = used * np.concatenate(
            [
                contrast * parts.reshape(count, parts.shape[1], -1),
                image.reshape(flat),
                plane.reshape(count, 3, -1),
            ],
            axis=1,
        )
        known = np.zeros(design.shape[1])
        known[2 : parts.shape[1]] = 1 / np.array([_ACROSS_SIGMA, *form.sigma.values()]) ** 2
        normal = design @ design.swapaxes(1, 2)
        scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-12))
        normal += noise[:, None, None] ** 2 * np.diag(known)
        normal /= scale[:, :, None] * scale[:, None, :]
        normal += 1e-9 * np.eye(len(known))
        grey = self._grey(columns, lines)
        columns_of = (
            np.stack(
                [
                    contrast * (_blurred(arcs, xy, columns, lines, blur) - image),
                    contrast * by_course,
                    grey - contrast * image,
                ],
                axis=1,
            ).reshape(count, 3, -1)
            * used
        )
        right = (design @ columns_of.swapaxes(1, 2)) / scale[:, :, None]
        solved = np.linalg.solve(normal, right) / scale[:, :, None]
        left = columns_of - (solved.swapaxes(1, 2) @ design)
        limit = (self.options.rejection * noise)[:, None]
        rest = np.clip(left[:, 2] - left[:, 0], -limit, limit)
        variance = noise**2 * found.inflation[rows]
        return Details(
            blur_px=solved[:, :2, 0],
            course_px=solved[:, :2, 1],
            score=(left[:, 1] * rest).sum(axis=1) / variance,
            information=(left[:, 1] ** 2).sum(axis=1) / variance,
        )

    def _usable(self, rows: Rows, columns: Array, lines: Array) -> Mask:
        """Pixels of the windows of some arcs that may be used, (k, r, c)."""
        c, r = (np.rint(axis).astype(np.intp) for axis in (columns, lines))
        height, width = self.valid.shape
        inside = ((r >= 0) & (r < height))[:, :, None] & ((c >= 0) & (c < width))[:, None, :]
        at = np.clip(r, 0, height - 1)[:, :, None], np.clip(c, 0, width - 1)[:, None, :]
        owner = self.echoes.claimed[at]
        return np.asarray(inside & self.valid[at] & ((owner < 0) | (owner == self.at[rows][:, None, None])))

    def _grey(self, columns: Array, lines: Array) -> Array:
        """Grey values of windows, (k, r, c)."""
        c, r = (np.rint(axis).astype(np.intp) for axis in (columns, lines))
        height, width = self.valid.shape
        at = np.clip(r, 0, height - 1)[:, :, None], np.clip(c, 0, width - 1)[:, None, :]
        return np.asarray(self.grey[at], dtype=np.float64)

    def _seen(self, found: ArcMatches, row: int) -> tuple[Array, Array, Array, Mask]:
        """Grey values of the pixels by which an arc was matched; columns, rows and mask of its window."""
        one = np.array([row])
        columns, lines = self._window(one, found.xy[one])
        grey, used = self._grey(columns, lines)[0], self._usable(one, columns, lines)[0]
        # Without what is no part of the line.
        rest = grey - found.contrast[row] * found.arcs.select(one).image(found.xy[one], columns, lines)[0]
        rest -= np.median(rest[used])
        used &= np.abs(rest) < _OTHER * self.options.rejection * found.noise[row]
        return grey[used], columns[0], lines[0], used

    def shift_with_wider_gap(self, half_hidden: Rows, found: ArcMatches, form: Form) -> Array:
        """Shifts (m, 2) of arcs if the pixels next to hidden ones are left out, too."""
        side = 2 * _WIDER_GAP_PX + 1
        less = cv2.erode(self.valid.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        again = self.matched(
            half_hidden, form, found.arcs.select(half_hidden), found.xy[half_hidden], valid=less
        )
        return again.moved(found, half_hidden)

    def _window(self, rows: Rows, xy: Array) -> tuple[Array, Array]:
        """Columns and rows of the pixels around arcs of one size, (k, c) and (k, r)."""
        (half_x, half_y), centre = self.half[rows[0]], np.rint(xy)
        columns = centre[:, :1] + np.arange(-half_x, half_x + 1.0)
        return columns, centre[:, 1:] + np.arange(-half_y, half_y + 1.0)

    def _of_like_size(self, rows: Rows) -> list[Rows]:
        sizes = np.unique(self.half[rows], axis=0)
        return [rows[(self.half[rows] == size).all(axis=1)] for size in sizes]

    def _light_of_others(self, arc: int, found: ArcMatches, modelled: Mask) -> Array:
        """Light of the other arcs in the window of one, (rows, columns)."""
        window = self._window(np.array([arc]), found.xy[[arc]])
        reach = 5 * found.arcs.along + 5 * found.arcs.across
        off = np.abs(found.xy - np.rint(found.xy[arc]))
        near = (off < reach[:, None] + self.half[arc]).all(axis=1) & modelled
        near[arc] = False
        others = np.flatnonzero(near)
        image = found.arcs.select(others).image(
            found.xy[others], *(np.broadcast_to(axis, (len(others), axis.shape[1])) for axis in window)
        )
        return np.asarray(np.tensordot(found.contrast[others], image, axes=1))

    def _adjusted(
        self,
        rows: Rows,
        form: Form,
        start: Arcs,
        xy: Array,
        others: Array | None = None,
        modelled: Mask | None = None,
        valid: Mask | None = None,
    ) -> ArcMatches:
        """Match the arcs `rows`, all with the same size of window."""
        shape = ArcShape(start, tuple(form.sigma))
        owner = self.echoes.claimed
        if modelled is not None:
            open_ = np.append(np.zeros(len(self.echoes), dtype=bool), True)
            open_[self.at[modelled]] = True
            owner = np.where(open_[owner], -1, owner)
        windowed = replace(
            self.options,
            half_px=(int(self.half[rows[0], 0]), int(self.half[rows[0], 1])),
            psf_px=start.across,
            psf_log_sigma=_ACROSS_SIGMA,
            polarity="bright",
        )
        found = match(
            self.grey,
            self.valid if valid is None else valid,
            shape,
            xy,
            windowed,
            noise=self.noise,
            form_sigma=np.array(list(form.sigma.values())),
            claims=(owner, self.at[rows]),
            others=others,
        )
        inflation = _inflation(found.residuals)
        arcs = shape.arcs(found.psf_px, found.form, np.arange(len(rows)))
        # An arc rotated by 180° with opposite curvature is the same arc; its ends change places.
        turns = np.round(arcs.tilt / np.pi)
        sign = np.where(turns % 2 == 0, 1.0, -1.0)
        assert arcs.fading is not None
        return ArcMatches(
            **{name: getattr(found, name) for name in _NUMBERS if hasattr(found, name) and name != "cov"},
            inflation=inflation,
            cov=found.cov * inflation[:, None, None],
            pixels=np.isfinite(found.residuals).sum(axis=(1, 2)) / inflation,
            arcs=replace(
                arcs,
                tilt=arcs.tilt - np.pi * turns,
                curvature=arcs.curvature * sign,
                fading=arcs.fading * sign,
            ),
            sigma={
                name: np.sqrt(inflation) * values
                for name, values in zip(form.sigma, found.form_sigma.T, strict=True)
            },
        )


def _starts(echoes: Echoes, at: Rows) -> tuple[Arcs, Arcs]:
    """Approximate arcs from the moments of the light, as beams and as lines."""
    long, wide, tilt = echoes.length[at], echoes.thickness[at], echoes.tilt[at]
    # A spot without direction starts horizontal, like the echo of a rod.
    round_ = long < _ROUND * wide
    tilt = np.where(round_, 0.0, tilt)
    wide = np.where(round_, np.sqrt(long * wide), wide)
    long = np.where(round_, wide, long)
    along, across = (_OF_MOMENTS / 4 * values for values in (long, wide))
    # The moments determine the curvature of a short arc poorly; its matching starts with a straight one.
    bend = np.clip(echoes.curvature[at] * along, -0.3, 0.3) * (long > 2 * wide)
    beams = Arcs(along, across, bend / along, tilt, *np.zeros((5, len(at))))
    shorter = _OF_LINES / _OF_MOMENTS * along
    return beams, replace(beams, along=shorter, flatness=np.full(len(at), _FLAT))


def ends_of(arcs: Arcs) -> tuple[Array, Array]:
    """Half lengths of lines, and widths of their ends, (k,)."""
    assert arcs.flatness is not None
    return arcs.along * np.sqrt(3 * arcs.flatness), arcs.along * np.sqrt(1 - arcs.flatness)


def reach_of(arcs: Arcs) -> Array:
    """Root mean square distance from the middle of the light that tells an arc's place along it, (k,).

    With the light I along the arc, it is the root of ∫u²I'²du / ∫I'²du.
    """
    half, soft = ends_of(arcs)
    ratio = (half / np.maximum(soft, 1e-12)) ** 2
    # h²/(1 − exp(−h²/s²)), which is s² for h = 0
    apart = soft**2 * np.where(ratio > 1e-9, ratio / -np.expm1(-np.maximum(ratio, 1e-9)), 1.0)
    return np.asarray(np.sqrt(apart + soft**2 / 2))


def lines_with(half: Array, soft: Array, arcs: Arcs) -> Arcs:
    """The arcs as lines of half lengths (k,) with ends of widths (k,)."""
    along = np.sqrt(half**2 / 3 + soft**2)
    return replace(arcs, along=along, flatness=half**2 / 3 / along**2)


def _half_sides(start: Arcs) -> Rows:
    """Half sides of the windows (k, 2), from a few sizes."""
    half, soft = ends_of(start)
    u, v = half + _REACH * soft, _REACH * start.across
    v = v + 0.5 * np.abs(start.curvature) * u**2
    c, s = np.abs(np.cos(start.tilt)), np.abs(np.sin(start.tilt))
    reach = np.stack([np.hypot(c * u, s * v), np.hypot(s * u, c * v)], axis=1) + _MARGIN_PX
    return _WINDOWS[np.minimum(np.searchsorted(_WINDOWS, reach), len(_WINDOWS) - 1)]


def _blurred(arcs: Arcs, xy: Array, columns: Array, lines: Array, blur: Array) -> Array:
    """Images (k, r, c) of sharper arcs that a blur (k,) makes as wide as these, as bright as these."""
    half, soft = ends_of(arcs)
    variance = np.minimum(blur**2, _MOST_OF_WIDTH * np.minimum(arcs.across, soft) ** 2)
    sharp = replace(
        lines_with(half, np.sqrt(soft**2 - variance), arcs), across=np.sqrt(arcs.across**2 - variance)
    )
    pad, n = int(np.ceil(4 * np.sqrt(variance.max()))), _SAMPLES
    x, y = (
        axis[:, :1] - pad + np.arange((axis.shape[1] + 2 * pad) * n - n + 1) / n for axis in (columns, lines)
    )
    light = sharp.image(xy, x, y)
    inner = slice(pad * n, -pad * n if pad else None, n)
    found = np.stack(
        [
            gaussian_filter(one, n * width, mode="nearest", truncate=4.0)[inner, inner]
            for one, width in zip(light, np.sqrt(variance), strict=True)
        ]
    )
    image = arcs.image(xy, columns, lines)
    bright = (image * found).sum(axis=(1, 2)) / np.maximum((found * found).sum(axis=(1, 2)), 1e-300)
    return np.asarray(bright[:, None, None] * found)


def _inflation(residuals: Array) -> Array:
    """Factors (m,) that correct variances for correlated residuals.

    The adjustment assumes independent residuals. The difference between an echo and its formed image
    (speckle, reverberation) extends over several pixels, so there is less information than pixels: by a
    factor of the sum of the autocorrelation, for parameters that change the image smoothly. Only significant
    correlations are summed: white residuals leave the variances unchanged, and the negative correlations at
    larger distances, which result from fitting alone, are ignored.
    """
    r = np.nan_to_num(residuals)
    squares = r * r
    power = np.maximum(squares.sum(axis=(1, 2)), 1e-300)
    independent = 3 * power**2 / np.maximum((squares * squares).sum(axis=(1, 2)), 1e-300)
    chance = 4 / np.sqrt(np.maximum(independent, 1.0))
    total, rows, columns = np.ones(len(r)), *r.shape[1:]
    for down in range(_LAGS + 1):
        for right in range(-_LAGS if down else 1, _LAGS + 1):
            here = r[:, : rows - down, max(0, -right) : columns - max(0, right)]
            there = r[:, down:, max(0, right) : columns + min(0, right)]
            together = (here * there).sum(axis=(1, 2)) / power
            total += 2 * np.where(together > chance, together, 0.0)
    return total


def _merged(parts: list[tuple[Rows, ArcMatches]], count: int) -> ArcMatches:
    """Columns of matches from parts of them."""
    names = {name for _, found in parts for name in found.sigma}

    def column(values: list[Array], tail: tuple[int, ...] = ()) -> Array:
        whole: Array = np.zeros((count, *tail))
        for (rows, _), part in zip(parts, values, strict=True):
            whole[rows] = part
        return whole

    tails: dict[str, tuple[int, ...]] = {"xy": (2,), "cov": (2, 2)}
    columns: dict[str, Any] = {
        name: column([getattr(found, name) for _, found in parts], tails.get(name, ())) for name in _NUMBERS
    }
    columns["converged"] = columns["converged"] > 0
    arcs = {f.name: column([getattr(found.arcs, f.name) for _, found in parts]) for f in fields(Arcs)}
    sigma = {name: column([found.sigma[name] for _, found in parts]) for name in sorted(names)}
    return ArcMatches(**columns, arcs=Arcs(**arcs), sigma=sigma)


def _replaced(arcs: Arcs, rows: Rows, other: Arcs) -> Arcs:
    """Arcs with `rows` replaced by others."""
    columns = {}
    for f in fields(Arcs):
        columns[f.name] = getattr(arcs, f.name).copy()
        columns[f.name][rows] = getattr(other, f.name)
    return Arcs(**columns)
