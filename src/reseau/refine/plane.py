"""The plane of the test object and the common system: scales λ1, λ2, and the rods M and N that join them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Array, ImagePoints
from ..core.failure import Code, Failure
from ..io import ReseauDesign
from ..measure.fitting import is_mirrored
from ..optics import Similarity
from .camera import defining_marks

__all__ = ["ObjectPlane", "object_plane"]


@dataclass(frozen=True, eq=False)
class ObjectPlane:
    """Coordinates of the test object and the common system.

    Parameters
    ----------
    axes : Similarity
        Object coordinates into the system of the rods M (origin) and N (on the axis), unscaled.
    scale : ndarray (2,)
        λ1 and λ2: of the photograph along that axis and across it.
    system : Similarity
        The scaled system into the common one: M onto its image M', N onto N'.
    """

    axes: Similarity
    scale: Array
    system: Similarity

    def to_common(self, xy: Array) -> Array:
        """Object coordinates (n, 2) in the common system."""
        return self.system(self.axes(xy) * self.scale)

    def from_common(self, xy: Array) -> Array:
        """Coordinates of the common system (n, 2) as object coordinates."""
        return self.axes.inverse(self.system.inverse(xy) / self.scale)

    @property
    def slope(self) -> Array:
        """Derivatives of `from_common`, (2, 2); the same everywhere."""
        ends = self.from_common(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return np.stack([ends[1] - ends[0], ends[2] - ends[0]], axis=1)

    @property
    def rotation(self) -> float:
        """Angle (rad) from the x-axis of the common system to that of the object."""
        along = self.to_common(np.array([[0.0, 0.0], [1.0, 0.0]]))
        return float(np.arctan2(*(along[1] - along[0])[::-1]))


def object_plane(refined: ImagePoints, plane: Array, design: ReseauDesign) -> ObjectPlane | Failure:
    """Scales λ1, λ2 and the system that M and N define."""
    ends = defining_marks(refined, plane, design)
    if isinstance(ends, Failure):
        return ends
    (m_image, m), (n_image, n) = ends
    mirrored = is_mirrored(plane, refined.xy)
    axes = Similarity.common_system(m, n, mirrored=mirrored)
    inverse = Similarity.common_system(m_image, n_image)
    local, seen = axes(plane), inverse(refined.xy)
    across = float(local[:, 1] @ local[:, 1])
    if not across > 0:
        return Failure(
            f"the rods of design {design.name!r} lie on one line with M and N; λ2 is undetermined",
            Code.COLLINEAR,
        )
    scale = np.array([np.hypot(*(n_image - m_image)) / np.hypot(*(n - m)), local[:, 1] @ seen[:, 1] / across])
    a, b = inverse.values[2:]
    system = Similarity(np.array([*m_image, a, -b]))
    return ObjectPlane(axes, scale, system)
