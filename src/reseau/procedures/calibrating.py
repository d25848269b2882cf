"""From photographs of a target, in files or in memory, to the calibration of their cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..calibration.sensor import SensorCorrection
from ..core.data import Frame, ImagePoints
from ..core.failure import Failure
from ..core.provenance import sha256_of
from ..execution import Executor, Outputs
from ..io.images import Channel
from ..measure.testfield.measure import TestfieldOptions
from .calibrated import Calibrated
from .calibration import calibrate_camera
from .calibration_options import CalibrationOptions, CameraOptions
from .exposures import Taken, photograph_reader, photographs_of
from .target_measurement import Photograph, drawing_overlays, measurer_of
from .which_target import Design, target_of


def calibrate_photographs(
    photographs: Sequence[tuple[str, Path | Frame | ImagePoints]],
    design: Design | None = None,
    size: tuple[int, int] | Mapping[str, tuple[int, int]] | None = None,
    model: CameraOptions | Mapping[str, CameraOptions] | None = None,
    options: CalibrationOptions | None = None,
    taken: Mapping[str, Taken] | None = None,
    *,
    channel: Channel = "luma",
    correction: SensorCorrection | None = None,
    testfield: TestfieldOptions | None = None,
    overlays: Mapping[str, Path] | None = None,
    executor: Executor | None = None,
    store: str = "",
    about: Mapping[str, Any] | None = None,
    note: Callable[[str], None] | None = None,
    step: Callable[[str], None] = lambda _: None,
) -> Calibrated | Failure:
    """Calibrate a camera, or several that are fixed to each other; the target is found where none is given.

    Parameters
    ----------
    photographs : sequence of (str, Path or Frame or ImagePoints)
        Names, and photographs or what was measured in them.
    design : Design, optional
        The target; by default it is looked for, see :func:`~reseau.procedures.which_target.target_of`.
    size, model, options, taken
        See :func:`~reseau.procedures.calibration.calibrate_camera`.
    channel, correction
        How photographs are read; see :func:`~reseau.procedures.exposures.photograph_reader`.
    testfield : TestfieldOptions, optional
        Options of the measurement; see :func:`~reseau.procedures.target_measurement.measurer_of`.
    overlays : mapping of str to Path, optional
        Files in which is drawn what was measured, by names of photographs.
    executor : Executor, optional
        What measures the photographs; by default this process.
    store : str, optional
        Folder or URL that keeps what is measured.
    about : mapping, optional
        Further options on which measurements depend, for the store.
    note : callable, optional
        Is called with what target was found, at once; by default it is among the notes of the result.
    step : callable
        Is called with what is measured next.

    Returns
    -------
    Calibrated or Failure
        A failure where no target is found, fewer than three images of a camera show it, or the adjustment
        fails.

    Raises
    ------
    UsageError, ArchiveError
        As :func:`~reseau.procedures.calibration.calibrate_camera`; when the store cannot be used.

    Examples
    --------
    >>> calibrate_photographs([]).code
    <Code.NOT_FOUND: 'not-found'>
    """
    read, testfield = photograph_reader(channel, correction), testfield or TestfieldOptions()
    notes = list[str]()
    if design is None:
        found = target_of([photograph for _, photograph in photographs], read)
        if isinstance(found, Failure):
            return found
        text, design = found
        (note or notes.append)(text)
    measure, kept = measurer_of(design, testfield), None
    if overlays:
        measure = drawing_overlays(measure, overlays)
    elif store:  # overlays are drawn while photographs are measured
        form = {
            "compute": "points of a target", "design": sha256_of(design.to_json().encode()),
            "fill": testfield.fill, "channel": channel, "row_jitter_px": testfield.row_jitter_px,
        }  # fmt: skip
        kept = Outputs(store, form | dict(about or {}))
    said, frames = photographs_of(photographs, read, one_lens=not taken, store=store)
    options = options or CalibrationOptions()
    options = options if options.focal_35_mm else replace(options, focal_35_mm=said)
    shown = _shown(frames, step)
    done = calibrate_camera(shown, design, measure, size, model, options, taken or None, executor, kept)
    if isinstance(done, Failure):
        return done
    sources = {name: source for name, source in photographs if isinstance(source, Path)}
    return done.described(notes=(*notes, *done.notes), target=design.name, sources=sources, channel=channel)


def _shown(photographs: Iterator[Photograph], step: Callable[[str], None]) -> Iterator[Photograph]:
    """The photographs, each of which is a step."""
    for each in photographs:
        step(f"measuring {each[0] if isinstance(each, tuple) else each.name}")
        yield each
