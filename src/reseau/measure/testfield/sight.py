"""A testfield recognised in a frame: its lines found, its squares read, and put on the board.

Where blur hides lines a pixel wide the frame is sharpened first (by Wiener's filter, as in Gonzalez & Woods,
*Digital Image Processing*, 5.8), for this alone: targets are measured in the frame as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.failure import Code, Failure
from ...io import TestfieldDesign
from ...optics.formation import PixelResponse
from ..screening import quiet_noise
from .clusters import Placement, Reading, locate, read_clusters
from .lattice import LatticeFit, lattices, straightened
from .lines import Ridges, find_lattice, ridge_points
from .profiles import blur_of

__all__ = ["Read", "Sight"]

_BLURRED_PX, _SHARP_PX = 1.8, 0.7
"""Width of the point-spread function that is taken out of a blurred frame, and of that put in its place."""
_LEAST_POWER = 2e-3
"""Power of the noise over that of the image, at least, when it is sharpened."""
_ELSEWHERE = 0.2
"""Part of the ridge points beyond a testfield from which on another one is looked for."""


@dataclass(frozen=True, eq=False)
class Read:
    """What was recognised: the lattice of lines, its clusters, and where on the board it lies."""

    ridges: Ridges
    lattice: LatticeFit
    reading: Reading
    placed: Placement


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame in which a testfield is looked for.

    Parameters
    ----------
    grey, dark : ndarray (h, w), float32
        Its grey values, and the same with dark lines on a bright ground.
    design : TestfieldDesign
        What stands on the board.
    psf_px : float
        First guess of the width of the point-spread function.
    response : PixelResponse
        The pixel.
    taken_px2 : float
        Variance of the point-spread function that has been taken out of the frame.
    """

    grey: NDArray[np.float32]
    dark: NDArray[np.float32]
    design: TestfieldDesign
    psf_px: float
    response: PixelResponse
    taken_px2: float = 0.0

    def sharpened(self, noise: float) -> Sight:
        """The frame with a good part of a blur taken out; its noise is `noise`."""
        power = max(_LEAST_POWER, (noise / max(float(self.grey.std()), 1e-9)) ** 2)
        grey, dark = (_sharpened(image, power) for image in (self.grey, self.dark))
        return replace(self, grey=grey, dark=dark, psf_px=1.0, taken_px2=_BLURRED_PX**2 - _SHARP_PX**2)

    def blurred(self, psf_px: float) -> float:
        """Width of the point-spread function of the frame as it was, from that here."""
        return float(np.sqrt(psf_px**2 + self.taken_px2))

    def read(self, ridges: Ridges | None = None) -> Read | Failure:
        """The first of the lattices through the lines found whose squares are those of the design.

        Parameters
        ----------
        ridges : Ridges, optional
            Ridge points among which lines are looked for; all of the frame by default.
        """
        ridges = ridges or ridge_points(self.dark, quiet_noise(self.dark))
        found = find_lattice(ridges)
        if isinstance(found, Failure):
            return found
        design, failure = self.design, None
        width, blur = design.lines.width / design.pitch, blur_of(self.psf_px, self.response)
        for lattice in lattices(self.dark, ridges, found, width, blur):
            reading = read_clusters(self.grey, lattice, design, self.psf_px, self.response)
            placed = reading if isinstance(reading, Failure) else locate(reading, design)
            if isinstance(placed, Placement) and isinstance(reading, Reading):
                return Read(ridges, lattice, reading, placed)
            if failure is None and isinstance(placed, Failure):
                failure = placed
        if failure is None:
            failure = Failure("the straight lines found lie in no common lattice", Code.NOT_FOUND)
        return failure

    def another(self, read: Read) -> bool:
        """Whether the testfield is to be found once more beyond the place where it was found."""
        x0, y0, x1, y1 = self.design.lines.extent
        corners = (
            np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) @ read.placed.frame.T + read.placed.origin
        )
        # Half a square is left around it; the projectivity alone tells near enough where it ends.
        low, high = corners.min(axis=0) - 0.5, corners.max(axis=0) + 0.5
        at = straightened(read.lattice.mapping, read.ridges.xy)
        beyond = ((at < low) | (at > high)).any(axis=1)
        if beyond.mean() < _ELSEWHERE:
            return False
        rest = replace(read.ridges, xy=read.ridges.xy[beyond], normal=read.ridges.normal[beyond])
        return not isinstance(self.read(rest), Failure)


def _sharpened(grey: NDArray[np.float32], power: float) -> NDArray[np.float32]:
    """An image with one Gaussian blur in the place of another, `power` being that of the noise."""
    (h, w), margin = grey.shape, min(int(4 * _BLURRED_PX + 4), min(grey.shape) - 1)
    wide = np.pad(grey, margin, mode="reflect")
    down, across = np.fft.fftfreq(wide.shape[0])[:, None], np.fft.rfftfreq(wide.shape[1])
    before, after = (
        np.exp(-2 * (np.pi * sigma) ** 2 * (down**2 + across**2)) for sigma in (_BLURRED_PX, _SHARP_PX)
    )
    found = np.fft.irfft2(np.fft.rfft2(wide) * after * before / (before**2 + power), s=wide.shape)
    return found[margin : margin + h, margin : margin + w].astype(np.float32)
