"""The camera of a roll of film from the corners of its frames: calibrated corners, transformations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ...calibration.film import TRANSFORMS, photo_coordinates
from ...core.data import Array, ImagePoints
from ...core.failure import Code, Failure
from ...io import CORNERS, FrameCorners, FrameOrientation, FrameTransform
from ..fitting import fit_mapping
from .lines import FrameShape, Lines, shape_of
from .orientation import FrameOptions, FrameResult

Kind = Literal["similarity", "affine", "projective", "bilinear"]

KINDS: tuple[Kind, ...] = ("similarity", "affine", "projective", "bilinear")
_LEAST_FRAMES = 4
"""Minimum number of frames for the calibrated corners of a camera."""
_LEAST_ASPECT, _LEAST_ANGLE = 2e-4, 2e-4
"""Minimum scatter of the shape from frame to frame by film and scanner: relative, and radians."""


@dataclass(frozen=True, eq=False)
class Roll:
    """Common properties of the frames of one roll.

    Parameters
    ----------
    corners : FrameCorners
        Calibrated corners of the camera: means over the frames with standard deviations.
    shape : FrameShape
        Shape of the frame with its scatter from frame to frame, as prior knowledge for other frames.
    px_per_mm : float
        Mean scale of the scans.
    frames : int
        Number of frames used.
    scatter_mm : (float, float)
        Standard deviation of one frame's corners about the mean.

    Examples
    --------
    >>> corners = FrameCorners.from_xy([[-18, 12], [18, 12], [18, -12], [-18, -12]], sigma=(0.003, 0.003))
    >>> roll = Roll(corners, FrameShape(36.0, 24.0), px_per_mm=94.5, frames=12, scatter_mm=(0.01, 0.01))
    >>> round(roll.options(FrameOptions()).dpi)
    2400
    """

    corners: FrameCorners
    shape: FrameShape
    px_per_mm: float
    frames: int
    scatter_mm: tuple[float, float]

    @property
    def format_mm(self) -> tuple[float, float]:
        """Width and height of its frames as they lie in the scans."""
        return self.shape.width, self.shape.height

    def options(self, before: FrameOptions) -> FrameOptions:
        """Options for orienting other frames of this roll."""
        return replace(before, formats=(), dpi=self.px_per_mm * 25.4, shape=self.shape)


def transformed(found: FrameOrientation, calibrated: FrameCorners, kind: Kind) -> FrameTransform | Failure:
    """Transform the photo-coordinates of a frame's corners to the calibrated ones.

    All corners have equal weight: they differ by film, scanner and gate, not by errors of the measurement.

    Parameters
    ----------
    found : FrameOrientation
        An oriented frame.
    calibrated : FrameCorners
        Calibrated corners of the camera.
    kind : {"similarity", "affine", "projective", "bilinear"}
        Kinds with 4, 6, 8 and 8 parameters; the last two fit four corners without redundancy.

    Returns
    -------
    FrameTransform or Failure
        A failure if the frame was declined.

    Examples
    --------
    >>> from reseau.io import MeasuredCorner
    >>> places = ((20.0, 20.0), (164.0, 20.0), (164.0, 116.0), (20.0, 116.0))
    >>> corners = [MeasuredCorner(x=x, y=y, sx=0.1, sy=0.1, rho=0.0) for x, y in places]
    >>> found = FrameOrientation(
    ...     image="roll-07.tif", status="oriented", why="", format_mm=(36.0, 24.0), channel="grey", edges={},
    ...     corners=dict(zip(CORNERS, corners)), principal_point=corners[0], angle_deg=0.0,
    ...     angle_sigma_deg=0.1, px_per_mm=(4.0, 4.0),
    ... )
    >>> calibrated = FrameCorners.from_xy([[-18.2, 12], [18.2, 12], [18.2, -12], [-18.2, -12]])
    >>> transform = transformed(found, calibrated, "affine")
    >>> round(transform.parameters["a1"]["value"], 4), round(transform.sigma_mm[0], 6)
    (1.0111, 0.0)
    """
    points = found.image_points()
    if not len(points) or found.px_per_mm is None:
        return Failure("a declined frame has no corners to transform", Code.DECLINED)
    xy = photo_coordinates(points.xy, points.xy, found.px_per_mm)
    model = TRANSFORMS[kind]
    # Sigmas of 0.01 mm; only their equality matters.
    fit = fit_mapping(model, ImagePoints.with_sigma(CORNERS, xy, 0.01), calibrated.xy())
    if isinstance(fit, Failure):
        return fit
    left = model.with_values(fit.values)(xy) - calibrated.xy()
    free = 8 - len(model.names)
    sigma = np.sqrt((left**2).sum(axis=0) / (free / 2)) if free else None
    spread = fit.sigma if free else [None] * len(model.names)
    return FrameTransform(
        kind=kind,
        parameters={
            name: {"value": float(value), "sigma": None if s is None else float(s)}
            for name, value, s in zip(model.names, fit.values, spread, strict=True)
        },
        residuals_mm={name: (float(x), float(y)) for name, (x, y) in zip(CORNERS, left, strict=True)},
        sigma_mm=None if sigma is None else (float(sigma[0]), float(sigma[1])),
    )


def result_of(document: FrameOrientation) -> FrameResult:
    """Return the result of a frame from its document, without the covariances between its corners.

    Parameters
    ----------
    document : FrameOrientation
        The document of a frame, as written by an earlier run.

    Returns
    -------
    FrameResult
        With corners, as a frame of its roll; without the quality of its edges.

    Examples
    --------
    >>> found = FrameResult("07.tif", "declined", "of one tone", None, None, None, {})
    >>> result_of(found.document()).why
    'of one tone'
    """
    points, none = document.image_points(), np.zeros(4)
    lines = None
    if len(points):
        covariance = np.zeros((8, 8))
        for k in range(4):
            covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = points.cov[k]
        lines = Lines(points.xy, covariance, none, none, none, none, none, none, none, 1.0, 0)
    result = FrameResult(
        document.image,
        document.status,
        document.why,
        document.format_mm,
        document.channel,
        lines,
        document.edges,  # type: ignore[arg-type]
        roll_frames=document.roll_frames,
    )
    if lines is not None and document.px_per_mm is not None and document.px_per_mm != result.px_per_mm:
        x, y = document.px_per_mm
        result = replace(result, resolution=x if x == y else None)
    return result


def rolls_of(results: Sequence[FrameResult], dpi: float | None = None) -> tuple[Roll, ...]:
    """Determine the common properties of the frames of each format, taken by one camera and scanned alike.

    Parameters
    ----------
    results : sequence of FrameResult
        Frames of one or more rolls; those that are oriented and agree with most of their format are used.
    dpi : float, optional
        Resolution, if it is known better than the format: it then defines the scale of the camera's corners.
        By default the mean sides of the frame are those of the format.

    Returns
    -------
    tuple of Roll
        The roll of each format of which at least four frames are oriented, that of most frames first.

    Examples
    --------
    >>> from reseau.measure.film.lines import Lines
    >>> corners = np.array([[20.0, 20.0], [164.0, 20.0], [164.0, 116.0], [20.0, 116.0]])
    >>> lines = [Lines(corners + shift, 0.01 * np.eye(8), *np.zeros((7, 4)), 1.0, 8) for shift in range(4)]
    >>> frames = [FrameResult("", "oriented", "", (36.0, 24.0), "grey", each, {}) for each in lines]
    >>> (roll,) = rolls_of(frames)
    >>> roll.frames, roll.px_per_mm, roll.corners.xy()[1].round(6) + 0.0
    (4, 4.0, array([18., 12.]))
    >>> rolls_of(frames[:3])
    ()
    """
    # A frame that was oriented by the shape of a roll says nothing about it.
    sure = [r for r in results if r.status == "oriented" and r.lines is not None and not r.roll_frames]
    number = Counter(r.format_mm for r in sure if r.format_mm is not None)
    return tuple(
        _roll([r for r in sure if r.format_mm == size], size, dpi)
        for size, count in number.most_common()
        if count >= _LEAST_FRAMES
    )


def corner_files(rolls: Sequence[Roll]) -> dict[str, FrameCorners]:
    """Names of the files of the calibrated corners: with the formats where there are several rolls.

    Examples
    --------
    >>> corner_files([])
    {}
    """
    if len(rolls) == 1:
        return {"corners.json": rolls[0].corners}
    return {"corners-{:g}x{:g}.json".format(*each.format_mm): each.corners for each in rolls}


def _roll(sure: list[FrameResult], size: tuple[float, float], dpi: float | None) -> Roll:
    """The roll of oriented frames of one format."""
    nominal = FrameShape(*size)
    corners = np.array([r.lines.corners for r in sure if r.lines is not None])
    scale = np.array([np.mean(r.px_per_mm or (1.0, 1.0)) for r in sure])
    known = scale if dpi is None else np.full(len(sure), dpi / 25.4)
    placed = np.array([photo_coordinates(c, c, (s, s)) for c, s in zip(corners, known, strict=True)])
    keep = np.ones(len(sure), dtype=bool)
    for _ in range(3):
        placed = _turned(placed, placed[keep].mean(axis=0))
        left = placed - placed[keep].mean(axis=0)
        spread = np.sqrt(np.mean(left[keep] ** 2))
        # A deviating frame must not influence the mean.
        keep = np.abs(left).max(axis=(1, 2)) < max(5 * spread, 1e-6)
    n = int(keep.sum())
    mean, scatter = placed[keep].mean(axis=0), np.sqrt((left[keep] ** 2).sum(axis=(0, 1)) / (4 * (n - 1)))
    mean = photo_coordinates(mean * [1.0, -1.0], mean * [1.0, -1.0], (1.0, 1.0))
    shapes = np.array([shape_of(c, nominal) for c in corners[keep]])
    own = shapes.std(axis=0, ddof=1)
    deviation = tuple(float(v) for v in shapes.mean(axis=0))
    # Another frame differs from the mean of n by the scatter, itself known from n − 1 differences only, and
    # by the error of the mean: Student's distribution, with its standard deviation.
    wider = float(np.sqrt((1 + 1 / n) * (n - 1) / max(n - 3, 0.5)))
    shape = FrameShape(
        *size,
        wider * max(float(own[3]), _LEAST_ASPECT),
        wider * max(float(own[:3].max()), _LEAST_ANGLE),
        deviation,  # type: ignore[arg-type]
    )
    sigma = (float(scatter[0] / np.sqrt(n)), float(scatter[1] / np.sqrt(n)))
    return Roll(
        FrameCorners.from_xy(mean, sigma),
        shape,
        float(scale[keep].mean()),
        n,
        (float(scatter[0]), float(scatter[1])),
    )


def _turned(placed: Array, mean: Array) -> Array:
    """Frames (n, 4, 2) shifted and rotated onto their mean, without a change of size (Procrustes)."""
    centred = placed - placed.mean(axis=1, keepdims=True)
    goal = mean - mean.mean(axis=0)
    dot = (centred * goal).sum(axis=(1, 2))
    cross = (centred[..., 0] * goal[:, 1] - centred[..., 1] * goal[:, 0]).sum(axis=1)
    angle = np.arctan2(cross, dot)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], axis=1)
    return np.asarray(centred @ turn + mean.mean(axis=0))
