"""The coded testfield on a turntable, and the camera of Vosselman and Förstner that records it.

The board is tilted by φ about the vertical axis of its mount and turned by κ in its own plane; the camera
is 5 m away and is turned about its axis. The board is not plane: it bends, and as in the paper the bend
depends on the tilt and keeps its direction relative to the mount when the board is turned in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import Literal, NamedTuple

import numpy as np

from reseau.core.data import Array, Frame, Mask
from reseau.designs import coded_testfield
from reseau.io import TestfieldDesign
from reseau.optics import (
    Brown,
    PixelGrid,
    Pose,
    Sensor,
    illumination,
    matrix_to_vector,
    project,
    rotation_matrix,
)
from reseau.optics.formation import Outline, PixelResponse, draw
from reseau.optics.grids import line_grid
from reseau.optics.sensor import sigma_of_snr
from reseau.optics.targets import target_outline

from .frame import SpaceFrame
from .photograph import Photograph
from .streams import stream
from .water import Water

PITCH_MM, PIXELS, C_MM, DISTANCE_MM = 0.027, 240, 57.5, 5000.0
"""The paper's camera: table 1 and section 2.2."""
WET_C_MM, WET_DISTANCE_MM = 8.0, 1000.0
"""Camera under water: the board is as large in the frame as in air, and rays are refracted by up to 8°."""
JITTER_PX = 0.0086
"""Row jitter by which the bound of x is 1.3 × that of y, over all targets recorded at right angles."""
_OUTSIDE_PX = 60.0
"""Distance from the frame beyond which no target is drawn."""
_SPACING_PX = 0.7
"""Distance of nodes on an outline in widths of the point-spread function."""


class Station(NamedTuple):
    """One recording: tilt and turn of the board, turn of the camera, all in degrees; height of the board.

    Examples
    --------
    >>> Station(30.0, 90.0).name
    'phi 30 kappa 90 camera 0'
    """

    phi: float
    kappa: float = 0.0
    camera_kappa: float = 0.0
    height_mm: float = 0.0

    @property
    def name(self) -> str:
        """Name of the recording."""
        lifted = f" height {self.height_mm:g}" if self.height_mm else ""
        return f"phi {self.phi:g} kappa {self.kappa:g} camera {self.camera_kappa:g}{lifted}"


def paper_stations(tilts: tuple[float, ...] = (0.0, 30.0, 45.0)) -> tuple[Station, ...]:
    """The paper's recordings, 36 of them: from nine positions, with the camera turned by 0, 90, 180, 270°.

    A board without tilt is recorded from one position, a tilted one from four, turned in its mount.

    Examples
    --------
    >>> len(paper_stations())
    36
    """
    quarters = (0.0, 90.0, 180.0, 270.0)
    return tuple(
        Station(phi, kappa, camera)
        for phi in tilts
        for kappa in (quarters if phi else (0.0,))
        for camera in quarters
    )


class Stain(NamedTuple):
    """A round spot in the image: centre and radius in pixels, and the grey value seen there.

    An opaque one hides the image behind it; its grey values vary by its texture, and with an end it is long
    and round like a finger. Otherwise it is glare, whose light is added and decreases as a Gaussian of this
    width.

    Examples
    --------
    >>> Stain(120.0, 80.0, radius=6.0, grey=10.0).opaque
    True
    """

    x: float
    y: float
    radius: float
    grey: float
    opaque: bool = True
    end: tuple[float, float] | None = None
    texture: float = 0.0


@dataclass(frozen=True, eq=False)
class FieldTruth:
    """True positions in a recording.

    Parameters
    ----------
    names : tuple of str (n,)
        The targets.
    xyz : ndarray (n, 3)
        Their true centroids on the bent board, in its system (mm).
    xy : ndarray (n, 2)
        Their true images (px), inside the frame or not.
    pose : Pose
        Of the camera in the system of the board.
    view : callable
        From the plane of the design (n, 2) to the image (n, 2), and its Jacobian (n, 2, 2).

    Examples
    --------
    >>> truth = FieldBench(seed=1).truth(Station(30.0))
    >>> truth.xyz.shape == (len(truth.names), 3)
    True
    """

    names: tuple[str, ...]
    xyz: Array
    xy: Array
    pose: Pose
    view: Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class FieldBench:
    """The testfield in its mount, the light on it, and the camera; by default those of the paper.

    Parameters
    ----------
    seed : int
        Seed of noise, jitter, and set-up errors.
    design : TestfieldDesign
        Targets and lines of the board.
    bend_mm : float
        Sag of the edges of the paper's 4 × 4 squares at a tilt of 45°; proportional to the sine of the tilt.
    bend_with : {"mount", "board"}
        System in which the direction of the bend is constant.
    distance_mm : float
        From the camera to the middle of the board.
    camera : Brown
        From ideal directions to pixels.
    sensor : Sensor
        Sensor with its noise and row jitter.
    psf_px : float
        Width (one sigma) of the point-spread function.
    response : PixelResponse
        21.6 of 27 µm are sensitive to light.
    level, contrast : float
        Grey value of bright areas, and relative difference of dark ones.
    gradient : (float, float)
        Relative change of the light from the middle of the frame to its edges.
    stains : tuple of Stain
        Hidden parts and glare.
    missing : frozenset of str
        Missing targets.
    mirrored : bool
        Whether the frame is seen in a mirror, left to right.
    photograph : Photograph
        Blur of other forms, unevenness of the light, tone curve, sharpening and compression.
    ink_mm : float
        Growth of everything printed, on every side.
    waves_mm : float
        Height of waves of the board, two squares long along both axes.
    stage_tilt : (float, float)
        Tilt of the axis of the stage that lifts the board: x and y in the system of the board (rad).
    stage_sigma_mm : float
        Standard deviation of the true height of the stage about its reading.
    water : Water, optional
        Port of the camera and the water between it and the board; by default air.
    frame : SpaceFrame, optional
        Targets of a frame in place of the board, photographed by their lens in place of `camera`.

    Examples
    --------
    >>> bench = FieldBench(seed=1)
    >>> station = paper_stations()[4]
    >>> frame, truth = bench.record(station), bench.truth(station)
    >>> station.name, frame.pixels.shape, int(bench.inside(truth, 8.0).sum())
    ('phi 30 kappa 0 camera 0', (240, 240), 312)
    """

    seed: int = 0
    design: TestfieldDesign = field(default_factory=coded_testfield)
    bend_mm: float = 0.8
    bend_with: Literal["mount", "board"] = "mount"
    distance_mm: float = DISTANCE_MM
    camera: Brown = field(
        default_factory=lambda: Brown(
            side="object", grid=PixelGrid(PIXELS, PIXELS, (PITCH_MM, PITCH_MM))
        ).with_values({"c": C_MM})
    )
    sensor: Sensor = field(
        # The noise of 46 dB is that of reading and of rounding.
        default_factory=lambda: Sensor(
            PIXELS,
            PIXELS,
            shot_noise=False,
            read_noise=float(np.sqrt(sigma_of_snr(46.0) ** 2 - 1 / 12)),
            row_jitter_px=JITTER_PX,
        )
    )
    psf_px: float = 0.7
    response: PixelResponse = field(default_factory=lambda: PixelResponse(0.8))
    level: float = 200.0
    contrast: float = 0.85
    gradient: tuple[float, float] = (0.0, 0.0)
    stains: tuple[Stain, ...] = ()
    missing: frozenset[str] = frozenset()
    mirrored: bool = False
    photograph: Photograph = field(default_factory=Photograph)
    ink_mm: float = 0.0
    waves_mm: float = 0.0
    stage_tilt: tuple[float, float] = (0.0, 0.0)
    stage_sigma_mm: float = 0.0
    water: Water | None = None
    frame: SpaceFrame | None = None

    def submerged(self, water: Water) -> FieldBench:
        """The bench in a tank: a camera of 8 mm in a housing, 1 m in front of the testfield."""
        camera = self.camera.with_values({"c": WET_C_MM})
        return replace(self, water=water, camera=camera, distance_mm=WET_DISTANCE_MM)

    def distorted(self, edge_px: float) -> FieldBench:
        """The bench with a lens whose radial distortion displaces the middles of the edges by `edge_px`.

        A positive displacement is a polynomial of the ideal point, a negative one the inverse of a
        polynomial, so that both are invertible.
        """
        half, moved = (self.sensor.width / 2) * PITCH_MM, edge_px * PITCH_MM
        at = half if edge_px > 0 else half + moved
        camera = replace(self.camera, side="object" if edge_px > 0 else "image")
        return replace(self, camera=camera.with_values({"K1": abs(moved) / at**3}))

    def pose(self, station: Station) -> Pose:
        """Pose of the camera in the system of the board, with set-up errors of a few millimetres."""
        rng = stream(self.seed, "setup", *station[:3])
        turn = np.deg2rad(station.camera_kappa) + rng.normal(0, 5e-3)
        roll = rotation_matrix(np.array([0, 0, turn]))
        x0 = np.array([*rng.normal(0, 3, 2), self.distance_mm + rng.normal(0, 5)])
        looks = roll @ np.diag([1.0, -1.0, -1.0])
        board = rotation_matrix(np.array([0, np.deg2rad(station.phi), 0])) @ self._turn(station)
        return Pose(matrix_to_vector(looks @ board), board.T @ x0 - self._lift(station))

    def _lift(self, station: Station) -> Array:
        """Displacement of the board by the stage (mm), in its system."""
        if not station.height_mm:
            return np.zeros(3)
        moved = station.height_mm + self.stage_sigma_mm * stream(self.seed, "stage", *station).normal()
        axis = np.array([*self.stage_tilt, 1.0])
        return np.asarray(moved * axis / np.linalg.norm(axis))

    def truth(self, station: Station) -> FieldTruth:
        """True positions of all targets in a recording, and the mapping that forms it."""
        pose, surface = self.pose(station), self.surface(station)
        view = self._view(station)
        xy = self.design.xy
        return FieldTruth(self.design.ids, surface(xy)[0], view(xy)[0], pose, view)

    def _view(
        self, station: Station, colour_nm: float | None = None
    ) -> Callable[[Array], tuple[Array, Array]]:
        """The mapping that forms a recording, in light of one colour."""
        pose, surface = self.pose(station), self.surface(station)

        def view(xy: Array) -> tuple[Array, Array]:
            points, slope = surface(xy)
            if self.water is None:
                seen = project(self.camera, pose, points)
                image, jacobian = seen.xy.copy(), seen.d_point @ slope
            else:
                place = (points - pose.x0) @ pose.matrix.T
                ray = self.water.directions(place, colour_nm)
                image, by_ray, _ = self.camera.derivatives(ray.xy)
                jacobian = by_ray @ ray.d_point @ pose.matrix @ slope
            if self.mirrored:
                image[:, 0] = self.sensor.width - 1 - image[:, 0]
                jacobian[:, 0] *= -1
            return image, jacobian

        return view

    def inside(self, truth: FieldTruth, margin_px: float) -> Mask:
        """Targets (n,) whose centre is in the frame, at least `margin_px` from its edges."""
        size = np.array([self.sensor.width, self.sensor.height]) - 1
        within: Mask = (truth.xy >= margin_px) & (truth.xy <= size - margin_px)
        return np.asarray(within.all(axis=1))

    def record(self, station: Station) -> Frame:
        """Record the testfield; the same seed and station give the same frame to the bit."""
        rng = stream(self.seed, "exposure", *(station if station.height_mm else station[:3]))
        shifts = self.sensor.row_shifts(rng) if self.sensor.row_jitter_px else None
        exposed = self.sensor.expose(self.light(station, shifts), rng)
        pixels = self.photograph.processed(exposed, self.sensor.full_scale)
        return Frame(pixels, self.sensor.full_scale, station.name, sha256(pixels.tobytes()).hexdigest())

    def light(self, station: Station, row_shifts: Array | None = None) -> Array:
        """Light on each pixel, (height, width), in grey values and without noise."""
        shape = (self.sensor.height, self.sensor.width)
        if self.frame is not None:
            share = self.frame.share(self.pose(station), self.water, shape, self.psf_px, self.response)
            even = illumination(self.sensor.width, self.sensor.height, gradient=self.gradient)
            return np.maximum(self.level * even * (1 - self.contrast * share), 0.0)
        colours = (None,) if self.water is None else self.water.colours
        share = np.zeros(shape)
        for colour in colours:
            view = self._view(station, colour)
            for outline in self._outlines(view):
                image = outline.mapped(view).oriented()
                for place, weight in zip(*self.photograph.kernel(), strict=True):
                    moved = Outline(image.xy + place, image.dxy)
                    drawn = draw(moved, shape, self.psf_px, self.response, row_shifts)
                    share += weight / len(colours) * drawn
        if self.design.polarity == "bright":
            share = 1 - share
        even = illumination(
            self.sensor.width,
            self.sensor.height,
            gradient=self.gradient,
            curvature=self.photograph.curvature,
        )
        light: Array = self.level * even * (1 - self.contrast * share)
        for stain in self.stains:
            light = self._stained(light, stain)
        return np.maximum(light, 0.0)

    def _turn(self, station: Station) -> Array:
        return rotation_matrix(np.array([0, 0, np.deg2rad(station.kappa)]))

    def surface(self, station: Station) -> Callable[[Array], tuple[Array, Array]]:
        """The bent board: from its plane (n, 2) to points (n, 3) in its system, and the slope (n, 3, 2)."""
        reach = 2 * self.design.pitch
        sag = self.bend_mm * np.sin(np.deg2rad(station.phi)) / np.sin(np.pi / 4)
        # The direction across the bend, in the system of the board.
        way = np.array([1.0, 0.0])
        if self.bend_with == "mount":
            way = self._turn(station)[:2, :2].T @ way

        def surface(xy: Array) -> tuple[Array, Array]:
            along = xy @ way / reach
            points = np.column_stack([xy, -sag * along**2])
            slope = np.tile(np.eye(3)[:, :2], (len(xy), 1, 1))
            slope[:, 2] = -2 * sag * along[:, None] * way / reach
            if self.waves_mm:
                (x, y), k = xy.T, np.pi / self.design.pitch
                points[:, 2] += self.waves_mm * np.sin(k * x) * np.cos(k * y)
                slope[:, 2, 0] += self.waves_mm * k * np.cos(k * x) * np.cos(k * y)
                slope[:, 2, 1] -= self.waves_mm * k * np.sin(k * x) * np.sin(k * y)
            return points, slope

        return surface

    def _outlines(self, view: Callable[[Array], tuple[Array, Array]]) -> list[Outline]:
        """Outlines of seen targets and of lines in the plane of the board, in batches of equal shape."""
        spacing = _SPACING_PX * self.psf_px * self._mm_per_px()
        targets, xy = self.design.targets, self.design.xy
        there = np.array([name not in self.missing for name in targets.id])
        if self.water is not None:  # rays through water take time: none to targets well outside of the frame
            at, size = view(xy)[0], np.array([self.sensor.width, self.sensor.height])
            there &= ((at > -_OUTSIDE_PX) & (at < size + _OUTSIDE_PX)).all(axis=1)
        kinds: dict[tuple[str, float, float], list[int]] = {}
        for k in np.flatnonzero(there):
            kinds.setdefault((targets.shape[k], targets.size[k], targets.angle[k]), []).append(int(k))
        outlines = [
            target_outline(kind[0], kind[1] + 2 * self.ink_mm, kind[2], spacing).affine(
                np.tile(np.eye(2), (len(rows), 1, 1)), xy[rows]
            )
            for kind, rows in kinds.items()
        ]
        lines = self.design.lines
        beyond = max(
            lines.vertical_x[0] - lines.extent[0], lines.horizontal_y[0] - lines.extent[1], lines.width / 2
        )
        return [
            *outlines,
            *line_grid(
                lines.vertical_x, lines.horizontal_y, lines.width + 2 * self.ink_mm, spacing, beyond=beyond
            ),
        ]

    def _mm_per_px(self) -> float:
        """Size of a pixel on a board perpendicular to the axis."""
        assert self.camera.grid is not None
        longer = 1.0 if self.water is None else self.water.index
        return float(self.distance_mm / (longer * self.camera.values[0] * self.camera.grid.pixels_per_mm[0]))

    def _stained(self, light: Array, stain: Stain) -> Array:
        rows, columns = np.indices(light.shape)
        along = np.zeros(2) if stain.end is None else np.subtract(stain.end, (stain.x, stain.y))
        way = np.stack([columns - stain.x, rows - stain.y], axis=-1)
        part = np.clip(way @ along / max(float(along @ along), 1e-9), 0, 1)
        distance = np.hypot(*np.moveaxis(way - part[..., None] * along, 2, 0))
        if stain.opaque:
            over = 0.5 - 0.5 * np.tanh((distance - stain.radius) / self.psf_px)
            grey = stain.grey + stain.texture * np.sin(columns / 2.3) * np.cos(rows / 1.9)
            stained: Array = light * (1 - over) + grey * over
        else:
            stained = light + stain.grey * np.exp(-0.5 * (distance / stain.radius) ** 2)
        return stained
