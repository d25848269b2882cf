"""What a calibration is good for: its accuracy in pixels, what the photographs do not cover, what to do next.

The accuracy at a place of the image is the root of the squares of the standard deviation of the projection,
enlarged where the images scatter more than it says, of what the residuals have in common there beyond noise,
and of what the next radial coefficient would change, where it is significant. It is a size in pixels, not a
test: with many points, a test finds errors that are too small to matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from ..bundle import Result, by_place, camera_mapping, common_pattern, image_scatter, lacking
from ..calibration import CameraMapping, projection_field
from ..core.data import Array, Mask
from ..core.errors import UsageError
from ..core.failure import Code, Remark
from .next_pose import NextPose, next_photograph

__all__ = ["Assessment", "Use", "assess", "sorted_remarks"]


class Use(StrEnum):
    """What a calibration is accurate enough for, by its error in the corners of the image."""

    MEASUREMENT = "measurement"  # up to 0.05 px
    RECONSTRUCTION = "reconstruction"  # up to 0.3 px: stereo, poses of objects and robots, models of scenes
    VIEWING = "viewing"  # up to 2 px: images without visible distortion
    NOTHING = "nothing"


_LIMITS = ((0.05, Use.MEASUREMENT), (0.3, Use.RECONSTRUCTION), (2.0, Use.VIEWING))
_FOR = {
    Use.MEASUREMENT: "usable for measurement",
    Use.RECONSTRUCTION: "usable for 3-D reconstruction, stereo and poses, not for precise measurement",
    Use.VIEWING: "usable to remove visible distortion only",
    Use.NOTHING: "not usable",
}
_FITS = 0.02
"""Common residuals (px) below which a model fits for all practical purposes."""
_CELLS, _EMPTY, _LIT = 12, 0.5, 0.3
"""Cells of a zone along each axis are a third of these; a zone with fewer of them covered is not covered;
share of a zone that a circular image has, from which it is to be covered."""
_ZONES = (
    ("upper left corner", "upper edge", "upper right corner"),
    ("left edge", "middle", "right edge"),
    ("lower left corner", "lower edge", "lower right corner"),
)
_ACROSS = 13
_CONTRADICT, _CONTRADICT_PX = 3.0, 0.3
"""Factor by which images scatter more than their points say, and error of the projection in the middle, from
which they are of different cameras. A precise measurement shows scatter that does not matter."""
_ENOUGH = 6
"""Fewer images do not show whether the camera is stable and the model fits."""
_STRAIGHT, _PLANE = 15.0, 0.05
"""Tilt, degrees, from which a plane tells the principal distance well; largest thickness of a plane by its
width."""
_STATISTICAL = (Code.SIGMAS_DOUBTFUL, Code.CORRELATED, Code.WEAK_GEOMETRY)
"""Remarks that concern the statistics; their effect on the result is part of the accuracy."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """What a calibration is good for.

    Parameters
    ----------
    use : Use
        What it is accurate enough for.
    centre_px, corners_px : float
        Standard error of the projection in the middle, and in the worst of the corners; of a circular image,
        in the worst place.
    circular_deg : float
        Angle from the axis up to which a circular image has rays; 0 where the image fills the frame.
    focal_px : float
        Pixels in a radian at the centre; NaN for parallel rays.
    fits : bool
        Whether the camera model describes the residuals but for practically nothing.
    misfit_px : float
        What the residuals have in common beyond noise, root mean square.
    lacks : str
        Radial coefficient that the camera lacks and the residuals need; empty where there is none.
    lacks_px : float
        What it changes in the corners.
    scatter : float
        Factor by which the images scatter more than the standard deviations say; at least 1.
    images : int
        Number of photographs.
    tilt_deg : float
        Largest angle at which a plane target was seen, but for one photograph; NaN where it is not plane.
    covered : float
        Share of the image, in cells of a twelfth of its width and height, with points.
    uncovered : tuple of str
        Parts of the image with few points.
    next_photograph : NextPose, optional
        Photograph that would help most; none where no photograph lowers the error, or the photographs
        contradict each other.
    compared : bool
        Whether the camera model is the best of several.
    warnings, tests : tuple of Remark
        Warnings that matter to the result, and remarks of the statistical tests whose effect is contained in
        the errors above.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> print(assess(adjust_network(example_network())).lines[0])  # doctest: +ELLIPSIS
    usable to remove visible distortion only: 0.019 px at the centre, 0.42 px in the corners...
    """

    use: Use
    centre_px: float
    corners_px: float
    circular_deg: float
    focal_px: float
    fits: bool
    misfit_px: float
    lacks: str
    lacks_px: float
    scatter: float
    images: int
    tilt_deg: float
    covered: float
    uncovered: tuple[str, ...]
    next_photograph: NextPose | None
    compared: bool
    warnings: tuple[Remark, ...]
    tests: tuple[Remark, ...]

    @property
    def contradicts(self) -> bool:
        """Whether the photographs are not of one camera and one target, so that more of them do not help."""
        return _contradict(self.scatter, self.centre_px)

    @property
    def _held_wrongly(self) -> bool:
        """Whether points of the target are held that the images show elsewhere, with an effect."""
        doubtful = any(remark.code is Code.DOUBTFUL_CONTROL for remark in self.warnings)
        return doubtful and self.use is not Use.MEASUREMENT

    @property
    def lines(self) -> tuple[str, str]:
        """The verdict in two lines."""
        first = f"{_FOR[self.use]}: "
        if np.isfinite(self.corners_px):
            first += f"{_two(self.centre_px)} px at the centre, {_two(self.corners_px)} px "
            first += (
                f"up to {self.circular_deg:.0f}° from the axis" if self.circular_deg else "in the corners"
            )
            far = 1e3 * self.corners_px / self.focal_px
            first += f" ({_two(far)} mm at 1 m)" if np.isfinite(far) else ""
        else:
            first += "the projection is not determined in the corners"
        if self._held_wrongly:
            first += "; the target is not as its points are held"
        elif self.contradicts:
            first += f"; the photographs contradict each other, by {_two(self.scatter)} times their sigmas"
        elif not self.fits:
            more = f" and lacks {self.lacks}" if self.lacks else ""
            if self.compared:
                why = "see that focus and zoom stay and the target is stiff"
            else:
                why = "try --model auto"
            first += f"; the model does not fit by {_two(self.misfit_px)} px{more}: {why}"
        elif self.lacks_px > _FITS:
            do = "estimate it too" if self.compared else "try --model auto"
            where = "at the margin" if self.circular_deg else "in the corners"
            first += f"; the model lacks {self.lacks} ({_two(self.lacks_px)} px {where}): {do}"
        elif self.use is Use.NOTHING:
            what = "the corners" if self.centre_px <= _LIMITS[-1][0] else "the camera"
            first += f"; the photographs do not determine {what}"
        else:
            first += f"; the model fits (to {_rounded(self.misfit_px)})"
        # Rounded down: points are in the whole image only where no part is left.
        second = f"points are in {int(100 * self.covered)} % of the image"
        if self.uncovered:
            second += f", and few are in the {_listed(self.uncovered)}: the result is extrapolated there"
        if self.images < _ENOUGH:
            second += f"; {self.images} photographs are few, take 10 or more"
        if self.tilt_deg < _STRAIGHT:
            second += f"; the target is seen nearly straight, tilted by {self.tilt_deg:.0f}° at most: tilt it"
        if self._held_wrongly:
            second += "; see the warning, then calibrate anew"
        elif self.contradicts:
            second += "; take them anew: focus, zoom, stabilisation or the target changed between them"
        elif self.next_photograph is not None:
            then = self.next_photograph
            enough = self.use is Use.MEASUREMENT and not self.uncovered and self.images >= _ENOUGH
            which = "enough for measurement; the next photograph" if enough else "the photograph"
            second += f"; {which} that would help most: {then.words} (then {_two(then.worst_px)} px at most)"
        elif not self.uncovered:
            enough = self.use is Use.MEASUREMENT
            second += "; no further photograph " + ("is needed" if enough else "alone lowers these errors")
        return first, second

    def entries(self) -> dict[str, Any]:
        """Entries for a document.

        Examples
        --------
        >>> from reseau.bundle import adjust_network, example_network
        >>> list(assess(adjust_network(example_network())).entries())[:3]
        ['use', 'lines', 'centre_px']
        """
        then = self.next_photograph
        return {
            "use": self.use.value,
            "lines": list(self.lines),
            "centre_px": self.centre_px,
            "corners_px": self.corners_px if np.isfinite(self.corners_px) else None,
            "fits": self.fits,
            "misfit_px": self.misfit_px,
            "lacks": self.lacks or None,
            "lacks_px": self.lacks_px,
            "scatter": self.scatter,
            "uncovered": list(self.uncovered),
            "next_photograph": None
            if then is None
            else {
                "text": then.words,
                "outline_px": [point for point in then.outline.tolist() if np.isfinite(point).all()],
                "worst_px": then.worst_px,
            },
        }


def assess(result: Result, camera: int = 0, *, compared: bool = False) -> Assessment:
    """Assess a calibration.

    Parameters
    ----------
    result : Result
        The adjustment.
    camera : int
        Row of the camera.
    compared : bool
        Whether its model is the best of several.

    Raises
    ------
    UsageError
        When the camera has no mapping of its own.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> assess(adjust_network(example_network())).uncovered
    ()
    """
    lens = camera_mapping(result, camera)
    used = result.fit.usable.observations & ~result.rejected
    rows = np.flatnonzero(used & (result.network.camera_of[result.network.image_of] == camera))
    field, factor = projection_field(lens, _ACROSS), _enlarged(result, camera)
    rows_down, columns = field.sigma.shape
    centre, corners = factor * field.sigma[rows_down // 2, columns // 2], factor * field.worst_px
    circular = field.reach_deg if field.circular else 0.0
    seen, covered, lit = _covered(result.network.xy[rows], lens, field.circular)
    count, with_points = (
        cells.reshape(3, _CELLS // 3, 3, _CELLS // 3).sum(axis=(1, 3)) for cells in (lit, covered & lit)
    )
    # A zone of which a circular image has little need not be covered.
    share = np.where(count < _LIT * (_CELLS // 3) ** 2, 1.0, with_points / np.maximum(count, 1))
    uncovered = tuple(_ZONES[r][c] for r in range(3) for c in range(3) if share[r, c] < _EMPTY)
    misfit, at_centre, at_corners, chance = _misfits(result, camera, lens)
    more = lacking(result, camera)
    lacks, lacks_centre, lacks_px = "", 0.0, 0.0
    if more is not None and more.significant and np.isfinite(corners):
        lacks, lacks_centre, lacks_px = more.name, more.centre_px, more.corners_px
    centre = float(np.linalg.norm([centre, at_centre, lacks_centre]))
    corners = float(np.linalg.norm([corners, at_corners, lacks_px]))
    fits = misfit <= _FITS or chance > 0.01
    use = next((use for limit, use in _LIMITS if corners <= limit), Use.NOTHING)
    empty = np.repeat(np.repeat(share < _EMPTY, _CELLS // 3, axis=0), _CELLS // 3, axis=1) & ~covered
    then = next_photograph(result, empty) if camera == 0 and not _contradict(factor, centre) else None
    few = _few_gross_errors(result, len(rows))
    tests = tuple(
        remark
        for remark in result.warnings
        if remark.code in _STATISTICAL
        or (remark.code is Code.GROSS_ERRORS and few)
        or (remark.code is Code.UNMODELLED and fits)
    )
    important = tuple(
        remark for remark in result.warnings if remark not in tests and remark.code is not Code.COVERAGE
    )
    slope = lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]
    focal = float("nan") if lens.mapping.parallel else float(np.sqrt(abs(np.linalg.det(slope))))
    images = int((result.fit.usable.images & (result.network.camera_of == camera)).sum())
    tilt = _tilted(result, camera)
    return Assessment(
        use, centre, corners, circular, focal, fits, misfit, lacks, lacks_px, factor, images, tilt,
        float(seen[lit].mean()), uncovered, then, compared, important, tests,
    )  # fmt: skip


def _contradict(scatter: float, centre_px: float) -> bool:
    """Whether photographs are not of one camera and one target; see :class:`Assessment`."""
    return scatter >= _CONTRADICT and centre_px > _CONTRADICT_PX


def _tilted(result: Result, camera: int) -> float:
    """Second largest angle between the camera's axis and the normal of a plane target, degrees."""
    used = result.fit.usable.images & (result.network.camera_of == camera)
    values = result.fit.values
    points = values.xyz[np.isfinite(values.xyz).all(axis=1)]
    if len(points) < 4 or used.sum() < 2 or camera_mapping(result, camera).mapping.parallel:
        return float("nan")
    _, size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if size[2] > _PLANE * size[1]:
        return float("nan")
    cosines = np.abs(values.rotation[used, 2] @ axes[2])
    return float(np.degrees(np.arccos(np.clip(np.sort(cosines)[1], 0.0, 1.0))))


def sorted_remarks(
    result: Result, assessments: Iterable[Assessment]
) -> tuple[tuple[Remark, ...], tuple[Remark, ...]]:
    """Warnings about an adjustment, and remarks of tests whose effect the errors of all cameras contain.

    Parameters
    ----------
    result : Result
        The adjustment.
    assessments : iterable of Assessment
        Those of its cameras. Without any, all remarks are warnings.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> len(sorted_remarks(result, ())[0]) == len(result.warnings)
    True
    """
    every = tuple(assessments)
    if not every:
        return tuple(result.warnings), ()
    tests = tuple(remark for remark in result.warnings if all(remark in each.tests for each in every))
    # What is not covered is part of the verdict.
    rest = (remark for remark in result.warnings if remark not in tests)
    return tuple(remark for remark in rest if remark.code is not Code.COVERAGE), tests


def _covered(xy: Array, lens: CameraMapping, circular: bool) -> tuple[Mask, Mask, Mask]:
    """Cells of the image that have points; that have points or a neighbour that has; that have an image."""
    cell = np.clip((xy / np.array(lens.size) * _CELLS).astype(int), 0, _CELLS - 1)
    seen = np.zeros((_CELLS + 2, _CELLS + 2), dtype=np.bool_)
    seen[1 + cell[:, 1], 1 + cell[:, 0]] = True
    shifts = [(i, k) for i in range(3) for k in range(3) if 1 in (i, k)]
    near = [seen[i : i + _CELLS, k : k + _CELLS] for i, k in shifts]
    lit = np.ones((_CELLS, _CELLS), dtype=np.bool_)
    if circular:
        middles = (np.indices((_CELLS, _CELLS))[::-1].reshape(2, -1).T + 0.5) / _CELLS * lens.size
        lit[:] = np.isfinite(lens.mapping.inverse(middles)).all(axis=1).reshape(lit.shape)
    return seen[1:-1, 1:-1], np.asarray(np.any(near, axis=0), dtype=np.bool_), lit


def _enlarged(result: Result, camera: int) -> float:
    """Factor by which the images scatter more than their standard deviations say; at least 1."""
    found = image_scatter(result, camera)
    return max(1.0, found) if np.isfinite(found) else 1.0


def _misfits(result: Result, camera: int, lens: CameraMapping) -> tuple[float, float, float, float]:
    """Common residuals beyond noise: of the whole image, near its centre and its corners; probability."""
    try:
        pattern = common_pattern(result, by_place(result, camera))
    except UsageError:
        return 0.0, 0.0, 0.0, 1.0
    size = np.array(lens.size)
    radius = np.linalg.norm(2 * (pattern.xy + 0.5) / size - 1, axis=1) / np.sqrt(2)
    excess = ((pattern.shift**2).sum(axis=1) - pattern.cov[:, [0, 1], [0, 1]].sum(axis=1)) / 2

    def rms(rows: Mask) -> float:
        return float(np.sqrt(max(excess[rows].mean(), 0.0))) if rows.sum() > 3 else pattern.rms

    if pattern.p > 0.01:
        return pattern.rms, 0.0, 0.0, pattern.p
    return pattern.rms, rms(radius < 0.4), max(pattern.rms, rms(radius > 0.7)), pattern.p


def _few_gross_errors(result: Result, count: int) -> bool:
    """Whether fewer than a hundredth of the image points have test values above the limit of snooping."""
    w = result.test_values[~result.rejected]
    return bool((np.nan_to_num(w) > 4).sum() < max(0.01 * count, 5))


def _two(value: float) -> str:
    """Two significant digits, never with an exponent for large values."""
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}"


def _rounded(value: float) -> str:
    return "0.001 px" if value < 0.001 else f"{value:.1g} px"


def _listed(words: tuple[str, ...]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
