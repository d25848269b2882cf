"""Conversion of a camera to another model: best fitting parameters, their covariance, and the differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.data import Array, Mask
from ...core.display import Display
from ...core.errors import UsageError
from ..mapping import PlaneMapping
from .grid import PixelGrid
from .registry import camera_model

# Points along the longer side of the image to which the camera is fitted, and at which it is compared: it may
# be worst between the former.
_POINTS, _COMPARED = 41, 161
# The same for approximate values.
_FEW = 15
# Greatest number of steps, and damping of the first one (columns have unit length).
_ITERATIONS, _DAMPING = 200, 1e-3
# Pixels that a parameter as large as its standard deviation by the prior counts.
_WEAK = 1e-4


@dataclass(frozen=True, eq=False, repr=False)
class Converted(Display):
    """A camera in another model, and where it differs from the original.

    Parameters
    ----------
    mapping : PlaneMapping
        From ideal directions to pixels.
    xy : ndarray (n, 2)
        Places over the image that were compared, pixels: those where the original has directions.
    difference : ndarray (n, 2)
        Image of the same direction by the new camera minus that by the original, px.
    share : float
        Share of the image where the original has directions; the rest was not compared.
    free : tuple of str
        Parameters that were estimated.
    by_original : ndarray (free, u)
        Derivatives of these by the parameters of the original.
    original : tuple of str (u,)
        Parameters of the original.

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> camera = Brown(grid=grid).with_values({"c": 8.0, "K1": 1e-3, "K2": -1e-5})
    >>> found = convert(camera, grid, "opencv", free=("fx", "fy", "cx", "cy", "k1"))
    >>> found
    <Converted: OpenCV, difference 0.028 px rms, 0.18 px at most, compared over 100 % of the image>
    >>> found.covariance(["c", "K1"], [[1e-6, 0.0], [0.0, 1e-10]]).shape
    (5, 5)
    """

    mapping: PlaneMapping
    xy: Array
    difference: Array
    share: float
    free: tuple[str, ...]
    by_original: Array
    original: tuple[str, ...]

    def _facts(self) -> list[tuple[str, str]]:
        return [
            (type(self.mapping).__name__, ""),
            ("difference", f"{self.rms_px:.2g} px rms"),
            (f"{self.greatest_px:.2g} px at most", ""),
            ("compared", f"over {self.share:.0%} of the image".replace("%", " %")),
        ]

    @property
    def rms_px(self) -> float:
        """Root mean square of the differences."""
        return float(np.sqrt((self.difference**2).sum(axis=1).mean()))

    @property
    def greatest_px(self) -> float:
        """The largest difference."""
        return float(np.hypot(*self.difference.T).max())

    def covariance(self, names: Sequence[str], covariance: ArrayLike) -> Array:
        """Covariance of the parameters that were estimated, from that of parameters of the original.

        It has the rank of the original at most: a model with more parameters knows no more. The difference of
        the models is not in it.

        Parameters
        ----------
        names : sequence of str (k,)
            Parameters of the original; the others are without error.
        covariance : array_like (k, k)
            Their covariance.

        Returns
        -------
        ndarray (free, free)
            In the order of `free`.

        Raises
        ------
        UsageError
            When a name is not a parameter of the original.
        """
        unknown = [name for name in names if name not in self.original]
        if unknown:
            raise UsageError(f"is not one of {', '.join(self.original)}", where=unknown[0])
        by = self.by_original[:, [self.original.index(name) for name in names]]
        return by @ np.asarray(covariance, dtype=np.float64) @ by.T


def convert(
    camera: PlaneMapping,
    grid: PixelGrid,
    model: str,
    options: Mapping[str, Any] | None = None,
    *,
    free: tuple[str, ...] = (),
) -> Converted:
    """Convert a camera to another registered model, by least squares over the image.

    The new camera is one-to-one over the image: parameters with which it has a pole or folds there are not
    taken, however well they fit at the points.

    Parameters
    ----------
    camera : PlaneMapping
        From ideal directions to pixels.
    grid : PixelGrid
        Pixels of the image.
    model : str
        Name of the model wanted.
    options : mapping, optional
        Options of that model.
    free : tuple of str
        Parameters to be estimated, the others are zero; all by default.

    Returns
    -------
    Converted
        The camera, and its differences from the original.

    Raises
    ------
    UsageError
        When the model or a parameter is unknown, the rays of one of the models are parallel and those of the
        other are not, or the original has no directions over most of the image.

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> camera = Brown(grid=grid).with_values({"c": 8.0, "K1": 1e-3})
    >>> found = convert(camera, grid, "opencv", free=("fx", "fy", "cx", "cy", "k1"))
    >>> found.greatest_px < 1e-6, round(found.mapping.value_of("k1"), 6)
    (True, 0.064)
    """
    found, uv, at = _closest(camera, grid, model, options, free, _POINTS)
    wanted = camera_model(model)
    names = tuple(name for name, chosen in zip(wanted.names, at, strict=True) if chosen)
    by_original = _by_original(camera, found, uv, at)
    pixels = _over(grid, _COMPARED)
    directions = camera.inverse(pixels)
    seen: Mask = np.asarray(np.isfinite(directions).all(axis=1))
    difference = found(directions[seen]) - pixels[seen]
    return Converted(
        found, pixels[seen], difference, float(seen.mean()), names, by_original, tuple(camera.names)
    )


def roughly(
    camera: PlaneMapping,
    grid: PixelGrid,
    model: str,
    options: Mapping[str, Any] | None = None,
    *,
    free: tuple[str, ...] = (),
) -> PlaneMapping:
    """Return approximate values in another model: :func:`convert` at few points, without its statistics.

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> camera = Brown(grid=grid).with_values({"c": 8.0, "K1": 1e-3})
    >>> round(roughly(camera, grid, "opencv", free=("fx", "fy", "cx", "cy", "k1")).value_of("k1"), 6)
    0.064
    """
    return _closest(camera, grid, model, options, free, _FEW)[0]


def _closest(
    camera: PlaneMapping, grid: PixelGrid, model: str, options: Mapping[str, Any] | None,
    free: tuple[str, ...], across: int,
) -> tuple[PlaneMapping, Array, Mask]:  # fmt: skip
    """The closest camera of a model at so many places across, directions, and what is free."""
    wanted = camera_model(model)
    unknown = [name for name in free if name not in wanted.names]
    if unknown:
        raise UsageError(f"is not one of {', '.join(wanted.names)}", where=unknown[0])
    if camera.parallel != wanted.parallel:
        rays = "parallel" if camera.parallel else "central"
        raise UsageError(f"has {rays} rays, the model `{model}` has not", where="camera to be converted")
    pixels = _over(grid, across)
    directions = camera.inverse(pixels)
    known: Mask = np.asarray(np.isfinite(directions).all(axis=1))
    if 2 * known.sum() <= len(known):
        raise UsageError("has no directions over most of the image", where="camera to be converted")
    uv, target = directions[known], pixels[known]
    # Focal length along the rows, in the middle of the image.
    centre = camera.inverse(grid.centre[None])
    f = float(camera.derivatives(centre if np.isfinite(centre).all() else uv[:1]).d_xy[0, 0, 0])
    at = np.array([not free or name in free for name in wanted.names], dtype=bool)
    priors = wanted.priors(wanted.names)
    start = wanted.mapping(wanted.start_values(f, grid), grid, options)
    weights = np.array([_WEAK / priors.get(name, np.inf) for name in wanted.names])
    return _fitted(start, uv, target, at, weights), uv, at


def _over(grid: PixelGrid, across: int) -> Array:
    """Pixels (n, 2) over the image, from edge to edge, so many along its longer side."""
    step = max(grid.width, grid.height) / across
    columns = np.linspace(0, grid.width - 1, max(2, round(grid.width / step)))
    rows = np.linspace(0, grid.height - 1, max(2, round(grid.height / step)))
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def _by_original(camera: PlaneMapping, found: PlaneMapping, uv: Array, at: Mask) -> Array:
    """Derivatives of the estimates by the parameters of the original, to first order.

    A change dp of the original moves the directions of fixed pixels by −D⁻¹J·dp, and their images by the new
    camera by −D' D⁻¹J·dp; its parameters follow by least squares, J'·dp' = D' D⁻¹J·dp.
    """
    before, after = camera.derivatives(uv), found.derivatives(uv)
    carried = after.d_xy @ np.linalg.solve(before.d_xy, before.d_parameters)
    design = after.d_parameters[:, :, at].reshape(2 * len(uv), -1)
    size = np.linalg.norm(design, axis=0)
    size[size == 0] = 1.0
    by = np.linalg.lstsq(design / size, carried.reshape(2 * len(uv), -1), rcond=1e-13)[0]
    scaled: Array = by / size[:, None]
    return scaled


def _fitted(mapping: PlaneMapping, uv: Array, target: Array, at: Array, weights: Array) -> PlaneMapping:
    """Levenberg–Marquardt in columns of unit length; undetermined corrections have least norm.

    Parameters with a prior are observed as zero, with these weights (px per unit): too little to be seen
    where there are points, enough to determine what has hardly any.
    """
    weak = weights[at] > 0
    cost, damping, slow = _cost(mapping, uv, target, weights), _DAMPING, 0
    for _ in range(_ITERATIONS):
        seen = mapping.derivatives(uv)
        design = seen.d_parameters[:, :, at].reshape(2 * len(uv), -1)
        design = np.vstack([design, np.diag(weights[at])[weak]])
        misfit = np.append((target - seen.value).ravel(), -(weights * mapping.values)[at][weak])
        size = np.linalg.norm(design, axis=0)
        size[size == 0] = 1.0
        left, values, right = np.linalg.svd(design / size, full_matrices=False)
        along = np.where(values > 1e-13 * values[0], left.T @ misfit, 0.0)
        before = cost
        while True:
            full = np.zeros(len(at))
            full[at] = right.T @ (along * values / (values**2 + damping)) / size
            trial = mapping.with_values(mapping.values + full)
            after = _cost(trial, uv, target, weights)
            # A pole or fold between the points costs nothing at them, but ruins the image there.
            if after < cost and trial.one_to_one(uv).all():
                mapping, cost, damping = trial, after, max(damping / 10, 1e-24)
                break
            damping *= 10
            if damping > 1e6:
                return mapping
        # A surface that hardly any point determines at its rim creeps on there for long.
        slow = slow + 1 if before - cost < (1e-2 if weak.any() else 1e-9) * before else 0
        if slow == 3:
            break
    return mapping


def _cost(mapping: PlaneMapping, uv: Array, target: Array, weights: Array) -> float:
    with np.errstate(all="ignore"):
        cost = float(((mapping(uv) - target) ** 2).sum() + ((weights * mapping.values) ** 2).sum())
    return cost if np.isfinite(cost) else np.inf
