"""The page of a live picture, on the loopback interface: marks, light, focus, coverage, what is reached.

Nothing can be changed through it: it answers ``GET`` only. A page of another site that has a name of its own
resolve to this machine is refused, because its requests carry that name in their ``Host``.
"""

from __future__ import annotations

import json
import math
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from ..capture.checks import edge_sigma, exposure_of, grey_counts
from ..core.data import Frame
from ..core.errors import UsageError
from ..procedures.watching import Seen
from ..report.overlay import preview

_ADDRESS, _WIDTH, _BINS, _RED = "127.0.0.1", 960, 64, (40, 40, 235)
_PAGES = {"/": ("live.html", "text/html"), "/live.js": ("live.js", "text/javascript"),
          "/live.css": ("live.css", "text/css")}  # fmt: skip
_SAFE = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class LivePage:
    """A page that shows the last frame and what was seen in it.

    Parameters
    ----------
    title : str
        Its heading.
    port : int
        Port on 127.0.0.1; 0 for a free one.

    Raises
    ------
    UsageError
        When the port is in use.

    Examples
    --------
    >>> with LivePage("camera") as page:
    ...     page.url.startswith("http://127.0.0.1:")
    True
    """

    def __init__(self, title: str, port: int = 0) -> None:
        self._lock = threading.Lock()
        self._picture, self._sharpest = b"", float("inf")
        self._state: dict[str, Any] = {"title": title, "number": 0, "words": "waiting for the first picture"}
        try:
            self._server = ThreadingHTTPServer((_ADDRESS, port), _handler(self))
        except OSError as error:
            raise UsageError(f"cannot be used ({error.strerror})", where=f"port {port}") from None
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)

    @property
    def port(self) -> int:
        """The port on 127.0.0.1."""
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{_ADDRESS}:{self.port}/"

    def show(self, frame: Frame, seen: Seen, wanted: int) -> None:
        """Show a frame, what was seen in it, and how many frames are wanted.

        The width of the sharpest edges is shown with the smallest one so far: turn the focus until it is
        reached again.
        """
        _, coded = cv2.imencode(".jpg", _marked(frame), [cv2.IMWRITE_JPEG_QUALITY, 80])
        edge = edge_sigma(frame)
        self._sharpest = min(self._sharpest, edge)
        counts = np.array(grey_counts(frame, _BINS)[:_BINS])
        state = {
            "number": self._state["number"] + 1,
            "width": frame.width,
            "height": frame.height,
            "points": seen.xy.round(1).tolist(),
            "covered": seen.covered.astype(int).tolist(),
            "histogram": (counts / max(1, counts.max())).round(3).tolist(),
            "saturated": exposure_of(frame)[0],
            "edge_px": edge if math.isfinite(edge) else None,
            "sharpest_px": self._sharpest if math.isfinite(self._sharpest) else None,
            "words": seen.words,
            "taken": seen.taken,
            "frames": seen.frames,
            "wanted": wanted,
            "sigmas": {name: f"{value:.2g}" for name, value in seen.sigmas.items()},
            "verdict": list(seen.verdict),
        }
        with self._lock:
            self._state |= state
            self._picture = coded.tobytes()

    def answer(self, path: str) -> tuple[bytes, str] | None:
        """Content and media type of a path; None where there is nothing."""
        with self._lock:
            if path == "/state.json":
                return json.dumps(self._state).encode(), "application/json"
            if path == "/frame.jpg":
                return (self._picture, "image/jpeg") if self._picture else None
        if path in _PAGES:
            name, kind = _PAGES[path]
            return files("reseau.service").joinpath("pages", name).read_bytes(), f"{kind}; charset=utf-8"
        return None

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _marked(frame: Frame) -> NDArray[np.uint8]:
    """A small picture of a frame; where a pixel is saturated it is red."""
    small = preview(frame, _WIDTH)
    coloured = small if small.ndim == 3 else cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    full = (frame.pixels >= frame.full_scale).astype(np.float32)
    height, width = coloured.shape[:2]
    coloured[cv2.resize(full, (width, height), interpolation=cv2.INTER_AREA) > 0] = _RED
    return np.asarray(coloured, np.uint8)


def _handler(page: LivePage) -> type[BaseHTTPRequestHandler]:
    """The handler of the requests of a page."""

    class Handler(BaseHTTPRequestHandler):
        timeout = 10

        def do_GET(self) -> None:
            if self.headers.get("Host") not in (f"{_ADDRESS}:{page.port}", f"localhost:{page.port}"):
                self._send(403, b"this page is for this machine only\n", "text/plain")
                return
            found = page.answer(self.path.partition("?")[0])
            if found is None:
                self._send(404, b"not found\n", "text/plain")
            else:
                self._send(200, *found)

        def _send(self, status: int, content: bytes, kind: str) -> None:
            self.send_response(status)
            for name, value in {**_SAFE, "Content-Type": kind, "Content-Length": str(len(content))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None:
            """Requests are not logged."""

    return Handler
