"""``lens/1``: the prescription of a lens, in TOML."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import scipy
from pydantic import Discriminator, Field, Tag, model_validator

from ..core.errors import FormatError, UsageError
from ..optics.lenses import AIR, Aperture, Medium, Prescription, glass
from ..optics.lenses.media import Air, Cauchy, Constant, Powers, Sellmeier, Water, model_glass
from ..optics.lenses.paraxial import Paraxial
from ..optics.lenses.prescription import Layout, Surface
from ..optics.lenses.ray_maps import SensorPlane
from .document import Document, Strict, write_whole

Positive = Annotated[float, Field(gt=0)]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
_AGREE = 0.01
"""Relative difference up to which a stated focal length agrees with the surfaces."""
_LONG = 100.0
"""Focal lengths, in lengths of the lens, above which it must at least form an image of a real object."""


class WaterPart(Strict):
    """Water: °C, g/kg."""

    temperature_c: float = 20.0
    salinity: float = 0.0


class AirPart(Strict):
    """Air: °C, hPa; at 0 hPa a vacuum."""

    temperature_c: float = 20.0
    pressure_hpa: float = 1013.25


class SellmeierPart(Strict):
    """Coefficients B, and C in µm²."""

    b: Annotated[tuple[float, ...], Field(min_length=1)]
    c: Annotated[tuple[float, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _pairs(self) -> Self:
        if len(self.b) != len(self.c):
            raise ValueError(f"`b` has {len(self.b)} coefficients, `c` {len(self.c)}")
        return self


class PowersPart(Strict):
    """A constant, and pairs of coefficients and powers of λ in µm, for n²."""

    constant: float
    terms: tuple[Pair, ...] = ()


class LensMedium(Strict):
    """A medium by exactly one of its keys; glasses of the catalogue are named instead.

    Examples
    --------
    >>> LensMedium(nd=1.5168, abbe=64.17).medium().name
    'n = 1.5168, V = 64.17'
    """

    index: Positive | None = None
    nd: Positive | None = None
    abbe: Positive | None = None
    cauchy: Annotated[tuple[float, ...], Field(min_length=1)] | None = None
    sellmeier: SellmeierPart | None = None
    powers: PowersPart | None = None
    water: WaterPart | None = None
    air: AirPart | None = None
    name: str | None = None
    range_nm: Pair | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        keys = ("index", "nd", "cauchy", "sellmeier", "powers", "water", "air")
        given = [key for key in keys if getattr(self, key) is not None]
        if len(given) != 1 or (self.nd is None) != (self.abbe is None):
            raise ValueError(f"a medium is given by one of {', '.join(keys)}; `nd` needs `abbe`")
        return self

    def medium(self) -> Medium:
        """Return the medium."""
        name, limits = self.name or "", self.range_nm
        if self.index is not None:
            return Constant(self.index, name)
        if self.nd is not None and self.abbe is not None:
            return model_glass(self.nd, self.abbe, name or f"n = {self.nd:g}, V = {self.abbe:g}")
        if self.cauchy is not None:
            return Cauchy(self.cauchy, name, limits)
        if self.sellmeier is not None:
            return Sellmeier(self.sellmeier.b, self.sellmeier.c, name, limits)
        if self.powers is not None:
            return Powers(self.powers.constant, self.powers.terms, name, limits)
        if self.water is not None:
            return Water(self.water.temperature_c, self.water.salinity)
        assert self.air is not None
        return Air(self.air.temperature_c, self.air.pressure_hpa)

    @classmethod
    def of(cls, medium: Medium) -> LensMedium | str:
        """Return the part for a medium, or its name if it is in the catalogue."""
        if medium == AIR:
            return "air"
        if isinstance(medium, Water):
            return cls(water=WaterPart(temperature_c=medium.temperature_c, salinity=medium.salinity))
        if isinstance(medium, Air):
            return cls(air=AirPart(temperature_c=medium.temperature_c, pressure_hpa=medium.pressure_hpa))
        named: Any = {"name": medium.name} if medium.name else {}
        if isinstance(medium, Constant):
            return cls(index=medium.n, **named)
        try:
            if glass(medium.name) == medium:
                return medium.name
        except UsageError:
            pass
        if isinstance(medium, Cauchy):
            part: Any = {"cauchy": medium.coefficients}
        elif isinstance(medium, Sellmeier):
            part = {"sellmeier": SellmeierPart(b=medium.b, c=medium.c)}
        elif isinstance(medium, Powers):
            part = {"powers": PowersPart(constant=medium.constant, terms=medium.terms)}
        else:
            raise UsageError(f"the medium {medium.name} cannot be written", where="lens/1")
        return cls(**part, **named, range_nm=medium.range_nm)


# Told apart by what is in the document, so that messages concern the right one.
GlassOrMedium = Annotated[
    Annotated[str, Tag("<name>")] | Annotated[LensMedium, Tag("<medium>")],
    Discriminator(lambda value: "<name>" if isinstance(value, str) else "<medium>"),
]


class LensAperture(Strict):
    """An aperture of a surface, mm: `radius` (and `inner`), or `half` width and height, or `corners`.

    Examples
    --------
    >>> LensAperture(radius=12.5).aperture().size
    (12.5, 0.0)
    """

    radius: Positive | None = None
    inner: Annotated[float, Field(ge=0)] = 0.0
    half: tuple[Positive, Positive] | None = None
    corners: Annotated[tuple[Pair, ...], Field(min_length=3)] | None = None
    centre: Pair = (0.0, 0.0)
    rotation_deg: float = 0.0
    blocks: bool = False

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(part is not None for part in (self.radius, self.half, self.corners)) != 1:
            raise ValueError("an aperture is given by one of radius, half, corners")
        if self.radius is not None and self.inner >= self.radius:
            raise ValueError(f"`inner` {self.inner:g} is not less than `radius` {self.radius:g}")
        return self

    def aperture(self) -> Aperture:
        """Return the aperture."""
        turn = np.deg2rad(self.rotation_deg)
        if self.radius is not None:
            return Aperture("circle", (self.radius, self.inner), None, self.centre, blocks=self.blocks)
        if self.half is not None:
            return Aperture("rectangle", self.half, None, self.centre, float(turn), self.blocks)
        c, s = np.cos(turn), np.sin(turn)
        corners = np.array(self.corners, dtype=np.float64) @ np.array([[c, s], [-s, c]])
        return Aperture("polygon", corners=corners, centre=self.centre, blocks=self.blocks)

    @classmethod
    def of(cls, aperture: Aperture) -> LensAperture:
        """Return the part for an aperture."""
        common: Any = {"centre": aperture.centre, "blocks": aperture.blocks}
        if aperture.shape == "circle":
            return cls(radius=aperture.size[0], inner=aperture.size[1], **common)
        if aperture.shape == "rectangle":
            return cls(half=aperture.size, rotation_deg=float(np.rad2deg(aperture.turn)), **common)
        assert aperture.corners is not None
        return cls(corners=tuple((float(x), float(y)) for x, y in aperture.corners), **common)


class LensBreak(Strict):
    """A shift (mm) and a turn (degrees, about x, the new y, the newest z, right-handed) of axes.

    Examples
    --------
    >>> LensBreak(tilt_deg=(45.0, 0.0, 0.0)).decentre
    (0.0, 0.0)
    """

    decentre: Pair = (0.0, 0.0)
    tilt_deg: Triple = (0.0, 0.0, 0.0)


class LensSurface(Strict):
    """A surface, the distance from it to the next one (mm), and the medium in between.

    Examples
    --------
    >>> LensSurface(radius=50.0, distance=5.0, medium="N-BK7").bent
    0.02
    """

    name: str | None = None
    radius: Annotated[float, Field(allow_inf_nan=True)] | None = None
    curvature: float | None = None
    conic: float = 0.0
    coefficients: tuple[float, ...] = ()
    distance: float | None = None
    medium: GlassOrMedium | None = None
    stop: bool = False
    apertures: tuple[LensAperture, ...] = ()
    # Of all that follows, in front of this surface; and of this surface alone.
    turned: Annotated[LensBreak | None, Field(alias="break")] = None
    decentre: Triple = (0.0, 0.0, 0.0)
    tilt_deg: Triple = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.radius is not None and self.curvature is not None:
            raise ValueError("give `radius` or `curvature`, not both")
        if self.radius == 0 or (self.radius is not None and np.isnan(self.radius)):
            raise ValueError(f"{self.radius:g} is not a radius; leave it out for a plane")
        return self

    @property
    def bent(self) -> float:
        """Curvature, 1/mm."""
        return 1 / self.radius if self.radius is not None else (self.curvature or 0.0)


class LensSensor(Strict):
    """The sensor in the image plane.

    `pitch_um` and `size_px` are those along x (right) and y (down) of the image; the axis of the lens pierces
    the pixel `principal_px`, by default the centre; rows are turned by `rotation_deg` from x of
    the lens towards its y. `fill` is the part of the pixel, along each side, that is sensitive.

    Examples
    --------
    >>> LensSensor(pitch_um=(5.0, 5.0), size_px=(640, 480)).principal
    (319.5, 239.5)
    """

    pitch_um: tuple[Positive, Positive]
    size_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    principal_px: Pair | None = None
    rotation_deg: float = 0.0
    fill: Annotated[float, Field(gt=0, le=1)] = 1.0

    @property
    def principal(self) -> Pair:
        """Pixel at which the axis of the lens pierces the image plane."""
        return self.principal_px or ((self.size_px[0] - 1) / 2, (self.size_px[1] - 1) / 2)

    def plane(self) -> SensorPlane:
        """Return the raster on the image surface."""
        x, y = self.pitch_um
        return SensorPlane((x / 1e3, y / 1e3), self.principal, float(np.deg2rad(self.rotation_deg)))


class LensDocument(Document):
    """``lens/1``: surfaces in the order of the light, the last one the image; mm, nm, degrees.

    Examples
    --------
    >>> text = '''
    ... schema = "lens/1"
    ... name = "singlet"
    ... wavelengths_nm = [587.5618]
    ... stop_radius = 5.0
    ... [[surface]]
    ... radius = 50.0
    ... distance = 5.0
    ... medium = "N-BK7"
    ... stop = true
    ... [[surface]]
    ... distance = 93.45
    ... medium = "air"
    ... [[surface]]
    ... '''
    >>> lens = LensDocument.parse(text, where="lens.toml").prescription()
    >>> lens.surfaces[-1].vertex
    array([ 0.  ,  0.  , 98.45])
    """

    SCHEMA: ClassVar[str] = "lens/1"
    LEFT_OUT: ClassVar[dict[str, Any]] = {"exclude_defaults": True, "exclude_none": True}
    name: str
    unit: Literal["mm"] = "mm"
    wavelengths_nm: Annotated[tuple[Annotated[float, Field(ge=100, le=20000)], ...], Field(min_length=1)]
    weights: tuple[Annotated[float, Field(ge=0)], ...] = ()
    reference_nm: float | None = None
    stop_radius: Positive | None = None
    focal_length: float | None = None
    before: GlassOrMedium = "air"
    notes: tuple[str, ...] = ()
    sensor: LensSensor | None = None
    surface: Annotated[tuple[LensSurface, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.weights and len(self.weights) != len(self.wavelengths_nm):
            raise ValueError(
                f"{len(self.wavelengths_nm)} wavelengths need as many weights, not {len(self.weights)}"
            )
        if self.reference_nm is not None and self.reference_nm not in self.wavelengths_nm:
            raise ValueError(f"the reference wavelength {self.reference_nm:g} nm is none of `wavelengths_nm`")
        stops = [k for k, at in enumerate(self.surface, 1) if at.stop]
        if len(stops) != 1:
            raise ValueError(f"one surface must have `stop = true`, not {len(stops)}")
        for k, at in enumerate(self.surface[:-1], 1):
            for key in ("distance", "medium"):
                if getattr(at, key) is None:
                    raise ValueError(f"surface {k} has no `{key}`; only the last one, the image, has none")
        if self.surface[-1].distance is not None or self.surface[-1].medium is not None:
            raise ValueError("the last surface is the image: it has neither `distance` nor `medium`")
        return self

    @classmethod
    def parse(cls, text: str, *, where: object) -> Self:
        """Read a document from TOML text; `where` names it in messages.

        Raises
        ------
        FormatError
            When it is not TOML, or not this document, or no lens.
        """
        try:
            content = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise FormatError(f"is not TOML ({error})", where=where) from None
        unit = content.get("unit", "mm")
        if unit != "mm":
            raise FormatError(f"has the unit {unit!r}; lengths of lens/1 are in mm", where=where)
        found = cls.from_content(content, where=where)
        try:
            found.prescription()
        except UsageError as error:
            what = error.what if error.where in (None, found.name) else f"{error.where}: {error.what}"
            raise FormatError(what, where=where, do=error.do) from None
        return found

    def prescription(self) -> Prescription:
        """Return the lens.

        Raises
        ------
        UsageError
            When it is no lens: nothing bends rays, a glass is not in the catalogue, radii and distances
            contradict each other or the stated focal length.
        """
        before = medium = medium_of(self.before, "before")
        layout, surfaces = Layout(), []
        for k, at in enumerate(self.surface, 1):
            name = at.name or ("image" if k == len(self.surface) else f"surface {k}")
            if at.turned is not None:
                layout.turn(at.turned.decentre, at.turned.tilt_deg)
            mirror = at.medium == "mirror"
            behind = medium if mirror or at.medium is None else medium_of(at.medium, name)
            alone = scipy.spatial.transform.Rotation.from_euler("XYZ", at.tilt_deg, degrees=True).as_matrix()
            surfaces.append(
                Surface(
                    at.bent,
                    at.conic,
                    at.coefficients,
                    "mirror" if mirror else "plain" if behind == medium else "refracting",
                    behind,
                    layout.vertex + layout.axes @ np.array(at.decentre),
                    layout.axes @ alone,
                    tuple(part.aperture() for part in at.apertures),
                    name,
                )
            )
            medium = behind
            layout.advance(at.distance or 0.0)
        lens = Prescription(
            tuple(surfaces),
            next(k for k, at in enumerate(self.surface) if at.stop),
            self.stop_radius,
            self.wavelengths_nm,
            self.weights,
            0 if self.reference_nm is None else self.wavelengths_nm.index(self.reference_nm),
            before,
            self.name,
            self.notes,
        )
        self._check_lengths(lens)
        return lens

    def _check_lengths(self, lens: Prescription) -> None:
        """Refuse radii and distances that contradict each other, or the stated focal length.

        A lens much shorter than its focal length images nothing, unless it is telecentric on both sides and
        its image plane is conjugate to a real object.
        """
        first = Paraxial(lens)
        try:
            focal = first.focal_length
        except UsageError:
            focal = np.inf
        if self.focal_length is not None and not abs(focal - self.focal_length) < _AGREE * abs(
            self.focal_length
        ):
            raise UsageError(
                f"states a focal length of {self.focal_length:g} mm, but its surfaces have {focal:g} mm",
                where=self.name,
                do="give all lengths in mm",
            )
        length = float(np.abs(first.distances).sum())
        if abs(focal) > _LONG * length and not _images(first):
            stated = f"a focal length of {focal / 1e3:.3g} m" if np.isfinite(focal) else "no power"
            raise UsageError(
                f"has {stated} and surfaces within {length:.3g} mm: it forms no image on its last surface",
                where=self.name,
                do="give all lengths in mm",
            )

    @classmethod
    def of(cls, lens: Prescription, sensor: LensSensor | None = None) -> LensDocument:
        """Return the document of a lens."""
        rows: list[LensSurface] = []
        layout, medium = Layout(), lens.before
        for k, surface in enumerate(lens.surfaces):
            last = k == len(lens.surfaces) - 1
            away = layout.axes.T @ (surface.vertex - layout.vertex)
            turn = layout.axes.T @ surface.axes
            if rows:
                rows[-1] = rows[-1].model_copy(update={"distance": float(away[2])})
                turned = LensBreak(decentre=(float(away[0]), float(away[1])), tilt_deg=_tilt(turn))
                broken = None if turned == LensBreak() else turned
            else:
                broken = None
                if np.abs(away).max() > 0 or np.abs(turn - np.eye(3)).max() > 0:
                    raise UsageError("its first surface is not at the origin of its axes", where=lens.name)
            behind = medium if surface.kind == "plain" else surface.medium
            if last or surface.kind == "mirror":
                behind = medium
            rows.append(
                LensSurface.model_validate(
                    {
                        "name": surface.name or None,
                        "curvature": surface.curvature or None,
                        "conic": surface.conic,
                        "coefficients": surface.coefficients,
                        "medium": None
                        if last
                        else "mirror"
                        if surface.kind == "mirror"
                        else LensMedium.of(behind),
                        "stop": k == lens.stop,
                        "apertures": tuple(LensAperture.of(a) for a in surface.apertures),
                        "break": broken,
                    }
                )
            )
            medium = behind
            layout.vertex, layout.axes = surface.vertex, surface.axes
        return cls(
            name=lens.name,
            wavelengths_nm=lens.wavelengths_nm,
            weights=lens.weights,
            reference_nm=lens.wavelength_nm,
            stop_radius=lens.stop_radius,
            before=LensMedium.of(lens.before),
            notes=lens.notes,
            sensor=sensor,
            surface=tuple(rows),
        )

    def to_toml(self) -> str:
        """Return the text of the file: same content, same bytes."""
        lines, tables = [], []
        for key, value in self.to_dict().items():
            if isinstance(value, list) and value and isinstance(value[0], dict):
                for row in value:
                    tables += ["", f"[[{key}]]", *(f"{k} = {_toml(v)}" for k, v in row.items())]
            else:
                lines.append(f"{key} = {_toml(value)}")
        return "\n".join([*lines, *tables]) + "\n"

    def write(self, path: Path | str) -> None:
        """Write the document completely or not at all.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        write_whole(Path(path), self.to_toml())


def medium_of(part: str | LensMedium, where: str) -> Medium:
    """Return the medium of a name or an entry; `where` names it in messages.

    Raises
    ------
    UsageError
        When it is not in the catalogue, or no medium.

    Examples
    --------
    >>> round(medium_of("N-BK7", "lens.toml").index(587.56), 4)
    1.5168
    """
    if isinstance(part, str):
        if part.lower() == "air":
            return AIR
        try:
            return glass(part)
        except UsageError as error:
            raise UsageError(error.what, where=where, do=error.do) from None
    try:
        return part.medium()
    except UsageError as error:
        raise UsageError(error.what, where=where, do=error.do) from None


def _tilt(turn: np.ndarray[Any, np.dtype[np.float64]]) -> Triple:
    """Angles, degrees, of a rotation about x, the new y and the newest z."""
    if np.abs(turn - np.eye(3)).max() < 1e-15:
        return 0.0, 0.0, 0.0
    x, y, z = scipy.spatial.transform.Rotation.from_matrix(turn).as_euler("XYZ", degrees=True)
    return float(x), float(y), float(z)


def _images(first: Paraxial) -> bool:
    """Whether the last surface is the image of a real object in front of the lens."""
    last = len(first.lens.surfaces) - 1
    at_image = [float(first.ray(*start, last=last)[0][-1]) for start in ((1.0, 0.0), (0.0, 1.0))]
    # Rays (d u, u) from the distance d in front meet where their height does not depend on u.
    distance = -at_image[1] / at_image[0] if at_image[0] else np.inf
    return bool(distance > 0)


def _toml(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(part) for part in value) + "]"
    return json.dumps(value, ensure_ascii=False).replace("Infinity", "inf")
