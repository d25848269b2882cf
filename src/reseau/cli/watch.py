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
    from ..core.data import Frame


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

    from ..capture.lighting import steer
    from ..core.errors import InputError, InstrumentError
    from ..exchange.boards import read_target
    from ..instruments import Camera
    from ..procedures.target_measurement import measurer_of
    from ..procedures.watching import WatchedFolder, Watching
    from ..service.live import LivePage

    target, options = read_target(design), model.options()
    if options.automatic:
        raise UsageError("is chosen from all photographs", where="--model auto", do="give it to calibrate")
    instruments = _bench(bench, camera)
    source = instruments.one(Camera, None if camera is None or camera.startswith("/dev/") else camera)
    # The axes of the bench are free to be moved from elsewhere meanwhile.
    instruments, watching = instruments.part([source.name]), Watching(target, measurer_of(target), options)
    photographs, failed = WatchedFolder(out, watching, count, resume), None
    for name, declined in photographs.left_out.items():
        typer.echo(f"left out: {name}: {declined.reason}", err=True)
    with (
        instruments.lock("reseau watch"),
        instruments,
        LivePage(f"{source.name}: {target.name}", port) as page,
        _Ending() as ending,
    ):
        typer.echo(f"{page.url}  (Ctrl-C ends)", err=True)
        if window and _has_display():
            webbrowser.open(page.url)
        if auto:
            steered = steer(source)
            say(f"{source.name}: exposure_us {steered.exposure_us:g}, gain {steered.gain:g}\n")
            if not steered:
                typer.echo(f"warning: {steered.why}", err=True)
        end = time.monotonic() + (seconds or float("inf"))

        def expose() -> Frame:
            with ending.at_once():
                frame: Frame = source.expose().frame
            return frame

        def over() -> bool:
            return ending.asked or time.monotonic() >= end

        try:
            for frame, seen, path in photographs.taken(expose, over):
                if path is not None:
                    reached = "".join(f"  {key} {value:.2g}" for key, value in seen.sigmas.items())
                    say(f"{path}: {len(seen.xy)} points{reached}\n")
                page.show(frame, seen, count)
        except KeyboardInterrupt:
            pass
        except (InstrumentError, InputError) as error:  # what was taken is reported before it
            failed = error
    for line in watching.verdict:
        say(f"{line}\n")
    kept = f"{watching.frames or 'no'} frame{'s' * (watching.frames != 1)} in {out}"
    if photographs.enough:
        say(f"{kept}; next: reseau calibrate {out} --design {design}\n")
    else:
        say(f"{kept}, too few to calibrate; --resume continues\n")
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
