"""Documents of lenses: what is read is what was written, and what is no lens is refused in one line."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from reseau.core.errors import FormatError
from reseau.io import LensDocument, LensSensor
from reseau.io.lens import LensMedium
from reseau.optics.lenses import AIR, Aperture, Paraxial, Prescription, Tracer, glass
from reseau.optics.lenses.media import Air, Cauchy, Constant, Powers, Sellmeier, Water, model_glass
from reseau.optics.lenses.prescription import Layout, Surface
from reseau.optics.lenses.trace import Rays

SINGLET = """
schema = "lens/1"
name = "singlet"
wavelengths_nm = [486.1327, 587.5618]
weights = [1, 2]
reference_nm = 587.5618
stop_radius = 5.0

[sensor]
pitch_um = [5.0, 5.0]
size_px = [640, 480]

[[surface]]
radius = 50
distance = 5
medium = "N-BK7"
stop = true
apertures = [{radius = 12.0}]

[[surface]]
distance = 93.45
medium = "air"

[[surface]]
"""


def read(text: str) -> Prescription:
    return LensDocument.parse(text, where="lens.toml").prescription()


def test_a_document_gives_the_lens_it_describes() -> None:
    lens = read(SINGLET)
    assert [surface.kind for surface in lens.surfaces] == ["refracting", "refracting", "plain"]
    assert lens.surfaces[0].curvature == 0.02
    assert lens.surfaces[-1].vertex.tolist() == [0.0, 0.0, 98.45]
    assert (lens.wavelength_nm, lens.weights, lens.stop_radius) == (587.5618, (1.0, 2.0), 5.0)
    document = LensDocument.parse(SINGLET, where="lens.toml")
    assert document.sensor == LensSensor(pitch_um=(5.0, 5.0), size_px=(640, 480))
    assert document.sensor.principal == (319.5, 239.5)


def test_every_kind_of_surface_medium_and_aperture_survives_writing(tmp_path: Path) -> None:
    media = (
        Constant(1.5, "resin"),
        Cauchy((1.5, 0.004), "plastic", (400.0, 700.0)),
        Sellmeier((1.0,), (0.01,), "new glass"),
        Powers(2.2, ((0.01, -2.0), (-0.01, 2.0)), "old glass", (400.0, 700.0)),
        Water(10.0, 35.0),
        Air(15.0, 900.0),
        glass("N-SF6"),
        model_glass(1.6, 60.0, "600.600"),
        AIR,
    )
    apertures = (
        Aperture("circle", (20.0, 2.0), centre=(0.5, 0.0)),
        Aperture("rectangle", (18.0, 15.0), turn=0.25),
        Aperture("polygon", corners=np.array([[-1.0, -1.0], [1.0, -1.0], [0.0, 1.0]]), blocks=True),
    )
    layout, surfaces = Layout(), []
    for k, medium in enumerate(media):
        if k in (3, 6):
            layout.turn((0.2 * k, -0.3), (3.0, -2.0, 30.0))
        kind = "mirror" if k == 7 else "refracting"
        surfaces.append(
            Surface(
                0.01 if k % 2 else 0.0,
                -0.5 if k == 1 else 0.0,
                (1e-6, 0.0, -1e-12) if k == 2 else (),
                kind,
                glass("N-SF6") if k == 7 else medium,
                layout.vertex,
                layout.axes,
                apertures if k == 4 else (),
                f"part {k}",
            )
        )
        layout.advance(4.0 if k != 7 else -40.0)
    surfaces.append(Surface(kind="plain", vertex=layout.vertex, axes=layout.axes, name="image"))
    lens = Prescription(
        tuple(surfaces), 2, 3.0, (550.0, 600.0), (0.3, 0.7), 1, Water(), "everything", ("as an example",)
    )
    sensor = LensSensor(
        pitch_um=(5.0, 6.0), size_px=(64, 48), principal_px=(30.0, 20.5), rotation_deg=3.0, fill=0.9
    )
    path = tmp_path / "lens.toml"
    LensDocument.of(lens, sensor).write(path)
    document = LensDocument.read(path)
    same = document.prescription()
    assert document.sensor == sensor
    for attribute in (
        "stop",
        "stop_radius",
        "wavelengths_nm",
        "weights",
        "reference",
        "before",
        "name",
        "notes",
    ):
        assert getattr(same, attribute) == getattr(lens, attribute)
    assert len(same.surfaces) == len(lens.surfaces)
    for one, other in zip(lens.surfaces, same.surfaces, strict=True):
        np.testing.assert_allclose(other.vertex, one.vertex, atol=1e-12)
        np.testing.assert_allclose(other.axes, one.axes, atol=1e-14)
        for attribute in ("curvature", "conic", "coefficients", "kind", "name"):
            assert getattr(other, attribute) == getattr(one, attribute)
        if one.kind == "refracting":
            assert other.medium == one.medium
        assert [(a.shape, a.size, a.centre, a.blocks) for a in other.apertures] == [
            (a.shape, a.size, a.centre, a.blocks) for a in one.apertures
        ]
        assert [a.turn for a in other.apertures] == pytest.approx([a.turn for a in one.apertures], abs=1e-15)
    np.testing.assert_array_equal(same.surfaces[4].apertures[2].corners, apertures[2].corners)


def test_a_surface_that_is_moved_alone_leaves_those_behind_it_in_place() -> None:
    alone = read(
        SINGLET.replace("stop = true", "stop = true\ndecentre = [0.1, 0.2, 0.3]\ntilt_deg = [1.0, 2.0, 0.0]")
    )
    both = read(
        SINGLET.replace(
            "stop = true", "stop = true\nbreak = {decentre = [0.1, 0.2], tilt_deg = [1.0, 2.0, 0.0]}"
        )
    )
    np.testing.assert_allclose(alone.surfaces[0].vertex, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(alone.surfaces[1].vertex, [0.0, 0.0, 5.0])
    np.testing.assert_allclose(alone.surfaces[0].axes, both.surfaces[0].axes)
    np.testing.assert_allclose(
        both.surfaces[1].vertex, np.array([0.1, 0.2, 0.0]) + 5 * both.surfaces[0].axes[:, 2]
    )


def test_a_tilt_about_x_turns_y_towards_z() -> None:
    lens = read(SINGLET.replace("stop = true", "stop = true\ntilt_deg = [90.0, 0.0, 0.0]"))
    np.testing.assert_allclose(lens.surfaces[0].axes[:, 1], [0.0, 0.0, 1.0], atol=1e-15)


def test_a_plane_mirror_returns_light_to_a_surface_at_a_negative_distance() -> None:
    text = SINGLET.replace('medium = "air"', 'medium = "air"').replace(
        "distance = 93.45\n", "distance = 40.0\n"
    ).replace(
        '[[surface]]\n"""', ""
    )  # fmt: skip
    head, _, _ = text.rpartition("[[surface]]")
    lens = read(head + '[[surface]]\ndistance = -30.0\nmedium = "mirror"\n[[surface]]\n')
    traced = Tracer(lens).trace(Rays(np.array([[0.0, 0.0, -5.0]]), np.array([[0.0, 0.0, 1.0]])))
    assert traced.rays.directions[0].tolist() == [0.0, 0.0, -1.0]
    assert lens.surfaces[-1].vertex[2] == 15.0


@pytest.mark.parametrize(
    ("old", "new", "refused"),
    [
        ('schema = "lens/1"', 'schema = "lens/9"', "'lens/9'"),
        ('schema = "lens/1"', "schema =", "is not TOML"),
        ('name = "singlet"', 'name = "singlet"\nunit = "m"', "has the unit 'm'; lengths of lens/1 are in mm"),
        ('name = "singlet"', 'name = "singlet"\nfocal_length = 50000.0', "states a focal length of 50000 mm"),
        ("radius = 50\n", "radius = 50000\n", "has a focal length of 96.7 m and surfaces within 98.5 mm"),
        ("wavelengths_nm = [486.1327, 587.5618]", "wavelengths_nm = []", "wavelengths_nm"),
        ("wavelengths_nm = [486.1327, 587.5618]\n", "", "missing key `wavelengths_nm`"),
        ("wavelengths_nm = [486.1327, 587.5618]", "wavelengths_nm = [0.486, 0.587]", "wavelengths_nm"),
        ("weights = [1, 2]", "weights = [1]", "need as many weights"),
        ("reference_nm = 587.5618", "reference_nm = 600.0", "600 nm is none"),
        ("stop = true", "stop = false", "one surface must have `stop = true`"),
        ("radius = 50\n", "radius = 0\n", "not a radius"),
        ("radius = 50\n", "radius = 50\ncurvature = 0.02\n", "not both"),
        ('medium = "N-BK7"\n', "", "surface 1 has no `medium`"),
        ("distance = 5\n", "", "surface 1 has no `distance`"),
        ("distance = 5\n", "distance = inf\n", r"surface\[0\]"),
        ('"N-BK7"', '"C79-80"', "surface 1: the glass C79-80 is not in the catalogue"),
        ('"N-BK7"', "{nd = 1.5}", "needs `abbe`"),
        ('"N-BK7"', "{index = 1.5, air = {}}", "one of"),
        ('"N-BK7"', "{index = 25.0}", "25.0 is not a refractive index"),
        ('"N-BK7"', "{water = {temperature_c = 80.0}}", "outside the formula"),
        ('"N-BK7"', '"air"', "no lens|not a lens"),
        ("radius = 50\n", "", "has no power"),
        ("pitch_um = [5.0, 5.0]", "pitch_um = [5.0, 0.0]", "sensor.pitch_um"),
        ("{radius = 12.0}", "{radius = 12.0, inner = 13.0}", "not less than"),
    ],
)
def test_what_is_wrong_with_a_document_is_said_in_one_line(old: str, new: str, refused: str) -> None:
    assert old in SINGLET
    with pytest.raises(FormatError, match=refused) as raised:
        read(SINGLET.replace(old, new, 1))
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith("lens.toml: ")


def test_a_lens_telecentric_on_both_sides_has_no_focal_length_and_is_a_lens() -> None:
    # Two thin lenses of 100 mm at a distance of 200 mm image an object 100 mm in front.
    half = (
        "radius = 100.0\ndistance = 1e-3\nmedium = {index = 1.5}\n"
        '[[surface]]\nradius = -100.0\nmedium = "air"\n'
    )
    text = (
        'schema = "lens/1"\nname = "telecentric"\nwavelengths_nm = [550.0]\nstop_radius = 5.0\n'
        f'[[surface]]\n{half}distance = 100.0\n[[surface]]\nstop = true\nmedium = "air"\ndistance = 100.0\n'
        f"[[surface]]\n{half}distance = 100.0\n[[surface]]\n"
    )
    lens = read(text)
    assert abs(Paraxial(lens).focal_length) > 1e5


def test_a_vacuum_is_air_without_pressure() -> None:
    medium = LensMedium.model_validate_json('{"air": {"pressure_hpa": 0.0}}').medium()
    assert medium.index(550.0) == pytest.approx(1 / 1.000273, abs=1e-6)


def test_the_example_of_the_documentation_is_a_lens() -> None:
    text = (Path(__file__).parents[2] / "docs" / "formats" / "lens.md").read_text("utf-8")
    example = text[text.index('    schema = "lens/1"') : text.index("Lengths are millimetres (`unit")]
    document = LensDocument.parse(dedent(example), where="lens.md")
    assert Paraxial(document.prescription()).focal_length == pytest.approx(document.focal_length, rel=0.001)
    assert document.sensor is not None
