"""What parameters of a camera that were not estimated could do: consider parameters.

A lens is a series of which a calibration estimates the first terms. Those that were held at zero are not
zero; what the image points, and the terms that are known, leave possible of them is a part of the uncertainty
of what was estimated (Schmidt 1966, *Advances in Control Systems* 3: a filter with parameters that are
considered, but not estimated).

The displacements of the coefficients over the whole image, without what the orientation can do, have the root
mean squares a, in pixels. The radial ones decay, a_j ~ N(0, (s q^j)²), the others (decentring, tilt, prism)
have a size of their own. s, q and that size are as probable as they predict the estimates and the image
points (the evidence; Bishop 2006, *Pattern Recognition and Machine Learning*, sect. 3.5). With the estimates
x̂ of covariance C, which held coefficients θ change by K θ, and with their scores g and information M, the
coefficients have the mean t and the covariance V, and the estimates without them err by

    [−K; I] (V + t tᵀ) [−K; I]ᵀ

about the values that were estimated, and zero.

Where the model was chosen, those of other kinds may be the right ones: model m is as probable as it predicts
the images, and moves the coefficients by δ_m, which describe its mapping best where points were seen. To the
mean squares, Σ P(m) δ_m δ_mᵀ is added (Draper 1995, *J. R. Statist. Soc.* B 57: the variance between models);
what no coefficients describe of m counts in the image, see
:meth:`reseau.calibration.CameraMapping.by_models`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ...calibration.camera import CameraMapping, Rival, by_rotation, places, referred
from ...core.data import Array, Mask, Rows
from ...optics.cameras.registry import CameraModel
from ..solver.problem import BundleFit
from .evidence import Effect, in_camera, scores, too_large, used_rows

_SIZES = np.geomspace(1e-5, 0.1, 11)
"""Root mean square displacements by the first term, in the diagonal of the image; equally probable."""
_DECAY = 2.0 ** -np.arange(5)
"""What a radial term is of the one before it."""
_ACROSS = 15
_RADIAL, _OWN, _NONE = 1e-3, 0.01, 1e-9
"""Part of the square that is not radial in a radial term; part of a displacement that the terms before it do
not have, as each power has a quarter of what the one before has; size that is none, by the largest."""
_PLACES = 400
"""Image points at which models are compared."""


@dataclass(frozen=True, eq=False)
class Considered:
    """Coefficients of a camera that were held at zero, and what is possible of them.

    Parameters
    ----------
    names : tuple of str (q,)
        The coefficients.
    square : ndarray (q, q)
        Their mean squares.
    by : ndarray (u, q)
        What one unit of each changes of the reduced unknowns, where it is held at zero.
    rivals : tuple of Rival
        Models of other kinds, with what they change of the estimated parameters and of the coefficients.
    """

    names: tuple[str, ...]
    square: Array
    by: Array
    rivals: tuple[Rival, ...] = ()

    def errors(self, columns: Rows) -> Array:
        """Mean squares (k + q, k + q) of errors of the estimated parameters, and of the coefficients."""
        turn = np.concatenate([-self.by[columns], np.eye(len(self.names))])
        total = turn @ self.square @ turn.T
        for each in self.rivals:
            assert each.moves is not None
            total += each.probability * np.outer(each.moves, each.moves)
        return np.asarray(total)


def considered(
    fit: BundleFit, c: int, columns: Rows, covariance: Array, rivals: Sequence[Rival] = ()
) -> Considered | None:
    """Consider the coefficients of a camera that were not estimated, and other models.

    Parameters
    ----------
    fit : BundleFit
        The adjustment.
    c : int
        Row of the camera.
    columns : ndarray (k,)
        Columns of its estimated parameters among the reduced unknowns.
    covariance : ndarray (k, k)
        Their covariance.
    rivals : sequence of Rival
        Models of other kinds.

    Returns
    -------
    Considered or None
        None where all coefficients are estimated or known, and where it is too large to be looked at.
    """
    network = fit.problem.network
    camera = network.cameras[c]
    model = camera.registered
    if model is None or not camera.has_plane_mapping or camera.additional or network.refraction is not None:
        return None
    names = model.of_role("distortion")
    held = [
        k for k, name in enumerate(camera.names)
        if name in names and name not in camera.free and camera.values[k] == 0
    ]  # fmt: skip
    if not len(columns) or model.priors(camera.free) or fit.redundancy < 1:
        return None
    if too_large(fit, len(held)):
        return None
    rows = np.array([camera.names.index(name) for name in camera.free], dtype=np.intp)
    mapping = camera.bare_mapping(fit.values.cameras[c, : len(camera.values)])
    lens = CameraMapping(mapping, camera.width, camera.height, rows, covariance)
    at = np.flatnonzero([name in names for name in camera.free])
    own = network.camera_of[network.image_of[used_rows(fit)]] == c
    x, y, z = in_camera(fit)[own].T
    uv = np.column_stack([x, y]) / (1.0 if mapping.parallel else z[:, None])
    found = Considered((), np.zeros((0, 0)), np.zeros((fit.unknowns.size, 0)))
    if held:
        size, radial, kept = _terms(lens, model, np.concatenate([rows[at], held]).astype(np.intp), len(at))
        held = [held[k] for k in kept]
    if held:
        slope = np.zeros((len(own), 2, len(held)))
        slope[own] = np.nan_to_num(mapping.derivatives(uv).d_parameters[:, :, held])
        seen = scores(fit, [Effect(slope, np.where(own, 0, -1), 1)])
        # The noise of the coefficients is that of the estimates, with what the points of an image share.
        formal = fit.cofactors.reduced.block(columns, columns)
        noise = float(np.trace(np.linalg.pinv(formal, hermitian=True) @ covariance)) / len(columns)
        turn = np.concatenate([np.eye(len(at)), seen.carried[columns[at]]], axis=1)
        inverse = np.linalg.pinv(covariance[np.ix_(at, at)], hermitian=True)
        known, side = turn.T @ inverse @ turn, turn.T @ inverse @ np.array(mapping.values)[rows[at]]
        known[len(at) :, len(at) :] += seen.m / noise
        side[len(at) :] += seen.g / noise
        square = _mean_square(known, side, size, radial, float(np.hypot(camera.width, camera.height)))
        names = tuple(camera.names[k] for k in held)
        found = Considered(names, square[len(at) :, len(at) :], seen.carried)
    if not rivals:
        return found if held else None
    possible = found.errors(columns)
    possible[: len(columns), : len(columns)] += covariance
    some = uv[:: max(1, len(uv) // _PLACES)]
    order = np.concatenate([rows, held]).astype(np.intp)
    return replace(found, rivals=tuple(_described(each, lens, order, some, possible) for each in rivals))


def _described(rival: Rival, lens: CameraMapping, order: Rows, uv: Array, possible: Array) -> Rival:
    """A model of another kind, with the changes of parameters in this order that describe it best.

    These are the most probable ones beside what is possible of the parameters, so that those which do the
    same are not played off against each other; what none describes is as noise.
    """
    seen = lens.mapping.derivatives(uv)
    off = rival.lens.mapping(uv) - seen.value
    at = np.isfinite(off).all(axis=1)
    moved, rotation = np.zeros(len(order)), np.zeros(3)
    if at.any():
        turn = (seen.d_xy @ by_rotation(uv, lens.mapping.parallel))[at]
        slope = seen.d_parameters[at][:, :, order]
        both = referred(turn, np.concatenate([slope, off[at, :, None]], axis=2)).reshape(2 * len(turn), -1)
        by, left = both[:, :-1], both[:, -1]
        # (Jᵀ J w + C⁻¹)⁻¹ Jᵀ w, with the root of C, which may be singular.
        values, vectors = np.linalg.eigh(possible)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        half = by @ root
        rest = left - half @ np.linalg.lstsq(half, left, rcond=None)[0]
        weight = max(len(left) - len(root), 1) / max(float(rest @ rest), _NONE**2)
        moved = root @ np.linalg.solve(np.eye(len(root)) + weight * half.T @ half, weight * half.T @ left)
        whole = (off[at] - slope @ moved).ravel()
        rotation = np.linalg.lstsq(turn.reshape(-1, 3), whole, rcond=None)[0]
    return replace(rival, moves=moved, rotation=rotation)


def _terms(lens: CameraMapping, model: CameraModel, order: Rows, free: int) -> tuple[Array, Mask, list[int]]:
    """Displacements over the image by coefficients in this order, of which the first ones are free.

    Returns their root mean squares (q,), px, which are radial, and which of the others are terms of their
    own: denominators of rational models write the powers before them in another way.
    """
    xy, _ = places(lens, _ACROSS, None)
    uv = lens.mapping.inverse(xy)
    uv = uv[np.isfinite(uv).all(axis=1)]
    seen, names = lens.mapping.derivatives(uv), lens.mapping.names
    plain = [names.index(name) for name in model.of_role("scale", "centre")]
    turn = seen.d_xy @ by_rotation(uv, lens.mapping.parallel)
    oriented = np.concatenate([seen.d_parameters[:, :, plain], turn], axis=2)
    slope = seen.d_parameters[:, :, order]
    across = np.column_stack([-uv[:, 1], uv[:, 0]]) / np.maximum(np.hypot(*uv.T), _NONE)[:, None]
    moved = np.linalg.solve(seen.d_xy, slope)
    beside = (np.einsum("gi,gik->gk", across, moved) ** 2).sum(axis=0)
    radial = beside < _RADIAL * (moved**2).sum(axis=(0, 1))
    flat = referred(oriented, slope).reshape(2 * len(uv), -1) / np.sqrt(max(len(uv), 1))
    size = np.linalg.norm(flat, axis=0)
    # Radial terms first: what others have of them is theirs.
    place = np.argsort(~radial, kind="stable")
    own = np.abs(np.diag(np.linalg.qr(flat[:, place], mode="r"))) > _OWN * size[place]
    place = np.sort(place[own | (place < free)])
    return size[place], radial[place], (place[place >= free] - free).tolist()


def _mean_square(known: Array, side: Array, sizes: Array, radial: Mask, diagonal: float) -> Array:
    """Mean squares of coefficients with this information, whatever the sizes of the terms (q, q)."""
    level = np.cumsum(radial) - 1
    decays = _DECAY if radial.sum() > 1 else _DECAY[:1]
    first = _SIZES if radial.any() else _SIZES[:1]
    others = _SIZES[:1] if radial.all() else _SIZES
    every = np.array(list(product(first, decays, others)))
    sigma = diagonal * np.where(radial, every[:, :1] * every[:, 1:2] ** level, every[:, 2:])
    total = known + np.eye(len(sizes)) * ((sizes / sigma) ** 2)[:, None, :]
    size = 1 / np.sqrt(np.einsum("hpp->hp", total))
    values, vectors = np.linalg.eigh(total * size[:, :, None] * size[:, None, :])
    values = np.maximum(values, _NONE**1.5 * values[:, -1:])
    half = size[:, :, None] * vectors / np.sqrt(values)[:, None, :]
    along = np.einsum("hpk,p->hk", half, side)
    log = 0.5 * (along**2).sum(axis=1) - np.log(sigma).sum(axis=1)
    log += np.log(size).sum(axis=1) - 0.5 * np.log(values).sum(axis=1)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = np.einsum("hpk,hk->hp", half, along)
    return np.asarray(
        np.einsum("h,hpk,hqk->pq", weight, half, half) + np.einsum("h,hp,hq->pq", weight, mean, mean)
    )
