"""One picture that shows a correction at a glance: the photograph, and what is left before and after."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.figure import Figure

from ..data import Frame, ImagePoints
from ..errors import UsageError
from ..procedures.oscilloscope import PhotoI
from .comparison import similarity_residuals
from .figures import draw_vectors
from .overlay import preview
from .style import BLUE, drawing

__all__ = ["overview_png"]


def overview_png(found: PhotoI, frame: Frame, unit: str) -> bytes:
    """Draw the overview.

    Parameters
    ----------
    found : PhotoI
        The correction, fitted here.
    frame : Frame
        The photograph.
    unit : str
        Of the design.

    Returns
    -------
    bytes
        A PNG, the same to the byte for the same input.

    Raises
    ------
    UsageError
        When the correction was read from a file.
    """
    fit = found.camera.fit
    if fit is None:
        raise UsageError("was read from a file and has no residuals", where="correction")
    marks = found.points.select(fit.check.names)
    check_photo = ImagePoints(marks.names, found.camera.photo_system(marks.xy), marks.cov)
    before, before_check = similarity_residuals(fit.points, fit.target, check_photo, fit.check_target)
    after_check = fit.check.xy - fit.check_target
    with drawing():
        figure = Figure(figsize=(10.4, 2.75), layout="constrained", facecolor="white")
        picture, left, right = figure.subplots(1, 3, width_ratios=(1.02, 1, 1))
        grey = preview(frame, 640)
        extent = (-0.5, frame.width - 0.5, frame.height - 0.5, -0.5)
        picture.imshow(grey, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="antialiased")
        picture.plot(*found.points.xy.T, "o", ms=4, mfc="none", mec=BLUE, mew=0.7)
        picture.set_title("the photograph, marks measured", loc="left")
        picture.set_xticks([])
        picture.set_yticks([])
        pairs = (
            (left, before, before_check, "best similarity"),
            (right, fit.residuals, after_check, "corrected"),
        )
        for axes, residuals, held, title in pairs:
            rms = np.sqrt((residuals**2).sum(axis=1).mean())
            shown = f"{rms * 1000:.3g} µm" if unit == "mm" else f"{rms:.3g} {unit}"
            draw_vectors(
                axes, (fit.target, residuals), (fit.check_target, held), unit, f"{title}: rms {shown}"
            )
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=120, metadata={"Software": None})
    return stream.getvalue()
