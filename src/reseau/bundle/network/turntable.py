"""A turntable as a part of a network document, and as the rotary stage of a network."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from ...core.numbers import or_null
from ...io.network import TurntableEntry
from .stage import Stage


def stage_of_turntable(
    entry: TurntableEntry, images: Sequence[str], exposures: Sequence[str | None] | None = None
) -> Stage | None:
    """Return the stage of a turntable for the images of a network; None where it has none of them.

    Parameters
    ----------
    entry : TurntableEntry
        The turntable; images that the network does not have are left out.
    images : sequence of str (m,)
        Images of the network.
    exposures : sequence of (str or None), optional
        Their exposures: an image without an angle has that of another image of its exposure.

    Raises
    ------
    UsageError
        When images of an exposure have different angles.

    Examples
    --------
    >>> entry = TurntableEntry(image=("a", "b"), angle_deg=(0.0, 90.0), sigma_deg=(0.0, 0.0))
    >>> stage = stage_of_turntable(entry, ["b", "c", "a"])
    >>> stage.pose.tolist(), stage.reading.round(3).tolist()
    ([0, -1, 0], [1.571, nan, 0.0])
    """
    row = {name: k for k, name in enumerate(entry.image)}
    of = [row.get(name, -1) for name in images]
    shared: dict[str, int] = {}
    for name, exposure, k in zip(images, exposures or (), of, strict=False):
        if exposure is None or k < 0:
            continue
        other = shared.setdefault(exposure, k)
        if (entry.angle_deg[k], entry.sigma_deg[k], entry.pose_of(k)) != (
            entry.angle_deg[other], entry.sigma_deg[other], entry.pose_of(other)
        ):  # fmt: skip
            raise UsageError(
                f"images {name} and {entry.image[other]} were taken at once, but differ in angle, sigma "
                "or pose",
                where="turntable",
            )
    of = [
        shared.get(exposure, -1) if k < 0 and exposure is not None else k
        for k, exposure in zip(of, exposures or [None] * len(of), strict=True)
    ]
    if max(of, default=-1) < 0:
        return None
    poses = {name: k for k, name in enumerate(dict.fromkeys(entry.pose_of(k) for k in of if k >= 0))}
    angle = [np.nan if k < 0 or entry.angle_deg[k] is None else entry.angle_deg[k] for k in of]
    sigma = [np.nan if k < 0 or entry.sigma_deg[k] is None else entry.sigma_deg[k] for k in of]
    spread = entry.direction_sigma_deg
    return Stage(
        np.array([-1 if k < 0 else poses[entry.pose_of(k)] for k in of], dtype=np.intp),
        np.radians(np.array(angle, dtype=np.float64)), np.radians(np.array(sigma, dtype=np.float64)),
        None if entry.direction is None else np.array(entry.direction),
        np.inf if spread is None else float(np.radians(spread)), "rotary", entry.carries,
        None if entry.position is None else np.array(entry.position),
        np.inf if entry.position_sigma is None else entry.position_sigma,
    )  # fmt: skip


def turntable_of_stage(stage: Stage, images: Sequence[str]) -> TurntableEntry:
    """Return the part of a network document for a rotary stage.

    Raises
    ------
    UsageError
        When the stage is linear.
    """
    if not stage.rotary:
        raise UsageError("a network with a linear stage cannot be written", where="network")
    on = np.flatnonzero(stage.pose >= 0).tolist()

    def column(values: Array) -> tuple[float | None, ...]:
        return tuple(or_null(v) for v in np.degrees(values[on]))

    return TurntableEntry(
        carries=stage.carries, image=tuple(images[i] for i in on), angle_deg=column(stage.reading),
        sigma_deg=column(np.asarray(stage.sigmas)), pose=tuple(str(p) for p in stage.pose[on].tolist()),
        direction=None if stage.axis is None else _triple(stage.axis),
        direction_sigma_deg=or_null(np.degrees(stage.axis_sigma)),
        position=None if stage.point is None else _triple(stage.point),
        position_sigma=or_null(stage.point_sigma),
    )  # fmt: skip


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
