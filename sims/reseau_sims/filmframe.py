"""Scanned frames of 35 and 70 mm film with known truth: the gate's edges, the film around, what disturbs.

A camera's gate lets light fall on the film; around its image the film stays as the unexposed film is, dark on
a slide and bright on a negative. What a scanner makes of it is formed from the signed distance of each pixel
from the gate's outline: a Gaussian spread folded with the pixel's square, exact along a straight edge.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array

from . import filmscene
from .streams import stream

__all__ = ["HASSELBLAD", "RICOH", "Beside", "FilmFrame", "FrameFormat", "FrameTruth"]

PITCH_35_MM = 38.0
"""From one 35 mm frame to the next: eight perforations."""


class FrameFormat(NamedTuple):
    """A camera's frame on its film: size in mm, film 35 or 70 mm wide, radius of its corners, its slits.

    `slits` are the places of V-shaped notches along the left edge, in mm from the middle, y up.
    """

    width: float
    height: float
    film: float
    radius: float = 0.0
    slits: tuple[float, ...] = ()


RICOH = FrameFormat(36.0, 24.0, 35.0, radius=0.3)
"""RICOH KR10M of Cruz et al."""
HASSELBLAD = FrameFormat(56.0, 56.0, 61.5, radius=0.4, slits=(4.0, 8.0))
"""HASSELBLAD 500 CM of Cruz et al.: its magazine leaves two notches at the left."""


@dataclass(frozen=True)
class Beside:
    """What else is on the film or in the picture; all of it off by default.

    Parameters
    ----------
    perforations, print, neighbours : bool
        Perforations and edge print of the film, and the frames before and after.
    lines : int
        Bright straight lines near and parallel to an edge, on as many edges (figure 7B of Cruz et al.).
    rods : int
        Bright rods in the picture, bent by the lens and nearly parallel to an edge (figure 7A), dark beyond.
    blown : bool
        A corner so overexposed that light has spread beyond the gate.
    dust, scratches : int
        Grains and hairs of dust; scratches, most of them along the film.
    """

    perforations: bool = False
    print: bool = False
    neighbours: bool = False
    lines: int = 0
    rods: int = 0
    blown: bool = False
    dust: int = 0
    scratches: int = 0


class FrameTruth(NamedTuple):
    """Corners (4, 2) in pixels, ul, ur, lr, ll as seen in the scan, and the gate's corners in mm, y up."""

    corners: Array
    gate: Array


@dataclass(frozen=True)
class FilmFrame:
    """One frame of a roll on a desktop scanner.

    Parameters
    ----------
    seed : int
        Of everything random.
    format : FrameFormat
        The camera's frame.
    dpi : float
        Resolution of the scan.
    tilt_deg : float
        Turn of the film on the glass, counter-clockwise as seen.
    mirrored : bool
        Whether the film lay with its wrong side up.
    negative : bool
        Whether unexposed film is bright.
    contrast : float
        Of the picture against unexposed film, as part of the scale of 255.
    noise : float
        Standard deviation of the scanner's noise, grey values.
    grain : float
        Standard deviation of the film's grain, grey values at full density.
    blur_px : float
        Width of the scanner's and the film's spread, one sigma.
    gate_sigma_mm : float
        Standard deviation of the gate's corners about the nominal format.
    gate_seed : int
        Which camera: frames of one roll share it.
    film_mm, scanner : float
        Deformation of the film, mm at the corners, and difference of the scanner's two scales.
    bow_mm : float
        Sagitta of the edges, each bowed by up to this.
    margin_mm : float
        Unexposed film around the frame that was scanned.
    crop : str
        Which edge lies outside the scan, if any: one of the names of the edges.
    beside : Beside
        What disturbs.
    bits : int
        Depth of the scan, 8 or 16.
    colour : bool
        Whether the scan has three channels, of different contrast.
    """

    seed: int = 0
    format: FrameFormat = RICOH
    dpi: float = 600.0
    tilt_deg: float = 0.6
    mirrored: bool = False
    negative: bool = False
    contrast: float = 0.7
    noise: float = 1.5
    grain: float = 3.0
    blur_px: float = 0.7
    gate_sigma_mm: float = 0.03
    gate_seed: int = 1
    film_mm: float = 0.004
    scanner: float = 2e-4
    bow_mm: float = 0.005
    margin_mm: float = 2.5
    crop: str = ""
    beside: Beside = field(default_factory=Beside)
    bits: int = 8
    colour: bool = False

    @property
    def px_per_mm(self) -> float:
        """Pixels of the scan in a millimetre."""
        return self.dpi / 25.4

    def with_seed(self, seed: int) -> FilmFrame:
        """Another frame of the same kind."""
        return replace(self, seed=seed)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Height and width of the scan."""
        w, h = (side + 2 * self.margin_mm for side in self.format[:2])
        # As much of the film as a turned frame needs.
        c, s = abs(np.cos(np.deg2rad(self.tilt_deg))), abs(np.sin(np.deg2rad(self.tilt_deg)))
        size = np.array([w * s + h * c, w * c + h * s]) * self.px_per_mm
        size[0 if self.crop in ("upper", "lower") else 1] -= self._cut if self.crop else 0.0
        return round(float(size[0])), round(float(size[1]))

    @property
    def _cut(self) -> float:
        """Pixels that a cropped scan lacks: the margin and a millimetre of the frame."""
        tilted = abs(float(np.sin(np.deg2rad(self.tilt_deg)))) * max(self.format.width, self.format.height)
        return (self.margin_mm + 1.0 + tilted) * self.px_per_mm

    @cached_property
    def gate(self) -> Array:
        """Corners of the camera's gate in mm, y up, (4, 2): ul, ur, lr, ll."""
        half = np.array(self.format[:2]) / 2
        nominal = half * [[-1, 1], [1, 1], [1, -1], [-1, -1.0]]
        return nominal + stream(self.gate_seed, "gate").normal(0, self.gate_sigma_mm, (4, 2))

    @cached_property
    def _matrix(self) -> Array:
        """From mm (y up) to pixels without the shift: two scales, the turn, the wrong side."""
        rng = stream(self.seed, "scanner")
        scale = self.px_per_mm * (1 + self.scanner * rng.normal(0, 1, 2))
        t = np.deg2rad(self.tilt_deg)
        turn = np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]])
        flip = np.diag([-1.0 if self.mirrored else 1.0, 1.0])
        return np.asarray(np.diag([scale[0], -scale[1]]) @ turn @ flip)

    @cached_property
    def _shift(self) -> Array:
        centre = (np.array(self.shape[::-1]) - 1) / 2
        centre = centre + stream(self.seed, "place").uniform(-0.5, 0.5, 2) * self.px_per_mm * 0.6
        way = {"upper": (0, -1), "lower": (0, 1), "left": (-1, 0), "right": (1, 0)}.get(self.crop, (0, 0))
        return np.asarray(centre + np.array(way) * self._cut / 2)

    @cached_property
    def truth(self) -> FrameTruth:
        """Where the corners are."""
        film = stream(self.seed, "film").normal(0, self.film_mm, (4, 2))
        corners = (self.gate + film) @ self._matrix.T + self._shift
        # As seen: the wrong side shows the frame's right at the left.
        return FrameTruth(corners[[1, 0, 3, 2]] if self.mirrored else corners, self.gate)

    @cached_property
    def bows_px(self) -> Array:
        """Sagittas of the edges (4,) as seen, positive outwards: upper, right, lower, left."""
        bow = stream(self.seed, "bow").uniform(-1, 1, 4) * self.bow_mm * self.px_per_mm
        return np.asarray(bow)

    def light(self) -> Array:
        """What the scanner sees without noise, grey values (h, w) of 255."""
        return filmscene.light(self)

    def scan(self) -> NDArray[Any]:
        """The scan: (h, w), or (h, w, 3) in colour."""
        light = self.light()
        if not self.colour:
            return self._exposed(light, "grey")
        base = 255.0 * 0.9 if self.negative else 14.0
        parts = [
            self._exposed(base + (light - base) * gain, name)
            for name, gain in (("red", 1.0), ("green", 0.8), ("blue", 0.45))
        ]
        return np.stack(parts, axis=2)

    def _exposed(self, light: Array, channel: str) -> NDArray[Any]:
        rng = stream(self.seed, "noise", channel)
        noisy = light + self.noise * rng.standard_normal(light.shape, dtype=np.float32)
        if self.grain > 0:
            noisy += filmscene.grain(light.shape, self.grain, rng)
        scale = 257.0 if self.bits == 16 else 1.0
        grey = np.clip(np.rint(noisy * scale), 0, 255 * scale)
        return grey.astype(np.uint16 if self.bits == 16 else np.uint8)
