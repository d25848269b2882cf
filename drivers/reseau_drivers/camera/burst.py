"""Sequences of frames at the rate of a camera, as bluesky flies them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from reseau.core.errors import StateError, UsageError
from reseau.instruments import ImageStore, Status

from .camera import CameraDriver


class Burst:
    """Consecutive frames of a camera, for ``bluesky.plans.fly``.

    With a camera that is triggered by hardware, each trigger gives a frame.

    Parameters
    ----------
    camera : CameraDriver
        The camera.
    count : int
        Number of frames.

    Examples
    --------
    >>> from reseau_drivers.camera import v4l2
    >>> Burst(v4l2("eye", "/dev/video0"), 20).name
    'eye_burst'
    """

    def __init__(self, camera: CameraDriver[Any], count: int) -> None:
        self.name, self.parent = f"{camera.name}_burst", None
        self._camera, self._images = camera, ImageStore(f"{camera.name}_burst")
        self._image = f"{camera.name}_image"
        self._status: Status | None = None
        self._events: list[dict[str, Any]] = []
        self._count = count
        self.prepare(count)

    def prepare(self, value: int | Mapping[str, Any]) -> Status:
        """Set the number of frames, or settings of the camera with it, as ``{"frames": 20, "rate": 50.0}``.

        Raises
        ------
        UsageError
            If the number of frames is not positive.
        """
        settings = {"frames": value} if isinstance(value, int) else dict(value)
        count = settings.pop("frames", self._count)
        if not isinstance(count, int) or count < 1:
            raise UsageError(f"{count!r} is not a number of frames", where=self.name)
        self._count = count
        work = (lambda: self._camera.configure(settings)) if settings else (lambda: None)
        return Status(work, f"{self.name}.prepare")

    def kickoff(self) -> Status:
        """Begin to take frames in the background.

        Raises
        ------
        StateError
            If it is still taking frames.
        """
        if self._status is not None and not self._status.done:
            raise StateError("is under way", where=self.name, do="wait until it is complete")
        self._camera.stage()
        self._images.restart()
        self._events = []
        self._status = Status(self._run, self.name)
        return Status(lambda: None, f"{self.name}.kickoff")

    def _run(self) -> None:
        for number, shot in enumerate(self._camera.frames(self._count)):
            self._images.put(self._image, shot.pixels)
            values = {
                self._image: self._images.datum_id(self._image, number),
                f"{self.name}_sequence": shot.sequence,
                f"{self.name}_dropped": shot.dropped,
                f"{self.name}_taken": shot.taken.timestamp(),
            }
            at = time.time()
            self._events.append(
                {
                    "time": at,
                    "data": values,
                    "timestamps": dict.fromkeys(values, at),
                    "filled": {self._image: False},
                }
            )

    def complete(self) -> Status:
        """Return the status that ends with the last frame.

        Raises
        ------
        StateError
            If it was not kicked off.
        """
        if self._status is None:
            raise StateError("was not kicked off", where=self.name)
        return self._status

    def stop(self, *, success: bool = False) -> None:
        """Stop the camera."""
        self._camera.stop(success=success)

    def describe_collect(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return the contents of an event, under the name of the stream."""
        shape = tuple(self._camera.describe()[self._image]["shape"][1:])
        image = self._images.describe(self._image, shape) | {"external": "FILESTORE:"}
        number = {"source": self._camera.name, "dtype": "integer", "shape": []}
        return {
            self.name: {
                self._image: image,
                f"{self.name}_sequence": number,
                f"{self.name}_dropped": number,
                f"{self.name}_taken": number | {"dtype": "number", "units": "s"},
            }
        }

    def collect(self) -> Iterator[dict[str, Any]]:
        """Yield an event for each frame."""
        yield from self._events

    def collect_asset_docs(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield bluesky's documents about the files of the frames."""
        return self._images.datum_documents()
