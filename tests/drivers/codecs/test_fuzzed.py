"""Every codec against everything: what is encoded comes back, however it is cut; garbage costs little."""

from __future__ import annotations

import itertools
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs import (
    apt,
    bk,
    compactpulser,
    gcode,
    hislip,
    ieee488,
    modbus,
    ping,
    rpc,
    smc100,
    usbtmc,
    vxi11,
    zaber,
)
from reseau_drivers.codecs.sentence import Sentence
from reseau_drivers.codecs.stream import Damaged, LineDecoder

Decoders = dict[str, Callable[[], Any]]

STREAMS: Decoders = {
    "lines": LineDecoder,
    "zaber": zaber.MessageDecoder,
    "ping": ping.FrameDecoder,
    "bk": bk.MessageDecoder,
    "rpc": rpc.RecordDecoder,
    "hislip": hislip.MessageDecoder,
    "apt": apt.MessageDecoder,
    "gcode": gcode.AnswerDecoder,
    "modbus-rtu": modbus.RtuDecoder,
    "modbus-tcp": modbus.TcpDecoder,
}
words = st.text(
    st.characters(min_codepoint=33, max_codepoint=126, exclude_characters="/:\\"), min_size=1, max_size=30
)
device, axis, number = st.integers(0, 99), st.integers(0, 9), st.none() | st.integers(0, 99)
flags = st.sampled_from(["--", "WR", "FS", "NI"])
zaber_messages = st.one_of(
    st.builds(zaber.Reply, device, axis, number, st.booleans(), st.booleans(), flags, words),
    st.builds(zaber.Info, device, axis, number, words.filter(lambda w: not w[0].isdigit())),
    st.builds(zaber.Alert, device, axis, st.booleans(), flags, words),
)
ping_frames = st.builds(
    ping.Frame, st.integers(0, 65535), st.binary(max_size=300), st.integers(0, 255), st.integers(0, 255)
)
hislip_messages = st.builds(
    hislip.Message,
    st.integers(0, 255),
    st.integers(0, 255),
    st.integers(0, 2**32 - 1),
    st.binary(max_size=99),
)
apt_messages = st.one_of(
    st.builds(
        apt.Message, st.sampled_from(["HOME", "HOMED", "STOP"]), st.just(apt.HOST),
        st.sampled_from([apt.USB, 0x21]), st.tuples(st.integers(0, 9), st.integers(0, 255)),
    ),
    st.builds(
        apt.Message, st.sampled_from(["STATUS", "DC_STATUS"]), st.just(apt.HOST), st.just(apt.USB),
        data=st.binary(min_size=14, max_size=14),
    ),
)  # fmt: skip
modbus_answers = st.builds(
    modbus.encode_registers, st.sampled_from([3, 4]), st.lists(st.integers(0, 65535), max_size=125)
)
rtu_frames = st.builds(modbus.Frame, st.integers(1, 247), modbus_answers)
tcp_frames = st.builds(modbus.Frame, st.integers(1, 247), modbus_answers, st.integers(0, 65535))
SPOKEN: dict[str, tuple[Any, Callable[[Any], bytes]]] = {
    "zaber": (zaber_messages, zaber.encode),
    "ping": (ping_frames, ping.encode),
    "bk": (st.binary(max_size=300), bk.encode),
    "rpc": (st.binary(max_size=300), rpc.record),
    "hislip": (hislip_messages, hislip.encode),
    "apt": (apt_messages, apt.encode),
    "modbus-rtu": (rtu_frames, modbus.encode),
    "modbus-tcp": (tcp_frames, modbus.encode),
}


def pieces(stream: bytes, cuts: list[int]) -> list[bytes]:
    at = sorted({0, len(stream), *(cut % (len(stream) + 1) for cut in cuts)})
    return [stream[a:b] for a, b in itertools.pairwise(at)]


@pytest.mark.parametrize("name", SPOKEN)
@given(data=st.data())
def test_messages_are_decoded_from_pieces_of_any_size(name: str, data: st.DataObject) -> None:
    messages, encode = SPOKEN[name]
    spoken = data.draw(st.lists(messages, min_size=1, max_size=5))
    decoder, heard = STREAMS[name](), []
    for piece in pieces(
        b"".join(map(encode, spoken)), data.draw(st.lists(st.integers(0, 10**6), max_size=8))
    ):
        heard += decoder.feed(piece)
    assert heard == spoken


@pytest.mark.parametrize("name", STREAMS)
@given(garbage=st.lists(st.binary(max_size=200), max_size=10))
def test_noise_does_not_raise(name: str, garbage: list[bytes]) -> None:
    decoder = STREAMS[name]()
    for piece in garbage:
        for found in decoder.feed(piece):
            assert found is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["zaber", "ping", "bk", "apt", "modbus-rtu"])
@given(garbage=st.binary(max_size=100), data=st.data())
def test_decoders_recover_after_noise(name: str, garbage: bytes, data: st.DataObject) -> None:
    messages, encode = SPOKEN[name]
    message = data.draw(messages)
    decoder = STREAMS[name]()
    decoder.feed(garbage)
    # A length in the garbage may swallow what follows, but no more than the longest message.
    heard: list[Any] = []
    for _ in range(2 + 2100 // len(encode(message))):
        heard += decoder.feed(encode(message))
    assert heard[-1] == message
    assert sum(not isinstance(found, Damaged) for found in heard) >= 1


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize(
    "piece", [b"x", b"\x01\x01", b"BR\xff\x0f\x00\x00", b"\x7f\xff\xff\xff", b"HS\x07\x00", b"@"]
)
def test_an_endless_message_uses_bounded_memory(name: str, piece: bytes) -> None:
    decoder, chunk = STREAMS[name](), (piece * 65536)[:65536]
    kept = 0
    for fed in range(160):
        decoder.feed(chunk)
        kept = max(kept, sum(len(v) for v in vars(decoder).values() if isinstance(v, bytes | bytearray)))
        # What has kept less than a chunk of five takes none for the begin of a message.
        if fed == 4 and kept < len(chunk):
            break
    assert kept < 8.6e6


def test_an_announced_length_allocates_nothing() -> None:
    tracemalloc.start()
    try:
        hislip.MessageDecoder().feed(b"HS\x07\x00" + bytes(4) + b"\xff" * 8)
        rpc.RecordDecoder().feed(b"\xff\xff\xff\xff")
        ping.FrameDecoder().feed(b"BR\xff\xff" + bytes(4))
        with pytest.raises(ProtocolError):
            rpc.Unpacker(b"\xff\xff\xff\xff").opaque()
        with pytest.raises(ProtocolError):
            ieee488.missing_bytes(b"#9999999999")
        assert tracemalloc.get_traced_memory()[1] < 1e5
    finally:
        tracemalloc.stop()


@given(data=st.binary(max_size=200))
def test_decoding_one_message_returns_a_value_or_raises_protocol_error(data: bytes) -> None:
    for decode in (
        zaber.decode,
        zaber.decode_command,
        smc100.decode,
        lambda line: smc100.decode_status(line.decode("latin-1")),
        compactpulser.decode,
        ping.Transducer.parse,
        ping.DeviceData.parse,
        ping.Information.parse,
        lambda content: bk.parse_frame(content, 8),
        lambda line: bk.numbers(line, "US_WIN_SIZE"),
        usbtmc.decode,
        ieee488.missing_bytes,
        ieee488.parse_block,
        ieee488.picture,
        lambda line: ieee488.error_entry(line.decode("latin-1")),
        rpc.decode_call,
        rpc.decode_reply,
        vxi11.WriteParameters.parse,
        vxi11.ReadParameters.parse,
        gcode.decode,
        gcode.decode_numbered,
        modbus.decode_read,
        Sentence(r"T=(?P<t>\S+)").values,
        Sentence(r"T=(?P<t>\S+)", "xor").values,
    ):
        with suppress(ProtocolError):
            decode(data)  # type: ignore[no-untyped-call]


@given(message=zaber_messages)
def test_a_flipped_bit_never_decodes_as_another_zaber_message(message: zaber.Message) -> None:
    sent = zaber.encode(message)
    for at in range(1, len(sent) - 2):
        flipped = sent[:at] + bytes([sent[at] ^ 1]) + sent[at + 1 :]
        for found in zaber.MessageDecoder().feed(flipped):
            assert isinstance(found, Damaged) or found == message or b":" not in flipped


@given(frame=ping_frames, samples=st.binary(max_size=1200))
def test_ping_messages_round_trip(frame: ping.Frame, samples: bytes) -> None:
    asked = ping.Transducer(1, 399, 1000, 40000, 740, len(samples), transmit=False)
    assert ping.DeviceData.parse(ping.DeviceData(asked, samples).frame().payload) == ping.DeviceData(
        asked, samples
    )
    assert ping.FrameDecoder().feed(b"noise B" + ping.encode(frame))[-1] == frame


@given(header=st.sampled_from([":HARDcopy:INKSaver", ":WAVeform:DATA?", "CH<n>:SCAle", "*IDN?", "HCSU"]))
def test_headers_match_in_short_and_long_form_only(header: str) -> None:
    found = ieee488.Header(header)
    short = "".join(c for c in header if not c.islower() or c == "n").replace("<n>", "2")
    long = header.replace("<n>", "2")
    assert found.matches(short)
    assert found.matches(long.lower())
    assert found.matches(long[:-1] + "x") is False


@given(text=st.text(max_size=60))
def test_any_text_splits_into_units(text: str) -> None:
    for head, _arguments in ieee488.split_message(text):
        assert head
