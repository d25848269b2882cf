"""The procedure of Vosselman and Förstner up to the labelled image coordinates of all recordings.

G. Vosselman and W. Förstner, The precision of a digital camera. Sections 2 and 3 of it are done here for
every recording: straight lines (3.1), rectification and targets (3.2), their recognition and numbers
(3.3), their location by least-squares matching (3.4). The adjustment of the bundle comes after.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ..core.data import Frame, ImagePoints
from ..core.errors import UsageError
from ..core.failure import Failure
from ..io import TestfieldDesign
from ..measure import TestfieldOptions, TestfieldResult, measure_testfield

__all__ = ["Recordings", "measure_recordings"]


@dataclass(frozen=True, eq=False)
class Recordings:
    """What was measured in the recordings of a testfield, by the names of these.

    Parameters
    ----------
    measured : dict
        Results of those in which the testfield was found.
    declined : dict
        Why it was not in the others.
    """

    measured: dict[str, TestfieldResult]
    declined: dict[str, str]

    def points(self) -> Iterator[tuple[str, ImagePoints]]:
        """Labelled image coordinates with covariances, recording by recording: the input of a bundle."""
        for name, result in self.measured.items():
            yield name, result.points


def measure_recordings(
    frames: Iterable[Frame], design: TestfieldDesign, options: TestfieldOptions | None = None
) -> Recordings:
    """Measure a testfield in all its recordings.

    Parameters
    ----------
    frames : iterable of Frame
        The recordings, of different names.
    design : TestfieldDesign
        The testfield.
    options : TestfieldOptions, optional
        How.

    Raises
    ------
    UsageError
        When two recordings have the same name.
    ImageError
        When one is all of one grey, or almost all saturated.
    """
    measured: dict[str, TestfieldResult] = {}
    declined: dict[str, str] = {}
    for frame in frames:
        if frame.name in measured or frame.name in declined:
            raise UsageError("is the name of two recordings", where=frame.name)
        result = measure_testfield(frame, design, options)
        if isinstance(result, Failure):
            declined[frame.name] = result.reason
        else:
            measured[frame.name] = result
    return Recordings(measured, declined)
