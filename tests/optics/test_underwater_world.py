"""The rays with which `benchmarks/worlds/underwater.py` draws underwater images, beside Snell's law."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Any:
    pytest.importorskip("batoid", reason="the underwater images are drawn with rays of batoid")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("worlds.underwater")


@pytest.mark.parametrize("name", ["left", "middle", "right"])
def test_corresponding_rays_are_those_of_the_bare_lens_refracted_by_window_and_water(
    world: Any, name: str
) -> None:
    strength, wavelength = world.STRENGTHS["strong"], 546.1
    centre, axes = world.targets(name)
    slope, pixels = world.principal_rays(world.View(strength, wavelength), centre, axes)
    at, way = world.View(strength, wavelength, port=False).outwards(np.zeros_like(slope), slope)
    sine = np.hypot(way[:, 0], way[:, 1])
    layers = (
        (1.0, world.PORT.distance - at[:, 2]),
        (world.index("window", wavelength), world.PORT.thickness),
        (world.index("water", wavelength), centre[:, 2] - world.PORT.distance - world.PORT.thickness),
    )
    aside = sum(depth * sine / np.sqrt(n**2 - sine**2) for n, depth in layers)
    miss = at[:, :2] + way[:, :2] / sine[:, None] * aside[:, None] - centre[:, :2]
    assert np.abs(miss).max() / 0.6 < 1e-6  # mm per pixel at the nearest target: 0.6
    assert ((pixels > 20) & (pixels < np.array(world.SIZE) - 20)).all()


def test_the_entrance_pupil_is_where_rays_near_the_axis_point(world: Any) -> None:
    at, way = world.View(world.STRENGTHS["weak"], 546.1, port=False).outwards(
        np.zeros((1, 2)), np.array([[1e-4, 0.0]])
    )
    assert abs(at[0, 2] - at[0, 0] * way[0, 2] / way[0, 0]) < 1e-6  # mm


def test_blur_grows_from_the_middle_to_the_rims_and_with_the_strength(world: Any) -> None:
    centre, axes = world.targets("middle")
    k = np.arange(100) + 0.5
    even = np.sqrt(k / 100)[:, None] * world.spiral(k)
    wide = np.empty((3, 2))
    for row, strength in zip(wide, world.STRENGTHS.values(), strict=True):
        views = [world.View(strength, w) for w in world.WAVELENGTHS]
        far = np.hypot(*(world.principal_rays(views[1], centre, axes)[1] - world.PRINCIPAL).T)
        stop = strength.stop_radius * even
        for column, target in enumerate((far.argmin(), far.argmax())):
            to = np.tile(centre[target], (100, 1)), np.tile(axes[target], (100, 1, 1))
            row[column] = world.energy_80([v.pixels(stop, v.aimed(stop, *to)) for v in views])
    assert (wide[:, 0] < 1.2).all()
    assert (np.abs(wide[:, 1] / [3.3, 6.4, 13.7] - 1) < 0.05).all()
