"""Where the disks of a sheet are in a frame, and which of them they are, at any rotation and tilt.

An ellipse determines the foreshortening of its surroundings except for a rotation; one neighbour determines
the rotation. From such a seed the lattice of the disks grows outwards, disk by disk, while the mapping from
the lattice to the image is adjusted. The assignment of lattice nodes to disks of the design is an integer
problem: for every quarter turn, reflection and shift, the disks that agree with the design are counted, and
the darkness of the rings around them is compared with their codes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...core.errors import UsageError
from ...core.failure import Code, Failure
from ...io import ReseauDesign
from ...optics.composition import Chain
from ..plane.growth import first_mapping, grown_through
from ..plane.lattice_mapping import second_order
from ..plane.levels import levels_around
from .assignment import spacing
from .disks import Disks

MOST_DISKS = 4
"""Number of ellipses examined, as a multiple of the disks of the design; others are specks."""
_SEEDS = 6
"""Number of seeds that are tried."""
_GATE = 0.25
"""Largest distance of a disk from its node, in steps of the lattice."""
_ALIKE = 0.7
"""Largest difference of the areas of disks, as logarithms, from those of the meshes around them."""
_FROM = 1.6
"""Distance from a disk of the lattice within which the next are searched, in steps."""
_ANGLES = 72
_RINGS = 6.0
"""Number of disks at their places that weigh as much as one ring read without error."""
_LEGIBLE = 0.5
"""Minimum agreement of a ring with the design, from -1 (opposite) to 1."""
_AHEAD = 2.0
"""Minimum lead of the best numbering over the second best, in disks."""


@dataclass(frozen=True, eq=False)
class SheetPlacement:
    """Position of a sheet on the disks of a frame.

    Parameters
    ----------
    mapping : Chain
        Mapping from lattice coordinates to the image.
    frame, origin : ndarray (2, 2), (2,)
        Lattice coordinates are `frame` times those of the design, plus `origin`.
    disk : ndarray of int (n,)
        Index of the ellipse of each disk of the design, -1 where there is none.
    """

    mapping: Chain
    frame: Array
    origin: Array
    disk: Rows


def lay_sheet(
    grey: NDArray[np.float32],
    disks: Disks,
    design: ReseauDesign,
    mirrored: bool | None = None,
) -> SheetPlacement | Failure:
    """Find the sheet among the ellipses of a frame, and number its disks.

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values; negative ones where the disks are bright.
    disks : Disks
        The ellipses.
    design : ReseauDesign
        Disks on a regular grid, some with coded rings.
    mirrored : bool, optional
        Whether the design has the handedness of the image (x right, y down; False) or the opposite (True,
        the default).

    Returns
    -------
    SheetPlacement or Failure
        A failure if the sheet is not found.

    Raises
    ------
    UsageError
        When the disks of the design do not form a regular grid.
    """
    numbers, step, start = _numbered(design)
    disks = disks.strongest(MOST_DISKS * len(numbers))
    assert design.mark.size is not None
    reach = 2 * step / design.mark.size
    failure = Failure(f"no disks at a distance of {reach / 2:.1f} diameters form a lattice", Code.NOT_FOUND)
    shape = (grey.shape[0], grey.shape[1])
    for seed in disk_seeds(disks, reach):
        nodes, rows, mapping = grown_disks(*seed, disks, shape, np.ptp(numbers, axis=0).max() + 1)
        if len(rows) < max(6, len(numbers) // 6):
            continue
        placed = _read(grey, nodes, rows, mapping, design, numbers, step, mirrored is not False)
        if isinstance(placed, Failure):
            failure = placed
            continue
        turn, shift, disk = placed
        return SheetPlacement(mapping, turn / step, shift - turn @ start / step, disk)
    return failure


def _numbered(design: ReseauDesign) -> tuple[Array, float, Array]:
    """Integer coordinates (n, 2) of the disks on their grid, its step, and its origin."""
    xy = design.xy
    step = spacing(xy[np.isfinite(xy).all(axis=1)])
    start = xy[np.isfinite(xy).all(axis=1)][0]
    numbers = (xy - start) / step
    if not (np.abs(numbers - np.rint(numbers)) < 0.25).all():
        raise UsageError(
            "disks with coded rings are not on a regular grid along the axes", where=f"design {design.name}"
        )
    return np.rint(numbers), step, start


def disk_seeds(disks: Disks, reach: float) -> Iterator[tuple[int, Array]]:
    """Ellipses with neighbours on a lattice around them, and the images (2, 2) of its unit steps."""
    if len(disks) < 6:
        return
    most = min(25, len(disks))
    near = scipy.spatial.KDTree(disks.xy).query(disks.xy, k=most)[1][:, 1:]
    back = np.linalg.inv(disks.form)
    away = np.einsum("kij,knj->kni", back, disks.xy[near] - disks.xy[:, None])
    z = (away[..., 0] + 1j * away[..., 1]) / reach
    alike = np.abs(np.log(np.linalg.det(disks.form)[near] / np.linalg.det(disks.form)[:, None])) < 0.8
    first = alike & (np.abs(np.abs(z) - 1) < _GATE)
    around = np.array([1, 1j, -1, -1j, 1 + 1j, 1 - 1j, -1 + 1j, -1 - 1j])
    seen = np.where(alike, z, np.inf)
    support = np.zeros(z.shape)
    disk, step = np.nonzero(first)
    expected = z[disk, step, None] * around
    gap = np.abs(seen[disk, None, :] - expected[..., None]).min(axis=2)
    support[disk, step] = (gap < _GATE).sum(axis=1)
    best, way = support.max(axis=1), support.argmax(axis=1)
    well = best >= max(3.0, best.max() - 2)
    if not well.any():
        return
    centre = np.median(disks.xy[well], axis=0)
    order = np.argsort(np.hypot(*(disks.xy - centre).T) + 1e6 * ~well, kind="stable")
    for i in order[: min(_SEEDS, int(well.sum()))]:
        angle = np.angle(z[i, way[i]])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        yield int(i), reach * disks.form[i] @ turn


def grown_disks(
    seed: int, slope: Array, disks: Disks, shape: tuple[int, int], extent: float
) -> tuple[Array, Rows, Chain]:
    """Nodes (m, 2) of the lattice grown from a seed, the disks on them, and the mapping to the image."""
    size, first = np.log(np.linalg.det(disks.form)), np.linalg.det(slope)

    def accepted(mapping: Chain, beside: Array, row: Rows, slopes: Array) -> Mask:
        # The area of an ellipse is proportional to that of the mesh around it.
        mesh = np.log(np.abs(np.linalg.det(slopes) / first))
        return np.asarray(np.abs(size[row] - size[seed] - mesh) < _ALIKE)

    start = first_mapping(slope, disks.xy[seed], shape)
    return grown_through(disks.xy, start, int(extent), shape, accepted, reach=_FROM)


def _read(
    grey: NDArray[np.float32],
    nodes: Array,
    rows: Rows,
    mapping: Chain,
    design: ReseauDesign,
    numbers: Array,
    step: float,
    mirrored: bool,
) -> tuple[Array, Array, Rows] | Failure:
    """Rotation and shift of the design on the lattice, and the ellipse of each of its disks."""
    rings = design.rings
    assert rings is not None
    dark = _darkness(grey, nodes, mapping, design, step)
    coded = np.array([design.ids.index(name) for name in rings.sectors], dtype=np.intp)
    ahead = np.ptp(numbers, axis=0).max()
    corner = (nodes.min(axis=0) - ahead).astype(np.intp)
    row_of, seen = _tables(nodes, mapping, corner, int(ahead), (grey.shape[0], grey.shape[1]))
    found: list[tuple[float, float, Array, Array, Rows]] = []
    for turn in _turns():
        turned = np.rint(numbers @ turn.T).astype(np.intp)
        low = nodes.min(axis=0).astype(np.intp) - turned.max(axis=0)
        high = nodes.max(axis=0).astype(np.intp) - turned.min(axis=0)
        shifts = np.array(list(product(*(range(a, b + 1) for a, b in zip(low, high, strict=True)))))
        at = tuple(np.moveaxis(shifts[:, None] + turned - corner, 2, 0))
        node, missed = row_of[at], seen[at]  # (shifts, disks)
        count = (node >= 0).sum(axis=1)
        expected = np.stack([_sectors(sectors, turn) for sectors in rings.sectors.values()])
        read = _agreement(dark, expected)[node[:, coded], np.arange(len(coded))]
        there = node[:, coded] >= 0
        score = count - 0.5 * missed.sum(axis=1) + _RINGS * np.where(there, read, 0.0).sum(axis=1)
        best = np.where(there, read, -1.0).max(axis=1)
        for k in np.flatnonzero(count >= 0.6 * min(len(nodes), len(numbers))):
            found.append((score[k], best[k], turn, shifts[k].astype(np.float64), node[k]))
    if not found:
        return Failure("the disks found do not agree with the design at any position", Code.OTHER_DESIGN)
    found.sort(key=lambda one: -one[0])
    score, agreement, turn, moved, node = found[0]
    if agreement < _LEGIBLE or (len(found) > 1 and score - found[1][0] < _AHEAD):
        return Failure("its disks were found, but no coded ring identifies them", Code.AMBIGUOUS)
    if (np.linalg.det(_slope(mapping) @ turn) < 0) != mirrored:
        return Failure("the sheet is seen mirrored", Code.MIRRORED)
    return turn, moved, np.where(node >= 0, rows[node], -1)


def _tables(
    nodes: Array, mapping: Chain, corner: Rows, ahead: int, shape: tuple[int, int]
) -> tuple[Rows, Mask]:
    """Lattice as tables: the index of each node that was found, and which other nodes are in the frame.

    Far from the nodes found, the projectivity alone predicts the others.
    """
    wide, high = (nodes.max(axis=0) - corner).astype(np.intp) + ahead + 1
    row_of = np.full((wide, high), -1, dtype=np.intp)
    row_of[tuple((nodes - corner).astype(np.intp).T)] = np.arange(len(nodes))
    at = corner + np.argwhere(row_of < 0).astype(np.float64)
    near = scipy.spatial.KDTree(nodes).query(at)[0] < _FROM
    xy = mapping.first(at)
    xy[near] = mapping(at[near])
    seen = np.zeros(row_of.shape, dtype=bool)
    seen[row_of < 0] = ((xy > 0) & (xy < np.array(shape[::-1]) - 1)).all(axis=1)
    return row_of, seen


def _slope(mapping: Chain) -> Array:
    slope: Array = second_order(mapping, np.zeros((1, 2)))[1][0]
    return slope


def _turns() -> list[Array]:
    """Quarter turns, with and without a reflection."""
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    return turns + [turn @ np.diag([1.0, -1.0]) for turn in turns]


def _darkness(
    grey: NDArray[np.float32], nodes: Array, mapping: Chain, design: ReseauDesign, step: float
) -> Array:
    """Darkness at the places of a ring, from 0 (background) to 1 (disk), (m, angles)."""
    rings, size = design.rings, design.mark.size
    assert rings is not None
    assert size is not None
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def along(diameter: float) -> Array:
        return levels_around(grey, mapping, nodes, diameter / 2 / step * circle)

    low = np.median(along(0.4 * size), axis=1, keepdims=True)
    high = np.median(along((size + rings.inner) / 2), axis=1, keepdims=True)
    dark = (high - along((rings.inner + rings.outer) / 2)) / np.maximum(high - low, 1e-6)
    return np.clip(dark, 0, 1)


def _sectors(sectors: tuple[tuple[float, float], ...], turn: Array) -> Array:
    """Expected ring at the angles of the lattice, 1 in its sectors and 0 elsewhere."""
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    x, y = turn.T @ np.stack([np.cos(angle), np.sin(angle)])
    degrees = np.rad2deg(np.arctan2(y, x))
    inside = [np.mod(degrees - start, 360) < end - start for start, end in sectors]
    return np.any(inside, axis=0).astype(np.float64) if inside else np.zeros(_ANGLES)


def _agreement(dark: Array, expected: Array) -> Array:
    """Agreement of rings with codes (m, c): 1 if equal, 0 on an empty background, -1 if opposite."""
    # Means, so that codes with many and with few dark sectors have equal weight.
    on, off = (part / np.maximum(part.sum(axis=1, keepdims=True), 1) for part in (expected, 1 - expected))
    agreement: Array = dark @ (on - off).T
    return agreement
