"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from .errors import InputError

__all__ = ["split_frame", "write_whole"]


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file completely or not at all.

    Raises
    ------
    InputError
        When the folder does not exist or cannot be written to.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_whole(Path(folder) / "note.txt", b"21")
    ...     (Path(folder) / "note.txt").stat().st_size
    2
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise InputError(f"cannot be written ({error.strerror})", where=path) from None


_NUMBERED = re.compile(r"(?P<file>.+)#(?P<frame>\d+)")


def split_frame(path: Path) -> tuple[Path, int | None]:
    """Split ``file.dcm#3`` into the file and the number of its frame, from 1; None without one.

    A file that is really called so is left as it is.

    Examples
    --------
    >>> file, frame = split_frame(Path("loop.dcm#3"))
    >>> file.name, frame
    ('loop.dcm', 3)
    """
    found = _NUMBERED.fullmatch(path.name)
    if found is None or path.exists():
        return path, None
    return path.with_name(found["file"]), int(found["frame"])
