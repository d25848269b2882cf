"""What a calibration is good for: its accuracy in pixels, what the photographs do not cover, what to do next.

The accuracy at a place of the image is the root of the squares of the standard deviation of the projection,
which contains what the points of each image have in common, and of the errors by what is wrong, or by what
the lens could have that its model lacks, as far as that is probable; see :mod:`reseau.bundle.explanations`.
It is a size in pixels, not a test: with many points, a test finds errors that are too small to matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np

from ..bundle import Result, explain
from ..bundle.diagnostics.fields import camera_mapping
from ..bundle.explanations.explain import Explanation
from ..bundle.explanations.sentences import described
from ..calibration import CameraMapping, Cause, projection_field
from ..calibration.assessment import Assessment, ErrorMap, Use, two_digits
from ..core.data import Array, Mask
from ..core.failure import Code, Remark
from ..core.numbers import or_null
from .next_pose import next_photograph

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
    rows = result.used_by(camera)
    explanation = explain(result) if explanation is None else explanation
    field = projection_field(lens, _ACROSS)
    formal = projection_field(camera_mapping(result, camera, formal=True), _ACROSS).sigma
    total = replace(field, cov=field.cov + np.nan_to_num(explanation.projection_variance(camera, _ACROSS)))
    rows_down, columns = field.sigma.shape
    cover = _Cover.of(result.network.xy[rows], lens, field.circular)
    anew = any(cause.code not in ("noise", "lens", "unknown") for cause in explanation.causes)
    found = Assessment(
        use=Use.of(total.worst_px),
        lines=(),
        centre_px=float(total.sigma[rows_down // 2, columns // 2]),
        corners_px=or_null(total.worst_px),
        circular_deg=field.reach_deg if field.circular else 0.0,
        causes=explanation.causes,
        images=int((result.fit.usable.images & (result.network.camera_of == camera)).sum()),
        tilts_deg=_tilts(result, camera),
        covered=cover.share,
        uncovered=cover.uncovered,
        next_photograph=next_photograph(result, cover.empty) if camera == 0 and not anew else None,
        errors=ErrorMap.of(total.xy, total.sigma, formal),
    )
    slope = lens.mapping.derivatives(np.zeros((1, 2))).d_xy[0]
    focal = float("nan") if lens.mapping.parallel else float(np.sqrt(abs(np.linalg.det(slope))))
    return found.model_copy(update={"lines": (_verdict(found, focal), _what_next(found, anew))})


def _verdict(found: Assessment, focal_px: float) -> str:
    """The verdict in one line: use, errors, causes."""
    text = found.short
    if found.corners_px is not None and np.isfinite(focal_px):
        text += f" ({two_digits(1e3 * found.corners_px / focal_px)} mm at 1 m)"
    if found.causes:
        return f"{text}; {_because(found.causes)}"
    if found.use is Use.NOTHING:
        what = "the corners" if found.centre_px <= Use.VIEWING.limit_px else "the camera"
        return f"{text}; the photographs do not determine {what}"
    return f"{text}; the model fits"


def _what_next(found: Assessment, anew: bool) -> str:
    """What the photographs cover, and what to photograph next; `anew` where others would not help."""
    assert found.covered is not None
    assert found.images is not None
    # Rounded down: points are in the whole image only where no part is left.
    text = f"points are in {int(100 * found.covered)} % of the image"
    if found.uncovered:
        text += f", and few are in the {_listed(found.uncovered)}: the result is extrapolated there"
    if found.images < _ENOUGH:
        text += f"; {found.images} photographs are few, take 10 or more"
    if found.tilts_deg is not None and found.tilts_deg[1] < _STRAIGHT:
        # One tilted photograph is not checked by another.
        most, next_most = found.tilts_deg
        tilted = f"{most:.0f}° at most"
        if most >= _STRAIGHT:
            tilted = f"{most:.0f}° in one photograph and by {next_most:.0f}° at most in the others"
        text += f"; the target is seen nearly straight, tilted by {tilted}: tilt it"
    then = found.next_photograph
    if then is not None:
        enough = found.use is Use.MEASUREMENT and not found.uncovered and found.images >= _ENOUGH
        which = "enough for measurement; the next photograph" if enough else "the photograph"
        text += f"; {which} that would help most: {then.text}"
        return f"{text} (σ then {two_digits(then.worst_px)} px at most)"
    if found.uncovered or anew:
        return text
    return f"{text}; no further photograph " + (
        "is needed" if found.use is Use.MEASUREMENT else "alone lowers these errors"
    )


def _because(causes: tuple[Cause, ...]) -> str:
    """The first cause in words, what explains alike, how much it is, and what to do."""
    first = causes[0]
    if first.code == "noise":
        return (
            f"the model fits, and image points scatter {first.form} as much as their standard deviations say"
        )
    alike = [cause for cause in causes[1:] if cause.instead]
    text = ", or ".join(described(cause.code, cause.form) for cause in (first, *alike))
    text += f" ({two_digits(first.amount_px)} px of the residuals"
    text += f"; {first.where})" if first.where else ")"
    return f"{text}: {first.do}"


def _tilts(result: Result, camera: int) -> tuple[float, float] | None:
    """The two largest angles between the camera's axis and the normal of a plane target, degrees."""
    used = result.fit.usable.images & (result.network.camera_of == camera)
    values = result.fit.values
    points = values.xyz[np.isfinite(values.xyz).all(axis=1)]
    if len(points) < 4 or used.sum() < 2 or camera_mapping(result, camera).mapping.parallel:
        return None
    _, size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if size[2] > _PLANE * size[1]:
        return None
    cosines = np.sort(np.abs(values.rotation[used, 2] @ axes[2]))[:2]
    most, next_most = np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))).tolist()
    return most, next_most


def sorted_remarks(
    remarks: Iterable[Remark], *, assessed: bool = True
) -> tuple[tuple[Remark, ...], tuple[Remark, ...]]:
    """Warnings about an adjustment, and remarks of tests whose effect its verdict contains.

    What is not covered is left out: the verdict says it.

    Parameters
    ----------
    remarks : iterable of Remark
        Those of the adjustment.
    assessed : bool
        Whether there is a verdict. Without one, all remarks are warnings.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> len(sorted_remarks(result.warnings, assessed=False)[0]) == len(result.warnings)
    True
    """
    every = tuple(remarks)
    if not assessed:
        return every, ()
    tests = tuple(remark for remark in every if remark.code in _STATISTICAL)
    left = (remark for remark in every if remark.code not in _STATISTICAL)
    return tuple(remark for remark in left if remark.code is not Code.COVERAGE), tests


class _Cover(NamedTuple):
    """What the points of a camera cover: share of the image, parts that have few, cells without."""

    share: float
    uncovered: tuple[str, ...]
    empty: Mask

    @classmethod
    def of(cls, xy: Array, lens: CameraMapping, circular: bool) -> Self:
        seen, covered, lit = _covered(xy, lens, circular)
        count, with_points = (
            cells.reshape(3, _CELLS // 3, 3, _CELLS // 3).sum(axis=(1, 3)) for cells in (lit, covered & lit)
        )
        # A zone of which a circular image has little need not be covered.
        share = np.where(count < _LIT * (_CELLS // 3) ** 2, 1.0, with_points / np.maximum(count, 1))
        uncovered = tuple(_ZONES[r][c] for r in range(3) for c in range(3) if share[r, c] < _EMPTY)
        cells = np.repeat(np.repeat(share < _EMPTY, _CELLS // 3, axis=0), _CELLS // 3, axis=1)
        return cls(float(seen[lit].mean()), uncovered, cells & ~covered)


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


def _listed(words: tuple[str, ...]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
