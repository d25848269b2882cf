"""Draws pictures of the README, the tours and the how-to pages, for light and, with `-dark`, for dark pages.

    python docs/figures.py calibration|several-machines
    python docs/figures.py gallery
    python docs/figures.py tour-camera|seen|blurred|underwater|PAGE FOLDER

The first is drawn by `docs/desk.py`, those of the gallery by its examples. The others show results of pages:
the folder is the one in which the commands of `docs/tours/camera.md`, `blurred.md`, `blurred-under-water.md`
were followed, or those of the page of `docs/howto` that has the name of the picture.
"""

from __future__ import annotations

import argparse
import json
import runpy
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from desk import Desk
from matplotlib import pyplot
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from themes import reset, save

import reseau
from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.core.figures import ACCENT, FAINT, INK, PALE, drawing, image_axes
from reseau.designs import board
from reseau.exchange import read_lens, read_network
from reseau.io import ReseauDesign
from reseau.io.reading import read_design
from reseau.measure import measure_reseau
from reseau.measure.blurred import BlurredOptions
from reseau.measure.reseau.marks import ReseauOptions
from reseau.procedures.blurred import lens_camera, measure_blurred_frame
from reseau.report.blurred import blurred_figure

IMAGES = Path(__file__).with_name("images")


def calibration() -> Figure:
    """A board on a desk is photographed from twelve sides, and the camera calibrated."""
    desk = Desk(board("charuco", 10, 7, 25.0))
    colours = {f"{k:02}.png": desk.photograph(*view, k) for k, view in enumerate(_views())}
    frames = [Frame(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), 255.0, name) for name, rgb in colours.items()]
    calibrated = reseau.calibrate(frames, desk.design).required()
    figure = Figure(figsize=(13.2, 3.9), layout="constrained")
    photo, residuals, total = figure.subplots(1, 3, width_ratios=(1, 1, 1.12))
    shown = "00.png"
    photo.imshow(colours[shown])
    image_axes(
        photo, *desk.size, f"one of {len(frames)} photographs: {len(calibrated.measured[shown])} corners"
    )
    photo.plot(*calibrated.measured[shown].xy.T, "o", mfc="none", mec="#ffd24a", ms=7, mew=1.4)
    calibrated.result.plot(residuals)
    (assessed,) = calibrated.assessments.values()
    assert assessed.errors is not None
    assessed.errors.plot(total)
    total.set_title("total error of the projection / px", loc="left")
    return figure


def _views() -> Iterator[tuple[tuple[float, float], float, float, float, float]]:
    """Place beside the board and distance (mm), tilt, its direction, roll (degrees); the first is shown."""
    yield (0.0, 0.0), 380.0, 36.0, -75.0, 10.0
    for k in range(1, 12):
        aside = ((-110.0, -70.0), (110.0, 70.0), (110.0, -70.0), (-110.0, 70.0))[k % 4]
        yield aside, 330.0 + 25 * (k % 4), (35.0, 42.0, 15.0)[k % 3], 33.0 * k, 90.0 * k + 20.0


def tour_camera(folder: Path) -> Figure:
    """A photograph of the tour with its distortion, and without."""
    figure = Figure(figsize=(9.0, 3.5), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), ("photos", "flat"), strict=True):
        axes.imshow(reseau.read_image(folder / name / "10.png").pixels, cmap="gray", vmin=0, vmax=255)
        axes.set_title(f"{name}/10.png", loc="left")
        axes.set_axis_off()
    return figure


def seen(folder: Path) -> Figure:
    """The overlay of a photograph of the tour, and a part of it."""
    picture = cv2.cvtColor(cv2.imread(str(folder / "seen.png")), cv2.COLOR_BGR2RGB)
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    whole, part = figure.subplots(1, 2)
    whole.imshow(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    part.imshow(picture[90:450, 960:])
    for axes in (whole, part):
        axes.set_axis_off()
    return figure


def blurred(folder: Path) -> Figure:
    """The most blurred target, measured with the options of the tour."""
    plate, optics = read_design(folder / "plate.json"), read_lens(folder / "lens.zmx")
    assert isinstance(plate, ReseauDesign)
    frame = reseau.read_image(folder / "photo.png")
    camera = lens_camera(optics, (frame.width, frame.height), pitch_mm=0.006, distance=500.0)
    turned = ReseauOptions(mirrored=False, max_rotation_deg=40.0)
    sharp = partial(measure_reseau, design=plate, options=turned)
    options = BlurredOptions(polarity=plate.polarity)
    found = measure_blurred_frame(frame, plate, camera, None, options, sharp=sharp)
    assert not isinstance(found, Failure), found
    return blurred_figure(frame, found.camera, found.targets, found.measured)


def underwater(folder: Path) -> Figure:
    """Residuals of the middle photograph before and after, to one scale."""
    folder = folder / "measured"
    final = read_network(folder / "network.json")
    width, height = final.cameras[0].width, final.cameras[0].height
    at = {
        final.points[j]: xy
        for i, j, xy in zip(final.image_of, final.point_of, final.xy, strict=True)
        if final.images[i] == "middle"
    }
    figure = Figure(figsize=(8.6, 3.6), layout="constrained")
    for axes, (name, title) in zip(
        figure.subplots(1, 2),
        (("round-0", "centres of gravity"), ("result", "measured by rays")),
        strict=True,
    ):
        table = json.loads((folder / f"{name}.json").read_text("utf-8"))["image_points"]
        rows = [k for k, image in enumerate(table["image"]) if image == "middle"]
        v = np.array([(table["vx"][k], table["vy"][k]) for k in rows], dtype=np.float64)
        xy = np.array([at.get(table["point"][k], (np.nan, np.nan)) for k in rows])
        axes.plot(*xy.T, ".", color=FAINT, markersize=2)
        axes.quiver(*xy.T, *(2000 * v).T, angles="xy", scale_units="xy", scale=1, width=0.004, color=ACCENT)
        axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
        axes.set_title(f"{title}: {np.sqrt((v**2).mean()):.4f} px rms (× 2000)")
    return figure


def fiducial_marks(folder: Path) -> Figure:
    """The overlay of the scan, and two of its marks."""
    seen, half = cv2.cvtColor(cv2.imread(str(folder / "marks.png")), cv2.COLOR_BGR2RGB), 110
    marks = json.loads((folder / "photo.json").read_text("utf-8"))["marks"]
    places = {mark["id"]: (round(mark["at"]["x"]), round(mark["at"]["y"])) for mark in marks}
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    whole, *parts = figure.subplots(1, 3)
    whole.imshow(cv2.resize(seen, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA))
    for axes, (x, y) in zip(parts, (places["1"], places["7"]), strict=True):
        axes.imshow(seen[max(0, y - half) : y + half, max(0, x - half) : x + half])
    for axes in (whole, *parts):
        axes.set_axis_off()
    return figure


def reseau_on_film(folder: Path) -> Figure:
    """What was measured in one half of a film, and both halves in one raster."""
    seen = cv2.cvtColor(cv2.imread(str(folder / "left-marks.png")), cv2.COLOR_BGR2RGB)
    left, right = (reseau.read_image(folder / f"{name}-corrected.tif").pixels for name in ("left", "right"))
    column = 610  # as the command printed: (76.4 - 15.4) mm at 10 px/mm; both begin at 46.3 mm
    both = np.zeros((max(len(left), len(right)), column + right.shape[1]), left.dtype)
    both[: len(left), : left.shape[1]] = left
    both[: len(right), column:] = right
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    one, whole = figure.subplots(1, 2, width_ratios=(1, 1.6))
    one.imshow(seen)
    whole.imshow(both, cmap="gray", vmin=0, vmax=255)
    whole.axvline(column, color=ACCENT, linewidth=0.8)
    for axes in (one, whole):
        axes.set_axis_off()
    return figure


def _photographs(folder: Path, rows: list[list[str]], wide: float, high: float) -> Figure:
    """Photographs in rows, each with its name."""
    figure = Figure(figsize=(wide, high), layout="constrained")
    grid = figure.subplots(len(rows), len(rows[0]), squeeze=False)
    for axes, name in zip(grid.flat, (name for row in rows for name in row), strict=True):
        axes.imshow(reseau.read_image(folder / name).pixels, cmap="gray", vmin=0, vmax=255)
        axes.set_title(name, loc="left")
        axes.set_axis_off()
    return figure


def several_cameras(folder: Path) -> Figure:
    """Three exposures, as both cameras took them."""
    taken = ("02.png", "04.png", "08.png")
    return _photographs(
        folder, [[f"{camera}/{name}" for name in taken] for camera in ("left", "right")], 9.0, 5.0
    )


def turntable(folder: Path) -> Figure:
    """The series before and after the camera was moved."""
    return _photographs(
        folder, [[f"table/{series + k:02}.png" for k in (1, 3, 5, 6)] for series in (0, 6)], 9.0, 4.0
    )


def n_wire_phantom(folder: Path) -> Figure:
    """The overlay of the frame, and its upper right part."""
    seen = cv2.cvtColor(cv2.imread(str(folder / "wires.png")), cv2.COLOR_BGR2RGB)
    scale = seen.shape[1] / 620
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    whole, part = figure.subplots(1, 2)
    whole.imshow(seen)
    part.imshow(seen[int(60 * scale) : int(300 * scale), int(290 * scale) : int(600 * scale)])
    for axes in (whole, part):
        axes.set_axis_off()
    return figure


def several_machines() -> Figure:
    """Who speaks with whom."""
    figure = Figure(figsize=(9.0, 2.9), layout="constrained")
    axes = figure.add_subplot()
    boxes = {
        "here": (0.0, 1.0, "reseau calibrate photos/\nadjusts"),
        "scheduler": (3.4, 1.7, "dask scheduler\ndistributes"),
        "store": (3.4, 0.3, "store\nphotographs, measurements"),
        **{f"worker {k}": (6.8, 2.0 - k, "dask worker\nmeasures") for k in range(3)},
    }
    at = {name: np.array((x, y)) for name, (x, y, _) in boxes.items()}
    for x, y, text in boxes.values():
        axes.add_patch(FancyBboxPatch((x - 1.0, y - 0.3), 2.0, 0.6, "round,pad=0.04", fc=PALE, ec=FAINT))
        axes.text(x, y, text, ha="center", va="center", color=INK)
    arrow = {"arrowstyle": "<->", "color": ACCENT, "shrinkA": 0, "shrinkB": 0}
    for a, b in [("here", middle) for middle in ("scheduler", "store")] + [
        (middle, name) for middle in ("scheduler", "store") for name in boxes if name.startswith("worker")
    ]:
        axes.annotate("", at[b] - (1.06, 0.0), at[a] + (1.06, 0.0), arrowprops=arrow)
    axes.set(xlim=(-1.2, 8.0), ylim=(-0.5, 2.5))
    axes.set_axis_off()
    return figure


def gallery() -> None:
    """Draw the pictures of how-to pages that examples of the gallery make."""
    for name, (example, number) in GALLERY.items():
        reset({}, example)
        runpy.run_path(str(Path(__file__).with_name("gallery") / f"{example}.py"))
        save(pyplot.figure(number), IMAGES / f"{name}.png", dpi=80)
        print(IMAGES / f"{name}.png")


GALLERY = {
    "camera-models": ("images/camera_models", 1),
    "noise": ("images/noise", 1),
    "refraction": ("images/refraction", 2),
    "blunders": ("networks/blunders", 1),
    "choice-of-model": ("networks/choose_model", 1),
    "ellipses": ("networks/ellipses", 1),
    "results": ("networks/plots", 2),
    "network": ("networks/read_network", 1),
    "photon-transfer": ("sensors/photon_transfer", 1),
    "slanted-edge": ("sensors/slanted_edge", 1),
    "disks": ("targets/disks", 1),
    "film-frame": ("targets/film_edges", 1),
    "reseau-wires": ("targets/reseau_crosses", 1),
    "distortion": ("targets/reseau_crosses", 2),
    "budget": ("uncertainty/certificate", 1),
    "drift": ("uncertainty/drift", 1),
}
"""Pictures by their names: example, and number of its figure."""


def main() -> None:
    """Draw the picture that is named."""
    parser = argparse.ArgumentParser(description="Pictures of the README and the tours.")
    parser.add_argument("name", choices=[*DRAWN, "gallery", *TOURS])
    parser.add_argument("folder", nargs="?", type=Path, help="where the commands of the tour were followed")
    given = parser.parse_args()
    if (given.folder is None) != (given.name not in TOURS):
        parser.error("the picture of a tour needs the folder of the tour")
    if given.name == "gallery":
        gallery()
        return
    with drawing():
        figure = DRAWN[given.name]() if given.folder is None else TOURS[given.name](given.folder)
        save(figure, IMAGES / f"{given.name}.png")
    print(IMAGES / f"{given.name}.png")


DRAWN = {"calibration": calibration, "several-machines": several_machines}
TOURS = {
    "tour-camera": tour_camera,
    "seen": seen,
    "blurred": blurred,
    "underwater": underwater,
    "fiducial-marks": fiducial_marks,
    "reseau-on-film": reseau_on_film,
    "several-cameras": several_cameras,
    "turntable": turntable,
    "n-wire-phantom": n_wire_phantom,
}

if __name__ == "__main__":
    main()
