"""A cathode-ray tube: draws video line by line, with geometric distortion and a spot of finite size."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.optics import RationalPolynomial
from reseau.optics.composition import Chain
from reseau.optics.displays import wong_display
from reseau.optics.mapping import Derivatives, PlaneMapping, as_points, as_values
from reseau.optics.resampling import on_lattice

from .scanner import Video
from .screen import Screen

_SPARE_MM = 6.0
"""Margin of the raster beyond the phosphor; distortion displaces parts of it into the visible area."""
_CHARGE_STEP = 10
"""Samples of the picture per node of the charge map."""


@dataclass(frozen=True, eq=False)
class Instrument(PlaneMapping):
    """Correction of a display and the beam of a scanner: from displayed to true positions.

    The sum of Wishahy's eq. (6): X = x + (Δx)s + (Δx)d + (Δx)o + m1·x + m2·y, all at the displayed point.

    Parameters
    ----------
    display : PlaneMapping
        Correction of the tube alone.
    m1, m2 : float
        Coefficients of the beam.

    Raises
    ------
    UsageError
        When the display has parameters `m1` or `m2` of its own.

    Examples
    --------
    >>> instrument = Instrument(RationalPolynomial.affine(), m1=0.01)
    >>> instrument(np.array([[10.0, 0.0]]))
    array([[10.1,  0. ]])
    """

    display: PlaneMapping
    m1: float = 0.0
    m2: float = 0.0

    def __post_init__(self) -> None:
        if {"m1", "m2"} & set(self.display.names):
            raise UsageError(
                "has m1 and m2, which belong to the scanner; remove them", where="model of a display"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the display, m1 and m2."""
        return (*self.display.names, "m1", "m2")

    @property
    def values(self) -> Array:
        """Values of the parameters."""
        return np.append(self.display.values, [self.m1, self.m2])

    def _replaced(self, values: Array) -> Self:
        display = self.display.with_values(values[:-2])
        return replace(self, display=display, m1=float(values[-2]), m2=float(values[-1]))

    def _value(self, xy: Array) -> Array:
        value = self.display(xy)
        value[:, 0] += xy @ (self.m1, self.m2)
        return value

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        value, d_xy, d_display = self.display.derivatives(points)
        value, d_xy, d_beam = value.copy(), d_xy.copy(), np.zeros((len(points), 2, 2))
        value[:, 0] += points @ (self.m1, self.m2)
        d_xy[:, 0] += (self.m1, self.m2)
        d_beam[:, 0] = points
        return Derivatives(value, d_xy, np.concatenate([d_display, d_beam], axis=2))


@dataclass(frozen=True, eq=False)
class Bending(PlaneMapping):
    """Displacement of the electron beam near bright areas: from displayed to intended positions.

    The charge of a bright area on the phosphor repels the beam, by an amount proportional to the gradient of
    the charge.

    Parameters
    ----------
    x, y : ndarray (c,), (r,)
        Nodes, ascending (mm).
    shift : ndarray (r, c, 2)
        Correction of a displayed point (mm).

    Examples
    --------
    >>> nodes = np.arange(4.0)
    >>> Bending(nodes, nodes, np.full((4, 4, 2), 0.1))(np.array([[1.5, 1.5]]))
    array([[1.6, 1.6]])
    """

    names: ClassVar[tuple[str, ...]] = ()
    x: Array
    y: Array
    shift: Array
    values: Array = field(default_factory=lambda: np.zeros(0))
    _splines: tuple[Any, Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", as_values(self.names, self.values))
        splines = tuple(
            scipy.interpolate.RectBivariateSpline(self.y, self.x, self.shift[..., k]) for k in range(2)
        )
        object.__setattr__(self, "_splines", splines)

    def _value(self, xy: Array) -> Array:
        shift: Array = np.stack([s.ev(xy[:, 1], xy[:, 0]) for s in self._splines], axis=-1)
        return xy + shift

    def derivatives(self, xy: ArrayLike) -> Derivatives:
        """See :meth:`PlaneMapping.derivatives`."""
        points = as_points(xy)
        x, y = points.T
        slope = [[s.ev(y, x, dy=1), s.ev(y, x, dx=1)] for s in self._splines]
        d_xy = np.eye(2) + np.moveaxis(np.array(slope), -1, 0)
        return Derivatives(self._value(points), d_xy, np.zeros((len(points), 2, 0)))


@dataclass(frozen=True)
class Display:
    """A cathode-ray tube.

    Parameters
    ----------
    correction : PlaneMapping
        From displayed to true positions in the plane of the screen (mm). Drawing applies its inverse.
    line_mm, sample_mm : float
        Distance of the lines of the raster and of the samples on a line.
    spot_mm : float
        Width (one sigma) of the spot across the lines.
    saturation : float
        Largest grey value of the phosphor; by default it does not saturate.
    glow : float
        Grey value of black: the raster is never completely dark, so that the reseau is visible.
    contrast : float
        Grey values added by a signal of 1.
    grain : float
        Relative standard deviation of the phosphor's light, from sample to sample.
    gradient, falloff : (float, float), float
        Unevenness of its light; see :meth:`reseau_sims.screen.Screen.illuminate`.
    bending_mm : float
        Displacement of the beam at the edge of a large area of full brightness.
    bending_reach_mm : float
        Width (one sigma) over which the charge of a bright area acts.
    bright : tuple of (float, float, float)
        Bright disks that the instrument shows: x, y on an ideal screen and radius (mm).

    Examples
    --------
    >>> display = Display.drawn(np.random.default_rng(1))
    >>> x, y = display.raster(Screen())
    >>> x.shape, y.shape
    ((1701,), (337,))
    """

    correction: PlaneMapping
    line_mm: float = 0.4
    sample_mm: float = 0.1
    spot_mm: float = 0.18
    saturation: float = np.inf
    glow: float = 45.0
    contrast: float = 180.0
    grain: float = 0.005
    gradient: tuple[float, float] = (0.03, -0.02)
    falloff: float = 0.05
    bending_mm: float = 0.0
    bending_reach_mm: float = 5.0
    bright: tuple[tuple[float, float, float], ...] = ()

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Display:
        """A random tube of Wong's model, with distortions of one to two millimetres at the corners."""
        values = {
            "k0": rng.normal(0.0, 4.0e-3),
            "k1": rng.normal(3.0e-6, 6.0e-7),
            "h'1": rng.normal(0.0, 3.0e-5),
            "h'2": rng.normal(0.0, 3.0e-9),
            "h'3": rng.normal(0.0, 3.0e-5),
            "h'4": rng.normal(0.0, 3.0e-9),
            "P0": rng.normal(0.0, 0.6),
            "P1": rng.normal(0.0, 3.0e-5),
            "P2": rng.normal(0.0, 3.0e-5),
            "P3": rng.normal(0.0, 4.0e-3),
            "P4": rng.normal(0.0, 0.6),
        }
        return cls(wong_display().without("k2", "k3", "m1", "m2").with_values(values))

    @classmethod
    def polynomial(cls, rng: np.random.Generator) -> Display:
        """A random tube that Wishahy's eq. (7a, b) corrects exactly."""
        mean = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 3.0e-6, 0.0]
        sigma = [0.6, 4.0e-3, 4.0e-3, 4.0e-5, 4.0e-5, 4.0e-5, 6.0e-7, 3.0e-9]
        return cls(RationalPolynomial.ultrasonic().with_values(rng.normal([*mean, *mean], [*sigma, *sigma])))

    def raster(self, screen: Screen) -> tuple[Array, Array]:
        """Coordinates x (samples,) and y (lines,) of the video raster on an ideal screen (mm)."""
        half = np.array([screen.width_mm, screen.height_mm]) / 2 + _SPARE_MM
        samples, lines = np.ceil(half / (self.sample_mm, self.line_mm)).astype(int)
        x = np.arange(-samples, samples + 1) * self.sample_mm
        y = -np.arange(-lines, lines + 1) * self.line_mm
        return x, y

    def path(self, video: Video, beam: tuple[float, float] = (0.0, 0.0)) -> PlaneMapping:
        """Mapping from displayed to true positions of a video, with all effects.

        Parameters
        ----------
        video : Video
            Its bright areas bend the beam.
        beam : (float, float)
            m1 and m2 of the scanner.
        """
        instrument = Instrument(self.correction, *beam)
        return instrument if not self.bending_mm else Chain(self._bending(video), instrument)

    def show(
        self, video: Video, screen: Screen, rng: np.random.Generator, beam: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Draw a video on a screen; replaces its present light.

        Parameters
        ----------
        video : Video
            Video on the raster of this display.
        screen : Screen
            Screen to draw on.
        rng : Generator
            Source of the phosphor's grain.
        beam : (float, float)
            m1 and m2 of the scanner.
        """
        picture = self._picture(video)
        path, (x, y) = self.path(video, beam), screen.raster()
        step = screen.pitch_mm

        def aimed(at: Array) -> Array:
            """Picture coordinates of the samples (column, row) of the screen."""
            belongs = path(np.stack([x[0] + step * at[:, 0], y[0] - step * at[:, 1]], axis=-1))
            return np.stack([belongs[:, 0] - video.x[0], video.y[0] - belongs[:, 1]], -1) / self.sample_mm

        columns, rows = on_lattice(aimed, np.arange(float(len(x))), np.arange(float(len(y))))
        # Cubic: with linear interpolation the middle of an echo would depend on how it lies between samples.
        light = scipy.ndimage.map_coordinates(
            picture, [rows, columns], output=np.float32, order=3, mode="nearest"
        )
        screen.illuminate(
            np.maximum(light, 0), rng, gradient=self.gradient, falloff=self.falloff, grain=self.grain
        )

    def _picture(self, video: Video) -> NDArray[np.float32]:
        """Light of the undistorted picture, as finely sampled across the lines as along them."""
        signal = self._with_disks(video)
        rows = round((video.y[0] - video.y[-1]) / self.sample_mm) + 1
        fine = video.y[0] - np.arange(rows) * self.sample_mm
        z = (fine[:, None] - video.y[None, :]) / self.spot_mm
        spot = np.exp(-0.5 * z * z) * (self.line_mm / (self.spot_mm * np.sqrt(2 * np.pi)))
        picture: NDArray[np.float32] = spot.astype(np.float32) @ (self.glow + self.contrast * signal)
        return np.clip(picture, 0, self.saturation, out=picture)

    def _with_disks(self, video: Video) -> NDArray[np.float32]:
        signal = video.signal
        for x, y, radius in self.bright:
            distance = np.hypot(video.x[None, :] - x, video.y[:, None] - y)
            disk = 0.5 - 0.5 * np.tanh((distance - radius) / 0.4)
            signal = np.maximum(signal, disk.astype(np.float32))
        return signal

    def _bending(self, video: Video) -> Bending:
        signal, reach = self._with_disks(video), self.bending_reach_mm
        steps = np.array([self.line_mm, self.sample_mm])
        # One node per millimetre is enough: the charge is blurred over several millimetres.
        every = np.maximum(1, np.rint(_CHARGE_STEP * self.sample_mm / steps)).astype(int)
        charge = scipy.ndimage.gaussian_filter(signal, reach / steps)[:: every[0], :: every[1]][::-1].astype(
            np.float64
        )
        x, y = video.x[:: every[1]], video.y[:: every[0]][::-1]
        up, right = np.gradient(charge, y, x)
        # At the straight edge of a large area the gradient of the charge is 1/(reach·√(2π)).
        amount = self.bending_mm * reach * np.sqrt(2 * np.pi)
        return Bending(x, y, amount * np.stack([right, up], axis=-1))
