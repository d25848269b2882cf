"""Windows around the marks of a plane target: what is known of their images, and matching with these.

The image of every mark is formed with the mapping through all marks, to second order. The estimate is
therefore the image of its point, not the centre of its image. What differs between kinds of marks are the
images themselves, which :class:`MarkWindows` leaves to its subclasses.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Frame, Mask, Rows
from ...optics.composition import Chain
from ...optics.formation import PixelResponse
from ..matching import Matches, Shape, match
from ..matching.patches import MatchOptions, windows
from ..matching.shapes import ShapeSubset, Window
from ..response import FilteredShape, Samples
from ..screening import Screened
from ..testfield.targets import merged
from .marks import ReseauOptions

_CLASS_PX = 4
"""Step of the window sizes."""
_GROUND_PX, _GROUND_WIDTHS = 5, 3.0
"""Background shown by a window around its mark: pixels, and widths of the point-spread function."""
_AT_ONCE_PX = 70_000
"""Number of pixels of windows matched together: what is formed in them takes some 8 MB."""
_SHARED_PX = 8_000
"""Number of pixels whose matching takes as long as what windows of one more size take beside it."""
_LEARNT_FROM = 120
"""Most marks from which mapping and appearance are learnt first."""
_SLOPE = 0.3
"""Standard deviation of the change of contrast from the centre of a mark to the edge of its window, caused by
reflected light."""
SEEN = 0.6
"""Least share of a mark on pixels that can be used."""
DISTURBED = 1.6
"""Multiple of the usual residuals from which a mark is declined."""
_HIDING = 6.0
"""Residuals, in units of the noise, from which something large lies in front of a mark: no search for single
blunders finds the mark, but another look without what its neighbours do not predict. Reflected light leaves
less."""
_LIKELY = 0.7
"""Correlation with the formed image from which a mark that was not found at first is looked for."""
ENOUGH = 6
"""Least number of reliable marks from which something is learnt."""
BESIDE = 0.05
"""Share of a pixel from which other ink hides it from the matching; the light of fainter tails is
subtracted."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of the marks of this frame.

    Examples
    --------
    >>> Appearance(0.7, 0.5, 1.0, np.zeros(0), None, None, 0.7, None, None).psf_px
    0.7
    """

    psf_px: float
    psf_log_sigma: float
    size: float
    form_sigma: Array
    variance: tuple[float, float] | None
    kernel: Array | None
    """Of motion or sharpening, see :mod:`reseau.measure.response`."""
    blur_px: float
    """Width of the point-spread function with the kernel."""
    contrast: Array | None
    """Contrast (n,) of each mark of the design."""
    light: Array | None
    """Grey values (n,) that full ink adds at each mark of the design; negative for dark ink."""


@dataclass(frozen=True, eq=False)
class Located:
    """Where the marks of a design are in a frame, approximately.

    Parameters
    ----------
    ids : tuple of str (n,)
        Names of the marks.
    xy : ndarray (n, 2)
        Their coordinates in the plane of the design.
    polarity : {"dark", "bright"}
        Of the marks.
    mapping : Chain
        Mapping from lattice coordinates to the image.
    frame, origin : ndarray (2, 2), (2,)
        Lattice coordinates are `frame` times those of the design, plus `origin`.
    found : ndarray of bool (n,)
        Marks that were found.
    start : ndarray (n, 2)
        Where they were found; for others any value.

    Examples
    --------
    >>> from reseau.measure.plane.lattice_mapping import started
    >>> plain, two = started(np.eye(3), 1, (480, 640)), np.array([[0.0, 0.0], [1.0, 0.0]])
    >>> all_found = np.ones(2, dtype=bool)
    >>> Located(("a", "b"), two, "dark", plain, np.eye(2), np.zeros(2), all_found, 100 * two).at[1]
    array([1., 0.])
    """

    ids: tuple[str, ...]
    xy: Array
    polarity: Literal["dark", "bright"]
    mapping: Chain
    frame: Array
    origin: Array
    found: Mask
    start: Array

    @property
    def at(self) -> Array:
        """Lattice coordinates (n, 2)."""
        return np.asarray(self.xy @ self.frame.T + self.origin)


class MarkWindows(ABC):
    """The marks of a frame, what is known of them, and their matching.

    Parameters
    ----------
    image : Frame
        The frame.
    screened : Screened
        Its grey values as they are matched.
    located : Located
        The marks.
    options : ReseauOptions
        Options of the measurement.
    size : float
        Size of a mark in the unit of the design.
    """

    word: ClassVar[str]
    """What a mark is called in messages."""
    form_sigma: ClassVar[Array]
    """Standard deviations of the parameters of the form, before anything is learnt."""
    learnt_form_sigma: ClassVar[Array]
    """The same for marks whose common size is known."""
    learnt_from: ClassVar[int] = _LEARNT_FROM
    """Most marks from which mapping and appearance are learnt first."""
    sampled: int = 20
    """Most marks that show the camera's response."""
    precise_start: ClassVar[bool] = False
    """Whether marks are found so precisely that a match can continue from what is known of them."""
    eccentric: ClassVar[bool] = False
    """Whether the mapping moves the centres of images so much that marks are matched again with the
    one through all of them."""
    even: ClassVar[bool] = False
    """Whether images of marks are even about their points."""
    least_seen: ClassVar[float] = SEEN
    """Least share of a mark on pixels that can be used."""
    bounded: ClassVar[bool] = False
    """Whether a window may be larger than its mark needs: :meth:`_region` excludes what else it shows."""
    curve_first: ClassVar[bool] = False
    """Whether a curve between light and grey values is looked for before motion and sharpening."""

    def __init__(
        self, image: Frame, screened: Screened, located: Located, options: ReseauOptions, size: float
    ) -> None:
        self.image, self.screened, self.options = image, screened, options
        self.ids, self.xy, self.polarity = located.ids, located.xy, located.polarity
        self.frame, self.mapping, self.origin = located.frame, located.mapping, located.origin
        self.at, self.found = located.at, located.found
        self.start = np.where(self.found[:, None], located.start, self.mapping(self.at))
        self.look = Appearance(
            options.psf_px, 0.5, size, self.form_sigma, None, None, options.psf_px, None, None
        )
        self.hidden = np.zeros(screened.grey.shape, dtype=bool)
        self.learning = True
        self.quick = self.precise_start  # whether marks are matched without a search for blunders
        self.searching = _HIDING if self.precise_start else np.inf  # see :func:`match`
        self.own_px = np.zeros(len(self.at))  # pixels of the windows that belong to marks, matched last
        self.matched_beside: Array | None = None  # see `beside`, when marks were matched last
        self.rough = 0.0  # residuals of the marks that were learnt from
        self._cleared: tuple[Array, Mask] | None = None  # see `_clear`

    @abstractmethod
    def _images(self, rows: Rows) -> tuple[Shape, Array]:
        """Images of marks around the images of their points, and half their width and height (k, 2)."""

    @abstractmethod
    def settle(self, first: Matches) -> Matches:
        """Learn sharpness and size; the form of the matches refers to the new size."""

    @abstractmethod
    def radius(self, rows: Rows) -> Array:
        """Half the mean extent (k,) of marks in the image."""

    @property
    def balanced(self) -> bool:
        """Whether a curve between light and grey values shifts no mark: edges of all directions alike."""
        return self.even

    @property
    def surrounded(self) -> bool:
        """Whether there is other ink of the target beside marks."""
        return False

    def beside(self) -> Array | None:
        """Share (h, w) of each pixel that other ink of the target takes."""
        return None

    def _region(self, rows: Rows, half: tuple[int, int]) -> Mask | None:
        """Pixels (k, rows, columns) of the windows that belong to the marks; None for all."""
        return None

    def match(self, rows: Rows, background: int = 2, influence: bool = False) -> Matches:
        """Match disks, grouped by window size."""
        images, reach = self._images(rows)
        beside = self.matched_beside = self.beside()
        # In a large frame every copy takes time.
        valid = self.screened.valid & ~self.hidden if self.hidden.any() else self.screened.valid
        if beside is not None:
            valid = valid & self._clear(beside)
        parts, found = [], []
        for part, half in self._windows(reach):
            region = self._region(rows[part], half)
            here = None if beside is None else self._cut(beside, rows[part], half)
            self.own_px[rows[part]] = float((2 * np.array(half) + 1).prod())
            if region is not None:
                # What is printed there is known, and the same around every mark.
                region = region if here is None else region & (np.abs(here) < BESIDE)
                self.own_px[rows[part]] = region.sum(axis=(1, 2))
            options = MatchOptions(
                half_px=half,
                psf_px=self.look.psf_px,
                psf_log_sigma=self.look.psf_log_sigma,
                response=PixelResponse(self.options.fill),
                polarity=self.polarity,
                row_jitter_px=self.options.row_jitter_px,
                settled=0.05,
                influence=influence,
                contrast=None if self.look.contrast is None else self.look.contrast[rows[part]],
                contrast_slope=_SLOPE,
                background=background,
                variance=self.look.variance,
            )
            found.append(
                match(
                    self.screened.grey,
                    valid,
                    self._shape(images, part),
                    self.start[rows[part]],
                    options,
                    noise=max(self.screened.noise, self.rough),
                    form_sigma=self._form_sigma(),
                    light=self._known_light(rows[part], background),
                    precise=self.quick,
                    searching=self.searching,
                    others=self._light_of(here, rows[part]),
                    region=region,
                    least=(np.where(self.found[rows[part]], -1.0, _LIKELY), self.least_seen),
                )
            )
            parts.append(part)
        return merged(parts, found)

    def _clear(self, beside: Array) -> Mask:
        """Pixels (h, w) of which other ink takes nearly nothing."""
        if self._cleared is None or self._cleared[0] is not beside:
            self._cleared = beside, (beside < BESIDE) & (beside > -BESIDE)
        return self._cleared[1]

    def _cut(self, values: NDArray[Any], rows: Rows, half: tuple[int, int]) -> NDArray[Any]:
        """Values (k, r, c) of a frame in the windows of marks."""
        return windows(values, np.rint(self.start[rows]).astype(np.intp), half)

    def _form_sigma(self) -> Array:
        """Standard deviations of the parameters of the form."""
        return self.look.form_sigma

    def _shape(self, images: Shape, part: Rows) -> Shape:
        """Images of some of the marks."""
        plain = ShapeSubset(images, part)
        return plain if self.look.kernel is None else FilteredShape(plain, self.look.kernel)

    def _windows(self, reach: Array) -> Iterator[tuple[Rows, tuple[int, int]]]:
        """Marks with windows of one size, not too many, and half their width and height."""
        ground = max(_GROUND_PX, int(np.ceil(_GROUND_WIDTHS * self.look.blur_px)))
        sizes, of = np.unique(np.ceil(reach / _CLASS_PX).astype(np.intp), axis=0, return_inverse=True)
        of = of.ravel()
        sides = 2 * (sizes * _CLASS_PX + ground) + 1
        if self.bounded:
            sides, joined = _joined(sides, np.bincount(of))
            of = joined[of]
        for k, side in enumerate(sides):
            part = np.flatnonzero(of == k)
            some = max(1, int(_AT_ONCE_PX // side.prod()))
            for piece in np.array_split(part, -(-len(part) // some)):
                yield piece, (int(side[0] // 2), int(side[1] // 2))

    def pixels(self, rows: Rows, half: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Columns (k, 1, c) and rows (k, r, 1) of the windows of marks, within the frame."""
        window, (h, w) = self.window(rows, half), self.screened.grey.shape
        x, y = (
            np.clip(axis, 0, last).astype(np.intp)
            for axis, last in ((window.columns, w - 1), (window.rows, h - 1))
        )
        return x[:, None, :], y[:, :, None]

    def window(self, rows: Rows, half: tuple[int, int]) -> Window:
        """Windows of marks; they may extend beyond the frame."""
        centre: Array = np.rint(self.start[rows])
        columns, lines = (centre[:, k, None] + np.arange(-half[k], half[k] + 1.0) for k in (0, 1))
        return Window(columns, lines, PixelResponse(self.options.fill))

    def _known_light(self, rows: Rows, background: int) -> tuple[Array, Array] | None:
        """Contrast and background from which the match of marks continues."""
        look = self.look
        if not self.precise_start or look.contrast is None or look.light is None:
            return None
        ground = np.zeros((len(rows), (background + 1) * (background + 2) // 2))
        ground[:, 0] = np.abs(look.light[rows] / look.contrast[rows])
        return look.contrast[rows], ground

    def _light_of(self, beside: Array | None, rows: Rows) -> Array | None:
        """Light (k, rows, columns) that other ink, its share in the windows given, takes there."""
        light = self.look.light
        if light is None or beside is None:
            return None
        return np.asarray(beside * light[rows, None, None])

    def depth(self, found: Matches) -> Array:
        """Grey values (k,) that ink adds."""
        return np.asarray(found.contrast * (-found.level if self.polarity == "dark" else 1))

    def samples(self, first: Matches, rows: Rows) -> tuple[Samples, Array]:
        """Matched marks in windows of one size, and their adjusted images."""
        images, reach = self._images(rows)
        high, wide = (n // 2 for n in first.residuals.shape[1:])
        size = np.max([half for _, half in self._windows(reach)], axis=0)
        half = int(min(size[0], wide)), int(min(size[1], high))
        x, y = self.pixels(rows, half)
        centre = slice(high - half[1], high + half[1] + 1), slice(wide - half[0], wide + half[0] + 1)
        residuals = first.residuals[:, *centre]
        grey = self.screened.grey[y, x].astype(np.float64)
        # What was subtracted when they were matched.
        beside = self.matched_beside
        if beside is not None and (others := self._light_of(beside[y, x], rows)) is not None:
            grey -= others
        every = np.arange(len(rows))
        samples = Samples(
            self._shape(images, every),
            first.xy,
            first.psf_px,
            first.form,
            self.depth(first),
            self.window(rows, half),
            grey,
            np.isfinite(residuals),
        )
        return samples, grey + np.nan_to_num(residuals)


def _joined(sides: Rows, count: Rows) -> tuple[Rows, Rows]:
    """Sizes (m, 2) that serve `count` (k,) windows of the sizes (k, 2), and which one serves each."""
    of = np.arange(len(sides))
    while len(sides) > 1:
        both = np.maximum(sides[:, None], sides)
        area = count * sides.prod(axis=1)
        more = (count[:, None] + count) * both.prod(axis=2) - area[:, None] - area
        more[np.arange(len(sides)), np.arange(len(sides))] = _SHARED_PX
        one, two = sorted(divmod(int(more.argmin()), len(sides)))
        if more[one, two] >= _SHARED_PX:
            break
        sides, count = sides.copy(), count.copy()
        sides[one], count[one] = both[one, two], count[one] + count[two]
        sides, count = np.delete(sides, two, axis=0), np.delete(count, two)
        of = np.where(of == two, one, of - (of > two))
    return sides, of
