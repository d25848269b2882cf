"""Rigs of simulated GigE Vision cameras: one exposure of all, the skew as it truly was, nothing mixed up."""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from reseau.capture import Bench, BenchFile
from reseau.core.errors import BenchError, DeadlineError, InstrumentError, SettingError
from reseau.instruments import CameraRig, ExposureSet
from reseau_drivers.camera import aravis, rig
from reseau_sims.serving import FaultScript, GigeVisionCamera, SimulatedCamera, StripeScene, View

from .rigs import own_key, vision_cameras

VIEW = View(2000.0, 0.0, 0.0, 0, 0, 96, 64, 255.0)


@dataclass
class Wired:
    """A bench with a rig, and its simulated cameras."""

    bench: Bench
    served: list[GigeVisionCamera]

    @property
    def rig(self) -> Any:
        return self.bench["rig"]

    def true_skew_s(self) -> float:
        """Skew of the last exposures, as the cameras know it."""
        starts = [each.starts_ns[-1] for each in self.served]
        return (max(starts) - min(starts)) / 1e9


Make = Callable[..., Wired]


def bench_file(addresses: list[str], trigger: str, own: str, lead: str = "") -> BenchFile:
    names = [f"camera {k}" for k in range(len(addresses))]
    text = 'schema = "reseau-bench/1"\n'
    for name, address in zip(names, addresses, strict=True):
        text += f"""[instruments."{name}"]
driver = "aravis"
address = "{address}"
options = {{seconds = 20.0}}
[instruments."{name}".settings]
width = 96
height = 64
gain = 0.0
exposure_us = 2000.0
trigger = "{"software" if name == lead else own}"
action_device_key = {own_key()}
"""
    text += f'[instruments.rig]\ndriver = "rig"\naddress = "{", ".join(names)}"\n'
    text += f'options = {{seconds = 20.0}}\nsettings = {{trigger = "{trigger}", lead = "{lead}"}}\n'
    return BenchFile.parse_toml(text, where="bench.toml")


@pytest.fixture
def make() -> Iterator[Make]:
    with ExitStack() as stack:

        def made(count: int, trigger: str, own: str, lead: str = "", scripts: Any = None) -> Wired:
            scripts = scripts or [FaultScript() for _ in range(count)]
            served = vision_cameras(stack, *(SimulatedCamera(script=script) for script in scripts))
            for k, each in enumerate(served):
                each.latency_us = 700.0 * k
            if lead:
                served[0].outputs += [each.pulse for each in served[1:]]
            addresses = [each.address for each in served]
            return Wired(stack.enter_context(Bench(bench_file(addresses, trigger, own, lead))), served)

        yield made


def pointed(wired: Wired, number: int) -> list[np.ndarray]:
    """Give each camera a scene of its own; return the images of all."""
    scenes = [StripeScene(shift=10 * number + k) for k in range(len(wired.served))]
    for each, scene in zip(wired.served, scenes, strict=True):
        each.body.point_at(scene)
    return [scene(VIEW) for scene in scenes]


def require(taken: ExposureSet, expected: list[np.ndarray]) -> None:
    for shot, image in zip(taken.exposures.values(), expected, strict=True):
        assert shot.fresh
        assert (shot.frame.pixels == image).all()


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize(
    ("trigger", "own", "lead"),
    [("software", "software", ""), ("software", "off", ""), ("hardware", "hardware", "camera 0"),
     ("action", "action", "")],
)  # fmt: skip
def test_cameras_expose_at_once_and_the_skew_is_what_it_truly_was(
    make: Make, count: int, trigger: str, own: str, lead: str
) -> None:
    wired = make(count, trigger, own, lead)
    assert isinstance(wired.rig, CameraRig)
    for number in range(8):
        expected = pointed(wired, number)
        taken = wired.rig.expose_all()
        require(taken, expected)
        skew, within = taken.skew
        if own != "off":  # what runs freely has exposed again meanwhile
            assert abs(skew - wired.true_skew_s()) <= within
        # Clocks are read at each second: a drift of 1e-4 since then, and reading them.
        assert 0 < within < 0.02
    assert all(each.body.violations == [] for each in wired.served)


def test_a_line_that_others_pulse_exposes_all_cameras_by_the_same_pulse(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    wired = make(2, "hardware", "hardware")

    def pulse() -> None:
        for each in wired.served:
            each.pulse()

    timers = list[threading.Timer]()

    def later() -> None:
        timers.append(threading.Timer(0.05, pulse))
        timers[-1].start()

    monkeypatch.setattr(wired.rig, "_fire", later)
    for _ in range(12):
        pulse()  # when all wait before it, or only the slower camera does
        skew, within = wired.rig.expose_all().skew
        # The second camera starts 0.7 ms later; frames of different pulses would be 50 ms apart.
        assert abs(skew - 0.7e-3) < 0.02 + within
        timers[-1].join()


def test_an_action_command_of_another_key_exposes_nothing(make: Make) -> None:
    wired = make(2, "action", "action")
    wired.rig.expose_all()
    before = [each.frames for each in wired.served]
    wired.bench["camera 1"].configure(action_group_mask=2)
    with pytest.raises(DeadlineError, match=r"camera 1 .expose.: delivered no new frame"):
        wired.rig.expose_all(1.0)
    assert [each.frames for each in wired.served] == [before[0] + 1, before[1]]
    # One camera alone sends the command to itself.
    assert wired.bench["camera 1"].expose().fresh


def test_a_camera_without_a_cable_is_named_and_the_others_are_not_kept_waiting(make: Make) -> None:
    wired = make(2, "action", "action")
    wired.rig.expose_all()
    wired.served[1].pull_plug()
    began = time.monotonic()
    for _ in range(2):  # the first time it is asked for a frame, the second time for a connection
        with pytest.raises(InstrumentError, match="camera 1"):
            wired.rig.expose_all(1.0)
    assert time.monotonic() - began < 10.0
    wired.served[1].plug_in()
    expected = pointed(wired, 1)
    require(wired.rig.expose_all(10.0), expected)
    assert wired.bench["camera 0"].reconnections == 1
    assert wired.bench["camera 1"].reconnections == 2


@pytest.mark.slow
def test_one_fault_in_a_hundred_frames_never_mixes_exposures(make: Make) -> None:
    scripts = [FaultScript(rate=0.01, seed=k, seconds=0.05) for k in (3, 5)]
    wired = make(2, "action", "action", scripts=scripts)
    taken = failed = 0
    for number in range(300):
        expected = pointed(wired, number)
        try:
            require(wired.rig.expose_all(1.0), expected)
            taken += 1
        except InstrumentError:
            failed += 1
    assert sum(len(script.happened) for script in scripts) >= 3
    # A fault spoils its exposure, and one that ends control also the next one.
    assert failed <= 3 * sum(len(script.happened) for script in scripts)
    assert taken + failed == 300
    assert all(each.body.violations == [] for each in wired.served)


@pytest.mark.parametrize(
    ("trigger", "own", "lead", "said"),
    [
        ("action", "software", "", "camera camera 0 has trigger = 'software'; set trigger = 'action'"),
        ("software", "hardware", "", "set trigger = 'software'"),
        ("hardware", "hardware", "camera 7", "lead 'camera 7' is not one of camera 0, camera 1"),
        ("action", "action", "camera 0", "on a hardware line"),
    ],
)
def test_a_rig_whose_cameras_are_triggered_otherwise_is_refused(
    trigger: str, own: str, lead: str, said: str
) -> None:
    with pytest.raises(BenchError) as caught:
        Bench(bench_file(["192.0.2.1", "192.0.2.2"], trigger, own, lead))
    assert said in str(caught.value)
    assert "rig" in str(caught.value)


def test_a_rig_needs_cameras_of_its_bench() -> None:
    with pytest.raises(SettingError, match="two or more cameras are needed"):
        rig("rig", "left")
    pair = rig("rig", "left, right")
    with pytest.raises(SettingError, match="'left' is not a camera on this bench"):
        pair.combine({})


def test_the_bench_check_measures_the_skew(make: Make) -> None:
    wired = make(2, "action", "action")
    checked = {each.name: each for each in wired.bench.check(20.0)}
    assert checked["rig"].error is None
    assert checked["rig"].found["trigger"] == "action"
    skew, within = (float(part) for part in checked["rig"].found["skew"].removesuffix(" ms").split(" ± "))
    assert abs(skew - 1e3 * wired.true_skew_s()) <= within + 0.01


def _program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"no {name}: apt-get install aravis-tools aravis-tools-cli")
    return found


def test_aravis_s_own_programs_find_both_cameras_and_receive_their_frames() -> None:
    listing, client = _program("arv-tool-0.8"), _program("arv-camera-test-0.8")
    with ExitStack() as stack:
        served = vision_cameras(stack, SimulatedCamera(), SimulatedCamera())
        said = subprocess.run([listing], capture_output=True, text=True, timeout=60, check=True).stdout
        for each in served:
            assert f"({each.address})" in said
            values = [listing, "-a", each.address, "control", "Width=64", "ExposureTime=1500", "Gain"]
            shown = subprocess.run(values, capture_output=True, text=True, timeout=60, check=True).stdout
            assert "Gain = 0 dB" in shown
            assert (each.value("Width"), each.value("ExposureTime")) == (64, 1500.0)
        options = ["-n", served[1].address, "-f", "50", "-i", "1500"]
        running = subprocess.Popen(
            [client, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        time.sleep(4.0)
        running.send_signal(2)
        message = running.communicate(timeout=60)[0]
    assert int(message.split("n_completed_buffers")[1].split()[1]) >= 20
    assert served[0].frames == 0


def test_lost_packets_are_sent_again() -> None:
    """Every third packet of the first sending is lost; the library asks for it again."""
    with ExitStack() as stack:
        (served,) = vision_cameras(stack, SimulatedCamera(StripeScene(640, 480), 640, 480))
        deliver, resent = served._deliver, 0

        def losing(packets: list[bytes]) -> None:
            nonlocal resent
            if len(packets) > 100:
                packets = [each for k, each in enumerate(packets) if k % 3 != 1]
            elif len(packets) < 100 and packets[0][4] == 3:
                resent += len(packets)
            deliver(packets)

        served._deliver = losing  # type: ignore[method-assign]
        how = {"width": 640, "height": 480, "packet_size": 1500, "trigger": "software"}
        camera = stack.enter_context(aravis("camera", served.address, settings=how, seconds=20.0))
        shot = camera.expose()
    assert (shot.pixels == StripeScene(640, 480)(View(10_000.0, 0.0, 0.0, 0, 0, 640, 480, 255.0))).all()
    assert resent >= 50
