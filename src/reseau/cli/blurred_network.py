"""`reseau blurred`: the blurred targets of a whole network, by rays through windows and lens."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from .blurred import Matching
from .common import Reading, progress, required, say

if TYPE_CHECKING:
    from ..procedures.blurred_network import BlurredNetwork


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
    from ..core.files import empty_folder, made_folder
    from ..core.provenance import Provenance, sha256_of
    from ..exchange import calibration_files, read_network
    from ..execution import executor_at
    from ..io import write_whole
    from ..io.network import Network1
    from ..io.targets import SpaceTargets
    from ..procedures.blurred_files import network_documents, photographs_of_network
    from ..procedures.blurred_network import NetworkOptions, measure_blurred_network
    from ..report.blurred_network import blurred_network_report

    empty_folder(out)
    document, content, space = Network1.read(network), read_network(network), SpaceTargets.read(targets)
    imaging = matching.imaging(lens)
    lenses = imaging.cameras(content)
    frames = {name: reading.frame(file) for name, file in photographs_of_network(images, content).items()}
    options = NetworkOptions(imaging.options(space.polarity), rounds, keep_sharp, initial)
    modules = ["reseau.procedures.blurred_network"]
    with executor_at(jobs, "", "", modules, len(frames)) as executor, progress("measuring", 5) as step:
        measured = measure_blurred_network(
            content, frames, space, lenses, options, watch=step, executor=executor
        )
        found = required(measured, network)
    inputs = [network, *calibration_files(network), targets, *([] if lens is None else [lens])]
    provenance = Provenance(
        {file.name: sha256_of(file) for file in inputs},
        {**vars(matching), "initial": initial, "keep_sharp": keep_sharp},
    )
    page = blurred_network_report(found, title=network.name, provenance=provenance)
    for name, text in (network_documents(found, document, provenance) | {"report.html": page}).items():
        write_whole(made_folder(out) / name, text)
    _say(found, out)


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
