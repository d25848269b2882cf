"""Bytes typed from the protocols' documents, not made by the code that they check."""

from __future__ import annotations

import pytest

from reseau.core.errors import ProtocolError, SettingError
from reseau_drivers.codecs import bk, compactpulser, hislip, ieee488, ping, rpc, smc100, usbtmc, vxi11, zaber
from reseau_drivers.codecs.stream import Damaged
from reseau_drivers.profiles import known, told_bits


def test_zaber_replies_of_the_manual_with_and_without_id_and_checksum() -> None:
    # Message format of the manual: "@01 0 OK IDLE -- 0", and an alert "!01 1 IDLE --".
    assert zaber.decode(b"@01 0 OK IDLE -- 0") == zaber.Reply(1, 0, None, True, False, "--", "0")
    assert zaber.decode(b"@01 1 05 RJ BUSY WR BADDATA") == zaber.Reply(1, 1, 5, False, True, "WR", "BADDATA")
    assert zaber.decode(b"#01 0 Available settings:"[:-1]) == zaber.Info(1, 0, None, "Available settings")
    assert zaber.decode(b"!01 1 IDLE --") == zaber.Alert(1, 1, False, "--")
    # 0x30+0x31+0x20+0x30 = 0xB1, its two's complement 0x4F.
    assert zaber.encode(zaber.Command(1, 0, "")) == b"/01 0:4F\n"
    assert zaber.decode_command(b"/01 0:4F") == zaber.Command(1, 0, "")
    assert zaber.decode_command(b"/") == zaber.Command(0, 0, "")
    assert zaber.decode_command(b"/1 2 home") == zaber.Command(1, 2, "home")


@pytest.mark.parametrize(
    "line", [b"", b"@", b"@01 0 OK IDLE -- 0:00", b"@01 OK", b"hello", b"@01 0 OK IDLE --"]
)
def test_zaber_rejects_invalid_messages(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        zaber.decode(line)


def test_zaber_finds_the_message_after_noise() -> None:
    assert zaber.decode(b"\xff\x00@01 0 OK IDLE -- 0") == zaber.Reply(1, 0, None, True, False, "--", "0")


def test_zaber_rejects_words_that_would_end_a_message() -> None:
    for words in ("home\n/1 estop", "get pos:00", "move abs é", "a\\"):
        with pytest.raises(SettingError):
            zaber.encode(zaber.Command(1, 1, words))


def test_smc100_lines_of_the_manual() -> None:
    # SMC100CC/PP User's Manual, "Command Syntax" (nnAAxx) and TP, as PyMeasure and bliss send and read them.
    assert smc100.encode(smc100.Line(1, "OR")) == b"1OR\r\n"
    assert smc100.decode(b"1TP2.0001\r\n") == smc100.Line(1, "TP", "2.0001")
    assert smc100.decode(b"1TS000033") == smc100.Line(1, "TS", "000033")
    assert smc100.decode(b"1TE@\r\n") == smc100.Line(1, "TE", "@")
    for wrong in ("", "0000", "0000FF", "00003Z"):
        with pytest.raises(ProtocolError):
            smc100.decode_status(wrong)


@pytest.mark.parametrize(
    ("codes", "state"),
    [
        # The manual's table of TS (page 65); 36 to 38 and 3F of the CONEX-CC's.
        ("0A 0B 0C 0D 0E 0F 10 11", "not referenced"),
        ("14", "configuration"),
        ("1E 1F", "homing"),
        ("28", "moving"),
        ("32 33 34 35 36 37 38", "ready"),
        ("3C 3D 3E 3F", "disabled"),
        ("46 47", "jogging"),
    ],
)
def test_smc100_states_of_the_manual(codes: str, state: str) -> None:
    for code in codes.split():
        assert smc100.decode_status(f"0000{code}") == (0, state)


def _bits(answer: str) -> tuple[str, ...]:
    return told_bits(known("smc100"), smc100.decode_status(answer)[0])


def test_smc100_status_bits_are_the_first_four_digits() -> None:
    # The manual's own example of TS: 0x004C is homing time-out, RMS and peak current limit.
    assert _bits("004C0A") == (
        "peak current limit",
        "RMS current limit",
        "homing time-out",
    )
    assert _bits("002132") == ("negative end of run", "following error")
    assert _bits("000232") == ("positive end of run",)
    assert _bits("030033") == ("DC voltage too low", "80 W output power exceeded")


def test_smc100_errors_are_those_of_the_manual() -> None:
    # TE, page 61: @, A to N but for none, S, U to X; P is the CONEX-CC's.
    assert "".join(known("smc100")["errors"]) == "@ABCDEFGHIJKLMNPSUVWX"
    assert "NOT REFERENCED" in known("smc100")["errors"]["H"]
    assert known("smc100")["errors"]["G"] == "displacement out of limits"


def test_ping_request_of_the_documentation() -> None:
    # "Message Format": general_request for protocol_version.
    typed = bytes.fromhex("42 52 02 00 06 00 00 00 05 00 a1 00")
    frame = ping.Frame(ping.GENERAL_REQUEST, b"\x05\x00")
    assert ping.encode(frame) == typed
    assert ping.FrameDecoder().feed(typed) == [frame]


def test_ping_transducer_payload_has_the_documented_fields() -> None:
    asked = ping.Transducer(1, 200, 32, 88, 740, 1200)
    payload = bytes.fromhex("01 01 c8 00 20 00 58 00 e4 02 b0 04 01 00")
    assert asked.frame().payload == payload
    assert ping.Transducer.parse(payload) == asked


def test_compactpulser_commands_as_in_public_code() -> None:
    # changbatterygroup/ultrasonicTesting, ultratekPulser.py: all of them drive a real one.
    for typed, setting in {
        b"P500\r": compactpulser.Setting("P", 500),
        b"P0\r": compactpulser.Setting("P", 0),
        b"W220\r": compactpulser.Setting("W", 220),
        b"V300\r": compactpulser.Setting("V", 300),
        b"D0\r": compactpulser.Setting("D", 0),
        b"M0\r": compactpulser.Setting("M", 0),
        b"T0\r": compactpulser.Setting("T", 0),
        b"G-120\r": compactpulser.Setting("G", -120),
        b"G?\r": compactpulser.Setting("G", None),
    }.items():
        assert compactpulser.encode(setting) == typed
        assert compactpulser.decode(typed) == (setting, False)
    assert compactpulser.decode(b"G=600\r") == (compactpulser.Setting("G", 600), True)
    for wrong in (b"", b"X1", b"P", b"G=?", b"P1e9", b"\xff", b"G=12.5"):
        with pytest.raises(ProtocolError):
            compactpulser.decode(wrong)
    with pytest.raises(SettingError):
        compactpulser.encode(compactpulser.Setting("G", 1_000_000))


def test_bk_messages_and_a_frame_with_every_escape() -> None:
    # PS12640-44, page 9: 1, 4 and 27 stand as 27 and their complement; the frame as NifTK reads it.
    typed = (
        bytes.fromhex("01") + b"DATA:GRAB_FRAME #15" + bytes.fromhex("00 1b fb 00 00 1b fe 1b e4 ff 3b 04")
    )
    (content,) = bk.MessageDecoder().feed(typed)
    assert isinstance(content, bytes)
    frame = bk.parse_frame(content, 3)
    # The announced length (5) is wrong, as on a BK5000: the end of the message counts.
    assert frame == bk.GrabbedFrame(0x0400, bytes([0x01, 0x1B, 0xFF]), 5)
    assert bk.encode(bk.encode_frame(frame)) == typed


def test_bk_queries_and_answers_as_in_public_clients() -> None:
    # PLUS, NifTK and scikit-surgerybk send these; a 592×384 frame is announced as 227332, its stamp included.
    assert bk.encode(b"QUERY:US_WIN_SIZE;") == b"\x01QUERY:US_WIN_SIZE;\x04"
    assert bk.numbers(b"DATA:US_WIN_SIZE 640,480;", "US_WIN_SIZE") == (640, 480)
    scan = b"DATA:B_GEOMETRY_SCANAREA:A 0.0017218,-0.000171398,1.37236,0,-0.00174855,-0.000176821,1.77236,"
    scan += b"0.0203479;"
    assert bk.numbers(scan, "B_GEOMETRY_SCANAREA:A")[7] == 0.0203479
    pixels = bytes(592 * 384)
    frame = bk.parse_frame(b"DATA:GRAB_FRAME #6227332" + bytes(4) + pixels + b";", 592 * 384)
    assert (len(frame.pixels), frame.announced) == (592 * 384, 592 * 384 + 4)
    # A last pixel that looks like the semicolon is a pixel.
    assert bk.parse_frame(b"DATA:GRAB_FRAME #16" + bytes(4) + b";;", 2).pixels == b";;"
    for wrong in (b"DATA:GRAB_FRAME #16" + bytes(6), b"DATA:GRAB_FRAME #19" + bytes(4 + 9), b"ACK;"):
        with pytest.raises(ProtocolError):
            bk.parse_frame(wrong, 3)


def test_blocks_and_pictures_end_at_their_announced_length() -> None:
    assert ieee488.parse_block(b"#800000005hello\n") == b"hello"
    assert ieee488.missing_bytes(b"#800000005hel") == 2
    png = bytes.fromhex(
        "89504e470d0a1a0a 0000000d49484452 00000001000000010800000000 3a7e9b55"
        "0000000a49444154 789c63600000000200 01 48afa471 0000000049454e44 ae426082".replace(" ", "")
    )
    assert ieee488.missing_bytes(png) == 0
    assert ieee488.missing_bytes(png[:-1]) is None
    assert ieee488.picture(png + b"\n") == png
    assert ieee488.picture(ieee488.block(png) + b"\n") == png
    bmp = b"BM" + (60).to_bytes(4, "little") + bytes(54)
    assert ieee488.missing_bytes(bmp[:-4]) == 4
    for wrong in (b"hello", b"#", b"#0", b"#9999999999", b"#3ab", b"BM\xff\xff\xff\xff", b"\x89GIF1234"):
        with pytest.raises(ProtocolError):
            ieee488.picture(wrong)


def test_vxi11_create_link_bytes() -> None:
    # RFC 5531: xid, CALL, RPC 2, program 0x0607AF, version 1, procedure 10, no credentials; arguments.
    typed = bytes.fromhex(
        "00000007 00000000 00000002 000607af 00000001 0000000a 00000000 00000000 00000000 00000000"
        "0000002a 00000000 00000000 00000005 696e7374 30000000".replace(" ", "")
    )
    call = rpc.decode_call(typed)
    assert (call.program, call.version, call.procedure) == (vxi11.CORE, vxi11.VERSION, 10)
    found = rpc.Unpacker(call.arguments)
    assert [found.number() for _ in range(3)] == [42, 0, 0]
    assert found.opaque() == b"inst0"
    assert rpc.encode_call(call) == typed
    assert rpc.record(b"abcd") == bytes.fromhex("80000004 61626364".replace(" ", ""))


def test_fragments_are_joined_to_one_record() -> None:
    assert rpc.RecordDecoder().feed(bytes.fromhex("00000002 6162 80000001 63".replace(" ", ""))) == [b"abc"]


def test_hislip_initialize_bytes() -> None:
    # Table 4: prologue, Initialize, control 0, version 1.0 and vendor "xx", length 7, "hislip0".
    typed = b"HS\x00\x00\x01\x00xx" + bytes(7) + b"\x07hislip0"
    (message,) = hislip.MessageDecoder().feed(typed)
    assert message == hislip.Message(hislip.Type.INITIALIZE, 0, 0x01007878, b"hislip0")
    assert not isinstance(message, Damaged)
    assert hislip.encode(message) == typed


def test_usbtmc_transfer_bytes() -> None:
    # USBTMC 1.0, table 1 to 4: a request for 1000 bytes with tag 3, and an answer of five bytes, padded.
    assert usbtmc.decode(bytes.fromhex("02 03 fc 00 e8 03 00 00 00 0a 00 00")) == usbtmc.Transfer(
        2, 3, 1000, False
    )
    assert usbtmc.encode_in(3, b"hello", True) == bytes.fromhex("02 03 fc 00 05 00 00 00 01 00 00 00") + (
        b"hello\0\0\0"
    )
    for wrong in (
        "",
        "01 01 01 00 01 00 00 00 01 00 00 00 2a",
        "01 01 fe 00 00 00 00 00 01 00 00 00",
        "7f" * 12,
    ):
        with pytest.raises(ProtocolError):
            usbtmc.decode(bytes.fromhex(wrong))
