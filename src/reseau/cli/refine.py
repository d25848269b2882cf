"""`reseau refine`: the oscilloscope procedure on files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from ..core import vocabulary as v
from ..core.files import writable
from ..core.options import Option
from .common import (
    orientation,
    overlay_files,
    probability,
    progress,
    read_photo,
    required,
    say,
)
from .measure import BY_DESIGN, NOT_NOMINAL

if TYPE_CHECKING:
    from ..core.data import Frame, ImagePoints
    from ..core.provenance import Provenance
    from ..io import ReseauDesign
    from ..procedures.oscilloscope import PhotoI, PhotoII, StillStandard
    from ..procedures.refining import RefineOptions


@dataclass(frozen=True)
class _Files:
    """The input files and options of a run."""

    photo_i: Annotated[Path | None, Option("PHOTO I: the reseau alone.")] = None
    photo_ii: Annotated[
        Path | None,
        Option("PHOTO II: the test object behind the reseau; with --calibration, test it."),
    ] = None
    photo_iii: Annotated[tuple[Path, ...], Option("PHOTO III: the body to measure; repeatable.")] = ()
    reseau: v.Reseau | None = None
    test_object: v.TestObject | None = None
    calibration: Annotated[
        Path | None, Option("Stored calibration: apply it to PHOTO III, or test it with PHOTO II.")
    ] = None
    points: Annotated[Path | None, Option("Points of the body in PHOTO III (JSON, CSV).")] = None
    check: Annotated[v.Check, "Here also rods."] = ()
    alpha: Annotated[v.Alpha, "Here of the coefficients."] = 0.05
    mirrored: Annotated[v.Mirrored | None, BY_DESIGN] = None
    max_rotation_deg: Annotated[v.MaxRotationDeg | None, NOT_NOMINAL] = None
    overlay: Annotated[v.Overlay | None, "Here a folder, for all photographs; FILE.png for one."] = None

    @property
    def photographs(self) -> list[Path]:
        """The photographs in their order."""
        return [path for path in (self.photo_i, self.photo_ii, *self.photo_iii) if path is not None]

    @cached_property
    def overlays(self) -> Mapping[Path, Path]:
        """The overlay of each photograph, if overlays are wanted."""
        return {} if self.overlay is None else overlay_files(self.overlay, self.photographs)

    def options(self) -> RefineOptions:
        """Options of the procedure; the points of the body are read."""
        from ..io.reading import read_measurement
        from ..measure.pins.detection import PinOptions
        from ..measure.reseau.marks import ReseauOptions
        from ..procedures.refining import RefineOptions

        return RefineOptions(
            self.check, self.alpha, ReseauOptions(**orientation(self.mirrored, self.max_rotation_deg)),
            PinOptions(**orientation(None, self.max_rotation_deg)),
            None if self.points is None else read_measurement(self.points).image_points(),
        )  # fmt: skip

    def draw(self, path: Path, photo: Frame | ImagePoints, found: Any) -> None:
        """Write the overlay of a photograph, if one is wanted: its marks and rods, or why there are none."""
        from ..core.data import Frame
        from ..core.failure import Failure
        from ..core.overlay import FOUND, OTHER, draw_overlay

        if path not in self.overlays or not isinstance(photo, Frame):
            return
        if isinstance(found, Failure):
            found.overlay(photo, self.overlays[path])
            return
        marks = getattr(found, "marks", None)
        layers = [] if found.measured is None else found.measured.layers()
        if marks is not None:  # beside the rods, the marks have no names and another colour
            layers += [
                replace(
                    layer,
                    names=(),
                    label=f"reseau: {layer.label}",
                    colour=OTHER if layer.colour == FOUND else layer.colour,
                )
                for layer in marks.layers()
            ]
        draw_overlay(photo.pixels, layers, photo.name, [str(n) for n in found.notes], self.overlays[path])

    def provenance(self) -> Provenance:
        """Hashes of the inputs, and the options."""
        from ..core.provenance import Provenance, sha256_of

        named = (self.photo_i, self.photo_ii, self.reseau, self.test_object, self.calibration, self.points)
        paths = [path for path in named if path is not None] + list(self.photo_iii)
        inputs = {path.name: sha256_of(path) for path in paths}
        options: dict[str, Any] = {"alpha": self.alpha, "check": list(self.check)}
        if self.mirrored is not None:
            options["mirrored"] = self.mirrored
        if self.max_rotation_deg is not None:
            options["max_rotation_deg"] = self.max_rotation_deg
        return Provenance(inputs, options)

    def frames(self) -> list[Frame | None]:
        """The photographs in their order; None for coordinates."""
        from ..io.images import read_image
        from ..io.reading import is_points

        return [None if is_points(path) else read_image(path) for path in self.photographs]


def refine(
    files: _Files,
    out: v.Out | None = None,
    true: Annotated[Path | None, Option("File to write true coordinates to (CSV, JSON).")] = None,
    report: v.Report | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Correct oscilloscope photographs: camera (PHOTO I), instrument (II), true coordinates (III).

    Each photograph is an image, or a file with the coordinates of its marks, rods and points, which are
    identified by their names. With --calibration, --out contains the true coordinates and the test;
    otherwise it contains the calibration.
    """
    from ..calibration import read_calibration
    from ..core.failure import Failure
    from ..core.provenance import canonical_json
    from ..core.threads import one_thread
    from ..io import ReseauDesign, write_whole
    from ..io.points import points_document
    from ..procedures.refining import Photographs, refine_photographs

    writable(out, ".json")
    writable(report, ".html")
    writable(true, ".csv", ".json")
    assert files.overlays is not None  # their names are checked before anything is computed
    photographs = Photographs(files.photo_i, files.photo_ii, files.photo_iii)
    grid, rods = (
        None if path is None else ReseauDesign.read(path) for path in (files.reseau, files.test_object)
    )
    stored = None if files.calibration is None else read_calibration(files.calibration)
    # With one thread results do not depend on the number of processors.
    with one_thread(), progress("correcting", len(photographs.given)) as step:

        def seen(path: Path, photo: Frame | ImagePoints, result: Any) -> None:
            files.draw(path, photo, result)
            step(path.name)

        found = refine_photographs(
            photographs, grid, rods, stored, files.options(), read=read_photo, seen=seen
        )
    done = required(found, found.where if isinstance(found, Failure) else "")
    provenance = files.provenance()
    if stored is None:
        times = {"computed": datetime.now(UTC).isoformat(timespec="seconds")}
        title = f"{done.reseau.name} {photographs.given[0].stem}"
        content = done.calibration(title, provenance.to_dict(), times).to_json()
    else:
        title, content = (
            f"{stored.name}: {', '.join(path.name for path in photographs.given)}",
            done.applied(),
        )
    page = "" if report is None else done.report_page(files.frames(), title=title, provenance=provenance)
    if out is not None:
        write_whole(out, content)
    if report is not None:
        write_whole(report, page)
    unit = "" if done.instrument is None else done.instrument.unit
    if true is not None and done.photo_iii:
        points = done.true_points()
        as_text = canonical_json(points_document(points, unit, "object"))
        write_whole(true, as_text if true.suffix.lower() == ".json" else points.to_csv())
    if as_json:
        say(content)
        return
    if done.photo_i is not None and files.photo_i is not None:
        _say_first(files.photo_i, done.photo_i, done.reseau)
    if done.photo_ii is not None and files.photo_ii is not None:
        _say_second(files.photo_ii, done.photo_ii)
    if done.again is not None and files.photo_ii is not None:
        _say_again(files.photo_ii, done.again, unit)
    for name, body in zip(done.names, done.photo_iii, strict=True):
        say(f"{name}: {len(body.true)} points in {unit}\n")
        _say_notes(body.notes)
        if true is None:
            say(body.true.to_csv())


def _say_notes(notes: Iterable[object]) -> None:
    say("".join(f"  note: {note}\n" for note in notes))


def _say_again(path: Path, again: StillStandard, unit: str) -> None:
    import numpy as np

    from ..core.numbers import measured

    test = again.test
    verdict = "are still valid" if test.holds else "are no longer valid"
    rod, length = test.largest
    at = test.names.index(rod)
    direction = test.change[at] / length if length > 0 else np.full(2, np.sqrt(0.5))
    largest = measured(length, float(np.linalg.norm(direction * test.sigma[at])), unit)
    say(f"{path.name}: the coefficients {verdict} (χ² = {test.statistic:.1f}, {test.degrees} degrees of ")
    say(f"freedom, {probability(test.p)}); largest change {largest} at rod {rod}\n")
    _say_notes(again.notes)


def _say_first(path: Path, first: PhotoI, design: ReseauDesign) -> None:
    fit, names = first.camera.fit, first.camera.model.names
    dropped = () if fit is None else fit.elimination.dropped
    say(f"{path.name}: {len(first.points)} marks, {len(names) - len(dropped)} significant coefficients\n")
    if fit is not None:
        x, y = (fit.residuals**2).mean(axis=0) ** 0.5
        say(f"  residuals {x:.2g} {design.unit} in x, {y:.2g} {design.unit} in y (rms)\n")
    _say_notes(first.notes)


def _say_second(path: Path, second: PhotoII) -> None:
    instrument = second.instrument
    fit, (along, across) = instrument.fit, instrument.plane.scale
    insignificant = () if fit is None else fit.elimination.dropped
    say(f"{path.name}: {len(second.pins)} rods, scales λ1 = {along:.4f}, λ2 = {across:.4f}\n")
    if insignificant:
        say(f"  not significant: {', '.join(insignificant)}\n")
    if second.causes is not None:
        for test in second.causes.conditions:
            verdict = "is satisfied" if test.holds else "is not satisfied"
            say(f"  {test.condition} {verdict} (χ² = {test.statistic:.2f}, {probability(test.p)})\n")
    if fit is not None and fit.displays is not None:
        better = {
            "first": "the polynomials predict the rods better than Wong's model",
            "second": "Wong's model predicts the rods better than the polynomials",
        }
        verdict = better.get(
            fit.displays.verdict, "no significant difference between the polynomials and Wong's model"
        )
        say(f"  {verdict} ({probability(fit.displays.p)})\n")
    if fit is not None and fit.local is not None and instrument.local is not None:
        level = probability(float(fit.local.need.min()))
        say(f"  residuals are correlated ({level}): corrected with a local model\n")
    _say_notes(second.notes)
