"""Shared, seeded state of all simulators: an effect of one instrument is visible to the others.

Results do not depend on the order of calls: each purpose has its own stream of random numbers. PHOTO I is the
same to the bit whether or not another photograph was taken before it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import Literal

import numpy as np

from reseau.core.data import Array, Frame
from reseau.designs import standard_reseau, test_object
from reseau.io import ReseauDesign
from reseau.optics import Brown, PixelGrid, Pose, Sensor, matrix_to_vector
from reseau.optics.composition import Chain, Inverted, Similarity
from reseau.optics.grids import Wires
from reseau.optics.mapping import PlaneMapping
from reseau.optics.poses import angles_to_matrix

from .camera import FilmCamera, film
from .display import Display
from .faults import Faults
from .plate import Plate, wired
from .reflectors import Reflectors, body_of, rods_of
from .scanner import Scanner, Video
from .screen import Screen
from .streams import stream

PHOTO_I, PHOTO_II, PHOTO_III = "PHOTO I", "PHOTO II", "PHOTO III"
"""Names of the photographs of the procedure."""
_LEVEL = 190.0
"""Grey value of the lit screen, of 255."""


@dataclass(frozen=True, eq=False)
class Truth:
    """True coordinates in the plane and in the image.

    Parameters
    ----------
    names : tuple of str (n,)
        Marks of the reseau, rods of the test object or points of a body.
    object_xy : ndarray (n, 2)
        Their coordinates in the plane of the reseau or of the object (mm). Those of rods are of the rods as
        manufactured, not as designed.
    xy : ndarray (n, 2)
        Their positions in the image without noise (px). For a rod, the middle of its arc: where the ridge
        line of the arc passes the position of the reflector.
    view : PlaneMapping
        Mapping from the plane to the image.

    Examples
    --------
    >>> truth = World.standard(seed=7).truth()
    >>> len(truth.names), truth.xy.shape
    (165, (165, 2))
    """

    names: tuple[str, ...]
    object_xy: Array
    xy: Array
    view: PlaneMapping


@dataclass
class World:
    """A scanner and its screen, a reseau in front of it, and a camera that looks at both.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    screen : Screen
        Screen of the tube.
    plate : Plate
        The reseau.
    camera : FilmCamera
        Camera that photographs the reseau and the screen.
    display : Display
        Tube that draws the video of the scanner on the screen.
    scanner : Scanner
        The ultrasonic instrument.
    test_object : ReseauDesign
        Rods of the test object, as designed.
    rods : Reflectors
        Rods of the test object, as manufactured.
    faults : Faults
        Faults.

    Notes
    -----
    Derived in ``docs/mathematics/bench.md``.

    Examples
    --------
    >>> world = World.standard(seed=7)
    >>> frame = world.photo_i()
    >>> frame.name, frame.pixels.shape, len(world.truth().names)
    ('PHOTO I', (1200, 1600), 165)
    >>> world.photo_ii().name, len(world.truth_ii().names), len(world.body(20).names)
    ('PHOTO II', 38, 20)
    """

    seed: int
    screen: Screen
    plate: Plate
    camera: FilmCamera
    display: Display
    scanner: Scanner
    test_object: ReseauDesign
    rods: Reflectors
    faults: Faults = field(default_factory=Faults)

    @classmethod
    def standard(
        cls,
        seed: int = 0,
        *,
        design: ReseauDesign | None = None,
        faults: Faults | None = None,
        camera: FilmCamera | None = None,
        display: Display | Literal["wong", "polynomial"] = "wong",
        scanner: Scanner | None = None,
        rods: ReseauDesign | None = None,
        wires: tuple[Wires, Wires] | None = None,
    ) -> World:
        """The bench of the oscilloscope procedure, with random non-metric components.

        Parameters
        ----------
        seed : int
            Seed of the world; camera, film and set-up differ between seeds.
        design : ReseauDesign, optional
            The reseau; by default the standard one.
        faults : Faults, optional
            None by default.
        camera : FilmCamera, optional
            Camera; random by default.
        display : Display or {"wong", "polynomial"}
            A random display of Wong's model, a random one that eq. (7a, b) corrects exactly, or this one.
        scanner : Scanner, optional
            Scanner; random by default.
        rods : ReseauDesign, optional
            The test object; by default the 100 mm one. The rods as made are drawn from its sigmas.
        wires : (Wires, Wires), optional
            Wires of the reseau, as of :func:`reseau_sims.plate.uneven_wires`; by default regular ones.
            Without a design, the reseau is that of their crossings.
        """
        faults, rods = faults or Faults(), rods or test_object()
        if not isinstance(display, Display):
            tube = {"wong": Display.drawn, "polynomial": Display.polynomial}[display]
            display = tube(stream(seed, "display"))
        world = cls(
            seed,
            Screen(),
            Plate(design or (standard_reseau() if wires is None else wired(wires)), wires=wires),
            camera or _non_metric(stream(seed, "camera")),
            display,
            scanner or Scanner.drawn(stream(seed, "scanner")),
            rods,
            rods_of(rods, stream(seed, "rods")),
            faults,
        )
        world.screen.illuminate(_LEVEL, world.rng("phosphor"))
        world._apply_faults()
        return world

    def rng(self, *purpose: str | int) -> np.random.Generator:
        """The stream of random numbers for one purpose."""
        return stream(self.seed, *purpose)

    @property
    def design(self) -> ReseauDesign:
        """The design of the reseau."""
        return self.plate.design

    def view(self) -> PlaneMapping:
        """True mapping from the plane of the reseau (mm) to the image (px)."""
        return self.camera.view

    def camera_of(self, photo: str) -> FilmCamera:
        """The camera as it stood for a photograph."""
        pushed = self.faults.camera_moved_mm
        if not pushed or photo not in (PHOTO_II, PHOTO_III):
            return self.camera
        way = self.rng("push").standard_normal(3)
        return self.camera.moved(pushed * way / np.hypot(*way[:2]) * (1, 1, 0.2), np.deg2rad(pushed / 20))

    def truth(self, photo: str = PHOTO_I) -> Truth:
        """True positions of all marks of the reseau in a photograph, including missing ones."""
        design, view = self.design, self.camera_of(photo).view
        return Truth(design.ids, design.xy, view(design.xy), view)

    def truth_ii(self) -> Truth:
        """True positions of the rods' images in PHOTO II, including those without echoes."""
        return self._truth_of(self.rods, PHOTO_II)

    def truth_iii(self, body: Reflectors | None = None) -> Truth:
        """True positions of a body's points in PHOTO III."""
        return self._truth_of(self.body() if body is None else body, PHOTO_III)

    def body(self, count: int = 24) -> Reflectors:
        """An invisible body of random points with known true positions."""
        return body_of(count, self.rng("body"))

    def check_marks(self) -> tuple[str, ...]:
        """Check marks spread over the reseau, about one in nine, for exclusion from an adjustment."""
        held = {self.design.origin, self.design.axis}
        x, y = (np.unique(c, return_inverse=True)[1] for c in self.design.xy.T)
        return tuple(
            name
            for name, column, row in zip(self.design.ids, x, y, strict=True)
            if column % 3 == 1 and row % 3 == 1 and name not in held
        )

    def photo_i(self) -> Frame:
        """PHOTO I of the procedure: the reseau in front of the evenly lit screen, nothing displayed."""
        return self.photograph(PHOTO_I)

    def photo_ii(self) -> Frame:
        """PHOTO II: the reseau in front of the section through the test object."""
        return self.photograph(PHOTO_II, self.show(self.rods, PHOTO_II))

    def photo_iii(self, body: Reflectors | None = None) -> Frame:
        """PHOTO III: the reseau in front of the section through a body, by default :meth:`body`."""
        return self.photograph(PHOTO_III, self.show(self.body() if body is None else body, PHOTO_III))

    def show(self, reflectors: Reflectors, name: str) -> Screen:
        """The screen while the scanner sweeps over reflectors; the same name gives the same noise."""
        screen = replace(self.screen)
        beam = self.scanner.m1, self.scanner.m2
        self.display.show(self._video(reflectors, name), screen, self.rng("phosphor", name), beam)
        return screen

    def photograph(self, name: str, screen: Screen | None = None) -> Frame:
        """Photograph a screen, by default the evenly lit one; the same name gives the same noise."""
        rng, camera = self.rng("exposure", name), self.camera_of(name)
        jitter = camera.sensor.row_shifts(rng) if camera.sensor.row_jitter_px else None
        behind = camera.view_at(-self.faults.parallax_mm)
        if screen is None:
            seen = self.screen.seen(behind, camera.shape)
        else:
            seen = screen.seen(behind, camera.shape, camera.psf_px)
        exposed = camera.sensor.expose(self.plate.over(seen, camera, jitter), rng)
        pixels = self.faults.transmit(exposed, camera.sensor.bits, rng)
        return Frame(pixels, camera.sensor.full_scale, name, sha256(pixels.tobytes()).hexdigest())

    def _standing(self, photo: str) -> Similarity:
        """From the system of the object to that of the transducer's path, with the rotation of the object."""
        angle = np.deg2rad(self.faults.object_turned_deg if photo == PHOTO_II else 0.0)
        middle = np.array([0.0, -self.scanner.depth_mm / 2])
        c, s = np.cos(angle), np.sin(angle)
        shift = middle - np.array([[c, -s], [s, c]]) @ middle
        return Similarity(np.array([*shift, c, s]))

    def _video(self, reflectors: Reflectors, photo: str) -> Video:
        """Video of reflectors in the tank, including faults."""
        silent = self.faults.silent(self.rods.names) if photo == PHOTO_II else frozenset()
        audible = reflectors.without(silent).moved(self._standing(photo))
        return self.scanner.sweep(audible, *self.display.raster(self.screen), self.rng("receiver", photo))

    def _truth_of(self, reflectors: Reflectors, photo: str) -> Truth:
        path = self.display.path(self._video(reflectors, photo), (self.scanner.m1, self.scanner.m2))
        section = Chain(self._standing(photo), self.scanner.section, ("standing.", "section."))
        shown = Chain(section, Inverted(path), ("", "display."))
        camera = self.camera_of(photo).view_at(-self.faults.parallax_mm)
        view = Chain(shown, camera, ("", "camera."))
        return Truth(reflectors.names, reflectors.xy, view(reflectors.xy), view)

    def _apply_faults(self) -> None:
        rng, ids = self.rng("faults"), self.design.ids
        gone = rng.choice(len(ids), self.faults.missing, replace=False)
        self.plate.missing = frozenset(ids[i] for i in gone)
        self.plate.false_marks = _between_marks(self.design.xy, self.faults.false_marks, rng)
        for sign in (1, -1, 1) if self.faults.scene else ():
            x, y = rng.uniform(-0.35, 0.35, 2) * (self.screen.width_mm, self.screen.height_mm)
            self.screen.draw_disk(x, y, rng.uniform(8, 22), sign * self.faults.scene)


def _between_marks(xy: Array, count: int, rng: np.random.Generator) -> Array:
    """Random positions that are not close to any mark."""
    gap = np.partition(np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)), 1, axis=1)[:, 1].min()
    found: list[Array] = []
    while len(found) < count:
        place = rng.uniform(xy.min(axis=0), xy.max(axis=0))
        if np.hypot(*(xy - place).T).min() > 0.35 * gap:
            found.append(place)
    return np.array(found).reshape(-1, 2)


def _non_metric(rng: np.random.Generator) -> FilmCamera:
    """An oscilloscope camera on Polaroid film: reproduction 0.57, nearly perpendicular, uncalibrated."""
    turn = angles_to_matrix(*np.deg2rad(rng.normal(0.0, [0.5, 0.5, 0.7])))
    # The camera is aimed at the middle of the screen, with a small error.
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
    return FilmCamera(pose, lens, deformation, scan, sensor)
