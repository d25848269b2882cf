"""Packets of GigE Vision, sent by hand to our driver: chunk data, packets that are lost, frames that lie.

Source: AIA, *GigE Vision* 2.0, sections 14 and 24: leader, payload and trailer of a block. Chunks lie behind
the image, each with its identifier and length at its end.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from reseau.core.errors import DeadlineError, ProtocolError, RefusedError
from reseau.instruments import Deadline
from reseau_drivers.camera import Aravis, AravisSettings, RawFrame, aravis
from reseau_sims.serving import SimulatedCamera

from .rigs import aravis_is_missing, gige_camera

WIDTH, HEIGHT, HALF = 64, 32, 1024
IMAGE = bytes(range(256)) * 8
LEADER, TRAILER, PAYLOAD = 1, 2, 3
MONO8, WITH_CHUNKS = 0x01080001, 0x4001

FEATURES = """
<IntSwissKnife Name="PayloadSize">
<pVariable Name="WIDTH">Width</pVariable><pVariable Name="HEIGHT">Height</pVariable>
<Formula>WIDTH * HEIGHT + 32</Formula></IntSwissKnife>
<Integer Name="ChunkModeActiveInteger"><Value>0</Value></Integer>
<Boolean Name="ChunkModeActive"><pValue>ChunkModeActiveInteger</pValue></Boolean>
<Integer Name="ChunkSelectorInteger"><Value>0</Value></Integer>
<Enumeration Name="ChunkSelector">
<EnumEntry Name="ExposureTime"><Value>0</Value></EnumEntry>
<EnumEntry Name="Gain"><Value>1</Value></EnumEntry>
<pValue>ChunkSelectorInteger</pValue></Enumeration>
<Integer Name="ChunkEnableInteger"><Value>0</Value></Integer>
<Boolean Name="ChunkEnable"><pValue>ChunkEnableInteger</pValue></Boolean>
<FloatReg Name="ChunkExposureTime"><Address>0x0</Address><Length>8</Length><AccessMode>RO</AccessMode>
<pPort>ExposurePort</pPort><Endianess>BigEndian</Endianess></FloatReg>
<FloatReg Name="ChunkGain"><Address>0x0</Address><Length>8</Length><AccessMode>RO</AccessMode>
<pPort>GainPort</pPort><Endianess>BigEndian</Endianess></FloatReg>
<Port Name="ExposurePort"><ChunkID>1001</ChunkID></Port>
<Port Name="GainPort"><ChunkID>1002</ChunkID></Port>
"""


class Sender:
    """Sends blocks to the stream's port, as the simulated camera does, which itself waits for a trigger."""

    def __init__(self, stack: ExitStack) -> None:
        self._socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(5.0)
        # READREG of the stream channel's port, register 0x0D00.
        self._socket.sendto(bytes.fromhex("4201 0080 0004 0007 00000d00"), ("127.0.0.1", 3956))
        answer = self._socket.recv(64)
        assert answer[:8] == bytes.fromhex("0000 0081 0004 0007")
        self._port = int.from_bytes(answer[10:12], "big")

    def send(
        self, block: int, data: bytes, *, leave_out: int = -1, kind: int = 1, width: int = WIDTH
    ) -> None:
        """A block of one leader, its payload in packets of half an image, and a trailer."""
        stamp = time.time_ns()
        head = struct.pack(">HHII", 0, kind, stamp >> 32, stamp & 0xFFFFFFFF)
        head += struct.pack(">IIIIIHH", MONO8, width, HEIGHT, 0, 0, 0, 0)
        parts = [data[:HALF], data[HALF : 2 * HALF], data[2 * HALF :]]
        packets = [(LEADER, head), *((PAYLOAD, part) for part in parts if part)]
        packets.append((TRAILER, struct.pack(">II", kind, HEIGHT)))
        for number, (form, body) in enumerate(packets):
            if number != leave_out:
                packet = struct.pack(">HHI", 0, block, form << 24 | number) + body
                self._socket.sendto(packet, ("127.0.0.1", self._port))


@dataclass
class Wired:
    """Our source of frames, and what sends them."""

    source: Aravis
    sender: Sender

    def taken(self, seconds: float = 5.0) -> RawFrame | None:
        """The next whole frame."""
        deadline = Deadline(seconds)
        while not deadline.expired:
            found = self.source.take(deadline.part(0.1))
            if found is not None:
                return found
        return None


@contextmanager
def wired(features: str = "", **settings: Any) -> Iterator[Wired]:
    with ExitStack() as stack:
        source = Aravis(gige_camera(stack, SimulatedCamera(), features).address)
        stack.callback(source.close)
        deadline = Deadline(20.0)
        source.open(deadline)
        known = {"width": WIDTH, "height": HEIGHT, "packet_size": HALF + 36, "exposure_us": 2000.0}
        # Waiting for a trigger, the library's own camera is silent.
        source.apply(AravisSettings(trigger="software", **known, **settings), deadline)
        source.start(deadline)
        yield Wired(source, Sender(stack))


def test_chunks_contain_exposure_and_gain_of_their_frame(tmp_path: Path) -> None:
    (tmp_path / "features").write_text(FEATURES)
    with wired(str(tmp_path / "features"), chunks="on") as pair:
        for block, exposure, gain in ((1, 1234.5, 6.25), (2, 777.0, 0.5)):
            chunks = struct.pack(">dII", exposure, 0x1001, 8) + struct.pack(">dII", gain, 0x1002, 8)
            pair.sender.send(block, IMAGE + chunks, kind=WITH_CHUNKS)
            taken = pair.taken()
            assert taken is not None
            assert taken.pixels.tobytes() == IMAGE
            assert (taken.exposure_us, taken.gain) == (exposure, gain)


@pytest.mark.parametrize("lost", [0, 1, 2, 3])
def test_a_frame_with_a_missing_packet_is_counted_and_not_returned(lost: int) -> None:
    with wired() as pair:
        pair.sender.send(1, IMAGE)
        assert pair.taken() is not None
        pair.sender.send(2, IMAGE[::-1], leave_out=lost)
        pair.sender.send(3, IMAGE)
        taken = pair.taken()
        assert taken is not None
        assert taken.pixels.tobytes() == IMAGE
        assert (taken.sequence, pair.source.dropped) == (3, 1)


def test_wrapped_repeated_and_missing_blocks_are_distinguished() -> None:
    with wired() as pair:
        numbers = []
        for block in (65534, 65535, 1, 1, 4):
            pair.sender.send(block, IMAGE)
            if (taken := pair.taken(0.5)) is not None:
                numbers.append(taken.sequence)
        # A camera that counts from 1: none is lost between 65535 and 1; 2 and 3 never came.
        assert numbers == [65534, 65535, 65536, 65539]
        assert pair.source.dropped == 2


class _Numbered:
    """A whole buffer of Aravis's, of which only the number is asked."""

    def __init__(self, number: int) -> None:
        self._number = number

    def get_status(self) -> Any:
        from gi.repository import Aravis as library

        return library.BufferStatus.SUCCESS

    def get_frame_id(self) -> int:
        return self._number


@pytest.mark.skipif(bool(aravis_is_missing()), reason=aravis_is_missing())
@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([*range(65530, 65536), *range(1, 6)], 0),  # GigE Vision 1
        ([*range(65530, 65536), *range(6)], 0),  # of cameras that use 0, too
        (range(65530, 65542), 0),  # GigE Vision 2 and USB3 Vision, which do not wrap
        (range(65530, 65542, 3), 6),
    ],
)
def test_frame_numbers_continue_with_any_number_of_bits(numbers: Any, lost: int) -> None:
    source = Aravis("127.0.0.1")
    counted = [source._counted(_Numbered(number)) for number in numbers]
    assert counted[-1] is not None
    assert counted[0] is not None
    assert counted[-1] - counted[0] == len(counted) - 1 + lost
    assert source.dropped == lost


def test_a_frame_of_another_size_is_rejected() -> None:
    with wired() as pair:
        pair.sender.send(1, IMAGE, width=WIDTH // 2)
        with pytest.raises(ProtocolError, match="32×32"):
            pair.taken()


def test_a_camera_without_chunk_data_refuses_chunks() -> None:
    with pytest.raises(RefusedError, match="does not support chunk data"), wired(chunks="on"):
        pass


def test_a_frame_after_a_hardware_trigger_is_fresh_and_an_earlier_one_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with ExitStack() as stack:
        address = gige_camera(stack, SimulatedCamera()).address
        known = {
            "width": WIDTH,
            "height": HEIGHT,
            "packet_size": HALF + 36,
            "exposure_us": 500.0,
            "rate": 500.0,
        }
        camera = stack.enter_context(aravis("camera", address, settings=known | {"trigger": "hardware"}))
        with pytest.raises(DeadlineError, match="is it triggered"):
            camera.expose(0.3)
        camera.connect()
        camera._source.start(Deadline(5.0))
        sender = Sender(stack)
        # A pulse nobody asked for, then one a moment after the question.
        sender.send(1, IMAGE)
        time.sleep(0.1)
        asked, request = threading.Event(), camera._source.request

        def question(deadline: Deadline, ready: Any = None) -> int:
            since = request(deadline, ready)
            asked.set()
            return since

        def pulse() -> None:
            asked.wait(5.0)
            time.sleep(0.05)
            sender.send(2, IMAGE[::-1])

        monkeypatch.setattr(camera._source, "request", question)
        pulsing = threading.Thread(target=pulse)
        pulsing.start()
        shot = camera.expose(5.0)
        pulsing.join()
        assert shot.fresh
        assert shot.pixels.tobytes() == IMAGE[::-1]
        assert shot.dropped == 0
