"""A number of an instrument is a value or an error, never a part of what was written."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reseau.core.errors import ProtocolError
from reseau.instruments import Deadline
from reseau_drivers.codecs.bk import numbers as bk_numbers
from reseau_drivers.codecs.gcode import decode
from reseau_drivers.codecs.numbers import number
from reseau_drivers.codecs.sentence import Sentence
from reseau_drivers.environment.probes import ScpiProbe
from reseau_drivers.oscilloscope import oscilloscope

from .fakes import Lines, Wire

VALUES = [
    ("+1.5", "", 1.5), ("-1.50E+00", "V", -1.5), (".5", "", 0.5), ("5.", "", 5.0), (" 12 ", "", 12.0),
    ("5.00E-01V", "V", 0.5), ("500 mV", "V", 0.5), ("20.0uS", "s", 2e-5), ("1.00GSa/s", "Sa/s", 1e9),
    ("500MSa/s", "Sa/s", 5e8), ("23.51 °C", None, 23.51),
]  # fmt: skip
ERRORS = [
    ("5,00E-01", "V"), ("1.234,5", ""), ("23,51", None), ("23,", None), ("23.51;45.2", None), ("", ""),
    ("nan", ""), ("inf", ""), ("1_000", ""), ("0x10", ""), ("1.0E", ""), ("1.0E+", ""), ("--5", ""),
    ("1.2.3", ""), ("9.9E37", ""), ("-9.9E37", ""), ("9.91E+37", "V"), ("1E400", ""), ("5.0A", "V"),
    ("5.0MV", "V"), ("5.0V", ""), ("1.5 2.5", ""), ("٣", ""),
]  # fmt: skip


@pytest.mark.parametrize(("text", "unit", "value"), VALUES)
def test_numbers_with_and_without_their_unit(text: str, unit: str | None, value: float) -> None:
    assert number(text, unit) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(("text", "unit"), ERRORS)
def test_what_is_no_number_is_an_error(text: str, unit: str | None) -> None:
    with pytest.raises(ProtocolError):
        number(text, unit)


@given(st.floats(-1e30, 1e30), st.sampled_from(["{:.4f}", "{:.6E}", "{:+.3e}"]))
def test_a_decimal_comma_is_an_error_whatever_the_number(value: float, form: str) -> None:
    text = form.format(value)
    assert number(text) == float(text)
    with pytest.raises(ProtocolError, match="decimal point"):
        number(text.replace(".", ","))


SIGLENT = {
    "*IDN?": b"Siglent Technologies,SDS1204X-E,S,8.2\n",
    "C1:VDIV?": b"5.00E-01\n",
    "C1:OFST?": b"1.50E+00\n",
    "SARA?": b"1.00E+09\n",
    "TDIV?": b"5.00E-04\n",
    "C1:WF? DAT2": b"DAT2,#13\x00\x01\x02\n\n",
}
TDS = {
    "*IDN?": b"TEKTRONIX,TDS 2024C,C0,CF:91.1CT FV:v24.26\n",
    "WFMPre:XINcr?": b"1.0E-6\n",
    "WFMPre:XZEro?": b"0.0E0\n",
    "WFMPre:YMUlt?": b"4.0E-2\n",
    "WFMPre:YOFf?": b"-5.0E1\n",
    "WFMPre:YZEro?": b"0.0E0\n",
    "WFMPre:PT_Off?": b"0\n",
    "CURVe?": b"#13\x00\x01\x02\n",
}
RIGOL = {
    "*IDN?": b"RIGOL TECHNOLOGIES,DS1054Z,DS1ZA,00.04.04\n",
    ":WAVeform:PREamble?": b"0,2,3,1,1.0e-6,-6e-4,0,2.0e-2,0,127\n",
    ":WAVeform:DATA?": b"#13\x7f\x80\x81\n",
}
INFINIIUM = {
    "*IDN?": b"KEYSIGHT TECHNOLOGIES,MXR054A,MY1,11.10\n",
    ":WAVeform:PREamble?": b"0,2,3,1,1.0E-06,-6E-04,0,2.0E-02,0,0,1,1.0E-03,0,8,0,"
    b'"17 SEP 2015","10:00:00","MXR054A:MY1",3,100,2,1,1.0E+09,0.0\n',
    ":WAVeform:DATA?": b"#13\x00\x01\x02\n",
}
ROHDE = {
    "*IDN?": b"Rohde&Schwarz,RTB2004,1333.1005k04/1,02.300\n",
    "CHANnel1:DATA:HEADer?": b"-1.0E-3,1.0E-3,2,1\n",
    "CHANnel1:DATA?": b"#18" + np.array([0.5, 1.0], "<f4").tobytes() + b"\n",
}


def volts(answers: dict[str, bytes], **other: bytes) -> list[float]:
    with oscilloscope("scope", Wire(Lines(answers | other)), seconds=0.5) as scope:
        return [float(each) for each in scope.waveform(1).volts]


@pytest.mark.parametrize(
    ("answers", "right"),
    [(SIGLENT, [-1.5, -1.48, -1.46]), (TDS, [2.0, 2.04, 2.08]), (RIGOL, [0.0, 0.02, 0.04]),
     (INFINIIUM, [0.0, 0.02, 0.04]), (ROHDE, [0.5, 1.0])],
)  # fmt: skip
def test_a_waveform_is_right_with_points_and_an_error_with_commas(
    answers: dict[str, bytes], right: list[float]
) -> None:
    assert volts(answers) == pytest.approx(right, abs=1e-7)
    for query, said in answers.items():
        if query.startswith("*") or b"." not in said or b"#" in said:
            continue
        with pytest.raises(ProtocolError):
            volts(answers, **{query: said.replace(b".", b",")})


@pytest.mark.parametrize("absent", [b"9.9E37\n", b"9.91E+37\n", b"-9.9E37\n", b"nan\n", b"\t\n"])
def test_a_scale_without_a_value_is_an_error(absent: bytes) -> None:
    with pytest.raises(ProtocolError, match=r"YMUlt|no value|not a number"):
        volts(TDS, **{"WFMPre:YMUlt?": absent})


def test_headers_and_units_in_answers_are_understood() -> None:
    said = {
        "C1:VDIV?": b"C1:VDIV 5.00E-01V\n",
        "C1:OFST?": b"C1:OFST 1.50E+00V\n",
        "SARA?": b"SARA 1.00GSa/s\n",
        "TDIV?": b"TDIV 5.00E-04S\n",
    }
    assert volts(SIGLENT, **said) == pytest.approx([-1.5, -1.48, -1.46])
    with pytest.raises(ProtocolError):
        volts(SIGLENT, **{"C1:VDIV?": b"C2:VDIV 5.00E-01V\n"})


def test_a_channel_that_is_off_has_no_samples() -> None:
    empty = {
        ":WAVeform:PREamble?": b"0,2,0,1,1.0e-6,-6e-4,0,2.0e-2,0,127\n",
        ":WAVeform:DATA?": b"#9000000000\n",
    }
    with pytest.raises(ProtocolError, match="no samples of channel 1; switch the channel on"):
        volts(RIGOL, **empty)
    nothing = b"#18" + np.array([0.5, 9.91e37], "<f4").tobytes() + b"\n"
    with pytest.raises(ProtocolError, match="some samples stand for no value"):
        volts(ROHDE, **{"CHANnel1:DATA?": nothing})


def test_a_waveform_with_fewer_samples_than_announced_is_an_error() -> None:
    """STOP of the last transfer was left at 600 by another program."""
    part = {
        ":WAVeform:PREamble?": b"0,2,1200,1,1.0e-6,-6e-4,0,2.0e-2,0,127\n",
        ":WAVeform:DATA?": b"#9000000600" + bytes(600) + b"\n",
    }
    with pytest.raises(ProtocolError, match="received 600 samples; 1200 were announced"):
        volts(RIGOL, **part)


@pytest.mark.parametrize("text", ["23,51", "23.51;45.2", "9.91E+37", "nan", "23.51 45"])
def test_sensors_and_scanners_decline_what_is_no_number(text: str) -> None:
    probe = ScpiProbe(Wire(Lines({"*IDN?": b"a,b,c,d\n", "T?": text.encode() + b"\n"})), {"t": "T?"}, 0.2)
    probe.open(Deadline(1.0))
    with pytest.raises(ProtocolError):
        probe.numbers(Deadline(1.0))
    with pytest.raises(ProtocolError):
        Sentence(r"T=(?P<t>.+)").values(f"T={text}".encode())
    with pytest.raises(ProtocolError):
        bk_numbers(f"DATA:US_WIN_SIZE {text.replace(',', ';')};".encode(), "US_WIN_SIZE")
    with pytest.raises(ProtocolError):
        decode(f"<Idle|MPos:{text.replace(',', ';')},0|FS:0,0>".encode())
