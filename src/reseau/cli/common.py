"""Shared by the commands: options, input and output files, progress bars, numbers as text."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from ..core import vocabulary as v
from ..core.errors import EstimationError, UsageError
from ..core.files import made_folder, writable
from ..core.notice import before_compiling

if TYPE_CHECKING:
    from ..archive import Archive
    from ..calibration.sensor import SensorCorrection
    from ..core.data import Frame, ImagePoints
    from ..core.failure import Failure
    from ..execution import Executor
    from ..procedures.calibration_options import CameraOptions

T = TypeVar("T")


@dataclass(frozen=True)
class Place:
    """The archive that a command uses."""

    archive: v.Archive = "archive"
    objects: v.Objects | None = None

    def open(self, *, create: bool = False) -> Archive:
        """Open the archive.

        Raises
        ------
        ArchiveError
            If it does not exist or cannot be used.
        """
        from ..archive import Archive

        return Archive.open(self.archive, self.objects, create=create)


def for_systemd(template: str, archive: str, benches: Sequence[Path] = ()) -> str:
    """Return a unit of systemd with the program, archive and benches of its place.

    Raises
    ------
    UsageError
        If a name has characters with a meaning for systemd.
    """
    if any(character in each for each in (archive, *map(str, benches)) for character in ' "%\n'):
        where = "--archive, --bench" if benches else "--archive"
        raise UsageError("contains characters with a meaning for systemd", where=where)
    return template.format(
        program=shutil.which("reseau") or "/usr/local/bin/reseau", where=Path.cwd(),
        archive=archive if "://" in archive else str(Path(archive).absolute()),
        more="".join(f" --bench {each.absolute()}" for each in benches),
    )  # fmt: skip


@dataclass(frozen=True)
class Computing:
    """What does the work of a command."""

    jobs: v.Jobs | None = None
    cluster: v.Cluster = ""
    store: v.Store = ""

    def executor(self, modules: Sequence[str], parts: int) -> Executor:
        """Return what computes a number of independent parts, which import modules."""
        from ..execution import executor_at

        return executor_at(self.jobs, self.cluster, self.store, modules, parts)


@dataclass(frozen=True)
class Reading:
    """How a command reads images."""

    channel: v.Channel = "luma"
    sensor: v.Sensor | None = None

    def frame(self, path: Path) -> Frame:
        """Read an image; notes on how it was read are written to standard error.

        With a calibration of a sensor the grey values are corrected.

        Raises
        ------
        FormatError
            If a file cannot be read, or `sensor` is not a calibration of a sensor.
        UsageError
            If the size of the frame is not that of the sensor.
        """
        from ..io.images import read_image

        frame = read_image(path, self.channel)
        say_notes(frame.notes)
        return frame if self.correction is None else self.correction.correct(frame)

    @cached_property
    def correction(self) -> SensorCorrection | None:
        """The correction of the sensor, which is read once for all frames of a command."""
        from ..calibration import Calibration
        from ..calibration.sensor import SensorCorrection

        return (
            None if self.sensor is None else SensorCorrection.from_calibration(Calibration.read(self.sensor))
        )


@dataclass(frozen=True)
class CameraChoice:
    """The camera model of a calibration."""

    model: v.Model = ""
    pitch_mm: v.PitchMm | None = None
    free: v.Free = ()

    def options(self) -> CameraOptions:
        """Return the options of the calibration."""
        from ..procedures.calibration_options import CameraOptions

        return CameraOptions(self.model, self.free, self.pitch_mm)


def ended(status: str) -> None:
    """End a command whose result contradicts itself with the exit status 3, after everything was written."""
    if status == "contradictory":
        raise typer.Exit(3)


SessionName = Annotated[str, typer.Argument(help="Name of the session.")]


def orientation(mirrored: bool | None, max_rotation_deg: float | None) -> dict[str, Any]:
    """Options of a measurement from those of a command; what is not given keeps its default."""
    given = {"mirrored": mirrored, "max_rotation_deg": max_rotation_deg}
    return {name: value for name, value in given.items() if value is not None}


def read_photo(path: Path) -> Frame | ImagePoints:
    """Read an image, or image coordinates."""
    from ..io.reading import is_points, read_measurement

    return read_measurement(path).image_points() if is_points(path) else Reading().frame(path)


def required(found: T | Failure, where: object) -> T:
    """Return the estimate, or raise its failure as an error that names a file.

    Raises
    ------
    EstimationError
        If there is no estimate.
    """
    from ..core.failure import Failure

    if isinstance(found, Failure):
        raise EstimationError(found.reason, where=where)
    return found


def overlay_files(path: Path, images: Sequence[Path]) -> dict[Path, Path]:
    """Return the overlay of each image: the PNG that is named, or one for each image in a folder.

    A path without a suffix is a folder, which is created; the file of an image is called after it. Where
    a PNG is named for several images, the name of the image is appended to its own. Files of image
    coordinates have no overlay.

    Raises
    ------
    UsageError
        If the suffix is not .png, there is no image, or the overlay would replace the image.
    InputError
        If the folder does not exist or cannot be created.
    """
    from ..io.reading import is_points

    where = "--overlay"
    shown = list(dict.fromkeys(image for image in images if not is_points(image)))
    if not shown:
        raise UsageError("needs an image, not image coordinates", where=where)
    stems = [image.stem for image in shown]
    names = [
        stem if stems.count(stem) == 1 else f"{stem}-{stems[: i + 1].count(stem)}"
        for i, stem in enumerate(stems)
    ]
    if path.is_dir() or not path.suffix:
        files = [made_folder(path) / f"{name}-overlay.png" for name in names]
    else:
        writable(path, ".png")
        one = len(shown) == 1
        files = [path if one else path.with_name(f"{path.stem}-{name}.png") for name in names]
    for file in files:
        if file.resolve() in {image.resolve() for image in images}:
            raise UsageError("would replace the image", where=file, do="choose another name")
    return dict(zip(shown, files, strict=True))


def out_files(path: Path | None, images: Sequence[Path], one: bool) -> dict[Path, Path]:
    """Return the file of each image: the one that is named for `one`, or one for each in a folder.

    Raises
    ------
    UsageError
        If a file is named for several images, or two images have one name.
    InputError
        If the folder cannot be created.
    """
    from ..core.data import twice

    if path is None:
        return {}
    if one:
        writable(path, ".json", ".csv")
        return {images[0]: path}
    if path.suffix:
        raise UsageError("must be a folder for several images", where="--out")
    if (again := twice([image.stem for image in images])) is not None:
        raise UsageError(
            f"two images are called {again!r}", where="--out", do="give them one after the other"
        )
    return {image: made_folder(path) / f"{image.stem}.json" for image in images}


def probability(p: float) -> str:
    """A probability as text, to two digits.

    Examples
    --------
    >>> probability(0.0314), probability(1e-9)
    ('p = 0.031', 'p < 0.001')
    """
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def remark_lines(warnings: Iterable[object], tests: Iterable[object]) -> list[str]:
    """Warnings about a result, and tests that are not passed, as lines."""
    lines, rest = [f"warning: {warning}" for warning in warnings], [f"  {remark}" for remark in tests]
    if rest:
        lines.append("tests that are not passed, by amounts that the errors above contain:")
    return lines + rest


def say(text: str) -> None:
    """Write to standard output, at once: what a daemon says is wanted while it runs."""
    sys.stdout.write(text)
    sys.stdout.flush()


def say_either(as_json: bool, value: object, lines: Iterable[str]) -> None:
    """Write a value as JSON, or lines of text, to standard output."""
    if as_json:
        say_json(value)
    else:
        say("".join(f"{line}\n" for line in lines))


def say_notes(notes: Iterable[object]) -> None:
    """Write notes to standard error, a line for each."""
    for note in notes:
        typer.echo(f"note: {note}", err=True)


def pairs_of(texts: Iterable[str] | None, option: str, form: str) -> dict[str, str]:
    """Values by name of texts NAME=VALUE, each name once; `form` says in messages what to write.

    Examples
    --------
    >>> pairs_of(["tilt=30", "roll=-10"], "positions", "axis=number")
    {'tilt': '30', 'roll': '-10'}
    """
    found: dict[str, str] = {}
    for text in texts or ():
        name, _, value = (part.strip() for part in text.partition("="))
        if not name or not value or name in found:
            raise UsageError(f"cannot interpret {text!r}", where=option, do=f"write {form}")
        found[name] = value
    return found


def say_json(value: object) -> None:
    """Write a value as JSON to standard output."""
    from ..core.provenance import canonical_json

    say(canonical_json(value))


def say_files_left_out(paths: Iterable[Path]) -> None:
    """Say which files of folders are no photographs."""
    from ..procedures.exposures import files_left_out

    for path in paths:
        if path.is_dir() and (line := files_left_out(path)):
            say_notes([line])


def compile_first(job: str, jobs: int | None = None) -> None:
    """Compile what a job calls and this processor has not compiled yet, with a bar of its own."""
    from ..core.ahead import by_module, compile_ahead, missing_loops
    from ..execution import executor_at

    modules = by_module(missing_loops(job))
    if modules:
        before_compiling(lambda: None)  # the bar says it
        title = "compiling for this processor, once"
        with executor_at(jobs, parts=len(modules)) as executor, progress(title, len(modules)) as step:
            compile_ahead(executor, modules, lambda _: step())


@contextmanager
def progress(title: str, steps: int) -> Iterator[Any]:
    """Show a progress bar on standard error if it is a terminal; yield a function to call after each step."""
    if not sys.stderr.isatty():
        yield lambda description=None: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", justify="left"),
        BarColumn(bar_width=30),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=steps)

        def step(description: str | None = None) -> None:
            bar.update(task, advance=1, description=description)

        yield step
