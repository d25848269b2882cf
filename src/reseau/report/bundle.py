"""The report of a bundle adjustment: a self-contained page, the same bytes for the same input."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from ..bundle import Result
from ..bundle.diagnostics.fields import camera_mapping, projection_field_at
from ..bundle.diagnostics.patterns import CommonPattern, by_place, by_point, common_pattern
from ..bundle.network.shutter import MOTION
from ..calibration import CameraMapping, FieldDifference, projection_field
from ..calibration.assessment import Assessment
from ..core.data import Array, Frame, Rows
from ..core.errors import UsageError
from ..core.figures import ACCENT, FAINT, INK, draw_arrows, nice, sheet, to_svg
from ..core.numbers import aligned, at_power, measured, plain, power
from ..core.provenance import Provenance
from ..io.photographs import Exif
from ..procedures.assessment import sorted_remarks
from .bundle_figures import distortion_figure, network_figure, next_figure, residual_figure
from .fields import difference_figure, errors_figure, uncertainty_figure
from .overlay import Marks, frame_overlay
from .tables import unit_text
from .template import rendered

_IMAGES, _CAMERAS, _PLACES = 200, 20, 45
_PHOTOGRAPHS, _ACROSS = 8, 800
"""Number of photographs that are shown, and their width in pixels."""
_THUMBNAILS, _SMALL, _BOLD = 24, 360, 2.5
"""Number of thumbnails, their width in pixels, and factor on the size of their marks."""
_NAMED = 3
"""Cameras that are named at the beginning of the page."""
_LONG = 0.03
"""Length of a large residual in a photograph, of its width."""


def bundle_report(
    result: Result,
    *,
    title: str,
    provenance: Provenance | None = None,
    against: Mapping[str, FieldDifference] | None = None,
    distances: Sequence[float] = (),
    assessments: Mapping[str, Assessment] | None = None,
    photograph: Callable[[str], Frame | None] | None = None,
    declined: Mapping[str, str] | None = None,
    exif: Collection[Exif] = (),
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
        Differences from other calibrations, by their names.
    distances : sequence of float
        Distances at which the uncertainty of the projection is mapped, in addition to that of directions; by
        default the median distance of the points.
    assessments : mapping of str to Assessment, optional
        What the calibrations of the cameras are good for, by their names.
    photograph : callable, optional
        Returns the photograph of an image, or None where there is none; those with the largest residuals are
        shown.
    declined : mapping of str to str, optional
        Photographs that were left out, and why.
    exif : collection of Exif
        What the camera says about the photographs: what it is called, when it took them.

    Returns
    -------
    str
        An HTML page without any external resource and without clock times.
    """
    assessments = assessments or {}
    cameras = [
        _camera(result, c, distances, assessments.get(result.network.cameras[c].id))
        for c in _shown(result)[:_CAMERAS]
    ]
    warnings, tests = sorted_remarks(result.warnings, assessed=bool(assessments))
    return rendered(
        "bundle.html.j2",
        title=title,
        facts=_facts(result, exif, provenance or Provenance()),
        summary=_summary(result),
        verdicts=[_verdict(result, name, each) for name, each in assessments.items()],
        warnings=warnings,
        tests=tests,
        network=Markup(network_figure(result)),
        components=components_table(result),
        dropped=dropped_table(result),
        cameras=cameras,
        refraction=_refraction(result),
        rig=_rig(result),
        turntable=_turntable(result),
        motion=_motion(result),
        more_cameras=max(0, len(_shown(result)) - _CAMERAS),
        images=images_table(result)[:_IMAGES],
        more_images=max(0, len(result.network.images) - _IMAGES),
        worst=worst_points(result),
        thumbnails=_photographs(result, photograph, _THUMBNAILS, _SMALL, _BOLD) if assessments else [],
        more_thumbnails=max(0, int(result.fit.usable.images.sum()) - _THUMBNAILS),
        photographs=_photographs(result, photograph),
        more_photographs=max(0, int(result.fit.usable.images.sum()) - _PHOTOGRAPHS),
        declined=list((declined or {}).items()),
        patterns=patterns_of(result),
        differences=[_difference(name, found) for name, found in (against or {}).items()],
        left_out=left_out_table(result)[:_IMAGES],
        unit=result.network.unit,
        provenance=(provenance or Provenance()).to_dict(),
    )


def _verdict(result: Result, name: str, assessed: Assessment) -> dict[str, Any]:
    """The verdict on a camera, with the next photograph."""
    c = [entry.id for entry in result.network.cameras].index(name)
    rows = result.used_by(c)
    drawn = next_figure(result, c, rows, assessed)
    errors = None if assessed.errors is None else errors_figure(assessed.errors, result.network.xy[rows])
    return {
        "map": None if errors is None else Markup(errors),
        "camera": name if len(result.network.cameras) > 1 else "",
        "lines": assessed.lines,
        "use": assessed.use.value,
        "figure": None if drawn is None else Markup(drawn),
        "next": "" if assessed.next_photograph is None else assessed.next_photograph.text,
    }


def _facts(result: Result, exif: Collection[Exif], provenance: Provenance) -> list[str]:
    """What was calibrated, from how many photographs, when they were taken, and by which version."""
    network, software = result.network, provenance.to_dict()["software"]
    alone = len(network.cameras) == 1
    cameras = [
        f"{'' if alone else f'{entry.id}: '}{entry.model}, {entry.width} × {entry.height} px"
        for entry in network.cameras[:_NAMED]
    ]
    cameras += [f"{len(network.cameras)} cameras"] * (len(network.cameras) > _NAMED)
    called = sorted({each.camera for each in exif if each.camera})
    days = sorted({each.day for each in exif if each.day})
    taken = " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "no date in the photographs"
    photographs = f"{int(result.fit.usable.images.sum())} photographs"
    return [*called[:_NAMED], *cameras, photographs, *([taken] if exif else []), software]


def _photographs(
    result: Result,
    photograph: Callable[[str], Frame | None] | None,
    count: int = _PHOTOGRAPHS,
    across: int = _ACROSS,
    bold: float = 1.0,
) -> list[dict[str, Any]]:
    """Photographs with the largest residuals, in their order, with their marks."""
    if photograph is None:
        return []
    network = result.network
    good = result.used
    squares = np.where(good, np.nan_to_num(result.residuals**2).sum(axis=1), 0.0)
    number = np.bincount(network.image_of[good], minlength=len(network.images))
    mean = np.bincount(network.image_of, squares, len(network.images)) / np.maximum(number, 1)
    usable = np.flatnonzero(result.fit.usable.images & (number > 0))
    large = float(np.quantile(np.sqrt(squares[good]), 0.95)) if good.any() else 0.0
    found = []
    for i in sorted(usable[np.argsort(-mean[usable], kind="stable")][:count]):
        frame = photograph(network.images[i])
        if frame is None:
            continue
        rows = np.flatnonzero(network.image_of == i)
        enlarged = nice(_LONG * bold * frame.width / large) if large > 0 else 1.0
        shifts = np.where(good[rows, None], enlarged * result.residuals[rows], np.nan)
        names = tuple(network.points[j] for j in network.point_of[rows])
        marks = Marks(names, network.xy[rows], good[rows], shifts=shifts)
        found.append(
            {
                "name": network.images[i],
                "picture": frame_overlay(frame, marks, across, bold),
                "points": int(good[rows].sum()),
                "rejected": int((~good[rows]).sum()),
                "enlarged": f"{enlarged:g}",
                "longest": f"{np.sqrt(squares[rows].max()):.2g}",
                # Of one coordinate, as the summary has it.
                "rms": f"{np.sqrt(mean[i] / 2):.2g}",
            }
        )
    return found


def _shown(result: Result) -> list[int]:
    """Cameras with estimated parameters."""
    return [
        c
        for c in range(len(result.network.cameras))
        if len(result.camera_columns(c)[0]) and len(result.used_by(c))
    ]


def _summary(result: Result) -> list[tuple[str, str, str]]:
    observations, unknowns, _ = result.fit.counts
    test, unit = result.global_test(), result.network.unit
    part = result.fit.usable.points & ~result.network.held.all(axis=1)
    sigmas = np.linalg.norm(result.point_sigma[part], axis=1)
    sigma = np.nanmedian(sigmas) if np.isfinite(sigmas).any() else np.nan
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
    """Smallest detectable errors of image coordinates, and effects of undetected ones."""
    n = 2 * len(result.network.xy)
    error, length = result.minimal_detectable_errors(), result.fit.external_lengths()[:n]
    kept = np.repeat(result.used, 2)
    error, length = error.ravel()[kept], length[kept]
    error, length = error[np.isfinite(error)], length[np.isfinite(length)]
    if not len(error) or not len(length):
        return []
    return [
        (plain(np.median(error), 2), "px", "smallest detectable error of an image coordinate, median"),
        (plain(np.median(length), 2), "σ", "largest effect of an undetected error on any result, median"),
        (plain(length.max(), 2), "σ", "the same, maximum"),
    ]


def _camera(
    result: Result, c: int, distances: Sequence[float], assessed: Assessment | None
) -> dict[str, Any]:
    """Table and figures of one camera."""
    camera = result.network.cameras[c]
    found = result.camera(c)
    tests = {test.name: test for test in result.camera_tests(c)}
    rows = []
    for name, value, s, formal in zip(
        found.parameters, found.values, found.sigma, found.sigma_formal, strict=True
    ):
        test = tests.get(name)
        rows.append(
            {
                "name": name,
                **_estimate(value, s, camera.unit_of(name)),
                "formal": at_power(formal, power(value, s)),
                "statistic": "" if test is None else f"{test.statistic:.1f}",
                "p": "" if test is None else f"{test.p:.3f}" if test.p >= 5e-4 else "< 0.001",
                "verdict": "" if test is None or test.significant else "not significant",
            }
        )
    at = result.used_by(c)
    lens = _lens(result, c)
    profile = None if lens is None else distortion_figure(lens, None if assessed is None else assessed.errors)
    return {
        "title": camera.label[0].upper() + camera.label[1:],
        "rows": rows,
        "residuals": Markup(residual_figure(result, c, at)),
        "fields": [] if lens is None else _fields(result, c, lens, at, distances, assessed is None),
        "profile": None if profile is None else Markup(profile[0]),
        "profile_of": "" if profile is None else profile[1],
    }


def _estimate(value: float, sigma: float, unit: str) -> dict[str, Any]:
    """An estimate and its unit, as rows of tables have them."""
    return {"estimate": power(float(value), float(sigma)), "unit": unit_text(unit)}


def _refraction(result: Result) -> list[dict[str, Any]]:
    """Rows of the table of windows and media."""
    found = result.refraction
    if found is None:
        return []
    return [
        {
            "name": name,
            **_estimate(value, sigma, unit),
            "given": f"{given:g}",
            "p": f"{test.p:.3f}" if test.p >= 5e-4 else "< 0.001",
            "partner": partner,
            "r": f"{r:+.2f}".replace("-", "−"),
        }
        for name, value, sigma, unit, given, test, (partner, r) in zip(
            found.parameters, found.values, found.sigma, found.units, found.given, found.tests,
            found.partners, strict=True,
        )
    ]  # fmt: skip


def _motion(result: Result) -> list[dict[str, Any]]:
    """Rows of the table of the motion of cameras with a shutter: its components in each image."""
    found = result.motion
    if found is None:
        return []
    units = 3 * [f"{found.unit}/s"] + 3 * ["rad/s"]
    columns = [k for k in range(6) if (found.sigma[:, k] > 0).any()]
    return [
        {
            "image": image,
            "name": MOTION[k],
            **_estimate(found.values[i, k], found.sigma[i, k], units[k]),
        }
        for i, image in enumerate(found.names)
        for k in columns
        if found.sigma[i, k] > 0
    ]


def _rig(result: Result) -> list[dict[str, Any]]:
    """Rows of the table of the cameras of a rig."""
    found = result.rig
    if found is None:
        return []
    rows = []
    for k, (camera, reference) in enumerate(zip(found.cameras, found.references, strict=True)):
        base = zip("XYZ", found.base[k], found.sigma[k, 3:], strict=True)
        values = [(f"{axis} of its centre", value, sigma, found.unit) for axis, value, sigma in base]
        values.append(("distance", found.length[k], found.length_sigma[k], found.unit))
        turn = np.rad2deg(found.sigma[k, :3].max())
        values.append(("rotation", found.angles[k], turn, "deg"))
        rows += [
            {"camera": camera, "reference": reference, "name": name, **_estimate(value, sigma, unit)}
            for name, value, sigma, unit in values
        ]
    return rows


def _turntable(result: Result) -> dict[str, Any] | None:
    """Rows of the tables of a turntable: its axis, and its angles."""
    found = result.stage
    if found is None or found.kind != "rotary":
        return None
    sigma = np.sqrt(np.diag(found.cov))
    axis = [
        (f"{name} of its {what}", values[k], spread[k], unit)
        for what, values, spread, unit in (
            ("direction", found.direction, sigma[:3], ""), ("position", found.position, sigma[3:], found.unit)
        )
        for k, name in enumerate("XYZ")
    ]  # fmt: skip
    angles = zip(found.images, *(np.rad2deg(c) for c in (found.reading, found.reading_sigma, found.residual)),
                 strict=True)  # fmt: skip
    return {
        "carries": found.carries,
        "axis": [{"name": name, **_estimate(value, s, unit)} for name, value, s, unit in axis],
        "angles": [
            {
                "image": image,
                "angle": f"{angle:.4f}" if spread == 0 else measured(float(angle), float(spread)),
                "residual": "" if spread == 0 else aligned([off], 4)[0],
            }
            for image, angle, spread, off in list(angles)[:_IMAGES]
        ],
        "more": max(0, len(found.images) - _IMAGES),
        "sigma_deg": plain(float(np.rad2deg(found.direction_sigma)), 2),
        "sigma": plain(found.position_sigma, 2),
    }


def _lens(result: Result, c: int) -> CameraMapping | None:
    """The mapping of the camera; None where it has several sets of parameters, or no mapping."""
    return camera_mapping(result, c) if result.network.cameras[c].has_plane_mapping else None


def _fields(
    result: Result, c: int, lens: CameraMapping, rows: Rows, distances: Sequence[float], directions: bool
) -> list[tuple[str, Markup]]:
    """Uncertainty of the projection of directions and at distances: description and figure of each."""
    network, values = result.network, result.fit.values
    away = values.xyz[network.point_of[rows]] - values.x0[network.image_of[rows]]
    usual = float(np.median(np.linalg.norm(away, axis=1)))
    # With a verdict, its map is that of directions.
    fields = [("directions", projection_field(lens, _PLACES))] if directions else []
    if network.behind_windows(c) or network.cameras[c].parallel:
        distances, usual = [], 0.0
    fields += [
        (
            f"points at {plain(distance, 3)} {network.unit}",
            projection_field_at(result, c, distance, across=_PLACES),
        )
        for distance in distances or ([usual] if directions and usual > 0 else [])
    ]
    return [
        (what, Markup(uncertainty_figure(field, network.xy[rows])))
        for what, field in fields
        if np.isfinite(field.sigma).any() and np.nanmax(field.sigma) > 0
    ]


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


_WORST = 20
"""Number of image points listed."""


def images_table(result: Result) -> list[tuple[str, ...]]:
    """Return a row for each image: points, residuals, factors on sigmas, reliability, orientation."""
    network = result.network
    v = np.where(result.rejected[:, None], np.nan, result.residuals)
    r, least, effect = (
        result.redundancy_numbers, result.minimal_detectable_errors(), result.external_reliability()
    )  # fmt: skip
    angle, sigma = np.degrees(result.angles), np.degrees(result.angle_sigma)
    q = np.sqrt(np.maximum(np.diagonal(result.pose_covariance, axis1=1, axis2=2), 0.0))[:, 3:]
    rows: list[tuple[str, ...]] = []
    for i, name in enumerate(network.images):
        at = network.rays_of_images[i]
        at = at[np.isfinite(v[at]).all(axis=1)]
        if not result.fit.usable.images[i]:
            rows.append((name, str(len(at)), "left out", *[""] * 7))
            continue
        rows.append(
            (
                name,
                str(len(at)),
                _pair(np.sqrt((v[at] ** 2).mean(axis=0)), ".3f"),
                _pair(result.variance_factors[i], ".2f"),
                _pair(r[at].mean(axis=0), ".2f"),
                f"{_median(least[at]):.2g}",
                f"{_largest(effect[at]):.2g}",
                " / ".join(f"{s:.2g}" for s in q[i]),
                " / ".join(f"{a:.4f}" for a in angle[i]),
                " / ".join(f"{s:.2g}" for s in sigma[i]),
            )
        )
    return rows


def worst_points(result: Result) -> list[tuple[str, ...]]:
    """Return the image points with the largest test values, with their reliability."""
    network, w = result.network, np.nan_to_num(result.test_values)
    order = np.argsort(-w.max(axis=1), kind="stable")[:_WORST]
    v, r = result.residuals, result.redundancy_numbers
    least, effect = result.minimal_detectable_errors(), result.external_reliability()
    return [
        (
            network.images[network.image_of[k]],
            network.points[network.point_of[k]],
            _pair(v[k], ".3f"),
            _pair(r[k], ".2f"),
            _pair(w[k], ".1f"),
            _pair(least[k], ".2g"),
            _pair(effect[k], ".2g"),
        )
        for k in order
        if w[k].max() > 0
    ]


def left_out_table(result: Result) -> list[tuple[str, str, str, str]]:
    """Return the rejected image points: image, point, test value, bound; gross errors without these."""
    return [
        (image, point, f"{value:.1f}", f"{critical:.1f}")
        if value == value
        else (image, point, "gross error", "")
        for image, point, value, critical in result.rejected_points()
    ]


def components_table(result: Result) -> list[tuple[str, str, str, str]]:
    """Return variance components: name, factor, its standard deviation, redundancy."""
    found = result.components
    if found is None:
        return []
    columns = zip(found.names, found.factors, found.sigma, found.redundancy, strict=True)
    return [(name, f"{factor:.3f}", f"{sigma:.2g}", f"{r:.1f}") for name, factor, sigma, r in columns]


def dropped_table(result: Result) -> dict[str, Any] | None:
    """Return dropped parameters and the errors of prediction before and after; None without elimination."""
    if result.eliminated is None:
        return None
    before, after = result.validation or (np.nan, np.nan)
    return {
        "steps": [
            (step.camera, step.test.name, f"{step.test.statistic:.2f}", f"{step.test.critical:.2f}",
             f"{step.test.p:.2g}", f"{step.sigma0:.5g}")
            for step in result.eliminated
        ],
        "before": f"{before:.4g}",
        "after": f"{after:.4g}",
    }  # fmt: skip


def _pair(values: Array, form: str) -> str:
    return " / ".join(f"{value:{form}}" if np.isfinite(value) else "–" for value in values)


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _largest(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else float("nan")


_PANELS, _FIGURES_ACROSS = 8, 4
"""Number of groups of images drawn, and number of panels side by side."""
_SURE = 0.01
"""Level at which the shift of a single class is marked as significant."""


def patterns_of(result: Result) -> list[dict[str, Any]]:
    """Return the common residuals of a network: by place in each camera's image, and by groups of images.

    Without a test, `why_not` gives the reason.
    """
    network = result.network
    patterns = [
        (f"at the same place in all images of {camera.label}", by_place(result, c), False)
        for c, camera in enumerate(network.cameras)
    ]
    if any(group is not None for group in network.groups):
        patterns.append(
            ("of the same point in the images of a group", by_point(result, network.groups), True)
        )
    found = list[dict[str, Any]]()
    for title, key, grouped in patterns:
        try:
            pattern = common_pattern(result, key)
        except UsageError as error:
            found.append({"title": title, "why_not": error.what})
            continue
        found.append(
            {
                "title": title,
                "classes": len(pattern.count),
                "statistic": f"{pattern.statistic:.2f}",
                "degrees": " and ".join(str(degree) for degree in pattern.degrees),
                "p": f"{pattern.p:.2g}",
                "rms": f"{pattern.rms:.2g}",
                "sigma0": f"{pattern.sigma0:.4g}",
                "figure": Markup(_figure(result, pattern, grouped)),
            }
        )
    return found


def _figure(result: Result, pattern: CommonPattern, grouped: bool) -> str:
    """Draw shifts as arrows at their mean places, one panel for each group; significant ones in colour."""
    network = result.network
    labels = np.full(len(pattern.count), "", dtype=object)
    if grouped:
        seen = pattern.key >= 0
        labels[pattern.key[seen]] = np.array(network.groups, dtype=object)[network.image_of[seen]]
    names = list(dict.fromkeys(labels))[:_PANELS]
    across = min(len(names), _FIGURES_ACROSS)
    down = -(-len(names) // across)
    camera = network.cameras[0]
    shape = camera.height / camera.width
    size = np.hypot(*pattern.shift.T)
    typical = float(np.quantile(size, 0.9)) or 1.0
    enlarged = nice((0.1 if grouped else 0.04) * camera.width / typical)
    sure = pattern.p_at < _SURE
    width = 8.6 if across > 1 else 6.0
    with sheet((width, 0.5 + width * down * shape / across)) as figure:
        grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        for axes in grid.flat[len(names) :]:
            axes.remove()
        for axes, name in zip(grid.flat, names, strict=False):
            for chosen, colour in (((labels == name) & ~sure, INK), ((labels == name) & sure, ACCENT)):
                draw_arrows(axes, pattern.xy[chosen], enlarged * pattern.shift[chosen], colour)
            axes.set_xlim(0, camera.width)
            axes.set_ylim(camera.height, 0)
            axes.set_aspect("equal")
            axes.label_outer()
            axes.set_title(str(name), color=FAINT if not grouped else INK)
        figure.supxlabel("x / px")
        figure.supylabel("y / px")
        figure.suptitle(f"shifts × {enlarged:g}; longest {size.max():.2g} px", fontsize=10.5)
        return to_svg(figure)
