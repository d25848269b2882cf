"""A small photograph of a reseau of disks with its design, as files, and a way to run commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from reseau.cli import run
from reseau.core.data import Array
from reseau.designs import regular_reseau
from reseau.io import Mark, ReseauDesign, write_whole
from reseau.io.images import write_image
from reseau.optics import RationalPolynomial
from reseau.optics.composition import Chain, Inverted, Similarity
from reseau.optics.formation import draw, mark_outline
from reseau.optics.mapping import PlaneMapping

SHAPE = (300, 360)


@dataclass(frozen=True)
class Photo:
    """Files of a photograph, and its true values."""

    image: Path
    design: Path
    grid: ReseauDesign
    view: PlaneMapping
    pixels: Array


def photograph() -> tuple[ReseauDesign, PlaneMapping, Array]:
    grid = regular_reseau(9, 7, 10.0, Mark(shape="disk", size=2.0), name="disks")
    barrel = RationalPolynomial({"k": {"X": "x3 + xy2", "Y": "y3 + yx2"}}, [5e-6], {"X": "x", "Y": "y"})
    view = Chain(Inverted(barrel), Similarity(np.array([180.3, 149.6, 4.1, 0.06]), mirrored=True))
    value, slope, _ = view.derivatives(grid.xy)
    disks = mark_outline("disk", 2.0, None, 0.12).affine(slope, value).oriented()
    light = 180 * (1 - 0.8 * draw(disks, SHAPE, 0.8))
    return grid, view, light + np.random.default_rng(4).normal(0, 1.5, SHAPE)


@pytest.fixture(scope="session")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Photo:
    folder = tmp_path_factory.mktemp("photo")
    grid, view, light = photograph()
    write_image(folder / "photo.png", np.rint(light).astype(np.uint8))
    write_whole(folder / "design.json", grid.to_json())
    return Photo(folder / "photo.png", folder / "design.json", grid, view, light)


@pytest.fixture
def reseau(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run a command in process: its exit status, standard output and standard error."""

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = run([str(argument) for argument in arguments])
        written = capsys.readouterr()
        return status, written.out, written.err

    return call


@pytest.fixture(scope="session")
def calibration(photo: Photo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration that `reseau refine` computes from the photograph."""
    path = tmp_path_factory.mktemp("calibration") / "camera.json"
    assert run(["refine", "--photo-i", str(photo.image), "--reseau", str(photo.design), "-o", str(path)]) == 0
    return path
