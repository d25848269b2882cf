"""Families of oscilloscopes as public reports describe them; each fake is written from its report."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs.ieee488 import block
from reseau_drivers.link import SerialLink
from reseau_drivers.oscilloscope import Oscilloscope, oscilloscope

from .fakes import Lines, Wire

SCREEN = np.random.default_rng(5).integers(0, 255, (48, 64), dtype=np.uint8)
PNG = bytes(cv2.imencode(".png", SCREEN)[1])
BMP = bytes(cv2.imencode(".bmp", SCREEN)[1])


class Filing(Lines):
    """Keeps a screen in a file once it is told to, and sends the file that is asked for.

    Parameters
    ----------
    idn : str
        Answer to ``*IDN?``.
    name, save, read, delete : str
        How the commands begin that name the file, save the screen, send the file and delete it.
    answer : bytes
        What is sent.
    """

    def __init__(self, idn: str, name: str, save: str, read: str, delete: str, answer: bytes) -> None:
        super().__init__({"*IDN?": idn.encode() + b"\n", "*OPC?": b"1\n"})
        self._commands, self._answer, self.files = (name, save, read, delete), answer, set[str]()
        self._named = ""

    def receive(self, data: bytes) -> bytes:
        """Answer lines."""
        said = super().receive(data)
        line = data.decode().strip()
        name, save, read, delete = self._commands
        file = line[-1:] and line.split(line[-1])[-2] if line[-1:] in "\"'" else ""
        if line.startswith(name):
            self._named = file
        elif line.startswith(save):
            self.files.add(self._named)
        elif line.startswith(read) and file in self.files:
            said += self._answer
        elif line.startswith(delete):
            self.files.discard(file)
        return said


def test_a_handheld_of_rohde_and_schwarz_sends_a_file() -> None:
    """lxi-tools issue 66: HCOPy:DATA? is not answered; the screen goes through a file on its card."""
    idn = "Rohde&Schwarz,RTH,1317.5000k04/105749,1.80.3.4"
    fake = Filing(idn, "MMEMory:NAME", "HCOPy:IMM", "MMEMory:DATA?", "MMEMory:DEL", block(PNG) + b"\n")
    with oscilloscope("scope", Wire(fake), seconds=0.5) as scope:
        assert scope.screen().data == PNG
    assert fake.files == set()
    assert "HCOPy:LANGuage PNG" in fake.heard


@pytest.mark.parametrize("model", ["DPO5104B", "DPO7254C", "MSO5204", "DSA72004B"])
def test_a_tektronix_with_windows_sends_a_file(model: str) -> None:
    """PyVISA issue 648: a hard copy has no remote port; it goes to a file, which READFile sends bare."""
    idn = f"TEKTRONIX,{model},C051041,CF:91.1CT FV:10.8.3 Build 3"
    fake = Filing(idn, "HARDCopy:FILEN", "HARDCopy STARt", "FILESystem:READFile", "FILESystem:DEL", PNG)
    with oscilloscope("scope", Wire(fake), seconds=0.5) as scope:
        assert scope.screen().data == PNG
    assert fake.files == set()
    assert {"HARDCopy:PORT FILE", "EXPort:FORMat PNG"} <= set(fake.heard)


def test_a_wavesurfer_is_an_oscilloscope_and_so_is_a_t3dso() -> None:
    """PyVISA issue 777: a WaveSurfer 3054 calls itself WS3054."""
    for model, said in (("WS3054", PNG), ("T3DSO1204", BMP)):
        fake = Lines({"*IDN?": f"LECROY,{model},LCRY3702N14196,7.7.2\n".encode(), "SCDP": said + b"\n"})
        with oscilloscope("scope", Wire(fake), seconds=0.5) as scope:
            assert (scope.screen().frame().pixels == SCREEN).all()


def test_a_rigol_of_the_first_generation_sends_pixels_and_codes_upside_down() -> None:
    """riglol-snap: 320×234 bytes of 2, 3 and 3 bits; a DS1052E as K. Shirriff and C. Mahto read it."""
    rng = np.random.default_rng(7)
    lcd = rng.integers(0, 256, (234, 320), dtype=np.uint8)
    volts = rng.uniform(-3.0, 3.0, 600)
    codes = np.round(255 - (130 + (volts + 0.4) / 1.0 * 25)).astype(np.uint8)
    said = {
        "*IDN?": b"Rigol Technologies,DS1052E,DS1EB0,00.04.04\n",
        ":LCD:DATA?": b"#800074880" + lcd.tobytes(),
        ":CHANnel2:SCALe?": b"1.000e+00\n",
        ":CHANnel2:OFFSet?": b"4.000e-01\n",
        ":TIMebase:SCALe?": b"1.000e-03\n",
        ":TIMebase:OFFSet?": b"0.000e+00\n",
        ":WAVeform:DATA? CHANnel2": b"#800000600" + codes.tobytes(),
    }
    with oscilloscope("scope", Wire(Lines(said)), seconds=0.5) as scope:
        shown = cv2.imdecode(np.frombuffer(scope.screen().data, np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        assert (shown[..., 2] == (lcd & 0xC0)).all()
        assert (shown[..., 1] == (lcd & 0x38) << 2).all()
        assert (shown[..., 0] == (lcd & 7) << 5).all()
        wave = scope.waveform(2)
    assert np.abs(wave.volts - volts).max() <= 0.5 / 25 + 1e-9  # half a code
    assert (wave.start_s, wave.step_s) == pytest.approx((-6e-3, 2e-5))


def test_a_gw_instek_sends_runs_of_colours() -> None:
    """dso1kb.py of the maker: little-endian pairs of a length and a colour."""
    colours = np.random.default_rng(9).integers(0, 1 << 16, 480).astype("<u2")
    runs = np.stack([np.full(480, 800, "<u2"), colours], axis=1).tobytes()
    idn = b"GW,GDS-1104B,PXXXXXX,V1.19\n"
    fake = Lines({"*IDN?": idn, ":DISPlay:OUTPut?": block(runs) + b"\n"})
    with oscilloscope("scope", Wire(fake), seconds=0.5) as scope:
        shown = cv2.imdecode(np.frombuffer(scope.screen().data, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == (480, 800, 3)
    assert (shown[:, 0, 2] == (colours >> 11 << 3)).all()
    assert (shown[:, 799, 1] == (colours >> 5 & 0x3F) << 2).all()
    assert (shown[:, 400, 0] == (colours & 0x1F) << 3).all()
    short = Lines({"*IDN?": idn, ":DISPlay:OUTPut?": block(runs[:-4]) + b"\n"})
    with (
        oscilloscope("scope", Wire(short), seconds=0.5) as scope,
        pytest.raises(ProtocolError, match="383200 pixels, not 800×480"),
    ):
        scope.screen()


@pytest.mark.parametrize(("serial", "port"), [(True, "RS232"), (False, "GPIb")])
def test_a_tds_220_prints_to_the_port_it_is_connected_by(serial: bool, port: str) -> None:
    """Its programmer manual: HARDCopy:PORT is RS232, GPIb or CENtronics; it has no USB."""

    class SerialWire(Wire, SerialLink):  # type: ignore[misc]
        pass

    idn = b"TEKTRONIX,TDS 220,0,CF:91.1CT FV:v1.16 TDS2CM:CMV:v1.04\n"
    fake = Lines({"*IDN?": idn, "HARDCopy STARt": BMP})
    scope = Oscilloscope("scope", (SerialWire if serial else Wire)(fake), seconds=0.5)
    with scope:
        assert (scope.screen().frame().pixels == SCREEN).all()
    assert f"HARDCopy:PORT {port}" in fake.heard
