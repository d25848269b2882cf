"""Draws `docs/images/calibration.png`, and `calibration-dark.png` for dark pages: python docs/figures.py.

With the folder of the tour of a camera (docs/tours/camera.md), whose commands were followed, it draws
`docs/images/tour-camera.png` and its dark one in its place: python docs/figures.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from themes import save

import reseau
from reseau.core.figures import drawing
from reseau.optics import Brown, PixelGrid, Sensor
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


def tour(folder: Path) -> None:
    """A photograph of the tour with its distortion, and without."""
    from matplotlib.figure import Figure

    with drawing():
        figure = Figure(figsize=(9.0, 3.2), layout="constrained")
        for axes, name in zip(figure.subplots(1, 2), ("photos", "flat"), strict=True):
            axes.imshow(reseau.read_image(folder / name / "10.png").pixels, cmap="gray", vmin=0, vmax=255)
            axes.set_title(f"{name}/10.png", loc="left")
            axes.set_axis_off()
        save(figure, IMAGES / "tour-camera.png")


def main() -> None:
    """Simulate photographs, calibrate, draw."""
    if len(sys.argv) > 1:
        tour(Path(sys.argv[1]))
        return
    world = bench()
    stations = paper_stations()[::3]
    frames = [world.record(station) for station in stations]
    calibrated = reseau.calibrate(frames, world.design, pitch_mm=PITCH_MM).required()
    with drawing():
        shown = max(range(len(frames)), key=lambda k: len(calibrated.measured.get(frames[k].name, ())))
        panels = calibrated.plot(frames[shown])
        panels[0].set_title(f"measured: {len(calibrated.measured[frames[shown].name])} targets", loc="left")
        path = IMAGES / "calibration.png"
        save(panels[0].figure, path)
    print(calibrated, path)
    assert np.isfinite(calibrated.sigma0)


if __name__ == "__main__":
    main()
