"""Frames formed with known truth, and the Cramér–Rao bound of the marks in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from reseau.core.data import Array, Frame, Mask
from reseau.designs import regular_reseau
from reseau.io import Mark, ReseauDesign
from reseau.measure import measure_reseau
from reseau.measure.reseau.marks import ReseauOptions
from reseau.measure.reseau.measure import ReseauResult
from reseau.optics import Sensor, illumination
from reseau.optics.formation import Outline, PixelResponse, coverage_derivatives, draw, mark_outline
from reseau_sims.wires import line_grid

__all__ = ["MARKS", "Formed", "Scene", "Statistics", "bounds", "form", "measure_many", "measured"]

PX_PER_MM = 10.0
PITCH_MM = 5.2
MARKS = {
    "cross": Mark(shape="cross", size=1.3, line_width=0.24),
    "disk": Mark(shape="disk", size=0.8),
    "square": Mark(shape="square", size=0.5),
    "rod": Mark(shape="rod", size=0.6),
    "line-grid": Mark(shape="line-grid", line_width=0.3),
}
"""A mark of every shape; 10 px/mm."""


@dataclass(frozen=True, eq=False)
class Scene:
    """How frames are formed; by default 210 dark disks in 800×800 pixels, with read noise only.

    Parameters
    ----------
    level, contrast : float
        Grey value of the background; share of it that a dark mark takes, of 255 that a bright one adds.
    psf_px, fill : float
        Width of the point-spread function, light-sensitive part of the pitch.
    sigma : float
        Read noise, grey values.
    gain : float, optional
        Electrons per grey value; shot noise only where given.
    jitter_px : float
        Standard deviation of the shift of a row.
    gradient : (float, float)
        Relative change of the light from the centre to the edge.
    quantise : bool
        Whether to 8 bits.
    bend : float
        Radial distortion at the corner of the frame, pixels.
    """

    mark: Mark = MARKS["disk"]
    columns: int = 15
    rows: int = 14
    width: int = 800
    height: int = 800
    polarity: Any = "dark"
    level: float = 170.0
    contrast: float = 0.7
    psf_px: float = 0.8
    fill: float = 1.0
    sigma: float = 2.55
    gain: float | None = None
    jitter_px: float = 0.0
    gradient: tuple[float, float] = (0.0, 0.0)
    quantise: bool = False
    bend: float = 2.0
    missing: frozenset[int] = frozenset()
    light: Array | None = None

    def design(self) -> ReseauDesign:
        return regular_reseau(self.columns, self.rows, PITCH_MM, self.mark, polarity=self.polarity)

    def options(self, **changes: Any) -> ReseauOptions:
        """Camera parameters that are known to the measurement."""
        return ReseauOptions(row_jitter_px=self.jitter_px, fill=self.fill, **changes)

    def background(self) -> Array:
        light = self.level if self.polarity == "dark" else 0.25 * self.level
        field_ = illumination(self.width, self.height, gradient=self.gradient)
        return light * field_ if self.light is None else light * field_ * self.light

    def added(self) -> float:
        """Grey values that a bright mark adds."""
        return 255.0 * self.contrast * 0.8

    def sensor(self) -> Sensor:
        return Sensor(
            self.width,
            self.height,
            gain=self.gain or 1.0,
            shot_noise=self.gain is not None,
            read_noise=self.sigma,
            quantise=self.quantise,
        )


@dataclass(frozen=True, eq=False)
class Formed:
    """A frame with its truth: where the marks are (n, 2), and the local frames (n, 2, 2) there."""

    frame: Frame
    design: ReseauDesign
    xy: Array
    jacobian: Array
    light: Array


def view(scene: Scene, shift: Array, turn: float = 0.021) -> Any:
    """From the design (mm, y up) to the frame: turned, mirrored, with a little radial distortion."""
    centre = np.array([scene.width - 1, scene.height - 1]) / 2 + shift
    c, s = np.cos(turn), np.sin(turn)
    matrix = PX_PER_MM * np.array([[c, s], [s, -c]])
    k = scene.bend / np.hypot(scene.width / 2, scene.height / 2) ** 3

    def mapping(xy: Array) -> tuple[Array, Array]:
        q = xy @ matrix.T
        r2 = (q**2).sum(axis=1)
        slope = (1 + k * r2)[:, None, None] * np.eye(2) + 2 * k * q[:, :, None] * q[:, None, :]
        return centre + q * (1 + k * r2)[:, None], slope @ matrix

    return mapping


def _outlines(scene: Scene, design: ReseauDesign, spacing: float, there: Mask) -> list[Outline]:
    mark, xy = design.mark, design.xy
    if mark.shape != "line-grid":
        outline = mark_outline(mark.shape, mark.size or 0.0, mark.line_width, spacing)
        return [outline.affine(np.tile(np.eye(2), (int(there.sum()), 1, 1)), xy[there])]
    x, column = np.unique(xy[:, 0], return_inverse=True)
    y, row = np.unique(xy[:, 1], return_inverse=True)
    broken = np.zeros((len(y), len(x)), dtype=bool)
    broken[row, column] = ~there
    return list(line_grid(x, y, mark.line_width or 0.0, spacing, beyond=2.0, broken=broken))


def form(scene: Scene, rng: np.random.Generator) -> Formed:
    """One frame, laid under the pixels at random."""
    design = scene.design()
    mapping = view(scene, rng.uniform(-3, 3, 2), rng.uniform(-0.03, 0.03))
    xy, jacobian = mapping(design.xy)
    there = ~np.isin(np.arange(len(xy)), list(scene.missing))
    shifts = rng.normal(0, scene.jitter_px, scene.height) if scene.jitter_px else None
    share = np.zeros((scene.height, scene.width))
    for outline in _outlines(scene, design, 0.6 * scene.psf_px / PX_PER_MM, there):
        image = outline.mapped(mapping).oriented()
        share += draw(image, share.shape, scene.psf_px, PixelResponse(scene.fill), shifts)
    background = scene.background()
    if scene.polarity == "dark":
        light = background * (1 - scene.contrast * share)
    else:
        light = background + scene.added() * share
    pixels = scene.sensor().expose(light, rng)
    guess = xy + rng.uniform(-4, 4, 2) + rng.normal(0, 0.8, xy.shape)
    points = tuple(
        point.model_copy(update={"nominal_px": (float(x), float(y))})
        for point, (x, y) in zip(design.points, guess, strict=True)
    )
    return Formed(
        Frame(pixels, 255.0), design.model_copy(update={"points": points}), xy, jacobian, background
    )


def bounds(scene: Scene, formed: Formed) -> Array:
    """Cramér–Rao bounds of the positions, covariances (n, 2, 2).

    The Fisher information of position, width of the point-spread function, contrast, level and slopes of the
    background, and size, all unknown, in the window that the measurement uses, under the covariance of all
    noise that was simulated: of reading and of the photons, the rounding, and the row jitter, which is common
    to the pixels of a row.
    """
    mark = formed.design.mark
    width_px = PX_PER_MM * (mark.line_width or 0.0)
    extent = 3 * width_px if mark.shape == "line-grid" else PX_PER_MM * (mark.size or 0.0)
    half = int(np.ceil(extent / 2 + 4))
    size = mark.line_width if mark.shape == "line-grid" else mark.size
    spacing = 0.4 * scene.psf_px / PX_PER_MM
    reach = (1.5 * half + 8 * scene.psf_px) / PX_PER_MM
    outline = mark_outline(mark.shape, size or 0.0, mark.line_width, spacing, reach)
    outline = outline.affine(formed.jacobian)
    outline = Outline(outline.xy, outline.dxy * np.sign(np.linalg.det(formed.jacobian))[:, None, None])
    centre = np.rint(formed.xy)
    offset = np.arange(-half, half + 1.0)
    at = Outline(outline.xy + formed.xy[:, None, :], outline.dxy)
    share, slopes = coverage_derivatives(
        at,
        centre[:, :1] + offset,
        centre[:, 1:] + offset,
        scene.psf_px,
        PixelResponse(scene.fill),
        outline.xy[:, None],
    )
    column, row = (np.clip(centre[:, k].astype(int), 0, formed.light.shape[1 - k] - 1) for k in (0, 1))
    level = formed.light[row, column][:, None, None]
    u, v = np.meshgrid(offset / half, offset / half)
    planes = np.stack([np.ones_like(u), u, v])
    if scene.polarity == "dark":
        grey = level * (1 - scene.contrast * share)
        by_share, by_contrast = np.broadcast_to(-level * scene.contrast, share.shape), -level * share
        by_plane = (1 - scene.contrast * share)[:, None] * planes
    else:
        grey = level + scene.added() * share
        by_share, by_contrast = np.full(share.shape, scene.added()), share
        by_plane = np.broadcast_to(planes, (len(share), *planes.shape))
    jacobian = np.concatenate([by_share[:, None] * slopes, by_contrast[:, None], by_plane], axis=1)
    variance = np.full(grey.shape, scene.sigma**2 + (1 / 12 if scene.quantise else 0.0))
    if scene.gain:
        variance += grey / scene.gain
    weighted = jacobian / variance[:, None]
    normal = np.einsum("kurc,kvrc->kuv", weighted, jacobian)
    if scene.jitter_px:
        # (D + s² g gᵀ)⁻¹ = D⁻¹ − D⁻¹g gᵀD⁻¹ s²/(1 + s² gᵀD⁻¹g), row by row.
        slope = jacobian[:, 0]
        along = np.einsum("kurc,krc->kur", weighted, slope)
        gain = scene.jitter_px**2 / (1 + scene.jitter_px**2 * (slope**2 / variance).sum(axis=2))
        normal -= np.einsum("kur,kr,kvr->kuv", along, gain, along)
    return np.linalg.inv(normal)[:, :2, :2]


@dataclass(frozen=True, eq=False)
class Statistics:
    """Errors (m, 2) of measured marks, their predicted covariances and bounds, phases; what was expected.

    `cluster` (m,) tells which frame and row of marks each is of: these share what jitter does.
    """

    error: Array
    cov: Array
    bound: Array
    phase: Array
    cluster: Array
    expected: int

    @classmethod
    def together(cls, parts: list[Statistics]) -> Statistics:
        """All of several."""
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("error", "cov", "bound", "phase")
        }
        last = np.cumsum([0] + [part.cluster.max() + 1 for part in parts])
        cluster = np.concatenate([part.cluster + first for part, first in zip(parts, last, strict=False)])
        return cls(**columns, cluster=cluster, expected=sum(part.expected for part in parts))

    @property
    def rms(self) -> Array:
        return np.sqrt((self.error**2).mean(axis=0))

    @property
    def ratio(self) -> Array:
        """Rms over the bound, per axis."""
        bound = np.diagonal(self.bound, axis1=1, axis2=2).mean(axis=0)
        return self.rms / np.sqrt(bound)

    @property
    def bias(self) -> Array:
        return self.error.mean(axis=0)

    @property
    def bias_sigma(self) -> Array:
        """Standard error of the bias, from the sums of independent clusters."""
        which = np.unique(self.cluster, return_inverse=True)[1]
        sums = np.stack([np.bincount(which, (self.error - self.bias)[:, k]) for k in (0, 1)])
        return np.sqrt((sums**2).sum(axis=1)) / len(self.error)

    @property
    def normalised(self) -> Array:
        """Rms of the errors over their predicted standard deviations, per axis."""
        return np.sqrt((self.error**2 / np.diagonal(self.cov, axis1=1, axis2=2)).mean(axis=0))

    def bias_by_phase(self, bins: int = 8) -> tuple[float, float]:
        """Largest mean error among bins of the position under the pixel, and its standard error."""
        worst, sigma = 0.0, 0.0
        for axis in range(2):
            which = np.floor(bins * self.phase[:, axis]).astype(int) % bins
            for k in range(bins):
                e = self.error[which == k, axis]
                if len(e) > 20 and abs(e.mean()) > worst:
                    worst, sigma = abs(float(e.mean())), float(e.std() / np.sqrt(len(e)))
        return worst, sigma


def measured(scene: Scene, formed: Formed, **changes: Any) -> ReseauResult:
    result = measure_reseau(formed.frame, formed.design, scene.options(**changes))
    assert result, result.reason
    return result


def measure_many(scene: Scene, frames: int, seed: int = 0) -> Statistics:
    """Errors of all marks of many frames."""
    rng = np.random.default_rng(seed)
    columns: list[list[Array]] = [[], [], [], [], []]
    expected = 0
    for number in range(frames):
        formed = form(scene, rng)
        result = measured(scene, formed)
        ok = result.ok
        expected += len(ok) - len(scene.missing)
        found = (
            result.xy - formed.xy,
            result.cov,
            bounds(scene, formed),
            formed.xy - np.floor(formed.xy),
            number * scene.rows + np.arange(len(ok)) // scene.columns,
        )
        for column, values in zip(columns, found, strict=True):
            column.append(values[ok])
    return Statistics(*(np.concatenate(column) for column in columns), expected)
