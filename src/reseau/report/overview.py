"""An overview of the procedure in one figure: the photographs, and below each its result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.data import Array, Frame
from ..core.errors import UsageError
from ..core.figures import ACCENT, BLUE, Panel, draw_vectors, drawing, length, to_bytes
from ..io import ReseauDesign
from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII
from ..refine import CorrectionFit
from .figures import draw_distortion
from .maps import draw_body
from .overlay import preview
from .photo_iii import errors_of
from .tables import rms
from .truth import Comparison


def overview_png(
    first: PhotoI,
    second: PhotoII,
    test_object: ReseauDesign,
    third: PhotoIII,
    frames: Sequence[Frame],
    truth: Comparison | None = None,
) -> bytes:
    """Draw the overview.

    Parameters
    ----------
    first, second, third : PhotoI, PhotoII, PhotoIII
        Results.
    test_object : ReseauDesign
        The rods.
    frames : sequence of Frame (3)
        The photographs.
    truth : Comparison, optional
        Comparison with the truth of a simulator.

    Returns
    -------
    bytes
        A PNG, the same to the byte for the same input.

    Raises
    ------
    UsageError
        When a correction was read from a file.
    """
    fit, instrument = first.camera.fit, second.instrument
    if fit is None or instrument.fit is None:
        raise UsageError("was read from a file and has no residuals", where="correction")
    unit = test_object.unit
    with drawing():
        figure = Figure(figsize=(10.4, 6.2), layout="constrained", facecolor="white")
        photos, results = figure.subplots(2, 3, height_ratios=(1, 1.16))
        _photo(photos[0], frames[0], first.points.xy, "PHOTO I: the reseau")
        _photo(photos[1], frames[1], second.pins.xy, "PHOTO II: a test object behind it")
        _photo(photos[2], frames[2], third.points.xy, "PHOTO III: an unknown body")
        _camera(results[0], fit, unit)
        draw_distortion(
            results[1],
            instrument.model,
            instrument.fit.target,
            Panel(unit, 10.0, labels=("x", "y")),
            "distortion of the instrument",
        )
        _body(results[2], third, test_object, truth)
        return to_bytes(figure, "png", dpi=120)


def _photo(axes: Axes, frame: Frame, at: Array, title: str) -> None:
    extent = (-0.5, frame.width - 0.5, frame.height - 0.5, -0.5)
    axes.imshow(
        preview(frame, 640), cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="antialiased"
    )
    axes.plot(*at.T, "o", ms=4.5, mfc="none", mec=BLUE if np.median(frame.pixels) > 128 else ACCENT, mew=0.7)
    axes.set_title(title, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])


def _camera(axes: Axes, fit: CorrectionFit, unit: str) -> None:
    """Residuals of the marks after group A."""
    left = length(float(f"{rms(fit.residuals):.2g}"), unit)
    check = (fit.check_target, fit.check.xy - fit.check_target)
    draw_vectors(axes, (fit.target, fit.residuals), check, Panel(unit), f"camera corrected: rms {left}")


def _body(axes: Axes, third: PhotoIII, test_object: ReseauDesign, truth: Comparison | None) -> None:
    known = None if truth is None or not truth.bodies else truth.bodies[0]
    errors = None if known is None else errors_of(third, known)
    enlarged = draw_body(axes, third.true, test_object.xy, test_object.unit, errors, named=False)
    axes.set_title(f"true coordinates, ellipses {enlarged:g} times enlarged", loc="left")
