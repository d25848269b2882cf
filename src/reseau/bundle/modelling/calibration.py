"""The calibration of a camera, from a bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np

from ...calibration.document import Calibration, CameraModel, Covariance, Place, Quantity
from ...core.errors import UsageError
from ...optics.poses import matrix_to_vector
from ..diagnostics.result import Result
from ..diagnostics.target_part import covariance_by_targets
from ..network.camera import Camera
from ..network.network import Network


def calibration_of(
    result: Result,
    camera: str,
    *,
    name: str,
    provenance: Mapping[str, Any] | None = None,
    times: Mapping[str, str] | None = None,
) -> Calibration:
    """Create the calibration of one camera, ``reseau-calibration/1``, with its place on a rig.

    Parameters
    ----------
    result : Result
        Result of the adjustment.
    camera : str
        Id of the camera in the network.
    name : str
        Name of the calibration.
    provenance, times : mapping, optional
        Provenance and times of the calibration.

    Raises
    ------
    UsageError
        When there is no such camera, or none of its parameters was estimated.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> calibration = calibration_of(result, "camera", name="front")
    >>> calibration.kind, calibration.covariance.names
    ('camera', ('c', 'x0', 'y0', 'K1'))
    """
    ids = [entry.id for entry in result.network.cameras]
    if camera not in ids:
        raise UsageError(
            "is not a camera of the network", where=camera, do=f"name one of {', '.join(ids[:8])}"
        )
    c = ids.index(camera)
    entry = result.network.cameras[c]
    names, columns, values = result.camera_columns(c)
    if not names:
        raise UsageError("no parameter was estimated", where=f"camera {camera}")
    found = result.camera(c)
    uncertain = result.uncertainty(columns)
    every, covariance, held = result.with_considered(c, names, columns, uncertain.covariance)
    sigma = dict(zip(every, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    parameters = {
        key: Quantity(value=value, sigma=sigma.get(key, 0.0), unit=entry.unit_of(key))
        for key, value in (entry.parameters | dict(zip(names, values.tolist(), strict=True))).items()
    }
    dof = {"degrees_of_freedom": uncertain.degrees} if np.isfinite(uncertain.degrees) else {}
    xy = result.network.xy[result.used_by(c)]
    targets = covariance_by_targets(result, c)
    targets = None if targets is None else np.pad(targets, (0, len(every) - len(names)))
    parts = {
        f"covariance_of_{name}": part.tolist()
        for name, part in (("targets", targets), ("held", held)) if part is not None
    }  # fmt: skip
    # Coefficients that were held have no formal sigma.
    formal = dict.fromkeys(every, 0.0) | dict(zip(names, found.sigma_formal.tolist(), strict=True))
    rivals = {"rivals": [each.entry() for each in result.rivals_of(c)]} if result.rivals_of(c) else {}
    return Calibration(
        kind="camera",
        name=name,
        model=model_entry(entry),
        parameters=parameters,
        covariance=Covariance(names=every, matrix=tuple(tuple(row) for row in covariance.tolist())),
        sigma0=result.sigma0 if result.redundancy > 0 else None,
        redundancy=result.redundancy,
        place=_place(result, camera),
        tests=tuple(vars(test) for test in result.camera_tests(c)),
        validity={"extent": [*xy.min(axis=0).tolist(), *xy.max(axis=0).tolist()], "unit": "px",
                  "sigma_formal": formal, **dof,
                  "images": int(np.count_nonzero(result.fit.usable.images & (result.network.camera_of == c))),
                  **parts, "rms_px": result.rms_px(c),
                  "warnings": [remark.text for remark in result.warnings],
                  "warning_codes": [remark.code.value for remark in result.warnings], **rivals},
        provenance=dict(provenance or {}),
        times=dict(times or {}),
    )  # fmt: skip


def _place(result: Result, camera: str) -> Place | None:
    """Return the place of a camera on a rig; None for the reference, and without a rig."""
    rig = result.rig
    if rig is None or camera not in rig.cameras:
        return None
    k = rig.cameras.index(camera)
    return Place(
        reference=rig.references[k],
        rotation=tuple(matrix_to_vector(rig.rotation[k]).tolist()),
        base=tuple(rig.base[k].tolist()),
        unit=rig.unit,
        covariance=tuple(tuple(row) for row in rig.cov[k].tolist()),
    )


def model_entry(camera: Camera) -> CameraModel:
    """Return the model as in a calibration."""
    model: CameraModel = {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "pitch_mm": list(camera.pitch_mm),
    }
    model = cast(CameraModel, model | dict(camera.options))
    extra = camera.additional
    if extra is not None:
        model["additional"] = {"model": extra.model, "base_mm": extra.base_mm, "per": extra.per}
    if camera.shutter is not None:
        shutter = camera.shutter
        model["shutter"] = {"mode": shutter.mode, "line_s": shutter.line_s, "row": shutter.row}
    return model


def with_estimates(result: Result) -> Network:
    """Return the network with its estimates as approximate values, for fast convergence.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> bool(np.isfinite(with_estimates(adjust_network(example_network())).x0).all())
    True
    """
    network, values = result.network, result.fit.values
    cameras = tuple(
        replace(camera, values=values.cameras[c, : len(camera.values)])
        for c, camera in enumerate(network.cameras)
    )
    bent = network.refraction
    return replace(
        network,
        cameras=cameras,
        x0=values.x0,
        rotation=result.rotation,
        xyz=values.xyz,
        refraction=None if bent is None else bent.with_values(values.refraction),
    )
