"""Features of a GenICam camera by hand: browse, search, set within ranges; user sets saved and compared."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from reseau.capture import BenchFile
from reseau.cli import run
from reseau.core.errors import RefusedError
from reseau_drivers.camera import aravis, v4l2
from reseau_drivers.codecs.pixels import GENICAM
from reseau_sims.serving import GigeVisionCamera, SimulatedCamera, VideoCamera

from .rigs import vision_cameras


@pytest.fixture
def served() -> Iterator[GigeVisionCamera]:
    with ExitStack() as stack:
        yield vision_cameras(stack, SimulatedCamera())[0]


def test_features_have_values_ranges_and_units(served: GigeVisionCamera) -> None:
    with aravis("camera", served.address, settings={"width": 64}) as camera:
        found = {each.name: each for each in camera.features()}
        assert set(found) == set(served.features)
        exposure, width, gain = found["ExposureTime"], found["Width"], found["Gain"]
        assert (exposure.kind, exposure.unit, exposure.low, exposure.high) == ("float", "us", 10.0, 1e7)
        assert (width.kind, width.value, width.low, width.high) == ("integer", "64", 1.0, 96.0)
        assert str(gain) == "Gain = 0 dB, 0 to 24 dB"
        assert found["PixelFormat"].entries == tuple(GENICAM)
        assert not found["SensorWidth"].writable
        assert found["AcquisitionStart"].kind == "command"
        assert {each.name for each in camera.features("trigger")} >= {"TriggerMode", "TriggerSource"}
        assert [each.name for each in camera.features("BayerRG8")] == ["PixelFormat"]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("Gain", "99", "Gain = 99: Gain = 0 dB, 0 to 24 dB"),
        ("PixelFormat", "Coord3D_A8", "it is one of Mono8, Mono10, Mono12"),
        ("SensorWidth", "5", "SensorWidth cannot be changed now"),
        ("Nope", "1", "has no feature Nope"),
    ],
)
def test_what_is_outside_its_range_is_refused_before_it_is_sent(
    served: GigeVisionCamera, name: str, value: str, said: str
) -> None:
    with aravis("camera", served.address) as camera:
        with pytest.raises(RefusedError, match=r"camera .set features.: ") as caught:
            camera.set_features({name: value})
        assert said in str(caught.value)
        assert camera.expose().fresh


def test_user_sets_are_saved_and_compared_and_the_camera_is_left_as_it_was(served: GigeVisionCamera) -> None:
    with aravis("camera", served.address, settings={"trigger": "software"}) as camera:
        camera.set_features({"Gain": "6", "BlackLevel": "10"})
        camera.save_user_set("UserSet1")
        camera.set_features({"Gain": "2", "ReverseX": "true"})
        assert camera.user_sets() == ("Default", "UserSet1", "UserSet2")
        found = camera.compare_user_sets("Default", "UserSet1")
        assert found["Gain"] == ("0", "6")
        assert found["BlackLevel"] == ("0", "10")
        assert "ReverseX" not in found
        assert camera.compare_user_sets("UserSet1")["ReverseX"] == ("false", "true")
        assert (served.value("Gain"), served.value("ReverseX"), served.value("BlackLevel")) == (2.0, 1, 10)
        assert served.value("TriggerMode") == "On"
        assert camera.expose().fresh
        with pytest.raises(RefusedError, match="has no user set Mine; it has Default, UserSet1, UserSet2"):
            camera.save_user_set("Mine")


def test_other_cameras_have_no_features() -> None:
    camera = v4l2("eye", VideoCamera(SimulatedCamera()).open)
    with camera, pytest.raises(RefusedError, match=r"eye.*has no GenICam features"):
        camera.features()


def test_commands_list_set_save_and_compare(
    served: GigeVisionCamera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(
        "reseau.capture.bench.plugin",
        lambda group, name: (lambda: [served.address]) if "discovery" in group else aravis,
    )
    assert run(["bench", "list", "--write", "bench.toml"]) == 0
    assert BenchFile.read("bench.toml").instruments["camera"].address == served.address
    assert run(["bench", "list", "--write", "bench.toml"]) == 2
    assert "bench.toml: exists" in capsys.readouterr().err
    assert run(["bench", "features", "gain", "--camera", "camera"]) == 0
    assert "AnalogControl\n  Gain = 0 dB, 0 to 24 dB\n" in capsys.readouterr().out
    assert run(["bench", "features", "--camera", "camera", "--set", "Gain=3", "--save-set", "UserSet2"]) == 0
    assert capsys.readouterr().out == "AnalogControl\n  Gain = 3 dB, 0 to 24 dB\n"
    assert run(["bench", "features", "--camera", "camera", "--compare", "Default,UserSet2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["different"]["Gain"] == ["0", "3"]
    assert run(["bench", "features", "--camera", "camera", "--set", "Gain=99"]) == 1
    assert "Gain = 99: " in capsys.readouterr().err
    how = ["bench", "expose", "--camera", "camera", "--auto", "--share", "0.5", "--json"]
    assert run(how) == 0
    auto = json.loads(capsys.readouterr().out)["auto"]
    assert abs(auto["level"] / 0.5 - 1) <= 0.05
    assert BenchFile.read("bench.toml").instruments["camera"].settings["exposure_us"] == auto["exposure_us"]
