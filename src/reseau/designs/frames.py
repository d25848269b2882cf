"""A space frame with plane targets, each to be printed and fixed to it."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..core.errors import UsageError
from ..io.targets import SpaceTargets, TargetColumns


def space_frame(
    sides: tuple[float, float, float] = (1200.0, 900.0, 400.0),
    count: int = 28,
    size: float = 20.0,
    *,
    shape: Literal["disk", "square"] = "disk",
    polarity: Literal["dark", "bright"] = "dark",
    name: str = "frame",
) -> SpaceTargets:
    """Lay out targets on the edges of a box: on its corners, then evenly along its edges.

    Parameters
    ----------
    sides : (float, float, float)
        Sides of the box along X, Y, Z, mm; its centre is the origin.
    count : int
        Number of targets, at least the eight corners.
    size : float
        Diameter of a disk or side of a square, mm.
    shape : {"disk", "square"}
    polarity : {"dark", "bright"}
        Whether targets are darker or brighter than their ground.
    name : str

    Returns
    -------
    SpaceTargets
        All face +Z. The coordinates are nominal: a frame is measured after it was built.

    Raises
    ------
    UsageError
        When there are fewer than eight targets, a size is not positive, or targets would touch.

    Examples
    --------
    >>> frame = space_frame(count=20)
    >>> frame.targets.id[:3], frame.targets.xyz[0]
    (('1', '2', '3'), (-600.0, -450.0, -200.0))
    """
    if count < 8:
        raise UsageError(f"is {count}; a frame has at least the eight corners", where="count")
    if not min(*sides, size) > 0:
        raise UsageError("must be above 0", where="sides and size of a frame")
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(sides) / 2
    edges = [(a, b) for k, a in enumerate(corners) for b in corners[k + 1 :] if np.count_nonzero(a != b) == 1]
    length = np.array([np.linalg.norm(b - a) for a, b in edges])
    inner = np.zeros(len(edges), dtype=int)
    for _ in range(count - 8):
        # The next target divides the edge with the longest gaps.
        inner[int(np.argmax(length / (inner + 1)))] += 1
    points = [*corners]
    for (a, b), n in zip(edges, inner, strict=True):
        points += [a + (b - a) * (k + 1) / (n + 1) for k in range(n)]
    if (length / (inner + 1)).min() < 2 * size:
        raise UsageError(
            f"{count} targets of {size:g} mm would touch on this frame", where="count",
            do="give fewer or smaller targets, or a larger frame",
        )  # fmt: skip
    columns = TargetColumns(
        id=tuple(str(k + 1) for k in range(count)),
        shape=(shape,) * count,
        size=(float(size),) * count,
        normal=((0.0, 0.0, 1.0),) * count,
        xyz=tuple((float(x), float(y), float(z)) for x, y, z in points),
    )
    return SpaceTargets(unit="mm", polarity=polarity, name=name, targets=columns)
