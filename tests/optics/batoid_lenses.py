"""Lenses in the YAML format of batoid, as prescriptions of ours: an independent reading of the same files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from reseau.optics.lenses import Aperture, Medium, Prescription
from reseau.optics.lenses.media import Constant, Powers, Sellmeier
from reseau.optics.lenses.prescription import Surface

__all__ = ["prescription"]

MM = 1000.0
"""Millimetres of the unit of batoid's files."""


def prescription(path: Path, wavelength_nm: float = 500.0) -> Prescription:
    """A lens of batoid; its z axis points against the light, and its stop is not used."""
    import yaml

    optic = yaml.safe_load(path.read_text("utf-8"))["opticalSystem"]
    surfaces: list[Surface] = []
    before = _medium(optic.get("inMedium", optic.get("medium", 1.0)), wavelength_nm)
    _add(optic, 0.0, before, before, surfaces, wavelength_nm)
    return Prescription(
        tuple(surfaces), 0, 1.0, (wavelength_nm,), before=before, name=optic.get("name", path.stem)
    )


def _add(
    item: dict[str, Any], z: float, front: Medium, behind: Medium, found: list[Surface], nm: float
) -> None:
    """Add the surfaces of an item; `front` and `behind` are the media around it."""
    place = item.get("coordSys", {})
    assert set(place) <= {"z"}, "only centred systems"
    z += place.get("z", 0.0)
    if "items" in item:
        inside = _medium(item["medium"], nm) if "medium" in item else behind
        parts = item["items"]
        for k, part in enumerate(parts):
            last = k == len(parts) - 1
            before = found[-1].medium if found else front
            if item["type"] == "Lens":
                _add(part, z, before, behind if last else inside, found, nm)
            else:
                _add(part, z, before, inside, found, nm)
        return
    surface = item["surface"]
    kinds = {"Mirror": "mirror", "RefractiveInterface": "refracting"}
    kind = kinds.get(item["type"], "plain")
    coefficients = [a / MM ** (2 * k + 3) for k, a in enumerate(surface.get("coefs", []))]
    found.append(
        Surface(
            1 / (MM * surface["R"]) if "R" in surface else 0.0,
            surface.get("conic", -1.0 if surface["type"] == "Paraboloid" else 0.0),
            tuple(coefficients),
            kind,  # type: ignore[arg-type]
            behind if kind == "refracting" else front,
            np.array([0.0, 0.0, MM * z]),
            apertures=tuple(_apertures(item.get("obscuration"))),
            name=item["name"],
        )
    )


def _medium(given: Any, wavelength_nm: float) -> Medium:
    if not isinstance(given, dict):
        return Constant(float(given))
    if given["type"] == "SumitaMedium":
        powers = (2.0, -2.0, -4.0, -6.0, -8.0)
        return Powers(given["A0"], tuple((given[f"A{k}"], p) for k, p in enumerate(powers, 1)))
    if given["type"] == "SellmeierMedium":
        return Sellmeier(tuple(given[f"B{k}"] for k in (1, 2, 3)), tuple(given[f"C{k}"] for k in (1, 2, 3)))
    if given["type"] == "Air":
        import batoid

        return Constant(batoid.Air().getN(wavelength_nm / 1e9))
    assert given["type"] == "ConstMedium", given["type"]
    return Constant(float(given["n"]))


def _apertures(given: dict[str, Any] | None) -> list[Aperture]:
    if given is None:
        return []
    kind = given["type"]
    centre = MM * given.get("x", 0.0), MM * given.get("y", 0.0)
    blocks = kind.startswith("Obsc")
    if kind == "ObscUnion":
        return [aperture for part in given["items"] for aperture in _apertures(part)]
    if kind.endswith("Circle"):
        return [Aperture("circle", (MM * given["radius"], 0.0), centre=centre, blocks=blocks)]
    if kind.endswith("Annulus"):
        size = MM * given["outer"], MM * given["inner"]
        return [Aperture("circle", size, centre=centre, blocks=blocks)]
    if kind.endswith("Rectangle"):
        half = MM * given["width"] / 2, MM * given["height"] / 2
        return [Aperture("rectangle", half, centre=centre, turn=given.get("theta", 0.0), blocks=blocks)]
    assert kind.endswith("Polygon"), kind
    corners = MM * np.stack([given["xs"], given["ys"]], axis=1)
    return [Aperture("polygon", corners=corners, blocks=blocks)]
