"""Photographs of a sheet of disks with coded rings, formed with known truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reseau.data import Array, Frame
from reseau.designs import regular_reseau
from reseau.formats import Mark, ReseauDesign, Rings
from reseau.optics import RationalPolynomial
from reseau.optics.formation import Outline, draw

__all__ = ["DESIGN", "Formed", "form", "view"]

_PITCH, _SIZE = 10.0, 2.6
_SECTORS: dict[str, tuple[tuple[float, float], ...]] = {
    "B2": ((20.0, 200.0),),
    "B7": ((0.0, 90.0), (180.0, 270.0)),
    "F4": ((100.0, 160.0), (250.0, 340.0)),
}
_BARREL = -0.03
"""Distortion at the edge of the frame, as a share of the distance from the middle."""

DESIGN: ReseauDesign = regular_reseau(8, 7, _PITCH, Mark(shape="disk", size=_SIZE), name="sheet").model_copy(
    update={"rings": Rings(inner=5.2, outer=9.0, sectors=_SECTORS)}
)


@dataclass(frozen=True, eq=False)
class Formed:
    """A frame, and the images (n, 2) of the centres of its disks."""

    frame: Frame
    truth: Array


def view(roll: float, tilt: float, shift: tuple[float, float], size: tuple[int, int]) -> RationalPolynomial:
    """The projectivity of a camera 13 cm above the sheet and 55° wide, turned and tilted by degrees."""
    k, t = np.deg2rad([roll, tilt])
    turn = np.array([[np.cos(k), -np.sin(k), 0], [np.sin(k), np.cos(k), 0], [0, 0, 1]])
    lean = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]])
    rotation = lean @ turn @ np.diag([1.0, -1.0, -1.0])
    focal = 0.95 * size[0]
    camera = np.array([[focal, 0, size[0] / 2 + shift[0]], [0, focal, size[1] / 2 + shift[1]], [0, 0, 1]])
    h = camera @ np.column_stack([rotation[:, :2], [0.0, 0.0, 130.0]])
    straight = RationalPolynomial.projective()
    return straight.with_values((h / h[2, 2]).ravel()[:8])


def form(
    roll: float, tilt: float, *, shift: tuple[float, float] = (0.0, 0.0), rings: bool = True, seed: int = 0
) -> Formed:
    """A photograph of 800 × 600 pixels with noise of 2 grey values, blur of 0.9 px and barrel distortion."""
    size = (800, 600)
    straight = view(roll, tilt, shift, size)
    middle, half = np.array(size) / 2, max(size) / 2

    def image(xy: Array) -> tuple[Array, Array]:
        first = straight.derivatives(xy)
        flat = straight(xy)
        u = (flat - middle) / half
        r2 = (u**2).sum(axis=1)[:, None]
        bent = middle + half * u * (1 + _BARREL * r2)
        slope = (1 + _BARREL * r2)[..., None] * np.eye(2) + 2 * _BARREL * u[:, :, None] * u[:, None, :]
        return bent, slope @ first.d_xy

    def drawn(outline: Outline) -> Array:
        return draw(outline.mapped(image).oriented(), size[::-1], 0.9)

    circle = Outline.circle(_SIZE / 2, 0.05)
    xy = DESIGN.xy
    share = drawn(Outline(xy[:, None] + circle.xy, np.broadcast_to(circle.dxy, (len(xy), *circle.dxy.shape))))
    if rings:
        assert DESIGN.rings is not None
        for name, sectors in DESIGN.rings.sectors.items():
            centre = xy[DESIGN.ids.index(name)]
            for start, end in sectors:
                share += drawn(_sector(DESIGN.rings, start, end, centre))
    rng = np.random.default_rng(seed)
    u = np.linspace(-1, 1, size[0])
    grey = 190 * (1 + 0.1 * u) * (1 - 0.85 * share) + rng.normal(0, 2.0, share.shape)
    return Formed(Frame(grey.round().clip(0, 254).astype(np.uint8), 255.0, "formed"), image(xy)[0])


def _sector(rings: Rings, start: float, end: float, centre: Array) -> Outline:
    """A part of a ring as a polygon."""
    angle = np.deg2rad(np.linspace(start, end, 60))
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = np.concatenate([rings.outer / 2 * arc, rings.inner / 2 * arc[::-1]]) + centre
    outline = Outline.polygon(corners, 0.1)
    return Outline(outline.xy[None], outline.dxy[None])
