"""Results that are drawn over the picture in which they were measured."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .data import Frame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .overlay import Layer


class Overlaid:
    """Base of such results."""

    def overlay(self, picture: Frame | NDArray[Any], path: Path | str | None = None) -> NDArray[np.uint8]:
        """Draw what was measured and what was declined, and why, over every pixel of the picture.

        Parameters
        ----------
        picture : Frame or ndarray (h, w) or (h, w, 3)
            The frame that was measured; or grey or RGB values of a scan.
        path : str or Path, optional
            PNG file to write.

        Returns
        -------
        ndarray (h, w, 3) of uint8
            The picture, enlarged by a whole number if it is small, with a legend below it.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        from .overlay import draw_overlay

        pixels = picture.pixels if isinstance(picture, Frame) else picture
        return draw_overlay(pixels, self.layers(), self._heading(), self._footnotes(), path)

    @abstractmethod
    def layers(self) -> list[Layer]:
        """What is drawn: first what was measured, then each reason for declining."""

    @abstractmethod
    def _heading(self) -> str:
        """First line of the legend."""

    def _footnotes(self) -> Sequence[str]:
        """Last lines of the legend."""
        return ()
