"""`reseau blurred`: the blurred targets of a whole network, by rays through windows and lens."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from .blurred import Matching
from .common import Reading, progress, required, say

if TYPE_CHECKING:
    from ..bundle import Network
    from ..core.data import Frame
    from ..optics.lenses import LensCamera, ThinLens
    from ..procedures.blurred_network import BlurredNetwork

__all__ = ["blurred_network"]

_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm")


def blurred_network(
    network: Annotated[
        Path,
        typer.Argument(help="reseau-network/1 with approximate image coordinates, windows and media."),
    ],
    images: Annotated[
        Path,
        typer.Option("--images", help="Folder with the photographs, named as the images of the network."),
    ],
    targets: v.Targets,
    out: Annotated[v.Out, "Here a folder: every round, the final network, its result, a report."],
    matching: Matching,
    reading: Reading,
    lens: Annotated[
        v.Lens | None,
        "Without it a thin lens with the principal distance of the camera stands in: give --focus and "
        "--f-number.",
    ] = None,
    rounds: v.Rounds = 6,
    initial: v.Initial = "given",
    keep_sharp: Annotated[
        bool,
        typer.Option(
            "--keep-sharp/--replace-sharp",
            rich_help_panel="Adjustment",
            help="Whether sharp targets keep coordinates that do not differ significantly from those by "
            "rays: given ones always, others where they are as certain.",
        ),
    ] = True,
    jobs: v.Jobs | None = None,
) -> None:
    """Measure the blurred targets of a network by rays and adjust it, until sigma0 no longer falls."""
    from ..bundle import ResultDocument
    from ..core.errors import UsageError
    from ..core.files import empty_folder
    from ..core.provenance import Provenance, sha256_of
    from ..exchange import calibration_files, read_network
    from ..execution import executor_at
    from ..io import write_whole
    from ..io.network import Network1
    from ..io.targets import SpaceTargets
    from ..procedures.blurred_network import NetworkOptions, final_document, measure_blurred_network
    from ..report.blurred_network import blurred_network_report

    empty_folder(out)
    document, content = Network1.read(network), read_network(network)
    lenses, fill = _lenses(content, lens, matching)
    space = SpaceTargets.read(targets)
    frames: dict[str, Frame] = {}
    for image, file in _photographs(images, content).items():
        frames[image] = reading.frame(file)
    if not frames:
        raise UsageError("has no photograph of an image of the network", where=images)
    options = matching.options(space.polarity, fill)
    modules = ["reseau.procedures.blurred_network"]
    with executor_at(jobs, "", "", modules, len(frames)) as executor, progress("measuring", 5) as step:
        found = required(
            measure_blurred_network(
                content,
                frames,
                space,
                lenses,
                NetworkOptions(options, rounds, keep_sharp, initial),
                watch=step,
                executor=executor,
            ),
            network,
        )
    inputs = [network, *calibration_files(network), targets, *([] if lens is None else [lens])]
    provenance = Provenance(
        {file.name: sha256_of(file) for file in inputs},
        {**vars(matching), "initial": initial, "keep_sharp": keep_sharp},
    )
    out.mkdir(parents=True, exist_ok=True)
    for number, entry in enumerate(found.rounds):
        ResultDocument.of(entry.result, provenance=provenance).write(out / f"round-{number}.json")
    ResultDocument.of(found.result, provenance=provenance).write(out / "result.json")
    final_document(document, found).write(out / "network.json")
    write_whole(out / "report.html", blurred_network_report(found, title=network.name, provenance=provenance))
    _say(found, out)


def _lenses(
    network: Network, lens: Path | None, matching: Matching
) -> tuple[dict[str, LensCamera | ThinLens], float]:
    """Lenses by camera, and the light-sensitive share of a pixel."""
    from ..core.errors import UsageError
    from ..exchange import read_lens
    from ..procedures.blurred import thin_lens_of

    if lens is not None:
        optics = read_lens(lens)
        known = {each.id: matching.camera(optics, (each.width, each.height)) for each in network.cameras}
        return dict(known), 1.0 if optics.sensor is None else optics.sensor.fill
    focus, f_number = matching.focus, matching.f_number
    if focus is None or f_number is None:
        raise UsageError("no design of the lens", do="give --lens, or --focus and --f-number for a thin lens")
    if matching.pitch_mm is not None:
        raise UsageError("is that of the cameras of the network", where="--pitch-mm", do="leave it out")
    return {each.id: thin_lens_of(each, distance=focus, f_number=f_number) for each in network.cameras}, 1.0


def _photographs(folder: Path, network: Network) -> dict[str, Path]:
    """Files by image: that of the network, or one of the image's name."""
    from ..core.errors import UsageError

    if not folder.is_dir():
        raise UsageError("is not a folder", where=folder)
    files = {file.name: file for file in sorted(folder.iterdir()) if file.suffix.lower() in _SUFFIXES}
    found: dict[str, Path] = {}
    for image, name in zip(network.images, network.files, strict=True):
        wanted = [Path(name).name] if name else []
        wanted += [image, *(image + suffix for suffix in _SUFFIXES)]
        file = next((files[name] for name in wanted if name in files), None)
        if file is not None:
            found[image] = file
    return found


def _say(found: BlurredNetwork, out: Path) -> None:
    for number, entry in enumerate(found.rounds):
        what = "ordinary coordinates" if number == 0 else f"round {number}"
        counts = (
            ""
            if number == 0
            else f"; {int(entry.replaced.sum())} by rays (mean shift {entry.shift_px:.2g} px), "
            f"{int(entry.kept.sum())} kept, {int(entry.declined.sum())} left out"
        )
        say(f"{what}: sigma0 {entry.result.sigma0:.4g}, residuals {entry.rms_px():.3g} px rms{counts}\n")
    for remark in found.notes:
        say(f"warning: {remark}\n")
    for remark in found.result.warnings:
        say(f"warning: {remark}\n")
    say(f"{out}: result.json, network.json and report.html are those of round {found.chosen}\n")
