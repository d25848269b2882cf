"""Calibrations as fields over the image: how two differ, and what a run may change by its errors alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special

from ..calibration import Calibration, CameraMapping, calibration_difference
from ..core.data import Array
from ..core.errors import UsageError

_PLACES, _FEW = 17, 7
_RANK = 1e-6


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of two calibrations over image and object space.

    Parameters
    ----------
    greatest, sigma : float
        Largest difference, and the largest standard deviation of the difference.
    unit : str
        Their unit.
    by_distance : float or None
        Largest difference of directions (rad) of a camera.
    p : float
        Probability of a difference at least as large between calibrations of the same instrument.

    Examples
    --------
    >>> Difference(0.02, 0.01, "px", 1e-5, 0.4).greatest
    0.02
    """

    greatest: float
    sigma: float
    unit: str
    by_distance: float | None
    p: float


@dataclass(frozen=True, eq=False)
class Change:
    """Difference of a calibration from a reference, at the same places of every calibration of an instrument.

    Parameters
    ----------
    off : ndarray (m, 2)
        Differences; NaN where a place is not imaged by both.
    root : ndarray (m, 2, k)
        A root of the covariance of the calibration alone.
    unit : str
        Unit of both.
    """

    off: Array
    root: Array
    unit: str


def difference(new: Calibration, old: Calibration) -> Difference:
    """Compare two calibrations of one instrument as fields, with the covariances of both.

    Calibrations of a camera may be of different models, and are compared after the rotation that brings their
    rays together. Of an oscilloscope or a film frame the corrected positions are compared.

    Raises
    ------
    UsageError
        If they are of different kinds, image sizes or units, or have no common field.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> found = difference(example_calibration(8.001), example_calibration(8.0))
    >>> round(found.greatest, 3), found.unit
    (0.05, 'px')
    """
    _same_kind(new, old)
    if new.kind == "camera":
        return _of_cameras(CameraMapping.from_calibration(new), CameraMapping.from_calibration(old))
    return _of_positions(new, old)


def _same_kind(new: Calibration, old: Calibration) -> None:
    """Refuse calibrations without a common field."""
    if new.kind != old.kind:
        raise UsageError(f"is of the kind {new.kind}, {old.name} of {old.kind}", where=new.name)
    if new.kind == "sensor":
        raise UsageError("has no field of positions to compare", where=new.name)


def _of_cameras(new: CameraMapping, old: CameraMapping) -> Difference:
    found = calibration_difference(old, new, _PLACES)
    off = found.difference.reshape(-1, 2)
    _, slope, _ = old.derivatives(found.xy.reshape(-1, 2))
    return Difference(
        greatest=float(np.nanmax(np.hypot(*off.T))),
        sigma=float(np.nanmax(found.sigma)),
        unit="px",
        by_distance=float(np.nanmax(np.linalg.norm(np.einsum("nij,nj->ni", slope, off), axis=1))),
        p=found.p,
    )


@dataclass(frozen=True, eq=False)
class _Positions:
    """Differences (m, 2) of corrected positions, and the roots (m, 2, k) of both."""

    off: Array
    roots: tuple[Array, Array]
    unit: str


def _positions(new: Calibration, old: Calibration, places: int, common: bool) -> _Positions:
    """Differences of corrected positions over what both cover, or at the places of the old one."""
    first, second = old.mapping(), new.mapping()
    if first.unit != second.unit or first.size != second.size:
        raise UsageError(
            f"maps images of {second.size} px to {second.unit}, {old.name} {first.size} px to {first.unit}",
            where=new.name,
        )
    extents = np.array([each.validity.get("extent", [np.nan] * 4) for each in (old, new)], dtype=np.float64)
    low, high = extents[:, :2].max(axis=0), extents[:, 2:].min(axis=0)
    if not common:
        low, high = extents[0, :2], extents[0, 2:]
    if not (high > low).all():
        raise UsageError(f"covers no part of the image that {old.name} covers", where=new.name)
    grid = np.meshgrid(np.linspace(low[0], high[0], places), np.linspace(low[1], high[1], places))
    xy = np.stack(grid, axis=-1).reshape(-1, 2)
    (a, _, by_a), (b, _, by_b) = first.derivatives(xy), second.derivatives(xy)
    if not (np.isfinite(a) & np.isfinite(b)).all(axis=1).any():
        raise UsageError(f"maps no position that {old.name} maps", where=new.name)
    roots = by_a @ _root(first.parameter_covariance), by_b @ _root(second.parameter_covariance)
    return _Positions(b - a, roots, first.unit)


def _of_positions(new: Calibration, old: Calibration) -> Difference:
    found = _positions(new, old, _PLACES, common=True)
    known = np.isfinite(found.off).all(axis=1)
    off, root = found.off[known], np.concatenate(found.roots, axis=2)[known]
    cov = root @ np.swapaxes(root, 1, 2)
    u, s, _ = np.linalg.svd(root.reshape(2 * len(root), -1), full_matrices=False)
    keep = s > _RANK * s[0]
    statistic = float((((u.T @ off.ravel())[keep] / s[keep]) ** 2).sum())
    return Difference(
        greatest=float(np.hypot(*off.T).max()),
        sigma=float(np.sqrt(np.linalg.eigvalsh(cov)[:, -1].max())),
        unit=found.unit,
        by_distance=None,
        p=float(scipy.special.chdtrc(int(keep.sum()), statistic)),
    )


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    found: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return found


def change(new: Calibration, reference: Calibration) -> Change:
    """Return the difference of a calibration from a reference, with the errors of the calibration alone.

    Raises
    ------
    UsageError
        As :func:`difference`.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> change(example_calibration(8.001), example_calibration(8.0)).off.shape
    (49, 2)
    """
    _same_kind(new, reference)
    if new.kind == "camera":
        first, second = (CameraMapping.from_calibration(each) for each in (reference, new))
        off = calibration_difference(first, second, _FEW, _FEW).difference.reshape(-1, 2)
        root = calibration_difference(second, second, _FEW, _FEW).root
        assert root is not None
        return Change(off, root / np.sqrt(2), "px")
    found = _positions(new, reference, _FEW, common=False)
    return Change(found.off, found.roots[1], found.unit)
