r"""An ultrasonic scanner: a transducer moves along the upper edge and draws the echoes below itself.

With the transducer at s, the echo of a reflector at (X, depth d) is drawn below the transducer at the range
:math:`r = \sqrt{d^2 + (s-X)^2}`, as long as the beam meets it: a point becomes a short arc that bends down at
its ends. Its middle, s = X and r = d, is the position of the reflector.

The beam is as wide as the transducer and diverges with depth (diffraction of a round piston, sin θ = 1.22
λ/D); across the beam, the echo decreases as a Gaussian. The displacement by the beam, (Δx)ε = m1·x + m2·y
(Wishahy, section B), is a correction at the displayed point; see
:class:`reseau_sims.display.Instrument`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.optics import RationalPolynomial

from .reflectors import Reflectors

_REACH = 4.5
"""Widths beyond which an echo is neglected."""
_MIXING = 4
"""Exponent by which overlapping echoes add: the stronger dominates, as with a logarithmic amplifier."""


@dataclass(frozen=True, eq=False)
class Video:
    """One picture, as input of a display.

    Parameters
    ----------
    x, y : ndarray (samples,), (lines,)
        Where on an ideal screen its samples and lines belong (mm, y up).
    signal : ndarray (lines, samples)
        Brightness: 0 is black, 1 the brightest that is meant.

    Examples
    --------
    >>> video = Video(np.linspace(-40.0, 40.0, 5), np.linspace(30.0, -30.0, 4), np.zeros((4, 5), np.float32))
    >>> video.signal.shape == (len(video.y), len(video.x))
    True
    """

    x: Array
    y: Array
    signal: NDArray[np.float32]


@dataclass(frozen=True)
class Scanner:
    """A transducer, its receiver, and the position of its section on the screen.

    Parameters
    ----------
    frequency_mhz, diameter_mm : float
        Frequency and diameter of the transducer.
    speed : float
        Speed of sound, mm/µs.
    cycles : float
        Length of the pulse in periods, as 2.35 standard deviations of its envelope.
    scale : (float, float)
        λ1 and λ2: millimetres on the screen for one in the object, along the edge and in depth.
    middle_mm, top_mm : float
        Position of the middle of the upper edge on the screen, x and y.
    half_sweep_mm, depth_mm : float
        Extent of the section to both sides of the middle, and in depth.
    m1, m2 : float
        The beam's displacement (Δx)ε = m1·x + m2·y, with x, y on the screen.
    brightness : float
        Signal of a rod at the focus.
    loss : float
        Uncompensated loss of echoes at the greatest depth, as a fraction.
    face : float
        Signal of the transducer's face, a line along the upper edge.
    noise : float
        Standard deviation of the receiver's noise at the greatest depth; half of it at the face.
    evenness : float
        0 for echoes that decrease like a Gaussian across the beam; towards 1 they become lines of even
        brightness.
    fading : float
        Change of an echo's signal over the width of the beam (one sigma), relative.
    tapering : float
        Loss of an echo's thickness at twice the width of the beam, as a fraction.

    Examples
    --------
    >>> scanner = Scanner()
    >>> round(scanner.wavelength_mm, 3), round(scanner.pulse_mm, 3)
    (0.684, 0.378)
    """

    frequency_mhz: float = 2.25
    diameter_mm: float = 13.0
    speed: float = 1.54
    cycles: float = 1.3
    scale: tuple[float, float] = (1.0, 1.0)
    middle_mm: float = 0.0
    top_mm: float = 55.0
    half_sweep_mm: float = 64.0
    depth_mm: float = 108.0
    m1: float = 0.0
    m2: float = 0.0
    brightness: float = 0.85
    loss: float = 0.25
    face: float = 0.5
    noise: float = 0.0015
    evenness: float = 0.0
    fading: float = 0.0
    tapering: float = 0.0

    def __post_init__(self) -> None:
        positive = ("frequency_mhz", "diameter_mm", "speed", "cycles", "half_sweep_mm", "depth_mm")
        if min(*self.scale, *(getattr(self, name) for name in positive)) <= 0:
            raise UsageError(f"all of {', '.join(positive)} and the scales are positive", where="scanner")
        if not (0 <= self.evenness < 1 and 0 <= self.tapering < 1):
            raise UsageError("evenness and tapering are at least 0 and less than 1", where="scanner")

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Scanner:
        """A random scanner: scales and beam differ by about one per cent between scanners."""
        lambda_1, lambda_2 = rng.normal([1.03, 0.98], 0.006)
        return cls(
            scale=(float(lambda_1), float(lambda_2)),
            middle_mm=float(rng.normal(0.0, 0.7)),
            top_mm=float(rng.normal(54.5, 0.4)),
            m1=float(rng.normal(4.0e-3, 1.5e-3)),
            m2=float(rng.normal(0.0, 3.0e-3)),
        )

    @property
    def wavelength_mm(self) -> float:
        """Wavelength of the ultrasound."""
        return self.speed / self.frequency_mhz

    @property
    def pulse_mm(self) -> float:
        """Width (one sigma) of an echo in depth; half the pulse, as the path is travelled twice."""
        return self.cycles * self.wavelength_mm / 2.355

    def beam_mm(self, depth: Array) -> Array:
        """Width (one sigma) of the echo of a point along the edge, by its depth."""
        divergence = np.arcsin(min(1.0, 1.22 * self.wavelength_mm / self.diameter_mm))
        width: Array = np.hypot(self.diameter_mm / 8, depth * np.tan(divergence) / 4)
        return width

    @property
    def section(self) -> RationalPolynomial:
        """From the system of the object (mm, y up from the upper edge) to an ideal screen (mm)."""
        lambda_1, lambda_2 = self.scale
        return RationalPolynomial.affine().with_values(
            [lambda_1, 0.0, self.middle_mm, 0.0, lambda_2, self.top_mm]
        )

    def sweep(self, reflectors: Reflectors, x: Array, y: Array, rng: np.random.Generator) -> Video:
        """The section as video.

        Parameters
        ----------
        reflectors : Reflectors
            Reflectors in the tank at their present positions.
        x, y : ndarray (samples,), (lines,)
            Raster of the display on an ideal screen (mm), x ascending and y descending.
        rng : Generator
            Source of the receiver's noise.
        """
        place, depth = (x - self.middle_mm) / self.scale[0], (self.top_mm - y) / self.scale[1]
        power = np.zeros((len(y), len(x)))
        widths, strength = self.beam_mm(-reflectors.xy[:, 1]), self._strength(reflectors)
        for (at, height), width, echo in zip(reflectors.xy, widths, strength, strict=True):
            self._add_echo(power, place, depth, at, -height, width, echo)
        signal = power ** (1 / _MIXING)
        signal += self.face * np.exp(-0.5 * ((depth - 0.8) / 0.45) ** 2)[:, None]
        # Nothing is drawn outside the sweep, or beyond the maximum depth.
        swept = 0.5 - 0.5 * np.tanh((np.abs(place) - self.half_sweep_mm) / 0.5)
        lit = 0.5 + 0.5 * np.tanh(np.minimum(depth + 0.5, self.depth_mm - depth) / 0.3)
        noise = scipy.ndimage.gaussian_filter1d(rng.standard_normal(power.shape), 2.0, axis=1)
        noise *= self.noise * np.sqrt(2 * np.sqrt(np.pi) * 2.0) * (0.5 + 0.5 * depth / self.depth_mm)[:, None]
        signal = (signal + noise) * lit[:, None] * swept[None, :]
        return Video(x, y, signal.astype(np.float32))

    def _strength(self, reflectors: Reflectors) -> Array:
        depth = -reflectors.xy[:, 1]
        strength: Array = (
            self.brightness * reflectors.strength * (1 - self.loss * (depth / self.depth_mm) ** 2)
        )
        return strength

    def _add_echo(
        self, power: Array, place: Array, depth: Array, at: float, range_: float, width: float, echo: float
    ) -> None:
        """Add the arc of one reflector, within its window."""
        reach = _REACH * width
        columns = np.flatnonzero(np.abs(place - at) < reach)
        lowest = np.hypot(range_, reach) + _REACH * self.pulse_mm
        rows = np.flatnonzero((depth > range_ - _REACH * self.pulse_mm) & (depth < lowest))
        if not len(columns) or not len(rows):
            return
        offset = place[columns] - at
        late = depth[rows, None] - np.hypot(range_, offset)[None, :]
        across = np.abs(offset / width)
        fall = across ** (2 / (1 - self.evenness))
        thickness = self.pulse_mm * (1 - self.tapering * np.minimum(across / 2, 1) ** 2)
        height = np.maximum(1 + self.fading * offset / width, 0)
        arc = echo * height * np.exp(-0.5 * fall - 0.5 * (late / thickness) ** 2)
        power[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += arc**_MIXING
