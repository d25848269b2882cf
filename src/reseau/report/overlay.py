"""A frame with what was found in it, as an SVG element: the picture as JPEG, marks as lines over it."""

from __future__ import annotations

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

from ..data import Array, Frame, Mask
from .style import ACCENT

__all__ = ["frame_overlay", "preview"]

_WIDTH = 1200
_FOUND, _CHECK = "#1f8a70", "#e0a100"


def preview(frame: Frame, width: int = _WIDTH) -> NDArray[np.uint8]:
    """The frame in 8 bits, between its 0.1 and 99.9 percentiles, at most so wide."""
    step = max(1, frame.pixels.size // 1_000_000)
    low, high = np.percentile(frame.pixels.reshape(-1)[::step], [0.1, 99.9])
    factor = min(1.0, width / frame.width)
    size = (max(1, round(frame.width * factor)), max(1, round(frame.height * factor)))
    kind = frame.pixels.dtype if frame.pixels.dtype in (np.uint8, np.uint16, np.int16) else np.float32
    small = cv2.resize(frame.pixels.astype(kind, copy=False), size, interpolation=cv2.INTER_AREA)
    stretched = 255 * (small.astype(np.float32) - low) / max(float(high - low), 1e-9)
    grey: NDArray[np.uint8] = np.clip(np.rint(stretched), 0, 255).astype(np.uint8)
    return grey


def frame_overlay(frame: Frame, ids: tuple[str, ...], xy: Array, ok: Mask, check: tuple[str, ...]) -> str:
    """Draw the marks over the frame.

    Parameters
    ----------
    frame : Frame
        What was measured in.
    ids : tuple of str (n,)
        Marks.
    xy : ndarray (n, 2)
        Positions of those measured, predictions of the others; NaN where there is neither.
    ok : ndarray of bool (n,)
        Which were measured.
    check : tuple of str
        Which were held out.

    Returns
    -------
    str
        An SVG element in the pixels of the frame.
    """
    _, coded = cv2.imencode(".jpg", preview(frame), [cv2.IMWRITE_JPEG_QUALITY, 82])
    picture = base64.b64encode(coded.tobytes()).decode()
    unit = frame.width / 1000
    width, height = frame.width, frame.height
    parts = [
        f'<svg class="frame" viewBox="-0.5 -0.5 {width} {height}" role="img">',
        f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" '
        f'href="data:image/jpeg;base64,{picture}"/>',
    ]
    held = set(check)
    for name, (x, y), found in zip(ids, xy, ok, strict=True):
        if not np.isfinite([x, y]).all():
            continue
        colour = (_CHECK if name in held else _FOUND) if found else ACCENT
        r = 7.5 * unit
        if found:
            shape = f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{r:.2f}"/>'
        else:
            d = r * 0.8
            shape = (
                f'<path d="M{x - d:.2f} {y - d:.2f}l{2 * d:.2f} {2 * d:.2f}m0 {-2 * d:.2f}'
                f'l{-2 * d:.2f} {2 * d:.2f}"/>'
            )
        parts.append(f'<g fill="none" stroke="{colour}" stroke-width="{1.7 * unit:.2f}">{shape}</g>')
    return "".join(parts) + "</svg>"
