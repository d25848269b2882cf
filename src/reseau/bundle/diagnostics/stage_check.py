"""Whether the images of a stage are rotated as its readings say: unit, sense and single wrong readings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Remark
from ..network.network import Network, finite
from ..network.stage import Stage, StageValues, nearest_rotation
from .checks import listed

# Rotations agree with the readings when they deviate by less than this (rad); readings in another unit must
# agree better than those given, by this factor.
_AGREE, _BETTER = 0.05, 0.2
# A wrong reading deviates by this many times the median, and by at least this (rad).
_FACTOR, _ODD = 8.0, 0.02
# Readings in other units, as factors on what was taken for the right one.
_UNITS = (
    (180.0 / np.pi, "radians where degrees are expected"),
    (np.pi / 180.0, "degrees where radians are expected"),
    (0.9, "gon where degrees are expected"),
)
# Rounds in which pairs of images that deviate are left out of the axis.
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class _Turned:
    """Images with orientations and readings, in poses of one camera."""

    stage: Stage
    rotation: Array
    known: Mask
    key: Rows

    def axis(self, factor: float, among: Mask) -> tuple[Array, Array]:
        """Axis (3,), and angles (m,) by which images deviate from their readings; NaN without orientation."""
        used, off = among.copy(), np.full(len(among), np.nan)
        axis = np.zeros(3)
        for _ in range(_ROUNDS):
            axis = self.stage.direction(self.rotation, used, self.key, factor=factor, free=True)
            off = self.deviations(axis, factor, among)
            least = max(_FACTOR / 2 * float(np.nanmedian(off)), _ODD)
            fewer = among & (off <= least)
            if (fewer == used).all() or fewer.sum() < 2:
                break
            used = fewer
        return axis, off

    def deviations(self, axis: Array, factor: float, among: Mask) -> Array:
        """Angles (m,) between the rotations of images and those of their readings about an axis."""
        stage, off = self.stage, np.full(len(among), np.nan)
        moved = StageValues(factor * stage.reading, axis, np.zeros(3))
        for pose in np.unique(self.key[among]):
            rows = np.flatnonzero(among & (self.key == pose))
            rest, _ = stage.at_rest(moved, rows, self.rotation[rows], np.zeros((len(rows), 3)))
            # The pose of the image that agrees best with the others: one wrong reading changes nothing.
            cosine = (np.einsum("aij,bij->ab", rest, rest) - 1) / 2
            angles = np.arccos(np.clip(cosine, -1.0, 1.0))
            best = int(np.argmin(np.median(angles, axis=1)))
            near = angles[best] <= max(float(np.median(angles[best])), _ODD)
            mean = nearest_rotation(rest[near].mean(axis=0))
            cosine = (np.einsum("aij,ij->a", rest, mean) - 1) / 2
            off[rows] = np.arccos(np.clip(cosine, -1.0, 1.0))
        return off


def checked_readings(network: Network, rotation: Array, x0: Array) -> tuple[tuple[Remark, ...], Rows]:
    """Compare the readings of a rotary stage with the orientations of its images.

    Parameters
    ----------
    network : Network
        The network.
    rotation, x0 : ndarray (m, 3, 3) and (m, 3)
        Orientations that do not come from the readings; NaN where unknown.

    Returns
    -------
    tuple of Remark
        What is wrong. With the code ``readings`` all or most readings are: in another unit, or sense.
    ndarray of int
        Images whose readings are wrong, where most are right.
    """
    stage, none = network.stage, np.zeros(0, dtype=np.intp)
    if stage is None or not stage.rotary:
        return (), none
    known = finite(x0) & (stage.pose >= 0) & ~np.isnan(stage.sigmas)
    key = np.where(stage.pose >= 0, stage.pose * (len(network.cameras)) + network.camera_of, -1)
    # A pose with one image compares nothing.
    known &= np.isin(key, [k for k in np.unique(key[known]) if (key[known] == k).sum() > 1])
    if not known.any() or not np.ptp(stage.reading[known]) > 0:
        return (), none
    turned = _Turned(stage, rotation, known, key.astype(np.intp))
    axis, off = turned.axis(1.0, known)
    typical = _rms(off[known])
    if typical > _AGREE:
        for factor, said in _UNITS:
            if _rms(turned.axis(factor, known)[1][known]) < min(_AGREE, _BETTER * typical):
                text = (
                    f"the angles of the turntable are in {said}: the images are rotated by {factor:.4g} "
                    "times as much"
                )
                return (Remark(text, Code.READINGS),), none
        other = _other_sense(network, turned, known)
        if other is not None:
            return (other,), none
    if typical > _AGREE and np.median(off[known]) > _AGREE:
        text = (
            "the rotations of the images do not follow the angles of the turntable: they deviate by "
            f"{np.rad2deg(np.median(off[known])):.2g} deg in the median; are the angles in the order of the "
            "images?"
        )
        return (Remark(text, Code.READINGS),), none
    odd = np.flatnonzero(
        known & (off > max(_FACTOR * float(np.nanmedian(off)), _ODD, 5 * _sigma(stage, known)))
    )
    # Without poses and coordinates, the system of the object is that of the first images.
    placed = finite(network.x0).any() or finite(network.xyz).any()
    remarks = _against_nominal(stage, axis) if placed else []
    if len(odd):
        first = network.same_reading[odd]
        odd = np.flatnonzero(np.isin(network.same_reading, first)).astype(np.intp)
        angles = listed(f"{network.images[i]} ({np.rad2deg(off[i]):.2g} deg)" for i in odd if off[i] > _ODD)
        remarks.append(Remark(f"the angle of the turntable is wrong in image {angles}", Code.INCONSISTENT))
    return tuple(remarks), odd.astype(np.intp)


def _rms(angles: Array) -> float:
    return float(np.sqrt(np.mean(angles**2)))


def _sigma(stage: Stage, known: Mask) -> float:
    return float(stage.sigmas[known].max())


def _against_nominal(stage: Stage, axis: Array) -> list[Remark]:
    """What contradicts the direction of the axis that is given."""
    if stage.axis is None:
        return []
    nominal = stage.axis / np.linalg.norm(stage.axis)
    angle = float(np.arccos(np.clip(axis @ nominal, -1.0, 1.0)))
    given = np.isfinite(stage.axis_sigma)
    if angle > np.pi / 2:
        carried = "camera" if stage.carries == "camera" else "object"
        text = (
            f"the {carried} turns about the given axis in the opposite sense: angles increase anticlockwise "
            "where the axis points to the viewer; change the sign of the angles, reverse the direction, or "
            "check whether the turntable carries the object or the camera"
        )
        return [Remark(text, Code.READINGS if given else Code.INCONSISTENT)]
    if given and angle > _AGREE + 5 * stage.axis_sigma:
        text = f"the images turn about an axis {np.rad2deg(angle):.2g} deg away from the given one"
        return [Remark(text, Code.INCONSISTENT)]
    return []


def _other_sense(network: Network, turned: _Turned, known: Mask) -> Remark | None:
    """Poses whose readings increase in the other sense than those of the pose with the most images."""
    keys, count = np.unique(turned.key[known], return_counts=True)
    axes, right = {}, {}
    for k in keys:
        among = known & (turned.key == k)
        if np.ptp(turned.stage.reading[among]) > 0:
            axes[int(k)], off = turned.axis(1.0, among)
            right[int(k)] = _rms(off[among]) < _AGREE
    most = max(axes, key=lambda k: int(count[np.searchsorted(keys, k)]))
    wrong = [k for k in axes if right[k] and axes[k] @ axes[most] < -0.5]
    if not right[most] or not wrong:
        return None
    one, other = (network.images[int(np.flatnonzero(turned.key == k)[0])] for k in (wrong[0], most))
    text = (
        f"the angles of the pose of image {one} increase in the opposite sense to those of the pose of image "
        f"{other}"
    )
    return Remark(text, Code.READINGS)


def without_readings(stage: Stage, images: Rows) -> Stage:
    """Return the stage with readings of some images that are estimated only."""
    sigma = stage.sigmas.copy()
    sigma[images] = np.nan
    return replace(stage, sigma=sigma)
