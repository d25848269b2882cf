"""Targets measured by us and by other programs in the same formed photographs with known truth.

Run from the checkout: ``python benchmarks/testfield_peers.py``. The other programs are installed by
``pip install .[peers]``; missing ones are listed. A sheet of 8 × 7 disks, and a ChArUco board with corners at
the same positions, are seen by the same camera. Programs that only refine positions get the true position
rounded to a pixel. The truth is the image of a disk's centre, which in perspective is not the centre of its
ellipse.
"""

from __future__ import annotations

import argparse
import importlib
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from figures import BOUND, record
from scipy.spatial import KDTree
from shared import of_the_tests

from reseau.core.data import Array
from reseau.measure import measure_reseau
from reseau.optics.formation import rectangles

sheets = of_the_tests("measure/sheets.py")
ROLLS, TILTS = (0.0, 100.0, 200.0, 300.0), (0.0, 30.0, 45.0)
NEAR_PX = 3.0
CELLS = 8
"""Cells per square of the board; a marker of 4 × 4 bits with its border has six."""


@dataclass(frozen=True, eq=False)
class View:
    """Photographs of sheet and board by one camera, the truth (n, 2) and approximate positions (n, 2).

    Programs for stars and particles get the sheet as bright disks without the ground: `dark`.
    """

    sheet: Array
    dark: Array
    board: Array
    truth: Array
    start: Array
    radius: int


@dataclass(eq=False)
class Tally:
    """Errors of a program in all views (v, n, 2), NaN where it failed, and its time (s) for each view."""

    errors: list[Array] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


Locate = Callable[[View], Array]


def viewed(roll: float, tilt: float, seed: int) -> View:
    camera = sheets.Camera(roll, tilt)
    formed = sheets.form(camera, seed=seed)
    _, slope = camera.image(sheets.DESIGN.xy)
    radius = sheets.DESIGN.mark.size / 2 * np.sqrt(np.abs(np.linalg.det(slope)))
    rng = np.random.default_rng(1000 + seed)
    return View(
        formed.frame.pixels,
        darkness(formed.frame.pixels),
        sheets.exposed(camera.share(rectangles(cells(), 0.12)), seed).pixels,
        formed.truth,
        formed.truth + rng.uniform(-1, 1, formed.truth.shape),
        int(np.ceil(np.median(radius))),
    )


def charuco() -> Any:
    """The board: 9 × 8 squares of 10 mm, with inner corners at the positions of the disks."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.CharucoBoard((9, 8), 10.0, 7.5, dictionary)


def cells() -> Array:
    """Dark runs of the board's rows of cells (k, 4): x0, y0, x1, y1 in millimetres."""
    pattern = charuco().generateImage((9 * CELLS, 8 * CELLS), marginSize=0, borderBits=1) < 128
    edges = []
    for row, line in enumerate(pattern):
        change = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        for first, last in change.reshape(-1, 2):
            # Whole squares have no seams, or the quadrature would have many more nodes than it needs.
            edges.append((first, row, last, row + 1))
    grid = np.array(edges, dtype=np.float64) * 10.0 / CELLS
    return np.stack([grid[:, 0] - 45, 40 - grid[:, 3], grid[:, 2] - 45, 40 - grid[:, 1]], axis=1)


def nearest(found: Array, view: View) -> Array:
    """The position found nearest to each target (n, 2), or NaN."""
    if not len(found):
        return np.full(view.truth.shape, np.nan)
    gap, row = KDTree(found).query(view.truth)
    return np.where(gap[:, None] < NEAR_PX, found[row], np.nan)


def ours(view: View) -> Array:
    from reseau.core.data import Frame

    result = measure_reseau(Frame(view.sheet, 255.0), sheets.DESIGN)
    return result.xy if result else np.full(view.truth.shape, np.nan)


def blob(view: View) -> Array:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = 50, 5000
    parameters.minInertiaRatio, parameters.minCircularity = 0.1, 0.5
    parameters.filterByCircularity = True
    found = cv2.SimpleBlobDetector.create(parameters).detect(view.sheet)
    return nearest(np.array([key.pt for key in found]).reshape(-1, 2), view)


def circles_grid(view: View) -> Array:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea, parameters.minInertiaRatio = 50, 5000, 0.1
    parameters.filterByCircularity, parameters.minCircularity = True, 0.5
    flags = cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
    detector = cv2.SimpleBlobDetector.create(parameters)
    ok, found = cv2.findCirclesGrid(view.sheet, (8, 7), flags=flags, blobDetector=detector)
    return nearest(found.reshape(-1, 2) if ok else np.empty((0, 2)), view)


def corner_sub_pix(view: View) -> Array:
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    start = np.ascontiguousarray(view.start, dtype=np.float32).reshape(-1, 1, 2)
    half = max(3, view.radius // 2)
    found = cv2.cornerSubPix(view.board, start, (half, half), (-1, -1), stop)
    return nearest(found.reshape(-1, 2), view)


def charuco_corners(view: View) -> Array:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.CharucoDetector(charuco(), detectorParams=parameters)
    corners, ids, _, _ = detector.detectBoard(view.board)
    found = np.full(view.truth.shape, np.nan)
    if ids is not None and len(ids):
        found[ids.ravel()] = corners.reshape(-1, 2)
    # A corner more than that away from its number's place is a wrong number, not an error of measurement.
    off = np.hypot(*(found - view.truth).T)
    return np.where(off[:, None] < NEAR_PX, found, np.nan)


def darkness(sheet: Array) -> Array:
    """Inverted grey values minus a plane background: bright disks on zero."""
    grey = sheet.astype(np.float64)
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]]
    plane = np.stack([np.ones(grey.size), u.ravel(), v.ravel()], axis=1)
    ground = grey.ravel() > np.percentile(grey, 50)
    for _ in range(4):
        fitted = plane @ np.linalg.lstsq(plane[ground], grey.ravel()[ground], rcond=None)[0]
        ground = np.abs(grey.ravel() - fitted) < 8
    return np.clip(fitted.reshape(grey.shape) - grey, 0, None)


def photutils_by(name: str) -> Callable[[ModuleType], Locate]:
    def bound(package: ModuleType) -> Locate:
        centroids = importlib.import_module("photutils.centroids")

        def locate(view: View) -> Array:
            side = 2 * int(1.5 * view.radius) + 1
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                x, y = centroids.centroid_sources(
                    view.dark, *view.start.T, box_size=side, centroid_func=getattr(centroids, name)
                )
            return nearest_of_own(np.stack([x, y], axis=1), view)

        return locate

    return bound


def nearest_of_own(found: Array, view: View) -> Array:
    """Positions found for each target, NaN if too far away."""
    return np.where(np.hypot(*(found - view.truth).T)[:, None] < NEAR_PX, found, np.nan)


def trackpy_locate(package: ModuleType) -> Locate:
    def locate(view: View) -> Array:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = package.locate(view.dark, 2 * int(1.4 * view.radius) + 1, engine="python")
        return nearest(found[["x", "y"]].to_numpy(), view)

    return locate


def skimage_ellipse(package: ModuleType) -> Locate:
    measure = importlib.import_module("skimage.measure")

    def one(view: View, x: int, y: int) -> Array:
        half = int(1.7 * view.radius)
        top, left = max(0, y - half), max(0, x - half)
        patch = view.sheet[top : y + half + 1, left : x + half + 1].astype(np.float64)
        level = (np.percentile(patch, 3) + np.percentile(patch, 90)) / 2
        contours = measure.find_contours(patch, level)
        if not contours:
            return np.full(2, np.nan)
        model = measure.EllipseModel.from_estimate(max(contours, key=len)[:, ::-1])
        return np.add(model.center, (left, top)) if model else np.full(2, np.nan)

    def locate(view: View) -> Array:
        found = [one(view, *np.rint(start).astype(int)) for start in view.start]
        return nearest_of_own(np.array(found), view)

    return locate


PROGRAMS: tuple[tuple[str, str, Any], ...] = (
    ("reseau, disks (found, numbered)", "", ours),
    ("OpenCV blob detector (found)", "cv2", blob),
    ("OpenCV findCirclesGrid (found)", "cv2", circles_grid),
    ("OpenCV cornerSubPix, chessboard", "cv2", corner_sub_pix),
    ("OpenCV ChArUco (found, numbered)", "cv2.aruco", charuco_corners),
    ("photutils, centre of mass", "photutils", photutils_by("centroid_com")),
    ("photutils, quadratic", "photutils", photutils_by("centroid_quadratic")),
    ("photutils, 2-D Gaussian", "photutils", photutils_by("centroid_2dg")),
    ("trackpy (found)", "trackpy", trackpy_locate),
    ("scikit-image, ellipse", "skimage", skimage_ellipse),
)
"""Name of a program, the package it needs, and the function that locates, or one that creates it."""


def located(name: str, needs: str, make: Any, views: list[View]) -> Tally | None:
    """Errors of one program in all views; None with a message if its package is not installed."""
    locate: Locate = make
    if needs and not needs.startswith("cv2"):
        try:
            locate = make(importlib.import_module(needs))
        except ImportError:
            print(f"{name:<34} not installed: pip install -e .[peers]")
            return None
    tally = Tally()
    locate(views[0])  # what is compiled or loaded at the first call takes no part
    for view in views:
        clock = time.perf_counter()
        found = locate(view)
        tally.seconds.append(time.perf_counter() - clock)
        tally.errors.append(found - view.truth)
    return tally


def row(name: str, tally: Tally) -> str:
    errors = np.stack(tally.errors)
    known = np.isfinite(errors[..., 0])
    record(name, "targets", int(known.sum()), of=known.size)
    if not known.any():
        return f"{name:<34} {'':>8} {'':>8} {'':>8} {known.size:>5}/{known.size}"
    size = np.hypot(*np.moveaxis(errors, -1, 0))
    means = [np.nanmean(e, axis=0) for e, k in zip(errors, known, strict=True) if k.any()]
    bias = np.sqrt(np.mean(np.square(means)))
    each = [float(np.sqrt(np.nanmean(e**2))) for e, k in zip(errors, known, strict=True) if k.any()]
    record(name, "rms of a photograph", each, "px")
    record(name, "bias", bias, "px")
    record(name, "time for a target", 1e3 * np.array(tally.seconds) / known.shape[1], "ms")
    if "chessboard" not in name and "ChArUco" not in name:
        own = name.startswith("reseau")
        record("disk, tilted to 45°", "reseau" if own else name, np.sqrt(np.nanmean(errors**2)), table=BOUND)
    return (
        f"{name:<34} {np.sqrt(np.nanmean(errors**2)):>8.4f} {bias:>8.4f} {np.nanmedian(size):>8.4f} "
        f"{(~known).sum():>5}/{known.size} {1e3 * sum(tally.seconds) / known.size:>9.3f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1, help="photographs of each view")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    views = [
        viewed(roll, tilt, seed)
        for seed, (_, roll, tilt) in enumerate(product(range(arguments.seeds), ROLLS, TILTS))
    ]
    print(f"{len(views)} photographs of {len(views[0].truth)} targets, tilts {TILTS}°; pixels, ms a target")
    print(f"{'':<34} {'rms':>8} {'bias':>8} {'median':>8} {'failures':>9} {'time':>9}")
    for name, needs, make in PROGRAMS:
        tally = located(name, needs, make, views)
        if tally is not None:
            print(row(name, tally))
    print("bias: root mean square over the photographs of the mean error in each, per axis")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
