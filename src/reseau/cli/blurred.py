"""`reseau measure blurred`: image coordinates of blurred targets, by rays through the lens."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .common import (
    AsJson,
    MaxRotation,
    Mirrored,
    Out,
    Overlay,
    SensorFile,
    orientation,
    read_frame,
    suffix_of,
    writable,
)
from .measure import Task

if TYPE_CHECKING:
    from ..core.data import Frame
    from ..measure.blurred import BlurredResult
    from ..optics.lenses import RayMap

__all__ = ["FNumber", "Focus", "LensFile", "Pitch", "Psf", "Search", "blurred"]

LensFile = Annotated[
    Path, typer.Option("--lens", "-l", help="Lens: lens/1 (TOML), Zemax .zmx or CODE V .seq.")
]
Focus = Annotated[
    float | None,
    typer.Option(
        min=1e-3,
        help="Distance from the front of the lens at which objects in air are sharp (mm). "
        "Default: the image plane of the lens file.",
    ),
]
Pitch = Annotated[
    float | None,
    typer.Option(
        min=0.1,
        max=1000,
        help="Pitch of the pixels (µm), if the lens file has no sensor; the axis of the lens is "
        "then at the centre of the image.",
    ),
]
FNumber = Annotated[
    float | None, typer.Option(min=0.3, help="F-number, if the stop is not as wide as in the lens file.")
]
Psf = Annotated[
    float,
    typer.Option(min=0.1, help="Blur of sensor and diffraction beside that of the rays (px, one sigma)."),
]
Search = Annotated[float, typer.Option(min=1, help="Largest distance from the predicted position (px).")]


def blurred(
    image: Annotated[Path, typer.Argument(help="Image.")],
    design: Annotated[Path, typer.Option("--design", "-d", help="Design of the targets, in mm.")],
    lens: LensFile,
    network: Annotated[
        Path | None,
        typer.Option(
            "--network",
            "-n",
            help="Network with the orientation of the image, as written by `reseau bundle`. Default: the "
            "image is oriented by its targets.",
        ),
    ] = None,
    focus: Focus = None,
    focus_sigma: Annotated[
        float | None,
        typer.Option(
            min=1e-4,
            max=10,
            help="Standard deviation of the place of the image plane (mm): it is then estimated from all "
            "targets.",
        ),
    ] = None,
    pitch: Pitch = None,
    f_number: FNumber = None,
    psf: Psf = 0.5,
    search: Search = 6.0,
    mirrored: Mirrored = None,
    max_rotation: MaxRotation = None,
    out: Out = None,
    overlay: Overlay = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            help="Figure of the most blurred target to write (.svg, .png, .pdf): rays, formed image, "
            "photograph, residuals."
        ),
    ] = None,
    sensor: SensorFile = None,
    as_json: AsJson = False,
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
    from ..measure.blurred import BlurredOptions
    from ..procedures.blurred import calibrated_by, lens_camera, measure_blurred_frame, pose_in_network

    kind = "" if figure is None else suffix_of(writable(figure), (".svg", ".png", ".pdf"))
    task = Task(image, out, overlay, as_json, "targets", "deviations from the orientation")
    target, optics = read_design(design), read_lens(lens)
    if isinstance(target, BoardDesign):
        raise UsageError("is a board", where=design, do="give a testfield or a reseau")
    frame = read_frame(image, sensor=sensor)
    size = frame.width, frame.height
    camera = lens_camera(optics, size, pitch_um=pitch, distance=focus, f_number=f_number)
    options = BlurredOptions(
        polarity=target.polarity,
        psf_px=psf,
        search_px=search,
        fill=1.0 if optics.sensor is None else optics.sensor.fill,
    )
    view: RayMap = camera
    pose, sharp = None, None
    if network is not None:  # it determines the orientation; names need no help
        block = read_network(network)
        pose = pose_in_network(block, image.name, target)
        view = calibrated_by(camera, block, image.name)
    elif isinstance(target, ReseauDesign):
        # Where the targets lie is predicted in the design as the image shows it.
        turned = ReseauOptions(**orientation(None if mirrored is None else False, max_rotation))
        target = target.from_behind() if mirrored else target
        sharp = partial(measure_reseau, design=target, options=turned)
    elif mirrored:
        target = target.from_behind()

    def measured(_: Frame) -> BlurredResult | Failure:
        found = measure_blurred_frame(
            frame, target, view, pose, options, sharp=sharp, focus_sigma_mm=focus_sigma
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

    task.run(lambda: frame, measured)
