"""Causes of a failed or doubtful adjustment that a network shows before it is adjusted.

Values in another unit are recognised by what cameras can be: the angle of view, the size of the sensor, the
place of the principal point. Geometry that cannot determine the unknowns is recognised by the directions of
the rays alone, without an adjustment that would not converge.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Remark
from ..network.camera import Camera
from ..network.network import Network, finite
from ..solver.spatial import directions
from .checks import listed
from .evidence import ODDS

# Half the diagonal of the image in the principal distance: tangents of half angles of view of real cameras.
_NARROWEST, _WIDEST = 6e-4, 12.0
# Diagonals of sensors and scanned films (mm).
_SENSORS = (0.5, 600.0)
# Distance of the principal point from the middle, in half the diagonal; displacement in a corner by the given
# distortion, in the radius.
_OFF_CENTRE, _DISTORTED = 0.75, 0.8
# Coordinates this far outside, in the size of the image, are outside.
_OUTSIDE = 0.01
# Extent of all coordinates, in the size of the image, below which they have another unit.
_TINY = 0.02
# Part of the coordinates that are negative where they are from the middle of the image.
_FROM_MIDDLE = 0.2
# Points are on a line, or in a plane, to this part of their extent.
_FLAT = 1e-3
# Half angle of view below which shifts and rotations during the read-out have the same effect.
_NARROW_DEG = 15.0
# Factors between units of projection centres and of points. The distance from the points is that from the
# angles between their rays to the first factor if the unit is right, and far from it by the second if it is
# not, in the median of this many images.
_UNITS, _RIGHT_UNIT, _WRONG_UNIT, _STATIONS = (1e3, 1e-3), 1.7, 8.0, 3
# Angle (rad) between the optical axes and the normal of a plane that is seen frontally.
_FRONTAL = 0.03


def causes(network: Network) -> list[Remark]:
    """Return what is implausible in a network, or cannot determine the unknowns.

    Parameters
    ----------
    network : Network
        The network, before its adjustment.

    Returns
    -------
    list of Remark
        Empty where nothing was found.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from reseau.bundle import example_network
    >>> network = example_network()
    >>> causes(network)
    []
    >>> camera = replace(network.cameras[0], values=network.cameras[0].values * [1e-3] + [0.0])
    >>> str(causes(replace(network, cameras=(camera,)))[0])[:52]
    'camera: the principal distance of 0.008 mm is too sh'
    """
    found = [remark for camera in network.cameras for remark in _camera(camera)]
    found += _outside(network)
    found += _rotations(network)
    if found:
        # Directions follow from these values.
        return found
    uv = directions(network)
    return [
        *_copies(network), *_stations(network, uv), *_lines(network, uv), *_control_on_a_line(network)
    ]  # fmt: skip


def _camera(camera: Camera) -> list[Remark]:
    """Implausible values of a camera."""
    model = camera.registered
    if model is None:
        return []
    values = camera.parameters
    half = np.hypot(camera.width, camera.height) / 2
    # A magnification is not limited by an angle of view.
    scale = [name for name in model.of_role("scale") if values[name] > 0 and not camera.parallel]
    found: list[str] = []
    if model.needs_pitch:
        pitch = float(np.mean(camera.pitch_mm))
        diagonal = 2 * half * pitch
        views = {name: half * pitch / values[name] for name in scale}
        if not camera.in_pixels and not _SENSORS[0] <= diagonal <= _SENSORS[1]:
            unit = "micrometres" if diagonal > _SENSORS[1] else "metres"
            factor = 1e-3 if unit == "micrometres" else 1e3
            guess = f"; is it given in {unit}?" if _within(diagonal * factor, _SENSORS) else ""
            found.append(
                f"a pixel size of {pitch:g} mm makes a sensor of {diagonal:.4g} mm across, which is not "
                f"plausible{guess}"
            )
            views = {}
    else:
        pitch, views = 0.0, {name: half / values[name] for name in scale}
    reported, with_size = set[float](), model.needs_pitch and not camera.in_pixels
    for name, view in views.items():
        if _within(view, (_NARROWEST, _WIDEST)) or values[name] in reported:
            continue
        reported.add(values[name])
        unit = camera.unit_of(name)
        size = f"{values[name]:g} {unit}"
        across = f"{2 * half * pitch:.3g} mm" if with_size else f"{2 * half:.0f} px"
        side = "too short" if view > _WIDEST else "too long"
        tries = {"metres": 1e3, "micrometres": 1e-3, "pixels": pitch} if with_size else {}
        fits = [other for other, f in tries.items() if f and _within(view / f, (_NARROWEST, _WIDEST))]
        # Of several units the one that gives the most usual angle of view.
        fits.sort(key=lambda other: abs(np.log(view / tries[other] / 0.5)))
        guess = f"; is it given in {fits[0]}?" if fits else "" if with_size else "; give it in pixels"
        what = "focal length" if unit == "px" else "principal distance"
        found.append(f"the {what} of {size} is {side} for an image of {across}{guess}")
    named = {name: name for name in model.of_role("centre")}
    if len(named) == 2 and not found:
        here = camera.bare_mapping(distorted=False)(np.zeros((1, 2)))[0]
        off = float(np.hypot(*(here - camera.grid.centre))) / half
        if off > _OFF_CENTRE:
            at = ", ".join(f"{name} {values[name]:g} {camera.unit_of(name)}" for name in named)
            guess = "; is it given in pixels?" if with_size else ""
            found.append(
                f"the principal point ({at}) is {off * half:.0f} px from the middle of the image{guess}"
            )
    if not found and any(values[name] for name in model.of_role("distortion")):
        found += _distortion(camera, half)
    return [Remark(f"{camera.label}: {text}", Code.IMPLAUSIBLE) for text in found]


def _distortion(camera: Camera, half: float) -> list[str]:
    """Given distortion that folds the image, or displaces its middle part by much of the radius."""
    plain, bent = camera.bare_mapping(distorted=False), camera.bare_mapping()
    centre = plain(np.zeros((1, 2)))[0]
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    # Half of the image: towards the corners strong distortion is usual in wide lenses.
    at = centre + 0.5 * half * np.column_stack([np.cos(angle), np.sin(angle)])
    with np.errstate(all="ignore"):
        move = np.linalg.norm(bent(plain.inverse(at)) - at, axis=1) / (0.5 * half)
    if np.isfinite(move).all() and move.max() < _DISTORTED:
        return []
    names = [name for name in camera.distortions if camera.parameters.get(name)]
    return [f"the given distortion ({', '.join(names)}) displaces points halfway to the corners by more than "
            f"{100 * _DISTORTED:.0f} % of their radius"]  # fmt: skip


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def outside_image(network: Network) -> Rows:
    """Return the image points outside their image, where exchanged coordinates do not explain them.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> outside_image(example_network())
    array([], dtype=int64)
    """
    found = [np.zeros(0, dtype=np.intp)]
    for camera, rows in zip(network.cameras, network.rays_of_cameras, strict=True):
        size = np.array([camera.width, camera.height], dtype=np.float64)
        out, swapped = _beyond(network.xy[rows], size)
        found += [] if swapped or _centred(network.xy[rows], size) else [rows[out]]
    return np.concatenate(found)


def _beyond(xy: Array, size: Array) -> tuple[Mask, bool]:
    """Which coordinates are outside an image, and whether several are inside it on its side."""
    far = (xy < -0.5 - _OUTSIDE * size) | (xy > size * (1 + _OUTSIDE) - 0.5)
    out: Mask = np.asarray(far.any(axis=1))
    turned = ((xy > -0.5 - _OUTSIDE * size) & (xy < size[::-1] * (1 + _OUTSIDE) - 0.5)).all()
    return out, bool(turned and out.sum() > 2)


def _centred(xy: Array, size: Array) -> bool:
    """Whether coordinates are such as those from the middle of an image."""
    inside = bool((np.abs(xy) < size / 2 * (1 + _OUTSIDE)).all())
    return inside and bool(((xy < -_OUTSIDE * size).mean(axis=0) > _FROM_MIDDLE).all())


def _outside(network: Network) -> list[Remark]:
    """Image coordinates outside the image, or in another unit."""
    found = []
    for camera, rows in zip(network.cameras, network.rays_of_cameras, strict=True):
        if not len(rows):
            continue
        size = np.array([camera.width, camera.height], dtype=np.float64)
        xy = network.xy[rows]
        extent = np.ptp(xy, axis=0)
        if len(rows) >= 4 and (extent < _TINY * size).all() and (np.abs(xy) < 0.1 * size).all():
            unit = "in millimetres" if (xy < 0).any() else "normalised"
            found.append(
                Remark(
                    f"{camera.label}: all image coordinates are within {extent[0]:.3g} × {extent[1]:.3g} px "
                    f"of an image of {camera.width}×{camera.height}; are they {unit}?",
                    Code.IMPLAUSIBLE,
                )
            )
            continue
        if _centred(xy, size):
            found.append(
                Remark(
                    f"{camera.label}: all image coordinates are within half an image of zero, many of them "
                    "negative; are they from the middle of the image? They count from the centre of the "
                    "top-left pixel, y down",
                    Code.OUTSIDE,
                )
            )
            continue
        beyond, swapped = _beyond(xy, size)
        out = rows[beyond]
        if not len(out):
            continue
        if swapped:
            found.append(
                Remark(
                    f"{camera.label}: {len(out)} image points are outside the {camera.width}×{camera.height} "
                    "pixels; are width and height, or x and y, exchanged?",
                    Code.OUTSIDE,
                )
            )
            continue
        names = [
            f"{network.points[network.point_of[k]]} in image {network.images[network.image_of[k]]} "
            f"({network.xy[k, 0]:.1f}, {network.xy[k, 1]:.1f})"
            for k in out
        ]
        found.append(
            Remark(
                f"outside the image of {camera.width}×{camera.height} px: point"
                f"{'s' * (len(out) > 1)} {listed(names)}",
                Code.OUTSIDE,
            )
        )
    return found


def _copies(network: Network) -> list[Remark]:
    """Images with exactly the same image points: one is a copy of the other."""
    seen = dict[bytes, int]()
    pairs = []
    for i, rows in enumerate(_by_image(network, np.ones(len(network.xy), dtype=bool))):
        if len(rows) < 4:
            continue
        rows = rows[np.argsort(network.point_of[rows], kind="stable")]
        key = network.point_of[rows].tobytes() + network.xy[rows].tobytes()
        if key in seen:
            pairs.append(f"{network.images[seen[key]]} and {network.images[i]}")
        seen.setdefault(key, i)
    if not pairs:
        return []
    return [
        Remark(
            f"the images {listed(pairs)} have exactly the same image points: leave out the copy",
            Code.INCONSISTENT,
        )
    ]


def _rotations(network: Network) -> list[Remark]:
    """Rotation vectors longer than a full turn: they are in degrees."""
    size = np.linalg.norm(network.rotation, axis=1)
    rows = np.flatnonzero(np.nan_to_num(size) > 2 * np.pi + 1e-6)
    if not len(rows):
        return []
    names = listed(f"{network.images[i]} ({size[i]:.4g})" for i in rows)
    return [
        Remark(
            f"rotation vectors longer than a full turn of 2π rad, in image{'s' * (len(rows) > 1)} {names}; "
            "are they in degrees?",
            Code.IMPLAUSIBLE,
        )
    ]


def _stations(network: Network, uv: Array) -> list[Remark]:
    """Projection centres that are given in another unit than the points."""
    if network.refraction is not None or network.parallel.any():
        return []
    known = finite(network.xyz)
    ratios = []
    for i, rows in enumerate(_by_image(network, finite(uv) & known[network.point_of])):
        if len(rows) < 4 or not np.isfinite(network.x0[i]).all():
            continue
        places, rays = network.xyz[network.point_of[rows]], _unit(uv[rows])
        spread = float(np.sqrt(((rays - rays.mean(axis=0)) ** 2).sum(axis=1).mean()))
        middle = places.mean(axis=0)
        row = []
        for factor in (1.0, *_UNITS):
            away = factor * network.x0[i] - middle
            far = max(float(np.linalg.norm(away)), 1e-300)
            # What is spread along the line of sight does not spread the rays.
            across = (places - middle) - np.outer((places - middle) @ away, away) / far**2
            extent = float(np.sqrt((across**2).sum(axis=1).mean()))
            row.append(far * spread / max(extent, 1e-300))
        ratios.append(row)
    if len(ratios) < _STATIONS:
        return []
    off = np.median(np.abs(np.log(np.maximum(ratios, 1e-300))), axis=0)
    best = int(np.argmin(off))
    if best == 0 or off[0] < np.log(_WRONG_UNIT) or off[best] > np.log(_RIGHT_UNIT):
        return []
    times = f"{1 / _UNITS[best - 1]:g}" if _UNITS[best - 1] < 1 else f"{_UNITS[best - 1]:g}"
    side = "small" if _UNITS[best - 1] > 1 else "large"
    return [
        Remark(
            f"the given projection centres X0 are {times} times too {side} for the points that the images "
            f"show; are they in another unit than the points ({network.unit})?",
            Code.IMPLAUSIBLE,
        )
    ]


def _by_image(network: Network, chosen: Mask) -> list[Rows]:
    """Rows of the chosen image points of each image."""
    rows = np.flatnonzero(chosen)
    rows = rows[np.argsort(network.image_of[rows], kind="stable")]
    count = np.bincount(network.image_of[rows], minlength=len(network.images))
    return [part.astype(np.intp) for part in np.split(rows, np.cumsum(count)[:-1])]


def _unit(uv: Array) -> Array:
    ray = np.column_stack([uv, np.ones(len(uv))])
    unit: Array = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return unit


def _lines(network: Network, uv: Array) -> list[Remark]:
    """Images whose points lie on one line: they do not determine the pose."""
    bad = []
    lines = np.array([c.shutter is not None and c.shutter.mode == "line" for c in network.cameras])
    for i, rows in enumerate(_by_image(network, finite(uv))):
        # The points of a line camera are seen in one plane each.
        own = network.xy[rows] if lines[network.camera_of[i]] else uv[rows]
        if len(own) < 3:
            continue
        size = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)
        if size[1] < _FLAT * size[0]:
            bad.append(network.images[i])
    if not bad:
        return []
    plural = "s" * (len(bad) > 1)
    return [Remark(f"all points of image{plural} {listed(bad)} lie on one line: they do not determine its "
                   "position", Code.COLLINEAR)]  # fmt: skip


def _control_on_a_line(network: Network) -> list[Remark]:
    """Control points that a line explains as well: nothing holds the rotation about it."""
    known = np.flatnonzero((network.held | network.observed).all(axis=1) & (network.rays > 1))
    others = finite(network.x0).any() or network.stage is not None or network.rig is not None
    if network.datum != "control" or others or len(known) < 3:
        return []
    places = network.xyz[known]
    off = places - places.mean(axis=0)
    axes = np.linalg.svd(off, full_matrices=False)[2]
    # What the images resolve at the points: their extent in object space by that in the images.
    scales = []
    for rows in _by_image(network, np.isin(network.point_of, known)):
        if len(rows) > 2:
            own = network.xyz[network.point_of[rows]]
            extent = float(np.linalg.norm(network.xy[rows] - network.xy[rows].mean(axis=0)))
            scales.append(np.linalg.norm(own - own.mean(axis=0)) / max(extent, 1e-300))
    if not scales:
        return []
    resolved = float(np.median(scales)) * float(np.sqrt(np.median(network.cov[:, 0, 0])))
    sigma = np.sqrt(np.nan_to_num(network.sigma[known]).max(axis=1) ** 2 + resolved**2)
    # Two coordinates across the line of each point, less its four parameters.
    square = float((((off @ axes[1:].T) / sigma[:, None]) ** 2).sum())
    if 0.5 * square - (2 * len(known) - 4) > ODDS:
        return []
    return [
        Remark(
            f"the {len(known)} control points lie on one line, to what their standard deviations and the "
            "images resolve: nothing holds the rotation of the network about it; add a control point beside "
            "the line, or use the datum `free`",
            Code.COLLINEAR,
        )
    ]


def seen_frontally(network: Network, rotation: Array, xyz: Array, used: Mask) -> list[Remark]:
    """Return a remark where all images look at a plane at right angles, and a principal distance is free.

    Parameters
    ----------
    network : Network
        The network.
    rotation : ndarray (m, 3, 3)
        Rotations, approximate or adjusted.
    xyz : ndarray (p, 3)
        Points, NaN where unknown.
    used : ndarray of bool (m,)
        Images with a known rotation.
    """
    used = used & ~network.parallel
    points = xyz[finite(xyz)]
    if len(points) < 4 or not used.any():
        return []
    _, size, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if not size[2] < 0.05 * size[1]:
        return []
    found = []
    for c, camera in enumerate(network.cameras):
        own = used & (network.camera_of == c)
        model = camera.registered
        if model is None or not own.any():
            continue
        scale = [name for name in model.of_role("scale") if name in camera.free and name not in camera.sigma]
        tilt = np.arccos(np.clip(np.abs(rotation[own, 2] @ axes[2]), 0.0, 1.0))
        # Poses of a plane seen frontally are uncertain themselves by some degrees.
        if scale and camera.covariance is None and float(np.median(tilt)) < _FRONTAL:
            found.append(
                Remark(
                    f"{camera.label}: all points lie in a plane that the images see frontally: {scale[0]} "
                    "cannot be separated from the distance; tilt the camera by 20 to 40 degrees, or hold "
                    f"{', '.join(scale)}",
                    Code.FRONTAL,
                )
            )
    return found


def motion_of_narrow_lens(network: Network) -> list[Remark]:
    """Return a remark where a lens is too narrow to tell estimated velocities and rotation rates apart.

    Within a small angle of the axis a rotation about y moves an image as a shift along x does, line by line.
    """
    free, found = network.motion_free & ~network.parallel[:, None], list[Remark]()
    moving = free[:, [0, 1]] & free[:, [4, 3]]
    if not moving.any():
        return found
    uv = directions(network)
    for c, camera in enumerate(network.cameras):
        own = (network.camera_of == c) & moving.any(axis=1)
        seen = uv[own[network.image_of]]
        seen = seen[np.isfinite(seen).all(axis=1)]
        if not own.any() or not len(seen):
            continue
        half = float(np.rad2deg(np.arctan(np.linalg.norm(seen, axis=1).max())))
        if half < _NARROW_DEG:
            found.append(
                Remark(
                    f"{camera.label}: with rays within {half:.2g} deg of the axis, rotations about x and y "
                    "during the read-out (wx, wy) have the effect of shifts (vy, vx), and vz hardly any; "
                    "estimate only vx, vy, wz (`free` of the shutter, or --motion vx,vy,wz)",
                    Code.NOT_IDENTIFIED,
                )
            )
    return found


def given_poses_that_do_not_fit(network: Network, misfit: Array) -> list[Remark]:
    """Return a remark on images whose given poses contradict their image points.

    Parameters
    ----------
    network : Network
        The network.
    misfit : ndarray (n,)
        Distances (px) of image points from their places with the given poses; NaN where unknown.
    """
    rows = _by_image(network, np.isfinite(misfit))
    wrong = [
        i
        for i in np.flatnonzero(network.posed).tolist()
        if len(rows[i]) >= 4 and np.median(misfit[rows[i]]) > 0.25 * max(_size(network, i))
    ]
    if not len(wrong):
        return []
    names = listed(network.images[i] for i in wrong)
    return [
        Remark(
            f"the given orientation{'s' * (len(wrong) > 1)} of image{'s' * (len(wrong) > 1)} {names} "
            f"{'do' if len(wrong) > 1 else 'does'} not fit the points; leave them out, or check the order "
            "and the sense of the rotations",
            Code.INCONSISTENT,
        )
    ]


def _size(network: Network, image: int) -> tuple[int, int]:
    camera = network.cameras[network.camera_of[image]]
    return camera.width, camera.height
