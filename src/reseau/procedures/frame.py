"""The inner orientation of scanned frames of 35 and 70 mm film, after Cruz, Cardenal and Delgado.

S. Cruz, J. Cardenal and J. Delgado, A program for automatic inner orientation of digitized non metric images
(35 and 70 mm). Its steps in its order: search areas, the four edges as one case, the edge in each channel by
transverse profiles, lines without blunders and their intersections (2.2), then the photo-coordinate system at
the intersection of the diagonals with its x-axis along the lower edge, the scale, and the transformation to
calibrated corners (2.3). How each step is done here is told where it is done, in `refine`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..core.failure import Failure
from ..io import FrameCorners, FrameOrientation
from ..io.scans import Scan
from ..measure.film import FrameOptions, FrameResult, Kind, Roll, orient_frames, roll_of, transformed

__all__ = ["FrameOptions", "FrameResult", "Roll", "described", "helped", "orient_scan", "roll_of"]


def orient_scan(scan: Scan, options: FrameOptions | None = None) -> list[FrameResult]:
    """Sections 2.1 and 2.2: search areas, edges, lines and corners of every frame of a scan.

    Parameters
    ----------
    scan : Scan
        The scan, opened.
    options : FrameOptions, optional
        What is known of its frames.
    """
    return orient_frames(scan, options)


def helped(scan: Scan, roll: Roll, before: Sequence[FrameResult], options: FrameOptions) -> list[FrameResult]:
    """A scan whose frames were doubtful, again with what the roll knows, where that is better."""
    again = orient_frames(scan, roll.options(options))
    order = {"oriented": 2, "three-edges": 1, "declined": 0}

    def worth(results: Sequence[FrameResult]) -> int:
        return max(order[result.status] for result in results)

    better = worth(again) > worth(before) or (worth(again) == worth(before) == 1)
    if not better:
        return list(before)
    note = f"by the shape of {roll.frames} frames of its roll"
    return [replace(r, why=f"{r.why}; {note}" if r.why else note) for r in again]


def described(
    result: FrameResult, calibrated: FrameCorners | None = None, kind: Kind = "affine"
) -> FrameOrientation | Failure:
    """Section 2.3: photo-coordinate system and scale, and the transformation where corners are calibrated.

    Parameters
    ----------
    result : FrameResult
        A frame, oriented or declined.
    calibrated : FrameCorners, optional
        Corners of the camera.
    kind : str
        The transformation.
    """
    document = result.document()
    if calibrated is None or not result:
        return document
    found = transformed(document, calibrated, kind)
    return found if isinstance(found, Failure) else document.model_copy(update={"transform": found})
