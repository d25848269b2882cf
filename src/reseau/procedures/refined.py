"""The results of the oscilloscope procedure for a series of photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..calibration import Calibration
from ..core.display import Display
from ..core.errors import UsageError
from ..core.failure import Estimated
from ..io import ReseauDesign
from .oscilloscope import PhotoI, PhotoII, PhotoIII

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Refined"]


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
    """

    photo_i: PhotoI | None
    photo_ii: PhotoII | None
    photo_iii: tuple[PhotoIII, ...]
    reseau: ReseauDesign
    test_object: ReseauDesign | None = None

    def calibration(self, name: str = "oscilloscope") -> Calibration:
        """Return the calibration of groups A and, with PHOTO II, B.

        Raises
        ------
        UsageError
            When the photographs were corrected by a stored calibration.
        """
        if self.photo_ii is not None and self.test_object is not None:
            return self.photo_ii.instrument.calibration(self.reseau, self.test_object, name=name)
        if self.photo_i is None:
            raise UsageError("was given and not computed", where="calibration")
        return self.photo_i.camera.calibration(name=name)

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
