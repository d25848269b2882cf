"""The film-frame procedure: inner orientation of scanned frames of 35 and 70 mm film (Cruz et al.).

S. Cruz, J. Cardenal and J. Delgado, A program for automatic inner orientation of digitized non metric images
(35 and 70 mm). Section 2.2: search areas, edges by transverse profiles in each channel, robust lines and
their intersections. Section 2.3: the photo-coordinate system at the intersection of the diagonals with its
x-axis along the lower edge, the scale, and the transformation to calibrated corners. The modules of
:mod:`reseau.measure.film` describe each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..calibration.document import Quantity
from ..core.data import Array
from ..core.failure import Failure
from ..io import FrameCorners, FrameOrientation
from ..io.scans import Scan
from ..measure.film import orient_frames
from ..measure.film.orientation import FrameOptions, FrameResult
from ..measure.film.perforations import FilmPlane
from ..measure.film.roll import Kind, Roll, transformed

__all__ = ["FrameOptions", "FrameResult"]


def orient_scan(scan: Scan, options: FrameOptions | None = None) -> list[FrameResult]:
    """Measure edges, lines and corners of every frame of a scan, sections 2.1 and 2.2.

    Parameters
    ----------
    scan : Scan
        The scan.
    options : FrameOptions, optional
        Prior knowledge of its frames.

    Returns
    -------
    list of FrameResult
        One for each frame; falsy ones are declined, with the reason in `why`.

    Examples
    --------
    :func:`reseau.measure.film.orient_frames` has an example with a frame; a scan without one is declined:

    >>> from reseau.io.scans import scan_of
    >>> (found,) = orient_scan(scan_of(np.full((60, 90), 128, np.uint8), "07.tif"))
    >>> bool(found), found.why
    (False, 'is of one tone; scan it with more exposure')
    """
    return orient_frames(scan, options)


def reorient_scan(
    scan: Scan, rolls: Sequence[Roll], before: Sequence[FrameResult], options: FrameOptions
) -> list[FrameResult]:
    """Repeat a scan with the frame shape of its roll; return the better results.

    Of several rolls that with which the frames are most complete counts; where two are equal, none does.

    Parameters
    ----------
    scan : Scan
        The scan.
    rolls : sequence of Roll
        Shapes of the other frames of the roll, or of each roll that it may be of.
    before : sequence of FrameResult
        Results without it.
    options : FrameOptions
        Prior knowledge of its frames.

    Returns
    -------
    list of FrameResult
        The repeated results if they are as complete, otherwise `before`.

    Examples
    --------
    A scan without a frame is declined with the shape of its roll as well:

    >>> from reseau.io.scans import scan_of
    >>> from reseau.measure.film.lines import FrameShape
    >>> corners = FrameCorners.from_xy([[-18, 12], [18, 12], [18, -12], [-18, -12]])
    >>> roll = Roll(corners, FrameShape(36.0, 24.0), px_per_mm=4.0, frames=12, scatter_mm=(0.01, 0.01))
    >>> scan, options = scan_of(np.full((136, 184), 128, np.uint8), "07.tif"), FrameOptions()
    >>> reorient_scan(scan, [roll], orient_scan(scan, options), options)
    [<FrameResult: image 07.tif, status declined, reason is of one tone; scan it with more exposure>]
    """
    order = {"oriented": 2, "three-edges": 1, "declined": 0}

    def best(results: Sequence[FrameResult]) -> int:
        return max(order[result.status] for result in results)

    # The format of a frame that is oriented is known.
    known = {r.format_mm for r in before if r} or {each.format_mm for each in rolls}
    tried = [(orient_frames(scan, each.options(options)), each) for each in rolls if each.format_mm in known]
    tried.sort(key=lambda one: -best(one[0]))
    # What the roll has in common is additional knowledge of a frame that is as complete without it.
    if not tried or best(tried[0][0]) < max(best(before), 1):
        return list(before)
    again, roll = tried[0]
    if len(tried) > 1 and best(tried[1][0]) == best(again):
        return list(before)
    note = f"by the shape of {roll.frames} frames of its roll"
    return [
        replace(r, why=f"{r.why}; {note}" if r.why else note, roll_frames=roll.frames) if r else r
        for r in again
    ]


def orientation_of(
    result: FrameResult, calibrated: FrameCorners | None = None, kind: Kind = "affine"
) -> FrameOrientation | Failure:
    """Return photo-coordinate system and scale, and the transformation to calibrated corners, section 2.3.

    Parameters
    ----------
    result : FrameResult
        A frame, oriented or declined.
    calibrated : FrameCorners, optional
        Calibrated corners of the camera.
    kind : str
        Kind of the transformation.

    Returns
    -------
    FrameOrientation or Failure
        The document of the frame; a failure if the transformation is not determined.

    Examples
    --------
    >>> found = FrameResult("07.tif", "declined", "of one tone", None, None, None, {})
    >>> document = orientation_of(found)
    >>> document.status, document.why, document.principal_point
    ('declined', 'of one tone', None)
    """
    document = result.document()
    if calibrated is None or not result:
        return document
    found = transformed(document, calibrated, kind)
    return found if isinstance(found, Failure) else document.model_copy(update={"transform": found})


def film_scale(plane: FilmPlane) -> dict[str, Quantity]:
    """Return the geometry of a scan from the perforations of its film, at the centre of the scan.

    Parameters
    ----------
    plane : FilmPlane
        The film plane; see :func:`reseau.measure.film.film_plane`.

    Returns
    -------
    dict of str to Quantity
        Scales across and along the film (px/mm), rotation of the film (deg), angle between its axes minus 90°
        (deg), and relative change of the scale from edge to edge of the scan across and along the film (%).

    Examples
    --------
    >>> values = np.array([25.0, 0, 0, 0, 25.0, 0, 0, 0, 0])
    >>> plane = FilmPlane(values, 1e-4 * np.eye(9), np.zeros(2), 1000.0, np.zeros((0, 2)), 0.1)
    >>> scale = film_scale(plane)["scale across"]
    >>> round(scale.value, 3), round(scale.sigma, 3), scale.unit
    (40.0, 0.016, 'px/mm')
    """
    units = ("px/mm", "px/mm", "deg", "deg", "%", "%")
    names = ("scale across", "scale along", "rotation", "skew", "change across", "change along")

    def quantities(values: Array) -> Array:
        at = replace(plane, values=values)
        across, along = _columns(at, np.zeros(2))
        rotation = np.arctan2(across[1], across[0])
        skew = np.arctan2(-along[0], along[1]) - rotation
        sides = [(k, sign * plane.unit * np.eye(2)[k]) for k in (0, 1) for sign in (-1, 1)]
        ends = [np.hypot(*_columns(at, offset)[k]) for k, offset in sides]
        changes = 100 * (1 - np.array([ends[1] / ends[0], ends[3] / ends[2]]))
        scales = 1 / np.hypot(*across), 1 / np.hypot(*along)
        return np.array([*scales, -np.rad2deg(rotation), np.rad2deg(skew), *changes])

    step = np.sqrt(np.diag(plane.covariance))
    slope = np.array(
        [quantities(plane.values + e) - quantities(plane.values - e) for e in np.diag(step)]
    ).T / (2 * np.maximum(step, 1e-300))
    found, sigma = quantities(plane.values), np.sqrt(np.diag(slope @ plane.covariance @ slope.T))
    return {
        name: Quantity(value=float(v), sigma=float(s), unit=unit)
        for name, v, s, unit in zip(names, found, sigma, units, strict=True)
    }


def _columns(plane: FilmPlane, offset: Array) -> Array:
    """Derivatives (2, 2) of film coordinates (mm) by pixel coordinates, at an offset from the centre."""
    half = 0.5 * np.eye(2)
    centre = plane.centre + offset
    return np.asarray(plane.to_mm(centre + half) - plane.to_mm(centre - half))
