"""Figure of a blurred target: rays of its centre, the image they form, the photograph, and what is left."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..core.data import Array, Frame
from ..core.errors import UsageError
from ..core.figures import ACCENT, BLUE, FAINT, INK, sheet
from ..measure.blurred.measure import BlurredResult
from ..optics.formation import PixelResponse
from ..optics.lenses import PupilElements, RayMap, ray_image
from ..optics.lenses.images import PlaneTarget

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_RINGS = 8


def blurred_figure(
    frame: Frame,
    camera: RayMap,
    targets: tuple[PlaneTarget, ...],
    found: BlurredResult,
    name: str | None = None,
    fill: float = 1.0,
) -> Figure:
    """Draw a target: spot diagram of its centre, formed image, photograph, residuals.

    Parameters
    ----------
    frame : Frame
    camera : RayMap
    targets : tuple of PlaneTarget (n,)
        In camera axes.
    found : BlurredResult
        What was measured of them.
    name : str, optional
        The target; by default the most blurred one that was measured.
    fill : float
        Light-sensitive share of the pitch of a pixel.

    Raises
    ------
    UsageError
        When there is no such target, or none was measured.
    """
    if name is not None and name not in found.ids:
        raise UsageError(f"there is no target {name!r}", where=found.image)
    if name is None and not found.ok.any():
        raise UsageError("no target was measured", where=found.image)
    blur = np.where(found.ok, found.blur_px, -1.0)
    k = int(np.argmax(blur)) if name is None else found.ids.index(name)
    if not found.ok[k]:
        raise UsageError(f"{found.ids[k]} was not measured: {found.why[k]}", where=found.image)
    elements, target, xy = PupilElements.gauss(_RINGS), targets[k], found.xy[k]
    image = ray_image(camera, target, elements)
    half = int(np.abs(image.outline.xy).max()) + 6
    columns, rows = (np.rint(at) + np.arange(-half, half + 1.0) for at in xy)
    inside_x, inside_y = (columns >= 0) & (columns < frame.width), (rows >= 0) & (rows < frame.height)
    columns, rows = columns[inside_x], rows[inside_y]
    share = image.formed(xy, float(found.psf_px[k]), columns, rows, PixelResponse(fill))
    photograph = frame.pixels[np.ix_(rows.astype(np.intp), columns.astype(np.intp))].astype(float)
    design = np.stack([share.ravel(), np.ones(share.size)], axis=1)
    formed = (design @ np.linalg.lstsq(design, photograph.ravel(), rcond=None)[0]).reshape(share.shape)
    spots, light = camera.spots(target.centre[None], elements)
    weight = np.linalg.norm(light[:, 0], axis=2)
    return _drawn(
        found, k, (spots[:, 0] - image.point, weight), image.centroid, (columns, rows), formed, photograph
    )


def _drawn(
    found: BlurredResult,
    k: int,
    spots: tuple[Array, Array],
    centroid: Array,
    pixels: tuple[Array, Array],
    formed: Array,
    photograph: Array,
) -> Figure:
    """The four panels."""

    with sheet((11.0, 3.3), facecolor="white") as figure:
        first, *others = figure.subplots(1, 4)
        for colour, xy, weight in zip((BLUE, INK, ACCENT, FAINT), spots[0], spots[1], strict=False):
            seen = weight > 0
            first.plot(*xy[seen].T, ".", color=colour, markersize=2.5)
        first.plot(0, 0, "+", color=INK, markersize=12)
        first.plot(*centroid, "x", color=ACCENT, markersize=7)
        first.set_aspect("equal", adjustable="datalim")
        first.invert_yaxis()
        first.set_title("rays of the centre (px), by wavelength")
        (columns, rows), (low, high) = pixels, (float(photograph.min()), float(photograph.max()))
        extent = (columns[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5, rows[0] - 0.5)
        residuals = photograph - formed
        limit = max(3 * float(residuals.std()), 1e-9)
        for axes, picture, title in zip(
            others,
            (formed, photograph, residuals),
            ("formed image", "photograph", f"residuals, ±{limit:.2g}"),
            strict=True,
        ):
            ends = (-limit, limit) if picture is residuals else (low, high)
            axes.imshow(
                picture, cmap="gray", vmin=ends[0], vmax=ends[1], extent=extent, interpolation="nearest"
            )
            axes.plot(*found.xy[k], "+", color=ACCENT, markersize=9)
            axes.set_title(title)
        sigma = np.sqrt(np.diagonal(found.cov[k]))
        figure.suptitle(
            f"{found.image}, {found.ids[k]}: x {found.xy[k, 0]:.3f} ± {sigma[0]:.3f}, "
            f"y {found.xy[k, 1]:.3f} ± {sigma[1]:.3f} px; + corresponding ray, × centre of density, "
            f"{np.hypot(*centroid):.2f} px beside it",
            fontsize=9.5,
        )
    return figure
