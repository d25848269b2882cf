"""Lenses of CODE V: every file of the reference data is traced, or refused with what is not supported."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import FormatError
from reseau.exchange import read_lens
from reseau.exchange.codev import read_codev
from reseau.optics.lenses import Paraxial, Tracer
from reseau.optics.lenses.trace import Rays

Data = Callable[[str], Path]

SINGLET = "rdm; len; dim m; epd 10; wl 587.6\nso 0 1e13\ns 50 5 NBK7_SCHOTT\nsto\ns 0 93.4\nsi 0 0; go\n"


@pytest.mark.parametrize(
    ("name", "focal_length", "stop", "stop_radius"),
    [
        ("CODV_32327.seq", 100.03, 0, 12.5),
        ("CODV_49664.seq", 35.01, 0, 12.5),
        ("CODV_65564.seq", 1.4989, 0, 0.5),
        ("ag_dblgauss.seq", 100.0038, 5, 15.852527),  # both printed by CODE V
        ("landscape_lens.seq", 10.0, 0, 0.5),
        ("singlet.seq", 13.005, 0, 1.3005),
    ],
)
def test_lenses_of_the_reference_data_are_read(
    reference_data: Data, name: str, focal_length: float, stop: int, stop_radius: float
) -> None:
    lens = read_lens(reference_data("raytrace") / "codev" / name).prescription
    assert Paraxial(lens).focal_length == pytest.approx(focal_length, rel=1e-4)
    assert lens.stop == stop
    assert lens.stop_radius == pytest.approx(stop_radius, rel=1e-4)


def test_the_paraxial_focus_of_a_catalogue_lens_is_where_codev_put_it(
    reference_data: Data,
) -> None:
    for name, back in (("CODV_32327.seq", 95.95194415183156), ("CODV_65564.seq", 0.9176749924408083)):
        lens = read_codev(reference_data("raytrace") / "codev" / name)
        assert Paraxial(lens).back_focus == pytest.approx(back, abs=1e-9)


def test_an_asphere_between_planes_is_read_with_its_coefficients(
    reference_data: Data,
) -> None:
    lens = read_codev(reference_data("raytrace") / "codev" / "asp46.seq")
    assert lens.surfaces[0].coefficients == (-0.1, 0.1)
    assert lens.surfaces[0].apertures == ()  # CIR EDG is the rim of the glass
    assert lens.surfaces[0].medium.index(587.5618) == pytest.approx(1.5, abs=1e-12)


def test_a_glass_code_has_its_index_and_abbe_number_and_is_noted(
    reference_data: Data,
) -> None:
    lens = read_codev(reference_data("raytrace") / "codev" / "CODV_49664.seq")
    n_f, n_d, n_c = (lens.surfaces[2].medium.index(w) for w in (486.1327, 587.5618, 656.2725))
    assert n_d == pytest.approx(1.517, abs=1e-12)
    assert (n_d - 1) / (n_f - n_c) == pytest.approx(52.0, abs=1e-9)
    assert any("517000.520000 of surface 3" in note for note in lens.notes)


def _printed(listing: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Start of the rays that CODE V printed, and their points at the surfaces 1 to 11, (11, 3)."""
    found = []
    lines = listing.read_text("latin-1").splitlines()
    for k, line in enumerate(lines):
        if re.match(r"\s*OBJ\s+\S+\s+\S+\s+\S+\s+\S+\s+\S+\s*$", line):
            rows = [[float(word) for word in row.split()[1:6]] for row in lines[k + 1 : k + 12]]
            slope = [float(word) for word in line.split()[4:6]]
            found.append((np.array(slope), np.array(rows)))
    return found


def test_rays_of_the_double_gauss_meet_surfaces_where_codev_printed_them(
    reference_data: Data,
) -> None:
    folder = reference_data("raytrace") / "codev"
    lens = read_codev(folder / "ag_dblgauss.seq")
    printed = _printed(folder / "ag_dblgauss.lis")
    assert len(printed) == 9
    worst = 0.0
    for (sx, sy), rows in printed:
        # Fields are given as angles of 0, 10 and 14 degrees; the printed tangents have six digits only.
        angle = {0.0: 0.0, 0.176327: 10.0000000023, 0.249328: 14.0000000032}[sy]
        direction = np.array([sx, np.tan(np.radians(angle)), 1.0])
        direction /= np.linalg.norm(direction)
        start = rows[0, :3] - 10 * direction
        traced = Tracer(lens).trace(Rays(start[None], direction[None]), seen=True)
        assert traced.arrived.all()
        worst = max(worst, float(np.abs(traced.seen[:11, 0, :3] - rows[:, :3]).max()))
    # The listing has six decimals.
    assert worst < 1e-6


@pytest.mark.parametrize(
    ("name", "refused"),
    [
        ("CODV_35571.seq", "surface 2: has XDE"),
        ("achroMangin_ok.seq", "surface 3: is a mirror"),
        ("dec_test.seq", "surface 2: has YDE"),
        ("tilt_test.seq", "surface 2: has ADE"),
    ],
)
def test_unsupported_surfaces_of_the_reference_data_are_named(
    reference_data: Data, name: str, refused: str
) -> None:
    with pytest.raises(FormatError, match=refused) as raised:
        read_lens(reference_data("raytrace") / "codev" / name)
    assert name in str(raised.value)


def test_without_rdm_the_numbers_are_curvatures(tmp_path: Path) -> None:
    radius, curvature = tmp_path / "r.seq", tmp_path / "c.seq"
    radius.write_text(SINGLET)
    curvature.write_text(SINGLET.replace("rdm; ", "").replace("s 50", "s .02"))
    assert read_codev(radius).surfaces[0].curvature == read_codev(curvature).surfaces[0].curvature == 0.02


@pytest.mark.parametrize(
    ("old", "new", "refused"),
    [
        ("dim m", "dim f", "has the unit 'F'"),
        ("wl 587.6", "", "no wavelength"),
        ("epd 10", "", "width of its beam"),
        ("epd 10", "epd -1", "width of its beam"),
        ("NBK7_SCHOTT", "NBK7_HOYA", "surface 1: the glass NBK7_HOYA is not in the catalogue"),
        ("NBK7_SCHOTT", "NOA61", "surface 1: the glass NOA61 is not in the catalogue"),
        ("s 50 5", "s fifty 5", "`S fifty 5` is not understood"),
        ("s 50 5", "s nan 5", "`S nan 5` is not understood"),
        ("sto", "sto; sps zrn", "surface 1: has SPS, which is not supported"),
        ("sto", "sto; cir hol 2", "surface 1: has CIR, which is not supported"),
        (" NBK7_SCHOTT", "", "not a lens"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_line(
    tmp_path: Path, old: str, new: str, refused: str
) -> None:
    path = tmp_path / "lens.seq"
    assert old in SINGLET
    path.write_text(SINGLET.replace(old, new))
    with pytest.raises(FormatError, match=refused) as raised:
        read_codev(path)
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(str(path))


LINE = "rdm; len; dim m; epd 10; wl 587.6; {more} so 0 {far}; s 50 5 {glass}; sto; s 0 93.4; si 0 0; go"


@pytest.mark.parametrize(
    ("far", "glass", "more"),
    [
        ("inf", "NBK7_SCHOTT", ""),
        ("1e13", "1.5168:64.17", ""),
        ("1e13", "'own'", "prv; pwl 656.2725 587.5618 486.1327; 'own' 1.51432 1.51680 1.52238; end;"),
        ("1e13", "'own'", "prv; 'own' lau 2.2718929 -0.010108077 0.010592509 2.081697e-4 -7.647253e-6 "
         "4.924099e-7; end;"),
        ("1e13", "MYBK7", ""),
    ],
)  # fmt: skip
def test_glasses_and_distances_in_all_their_spellings(
    tmp_path: Path, far: str, glass: str, more: str
) -> None:
    """Each is BK7, of which the makers state n_d = 1.5168."""
    (tmp_path / "own.AGF").write_text(
        "NM MYBK7 2 517642 1.5168 64.17 0 1\nCD 1.03961212 6.00069867E-3 0.231792344 2.00179144E-2 "
        "1.01046945 103.560653 0 0 0 0\nLD 0.3 2.5\n"
    )
    path = tmp_path / "lens.seq"
    path.write_text(LINE.format(far=far, glass=glass, more=more))
    assert read_lens(path).prescription.indices(587.5618)[1] == pytest.approx(1.5168, abs=2e-5)


def test_a_glass_of_an_unknown_formula_is_refused_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "own.agf").write_text("NM ODD 13 1 1.5 60\nCD 1 2 3\nLD 0.3 2\n")
    path = tmp_path / "lens.seq"
    path.write_text(LINE.format(far="inf", glass="ODD", more=""))
    with pytest.raises(FormatError, match="ODD"):
        read_codev(path)
