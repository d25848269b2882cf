"""Images that are not taken at one moment: their lines follow each other while the camera moves.

Line y of an image is taken at the time t = (y − y_m)·line_s, where y_m is the middle of the image. At that
time the camera has the pose::

    x_c(t) = exp(t·ω) (R(X − X0) − t·v)

R and X0 are the pose at the middle line, v the velocity of the projection centre along the axes that the
camera has there, ω its rotation rates about these axes. A point has its image on the line at whose time it is
seen there. With a *rolling* shutter each line of the sensor is read at its time: y is also the coordinate on
the sensor. A *line* camera has one line of sensor elements: its points are on the line where they are seen at
the row `row` of the camera model, and y only counts time.

Gupta, R. & Hartley, R. (1997), Linear pushbroom cameras, PAMI 19(9); Hedborg, J., Forssén, P.-E., Felsberg,
M. & Ringaby, E. (2012), Rolling shutter bundle adjustment, CVPR.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...core.data import Array, Mask
from ...core.errors import UsageError

MOTION = ("vx", "vy", "vz", "wx", "wy", "wz")
"""Names of velocity and rotation rates."""


@dataclass(frozen=True)
class Shutter:
    """How the lines of the images of a camera follow each other.

    Parameters
    ----------
    mode : {"rolling", "line"}
        Lines of a sensor that is read line by line, or of one line of sensor elements.
    line_s : float
        Time from one line to the next, s; with 1, velocities are per line. Negative where the last line is
        read first.
    free : tuple of str
        Components of :data:`MOTION` to estimate, for each image.
    sigma : mapping of str to float
        Standard deviations of free components that are observations.
    row : float
        Row of the camera model at which a line camera has its sensor elements.

    Raises
    ------
    UsageError
        For an unknown mode or component, or a time of zero.

    Examples
    --------
    >>> Shutter("rolling", 3e-5, ("vx", "wy")).is_free
    array([ True, False, False, False,  True, False])
    """

    mode: Literal["rolling", "line"]
    line_s: float = 1.0
    free: tuple[str, ...] = MOTION
    sigma: Mapping[str, float] | None = None
    row: float = 0.0

    def __post_init__(self) -> None:
        if self.mode not in ("rolling", "line"):
            raise UsageError(f"is {self.mode!r}", where="mode of a shutter", do="write `rolling` or `line`")
        if not (np.isfinite(self.line_s) and self.line_s != 0):
            raise UsageError(
                f"is {self.line_s:g}", where="line_s of a shutter", do="write a time other than 0"
            )
        for name in (*self.free, *(self.sigma or {})):
            if name not in MOTION:
                raise UsageError(f"is not one of {', '.join(MOTION)}", where=f"{name} of a shutter")
        for name, sigma in (self.sigma or {}).items():
            if name not in self.free or not sigma > 0:
                raise UsageError(
                    "needs a sigma above zero and to be free", where=f"observed {name} of a shutter"
                )

    @property
    def is_free(self) -> Mask:
        """Which components are estimated (6,)."""
        return np.array([name in self.free for name in MOTION])

    @property
    def sigmas(self) -> Array:
        """Standard deviations (6,) of observed components, 0 for the others."""
        return np.array([(self.sigma or {}).get(name, 0.0) for name in MOTION])

    def columns(self, height: int, *, implicit: bool) -> Array:
        """What the compiled loops know: time of a line, line at time 0, row of a line camera or NaN, solved.

        Parameters
        ----------
        height : int
            Lines of the image.
        implicit : bool
            Whether the camera corrects the measured point; its time is then that of the measured line, which
            is the same to first order in the noise.
        """
        row = self.row if self.mode == "line" else np.nan
        return np.array([self.line_s, (height - 1) / 2, row, float(not implicit)])
