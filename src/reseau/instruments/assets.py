"""Images of readings as files: what bluesky's documents refer to, in place of arrays inside events.

Every image is a TIFF in a folder of its series. Readings are described by documents `stream_resource` and
`stream_datum`; sequences that were collected at the end, as by ``bluesky.plans.fly``, by `resource` and
`datum`. Tiled reads both.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from ..core.errors import InputError

ENVIRONMENT = "RESEAU_ASSETS"
_TEMPLATE = "{:06d}.tiff"
Document = tuple[str, dict[str, Any]]


class _Series:
    """Images of one size and type, in one folder."""

    def __init__(self, key: str, folder: Path, pixels: NDArray[Any]) -> None:
        self.key, self.uid = key, str(uuid.uuid4())
        self.folder = folder / self.uid
        self.shape, self.dtype = pixels.shape, pixels.dtype
        self.count, self.reported = 0, 0
        self.announced = False
        self.folder.mkdir(parents=True)

    def put(self, pixels: NDArray[Any]) -> None:
        path = self.folder / _TEMPLATE.format(self.count)
        part = path.with_suffix(".part")
        tifffile.imwrite(part, pixels, photometric="minisblack")
        part.replace(path)
        self.count += 1

    @property
    def parameters(self) -> dict[str, Any]:
        return {"template": _TEMPLATE, "chunk_shape": [1, *self.shape], "join_method": "concat"}


class ImageStore:
    """Stores the images of an instrument for bluesky.

    Parameters
    ----------
    name : str
        Name of the instrument.
    folder : path, optional
        Folder of its series. Default: that of the environment variable ``RESEAU_ASSETS``, else ``assets`` in
        the current folder; a folder with the name of the instrument in it.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     store = ImageStore("eye", Path(folder))
    ...     store.put("eye_image", np.zeros((4, 6), np.uint8))
    ...     print(store.describe("eye_image", (4, 6))["shape"], store.index)
    ...     [kind for kind, _ in store.stream_documents()]
    [1, 4, 6] 1
    ['stream_resource', 'stream_datum']
    """

    def __init__(self, name: str, folder: Path | None = None) -> None:
        self.name, self._folder = name, folder
        self._series: dict[str, _Series] = {}

    @property
    def folder(self) -> Path:
        """Folder of the series."""
        return self._folder or Path(os.environ.get(ENVIRONMENT, "assets")).absolute() / self.name

    @property
    def index(self) -> int:
        """Number of images of the present series."""
        return max((series.count for series in self._series.values()), default=0)

    def restart(self) -> None:
        """Begin new series with the next images: those of another run."""
        self._series.clear()

    def put(self, key: str, pixels: NDArray[Any]) -> None:
        """Store an image under the name of its reading.

        Raises
        ------
        InputError
            If it cannot be written, or differs in size or type from those before it in this run.
        """
        try:
            series = self._series.get(key)
            if series is None:
                series = self._series[key] = _Series(key, self.folder, pixels)
            if (series.shape, series.dtype) != (pixels.shape, pixels.dtype):
                what = f"{pixels.shape} {pixels.dtype} differs from the images before ({series.shape})"
                raise InputError(what, where=key, do="do not change the size within a run")
            series.put(pixels)
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror})", where=self.folder) from None

    def describe(self, key: str, shape: tuple[int, ...]) -> dict[str, Any]:
        """Return the data key of an image: `shape` and 8 bits are taken until there is one."""
        series = self._series.get(key)
        shape, kind = (shape, np.dtype(np.uint8)) if series is None else (series.shape, series.dtype)
        return {
            "source": self.name, "dtype": "array", "shape": [1, *shape], "dtype_numpy": kind.str,
            "external": "STREAM:",
        }  # fmt: skip

    def stream_documents(self, index: int | None = None) -> Iterator[Document]:
        """Yield what has not been reported of the images before `index`; by default of all."""
        for series in self._series.values():
            if not series.announced:
                series.announced = True
                yield (
                    "stream_resource",
                    {
                        "uid": series.uid, "data_key": series.key, "parameters": series.parameters,
                        "mimetype": "multipart/related;type=image/tiff",
                        "uri": series.folder.as_uri().replace("file://", "file://localhost", 1) + "/",
                    },
                )  # fmt: skip
            end = series.count if index is None else min(index, series.count)
            if end > series.reported:
                yield (
                    "stream_datum",
                    {
                        "uid": f"{series.uid}/{series.reported}", "stream_resource": series.uid,
                        "descriptor": "", "indices": {"start": series.reported, "stop": end},
                        "seq_nums": {"start": 0, "stop": 0},
                    },
                )  # fmt: skip
                series.reported = end

    def datum_id(self, key: str, number: int) -> str:
        """Return the name by which an event refers to an image of the present series."""
        return f"{self._series[key].uid}/{number}"

    def datum_documents(self) -> Iterator[Document]:
        """Yield `resource` and `datum` of the images of which nothing has been reported."""
        for series in self._series.values():
            if not series.announced:
                series.announced = True
                root = Path(series.folder.anchor)
                yield (
                    "resource",
                    {
                        "uid": series.uid, "spec": "AD_TIFF", "root": str(root),
                        "resource_path": f"{series.folder.relative_to(root).as_posix()}/",
                        "resource_kwargs": series.parameters | {"template": "/" + _TEMPLATE},
                        "path_semantics": os.name.replace("nt", "windows"),
                    },
                )  # fmt: skip
            for number in range(series.reported, series.count):
                yield (
                    "datum",
                    {
                        "datum_id": f"{series.uid}/{number}", "resource": series.uid,
                        "datum_kwargs": {"point_number": number},
                    },
                )  # fmt: skip
            series.reported = series.count
