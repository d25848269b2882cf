"""`reseau measure perforations`: scale of a drawn film whose geometry is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from reseau.io.images import write_image

Run = Callable[..., tuple[int, str, str]]
SCALE = 40.0
"""Pixels per millimetre."""
ROWS, PITCH, COUNT = 28.17, 4.75, 7
OPTIONS = (
    "--left", "88,160,200,239", "--right", "1215,160,1327,239", "--perforation-px", 190, "--number", COUNT
)  # fmt: skip


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bright perforations with a dark rim, blurred by 1.5 px; the film is 35.4 mm wide."""
    y, x = np.mgrid[:1560, :1416].astype(float)
    grey = np.full(y.shape, 120.0)
    for centre in (143.9, 143.9 + SCALE * ROWS):
        for k in range(COUNT):
            dx = np.abs(x - centre) - SCALE * 2.79 / 2
            dy = np.abs(y - 199.6 - k * SCALE * PITCH) - SCALE * 1.98 / 2
            outside = np.maximum(dx, dy)
            grey += 110 * ndtr(-outside / 1.5) - 70 * (ndtr((8 - outside) / 1.5) - ndtr(-outside / 1.5))
    grey += np.random.default_rng(3).normal(0, 1.0, y.shape)
    path = tmp_path_factory.mktemp("film") / "film.png"
    write_image(path, np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    return path


@pytest.mark.slow
def test_scale_and_rotation_follow_from_the_perforations(film: Path, reseau: Run) -> None:
    status, out, err = reseau("measure", "perforations", film, *OPTIONS, "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert found["edges"] > 40
    assert found["rms_px"] < 0.5
    quantities = found["quantities"]
    for name, true in (("scale across", SCALE), ("scale along", SCALE), ("rotation", 0.0), ("skew", 0.0)):
        assert abs(quantities[name]["value"] - true) < 4 * quantities[name]["sigma"] + 1e-3, name
    assert quantities["scale along"]["sigma"] < 0.05


@pytest.mark.slow
def test_results_have_units_and_as_many_digits_as_the_sigma_supports(film: Path, reseau: Run) -> None:
    status, out, _ = reseau("measure", "perforations", film, *OPTIONS)
    assert status == 0
    line = next(line for line in out.splitlines() if "scale across" in line)
    assert line.endswith(" px/mm")
    assert " ± 0.0" in line


def test_wrong_use_is_reported_in_one_line(film: Path, reseau: Run) -> None:
    for more, text in (
        (("--channel", "blue"), "--channel: the scan has no channel 'blue'; use grey"),
        (("--left", "600,160,712,239"), "film.png: "),
    ):
        status, _, err = reseau("measure", "perforations", film, *OPTIONS, *more)
        assert status in (1, 2)
        assert text in err
        assert err.count("\n") == 1
