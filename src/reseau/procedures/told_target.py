"""A board that was told and the photographs contradict: the one that they show is measured in its place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ..bundle import Result
from ..bundle.diagnostics.fields import camera_mapping
from ..bundle.network.rig import Rig
from ..calibration import CameraMapping
from ..core.data import Array, Frame, ImagePoints
from ..core.errors import ImageError, UsageError
from ..core.failure import Failure
from ..designs.boards import unusual_size
from ..execution import Executor, Outputs
from ..io import BoardDesign
from .exposures import Taken
from .target_measurement import (
    MeasuredPhotograph,
    Measurer,
    Photograph,
    Unread,
    measured_in_order,
    measurer_with,
)
from .which_target import CONTRADICT, corrected, described, difference

_TRIED = 3
"""Photographs in which further rows of markers are looked for."""


@dataclass(frozen=True)
class TargetMeasured:
    """What was measured in photographs, and of which target.

    Parameters
    ----------
    photographs : tuple of MeasuredPhotograph
        What was measured.
    corrected : BoardDesign, optional
        The board that was measured in place of the target that was told.
    notes : tuple of str
        What the user should know of the design.
    shown : str
        What the photographs show in place of the target, in words; empty where they show it.
    """

    photographs: tuple[MeasuredPhotograph, ...]
    corrected: BoardDesign | None = None
    notes: tuple[str, ...] = ()
    shown: str = ""


def measured_as_shown(
    photographs: Iterable[Photograph],
    design: object,
    measure: Measurer,
    executor: Executor | None = None,
    outputs: Outputs | None = None,
) -> TargetMeasured:
    """Measure a target in photographs; where they contradict its design, the board that they show.

    A board whose design is contradicted by more photographs than show it, or whose markers go on beyond its
    last row, is compared with boards of the same kind that the photographs show; see
    :func:`~reseau.procedures.which_target.corrected`.

    Parameters
    ----------
    photographs, measure, executor, outputs
        See :func:`~reseau.procedures.target_measurement.measured_in_order`.
    design : BoardDesign or object
        The target. Designs of other kinds are not corrected.

    Examples
    --------
    >>> measured_as_shown([], None, print).photographs
    ()
    """
    seen = list[Photograph]()
    done = list(measured_in_order(_remembered(photographs, seen), measure, executor, outputs))
    if not isinstance(design, BoardDesign):
        return TargetMeasured(tuple(done))
    notes = tuple(filter(None, [unusual_size(design)]))
    # Where a part of the told board may be hidden, a smaller board may be seen whole.
    against = {
        each.name
        for each in done
        if not each.certain or (isinstance(each.found, Failure) and each.found.code in CONTRADICT)
    }
    showing = {each.name for each in done if each.certain and not isinstance(each.found, Failure)}
    contradicted = len(against) > len(showing)
    if not contradicted and not _goes_on(_frames(seen, showing), design, measure):
        return TargetMeasured(tuple(done), None, notes)
    other = corrected(_frames(seen, against if contradicted else showing), design)
    if isinstance(other, Failure):
        return TargetMeasured(tuple(done), None, notes, other.reason if contradicted else "")
    again = measurer_with(measure, other)
    if again is None:  # the caller's own
        return TargetMeasured(tuple(done), None, notes, f"the photographs show {described(other)}")
    # What is kept is kept for the design that was told.
    done = list(measured_in_order(seen, again, executor))
    shown, told = f"the photographs show {described(other)}", described(design)
    shown += (
        f", not {told} as was told" if told != described(other) else " in other proportions than was told"
    )
    said = f"{shown}: {difference(other, design)}; calibrated with what they show, correct the design"
    return TargetMeasured(tuple(done), other, (*notes, said), shown)


def _goes_on(frames: Iterable[Frame], design: BoardDesign, measure: Measurer) -> bool:
    """Whether photographs show corners beyond the last row of a board whose markers are numbered by rows."""
    # Two rows: the layout of some boards depends on whether their number is even.
    longer = design.model_copy(update={"rows": design.rows + 2})
    again = None if design.dictionary is None else measurer_with(measure, longer)
    if again is None:
        return False
    own = set(design.ids)
    for frame in islice(frames, _TRIED):
        try:
            found = again(frame)
        except UsageError:  # the dictionary has no further markers
            return False
        if not isinstance(found, Failure) and not own.issuperset(found.points.names):
            return True
    return False


def _remembered(photographs: Iterable[Photograph], seen: list[Photograph]) -> Iterator[Photograph]:
    for each in photographs:
        seen.append(each)
        yield each


def _frames(photographs: Iterable[Photograph], names: set[str]) -> Iterator[Frame]:
    """Frames of some photographs."""
    for each in photographs:
        if isinstance(each, Frame | Unread) and each.name in names:
            with suppress(ImageError):
                yield each.read() if isinstance(each, Unread) else each


_LEAST_COMMON, _PASSES = 12, 3
"""Points that two photographs have in common, to be compared; passes over all photographs."""


class Way(NamedTuple):
    """A rotation by which a target equals itself."""

    rows: NDArray[np.intp]
    """Point (n,) to which each point is turned."""
    rotation: Array
    """Matrix (2, 2)."""


def ways_to_turn(design: BoardDesign) -> tuple[Way, ...]:
    """Rotations in its plane by which a design equals itself; the first one turns nothing.

    Parameters
    ----------
    design : BoardDesign
        A target; of all but circle grids and chessboards without dots, markers tell which way is up.

    Examples
    --------
    >>> from reseau.designs import board
    >>> [len(ways_to_turn(board(*one))) for one in (
    ...     ("circles", 7, 10, 20.0), ("circles", 9, 9, 20.0), ("chess", 7, 10, 20.0), ("chess", 7, 9, 20.0)
    ... )]
    [2, 4, 1, 2]
    """
    if design.kind not in ("circles", "chess") or design.dots:
        return ()
    xy, found = design.xy - (design.xy.max(axis=0) + design.xy.min(axis=0)) / 2, []
    chess = design.kind == "chess"
    for quarter in range(4):
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        rotation = np.array([[c, -s], [s, c]], dtype=np.float64)
        away, to = scipy.spatial.KDTree(xy).query(xy @ rotation.T)
        if away.max() > 1e-6 * design.pitch:
            continue
        # Dark squares lie one way or the other at a corner of a chessboard; a quarter turn exchanges them.
        dark = design.nodes.sum(axis=1) % 2
        if chess and (dark[to] != (dark + quarter) % 2).any():
            continue
        found.append(Way(to, rotation))
    return tuple(found)


def named_alike(
    measured: Mapping[str, ImagePoints], design: BoardDesign, lenses: Mapping[str, CameraMapping]
) -> dict[str, ImagePoints]:
    """Name the points of all photographs in the same way, by how they deviate from the design.

    In each photograph the directions to the points, through an approximate calibration, are mapped to the
    plane of the design by a homography; what remains are the deviations of the points from the design, of
    which those of one point agree in all photographs.

    Parameters
    ----------
    measured : mapping of str to ImagePoints
        Points of each photograph.
    design : BoardDesign
        A circle grid or chessboard; see :func:`ways_to_turn`.
    lenses : mapping of str to CameraMapping
        The camera of each photograph, approximately calibrated.

    Returns
    -------
    dict of str to ImagePoints
        The same points; names of some photographs are those of the target turned.
    """
    row, ways = {name: k for k, name in enumerate(design.ids)}, ways_to_turn(design)
    seen = {image: _deviations(points, design, row, lenses[image]) for image, points in measured.items()}
    fields = {image: _named(design, ways, *each) for image, each in seen.items() if each is not None}
    # Photographs with most points first: the others are compared with their mean.
    order = sorted(fields, key=lambda image: -len(measured[image].names))
    chosen = dict.fromkeys(order[:1], 0)
    for _ in range(_PASSES):
        for image in order:
            others = [fields[other][k][1] for other, k in chosen.items() if other != image]
            if others:
                mean = _mean(others)
                chosen[image] = int(np.argmin([_misfit(field - mean) for _, field in fields[image]]))
    ids = np.array(design.ids)
    names = {image: ids[fields[image][k][0]].tolist() for image, k in chosen.items()}
    return {
        image: ImagePoints(tuple(names.get(image, points.names)), points.xy, points.cov)
        for image, points in measured.items()
    }


def _deviations(
    points: ImagePoints, design: BoardDesign, row: dict[str, int], lens: CameraMapping
) -> tuple[NDArray[np.intp], Array] | None:
    """Rows of the points, and how they deviate from the design, in its plane; none if that is not known."""
    rows, seen = np.array([row[name] for name in points.names]), lens.mapping.inverse(points.xy)
    if len(rows) < _LEAST_COMMON or not np.isfinite(seen).all():
        return None
    plane = cv2.findHomography(seen, design.xy[rows])[0]
    if plane is None:
        return None
    mapped = np.column_stack([seen, np.ones(len(seen))]) @ plane.T
    return rows, mapped[:, :2] / mapped[:, 2:] - design.xy[rows]


def named_by_others(
    unsure: Mapping[str, ImagePoints], taken: Mapping[str, Taken], design: BoardDesign, result: Result
) -> dict[str, ImagePoints]:
    """Name points by photographs that other cameras of a rig took at once.

    Parameters
    ----------
    unsure : mapping of str to ImagePoints
        Photographs whose names may be shifted.
    taken : mapping of str to Taken
        Camera and exposure of each photograph.
    design : BoardDesign
        The target.
    result : Result
        Adjustment of other photographs of the rig.

    Returns
    -------
    dict of str to ImagePoints
        Those photographs of which others tell which points they show; they are the ways to name them whose
        points lie nearest to where others predict them, by less than half their distance.
    """
    network, values, row = result.network, result.fit.values, {name: k for k, name in enumerate(design.ids)}
    cameras = [camera.id for camera in network.cameras]
    images = [*network.images, *(name for name in unsure if taken[name].camera in cameras)]
    count, exposures = len(network.images), list(dict.fromkeys(taken[name].exposure for name in images))
    rig = Rig(
        np.array([cameras.index(taken[name].camera) for name in images]),
        np.array([exposures.index(taken[name].exposure) for name in images]),
    )
    rotation, x0 = np.full((len(images), 3, 3), np.nan), np.full((len(images), 3), np.nan)
    rotation[:count], x0[:count] = values.rotation, values.x0
    _, rotation, x0 = rig.approximate(rotation, x0)
    at = {name: k for k, name in enumerate(network.points)}
    xyz = np.array([values.xyz[at[name]] if name in at else np.full(3, np.nan) for name in design.ids])
    found = dict[str, ImagePoints]()
    for image in range(count, len(images)):
        points = unsure[images[image]]
        there = (xyz - x0[image]) @ rotation[image].T
        lens = camera_mapping(result, int(rig.camera[image])).mapping
        known = np.isfinite(there).all(axis=1) & (there[:, 2] > 0)
        predicted = np.full((len(xyz), 2), np.nan)
        predicted[known] = lens(there[known, :2] / there[known, 2:])
        rows = np.array([row[name] for name in points.names])
        named = [to for to, _ in _named(design, ways_to_turn(design), rows, np.zeros((len(rows), 2)))]
        off = [float(np.median(np.linalg.norm(predicted[to] - points.xy, axis=1))) for to in named]
        apart = np.median(scipy.spatial.KDTree(points.xy).query(points.xy, k=2)[0][:, 1])
        # A photograph that was not taken with the others is as far from all of them.
        if np.isfinite(off).any() and np.nanmin(off) < apart / 2:
            names = np.array(design.ids)[named[int(np.nanargmin(off))]]
            found[images[image]] = ImagePoints(tuple(names.tolist()), points.xy, points.cov)
    return found


def _named(
    design: BoardDesign, ways: tuple[Way, ...], rows: NDArray[np.intp], deviations: Array
) -> list[tuple[NDArray[np.intp], Array]]:
    """Each way to name the points, the given one first: their rows, and deviations (n, 2) of all points."""
    nodes, found = design.nodes, []
    index = np.full(nodes.max(axis=0) + 1, -1)
    index[tuple(nodes.T)] = np.arange(len(nodes))
    for way in ways:
        turned = nodes[way.rows[rows]]
        low, high = turned.min(axis=0), nodes.max(axis=0) - turned.max(axis=0)
        shifts = np.mgrid[-low[0] : high[0] + 1, -low[1] : high[1] + 1].reshape(2, -1).T
        for shift in sorted(shifts.tolist(), key=lambda each: abs(each[0]) + abs(each[1])):
            to = index[tuple((turned + shift).T)]
            if (to < 0).any() or (design.kind == "chess" and sum(shift) % 2):
                continue
            field = np.full((len(nodes), 2), np.nan)
            field[to] = deviations @ way.rotation.T
            found.append((to, field))
    return found


def _mean(fields: list[Array]) -> Array:
    known = np.isfinite(fields)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, fields, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def _misfit(difference: Array) -> float:
    """Mean square of differences; infinite with too few of them."""
    known = np.isfinite(difference).all(axis=1)
    return float((difference[known] ** 2).mean()) if known.sum() >= _LEAST_COMMON else np.inf
