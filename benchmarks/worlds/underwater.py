"""The network of Meid (1992, section 4): three underwater images of 28 targets on a frame, by rays of batoid.

A double Gauss of 70 mm in a housing looks through a plane-parallel window of 25 mm into water. For thousands
of points of the stop, rays of nine directions are traced from the stop both ways: through the front of the
lens, the window and the water to the plane of a target, and through the rear of the lens to the sensor. So
each place of the sensor sees, through that point of the stop, a point of the target. Behind the window, the
rims of the image are blurred by lateral colour and by astigmatism, the more the wider the stop. Nothing is
shared with the project: neither rays, nor indices, nor the formation of images.

Axes of the camera: x to the right, y down, z along the view, origin in the middle of the entrance pupil that
the lens has in air; millimetres. The axis of the lens is perpendicular to the window and the sensor.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import batoid
import numpy as np

from .blurred import ROWS, SELLMEIER, WAVELENGTHS, WEIGHTS, Array, add_shares, noisy, smoothed, spiral

__all__ = [
    "GLASS",
    "LENS_SCALE",
    "PITCH",
    "PORT",
    "PRINCIPAL",
    "PSF",
    "SIZE",
    "STRENGTHS",
    "WATER",
    "Port",
    "Project",
    "Strength",
    "View",
    "index",
    "project",
]


@dataclass(frozen=True)
class Strength:
    """What sets the blur: radius of the stop (mm) and the sensor's distance behind the first surface (mm)."""

    stop_radius: float
    image_z: float


@dataclass(frozen=True)
class Port:
    """The window: its inner face in front of the entrance pupil, and its thickness, mm."""

    distance: float
    thickness: float


LENS_SCALE = 0.7
"""Of the prescription `ROWS` of the double Gauss with a focal length of 100 mm."""
STRENGTHS = {
    "weak": Strength(1.6, 100.75),
    "medium": Strength(3.4, 100.7),
    "strong": Strength(7.2, 100.6),
}
FRAME = np.array([1100.0, 740.0, 400.0])
"""Sides of the frame, mm, about the origin of the object: X to the right, Y up, Z towards the cameras."""
RADII = (7.5, 11.0)
STATIONS = {
    "left": ((-1100.0, 150.0, 1890.0), (-25.0, -30.0, 0.0), 2.0),
    "middle": ((20.0, -30.0, 2150.0), (-12.0, 0.0, 0.0), -1.0),
    "right": ((1120.0, -180.0, 1880.0), (20.0, 30.0, 0.0), 1.0),
}
"""Projection centre, a point on the axis, and a turn about it, degrees."""
PORT = Port(90.0, 25.0)
SIZE = (1600, 1200)
PITCH = 0.036
"""mm: an image of 57.6 × 43.2 mm."""
PRINCIPAL = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
PSF = 0.45
"""Sigma of what blurs besides (film, sensor): a Gaussian, pixels."""
BRIGHT, DARK, DECIBELS = 200.0, 50.0, 40.0
"""Grey values of ground and targets; noise in all, in decibels below their difference."""
COUNT = 3000
"""Points of the stop for each wavelength, unless others are asked for."""
GLASS = (1.03961212, 0.231792344, 1.01046945, 0.00600069867, 0.0200179144, 103.560653)
"""Of the window, N-BK7: B1, B2, B3, C1, C2, C3 (µm²) as published by Schott."""
WATER = (
    (5.684027565e-1, 1.726177391e-1, 2.086189578e-2, 1.130748688e-1),
    (5.101829712e-3, 1.821153936e-2, 2.620722293e-2, 1.069792721e1),
)
"""Distilled water of 20 °C: A and C (µm²) of Daimon and Masumura (2007)."""
CORRESPONDING = WAVELENGTHS[1]
"""Wavelength of the corresponding rays, nm."""


def index(medium: str, wavelength_nm: float) -> float:
    """Refractive index of "water", of "window", or of a glass of the lens; 1 for "" and "stop"."""
    w2 = (wavelength_nm / 1000) ** 2
    if medium == "water":
        return float(np.sqrt(1 + sum(a * w2 / (w2 - c) for a, c in zip(*WATER, strict=True))))
    if medium in ("", "stop"):
        return 1.0
    terms = GLASS if medium == "window" else SELLMEIER[medium]
    return float(np.sqrt(1 + sum(b * w2 / (w2 - c) for b, c in zip(terms[:3], terms[3:], strict=True))))


class View:
    """Rays of one wavelength from the stop to both sides.

    Parameters
    ----------
    strength : Strength
    wavelength_nm : float
    port : bool
        Whether window and water are there.
    """

    def __init__(self, strength: Strength, wavelength_nm: float, *, port: bool = True) -> None:
        self.strength = strength
        self.stop_row = next(k for k, row in enumerate(ROWS) if row[2] == "stop")
        self.z = np.concatenate([[0.0], np.cumsum([row[1] for row in ROWS[:-1]])]) * LENS_SCALE
        self.stop_z = float(self.z[self.stop_row])
        media = [batoid.ConstMedium(index(row[2], wavelength_nm)) for row in ROWS]
        air = batoid.ConstMedium(1.0)

        def surface(k: int, side: float, origin: float) -> tuple[object, object]:
            bend = side * ROWS[k][0] / LENS_SCALE
            shape = batoid.Sphere(1 / bend) if bend else batoid.Plane()
            return shape, batoid.CoordSys(np.array([0.0, 0.0, side * (self.z[k] - origin)]))

        # To the sensor, z as in the prescription, from the stop.
        self._rear = []
        for k in range(self.stop_row + 1, len(ROWS)):
            shape, place = surface(k, 1.0, self.stop_z)
            self._rear.append(
                batoid.RefractiveInterface(shape, coordSys=place, inMedium=media[k - 1], outMedium=media[k])
            )
        # To the object, mirrored, from the stop.
        self._front = []
        for k in range(self.stop_row - 1, -1, -1):
            shape, place = surface(k, -1.0, self.stop_z)
            before = media[k - 1] if k else air
            self._front.append(
                batoid.RefractiveInterface(shape, coordSys=place, inMedium=media[k], outMedium=before)
            )
        self.pupil = pupil_z()
        if port:
            window = batoid.ConstMedium(index("window", wavelength_nm))
            water = batoid.ConstMedium(index("water", wavelength_nm))
            faces = ((PORT.distance, air, window), (PORT.distance + PORT.thickness, window, water))
            for distance, before, behind in faces:
                place = batoid.CoordSys(np.array([0.0, 0.0, distance + self.stop_z - self.pupil]))
                self._front.append(
                    batoid.RefractiveInterface(
                        batoid.Plane(), coordSys=place, inMedium=before, outMedium=behind
                    )
                )

    def outwards(self, stop: Array, slope: Array) -> tuple[Array, Array]:
        """Last refraction (n, 3) and direction (n, 3) in camera axes of rays from the stop.

        Parameters
        ----------
        stop, slope : ndarray (n, 2)
            Place in the stop, mm, and direction there (dx/dz, dy/dz), in camera axes.
        """
        at, way = _traced(self._front, stop, slope)
        return at + np.array([0.0, 0.0, self.pupil - self.stop_z]), way

    def pixels(self, stop: Array, slope: Array) -> Array:
        """Pixels (n, 2) where the same rays come from: backwards through the rear of the lens."""
        at, way = _traced(self._rear, stop, -slope)
        t = (self.strength.image_z - self.stop_z - at[:, 2]) / way[:, 2]
        return np.asarray(PRINCIPAL - (at + t[:, None] * way)[:, :2] / PITCH)

    def on_plane(self, stop: Array, slope: Array, centre: Array, axes: Array) -> Array:
        """Where the rays meet planes: coordinates (n, 2) along axes (…, 3, 2) about centres (…, 3), mm."""
        at, way = self.outwards(stop, slope)
        normal = np.cross(axes[..., 0], axes[..., 1])
        t = ((centre - at) * normal).sum(axis=-1) / (way * normal).sum(axis=-1)
        return np.asarray(((at + t[:, None] * way - centre)[:, None, :] @ axes)[:, 0])

    def aimed(self, stop: Array, centre: Array, axes: Array) -> Array:
        """Directions (n, 2) at the stop of the rays to the centres of targets, by Newton's method."""
        slope = np.broadcast_to(1.5 * centre[..., :2] / centre[..., 2:], stop.shape)
        h = 1e-5
        for k in range(20):
            off = self.on_plane(stop, slope, centre, axes)
            if k < 3:  # later, the derivatives hardly change
                by = [(self.on_plane(stop, slope + d, centre, axes) - off) / h for d in ((h, 0.0), (0.0, h))]
                slopes = np.stack(by, axis=2)
            change = np.linalg.solve(slopes, off[:, :, None])[:, :, 0]
            slope = slope - change
            if np.abs(change).max() < 1e-11:
                return np.asarray(slope)
        raise ArithmeticError("no ray to the target was found")


@cache
def pupil_z() -> float:
    """Distance of the entrance pupil of the lens in air behind its first surface, at 546.1 nm, mm."""
    index_before, height, slope = 1.0, 0.0, 1.0  # from the middle of the stop to the front, paraxially
    row = next(k for k, r in enumerate(ROWS) if r[2] == "stop")
    z = np.concatenate([[0.0], np.cumsum([r[1] for r in ROWS[:-1]])]) * LENS_SCALE
    at = z[row]
    for k in range(row - 1, -1, -1):
        height, at = height + slope * (at - z[k]), z[k]
        behind = index(ROWS[k - 1][2] if k else "", CORRESPONDING)
        # Mirrored, the curvature has the other sign.
        slope = (index_before * slope + (behind - index_before) * ROWS[k][0] / LENS_SCALE * height) / behind
        index_before = behind
    return height / slope


def _traced(items: list[object], stop: Array, slope: Array) -> tuple[Array, Array]:
    """Place and direction behind the last surface of rays through the stop, z from the stop."""
    count = np.zeros(len(stop))
    way = np.column_stack([slope, count + 1])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    rays = batoid.RayVector(*stop.T.copy(), count, *way.T.copy(), count, count + CORRESPONDING * 1e-9, count)
    for item in items:
        item.trace(rays)  # type: ignore[attr-defined]
    rays.toCoordSys(batoid.CoordSys())
    if rays.failed.any():
        raise ArithmeticError("a ray misses a surface of the lens")
    way = np.stack([rays.vx, rays.vy, rays.vz], axis=1)
    return np.stack([rays.x, rays.y, rays.z], axis=1), way / np.linalg.norm(way, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Project:
    """Three images of 28 targets, and what is true.

    Parameters
    ----------
    images : dict of ndarray (rows, columns)
        8-bit grey values: dark targets on a bright ground.
    centres : dict of ndarray (3,)
        Middle of the entrance pupil of the lens in air, in object coordinates, mm.
    rotations : dict of ndarray (3, 3)
        From object to camera axes.
    points : tuple of str
    xyz, normals : ndarray (28, 3)
        Centres of the round targets, mm, and unit normals towards the cameras.
    radius : ndarray (28,)
        mm.
    corresponding : dict of ndarray (28, 2)
        Pixels of the rays of 546.1 nm through the middle of the stop; NaN outside of the image.
    blur : dict of ndarray (28,)
        Diameter about the centroid that contains 80 % of the light of the target's centre, pixels; 0 in
        sharp images.
    """

    images: dict[str, Array]
    centres: dict[str, Array]
    rotations: dict[str, Array]
    points: tuple[str, ...]
    xyz: Array
    normals: Array
    radius: Array
    corresponding: dict[str, Array]
    blur: dict[str, Array]


def project(strength: str, seed: int, *, sharp: bool = False, count: int = COUNT) -> Project:
    """The images with noise; the network is the same for all strengths and seeds.

    Parameters
    ----------
    strength : {"weak", "medium", "strong"}
    seed : int
        Of the noise.
    sharp : bool
        The same network, formed by the rays of 546.1 nm through the middle of the stop alone.
    count : int
        Points of the stop for each wavelength.
    """
    centres, rotations = stations()
    points, xyz, normals, radius = frame()
    images, corresponding, blur = {}, {}, {}
    for k, name in enumerate(centres):
        image, corresponding[name], blur[name] = drawn(strength, name, sharp, count)
        images[name] = noisy(image, BRIGHT - DARK, DECIBELS, np.random.default_rng((seed, k, int(sharp))))
    return Project(images, centres, rotations, points, xyz, normals, radius, corresponding, blur)


def frame() -> tuple[tuple[str, ...], Array, Array, Array]:
    """Names, centres, normals and radii of the targets: corners, edges and inner struts of a box."""
    rng = np.random.default_rng(1992)
    box = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]
    outer = np.array([p for p in box if np.abs(p).sum() > 1]) * FRAME / 2
    inner = [(-230, -150), (0, -200), (230, -150), (-290, 30), (290, -30), (-200, 180), (30, 60), (210, 170)]
    xyz = np.concatenate([outer, np.column_stack([inner, np.zeros(8)])])
    xyz += rng.uniform(-1, 1, xyz.shape) * [20.0, 20.0, 30.0]
    tilt, towards = np.deg2rad(rng.uniform(0, 20, len(xyz))), rng.uniform(0, 2 * np.pi, len(xyz))
    normals = np.stack([np.sin(tilt) * np.cos(towards), np.sin(tilt) * np.sin(towards), np.cos(tilt)], axis=1)
    return tuple(str(101 + k) for k in range(len(xyz))), xyz, normals, rng.uniform(*RADII, len(xyz))


def stations() -> tuple[dict[str, Array], dict[str, Array]]:
    """Projection centres and rotations of the images."""
    centres, rotations = {}, {}
    for name, (at, aim, roll) in STATIONS.items():
        z = np.subtract(aim, at)
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 1.0, 0.0])
        x /= np.linalg.norm(x)
        y, turn = np.cross(z, x), np.deg2rad(roll)
        rotations[name] = np.stack(
            [np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x, z]
        )
        centres[name] = np.array(at)
    return centres, rotations


def targets(name: str) -> tuple[Array, Array]:
    """Centres (28, 3) and axes (28, 3, 2) of the targets in camera axes."""
    centres, rotations = stations()
    _, xyz, normals, _ = frame()
    first = np.cross([0.0, 1.0, 0.0], normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normals, first)], axis=2)
    turn = rotations[name]
    return (xyz - centres[name]) @ turn.T, turn @ axes


def principal_rays(view: View, centre: Array, axes: Array) -> tuple[Array, Array]:
    """Directions at the stop and pixels (n, 2) of the rays from targets through the middle of the stop."""
    stop = np.zeros((len(centre), 2))
    slope = view.aimed(stop, centre, axes)
    return slope, view.pixels(stop, slope)


@cache
def drawn(strength: str, name: str, sharp: bool, count: int = COUNT) -> tuple[Array, Array, Array]:
    """One image without noise, its corresponding points and blurs; kept in the folder for temporary files."""
    sources = [Path(__file__), Path(__file__).with_name("blurred.py")]
    key = hashlib.sha256(b"".join(p.read_bytes() for p in sources)).hexdigest()[:16]
    kept = Path(tempfile.gettempdir()) / f"underwater-{key}" / f"{strength}-{name}-{sharp:d}-{count}.npz"
    if not kept.exists():
        kept.parent.mkdir(exist_ok=True)
        image, corresponding, blur = draw(strength, name, sharp, count)
        part = kept.with_name(f"{os.getpid()}-{kept.name}")
        np.savez(part, image=image, corresponding=corresponding, blur=blur)
        part.replace(kept)
    with np.load(kept) as found:
        return found["image"], found["corresponding"], found["blur"]


def draw(strength: str, name: str, sharp: bool, count: int = COUNT) -> tuple[Array, Array, Array]:
    """One image without noise, its corresponding points (28, 2), and blurs (28,)."""
    views = [View(STRENGTHS[strength], w) for w in ((CORRESPONDING,) if sharp else WAVELENGTHS)]
    centre, axes = targets(name)
    corresponding = principal_rays(View(STRENGTHS[strength], CORRESPONDING), centre, axes)[1]
    image, blur = np.full(SIZE[::-1], BRIGHT), []
    for k, radius in enumerate(frame()[3]):
        share, (column, row), wide = taken(
            views, np.rint(corresponding[k]), centre[k], axes[k], radius, count
        )
        blur.append(wide)
        rows, columns = (np.arange(n) + first for n, first in zip(share.shape, (row, column), strict=True))
        r = (rows >= 0) & (rows < SIZE[1])
        c = (columns >= 0) & (columns < SIZE[0])
        image[np.ix_(rows[r], columns[c])] -= (BRIGHT - DARK) * share[np.ix_(r, c)]
    inside = (corresponding >= 0).all(axis=1) & (corresponding <= np.array(SIZE) - 1).all(axis=1)
    return image, np.where(inside[:, None], corresponding, np.nan), np.array(blur)


def taken(
    views: list[View], middle: Array, centre: Array, axes: Array, radius: float, count: int = COUNT
) -> tuple[Array, tuple[int, int], float]:
    """Share (r, c) of the light of pixels that a target takes, the first column and row, and its blur.

    One view instead of one for each wavelength: sharp. `middle` is a whole pixel close to the image.
    """
    sharp = len(views) == 1
    grid = 1.1 * radius * np.array([[u, v] for u in (-1, 0, 1) for v in (-1, 0, 1)])
    maps, weights, places, spots = [], [], [], []
    k = np.arange(count) + 0.5
    even = np.sqrt(k / count)[:, None] * spiral(k)
    # A sharp image needs one point of the stop; that it is repeated samples the pixels.
    stop = np.zeros((200, 2)) if sharp else views[0].strength.stop_radius * even
    n = len(stop)
    both = np.tile(centre, (n, 1)), np.broadcast_to(axes, (n, 3, 2))
    for weight, view in zip((1.0,) if sharp else WEIGHTS, views, strict=True):
        slope = view.aimed(stop, *both)
        spots.append(view.pixels(stop, slope))
        h = 1e-5
        by = [view.on_plane(stop, slope + d, *both) / h for d in ((h, 0.0), (0.0, h))]
        to = np.linalg.solve(np.stack(by, axis=2)[:, None], grid[None, :, :, None])[..., 0]
        slopes = (slope[:, None] + to).reshape(-1, 2)
        stops = np.repeat(stop, 9, axis=0)
        seen = view.on_plane(stops, slopes, *(np.repeat(b, 9, axis=0) for b in both)).reshape(n, 9, 2)
        place = view.pixels(stops, slopes).reshape(n, 9, 2) - middle
        x, y = place[..., 0], place[..., 1]
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
        turned = np.swapaxes(terms, 1, 2)
        maps.append(np.linalg.solve(turned @ terms, turned @ seen).transpose(0, 2, 1))
        # The light through an element of the stop from an element of the sensor: the product of the first
        # and the solid angle that the second spans there, in direction cosines.
        cosines = slopes / np.sqrt(1 + (slopes**2).sum(axis=1, keepdims=True))
        fit = np.linalg.solve(turned @ terms, turned @ cosines.reshape(n, 9, 2))
        weights.append(weight * np.abs(fit[:, 1, 0] * fit[:, 2, 1] - fit[:, 1, 1] * fit[:, 2, 0]))
        places.append(place)
    share, where = np.concatenate(weights), np.concatenate(places)
    margin, side = int(np.ceil(5 * PSF)) + 1, 12 if sharp else 4
    low = np.floor(where.min(axis=(0, 1))) - margin
    size = (np.ceil(where.max(axis=(0, 1))) + margin - low).astype(int) + 1
    samples = np.zeros((size[1] * side, size[0] * side))
    add_shares(samples, np.concatenate(maps), where, low - 0.5, side, False, radius, share)
    column, row = (int(v) for v in low + margin + middle)
    return smoothed(samples / share.sum(), side, PSF, margin), (column, row), energy_80(spots)


def energy_80(spots: list[Array]) -> float:
    """Diameter about the centroid of spots of all wavelengths that contains 80 % of their light."""
    if len(spots) == 1:
        return 0.0
    xy, weight = np.concatenate(spots), np.repeat(WEIGHTS, [len(s) for s in spots])
    away = np.hypot(*(xy - np.average(xy, axis=0, weights=weight)).T)
    order = np.argsort(away)
    share = np.cumsum(weight[order]) / weight.sum()
    return 2 * float(away[order][np.searchsorted(share, 0.8)])
