"""Figures of a bundle adjustment: the network, residuals over the image, distortion with its uncertainty."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ..bundle import Result
from ..calibration import CameraMapping
from ..calibration.assessment import Assessment, ErrorMap
from ..core.data import Array, Rows
from ..core.figures import (
    ACCENT,
    BLUE,
    FAINT,
    INK,
    PALE,
    draw_arrows,
    draw_ellipses,
    image_axes,
    nice,
    sheet,
    to_svg,
)
from ..optics.cameras.registry import distortion_names

_MANY_POINTS, _ELLIPSES, _CELLS, _WEAK = 4000, 250, 12, 5.0
_BAND = 3.0
"""Standard deviations of the band."""
_DIRECTIONS, _RADII = 24, 60
_WIDE_DEG = 55.0
"""Angle to the axis in a corner from which on a lens is wide."""


def network_figure(result: Result) -> str:
    """Draw plan and elevation: projection centres, points, and enlarged standard ellipses."""
    values, part = result.fit.values, result.fit.usable
    points = np.flatnonzero(part.points)
    points = points[:: max(1, len(points) // _MANY_POINTS)].astype(np.intp)
    with sheet((8.6, 4.2)) as figure:
        for axes, (a, b), title in zip(
            figure.subplots(1, 2), ((0, 1), (0, 2)), ("plan", "elevation"), strict=True
        ):
            xyz, x0 = values.xyz[points], values.x0[part.images]
            axes.plot(xyz[:, a], xyz[:, b], ".", color=FAINT, markersize=2)
            view = values.rotation[part.images][:, 2]
            size = 0.08 * float(np.ptp(np.concatenate([xyz, x0]), axis=0).max())
            draw_arrows(axes, x0[:, [a, b]], size * view[:, [a, b]], BLUE, 0.003)
            axes.plot(x0[:, a], x0[:, b], "^", color=BLUE, markersize=4)
            enlarged = _ellipses(axes, result, points, (a, b), 0.4 * size)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(f"{title}; ellipses × {enlarged:g}")
            axes.set_xlabel(f"{'XYZ'[a]} [{result.network.unit}]")
            axes.set_ylabel(f"{'XYZ'[b]} [{result.network.unit}]")
        return to_svg(figure)


def _ellipses(axes: Axes, result: Result, points: Rows, plane: tuple[int, int], size: float) -> float:
    """Draw standard ellipses of some points; return the factor of enlargement."""
    points = points[np.isfinite(result.point_sigma[points]).all(axis=1)]
    some = points[:: max(1, len(points) // _ELLIPSES)]
    q = result.point_covariance[some][:, plane][:, :, plane]
    axis = np.sqrt(np.maximum(np.linalg.eigvalsh(q)[:, 1], 0.0))
    median = float(np.median(axis)) if len(axis) else 0.0
    if median == 0:
        return 1.0
    power = nice(size / median)
    # Weak points, which the warnings list, would cover the others.
    shown = axis <= _WEAK * median
    at = result.fit.values.xyz[some[shown]][:, plane]
    return draw_ellipses(axes, at, q[shown], enlarged=power, linewidth=0.5)


def residual_figure(result: Result, c: int, rows: Rows) -> str:
    """Draw coverage of the image, mean residuals of its cells, and the distribution of test values."""
    camera, network = result.network.cameras[c], result.network
    across, down = _CELLS, max(2, round(_CELLS * camera.height / camera.width))
    xy, v = network.xy[rows], result.residuals[rows]
    cell = np.clip(
        (xy / [camera.width, camera.height] * [across, down]).astype(int), 0, [across - 1, down - 1]
    )
    flat = cell[:, 1] * across + cell[:, 0]
    number = np.bincount(flat, minlength=across * down)
    total = np.stack([np.bincount(flat, v[:, k], across * down) for k in (0, 1)], axis=1)
    mean: Array = total / np.maximum(number, 1)[:, None]
    with sheet((8.6, 3.6)) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
        extent = (0, camera.width, camera.height, 0)
        left.imshow(number.reshape(down, across), extent=extent, cmap="Greys", alpha=0.35, aspect="equal")
        x = (np.arange(across) + 0.5) * camera.width / across
        y = (np.arange(down) + 0.5) * camera.height / down
        longest = float(np.hypot(*mean.T).max()) or 1.0
        enlarged = 0.8 * camera.width / across / longest
        draw_arrows(left, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), enlarged * mean, ACCENT)
        image_axes(left, camera.width, camera.height, f"mean residuals; longest {longest:.2g} px")
        w = result.test_values[rows]
        w = w[np.isfinite(w)]
        bins = np.linspace(0, 5, 41)
        right.hist(
            np.minimum(w, 5), bins=list(bins), density=True, color=PALE, edgecolor=FAINT, linewidth=0.4
        )
        right.plot(bins, np.sqrt(2 / np.pi) * np.exp(-(bins**2) / 2), color=INK, linewidth=1)
        right.set_title("test values and normal distribution", loc="left")
        right.set_xlabel("|w|")
        right.set_ylabel("density")
        return to_svg(figure)


def next_figure(result: Result, c: int, rows: Rows, assessed: Assessment) -> str | None:
    """Draw the image with its points so far, and the target as the next photograph shows it."""
    then, camera = assessed.next_photograph, result.network.cameras[c]
    if then is None:
        return None
    xy = result.network.xy[rows]
    xy = xy[:: max(1, len(xy) // _MANY_POINTS)]
    with sheet((4.6, 0.9 + 4.0 * camera.height / camera.width)) as figure:
        axes = figure.subplots()
        axes.plot(*xy.T, ".", color=FAINT, markersize=2.5, label="points so far")
        outline = np.array(then.outline_px)
        axes.fill(*outline.T, facecolor=BLUE, alpha=0.15)
        axes.plot(*np.vstack([outline, outline[:1]]).T, color=BLUE, lw=1.2)
        expected = np.array(then.points_px).reshape(-1, 2)
        axes.plot(*expected.T, ".", color=BLUE, markersize=3.5, label="in the next photograph")
        image_axes(axes, camera.width, camera.height)
        figure.legend(loc="outside upper left", ncols=2, frameon=False, fontsize=8.5)
        return to_svg(figure)


def distortion_figure(lens: CameraMapping, errors: ErrorMap | None = None) -> tuple[str, str] | None:
    """Draw the radial distortion with its confidence band, and its standard deviation.

    Of a wide lens, whose distortion against a central projection has no limit, the radius in the image is
    drawn by the angle of the ray.

    Parameters
    ----------
    lens : CameraMapping
        A calibrated camera.
    errors : ErrorMap, optional
        Errors of the projection, drawn beside in place of the standard deviation of the distortion alone.

    Returns
    -------
    (str, str) or None
        An SVG element, and what it shows; None where no distortion was estimated.
    """
    found = _radial(lens)
    if found is None:
        return None
    at, curve, sigma, ideal = found
    by_angle = ideal is not None
    with sheet((8.6, 3.0)) as figure:
        left, right = figure.subplots(1, 2)
        left.fill_between(
            at, curve - _BAND * sigma, curve + _BAND * sigma, color=ACCENT, alpha=0.3, linewidth=0
        )
        left.plot(at, curve, color=INK, linewidth=1)
        if ideal is None:
            left.axhline(0, color=FAINT, linewidth=0.6, zorder=0)
        else:
            left.plot(at, ideal, color=FAINT, linewidth=1, linestyle="--", zorder=0)
        left.set_title(f"{'radius' if by_angle else 'radial distortion'} ± {_BAND:g} σ", loc="left")
        left.set_ylabel("radius / px" if by_angle else "px")
        for axes in (left, right):
            axes.set_xlabel("angle to the axis / °" if by_angle else "radius / px")
        if errors is None:
            right.fill_between(at, 0, _BAND * sigma, color=PALE, linewidth=0)
            right.plot(at, sigma, color=ACCENT, linewidth=1)
            right.set_title(f"its σ; up to {_BAND:g} σ in grey", loc="left")
        else:
            _draw_profile(right, lens, errors, by_angle)
        right.set_ylim(bottom=0)
        right.set_ylabel("px")
        what = "Radius in the image by the angle of the ray (dashed: proportional to it)"
        return to_svg(figure), what if by_angle else "Radial distortion"


def _draw_profile(axes: Axes, lens: CameraMapping, errors: ErrorMap, by_angle: bool) -> None:
    """Draw errors of the projection by the radius, or by the angle to the axis, in degrees."""
    xy = errors.xy.reshape(-1, 2)
    if by_angle:
        at = np.degrees(np.arctan(np.hypot(*lens.mapping.inverse(xy).T)))
    else:
        at = np.hypot(*(xy - lens.mapping(np.zeros((1, 2)))).T)
    axes.plot(at, errors.formal.ravel(), ".", color=FAINT, markersize=3, label="formal σ")
    axes.plot(at, errors.total.ravel(), ".", color=ACCENT, markersize=3, label="total")
    axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    axes.set_title("error of the projection over the image", loc="left")


def _radial(lens: CameraMapping) -> tuple[Array, Array, Array, Array | None] | None:
    """Radius, mean radial distortion over all directions, and its standard deviation (px).

    Of a wide lens: angle (°), radius, its standard deviation, and the radius that is proportional to the
    angle (px).

    Distortion is the difference between the mapping and the central projection with its slope on the axis.
    """
    bent = distortion_names(lens.names)
    own = [k for k, name in enumerate(lens.names) if name in bent]
    if not own:
        return None
    axis = lens.mapping.derivatives(np.zeros((1, 2)))
    corner = lens.mapping.inverse(np.array([[0.0, 0.0], [lens.width - 1.0, lens.height - 1.0]]))
    if not np.isfinite(corner).all():
        return None
    reach = float(np.hypot(*corner.T).max())
    wide = reach > np.tan(np.deg2rad(_WIDE_DEG))
    turn = np.linspace(0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    away = np.column_stack([np.cos(turn), np.sin(turn)])
    angles = np.linspace(0, np.arctan(reach), _RADII)
    lengths = np.tan(angles) if wide else np.linspace(0, reach, _RADII)
    uv = (lengths[:, None, None] * away).reshape(-1, 2)
    seen = lens.mapping.derivatives(uv)
    ideal = axis.value + uv @ axis.d_xy[0].T
    out = away @ axis.d_xy[0].T
    slope = float(np.linalg.norm(out, axis=1).mean())
    out = np.tile(out / np.linalg.norm(out, axis=1, keepdims=True), (_RADII, 1))
    curve = (
        ((seen.value - (axis.value if wide else ideal)) * out).sum(axis=1).reshape(_RADII, -1).mean(axis=1)
    )
    by = np.einsum("ni,niu->nu", out, seen.d_parameters[:, :, lens.rows[own]])
    by = by.reshape(_RADII, _DIRECTIONS, -1).mean(axis=1)
    variance = np.einsum("ri,ij,rj->r", by, lens.covariance[np.ix_(own, own)], by)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    if wide:
        return np.rad2deg(angles), curve, sigma, slope * angles
    radius = np.hypot(*(ideal - axis.value).T).reshape(_RADII, -1).mean(axis=1)
    return radius, curve, sigma, None
