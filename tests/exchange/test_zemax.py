"""Lenses of Zemax: every file of the reference data is traced, or refused with what is not supported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import FormatError, InputError
from reseau.exchange import read_lens
from reseau.exchange.zemax import read_zemax
from reseau.io import LensDocument
from reseau.optics.lenses import Paraxial, Prescription, Tracer
from reseau.optics.lenses.trace import Rays

Data = Callable[[str], Path]

SINGLET = """MODE SEQ
UNIT MM
ENPD 10
WAVM 1 0.5875618 1
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  CURV 0.02
  DISZ 5
  GLAS N-BK7 0 0 1.5 40
SURF 2
  DISZ 93.4
SURF 3
  DISZ 0
"""


def singlet(tmp_path: Path, *replaced: tuple[str, str]) -> Prescription:
    text = SINGLET
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "lens.zmx"
    path.write_text(text)
    return read_zemax(path)


def beam(lens: Prescription, share: float = 0.5) -> np.ndarray:
    """Where a cone of parallel rays arrives, (n, 2)."""
    first = Paraxial(lens)
    radius = share * abs(first.entrance_pupil[1]) * lens.stop_radius
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    start = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(16, -300.0)], axis=1)
    traced = Tracer(lens, apertures=False).trace(Rays(start, np.tile([0.0, 0.0, 1.0], (16, 1))))
    assert traced.arrived.all()
    return traced.xy


@pytest.mark.parametrize(
    ("name", "focal_length", "surfaces", "spot"),
    [
        # Focal lengths and f-numbers that the files state themselves, where they do.
        ("US00583336-2-scaled.zmx", 49.4, 13, 0.03),
        ("US08427765-1.ZMX", 30.8, 12, 0.02),
        ("zmax_55278.zmx", 52.24, 7, 0.04),
        ("US05331467-1.zmx", 1000.0, 25, 0.03),
        ("HoO-V2C18Ex03.zmx", 80.1, 4, 1e-4),
        ("HoO-V2C18Ex27.zmx", 24.6, 10, 1e-3),
        ("US08011793-1.zmx", 500.0, 6, 0.01),
        ("354710-C-Zemax(ZMX).zmx", 1.49, 5, 0.01),
        ("zmax_37992.zmx", -95.3, 3, 1e-9),
        ("HoO-V2C18Ex66.zmx", 90.05, 11, 0.001),
        ("HoO-V2C18Ex66NEW.zmx", 90.05, 10, 0.001),
    ],
)
def test_lenses_of_the_reference_data_form_an_image(
    reference_data: Data, name: str, focal_length: float, surfaces: int, spot: float
) -> None:
    lens = read_zemax(reference_data("raytrace") / "zemax" / name)
    assert len(lens.surfaces) == surfaces
    assert Paraxial(lens).focal_length == pytest.approx(focal_length, rel=0.005)
    at = beam(lens)
    assert np.hypot(*(at - at.mean(axis=0)).T).max() < spot


def test_a_lithographic_lens_images_an_object_at_a_finite_distance(
    reference_data: Data,
) -> None:
    # Reduction and conjugates of US 5,831,776: the object lies 110.86 mm in front of the first surface.
    lens = read_zemax(reference_data("raytrace") / "zemax" / "US05831776-1.zmx")
    start = np.array([0.0, 0.0, -110.8588354359])
    through = np.stack([np.linspace(1, 14, 14), np.zeros(14), np.zeros(14)], axis=1)
    traced = Tracer(lens, apertures=False).trace(Rays.between(start, through))
    assert traced.arrived.all()
    # Within a micrometre: the index of silica at 248 nm is that of another author.
    assert np.abs(traced.xy).max() < 1e-3
    assert any("telecentric" in note for note in lens.notes)


def test_the_stop_is_as_large_as_zemax_computed_it_with_real_rays(
    reference_data: Data,
) -> None:
    folder = reference_data("raytrace") / "zemax"
    for name, radius in (("US00583336-2-scaled.zmx", 4.215000499256), ("US08011793-1.zmx", 58.50393517472)):
        assert read_zemax(folder / name).stop_radius == pytest.approx(radius, abs=1e-6)


def test_the_plane_of_symmetry_of_a_tilted_system_shows_the_sign_of_tilts_and_decentres(
    reference_data: Data, tmp_path: Path
) -> None:
    # Its last break of coordinates centres the image. The toroid is a sphere in the plane of symmetry.
    text = (reference_data("raytrace") / "zemax" / "HoO-V2C18Ex46.zmx").read_text("latin-1")
    path = tmp_path / "sphere.zmx"
    path.write_text(text.replace("TYPE TOROIDAL", "TYPE STANDARD"))
    lens = read_zemax(path)
    traced = Tracer(lens).trace(Rays(np.array([[0.0, 0.0, -10.0]]), np.array([[0.0, 0.0, 1.0]])))
    np.testing.assert_allclose(traced.xy, 0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "refused"),
    [("HoO-V2C18Ex46.zmx", "surface 7: .*TOROIDAL"), ("ASL5040-UV-Zemax(ZMX).zmx", "QED_TYPE")],
)
def test_unsupported_surfaces_of_the_reference_data_are_named(
    reference_data: Data, name: str, refused: str
) -> None:
    with pytest.raises(FormatError, match=refused) as raised:
        read_zemax(reference_data("raytrace") / "zemax" / name)
    assert name in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "name",
    ["US08427765-1.ZMX", "US05331467-1.zmx", "HoO-V2C18Ex27.zmx", "HoO-V2C18Ex66.zmx", "US08011793-1.zmx"],
)
def test_a_lens_written_as_our_document_images_as_before(
    reference_data: Data, tmp_path: Path, name: str
) -> None:
    lens = read_zemax(reference_data("raytrace") / "zemax" / name)
    LensDocument.of(lens).write(tmp_path / "lens.toml")
    same = read_lens(tmp_path / "lens.toml").prescription
    assert (same.stop, same.stop_radius, same.notes) == (lens.stop, lens.stop_radius, lens.notes)
    np.testing.assert_allclose(beam(same), beam(lens), rtol=0, atol=1e-10)


def test_an_unknown_glass_is_named_and_the_index_beside_it_not_taken(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="surface 1: the glass C79-80 is not in the catalogue"):
        singlet(tmp_path, ("N-BK7", "C79-80"))


def test_a_moulded_glass_is_noted_with_both_names(reference_data: Data) -> None:
    lens = read_zemax(reference_data("raytrace") / "zemax" / "354710-C-Zemax(ZMX).zmx")
    note, other = lens.notes
    assert "D-ZK3M" in note
    assert "D-ZK3 after" in note
    assert lens.surfaces[0].medium.name == "D-ZK3"
    assert "BK7 is catalogued as N-BK7" in other


def test_a_model_glass_has_its_index_and_abbe_number(reference_data: Data) -> None:
    lens = read_zemax(reference_data("raytrace") / "zemax" / "HoO-V2C18Ex27.zmx")
    n_f, n_d, n_c = (lens.surfaces[0].medium.index(w) for w in (486.1327, 587.5618, 656.2725))
    assert n_d == pytest.approx(1.489, abs=1e-12)
    assert (n_d - 1) / (n_f - n_c) == pytest.approx(57.4, abs=1e-9)


def test_apertures_stop_rays_and_computed_diameters_do_not(reference_data: Data) -> None:
    folder = reference_data("raytrace") / "zemax"
    mounted = read_zemax(folder / "zmax_55278.zmx")
    assert [a.size for surface in mounted.surfaces for a in surface.apertures] == [(12.5, 0.0)] * 6
    telephoto = read_zemax(folder / "US05331467-1.zmx")
    (obscuration,) = (a for surface in telephoto.surfaces for a in surface.apertures)
    assert obscuration.blocks
    assert obscuration.size == (25.0, 0.0)
    folded = read_zemax(folder / "US08011793-1.zmx")
    (window,) = folded.surfaces[1].apertures
    assert (window.shape, window.size, window.centre) == ("rectangle", (424.0, 192.0), (0.0, -397.0))


def test_lengths_in_inches_are_converted_and_noted(tmp_path: Path) -> None:
    lens = singlet(tmp_path, ("UNIT MM", "UNIT IN"))
    same = singlet(tmp_path)
    assert Paraxial(lens).focal_length == pytest.approx(25.4 * Paraxial(same).focal_length, rel=1e-12)
    assert lens.stop_radius == pytest.approx(25.4 * 5)
    assert any("converted to mm" in note for note in lens.notes)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "latin-1", "utf-8"])
def test_encodings_do_not_matter(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "lens.zmx"
    path.write_bytes(("NAME Ø 5\n" + SINGLET).encode(encoding))
    assert read_zemax(path).name == "Ø 5"
    assert read_lens(path).prescription.name == "Ø 5"


@pytest.mark.parametrize(
    ("old", "new", "radius"),
    [
        ("ENPD 10", "FNUM 4 0", 11.870),
        ("ENPD 10", "FLOA\nXXXX", 4.0),
        ("ENPD 10", "OBNA 0.1 0", 10.0504),
    ],
)
def test_the_stop_follows_from_every_statement_of_the_beam(
    tmp_path: Path, old: str, new: str, radius: float
) -> None:
    # f = 50/(n - 1)/... of a plano-convex lens: 96.75 mm with n = 1.5168.
    lens = singlet(tmp_path, (old, new), ("INFINITY", "100"), ("  STOP", "  STOP\n  DIAM 4.0"))
    expected = Paraxial(lens).focal_length / 8 if "FNUM" in new else radius
    assert lens.stop_radius == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "refused"),
    [
        ("MODE SEQ", "MODE NSC", "not a sequential lens"),
        ("UNIT MM", "UNIT FURLONG", "FURLONG"),
        ("ENPD 10", "ENPX 10", "width of its beam"),
        ("ENPD 10", "ENPD zero", "`ENPD zero` has no number"),
        ("WAVM 1 0.5875618 1\n", "", "no wavelength"),
        ("  STOP\n", "", "no stop"),
        ("WAVM 1 0.5875618 1", "PWAV nan\nWAVM 1 0.5875618 1", "`PWAV nan` has no number"),
        ("WAVM 1 0.5875618 1", "WAVM 1 1e-9 1", "is not a wavelength"),
        ("ENPD 10", "OBNA 1.2 0", "numerical aperture"),
        ("  DISZ 5\n", "  DISZ 5\n  CLAP 0 -3 0\n", "surface 1: .* is not the size of an aperture"),
        ("DISZ 5", "DISZ 1e300", "away"),
        ("CURV 0.02", "CURV round", "surface 1: `CURV round` has no number"),
        ("DISZ 5", "DISZ INFINITY", "surface 1: has an infinite distance"),
        ("  GLAS N-BK7 0 0 1.5 40\n", "", "not a lens"),
        ("  CURV 0.02\n", "  CURV 0.02\n  UDAD 0 0 0\n", "surface 1: .*UDAD"),
        ("WAVM 1 0.5875618 1", "WAVM 1 9.9 1", "N-BK7: the index at 9900 nm is not known"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(
    tmp_path: Path, old: str, new: str, refused: str
) -> None:
    with pytest.raises(FormatError, match=refused) as raised:
        singlet(tmp_path, (old, new))
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(str(tmp_path / "lens.zmx"))


def test_a_missing_file_and_other_content_are_input_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_zemax(tmp_path / "none.zmx")
    path = tmp_path / "text.txt"
    path.write_text("so be it")
    with pytest.raises(FormatError, match="is not a lens"):
        read_lens(path)


def test_an_even_asphere_of_the_second_order_alone_is_a_paraboloid(tmp_path: Path) -> None:
    lens = singlet(tmp_path, ("  CURV 0.02\n", "  TYPE EVENASPH\n  PARM 1 0.01\n"))
    (bent,) = [each for each in lens.surfaces if each.curvature != 0]
    # z = 0.01 r².
    assert (bent.curvature, bent.conic) == (0.02, -1.0)
