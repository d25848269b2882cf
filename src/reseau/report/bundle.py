"""The report of a bundle adjustment: a page that stands alone, same to the byte for the same input."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import count
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from ..bundle import FieldDifference, Lens, Result, projection_field
from ..data import Array, Rows
from ..provenance import Provenance
from .fields import difference_figure, uncertainty_figure
from .figures import nice
from .patterns import patterns_of
from .style import ACCENT, BLUE, FAINT, INK, PALE, drawing, to_svg

__all__ = ["bundle_report"]

_MANY_POINTS, _ELLIPSES, _CELLS, _IMAGES, _WEAK = 4000, 250, 12, 200, 5.0
_UNITS = {"c": "mm", "x0": "mm", "y0": "mm", "K1": "mm⁻²", "K2": "mm⁻⁴", "K3": "mm⁻⁶", "P1": "mm⁻¹",
          "P2": "mm⁻¹", "fx": "px", "fy": "px", "cx": "px", "cy": "px"}  # fmt: skip


def bundle_report(
    result: Result,
    *,
    title: str,
    provenance: Provenance | None = None,
    against: Mapping[str, FieldDifference] | None = None,
) -> str:
    """Render the report of a bundle adjustment.

    Parameters
    ----------
    result : Result
        The adjustment.
    title : str
        Heading of the page.
    provenance : Provenance, optional
        Inputs, options, version.
    against : mapping of str to FieldDifference, optional
        Differences from other calibrations, by what these are called.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("reseau.report"), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    cameras = [_camera(result, c) for c in range(len(result.network.cameras))]
    return environment.get_template("bundle.html.j2").render(
        title=title,
        summary=_summary(result),
        warnings=result.warnings,
        network=Markup(_network_figure(result)),
        cameras=[camera for camera in cameras if camera["shown"]][:20],
        more_cameras=max(0, sum(camera["shown"] for camera in cameras) - 20),
        images=_images(result)[:_IMAGES],
        more_images=max(0, len(result.network.images) - _IMAGES),
        patterns=patterns_of(result),
        differences=[_difference(name, found) for name, found in (against or {}).items()],
        left_out=list(zip(*result.rejected_names(), strict=True))[:_IMAGES],
        unit=result.network.unit,
        provenance=(provenance or Provenance()).to_dict(),
        figure=partial(next, count(1)),
        table=partial(next, count(1)),
    )


def _summary(result: Result) -> list[tuple[str, str, str]]:
    observations, unknowns, _ = result.fit.counts
    test, unit = result.global_test(), result.network.unit
    part = result.fit.usable.points & ~result.network.held.all(axis=1)
    sigma = np.median(np.linalg.norm(result.point_sigma[part], axis=1)) if part.any() else np.nan
    verdict = "not tested" if test is None else "passed" if test.passed else "not passed"
    return [
        (f"{result.sigma0:.4g}", "", f"σ₀ a posteriori; global test {verdict}"),
        (f"{observations}", "", "observations"),
        (f"{unknowns}", "", "unknowns"),
        (f"{result.redundancy}", "", "redundancy"),
        (f"{sigma:.2g}", unit, "σ of a point in space, median"),
        *_reliability(result),
    ]


def _reliability(result: Result) -> list[tuple[str, str, str]]:
    """What errors of image coordinates the test finds, and what those it does not find can do."""
    n = 2 * len(result.network.xy)
    error, length = result.minimal_detectable_errors(), result.fit.external_lengths()[:n]
    kept = np.repeat(result.fit.usable.observations & ~result.rejected, 2)
    error, length = error.ravel()[kept], length[kept]
    error, length = error[np.isfinite(error)], length[np.isfinite(length)]
    if not len(error) or not len(length):
        return []
    return [
        (f"{np.median(error):.2g}", "px", "error of an image coordinate that is found, median"),
        (f"{np.median(length):.2g}", "σ", "most that one not found does to any result, median"),
        (f"{length.max():.2g}", "σ", "the same, at most"),
    ]


def _camera(result: Result, c: int) -> dict[str, Any]:
    """Table and figures of one camera."""
    camera = result.network.cameras[c]
    names, _, values = result.camera_columns(c)
    sigma = np.sqrt(np.diag(result.camera_covariance(c)))
    tests = {test.name: test for test in result.camera_tests(c)}
    rows = []
    for name, value, s in zip(names, values, sigma, strict=True):
        test = tests.get(name)
        rows.append(
            {
                "name": name,
                "value": f"{value:.7g}",
                "sigma": f"{s:.2g}",
                "unit": _UNITS.get(name, ""),
                "statistic": "" if test is None else f"{test.statistic:.1f}",
                "p": "" if test is None else f"{test.p:.3f}",
                "verdict": "" if test is None or test.significant else "not significant",
            }
        )
    seen = result.network.camera_of[result.network.image_of] == c
    rows_of = np.flatnonzero(seen & result.fit.usable.observations & ~result.rejected).astype(np.intp)
    shown = bool(len(names)) and len(rows_of) > 0
    return {
        "id": camera.id,
        "shown": shown,
        "rows": rows,
        "residuals": Markup(_residual_figure(result, c, rows_of)) if shown else None,
        "field": _field_figure(result, c, rows_of) if shown else None,
        "profile": Markup(_profile_figure(result, c)) if shown and _radial(result, c) is not None else None,
    }


def _field_figure(result: Result, c: int, rows: Rows) -> Markup | None:
    """Uncertainty of the projection; None where a camera has several sets of parameters, or no mapping."""
    extra = result.network.cameras[c].additional
    if extra is not None and (extra.per != "camera" or result.network.cameras[c].side == "image"):
        return None
    field = projection_field(Lens.of_result(result, c))
    if not np.isfinite(field.sigma).any() or not np.nanmax(field.sigma) > 0:
        return None
    return Markup(uncertainty_figure(field, result.network.xy[rows]))


def _difference(name: str, found: FieldDifference) -> dict[str, Any]:
    size = np.hypot(*np.moveaxis(found.difference, 2, 0))
    return {
        "name": name,
        "figure": Markup(difference_figure(found)),
        "rms": f"{np.sqrt(np.nanmean(size**2)):.2g}",
        "statistic": f"{found.statistic:.1f}",
        "degrees": found.degrees,
        "p": f"{found.p:.2g}",
        "tilt": " / ".join(f"{angle:.2g}" for angle in 1e3 * found.rotation),
    }


def _images(result: Result) -> list[tuple[str, ...]]:
    network = result.network
    v = np.where(result.rejected[:, None], np.nan, result.residuals)
    angle, sigma = np.degrees(result.angles), np.degrees(result.angle_sigma)
    q = np.sqrt(np.maximum(np.diagonal(result.pose_covariance, axis1=1, axis2=2), 0.0))[:, 3:]
    rows: list[tuple[str, ...]] = []
    for i, name in enumerate(network.images):
        own = v[network.image_of == i]
        own = own[np.isfinite(own).all(axis=1)]
        if not result.fit.usable.images[i]:
            rows.append((name, str(len(own)), "left out", "", "", ""))
            continue
        rms = np.sqrt((own**2).mean(axis=0)) if len(own) else np.full(2, np.nan)
        rows.append(
            (
                name,
                str(len(own)),
                f"{rms[0]:.3f} / {rms[1]:.3f}",
                " / ".join(f"{s:.2g}" for s in q[i]),
                " / ".join(f"{a:.4f}" for a in angle[i]),
                " / ".join(f"{s:.2g}" for s in sigma[i]),
            )
        )
    return rows


def _network_figure(result: Result) -> str:
    """Plan and elevation: projection centres, points, and ellipses of their standard deviations, enlarged."""
    values, part = result.fit.values, result.fit.usable
    points = np.flatnonzero(part.points)
    points = points[:: max(1, len(points) // _MANY_POINTS)].astype(np.intp)
    with drawing():
        figure = Figure(figsize=(8.6, 4.2), layout="constrained")
        for axes, (a, b), title in zip(
            figure.subplots(1, 2), ((0, 1), (0, 2)), ("plan", "elevation"), strict=True
        ):
            xyz, x0 = values.xyz[points], values.x0[part.images]
            axes.plot(xyz[:, a], xyz[:, b], ".", color=FAINT, markersize=2)
            view = values.rotation[part.images][:, 2]
            size = 0.08 * float(np.ptp(np.concatenate([xyz, x0]), axis=0).max())
            axes.quiver(
                x0[:, a], x0[:, b], size * view[:, a], size * view[:, b], color=BLUE, angles="xy",
                scale_units="xy", scale=1, width=0.003,
            )  # fmt: skip
            axes.plot(x0[:, a], x0[:, b], "^", color=BLUE, markersize=4)
            enlarged = _ellipses(axes, result, points, (a, b), 0.4 * size)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_title(f"{title}; ellipses × {enlarged:.3g}")
            axes.set_xlabel(f"{'XYZ'[a]} [{result.network.unit}]")
            axes.set_ylabel(f"{'XYZ'[b]} [{result.network.unit}]")
        return to_svg(figure)


def _ellipses(axes: Axes, result: Result, points: Rows, plane: tuple[int, int], size: float) -> float:
    """Standard ellipses of some points, and how much they are enlarged."""
    some = points[:: max(1, len(points) // _ELLIPSES)]
    q = result.point_covariance[some][:, plane][:, :, plane]
    values, vectors = np.linalg.eigh(q)
    axis = np.sqrt(np.maximum(values, 0.0))
    median = float(np.median(axis[:, 1])) if len(axis) else 0.0
    if median == 0:
        return 1.0
    power = nice(size / median)
    # Weak points, which the warnings name, would cover the others.
    shown = axis[:, 1] <= _WEAK * median
    some, axis, vectors = some[shown], axis[shown], vectors[shown]
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    axes.add_collection(
        EllipseCollection(
            2 * power * axis[:, 1], 2 * power * axis[:, 0], angle, units="xy",
            offsets=result.fit.values.xyz[some][:, plane], transOffset=axes.transData, facecolors="none",
            edgecolors=ACCENT, linewidths=0.5,
        )
    )  # fmt: skip
    return float(power)


def _residual_figure(result: Result, c: int, rows: Rows) -> str:
    """Coverage of the image, mean residuals in its cells, and test values against the normal distribution."""
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
    with drawing():
        figure = Figure(figsize=(8.6, 3.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
        extent = (0, camera.width, camera.height, 0)
        left.imshow(number.reshape(down, across), extent=extent, cmap="Greys", alpha=0.35, aspect="equal")
        x = (np.arange(across) + 0.5) * camera.width / across
        y = (np.arange(down) + 0.5) * camera.height / down
        longest = float(np.hypot(*mean.T).max()) or 1.0
        scale = longest / (0.8 * camera.width / across)
        gx, gy = np.meshgrid(x, y)
        left.quiver(
            gx, gy, mean[:, 0].reshape(gx.shape), mean[:, 1].reshape(gx.shape), color=ACCENT, angles="xy",
            scale_units="xy", scale=scale, width=0.004,
        )  # fmt: skip
        left.set_title(f"coverage and mean residuals (longest {longest:.3f} px)")
        w = result.test_values[rows]
        w = w[np.isfinite(w)]
        bins = np.linspace(0, 5, 41)
        right.hist(
            np.minimum(w, 5), bins=list(bins), density=True, color=PALE, edgecolor=FAINT, linewidth=0.4
        )
        right.plot(bins, np.sqrt(2 / np.pi) * np.exp(-(bins**2) / 2), color=INK, linewidth=1)
        right.set_title("test values w and the normal distribution")
        return to_svg(figure)


def _radial(result: Result, c: int) -> tuple[Array, Array, Array] | None:
    """Radius, radial distortion of Brown's model and its standard deviation (mm); None where held."""
    camera = result.network.cameras[c]
    names, _, _ = result.camera_columns(c)
    free = [k for k in ("K1", "K2", "K3") if k in names]
    if camera.model != "brown" or not free:
        return None
    half = np.array([camera.width, camera.height]) * camera.pitch_mm / 2
    r, r0 = np.linspace(0, float(np.hypot(*half)), 60), camera.balance_radius_mm
    terms = {f"K{k}": r * (r ** (2 * k) - r0 ** (2 * k)) for k in (1, 2, 3)}
    values = dict(zip(camera.names, result.fit.values.cameras[c], strict=False))
    at = [names.index(k) for k in free]
    slope = np.stack([terms[k] for k in free], axis=1)
    variance = np.einsum("ri,ij,rj->r", slope, result.camera_covariance(c)[np.ix_(at, at)], slope)
    curve = np.sum([values[k] * terms[k] for k in terms], axis=0)
    return r, curve, np.sqrt(np.maximum(variance, 0.0))


def _profile_figure(result: Result, c: int) -> str:
    """Radial distortion with the band of three standard deviations, and that band alone."""
    found = _radial(result, c)
    assert found is not None
    r, curve, sigma = found
    with drawing():
        figure = Figure(figsize=(8.6, 3.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        left.plot(r, 1e3 * curve, color=INK, linewidth=1)
        left.set_title("radial distortion [µm] by radius [mm]")
        right.fill_between(r, -3e3 * sigma, 3e3 * sigma, color=PALE)
        right.plot(r, 1e3 * sigma, color=ACCENT, linewidth=1)
        right.set_title("its σ [µm]; band of ±3 σ")
        return to_svg(figure)
