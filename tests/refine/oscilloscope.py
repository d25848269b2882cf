"""An oscilloscope camera and an ultrasonic instrument with known coefficients, as points without images."""

from __future__ import annotations

import numpy as np

from reseau.core.data import Array, ImagePoints
from reseau.io import DesignPoint, Mark, ReseauDesign
from reseau.optics import RationalPolynomial

SIGMA_PX = 0.01
CAMERA = RationalPolynomial.camera().with_values({"k": 2e-7, "d1": 1e-5, "a0": 1e-5})
INSTRUMENT = RationalPolynomial.ultrasonic().with_values(
    {"A0": 0.3, "A1": 1.01, "A2": 0.01, "B1": 0.99, "B2": -0.008, "A6": 1e-6, "B6": 1e-6}
)
SCALE = np.array([1.05, 1.04])
RESEAU = ReseauDesign(
    name="reseau",
    unit="mm",
    mark=Mark(shape="line-grid", line_width=0.3),
    polarity="dark",
    origin="7-5",
    axis="14-5",
    points=tuple(
        DesignPoint(id=f"{i}-{j}", x=10.0 * i - 70, y=10.0 * j - 50) for i in range(15) for j in range(11)
    ),
)
_RODS = [(x, y) for y in (0, 20, 40, 60, 80) for x in (0, 25, 50, 75, 100)] + [
    (10 * i + 5, 31 + 5 * i) for i in range(9)
]
RODS = ReseauDesign(
    name="rods",
    unit="mm",
    mark=Mark(shape="rod", size=0.75),
    polarity="bright",
    origin="r0",
    axis="r4",
    points=tuple(
        DesignPoint(id=f"r{i}", x=float(x), y=float(y), sigma=0.05) for i, (x, y) in enumerate(_RODS)
    ),
)


def pixels(common: Array) -> Array:
    """Images of points of the common system, in pixels."""
    photo = CAMERA.inverse(common)
    return np.stack([800 + 9 * photo[:, 0], 600 - 9 * photo[:, 1]], axis=1)


def displayed(object_xy: Array) -> Array:
    """Images of object points (y down, as depth), in pixels."""
    return pixels(INSTRUMENT.inverse(object_xy * SCALE * [1, -1] + [-50.0, 38.0]))


def measured(names: tuple[str, ...], xy: Array, rng: np.random.Generator) -> ImagePoints:
    """Points with the measurement's noise."""
    return ImagePoints.with_sigma(names, xy + rng.normal(0, SIGMA_PX, xy.shape), SIGMA_PX)


def reseau_marks(rng: np.random.Generator) -> ImagePoints:
    """The reseau as PHOTO I shows it."""
    return measured(RESEAU.ids, pixels(RESEAU.xy), rng)
