"""The simulated port and the water behind it: exact rays, independent of those of the adjustment."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.io.refraction import RefractionEntry
from reseau.optics.refraction import RefractedRays
from reseau_sims import FieldBench, Station, Water

POINTS = np.random.default_rng(1).uniform([-350, -350, 700], [350, 350, 1300], (200, 3))


def test_the_ray_through_a_pane_satisfies_snells_law_in_closed_form() -> None:
    water = Water(distance_mm=50.0, thickness_mm=15.0)
    seen = water.directions(POINTS)
    glass, index = water.indices(water.colour_nm)
    sine = np.linalg.norm(seen.xy, axis=1) / np.hypot(1, np.linalg.norm(seen.xy, axis=1))
    tangents = [sine / np.sqrt(n * n - sine * sine) for n in (1.0, glass, index)]
    reached = 50.0 * tangents[0] + 15.0 * tangents[1] + (POINTS[:, 2] - 65.0) * tangents[2]
    assert seen.found.all()
    assert np.abs(reached - np.hypot(POINTS[:, 0], POINTS[:, 1])).max() < 1e-7  # mm


def test_rays_agree_with_those_of_the_adjustment_where_both_know_the_port() -> None:
    water = Water(tilt_deg=(0.0, 3.0))
    entry = json.dumps(tomllib.loads(water.toml())["instruments"]["camera"]["refraction"])
    bent = RefractionEntry.model_validate_json(entry).refraction(("image",), ("camera",))
    every = np.arange(len(POINTS))
    rays = RefractedRays.of(
        bent.columns(bent.values), bent.path_of, np.eye(3)[None], np.zeros((1, 3)), POINTS, 0 * every, every
    )
    # The description has six decimals.
    assert np.abs(rays.uv - water.directions(POINTS).xy).max() < 1e-6


def test_derivatives_are_those_of_differences() -> None:
    water = Water(tilt_deg=(2.0, -1.0), bend_um=5.0, wedge_arcsec=60.0)
    seen, step = water.directions(POINTS), 0.01
    for axis in range(3):
        moved = step * np.eye(3)[axis]
        slope = (water.directions(POINTS + moved).xy - water.directions(POINTS - moved).xy) / (2 * step)
        assert np.abs(slope - seen.d_point[:, :, axis]).max() < 1e-9


def test_bend_wedge_temperature_and_colour_each_change_the_image() -> None:
    water, camera_px = Water(), 8.0 / 0.027
    seen = water.directions(POINTS).xy
    for changed, least in (
        ({"bend_um": 5.0}, 0.01),
        ({"wedge_arcsec": 60.0}, 0.01),
        ({"temperature_c": 20.0}, 0.01),
    ):
        assert np.abs(replace(water, **changed).directions(POINTS).xy - seen).max() * camera_px > least
    blue, red = (water.directions(POINTS, colour).xy for colour in water.colours)
    apart = np.linalg.norm(red - blue, axis=1) * camera_px
    assert 0.05 < apart.max() < 0.5
    far = np.linalg.norm(seen, axis=1)
    assert np.corrcoef(apart, far)[0, 1] > 0.9  # a blur that grows towards the edges


def test_a_frame_under_water_is_sharp_where_its_truth_says() -> None:
    bench = FieldBench(seed=1, bend_mm=0.0).submerged(Water(width_nm=0.0))
    truth = bench.truth(Station(0.0))
    seen = bench.inside(truth, 8.0)
    assert 300 < seen.sum() < 400  # as many as in air
    light = bench.light(Station(0.0))
    x, y = np.rint(truth.xy[seen]).astype(int).T
    assert np.median(light[y, x]) < 0.6 * np.median(light)


@pytest.mark.parametrize("wrong", [{"distance_mm": 0.0}, {"thickness_mm": -1.0}, {"tilt_deg": (0.0, 30.0)}])
def test_an_impossible_port_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        Water(**wrong)
