"""`reseau watch`: take photographs of a target from a live picture, and see the calibration grow."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.options import Option
from .common import CameraChoice, say

if TYPE_CHECKING:
    from ..capture import Bench

__all__ = ["watch"]

_LEAST = 3
"""Frames without which there is no calibration."""


def watch(
    design: v.Design,
    model: CameraChoice,
    out: Annotated[v.Out, "Here a folder for the frames; new or empty."] = Path("photos"),
    camera: Annotated[v.Camera | None, "Or a video device, as /dev/video0."] = None,
    bench: v.Bench = Path("bench.toml"),
    count: v.Count = 15,
    port: Annotated[v.Port, "Here of the page on 127.0.0.1."] = 0,
    seconds: v.Seconds = 0.0,
    auto: Annotated[v.Auto, "99.5 % of the pixels below 80 % of full scale."] = False,
    resume: Annotated[v.Resume, "Here with the frames of --out."] = False,
    window: Annotated[bool, Option("Open the page in a window, where there is a display.")] = True,
) -> None:
    """Show the live picture of a camera on a page, and take a frame when it is sharp and new."""
    import time
    import webbrowser

    from ..capture import steer
    from ..core.errors import InputError, InstrumentError
    from ..exchange import read_target
    from ..instruments import Camera
    from ..io.images import read_image, write_image
    from ..procedures.exposures import photographs_in
    from ..procedures.target_measurement import measurer_of
    from ..procedures.watching import Watching
    from ..service.live import LivePage

    target = read_target(design)
    if count < _LEAST:
        raise UsageError(f"is {count}, not at least {_LEAST}", where="--count")
    options = model.options()
    if options.automatic:
        raise UsageError("is chosen from all photographs", where="--model auto", do="give it to calibrate")
    before = photographs_in(out) if resume and out.is_dir() and any(out.iterdir()) else []
    if out.exists() and not before and (not out.is_dir() or any(out.iterdir())):
        raise UsageError("is not empty", where=out, do="give a new folder, or --resume")
    instruments = _bench(bench, camera)
    chosen = None if camera is None or camera.startswith("/dev/") else camera
    source = instruments.one(Camera, chosen)
    # The axes of the bench are free to be moved from elsewhere meanwhile.
    instruments, watching = instruments.part([source.name]), Watching(target, measurer_of(target), options)
    for path in before:
        declined = watching.resume(read_image(path), path.name)
        if declined is not None:
            typer.echo(f"left out: {path.name}: {declined.reason}", err=True)
    kept, failed = watching.frames, None
    number = max((int(path.stem) for path in before if path.stem.isdecimal()), default=0)
    with (
        instruments.lock("reseau watch"),
        instruments,
        LivePage(f"{source.name}: {target.name}", port) as page,
        _Ending() as ending,
    ):
        out.mkdir(parents=True, exist_ok=True)
        typer.echo(f"{page.url}  (Ctrl-C ends)", err=True)
        if window and _has_display():
            webbrowser.open(page.url)
        if auto:
            steered = steer(source)
            say(f"{source.name}: exposure_us {steered.exposure_us:g}, gain {steered.gain:g}\n")
            if not steered:
                typer.echo(f"warning: {steered.why}", err=True)
        end = time.monotonic() + (seconds or float("inf"))
        try:
            while kept < count and time.monotonic() < end and not ending.asked:
                with ending.at_once():
                    frame = source.expose().frame
                name = f"{number + 1:03d}.png"
                seen = watching.on_frame(frame, name)
                if seen.taken:
                    write_image(out / name, frame.pixels)
                    number, kept = number + 1, kept + 1
                    reached = "".join(f"  {key} {value:.2g}" for key, value in seen.sigmas.items())
                    say(f"{out / name}: {len(seen.xy)} points{reached}\n")
                page.show(frame, seen, count)
        except KeyboardInterrupt:
            pass
        except (InstrumentError, InputError) as error:  # what was taken is reported before it
            failed = error
    for line in watching.verdict:
        say(f"{line}\n")
    if kept < _LEAST:
        say(f"{kept or 'no'} frame{'s' * (kept != 1)} in {out}, too few to calibrate; --resume continues\n")
    else:
        say(f"{kept} frames in {out}; next: reseau calibrate {out} --design {design}\n")
    if failed is not None:
        raise failed


class _Ending:
    """Ctrl-C, SIGTERM and a closed terminal end the wait for a frame, and otherwise wait for the present one.

    A frame that is being measured or written is counted and reported before the end; a second Ctrl-C is not
    waited for.
    """

    _SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")

    def __init__(self) -> None:
        self.asked = False
        self._now = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        # Handlers are those of the process: only its main thread may set them.
        if threading.current_thread() is threading.main_thread():
            numbers = [getattr(signal, name) for name in self._SIGNALS if hasattr(signal, name)]
            self._before = {number: signal.signal(number, self._on_signal) for number in numbers}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Inside, a signal raises KeyboardInterrupt."""
        self._now = True
        try:
            if self.asked:
                raise KeyboardInterrupt
            yield
        finally:
            self._now = False

    def _on_signal(self, *_: object) -> None:
        again, self.asked = self.asked, True
        if again or self._now:
            raise KeyboardInterrupt


def _has_display() -> bool:
    """Whether windows can be shown."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _bench(path: Path, camera: str | None) -> Bench:
    """The bench of a file, or one with a video device alone."""
    from ..capture import Bench, BenchFile, InstrumentEntry

    if camera is None or not camera.startswith("/dev/"):
        return Bench.read(path)
    entry = InstrumentEntry(driver="v4l2", address=camera)
    return Bench(BenchFile(name=camera, instruments={"camera": entry}))
