"""Names of the unknowns that the observations do not determine."""

from __future__ import annotations

import numpy as np

from ...adjust.engine import AdjustmentFailure, sparse_basis
from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure
from ...optics.refraction import RefractedRays
from ...optics.refraction.windows import Refraction
from ..network.network import Network
from .arrow import full
from .datum import Freedom, held_for, similarity_changes
from .direct import formed
from .linear import Linear, linearised
from .system import System
from .values import Values

# What is wrong where nothing else gives the scale of a network.
SCALE_OF_WINDOWS = (
    "only the dimensions of the windows determine the scale, too weakly; give a distance or control points"
)
# Effect of a parameter on all image coordinates, in their standard deviations, that is rounding.
_IDLE = 1e-5
# Eigenvalues of the scaled normal equations below this count as zero.
_ZERO = 1e-11
# Smallest eigenvalue of the scaled normal equations of a point with parallel rays: they intersect at less
# than 3e-5 rad.
PARALLEL = 1e-9
_LISTED = 8
# Effect of an axis on all orientations, relative to the extent of the network, that is rounding.
_IDLE_AXIS = 1e-10
# Indices that differ by less are equal: no ray is bent by 1e-9 rad.
_SAME = 1e-9
# A point with this many times the median uncertainty is poorly determined.
_POOR = 50.0
# A point is seen from one place where the centres of its images are no farther apart than the first part of
# its distance, and determine this no better than to the second part of it.
_ONE_PLACE, _NOWHERE = 1e-4, 0.05
# Greatest part of a change of the projection centres that is left by a similarity which explains it.
_LIKE = 0.05
# Largest uncertainty of a datum point from its own rays, relative to the median of all points.
_UNSTEADY = 5.0


def undetermined(linear: Linear, freedom: Freedom, costs: tuple[float, ...]) -> Failure:
    """Return a failure that names the undetermined points, or combinations of the other unknowns.

    Parameters
    ----------
    linear : Linear
        The linear problem at the estimates.
    freedom : Freedom
        Similarity transformations that the datum determines.
    costs : tuple of float
        vᵀPv after each iteration.
    """
    weak = [linear.system.unknowns.network.points[j] for j in weak_points(linear)]
    if weak:
        listed = ", ".join(weak[:_LISTED]) + (" …" if len(weak) > _LISTED else "")
        return AdjustmentFailure(
            f"the rays do not determine the point{'s' * (len(weak) > 1)} {listed}",
            Code.NOT_IDENTIFIED,
            costs=costs,
        )
    constrained = linear.system.constraints is not None
    vectors = _null_vectors(linear, freedom)
    bent = linear.system.unknowns.network.refraction is not None and not constrained
    if bent and len(vectors) == 1 and _is_scale(linear, vectors[0]):
        reason = f"rank defect 1: {SCALE_OF_WINDOWS}"
        return AdjustmentFailure(reason, Code.RANK_DEFECT, costs=costs, null_space=tuple(vectors))
    if not vectors:
        return AdjustmentFailure("the normal equations are numerically singular", Code.SINGULAR, costs=costs)
    listed = "; ".join(_said(linear.system.unknowns.network.refraction, list(vector)) for vector in vectors)
    reason = f"rank defect {len(vectors)}: {listed}"
    return AdjustmentFailure(reason, Code.RANK_DEFECT, costs=costs, null_space=tuple(vectors))


def _said(bent: Refraction | None, names: list[str]) -> str:
    """Say what a combination of unknowns that is not determined means, with windows and media first."""
    own = [name for name in names if bent is not None and name in bent.names]
    if bent is None or not own:
        return f"the observations do not determine {' with '.join(list(dict.fromkeys(names))[:_LISTED])}"
    others = [name for name in names if name not in own]
    rest = f" (with {', '.join(others[:_LISTED])}{' …' if len(others) > _LISTED else ''})" if others else ""
    indices = [medium.name for medium in bent.media if medium.label in own]
    if len(indices) == len(own) > 1 and not others:
        return (
            f"rays depend on the ratios of the indices of {_and(indices)} only, not on their size; "
            "hold one of them"
        )
    parts = [f"the {quantity} of window {window}" for quantity, window in _of_windows(bent, own)]
    parts += [f"the index of {name}" for name in indices]
    if len(own) == 1 and not others:
        return f"images from one side do not determine {parts[0]}; hold it, or give it a sigma"
    return (
        f"images from one side do not determine {_and(parts)}: changed together{rest}, they leave every "
        "image coordinate as it is; hold one of them, or give it a sigma"
    )


def _of_windows(bent: Refraction, names: list[str]) -> list[tuple[str, str]]:
    """Quantities with the names of their windows, in the order of the windows."""
    return [
        (quantity, window.name)
        for window in bent.windows
        for quantity, label in zip(window.names, window.labels, strict=True)
        if label in names
    ]


def _and(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def why_without_effect(bent: Refraction, values: Array, names: list[str]) -> str:
    """Say of parameters of windows on which no ray depends (:func:`without_effect`) why that is so.

    Parameters
    ----------
    bent : Refraction
        Windows and media of the network.
    values : ndarray (u,)
        Their parameters.
    names : list of str
        Parameters without effect.
    """
    index = dict(zip(bent.names, values.tolist(), strict=True))
    reasons = []
    for quantity, name in _of_windows(bent, names):
        window = next(each for each in bent.windows if each.name == name)
        along = [index[f"index of {medium}"] for medium in window.media]
        if quantity == "thickness" and abs(along[1] - along[2]) < _SAME:
            one, two = window.media[1:]
            reasons.append(
                f"{one} and {two} have the same index, so that the second surface of window {name} does not "
                "refract"
            )
        elif quantity == "thickness" and abs(along[0] - along[1]) < _SAME:
            reasons.append(
                f"{window.media[0]} and {window.media[1]} have the same index, so that the first surface of "
                f"window {name} does not refract"
            )
        elif window.shape == "plane" and abs(along[0] - along[-1]) < _SAME:
            reasons.append(
                f"window {name} has {_and(sorted({window.media[0], window.media[-1]}))} on both sides, where "
                "rays are parallel: images from one side do not determine where along them it stands"
            )
    return "".join(f"; {reason}" for reason in dict.fromkeys(reasons))


def _is_scale(linear: Linear, vector: dict[str, float]) -> bool:
    """Whether a change of the reduced unknowns is one of the scale of object space, with any other datum."""
    unknowns, values = linear.system.unknowns, linear.values
    row = {name: k for k, name in enumerate(unknowns.names)}
    change = np.zeros(unknowns.size)
    change[[row[name] for name in vector]] = list(vector.values())
    moves = similarity_changes(linear.system, values)
    # Centres of projection only: all other changes follow from these.
    at = np.concatenate([unknowns.pose[unknowns.pose >= 0][:, None] + np.arange(3, 6)]).ravel()
    part, moves = change[at], moves[at]
    fitted = moves @ np.linalg.lstsq(moves, part, rcond=None)[0]
    without = moves[:, :6] @ np.linalg.lstsq(moves[:, :6], part, rcond=None)[0]
    size = float(np.linalg.norm(part))
    return bool(np.linalg.norm(part - fitted) < _LIKE * size < np.linalg.norm(part - without))


def weak_points(linear: Linear) -> Rows:
    """Return the points with singular normal equations: all rays lie on one line."""
    v = _own_normals(linear)
    size = np.sqrt(np.diagonal(v, axis1=1, axis2=2))
    known = (size > 0).all(axis=1) & linear.system.unknowns.by_rays
    scaled = v / np.where(known[:, None, None], size[:, :, None] * size[:, None, :], 1.0)
    least = np.linalg.eigvalsh(scaled[known])[:, 0]
    return np.asarray(np.flatnonzero(known)[least < PARALLEL], dtype=np.intp)


def weak_images(linear: Linear) -> Rows:
    """Return the images with singular normal equations: their points do not determine the pose.

    An example are three points on one line. All points and cameras are held.
    """
    system, unknowns = linear.system, linear.system.unknowns
    if system.constraints is not None:
        return np.zeros(0, dtype=np.intp)
    j = linear.rows[:, :, :6]
    normal = np.zeros((len(unknowns.pose), 6, 6))
    np.add.at(normal, system.seen.image, np.swapaxes(j, 1, 2) @ j)
    # The distance of parallel rays is held.
    normal[unknowns.network.parallel, 5, 5] = 1.0
    images = np.flatnonzero(unknowns.pose >= 0)
    size = np.sqrt(np.diagonal(normal[images], axis1=1, axis2=2))
    known = (size > 0).all(axis=1)
    scaled = normal[images[known]] / (size[known][:, :, None] * size[known][:, None, :])
    weak = np.ones(len(images), dtype=bool)
    weak[known] = np.linalg.eigvalsh(scaled)[:, 0] < _ZERO
    return np.asarray(images[weak], dtype=np.intp)


def without_effect(linear: Linear) -> list[str]:
    """Return the parameters of windows and media on which, but for rounding, no ray depends.

    An example is the distance of a plate in one medium. A scaled matrix would not show it.
    """
    system = linear.system
    unknowns, bent = system.unknowns, system.unknowns.network.refraction
    if bent is None or unknowns.refraction < 0:
        return []
    count = len(unknowns.refracting)
    at = unknowns.width - 3 - unknowns.extra_width - unknowns.bent_width
    effect = np.sqrt((linear.rows[:, :, at : at + count] ** 2).sum(axis=(0, 1)))
    # A change by the size of the network, of a length; by one, of a tilt or an index.
    size = float(np.abs(linear.values.xyz - linear.values.xyz.mean(axis=0)).max())
    names = [bent.names[row] for row in unknowns.refracting]
    change = np.array([size if bent.unit_of(name, "m") == "m" else 1.0 for name in names])
    observed = np.isin(unknowns.refracting, system.others.refraction)
    idle = ~observed & (effect * change < _IDLE)
    return [name for name, none in zip(names, idle, strict=True) if none]


def missing_windows(network: Network, values: Values, observations: Mask) -> Rows:
    """Return the image points, of those given (n,), without a ray through the windows of their image."""
    bent = network.refraction
    if bent is None:
        return np.zeros(0, dtype=np.intp)
    rows = np.flatnonzero(observations & (bent.path_of[network.image_of] >= 0))
    estimates = values.refraction
    if values.rig is not None:
        bent = bent.with_values(estimates).on_cameras(network.camera_of, *values.rig)
        estimates = bent.values
    rays = RefractedRays.of(
        bent.columns(estimates), bent.path_of, values.rotation, values.x0, values.xyz,
        network.image_of[rows], network.point_of[rows],
    )  # fmt: skip
    return rows[~rays.reached].astype(np.intp)


def steady_points(linear: Linear, chosen: Mask) -> Mask:
    """Return which of the chosen points (p,) are determined well enough for the datum.

    Inner constraints over a poorly determined point make all others as uncertain as this point. Its
    uncertainty with all images held does not depend on the datum.

    Parameters
    ----------
    linear : Linear
        The linear problem at the estimates.
    chosen : ndarray of bool (p,)
        Points that are determined.
    """
    return chosen & ~_unsteady(linear, chosen, _UNSTEADY)


def poorly_determined_points(linear: Linear) -> Rows:
    """Return the points with nearly parallel rays that can prevent convergence."""
    every = np.ones(len(linear.prior), dtype=bool)
    return np.asarray(np.flatnonzero(_unsteady(linear, every, _POOR)), dtype=np.intp)


def points_from_one_place(system: System, values: Values) -> Rows:
    """Return the points of which all images were taken from practically the same place.

    Their distances follow from the errors of the projection centres alone. They contribute nothing, but each
    change of the projection centres moves them, so that the iteration creeps along a curved valley.

    Parameters
    ----------
    system : System
        The observations.
    values : Values
        Approximate values.
    """
    seen, first = system.seen, system.unknowns.first
    rays, images = np.diff(first), len(values.x0)
    lit = np.flatnonzero(rays)
    with np.errstate(invalid="ignore", divide="ignore"):
        near = 1.0 / np.linalg.norm(values.xyz[seen.point] - values.x0[seen.image], axis=1)
        # Harmonic means: approximate values of some points may lie far away.
        distance = np.bincount(seen.image, minlength=images) / np.bincount(seen.image, near, images)
    base = np.linalg.norm(values.x0[seen.image] - values.x0[seen.image[first[seen.point]]], axis=1)
    # The centre of a parallel projection says nothing about distances.
    base[system.unknowns.network.parallel[seen.image]] = np.inf
    wide = np.full(len(rays), np.inf)
    wide[lit] = np.maximum.reduceat(base / distance[seen.image], first[lit])
    points = np.flatnonzero((wide < _ONE_PLACE) & (rays > 1) & system.unknowns.by_rays)
    if not len(points):
        return points
    least = _least_information(linearised(system, values), points)
    known: Mask = least * (_NOWHERE * distance[seen.image[first[points]]]) ** 2 > 1.0
    return points[~known]


def _unsteady(linear: Linear, chosen: Mask, times: float) -> Mask:
    """Points (p,) above a multiple of the median uncertainty of the chosen ones, with images held."""
    movable = (linear.system.movable > 0).any(axis=1)
    rows = np.flatnonzero(chosen & movable & linear.system.unknowns.by_rays)
    size = np.zeros(len(chosen))
    size[rows] = 1.0 / np.sqrt(np.maximum(_least_information(linear, rows), np.finfo(float).tiny))
    median = float(np.median(size[rows])) if len(rows) else 0.0
    return np.asarray(size > times * median) if median > 0 else np.zeros(len(chosen), dtype=bool)


def _least_information(linear: Linear, points: Rows) -> Array:
    """Smallest eigenvalues of the normal equations of these points, each with all images held."""
    v = _own_normals(linear)[points]
    # Held coordinates have no uncertainty: they must not count as undetermined.
    largest = np.diagonal(v, axis1=1, axis2=2).max(axis=1)
    j, axis = np.nonzero(linear.system.movable[points] == 0)
    v[j, axis, axis] = largest[j]
    return np.asarray(np.linalg.eigvalsh(v)[:, 0])


def _own_normals(linear: Linear) -> Array:
    """Normal equations (p, 3, 3) of each point with all images held."""
    system = linear.system
    last = linear.rows.shape[2] - 3
    b = linear.rows[:, :, last:]
    v = np.zeros((len(linear.prior), 3, 3))
    rays = np.diff(system.unknowns.first)
    lit = np.flatnonzero(rays)
    if len(lit):
        v[lit] = np.add.reduceat(np.swapaxes(b, 1, 2) @ b, system.unknowns.first[lit])
    v[:, np.arange(3), np.arange(3)] += linear.prior[:, :, 0]
    return v


def _null_vectors(linear: Linear, freedom: Freedom) -> list[dict[str, float]]:
    """Basis of the null space of the reduced normal equations, with as many zeros as possible."""
    system = linear.system
    normal = formed(linear, 0.0, turned=False)
    if system.constraints is not None:
        constraints, free = system.constraints, normal.constrained()
        held = constraints.held(system.held)
        held[system.fixed] = True
        if freedom.defect:
            slopes, own = linear.constraint_slopes, np.diag(free.matrix)
            held[constraints.held_for(freedom.reduced, free.back, slopes, own)] = True
        s, names = normal.constrained(held).matrix, constraints.names(system.unknowns)
        diagonal = np.diag(s).copy()
    else:
        held, names = system.held.copy(), system.unknowns.names
        held[held_for(freedom, system.unknowns, normal.sums.diagonal)] = True
        diagonal = normal.sums.diagonal
        normal.hold(held)
        s = full(normal.sums.band, normal.sums.border)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = s * scale[:, None] * scale
    values, vectors = np.linalg.eigh(scaled)
    null = sparse_basis(vectors[:, values < _ZERO * max(values[-1], 1.0)])
    named = []
    for vector in null.T:
        strong = np.flatnonzero(np.abs(vector) > 1e-3)
        strong = strong[np.argsort(-np.abs(vector[strong]))]
        named.append({names[i]: float(vector[i] * scale[i]) for i in strong})
    return named


def axis_without_effect(linear: Linear) -> list[str]:
    """Return what the orientations of all images, and its observations, leave open of the axis of a stage.

    An example is one reading for each pose: any axis gives any orientation then.
    """
    constraints = linear.system.constraints
    if constraints is None or constraints.stage is None:
        return []
    own = constraints.stage
    rows = np.concatenate([linear.transformation, linear.constraint_slopes])[:, len(own.others) :]
    size = np.linalg.norm(rows, axis=0)
    far = float(
        np.linalg.norm(linear.values.x0[own.frames.image] - linear.values.x0.mean(axis=0), axis=1).max()
    )
    # Of a turn by 360 degrees there remain roundings.
    rows = np.where(size > _IDLE_AXIS * max(far, 1.0), rows / np.where(size > 0, size, 1.0), 0.0)
    values, vectors = np.linalg.eigh(rows.T @ rows)
    names = np.array(constraints.names(linear.system.unknowns)[len(own.others) :])
    open_ = list[str]()
    for vector in vectors[:, values < _ZERO * len(values)].T:
        strong = np.abs(vector) > 1e-3
        of_axis = [str(name) for name in names[strong] if name.endswith("of the axis")]
        open_.append(of_axis[0] if of_axis else str(names[int(np.argmax(np.abs(vector)))]))
    return open_
