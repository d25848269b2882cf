"""Points with their covariances in one coordinate system, in columns: ``reseau-points/1``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.data import ImagePoints, covariances_of
from ..core.errors import FormatError

POINTS = "reseau-points/1"


def points_document(points: ImagePoints, unit: str, system: str) -> dict[str, Any]:
    """Return points in columns: what `--json` prints.

    Examples
    --------
    >>> points = ImagePoints(("a",), np.array([[1.0, 2.0]]), np.array([[[4.0, 3.0], [3.0, 9.0]]]))
    >>> points_document(points, "px", "image")["points"]["rho"]
    [0.5]
    """
    return {"schema": POINTS, "unit": unit, "system": system, "points": points._columns()}


def points_of(document: Mapping[str, Any], where: object) -> ImagePoints:
    """Return the points of a document; those without a position are left out.

    Parameters
    ----------
    document : mapping
        See :func:`points_document`.
    where : object
        File, for messages.

    Raises
    ------
    FormatError
        If a column is missing, or has something else than numbers.

    Examples
    --------
    >>> points = ImagePoints(("a",), np.array([[1.0, 2.0]]), np.array([[[4.0, 3.0], [3.0, 9.0]]]))
    >>> points_of(points_document(points, "px", "image"), "points.json").cov
    array([[[4., 3.],
            [3., 9.]]])
    """
    try:
        table = document["points"]
        keys = ("x", "y", "sx", "sy", "rho")
        x, y, sx, sy, rho = (np.array(table[key], dtype=np.float64) for key in keys)
        known = np.asarray(np.isfinite([x, y, sx, sy, rho]).all(axis=0))
        names = tuple(str(name) for name, one in zip(table["id"], known, strict=True) if one)
        return ImagePoints(names, np.stack([x, y], axis=-1)[known], covariances_of(sx, sy, rho)[known])
    except (KeyError, TypeError, ValueError):
        raise FormatError(f"is not a complete {POINTS}", where=where) from None
