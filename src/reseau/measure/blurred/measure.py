"""Measurement of the blurred targets of one frame: formed, found, matched and judged."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, cast

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core import vocabulary as v
from ...core.data import Array, Frame, Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Failure, Remark
from ...optics.formation import Outline, PixelResponse
from ...optics.lenses import PupilElements, RayMap
from ...optics.lenses.images import PlaneTarget, RayImage, ray_images, required_image
from ..matching import Matches, match, with_alike_errors
from ..matching.patches import MatchOptions
from ..mosaic import balanced
from ..points import Measured, Reason
from ..screening import Screened, screen
from .likeness import Likeness, Residuals, widths_differ
from .shapes import RayShapes

_WINDOWS = (8, 10, 12, 14, 17, 20, 24, 28, 34, 40, 48, 57, 68, 81, 96, 115, 137, 160)
"""Half sides of windows: targets of similar size are matched together."""
RINGS = (4, 6, 8, 11)
"""Rings of elements of the stop: each step doubles the number of rays."""
_SETTLED = 0.1
"""More rays no longer matter if what is judged changes by less than this part of its standard deviation."""
_LEAST_SHIFT = 0.0005
"""… or by less than this many pixels."""
_CRITICAL = 4
"""Number of targets with which this is tested."""
_STEP = 0.05
"""Step of a varied parameter for the motion of the nodes, in its standard deviations."""
_SEEN = 0.95
_APART = 2.0
"""Widths of the remaining blur by which images must be apart."""
_BEGINNING = 0.75
"""Least correlation at whole pixels."""
_ALIKE = 0.8
"""Least correlation of a target with its formed image."""
_DISTURBED = 2.5
"""Largest ratio of the residuals of a target to those of the others."""


@dataclass(frozen=True, eq=False)
class Varied:
    """Parameters of the optics that are estimated with each target: focus, media.

    A shift of the whole image is not among their effects: the result is the place of the corresponding ray,
    wherever that lies; what they change is the form of the image around it.

    Parameters
    ----------
    names : tuple of str (p,)
        With their units, as `focus_mm`.
    sigma : tuple of float (p,)
        Prior standard deviations around 0.
    camera : callable
        Function of changes (p,) of the parameters that returns the map of rays with them.

    Examples
    --------
    The distance of the sensor from a thin lens:

    >>> from reseau.optics.lenses import ThinLens
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> sensor = SensorPlane((0.01, 0.01), (0.0, 0.0))
    >>> focus = Varied(("focus_mm",), (0.2,), lambda by: ThinLens(50.0, 12.5, 52.0 + by[0], sensor))
    >>> focus.camera(np.array([0.1])).corresponding(np.array([[10.0, 0.0, 1000.0]])).round(3) + 0.0
    array([[52.1,  0. ]])
    """

    names: tuple[str, ...]
    sigma: tuple[float, ...]
    camera: Callable[[Array], RayMap]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.sigma):
            raise UsageError(f"{len(self.names)} parameters need as many standard deviations")
        if not all(0 < value < np.inf for value in self.sigma):
            raise UsageError("standard deviations of varied parameters must be positive")


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
    varied : Varied, optional
        Parameters of the optics, such as focus and media, that are estimated with each target.
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

    polarity: v.Polarity = "dark"
    psf_px: v.PsfPx = 0.5
    psf_log_sigma: float = 0.3
    search_px: v.SearchPx = 6.0
    varied: Varied | None = None
    fill: v.Fill = 1.0
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
    varied, varied_sigma : ndarray (n, p)
        Estimates of varied parameters of the optics, and their standard deviations.
    rings : int
        Rings of elements of the stop that were used.
    misfit : float
        Residuals of the targets, in means over 3×3 pixels, ÷ those beside them, both in units of the noise of
        their grey values: about 1 where they are like their images; NaN if none was measured.
    uneven : bool
        Whether what blurs beside the rays differs from target to target, where images are like their targets.

    Examples
    --------
    See :func:`measure_blurred`, which returns it.
    """

    psf_px: Array = field(default_factory=lambda: np.zeros(0))
    blur_px: Array = field(default_factory=lambda: np.zeros(0))
    offset: Array = field(default_factory=lambda: np.zeros((0, 2)))
    varied: Array = field(default_factory=lambda: np.zeros((0, 0)))
    varied_sigma: Array = field(default_factory=lambda: np.zeros((0, 0)))
    rings: int = 0
    misfit: float = float("nan")
    uneven: bool = False
    notes: tuple[Remark, ...] = ()


@dataclass(frozen=True, eq=False)
class Equations:
    """What a target tells of parameters of the optics, without what its place, light and width explain.

    Normal equations (p, p) and (p,), sum of squares over the variance of the noise, degrees of freedom, and
    the displacement (p, 2) of its place with each parameter.
    """

    row: int
    normal: Array
    right: Array
    cost: float
    freedom: int
    shifts: Array


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
        The lens with its sensor, or a stand-in of it.
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

    Notes
    -----
    Derived in ``docs/mathematics/blurred.md``.

    Examples
    --------
    A disk seen by a lens that is focused behind it; the image is drawn with the same rays:

    >>> from reseau.optics.formation import coverage
    >>> from reseau.optics.lenses import ThinLens, ray_image
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
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
    return Run(frame, camera, tuple(ids), tuple(targets), options).result()


class Run:
    """The measurement of one frame."""

    def __init__(
        self,
        frame: Frame,
        camera: RayMap,
        ids: tuple[str, ...],
        targets: tuple[PlaneTarget, ...],
        options: BlurredOptions,
    ) -> None:
        frame = balanced(frame)
        self.frame, self.camera, self.ids, self.targets, self.options = frame, camera, ids, targets, options
        screened, n = screen(frame, None), len(ids)
        self.blank = screened if isinstance(screened, Failure) else None
        if isinstance(screened, Failure):
            screened = Screened(
                frame.pixels.astype(np.float32), np.zeros(frame.pixels.shape, dtype=bool), np.nan
            )
        self.screened, reason = screened, "" if self.blank is None else self.blank.reason
        self.why = Reason(reason, Code.DECLINED).repeated(n)
        self.predicted = np.full((n, 2), np.nan)
        self.columns: dict[str, Array] = {
            name: np.full(n, np.nan) for name in ("contrast", "t", "noise", "psf_px", "blur_px")
        }
        count = 0 if options.varied is None else len(options.varied.names)
        self.columns |= {name: np.full((n, count), np.nan) for name in ("varied", "varied_sigma")}
        self.columns |= {name: np.full((n, 2), np.nan) for name in ("xy", "offset")}
        self.columns["cov"] = np.full((n, 2, 2), np.nan)
        self.ok = np.zeros(n, dtype=np.bool_)

    def result(self) -> BlurredResult:
        """Form, find, match and judge all targets."""
        rings, elements, images = self._images()
        self.elements, self.images = elements, images
        lit = images if self.blank is None else []
        seen = np.array([k for k, image in enumerate(lit) if image is not None], dtype=np.intp)
        seen = self._apart(seen)
        start = np.full((len(self.ids), 2), np.nan)
        for k in seen:
            start[k] = self._found(int(k), cast(RayImage, images[k]))
        rows = seen[np.isfinite(start[seen]).all(axis=1)]
        halves = np.array([self.half(cast(RayImage, images[k])) for k in rows], dtype=np.intp)
        results: list[tuple[Rows, Array, Matches]] = []
        for half in np.unique(halves):
            those = rows[halves == half]
            shape = self._shape(
                those, [cast(RayImage, images[k]) for k in those], elements, self.options.varied
            )
            results.append((those, start[those], self._matched(shape, start[those], int(half))))
        likeness = self._judge(results)
        for k in seen:
            image = cast(RayImage, images[k])
            self.columns["blur_px"][k], self.columns["offset"][k] = image.blur, image.centroid
            # What a stand-in does not know; the noise knows nothing of it, the remaining blur a part.
            blur2 = image.blur**2 + 2 * self.columns["psf_px"][k] ** 2
            self.columns["cov"][k] += self.camera.unknown**2 * blur2 * np.eye(2)
        uneven = not likeness.unlike and self._uneven(results)
        return BlurredResult(
            image=self.frame.name,
            sha256=self.frame.sha256,
            ids=self.ids,
            ok=self.ok,
            why=tuple(self.why),
            predicted=self.predicted,
            deviation=np.where(self.ok[:, None], self.columns["xy"] - self.predicted, np.nan),
            rings=rings,
            misfit=likeness.misfit,
            uneven=uneven,
            notes=self._notes(likeness, uneven),
            **cast(Any, self.columns),
        )

    def equations(self, found: BlurredResult, varied: Varied, halves: dict[int, int]) -> Iterator[Equations]:
        """What each measured target tells of varied parameters."""
        count, o, noise = len(varied.names), self.options, self.screened.noise
        rows = np.flatnonzero(found.ok)
        shape = self._shape(rows, [cast(RayImage, self.images[k]) for k in rows], self.elements, varied)
        for k, row in enumerate(rows):
            half = halves.setdefault(int(row), self.half(shape.images[k]))
            xy, width = found.xy[row], float(found.psf_px[row])
            columns, lines = (np.rint(at) + np.arange(-half, half + 1.0) for at in xy)
            columns = columns[(columns >= 0) & (columns < self.frame.width)]
            lines = lines[(lines >= 0) & (lines < self.frame.height)]
            inside = np.ix_(lines.astype(np.intp), columns.astype(np.intp))
            grey, valid = self.screened.grey[inside].ravel(), self.screened.valid[inside].ravel()
            where = xy, width, columns, lines, PixelResponse(o.fill)
            outlines = shape.at(k, np.zeros(count))
            parts = shape.images[k].formed(*where, derivatives=True, bright=shape.bright, parts=outlines)
            parts = parts.reshape(len(parts), -1)
            u, v = (at.ravel() for at in np.meshgrid((columns - xy[0]) / half, (lines - xy[1]) / half))
            light = np.stack([np.ones_like(u), u, v, parts[0]], axis=1)[valid]
            fitted = np.linalg.lstsq(light, grey[valid], rcond=None)[0]
            residuals = grey[valid] - light @ fitted
            others = fitted[3] * parts[1:, valid].T
            others[:, 2] *= width
            design = np.concatenate([light, others], axis=1) / noise
            normal, right = design.T @ design, design.T @ (residuals / noise)
            normal[6, 6] += 1 / o.psf_log_sigma**2
            right[6] -= np.log(width / o.psf_px) / o.psf_log_sigma**2
            local, common = slice(0, 7), slice(7, None)
            factor = np.linalg.solve(normal[local, local], normal[local, common]).T
            cost = float((residuals**2).sum()) / noise**2
            reduced = normal[common, common] - factor @ normal[local, common]
            to_the_right, free = right[common] - factor @ right[local], int(valid.sum()) - 7
            yield Equations(
                int(row), reduced, to_the_right, cost, free, np.asarray(-factor[:, 4:6], np.float64)
            )

    def _imaged(self, rows: Sequence[int], elements: PupilElements) -> list[RayImage | None]:
        """Images of targets by rays; None, with the reason, where there is none in the frame."""
        images = ray_images(self.camera, [self.targets[k] for k in rows], elements)
        return [self._inside(k, image) for k, image in zip(rows, images, strict=True)]

    def _inside(self, k: int, image: RayImage | Failure) -> RayImage | None:
        if isinstance(image, Failure):
            self.why[k] = Reason(image.reason, image.code)
            return None
        self.predicted[k] = image.point
        low, high = (image.point + end(image.outline.xy, axis=0) for end in (np.min, np.max))
        if (high < 0).any() or (low > np.array([self.frame.width, self.frame.height]) - 1).any():
            self.why[k] = Reason("outside the frame", Code.OUTSIDE)
            return None
        return image

    def _apart(self, seen: Rows) -> Rows:
        """Targets whose predicted images touch no other; the reason is noted for those that do."""
        images = [cast(RayImage, self.images[k]) for k in seen]
        if not images:
            return seen
        centre = np.array([image.point + image.centroid for image in images])
        around = [image.outline.xy - image.centroid for image in images]
        reach = np.array([np.hypot(*xy.T).max() for xy in around]) + _APART * self.options.psf_px
        touching: dict[int, int] = {}
        for a, b in scipy.spatial.cKDTree(centre).query_pairs(2 * float(reach.max())):
            if np.hypot(*(centre[a] - centre[b])) < reach[a] + reach[b]:
                touching.setdefault(a, b)
                touching.setdefault(b, a)
        for a, b in touching.items():
            self.why[seen[a]] = Reason(f"its image touches that of {self.ids[seen[b]]}", Code.OVERLAPPING)
        return seen[[a not in touching for a in range(len(seen))]]

    def half(self, image: RayImage) -> int:
        """Half side of the window of a target."""
        need = float(np.abs(image.outline.xy).max()) + 4 * self.options.psf_px + 3
        at = int(np.searchsorted(_WINDOWS, need))
        return _WINDOWS[min(at, len(_WINDOWS) - 1)]

    def _formed(self, image: RayImage, half: int, xy: Array) -> NDArray[Any]:
        """Image (r, c) of a target at a place, in a window around the nearest pixel."""
        across: Array = np.rint(xy) + np.arange(-half, half + 1.0)[:, None]
        response = PixelResponse(self.options.fill)
        bright = self.options.polarity == "bright"
        return image.formed(xy, self.options.psf_px, across[:, 0], across[:, 1], response, bright=bright)

    def correlated(self, image: RayImage) -> tuple[float, Array]:
        """Largest correlation of an image with the frame within the range of search, and where it is."""
        half, reach = self.half(image), int(np.ceil(self.options.search_px))
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
        return float(score[row, column]), centre + np.array([column - reach, row - reach])

    def _found(self, k: int, image: RayImage) -> Array:
        """Approximate position of a target; NaN if there is none."""
        score, place = self.correlated(image)
        if not score > _BEGINNING:
            self.why[k] = Reason(
                f"nothing like its image within {self.options.search_px:g} px of the predicted position",
                Code.NOT_FOUND,
            )
            return np.full(2, np.nan)
        return place

    def _shape(
        self, rows: Rows, images: list[RayImage], elements: PupilElements, varied: Varied | None
    ) -> RayShapes:
        bright = self.options.polarity == "bright"
        if varied is None or not varied.names:
            return RayShapes(tuple(images), bright=bright)
        steps = _STEP * np.diag(varied.sigma)
        beside = [(varied.camera(step), varied.camera(-step), 2 * float(step.sum())) for step in steps]
        motions: list[list[tuple[Array, Array]]] = [[] for _ in rows]
        for far, near, by in beside:
            # Relative to the corresponding ray, whose place is the result, whatever the parameters are.
            ends = (ray_images(camera, [self.targets[k] for k in rows], elements) for camera in (far, near))
            for motion, a, b in zip(motions, *ends, strict=True):
                one, other = required_image(a).outline, required_image(b).outline
                # Elements that are stopped on one side do not move.
                lit = np.asarray(one.dxy.any(axis=1) & other.dxy.any(axis=1))[:, None] / by
                motion.append((lit * (one.xy - other.xy), lit * (one.dxy - other.dxy)))
        changes = [Outline(*(np.stack(part) for part in zip(*motion, strict=True))) for motion in motions]
        return RayShapes(tuple(images), tuple(changes), bright=bright)

    def _matched(self, shape: RayShapes, start: Array, half: int) -> Matches:
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
            prior = None if o.varied is None else np.array(o.varied.sigma)
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
        variance = Residuals.of(self.screened.grey, start[sure], first.residuals[sure]).variance()
        return first if variance is None else run(replace(options, variance=variance))

    def _judge(self, results: list[tuple[Rows, Array, Matches]]) -> Likeness:
        """Fill in the columns; decline what is not an image of its target; return how like the others are."""
        if not results:
            return Likeness(float("nan"), False)
        usual, left = float(np.median(np.concatenate([found.noise for *_, found in results]))), []
        for rows, start, found in results:
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
            self.columns["varied"][rows], self.columns["varied_sigma"][rows] = found.form, found.form_sigma
            if good.any():
                left.append(Residuals.of(self.screened.grey, start[good], found.residuals[good]))
        return Residuals.likeness(left) if left else Likeness(float("nan"), False)

    def _uneven(self, results: list[tuple[Rows, Array, Matches]]) -> bool:
        """Whether what blurs beside the rays differs from target to target; a stand-in leaves much there."""
        good = [found.select(self.ok[rows]) for rows, _, found in results]
        if sum(map(len, good)) < 2 or self.camera.unknown > 0:
            return False
        width, sigma = (
            np.concatenate([getattr(found, name) for found in good]) for name in ("psf_px", "psf_log_sigma")
        )
        return widths_differ(width, sigma, sum(int(np.isfinite(found.residuals).sum()) for found in good))

    def _notes(self, likeness: Likeness, uneven: bool) -> tuple[Remark, ...]:
        """Say if the images of all targets differ from those formed."""
        said, width = "", self.columns["psf_px"][self.ok]
        if likeness.unlike:
            said = f"residuals of targets are {likeness.misfit:.3g} times the noise beside them"
        elif uneven:
            said = "what blurs beside the rays is "
            said += f"{width.min():.2g} px wide at one target and {width.max():.2g} px at another"
        text = "lens, focus or aperture are not those of the photograph, and places may be wrong by more"
        return (Remark(f"{said}: {text} than their sigmas", Code.INCONSISTENT),) if said else ()

    def _images(self) -> tuple[int, PupilElements, list[RayImage | None]]:
        """Rings of elements of the stop, these elements, and images of all targets.

        As many rings that more of them no longer change the images of the most critical targets within the
        noise.
        """

        def images(elements: PupilElements) -> list[RayImage | None]:
            return self._imaged(range(len(self.ids)), elements)

        rings = self.options.rings or RINGS[0]
        elements = PupilElements.gauss(rings)
        found = images(elements)
        seen = [(k, image) for k, image in enumerate(found) if image is not None]
        if self.options.rings or not seen:
            return rings, elements, found
        # Small targets that are much blurred show the single elements first.
        seen.sort(key=lambda pair: -pair[1].blur / self.targets[pair[0]].extent)
        critical = [k for k, _ in seen[:_CRITICAL]]
        windows = {k: (self.half(image), np.rint(image.point)) for k, image in seen[:_CRITICAL]}
        formed = {k: self._formed(image, *windows[k]) for k, image in seen[:_CRITICAL]}
        for few, many in pairwise(RINGS):
            rings, settled = few, True
            for k, finer in zip(critical, self._imaged(critical, PupilElements.gauss(many)), strict=True):
                if finer is not None:
                    coarser, formed[k] = formed[k], self._formed(finer, *windows[k])
                    settled &= self._alike(coarser, formed[k])
            if settled:
                break
            rings = many
        if rings == RINGS[0]:
            return rings, elements, found
        elements = PupilElements.gauss(rings)
        return rings, elements, images(elements)

    def _alike(self, formed: NDArray[Any], finer: NDArray[Any]) -> bool:
        """Whether two formed images differ insignificantly under the noise, in all that is judged.

        Which is the place, the width, and what is left, in the residuals of all targets together.
        """
        unit = float(np.ptp(self.screened.grey)) / 2 / self.screened.noise
        down, right = np.gradient(finer)
        wider = np.gradient(right, axis=1) + np.gradient(down, axis=0)
        design = np.stack([part.ravel() for part in (right, down, wider, finer, np.ones_like(finer))], axis=1)
        cofactor = np.linalg.inv(design.T @ design)
        off = (finer - formed).ravel()
        change = cofactor @ design.T @ off
        allowed = _SETTLED * np.sqrt(np.diagonal(cofactor)[:3]) / unit
        allowed[:2] = np.maximum(allowed[:2], _LEAST_SHIFT)
        left = float(np.sum((off - design @ change) ** 2)) * unit**2
        # The sum over all targets has as many times the squares, and their root times the scatter.
        scatter = float(np.sqrt(2 * off.size / len(self.ids)))
        return bool((np.abs(change[:3]) < allowed).all() and left < _SETTLED * scatter)
