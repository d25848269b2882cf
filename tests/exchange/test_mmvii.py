"""Projects of MMVII, written by these tests from the equations of its camera."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.core.errors import FormatError, UsageError
from reseau.exchange import read_network

from .scene import residuals, scene

F, PP = 2095.5, np.array([986.9, 664.4])
TERMS = {"K1": -0.097, "K2": 0.1, "K3": -0.03, "p1": -4e-4, "p2": -2e-4, "b1": 8e-5, "b2": 3e-5}
SCENE = scene()


def seen() -> Array:
    """Pixels (m, p, 2): the distortion is added to the direction, in units of F."""
    x, y = np.moveaxis(SCENE.directions, -1, 0)
    r2 = x**2 + y**2
    k = TERMS["K1"] * r2 + TERMS["K2"] * r2**2 + TERMS["K3"] * r2**3
    p1, p2 = TERMS["p1"], TERMS["p2"]
    dx = k * x + p1 * (3 * x**2 + y**2) + p2 * 2 * x * y + TERMS["b1"] * x + TERMS["b2"] * y
    dy = k * y + p1 * 2 * x * y + p2 * (x**2 + 3 * y**2)
    return PP + F * np.stack([x + dx, y + dy], axis=-1)


def written(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    head = '<?xml version="1.0" encoding="UTF-8" ?><Root><Type>"MMVII_Serialization"</Type><Data>'
    path.write_text(f"{head}{content}</Data></Root>")


def words(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)


def project(folder: Path, variance: str = "4 0 0 9 0 16", lens: str = "") -> Path:
    """The scene; point 0 is not given, point 1 is free."""
    own, points = (
        folder / "MMVII-PhgrProj" / "Ori" / "BA",
        folder / "MMVII-PhgrProj" / "PointsMeasure" / "Test",
    )
    terms = lens or "".join(f"<{name}>{value}</{name}>" for name, value in TERMS.items())
    written(
        own / "Calib-PerspCentral-A.xml",
        "<InternalCalibration><PixelFrame><NbPix>2000 1333</NbPix></PixelFrame>"
        f'<Projection>"Stenope"</Projection><PerfectProj><F>{F}</F><PP>{words(PP)}</PP></PerfectProj>'
        f"<Distorsion><Radial>{terms}</Radial></Distorsion></InternalCalibration>",
    )
    for i, (turn, centre, xy) in enumerate(zip(SCENE.turns, SCENE.x0, seen(), strict=True)):
        axes = "".join(
            f"<Axe{name}>{words(axis)}</Axe{name}>" for name, axis in zip("IJK", turn, strict=True)
        )
        written(
            own / f"Ori-PerspCentral-{i}.tif.xml",
            f'<CameraPose><NameImage>"{i}.tif"</NameImage>'
            f'<NameInternalCalib>"Calib-PerspCentral-A"</NameInternalCalib>'
            f"<Center>{words(centre)}</Center><RotMatrix>{axes}</RotMatrix></CameraPose>",
        )
        marks = "".join(
            f'<el><Name>"{j}"</Name><Pt>{words(at)}</Pt><Sigma2>0.25 0 1</Sigma2></el>'
            for j, at in enumerate(xy)
        )
        written(
            points / f"MesIm-{i}.tif.xml",
            f'<SetMesIm><NameIm>"{i}.tif"</NameIm><Measures>{marks}</Measures></SetMesIm>',
        )
    given = "".join(
        f'<el><Name>"{j}"</Name><Pt>{words(at)}</Pt>'
        + (f"<__Opt__Sigma2>{variance}</__Opt__Sigma2></el>" if j > 1 else "</el>")
        for j, at in enumerate(SCENE.xyz)
        if j > 0
    )
    written(points / "MesGCP-Test.xml", f"<SetGCP><Measures>{given}</Measures></SetGCP>")
    return own


def test_points_are_where_the_project_has_them(tmp_path: Path) -> None:
    network = read_network(project(tmp_path))
    off = residuals(network)[network.point_of > 0]
    np.testing.assert_allclose(off, 0, atol=1e-8)
    np.testing.assert_allclose(np.sqrt(network.cov[:, [0, 1], [0, 1]]), np.tile([0.5, 1.0], (60, 1)))
    assert network.role == ("tie", "tie", *13 * ["control"])
    np.testing.assert_allclose(network.sigma[2:], np.tile([2.0, 3.0, 4.0], (13, 1)))
    assert np.isnan(network.xyz[0]).all()
    assert set(network.cameras[0].free) == {"c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "B1", "B2"}


def test_variances_that_no_one_gave_are_asked_for(tmp_path: Path) -> None:
    own = project(tmp_path, "1 0 0 1 0 1")
    with pytest.raises(UsageError, match="--control-sigma"):
        read_network(own)
    assert np.unique(read_network(own, control_sigma=0.02).sigma[2:]).tolist() == [0.02]


def test_of_several_sets_of_points_none_is_chosen(tmp_path: Path) -> None:
    own = project(tmp_path)
    points = tmp_path / "MMVII-PhgrProj" / "PointsMeasure" / "Test"
    shutil.copytree(points, points.with_name("Completed"))
    with pytest.raises(
        FormatError, match=r"several sets of points .*PointsMeasure/Completed, PointsMeasure/Test"
    ):
        read_network(own)
    apart = tmp_path / "apart"
    shutil.copytree(own, apart / "BA")
    shutil.copytree(points, apart / "Test")
    assert len(read_network(apart / "BA").xy) == 60


@pytest.mark.parametrize(("old", "new", "message"), [
    ("Stenope", "eFE_EquiSolid", "the projection eFE_EquiSolid"),
    ("<K1>", "<p3>1e-3</p3><K1>", "the distortion p3"),
])  # fmt: skip
def test_what_is_another_model_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    own = project(tmp_path)
    file = own / "Calib-PerspCentral-A.xml"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(FormatError, match=message):
        read_network(own)
