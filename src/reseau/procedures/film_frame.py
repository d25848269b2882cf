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

from ..core.failure import Failure
from ..io import FrameCorners, FrameOrientation
from ..io.scans import Scan
from ..measure.film import FrameOptions, FrameResult, Kind, Roll, orient_frames, roll_of, transformed

__all__ = ["FrameOptions", "FrameResult", "Roll", "orient_scan", "orientation_of", "reorient_scan", "roll_of"]


def orient_scan(scan: Scan, options: FrameOptions | None = None) -> list[FrameResult]:
    """Measure edges, lines and corners of every frame of a scan, sections 2.1 and 2.2.

    Parameters
    ----------
    scan : Scan
        The scan.
    options : FrameOptions, optional
        Prior knowledge of its frames.
    """
    return orient_frames(scan, options)


def reorient_scan(
    scan: Scan, roll: Roll, before: Sequence[FrameResult], options: FrameOptions
) -> list[FrameResult]:
    """Repeat a scan with the frame shape of its roll; return the better results.

    Parameters
    ----------
    scan : Scan
        The scan.
    roll : Roll
        Shape of the other frames of the roll.
    before : sequence of FrameResult
        Results without it.
    options : FrameOptions
        Prior knowledge of its frames.
    """
    again = orient_frames(scan, roll.options(options))
    order = {"oriented": 2, "three-edges": 1, "declined": 0}

    def best(results: Sequence[FrameResult]) -> int:
        return max(order[result.status] for result in results)

    better = best(again) > best(before) or (best(again) == best(before) == 1)
    if not better:
        return list(before)
    note = f"by the shape of {roll.frames} frames of its roll"
    return [replace(r, why=f"{r.why}; {note}" if r.why else note) for r in again]


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
    """
    document = result.document()
    if calibrated is None or not result:
        return document
    found = transformed(document, calibrated, kind)
    return found if isinstance(found, Failure) else document.model_copy(update={"transform": found})
