"""The driver of V4L2 at a real node of the kernel, whose frames are ours."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import InstrumentError, ProtocolError, RefusedError
from reseau_drivers.camera import v4l2, video_devices

from .gadget import settle
from .lab import steer, value

FORMATS = {"GREY": "GREY", "Y10": "Y10 ", "Y12": "Y12 ", "Y16": "Y16 ", "YUYV": "YUYV"}
WORLD = -1
PATIENCE_S = 20.0
"""After a change until it is seen: frames go through the loop's buffers, slowly in emulation."""


@pytest.fixture(params=list(FORMATS))
def looped(request: pytest.FixtureRequest) -> Iterator[tuple[str, str]]:
    yield steer("start_camera", FORMATS[request.param]), request.param
    assert not value("camera.failed")
    steer("stop_camera")


@pytest.fixture
def grey() -> Iterator[str]:
    yield steer("start_camera", "GREY")
    steer("stop_camera")


def _seen(camera: Any, shift: int) -> None:
    """Wait until the stripes of this shift, or the world, are seen, to the bit."""
    wanted = steer("picture", shift)
    until = time.monotonic() + PATIENCE_S
    while not np.array_equal(pixels := camera.expose().pixels, wanted):
        if time.monotonic() > until:
            wrong = np.count_nonzero(pixels != wanted, axis=1)
            told = f"rows {np.flatnonzero(wrong)[[0, -1]]}, grey values {pixels.min()} to {pixels.max()}"
            raise AssertionError(f"{wrong.sum()} pixels differ: {told}; loop: {value('camera.state')}")


def test_frames_equal_the_drawn_image(looped: tuple[str, str]) -> None:
    node, name = looped
    with v4l2("camera", node, settings={"format": name}) as camera:
        for shift in (0, 9, WORLD):
            steer("point_at", shift)
            _seen(camera, shift)
        shot = camera.expose()
        assert shot.full_scale == {"Y10": 1023, "Y12": 4095, "Y16": 65535}.get(name, 255)
        assert shot.pattern == ("YUYV" if name == "YUYV" else "")
        if name in ("GREY", "Y16"):
            drawn = np.load(Path(os.environ["RIG_OUT"], "world.npy"))
            assert (shot.pixels == drawn * np.uint16(257 if name == "Y16" else 1)).all()


def test_brightness_and_gain_act_on_the_picture(grey: str) -> None:
    with v4l2("camera", grey) as camera:
        steer("point_at", 3)
        seen = []
        for changes in ({}, {"brightness": 138}, {"brightness": 128, "gain": 60.0}, {"gain": 0.0}):
            camera.configure(**changes)
            _seen(camera, 3)
            seen.append(camera.expose().pixels.astype(float))
    plain, brighter, amplified, again = seen
    assert (brighter == plain + 10).all()
    assert amplified.mean() == pytest.approx(10 ** (6 / 20) * plain.mean(), rel=0.01)
    assert (again == plain).all()


@pytest.mark.parametrize("source", ["End of Frame", "Start of Exposure"])
def test_frames_are_fresh_with_an_uncertainty_of_their_time(grey: str, source: str) -> None:
    with v4l2("camera", grey) as camera:
        steer("camera._choose", "Timestamp Source", source)
        for _ in range(5):
            asked = datetime.now(UTC)
            shot = camera.expose()
            assert shot.fresh
            assert (shot.taken - asked).total_seconds() + shot.taken_within_s >= 0
            assert shot.taken <= datetime.now(UTC)
        assert (shot.taken_within_s < 1e-3) == (source == "Start of Exposure")
        steer("camera._choose", "Timestamp Source", "End of Frame")


def test_lost_frames_are_counted(grey: str) -> None:
    with v4l2("camera", grey) as camera:
        camera.expose()
        steer("camera._set", "Percentage of Dropped Buffers", 50)
        try:
            shots = list(camera.frames(20))
        finally:
            steer("camera._set", "Percentage of Dropped Buffers", 0)
    gaps = sum(b.sequence - a.sequence - 1 for a, b in pairwise(shots))
    assert shots[-1].dropped - shots[0].dropped == gaps > 0


def test_frame_numbers_wrap_without_a_gap(grey: str) -> None:
    # The virtual driver begins at −128 then.
    with v4l2("camera", grey) as camera:
        camera.stop()
        steer("camera._set", "Wrap Sequence Number", 1)
        try:
            shots = list(camera.frames(150))
        finally:
            steer("camera._set", "Wrap Sequence Number", 0)
    assert shots[0].sequence < 1 << 32 <= shots[-1].sequence
    steps = shots[-1].sequence - shots[0].sequence
    assert steps == 149 + shots[-1].dropped - shots[0].dropped
    assert steps < 1000


@pytest.mark.parametrize("button", ["Inject VIDIOC_STREAMON Error", "Inject Fatal Streaming Error"])
def test_faults_of_the_driver_raise_and_are_recovered(grey: str, button: str) -> None:
    with v4l2("camera", grey) as camera:
        camera.expose()
        if "STREAMON" in button:
            camera.stop()
        steer("camera._set", button, 1)
        with pytest.raises(InstrumentError) as caught:
            camera.expose(2.0)
        assert caught.value.instrument == "camera"
        if "Fatal" in button:
            assert isinstance(caught.value, ProtocolError)
        assert camera.expose().fresh


def test_a_second_process_is_refused_without_effect(grey: str) -> None:
    program = (
        "from reseau_drivers.camera import v4l2\n"
        "from reseau.core.errors import RefusedError\n"
        f"try: v4l2('other', {grey!r}).connect()\n"
        "except RefusedError as error: print(error)\n"
    )
    with v4l2("camera", grey) as camera:
        before = camera.expose()
        other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=50)
        assert "another process" in other.stdout, other.stderr
        assert camera.expose().sequence > before.sequence


def test_the_self_test_passes(grey: str) -> None:
    with v4l2("camera", grey) as camera:
        found = camera.check(10.0)
    assert found["identity"].startswith("vivid vivid")
    assert found["frames"].startswith("640 × 480, ")


def test_unsupported_settings_are_refused(grey: str) -> None:
    with v4l2("camera", grey) as camera:
        with pytest.raises(RefusedError, match="no control for the exposure time"):
            camera.configure(exposure_us=1000.0)
        with pytest.raises(RefusedError, match="brightness 999 is outside 0…255"):
            camera.configure(brightness=999)
        assert camera.expose().fresh


def test_the_nodes_are_found(grey: str) -> None:
    assert grey in {os.path.realpath(path) for path in video_devices()}


def test_v4l2_ctl_reports_the_settings_of_the_driver(grey: str) -> None:
    if shutil.which("v4l2-ctl") is None:
        pytest.skip("no v4l2-ctl on the host: apt-get install v4l-utils")
    with v4l2("camera", grey, settings={"brightness": 77}) as camera:
        camera.expose()
        said = subprocess.run(
            ["v4l2-ctl", "-d", grey, "--get-fmt-video", "--get-ctrl=brightness"],
            capture_output=True,
            text=True,
        ).stdout
    assert "640/480" in said
    assert "'GREY'" in said
    assert "brightness: 77" in said


def test_v4l2_ctl_captures_the_same_frame(grey: str, tmp_path: Any) -> None:
    if shutil.which("v4l2-ctl") is None:
        pytest.skip("no v4l2-ctl on the host: apt-get install v4l-utils")
    steer("point_at", 17)
    with v4l2("camera", grey, settings={"brightness": 128, "gain": 0.0}) as camera:
        _seen(camera, 17)
        camera.stop()
    file = tmp_path / "frame"
    options = ["--stream-mmap=4", "--stream-skip=20", "--stream-count=1", f"--stream-to={file}"]
    subprocess.run(["v4l2-ctl", "-d", grey, *options], check=True, capture_output=True, timeout=50)
    wanted = steer("picture", 17)
    assert file.read_bytes() == wanted.tobytes()


def test_settings_are_restored_after_unplugging(grey: str) -> None:
    with v4l2("camera", grey, settings={"brightness": 140}) as camera:
        camera.expose()
        steer("camera._set", "Disconnect", 1)
        for _ in range(2):
            with pytest.raises(InstrumentError) as caught:
                camera.expose(3.0)
            assert caught.value.instrument == "camera"
        # The virtual driver stays disconnected until it is loaded anew.
        steer("stop_camera")
        busybox, line = "/run/busybox", Path("/proc/cmdline").read_text().split()
        options = next(word for word in line if word.startswith("rig.mod.vivid=")).split("=", 1)[1].split(",")
        subprocess.run([busybox, "rmmod", "vivid"], check=True)
        subprocess.run([busybox, "insmod", "/run/modules/vivid.ko", *options], check=True)
        settle()
        assert steer("start_camera", "GREY") == grey
        steer("point_at", 31)
        camera.expose()  # it is set as before by then; the first frames through the loop are older than that
        assert value("camera.view").offset == 12.0
        _seen(camera, 31)
        assert camera.reconnections >= 2
