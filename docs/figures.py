"""Draws pictures of the README and the tours, for light and, with `-dark` in their names, for dark pages.

    python docs/figures.py calibration
    python docs/figures.py tour-camera|blurred|underwater FOLDER

The first is simulated. The others show results of tours: the folder is the one in which the commands of
`docs/tours/camera.md`, `blurred.md` or `blurred-under-water.md` were followed.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from themes import save

import reseau
from reseau.core.failure import Failure
from reseau.core.figures import ACCENT, FAINT, drawing
from reseau.exchange import read_lens, read_network
from reseau.io import ReseauDesign
from reseau.io.reading import read_design
from reseau.measure import ReseauOptions, measure_reseau
from reseau.measure.blurred import BlurredOptions
from reseau.optics import Brown, PixelGrid, Sensor
from reseau.procedures.blurred import lens_camera, measure_blurred_frame
from reseau.report.blurred import blurred_figure
from reseau_sims import FieldBench, paper_stations

IMAGES = Path(__file__).with_name("images")
WIDTH, HEIGHT, PITCH_MM = 800, 600, 0.006


def bench() -> FieldBench:
    """The coded testfield in front of a camera of 800 × 600 pixels with barrel distortion."""
    camera = Brown(side="object", grid=PixelGrid(WIDTH, HEIGHT, (PITCH_MM, PITCH_MM)))
    values = {"c": 4.6, "x0": 0.02, "y0": -0.015, "K1": -8e-4, "P1": 2e-5}
    return FieldBench(
        seed=7,
        camera=camera.with_values(values),
        sensor=Sensor(WIDTH, HEIGHT, read_noise=1.2),
        bend_mm=0.0,
        distance_mm=1300.0,
        gradient=(0.15, -0.1),
    )


def calibration() -> Figure:
    """Photographs of a testfield are simulated and calibrated."""
    world = bench()
    stations = paper_stations()[::3]
    frames = [world.record(station) for station in stations]
    calibrated = reseau.calibrate(frames, world.design, pitch_mm=PITCH_MM).required()
    shown = max(range(len(frames)), key=lambda k: len(calibrated.measured.get(frames[k].name, ())))
    panels = calibrated.plot(frames[shown])
    panels[0].set_title(f"measured: {len(calibrated.measured[frames[shown].name])} targets", loc="left")
    figure = panels[0].figure
    assert isinstance(figure, Figure)
    return figure


def tour_camera(folder: Path) -> Figure:
    """A photograph of the tour with its distortion, and without."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), ("photos", "flat"), strict=True):
        axes.imshow(reseau.read_image(folder / name / "10.png").pixels, cmap="gray", vmin=0, vmax=255)
        axes.set_title(f"{name}/10.png", loc="left")
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


def main() -> None:
    """Draw the picture that is named."""
    parser = argparse.ArgumentParser(description="Pictures of the README and the tours.")
    parser.add_argument("name", choices=["calibration", *TOURS])
    parser.add_argument("folder", nargs="?", type=Path, help="where the commands of the tour were followed")
    given = parser.parse_args()
    if (given.folder is None) != (given.name == "calibration"):
        parser.error("the picture of a tour needs the folder of the tour")
    with drawing():
        figure = calibration() if given.folder is None else TOURS[given.name](given.folder)
        save(figure, IMAGES / f"{given.name}.png")
    print(IMAGES / f"{given.name}.png")


TOURS = {"tour-camera": tour_camera, "blurred": blurred, "underwater": underwater}

if __name__ == "__main__":
    main()
