"""Calibration networks with one known cause of misfit, drawn with OpenCV's cameras and code of this module.

A set-up is a camera, a target and a noise; of each a camera, a target, poses and noise are drawn at random.
The set-up ``stereo`` has two cameras that are fixed to each other; :func:`rig_of` makes such a pair of any
other. The ten causes change the world that is drawn, or the names, coordinates and sigmas that are stated;
the network is then adjusted as if there were no such cause. What a cause leaves in the residuals of an
adjustment without noise, over the noise, is the size of a case: the amplitude is searched for it. ``noise``
has factors, ``blunders`` and ``names`` have counts.

Poses map the target to a camera: ``x_c = R X + t``. Image coordinates are pixels as OpenCV has them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from reseau.bundle import Camera, Network, adjust_network, problem_of
from reseau.bundle.modelling.board import held_as_designed
from reseau.bundle.network.rig import Rig
from reseau.core.data import Array, ImagePoints, Rows
from reseau.core.failure import Failure
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera, first_camera, network_of
from reseau.procedures.calibration_options import CalibrationOptions, CameraOptions
from reseau.procedures.exposures import Taken

__all__ = [
    "CAUSES",
    "SETUPS",
    "SIZES",
    "Case",
    "Lens",
    "Scene",
    "SetUp",
    "Target",
    "World",
    "calibrated",
    "draw_case",
    "draw_scene",
    "draw_sound",
    "hand_held",
    "network",
    "rig_of",
]

CAUSES = (
    "lens", "refocus", "other-camera", "rolling-shutter", "motion", "target-shape", "target-scale", "names",
    "blunders", "noise",
)  # fmt: skip
SIZES = (0.3, 1.0, 3.0, 10.0)
FACTORS = (0.5, 1.5, 3.0, 10.0)
"""True noise over the stated sigma, for the sizes of `noise`."""
BLUNDERS = (1, 3, 10, 30)
MISNAMED = (1, 2, 3, 0)
"""Images with wrong names; 0 stands for a third of all."""
REACHED, STEPS = 0.05, 8
"""Relative difference from the asked size at which the search ends, and its most steps."""
KEPT = 0.9
"""Least part of the points of an image that stay in its frame."""
DISTORTIONS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
PLAIN = ("fx", "fy", "cx", "cy")
USUAL = (*PLAIN, "k1", "k2", "p1", "p2")
FIVE = (*USUAL, "k3")
EIGHT = (*FIVE, "k4", "k5", "k6")
FISHEYE = (*PLAIN, "k1", "k2", "k3", "k4")


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera as OpenCV computes it, or one whose radius is ``f tan(c·angle)/c``.

    Parameters
    ----------
    width, height : int
        Pixels.
    fx, fy, cx, cy : float
        Principal distances and principal point, px.
    k : dict of str to float
        Coefficients by OpenCV's names; those of tilt in radians.
    fisheye : bool
        Whether it is ``cv2.fisheye``; its coefficients are k1 to k4.
    bent : float
        One minus c; 0 is a perspective lens, 1 an equidistant one. Other than 0 without coefficients only.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k: dict[str, float] = field(default_factory=dict)
    fisheye: bool = False
    bent: float = 0.0

    @property
    def matrix(self) -> Array:
        """Camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def coefficients(self) -> Array:
        """Coefficients in the order of OpenCV."""
        names = ("k1", "k2", "k3", "k4") if self.fisheye else DISTORTIONS
        return np.array([self.k.get(name, 0.0) for name in names])

    @property
    def values(self) -> dict[str, float]:
        """Parameters by name."""
        return {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy} | self.k

    def changed(self, **k: float) -> Lens:
        """The lens with other coefficients."""
        return replace(self, k=self.k | k)

    def imaged(self, x: Array) -> Array:
        """Pixels (n, 2) of points in the camera system (n, 3), wherever the formula puts them."""
        if not len(x):
            return np.zeros((0, 2))
        if self.bent:
            angle = np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
            c = max(1 - self.bent, 1e-6)
            size = np.tan(c * angle) / c / np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-12)
            return np.array([self.fx, self.fy]) * size[:, None] * x[:, :2] + [self.cx, self.cy]
        none, given = np.zeros(3), np.ascontiguousarray(x[:, None, :])
        if self.fisheye:
            xy, _ = cv2.fisheye.projectPoints(given, none, none, self.matrix, self.coefficients)
        else:
            xy, _ = cv2.projectPoints(given, none, none, self.matrix, self.coefficients)
        return np.asarray(xy[:, 0], dtype=np.float64)

    @cached_property
    def widest(self) -> float:
        """Largest angle (rad) from the axis that has an image of its own, in the frame or near it."""
        most = 1.55 if self.fisheye or self.bent else 1.4
        angle = np.linspace(0.0, most, 600)
        far = 1.1 * np.hypot(max(self.cx, self.width - self.cx), max(self.cy, self.height - self.cy))
        found = most
        for side in (1.0, -1.0):
            for axis in range(2):
                x = np.zeros((len(angle), 3))
                x[:, axis], x[:, 2] = side * np.sin(angle), np.cos(angle)
                r = side * (self.imaged(x)[:, axis] - (self.cx, self.cy)[axis])
                ends = np.flatnonzero((np.diff(r, prepend=-1.0) <= 0) | (r > far))
                found = min(found, float(angle[ends[0]]) if len(ends) else most)
        return found

    def project(self, x: Array, margin: float = 0.0) -> Array:
        """Pixels (n, 2) of points in the camera system; NaN outside the frame less a margin (px)."""
        angle = np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
        xy = np.full((len(x), 2), np.nan)
        ahead = np.flatnonzero(angle < 0.98 * self.widest)
        xy[ahead] = self.imaged(x[ahead])
        return np.where(self.inside(xy, margin)[:, None], xy, np.nan)

    def inside(self, xy: Array, margin: float = 0.0) -> Array:
        """Whether pixels are in the frame."""
        return np.asarray(
            (xy >= margin).all(axis=1) & (xy <= np.array([self.width, self.height]) - 1 - margin).all(axis=1)
        )


@dataclass(frozen=True, eq=False)
class Target:
    """A plane target as designed, for :func:`reseau.procedures.calibration.calibrate_camera`.

    Parameters
    ----------
    ids : tuple of str
        Names of the points (p).
    xy : ndarray (p, 2)
        Coordinates, mm.
    place : ndarray of int (p, 2), optional
        Row and column of the point, or of its tag.
    corner : ndarray of int (p,), optional
        Number of the corner of a tag.
    whole : bool
        Whether only whole boards are measured.
    unit : str
        Unit.
    """

    ids: tuple[str, ...]
    xy: Array
    place: Rows | None = None
    corner: Rows | None = None
    whole: bool = False
    unit: str = "mm"

    @property
    def diagonal(self) -> float:
        """Diagonal of the target, mm."""
        return float(np.linalg.norm(np.ptp(self.xy, axis=0)))

    @property
    def flat(self) -> Array:
        """Points (p, 3)."""
        return np.column_stack([self.xy, np.zeros(len(self.xy))])


@dataclass(frozen=True, eq=False)
class SetUp:
    """Camera, target and noise, of which scenes are drawn.

    Parameters
    ----------
    name : str
        Name.
    lens, target : callable
        Draw a camera, and the target.
    images : (int, int)
        Range of the number of images, or of exposures of a rig.
    noise : float
        Standard deviation of image coordinates, px.
    model, free : str, tuple of str
        Model of the camera that is right, and its parameters.
    lacks : tuple of str
        Kinds of lenses that its model may be made to lack; see :func:`_lenses`.
    rig : bool
        Whether two cameras are fixed to each other.
    """

    name: str
    lens: Callable[[np.random.Generator], Lens]
    target: Callable[[np.random.Generator], Target]
    images: tuple[int, int]
    noise: float
    model: str
    free: tuple[str, ...]
    lacks: tuple[str, ...]
    rig: bool = False


@dataclass(frozen=True, eq=False)
class World:
    """What is photographed, and with what: all that a cause may change.

    Parameters
    ----------
    lenses : tuple of Lens
        Cameras.
    xyz : ndarray (p, 3)
        Points of the target.
    bent : ndarray (m, p, 3)
        What is added to them in each image.
    rotation, shift : ndarray (m, 3, 3), (m, 3)
        Poses.
    zoom : ndarray (m,)
        Factor of the principal distance of each image.
    centre : ndarray (m, 2)
        Shift of the principal point of each image, px.
    resized : ndarray (m,)
        Factor of the size of each image.
    speed : ndarray (m, 6)
        Velocity and rotation rates along the axes of the camera, per height of the frame.
    """

    lenses: tuple[Lens, ...]
    xyz: Array
    bent: Array
    rotation: Array
    shift: Array
    zoom: Array
    centre: Array
    resized: Array
    speed: Array


@dataclass(frozen=True, eq=False)
class Scene:
    """A sound world, and which points are measured in which image.

    Parameters
    ----------
    setup : SetUp
        Where it is from.
    target : Target
        The target as designed.
    world : World
        Everything that is photographed.
    camera_of, exposure_of : ndarray of int (m,)
        Camera and exposure of each image.
    seen : tuple of ndarray of int
        Points in each image.
    noise : tuple of ndarray (k, 2)
        Errors of the points of each image, in units of their sigma.
    sigma : float
        Standard deviation of image coordinates, px.
    """

    setup: SetUp
    target: Target
    world: World
    camera_of: Rows
    exposure_of: Rows
    seen: tuple[Rows, ...]
    noise: tuple[Array, ...]
    sigma: float

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images."""
        return tuple(f"{'ab'[c]}{e:02d}" for c, e in zip(self.camera_of, self.exposure_of, strict=True))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images."""
        return self.world.lenses[0].width, self.world.lenses[0].height

    @property
    def taken(self) -> dict[str, Taken] | None:
        """Camera and exposure of each image of a rig."""
        if len(self.world.lenses) == 1:
            return None
        rows = zip(self.images, self.camera_of, self.exposure_of, strict=True)
        return {name: Taken("ab"[c], f"{e:02d}") for name, c, e in rows}

    def exact(self, world: World | None = None) -> list[Array]:
        """Image coordinates without noise, of the points that are measured in each image."""
        world = world or self.world
        found = []
        for i, (c, rows) in enumerate(zip(self.camera_of, self.seen, strict=True)):
            lens = world.lenses[c]
            x = (world.xyz + world.bent[i])[rows] @ world.rotation[i].T + world.shift[i]
            xy = lens.imaged(x)
            if world.speed[i].any():
                xy = _line_by_line(lens, x, xy, world.speed[i])
            pp = np.array([lens.cx, lens.cy])
            xy = pp + world.centre[i] + world.zoom[i] * (xy - pp)
            found.append((xy + 0.5) * world.resized[i] - 0.5)
        return found


def _line_by_line(lens: Lens, x: Array, xy: Array, speed: Array) -> Array:
    """Pixels of points that are read at the time of their line while the camera moves."""
    for _ in range(20):
        t = (xy[:, 1] - (lens.height - 1) / 2) / lens.height
        moved = x - t[:, None] * speed[:3]
        turned = moved + _rotated(moved, t[:, None] * speed[3:])
        new = lens.imaged(turned)
        done = np.abs(new - xy).max() < 1e-9
        xy = new
        if done:
            break
    return xy


def _rotated(x: Array, angle: Array) -> Array:
    """Change of points (n, 3) by rotations (n, 3), Rodrigues' formula."""
    size = np.linalg.norm(angle, axis=1, keepdims=True)
    axis = angle / np.maximum(size, 1e-15)
    first = np.cross(axis, x)
    return np.asarray(np.sin(size) * first + (1 - np.cos(size)) * np.cross(axis, first))


@dataclass(frozen=True, eq=False)
class Case:
    """A network to adjust: what is measured, and how it is adjusted.

    Parameters
    ----------
    cause, variant : str
        What is wrong, and in which way; ``sound`` where nothing is.
    asked, size : float
        Asked size or count, and that which is reached.
    amplitude : float
        Amplitude of the cause, in the unit of the variant.
    reached : bool
        Whether the size is within a tenth of that asked.
    scene : Scene
        Where it is from.
    measured : dict of str to ImagePoints
        Points of each image.
    model, free : str, tuple of str
        Adjusted model of the camera.
    flat : bool
        Whether the target is held as designed.
    """

    cause: str
    variant: str
    asked: float
    size: float
    amplitude: float
    reached: bool
    scene: Scene
    measured: dict[str, ImagePoints]
    model: str
    free: tuple[str, ...]
    flat: bool


# -- cameras, targets, set-ups


def _about(rng: np.random.Generator, f: float, size: tuple[int, int], **k: float) -> Lens:
    """A camera like this one: f within 5 %, coefficients within 15 %, the centre within 1 % of the width."""
    f *= rng.uniform(0.95, 1.05)
    ratio = rng.uniform(0.999, 1.001)
    cx, cy = (np.array(size) - 1) / 2 + rng.normal(0, 0.007 * size[0], 2)
    return Lens(*size, f, f * ratio, cx, cy, {name: v * rng.uniform(0.85, 1.15) for name, v in k.items()})


def _wide(rng: np.random.Generator, terms: int = 6) -> Lens:
    """110 degrees over the diagonal: four or six radial coefficients that follow f tan(0.75 angle)/0.75."""
    c = rng.uniform(0.7, 0.8)
    r = np.linspace(0.02, np.tan(np.radians(60)), 200)
    ratio = np.tan(c * np.arctan(r)) / c / r
    powers = r[:, None] ** np.array([2, 4, 6])
    a = np.column_stack([powers, -ratio[:, None] * powers])[:, :terms]
    k = np.linalg.lstsq(a, ratio - 1, rcond=None)[0]
    size = (1920, 1080)
    f = rng.uniform(0.97, 1.03) * np.hypot(*size) / 2 / (np.tan(c * np.radians(55)) / c)
    cx, cy = (np.array(size) - 1) / 2 + rng.normal(0, 8, 2)
    names = ("k1", "k2", "k3", "k4", "k5", "k6")[:terms]
    given = dict(zip(names, k.tolist(), strict=True)) | dict(
        zip(("p1", "p2"), rng.normal(0, 2e-4, 2), strict=True)
    )
    return Lens(*size, f, f * rng.uniform(0.999, 1.001), cx, cy, given)


def _fisheye(rng: np.random.Generator) -> Lens:
    """150 degrees over the diagonal, nearly equidistant."""
    size, angle = (1280, 1024), np.radians(75)
    k = np.array([0.02, -0.006, 0.002, -0.0004]) * rng.uniform(0.8, 1.2, 4)
    f = np.hypot(*size) / 2 / (angle * (1 + k @ angle ** np.array([2, 4, 6, 8])))
    f *= rng.uniform(0.97, 1.03)
    cx, cy = (np.array(size) - 1) / 2 + rng.normal(0, 6, 2)
    names = ("k1", "k2", "k3", "k4")
    return Lens(
        *size, f, f * rng.uniform(0.999, 1.001), cx, cy, dict(zip(names, k.tolist(), strict=True)), True
    )


def _grid(columns: int, rows: int, pitch: float, whole: bool) -> Target:
    """Corners or circles in rows and columns."""
    row, column = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    ids = tuple(f"{r + 1}-{c + 1}" for r, c in zip(row, column, strict=True))
    return Target(
        ids,
        pitch * np.column_stack([column, -row]).astype(float),
        np.column_stack([row, column]),
        None,
        whole,
    )


def _tags(columns: int, rows: int, side: float, spacing: float) -> Target:
    """Corners of tags with a gap of `spacing` times their side."""
    row, column, corner = (
        a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(columns), np.arange(4), indexing="ij")
    )
    off = side * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    pitch = side * (1 + spacing)
    xy = pitch * np.column_stack([column, row]) + off[corner]
    ids = tuple(f"{columns * r + c}.{k}" for r, c, k in zip(row, column, corner, strict=True))
    return Target(ids, xy, np.column_stack([row, column]), corner)


def _testfield(rng: np.random.Generator) -> Target:
    """About 100 points spread over a plane, at least 22 mm apart."""
    xy = np.zeros((0, 2))
    for point in rng.uniform([0, 0], [400, 300], (3000, 2)):
        if len(xy) < 100 and (np.linalg.norm(xy - point, axis=1) > 22).all():
            xy = np.vstack([xy, point])
    return Target(tuple(f"T{k:03d}" for k in range(len(xy))), xy)


SETUPS: dict[str, SetUp] = {
    each.name: each
    for each in (
        SetUp(
            "phone",
            lambda rng: _about(rng, 3300, (4032, 3024), k1=0.08, k2=-0.16, p1=4e-4, p2=-3e-4, k3=0.07),
            lambda _: _grid(9, 6, 25.0, True), (9, 14), 0.15, "opencv", FIVE, ("k3", "p", "k2", "k1"),
        ),
        SetUp(
            "industrial", lambda rng: _about(rng, 1100, (1280, 960), k1=-0.21, k2=0.09, p1=3e-4, p2=2e-4),
            lambda _: _grid(7, 10, 20.0, False), (12, 18), 0.03, "opencv", USUAL, ("k3", "k2", "tilt", "p"),
        ),
        SetUp(
            "webcam", lambda rng: _about(rng, 560, (640, 480), k1=0.06, k2=-0.12, p1=8e-4, p2=-6e-4),
            lambda _: _grid(9, 7, 20.0, True), (10, 15), 0.05, "opencv", USUAL, ("k1", "p", "k2", "k3"),
        ),
        SetUp(
            "wide", _wide, lambda _: _grid(11, 8, 30.0, False), (15, 20), 0.04, "opencv", EIGHT,
            ("rational", "bent"),
        ),
        SetUp(
            "fisheye", _fisheye, lambda _: _tags(6, 6, 22.0, 0.3), (14, 20), 0.04, "fisheye", FISHEYE,
            ("fisheye", "perspective"),
        ),
        SetUp(
            "tele", lambda rng: _about(rng, 4000, (1600, 1200), k1=-0.15),
            lambda _: _grid(12, 9, 8.0, True), (12, 18), 0.025, "opencv", (*PLAIN, "k1"), ("k1", "p"),
        ),
        SetUp(
            "testfield", lambda rng: _about(rng, 2500, (2448, 2048), k1=-0.1, k2=0.12, p1=-2e-4, p2=3e-4),
            _testfield, (8, 12), 0.02, "opencv", USUAL, ("k3", "p", "tilt", "k2"),
        ),
        SetUp(
            "action",
            lambda rng: _about(rng, 960, (1920, 1080), k1=-0.22, k2=0.06, p1=2e-4, p2=-1e-4, k3=-0.004),
            lambda _: _grid(9, 6, 30.0, False), (16, 24), 0.1, "opencv", FIVE, ("k3", "bent", "k2", "k1"),
        ),
        SetUp(
            "small", lambda rng: _about(rng, 800, (752, 480), k1=-0.35, k2=0.14, p1=3e-4, p2=-5e-4),
            lambda _: _grid(11, 8, 15.0, True), (20, 25), 0.01, "opencv", USUAL, ("k3", "tilt", "p", "k2"),
        ),
        SetUp(
            "stereo", lambda rng: _about(rng, 1400, (1280, 960), k1=-0.1, k2=0.12, p1=2e-4, p2=3e-4),
            lambda _: _grid(9, 6, 30.0, True), (9, 13), 0.05, "opencv", USUAL, ("k3", "p", "k2", "k1"), True,
        ),
    )
}  # fmt: skip


def rig_of(setup: SetUp) -> SetUp:
    """The set-up with two cameras that are fixed to each other, and fewer exposures.

    From these, eight coefficients of two wide lenses are hardly determined; the lenses have six.
    """
    if setup.rig:
        return setup
    low, high = setup.images
    found = replace(setup, rig=True, images=(max(8, low // 2), max(10, high // 2)))
    if setup.name == "wide":
        return replace(found, lens=lambda rng: _wide(rng, 4), free=(*FIVE, "k4"))
    return found


# -- scenes


def _turn(vector: Any) -> Array:
    return np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0])


def hand_held(
    rng: np.random.Generator, lens: Lens, target: Target, fill: tuple[float, float] = (0.35, 1.0)
) -> tuple[Array, Array]:
    """A pose of a hand-held camera or board: rotation (3, 3), and shift (3,).

    The board is aimed at from 5 to 40 degrees in any direction, with any small roll or one of 90 degrees, and
    has `fill` times the height of the frame for its diagonal.
    """
    aim = rng.uniform(0.08, 0.92, 2) * [lens.width, lens.height]
    off = (aim - [lens.cx, lens.cy]) / lens.fx
    size = float(np.linalg.norm(off))
    angle = _angle_of(lens, size * lens.fx)
    way = np.append(np.sin(angle) * off / max(size, 1e-9), np.cos(angle))
    axis = np.array([-way[1], way[0], 0.0]) / max(np.hypot(way[0], way[1]), 1e-9)
    azimuth, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(5, 40))
    roll = rng.normal(0, 0.25) + rng.choice([0.0, np.pi / 2, -np.pi / 2, np.pi], p=[0.7, 0.12, 0.12, 0.06])
    tilted = _turn(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    rotation = _turn(angle * axis) @ tilted @ _turn([0, 0, roll]) @ np.diag([1.0, -1.0, -1.0])
    distance = lens.fx * target.diagonal / (rng.uniform(*fill) * lens.height)
    middle = np.append((target.xy.min(axis=0) + target.xy.max(axis=0)) / 2, 0.0)
    return rotation, distance * way - rotation @ middle


def _angle_of(lens: Lens, radius: float) -> float:
    """Angle of the ray at a distance from the principal point, px."""
    angle = np.linspace(0.0, lens.widest, 200)
    x = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    return float(np.interp(radius, lens.imaged(x)[:, 0] - lens.cx, angle))


def draw_scene(setup: SetUp, rng: np.random.Generator, flat: bool) -> Scene:
    """Draw a scene; where the target is not held as designed, it is printed with errors."""
    target, lens = setup.target(rng), setup.lens(rng)
    count = int(rng.integers(setup.images[0], setup.images[1] + 1))
    lenses: tuple[Lens, ...] = (lens,)
    apart, base = np.eye(3)[None], np.zeros((1, 3))
    if setup.rig:
        lenses = (lens, replace(setup.lens(rng), fisheye=lens.fisheye))
        away = lens.fx * target.diagonal / (0.6 * lens.height)
        converge = _turn(rng.normal(0, 0.02, 3)) @ _turn([0, rng.uniform(0.12, 0.3), 0])
        apart = np.stack([np.eye(3), converge])
        # The axes meet near the target.
        base = np.stack([np.zeros(3), np.array([0, 0, away]) - converge @ np.array([0, 0, away])])
    xyz = target.flat if flat else _printed(target, rng)
    rotation, shift, camera_of, exposure_of = [], [], [], []
    seen: list[Rows] = []
    fill, tries = (0.35, 1.0), 0
    while len(seen) < count * len(lenses):
        tries += 1
        if tries % 40 == 0:
            fill = (0.9 * fill[0], 0.9 * fill[1])
        if tries > 2000:
            raise RuntimeError(f"{setup.name}: no poses")
        pose, at = hand_held(rng, lens, target, fill)
        found = []
        for c, each in enumerate(lenses):
            own, off = apart[c] @ pose, apart[c] @ at + base[c]
            x = xyz @ own.T + off
            facing = _facing(own, off, target)
            xy = each.project(x, 0.012 * each.width)
            rows = np.flatnonzero(np.isfinite(xy).all(axis=1))
            if facing and _enough(rows, xy, target, each):
                found.append((own, off, rows))
        if len(found) < len(lenses):
            continue
        fill, tries = (0.35, 1.0), 0
        for c, (own, off, rows) in enumerate(found):
            rotation.append(own)
            shift.append(off)
            camera_of.append(c)
            exposure_of.append(len(seen) // len(lenses))
            seen.append(rows)
        exposure_of[-len(lenses) :] = [exposure_of[-len(lenses)]] * len(lenses)
    m = len(seen)
    world = World(
        lenses, xyz, np.zeros((m, *xyz.shape)), np.array(rotation), np.array(shift), np.ones(m),
        np.zeros((m, 2)), np.ones(m), np.zeros((m, 6)),
    )  # fmt: skip
    noise = tuple(rng.normal(size=(len(rows), 2)) for rows in seen)
    return Scene(
        setup, target, world, np.array(camera_of), np.array(exposure_of), tuple(seen), noise, setup.noise
    )


def _facing(rotation: Array, shift: Array, target: Target) -> bool:
    """Whether the face of the target is towards the camera, by at most 60 degrees."""
    middle = rotation @ np.append(target.xy.mean(axis=0), 0.0) + shift
    return bool(-rotation[:, 2] @ middle > 0.5 * np.linalg.norm(middle))


def _enough(rows: Rows, xy: Array, target: Target, lens: Lens) -> bool:
    """Whether an image is measured: the whole board, or a good part of it that is not a line."""
    if target.whole:
        return len(rows) == len(target.ids)
    if len(rows) < max(16, 0.3 * len(target.ids)):
        return False
    spread = np.linalg.svd(xy[rows] - xy[rows].mean(axis=0), compute_uv=False) / np.sqrt(len(rows))
    return bool(spread[1] > 0.02 * lens.width)


def _printed(target: Target, rng: np.random.Generator) -> Array:
    """Points of a target with the errors of a print: scale of the axes, single points, a bend."""
    size = target.diagonal
    xyz = target.flat
    xyz[:, :2] *= 1 + rng.normal(0, 1.5e-3, 2)
    xyz[:, :2] += rng.normal(0, 5e-5 * size, (len(xyz), 2))
    return xyz + _deflection(target, rng, rng.choice(["cylinder", "saddle"])) * rng.uniform(0, 2e-3) * size


def _deflection(target: Target, rng: np.random.Generator, kind: str) -> Array:
    """A deflection (p, 3) of unit size over the target."""
    s = (target.xy - (target.xy.min(axis=0) + target.xy.max(axis=0)) / 2) / (target.diagonal / 2)
    turn = rng.uniform(0, np.pi)
    u, v = np.cos(turn) * s[:, 0] + np.sin(turn) * s[:, 1], np.cos(turn) * s[:, 1] - np.sin(turn) * s[:, 0]
    z = u**2 if kind == "cylinder" else u**2 - v**2
    found = np.zeros((len(z), 3))
    found[:, 2] = rng.choice([-1.0, 1.0]) * (z - z.mean())
    return found


def _creases(target: Target, rng: np.random.Generator) -> Array:
    """Heights (p, 3) of about unit size of a target that is not stiff: three waves."""
    s = target.xy / target.diagonal
    found = np.zeros((len(s), 3))
    for _ in range(3):
        turn, length, phase = rng.uniform(0, np.pi), rng.uniform(0.4, 1.5), rng.uniform(0, 2 * np.pi)
        found[:, 2] += np.sin(2 * np.pi * (s @ [np.cos(turn), np.sin(turn)]) / length + phase)
    return found


# -- causes


@dataclass(frozen=True, eq=False)
class Plan:
    """A cause of which the amplitude is searched.

    Parameters
    ----------
    variant : str
        In which way.
    at : callable
        World for an amplitude.
    first, most : float
        Amplitude to begin with, and the largest that is plausible.
    model, free : str, tuple of str
        The model of the camera to adjust.
    sound_at_zero : bool
        Whether nothing is wrong with an amplitude of zero.
    """

    variant: str
    at: Callable[[float], World]
    first: float
    most: float
    model: str
    free: tuple[str, ...]
    sound_at_zero: bool = True


def _plans(cause: str, scene: Scene, rng: np.random.Generator) -> Iterator[Plan]:
    """Variants of a cause for a scene, in random order."""
    right = scene.setup.model, scene.setup.free
    world, target, m = scene.world, scene.target, len(scene.seen)
    if cause == "lens":
        for k in rng.permutation(len(scene.setup.lacks)):
            yield _lens_plan(scene.setup.lacks[k], scene, rng)
        return
    if cause == "refocus":
        normal, centre = rng.normal(size=m), rng.normal(size=(m, 2))
        for variant in rng.permutation(["distance", "distance and point"]):
            part = float(variant != "distance")
            # A principal point moves as far as the corners of the image do; no image becomes larger.
            off = part * 0.3 * centre * scene.size[0]
            zoom = normal - normal.max() - part

            def refocused(a: float, zoom: Array = zoom, off: Array = off) -> World:
                return replace(world, zoom=np.exp(a * zoom), centre=a * off)

            yield Plan(variant, refocused, 0.005, 0.4, *right)
        return
    if cause == "other-camera":
        few = _some_images(scene, int(rng.integers(2, max(2, m // 3) + 1)), rng)
        own: Array = np.isin(np.arange(m), few).astype(np.float64)
        sign, towards = float(rng.choice([-1.0, 1.0])), rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(towards), np.sin(towards)])
        worlds: dict[str, Callable[[float], World]] = {
            "zoom": lambda a: replace(world, zoom=np.exp(a * (sign * own - (sign > 0)))),
            "point": lambda a: replace(
                world, centre=own[:, None] * a * scene.size[0] * way, zoom=1 - a * own
            ),
            "size": lambda a: replace(world, resized=1 - a * own),
        }
        for variant in rng.permutation(list(worlds)):
            yield Plan(f"{variant} of {len(few)}", worlds[variant], 0.01, 0.4, *right)
        return
    if cause == "rolling-shutter":
        away = np.linalg.norm(world.shift + world.rotation @ world.xyz.mean(axis=0), axis=1)[:, None]
        speed = np.hstack([away * rng.normal(size=(m, 3)), rng.normal(size=(m, 3))])
        yield Plan("hand-held", lambda a: replace(world, speed=a * speed), 0.003, 0.3, *right)
        return
    if cause == "motion":
        second = scene.camera_of == 1
        turn, shift = rng.normal(size=(m, 3)), target.diagonal * rng.normal(size=(m, 3))
        middle = world.xyz.mean(axis=0)

        def moved(a: float) -> World:
            turns = np.array([_turn(a * each) for each in turn])
            rotation = np.where(second[:, None, None], world.rotation @ turns, world.rotation)
            off = world.shift + np.einsum("mij,mj->mi", world.rotation - rotation, np.tile(middle, (m, 1)))
            off = off + second[:, None] * a * np.einsum("mij,mj->mi", world.rotation, shift)
            return replace(world, rotation=rotation, shift=off)

        yield Plan("all exposures", moved, 1e-3, 0.2, *right)
        return
    if cause == "target-shape":
        for kind in rng.permutation(["cylinder", "saddle", "creased"]):
            if kind == "creased":
                creases = target.diagonal * np.array([_creases(target, rng) for _ in range(m)])
                yield Plan(kind, _deformed(world, creases, "bent"), 1e-3, 0.05, *right)
                continue
            bend = target.diagonal * _deflection(target, rng, kind)
            yield Plan(kind, _deformed(world, bend), 2e-3, 0.15, *right)
        return
    if cause == "target-scale":
        sign = rng.choice([-1.0, 1.0])
        kinds = ["x", "y"] if target.corner is None else ["x", "y", "spacing"]
        for kind in rng.permutation(kinds):
            change = np.zeros_like(world.xyz)
            if kind == "spacing":
                change[:, :2] = _places(target)
            else:
                axis = "xy".index(kind)
                change[:, axis] = world.xyz[:, axis] - world.xyz[:, axis].mean()
            yield Plan(kind, _deformed(world, sign * change), 2e-3, 0.08, *right)
        return
    raise ValueError(cause)


def _deformed(world: World, change: Array, field: str = "xyz") -> Callable[[float], World]:
    """The world with a target that differs from the design by a multiple of this change."""
    return lambda a: replace(world, **{field: getattr(world, field) + a * change})


def _places(target: Target) -> Array:
    """Place of the tag of each point (p, 2), mm, from the middle."""
    assert target.place is not None
    number = target.place[:, 0] * (target.place[:, 1].max() + 1) + target.place[:, 1]
    sums = np.array([target.xy[number == k].mean(axis=0) for k in range(number.max() + 1)])
    return np.asarray((sums - sums.mean(axis=0))[number])


def _some_images(scene: Scene, count: int, rng: np.random.Generator) -> Rows:
    """Images of one camera at random."""
    camera = int(rng.integers(len(scene.world.lenses)))
    own = np.flatnonzero(scene.camera_of == camera)
    return np.sort(rng.choice(own, min(count, len(own) // 2), replace=False))


def _within_frame(old: Lens, new: Lens) -> Lens:
    """A changed lens, with principal distances that leave nothing outside the frame that was inside."""
    far = np.hypot(max(old.cx, old.width - old.cx), max(old.cy, old.height - old.cy))
    x = np.sin(_angle_of(old, far)) * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    x[:, 2] = np.cos(_angle_of(old, far))
    before, after = (np.abs(lens.imaged(x) - [lens.cx, lens.cy]).max(axis=1) for lens in (old, new))
    ratio = min(1.0, float((before / np.maximum(after, 1e-9)).min()))
    return replace(new, fx=ratio * new.fx, fy=ratio * new.fy)


def _lens_plan(kind: str, scene: Scene, rng: np.random.Generator) -> Plan:
    """What a model may lack; the lenses of a rig lack the same.

    k1, k2, k3
        The coefficient, with those of higher order zero.
    p
        Decentring.
    tilt
        Tilted sensor; decentring is adjusted.
    rational
        k3 to k6 of a wide lens.
    bent
        A radius of f tan(c·angle)/c in place of the perspective, adjusted with k1, k2, p1, p2.
    fisheye
        k2 to k4 of a fisheye.
    perspective
        A fisheye adjusted as a perspective lens, with the boards near its axis.
    """
    world, sign, turn = scene.world, rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
    orders = ("k1", "k2", "k3")
    free: tuple[str, ...] = USUAL

    def lenses(change: Callable[[Lens], Lens]) -> World:
        return replace(world, lenses=tuple(_within_frame(lens, change(lens)) for lens in world.lenses))

    if kind in orders:
        n = orders.index(kind)
        higher = dict.fromkeys(orders[n + 1 :], 0.0)
        free = (*PLAIN, *orders[:n], *(("p1", "p2") if n else ()))
        none = {} if n else {"p1": 0.0, "p2": 0.0}
        reach = max(lens.widest for lens in world.lenses)
        first = 0.01 / np.tan(min(reach, 1.0)) ** (2 * n + 2)
        return Plan(
            f"lacks {kind}",
            lambda a: lenses(lambda lens: lens.changed(**higher, **none, **{kind: sign * a})),
            first, 12 * first, "opencv", free,
        )  # fmt: skip
    if kind == "p":
        free = tuple(name for name in scene.setup.free if name not in ("p1", "p2"))
        way = {"p1": np.cos(turn), "p2": np.sin(turn)}
        return Plan(
            "lacks p1 p2",
            lambda a: lenses(lambda lens: lens.changed(**{name: a * v for name, v in way.items()})),
            1e-4, 0.02, "opencv", free,
        )  # fmt: skip
    if kind == "tilt":
        way = {"tau_x": np.cos(turn), "tau_y": np.sin(turn)}
        return Plan(
            "tilted sensor",
            lambda a: lenses(lambda lens: lens.changed(**{name: a * v for name, v in way.items()})),
            0.05, 0.25, "opencv", USUAL,
        )  # fmt: skip
    if kind == "rational":
        radial = ("k1", "k2", "k3", "k4", "k5", "k6")
        return Plan(
            "lacks k3 to k6",
            lambda a: lenses(
                lambda lens: lens.changed(**{name: a * v for name, v in lens.k.items() if name in radial})
            ),
            0.3, 1.1, "opencv", USUAL,
        )  # fmt: skip
    if kind == "bent":
        return Plan(
            "wide lens as perspective", lambda a: lenses(lambda lens: replace(lens, bent=a, k={})),
            0.3, 1.0, "opencv", USUAL,
        )  # fmt: skip
    if kind == "fisheye":
        names = ("k2", "k3", "k4")
        return Plan(
            "lacks k2 to k4",
            lambda a: lenses(lambda lens: lens.changed(**{name: a * lens.k[name] for name in names})),
            0.3, 12.0, "fisheye", (*PLAIN, "k1"),
        )  # fmt: skip
    if kind == "perspective":
        middle = world.xyz.mean(axis=0)
        at = world.shift + world.rotation @ middle
        away = np.linalg.norm(at, axis=1)
        angle = np.arccos(at[:, 2] / away)
        axis = np.cross([0.0, 0.0, 1.0], at)
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)

        def nearer(a: float) -> World:
            # The directions to the boards are a times as far from the axis, and the boards twice as far.
            back = np.array([_turn((a - 1) * t * v) for t, v in zip(angle, axis, strict=True)])
            rotation = back @ world.rotation
            there = 2 * np.einsum("mij,mj->mi", back, at)
            return replace(world, rotation=rotation, shift=there - rotation @ middle)

        return Plan("fisheye as perspective", nearer, 0.3, 0.6, "opencv", USUAL, sound_at_zero=False)
    raise ValueError(kind)


def _searched(plan: Plan, scene: Scene, asked: float, flat: bool) -> tuple[float, float]:
    """Amplitude at which the cause leaves this size in the residuals, and the size that it leaves.

    Models with many coefficients are hardly determined without noise: residuals with the noise of the scene
    are compared with those of the same noise alone.
    """
    none = _residuals(plan, scene, 0.0, flat) if plan.sound_at_zero else None
    a, most, slope = plan.first, plan.most, 1.0
    best, last = (a, np.nan), None
    for _ in range(STEPS):
        v = _residuals(plan, scene, a, flat)
        size = np.nan
        if v is not None:
            size = float(np.sqrt(np.nanmean((v if none is None else v - none) ** 2))) / scene.sigma
        if not np.isfinite(size) or size <= 0:
            most = 0.95 * a
            a = 0.5 * a if last is None or last[0] > a else np.sqrt(last[0] * a)
            continue
        if not np.isfinite(best[1]) or abs(np.log(size / asked)) < abs(np.log(best[1] / asked)):
            best = (a, size)
        if abs(size / asked - 1) < REACHED:
            break
        if last is not None and a != last[0]:
            slope = float(np.clip(np.log(size / last[1]) / np.log(a / last[0]), 0.5, 4.0))
        last = (a, size)
        a *= float(np.clip((asked / size) ** (1 / slope), 0.03, 30.0))
        if a > most:
            if last[0] >= most:
                break
            a = most
    return best


def _residuals(plan: Plan, scene: Scene, a: float, flat: bool) -> Array | None:
    """Residuals (n, 2), px; None where the world folds, leaves the frame, or the adjustment fails."""
    world = plan.at(a)
    exact = scene.exact(world)
    for lens, xy in zip((scene.world.lenses[c] for c in scene.camera_of), exact, strict=True):
        if np.mean(lens.inside(xy)) < KEPT:
            return None
    if any(_folds(scene, world)):
        return None
    noisy = _noisy(scene, exact, float(plan.sound_at_zero))
    measured = dict(zip(scene.images, _points(scene, noisy, frame=False), strict=True))
    found = network(scene, measured, world, plan.model, plan.free, flat)
    fit: Any = problem_of(found)[0].adjusted()
    v = fit.residuals[: 2 * len(found.xy)].reshape(-1, 2) if fit else np.array([np.inf])
    if not fit or np.sqrt(np.nanmean(v**2)) > 100 * scene.sigma:
        result = adjust_network(network(scene, measured, None, plan.model, plan.free, flat))
        return None if isinstance(result, Failure) else result.residuals
    return v


def _folds(scene: Scene, world: World) -> Iterator[bool]:
    """For each image whether a lens has no image of its own of some point."""
    for i, (c, rows) in enumerate(zip(scene.camera_of, scene.seen, strict=True)):
        x = world.xyz[rows] @ world.rotation[i].T + world.shift[i]
        yield bool((np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2]) >= world.lenses[c].widest).any())


def _points(
    scene: Scene, xy: list[Array], names: list[Rows] | None = None, *, frame: bool = True
) -> Iterator[ImagePoints]:
    """Image points, inside the frames where asked, with the stated sigma."""
    rows_of = scene.seen if names is None else names
    for c, rows, at in zip(scene.camera_of, rows_of, xy, strict=True):
        inside = np.flatnonzero(scene.world.lenses[c].inside(at) | (not frame))
        cov = np.tile(scene.sigma**2 * np.eye(2), (len(inside), 1, 1))
        yield ImagePoints(tuple(scene.target.ids[rows[k]] for k in inside), at[inside], cov)


def network(
    scene: Scene,
    measured: dict[str, ImagePoints],
    near: World | None,
    model: str,
    free: tuple[str, ...],
    flat: bool,
) -> Network:
    """The network of a scene, with the poses and cameras of a world as approximate values."""
    options = CameraOptions(model=model, free=free)
    cameras = []
    for c, name in enumerate(("camera",) if scene.taken is None else ("a", "b")):
        if near is None:
            rows = zip(measured.items(), scene.camera_of, strict=True)
            own = {image: points for (image, points), at in rows if at == c}
            cameras.append(replace(first_camera(own, scene.target, scene.size, options), id=name))
            continue
        lens = near.lenses[c]
        known = set(PLAIN) if lens.fisheye != (model == "fisheye") or lens.bent else {*PLAIN, *free}
        given = [lens.values.get(p, 0.0) if p in known else 0.0 for p in options.registered.names]
        cameras.append(Camera(name, *scene.size, (1.0, 1.0), model, np.array(given), free))
    found = network_of(measured, scene.target, cameras[0])
    if scene.taken is not None:
        rig = Rig(scene.camera_of.astype(np.intp), scene.exposure_of.astype(np.intp))
        found = replace(found, cameras=tuple(cameras), camera_of=rig.camera, rig=rig)
    if near is not None:
        found = replace(
            found, x0=-np.einsum("mji,mj->mi", near.rotation, near.shift),
            rotation=np.array([cv2.Rodrigues(each)[0].ravel() for each in near.rotation]),
        )  # fmt: skip
    return held_as_designed(found) if flat else found


def _noisy(scene: Scene, exact: list[Array], factor: float = 1.0) -> list[Array]:
    return [xy + factor * scene.sigma * e for xy, e in zip(exact, scene.noise, strict=True)]


def _setup_of(cause: str, name: str) -> SetUp:
    """The set-up of a case: motion needs a rig, a rolling shutter a single camera."""
    setup = SETUPS[name]
    if cause == "motion":
        return rig_of(setup)
    return replace(setup, rig=False) if cause == "rolling-shutter" else setup


def draw_case(cause: str, level: int, setup: str, seed: int) -> Case:
    """Draw the network of a cause in one of the four sizes."""
    key = [seed, CAUSES.index(cause), level, list(SETUPS).index(setup)]
    rng = np.random.default_rng(key)
    flat = cause.startswith("target") or bool(rng.random() < 0.5)
    scene = draw_scene(_setup_of(cause, setup), rng, flat)
    right = scene.setup.model, scene.setup.free
    if cause == "noise":
        factor = FACTORS[level]
        measured = _measured(scene, _noisy(scene, scene.exact(), factor))
        return Case(cause, "factor", factor, factor, factor, True, scene, measured, *right, flat)
    if cause == "blunders":
        count, xy = BLUNDERS[level], _noisy(scene, scene.exact())
        whose = np.concatenate([np.full(len(rows), i) for i, rows in enumerate(scene.seen)])
        which = np.concatenate([np.arange(len(rows)) for rows in scene.seen])
        for k in rng.choice(len(whose), count, replace=False):
            turn, size = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(3), np.log(60)))
            xy[whose[k]][which[k]] += size * np.array([np.cos(turn), np.sin(turn)])
        return Case(
            cause, "single points", count, count, count, True, scene, _measured(scene, xy), *right, flat
        )
    if cause == "names":
        m = len(scene.seen)
        count = min(MISNAMED[level] or max(4, m // 3), max(1, int(0.4 * m)))
        names, variant = _misnamed(scene, count, rng)
        measured = _measured(scene, _noisy(scene, scene.exact()), names)
        return Case(cause, variant, count, count, count, True, scene, measured, *right, flat)
    asked, best = SIZES[level], None
    for plan in _plans(cause, scene, rng):
        a, size = _searched(plan, scene, asked, flat)
        if best is None or (np.isfinite(size) and abs(np.log(size / asked)) < abs(np.log(best[2] / asked))):
            best = plan, a, size if np.isfinite(size) else 1e-9
        if abs(best[2] / asked - 1) < 0.1:
            break
    assert best is not None
    plan, a, size = best
    measured = _measured(scene, _noisy(scene, scene.exact(plan.at(a))))
    reached = abs(size / asked - 1) < 0.1
    return Case(cause, plan.variant, asked, size, a, reached, scene, measured, plan.model, plan.free, flat)


def draw_sound(setup: str, seed: int) -> Case:
    """Draw a network with nothing wrong."""
    rng = np.random.default_rng([seed, 1000, list(SETUPS).index(setup)])
    flat = bool(rng.random() < 0.5)
    scene = draw_scene(SETUPS[setup], rng, flat)
    measured = _measured(scene, _noisy(scene, scene.exact()))
    return Case("sound", "", 0.0, 0.0, 0.0, True, scene, measured, scene.setup.model, scene.setup.free, flat)


def _measured(scene: Scene, xy: list[Array], names: list[Rows] | None = None) -> dict[str, ImagePoints]:
    return dict(zip(scene.images, _points(scene, xy, names), strict=True))


def _misnamed(scene: Scene, count: int, rng: np.random.Generator) -> tuple[list[Rows], str]:
    """Names of the points of each image, wrong in some images in the same way, and the way."""
    target = scene.target
    if target.place is None:
        ways = ["swapped", "turned", "mirrored"]
    elif target.corner is not None:
        ways = ["swapped", "tags swapped", "rows", "shifted", "corners"]
    else:
        # A mirrored lattice is that which is seen from behind: a pose absorbs it.
        ways = ["swapped", "rows", "shifted"]
    way = str(rng.choice(ways))
    names = [rows.copy() for rows in scene.seen]
    for i in rng.choice(len(names), count, replace=False):
        names[i] = _renamed(target, way, names[i], rng)
    return names, way


def _renamed(target: Target, way: str, rows: Rows, rng: np.random.Generator) -> Rows:
    """Wrong names of the points in an image."""
    new = rows.copy()
    if way == "swapped":
        a, b = rng.choice(len(rows), 2, replace=False)
        new[[a, b]] = new[[b, a]]
        return new
    if target.place is None:
        # A matcher that took the field for turned or mirrored: each name is that of the nearest point.
        middle = (target.xy.min(axis=0) + target.xy.max(axis=0)) / 2
        changed = middle + (target.xy[rows] - middle) * ([-1, -1] if way == "turned" else [-1, 1])
        cost = ((changed[:, None] - target.xy[None]) ** 2).sum(axis=2)
        return np.asarray(linear_sum_assignment(cost)[1])
    place = target.place
    columns = int(place[:, 1].max()) + 1
    number = place[:, 0] * columns + place[:, 1]
    corner = np.zeros_like(number) if target.corner is None else target.corner
    row_of = {(int(n), int(k)): j for j, (n, k) in enumerate(zip(number, corner, strict=True))}
    total = int(number.max()) + 1
    to = np.arange(total)
    if way == "tags swapped":
        a, b = rng.choice(np.unique(number[rows]), 2, replace=False)
        to[[a, b]] = to[[b, a]]
    elif way == "rows":
        axis = int(rng.integers(2))
        a, b = rng.choice(np.unique(place[rows, axis]), 2, replace=False)
        swap = place.copy()
        swap[place[:, axis] == a, axis], swap[place[:, axis] == b, axis] = b, a
        to[number] = swap[:, 0] * columns + swap[:, 1]
    elif way == "shifted":
        # A missed point: those after it have the number before theirs, up to the end of the board.
        missed = int(rng.integers(0, total // 2))
        to = np.where(np.arange(total) > missed, np.arange(total) - 1, np.arange(total))
        to[missed] = total - 1
    turned = 1 if way == "corners" else 0
    return np.array(
        [row_of[int(to[number[j]]), int(corner[j] + turned) % 4 if turned else int(corner[j])] for j in rows]
    )


# -- adjustment


def calibrated(case: Case, *, reject: bool = False) -> Calibrated | Failure:
    """Calibrate as a user would who knows nothing of the cause; without gross errors where asked."""
    scene = case.scene
    cameras = ("camera",) if scene.taken is None else ("a", "b")
    return calibrate_camera(
        list(case.measured.items()), scene.target, _unmeasured, dict.fromkeys(cameras, scene.size),
        CameraOptions(model=case.model, free=case.free),
        CalibrationOptions(target="flat" if case.flat else "free", reject=reject),
        scene.taken,
    )  # fmt: skip


def _unmeasured(*_: Any) -> Any:
    raise AssertionError("points are measured already")
