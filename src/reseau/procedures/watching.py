"""Photographs of a target from a live picture: each frame that is sharp, still and new is taken.

A frame is still if its points moved little since the frame before, which also bounds the motion blur; sharp
if the standard deviations of its points are not much larger than those of the best frame taken so far; new if
the target lies elsewhere in the image than in all frames taken before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..core.data import Array, Frame, ImagePoints, Mask
from ..core.errors import UsageError
from ..core.failure import Failure
from ..core.files import empty_folder, made_folder
from ..io.images import read_image, write_image
from ..measure.points import Measured
from .calibration_options import CameraOptions, PlaneDesign
from .exposures import photographs_in
from .target_measurement import Measurer
from .testfield import TestfieldProcedure

_ACROSS, _DOWN = 12, 9
_LEAST_IMAGES, _LEAST_POINTS = 3, 12
_STILL_PX = 1.5
"""Largest movement of the points since the frame before, root mean square."""
_SHARP = 2.5
"""Largest ratio of the median standard deviation of the points to the smallest of the frames taken."""
_NEW = 0.05
"""Smallest movement of the points since each frame taken before, root mean square, in image widths."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What a frame showed.

    Parameters
    ----------
    taken : bool
        Whether it was taken.
    words : str
        What to do, for the person who moves the target or the camera.
    xy : ndarray (n, 2)
        Measured points, pixels.
    covered : ndarray of bool (9, 12)
        Cells of the image that have points in the frames taken so far.
    frames : int
        Number of frames taken.
    sigmas : dict of str to float
        Standard deviations of the parameters reached so far; empty before the third frame.
    verdict : tuple of str
        What the calibration so far is good for.

    Examples
    --------
    >>> Seen(False, "show the target", np.zeros((0, 2)), np.zeros((9, 12), dtype=bool), 0).sigmas
    {}
    """

    taken: bool
    words: str
    xy: Array
    covered: Mask
    frames: int
    sigmas: Mapping[str, float] = field(default_factory=dict)
    verdict: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Place:
    """A frame of a camera that is moved by hand."""

    name: str
    position: Mapping[str, float] = field(default_factory=dict)
    camera: str = ""
    exposure: str = ""


class Watching:
    """A calibration during a live picture; the frames that it takes join the calibration at once.

    Parameters
    ----------
    design : PlaneDesign
        The target.
    measure : callable
        Measures the target in a frame.
    model : CameraOptions
        Camera model and parameters to estimate.

    Examples
    --------
    >>> from reseau.designs import board
    >>> from reseau.procedures.target_measurement import measurer_of
    >>> design = board("charuco", 7, 6, 24.0)
    >>> watching = Watching(design, measurer_of(design), CameraOptions())
    >>> watching.on_frame(Frame(np.full((90, 120), 128, np.uint8), 255.0), "001").taken
    False
    """

    def __init__(self, design: PlaneDesign, measure: Measurer, model: CameraOptions) -> None:
        self._measure = measure
        self._current: Measured | Failure | None = None
        self._procedure = TestfieldProcedure(
            design, self._again, model, name="watch", least_points=_LEAST_POINTS
        )
        self._before: ImagePoints | None = None
        self._taken: list[ImagePoints] = []
        self._best = np.inf
        self._covered = np.zeros((_DOWN, _ACROSS), dtype=np.bool_)
        self._sigmas: Mapping[str, float] = {}
        self._verdict: tuple[str, ...] = ()

    def _again(self, frame: Frame) -> Measured | Failure:
        """The measurement of this frame, which was made already."""
        assert self._current is not None
        return self._current

    @property
    def frames(self) -> int:
        """Number of frames taken."""
        return len(self._taken)

    @property
    def verdict(self) -> tuple[str, ...]:
        """What the calibration so far is good for; empty before the third frame."""
        return self._verdict

    def resume(self, frame: Frame, name: str) -> Failure | None:
        """Take a frame of an earlier session as it is; why it cannot be measured otherwise."""
        points = self._measured(frame)
        if points is not None:
            self._take(frame, points, name)
        return self._current if isinstance(self._current, Failure) else None

    def on_frame(self, frame: Frame, name: str) -> Seen:
        """Measure a frame, and take it under this name if it is sharp, still and new."""
        points = self._measured(frame)
        words = self._objection(points, frame.width)
        self._before = points
        taken = not words and points is not None
        if taken and points is not None:
            self._take(frame, points, name)
            words = f"taken: {len(self._taken)} frames; move the target or the camera"
        xy = np.zeros((0, 2)) if points is None else points.xy
        return Seen(taken, words, xy, self._covered.copy(), len(self._taken), self._sigmas, self._verdict)

    def _measured(self, frame: Frame) -> ImagePoints | None:
        """The points of a frame, which becomes the current one."""
        self._current = self._measure(frame)
        return None if isinstance(self._current, Failure) else self._current.points

    def _objection(self, points: ImagePoints | None, width: int) -> str:
        """Why the frame is not taken, and what helps; empty where nothing does."""
        if points is None:
            assert isinstance(self._current, Failure)
            return f"the target is not seen: {self._current.reason}"
        if len(points) < _LEAST_POINTS:
            return f"only {len(points)} points are seen: show more of the target"
        moved = np.inf if self._before is None else _moved(points, self._before)
        if moved > _STILL_PX:
            return "hold still"
        if min((_moved(points, each) for each in self._taken), default=np.inf) < _NEW * width:
            return "seen before: move the target to another place, or tilt it"
        if _sigma(points) > _SHARP * self._best:
            return "not sharp: hold still, add light, or focus"
        return ""

    def _take(self, frame: Frame, points: ImagePoints, name: str) -> None:
        from .assessment import assess

        self._procedure.on_frame(frame, _Place(name))
        self._taken.append(points)
        self._best = min(self._best, _sigma(points))
        size = np.array([frame.width, frame.height])
        cell = (points.xy / size * [_ACROSS, _DOWN]).astype(int).clip(0, [_ACROSS - 1, _DOWN - 1])
        self._covered[cell[:, 1], cell[:, 0]] = True
        self._sigmas = self._procedure.progress()
        if len(self._taken) >= _LEAST_IMAGES:
            found = self._procedure.calibrated()
            self._verdict = (found.reason,) if isinstance(found, Failure) else assess(found.result).lines


class WatchedFolder:
    """The photographs that a live picture leaves in a folder.

    Parameters
    ----------
    folder : Path
        New or empty, unless an earlier session is resumed; it is made when frames are taken.
    watching : Watching
        Decides which frames are taken.
    count : int
        Frames that are wanted.
    resume : bool
        Whether the frames of an earlier session that the folder holds are used.

    Attributes
    ----------
    left_out : dict of str to Failure
        Frames of the earlier session that cannot be measured.

    Raises
    ------
    UsageError
        When the folder is not empty, or fewer frames are wanted than a calibration needs.

    Examples
    --------
    >>> from reseau.designs import board
    >>> from reseau.procedures.target_measurement import measurer_of
    >>> design = board("charuco", 7, 6, 24.0)
    >>> watching = Watching(design, measurer_of(design), CameraOptions())
    >>> WatchedFolder(Path("src"), watching)
    Traceback (most recent call last):
    ...
    reseau.core.errors.UsageError: src: is not empty; give a new folder, or resume an earlier session
    """

    def __init__(self, folder: Path, watching: Watching, count: int = 15, resume: bool = False) -> None:
        if count < _LEAST_IMAGES:
            raise UsageError(f"is {count}, not at least {_LEAST_IMAGES}", where="count")
        self.folder, self.count, self._watching, self._number = folder, count, watching, 0
        self.left_out: dict[str, Failure] = {}
        if not resume:
            empty_folder(folder, "give a new folder, or resume an earlier session")
        elif folder.is_dir() and any(folder.iterdir()):
            for path in photographs_in(folder):
                self._number = max(self._number, int(path.stem) if path.stem.isdecimal() else 0)
                declined = watching.resume(read_image(path), path.name)
                if declined is not None:
                    self.left_out[path.name] = declined

    def taken(
        self, expose: Callable[[], Frame], over: Callable[[], bool] = lambda: False
    ) -> Iterator[tuple[Frame, Seen, Path | None]]:
        """Look at frames until as many as wanted are taken, or it is over.

        Yields
        ------
        (Frame, Seen, Path or None)
            Each frame, what it showed, and the file in which it was written if it was taken.
        """
        made_folder(self.folder)
        while self._watching.frames < self.count and not over():
            frame, path = expose(), self.folder / f"{self._number + 1:03d}.png"
            seen = self._watching.on_frame(frame, path.name)
            if seen.taken:
                write_image(path, frame.pixels)
                self._number += 1
            yield frame, seen, path if seen.taken else None

    @property
    def enough(self) -> bool:
        """Whether there are as many frames as a calibration needs."""
        return self._watching.frames >= _LEAST_IMAGES


def _sigma(points: ImagePoints) -> float:
    """Median standard deviation of the points, px."""
    return float(np.median(np.sqrt(np.trace(points.cov, axis1=1, axis2=2) / 2)))


def _moved(points: ImagePoints, before: ImagePoints) -> float:
    """Root mean square of the movement of the points that both have; infinite with fewer than four."""
    _, now, then = np.intersect1d(points.names, before.names, return_indices=True)
    if len(now) < 4:
        return float("inf")
    return float(np.sqrt(((points.xy[now] - before.xy[then]) ** 2).sum(axis=1).mean()))
