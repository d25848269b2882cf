"""A calibrated camera by itself: its mapping with the covariance of what was estimated of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ...calibration.document import Calibration
from ...core.data import Array, Rows
from ...core.errors import UsageError
from ...optics import PlaneMapping, camera_model, camera_models
from ..network import Additional, Camera
from .result import Result

__all__ = ["Lens", "own_columns"]


@dataclass(frozen=True, eq=False)
class Lens:
    """A calibrated camera.

    Parameters
    ----------
    mapping : PlaneMapping
        From ideal directions u = xc/zc, v = yc/zc to pixels, with the estimates.
    width, height : int
        Pixels of the image.
    rows : ndarray of int (u,)
        Parameters of the mapping that were estimated.
    covariance : ndarray (u, u)
        Of these, a posteriori.

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> camera = Brown(grid=PixelGrid(640, 480, (0.01, 0.01))).with_values({"c": 8.0})
    >>> Lens(camera, 640, 480, np.array([0]), np.array([[1e-6]])).names
    ('c',)
    """

    mapping: PlaneMapping
    width: int
    height: int
    rows: Rows
    covariance: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return tuple(self.mapping.names[k] for k in self.rows)

    @classmethod
    def of_result(cls, result: Result, c: int, additional: str | None = None) -> Self:
        """A camera as an adjustment left it.

        Parameters
        ----------
        result : Result
            The adjustment.
        c : int
            Row of the camera.
        additional : str, optional
            Which set of additional parameters, ``group G`` or ``image I``, where there are several.

        Raises
        ------
        UsageError
            When there is no such set, or several and none is named.
        """
        names, columns, values = own_columns(result, c, additional)
        covariance = result.fit.cofactors.reduced[np.ix_(columns, columns)] * result.fit.variance
        found = dict(zip(names, values.tolist(), strict=True))
        return cls._of(result.network.cameras[c], found, names, covariance)

    @classmethod
    def of_calibration(cls, calibration: Calibration) -> Self:
        """A camera from its file ``reseau-calibration/1``.

        Raises
        ------
        UsageError
            When it is none of a camera of a registered model.
        """
        model = calibration.model
        if calibration.kind != "camera" or not isinstance(model, dict):
            raise UsageError("is not that of a camera", where=f"calibration {calibration.name}")
        if model.get("model") not in [known.name for known in camera_models()]:
            raise UsageError("has a model without a form in files", where=f"calibration {calibration.name}")
        camera = _camera(calibration.name, model, calibration.values())
        names = calibration.covariance.names
        matrix = np.array(calibration.covariance.matrix).reshape(len(names), len(names))
        return cls._of(camera, calibration.values(), names, matrix)

    @classmethod
    def _of(cls, camera: Camera, found: dict[str, float], names: tuple[str, ...], covariance: Array) -> Self:
        mapping = camera.plane_mapping()
        mapping = mapping.with_values({name: found[name] for name in mapping.names if name in found})
        rows = np.array([mapping.names.index(name) for name in names], dtype=np.intp)
        return cls(mapping, camera.width, camera.height, rows, covariance)


def own_columns(result: Result, c: int, additional: str | None) -> tuple[tuple[str, ...], Rows, Array]:
    """Names, columns and values of what was estimated of a camera, of its additional parameters one set."""
    names, columns, values = result.camera_columns(c)
    camera = result.network.cameras[c]
    if camera.additional is None or camera.additional.per == "camera":
        return names, columns, values
    keep = [k for k, name in enumerate(names) if " of " not in name]
    own = [k for k, name in enumerate(names) if name.endswith(f" of {additional}")]
    if not own:
        raise UsageError("is no set of additional parameters of it", where=f"{additional or 'none'}")
    keep += own
    return tuple(names[k].partition(" of ")[0] for k in keep), columns[keep], values[keep]


def _camera(name: str, model: dict[str, Any], values: dict[str, float]) -> Camera:
    """A camera from the model of its calibration."""
    extra = model.get("additional")
    if extra is not None and extra["per"] != "camera":
        raise UsageError("has several sets of additional parameters", where=f"calibration {name}")
    registered = camera_model(model["model"])
    return Camera(
        name, model["width"], model["height"], tuple(model["pitch_mm"]), registered.name,
        np.array([values.get(key, 0.0) for key in registered.names]),
        options={option.name: model[option.name] for option in registered.options if option.name in model},
        additional=None if extra is None else Additional(extra["base_mm"], model=extra["model"]),
    )  # fmt: skip
