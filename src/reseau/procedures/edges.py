"""Sharpness over a photograph, from its slanted edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.data import Frame
from ..core.failure import Failure
from ..core.provenance import Provenance
from ..io.edges import EdgesDocument, MeasuredEdge
from ..sensor import EdgeSpread, measure_edges
from ..sensor.chart import ChartEdge


@dataclass(frozen=True, eq=False)
class Sharpness:
    """The edges of a photograph; truthy.

    Parameters
    ----------
    frame : Frame
        The photograph.
    edges : tuple of ChartEdge
        Its edges.
    notes : tuple of str
        How grey values were used.
    options : dict
        Parameters, for the provenance.
    """

    frame: Frame
    edges: tuple[ChartEdge, ...]
    notes: tuple[str, ...]
    options: dict[str, Any]

    @property
    def measured(self) -> tuple[ChartEdge, ...]:
        """Those that were measured."""
        return tuple(edge for edge in self.edges if isinstance(edge.found, EdgeSpread))

    @property
    def provenance(self) -> Provenance:
        """Input and parameters."""
        return Provenance({self.frame.name: self.frame.sha256}, self.options)

    def document(self) -> EdgesDocument:
        """Return the file ``reseau-edges/1``."""
        size = self.frame.width, self.frame.height
        rows = tuple(_row(edge, size) for edge in self.edges)
        return EdgesDocument(
            image=self.frame.name,
            sha256=self.frame.sha256,
            size=size,
            edges=rows,
            found=len(self.measured),
            expected=len(rows),
            notes=self.notes,
            provenance=self.provenance.to_dict(),
        )


def normal_of(edge: ChartEdge) -> float:
    """Direction of the normal of an edge in the image, degrees from the x-axis towards y, −90 to 90."""
    along = edge.at.xy[1] - edge.at.xy[0]
    angle = float(np.rad2deg(np.arctan2(along[0], -along[1])))
    return (angle + 90) % 180 - 90


def radial_of(edge: ChartEdge, size: tuple[int, int]) -> float | None:
    """Angle between the normal of an edge and the ray from the centre of the image, 0° to 90°."""
    ray = edge.at.centre - (np.array(size) - 1) / 2
    if not np.hypot(*ray) > 1:
        return None
    away = abs(normal_of(edge) - float(np.rad2deg(np.arctan2(ray[1], ray[0])))) % 180
    return min(away, 180 - away)


def _row(edge: ChartEdge, size: tuple[int, int]) -> MeasuredEdge:
    x, y = edge.at.centre.tolist()
    place: dict[str, Any] = {"id": edge.at.name, "x": x, "y": y, "region": edge.at.region}
    found = edge.found
    if isinstance(found, Failure):
        return MeasuredEdge(**place, ok=False, why=found.reason, code=found.code.value)
    numbers: dict[str, Any] = {}
    for name, each in found.quantities().items():
        numbers |= {name: each.value, f"s_{name}": each.sigma}
    first, last = edge.at.xy.tolist()
    return MeasuredEdge(
        **place,
        ends=((first[0], first[1]), (last[0], last[1])) if edge.at.good is not None else None,
        ok=True,
        angle_deg=float(abs(np.rad2deg(found.angle))),
        normal_deg=normal_of(edge) if edge.at.good is not None else None,
        radial_deg=radial_of(edge, size) if edge.at.good is not None else None,
        mtf=found.to_model().get("mtf"),
        tests=tuple(found.tests()),
        **numbers,
    )


def measure_sharpness(
    frame: Frame,
    regions: Sequence[tuple[int, int, int, int]] = (),
    *,
    options: dict[str, Any] | None = None,
    step: Callable[[str], object] = lambda name: None,
) -> Sharpness | Failure:
    """Measure the slanted edges of a photograph: one, or those of a chart.

    Parameters
    ----------
    frame : Frame
        The photograph; a tone curve that its file states is removed.
    regions : sequence of (left, top, width, height)
        Regions with one edge each; without any, edges are found.
    options : dict
        Parameters, for the provenance.
    step : callable
        Called with the name of each edge before it is measured.

    Returns
    -------
    Sharpness or Failure
        A failure if no edge could be measured.

    Examples
    --------
    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[:64, :64] - 31.5
    >>> noise = np.random.default_rng(1).normal(0, 1, x.shape)
    >>> found = measure_sharpness(Frame(40 + 150 * ndtr((x - 0.1 * y) / 0.9) + noise, 255.0))
    >>> [(edge.id, edge.ok, round(edge.psf, 1)) for edge in found.document().edges]
    [('E1', True, 0.8)]
    """
    curve, notes = frame.curve, list(frame.notes)
    light = frame
    if curve is not None and not curve.linear:
        light = replace(frame, pixels=curve.light(frame.pixels.astype(np.float64), frame.full_scale))
        notes.append(f"grey values made proportional to the light ({curve.source or curve})")
    elif Path(frame.name).suffix.lower() in (".jpg", ".jpeg", ".heic", ".heif") and curve is None:
        notes.append("grey values are taken as proportional to the light: the file states no tone curve")
    edges = measure_edges(light, regions, step=step)
    if isinstance(edges, Failure):
        return edges
    return Sharpness(frame, edges, tuple(notes), dict(options or {}))
