"""The fiducial marks of one photograph as measured, and its inner orientation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...adjust import Adjustment
from ...calibration.film import TRANSFORMS
from ...core.data import Array, ImagePoints, Mask
from ...core.display import Display
from ...core.failure import Code, Remark
from ...core.overlaid import Overlaid
from ...io import FiducialDesign, FiducialOrientation, FrameTransform, MeasuredCorner, MeasuredFiducial
from ..film.roll import Kind
from ..points import Reason
from .search import Attitude

if TYPE_CHECKING:
    from ...core.overlay import Layer


@dataclass(frozen=True, eq=False, repr=False)
class FiducialResult(Display, Overlaid):
    """Fiducial marks of one photograph, and its inner orientation.

    Parameters
    ----------
    image, sha256 : str
        The scan.
    design : FiducialDesign
        The camera.
    size : (int, int)
        Width and height of the scan.
    attitude : Attitude
        How the film lies in the scan.
    px_per_mm : float
        Scale.
    xy, cov : ndarray (n, 2), (n, 2, 2)
        Marks in pixels of the scan; NaN where not measured.
    common : ndarray (n, 2, 2)
        What the covariances contain of errors of a learnt mark, which all marks of its kind have.
    negative : bool
        Whether the scan shows bright marks of the design dark, and dark ones bright.
    ok : ndarray of bool (n,)
        Which marks were measured.
    why : tuple of str (n,)
        Why not.
    predicted : ndarray (n, 2)
        Positions by the transformation.
    likeness, psf_px : ndarray (n,)
        Correlation with the formed mark, and width of the point-spread function in pixels of the scan.
    kind : str
        Of the transformation.
    fit : Adjustment
        The transformation from scan coordinates to the calibrated ones.
    shared : ndarray (u, u)
        Covariance of its parameters by errors of learnt marks.
    residuals : ndarray (n, 2)
        Transformed minus calibrated coordinates, mm.
    notes : tuple of Remark
        What to know about the result.

    Examples
    --------
    >>> from reseau.io import FiducialMark, FiducialPoint, MarkPart
    >>> dot = FiducialMark(polarity="bright", parts=(MarkPart(shape="disk", size=0.2),))
    >>> places = {"1": (100, 0), "2": (-100, 0), "3": (0, 100)}
    >>> points = tuple(FiducialPoint(id=k, x=x, y=y, mark="dot") for k, (x, y) in places.items())
    >>> design = FiducialDesign(name="camera", marks={"dot": dot}, points=points)
    >>> uv, none, one = design.xy, np.zeros((3, 2)), np.ones(3)
    >>> from reseau.measure.fitting import fit_mapping
    >>> from reseau.optics import RationalPolynomial
    >>> fit = fit_mapping(RationalPolynomial.similarity(), ImagePoints.with_sigma("123", uv, 0.01), uv)
    >>> found = FiducialResult(
    ...     "7.tif", "", design, (2300, 2300), Attitude(0, False), 10.0, 1149.5 + uv * [10, -10],
    ...     np.tile(0.01 * np.eye(2), (3, 1, 1)), np.zeros((3, 2, 2)), False, one > 0, ("", "", ""), none,
    ...     one, one, "similarity", fit, np.zeros((4, 4)), none, ())
    >>> found.document().marks[0].at.x, found.sigma_mm
    (2149.5, (0.0, 0.0))
    """

    image: str
    sha256: str
    design: FiducialDesign
    size: tuple[int, int]
    attitude: Attitude
    px_per_mm: float
    xy: Array
    cov: Array
    common: Array
    negative: bool
    ok: Mask
    why: tuple[str, ...]
    predicted: Array
    likeness: Array
    psf_px: Array
    kind: Kind
    fit: Adjustment
    shared: Array
    residuals: Array
    notes: tuple[Remark, ...]

    @property
    def sigma_mm(self) -> tuple[float, float] | None:
        """Standard deviation of a coordinate in X and Y by the residuals; None without redundancy."""
        free = 2 * int(self.ok.sum()) - len(self.fit.values)
        if free <= 0:
            return None
        sx, sy = np.sqrt((self.residuals[self.ok] ** 2).sum(axis=0) / (free / 2))
        return float(sx), float(sy)

    @property
    def covariance(self) -> Array:
        """Covariance matrix of the transformation's parameters; enlarged where residuals ask for it."""
        return np.asarray(self.fit.covariance + self.shared)

    def _facts(self) -> list[tuple[str, str]]:
        sigma = self.sigma_mm
        return [
            ("image", self.image),
            ("measured", f"{int(self.ok.sum())} of {len(self.ok)}"),
            ("film", f"{self.attitude}, negative" if self.negative else str(self.attitude)),
            (
                self.kind,
                "no residuals" if sigma is None else f"residuals {sigma[0]:.2g}, {sigma[1]:.2g} mm",
            ),
        ]

    @property
    def points(self) -> ImagePoints:
        """The marks that were measured."""
        names = tuple(name for name, ok in zip(self.design.ids, self.ok, strict=True) if ok)
        return ImagePoints(names, self.xy[self.ok], self.cov[self.ok])

    def document(self) -> FiducialOrientation:
        """The result as a document."""
        marks = tuple(
            MeasuredFiducial(
                id=name,
                at=MeasuredCorner.from_columns(self.xy[k], self.cov[k]) if self.ok[k] else None,
                ok=bool(self.ok[k]),
                why=str(self.why[k]),
            )
            for k, name in enumerate(self.design.ids)
        )
        spread = [None] * len(self.fit.values) if self.sigma_mm is None else np.sqrt(np.diag(self.covariance))
        transform = FrameTransform(
            kind=self.kind,
            parameters={
                name: {"value": float(v), "sigma": None if s is None else float(s)}
                for name, v, s in zip(TRANSFORMS[self.kind].names, self.fit.values, spread, strict=True)
            },
            residuals_mm={
                name: (float(x), float(y))
                for name, (x, y), ok in zip(self.design.ids, self.residuals, self.ok, strict=True)
                if ok
            },
            sigma_mm=self.sigma_mm,
        )
        return FiducialOrientation(
            image=self.image,
            sha256=self.sha256,
            camera=self.design.name,
            status="oriented",
            why="",
            size=self.size,
            px_per_mm=self.px_per_mm,
            rotation_deg=self.attitude.rotation,  # type: ignore[arg-type]
            mirrored=self.attitude.mirrored,
            negative=self.negative,
            marks=marks,
            transform=transform,
            covariance=tuple(tuple(map(float, row)) for row in self.covariance),
            extent=_extent(self.design),
            notes=tuple(str(note) for note in self.notes),
            note_codes=tuple(note.code.value for note in self.notes),
        )

    def layers(self) -> list[Layer]:
        """What is drawn over the scan: measured marks, and those that were not measured."""
        from ...core.overlay import Layer, declined_layers

        ids, rest = self.design.ids, np.flatnonzero(~self.ok)
        measured = Layer(
            f"measured, {int(self.ok.sum())}", self.points.xy, self.points.names, self.points.cov
        )
        codes = [_code(self.why[i]).value for i in rest]
        declined = declined_layers(
            [ids[i] for i in rest], self.predicted[rest], [str(self.why[i]) for i in rest], codes
        )
        return [measured, *declined]

    def _heading(self) -> str:
        return f"{self.image}: {int(self.ok.sum())} of {len(self.ok)} fiducial marks, {self.attitude}"

    def _footnotes(self) -> list[str]:
        return [str(note) for note in self.notes]


def _code(why: str) -> Code:
    return why.code if isinstance(why, Reason) else Code.DECLINED


def _extent(design: FiducialDesign) -> tuple[float, float, float, float]:
    if design.extent is not None:
        return design.extent
    low, high = design.xy.min(axis=0), design.xy.max(axis=0)
    room = 0.02 * (high - low)
    (left, bottom), (right, top) = (low - room).tolist(), (high + room).tolist()
    return left, bottom, right, top
