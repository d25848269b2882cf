r"""Images of plane targets formed by rays: blurred by defocus, aberrations and colour.

A pupil element of one wavelength forms a sharp image of the target, displaced and distorted; the image is the
sum of these over the elements of the stop and the wavelengths (Meid 1992, section 3.1.4; Herzberger 1947).
The outline of each is mapped by rays, so that the sum is one outline integral
(:mod:`reseau.optics.formation`): the limit of infinitely small elements of the target, integrated over
pixels, without sampling in the image plane. Within a target the rays of an element are mapped with a
polynomial of second degree through nine traced points.

Points of the object are in camera axes: x right, y down, z along the view, millimetres, origin at the
projection centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ..formation import Outline, PixelResponse
from ..gridded import GriddedOutline
from ..newton import determinant
from .pupils import PupilElements
from .ray_maps import CalibratedLens, LensCamera, RayMap

_TOGETHER = 40_000
"""Largest number of rays of one wavelength in one call, for the sake of memory."""

_UNSEEN = 1e-4
"""Shift of an image, pixels, below which the shares of elements count as even: two outlines less to form."""

_GRID = np.array([[u, v] for u in (-1.0, 0.0, 1.0) for v in (-1.0, 0.0, 1.0)])


def _powers(uv: Array) -> Array:
    """Terms (n, 6) of a polynomial of second degree."""
    u, v = uv[..., 0], uv[..., 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _slopes(uv: Array) -> tuple[Array, Array]:
    """Derivatives (n, 6) of these terms by u and by v."""
    (u, v), none, one = uv.T, np.zeros(len(uv)), np.ones(len(uv))
    return (
        np.stack([none, one, none, 2 * u, v, none], axis=1),
        np.stack([none, none, one, none, u, 2 * v], axis=1),
    )


_FIT = np.linalg.pinv(_powers(_GRID))


@dataclass(frozen=True, eq=False)
class PlaneTarget:
    """A plane target in space.

    Parameters
    ----------
    centre : ndarray (3,)
        Its point, in camera axes, mm.
    axes : ndarray (3, 2)
        Unit vectors of the plane, in columns, in camera axes.
    outline : Outline
        Outline (j, 2) about its point, mm; see :func:`reseau.optics.formation.mark_outline`.

    Examples
    --------
    >>> disk = PlaneTarget(np.array([0.0, 0, 500]), np.eye(3)[:, :2], Outline.circle(4.0, 0.2))
    >>> round(disk.extent, 1), disk.points(np.array([[1.0, 0.0]]))
    (4.0, array([[  1.,   0., 500.]]))
    """

    centre: Array
    axes: Array
    outline: Outline

    @cached_property
    def extent(self) -> float:
        """Half the side of a square around the target, mm."""
        return float(np.abs(self.outline.xy).max())

    @property
    def normal(self) -> Array:
        """Unit vector (3,) across the plane."""
        return np.asarray(np.cross(self.axes[:, 0], self.axes[:, 1]))

    def points(self, uv: Array) -> Array:
        """Points (n, 3) in camera axes of points (n, 2) of the plane."""
        return np.asarray(self.centre + uv @ self.axes.T)


@dataclass(frozen=True, eq=False)
class RayImage:
    """Image of a target by rays.

    Parameters
    ----------
    outline : Outline
        Nodes (j, 2) in pixels from the corresponding point; their tangents contain the light of each element,
        so that the image of a target without losses has the light 1 inside.
    point : ndarray (2,)
        Pixel of the corresponding ray: the principal ray, in one wavelength, of the target's point.
    blur : float
        Root mean square distance of rays of one point from their mean, pixels.

    falloff : ndarray (2,)
        Change of the logarithm of the light of an even ground, by pixel along x and y. A dark target takes
        its share of the light of the ground; a bright one in front of nothing is as much darker.
    uneven : ndarray (2, j, 2) or (0, 0, 2)
        Changes of the tangents by pixel along x and y: the share of an element changes with the place of the
        sensor, most where apertures cut the stop.

    Examples
    --------
    >>> image = RayImage(Outline.circle(3.0, 0.5), np.array([10.0, 20.0]), 0.0)
    >>> bool(np.abs(image.centroid).max() < 1e-12)
    True
    """

    outline: Outline
    point: Array
    blur: float
    falloff: Array = field(default_factory=lambda: np.zeros(2))
    uneven: Array = field(default_factory=lambda: np.zeros((0, 0, 2)))

    @cached_property
    def gridded(self) -> tuple[GriddedOutline, ...]:
        """The outline, and its changes by pixel along x and y, gridded for the formation of images."""
        parts = self.outline.dxy, *self.uneven
        return tuple(GriddedOutline.of(Outline(self.outline.xy, dxy)) for dxy in parts)

    def formed(
        self,
        place: Array,
        sigma: float,
        columns: Array,
        rows: Array,
        response: PixelResponse,
        *,
        bright: bool = False,
        derivatives: bool = False,
        parts: tuple[GriddedOutline, ...] | None = None,
    ) -> Array:
        """Share (r, c) of the light of each pixel, or with derivatives (4 + m, r, c).

        Parameters
        ----------
        place : ndarray (2,)
            Pixel of the corresponding point.
        sigma : float
            Width of the point-spread function, pixels.
        columns, rows : ndarray (c,), (r,)
            Adjacent pixels.
        response : PixelResponse
        bright : bool
            Whether the light is that of a bright target, which falls off as that of an even ground.
        derivatives : bool
            By place, width, and parameters of the form; see :class:`GriddedOutline`.
        parts : tuple of GriddedOutline, optional
            In place of :attr:`gridded`, with other parameters of the optics.
        """
        where = place, sigma, columns, rows, response
        even, *uneven = (
            part.derivatives(*where) if derivatives else part.image(*where) for part in parts or self.gridded
        )
        x, y = columns - self.point[0], rows[:, None] - self.point[1]
        for away, part in zip((x, y), uneven, strict=False):
            even = even + away * part
        by_x, by_y = self.falloff if bright else (0.0, 0.0)
        return np.asarray(np.exp(by_x * x + by_y * y) * even)

    @property
    def centroid(self) -> Array:
        """Centre of density, in pixels from the corresponding point."""
        (x, y), (dx, dy) = self.outline.xy.T, self.outline.dxy.T
        area = 0.5 * (x * dy - y * dx).sum()
        return np.asarray(np.array([0.5 * (x * x * dy).sum(), -0.5 * (y * y * dx).sum()]) / area)


def ray_image(camera: RayMap, target: PlaneTarget, elements: PupilElements) -> RayImage:
    """Form the image of a target.

    Parameters
    ----------
    camera : RayMap
    target : PlaneTarget
    elements : PupilElements
        Elements of the stop, used for each wavelength.

    Raises
    ------
    UsageError
        When no light of the target reaches the sensor.

    Examples
    --------
    >>> from reseau.optics.lenses import ThinLens
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> disk = PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(4.0, 0.2))
    >>> image = ray_image(camera, disk, PupilElements.gauss(6))
    >>> bool(np.abs(image.centroid).max() < 1e-9), round(image.blur, 1)
    (True, 5.3)
    """
    return required_image(ray_images(camera, [target], elements)[0])


def required_image(found: RayImage | Failure) -> RayImage:
    """Return the image, or raise why there is none as a UsageError."""
    if isinstance(found, Failure):
        raise UsageError(found.reason)
    return found


def ray_images(
    camera: RayMap, targets: Sequence[PlaneTarget], elements: PupilElements
) -> list[RayImage | Failure]:
    """Form the images of several targets; their rays are traced together, which is faster.

    Parameters
    ----------
    camera : RayMap
    targets : sequence of PlaneTarget
    elements : PupilElements
        Elements of the stop, used for each wavelength.

    Returns
    -------
    list of RayImage or Failure
        A failure, with the reason, where no light of a target reaches the sensor, or it cannot be imaged.

    Examples
    --------
    >>> from reseau.optics.lenses import ThinLens
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> outline = Outline.circle(4.0, 0.2)
    >>> near, far = (PlaneTarget(np.array([0.0, 0, z]), np.eye(3)[:, :2], outline) for z in (1e3, 2e3))
    >>> [round(image.blur, 1) for image in ray_images(camera, [near, far], PupilElements.gauss(6))]
    [5.3, 6.2]
    """
    count = max(1, _TOGETHER // (len(_GRID) * len(elements.xy)))
    found: list[RayImage | Failure] = []
    for k in range(0, len(targets), count):
        found += _imaged(camera, targets[k : k + count], elements)
    return found


def _imaged(
    camera: RayMap, targets: Sequence[PlaneTarget], elements: PupilElements
) -> list[RayImage | Failure]:
    """Images of targets whose rays are traced in one call."""
    try:
        points = np.concatenate([target.points(target.extent * _GRID) for target in targets])
        xy, light = camera.spots(points, elements)
        at = camera.corresponding(np.array([target.centre for target in targets]))
    except UsageError as error:
        if len(targets) == 1:
            return [Failure(error.what, Code.OUTSIDE)]
        # A point that no lens images, as one behind it, is refused with all others: find out which it is.
        return [_imaged(camera, [target], elements)[0] for target in targets]
    shape = len(xy), len(targets), len(_GRID), xy.shape[2]
    xy, light = xy.reshape(*shape, 2), light.reshape(*shape, 3)
    return [_image_of(camera, target, xy[:, k], light[:, k], at[k]) for k, target in enumerate(targets)]


def _image_of(
    camera: RayMap, target: PlaneTarget, xy: Array, light: Array, point: Array
) -> RayImage | Failure:
    """Image from the pixels (w, 9, e, 2) and the light (w, 9, e, 3) of the rays of a target."""
    usable = np.asarray(np.isfinite(xy).all(axis=(1, 3)))
    maps = np.einsum("tg,wgex->wetx", _FIT, np.where(usable[:, None, :, None], xy, 0.0))
    emitted = np.moveaxis(np.abs(light @ target.normal), 1, 2)
    # Light per area of the image: where an element images the target smaller, it is brighter. In a tilted
    # target this cancels what Lambert's law changes over the stop, which alone would displace the image.
    by_u, by_v = (np.einsum("gt,wetx->wegx", slopes, maps) for slopes in _slopes(_GRID))
    area = np.abs(by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0])
    usable &= (area > 0).all(axis=2)
    density = np.where(usable[..., None], emitted / np.where(usable[..., None], area, 1.0), 0.0)
    coefficients, light = maps.reshape(-1, 6, 2), density.reshape(-1, len(_GRID))
    if not (light.any() and np.isfinite(point).all()):
        lens = camera.camera if isinstance(camera, CalibratedLens) else camera
        why = lens.why_dark(target.centre) if isinstance(lens, LensCamera) else "it is not in the field"
        return Failure(f"no light of the target reaches the sensor: {why}", Code.OUTSIDE)
    # What a place of the sensor receives through each element, and its changes with the place: the share of
    # an element is that at the point of the image, not that where the element has the target.
    plane = np.einsum("tg,eg->et", _FIT[:3], light)
    by_uv = np.stack([coefficients[:, 1], coefficients[:, 2]], axis=1)
    # What blocks light within the stop, as a spider, does not change with the place as a plane does.
    dark = (light == 0).any(axis=1) | (determinant(by_uv) == 0)
    by_xy = np.linalg.solve(np.where(dark[:, None, None], np.eye(2), by_uv), plane[:, 1:, None])[..., 0]
    by_xy[dark] = 0.0
    at_point = np.maximum(light.mean(axis=1) - ((coefficients[:, 0] - point) * by_xy).sum(axis=1), 0.0)
    share = at_point / at_point.sum()
    slope = by_xy / at_point.sum()
    falloff = slope.sum(axis=0)
    # Elements without light remain, as points: images with other parameters have the same nodes.
    coefficients[share == 0] = 0.0
    coefficients[share == 0, 0] = point
    uneven = slope - share[:, None] * falloff
    return _assembled(coefficients, share, target, point, falloff, uneven)


def _assembled(
    coefficients: Array, share: Array, target: PlaneTarget, point: Array, falloff: Array, uneven: Array
) -> RayImage:
    """Outline of an image from mappings (m, 6, 2) of elements, their light (m,) and its changes (m, 2)."""
    uv = target.outline.xy / target.extent
    xy = _powers(uv) @ coefficients
    by_u, by_v = (slopes @ coefficients for slopes in _slopes(uv))
    du, dv = target.outline.dxy.T[:, None, :, None] / target.extent
    tangents = by_u * du + by_v * dv
    nodes = Outline((xy - point).reshape(-1, 2), (tangents * share[:, None, None]).reshape(-1, 2))
    outline = nodes.oriented()
    side = 1.0 if np.array_equal(outline.dxy, nodes.dxy) else -1.0
    changes = side * uneven.T[:, :, None, None] * tangents
    away = coefficients[:, 0] - share @ coefficients[:, 0]
    if np.hypot(*((uneven * away).sum(axis=1) @ away)) < _UNSEEN:
        changes = changes[:0]
    blur = float(np.sqrt(share @ (away**2).sum(axis=1)))
    return RayImage(outline, point, blur, falloff, changes.reshape(len(changes), len(outline.xy), 2))


def image_scale(camera: RayMap, centre: Array, axes: Array) -> Array:
    """Pixels per millimetre of small plane targets in the image.

    Parameters
    ----------
    camera : RayMap
    centre : ndarray (n, 3)
        In camera axes, mm.
    axes : ndarray (n, 3, 2)
        Unit vectors of their planes.

    Returns
    -------
    ndarray (n,)
        Root of the areal scale; NaN out of the field of the lens.

    Examples
    --------
    >>> from reseau.optics.lenses import ThinLens
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> image_scale(camera, np.array([[0.0, 0.0, 1000.0]]), np.eye(3)[None, :, :2]).round(2)
    array([5.2])
    """
    around = np.stack([centre, centre + axes[..., 0], centre + axes[..., 1]], axis=1)
    near = camera.corresponding(around.reshape(-1, 3)).reshape(-1, 3, 2)
    return np.asarray(np.sqrt(np.abs(determinant(near[:, 1:] - near[:, :1]))))
