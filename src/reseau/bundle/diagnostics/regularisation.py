"""Where in the image a regularisation, not the image points, determines a camera.

A spline surface has control points in cells without image points. There its regularisation alone keeps the
estimate from being undetermined: the camera looks complete, but says nothing about the lens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...calibration.camera import CameraMapping, by_rotation, places, worst
from ...core.data import Array, Mask
from .result import Result

# Places along the columns of the image; distance to the next image point, in steps between places, up to
# which a place counts as observed; image points compared at once.
_ACROSS, _NEAR, _AT_ONCE = 25, 1.5, 4096
# Share of the variance above which the regularisation determines a place.
_MOSTLY = 0.5
_ROWS, _COLUMNS = ("upper", "", "lower"), ("left", "", "right")


@dataclass(frozen=True, eq=False)
class Regularised:
    """Influence of a regularisation over the image.

    Parameters
    ----------
    xy : ndarray (rows, columns, 2)
        Places, pixels.
    share : ndarray (rows, columns)
        Share of the variance of the projection that does not come from the noise of the observations, but
        from the sigma of the regularisation; NaN where the camera has no image.
    sigma : ndarray (rows, columns)
        Standard deviation of the projection in the worst direction, px, after a rotation referred to the
        places with image points.
    observed : ndarray of bool (rows, columns)
        Places with image points near them.

    Examples
    --------
    >>> xy = np.stack(np.meshgrid([0.0, 99.0, 199.0], [0.0, 99.0, 199.0]), axis=2)
    >>> share = np.zeros((3, 3))
    >>> share[0, 0] = 0.9
    >>> found = Regularised(xy, share, 9 * share, share < 0.5)
    >>> found.regions, round(found.area, 2), round(found.largest, 1)
    ({'upper left': 1.0}, 0.11, 8.1)
    """

    xy: Array
    share: Array
    sigma: Array
    observed: Mask

    @property
    def mostly(self) -> Mask:
        """Places that the regularisation determines mostly."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.share > _MOSTLY)

    @property
    def area(self) -> float:
        """Part of the image that the regularisation determines mostly."""
        return float(self.mostly.mean())

    @property
    def largest(self) -> float:
        """Largest standard deviation of the projection there, px; 0 without such places."""
        return float(self.sigma[self.mostly].max()) if self.mostly.any() else 0.0

    @property
    def where_observed(self) -> float:
        """Median share of the regularisation at the places with image points."""
        own = self.share[self.observed & np.isfinite(self.share)]
        return float(np.median(own)) if len(own) else 1.0

    @property
    def regions(self) -> dict[str, float]:
        """Ninths of the image with such places, and the part of each that they take up."""
        size = self.xy[-1, -1] + 1
        row, column = (np.minimum((3 * self.xy[..., k] / size[k]).astype(int), 2) for k in (1, 0))
        found = {}
        for r, high in enumerate(_ROWS):
            for c, side in enumerate(_COLUMNS):
                part = float(self.mostly[(row == r) & (column == c)].mean())
                if part > 0:
                    found[f"{high} {side}".strip() or "middle"] = part
        return found


def regularised(result: Result, c: int) -> Regularised | None:
    """Compute the influence of the regularisation of a camera over the image.

    Parameters
    ----------
    result : Result
        The adjustment.
    c : int
        Row of the camera.

    Returns
    -------
    Regularised or None
        None for a camera without regularisation.

    Notes
    -----
    With the cofactors Q of the parameters and the sigmas S of their observations, the noise of all other
    observations contributes Q − Q S⁻² Q (see :class:`~reseau.bundle.PriorInfluence`). The share of the
    rest in the variance of the projection is reported at each place. Rotations of the camera, which the poses
    compensate, are removed at the places with image points.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> regularised(adjust_network(example_network()), 0) is None
    True
    """
    camera = result.network.cameras[c]
    model = camera.registered
    if model is None or not model.priors(camera.sigma) or camera.additional is not None:
        return None
    names, columns, values = result.camera_columns(c)
    if not len(names):
        return None
    covariance = result.fit.cofactors.reduced.block(columns, columns) * result.fit.variance
    found = camera.parameters | dict(zip(names, values.tolist(), strict=True))
    size = (camera.width, camera.height)
    lens = CameraMapping.of_estimates(camera.plane_mapping(), size, found, names, covariance)
    xy, shape = places(lens, _ACROSS, None)
    own = result.fit.usable.observations & (result.network.camera_of[result.network.image_of] == c)
    observed = _near(xy, result.network.xy[own], _NEAR * camera.width / (_ACROSS - 1))
    uv = lens.mapping.inverse(xy)
    known = np.isfinite(uv).all(axis=1)
    if not (known & observed).any():
        return None
    seen = lens.mapping.derivatives(uv[known])
    turn, slope = seen.d_xy @ by_rotation(uv[known]), seen.d_parameters[:, :, lens.rows]
    here = observed[known]
    part = np.linalg.lstsq(turn[here].reshape(-1, 3), slope[here].reshape(-1, len(names)), rcond=None)[0]
    slope = slope - turn @ part
    inverse = np.array([1 / camera.sigma[name] if name in camera.sigma else 0.0 for name in names])
    weighted = covariance * inverse
    # Cofactors of the noise of the other observations, and of all.
    noise = covariance - weighted @ weighted.T / result.fit.variance
    share, sigma = np.full(len(xy), np.nan), np.full(len(xy), np.nan)
    full = slope @ covariance @ np.swapaxes(slope, 1, 2)
    images = np.trace(slope @ noise @ np.swapaxes(slope, 1, 2), axis1=1, axis2=2)
    share[known] = np.clip(1 - images / np.trace(full, axis1=1, axis2=2), 0.0, 1.0)
    sigma[known] = worst(full)
    return Regularised(
        xy.reshape(*shape, 2), share.reshape(shape), sigma.reshape(shape), observed.reshape(shape)
    )


def _near(places_xy: Array, points: Array, limit: float) -> Mask:
    """Places with an image point within a distance."""
    near = np.zeros(len(places_xy), dtype=bool)
    for k in range(0, len(points), _AT_ONCE):
        off = places_xy[:, None] - points[None, k : k + _AT_ONCE]
        near |= ((off**2).sum(axis=2) < limit**2).any(axis=1)
    return near
