"""GigE Vision on the loopback interface: real packets, read by our driver and by Aravis's own programs."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from reseau.capture import Bench, BenchFile
from reseau.core.errors import (
    ConnectionLost,
    DeadlineError,
    InstrumentError,
    RefusedError,
    SettingError,
    UsageError,
)
from reseau_drivers import camera as cameras
from reseau_drivers.camera import AravisSettings, aravis
from reseau_drivers.codecs.pixels import GENICAM
from reseau_sims import World
from reseau_sims.laboratory import Laboratory
from reseau_sims.serving import (
    Fault,
    FaultScript,
    GigeCamera,
    LaboratoryScene,
    SimulatedCamera,
    StillScene,
    StripeScene,
    View,
)

from .rigs import gige_camera, vision_cameras

Cam = cameras.CameraDriver[AravisSettings]
SIZE = {"width": 640, "height": 480}
LIGHT = {"exposure_us": 2000.0, "gain": 0.0, "rate": 100.0}


def pattern(shift: int = 0) -> StripeScene:
    return StripeScene(640, 480, shift)


def expected_image(shift: int, exposure_us: float = 2000.0, full_scale: float = 255.0) -> Any:
    return pattern(shift)(View(exposure_us, 0.0, 0.0, 0, 0, 640, 480, full_scale))


@pytest.fixture
def simulated() -> Iterator[GigeCamera]:
    with ExitStack() as stack:
        yield gige_camera(stack, SimulatedCamera(pattern(), 640, 480))


@pytest.fixture
def camera(simulated: GigeCamera) -> Iterator[Cam]:
    with aravis("camera", simulated.address, settings=SIZE | LIGHT, seconds=2.0) as made:
        yield made


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Mono8", "Mono16"])
def test_frames_equal_the_simulated_image(simulated: GigeCamera, name: str) -> None:
    frame = World.standard(seed=5).photo_i()
    simulated.body.point_at(StillScene(frame))
    size = {"width": frame.width, "height": frame.height, "format": name, "exposure_us": 10_000.0}
    with aravis("camera", simulated.address, settings=size) as camera:
        shot = camera.expose()
        if name == "Mono8":
            assert shot.frame.sha256 == frame.sha256
        assert (shot.pixels == frame.pixels * np.uint16(257 if name == "Mono16" else 1)).all()
        assert shot.full_scale == {"Mono8": 255, "Mono16": 65535}[name]


@pytest.mark.slow
def test_the_camera_images_the_laboratory(simulated: GigeCamera) -> None:
    laboratory = Laboratory(World.standard(seed=5))
    laboratory.expose("screen")  # what takes long is computed now, not while the camera is controlled
    simulated.body.point_at(LaboratoryScene(laboratory))
    settings = {"width": 1600, "height": 1200, "trigger": "software"}
    with aravis("camera", simulated.address, settings=settings) as camera:
        one = camera.expose(20.0)
        assert any((one.pixels == drawn).all() for drawn in simulated.body.drawn)
        camera.configure(exposure_us=5000.0)
        assert camera.expose(20.0).pixels.mean() == pytest.approx(one.pixels.mean() / 2, rel=0.03)


@pytest.mark.parametrize("name", ["BayerRG8", "BayerGR8"])
def test_colour_stays_raw_with_its_pattern(simulated: GigeCamera, camera: Cam, name: str) -> None:
    camera.configure(format=name)
    shot = camera.expose()
    assert shot.pattern == {"BayerRG8": "RGGB", "BayerGR8": "GRBG"}[name]
    assert (shot.pixels == expected_image(0)).all()


@pytest.mark.parametrize("trigger", ["off", "software"])
def test_exposures_start_after_the_request(simulated: GigeCamera, camera: Cam, trigger: str) -> None:
    camera.configure(trigger=trigger)
    for shift in range(12):
        simulated.body.point_at(pattern(shift))
        shot = camera.expose()
        assert shot.fresh
        assert (shot.pixels == expected_image(shift)).all()
    assert camera.skipped > 0 or trigger != "off"


def test_a_delayed_frame_is_not_fresh(simulated: GigeCamera, camera: Cam) -> None:
    camera.expose()
    time.sleep(0.2)
    simulated.body.point_at(pattern(5))
    shots = list(camera.frames(4))
    assert not shots[0].fresh
    assert (shots[0].pixels == expected_image(0)).all()
    assert (camera.expose().pixels == expected_image(5)).all()


def test_exposure_gain_and_region_act_on_the_picture(simulated: GigeCamera, camera: Cam) -> None:
    before = camera.expose().pixels.astype(float)
    camera.configure(exposure_us=4000.0)
    assert (camera.expose().pixels == expected_image(0, 4000.0)).all()
    camera.configure(exposure_us=2000.0, gain=6)
    assert camera.expose().pixels.mean() == pytest.approx(10**0.3 * before.mean(), rel=0.03)
    camera.configure(gain=0, left=8, top=16, width=128, height=64)
    assert (camera.expose().pixels == before[16:80, 8:136]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gain": 99.0}, "gain 99 is outside 0…10"),
        ({"exposure_us": 1.0}, "exposure_us 1 is outside 10…"),
        ({"rate": 5e4}, "rate 50000 is outside"),
        ({"width": 2048, "left": 8}, r"has 2048×2048 pixels; 2048×480 at \(8, 0\) does not fit"),
        ({"format": "Mono12"}, "does not offer the format Mono12; set `format` to what it offers: .*Mono8"),
        ({"left": 16, "width": 320, "rate": 50.0, "exposure_us": 1.0}, "exposure_us 1 is outside 10…"),
    ],
)
def test_unsupported_settings_raise_and_change_nothing(
    camera: Cam, changes: dict[str, Any], message: str
) -> None:
    before = camera.settings
    with pytest.raises(RefusedError, match=message):
        camera.configure(**changes)
    assert camera.settings == before
    assert (camera.expose().pixels == expected_image(0)).all()
    assert camera.reconnections == 1


def test_default_settings_restore_the_original_values(simulated: GigeCamera) -> None:
    def asked(camera: Cam) -> tuple[Any, ...]:
        source = camera._source
        assert isinstance(source, cameras.Aravis)
        its = source._camera
        return (*its.get_region(), its.get_frame_rate(), its.get_exposure_time(), its.get_gain())

    with aravis("camera", simulated.address) as camera:
        found = asked(camera)
        changes = {
            "left": 16,
            "top": 8,
            "width": 320,
            "height": 200,
            "rate": 50.0,
            "exposure_us": 500.0,
            "gain": 3.0,
        }
        camera.configure(**changes)
        assert asked(camera) != found
        camera.configure(**{name: getattr(AravisSettings(), name) for name in changes})
        assert asked(camera) == found


def test_features_are_set_by_name_also_after_unplugging(simulated: GigeCamera, camera: Cam) -> None:
    source = camera._source
    assert isinstance(source, cameras.Aravis)
    camera.configure(features="BinningHorizontal=2 GainAuto=Continuous TestBoolean=True")
    camera.expose()
    simulated.pull_plug()
    simulated.plug_in()
    with pytest.raises(InstrumentError):
        camera.expose(1.5)
    camera.connect()
    assert source._camera.get_integer("BinningHorizontal") == 2
    assert source._camera.get_string("GainAuto") == "Continuous"
    assert source._camera.get_boolean("TestBoolean")
    assert camera.reconnections == 2


@pytest.mark.parametrize(
    ("features", "error", "message"),
    [
        ("Nope=1", RefusedError, "has no feature Nope"),
        ("GainAuto=Sometimes", RefusedError, "'Sometimes' not an entry"),
        ("ExposureTimeAbs=1234.5", RefusedError, "ExposureTimeAbs is 1234, not 1234.5"),
        ("GainAuto", SettingError, "features: 'GainAuto' is not a feature setting"),
        ('DeviceVendorName="me', SettingError, "is incomplete"),
    ],
)
def test_unknown_features_and_invalid_values_raise(
    camera: Cam, features: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        camera.configure(features=features)
    assert (camera.settings.features, camera.reconnections) == ("", 1)
    assert camera.expose().fresh


@pytest.mark.slow
def test_frame_numbers_of_16_bits_wrap_without_a_gap(simulated: GigeCamera, camera: Cam) -> None:
    # The library's camera begins at 65400, and counts 0 too.
    camera.configure(rate=500.0)
    shots = list(camera.frames(200))
    numbers = [shot.sequence for shot in shots]
    assert numbers[0] < 65536 <= numbers[-1]
    gaps = sum(b - a - 1 for a, b in itertools.pairwise(numbers))
    assert gaps == shots[-1].dropped - shots[0].dropped
    assert simulated.frames >= 200


@pytest.mark.parametrize("kind", ["dropped", "truncated", "corrupted"])
def test_lost_and_damaged_frames_are_counted_and_not_returned(
    simulated: GigeCamera, camera: Cam, kind: Any
) -> None:
    camera.configure(rate=50.0)
    before = next(camera.frames(1, 20.0))
    script = simulated.body.script
    script.fault_at(script.count + 2, Fault(kind))
    shots = list(camera.frames(8, 20.0))
    assert [fault.kind for fault in script.happened] == [kind]
    assert all((shot.pixels == expected_image(0)).all() for shot in shots)
    lost = shots[-1].dropped - before.dropped
    assert lost >= 1
    assert shots[-1].sequence - before.sequence == 8 + lost


def test_a_repeated_frame_is_not_returned_twice(simulated: GigeCamera, camera: Cam) -> None:
    camera.expose()
    script = simulated.body.script
    script.fault_at(script.count + 2, Fault("repeated"))
    numbers = [shot.sequence for shot in camera.frames(8)]
    assert len(script.happened) == 1
    assert len(set(numbers)) == 8


def test_lost_control_raises_and_is_regained_with_the_settings(simulated: GigeCamera, camera: Cam) -> None:
    camera.configure(exposure_us=4000.0)
    camera.expose()
    simulated.power_cycle()
    with pytest.raises(ConnectionLost, match="control of the camera was lost"):
        camera.expose()
    assert (camera.expose().pixels == expected_image(0, 4000.0)).all()
    assert camera.reconnections == 2


def test_unplugging_and_plugging_in(simulated: GigeCamera, camera: Cam) -> None:
    camera.expose()
    simulated.pull_plug()
    began = time.monotonic()
    with pytest.raises(DeadlineError):
        camera.expose(0.5)
    with pytest.raises(ConnectionLost):
        camera.expose(0.5)
    # The library alone would try for a quarter of a minute.
    assert time.monotonic() - began < 8.0
    simulated.plug_in()
    assert (camera.expose(5.0).pixels == expected_image(0)).all()


def test_a_camera_controlled_by_another_program_is_refused(simulated: GigeCamera, camera: Cam) -> None:
    camera.expose()
    began = time.monotonic()
    with pytest.raises(RefusedError, match=r"other .connect.: 127.0.0.1 is controlled by another program"):
        aravis("other", simulated.address, settings=SIZE).connect()
    # The library alone would try for six seconds, and then say that nobody answers.
    assert time.monotonic() - began < 3.0
    assert camera.expose().fresh
    assert camera.reconnections == 1


# What another program does that asks for a camera that is controlled, by a name that only the library knows.
_ASKED_BY_THE_LIBRARY = """
import sys
from reseau.core.errors import RefusedError
from reseau_drivers.camera import aravis, gvcp
gvcp.is_ip = lambda address: False
try:
    aravis("other", sys.argv[1], settings={"width": 640, "height": 480}).connect(20.0)
except RefusedError as error:
    print(error, flush=True)
"""


@pytest.mark.slow
def test_a_camera_controlled_by_another_program_is_refused_before_it_is_set(
    simulated: GigeCamera, camera: Cam
) -> None:
    # Only IP addresses are asked before; of other names the library finds out itself. A process of its own,
    # as another program is: libaravis has once crashed while it gave up such a camera.
    camera.expose()
    command = [sys.executable, "-c", _ASKED_BY_THE_LIBRARY, simulated.address]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "is controlled by another program" in done.stdout, done.stderr
    assert camera.expose().fresh


def test_the_driver_waits_for_its_own_old_control_to_end(simulated: GigeCamera, camera: Cam) -> None:
    camera.expose()
    source = camera._source
    assert isinstance(source, cameras.Aravis)
    # A cable was pulled: the camera missed that it was let go.
    held, source._camera, source._stream = [source._camera], None, None
    source._ours_until = time.monotonic() + 3.0
    threading.Timer(0.5, held.clear).start()
    camera._connected = False
    assert camera.expose().fresh
    assert camera.reconnections == 2


def test_a_maker_s_own_format_is_named_with_what_to_set(simulated: GigeCamera) -> None:
    camera = aravis("camera", simulated.address, settings=SIZE)
    camera.connect()
    source: Any = camera._source
    inner = source._camera

    class Offers:
        def __getattr__(self, name: str) -> Any:
            return getattr(inner, name)

        def dup_available_pixel_formats(self) -> list[int]:
            return [0x01080001, 0x81080005 - (1 << 32)]

    source._camera = Offers()
    with pytest.raises(
        RefusedError, match=r"Mono16, but the maker's own format 0x81080005; set `format`.*: Mono8$"
    ):
        camera.configure(format="Mono16")
    camera.close()


def test_a_camera_that_refuses_its_settings_is_released(simulated: GigeCamera) -> None:
    refused = aravis("refused", simulated.address, settings=SIZE | {"format": "Mono12"})
    with pytest.raises(RefusedError):
        refused.connect()
    with aravis("other", simulated.address, settings=SIZE | LIGHT) as camera:
        assert camera.expose().fresh


def test_the_self_test_reports_rate_losses_clock_and_dark_noise(camera: Cam) -> None:
    camera.configure(rate=50.0)
    before = camera.settings
    found = camera.check(10.0)
    assert found["identity"].startswith("Aravis Fake SIM1")
    size, rate = found["frames"].removesuffix(" 1/s").split(", ")
    assert size == "640 × 480"
    assert float(rate) > 0  # how even they arrive is the machine's
    lost, of = map(int, found["dropped"].split(" of "))
    assert of == 12 + lost
    # The library's camera stamps by this machine's clock; from stamp to arrival a frame is drawn and sent.
    offset = float(found["clock"].split("offset at most ")[1].split(" s")[0])
    assert 0 <= offset < 1.0
    assert "from the arrival of frames" in found["clock"]
    assert "noise 0 at the shortest exposure" in found["dark"]
    assert camera.settings == before


def test_a_bench_check_releases_the_camera(simulated: GigeCamera) -> None:
    text = f'''schema = "reseau-bench/1"
name = "cameras"
[instruments.eye]
driver = "aravis"
address = "{simulated.address}"
settings = {{width = 320, height = 240, rate = 50.0, exposure_us = 2000.0}}
'''
    with Bench(BenchFile.parse_toml(text, where="bench.toml")) as bench:
        (checked,) = bench.check(10.0)
    assert (checked.name, checked.driver, checked.error) == ("eye", "aravis", None)
    assert list(checked.found) == ["identity", "frames", "dropped", "clock", "dark"]
    assert checked.found["frames"].startswith("320 × 240, ")
    with aravis("camera", simulated.address, settings=SIZE | LIGHT) as camera:
        assert camera.expose().fresh


def test_only_one_simulated_camera_runs_at_a_time(simulated: GigeCamera) -> None:
    with pytest.raises(UsageError, match="another simulated GigE camera"):
        GigeCamera(SimulatedCamera())


def test_no_answer_raises() -> None:
    with ExitStack() as stack:
        gige_camera(stack, SimulatedCamera()).pull_plug()
        with pytest.raises(InstrumentError, match="camera"):
            aravis("camera", "127.0.0.1").connect(2.0)


class Numbered:
    """Noise whose first pixels are the number of the picture."""

    def __init__(self) -> None:
        self.number = 0
        self.noise = np.random.default_rng(1).integers(0, 256, (2048, 2048), np.uint8)

    def __call__(self, view: View) -> Any:
        self.number += 1
        picture = self.noise.copy()
        picture[0, :4] = np.frombuffer(self.number.to_bytes(4, "little"), np.uint8)
        return picture

    @staticmethod
    def of(pixels: Any) -> int:
        return int.from_bytes(pixels[0, :4].tobytes(), "little")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_thousands_of_large_frames_use_constant_memory_without_damage() -> None:
    """`benchmarks/gige.py` compares rates; here is what must hold, one frame in fifty being lost or torn."""
    count = int(os.environ.get("RESEAU_FRAMES", "5000"))
    sight, script = Numbered(), FaultScript(rate=0.02, seed=3, kinds=("dropped", "truncated", "repeated"))
    settings = {"width": 2048, "height": 2048, "rate": 60.0, "packet_size": 8192, "exposure_us": 10_000.0}
    memory, cpu = [], []
    with ExitStack() as stack:
        address = gige_camera(stack, SimulatedCamera(sight, 2048, 2048, script)).address
        camera = stack.enter_context(aravis("camera", address, settings=settings, seconds=20.0))
        first = camera.expose()
        for _ in range(10):
            used, drawn = time.process_time(), sight.number
            for last in camera.frames(count // 10):
                assert (last.pixels[1:] == sight.noise[1:]).all()
                # Each frame that was drawn has been handed out or counted as lost.
                steps = Numbered.of(last.pixels) - Numbered.of(first.pixels)
                assert last.sequence - first.sequence == steps
            cpu.append((time.process_time() - used) / (sight.number - drawn))
            memory.append(psutil.Process().memory_info().rss / 1e6)
    assert steps == count + last.dropped - first.dropped
    assert last.dropped - first.dropped >= 0.01 * count
    assert memory[-1] - memory[2] < 20.0
    assert np.median(cpu[-3:]) < 1.5 * np.median(cpu[:3])


def _program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"no {name}: apt-get install aravis-tools aravis-tools-cli")
    return found


@pytest.mark.client("arv-tool", "GigE Vision", "features read and set")
def test_aravis_s_own_tool_reads_and_sets_its_features(simulated: GigeCamera) -> None:
    tool = [_program("arv-tool-0.8"), "-a", simulated.address]
    names = ["DeviceID", "DeviceModelName", "Width", "PixelFormat", "ExposureTimeAbs"]
    message = subprocess.run([*tool, "control", *names], capture_output=True, text=True, timeout=30).stdout
    assert "DeviceID = SIM1" in message
    assert "Fake" in message
    subprocess.run([*tool, "control", "Width=320"], capture_output=True, text=True, timeout=30, check=True)
    message = subprocess.run([*tool, "control", "Width"], capture_output=True, text=True, timeout=30).stdout
    assert "Width = 320" in message


@pytest.mark.client("arv-camera-test", "GigE Vision", "frames at a rate, whole")
def test_aravis_s_own_client_receives_whole_frames(simulated: GigeCamera) -> None:
    client = _program("arv-camera-test-0.8")
    options = ["-n", simulated.address, "-w", "640", "-h", "480", "-f", "25", "-d", "stream:0"]
    running = subprocess.Popen(
        [client, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    until, enough = time.monotonic() + 60.0, simulated.frames + 40
    while simulated.frames < enough and time.monotonic() < until:
        time.sleep(0.1)
    running.send_signal(2)
    message = running.communicate(timeout=30)[0]
    whole = int(message.split("n_completed_buffers")[1].split()[1])
    failed = int(message.split("n_failures")[1].split()[1])
    assert whole >= 20
    assert failed <= whole // 20  # what a busy machine loses of packets is its own


@pytest.mark.parametrize("name", GENICAM)
def test_every_format_of_the_convention_is_decoded(name: str) -> None:
    body = SimulatedCamera()
    with ExitStack() as stack:
        (simulated,) = vision_cameras(stack, body)
        settings = {"format": name, "trigger": "software"}
        shot = stack.enter_context(aravis("camera", simulated.address, settings=settings)).expose(10.0)
        away = np.abs(shot.pixels.astype(int) - body.drawn[-1])
        assert away.max() <= (3 if "565" in name else 0)
        assert bool(shot.raw) == name.startswith(("RGB", "BGR", "YUV", "YCb"))


def test_a_stream_has_no_raw_socket_which_would_receive_frames_of_other_cameras() -> None:
    with ExitStack() as stack:
        (simulated,) = vision_cameras(stack, SimulatedCamera())
        camera = stack.enter_context(aravis("camera", simulated.address, settings={"trigger": "software"}))
        camera.expose(10.0)
        raw = {line.split()[-1] for line in Path("/proc/net/packet").read_text().splitlines()[1:]}
        own = {os.readlink(fd) for fd in Path("/proc/self/fd").iterdir() if os.path.islink(fd)}
        assert not {f"socket:[{inode}]" for inode in raw} & own
