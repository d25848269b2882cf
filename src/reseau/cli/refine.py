"""`reseau refine`: the oscilloscope procedure on files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.options import Option
from .common import (
    orientation,
    overlay_files,
    probability,
    progress,
    read_photo,
    required,
    say,
    suffix_of,
    writable,
)
from .measure import BY_DESIGN, NOT_NOMINAL

if TYPE_CHECKING:
    from ..calibration import InstrumentCorrection
    from ..core.data import Frame, ImagePoints
    from ..core.provenance import Provenance
    from ..io import ReseauDesign
    from ..measure import PinOptions, ReseauOptions
    from ..procedures.oscilloscope import PhotoI, PhotoII, PhotoIII, StillStandard

__all__ = ["refine"]


@dataclass(frozen=True)
class _Files:
    """The input files and options of a run."""

    photo_i: Annotated[Path | None, typer.Option(help="PHOTO I: the reseau alone.")] = None
    photo_ii: Annotated[
        Path | None,
        typer.Option(help="PHOTO II: the test object behind the reseau; with --calibration, test it."),
    ] = None
    photo_iii: Annotated[tuple[Path, ...], Option("PHOTO III: the body to measure; repeatable.")] = ()
    reseau: v.Reseau | None = None
    test_object: v.TestObject | None = None
    calibration: Annotated[
        Path | None, typer.Option(help="Stored calibration: apply it to PHOTO III, or test it with PHOTO II.")
    ] = None
    points: Annotated[Path | None, typer.Option(help="Points of the body in PHOTO III (JSON, CSV).")] = None
    check: Annotated[v.Check, "Here also rods."] = ()
    alpha: Annotated[v.Alpha, "Here of the coefficients."] = 0.05
    mirrored: Annotated[v.Mirrored | None, BY_DESIGN] = None
    max_rotation_deg: Annotated[v.MaxRotationDeg | None, NOT_NOMINAL] = None
    overlay: Annotated[v.Overlay | None, "Here a folder, for all photographs; FILE.png for one."] = None

    @cached_property
    def overlays(self) -> Mapping[Path, Path]:
        """The overlay of each photograph, if overlays are wanted."""
        return {} if self.overlay is None else overlay_files(self.overlay, self.photographs())

    def marks(self) -> ReseauOptions:
        """Options of the measurement of the reseau."""
        from ..measure import ReseauOptions

        return ReseauOptions(**orientation(self.mirrored, self.max_rotation_deg))

    def pins(self) -> PinOptions:
        """Options of the measurement of the rods."""
        from ..measure import PinOptions

        return PinOptions(**orientation(None, self.max_rotation_deg))

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

    def photographs(self) -> list[Path]:
        """The photographs in their order."""
        return [path for path in (self.photo_i, self.photo_ii, *self.photo_iii) if path is not None]

    def frames(self) -> list[Frame | None]:
        """The photographs in their order; None for coordinates."""
        from ..io import is_points
        from ..io.images import read_image

        paths = (self.photo_i, self.photo_ii, *self.photo_iii)
        return [None if path is None or is_points(path) else read_image(path) for path in paths]


def refine(
    files: _Files,
    out: v.Out | None = None,
    true: Annotated[Path | None, typer.Option(help="File to write true coordinates to (CSV, JSON).")] = None,
    report: v.Report | None = None,
    as_json: v.AsJson = False,
) -> None:
    """Correct oscilloscope photographs: camera (PHOTO I), instrument (II), true coordinates (III).

    Each photograph is an image, or a file with the coordinates of its marks, rods and points, which are
    identified by their names. With --calibration, --out contains the true coordinates and the test;
    otherwise it contains the calibration.
    """
    from ..core.threads import one_thread

    _checked(files)
    for path, suffixes in ((out, (".json",)), (report, (".html",)), (true, (".csv", ".json"))):
        if path is not None:
            suffix_of(writable(path), suffixes)
    assert files.overlays is not None  # their names are checked before anything is computed
    with one_thread():  # results do not depend on the number of processors
        if files.calibration is not None:
            _by_calibration(files, files.calibration, out, true, report, as_json)
        else:
            _by_photographs(files, out, true, report, as_json)


def _checked(files: _Files) -> None:
    """Refuse options that contradict each other.

    Raises
    ------
    UsageError
        If an option is missing or superfluous.
    """
    from ..core.errors import UsageError

    if not 0 < files.alpha < 1:
        raise UsageError(f"{files.alpha:g} is not between 0 and 1", where="--alpha")
    if files.calibration is not None:
        if files.photo_i or files.reseau:
            raise UsageError(
                "contains PHOTO I and its reseau", where="--calibration", do="omit --photo-i and --reseau"
            )
        if not files.photo_iii and not files.photo_ii:
            raise UsageError(
                "needs a photograph", where="--calibration", do="give --photo-iii, or --photo-ii to test it"
            )
        return
    if files.photo_i is None or files.reseau is None:
        raise UsageError("needs --photo-i and --reseau, or --calibration", where="refine")
    if (files.photo_ii is None) != (files.test_object is None):
        raise UsageError("--photo-ii and --test-object must be given together", where="refine")
    if files.photo_iii and files.photo_ii is None:
        raise UsageError("needs PHOTO II", where="--photo-iii", do="give --photo-ii and --test-object")


def _by_photographs(
    files: _Files, out: Path | None, true: Path | None, report: Path | None, as_json: bool
) -> None:
    """Correct PHOTO I, and PHOTO II and III if given."""
    from ..core.data import Frame
    from ..core.errors import UsageError
    from ..io import ReseauDesign, write_whole
    from ..procedures.oscilloscope import photo_i

    assert files.photo_i is not None
    assert files.reseau is not None
    design = ReseauDesign.read(files.reseau)
    rods = None if files.test_object is None else ReseauDesign.read(files.test_object)
    known = set(design.ids) | set(() if rods is None else rods.ids)
    unknown = [name for name in files.check if name not in known]
    if unknown:
        raise UsageError(f"{unknown[0]!r} is neither a mark nor a rod", where="--check")
    steps = 1 + (files.photo_ii is not None) + len(files.photo_iii)
    photo = read_photo(files.photo_i)
    with progress("correcting", steps) as step:
        found = photo_i(photo, design, options=files.marks(), alpha=files.alpha, check=files.check)
        files.draw(files.photo_i, photo, found)
        first = required(found, files.photo_i)
        if isinstance(photo, Frame):
            first = replace(first, camera=replace(first.camera, size=(photo.width, photo.height)))
        step("PHOTO I")
        second = None if rods is None else _second(files, design, rods, first)
        step("PHOTO II")
        third = [] if second is None else _third(files, second.instrument, design, step)
    provenance, times = files.provenance(), {"computed": datetime.now(UTC).isoformat(timespec="seconds")}
    name = f"{design.name} {files.photo_i.stem}"
    if second is None or rods is None:
        result = first.camera.calibration(name=name, provenance=provenance.to_dict(), times=times)
    else:
        result = second.instrument.calibration(
            design, rods, name=name, provenance=provenance.to_dict(), times=times
        )
    page = None
    if report is not None:
        from ..report import oscilloscope_report

        bodies = [found for _, found in third]
        page = oscilloscope_report(
            first, design, second, rods, bodies, frames=files.frames(), title=name, provenance=provenance
        )
    if out is not None:
        write_whole(out, result.to_json())
    if page is not None and report is not None:
        write_whole(report, page)
    _write_true(third, true, None if second is None else second.instrument.unit)
    if as_json:
        say(result.to_json())
    else:
        _say_first(files.photo_i, first, design)
        if second is not None and files.photo_ii is not None:
            _say_second(files.photo_ii, second)
        _say_third(files, third, None if second is None else second.instrument.unit, true)


def _split(points: ImagePoints, design: ReseauDesign) -> tuple[ImagePoints | None, ImagePoints]:
    """Split points into marks of the reseau and others."""
    import numpy as np

    marks = np.isin(points.names, design.ids)
    return (points.select(marks) if marks.any() else None), points.select(~marks)


def _second(files: _Files, design: ReseauDesign, rods: ReseauDesign, first: PhotoI) -> PhotoII:
    from ..core.data import ImagePoints
    from ..procedures.oscilloscope import photo_ii

    assert files.photo_ii is not None
    photo, marks = read_photo(files.photo_ii), None
    if isinstance(photo, ImagePoints):
        marks, photo = _split(photo, design)
    found = photo_ii(
        photo, design, rods, first.camera, marks=marks, options=files.marks(), pins=files.pins(),
        alpha=files.alpha, check=files.check,
    )  # fmt: skip
    files.draw(files.photo_ii, photo, found)
    return required(found, files.photo_ii)


def _third(
    files: _Files, instrument: InstrumentCorrection, design: ReseauDesign, step: Any
) -> list[tuple[Path, PhotoIII]]:
    from ..core.data import ImagePoints
    from ..io import read_measurement
    from ..procedures.oscilloscope import photo_iii

    body = None if files.points is None else read_measurement(files.points).image_points()
    results = []
    for path in files.photo_iii:
        photo, marks = read_photo(path), None
        if isinstance(photo, ImagePoints):
            marks, photo = _split(photo, design)
        found = photo_iii(photo, instrument, design, points=body, marks=marks, options=files.marks())
        files.draw(path, photo, found)
        results.append((path, required(found, path)))
        step(path.name)
    return results


def _by_calibration(
    files: _Files,
    calibration: Path,
    out: Path | None,
    true: Path | None,
    report: Path | None,
    as_json: bool,
) -> None:
    """Apply or test a stored calibration."""
    from ..calibration import InstrumentCorrection, read_calibration
    from ..core.provenance import canonical_json
    from ..io import ReseauDesign, points_document, write_whole

    stored = read_calibration(calibration)
    instrument, design, rods = InstrumentCorrection.from_calibration(stored)
    with progress("correcting", len(files.photo_iii) + (files.photo_ii is not None)) as step:
        again = None
        if files.photo_ii is not None:
            again = _again(files, files.photo_ii, instrument, design, rods)
            step(files.photo_ii.name)
        third = _third(files, instrument, design, step)
    documents = [] if again is None or files.photo_ii is None else [_standard(files.photo_ii, again)]
    documents += [
        points_document(found.true, instrument.unit, "object")
        | {
            "image": path.name,
            "notes": [note.text for note in found.notes],
            "note_codes": [note.code.value for note in found.notes],
        }
        for path, found in third
    ]
    content = canonical_json(documents[0] if len(documents) == 1 else documents)
    page = None
    if report is not None:
        from ..report import applied_report

        page = applied_report(
            rods if files.test_object is None else ReseauDesign.read(files.test_object),
            [found for _, found in third],
            again,
            frames=files.frames()[2:],
            title=f"{stored.name}: {', '.join(path.name for path in files.photographs())}",
            provenance=files.provenance(),
        )
    if out is not None:
        write_whole(out, content)
    if page is not None and report is not None:
        write_whole(report, page)
    _write_true(third, true, instrument.unit)
    if as_json:
        say(content)
    else:
        if again is not None and files.photo_ii is not None:
            _say_again(files.photo_ii, again, instrument.unit)
        _say_third(files, third, instrument.unit, true)


def _again(
    files: _Files, path: Path, instrument: InstrumentCorrection, design: ReseauDesign, rods: ReseauDesign
) -> StillStandard:
    """Test the stored coefficients with a new PHOTO II; --test-object names another test object."""
    from ..core.data import ImagePoints
    from ..io import ReseauDesign
    from ..procedures.oscilloscope import still_standard_in

    same = files.test_object is None
    if files.test_object is not None:
        rods = ReseauDesign.read(files.test_object)
    photo, marks = read_photo(path), None
    if isinstance(photo, ImagePoints):
        marks, photo = _split(photo, design)
    found = still_standard_in(
        photo, instrument, design, rods, marks=marks, options=files.marks(), pins=files.pins(),
        same_object=same, alpha=files.alpha,
    )  # fmt: skip
    files.draw(path, photo, found)
    return required(found, path)


def _standard(path: Path, again: StillStandard) -> dict[str, Any]:
    """The test as JSON."""
    test = again.test
    return {
        "image": path.name,
        "holds": test.holds,
        "same_object": test.same_object,
        "chi2": test.statistic,
        "degrees": test.degrees,
        "critical": test.critical,
        "p": test.p,
        "shift": test.shift.tolist(),
        "shift_sigma": test.shift_sigma.tolist(),
        "p_shift": test.p_shift,
        "p_rest": test.p_rest,
        "rods": {"id": list(test.names), "change": test.change.tolist(), "sigma": test.sigma.tolist()},
        "notes": [note.text for note in again.notes],
        "note_codes": [note.code.value for note in again.notes],
    }


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
    for note in again.notes:
        say(f"  note: {note}\n")


def _write_true(third: list[tuple[Path, PhotoIII]], true: Path | None, unit: str | None) -> None:
    """Write true coordinates; with several photographs, names have that of their photograph as prefix."""
    from ..core.data import ImagePoints
    from ..core.provenance import canonical_json
    from ..io import points_document, write_whole

    if true is None or not third or unit is None:
        return
    import numpy as np

    several = len(third) > 1
    names = [f"{path.stem}:{n}" if several else n for path, found in third for n in found.true.names]
    points = ImagePoints(
        tuple(names),
        np.concatenate([found.true.xy for _, found in third]),
        np.concatenate([found.true.cov for _, found in third]),
    )
    document = canonical_json(points_document(points, unit, "object"))
    write_whole(true, document if true.suffix.lower() == ".json" else points.to_csv())


def _say_first(path: Path, first: PhotoI, design: ReseauDesign) -> None:
    fit, names = first.camera.fit, first.camera.model.names
    dropped = () if fit is None else fit.elimination.dropped
    say(f"{path.name}: {len(first.points)} marks, {len(names) - len(dropped)} significant coefficients\n")
    if fit is not None:
        x, y = (fit.residuals**2).mean(axis=0) ** 0.5
        say(f"  residuals {x:.2g} {design.unit} in x, {y:.2g} {design.unit} in y (rms)\n")
    for note in first.notes:
        say(f"  note: {note}\n")


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
    for note in second.notes:
        say(f"  note: {note}\n")


def _say_third(
    files: _Files, third: list[tuple[Path, PhotoIII]], unit: str | None, true: Path | None
) -> None:
    for path, found in third:
        say(f"{path.name}: {len(found.true)} points in {unit}\n")
        for note in found.notes:
            say(f"  note: {note}\n")
        if true is None:
            say(found.true.to_csv())
