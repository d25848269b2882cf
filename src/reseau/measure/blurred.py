"""Blurred targets: image coordinates of the corresponding rays, by matching with images formed by rays.

In a blurred image the centre of density is not the image of the target's point: coma, colour and vignetting
shift it, and it may be the image of another point at each place of the field. The image of the target is
formed by rays (:mod:`reseau.optics.lenses.images`) and matched with the frame; the result is the place of the
corresponding ray, the principal ray of one wavelength (Meid 1992, sections 2.2 and 3.2). The matcher is that
of all other marks: two shifts, contrast and background, the width of the remaining blur, and, if wanted, the
focus.

Motion during the exposure is another physical cause: :class:`Moving` smears the images of any lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Frame, Mask, Rows
from ..core.errors import UsageError
from ..core.failure import Code, Remark
from ..optics.formation import Outline, PixelResponse
from ..optics.lenses import PlaneTarget, PupilElements, RayImage, RayMap, RaySurrogate, ray_image
from .matching import GrownOutline, Matches, MatchOptions, Window, grey_variance, match, with_alike_errors
from .points import Measured, Reason
from .screening import screen

__all__ = ["BlurredOptions", "BlurredResult", "Moving", "measure_blurred"]

_WINDOWS = (8, 10, 12, 14, 17, 20, 24, 28, 34, 40, 48, 57, 68, 81, 96, 115, 137, 160)
"""Half sides of windows: targets of similar size are matched together."""
_RINGS = (4, 6, 8, 11)
"""Rings of elements of the stop: each step doubles the number of rays."""
_SETTLED = 0.1
"""More rays no longer matter if they shift the match by less than this many of its standard deviations."""
_LEAST_SHIFT = 0.002
"""… or by less than this many pixels."""
_TAPS = 8
"""Values between which images at half pixels are interpolated; exact to 1e-5 of the light."""
_LEVEL = 0.12
"""Step of the logarithm of the widths for which images are formed."""
_SMALL_PX = 0.05
"""Motion of the nodes for the derivative by the focus."""
_KEPT = 60
"""Images of other focus that are kept."""
_SEEN = 0.95
_BEGINNING = 0.75
"""Least correlation at whole pixels."""
_ALIKE = 0.8
"""Least correlation of a target with its formed image."""
_DISTURBED = 2.5
"""Largest ratio of the residuals of a target to those of the others."""
_FEWEST = 8
"""Targets from which the noise as a function of the grey value is estimated."""


@dataclass(frozen=True)
class BlurredOptions:
    """Options of the measurement of blurred targets.

    Parameters
    ----------
    polarity : {"dark", "bright"}
        Whether targets are darker or brighter than what is around them.
    psf_px : float
        Width (one sigma) of what remains beside the blur of the rays: diffraction and the sensor's own.
    psf_log_sigma : float
        Uncertainty of that width: standard deviation of its logarithm.
    search_px : float
        Largest distance of a target from where the orientation predicts it.
    focus : callable, optional
        Function of a displacement of the image surface (mm) that returns the map of rays with it; the
        displacement is then estimated for each target.
    focus_sigma_mm : float
        Prior standard deviation of the displacement.
    fill : float
        Light-sensitive share of the pitch of a pixel.
    rings : int, optional
        Rings of elements of the stop; by default as many as the noise requires.
    background : int
        Degree of the polynomial of the background.

    Examples
    --------
    >>> BlurredOptions(polarity="bright", search_px=3.0).psf_px
    0.5
    """

    polarity: Literal["dark", "bright"] = "dark"
    psf_px: float = 0.5
    psf_log_sigma: float = 0.3
    search_px: float = 6.0
    focus: Any = None
    focus_sigma_mm: float = 0.2
    fill: float = 1.0
    rings: int | None = None
    background: int = 1


@dataclass(frozen=True, eq=False, repr=False)
class BlurredResult(Measured):
    """Blurred targets measured in one frame; `xy` are the corresponding rays.

    Parameters
    ----------
    psf_px : ndarray (n,)
        Estimated width (one sigma) of what blurs beside the rays.
    blur_px : ndarray (n,)
        Root mean square distance of the rays of a point from their mean.
    offset : ndarray (n, 2)
        Centre of density minus corresponding point, pixels: the error of a centre of gravity.
    focus_mm, focus_sigma_mm : ndarray (n,)
        Estimated displacement of the image surface; NaN if it was not wanted.
    rings : int
        Rings of elements of the stop that were used; 0 for those of a surrogate.
    """

    psf_px: Array = field(default_factory=lambda: np.zeros(0))
    blur_px: Array = field(default_factory=lambda: np.zeros(0))
    offset: Array = field(default_factory=lambda: np.zeros((0, 2)))
    focus_mm: Array = field(default_factory=lambda: np.zeros(0))
    focus_sigma_mm: Array = field(default_factory=lambda: np.zeros(0))
    rings: int = 0
    notes: tuple[Remark, ...] = ()


@dataclass(frozen=True, eq=False)
class Moving:
    """A map of rays during whose exposure the image moves.

    Parameters
    ----------
    camera : RayMap
    path_px : ndarray (m, 2)
        Places of the image during equal parts of the exposure, relative to its place for the result.

    Examples
    --------
    >>> from reseau.optics.lenses import SensorPlane, ThinLens
    >>> still = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> moving = Moving(still, np.array([[-2.0, 0.0], [0.0, 0.0], [2.0, 0.0]]))
    >>> moving.spots(np.array([[0.0, 0.0, 1000.0]]), PupilElements.gauss(2))[0].shape
    (3, 1, 20, 2)
    """

    camera: RayMap
    path_px: Array

    def corresponding(self, points: Array) -> Array:
        """See :class:`reseau.optics.lenses.RayMap`."""
        return self.camera.corresponding(points)

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """See :class:`reseau.optics.lenses.RayMap`."""
        xy, light = self.camera.spots(points, elements)
        return np.concatenate([xy + step for step in self.path_px]), np.concatenate(
            [light] * len(self.path_px)
        )


class _RayShapes:
    """Images by rays as a shape of the matcher; its only parameter of form is the focus.

    A shift moves the formed image as it is. Each image is therefore formed once, at half the distance of the
    pixels, and interpolated; the width of the point-spread function follows by the heat equation from the
    two nearest of some widths for which it is formed.

    Parameters
    ----------
    images : tuple of RayImage
    motions : tuple of ndarray (j, 2)
        Motions of the nodes with the focus, one array for each image, or none. Images with another focus are
        formed anew.
    """

    def __init__(self, images: tuple[RayImage, ...], motions: tuple[Array, ...] = ()) -> None:
        self.images, self.motions = images, motions
        self._formed: dict[tuple[int, int, int, float], Array] = {}

    @property
    def parameters(self) -> int:
        """See :class:`reseau.measure.matching.Shape`."""
        return 1 if self.motions else 0

    def image(self, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """See :class:`reseau.measure.matching.Shape`."""
        return np.stack([self._one(k, xy, width, form, at, window)[0] for k in range(len(at))])

    def derivatives(
        self, xy: Array, width: Array, form: Array, at: Rows, window: Window
    ) -> tuple[Array, Array]:
        """See :class:`reseau.measure.matching.Shape`."""
        found = np.stack([self._one(k, xy, width, form, at, window) for k in range(len(at))])
        return found[:, 0], found[:, 1:]

    def _one(self, k: int, xy: Array, width: Array, form: Array, at: Rows, window: Window) -> Array:
        """Image of the target at row `k` and its derivatives, (4 + p, r, c)."""
        target, place, sigma = int(at[k]), xy[k], float(width[k])
        columns, rows = window.columns[k], window.rows[k]
        if not self.parameters:
            return self._interpolated(target, place, sigma, 0.0, columns, rows, window.response)
        focus = float(form[k, 0])
        step = _SMALL_PX / max(float(np.abs(self.motions[target]).max()), 1e-9)
        here, *beside = (
            self._interpolated(target, place, sigma, focus + by, columns, rows, window.response)
            for by in (0.0, step, -step)
        )
        return np.concatenate([here, (beside[0][:1] - beside[1][:1]) / (2 * step)])

    def _interpolated(
        self,
        target: int,
        place: Array,
        sigma: float,
        focus: float,
        columns: Array,
        rows: Array,
        response: PixelResponse,
    ) -> Array:
        """Image, its derivatives along x and y and by the width, (4, r, c)."""
        below, along = divmod(np.log(sigma) / _LEVEL, 1.0)
        # Places of the pixels relative to the target: whole half pixels, and a common rest.
        across, down = (2 * (pixels[0] - at) for pixels, at in zip((columns, rows), place, strict=True))
        left, top = int(np.floor(across)), int(np.floor(down))
        reach = max(abs(left), abs(top), abs(left + 2 * len(columns)), abs(top + 2 * len(rows))) + 2 * _TAPS
        reach = -(-reach // 32) * 32  # a little more than needed, so that a shift finds it again
        by_x, by_y = _taps(across - left), _taps(down - top)
        x, y = (
            reach + start + 1 - _TAPS // 2 + np.arange(2 * count + _TAPS)
            for start, count in ((left, len(columns)), (top, len(rows)))
        )
        # Between two widths, so that the image is a continuous function of the width.
        part: Array = np.zeros((4, y[-1] + 1 - y[0], x[-1] + 1 - x[0]))
        by_width: Array = np.zeros(part.shape[1:])
        for level, share, rise in ((int(below), 1 - along, -1.0), (int(below) + 1, along, 1.0)):
            formed_at = float(np.exp(level * _LEVEL))
            grid = self._grid(target, level, reach, focus, formed_at, response)
            grid = grid[:, y[0] : y[-1] + 1, x[0] : x[-1] + 1]
            widened = grid[0] + (sigma**2 - formed_at**2) / 2 * grid[3]
            part[0] += share * widened
            part[1:3] += share * grid[1:3]
            by_width += share * sigma * grid[3] + rise / (sigma * _LEVEL) * widened
        part[3] = by_width
        part = sum(w * part[:, :, j : j + 2 * len(columns) : 2] for j, w in enumerate(by_x))
        part = sum(w * part[:, j : j + 2 * len(rows) : 2] for j, w in enumerate(by_y))
        return part

    def _grid(
        self,
        target: int,
        level: int,
        reach: int,
        focus: float,
        sigma: float,
        response: PixelResponse,
    ) -> Array:
        """Image, derivatives by a shift along x and y, and Laplacian (4, r, c), at half pixels."""
        key = target, level, reach, focus
        if key not in self._formed:
            if focus and len(self._formed) > _KEPT:
                self._formed.clear()
            nodes = self.images[target].outline
            if focus:
                nodes = Outline(nodes.xy + focus * self.motions[target], nodes.dxy)
            at = np.arange(-reach, reach + 1) / 2
            shape, origin = _shape_of(nodes), (np.zeros((1, 2)), np.array([sigma]), *_ALONE)
            grid = np.empty((4, len(at), len(at)))
            for odd_y in (0, 1):  # pixels are adjacent in each of four rasters
                for odd_x in (0, 1):
                    window = Window(at[None, odd_x::2], at[None, odd_y::2], response)
                    share, slopes = shape.derivatives(*origin, window)
                    grid[0, odd_y::2, odd_x::2] = share[0]
                    grid[1:, odd_y::2, odd_x::2] = slopes[0]
            grid[3] /= sigma
            self._formed[key] = grid
        return self._formed[key]


_ALONE = np.zeros((1, 0)), np.zeros(1, np.intp)
"""Form and row of a single shape."""


def _shape_of(outline: Outline) -> GrownOutline:
    """One outline (j, 2) as a shape of the matcher, in single precision."""
    return GrownOutline(Outline(outline.xy[None], outline.dxy[None]).single(), np.zeros((0, 2, 2)))


def _taps(share: float) -> Array:
    """Weights (_TAPS,) of Lagrange's interpolation between the middle two of so many equidistant values."""
    nodes = np.arange(_TAPS) - (_TAPS // 2 - 1)
    weights = np.ones(_TAPS)
    for j in range(_TAPS):
        for m in range(_TAPS):
            if m != j:
                weights[j] *= (share - nodes[m]) / (nodes[j] - nodes[m])
    return weights


def measure_blurred(
    frame: Frame,
    camera: RayMap,
    ids: Sequence[str],
    targets: Sequence[PlaneTarget],
    options: BlurredOptions = BlurredOptions(),
) -> BlurredResult:
    """Measure blurred targets in a frame.

    Parameters
    ----------
    frame : Frame
    camera : RayMap
        The lens with its sensor, a surrogate or a stand-in of it.
    ids : sequence of str (n,)
        Names of the targets.
    targets : sequence of PlaneTarget (n,)
        The targets in camera axes, from an approximate orientation.
    options : BlurredOptions

    Returns
    -------
    BlurredResult
        All n targets; those that were not measured with the reason.

    Raises
    ------
    UsageError
        When names and targets differ in number, or a target cannot be imaged by any lens.

    Examples
    --------
    A disk seen by a lens that is focused behind it; the image is drawn with the same rays:

    >>> from reseau.optics.formation import coverage
    >>> from reseau.optics.lenses import SensorPlane, ThinLens
    >>> camera = ThinLens(50.0, 12.5, 52.9, SensorPlane((0.01, 0.01), (40.0, 40.0)))
    >>> disk = PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(2.0, 0.05))
    >>> formed = ray_image(camera, disk, PupilElements.gauss(12)).outline
    >>> placed, pixels = Outline(formed.xy + [41.2, 39.7], formed.dxy), np.arange(81.0)
    >>> share = coverage(placed, pixels, pixels, 0.5)
    >>> noise = np.random.default_rng(0).normal(0.0, 1.0, share.shape)
    >>> found = measure_blurred(Frame(200 - 150 * share + noise, 255.0), camera, ["1"], [disk])
    >>> found.xy.round(1)
    array([[41.2, 39.7]])
    """
    if len(ids) != len(targets):
        raise UsageError(f"{len(ids)} names were given for {len(targets)} targets")
    return _Run(frame, camera, tuple(ids), tuple(targets), options).result()


class _Run:
    """The measurement of one frame."""

    def __init__(
        self,
        frame: Frame,
        camera: RayMap,
        ids: tuple[str, ...],
        targets: tuple[PlaneTarget, ...],
        options: BlurredOptions,
    ) -> None:
        self.frame, self.camera, self.ids, self.targets, self.options = frame, camera, ids, targets, options
        self.screened = screen(frame, None)
        n = len(ids)
        self.why = Reason("", Code.DECLINED).repeated(n)
        self.predicted = np.full((n, 2), np.nan)
        self.columns: dict[str, Array] = {
            name: np.full(n, np.nan)
            for name in ("contrast", "t", "noise", "psf_px", "blur_px", "focus_mm", "focus_sigma_mm")
        }
        self.columns |= {name: np.full((n, 2), np.nan) for name in ("xy", "offset")}
        self.columns["cov"] = np.full((n, 2, 2), np.nan)
        self.ok = np.zeros(n, dtype=np.bool_)

    def result(self) -> BlurredResult:
        if isinstance(self.camera, RaySurrogate):
            rings, elements = 0, self.camera.elements
        else:
            rings = self.options.rings or self._rings()
            elements = PupilElements.gauss(rings)
        images = [self._imaged(k, elements) for k in range(len(self.ids))]
        seen = np.array([k for k, image in enumerate(images) if image is not None], dtype=np.intp)
        start = np.full((len(self.ids), 2), np.nan)
        for k in seen:
            start[k] = self._found(int(k), cast(RayImage, images[k]))
        rows = seen[np.isfinite(start[seen]).all(axis=1)]
        halves = np.array([self._half(cast(RayImage, images[k])) for k in rows], dtype=np.intp)
        results: list[tuple[Rows, Matches]] = []
        for half in np.unique(halves):
            those = rows[halves == half]
            shape = self._shape(those, [cast(RayImage, images[k]) for k in those], elements)
            results.append((those, self._matched(shape, start[those], int(half))))
        self._judge(results)
        for k in seen:
            image = cast(RayImage, images[k])
            self.columns["blur_px"][k], self.columns["offset"][k] = image.blur, image.centroid
        return BlurredResult(
            image=self.frame.name,
            sha256=self.frame.sha256,
            ids=self.ids,
            ok=self.ok,
            why=tuple(self.why),
            predicted=self.predicted,
            deviation=np.where(self.ok[:, None], self.columns["xy"] - self.predicted, np.nan),
            rings=rings,
            **cast(Any, self.columns),
        )

    def _imaged(self, k: int, elements: PupilElements) -> RayImage | None:
        """Image of a target by rays; None, with the reason, where there is none in the frame."""
        try:
            image = ray_image(self.camera, self.targets[k], elements)
        except UsageError as error:
            self.why[k] = Reason(error.what, Code.OUTSIDE)
            return None
        self.predicted[k] = image.point
        low, high = (image.point + end(image.outline.xy, axis=0) for end in (np.min, np.max))
        if (high < 0).any() or (low > np.array([self.frame.width, self.frame.height]) - 1).any():
            self.why[k] = Reason("outside the frame", Code.OUTSIDE)
            return None
        return image

    def _half(self, image: RayImage) -> int:
        """Half side of the window of a target."""
        need = float(np.abs(image.outline.xy).max()) + 4 * self.options.psf_px + 3
        at = int(np.searchsorted(_WINDOWS, need))
        return _WINDOWS[min(at, len(_WINDOWS) - 1)]

    def _formed(self, image: RayImage, half: int, xy: Array) -> NDArray[Any]:
        """Image (r, c) of a target at a place, in a window around the nearest pixel."""
        across: Array = np.rint(xy) + np.arange(-half, half + 1.0)[:, None]
        window = Window(across[None, :, 0], across[None, :, 1], PixelResponse(self.options.fill))
        width = np.array([self.options.psf_px])
        return np.asarray(_shape_of(image.outline).image(xy[None], width, *_ALONE, window)[0])

    def _found(self, k: int, image: RayImage) -> Array:
        """Approximate position of a target by correlation within the range of search; NaN if not found."""
        half, reach = self._half(image), int(np.ceil(self.options.search_px))
        centre = np.rint(image.point)
        formed = self._formed(image, half, centre)
        sign = -1.0 if self.options.polarity == "dark" else 1.0
        left, top = (centre - half - reach).astype(int)
        side = 2 * (half + reach) + 1
        h, w = self.screened.grey.shape
        rows, columns = (
            np.clip(np.arange(top, top + side), 0, h - 1),
            np.clip(np.arange(left, left + side), 0, w - 1),
        )
        around = np.ascontiguousarray(self.screened.grey[np.ix_(rows, columns)], np.float32)
        score = cv2.matchTemplate(around, (sign * formed).astype(np.float32), cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        if not score[row, column] > _BEGINNING:
            self.why[k] = Reason(
                f"nothing like its image within {self.options.search_px:g} px of the predicted position",
                Code.NOT_FOUND,
            )
            return np.full(2, np.nan)
        return np.asarray(centre + np.array([column - reach, row - reach]))

    def _shape(self, rows: Rows, images: list[RayImage], elements: PupilElements) -> _RayShapes:
        if self.options.focus is None:
            return _RayShapes(tuple(images))
        step, motions = 0.01, []
        for k in rows:
            near, far = (ray_image(self.options.focus(by), self.targets[k], elements) for by in (step, -step))
            # Relative to the corresponding ray, whose place is the result, at whatever focus.
            motions.append((near.outline.xy - far.outline.xy) / (2 * step))
        return _RayShapes(tuple(images), tuple(motions))

    def _matched(self, shape: _RayShapes, start: Array, half: int) -> Matches:
        o = self.options
        options = MatchOptions(
            half_px=half,
            psf_px=o.psf_px,
            psf_log_sigma=o.psf_log_sigma,
            polarity=o.polarity,
            response=PixelResponse(o.fill),
            background=o.background,
            settled=0.05,
            influence=True,
        )

        def run(options: MatchOptions) -> Matches:
            prior = np.array([o.focus_sigma_mm]) if shape.parameters else None
            return match(
                self.screened.grey,
                self.screened.valid,
                shape,
                start,
                options,
                noise=self.screened.noise,
                form_sigma=prior,
            )

        first = run(options)
        sure = first.converged & (first.correlation > _ALIKE)
        if sure.sum() < _FEWEST:
            return first
        variance = grey_variance(self.screened.grey, start[sure], first.residuals[sure])
        return first if variance is None else run(replace(options, variance=variance))

    def _judge(self, results: list[tuple[Rows, Matches]]) -> None:
        """Fill in the columns; decline what is not an image of its target."""
        if not results:
            return
        usual = float(np.median(np.concatenate([found.noise for _, found in results])))
        for rows, found in results:
            found = with_alike_errors(found)
            sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1))
            distance = np.hypot(*(found.xy - self.predicted[rows]).T)
            objections: list[tuple[Mask, Reason]] = [
                (found.seen < _SEEN, Reason("partly outside the frame, or hidden", Code.HIDDEN)),
                (~found.converged, Reason("the match did not converge", Code.NOT_CONVERGED)),
                (
                    ~(found.t >= 8) | (found.contrast <= 0),
                    Reason("no target is distinct from its surroundings", Code.LOW_CONTRAST),
                ),
                (
                    distance > self.options.search_px + 1,
                    Reason("farther from the predicted position than the range of search", Code.DEVIATES),
                ),
                (found.correlation < _ALIKE, Reason("the image is not that of the target", Code.UNLIKE)),
                (
                    (found.rejected > 0.1) | (found.noise > _DISTURBED * max(usual, self.screened.noise)),
                    Reason("partly hidden or disturbed", Code.DISTURBED),
                ),
                (~(sigma < 0.5), Reason("too uncertain", Code.UNCERTAIN)),
            ]
            for mask, reason in objections:
                first = mask & (self.why[rows] == "")
                self.why[rows[first]] = reason
            good = self.why[rows] == ""
            self.ok[rows] = good
            self.columns["xy"][rows[good]] = found.xy[good]
            self.columns["cov"][rows[good]] = found.cov[good]
            for name in ("contrast", "t", "noise", "psf_px"):
                self.columns[name][rows] = getattr(found, name)
            if self.options.focus is not None:
                self.columns["focus_mm"][rows] = found.form[:, 0]
                self.columns["focus_sigma_mm"][rows] = found.form_sigma[:, 0]

    def _rings(self) -> int:
        """As many rings that more of them no longer change the most blurred image within the noise."""
        coarse = PupilElements.gauss(_RINGS[0])
        images = [(k, image) for k in range(len(self.ids)) if (image := self._imaged(k, coarse)) is not None]
        if not images:
            return _RINGS[0]
        k, before = max(images, key=lambda pair: pair[1].blur)
        half, xy = self._half(before), np.rint(before.point)
        formed = self._formed(before, half, xy)
        for few, many in pairwise(_RINGS):
            image = self._imaged(k, PupilElements.gauss(many))
            if image is None:
                return many
            finer = self._formed(image, half, xy)
            if self._alike(formed, finer):
                return few
            formed = finer
        return _RINGS[-1]

    def _alike(self, formed: NDArray[Any], finer: NDArray[Any]) -> bool:
        """Whether two formed images differ by an insignificant shift under the noise of the frame."""
        down, right = np.gradient(finer)
        design = np.stack([right.ravel(), down.ravel(), finer.ravel(), np.ones(finer.size)], axis=1)
        cofactor = np.linalg.inv(design.T @ design)
        shift = (cofactor @ design.T @ (finer - formed).ravel())[:2]
        contrast = float(np.ptp(self.screened.grey)) / 2
        sigma = np.sqrt(np.diagonal(cofactor)[:2]) * self.screened.noise / contrast
        return bool((np.abs(shift) < np.maximum(_SETTLED * sigma, _LEAST_SHIFT)).all())
