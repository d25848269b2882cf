"""What is safe with a camera: fresh, whole, counted; settings checked; shared; unplugged and plugged in."""

from __future__ import annotations

import importlib
import itertools
import math
import re
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import (
    ConnectionLost,
    DeadlineError,
    ProtocolError,
    RefusedError,
    SettingError,
    StateError,
    UsageError,
)
from reseau.instruments import Camera
from reseau_drivers import camera as cameras
from reseau_drivers.camera import V4l2Settings, v4l2
from reseau_drivers.camera.clocks import ExposureTimes
from reseau_drivers.codecs import v4l2 as uapi
from reseau_drivers.codecs.pixels import VIDEO
from reseau_sims import World
from reseau_sims.serving import Fault, SimulatedCamera, StillScene, StripeScene, VideoCamera, View

Cam = cameras.CameraDriver[V4l2Settings]


@pytest.fixture
def device() -> VideoCamera:
    return VideoCamera(SimulatedCamera())


@pytest.fixture
def camera(device: VideoCamera) -> Iterator[Cam]:
    with v4l2("camera", device.open, settings={"exposure_us": 2000.0}, seconds=1.0) as made:
        yield made
    assert device.body.violations == []


def test_the_driver_satisfies_the_camera_protocol(camera: Cam) -> None:
    assert isinstance(camera, Camera)


@pytest.mark.parametrize("stamps", [{}, {"start_of_exposure": True}, {"webcam": True}])
def test_exposures_start_after_the_request(stamps: dict[str, bool]) -> None:
    device = VideoCamera(SimulatedCamera(), **stamps)
    with v4l2("camera", device.open, settings={"exposure_us": 3000.0, "rate": 200.0}) as camera:
        for shift in range(30):
            pattern = StripeScene(shift=shift)
            time.sleep(0.012)  # frames of the pattern of before wait in the queue
            device.body.point_at(pattern)
            asked = datetime.now(UTC)
            shot = camera.expose()
            assert shot.fresh
            assert (shot.pixels == pattern(device.view)).all()
            # The truth lies in the interval that is told.
            assert (shot.taken - asked).total_seconds() + shot.taken_within_s >= 0
        assert camera.skipped > 0
        assert device.body.violations == []


def test_the_time_of_an_exposure_has_an_uncertainty() -> None:
    for at_start, within in ((True, 1e-4), (False, 6e-3)):
        device = VideoCamera(SimulatedCamera(), start_of_exposure=at_start)
        with v4l2("camera", device.open, settings={"exposure_us": 2000.0}) as camera:
            shot = camera.expose()
            assert 0 < shot.taken_within_s < within
            assert abs((datetime.now(UTC) - shot.taken).total_seconds()) < 1.0


def test_webcam_stamps_are_not_taken_as_starts_of_exposures() -> None:
    # The kernel's driver says that they are; they are when the first packet of a frame came.
    device = VideoCamera(SimulatedCamera(), webcam=True)
    with v4l2("camera", device.open, settings={"exposure_us": 2000.0, "rate": 100.0}) as camera:
        assert camera.expose().taken_within_s == pytest.approx(6e-3, abs=1e-3)
        assert "first packet" in camera.check(5.0)["clock"]


def test_a_series_has_every_frame_once_with_its_freshness(device: VideoCamera, camera: Cam) -> None:
    camera.expose()
    time.sleep(0.1)  # as many frames as there are buffers wait now; what came besides is lost
    shots = list(camera.frames(12))
    numbers = [shot.sequence for shot in shots]
    assert numbers == sorted(set(numbers))
    assert not shots[0].fresh
    assert shots[-1].dropped - shots[0].dropped == numbers[-1] - numbers[0] - 11
    assert shots[-1].dropped >= 3


@pytest.mark.parametrize("name", [name for name in VIDEO if name != "MJPEG"])
def test_frames_are_bit_exact_with_their_colour_pattern(device: VideoCamera, name: str) -> None:
    with v4l2("camera", device.open, settings={"format": name, "exposure_us": 2000.0}) as camera:
        shot = camera.expose()
        away = np.abs(shot.pixels.astype(int) - StripeScene()(device.view))
        assert away.max() <= (3 if name == "RGB565" else 0)
        bits = (
            int(found[0]) if name not in ("NV12", "RGB565") and (found := re.findall("1[0246]", name)) else 8
        )
        assert shot.full_scale == 2**bits - 1
        mosaic = name[1:5] if name.startswith("S") else ""
        coloured = {"RGB24": "RGB", "BGR24": "BGR", "RGB565": "BGR"}
        coloured |= {each: each for each in ("YUYV", "UYVY", "NV12")}
        assert shot.pattern == coloured.get(name, mosaic)
        assert shot.frame.pixels is shot.pixels
        assert shot.frame.filters == mosaic
        assert bool(shot.raw) == (name in coloured)


@pytest.mark.slow
def test_frames_equal_the_simulated_image() -> None:
    frame = World.standard(seed=5).photo_i()
    device = VideoCamera(SimulatedCamera(StillScene(frame), frame.width, frame.height))
    with v4l2("camera", device.open, settings={"exposure_us": 10_000.0}, seconds=10.0) as camera:
        assert camera.expose().frame.sha256 == frame.sha256
        camera.configure(format="Y16")
        assert (camera.expose().pixels == frame.pixels * np.uint16(257)).all()


def test_a_compressed_frame_keeps_its_file(device: VideoCamera) -> None:
    with v4l2("camera", device.open, settings={"format": "MJPEG", "exposure_us": 2000.0}) as camera:
        shot = camera.expose()
        assert shot.pattern == "MJPEG"
        assert shot.raw.startswith(b"\xff\xd8")
        expected = StripeScene()(device.view).astype(float)
        assert np.sqrt(((shot.pixels - expected) ** 2).mean()) < 8


def test_exposure_gain_brightness_and_region_act_on_the_picture(device: VideoCamera, camera: Cam) -> None:
    before = camera.expose().pixels.astype(float)
    camera.configure(exposure_us=4000.0)
    assert camera.expose().pixels.mean() == pytest.approx(2 * before.mean(), rel=0.03)
    camera.configure(exposure_us=2000.0, gain=6)
    assert camera.expose().pixels.mean() == pytest.approx(10**0.3 * before.mean(), rel=0.03)
    camera.configure(gain=0, brightness=138)
    assert (camera.expose().pixels == before + 10).all()
    camera.configure(brightness=128, left=8, top=4, width=32, height=16)
    assert (camera.expose().pixels == before[4:20, 8:40]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gain": 99.0}, "gain 99 is outside 0…24"),
        ({"exposure_us": 2e6}, "is outside 1…10000"),
        ({"brightness": 300}, "brightness 300 is outside 0…255"),
        ({"width": 4000}, "delivers 96×64 GREY, not 4000×64"),
        ({"rate": 5000.0}, "frames in a second"),
        ({"left": 8, "top": 4, "width": 32, "height": 16, "rate": 50.0, "gain": 99.0}, "gain 99 is outside"),
        ({"gain": 3.0, "brightness": 300}, "brightness 300 is outside 0…255"),
    ],
)
def test_unsupported_settings_raise_and_change_nothing(
    device: VideoCamera, camera: Cam, changes: dict[str, Any], message: str
) -> None:
    camera.expose()
    before, view = camera.settings, device.view
    with pytest.raises(RefusedError, match=message):
        camera.configure(**changes)
    assert (camera.settings, device.view) == (before, view)
    assert camera.expose().fresh
    assert camera.reconnections == 1


def test_default_settings_restore_the_original_values(device: VideoCamera, camera: Cam) -> None:
    camera.configure(exposure_us=0.0)
    device.controls[uapi.GAIN] = 7
    before, period = device.view, device.period
    changes: dict[str, Any] = {"exposure_us": 4000.0, "gain": 3.0, "brightness": 99, "rate": 50.0}
    changes |= {"left": 8, "top": 4, "width": 32, "height": 16}
    camera.configure(**changes)
    assert camera.expose().pixels.shape == (16, 32)
    camera.configure(**{name: getattr(V4l2Settings(), name) for name in changes})
    assert (device.view, device.period) == (before, period)
    assert camera.expose().pixels.shape == (64, 96)


def test_a_camera_that_refuses_its_first_settings_is_closed(device: VideoCamera) -> None:
    refused = v4l2("refused", device.open, settings={"gain": 99.0})
    with pytest.raises(RefusedError, match="gain 99 is outside"):
        refused.connect()
    assert device.nodes == 0


def test_invalid_settings_raise_before_anything_is_sent(camera: Cam) -> None:
    for changes in ({"format": "RGB"}, {"exposure_us": -1.0}, {"colour": 3}, {"width": 1.5}):
        with pytest.raises(SettingError):
            camera.configure(**changes)


def test_settings_are_restored_after_unplugging(device: VideoCamera, camera: Cam) -> None:
    camera.configure(gain=6, exposure_us=1000.0)
    camera.expose()
    device.plugged_in = False
    device.unplug(power=True)
    with pytest.raises(ConnectionLost, match="camera"):
        camera.expose()
    device.plugged_in = True
    assert camera.expose().exposure_us == 1000.0
    assert (device.view.gain_db, device.view.exposure_us) == (6.0, 1000.0)
    assert camera.reconnections == 2


def test_a_camera_of_another_process_is_refused_and_unchanged(device: VideoCamera, camera: Cam) -> None:
    first = camera.expose()
    other = v4l2("other", device.open)
    with pytest.raises(RefusedError, match="another process"):
        other.connect()
    other.close()
    assert camera.expose().sequence > first.sequence
    camera.stop()
    with v4l2("other", device.open, settings={"exposure_us": 1000.0}) as taken_over:
        assert taken_over.expose().fresh
        with pytest.raises(RefusedError, match="another process"):
            camera.expose()


@pytest.mark.parametrize(
    ("kind", "lost"), [("dropped", 1), ("truncated", 1), ("corrupted", 1), ("repeated", 0), ("late", None)]
)
def test_lost_and_damaged_frames_are_counted_and_not_returned(
    device: VideoCamera, camera: Cam, kind: Any, lost: int | None
) -> None:
    script = device.body.script
    camera.expose()
    before = next(camera.frames(1))
    script.fault_at(script.count + 2, Fault(kind, 0.02))
    shots = list(camera.frames(6))
    assert [fault.kind for fault in script.happened] == [kind]
    expected = StripeScene()(device.view)
    assert all((shot.pixels == expected).all() for shot in shots)
    steps = shots[-1].sequence - before.sequence
    assert steps == 6 + shots[-1].dropped - before.dropped
    if lost is not None:
        # A busy machine queues buffers too late.
        assert lost <= shots[-1].dropped - before.dropped <= lost + device.overruns


def test_a_stuck_camera_raises_in_time_and_restarts(device: VideoCamera, camera: Cam) -> None:
    camera.expose()
    device.body.script.fault_at(device.body.script.count, Fault("stuck"))
    with pytest.raises(DeadlineError, match="no new frame within"):
        camera.expose(0.3)
    assert camera.expose().fresh


def test_a_stamp_in_the_future_is_rejected(device: VideoCamera, camera: Cam) -> None:
    camera.expose()
    device.body.script.fault_at(device.body.script.count + 1, Fault("out of range"))
    with pytest.raises(ProtocolError, match="from now"):
        list(camera.frames(9))
    assert camera.expose().fresh


def test_frame_numbers_of_32_bits_wrap_without_a_gap() -> None:
    device = VideoCamera(SimulatedCamera(), first=(1 << 32) - 3)
    with v4l2("camera", device.open, settings={"exposure_us": 2000.0}) as camera:
        numbers = [shot.sequence for shot in camera.frames(8)]
        assert [b - a for a, b in itertools.pairwise(numbers)] == [1] * 7


def test_an_exposure_longer_than_the_deadline_ends_in_time(camera: Cam) -> None:
    camera.configure(exposure_us=1e6)
    began = time.monotonic()
    with pytest.raises(DeadlineError):
        camera.expose(0.3)
    assert time.monotonic() - began < 1.0


def test_stop_from_another_thread_ends_an_exposure(device: VideoCamera, camera: Cam) -> None:
    camera.configure(exposure_us=1e6)

    def stop() -> None:
        while device.stream is None or not device.stream.on:
            time.sleep(0.001)  # before that there is nothing to stop, and the exposure would begin anew
        camera.stop()

    stopping = threading.Thread(target=stop)
    stopping.start()
    with pytest.raises(StateError, match="was stopped"):
        camera.expose(5.0)
    stopping.join()


def test_the_self_test_reports_rate_losses_clock_and_dark_noise(device: VideoCamera, camera: Cam) -> None:
    camera.configure(rate=50.0)
    before = camera.settings
    found = camera.check(5.0)
    assert found["identity"].startswith("simulated Simulated camera")
    assert found["frames"].startswith("96 × 64, 50 1/s")
    assert found["dropped"] == "0 of 12"
    assert "offset 0 s" in found["clock"]
    assert "noise 0 at the shortest exposure" in found["dark"]
    assert camera.settings == before


class _Noisy:
    """Light of 1000 grey values at 10 ms, on a dark level of 50 with a noise of 3."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(8)

    def __call__(self, view: View) -> Any:
        noise = self._rng.normal(0.0, 3.0, (view.height, view.width))
        return np.rint(50 + 1000 * view.light + noise).astype(np.uint16)


def test_the_self_test_measures_known_noise(device: VideoCamera, camera: Cam) -> None:
    device.body.point_at(_Noisy())
    camera.configure(format="Y16", rate=50.0)
    script = device.body.script
    script.fault_at(script.count + 3, Fault("dropped"))
    script.fault_at(script.count + 5, Fault("corrupted"))
    found = camera.check(5.0)
    assert found["dropped"] == "2 of 14"
    mean, noise = (float(word) for word in re.findall(r"[\d.]+", found["dark"]))
    # The shortest exposure is 100 µs: a hundredth of that light. Rounding to grey values adds its noise.
    assert mean == pytest.approx(60.0, abs=0.5)
    assert noise == pytest.approx(np.hypot(3.0, 12**-0.5), abs=0.15)


def test_a_reading_has_the_form_of_bluesky(camera: Cam) -> None:
    camera.trigger().wait(2.0)
    reading, kinds = camera.read(), camera.describe()
    assert {*reading, "camera_image"} == set(kinds)
    assert kinds["camera_image"]["shape"] == [1, 64, 96]
    assert camera.get_index() == 1
    assert camera.hints == {"fields": ["camera_sequence", "camera_dropped"]}


def test_a_missing_node_or_one_that_is_not_a_camera_raises() -> None:
    with pytest.raises(ConnectionLost, match="cannot be opened"):
        v4l2("camera", "/dev/no-such-video").connect()
    with pytest.raises(RefusedError, match="query"):
        v4l2("camera", "/dev/null").connect()


def test_missing_aravis_raises_with_instructions(monkeypatch: pytest.MonkeyPatch) -> None:
    library = importlib.import_module("reseau_drivers.camera.aravis")._library
    library.cache_clear()
    monkeypatch.setitem(sys.modules, "gi", None)
    message = r"Aravis is not installed .*; install gir1.2-aravis-0.8, and pip install 'reseau\[aravis\]'"
    with pytest.raises(UsageError, match=message):
        cameras.aravis_cameras()
    with pytest.raises(UsageError, match=message):
        cameras.aravis("camera", "127.0.0.1").connect()
    library.cache_clear()


class _Clocked:
    """What is asked of Aravis's camera for its clock, which is an hour ahead and runs, or stands still."""

    def __init__(self, name: str, *, runs: bool) -> None:
        self._latch, self._runs, self._value = name, runs, 0

    def is_feature_available(self, name: str) -> bool:
        return name in (
            self._latch,
            {"TimestampLatch": "TimestampLatchValue"}.get(self._latch, "GevTimestampValue"),
        )

    def execute_command(self, name: str) -> None:
        assert name == self._latch
        if self._runs:
            self._value = time.monotonic_ns() + 3_600_000_000_000

    def get_integer(self, name: str) -> int:
        assert self.is_feature_available(name)
        return self._value


@pytest.mark.parametrize("name", ["TimestampLatch", "GevTimestampControlLatch"])
def test_the_clock_of_a_camera_is_read_if_possible(name: str) -> None:
    source = cameras.Aravis("127.0.0.1")
    source._camera = _Clocked(name, runs=True)
    found = source._latched()
    assert found is not None
    offset, doubt = found
    assert abs(offset + 3_600_000_000_000) <= doubt < 50_000_000
    source._camera = _Clocked(name, runs=False)
    assert source._latched() is None
    source._camera = _Clocked("", runs=False)
    assert source._latched() is None
    source._camera = None


def test_unknown_exposure_and_period_widen_the_interval() -> None:
    device = VideoCamera(SimulatedCamera())
    # In automatic mode the exposure may be as long as the period, and it is not told.
    with v4l2("camera", device.open) as camera:
        shot = camera.expose()
        assert math.isnan(shot.exposure_us)
        assert shot.taken_within_s == pytest.approx(0.01, abs=1e-3)
    device.period = uapi.Interval(0, 0)
    with v4l2("camera", device.open) as camera, pytest.raises(DeadlineError, match="may have started before"):
        camera.expose(0.4)


def test_a_camera_whose_clock_begins_anew_gets_no_wrong_times() -> None:
    """Its stamps fall back after it was reset: the offset that was read before is void."""
    ms = 1_000_000
    times = ExposureTimes()
    times.restart(period=40 * ms)
    times.offset, times.read_at = (500 * ms, 1000), 1000 * ms
    before = times.began(1000 * ms, 1512 * ms, before=0, exposure=10 * ms)
    assert before.earliest <= 1500 * ms <= before.latest
    true = 2500 * ms  # when the exposure of the next frame began, by the computer's clock
    after = times.began(3 * ms, true + 12 * ms, before=0, exposure=10 * ms)
    assert after.earliest <= true <= after.latest
    assert times.offset is None


class _Fields:
    """A node whose driver chooses the order of fields itself, of the format or of a buffer (Motion#1548)."""

    def __init__(self, node: Any, request: int, at: int, order: int) -> None:
        self._node, self._request, self._at, self._order = node, request, at, order

    def ioctl(self, request: int, data: bytearray) -> None:
        self._node.ioctl(request, data)
        if request == self._request:
            data[self._at : self._at + 4] = self._order.to_bytes(4, "little")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._node, name)


@pytest.mark.parametrize(("request_", "at"), [(uapi.S_FMT, 20), (uapi.DQBUF, 16)], ids=["format", "buffer"])
@pytest.mark.parametrize("order", range(11))
def test_fields_are_not_taken_for_frames(device: VideoCamera, request_: int, at: int, order: int) -> None:
    """Numbers of videodev2.h: 0 any, 1 none, then 2…9 fields; 10 is none of them."""
    camera = v4l2("camera", lambda: _Fields(device.open(), request_, at, order), seconds=1.0)
    try:
        if order > 1:
            with pytest.raises(RefusedError, match=r"delivers fields, not whole frames .*progressive"):
                camera.expose()
        else:
            assert camera.expose().frame.pixels.shape == (64, 96)
    finally:
        camera.close()
