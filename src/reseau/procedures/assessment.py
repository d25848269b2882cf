"""What a calibration is good for: its accuracy in pixels, what the photographs do not cover, what to do next.

The accuracy at a place of the image is the root of the squares of the standard deviation of the projection,
which contains what the points of each image have in common, and of the errors by what is wrong, or by what
the lens could have that its model lacks, as far as that is probable; see :mod:`reseau.bundle.explanations`.
It is a size in pixels, not a test: with many points, a test finds errors that are too small to matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from ..bundle import Cause, Explanation, Result, camera_mapping, explain
from ..bundle.explanations import described
from ..calibration import CameraMapping, ProjectionField, projection_field
from ..calibration.camera import worst
from ..core.data import Array, Mask
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
_CELLS, _EMPTY, _LIT = 12, 0.5, 0.3
"""Cells of a zone along each axis are a third of these; a zone with fewer of them covered is not covered;
share of a zone that a circular image has, from which it is to be covered."""
_ZONES = (
    ("upper left corner", "upper edge", "upper right corner"),
    ("left edge", "middle", "right edge"),
    ("lower left corner", "lower edge", "lower right corner"),
)
_ACROSS = 25
_ENOUGH = 6
"""Fewer images do not show whether the camera is stable and the model fits."""
_STRAIGHT, _PLANE = 15.0, 0.05
"""Tilt, degrees, from which a plane tells the principal distance well; largest thickness of a plane by its
width."""
_STATISTICAL = (
    Code.SIGMAS_DOUBTFUL, Code.CORRELATED, Code.WEAK_GEOMETRY, Code.UNMODELLED, Code.GROSS_ERRORS,
    Code.CAMERA_UNSTABLE,
)  # fmt: skip
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
    total : ProjectionField
        This standard error over the image, with its covariances; the verdict is that of its worst corner.
    circular_deg : float
        Angle from the axis up to which a circular image has rays; 0 where the image fills the frame.
    focal_px : float
        Pixels in a radian at the centre; NaN for parallel rays.
    causes : tuple of Cause
        What is wrong, the most probable first; empty where nothing is.
    images : int
        Number of photographs.
    tilts_deg : (float, float)
        Angles at which the most tilted photographs of a plane target were taken, the largest first; NaN where
        the target is not plane.
    covered : float
        Share of the image, in cells of a twelfth of its width and height, with points.
    uncovered : tuple of str
        Parts of the image with few points.
    next_photograph : NextPose, optional
        Photograph that would help most; none where no photograph lowers the error, or something other than
        the model of the lens is wrong.
    warnings, tests : tuple of Remark
        Warnings that matter to the result, and remarks of the statistical tests whose effect is contained in
        the errors above.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> print(assess(adjust_network(example_network())).lines[0])  # doctest: +ELLIPSIS
    usable to remove visible distortion only: 0.016 px at the centre, 0.48 px in the corners...
    """

    use: Use
    centre_px: float
    corners_px: float
    total: ProjectionField
    circular_deg: float
    focal_px: float
    causes: tuple[Cause, ...]
    images: int
    tilts_deg: tuple[float, float]
    covered: float
    uncovered: tuple[str, ...]
    next_photograph: NextPose | None
    warnings: tuple[Remark, ...]
    tests: tuple[Remark, ...]

    @property
    def fits(self) -> bool:
        """Whether nothing is wrong, but perhaps the standard deviations of the image points."""
        return all(cause.code == "noise" for cause in self.causes)

    @property
    def _to_be_taken_anew(self) -> bool:
        """Whether something is wrong that other photographs or another target would not have."""
        return any(cause.code not in ("noise", "lens", "unknown") for cause in self.causes)

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
        if self.causes:
            first += f"; {_because(self.causes)}"
        elif self.use is Use.NOTHING:
            what = "the corners" if self.centre_px <= _LIMITS[-1][0] else "the camera"
            first += f"; the photographs do not determine {what}"
        else:
            first += "; the model fits"
        # Rounded down: points are in the whole image only where no part is left.
        second = f"points are in {int(100 * self.covered)} % of the image"
        if self.uncovered:
            second += f", and few are in the {_listed(self.uncovered)}: the result is extrapolated there"
        if self.images < _ENOUGH:
            second += f"; {self.images} photographs are few, take 10 or more"
        most, next_most = self.tilts_deg
        # One tilted photograph is not checked by another.
        if next_most < _STRAIGHT:
            tilted = f"{most:.0f}° at most"
            if most >= _STRAIGHT:
                tilted = f"{most:.0f}° in one photograph and by {next_most:.0f}° at most in the others"
            second += f"; the target is seen nearly straight, tilted by {tilted}: tilt it"
        if self.next_photograph is not None:
            then = self.next_photograph
            enough = self.use is Use.MEASUREMENT and not self.uncovered and self.images >= _ENOUGH
            which = "enough for measurement; the next photograph" if enough else "the photograph"
            second += f"; {which} that would help most: {then.words} (then {_two(then.worst_px)} px at most)"
        elif not self.uncovered and not self._to_be_taken_anew:
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
            "causes": [cause.entries() for cause in self.causes],
            "uncovered": list(self.uncovered),
            "next_photograph": None
            if then is None
            else {
                "text": then.words,
                "outline_px": [point for point in then.outline.tolist() if np.isfinite(point).all()],
                "worst_px": then.worst_px,
            },
        }


def assess(result: Result, camera: int = 0, explanation: Explanation | None = None) -> Assessment:
    """Assess a calibration.

    Parameters
    ----------
    result : Result
        The adjustment.
    camera : int
        Row of the camera.
    explanation : Explanation, optional
        What is wrong in the adjustment; by default :func:`reseau.bundle.explain`.

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
    explanation = explain(result) if explanation is None else explanation
    causes = explanation.causes
    field = projection_field(lens, _ACROSS)
    rows_down, columns = field.sigma.shape
    total = replace(field, cov=field.cov + np.nan_to_num(explanation.projection_variance(camera, _ACROSS)))
    centre, corners = float(worst(total.cov)[rows_down // 2, columns // 2]), total.worst_px
    circular = field.reach_deg if field.circular else 0.0
    seen, covered, lit = _covered(result.network.xy[rows], lens, field.circular)
    count, with_points = (
        cells.reshape(3, _CELLS // 3, 3, _CELLS // 3).sum(axis=(1, 3)) for cells in (lit, covered & lit)
    )
    # A zone of which a circular image has little need not be covered.
    share = np.where(count < _LIT * (_CELLS // 3) ** 2, 1.0, with_points / np.maximum(count, 1))
    uncovered = tuple(_ZONES[r][c] for r in range(3) for c in range(3) if share[r, c] < _EMPTY)
    use = next((use for limit, use in _LIMITS if corners <= limit), Use.NOTHING)
    empty = np.repeat(np.repeat(share < _EMPTY, _CELLS // 3, axis=0), _CELLS // 3, axis=1) & ~covered
    anew = any(cause.code not in ("noise", "lens", "unknown") for cause in causes)
    then = next_photograph(result, empty) if camera == 0 and not anew else None
    tests = tuple(remark for remark in result.warnings if remark.code in _STATISTICAL)
    important = tuple(
        remark for remark in result.warnings if remark not in tests and remark.code is not Code.COVERAGE
    )
    slope = lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]
    focal = float("nan") if lens.mapping.parallel else float(np.sqrt(abs(np.linalg.det(slope))))
    images = int((result.fit.usable.images & (result.network.camera_of == camera)).sum())
    tilts = _tilts(result, camera)
    return Assessment(
        use, centre, corners, total, circular, focal, causes, images, tilts, float(seen[lit].mean()),
        uncovered, then, important, tests,
    )  # fmt: skip


def _because(causes: tuple[Cause, ...]) -> str:
    """The first cause in words, what explains alike, how much it is, and what to do."""
    first = causes[0]
    if first.code == "noise":
        return (
            f"the model fits, and image points scatter {first.form} as much as their standard deviations say"
        )
    alike = [cause for cause in causes[1:] if cause.instead]
    text = ", or ".join(described(cause.code) for cause in (first, *alike))
    text += f" ({_two(first.amount_px)} px of the residuals"
    text += f"; {first.where})" if first.where else ")"
    return f"{text}: {first.do}"


def _tilts(result: Result, camera: int) -> tuple[float, float]:
    """The two largest angles between the camera's axis and the normal of a plane target, degrees."""
    unknown = float("nan"), float("nan")
    used = result.fit.usable.images & (result.network.camera_of == camera)
    values = result.fit.values
    points = values.xyz[np.isfinite(values.xyz).all(axis=1)]
    if len(points) < 4 or used.sum() < 2 or camera_mapping(result, camera).mapping.parallel:
        return unknown
    _, size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if size[2] > _PLANE * size[1]:
        return unknown
    cosines = np.sort(np.abs(values.rotation[used, 2] @ axes[2]))[:2]
    most, next_most = np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))).tolist()
    return most, next_most


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


def _two(value: float) -> str:
    """Two significant digits, never with an exponent for large values."""
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}"


def _listed(words: tuple[str, ...]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
