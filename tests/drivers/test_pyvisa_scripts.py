"""Scripts with pyvisa drive every simulated oscilloscope: five styles, and the forms of parameters."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest

from reseau_sims import serving
from reseau_sims.serving import (
    FAMILIES,
    FaultScript,
    FaultyConnection,
    HislipInstrument,
    TcpServer,
    Vxi11Session,
)
from reseau_sims.serving.usbtmc import UsbInstrument, plugged_in

pyvisa = pytest.importorskip("pyvisa")
CLIENT = partial(pytest.mark.client, "pyvisa, pyvisa-py")
VOLTS = (np.arange(1000).astype(np.uint8).astype(float) - 128) * 0.04 + 0.12


@contextmanager
def opened(family: str, transport: str = "socket") -> Iterator[tuple[Any, serving.Oscilloscope]]:
    machine = serving.Oscilloscope(family)
    session: Any = partial(FaultyConnection, machine)
    if transport == "vxi-11":
        session = partial(Vxi11Session, machine, machine.execute, FaultScript())
    elif transport == "hislip":
        session = HislipInstrument(machine, machine.execute, FaultScript()).channel
    usb = UsbInstrument(machine, machine.execute, FaultScript())
    with TcpServer(session) as server, plugged_in(usb):
        manager = pyvisa.ResourceManager("@py")
        name = {
            "usbtmc": usb.resource,
            "socket": f"TCPIP::127.0.0.1::{server.port}::SOCKET",
            "vxi-11": f"TCPIP::127.0.0.1,{server.port}::inst0::INSTR",
            "hislip": f"TCPIP::127.0.0.1::hislip0,{server.port}::INSTR",
        }[transport]
        device = manager.open_resource(name, read_termination="\n", write_termination="\n", timeout=5000)
        try:
            yield device, machine
        finally:
            device.close()


@CLIENT(
    "{family}",
    "VXI-11: `query`, joined queries, `write` and `read_stb` with `*ESE`, `*SRE`, `*OPC`, `*STB?`; errors by "
    "`*ESR?` and `SYST:ERR?`",
)
@pytest.mark.parametrize("family", FAMILIES)
def test_the_five_styles(family: str) -> None:
    with opened(family, "vxi-11") as (device, machine):
        # query; query of several units; write, then poll the status byte
        assert device.query("*IDN?") == FAMILIES[family].idn
        assert device.query("*ESE 60;*ESE?;*OPC?") == "60;1"
        device.write("*CLS;*ESE 1;*SRE 32;*OPC")
        assert device.query("*STB?") == "96"
        # A service is requested once for each reason, the summary stays as long as the reason.
        assert device.read_stb() & 0x60 == 0x60
        assert device.read_stb() & 0x60 == 0x20
        assert device.query("*STB?;*ESR?;*STB?") == "96;1;0"
        assert device.read_stb() & 0x60 == 0
        device.write("*OPC")
        assert device.read_stb() & 0x60 == 0x60
        device.write("*CLS")
        # an error: in the queue, in the event register, in the status byte
        device.write("NO:SUCH 1")
        assert device.read_stb() & 0x04
        assert int(device.query("*ESR?")) & 0x20
        assert device.query("SYST:ERR?").startswith("-113,")
        assert device.query(":system:error:next?").startswith("0,")
        assert len(machine.violations) == 1


PICTURES = {
    "keysight": (":disp:data? png,col", ()),
    "keysight-infiniium": (":DISPLAY:DATA? PNG", ()),
    "rigol-1000z": (":DISP:DATA? ON,0,PNG", ()),
    "rigol-2000": ("DISPlay:DATA?", ()),
    "siglent-hd": ("PRIN? PNG", ()),
    "rohde": ("hcop:data?", ("HCOP:LANG PNG;FORM PNG",)),
    "rohde-files": ("MMEM:DATA? 'a.png'", ("HCOP:DEV1:LANG PNG", "MMEM:NAME 'a.png'", ":HCOP:IMM1")),
}


@CLIENT("{family}", "VXI-11: pictures by `query_binary_values`")
@pytest.mark.parametrize("family", PICTURES)
def test_pictures_are_read_as_binary_values(family: str) -> None:
    query, before = PICTURES[family]
    with opened(family, "vxi-11") as (device, machine):
        for command in before:
            device.write(command)
        data = device.query_binary_values(query, datatype="B", container=bytes)
        assert (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) == machine.screen()).all()
        assert machine.violations == []


@CLIENT("tektronix-files", "VXI-11: a file by `read_raw`")
def test_bare_files_are_read_raw() -> None:
    with opened("tektronix-files", "vxi-11") as (device, machine):
        device.write('SAVE:IMAGE "C:/x.png"')
        assert device.query("*OPC?") == "1"
        device.write('FILES:READF "C:/x.png"')
        data = device.read_raw()
        assert (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) == machine.screen()).all()
        device.write('FILESystem:DELEte "C:/x.png"')
        assert machine.violations == []


@CLIENT("{family}", "VXI-11: waveforms in bytes, words, text, by `query_binary_values` and `query`")
@pytest.mark.parametrize("form", ["BYTE", "WORD", "ASCii"])
@pytest.mark.parametrize("family", ["keysight", "keysight-infiniium", "rigol-1000z"])
def test_waveforms_in_bytes_words_and_text(family: str, form: str) -> None:
    with opened(family, "vxi-11") as (device, machine):
        device.write(f":WAV:SOUR CHAN1;FORM {form}")
        _, _, n, _, _, _, _, dy, y0, yref = (float(part) for part in device.query("WAV:PRE?").split(","))
        if form == "ASCii":
            text = device.query(":WAVEFORM:DATA?")
            text = text[2 + int(text[1]) :] if text[0] == "#" else text
            found = np.array([float(value) for value in text.split(",")])
        else:
            signed, kind = family == "keysight-infiniium", form == "WORD"
            datatype = ("h" if signed else "H") if kind else ("b" if signed else "B")
            codes = device.query_binary_values(
                ":WAV:DATA?", datatype=datatype, is_big_endian=family != "rigol-1000z", container=np.array
            ).astype(float)
            found = (codes - y0 - yref) * dy if "rigol" in family else (codes - yref) * dy + y0
        assert len(found) == n
        assert found == pytest.approx(VOLTS, abs=1e-4)
        assert machine.violations == []


@CLIENT("keysight-infiniium", "VXI-11: a block of unknown length")
def test_a_block_of_unknown_length_is_read() -> None:
    with opened("keysight-infiniium", "vxi-11") as (device, machine):
        device.write(":WAV:FORM BYTE;STR ON")
        codes = device.query_binary_values(":WAV:DATA?", datatype="b", data_points=1000, container=np.array)
        assert codes.astype(float) * 0.04 + 0.12 == pytest.approx(VOLTS, abs=1e-6)
        assert machine.violations == []


@CLIENT("tektronix", "VXI-11: curves in four codings by `query_binary_values` and `query_ascii_values`")
@pytest.mark.parametrize(
    ("coding", "datatype", "big", "shift"),
    [("RIB", "b", True, 0), ("rpbinary", "B", True, 128), ("SRI", "h", False, 0), ("ASCII", "", True, 0)],
)
def test_curves_of_tektronix_in_every_coding(coding: str, datatype: str, big: bool, shift: int) -> None:
    wide = 256 if datatype == "h" else 1
    with opened("tektronix", "vxi-11") as (device, machine):
        device.write(f"DATA:SOURCE CH1;ENCDG {coding};WIDTH {2 if wide > 1 else 1};:HEADER 0")
        scale, offset = (float(v) for v in device.query("WFMO:YMU?;YOF?").split(";"))
        if datatype:
            codes = device.query_binary_values(
                "CURV?", datatype=datatype, is_big_endian=big, container=np.array
            )
        else:
            codes = np.array(device.query_ascii_values("CURVE?"))
        assert offset == shift
        assert (codes.astype(float) - offset) * scale + 0.12 == pytest.approx(VOLTS, abs=1e-6)
        assert machine.violations == []


@CLIENT("tektronix-tds3000", "VXI-11: headers of answers; pictures that are printed, saved, compressed")
def test_answers_of_tektronix_have_headers_until_they_are_switched_off() -> None:
    with opened("tektronix-tds3000", "vxi-11") as (device, machine):
        assert device.query("HARDC:FORM?") == ":HARDCOPY:FORMAT BMP"
        assert device.query("VERB OFF;:HARDC:LAY?;:CH2:SCA?") == ":HARDC:LAY PORTR;:CH2:SCA 1.000000E+00"
        assert device.query("HEAD OFF;:HARDC:PORT?;:WFMP:PT_O?") == "FIL;500"
        # A picture that is to be printed or saved is not sent; one that is compressed is.
        device.write("HARDCopy:FORMat PNG;PORT CENtronics;:HARDCopy STARt")
        assert device.read_stb() & 0x10 == 0
        device.write("HARDCopy:PORT GPIb;COMPRession ON;:HARDCopy STARt")
        data = gzip.decompress(device.read_raw())
        assert (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) == machine.screen()).all()
        assert machine.violations == []


@CLIENT("keysight over {transport}", "service request by a poll; it cannot wait for one")
@pytest.mark.parametrize("transport", ["vxi-11", "hislip", "socket"])
def test_pyvisa_py_polls_for_service_requests_and_cannot_wait_for_them(transport: str) -> None:
    events, queue = pyvisa.constants.EventType.service_request, pyvisa.constants.EventMechanism.queue
    with opened("keysight", transport) as (device, machine):
        # None of its transports has events: nothing can be received, whatever the instrument sends.
        with pytest.raises(NotImplementedError):
            device.enable_event(events, queue)
        with pytest.raises(NotImplementedError):
            device.wait_on_event(events, 100)
        # The answer says that all is executed: HiSLIP polls on another channel.
        assert device.query("*CLS;*ESE 1;*SRE 32;*OPC;*OPC?") == "1"
        polled = int(device.query("*STB?")) if transport == "socket" else device.read_stb()
        assert polled & 0x60 == 0x60
        assert machine.violations == []


@CLIENT("keysight over {transport}", "identity, a picture, a waveform")
@pytest.mark.parametrize("transport", ["socket", "vxi-11", "hislip", "usbtmc"])
def test_every_transport_carries_text_and_blocks(transport: str) -> None:
    with opened("keysight", transport) as (device, machine):
        assert device.query("*IDN?") == FAMILIES["keysight"].idn
        data = device.query_binary_values(":DISP:DATA? PNG", datatype="B", container=bytes)
        assert (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) == machine.screen()).all()
        codes = device.query_binary_values(":WAV:DATA?", datatype="B", container=np.array)
        assert (codes.astype(float) - 128) * 0.04 + 0.12 == pytest.approx(VOLTS, abs=1e-6)
        assert machine.violations == []


@CLIENT(
    "keysight over socket",
    "suffixes, MIN, MAX, DEF, ON and 1, `#H`, paths after semicolons; six wrong forms by their error numbers",
)
def test_parameters_in_all_their_forms() -> None:
    with opened("keysight") as (device, machine):
        for written, value in {
            "100 mV": 0.1, "100MV": 0.1, "1e-1": 0.1, ".1V": 0.1, "MAX": 100.0, "minimum": 1e-4, "DEF": 1.0,
            "#H2": 2.0,
        }.items():  # fmt: skip
            device.write(f"CHAN2:SCAL {written}")
            assert float(device.query(":CHANNEL2:SCALE?")) == value, written
        assert float(device.query(":TIM:SCAL? MIN")) == 1e-10
        for written, shown in {"ON": "1", "0": "0", "on": "1", "OFF": "0"}.items():
            device.write(f":chan1:disp {written}")
            assert device.query(":CHAN1:DISP?") == shown
        assert device.query("TIM:SCAL 2MS;POS -10US;SCAL?;POS?") == "2.000000E-03;-1.000000E-05"
        assert machine.violations == []
        for wrong, number in {
            "CHAN1:SCAL 1 HZ": "-131", "CHAN1:SCAL 1e9": "-222", "CHAN1:SCAL x": "-104",
            "CHAN1:COUP XY": "-224", "CHAN1:SCAL": "-109", "TIM:SCAL 1;WAV:FORM BYTE": "-113",
        }.items():  # fmt: skip
            device.write(wrong)
            assert device.query("SYST:ERR?").startswith(number), wrong
