"""A target in one module: disks on circles, for a round object.

A target whose marks are disks, crosses, squares or rods is a document, ``reseau-design/1``: what draws,
measures and calibrates with it is there already.
"""

from __future__ import annotations

import numpy as np

from reseau.io import DesignPoint, Mark, ReseauDesign


def wheel(circles: int, pitch_mm: float) -> ReseauDesign:
    """Design of disks on circles about the middle, each circle with six disks more than the one inside it.

    Parameters
    ----------
    circles : int
        Number of circles.
    pitch_mm : float
        Distance of the circles, and about that of the disks on them.
    """
    points = [DesignPoint(id="C0", x=0.0, y=0.0)]
    for circle in range(1, circles + 1):
        for k, angle in enumerate(2 * np.pi * np.arange(6 * circle) / (6 * circle)):
            x, y = circle * pitch_mm * np.array([np.cos(angle), np.sin(angle)])
            points.append(DesignPoint(id=f"C{circle}-{k}", x=round(float(x), 4), y=round(float(y), 4)))
    return ReseauDesign(
        name="wheel", unit="mm", mark=Mark(shape="disk", size=0.25 * pitch_mm), polarity="dark",
        origin="C0", axis=f"C{circles}-0", points=tuple(points),
    )  # fmt: skip
