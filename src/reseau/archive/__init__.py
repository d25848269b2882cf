"""The archive: frames and results with their provenance; written once, checked by hash, never changed.

Names are imported when they are first used: files of a store need no database.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
    from .archive import Archive
    from .picture import tiff_of
    from .records import Verdict
    from .session import Session

__all__ = ["Archive", "Session", "Verdict", "tiff_of"]

__getattr__ = lazily(
    __name__,
    {
        "Archive": ".archive",
        "tiff_of": ".picture",
        "Verdict": ".records",
        "Session": ".session",
    },
)
