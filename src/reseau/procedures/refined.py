"""The results of the oscilloscope procedure for a series of photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration import Calibration, InstrumentCorrection
from ..core.data import Frame, ImagePoints
from ..core.display import Display
from ..core.errors import UsageError
from ..core.failure import Estimated
from ..core.lazy import above
from ..core.provenance import canonical_json
from ..io import ReseauDesign
from ..io.points import points_document
from .oscilloscope import PhotoI, PhotoII, PhotoIII, StillStandard, note_entries

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, repr=False)
class Refined(Estimated, Display):
    """The oscilloscope procedure's results, one for each photograph that was given.

    Parameters
    ----------
    photo_i : PhotoI or None
        The camera's correction (group A).
    photo_ii : PhotoII or None
        The instrument's correction (group B).
    photo_iii : tuple of PhotoIII
        True coordinates of the body in each further photograph.
    reseau, test_object : ReseauDesign
        The designs.
    again : StillStandard, optional
        The test of a stored calibration by a new PHOTO II.
    instrument : InstrumentCorrection, optional
        Groups A and B that were applied to PHOTO III.
    photographs : tuple
        All photographs as they were given.
    """

    photo_i: PhotoI | None
    photo_ii: PhotoII | None
    photo_iii: tuple[PhotoIII, ...]
    reseau: ReseauDesign
    test_object: ReseauDesign | None = None
    again: StillStandard | None = None
    instrument: InstrumentCorrection | None = None
    photographs: tuple[Any, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photographs III."""
        third = self.photographs[len(self.photographs) - len(self.photo_iii) :]
        return tuple(each.name if isinstance(each, Path) else f"photo {k}" for k, each in enumerate(third, 1))

    def calibration(
        self,
        name: str = "oscilloscope",
        provenance: Mapping[str, Any] | None = None,
        times: Mapping[str, str] | None = None,
    ) -> Calibration:
        """Return the calibration of groups A and, with PHOTO II, B.

        Raises
        ------
        UsageError
            When the photographs were corrected by a stored calibration.
        """
        about: dict[str, Any] = {"name": name, "provenance": provenance, "times": times}
        if self.photo_ii is not None and self.test_object is not None:
            return self.photo_ii.instrument.calibration(self.reseau, self.test_object, **about)
        if self.photo_i is None:
            raise UsageError("was given and not computed", where="calibration")
        return self.photo_i.camera.calibration(**about)

    def applied(self) -> str:
        """Return true coordinates, and the test of a stored calibration, as JSON."""
        documents = [] if self.again is None else [{"image": self.photographs[0].name} | self.again.entries()]
        if self.instrument is not None:
            for name, found in zip(self.names, self.photo_iii, strict=True):
                points = points_document(found.true, self.instrument.unit, "object")
                documents.append(points | {"image": name} | note_entries(found.notes))
        return canonical_json(documents[0] if len(documents) == 1 else documents)

    def true_points(self) -> ImagePoints:
        """Return the true coordinates of all bodies; of several, names begin with their photograph's."""
        several = len(self.photo_iii) > 1
        parts = list(zip(self.names, self.photo_iii, strict=True))
        return ImagePoints(
            tuple(
                f"{Path(image).stem}:{n}" if several else n for image, each in parts for n in each.true.names
            ),
            np.concatenate([each.true.xy for _, each in parts]),
            np.concatenate([each.true.cov for _, each in parts]),
        )

    def report_page(self, frames: Sequence[Frame | None] = (), **about: Any) -> str:
        """Return the report, an HTML page.

        Parameters
        ----------
        frames : sequence of Frame or None
            The photographs as they were given, without those of which there are coordinates only.
        **about
            Title and provenance; see :func:`reseau.report.oscilloscope_report`.
        """
        page: str
        if self.photo_i is None:
            later = frames[self.again is not None :]
            page = above("reseau.report.page:applied_report")(
                self.test_object, self.photo_iii, self.again, frames=later, **about
            )
            return page
        page = above("reseau.report.page:oscilloscope_report")(
            self.photo_i, self.reseau, self.photo_ii, self.test_object, self.photo_iii, frames=frames, **about
        )
        return page

    def write(self, path: Path | str) -> None:
        """Write the calibration, or true coordinates to a CSV file.

        Parameters
        ----------
        path : str or Path
            A file that ends in ``.json`` for the calibration, or ``.csv`` for the true coordinates of the
            first body.

        Raises
        ------
        UsageError
            When there is no such result, or the file has another suffix.
        InputError
            When the file cannot be written.
        """
        suffix = Path(path).suffix.lower()
        if suffix == ".json":
            self.calibration(Path(path).stem).write(path)
        elif suffix == ".csv" and self.photo_iii:
            self.photo_iii[0].true.write(path)
        else:
            raise UsageError("is neither .json nor, with PHOTO III, .csv", where=path)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the true coordinates of the first body, or the residuals of PHOTO I, with matplotlib.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        """
        from ..core.figures import Panel, draw_vectors, new_axes

        if self.photo_iii:
            return self.photo_iii[0].true.plot(axes, y_down=False)
        fit = None if self.photo_i is None else self.photo_i.camera.fit
        if fit is None:
            raise UsageError("was not computed", where="PHOTO I")
        axes = new_axes(axes)
        check = (fit.check_target, fit.check.xy - fit.check_target)
        draw_vectors(
            axes, (fit.target, fit.residuals), check, Panel(self.reseau.unit), "residuals of PHOTO I"
        )
        return axes

    def _facts(self) -> list[tuple[str, str]]:
        facts = []
        if self.photo_i is not None:
            facts.append(("PHOTO I", f"{len(self.photo_i.points)} marks"))
        if self.photo_ii is not None:
            facts.append(("PHOTO II", f"{len(self.photo_ii.pins)} rods"))
        facts += [("PHOTO III", f"{len(found.true)} points") for found in self.photo_iii]
        return facts

    def _columns(self) -> dict[str, list[Any]]:
        if not self.photo_iii:
            raise UsageError("has no PHOTO III", where="Refined")
        return self.photo_iii[0].true._columns()
