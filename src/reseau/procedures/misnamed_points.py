"""Image points of a plane target that lie in the places of others: left out, and said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.spatial

from ..bundle import Camera, Misnamed, Network, Result, camera_mapping, misnamed
from ..core.data import ImagePoints, Mask
from ..optics import camera_model

__all__ = ["LeftOut", "left_out"]

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
        """Those that still lie nearer to the place of another point after an adjustment without them."""
        network, adjusted = self.network, result.network
        image_of = {name: k for k, name in enumerate(adjusted.images)}
        point_of = {name: k for k, name in enumerate(adjusted.points)}
        values, rows = result.fit.values, self.found.rows
        still: Mask = np.ones(len(rows), dtype=np.bool_)
        for image in np.unique(network.image_of[rows]):
            i = image_of.get(network.images[image])
            if i is None or not result.fit.usable.images[i]:
                continue
            mapping = camera_mapping(result, int(adjusted.camera_of[i]), formal=True).mapping
            at = (values.xyz - values.x0[i]) @ values.rotation[i].T
            uv = at[:, :2] if mapping.parallel else at[:, :2] / at[:, 2:]
            places = np.where(mapping.one_to_one(uv)[:, None], mapping(uv), np.nan)
            known = np.flatnonzero(np.isfinite(places).all(axis=1))
            tree = scipy.spatial.cKDTree(places[known])
            for k in np.flatnonzero(network.image_of[rows] == image):
                own = point_of.get(network.points[network.point_of[rows[k]]])
                if own is None or not np.isfinite(places[own]).all():
                    continue
                gap = float(tree.query(places[own], k=2)[0][1])
                still[k] = np.linalg.norm(places[own] - network.xy[rows[k]]) > 0.5 * gap
        if not still.any():
            return None
        found = self.found
        labels = tuple(label for label, keep in zip(found.labels, still, strict=True) if keep)
        kept = replace(
            found, rows=rows[still], point=found.point[still], off_px=found.off_px[still], labels=labels
        )
        return replace(self, found=kept)


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
