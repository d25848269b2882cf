"""The oscilloscope procedure in an acquisition: PHOTO I, II and III are corrected as they are taken."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from ..archive import Verdict
from ..core.data import Frame
from ..core.environment import Surroundings
from ..core.errors import EstimationError
from ..core.failure import Code, Failure
from ..core.provenance import Provenance
from ..io import ReseauDesign
from .oscilloscope import PhotoI, PhotoII, PhotoIII, photo_i, photo_ii, photo_iii


class _Named(Protocol):
    """A step; see :class:`reseau.capture.Step`."""

    @property
    def name(self) -> str:
        """PHOTO I, PHOTO II or PHOTO III."""


P = TypeVar("P", bound=_Named)


class OscilloscopeProcedure:
    """The procedure in an acquisition: corrects PHOTO I, II and III as they are taken.

    The same frames give the same results to the byte, live and from the archive.

    Parameters
    ----------
    reseau, test_object : ReseauDesign
        The reseau and the rods.
    name : str
        Name of the calibration.
    options, inputs : mapping
        Provenance: parameters, and SHA-256 of the input files by name.
    check : iterable of str
        Marks of PHOTO I used as check points only.

    Examples
    --------
    >>> from reseau.designs import standard_reseau, test_object
    >>> procedure = OscilloscopeProcedure(standard_reseau(), test_object(), name="monday")
    >>> procedure.finish()
    Traceback (most recent call last):
        ...
    reseau.core.errors.EstimationError: PHOTO I: could not be corrected; see the verdicts on its frames
    """

    def __init__(
        self,
        reseau: ReseauDesign,
        test_object: ReseauDesign,
        *,
        name: str,
        options: Mapping[str, Any] | None = None,
        inputs: Mapping[str, str] | None = None,
        check: Iterable[str] = (),
    ) -> None:
        self.reseau, self.test_object, self.name = reseau, test_object, name
        self._check = tuple(check)
        self._options, self._inputs = dict(options or {}), dict(inputs or {})
        self._surroundings = Surroundings()
        self.first: PhotoI | None = None
        self.second: PhotoII | None = None
        self.third: PhotoIII | None = None

    @property
    def provenance(self) -> Provenance:
        """Inputs and parameters."""
        return Provenance(self._inputs, self._options, environment=self._surroundings.summary())

    def on_frame(self, frame: Frame, step: _Named) -> Verdict:
        """Correct a photograph; the name of its step says which one it is."""
        found = self._corrected(frame, step.name)
        if isinstance(found, Failure):
            return Verdict(False, found.reason)
        self._inputs[step.name] = frame.sha256
        self._surroundings.add(step.name, step)
        points = {PhotoI: "points", PhotoII: "pins", PhotoIII: "points"}[type(found)]
        return Verdict(True, facts={"points": len(getattr(found, points))})

    def _corrected(self, frame: Frame, photo: str) -> PhotoI | PhotoII | PhotoIII | Failure:
        if photo == "PHOTO I":
            one = photo_i(frame, self.reseau, check=self._check)
            self.first = None if isinstance(one, Failure) else one
            return one
        if photo == "PHOTO II":
            if self.first is None:
                return Failure("PHOTO I is not corrected", Code.PREREQUISITE_MISSING)
            two = photo_ii(frame, self.reseau, self.test_object, self.first.camera)
            self.second = None if isinstance(two, Failure) else two
            return two
        if photo == "PHOTO III":
            if self.second is None:
                return Failure("PHOTO II is not corrected", Code.PREREQUISITE_MISSING)
            three = photo_iii(frame, self.second.instrument, self.reseau)
            self.third = None if isinstance(three, Failure) else three
            return three
        return Failure(f"{photo} is not a photograph of this procedure", Code.UNKNOWN_STEP)

    def progress(self) -> dict[str, float]:
        """Return nothing: no standard deviations are known before the end."""
        return {}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """Return None: the photographs are taken from one position."""
        return None

    def finish(self) -> dict[str, str]:
        """Return the calibration of camera and instrument, and the true coordinates of the body if present.

        Raises
        ------
        EstimationError
            If PHOTO I or II could not be corrected.
        """
        if self.second is None:
            what = "PHOTO I" if self.first is None else "PHOTO II"
            raise EstimationError("could not be corrected", where=what, do="see the verdicts on its frames")
        calibration = self.second.instrument.calibration(
            self.reseau, self.test_object, name=self.name, provenance=self.provenance.to_dict(), times={}
        )
        made = {"calibration.json": calibration.to_json()}
        if self.third is not None:
            made["true.csv"] = self.third.true.to_csv()
        return made
