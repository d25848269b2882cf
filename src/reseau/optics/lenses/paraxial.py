r"""First-order optics of a lens: focal length, pupils, invariants.

Rays are traced by :math:`n'u' = nu - y\,c\,(n' - n)` and :math:`y_{+} = y + t\,u'` (Welford 1986,
section 3.5).
Behind a mirror the index is negative, and so are distances. Tilts are left out, as if the axis were
unfolded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from .prescription import Prescription


@dataclass(frozen=True, eq=False)
class Paraxial:
    """A lens in first order, at one wavelength.

    Parameters
    ----------
    lens : Prescription
    wavelength_nm : float, optional
        By default that of the corresponding rays.

    Examples
    --------
    A plano-convex lens, with the light entering at its curved side:

    >>> from reseau.optics.lenses import AIR, Prescription, in_order
    >>> from reseau.optics.lenses.media import Constant
    >>> lens = Prescription(in_order([(0.02, 6.0, Constant(1.5)), (0.0, 96.0, AIR)]), stop=0, stop_radius=8.0)
    >>> first = Paraxial(lens)
    >>> round(first.focal_length, 6), round(first.back_focus, 6), round(first.f_number, 4)
    (100.0, 96.0, 6.25)
    """

    lens: Prescription
    wavelength_nm: float | None = None

    @cached_property
    def indices(self) -> Array:
        """Indices in front of the first surface and behind each, negative behind a mirror, (1 + s,)."""
        lens = self.lens
        found = lens.indices(lens.wavelength_nm if self.wavelength_nm is None else self.wavelength_nm)
        mirrors = [surface.kind == "mirror" for surface in lens.surfaces]
        signs = np.cumprod(np.where([False, *mirrors], -1.0, 1.0))
        return np.asarray(found * signs)

    @cached_property
    def distances(self) -> Array:
        """Distances from each surface to the next, (s - 1,), mm."""
        found = []
        for here, there, n in zip(self.lens.surfaces, self.lens.surfaces[1:], self.indices[1:], strict=False):
            away = there.vertex - here.vertex
            tilted = np.abs(here.axes - there.axes).max() > 1e-9
            length = np.sign(n) * np.linalg.norm(away) if tilted else away @ here.axes[:, 2]
            found.append(float(length))
        return np.array(found)

    def ray(
        self, height: float, slope: float, first: int = 0, last: int | None = None
    ) -> tuple[Array, Array]:
        """Heights at surfaces, and slopes behind them, of a ray with a height and a slope at the first.

        Parameters
        ----------
        height, slope : float
            At the surface `first`, in front of it.
        first, last : int
            Surfaces between which it is traced.
        """
        n, stop = self.indices, len(self.lens.surfaces) if last is None else last + 1
        heights, slopes, y, u = [], [], height, slope
        for s in range(first, stop):
            if s > first:
                y = y + self.distances[s - 1] * u
            surface = self.lens.surfaces[s]
            c = surface.curvature if surface.kind != "plain" else 0.0
            u = (n[s] * u - y * c * (n[s + 1] - n[s])) / n[s + 1]
            heights.append(y)
            slopes.append(u)
        return np.array(heights), np.array(slopes)

    @cached_property
    def _power(self) -> int:
        """The last surface that bends rays."""
        return max(s for s, surface in enumerate(self.lens.surfaces) if surface.kind != "plain")

    @cached_property
    def focal_length(self) -> float:
        """Effective focal length on the image side, mm.

        Raises
        ------
        UsageError
            When the lens has no power.
        """
        slope = float(self.ray(1.0, 0.0, last=self._power)[1][-1])
        if abs(slope) < 1e-12:
            raise UsageError("is afocal: parallel light leaves it parallel", where=self.lens.name)
        return -1 / slope

    @cached_property
    def back_focus(self) -> float:
        """Distance from the last surface with power to the focus on the image side, mm."""
        heights, slopes = self.ray(1.0, 0.0, last=self._power)
        return float(-heights[-1] / slopes[-1]) if self.focal_length else np.nan

    @cached_property
    def _towards_stop(self) -> tuple[float, float, float, float]:
        """Matrix from height and slope at the first surface to height at the stop and slope before it."""
        stop = self.lens.stop
        if stop == 0:
            return 1.0, 0.0, 0.0, 1.0
        found = []
        for y, u in ((1.0, 0.0), (0.0, 1.0)):
            heights, slopes = self.ray(y, u, last=stop - 1)
            found.append((heights[-1] + self.distances[stop - 1] * slopes[-1], slopes[-1]))
        (a, c), (b, d) = found
        return float(a), float(b), float(c), float(d)

    @cached_property
    def entrance_pupil(self) -> tuple[float, float]:
        """Position behind the first surface, mm (infinite if telecentric), and magnification by the stop."""
        a, b, _, _ = self._towards_stop
        # A ray through the centre of the stop has y a + u b = 0; it crosses the axis at z = -y/u = b/a.
        return (b / a, 1 / a) if abs(a) > 1e-12 else (np.inf, np.inf)

    @cached_property
    def entrance_pupil_radius(self) -> float:
        """Radius of the entrance pupil, mm.

        Raises
        ------
        UsageError
            When the radius of the stop is not known.
        """
        if self.lens.stop_radius is None:
            raise UsageError(
                "the radius of its stop is not known", where=self.lens.name, do="give `stop_radius`"
            )
        return abs(self.entrance_pupil[1]) * self.lens.stop_radius

    @property
    def f_number(self) -> float:
        """Focal length over the diameter of the entrance pupil."""
        return abs(self.focal_length) / (2 * self.entrance_pupil_radius)

    def image_distance(self, object_distance: float) -> float:
        """Distance from the last surface with power to the image of an axial point, mm.

        Parameters
        ----------
        object_distance : float
            From the first surface against the light, positive, mm; may be infinite.
        """
        if np.isinf(object_distance):
            return self.back_focus
        y, u = (float(part[-1]) for part in self.ray(object_distance, 1.0, last=self._power))
        return float(-y / u) if abs(u) > 1e-15 else np.inf

    def principal(self, slope: float) -> tuple[Array, Array]:
        """Heights and slopes at all surfaces of the ray through the centre of the stop."""
        return self.ray(-slope * self.entrance_pupil[0], slope)
