"""Real scans of film: orientation of their frames, and pictures of the edges for inspection."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array
from reseau.io.images import open_scan, write_image
from reseau.io.scans import Scan
from reseau.measure.film import film_plane, orient_frames
from reseau.measure.film.orientation import FrameOptions
from reseau.measure.film.perforations import PITCH_MM, FilmPlane, edge_of
from reseau.report.frames import contact_sheet, frame_tile

__all__ = ["print_real"]

_SCANS: dict[str, tuple[tuple[float, float], tuple[float, ...] | None]] = {
    "fac_neg.jpg": ((24.0, 36.0), None),
    "strw_in1.jpg": ((36.0, 24.0), None),
    "strw_in3.jpg": ((36.0, 24.0), None),
    "kino_1264.jpg": ((22.0, 16.0), (893, 1676, 2874, 3145)),
    "kino_1265.jpg": ((22.0, 16.0), (885, 1615, 2870, 3085)),
}
"""Formats, and approximate position of a frame among others: left, top, right, bottom."""

_PERFORATIONS = {
    "kino_1264.jpg": ((357, 1245, 621, 1421, 431), (2904, 1246, 3157, 1425, 431)),
    "kino_1265.jpg": ((351, 1184, 613, 1360, 431), (2896, 1187, 3150, 1365, 431)),
}
"""Edges of the first perforation of both rows (left, top, right, bottom), and the approximate pitch."""
_EDGES = {"kino_1264.jpg": (1421, 1673, 3142, 3393), "kino_1265.jpg": (1362, 1614, 3082, 3335)}
"""Rows of the lower edge of the previous frame, both edges of the frame, and the upper edge of the next."""
_SEVEN, _FRAME_MM, _GATE_MM = 7, 4 * PITCH_MM, 16.0
"""Number of complete perforations in a row, and per frame; nominal height of the gate."""


def print_real(folder: Path, pictures: Path | None) -> None:
    """Orient every real scan; cameras were tilted when copying, so shapes are known only to 2 % and 1°."""
    if not folder.is_dir():
        print(f"\nReal scans: no reference data in {folder}")
        return
    print("\nReal scans: status, largest σ of a corner in px, px/mm along x and y, bows of the edges in px")
    tiles = []
    for name, (size, near) in _SCANS.items():
        scan, start = open_scan(folder / name), time.perf_counter()
        options = FrameOptions((size,), near=_box(near), aspect_sigma=0.02, angle_sigma_deg=1.0)
        for result in orient_frames(scan, options):
            took = time.perf_counter() - start
            print(f"  {name:15s} {result.status:12s} {took:5.1f} s  {result.why}")
            tiles.append(frame_tile(scan, result.document()))
            if result.lines is None or result.px_per_mm is None:
                continue
            sigma = np.sqrt(np.diag(result.lines.covariance))
            x, y = result.px_per_mm
            bows = " ".join(f"{bow:.1f}" for bow in result.lines.bow)
            print(f"  {'':15s} σ {sigma.max():.2f}  scale {x:.2f} {y:.2f}  bows {bows}")
    for name in _PERFORATIONS:
        print_film(open_scan(folder / name), pictures)
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        contact_sheet(pictures / "real.png", tiles)
        print(f"  overlays: {pictures / 'real.png'}")


def print_film(scan: Scan, pictures: Path | None) -> None:
    """Perforations against frames of cine film: four perforations make a frame, by the same edge model."""
    rows = [np.array(row, dtype=float) for row in _PERFORATIONS[scan.name]]
    plane = film_plane(scan, rows, _SEVEN)
    if not plane:
        print(f"  {scan.name:15s} {plane.reason}")
        return
    edges = []
    for k, y in enumerate(_EDGES[scan.name]):
        ends = np.array([1000.0, y]), np.array([2800.0, y - 8.0])
        edges.append(edge_of(scan, *(ends if k % 2 else ends[::-1]), channel=1))
    assert all(edge is not None for edge in edges)
    before, upper, lower, after = edges
    print(f"  {scan.name:15s} {plane.edges} edges of perforations, rms {plane.rms_px:.1f} px; on the film:")
    for what, a, b, nominal in (
        ("lower edges, frame to frame", before, lower, _FRAME_MM),
        ("upper edges, frame to frame", upper, after, _FRAME_MM),
        ("height of the frame", upper, lower, _GATE_MM),
    ):
        found, sigma = plane.apart(a, b)
        away, of = 100 * (found / nominal - 1), 100 * sigma / nominal
        print(f"  {'':15s} {what:28s} {found:.3f} mm, {away:+.2f} ± {of:.2f} % of {nominal:g} mm")
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        write_image(pictures / f"{scan.name[:-4]}_film.png", _film_picture(scan, plane, edges))


def _film_picture(scan: Scan, plane: FilmPlane, edges: list[Array]) -> NDArray[np.uint8]:
    """Enlarged pictures of every edge of a perforation and of a frame."""
    places = [*plane.at, *(edge[k] for edge in edges for k in (5, 25, 45))]
    size, zoom = 24, 5
    tiles = []
    for x, y in places:
        left, top = int(np.rint(x)) - size, int(np.rint(y)) - size
        part = scan.window(top, top + 2 * size, left, left + 2 * size).astype(np.float32)
        low, high = part.min(), part.max()
        eight = np.rint((part - low) / max(high - low, 1) * 255).astype(np.uint8)
        tile = cv2.resize(eight, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
        at = (np.rint((np.array([x - left, y - top]) + 0.5) * zoom - 0.5)).astype(int)
        cv2.drawMarker(tile, (int(at[0]), int(at[1])), (255, 0, 0), cv2.MARKER_CROSS, 60, 1)
        tiles.append(np.pad(tile, ((1, 1), (1, 1), (0, 0)), constant_values=255))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 11)
    return np.vstack([np.hstack(tiles[i : i + 11]) for i in range(0, len(tiles), 11)])


def _box(near: tuple[float, ...] | None) -> Array | None:
    if near is None:
        return None
    x0, y0, x1, y1 = near
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
