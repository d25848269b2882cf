"""The section of the report on PHOTO III: true coordinates of a body without control points."""

from __future__ import annotations

from collections import Counter

import numpy as np
from markupsafe import Markup

from ..core.data import Array, Frame
from ..core.numbers import aligned
from ..io import ReseauDesign
from ..procedures.oscilloscope import PhotoIII
from .maps import PROBABILITY, body_map
from .overlay import Arcs, Marks, frame_overlay, marks_of
from .tables import Item, Row
from .truth import BodyComparison

_SHOWN_FROM = 0.2
"""Brightness, relative to the brightest echo, above which a rejected spot is crossed out in the picture."""


def photo_iii_section(
    found: PhotoIII, design: ReseauDesign, frame: Frame | None, truth: BodyComparison | None
) -> Row:
    """Return the content of the section's template.

    Parameters
    ----------
    found : PhotoIII
        Result of the procedure.
    design : ReseauDesign
        The rods of the test object.
    frame : Frame or None
        The photograph; None omits the picture.
    truth : BodyComparison or None
        Comparison with the truth of a simulator.
    """
    errors = None if truth is None else errors_of(found, truth)
    drawn, enlarged = body_map(found.true, design.xy, design.unit, errors)
    measured = found.measured
    declined = Counter() if measured is None else Counter(why for why in measured.why if why)
    return {
        "name": "PHOTO III" if frame is None else frame.name,
        "summary": _summary(found, design.unit, truth),
        "frame": None if frame is None else Markup(_overlay(found, frame)),
        "crossed": measured is not None and bool((~measured.ok & (measured.strength >= _SHOWN_FROM)).any()),
        "declined": declined.most_common(),
        "notes": found.notes,
        "map": Markup(drawn),
        "enlarged": f"{enlarged:g}",
        "probability": f"{PROBABILITY * 100:g}",
        "points": _points(found, truth),
        "truth": None if truth is None else _truth(truth, design.unit),
        "strays": 0 if truth is None else truth.strays,
    }


def errors_of(found: PhotoIII, truth: BodyComparison) -> Array:
    """Return the errors of the true coordinates (n, 2), NaN for points that the truth does not contain."""
    unknown = (np.nan, np.nan)
    return np.array([truth.errors.get(name, unknown) for name in found.true.names]).reshape(-1, 2)


def _summary(found: PhotoIII, unit: str, truth: BodyComparison | None) -> list[Item]:
    sigma = np.sqrt((found.true.sigma**2).mean(axis=0))
    number = str(len(found.true)) if truth is None else f"{truth.points}\u2009/\u2009{truth.known}"
    items = [
        (number, "", "points of the body measured"),
        (f"{np.sqrt((found.points.sigma**2).mean()):.3f}", "px", "standard deviation of a coordinate"),
        (f"{sigma[0]:.3f}", unit, "standard deviation of X"),
        (f"{sigma[1]:.3f}", unit, "standard deviation of Y"),
    ]
    if truth is not None:
        items.append((f"{np.hypot(*truth.error):.3f}", unit, "rms error of a point"))
    return items


def _overlay(found: PhotoIII, frame: Frame) -> str:
    """Points with their names; bright rejected spots are crossed out."""
    measured = found.measured
    if measured is None:
        labels = {name: name for name in found.points.names}
        return frame_overlay(frame, marks_of(found.points, None, labels=labels))
    points = measured.points
    show = measured.ok | (measured.strength >= _SHOWN_FROM)
    every = np.full(len(measured), "", dtype=object)
    every[measured.ok] = points.names
    arcs = Arcs(*(column[show] for column in (measured.length, measured.curvature, measured.tilt)))
    labels = {name: name for name in points.names}
    return frame_overlay(
        frame, Marks(tuple(every[show]), measured.xy[show], measured.ok[show], (), arcs, labels)
    )


def _points(found: PhotoIII, truth: BodyComparison | None) -> list[tuple[str, ...]]:
    """True coordinates with sigmas; with the truth also the names of the true points and the errors."""
    true = found.true
    columns = [
        *(aligned(true.xy[:, k], 3) for k in range(2)),
        *(aligned(true.sigma[:, k], 3) for k in range(2)),
    ]
    if truth is not None:
        errors = errors_of(found, truth)
        columns += [[truth.identity.get(name, "–") for name in true.names]]
        columns += [aligned(errors[:, k], 3) for k in range(2)]
    return [(name, *cells) for name, *cells in zip(true.names, *columns, strict=True)]


def _truth(truth: BodyComparison, unit: str) -> list[tuple[str, ...]]:
    """Comparison with the truth: quantity, x, y, unit."""
    return [
        ("error of the measured positions", *aligned(truth.position_px, 3), "px"),
        ("the same in units of their standard deviations", *aligned(truth.position_normalised, 2), ""),
        ("error of the true coordinates", *aligned(truth.error, 3), unit),
        ("their standard deviations", *aligned(truth.sigma, 3), unit),
        ("the errors in units of their standard deviations", *aligned(truth.error_normalised, 2), ""),
    ]
