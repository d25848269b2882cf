"""One shared, seeded state that all simulators draw from: what one instrument does, another sees.

A world is not asked for images in an order: everything random has a stream of its own, named after what it is
for. PHOTO I is the same to the bit whether or not another photograph was taken before it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import sha256

import numpy as np

from reseau.data import Array, Frame
from reseau.designs import standard_reseau
from reseau.formats import ReseauDesign
from reseau.optics import Brown, PixelGrid, PlaneMapping, Pose, Sensor, angles_to_matrix, matrix_to_vector

from .camera import Camera, film
from .faults import Faults
from .plate import Plate
from .screen import Screen

__all__ = ["Truth", "World"]

_LEVEL = 190.0
"""Grey value of the lit screen, of 255."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Where everything really is.

    Parameters
    ----------
    names : tuple of str (n,)
        The marks of the design.
    object_xy : ndarray (n, 2)
        Their coordinates in the plane of the reseau (mm).
    xy : ndarray (n, 2)
        Their positions in the image without noise (px).
    view : PlaneMapping
        From the plane to the image, and by its inverse back.
    """

    names: tuple[str, ...]
    object_xy: Array
    xy: Array
    view: PlaneMapping


@dataclass
class World:
    """A screen, a reseau in front of it, and a camera that looks at both.

    Parameters
    ----------
    seed : int
        Where all that is random begins.
    screen : Screen
        What is lit.
    plate : Plate
        The reseau.
    camera : Camera
        What photographs them.
    faults : Faults
        What goes wrong.

    Examples
    --------
    >>> world = World.standard(seed=7)
    >>> frame = world.photo_i()
    >>> frame.name, frame.pixels.shape, len(world.truth().names)
    ('PHOTO I', (1200, 1600), 165)
    """

    seed: int
    screen: Screen
    plate: Plate
    camera: Camera
    faults: Faults = field(default_factory=Faults)

    @classmethod
    def standard(
        cls,
        seed: int = 0,
        *,
        design: ReseauDesign | None = None,
        faults: Faults | None = None,
        camera: Camera | None = None,
    ) -> World:
        """The bench of the oscilloscope procedure: a non-metric camera drawn from the seed.

        Parameters
        ----------
        seed : int
            Of the world. The camera, its film and the way it was set up differ from seed to seed.
        design : ReseauDesign, optional
            The reseau; by default the standard one.
        faults : Faults, optional
            None by default.
        camera : Camera, optional
            Instead of the one drawn.
        """
        faults = faults or Faults()
        world = cls(
            seed,
            Screen(),
            Plate(design or standard_reseau()),
            camera or _non_metric(_stream(seed, "camera")),
            faults,
        )
        world.screen.illuminate(_LEVEL, world.rng("phosphor"))
        world._apply_faults()
        return world

    def rng(self, *purpose: str | int) -> np.random.Generator:
        """The stream of random numbers for one purpose."""
        return _stream(self.seed, *purpose)

    @property
    def design(self) -> ReseauDesign:
        """The design of the reseau."""
        return self.plate.design

    def view(self) -> PlaneMapping:
        """From the plane of the reseau (mm) to the image (px), without noise: the truth."""
        return self.camera.view

    def truth(self) -> Truth:
        """Exact positions of all marks of the design, also of those that are missing."""
        design = self.design
        return Truth(design.ids, design.xy, self.camera.view(design.xy), self.camera.view)

    def check_marks(self) -> tuple[str, ...]:
        """Marks spread over the reseau that are meant to be held out of an adjustment: about one in nine."""
        held = {self.design.origin, self.design.axis}
        x, y = (np.unique(c, return_inverse=True)[1] for c in self.design.xy.T)
        return tuple(
            name
            for name, column, row in zip(self.design.ids, x, y, strict=True)
            if column % 3 == 1 and row % 3 == 1 and name not in held
        )

    def photo_i(self) -> Frame:
        """PHOTO I of the procedure: the reseau in front of the evenly lit screen, nothing displayed."""
        return self.photograph("PHOTO I")

    def photograph(self, name: str) -> Frame:
        """What the camera sees now; the same name gives the same noise."""
        rng, camera = self.rng("exposure", name), self.camera
        jitter = camera.sensor.row_shifts(rng) if camera.sensor.row_jitter_px else None
        light = self.plate.over(self.screen.seen(camera.view, camera.shape), camera, jitter)
        exposed = camera.sensor.expose(light, rng)
        pixels = self.faults.transmit(exposed, camera.sensor.bits, rng)
        return Frame(pixels, camera.sensor.full_scale, name, sha256(pixels.tobytes()).hexdigest())

    def _apply_faults(self) -> None:
        rng, ids = self.rng("faults"), self.design.ids
        gone = rng.choice(len(ids), self.faults.missing, replace=False)
        self.plate.missing = frozenset(ids[i] for i in gone)
        self.plate.false_marks = _between_marks(self.design.xy, self.faults.false_marks, rng)
        for sign in (1, -1, 1) if self.faults.scene else ():
            x, y = rng.uniform(-0.35, 0.35, 2) * (self.screen.width_mm, self.screen.height_mm)
            self.screen.draw_disk(x, y, rng.uniform(8, 22), sign * self.faults.scene)


def _stream(seed: int, *purpose: str | int) -> np.random.Generator:
    words = sha256(repr(purpose).encode()).digest()
    return np.random.default_rng([seed, *np.frombuffer(words, dtype="<u4").tolist()])


def _between_marks(xy: Array, count: int, rng: np.random.Generator) -> Array:
    """Places that keep away from every mark by a quarter of the way to its neighbour."""
    gap = np.partition(np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)), 1, axis=1)[:, 1].min()
    found: list[Array] = []
    while len(found) < count:
        place = rng.uniform(xy.min(axis=0), xy.max(axis=0))
        if np.hypot(*(xy - place).T).min() > 0.35 * gap:
            found.append(place)
    return np.array(found).reshape(-1, 2)


def _non_metric(rng: np.random.Generator) -> Camera:
    """An oscilloscope camera on Polaroid film: reproduction 0.57, nearly perpendicular, uncalibrated."""
    turn = angles_to_matrix(*np.deg2rad(rng.normal(0.0, [0.5, 0.5, 0.7])))
    # Whoever set it up looked at the middle of the screen: the axis meets it there, nearly.
    aim = np.array([*rng.normal(0.0, 0.3, 2), 0.0])
    pose = Pose(matrix_to_vector(turn), aim - turn[2] * rng.normal(264.0, 0.5))
    lens = Brown(side="image").with_values(
        {
            "c": 150.0,
            "x0": rng.normal(0.0, 0.1),
            "y0": rng.normal(0.0, 0.1),
            "K1": rng.normal(2.5e-6, 0.4e-6),
            "P1": rng.normal(0.0, 4.0e-8),
            "P2": rng.normal(0.0, 4.0e-8),
        }
    )
    deformation = film(
        ax=rng.normal(-2.0e-3, 5e-4),
        ay=rng.normal(-3.5e-3, 5e-4),
        bx=rng.normal(0.0, 1.0e-3),
        d1=rng.normal(2.0e-5, 5e-6),
        d2=rng.normal(-2.0e-5, 5e-6),
        h1=rng.normal(2.0e-8, 4e-9),
        h2=rng.normal(-2.5e-8, 5e-9),
    )
    sensor = Sensor(1600, 1200, gain=12.0, read_noise=1.0)
    scan = PixelGrid(sensor.width, sensor.height, (0.063, 0.063))
    return Camera(pose, lens, deformation, scan, sensor)
