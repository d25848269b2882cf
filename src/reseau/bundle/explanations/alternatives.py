"""Explanations as networks of their own, adjusted: for effects that first derivatives do not describe."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ...core.errors import UsageError
from ...core.failure import Failure
from ...optics.cameras import convert
from ...optics.cameras.registry import camera_model
from ..diagnostics.evidence import Scores
from ..diagnostics.result import Result
from ..modelling.adjustment import problem_of
from ..modelling.calibration import with_estimates
from ..network.camera import Camera
from ..network.network import Network
from .discrete import Single, log_choice

_WIDER = ("opencv_full", "fisheye", "double_sphere")
"""Models that describe most lenses."""
_STEPS = 25
"""Iterations, from the estimates of the network that is explained."""
_TILT = ("tau_x", "tau_y")


def alternatives(result: Result, known: float) -> Iterator[Single]:
    """Yield richer models of the lenses, as far as they can be adjusted."""
    network = with_estimates(result)
    for form, cameras in _lenses(network):
        found = _adjusted(result, replace(network, cameras=cameras), form, known)
        if found is not None:
            yield found


def divided(result: Result, among: Single, known: float) -> Single:
    """The images of another camera, adjusted with one; as they were where that explains less.

    Cameras that are fixed to each other are no other cameras in some of their exposures.
    """
    if result.network.rig is not None:
        return among
    network = with_estimates(result)
    own, camera_of = int(network.camera_of[among.rows[0]]), network.camera_of.copy()
    camera_of[among.rows] = len(network.cameras)
    other = replace(network.cameras[own], id=f"{network.cameras[own].id} other")
    cameras = (*network.cameras, other)
    found = _adjusted(result, replace(network, cameras=cameras, camera_of=camera_of), among.form, known)
    if found is None:
        return among
    count = int((network.camera_of == own).sum())
    log = found.log_evidence - log_choice(count, len(among.rows))
    return replace(among, log_evidence=log, explained=found.explained) if log > among.log_evidence else among


def _lenses(network: Network) -> Iterator[tuple[str, tuple[Camera, ...]]]:
    """Cameras with more coefficients, or of other models, all of them together."""
    yield "all coefficients", tuple(_with_all(camera) for camera in network.cameras)
    for model in _WIDER:
        cameras = [_converted(camera, model) for camera in network.cameras]
        if all(camera is not None for camera in cameras):
            yield model, tuple(camera for camera in cameras if camera is not None)


def _with_all(camera: Camera) -> Camera:
    """The camera with all coefficients of its model, a tilt of the sensor excepted."""
    model = camera.registered
    if model is None or camera.sigma:
        return camera
    more = [name for name in model.of_role("distortion") if name not in _TILT]
    return replace(camera, free=tuple(name for name in model.names if name in camera.free or name in more))


def _converted(camera: Camera, model: str) -> Camera | None:
    """The camera by another model with its usual parameters."""
    if camera.registered is None or camera.parallel or camera.additional is not None or camera.sigma:
        return None
    registered = camera_model(model)
    free = registered.usual
    if model == "opencv_full":
        free = tuple(name for name in registered.names if name not in (*_TILT, "s1", "s2", "s3", "s4"))
    try:
        found = convert(camera.plane_mapping(), camera.grid, model, {}, free=free)
    except UsageError:
        return None
    return replace(
        camera, model=model, values=np.array(found.mapping.values)[: len(registered.names)], free=free,
        options={}, covariance=None,
    )  # fmt: skip


def _adjusted(result: Result, network: Network, form: str, known: float) -> Single | None:
    """Adjust another network of the same image points, and compare it."""
    fit = result.fit
    problem, _ = problem_of(network)
    if fit.problem.weights is not None:
        n = 2 * len(network.xy)
        weights = np.ones(len(problem.observations))
        weights[:n] = fit.problem.weights[:n]
        problem = problem.with_weights(weights)
    again = replace(problem, rounds=0, max_iterations=_STEPS).adjusted()
    if isinstance(again, Failure):
        return None
    more = result.redundancy - again.redundancy
    if more < 0 or again.usable.observations.sum() < fit.usable.observations.sum():
        return None
    # A parameter costs half the logarithm of the number of observations (Schwarz 1978).
    plain = Scores(np.zeros(0), np.zeros((0, 0)), again.cost, result.redundancy, np.zeros((0, 0)))
    log = plain.log_nothing(known=known) - 0.5 * more * np.log(result.redundancy)
    return Single("lens", form, log, fit.cost - again.cost)
