"""Files of the archive over HTTP: ranges, previews, and reports in a sandbox."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, BinaryIO

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from ...archive import Session
from ...archive.records import ArchivedFrame, ArchivedResult

if TYPE_CHECKING:
    from ...core.data import Frame
    from ...report.overlay import Marks


_TYPES = {
    ".csv": "text/csv; charset=utf-8", ".html": "text/html; charset=utf-8", ".ics": "text/calendar",
    ".jpeg": "image/jpeg", ".jpg": "image/jpeg", ".json": "application/json", ".pdf": "application/pdf",
    ".png": "image/png", ".svg": "image/svg+xml", ".tif": "image/tiff", ".toml": "text/plain; charset=utf-8",
    ".txt": "text/plain; charset=utf-8", ".xml": "application/xml",
}  # fmt: skip
SANDBOX = (
    "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; font-src data:; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Of files of the archive: they may have inline styles and pictures, but no script, and no origin."""
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")
_PIECE = 1 << 18
_IMMUTABLE = "private, max-age=31536000, immutable"
FILE_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"content": {"*/*": {}}, "description": "The file"},
    206: {"content": {"*/*": {}}, "description": "A part of the file"},
    304: {"description": "The file is known to the client"},
    416: {"description": "The file has no such part"},
}


def file_answer(request: Request, content: BinaryIO, name: str, sha256: str) -> Response:
    """Return a file or the range of it that is asked for; what a browser would execute is in a sandbox.

    Parameters
    ----------
    request : Request
        Has `Range` and `If-None-Match`.
    content : binary file
        The file, which is closed when it was sent; large ones are never in memory as a whole.
    name : str
        Its name, for saving.
    sha256 : str
        Its hash: the answer may be kept for ever.
    """
    suffix = "." + name.rpartition(".")[2].lower()
    plain = re.sub(r"[^A-Za-z0-9._ -]", "_", name)
    tag = f'"{sha256}"'
    headers = {
        "ETag": tag, "Accept-Ranges": "bytes", "Cache-Control": _IMMUTABLE,
        "Content-Security-Policy": SANDBOX,
        "X-Frame-Options": "SAMEORIGIN", "Content-Disposition": f'inline; filename="{plain}"',
    }  # fmt: skip
    kind = _TYPES.get(suffix, "application/octet-stream")
    if request.headers.get("if-none-match") == tag:
        content.close()
        return Response(status_code=304, headers=headers)
    size = content.seek(0, os.SEEK_END)
    wanted = _RANGE.fullmatch(request.headers.get("range", ""))
    if wanted is None or not (wanted[1] or wanted[2]):
        return _sent(content, 0, size, 200, headers, kind)
    if wanted[1]:
        start, end = int(wanted[1]), min(int(wanted[2] or size - 1), size - 1)
    else:
        start, end = max(0, size - int(wanted[2])), size - 1
    if start > end or start >= size:
        content.close()
        return Response(status_code=416, headers=headers | {"Content-Range": f"bytes */{size}"})
    headers["Content-Range"] = f"bytes {start}-{end}/{size}"
    return _sent(content, start, end + 1, 206, headers, kind)


def _sent(
    content: BinaryIO, start: int, end: int, status: int, headers: dict[str, str], kind: str
) -> Response:
    """A part of a file, in pieces."""

    def pieces() -> Iterator[bytes]:
        with content:
            left = end - content.seek(start)
            while left > 0 and (piece := content.read(min(left, _PIECE))):
                left -= len(piece)
                yield piece

    return StreamingResponse(pieces(), status, headers | {"Content-Length": str(end - start)}, kind)


def picture_answer(request: Request, draw: Callable[[], bytes | str], kind: str, tag: str) -> Response:
    """Return a picture that follows from what the archive has; it is drawn if the client has not this one."""
    quoted = f'"{tag}"'
    headers = {"ETag": quoted, "Cache-Control": "private, no-cache", "Content-Security-Policy": SANDBOX}
    if request.headers.get("if-none-match") == quoted:
        return Response(status_code=304, headers=headers)
    return Response(draw(), 200, headers, kind)


def preview_jpeg(session: Session, archived: ArchivedFrame, width: int) -> bytes:
    """Return a frame reduced to a width, with 8 bits, as JPEG."""
    import cv2

    from ...report.overlay import preview

    _, coded = cv2.imencode(".jpg", preview(session.picture(archived), width), [cv2.IMWRITE_JPEG_QUALITY, 80])
    return coded.tobytes()


def marks_of(session: Session, archived: ArchivedFrame) -> tuple[Frame, Marks, str]:
    """Return a frame, the marks that are measured in it again, and why there are none.

    Raises
    ------
    ReseauError
        If the session has no design, or the frame cannot be read.
    """
    import numpy as np

    from ...core.errors import UsageError
    from ...core.failure import Failure
    from ...io import parse_design
    from ...measure.testfield.measure import TestfieldOptions
    from ...procedures.target_measurement import measurer_of
    from ...report.overlay import Marks
    from ...sessions.parameters import present_keys

    names = [name for name in session.inputs() if name in ("design.json", "reseau.json")]
    if not names:
        raise UsageError("has no design of a target", where=session.name)
    given = present_keys(session.parameters)
    options = TestfieldOptions(row_jitter_px=given.get("row_jitter_px", 0.0), fill=given.get("fill", 1.0))
    frame = session.picture(archived)
    found: Any = measurer_of(parse_design(session.input(names[0]), names[0]), options)(frame)
    if isinstance(found, Failure):
        return frame, Marks((), np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)), found.reason
    points = found.points
    return frame, Marks(points.names, points.xy, np.ones(len(points), dtype=np.bool_)), ""


def result_named(session: Session, number: int) -> ArchivedResult | None:
    """Return a result by its number, or None."""
    return next((each for each in session.results() if each.id == number), None)
