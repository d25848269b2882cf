"""Windows and media of a network: the optional key `refraction` of ``reseau-network/1``."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from ..core.errors import UsageError
from ..optics.refraction import Window
from ..optics.refraction.windows import Refraction, RefractiveIndex
from .document import Document, Strict
from .lens import GlassOrMedium, medium_of

Triple = tuple[float, float, float]


class MediumEntry(Strict):
    """A medium: its index, or what it is and the wavelength of the images.

    Examples
    --------
    >>> entry = MediumEntry(medium={"water": {"temperature_c": 15.0, "salinity": 35.0}}, wavelength_nm=550.0)
    >>> round(entry.named("sea water").value, 4)
    1.3413
    """

    index: float | None = None
    medium: GlassOrMedium | None = None
    wavelength_nm: float | None = None
    free: bool = False
    sigma: float | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.index is None) == (self.medium is None):
            raise ValueError("a medium is given by `index`, or by `medium` and `wavelength_nm`")
        if (self.medium is None) != (self.wavelength_nm is None):
            raise ValueError("`medium` and `wavelength_nm` belong together")
        return self

    def named(self, name: str) -> RefractiveIndex:
        """Return the index under a name.

        Raises
        ------
        UsageError
            When the medium or its index is not known.
        """
        where = f"medium {name}"
        value, dispersion = self.index, None
        if self.medium is not None and self.wavelength_nm is not None:
            dispersion = medium_of(self.medium, where).index
            try:
                value = dispersion(self.wavelength_nm)
            except UsageError as error:
                raise UsageError(error.what, where=where, do=error.do) from None
        assert value is not None
        return RefractiveIndex(name, value, self.free, self.sigma, dispersion)


class WindowEntry(Strict):
    """A window; see :class:`~reseau.optics.refraction.Window`."""

    id: str = Field(min_length=1)
    shape: Literal["plane", "sphere", "cylinder"]
    on: Literal["camera", "rig", "object"]
    parameters: dict[str, float]
    media: tuple[str, ...]
    free: tuple[str, ...] = ()
    sigma: dict[str, float] | None = None
    direction: Triple = (0.0, 0.0, 1.0)
    camera_side: Literal["inside", "outside"] = "inside"

    def window(self) -> Window:
        """Return the window."""
        return Window(
            self.id, self.shape, self.on, self.parameters, self.media, self.free, self.sigma or {},
            self.direction, self.camera_side,
        )  # fmt: skip


class Through(Strict):
    """Windows that the rays pass, in their order: of all images of a camera, or of single images."""

    cameras: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    images: dict[str, tuple[str, ...]] = Field(default_factory=dict)


# A number is an index.
IndexOrMedium = Annotated[
    Annotated[float, Tag("<index>")] | Annotated[MediumEntry, Tag("<medium>")],
    Discriminator(lambda value: "<index>" if isinstance(value, int | float) else "<medium>"),
]


class RefractionEntry(Strict):
    """Media by name, windows, and which windows the rays pass; without `through` all rays pass all of them.

    Examples
    --------
    >>> entry = RefractionEntry.model_validate_json('''{
    ...     "media": {"air": 1.0, "glass": 1.52, "water": {"index": 1.333, "free": true, "sigma": 1e-4}},
    ...     "windows": [{"id": "port", "shape": "plane", "on": "camera", "media": ["air", "glass", "water"],
    ...                  "parameters": {"distance": 40.0, "thickness": 10.0}, "free": ["distance"]}]}''')
    >>> entry.refraction(("i1", "i2"), ("cam", "cam"))
    <Refraction: 3 media, 1 window, 2 free parameters>
    """

    media: dict[str, IndexOrMedium]
    windows: tuple[WindowEntry, ...]
    through: Through | None = None

    def refraction(self, images: tuple[str, ...], cameras: tuple[str, ...]) -> Refraction:
        """Return windows and media, with the path of each image.

        Parameters
        ----------
        images, cameras : tuple of str (m,)
            Name and camera of each image.

        Raises
        ------
        UsageError
            When windows and media contradict each other, or an unknown window, camera or image is named.
        """
        windows = tuple(entry.window() for entry in self.windows)
        number = {window.name: k for k, window in enumerate(windows)}
        through = self.through or Through(
            cameras=dict.fromkeys(cameras, tuple(window.name for window in windows))
        )
        for what, named, known in (
            ("cameras", through.cameras, set(cameras)),
            ("images", through.images, set(images)),
        ):
            for name, path in named.items():
                if name not in known:
                    raise UsageError(f"{name!r} is not in `{what}`", where=f"refraction.through.{what}")
                for window in path:
                    if window not in number:
                        raise UsageError(
                            f"{window!r} is not in `windows`", where=f"refraction.through.{what}"
                        )
        paths: dict[tuple[int, ...], int] = {}
        path_of = np.full(len(images), -1, dtype=np.intp)
        for i, (image, camera) in enumerate(zip(images, cameras, strict=True)):
            names = through.images.get(image, through.cameras.get(camera, ()))
            if names:
                path_of[i] = paths.setdefault(tuple(number[name] for name in names), len(paths))
        media = tuple(
            RefractiveIndex(name, entry) if isinstance(entry, int | float) else entry.named(name)
            for name, entry in self.media.items()
        )
        return Refraction(media, windows, tuple(paths), path_of)

    @classmethod
    def of(cls, refraction: Refraction, images: tuple[str, ...]) -> Self:
        """Return the entry of windows and media of a network with these images."""
        return cls(
            media={
                medium.name: MediumEntry(index=medium.value, free=medium.free, sigma=medium.sigma)
                if medium.free
                else medium.value
                for medium in refraction.media
            },
            windows=tuple(
                WindowEntry(
                    id=window.name, shape=window.shape, on=window.on, parameters=dict(window.values),
                    media=window.media, free=window.free, sigma=dict(window.sigma) or None,
                    direction=window.direction, camera_side=window.camera_side,
                )
                for window in refraction.windows
            ),
            through=Through(
                images={
                    image: tuple(refraction.windows[k].name for k in refraction.paths[p])
                    for image, p in zip(images, refraction.path_of.tolist(), strict=True)
                    if p >= 0
                }
            ),
        )  # fmt: skip


class RefractionFile(Document, RefractionEntry):
    """``reseau-refraction/1``: the same as a file of its own, for `reseau calibrate --refraction`.

    Examples
    --------
    >>> text = '{"schema": "reseau-refraction/1", "media": {"air": 1.0, "water": 1.333}, "windows": [{"id": '
    >>> text += '"surface", "shape": "plane", "on": "camera", "parameters": {"distance": 40.0}, '
    >>> text += '"media": ["air", "water"]}]}'
    >>> RefractionFile.parse(text, where="port.json").refraction(("i1",), ("cam",))
    <Refraction: 2 media, 1 window, 0 free parameters>
    """

    SCHEMA: ClassVar[str] = "reseau-refraction/1"
