"""`reseau measure blurred`: image coordinates of blurred targets, by rays through the lens."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..core import vocabulary as v
from ..core.files import writable
from .common import Reading, orientation
from .measure import BY_DESIGN, NOT_NOMINAL, Image, Output, Task

if TYPE_CHECKING:
    from ..core.data import Frame
    from ..core.failure import Failure
    from ..measure.blurred import BlurredResult
    from ..procedures.blurred_files import BlurredImaging


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
        typer.Option(
            min=1e-4,
            max=10,
            rich_help_panel="Adjustment",
            help="Standard deviation of the place of the image plane (mm): it is then estimated from all "
            "targets.",
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

    The images of the targets are formed by rays through the lens and matched with the photograph.
    """
    from ..core.failure import Failure
    from ..exchange import read_network
    from ..io.reading import read_design
    from ..measure import ReseauOptions
    from ..procedures.blurred_files import measure_blurred_photograph

    kind = "" if figure is None else writable(figure, ".svg", ".png", ".pdf").suffix.lower()
    task = Task(image, output, "targets", "deviations from the orientation")
    target, imaging = read_design(design), matching.imaging(lens)
    block = None if network is None else read_network(network)
    turned = ReseauOptions(**orientation(mirrored, max_rotation_deg))

    def measured(frame: Frame) -> BlurredResult | Failure:
        found = measure_blurred_photograph(frame, target, imaging, block, image.name, turned, focus_sigma_mm)
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
