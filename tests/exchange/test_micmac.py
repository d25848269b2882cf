"""Networks of MicMac, with figures of files that MicMac wrote."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from reseau.core.errors import FormatError, UsageError
from reseau.exchange import export_calibration, read_network
from reseau.exchange.calibrations.formats import import_calibration
from reseau.optics.poses import rotation_matrix

# A calibration, an orientation, and points that MicMac projects with both (``Verif``), from its test data.
CALIBRATION = """<?xml version="1.0" ?>
<ExportAPERO><CalibrationInternConique><KnownConv>eConvApero_DistM2C</KnownConv>
<PP>856.865441648138244 577.614006671525772</PP><F>2112.04115765381403</F><SzIm>1728 1152</SzIm>
<CalibDistortion><ModRad><CDist>856.865441648138244 577.614006671525772</CDist>
<CoeffDist>-2.13187449928481487e-08</CoeffDist><CoeffDist>1.7226374299904674e-15</CoeffDist>
<CoeffDist>5.49746079672967297e-21</CoeffDist><CoeffDist>-2.41801731114306416e-27</CoeffDist>
</ModRad></CalibDistortion></CalibrationInternConique></ExportAPERO>
"""
CENTRE = "5.20331571033942808 0.801558951120938779 2.10423388394582389"
TURN = (
    "<L1>-0.163607947073460436 0.115991824112040953 -0.979682773347357205</L1>"
    "<L2>0.0505337959379910037 0.992745533269003166 0.109099228423211472</L2>"
    "<L3>0.985230315775202481 -0.0316575885626802847 -0.168282565834642545</L3>"
)
POINTS = np.array([
    [2.34201289415539327, 1.18060072005993355, 1.52389541042144505],
    [2.1962737011872977, 1.49603061496488898, 0.291882742649256288],
    [0.458953817400082897, 0.255149787141798035, 3.16255323043381997],
])  # fmt: skip
SEEN = [
    [796.228448867797738, 622.67246246337902],
    [68.0980188851808776, 827.068771362139842],
    [1700.28139114184114, 47.3248143208406162],
]


def project(folder: Path, calibration: str = CALIBRATION, images: str = "abc") -> Path:
    """Orientations of some images; the calibration lies beside them."""
    own = folder / "Ori-Ground"
    own.mkdir(exist_ok=True)
    (own / "AutoCal.xml").write_text(calibration)
    for name in images:
        (own / f"Orientation-{name}.tif.xml").write_text(
            f"<ExportAPERO><OrientationConique><FileInterne>Ori-Elsewhere/AutoCal.xml</FileInterne><Externe>"
            f"<Centre>{CENTRE}</Centre><ParamRotation><CodageMatr>{TURN}</CodageMatr></ParamRotation></Externe>"
            "</OrientationConique></ExportAPERO>"
        )
    return own


def tie(folder: Path, one: str, other: str, *lines: str) -> None:
    pair = folder / "Homol" / f"Pastis{one}.tif"
    pair.mkdir(parents=True, exist_ok=True)
    (pair / f"{other}.tif.txt").write_text("\n".join(lines))


def test_points_are_projected_as_micmac_does(tmp_path: Path) -> None:
    tie(tmp_path, "a", "b", "1 2 3 4")
    network = read_network(project(tmp_path))
    camera = network.cameras[0]
    x = (POINTS - network.x0[0]) @ rotation_matrix(network.rotation[:1])[0].T
    np.testing.assert_allclose(
        camera.bare_mapping(camera.values)(x[:, :2] / x[:, 2:]), SEEN, rtol=0, atol=1e-9
    )
    assert len(network.cameras) == 1


def test_pairs_are_joined_to_points_unless_these_are_twice_in_an_image(tmp_path: Path) -> None:
    tie(tmp_path, "a", "b", "10 20 11 21", "30 40 31 41", "50 60 51 61")
    tie(tmp_path, "b", "c", "11 21 12 22", "31 41 32 42")
    tie(tmp_path, "c", "a", "32 42 99 98")
    network = read_network(project(tmp_path))
    assert network.rays.tolist() == [3, 2]
    found = sorted(zip(network.image_of.tolist(), network.xy.tolist(), strict=True))
    assert found == [(0, [10, 20]), (0, [50, 60]), (1, [11, 21]), (1, [51, 61]), (2, [12, 22])]


def test_binary_homologous_points_are_those_of_the_text(tmp_path: Path) -> None:
    """Little-endian: 2, count; 2, weight, x and y in both images for each. What is cut off is refused."""
    for name in ("text", "binary"):
        (tmp_path / name).mkdir()
    of_text = project(tmp_path / "text", images="ab")
    tie(tmp_path / "text", "a", "b", "320 240 160 240", "100 50.5 20 60")
    of_binary = project(tmp_path / "binary", images="ab")
    pair = tmp_path / "binary" / "Homol" / "Pastisa.tif"
    pair.mkdir(parents=True)
    rows = [(320.0, 240.0, 160.0, 240.0), (100.0, 50.5, 20.0, 60.0)]
    content = struct.pack("<ii", 2, 2) + b"".join(struct.pack("<id4d", 2, 1.0, *row) for row in rows)
    (pair / "b.tif.dat").write_bytes(content)
    one, other = read_network(of_text), read_network(of_binary)
    assert np.array_equal(one.xy, other.xy)
    assert np.array_equal(one.point_of, other.point_of)
    (pair / "b.tif.dat").write_bytes(content[:-5])
    with pytest.raises(FormatError, match="not complete"):
        read_network(of_binary)


@pytest.mark.parametrize(
    ("uncertainty", "factor", "sigma"),
    [
        ("0.1 0.1 0.2", None, [0.1, 0.1, 0.2]),
        ("0.1 0.1 0.2", 2.0, [0.2, 0.2, 0.4]),
        ("1 1 1", 0.01, 3 * [0.01]),
    ],
)
def test_control_points_have_their_uncertainties_times_the_factor(
    uncertainty: str, factor: float | None, sigma: list[float], tmp_path: Path
) -> None:
    network = read_network(with_control(tmp_path, uncertainty), control_sigma=factor)
    assert (network.points, network.role) == (("P",), ("control",))
    assert network.xyz.tolist() == [[1, 2, 3]]
    np.testing.assert_allclose(network.sigma, [sigma], rtol=1e-12)


def test_the_default_uncertainty_of_one_is_asked_about(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"the uncertainty 1, .*: --control-sigma"):
        read_network(with_control(tmp_path, "1 1 1"))


def with_control(tmp_path: Path, uncertainty: str) -> Path:
    """A project with a control point in two images."""
    own = project(tmp_path)
    marks = "".join(
        f"<MesureAppuiFlottant1Im><NameIm>{name}.tif</NameIm><OneMesureAF1I><NamePt>P</NamePt>"
        "<PtIm>5 6</PtIm></OneMesureAF1I></MesureAppuiFlottant1Im>"
        for name in "ab"
    )
    (tmp_path / "Mes-S2D.xml").write_text(f"<SetOfMesureAppuisFlottants>{marks}</SetOfMesureAppuisFlottants>")
    (tmp_path / "Pts.xml").write_text(
        f"<DicoAppuisFlottant><OneAppuisDAF><Pt>1 2 3</Pt><NamePt>P</NamePt><Incertitude>{uncertainty}"
        "</Incertitude></OneAppuisDAF></DicoAppuisFlottant>"
    )
    return own


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("", "", "has no image points beside it"),
        ("ModRad>", "ModFourier>", "has the distortion of another model"),
        ("<F>2112.04115765381403</F>", "", "has no element <F>"),
        ("<F>2112", "<F>-2112", "has the focal length -2112.04"),
        ("eConvApero_DistM2C", "eConvOther", "has the convention 'eConvOther'"),
    ],
)
def test_what_cannot_be_read_is_said(old: str, new: str, said: str, tmp_path: Path) -> None:
    text = CALIBRATION.replace(old, new) if old else CALIBRATION
    with pytest.raises(FormatError, match=said):
        read_network(project(tmp_path, text))


@pytest.mark.parametrize("convention", ["eConvApero_DistM2C", "eConvApero_DistC2M"])
def test_an_interior_orientation_is_written_back_as_it_is(tmp_path: Path, convention: str) -> None:
    file, again = tmp_path / "AutoCal.xml", tmp_path / "again.xml"
    radial = CALIBRATION.replace("<CoeffDist>-2.41801731114306416e-27</CoeffDist>", "")
    file.write_text(radial.replace("eConvApero_DistM2C", convention))
    given = import_calibration(file)
    done = export_calibration(given, "micmac", again)
    assert done.rms_px == 0
    back = import_calibration(again)
    for name, quantity in given.parameters.items():
        assert back.parameters[name].value == pytest.approx(quantity.value, rel=1e-14)
    assert back.model == given.model


def test_with_the_width_of_the_sensor_lengths_are_in_millimetres(tmp_path: Path) -> None:
    own = project(tmp_path)
    tie(tmp_path, "a", "b", "1 2 3 4")
    plain, sized = read_network(own).cameras[0], read_network(own, sensor_width=36.0).cameras[0]
    assert sized.parameters["c"] == pytest.approx(2112.04115765381403 * 36 / 1728, rel=1e-12)
    assert sized.unit_of("c") == "mm"
    uv = np.array([[0.1, -0.2], [-0.3, 0.2]])
    assert np.abs(sized.bare_mapping()(uv) - plain.bare_mapping()(uv)).max() < 1e-9
