"""Blurred targets from files: the lens that forms their images, one photograph of a design, and a network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from ..bundle import Network, ResultDocument
from ..core.data import Frame
from ..core.errors import UsageError
from ..core.failure import Failure
from ..core.provenance import Provenance
from ..exchange.lenses import Lens
from ..io import BoardDesign, ReseauDesign, TestfieldDesign
from ..io.network import Network1
from ..io.photographs import PHOTOGRAPHS
from ..measure import measure_reseau
from ..measure.blurred import BlurredOptions
from ..measure.reseau.marks import ReseauOptions
from ..optics.lenses import RayMap, ThinLens
from ..optics.lenses.ray_maps import LensCamera
from .blurred import (
    BlurredFrame,
    calibrated_by,
    lens_camera,
    measure_blurred_frame,
    pose_in_network,
    thin_lens_of,
)
from .blurred_network import BlurredNetwork, final_document
from .exposures import photographs_in


@dataclass(frozen=True)
class BlurredImaging:
    """What forms the images of blurred targets, and how these are matched.

    Parameters
    ----------
    lens : Lens, optional
        Without it a thin lens with the principal distance of each camera of a network stands in, which needs
        `focus` and `f_number`.
    pitch_mm, focus, f_number : float, optional
        See :func:`~reseau.procedures.blurred.lens_camera`.
    psf_px, search_px : float
        See :class:`~reseau.measure.blurred.BlurredOptions`.

    Examples
    --------
    >>> BlurredImaging(search_px=4.0).options("bright").polarity
    'bright'
    """

    lens: Lens | None = None
    pitch_mm: float | None = None
    focus: float | None = None
    f_number: float | None = None
    psf_px: float = 0.5
    search_px: float = 6.0

    def options(self, polarity: Literal["dark", "bright"]) -> BlurredOptions:
        """Return the options of the measurement of targets."""
        sensor = None if self.lens is None else self.lens.sensor
        fill = 1.0 if sensor is None else sensor.fill
        return BlurredOptions(polarity, self.psf_px, search_px=self.search_px, fill=fill)

    def camera(self, size_px: tuple[int, int]) -> LensCamera:
        """Return the lens with a sensor of a size in pixels.

        Raises
        ------
        UsageError
            When there is no lens, or as :func:`~reseau.procedures.blurred.lens_camera`.
        """
        if self.lens is None:
            raise UsageError("no design of the lens", do="give --lens")
        return lens_camera(
            self.lens, size_px, pitch_mm=self.pitch_mm, distance=self.focus, f_number=self.f_number
        )

    def cameras(self, network: Network) -> dict[str, LensCamera | ThinLens]:
        """Return the lenses of the cameras of a network, by their names.

        Raises
        ------
        UsageError
            When there is neither a lens nor what a thin one needs.
        """
        if self.lens is not None:
            return {each.id: self.camera((each.width, each.height)) for each in network.cameras}
        if self.focus is None or self.f_number is None:
            raise UsageError(
                "no design of the lens", do="give --lens, or --focus and --f-number for a thin lens"
            )
        if self.pitch_mm is not None:
            raise UsageError("is that of the cameras of the network", where="--pitch-mm", do="leave it out")
        about = {"distance": self.focus, "f_number": self.f_number}
        return {each.id: thin_lens_of(each, **about) for each in network.cameras}


def measure_blurred_photograph(
    frame: Frame,
    design: ReseauDesign | TestfieldDesign | BoardDesign,
    imaging: BlurredImaging,
    network: Network | None = None,
    name: str = "",
    turned: ReseauOptions | None = None,
    focus_sigma_mm: float | None = None,
    exposure_lines: float | None = None,
) -> BlurredFrame | Failure:
    """Measure the blurred targets of a plane design in a photograph, oriented by a network or by themselves.

    Parameters
    ----------
    frame : Frame
        The photograph.
    design : ReseauDesign or TestfieldDesign
        The targets.
    imaging : BlurredImaging
        With a lens.
    network : Network, optional
        With the orientation of the photograph.
    name : str
        Name of its image in the network, or of its file.
    turned : ReseauOptions, optional
        How a reseau may be turned or mirrored, where no network tells.
    focus_sigma_mm, exposure_lines : float, optional
        See :func:`~reseau.procedures.blurred.measure_blurred_frame`, also for what is returned.

    Raises
    ------
    UsageError
        When the design is a board, or the lens, its sensor or the orientation is missing.

    Examples
    --------
    See :func:`~reseau.procedures.blurred.measure_blurred_frame`.
    """
    if isinstance(design, BoardDesign):
        raise UsageError("is a board", where=design.name, do="give a testfield or a reseau")
    view: RayMap = imaging.camera((frame.width, frame.height))
    pose = sharp = None
    if network is not None:  # determines the orientation: names need no help
        pose, view = pose_in_network(network, name, design), calibrated_by(view, network, name)
    elif turned is not None:
        design = design.from_behind() if turned.mirrored else design
        if isinstance(design, ReseauDesign):
            # Where the targets lie is predicted in the design as the image shows it.
            turned = replace(turned, mirrored=None if turned.mirrored is None else False)
            sharp = partial(measure_reseau, design=design, options=turned)
    options = imaging.options(design.polarity)
    return measure_blurred_frame(
        frame,
        design,
        view,
        pose,
        options,
        sharp=sharp,
        focus_sigma_mm=focus_sigma_mm,
        exposure_lines=exposure_lines,
    )


def photographs_of_network(folder: Path, network: Network) -> dict[str, Path]:
    """Return the photographs of a folder by the images of a network: its files, or called as the images.

    Raises
    ------
    UsageError, InputError
        When it is not a folder, or has no photograph of an image of the network.
    """
    if not folder.is_dir():
        raise UsageError("is not a folder", where=folder)
    files = {path.name: path for path in photographs_in(folder)}
    found: dict[str, Path] = {}
    for image, name in zip(network.images, network.files, strict=True):
        wanted = [Path(name or image).name, image, *(image + suffix for suffix in PHOTOGRAPHS)]
        file = next((files[each] for each in wanted if each in files), None)
        if file is not None:
            found[image] = file
    if not found:
        raise UsageError("has no photograph of an image of the network", where=folder)
    return found


def network_documents(found: BlurredNetwork, document: Network1, provenance: Provenance) -> dict[str, str]:
    """Return every round, the final result and the final network by the names of their files."""
    results = {f"round-{number}.json": entry.result for number, entry in enumerate(found.rounds)}
    written = {
        name: ResultDocument.of(each, provenance=provenance).to_json()
        for name, each in (results | {"result.json": found.result}).items()
    }
    return written | {"network.json": final_document(document, found).to_json()}
