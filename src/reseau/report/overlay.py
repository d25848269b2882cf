"""A frame with measured marks as an SVG element: the picture as JPEG, the marks as lines."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from html import escape
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.data import Array, Frame, ImagePoints, Mask
from ..core.figures import ACCENT

_WIDTH = 1200
_FOUND, _CHECK = "#1f8a70", "#e0a100"
_ON_DARK = ("#35c79f", "#f0603f")
"""Colours of measured and rejected marks on the dark screen of an instrument."""

_AROUND = np.array([(0, -1), (0, 1), (1, 0), (-1, 0), (1, -1), (-1, -1), (1, 1), (-1, 1)])
"""Directions of a label from its mark."""


@dataclass(frozen=True, eq=False)
class Arcs:
    """Centre lines of the arcs of pins, in columns: v = ½·curvature·u² along a chord.

    Parameters
    ----------
    length, curvature, tilt : ndarray (n,)
        Length of the chord (px), curvature in the middle (1/px), angle of the chord with the rows (rad).
    """

    length: Array
    curvature: Array
    tilt: Array


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks drawn over a frame.

    Parameters
    ----------
    ids : tuple of str (n,)
        Names.
    xy : ndarray (n, 2)
        Measured positions, predicted positions of the others; NaN without either.
    ok : ndarray of bool (n,)
        True for measured marks.
    check : tuple of str
        Names of check marks.
    arcs : Arcs, optional
        Arcs to draw instead of circles.
    labels : dict
        Labels by name.
    shifts : ndarray (n, 2), optional
        Lines from the marks, in pixels of the frame; none for NaN.
    """

    ids: tuple[str, ...]
    xy: Array
    ok: Mask
    check: tuple[str, ...] = ()
    arcs: Arcs | None = None
    labels: dict[str, str] = field(default_factory=dict)
    shifts: Array | None = None


def marks_of(points: ImagePoints, found: Any, check: tuple[str, ...] = (), **more: Any) -> Marks:
    """Marks of points, or of a measurement of marks or rods: lost ones are at their predicted places."""
    if found is None:
        return Marks(points.names, points.xy, np.ones(len(points), dtype=bool), check, **more)
    xy = np.where(found.ok[:, None], found.xy, found.predicted)
    return Marks(found.ids, xy, found.ok, check, **more)


def preview(frame: Frame, width: int = _WIDTH) -> NDArray[np.uint8]:
    """Return the frame with 8 bits, stretched between its 0.1 and 99.9 percentiles, reduced to the width."""
    step = max(1, frame.pixels.size // 1_000_000)
    low, high = np.percentile(frame.pixels.reshape(-1)[::step], [0.1, 99.9])
    factor = min(1.0, width / frame.width)
    size = (max(1, round(frame.width * factor)), max(1, round(frame.height * factor)))
    kind = frame.pixels.dtype if frame.pixels.dtype in (np.uint8, np.uint16, np.int16) else np.float32
    small = cv2.resize(frame.pixels.astype(kind, copy=False), size, interpolation=cv2.INTER_AREA)
    stretched = 255 * (small.astype(np.float32) - low) / max(float(high - low), 1e-9)
    grey: NDArray[np.uint8] = np.clip(np.rint(stretched), 0, 255).astype(np.uint8)
    return grey


def frame_overlay(frame: Frame, marks: Marks, across: int = _WIDTH, bold: float = 1.0) -> str:
    """Draw marks over the frame.

    Parameters
    ----------
    frame : Frame
        The frame.
    marks : Marks
        The marks.
    across : int
        Largest width of the picture, pixels; the marks keep their places.
    bold : float
        Factor on the size of marks and lines, for small pictures.

    Returns
    -------
    str
        An SVG element in the pixels of the frame.
    """
    _, coded = cv2.imencode(".jpg", preview(frame, across), [cv2.IMWRITE_JPEG_QUALITY, 82])
    picture = base64.b64encode(coded.tobytes()).decode()
    unit = bold * frame.width / 1000
    width, height = frame.width, frame.height
    parts = [
        f'<svg class="frame" viewBox="-0.5 -0.5 {width} {height}">',
        f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" '
        f'href="data:image/jpeg;base64,{picture}"/>',
    ]
    held = set(marks.check)
    good, bad = (_FOUND, ACCENT) if marks.arcs is None else _ON_DARK
    colours = [
        (_CHECK if name in held else good) if found else bad
        for name, found in zip(marks.ids, marks.ok, strict=True)
    ]
    for i, (x, y) in enumerate(marks.xy):
        if not np.isfinite([x, y]).all():
            continue
        if not marks.ok[i]:
            shape = _cross(x, y, 6.0 * unit)
        elif marks.arcs is None:
            shape = f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{7.5 * unit:.2f}"/>'
        else:
            shape = _arc(x, y, marks.arcs, i, 3.5 * unit)
        if marks.shifts is not None and np.isfinite(marks.shifts[i]).all():
            dx, dy = marks.shifts[i]
            shape += f'<path d="M{x:.2f} {y:.2f}l{dx:.2f} {dy:.2f}" stroke="{ACCENT}"/>'
        parts.append(f'<g fill="none" stroke="{colours[i]}" stroke-width="{1.7 * unit:.2f}">{shape}</g>')
    for row, x, y in _placed(marks, 12.0 * unit):
        parts.append(_label(x, y, marks.labels[marks.ids[row]], colours[row], 12.0 * unit))
    return "".join(parts) + "</svg>"


def _placed(marks: Marks, size: float) -> list[tuple[int, float, float]]:
    """Rows of marks and the centres of their labels, placed so that they cover neither marks nor each other.

    The first free place is taken: above, below, beside, then farther away; if none is free, the one above.
    """
    known = np.flatnonzero(np.isfinite(marks.xy).all(axis=1))
    half = np.full((len(marks.xy), 2), 0.5 * size)
    if marks.arcs is not None:
        half[:, 0] = np.where(marks.ok, np.nan_to_num(marks.arcs.length) / 2, half[:, 0])
    taken = [(*marks.xy[i], *half[i]) for i in known]
    found = []
    for i in known:
        text = marks.labels.get(marks.ids[i], "")
        if not text:
            continue
        box = np.array([0.33 * size * len(text), 0.42 * size])
        away = half[i] + box + 0.25 * size
        places = [marks.xy[i] + reach * away * way for reach in (1.0, 1.9) for way in _AROUND]
        free = [place for place in places if not _covers(place, box, taken)]
        x, y = (free or places)[0]
        taken.append((x, y, *box))
        found.append((int(i), float(x), float(y)))
    return found


def _covers(place: Array, box: Array, taken: list[tuple[float, ...]]) -> bool:
    others = np.array(taken)
    return bool((np.abs(others[:, :2] - place) < others[:, 2:] + box).all(axis=1).any())


def _cross(x: float, y: float, d: float) -> str:
    return (
        f'<path d="M{x - d:.2f} {y - d:.2f}l{2 * d:.2f} {2 * d:.2f}m0 {-2 * d:.2f}'
        f'l{-2 * d:.2f} {2 * d:.2f}"/>'
    )


def _arc(x: float, y: float, arcs: Arcs, row: int, tick: float) -> str:
    """The centre line of an arc, a parabola, with a tick across its middle."""
    half, bend, tilt = arcs.length[row] / 2, arcs.curvature[row], arcs.tilt[row]
    c, s = np.cos(tilt), np.sin(tilt)
    # A parabola is a quadratic Bézier curve; its third point lies as far above the vertex as the ends below.
    u = np.array([-half, 0.0, half, 0.0, 0.0])
    v = np.array([bend * half**2 / 2, -bend * half**2 / 2, bend * half**2 / 2, -tick, tick])
    px, py = x + c * u - s * v, y + s * u + c * v
    points = [f"{a:.2f} {b:.2f}" for a, b in zip(px, py, strict=True)]
    return f'<path d="M{points[0]}Q{points[1]} {points[2]}M{points[3]}L{points[4]}"/>'


def _label(x: float, y: float, text: str, colour: str, size: float) -> str:
    return (
        f'<text x="{x:.2f}" y="{y + 0.35 * size:.2f}" fill="{colour}" font-size="{size:.1f}" '
        f'text-anchor="middle" stroke="#000" stroke-width="{0.16 * size:.2f}" stroke-opacity="0.6" '
        f'paint-order="stroke">{escape(text)}</text>'
    )
