"""The middle of an echo on the screen is not the middle of its image."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Array, ImagePoints
from reseau.designs import regular_reseau
from reseau.io import Mark
from reseau.refine import correct_camera, register
from reseau.refine.echoes import middles_on_screen

_RESEAU = regular_reseau(11, 9, 9.0, Mark(shape="line-grid", size=0.5, line_width=0.5))


def _photographed(screen: Array, perspective: float, shear: float) -> Array:
    """Pixels of points of the screen (n, 2), mm."""
    x, y = screen.T
    below = 1 + perspective * x
    return np.stack([500 + 10 * (x + shear * y) / below, 400 - 10 * y / below], axis=-1)


@pytest.mark.parametrize(("perspective", "shear"), [(2e-4, 0.0), (0.0, 0.004), (-2e-4, 0.003)])
def test_shear_and_perspective_do_not_shift_the_middle_of_an_echo(perspective, shear):
    marks = ImagePoints.with_sigma(_RESEAU.ids, _photographed(_RESEAU.xy, perspective, shear), 1e-4)
    camera = correct_camera(marks, _RESEAU, trials=0).required()
    middle = np.stack(np.meshgrid([-40.0, -15, 10, 35], [-30.0, 0, 30]), axis=-1).reshape(-1, 2)
    half, bend = 2.4, -0.12  # mm, 1/mm: a rise of 0.35 mm
    u = np.linspace(-half, half, 20001)
    line = middle[:, None] + np.stack([u, 0.5 * bend * u**2], axis=-1)
    image = _photographed(line.reshape(-1, 2), perspective, shear).reshape(line.shape)
    # The image of a line is matched with a line that has its ends, and its middle halfway between them.
    chord = image[:, -1] - image[:, 0]
    length = np.hypot(*chord.T)
    along = ((image - image[:, :1]) * chord[:, None]).sum(axis=2) / length[:, None]
    row = np.abs(along - length[:, None] / 2).argmin(axis=1)
    seen = image[np.arange(len(image)), row]
    tilt = np.arctan2(chord[:, 1], chord[:, 0])
    rise = -((0.5 * (image[:, 0] + image[:, -1]) - seen) * np.stack([np.sin(tilt), -np.cos(tilt)], 1)).sum(1)
    reach = length / 2
    truth = _photographed(middle, perspective, shear)
    points = ImagePoints.with_sigma([str(i) for i in range(12)], seen, 0.03)
    found = middles_on_screen(
        points, reach, 2 * rise / reach**2, tilt, camera, register(marks, _RESEAU, camera)
    )
    assert np.hypot(*(seen - truth).T).max() > 0.008
    # The points of the line above are 0.0024 px apart.
    assert np.hypot(*(found.xy - truth).T).max() < 0.003
