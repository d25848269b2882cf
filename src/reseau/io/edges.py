"""``reseau-edges/1``: sharpness of the slanted edges of a photograph."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field

from .document import Document, Strict


class MeasuredEdge(Strict):
    """One edge, measured or not.

    `x`, `y` is its middle (px), `ends` are its ends, `region` is left, top, width, height. `normal_deg` is
    the direction of its normal, along which the modulation transfer is, from the x-axis towards y;
    `radial_deg` the angle between the normal and the ray from the centre of the image, 0 for the MTF along
    the ray. Widths and frequencies: `psf` (px) and `mtf50` (1/px) of a Gaussian, `mtf50_free` and
    `mtf_nyquist_free` of the free curve, each with its standard deviation `s_…`; `mtf` is the curve, and
    `tests` are its tests.

    Examples
    --------
    >>> MeasuredEdge(id="E1", x=4.0, y=2.0, region=(0, 0, 8, 4), ok=False, why="too short").ok
    False
    """

    id: str
    x: float
    y: float
    region: tuple[int, int, int, int]
    ends: tuple[tuple[float, float], tuple[float, float]] | None = None
    ok: bool
    why: str = ""
    code: str = ""
    angle_deg: float | None = None
    normal_deg: float | None = None
    radial_deg: float | None = None
    psf: float | None = None
    s_psf: float | None = None
    mtf50: float | None = None
    s_mtf50: float | None = None
    mtf50_free: float | None = None
    s_mtf50_free: float | None = None
    mtf_nyquist_free: float | None = None
    s_mtf_nyquist_free: float | None = None
    mtf: dict[str, list[float]] | None = None
    tests: tuple[dict[str, Any], ...] = ()


class EdgesDocument(Document):
    """``reseau-edges/1``: sharpness of the slanted edges of a photograph, and why others were not measured.

    Examples
    --------
    >>> EdgesDocument(image="a.png", sha256="", size=(8, 4), edges=(), found=0, expected=0).found
    0
    """

    SCHEMA: ClassVar[str] = "reseau-edges/1"
    image: str
    sha256: str
    size: tuple[int, int]
    edges: tuple[MeasuredEdge, ...]
    found: int
    expected: int
    notes: tuple[str, ...] = ()
    provenance: dict[str, Any] = Field(default_factory=dict)
