"""``reseau-scene/1``: cameras and target as adjusted, in space, for pictures that can be turned."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..io import Document, Strict

if TYPE_CHECKING:
    from ..bundle import Result


Triple = tuple[float, float, float]
_MANY_POINTS = 2000


class SceneCamera(Strict):
    """An image: where its camera was, and where it looked.

    Parameters
    ----------
    name : str
        Name of the image.
    position : (float, float, float)
        Projection centre.
    axes : three of (float, float, float)
        Directions right, down and forward in the image, unit vectors.
    field : (float, float)
        Tangents of half the angles of view, across and down; of a central perspective.

    Examples
    --------
    >>> axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    >>> SceneCamera(name="left", position=(0.0, 0.0, 0.0), axes=axes, field=(0.4, 0.3)).field
    (0.4, 0.3)
    """

    name: str
    position: Triple
    axes: tuple[Triple, Triple, Triple]
    field: tuple[float, float]


class Scene(Document):
    """Cameras and points of an adjusted network.

    Parameters
    ----------
    unit : str
        Unit of length.
    cameras : tuple of SceneCamera
        One for each image.
    points : tuple of str
        Names of the points.
    xyz : tuple of (float, float, float)
        Their positions.

    Examples
    --------
    >>> Scene(unit="mm", cameras=(), points=("a",), xyz=((0.0, 0.0, 1.0),)).unit
    'mm'
    """

    SCHEMA: ClassVar[str] = "reseau-scene/1"
    unit: str
    cameras: tuple[SceneCamera, ...]
    points: tuple[str, ...]
    xyz: tuple[Triple, ...]


def scene_of(result: Result) -> Scene:
    """Return the scene of an adjustment; of very many points some.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> scene = scene_of(adjust_network(example_network()))
    >>> len(scene.cameras), len(scene.points)
    (8, 20)
    """
    network, values, part = result.network, result.fit.values, result.fit.usable
    points = np.flatnonzero(part.points)
    points = points[:: max(1, -(-len(points) // _MANY_POINTS))]
    cameras = []
    for k in np.flatnonzero(part.images).tolist():
        camera = network.cameras[int(network.camera_of[k])]
        c = dict(zip(camera.names, camera.values.tolist(), strict=True)).get("c", 0.0)
        size = [0.5 * n * p for n, p in zip((camera.width, camera.height), camera.pitch_mm, strict=True)]
        field = tuple(round(each / c, 4) if c > 0 else 0.5 for each in size)
        axes = tuple(_triple(row, 6) for row in values.rotation[k])
        cameras.append(
            SceneCamera(name=network.images[k], position=_triple(values.x0[k]), axes=axes, field=field)  # type: ignore[arg-type]
        )
    return Scene(
        unit=network.unit, cameras=tuple(cameras), points=tuple(network.points[k] for k in points.tolist()),
        xyz=tuple(_triple(row) for row in values.xyz[points]),
    )  # fmt: skip


def _triple(row: np.ndarray[tuple[int, ...], np.dtype[np.float64]], digits: int = 4) -> Triple:
    x, y, z = (round(float(each), digits) for each in row)
    return x, y, z
