"""Image points of a plane target that lie in the places of others: left out, and said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..bundle import Camera, Misnamed, Network, Result, camera_mapping, misnamed
from ..core.data import ImagePoints
from ..optics import camera_model

_STAND_IN = "opencv"
"""Model of a camera of which only the size of its images is used."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Image points that are left out, and the others.

    Parameters
    ----------
    network : Network
        All image points, with the coordinates of the design.
    found : Misnamed
        Those that are left out.
    """

    network: Network
    found: Misnamed

    def kept(self, measured: Mapping[str, ImagePoints]) -> dict[str, ImagePoints]:
        """The measured points without those that are left out."""
        network = self.network
        wrong = {
            (network.images[network.image_of[k]], network.points[network.point_of[k]])
            for k in self.found.rows
        }
        kept = {}
        for image, points in measured.items():
            keep = np.array([(image, name) not in wrong for name in points.names])
            names = tuple(name for name, good in zip(points.names, keep, strict=True) if good)
            kept[image] = ImagePoints(names, points.xy[keep], points.cov[keep])
        return kept

    def after(self, result: Result) -> LeftOut | None:
        """Those that still lie in other places by the cameras of an adjustment without them."""
        adjusted = result.network
        plain = all(camera.has_plane_mapping for camera in adjusted.cameras)
        if adjusted.refraction is not None or not plain:
            return self
        by_name = {
            camera.id: camera_mapping(result, c, formal=True).mapping
            for c, camera in enumerate(adjusted.cameras)
        }
        lenses = [by_name[camera.id] for camera in self.network.cameras]
        found = misnamed(self.network, lenses, self.found)
        return None if found is None else replace(self, found=found)


def left_out(
    network: Network, cameras: Sequence[str], sizes: Mapping[str, tuple[int, int]], of: Sequence[int]
) -> LeftOut | None:
    """Find image points that lie in the places of others.

    Parameters
    ----------
    network : Network
        Image points and the design; its cameras are not used.
    cameras, sizes, of : sequence of str, mapping of str to (int, int), sequence of int
        Names of the cameras, sizes of their images, and the camera of each image.
    """
    values = np.zeros(len(camera_model(_STAND_IN).names))
    plain = tuple(Camera(name, *sizes[name], (1.0, 1.0), _STAND_IN, values) for name in cameras)
    network = replace(network, cameras=plain, camera_of=np.array(of, dtype=np.intp))
    found = misnamed(network)
    return None if found is None else LeftOut(network, found)
