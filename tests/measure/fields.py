"""Recordings of the simulated testfield, and the Cramér–Rao bound of the targets in them."""

from __future__ import annotations

import numpy as np

from reseau.core.data import Array, Mask
from reseau.optics.formation import coverage_derivatives
from reseau.optics.targets import target_outline
from reseau_sims.testfield import FieldBench, Station

__all__ = ["bounds"]

_HALF = {False: 8, True: 11}
"""Half sides of the windows of small and large targets: all that is theirs lies within."""


def bounds(bench: FieldBench, station: Station, at: Mask, *, growth: bool = True) -> Array:
    """Cramér–Rao bounds of the positions of targets, covariances (n, 2, 2), NaN where not asked for.

    The Fisher information of position, width of the point-spread function, contrast, level and slopes of the
    background, and size, all unknown, under all noise that was simulated: of reading, of the rounding, and
    the row jitter, which is common to the pixels of a row. What else stands near is taken as known.

    Parameters
    ----------
    at : ndarray of bool (n,)
        Targets wanted.
    growth : bool
        Whether the size counts as unknown.
    """
    truth, targets = bench.truth(station), bench.design.targets
    cov = np.full((len(at), 2, 2), np.nan)
    kinds: dict[tuple[str, float, float], list[int]] = {}
    for k in np.flatnonzero(at):
        kinds.setdefault((targets.shape[k], targets.size[k], targets.angle[k]), []).append(int(k))
    for kind, rows in kinds.items():
        cov[rows] = _bounds(bench, truth.view, np.array(rows), kind, growth)
    return cov


def _bounds(
    bench: FieldBench, view: object, rows: Array, kind: tuple[str, float, float], growth: bool
) -> Array:
    assert callable(view)
    shape = target_outline(*kind, 0.5 * bench.psf_px * 1.2)
    centre_mm = bench.design.xy[rows]
    nodes = shape.affine(np.tile(np.eye(2), (len(rows), 1, 1)), centre_mm)
    image, centre = nodes.mapped(view).oriented(), view(centre_mm)[0]
    half = _HALF[bool(bench.design.large[rows[0]])]
    offset = np.arange(-half, half + 1.0)
    middle = np.rint(centre)
    share, slopes = coverage_derivatives(
        image,
        middle[:, :1] + offset,
        middle[:, 1:] + offset,
        bench.psf_px,
        bench.response,
        (image.xy - centre[:, None])[:, None] if growth else None,
    )
    u, v = np.meshgrid(offset / half, offset / half)
    planes = np.stack([np.ones_like(u), u, v])
    rest = 1 - bench.contrast * share
    jacobian = np.concatenate(
        [-bench.level * bench.contrast * slopes, -bench.level * share[:, None], rest[:, None] * planes],
        axis=1,
    )
    variance = bench.sensor.read_noise**2 + (1 / 12 if bench.sensor.quantise else 0.0)
    normal = np.einsum("kurc,kvrc->kuv", jacobian, jacobian) / variance
    if bench.sensor.row_jitter_px:
        # (D + s² g gᵀ)⁻¹ = D⁻¹ − D⁻¹g gᵀD⁻¹ s²/(1 + s² gᵀD⁻¹g), row by row.
        jitter2, slope = bench.sensor.row_jitter_px**2, jacobian[:, 0]
        along = np.einsum("kurc,krc->kur", jacobian, slope) / variance
        gain = jitter2 / (1 + jitter2 * (slope**2).sum(axis=2) / variance)
        normal -= np.einsum("kur,kr,kvr->kuv", along, gain, along)
    return np.linalg.inv(normal)[:, :2, :2]
