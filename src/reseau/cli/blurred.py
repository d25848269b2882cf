"""`reseau measure blurred`: image coordinates of blurred targets, by rays through the lens."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ..core import vocabulary as v
from ..core.files import writable
from .common import Reading, orientation
from .measure import BY_DESIGN, NOT_NOMINAL, Image, Output, Task

if TYPE_CHECKING:
    from ..core.data import Frame
    from ..exchange import Lens
    from ..measure.blurred import BlurredOptions, BlurredResult
    from ..optics.lenses import LensCamera, RayMap

__all__ = ["BESIDE_RAYS", "Matching", "blurred"]

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

    def camera(self, lens: Lens, size: tuple[int, int]) -> LensCamera:
        """Return the lens with a sensor of a size in pixels."""
        from ..procedures.blurred import lens_camera

        return lens_camera(lens, size, pitch_mm=self.pitch_mm, distance=self.focus, f_number=self.f_number)

    def options(self, polarity: Literal["dark", "bright"], fill: float) -> BlurredOptions:
        """Return the options of the measurement."""
        from ..measure.blurred import BlurredOptions

        return BlurredOptions(polarity=polarity, psf_px=self.psf_px, search_px=self.search_px, fill=fill)


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
    from ..core.errors import UsageError
    from ..core.failure import Failure
    from ..exchange import read_lens, read_network
    from ..io import BoardDesign, ReseauDesign
    from ..io.reading import read_design
    from ..measure import ReseauOptions, measure_reseau
    from ..procedures.blurred import calibrated_by, measure_blurred_frame, pose_in_network

    kind = "" if figure is None else writable(figure, ".svg", ".png", ".pdf").suffix.lower()
    task = Task(image, output, "targets", "deviations from the orientation")
    target, optics = read_design(design), read_lens(lens)
    if isinstance(target, BoardDesign):
        raise UsageError("is a board", where=design, do="give a testfield or a reseau")
    fill = 1.0 if optics.sensor is None else optics.sensor.fill
    options = matching.options(target.polarity, fill)
    block = None if network is None else read_network(network)
    sharp = None
    if block is None:  # a network determines the orientation: names need no help
        target = target.from_behind() if mirrored else target
        if isinstance(target, ReseauDesign):
            # Where the targets lie is predicted in the design as the image shows it.
            turned = ReseauOptions(**orientation(None if mirrored is None else False, max_rotation_deg))
            sharp = partial(measure_reseau, design=target, options=turned)

    def measured(frame: Frame) -> BlurredResult | Failure:
        view: RayMap = matching.camera(optics, (frame.width, frame.height))
        pose = None
        if block is not None:
            pose, view = pose_in_network(block, image.name, target), calibrated_by(view, block, image.name)
        found = measure_blurred_frame(
            frame, target, view, pose, options, sharp=sharp, focus_sigma_mm=focus_sigma_mm
        )
        if isinstance(found, Failure):
            return found
        if figure is not None:
            from ..core.figures import to_bytes
            from ..core.files import write_whole
            from ..report.blurred import blurred_figure

            drawn = blurred_figure(frame, found.camera, found.targets, found.measured, fill=options.fill)
            write_whole(figure, to_bytes(drawn, kind[1:], dpi=150))
        return found.measured

    task.run(reading, measured)
