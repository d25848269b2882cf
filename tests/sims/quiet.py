"""Worlds without noise, for comparison with their truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates

from reseau.core.data import Array
from reseau_sims import Reflectors, World


def quiet(world: World) -> World:
    """The world without noise, unevenness and the face of the transducer.

    Its arcs are short: the centre of gravity of a long one is off its middle where the mapping bends.
    """
    world.scanner = replace(
        world.scanner, noise=0.0, face=0.0, frequency_mhz=20.0, diameter_mm=5.0, cycles=10.0
    )
    world.display = replace(world.display, grain=0.0, gradient=(0.0, 0.0), falloff=0.0)
    return world


def echoes(world: World, reflectors: Reflectors, photo: str = "PHOTO II") -> Array:
    """Light of the echoes alone, before the reseau, as the camera would see it."""
    camera = world.camera_of(photo)
    view = camera.view_at(-world.faults.parallax_mm)
    nothing = reflectors.without(frozenset(reflectors.names))
    with_them, without = (
        world.show(which, photo).seen(view, camera.shape, camera.psf_px) for which in (reflectors, nothing)
    )
    return with_them - without


def middle_of(light: Array, near: Array) -> Array:
    """Middle of an arc (2,): x is the centre of gravity of all its light, y that of the column through it."""
    column, row = np.rint(near).astype(int)
    across, down = np.arange(-48.0, 49.0), np.arange(-24.0, 25.0)
    window = light[row - 24 : row + 25, column - 48 : column + 49]
    x = column + (window.sum(axis=0) @ across) / window.sum()
    profile = map_coordinates(light, [row + down, np.full(len(down), x)], order=3)
    return np.array([x, row + (profile @ down) / profile.sum()])
