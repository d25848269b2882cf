"""Photographs of a sheet of disks with coded rings, formed with known truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reseau.core.data import Array, Frame
from reseau.designs import regular_reseau
from reseau.io import Mark, ReseauDesign, Rings
from reseau.optics import RationalPolynomial
from reseau.optics.formation import Outline, draw

__all__ = ["DESIGN", "Camera", "Formed", "exposed", "form"]

_PITCH, _SIZE = 10.0, 2.6
_SECTORS: dict[str, tuple[tuple[float, float], ...]] = {
    "B2": ((20.0, 200.0),),
    "B7": ((0.0, 90.0), (180.0, 270.0)),
    "F4": ((100.0, 160.0), (250.0, 340.0)),
}
_BARREL = -0.03
"""Distortion at the edge of the frame, as a share of the distance from the middle."""
_SHAPE = (600, 800)

DESIGN: ReseauDesign = regular_reseau(8, 7, _PITCH, Mark(shape="disk", size=_SIZE), name="sheet").model_copy(
    update={"rings": Rings(inner=5.2, outer=9.0, sectors=_SECTORS)}
)


@dataclass(frozen=True, eq=False)
class Formed:
    """A frame, and the images (n, 2) of the centres of its disks."""

    frame: Frame
    truth: Array


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera 13 cm above the sheet, turned and tilted, with barrel distortion: 800 × 600 pixels, 55° wide.

    Parameters
    ----------
    roll, tilt : float
        Degrees.
    shift : (float, float)
        Of the whole image, pixels.
    blur_px : float
        Width of the point-spread function.
    """

    roll: float
    tilt: float
    shift: tuple[float, float] = (0.0, 0.0)
    blur_px: float = 0.9

    def image(self, xy: Array) -> tuple[Array, Array]:
        """Images (n, 2) of points of the sheet (n, 2), millimetres, and the derivatives (n, 2, 2)."""
        straight, middle, half = self._straight(), np.array(_SHAPE[::-1]) / 2, max(_SHAPE) / 2
        u = (straight(xy) - middle) / half
        r2 = (u**2).sum(axis=1)[:, None]
        slope = (1 + _BARREL * r2)[..., None] * np.eye(2) + 2 * _BARREL * u[:, :, None] * u[:, None, :]
        return middle + half * u * (1 + _BARREL * r2), slope @ straight.derivatives(xy).d_xy

    def _straight(self) -> RationalPolynomial:
        k, t = np.deg2rad([self.roll, self.tilt])
        turn = np.array([[np.cos(k), -np.sin(k), 0], [np.sin(k), np.cos(k), 0], [0, 0, 1]])
        lean = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]])
        rotation = lean @ turn @ np.diag([1.0, -1.0, -1.0])
        height, width = _SHAPE
        focal = 0.95 * width
        x0, y0 = width / 2 + self.shift[0], height / 2 + self.shift[1]
        camera = np.array([[focal, 0, x0], [0, focal, y0], [0, 0, 1]])
        h = camera @ np.column_stack([rotation[:, :2], [0.0, 0.0, 130.0]])
        straight = RationalPolynomial.projective()
        return straight.with_values((h / h[2, 2]).ravel()[:8])

    def share(self, outline: Outline) -> Array:
        """Share of each pixel that plane shapes take."""
        return draw(outline.mapped(self.image).oriented(), _SHAPE, self.blur_px)


def exposed(share: Array, seed: int = 0, light: float = 190.0) -> Frame:
    """Dark marks on an unevenly lit ground, with noise of 2 grey values."""
    u = np.linspace(-1, 1, share.shape[1])
    noise = np.random.default_rng(seed).normal(0, 2.0, share.shape)
    grey = light * (1 + 0.1 * u) * (1 - 0.85 * share) + noise
    return Frame(grey.round().clip(0, 254).astype(np.uint8), 255.0, "formed")


def form(
    camera: Camera,
    design: ReseauDesign = DESIGN,
    *,
    rings: bool = True,
    glare: Array | None = None,
    seed: int = 0,
    light: float = 190.0,
) -> Formed:
    """A photograph of the sheet; of the light that a disk takes, `glare` (h, w) gives back a share."""
    assert design.mark.size is not None
    circle, xy = Outline.circle(design.mark.size / 2, 0.05), design.xy
    tangents = np.broadcast_to(circle.dxy, (len(xy), *circle.dxy.shape))
    share = camera.share(Outline(xy[:, None] + circle.xy, tangents))
    assert design.rings is not None
    for name, sectors in design.rings.sectors.items():
        for start, end in sectors if rings else ():
            share += camera.share(_sector(design.rings, start, end, xy[design.ids.index(name)]))
    if glare is not None:
        share *= 1 - glare
    return Formed(exposed(share, seed, light), camera.image(xy)[0])


def _sector(rings: Rings, start: float, end: float, centre: Array) -> Outline:
    """A part of a ring as a polygon."""
    angle = np.deg2rad(np.linspace(start, end, 60))
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = np.concatenate([rings.outer / 2 * arc, rings.inner / 2 * arc[::-1]]) + centre
    outline = Outline.polygon(corners, 0.1)
    return Outline(outline.xy[None], outline.dxy[None])
