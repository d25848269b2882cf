"""Photographs of a sheet of 100 disks, four with coded rings, and what another program measured in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reseau.core.data import Array
from reseau.io import DesignPoint, Mark, ReseauDesign, Rings

__all__ = ["PITCH", "design", "marks", "photographs"]

PITCH = 1 / 7
"""Distance of the disks where the coded ones are 1 apart."""
_SECTORS: dict[str, tuple[tuple[float, float], ...]] = {
    "1001": ((112.5, 337.5),),
    "1002": ((22.5, 112.5), (202.5, 292.5)),
    "1003": ((67.5, 112.5), (157.5, 202.5), (292.5, 337.5)),
    "1004": ((-22.5, 22.5), (67.5, 112.5), (157.5, 202.5), (247.5, 292.5)),
}
"""Read off a photograph with a ruler, as are the diameters."""


def photographs(folder: Path) -> list[Path]:
    """The photographs in the order of their numbers."""
    names = (line.split(",")[1] for line in _lines(folder / "images.txt"))
    return [folder / Path(name.strip()).name for name in names]


def marks(folder: Path) -> list[dict[str, Array]]:
    """For each photograph the image coordinates of another program, by the number of the disk."""
    found: dict[int, dict[str, Array]] = {}
    for line in _lines(folder / "markpts.txt"):
        image, point, x, y, _ = line.split(",")
        found.setdefault(int(image), {})[str(int(point))] = np.array([float(x), float(y)])
    return [found[image] for image in sorted(found)]


def design(folder: Path) -> ReseauDesign:
    """The sheet as it was meant: a grid; its numbers are those of the other program."""
    points = []
    for line in (folder / "weighted-with-orient-3dpts.txt").read_text().splitlines():
        columns = line.split(",")
        if columns[0].isdigit():
            # A quoted list of photographs stands before the coordinates, with commas in it.
            after = line.split('","')[1].split('",', 1)[1].split(",")
            x, y = (round(float(value) / PITCH) * PITCH for value in after[:2])
            points.append(DesignPoint(id=columns[0], x=x, y=y))
    return ReseauDesign(
        name="camcal",
        unit="m",
        mark=Mark(shape="disk", size=0.0318),
        polarity="dark",
        points=tuple(points),
        rings=Rings(inner=0.078, outer=0.138, sectors=_SECTORS),
    )


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
