"""Pictures of oriented frames: copies with marked corners, and an overview of all frames."""

from __future__ import annotations

import mmap
from base64 import b64encode
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array
from ..core.errors import InputError
from ..io import FrameOrientation
from ..io.frame import RollSummary
from ..io.images import write_image
from ..io.scans import Scan
from ..measure.film.orientation import FrameResult
from .template import rendered

_STRIPE, _UNWRITTEN = 512, 50_000_000
"""Rows copied at a time, and bytes that are held before they are written."""
_SIDE, _ZOOM, _PART = 420, 208, 0.02
"""Side of the picture of a frame and of a corner in pixels, and the least part of an edge shown on both sides
of a corner."""
_LABEL = 22
"""Height of the line above the picture of a frame."""
_WORDS = {
    "oriented": "oriented",
    "three-edges": "three edges",
    "declined": "declined",
    "failed": "not read",
}
_COLOURS = {"oriented": (60, 170, 60), "three-edges": (230, 150, 30), "declined": (200, 50, 50)}


def write_marked(path: Path, scan: Scan, corners: Sequence[Array]) -> None:
    """Write a copy of a scan, TIFF, with the pixels of the corners marked (Cruz et al., sect. 2.3).

    Parameters
    ----------
    path : Path
        File to write; it is complete or not written at all.
    scan : Scan
        The scan, copied stripe by stripe.
    corners : sequence of ndarray (4, 2)
        Corners of each frame. The pixel of a corner becomes white, in a black cross of 15 px with a gap.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    import tifffile

    grey = len(scan.channels) == 1
    shape = (scan.height, scan.width) if grey else (scan.height, scan.width, 3)
    draft = path.with_name(f".{path.name}.draft")
    resolution = None if scan.dpi is None else (scan.dpi, scan.dpi)
    written = 0
    try:
        image = tifffile.memmap(
            draft,
            shape=shape,
            dtype=scan.dtype,
            photometric="minisblack" if grey else "rgb",
            resolution=resolution,
        )
        for top in range(0, scan.height, _STRIPE):
            bottom = min(top + _STRIPE, scan.height)
            part = scan.window(top, bottom, 0, scan.width)
            image[top:bottom] = part[:, :, 0] if grey else part
            written += part.nbytes
            if written > _UNWRITTEN and hasattr(mmap, "MADV_DONTNEED"):
                # Rows that are written no longer count as memory of this process.
                image.flush()
                image._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]
                written = 0
        for xy in np.concatenate(list(corners)) if corners else ():
            _mark(image, xy, scan.full_scale)
        image.flush()
        del image
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise InputError(f"cannot be written ({error.strerror})", where=path) from None


def _mark(image: NDArray[Any], xy: Array, white: float) -> None:
    column, row = (int(v) for v in np.rint(xy))
    h, w = image.shape[:2]
    for away in (*range(-7, -1), *range(2, 8)):
        for r, c in ((row + away, column), (row, column + away)):
            if 0 <= r < h and 0 <= c < w:
                image[r, c] = 0
    if 0 <= row < h and 0 <= column < w:
        image[row, column] = white


def write_cut(path: Path, scan: Scan, corners: Array) -> None:
    """Write one frame of a scan upright, between its corners, with the pixels of the scan.

    Parameters
    ----------
    path : Path
        File to write.
    scan : Scan
        The scan.
    corners : ndarray (4, 2)
        Corners ul, ur, lr, ll, pixels; they become the centres of the picture's outermost pixels.
    """
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 2, 0, None)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 3, [scan.width, scan.height])
    part = np.ascontiguousarray(scan.window(low[1], high[1], low[0], high[0]))
    width, height = (
        round(float(np.hypot(*(corners[1] - corners[0])))),
        round(float(np.hypot(*(corners[3] - corners[0])))),
    )
    goal = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    moved = cv2.getPerspectiveTransform((corners - low).astype(np.float32), goal)
    cut = cv2.warpPerspective(part, moved, (width + 1, height + 1), flags=cv2.INTER_CUBIC)
    write_image(path, cut)


def frame_tile(scan: Scan, found: FrameOrientation) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) of one frame with its edges, and enlarged pictures of its corners."""
    overview, r = scan.overview(_SIDE)
    step = np.quantile(overview, [0.002, 0.998]).astype(np.float64)
    small = _shown(overview, step)
    tile = np.full((_SIDE + _LABEL, _SIDE + 2 * _ZOOM + 8, 3), 255, dtype=np.uint8)
    points = found.image_points().xy
    colour = _COLOURS[found.status]
    if len(points):
        at = np.rint(((points + 0.5) / r - 0.5) * 16).astype(np.int32)
        cv2.polylines(small, [at], True, colour, 1, cv2.LINE_AA, 4)
        for k in range(4):
            zoom = _corner(scan, points, k, step, colour)
            y, x = _LABEL + (k // 2) * (_ZOOM + 4), _SIDE + 4 + ((k in (1, 2)) * (_ZOOM + 4))
            tile[y : y + _ZOOM, x : x + _ZOOM] = zoom
    tile[_LABEL : _LABEL + small.shape[0], : small.shape[1]] = small
    text = f"{found.image}  {found.status}"
    # OpenCV's built-in fonts contain ASCII characters only.
    text = text.encode("ascii", "replace").decode()
    cv2.putText(tile, text, (2, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (34, 39, 43), 1, cv2.LINE_AA)
    return tile


def scan_overlay(path: Path, scan: Scan, results: Sequence[FrameResult]) -> None:
    """Write a scan with the edges and corners of all its frames, and what was not found, as PNG.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    from ..core.overlay import draw_overlay

    pixels = scan.window(0, scan.height, 0, scan.width)
    title = f"{scan.name}: {', '.join(result.status for result in results)}"
    reasons = [
        f"frame {k + 1}: {r.why}" if len(results) > 1 else r.why for k, r in enumerate(results) if r.why
    ]
    layers = [layer for result in results for layer in result.layers()]
    draw_overlay(pixels[:, :, 0] if pixels.shape[2] == 1 else pixels, layers, title, reasons, path)


def _shown(grey: NDArray[Any], step: Array) -> NDArray[np.uint8]:
    """Grey values between two limits as 8-bit RGB."""
    scaled = np.clip((grey.astype(np.float32) - step[0]) / max(step[1] - step[0], 1e-9), 0, 1) * 255
    eight = np.rint(scaled).astype(np.uint8)
    return np.ascontiguousarray(eight if eight.shape[2] == 3 else np.repeat(eight, 3, axis=2))


def _corner(
    scan: Scan, points: Array, k: int, step: Array, colour: tuple[int, int, int]
) -> NDArray[np.uint8]:
    """An enlarged picture of a corner with its two edges."""
    side = float(np.hypot(*(points[(k + 1) % 4] - points[k])))
    half = max(_ZOOM // 8, round(_PART * side))
    zoom = _ZOOM / (2 * half)
    column, row = (int(v) for v in np.rint(points[k]))
    top, left = max(row - half, 0), max(column - half, 0)
    bottom, right = min(row + half, scan.height), min(column + half, scan.width)
    canvas = np.full((_ZOOM, _ZOOM, 3), 255, dtype=np.uint8)
    if bottom <= top or right <= left:
        return canvas
    part = np.full((2 * half, 2 * half, len(scan.channels)), scan.full_scale, dtype=np.float32)
    seen = scan.window(top, bottom, left, right)
    part[top - row + half : bottom - row + half, left - column + half : right - column + half] = seen
    how = cv2.INTER_NEAREST if zoom >= 1 else cv2.INTER_AREA
    canvas = cv2.resize(_shown(part, step), (_ZOOM, _ZOOM), interpolation=how).astype(np.uint8)
    for other in (points[k - 1], points[(k + 1) % 4]):
        ends = (np.array([points[k], other]) - [column - half, row - half] + 0.5) * zoom - 0.5
        way = ends[1] - ends[0]
        ends[1] = ends[0] + way / np.hypot(*way) * 200
        cv2.polylines(canvas, [np.rint(ends * 16).astype(np.int32)], False, colour, 1, cv2.LINE_AA, 4)
    return canvas


def contact_sheet(path: Path, tiles: Sequence[NDArray[np.uint8]]) -> None:
    """Write pictures of frames as one sheet, at most six in a row."""
    if not tiles:
        return
    across = min(6, int(np.ceil(np.sqrt(len(tiles)))))
    h, w = tiles[0].shape[:2]
    down = -(-len(tiles) // across)
    sheet = np.full((down * (h + 8), across * (w + 8), 3), 255, dtype=np.uint8)
    for i, tile in enumerate(tiles):
        y, x = (i // across) * (h + 8), (i % across) * (w + 8)
        sheet[y : y + h, x : x + w] = tile
    write_image(path, sheet)


def roll_page(summary: RollSummary, picture_of: Callable[[str], NDArray[np.uint8] | None]) -> str:
    """Return an HTML page of a roll: numbers, and each frame with its picture and why it was declined.

    Parameters
    ----------
    summary : RollSummary
        What became of the frames.
    picture_of : callable
        Returns the picture of the frame of a name, see :func:`frame_tile`; None: it is left out.
    """
    rows = []
    for frame in summary.frames:
        picture, shown = picture_of(frame.name), ""
        if picture is not None:
            # The whole frame beside its corners; half the size is enough on a page of a roll, which names it.
            small = cv2.resize(picture[_LABEL:], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            coded = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
            shown = b64encode(coded).decode()
        # A reason begins with the file, of which the row has the name.
        rows.append({"frame": frame, "why": frame.why.split(f"{frame.image}: ")[-1], "picture": shown})
    return rendered(
        "roll.html.j2", title="Frames of a roll", counts=summary.counts(), rows=rows, words=_WORDS
    )
