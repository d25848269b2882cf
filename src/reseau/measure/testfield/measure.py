"""Measure a coded testfield in a frame: find its lines, read its squares, measure its targets.

The steps are those of Vosselman and Förstner (section 3): straight lines from the Laplacian, the Hough
transform and adjustment; classification of the targets in every square; numbering of the squares by topology;
location of the targets by least-squares matching. Targets that are not measured are reported with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from ...core import vocabulary as v
from ...core.data import Array, Frame, Mask, Rows
from ...core.failure import Code, Failure, Remark
from ...core.threads import one_thread
from ...core.tone import ToneCurve
from ...io import TestfieldDesign
from ...optics.formation import PixelResponse
from ..marks.judging import Objection, columns_of, reasons_of
from ..matching import Matches
from ..matching.shapes import Window
from ..mosaic import balanced
from ..plane.lattice_mapping import images_of, numbers_of, slope_of, stretches
from ..plane.plane_mapping import plane_through
from ..plane.polynomial import common_part, median, refit
from ..points import Measured, Reason
from ..response import Samples
from ..screening import quiet_noise, screen
from ..tone import FoundCurve, find_curve
from .lattice import LatticeFit
from .motion import MovedShape, anisotropy, path_of, spread_of
from .recognition import Reading, SearchedFrame, shows_second
from .target_images import form_targets
from .targets import Light, Scene, match_targets, pixels_of_targets, replaced

_LEAST_FIRST, _MOST_FIRST, _FIRST_SHARE = 8, 36, 0.125
"""Minimum and maximum number of large targets matched first, to improve the mapping and the sharpness; more
than the maximum if it is less than this share of all targets in the frame."""
_FEW, _AGAIN = 0.05, 4
"""Share of targets not measured for which another round is made; maximum number of rounds."""
_BESIDE_PX = 0.025
"""Distance of targets from their predictions, exceeded by one coordinate in ten, for which another round is
made: the light of lines and neighbours was formed in wrong places."""
_SAME_LIGHT, _SAME_PSF_PX = 0.005, 0.01
"""Relative change of contrast, and change of sharpness in pixels, for which another round is made: where
neighbours blend, the light of each depends on that of the others."""
_RESHAPED_PX, _REACH, _REPEATED = 0.015, 0.6, 1.05
"""Displacement of an outline by the mapping through all targets from which a target is matched again; reach
of targets relative to their size; multiple of the residuals that may remain then."""
_FAR = 4.5
"""Largest deviation of a target from the mapping through all targets, in standard deviations."""
_WIDE = 0.1
"""Margin around the frame, relative to its size, in which targets are considered that reach into it."""
_BEYOND = 1.0
"""Distance beyond the lines, in lattice steps, up to which the mapping through them is reliable."""
_SETTLED_PX = 0.1
"""Change of the predictions, in pixels, below which learning is not continued further outwards."""
_UNMODELLED_PX = 0.03
"""Scatter of positions about a mapping of third degree beyond their own sigmas."""
_SEEN = 0.6
"""Minimum share of a target on pixels that carry an image and are not saturated."""
_MOVES, _SAME_SPREAD = 4, 0.03
"""Maximum number of rounds in which motion is estimated; change of the covariance (px²) that ends them."""
_SHRUNK = 0.015
"""Apparent shrinking of dark targets (of bright ones growth) from which a tone curve is searched for."""
_HIGH_RESIDUALS = 1.4
"""Multiple of the usual residuals from which a curved background is tried."""
_CLEARED, _NEIGHBOURS, _LIKE = 0.9, 6, 0.8
"""The residuals must fall below this multiple without the pixels that show something else; number of
neighbours that give the light of the background there; correlation of a window that is like its target."""
_VEILED, _CONTRAST_SLOPE = 0.04, 0.3
"""Deviation of the contrast of a target from the usual one from which it may change across the target, and
the standard deviation of this change over half a window."""
_UNLIKE, _UNLIKE_BESIDE, _ALIKE = 2.0, 3.5, 0.08
"""Multiple of the usual residuals from which an image is that of another object; the same for targets whose
sharpness, contrast and size differ from the usual by less than this share."""
FORMED_PX = 0.002
"""Standard deviation of a coordinate from what no image shows: edges of prints, unequal pixels, formation of
images. Other programs for the formation of images agree with ours to this."""
_SECOND = Remark(
    "the frame shows the testfield more than once: one of them is measured", Code.SEVERAL_TARGETS
)
_CHANCE = 2.0
"""Standard deviations by which the scatter of targets may be too small by chance."""
_BLURRED, _PALE, _GROWN = 1.5, 0.25, 0.15
"""Tolerances of sharpness (factor), contrast and size (shares) of a target relative to the others."""


@dataclass(frozen=True)
class TestfieldOptions:
    """Options of the measurement of a testfield.

    Parameters
    ----------
    psf_px : float
        Approximate width (one sigma) of the point-spread function; it is estimated.
    row_jitter_px : float
        Standard deviation of the shift of single rows, if known.
    fill : float
        Light-sensitive share of the pixel pitch along either axis, 0 to 1, if known.
    least_t : float
        Minimum contrast of a target over its standard deviation.
    most_sigma_px : float
        Largest standard deviation of a coordinate that is accepted.
    neighbour_px : float
        Minimum deviation from the mapping through all targets for which a target is rejected.

    Examples
    --------
    >>> TestfieldOptions(psf_px=1.0).least_t
    8.0
    """

    __test__ = False  # prevents collection by pytest
    psf_px: v.PsfPx = 0.8
    row_jitter_px: v.RowJitterPx = 0.0
    fill: v.Fill = 1.0
    least_t: float = 8.0
    most_sigma_px: float = 0.3
    neighbour_px: float = 0.03


@dataclass(frozen=True, eq=False, repr=False)
class TestfieldResult(Measured):
    """Targets of a testfield in one frame: `xy` are images of centroids, `deviation` is from a mapping.

    Parameters
    ----------
    psf_px : ndarray (n,)
        Width of the point-spread function of each match, NaN where there was none.
    lattice : LatticeFit
        The adjusted straight lines.
    reading : Reading
        Classification of the clusters.
    squares : int
        Number of squares that agree with the design; where too few can be read, those that agree better than
        by chance.
    notes : tuple of Remark
        How grey values that are not proportional to the light were linearised, and by which curve.

    Examples
    --------
    >>> from reseau.optics.composition import Chain, Similarity
    >>> lattice = LatticeFit(
    ...     Chain(Similarity(), Similarity(), ("camera.", "display.")), np.arange(2), np.arange(2)
    ... )
    >>> none = np.zeros((0, 16))
    >>> reading = Reading(np.zeros((0, 2), int), none, none, (), np.zeros((0, 16, 2)), none, none, 0.8)
    >>> ok, one = np.array([True, False]), np.ones(2)
    >>> xy = np.array([[40.1, 40.2], [np.nan, np.nan]])
    >>> columns = [xy, np.tile(1e-4 * np.eye(2), (2, 1, 1)), ok, ("", "outside"), xy, 0 * xy, *[one] * 4]
    >>> found = TestfieldResult("a.tif", "", ("1.01", "1.02"), *columns, lattice, reading, squares=0)
    >>> found.found, found.points.names
    (1, ('1.01',))
    """

    __test__ = False  # prevents collection by pytest
    psf_px: Array
    lattice: LatticeFit
    reading: Reading
    squares: int
    notes: tuple[Remark, ...] = ()


def measure_testfield(
    frame: Frame, design: TestfieldDesign, options: TestfieldOptions | None = None
) -> TestfieldResult | Failure:
    """Measure every target of a coded testfield that can be measured.

    Parameters
    ----------
    frame : Frame
        A frame that shows the testfield or a part of it, at least one square with its lines.
    design : TestfieldDesign
        The testfield.
    options : TestfieldOptions, optional
        Options of the measurement.

    Returns
    -------
    TestfieldResult or Failure
        A failure (falsy) if the design is not found in the frame.

    UsageError
        When the squares of the design do not consist of sixteen targets in a grid.

    Notes
    -----
    Derived in ``docs/mathematics/testfield.md``.

    Examples
    --------
    Form an image of a testfield of one square, one pixel per millimetre, and measure its targets:

    >>> from reseau.designs import coded_testfield
    >>> from reseau.optics.formation import draw, rectangles
    >>> from reseau.optics.targets import target_outline
    >>> design = coded_testfield(1, 1)
    >>> flip, targets = np.diag([1.0, -1.0]), design.targets
    >>> centres = design.xy @ flip + 74.5
    >>> bars = [[11.0, 11.0, 13.0, 138.0], [136.0, 11.0, 138.0, 138.0]]
    >>> bars += [[13.0, 11.0, 136.0, 13.0], [13.0, 136.0, 136.0, 138.0]]
    >>> share = draw(rectangles(np.array(bars), 0.5), (150, 150), 0.8)
    >>> for shape, size, centre in zip(targets.shape, targets.size, centres, strict=True):
    ...     outline = target_outline(shape, size, 0.0, 0.5).affine(flip[None], centre[None]).oriented()
    ...     share += draw(outline, (150, 150), 0.8)
    >>> grey = 200 * (1 - 0.8 * share) + np.random.default_rng(0).normal(0, 1, share.shape)
    >>> found = measure_testfield(Frame(grey, 255.0), design)
    >>> found.found, found.squares, bool(abs(found.xy - centres).max() < 0.02)
    (16, 1, True)
    """
    with one_thread():
        return _measured(balanced(frame), design, options or TestfieldOptions())


def _measured(frame: Frame, design: TestfieldDesign, options: TestfieldOptions) -> TestfieldResult | Failure:
    screened = screen(frame, None, noisy=False)
    if isinstance(screened, Failure):
        return screened
    grey = screened.grey if design.polarity == "dark" else -screened.grey
    noise, response = quiet_noise(grey), PixelResponse(options.fill)
    read = SearchedFrame(screened.grey, grey, noise, design, options.psf_px, response).read()
    if isinstance(read, Failure):
        return replace(read, where=frame.name)
    second = _SECOND if shows_second(read) else None
    (lattice, reading), placed = read.original(), read.placed
    valid = screened.valid & (frame.pixels < frame.full_scale)
    size = (float(frame.width), float(frame.height))
    light = Light.through(reading.xy.reshape(-1, 2), reading.level.ravel(), reading.contrast.ravel(), size)
    scene = Scene(
        screened.grey,
        valid,
        noise,
        design,
        lattice.mapping,
        placed.frame,
        placed.origin,
        light,
        reading.psf_px,
        response,
        options.row_jitter_px,
    )
    work = _Measurement(scene, lattice, options)
    work.learn()
    found = work.curve(float(frame.full_scale), frame.curve)
    if found.curve is not None:
        work.linearise(found.curve, float(frame.full_scale))
    note = found.remark("targets")
    return TestfieldResult(
        image=frame.name,
        sha256=frame.sha256,
        ids=design.ids,
        lattice=replace(lattice, mapping=work.scene.mapping),
        reading=reading,
        squares=placed.squares,
        **work.columns(),
        notes=tuple(each for each in (second, note) if each is not None),
    )


def _samples(scene: Scene, rows: Rows, found: Matches) -> tuple[Samples, Array]:
    """Matched targets of one window size, and all that was formed in their windows."""
    at = scene.lattice(scene.design.xy[rows])
    images, xy, _ = form_targets(scene.design, rows, scene.mapping, scene.frame, at, scene.psf_px)
    centre, half = np.rint(xy), [n // 2 for n in found.residuals.shape[1:]]
    down, right = (np.arange(-n, n + 1.0) for n in half)
    window = Window(centre[:, :1] + right, centre[:, 1:] + down, scene.response)
    h, w = scene.grey.shape
    x, y = (axis.clip(0, size - 1).astype(np.intp) for axis, size in ((window.columns, w), (window.rows, h)))
    grey = scene.grey[y[:, :, None], x[:, None, :]].astype(np.float64)
    dark = scene.design.polarity == "dark"
    samples = Samples(
        MovedShape(images, scene.path) if scene.path.any() else images,
        found.xy,
        found.psf_px,
        found.form,
        -found.contrast * found.level if dark else found.contrast,
        window,
        grey,
        np.isfinite(found.residuals),
    )
    return samples, grey + np.nan_to_num(found.residuals)


class _Measurement:
    """The two rounds of matching, and the tests of every target."""

    def __init__(self, scene: Scene, lattice: LatticeFit, options: TestfieldOptions) -> None:
        self.scene, self.options = scene, options
        self.growth: float | None = None
        self.spread = np.zeros(2)
        self.at = scene.lattice(scene.design.xy)
        ends = np.array([(lines.min(), lines.max()) for lines in (lattice.across, lattice.along)])
        self.middle, self.half = ends.mean(axis=1), np.ptp(ends, axis=1) / 2
        self._place()

    def _place(self) -> None:
        """Predict the positions of the targets, and select those in the frame."""
        scene = self.scene
        self.predicted = images_of(scene.mapping, self.at)
        h, w = scene.grey.shape
        size = np.array([w, h])
        margin = 3 * scene.psf_px
        wide = _WIDE * size.max()
        self.rows = np.flatnonzero(((self.predicted > -wide) & (self.predicted < size + wide)).all(axis=1))
        self.rows = self.rows[self._unfolded(self.at[self.rows])]
        slope = slope_of(scene.mapping, self.at[self.rows]) @ scene.frame
        reach = np.abs(slope).sum(axis=2) * 0.6 * scene.design.sizes[self.rows, None]
        xy = self.predicted[self.rows]
        near = ((xy > -reach - margin) & (xy < size - 1 + reach + margin)).all(axis=1)
        self.rows, reach, xy = self.rows[near], reach[near], xy[near]
        self.inside = ((xy > reach - 0.5) & (xy < size - 0.5 - reach)).all(axis=1)

    def _unfolded(self, at: Array) -> Mask:
        """Whether the mapping keeps its orientation from the middle of the lattice to these places.

        A polynomial folds back beyond the points that it was adjusted to.
        """
        way = at - self.middle
        parts = np.array([0.4, 0.7, 1.0])[:, None, None]
        slope = slope_of(self.scene.mapping, (self.middle + parts * way).reshape(-1, 2))
        return np.asarray((np.linalg.det(slope).reshape(3, -1) < 0).all(axis=0))

    def columns(self) -> dict[str, Any]:
        """Columns of the result from `xy` to `noise`."""
        wanted = self.rows[self.inside]
        found = self._matched()
        why, predicted = self._judged(self.scene, wanted, found)
        for _ in range(_AGAIN):
            good = why == ""
            off = (found.xy - self.predicted[wanted])[good]
            settled = good.mean() > 1 - _FEW and np.quantile(np.abs(off), 0.9) < _BESIDE_PX
            settled &= common_part(self.at[wanted[good]], off) is None
            settled &= self._alike(found, good, wanted)
            if settled or good.sum() < _MOST_FIRST:
                break
            # With many targets known, the mapping and the light of neighbours are known better.
            self._learn_from(found, good, wanted)
            wanted = self.rows[self.inside]
            found = self._matched()
            why, predicted = self._judged(self.scene, wanted, found)
            if good.mean() < 1 - _FEW and (why == "").sum() < 1.05 * good.sum():
                break
        found, why, predicted = self._reshaped(wanted, found, why, predicted)
        beyond = Reason("beyond the edge of the frame", Code.OUTSIDE).repeated(len(self.at))
        found = self._by_scatter(found, wanted, why, predicted)
        found = replace(found, cov=found.cov + FORMED_PX**2 * np.eye(2))
        columns = columns_of(found, wanted, why, beyond)
        return columns | {"predicted": predicted, "deviation": columns["xy"] - predicted}

    def _by_scatter(self, found: Matches, wanted: Rows, why: Array, predicted: Array) -> Matches:
        """Covariances no larger than what the scatter of small and large targets about a mapping shows.

        Residuals contain more than noise: levels, a curve and a filter of the camera that are not quite those
        of the model leave some in every window, and errors of neighbouring pixels cancel each other after
        sharpening. Targets are displaced less than such residuals tell.
        """
        off, cov = found.xy - predicted[wanted], found.cov.copy()
        parameters, large = len(numbers_of(self.scene.mapping)[1].ravel()), self.scene.design.large[wanted]
        for size in (False, True):
            good = np.flatnonzero((why == "") & (large == size))
            if (redundancy := 2 * len(good) - parameters) > 0:
                squares = (off[good, None] @ np.linalg.solve(cov[good], off[good, :, None])).sum()
                # As large as it may be by chance.
                most = squares / redundancy * (1 + _CHANCE * np.sqrt(2 / redundancy))
                cov[large == size] *= min(1.0, most)
        return replace(found, cov=cov)

    def _alike(self, found: Matches, good: Mask, wanted: Rows) -> bool:
        """Whether light and sharpness of the targets are those with which their neighbours were formed."""
        scene = self.scene
        large = good & scene.design.large[wanted]
        amplitude = scene.light.at(found.xy[large])[1]
        depth = found.contrast[large] * (found.level[large] if scene.design.polarity == "dark" else 1.0)
        if not large.any():
            return True
        wider = median(found.psf_px[large]) - scene.psf_px
        return abs(median(depth / amplitude) - 1) < _SAME_LIGHT and abs(wider) < _SAME_PSF_PX

    def _reshaped(
        self, wanted: Rows, found: Matches, why: Array, predicted: Array
    ) -> tuple[Matches, Array, Array]:
        """Match targets again whose form the mapping through all targets changes; see `_judged`.

        An outline of wrong form displaces the image of a target that is not symmetric.
        """
        good = why == ""
        if good.sum() < _MOST_FIRST:
            return found, why, predicted
        scene, at = self.scene, self.at[wanted]
        mapping = refit(scene.mapping, at[good], found.xy[good], _UNMODELLED_PX)
        change = (slope_of(mapping, at) - slope_of(scene.mapping, at)) @ scene.frame
        size = scene.design.sizes[wanted]
        displaced = stretches(change)[0] * _REACH * size > _RESHAPED_PX
        if not displaced.any():
            return found, why, predicted
        self._learn_from(found, good, wanted)
        among = self.inside & np.isin(self.rows, wanted[displaced])
        some = np.flatnonzero(np.isin(wanted, self.rows[among]))
        again = match_targets(self.scene, self.rows, among)
        better = again.converged & ~(again.noise > _REPEATED * found.noise[some])
        keep = np.ones(len(found), dtype=bool)
        keep[some] = ~better
        found = replaced(found, keep, again.select(better))
        return found, *self._judged(self.scene, wanted, found)

    def curve(self, full_scale: float, stated: ToneCurve | None) -> FoundCurve:
        """The curve between light and grey values.

        It is estimated if the size of the targets suggests that there is one.
        """
        large = self.inside & self.scene.design.large[self.rows]
        dark = self.scene.design.polarity == "dark"
        shrunk = self.growth is not None and self.growth * (1 if dark else -1) < -_SHRUNK
        some = np.zeros(len(self.rows), dtype=bool)
        candidates = np.flatnonzero(large)
        some[candidates[:: max(1, len(candidates) // _MOST_FIRST)]] = True

        def matched(curve: ToneCurve) -> tuple[Samples, Array] | None:
            scene = self.scene if curve.linear else self._linearised(curve, full_scale)
            found = match_targets(scene, self.rows, some, searching=False, residuals=True)
            # Residuals are large, and matches do not count as converged, where the curve is wrong.
            clear = (found.t > self.options.least_t) & np.isfinite(found.xy).all(axis=1)
            if clear.sum() < _LEAST_FIRST:
                return None
            return _samples(scene, self.rows[some][clear], found.select(clear))

        return find_curve(matched, full_scale, stated, suspected=shrunk)

    def linearise(self, curve: ToneCurve, full_scale: float) -> None:
        """Continue with grey values that are proportional to the light, and learn the scene again."""
        self.scene = self._linearised(curve, full_scale)
        self.learn()

    def _linearised(self, curve: ToneCurve, full_scale: float) -> Scene:
        scene = self.scene
        xy = self.predicted[self.rows[self.inside]]
        level, contrast = scene.light.at(xy)
        sign = -1.0 if scene.design.polarity == "dark" else 1.0
        bright = curve.light(level, full_scale)
        amplitude = sign * (curve.light(level + sign * contrast, full_scale) - bright)
        light = Light.through(xy, bright, amplitude, scene.light.size)
        scale = median(amplitude / contrast)
        grey = curve.light(scene.grey, full_scale)
        return replace(scene, grey=grey, light=light, noise=scene.noise * scale)

    def learn(self) -> None:
        """Learn mapping, light and sharpness from some of the large targets, matched first.

        Start between the lines, where the mapping is known, and continue outwards.
        """
        every = max(_MOST_FIRST, int(_FIRST_SHARE * self.inside.sum()))
        # Where many are wanted, a first mapping by fewer of them is sufficient.
        few = _MOST_FIRST if every > 2 * _MOST_FIRST else every
        for beyond, most in ((_BEYOND, few), (np.inf, every)):
            candidates = np.flatnonzero(self.inside & self.scene.design.large[self.rows])
            out = np.abs(self.at[self.rows[candidates]] - self.middle) - self.half
            candidates = candidates[(out <= beyond).all(axis=1)]
            if len(candidates) < _LEAST_FIRST:
                continue
            each = np.linspace(0, len(candidates) - 1, min(most, len(candidates))).astype(np.intp)
            targets = self.rows[candidates[each]]
            predicted = self.predicted
            for _ in range(_MOVES):
                self._learn(np.isin(self.rows, targets) & self.inside)
                if not self._shifted():
                    break
            moved = (self.predicted - predicted)[self.rows[self.inside]]
            if len(moved) and np.abs(moved).max() < _SETTLED_PX:
                break

    def _learn(self, some: Mask) -> None:
        for searching in (False, True):
            first = match_targets(self.scene, self.rows, some, searching=searching, residuals=True)
            sure = first.converged & (first.t > self.options.least_t) & (first.rejected < 0.1)
            if sure.sum() >= max(_LEAST_FIRST, some.sum() // 2):
                break
        if sure.sum() >= _LEAST_FIRST:
            self.spread = self._spread(first, sure, self.rows[some])
            self._learn_from(first, sure, self.rows[some])

    def _spread(self, first: Matches, sure: Mask, rows: Rows) -> Array:
        """Anisotropy of the point-spread function, from the residuals of matched targets."""
        # What lies over a target looks like motion, too.
        some = np.flatnonzero(sure & (first.noise <= median(first.noise[sure])))
        some = some[np.linspace(0, len(some) - 1, min(_MOST_FIRST, len(some))).astype(np.intp)]
        samples, formed = _samples(self.scene, rows[some], first.select(some))
        left = np.where(samples.used, samples.grey - formed, np.nan) / samples.depth[:, None, None]
        place = samples.shape, samples.xy, samples.psf_px, samples.window
        return spread_of(self.scene.path) + anisotropy(*place, left)

    def _shifted(self) -> bool:
        """Adopt the motion during the exposure that was found; whether it is another one than before."""
        path = path_of(self.spread)
        before, self.scene = self.scene, replace(self.scene, path=path)
        change = np.hypot(*(spread_of(path) - spread_of(before.path)))
        if change > _SAME_SPREAD:
            # What is now modelled as motion was part of the blur.
            added = (path @ path - before.path @ before.path) / 24
            variance = max(self.scene.psf_px**2 - float(added), 0.25 * self.scene.psf_px**2)
            self.scene = replace(self.scene, psf_px=float(np.sqrt(variance)))
            self._place()
        return bool(change > _SAME_SPREAD)

    def _learn_from(self, first: Matches, sure: Mask, rows: Rows) -> None:
        """Learn mapping, light and sharpness from matched targets."""
        scene = self.scene
        (h, w), at, xy = scene.grey.shape, self.at[rows[sure]], first.xy[sure]
        # A projectivity that was found at a coarse scale may be a rough one.
        tried = refit(scene.mapping, at, xy, _UNMODELLED_PX), plane_through(at, xy, (h, w))
        mapping = min(tried, key=lambda each: float(np.median(np.abs(images_of(each, at) - xy))))
        # In small blurred targets contrast, sharpness and size can hardly be distinguished.
        large = sure & scene.design.large[rows]
        plain = large if large.sum() >= _LEAST_FIRST else sure
        amplitude = first.contrast * (first.level if scene.design.polarity == "dark" else 1.0)
        light = Light.through(first.xy[plain], first.level[plain], amplitude[plain], scene.light.size)
        psf_px = median(first.psf_px[plain])
        # The light of neighbours was not known well yet: the targets with small residuals give the noise.
        noise = float(np.quantile(first.noise[sure], 0.2))
        self.growth = median(first.form[plain, 0])
        self.scene = replace(scene, mapping=mapping, light=light, psf_px=psf_px, noise=noise)
        self._place()

    def _matched(self) -> Matches:
        """Match all targets, without what hides them; on an uneven background with a curved one if better.

        Where light is reflected over a target, or lies over it as a veil, its contrast differs from the usual
        and changes across it.
        """
        found = match_targets(self.scene, self.rows, self.inside, searching=False)
        found, covered = self._uncovered(found)
        amiss = ~found.converged & ~covered
        if amiss.any():
            found = replaced(found, ~amiss, match_targets(self.scene, self.rows, self._among(amiss)))
        if not found.converged.any():
            return found
        usual = median(found.contrast[found.converged])
        # The contrast itself has a relative standard deviation of 1/t.
        doubt = 4 / np.maximum(found.t, 1.0)
        veiled = found.converged & (np.abs(found.contrast / usual - 1) > _VEILED + doubt)
        for some, slope in ((self._uneasy(found) & ~veiled, None), (veiled, _CONTRAST_SLOPE)):
            some &= ~covered
            if not some.any():
                continue
            among = self._among(some)
            curved = match_targets(self.scene, self.rows, among, background=2, contrast_slope=slope)
            better = curved.converged & ~(curved.noise > (0.9 if slope is None else 0.97) * found.noise[some])
            keep = ~some
            keep[some] = ~better
            found = replaced(found, keep, curved.select(better))
        return found

    def _among(self, some: Mask) -> Mask:
        """Which of all targets are some of those inside the frame."""
        among: Mask = self.inside.copy()
        among[among] = some
        return among

    @staticmethod
    def _uneasy(found: Matches) -> Mask:
        """Targets with larger residuals than the others, or that did not converge."""
        ordinary = median(found.noise[found.converged]) if found.converged.any() else np.inf
        uneasy = ~found.converged | (found.noise > _HIGH_RESIDUALS * ordinary) | (found.rejected > 0.02)
        return np.asarray(uneasy)

    def _uncovered(self, found: Matches) -> tuple[Matches, Mask]:
        """Match targets with large residuals without the pixels that show something in front of them.

        Returns
        -------
        Matches
            Those of targets that are seen well enough replaced.
        ndarray of bool (n,)
            Targets that are hidden: they are seen in part at most, and their windows do not look like them.
        """
        uneasy = self._uneasy(found)
        easy = np.flatnonzero(~uneasy & (found.t > self.options.least_t))
        covered = np.zeros(len(found), dtype=bool)
        if not uneasy.any() or len(easy) < _LEAST_FIRST:
            return found, covered
        xy = self.predicted[self.rows[self.inside]]
        near = scipy.spatial.KDTree(xy[easy]).query(xy[uneasy], k=_NEIGHBOURS)[1]
        level = np.median(found.level[easy][near], axis=1)
        valid, seen = pixels_of_targets(self.scene, self.rows, self._among(uneasy), level)
        some = np.flatnonzero(uneasy)[seen >= _SEEN]
        covered[uneasy] = (seen < _SEEN) & ~(found.correlation[uneasy] > _LIKE)
        found.seen[covered] = seen[covered[uneasy]]
        if not len(some):
            return found, covered
        if not len(some):
            return found, covered
        among = self._among(np.isin(np.arange(len(found)), some))
        again = match_targets(self.scene.through(valid), self.rows, among, searching=False)
        better = again.converged & (again.seen >= _SEEN) & ~(again.noise > _CLEARED * found.noise[some])
        keep = np.ones(len(found), dtype=bool)
        keep[some] = ~better
        return replaced(found, keep, again.select(better)), covered

    def _judged(self, scene: Scene, wanted: Rows, found: Matches) -> tuple[Array, Array]:
        """Reason why each target is rejected, and the positions predicted by the mapping through all."""
        why = reasons_of(self._objections(found), len(wanted))
        mapping, good = scene.mapping, why == ""
        if good.sum() >= _LEAST_FIRST:
            mapping = refit(mapping, self.at[wanted[good]], found.xy[good], _UNMODELLED_PX)
        predicted = images_of(mapping, self.at)
        off = np.hypot(*(found.xy - predicted[wanted]).T)
        # The median distance in a plane is 1.18 standard deviations of a coordinate.
        ordinary = median(off[good]) / 1.18 if good.any() else 0.0
        sigma = np.sqrt(np.trace(found.cov, axis1=1, axis2=2) / 2)
        limit = np.maximum(self.options.neighbour_px, _FAR * np.hypot(ordinary, np.nan_to_num(sigma)))
        for k in np.flatnonzero(good & (off > limit)):
            why[k] = Reason(
                f"{off[k]:.2f} px from the position predicted by all targets together", Code.DEVIATES
            )
        return why, predicted

    def _objections(self, found: Matches) -> list[Objection]:
        """Objections to targets from their own images, the most serious first."""
        o = self.options
        sigma = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=1, axis2=2).max(axis=1), 0))
        sure = found.converged & (found.t > o.least_t)
        indistinct = "no target is distinct from its surroundings"
        if not sure.any():
            return [(np.ones(len(found), dtype=bool), indistinct, Code.LOW_CONTRAST)]
        amplitude = found.contrast * found.level
        width, contrast, noise, usual = (
            median(values[sure]) for values in (found.psf_px, found.contrast, found.noise, amplitude)
        )
        # Light that is added to that of a target changes its contrast, but not its depth.
        pale = np.minimum(np.abs(found.contrast / contrast - 1), np.abs(amplitude / usual - 1))
        # Something beside a target raises its residuals, but changes neither sharpness nor contrast nor size.
        alike = (np.abs(np.log(found.psf_px / width)) < _ALIKE) & (np.abs(found.form[:, 0]) < _ALIKE)
        alike &= np.abs(found.contrast / contrast - 1) < _ALIKE
        unlike = found.noise > np.where(alike, _UNLIKE_BESIDE, _UNLIKE) * noise
        blurred = np.abs(np.log(found.psf_px / width)) > np.log(_BLURRED)
        return [
            (found.seen < _SEEN, "hidden, saturated or beyond the edge of the frame", Code.HIDDEN),
            (~found.converged, "the match did not converge", Code.NOT_CONVERGED),
            (~(found.t >= o.least_t), indistinct, Code.LOW_CONTRAST),
            (found.rejected > 0.1, "partly hidden", Code.HIDDEN),
            (unlike, "the image is not that of the target", Code.UNLIKE),
            (blurred, "sharpness differs from the other targets", Code.BLURRED),
            (pale > _PALE, "contrast differs from the other targets", Code.UNLIKE),
            (np.abs(found.form[:, 0]) > _GROWN, "size differs from the design", Code.UNLIKE),
            (~(sigma <= o.most_sigma_px), "too uncertain", Code.UNCERTAIN),
        ]
