"""What a user sets beside a network file: parameters, control points, datum, sigmas; and writing it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ...core.data import sigmas_of
from ...core.errors import UsageError
from ...io.network import (
    AdditionalParameters,
    BaseColumns,
    CameraEntry,
    DistanceColumns,
    ImageColumns,
    Network1,
    ObservationColumns,
    PointColumns,
    ShutterEntry,
)
from .camera import Camera
from .network import ControlPoints, Datum, Network, finite
from .turntable import turntable_of_stage


def with_parameters(network: Network, free: Sequence[str] = (), fix: Sequence[str] = ()) -> Network:
    """Return the network with other free parameters of its cameras.

    Parameters
    ----------
    network : Network
        The network.
    free, fix : sequence of str
        Parameters to estimate and to hold, as ``K1`` for all cameras that have it, or ``ID:K1`` for one;
        ``all`` means all parameters of the model.

    Raises
    ------
    UsageError
        When no camera has a parameter of this name, or one is both free and fixed.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> with_parameters(example_network(), ["K2"], ["x0", "y0"]).cameras[0].free
    ('c', 'K1', 'K2')
    """
    chosen: list[set[str]] = [set(camera.free) for camera in network.cameras]
    both = set(free) & set(fix)
    if both:
        raise UsageError("is both free and fixed", where=f"parameter {min(both)}")
    for names, add in ((fix, False), (free, True)):
        for name in names:
            for c in _cameras_with(network, name):
                own = name.rpartition(":")[2]
                parameters = set(network.cameras[c].names) if own == "all" else {own}
                chosen[c] = chosen[c] | parameters if add else chosen[c] - parameters
    cameras = tuple(
        _with_free(camera, tuple(n for n in camera.names if n in own))
        for camera, own in zip(network.cameras, chosen, strict=True)
    )
    return replace(network, cameras=cameras)


def _cameras_with(network: Network, name: str) -> list[int]:
    """Rows of the cameras that a name of a parameter is about."""
    camera, _, own = name.rpartition(":")
    if camera and camera not in [entry.id for entry in network.cameras]:
        raise UsageError("is not a camera of the network", where=camera)
    found = [
        c
        for c, entry in enumerate(network.cameras)
        if camera in ("", entry.id) and (own == "all" or own in entry.names)
    ]
    if not found:
        known = dict.fromkeys(n for entry in network.cameras for n in entry.names)
        raise UsageError("is no parameter of a camera", where=own, do=f"use one of {', '.join(known)}")
    return found


def _with_free(camera: Camera, free: tuple[str, ...]) -> Camera:
    if free == camera.free:
        return camera
    sigma = {} if camera.registered is None else camera.registered.priors(set(free) - set(camera.free))
    sigma |= {name: s for name, s in camera.sigma.items() if name in free}
    return replace(camera, free=free, sigma=sigma)


def with_control(network: Network, control: ControlPoints) -> Network:
    """Return the network with the coordinates of control points, and the datum ``control``.

    Points that were control points before and are not among these become tie points.

    Parameters
    ----------
    network : Network
        The network.
    control : ControlPoints
        Held, observed and free coordinates; points of other networks in the same table are ignored.

    Raises
    ------
    UsageError
        When none of the points is in the network, or one of them has fewer than three coordinates.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> given = ControlPoints(("p3",), np.zeros((1, 3)), np.zeros((1, 3)))
    >>> network = with_control(example_network(), given)
    >>> network.datum, network.role[3], network.xyz[3]
    ('control', 'control', array([0., 0., 0.]))
    """
    rows = {name: j for j, name in enumerate(network.points)}
    found = [k for k, name in enumerate(control.names) if name in rows]
    if not found:
        raise UsageError(
            "none of the control points is in the network", do="check that their names are the same"
        )
    at = [rows[control.names[k]] for k in found]
    before = np.array([role == "control" for role in network.role])
    sigma = np.where(before[:, None], np.nan, network.sigma)
    xyz, role = network.xyz.copy(), list(network.role)
    unknown = before.copy()
    unknown[at] = False
    xyz[unknown] = np.nan
    role = ["tie" if gone else name for gone, name in zip(unknown, role, strict=True)]
    complete = finite(control.xyz[found])
    if not complete.all():
        name = control.names[found[int(np.flatnonzero(~complete)[0])]]
        raise UsageError("needs three coordinates", where=f"control point {name}")
    xyz[at], sigma[at] = control.xyz[found], control.sigma[found]
    for j in at:
        role[j] = "control"
    # Approximate poses and coordinates of a free network have another coordinate system.
    ours = network.datum != "control"
    nowhere = np.full_like(network.x0, np.nan)
    if ours:
        rest = np.ones(len(xyz), dtype=bool)
        rest[at] = False
        xyz[rest] = np.nan
    return replace(
        network,
        xyz=xyz,
        sigma=sigma,
        role=tuple(role),
        datum="control",
        x0=nowhere if ours else network.x0,
        rotation=nowhere if ours else network.rotation,
    )


def with_datum(network: Network, datum: Datum) -> Network:
    """Return the network with another datum; without the datum ``control``, control points are tie points.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> with_datum(example_network(), "minimal").datum
    'minimal'
    """
    if datum == "control":
        return replace(network, datum=datum)
    return replace(
        network,
        datum=datum,
        sigma=np.full_like(network.sigma, np.nan),
        role=tuple("tie" if role == "control" else role for role in network.role),
        stage=None,
    )


def with_sigma(network: Network, sigma: float) -> Network:
    """Return the network with one standard deviation (px) for all image coordinates.

    Raises
    ------
    UsageError
        When it is not above zero.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> np.sqrt(with_sigma(example_network(), 0.2).cov[0].diagonal())
    array([0.2, 0.2])
    """
    if not 0 < sigma < np.inf:
        raise UsageError(f"{sigma:g} is not above zero", where="sigma")
    return replace(network, cov=np.tile(sigma**2 * np.eye(2), (len(network.xy), 1, 1)))


def network_document(network: Network) -> Network1:
    """Return the document ``reseau-network/1`` of a network.

    Raises
    ------
    UsageError
        When the network has something that its file format describes by other files: a calibrated camera,
        windows, a linear stage.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> network = example_network()
    >>> again = Network.from_document(network_document(network))
    >>> bool((again.xy == network.xy).all()), again.cameras[0].free == network.cameras[0].free
    (True, True)
    """
    if network.refraction is not None:
        raise UsageError("a network with windows cannot be written", where="network")
    ids = [camera.id for camera in network.cameras]
    points = np.array(network.points, dtype=object)
    bars = network.distance
    a, b = network.distance_of.T
    return Network1(
        unit=network.unit,
        cameras=tuple(_entry(camera) for camera in network.cameras),
        images=ImageColumns(
            id=network.images,
            camera=tuple(ids[c] for c in network.camera_of),
            X0=_triples(network.x0),
            rotation=_triples(network.rotation),
            file=network.files if any(network.files) else None,
            group=network.groups if any(network.groups) else None,
            exposure=None if network.rig is None
            else tuple(str(e) if e >= 0 else None for e in network.rig.exposure.tolist()),
            motion=_motion(network),
        ),
        points=PointColumns(
            id=network.points,
            xyz=_triples(network.xyz),
            sigma=tuple(
                None if np.isnan(row).all() else tuple(None if np.isnan(s) else float(s) for s in row)  # type: ignore[misc]
                for row in network.sigma
            ),
            role=network.role,  # type: ignore[arg-type]
        ),
        observations=observation_columns(network),
        distances=DistanceColumns(
            **{"from": tuple(points[a])}, to=tuple(points[b]), length=tuple(bars[:, 0].tolist()),
            sigma=tuple(bars[:, 1].tolist()),
        ) if len(bars) else None,
        bases=_bases(network, ids),
        turntable=None if network.stage is None else turntable_of_stage(network.stage, network.images),
        datum=network.datum,
        datum_points=tuple(points[network.datum_points]) if network.datum_chosen else None,
    )  # fmt: skip


def observation_columns(network: Network) -> ObservationColumns:
    """Return the image coordinates of a network as its document has them.

    Examples
    --------
    >>> from reseau.bundle import example_network
    >>> observation_columns(example_network()).x[0] == example_network().xy[0, 0]
    np.True_
    """
    x, y, sx, sy, rho = np.column_stack([network.xy, *sigmas_of(network.cov)]).T.tolist()
    return ObservationColumns(
        image=tuple(network.images[i] for i in network.image_of),
        point=tuple(network.points[j] for j in network.point_of),
        x=tuple(x), y=tuple(y), sx=tuple(sx), sy=tuple(sy), rho=tuple(rho) if any(rho) else None,
    )  # fmt: skip


def _motion(network: Network) -> tuple[Any, ...] | None:
    """Motion of the images of cameras with a shutter; None where none is known."""
    if network.motion is None or not network.shutters.any():
        return None
    return tuple(
        tuple(row) if moves else None
        for row, moves in zip(network.motion.tolist(), network.shutters.tolist(), strict=True)
    )


def _bases(network: Network, ids: list[str]) -> BaseColumns | None:
    rig = network.rig
    if rig is None or not len(rig.base):
        return None
    a, b = ([ids[c] for c in end] for end in rig.base_of.T)
    length, sigma = rig.base.T.tolist()
    return BaseColumns(**{"from": tuple(a)}, to=tuple(b), length=tuple(length), sigma=tuple(sigma))


def _entry(camera: Camera) -> CameraEntry:
    if camera.registered is None or camera.covariance is not None:
        raise UsageError("has the covariance of a calibration, and cannot be written", where=camera.label)
    extra = camera.additional
    additional = None
    if extra is not None:
        additional = AdditionalParameters(
            base_mm=extra.base_mm, free=extra.free, per=extra.per, model=extra.model
        )
    shutter = None
    if camera.shutter is not None:
        shutter = ShutterEntry(**asdict(camera.shutter))
    content: dict[str, Any] = {
        "id": camera.id,
        "width": camera.width,
        "height": camera.height,
        "pitch_mm": camera.pitch_mm if camera.registered.needs_pitch else None,
        "model": camera.model,
        "parameters": camera.parameters,
        "free": camera.free,
        "sigma": dict(camera.sigma) or None,
        "additional": additional,
        "shutter": shutter,
    }
    return CameraEntry(**content | dict(camera.options))


def _triples(rows: np.ndarray) -> tuple[tuple[float, float, float] | None, ...]:
    return tuple(
        None if not np.isfinite(row).all() else (float(row[0]), float(row[1]), float(row[2])) for row in rows
    )
