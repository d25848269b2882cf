"""The scans of a roll of film in a session: oriented alone, then again with what the roll has in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any, Protocol, TypeVar

from ..archive import Verdict
from ..core.data import Frame
from ..core.errors import EstimationError
from ..core.failure import Failure
from ..core.provenance import Provenance
from ..io import FrameCorners, FrameOrientation
from ..io.frame import FrameOutcome, RollSummary
from ..io.scans import Scan
from ..measure.film.curves import CurveEvidence, curves_of_roll, curves_of_scan
from ..measure.film.roll import Kind, Roll, corner_files, rolls_of
from .film_frame import FrameOptions, FrameResult, orient_scan, orientation_of, reorient_scan


class _Named(Protocol):
    """A step; see :class:`reseau.capture.Step`."""

    @property
    def name(self) -> str:
        """Name of the scan."""


P = TypeVar("P", bound=_Named)


@dataclass(frozen=True)
class OrientedFrame:
    """A frame of the roll: the scan that it is in, the stem of its file, and its orientation."""

    scan: str
    stem: str
    document: FrameOrientation


class FilmRollProcedure:
    """The procedure in a session: the inner orientation of each scan, and the summary of the roll.

    The same frames give the same results to the byte.

    Parameters
    ----------
    opened : callable
        Returns the scan of a name, with its colours.
    options : FrameOptions
        Prior knowledge of the frames.
    calibrated : FrameCorners, optional
        Calibrated corners of the camera.
    kind : str
        Kind of the transformation to them.
    parameters, inputs : mapping
        Provenance: parameters, and SHA-256 of the input files by name.

    Examples
    --------
    >>> procedure = FilmRollProcedure(lambda name: None, FrameOptions())
    >>> procedure.finish()
    Traceback (most recent call last):
        ...
    reseau.core.errors.EstimationError: roll: no frame could be oriented
    """

    def __init__(
        self,
        opened: Callable[[str], Scan],
        options: FrameOptions,
        *,
        calibrated: FrameCorners | None = None,
        kind: Kind = "affine",
        parameters: Mapping[str, Any] | None = None,
        inputs: Mapping[str, str] | None = None,
    ) -> None:
        self.opened = opened
        self._options, self._calibrated, self._kind = options, calibrated, kind
        self._parameters, self._inputs = dict(parameters or {}), dict(inputs or {})
        self._results: dict[str, list[FrameResult]] = {}
        self._curves: dict[str, CurveEvidence | None] = {}
        self._rolls: tuple[Roll, ...] = ()
        self.frames: tuple[OrientedFrame, ...] = ()

    @property
    def provenance(self) -> Provenance:
        """Inputs and parameters."""
        return Provenance(self._inputs, self._parameters)

    def on_frame(self, frame: Frame, step: _Named) -> Verdict:
        """Orient the frames of a scan; a declined one may be oriented when the roll is known."""
        scan = self.opened(step.name)
        self._results[step.name] = results = orient_scan(scan, self._options)
        self._curves[step.name] = curves_of_scan(scan, (each.curves for each in results))
        self._inputs[step.name] = frame.sha256
        return Verdict(True)

    def verdicts(self) -> dict[str, Verdict]:
        """Return what became of each scan, after :meth:`finish`."""
        found = {}
        for name in self._results:
            mine = [each.document for each in self.frames if each.scan == name]
            said = ", ".join(d.why or d.status if d.status == "declined" else d.status for d in mine)
            found[name] = Verdict(True, facts={"found": said})
        return found

    def progress(self) -> dict[str, float]:
        """Return nothing: no standard deviations are known before the end."""
        return {}

    def next_pose(self, candidates: Sequence[P], wanted: str) -> tuple[P, float | None] | None:
        """Return None: there are no poses."""
        return None

    def summary(self) -> RollSummary:
        """Return what became of the frames, after :meth:`finish`."""
        return RollSummary.of([FrameOutcome.of(each.document, each.stem) for each in self.frames])

    def finish(self) -> dict[str, str]:
        """Return the orientation of each frame, the summary, and the common corners if there are enough.

        Raises
        ------
        EstimationError
            If no frame could be oriented, or a transformation is not determined.
        """
        options: dict[str, FrameOptions] = {}
        for (name, own), curve in zip(
            self._curves.items(), curves_of_roll(self._curves.values()), strict=True
        ):
            options[name] = replace(self._options, curves=None if curve is None else curve.share)
            if curve is not None and not curve.like(own):
                self._results[name] = orient_scan(self.opened(name), options[name])
        self._rolls = rolls_of([each for results in self._results.values() for each in results])
        frames, stems = [], _stems(list(self._results))
        for name, results in self._results.items():
            if self._rolls and any(each.status != "oriented" for each in results):
                results = reorient_scan(self.opened(name), self._rolls, results, options[name])
            for k, each in enumerate(results, start=1):
                found = orientation_of(each, self._calibrated, self._kind)
                if isinstance(found, Failure):
                    raise EstimationError(found.reason, where=name, do="give other corners")
                stem = stems[name] if len(results) == 1 else f"{stems[name]}-{k}"
                frames.append(OrientedFrame(name, stem, found))
        self.frames = tuple(frames)
        if all(each.document.status == "declined" for each in frames):
            why = frames[0].document.why if len(frames) == 1 else ""
            raise EstimationError(f"no frame could be oriented{why and f' ({why})'}", where="roll")
        made = {f"orientation {each.stem}.json": each.document.to_json() for each in frames}
        made["summary.json"] = self.summary().to_json()
        return made | {name: each.to_json() for name, each in corner_files(self._rolls).items()}


def _stems(names: list[str]) -> dict[str, str]:
    """Names without their suffixes, numbered where several are equal."""
    stems = [PurePath(name).stem or name for name in names]
    return {
        name: stem if stems.count(stem) == 1 else f"{stem}-{stems[: k + 1].count(stem)}"
        for k, (name, stem) in enumerate(zip(names, stems, strict=True))
    }
