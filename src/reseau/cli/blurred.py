"""`reseau measure blurred`, `reseau blurred`: blurred targets, by rays through the lens."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.files import writable
from ..core.options import Group, Option
from .common import Reading, orientation, progress, required, say
from .measure import BY_DESIGN, NOT_NOMINAL, Image, Output, Task

if TYPE_CHECKING:
    from ..core.data import Frame
    from ..core.failure import Failure
    from ..measure.blurred.measure import BlurredResult
    from ..procedures.blurred_files import BlurredImaging
    from ..procedures.blurred_network import BlurredNetwork


BESIDE_RAYS = "Here what blurs beside the rays: sensor and diffraction."


@dataclass(frozen=True)
class Matching:
    """How blurred targets are matched, and the lens that forms their images."""

    pitch_mm: Annotated[
        v.PitchMm | None,
        "Here if the lens file has no sensor; the axis of the lens is then at the centre of the image.",
    ] = None
    focus: v.Focus | None = None
    f_number: v.FNumber | None = None
    psf_px: Annotated[v.PsfPx, BESIDE_RAYS] = 0.5
    search_px: v.SearchPx = 6.0

    def imaging(self, lens: Path | None) -> BlurredImaging:
        """Return what forms the images, with the lens of a file."""
        from ..exchange import read_lens
        from ..procedures.blurred_files import BlurredImaging

        return BlurredImaging(None if lens is None else read_lens(lens), **vars(self))


def blurred(
    image: Image,
    design: v.Design,
    lens: v.Lens,
    reading: Reading,
    output: Output,
    matching: Matching,
    network: Annotated[
        v.Network | None,
        "Here with the orientation of the image, as written by `reseau bundle`. Default: the image is "
        "oriented by its targets.",
    ] = None,
    focus_sigma_mm: Annotated[
        float | None,
        Option(
            "Standard deviation of the place of the image plane (mm): it is then estimated from all targets.",
            Group.ADJUSTMENT,
            least=1e-4,
            most=10,
        ),
    ] = None,
    exposure_lines: Annotated[
        float | None,
        Option(
            "Lines of a rolling shutter that are read during an exposure: exposure over the time of a line. "
            "Default: all lines are exposed at once.",
            Group.CAMERA,
            least=1,
        ),
    ] = None,
    mirrored: Annotated[v.Mirrored | None, BY_DESIGN] = None,
    max_rotation_deg: Annotated[v.MaxRotationDeg | None, NOT_NOMINAL] = None,
    figure: Annotated[
        v.Figure | None,
        "Here of the most blurred target (.svg, .png, .pdf): rays, formed image, photograph, residuals.",
    ] = None,
) -> None:
    """Measure blurred targets: the places of their corresponding rays.

    The images of the targets are formed by rays through the lens and matched with the photograph. Where they
    are not those of the lens as it is stated, motion during the exposure and another focus are considered.
    """
    from ..core.failure import Failure
    from ..exchange import read_network
    from ..io.reading import read_design
    from ..measure.reseau.marks import ReseauOptions
    from ..procedures.blurred_files import measure_blurred_photograph

    kind = "" if figure is None else writable(figure, ".svg", ".png", ".pdf").suffix.lower()
    task = Task(image, output, "targets", "deviations from the orientation")
    target, imaging = read_design(design), matching.imaging(lens)
    block = None if network is None else read_network(network)
    turned = ReseauOptions(**orientation(mirrored, max_rotation_deg))

    def measured(frame: Frame) -> BlurredResult | Failure:
        found = measure_blurred_photograph(
            frame, target, imaging, block, image.name, turned, focus_sigma_mm, exposure_lines
        )
        if isinstance(found, Failure):
            return found
        if figure is not None:
            from ..core.figures import to_bytes
            from ..core.files import write_whole
            from ..report.blurred import blurred_figure

            fill = imaging.options(target.polarity).fill
            drawn = blurred_figure(frame, found.camera, found.targets, found.measured, fill=fill)
            write_whole(figure, to_bytes(drawn, kind[1:], dpi=150))
        return found.measured

    task.run(reading, measured)


def blurred_network(
    network: Annotated[
        Path,
        typer.Argument(help="reseau-network/1 with approximate image coordinates, windows and media."),
    ],
    images: Annotated[
        Path,
        Option("Folder with the photographs, named as the images of the network."),
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
        Option(
            "Whether sharp targets keep coordinates that do not differ significantly from those by "
            "rays: given ones always, others where they are as certain.",
            Group.ADJUSTMENT,
            off="--replace-sharp",
        ),
    ] = True,
    jobs: v.Jobs | None = None,
) -> None:
    """Measure the blurred targets of a network by rays and adjust it, until sigma0 no longer falls."""
    from ..core.files import empty_folder, made_folder
    from ..core.provenance import Provenance, sha256_of
    from ..exchange import read_network
    from ..exchange.networks import calibration_files
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
