"""Commands for screen pictures and waveforms of each manufacturer's oscilloscopes, selected by ``*IDN?``.

Source: programming manuals of the manufacturers. The first pattern that matches the identity selects the
family.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Literal

import numpy as np

from reseau.core.data import Array
from reseau.core.errors import ProtocolError

from ..codecs.ieee488 import picture
from ..codecs.numbers import INFINITE
from .screens import bytes_of_colours, runs_of_colours

__all__ = [
    "DIALECTS",
    "UNITS",
    "Dialect",
    "Step",
    "WaveformDialect",
    "candidates_of",
    "dialect_of",
    "fields_of",
    "samples_of",
]

Numbers = dict[str, float]
Step = tuple[Literal["send", "query", "fetch"], str]
"""``send`` a command, where ``{port}`` is the port that it is connected to;
``query``: wait for a line and ignore it; ``fetch`` a picture or block."""


@dataclass(frozen=True)
class WaveformDialect:
    """Commands that transfer a waveform; ``{n}`` stands for the channel.

    Parameters
    ----------
    setup : tuple of str
        Commands sent first.
    scale : mapping
        Queries by the name of the number in their answer; several names, separated by spaces, stand for an
        answer with commas. The name ``-`` skips a number.
    data : str
        Query for the block of samples.
    dtype : str
        Data type of the samples.
    volts : callable
        Converts samples to volts, given the numbers.
    start, step : callable
        Time of the first sample and time step (s), given the numbers.
    preamble : str
        Query for a block with further numbers.
    fields : mapping
        Offset and format (of :mod:`struct`) of these numbers, by name.
    wide : tuple (str, str), optional
        Command and data type for samples of more than eight bits (number ``bits``).
    piece : str
        Command before each block, if the samples come in several blocks; ``{at}`` is the index of the first
        sample.
    more : tuple of int
        Numbers of further fields that the answers of `scale` may have.
    """

    setup: tuple[str, ...]
    scale: Mapping[str, str]
    data: str
    dtype: str
    volts: Callable[[Array, Numbers], Array]
    start: Callable[[Numbers], float] = lambda f: f["x0"]
    step: Callable[[Numbers], float] = lambda f: f["dx"]
    preamble: str = ""
    fields: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    wide: tuple[str, str] | None = None
    piece: str = ""
    more: tuple[int, ...] = (0,)

    def sampled(self, numbers: Numbers) -> tuple[str, str]:
        """Return the command for the sample width, and the data type."""
        return self.wide if self.wide and numbers.get("bits", 8) > 8 else ("", self.dtype)


@dataclass(frozen=True)
class Dialect:
    """Commands of one family of oscilloscopes.

    Parameters
    ----------
    name : str
        Name of the family; begins with that of the maker.
    models : str
        Regular expression for the beginning of the model.
    screen : tuple of Step
        Steps to obtain the screen picture; one of them fetches it.
    waveform : WaveformDialect, optional
        None if waveforms are not supported.
    setup : tuple of str
        Commands sent after connecting.
    halt : str
        Command that stops the acquisition.
    errors : str
        Query for the oldest error; empty if there is no error queue.
    decode : callable
        Makes a PNG or BMP file from the answer with the picture.

    Examples
    --------
    >>> [step for step, _ in DIALECTS[1].screen]
    ['send', 'fetch']
    """

    name: str
    models: str
    screen: tuple[Step, ...]
    waveform: WaveformDialect | None = None
    setup: tuple[str, ...] = ()
    halt: str = ":STOP"
    errors: str = ":SYSTem:ERRor?"
    decode: Callable[[bytes], bytes] = picture

    @property
    def maker(self) -> str:
        """The maker."""
        return next(maker for maker in _MAKERS if self.name.startswith(maker))


UNITS = {"vdiv": "V", "ofst": "V", "rate": "Sa/s", "tdiv": "s"}
"""Units that may follow numbers, by their names."""
_TEN = "- - points - dx x0 - dy y0 yref"
"""The ten numbers of a Keysight or Rigol preamble: format, type, points, count, x, y."""


def _with_preamble(dtype: str, *setup: str, shifted: bool = False) -> WaveformDialect:
    """Bytes scaled by a preamble of ten numbers; `shifted`: its origin counts codes, not volts."""

    def volts(codes: Array, f: Numbers) -> Array:
        return (codes - f["y0"] - f["yref"]) * f["dy"] if shifted else (codes - f["yref"]) * f["dy"] + f["y0"]

    return WaveformDialect(
        (":WAVeform:SOURce CHANnel{n}", ":WAVeform:FORMat BYTE", *setup),
        MappingProxyType({_TEN: ":WAVeform:PREamble?"}),
        ":WAVeform:DATA?",
        dtype,
        volts,
    )


def _curve(group: str, **more: str) -> WaveformDialect:
    """The curve of a Tektronix, scaled by the numbers of a group; some count samples from the trigger."""
    names = {"dx": "XINcr", "x0": "XZEro", "dy": "YMUlt", "yoff": "YOFf", "y0": "YZEro"} | more
    return WaveformDialect(
        ("HEADer OFF", "DATa:SOUrce CH{n}", "DATa:ENCdg RIBinary", "DATa:WIDth 1"),
        MappingProxyType({name: f"{group}:{written}?" for name, written in names.items()}),
        "CURVe?",
        "i1",
        lambda codes, f: (codes - f["yoff"]) * f["dy"] + f["y0"],
        start=lambda f: f["x0"] - f.get("first", 0.0) * f["dx"],
    )


_KEYSIGHT = _with_preamble("u1", ":WAVeform:UNSigned ON")
# Coupling, ranges, date and the like follow; the number of segments in segmented memory.
_INFINIIUM = replace(_with_preamble("i1", ":WAVeform:STReaming OFF"), more=(0, 14, 15))
_RIGOL = _with_preamble("u1", ":WAVeform:MODE NORMal", shifted=True)
_RIGOL_E = WaveformDialect(
    (":WAVeform:POINts:MODE NORMal",),
    MappingProxyType(
        {
            "vdiv": ":CHANnel{n}:SCALe?",
            "ofst": ":CHANnel{n}:OFFSet?",
            "tdiv": ":TIMebase:SCALe?",
            "delay": ":TIMebase:OFFSet?",
        }
    ),
    ":WAVeform:DATA? CHANnel{n}",
    "u1",
    # 125 is the middle of the screen, and a smaller number is higher; 600 samples are twelve divisions.
    lambda codes, f: (125 - codes) * f["vdiv"] / 25 - f["ofst"],
    start=lambda f: f["delay"] - 6 * f["tdiv"],
    step=lambda f: f["tdiv"] / 50,
)
_SIGLENT = WaveformDialect(
    ("CHDR OFF", "WFSU SP,0,NP,0,FP,0"),
    MappingProxyType({"vdiv": "C{n}:VDIV?", "ofst": "C{n}:OFST?", "rate": "SARA?", "tdiv": "TDIV?"}),
    "C{n}:WF? DAT2",
    "i1",
    lambda codes, f: codes * f["vdiv"] / 25 - f["ofst"],
    # Fourteen divisions with the trigger in the middle.
    start=lambda f: -7 * f["tdiv"],
    step=lambda f: 1 / f["rate"],
)
_SIGLENT_BLOCK = WaveformDialect(
    (":WAVeform:SOURce C{n}", ":WAVeform:WIDTh BYTE", ":WAVeform:INTerval 1", ":WAVeform:POINt 0"),
    MappingProxyType({"tdiv": ":TIMebase:SCALe?"}),
    ":WAVeform:DATA?",
    "i1",
    lambda codes, f: f["probe"] * (codes / f["codes"] * f["vdiv"] - f["ofst"]),
    # Ten divisions; the delay refers to their middle.
    start=lambda f: f["delay"] - 5 * f["tdiv"],
    step=lambda f: f["dx"],
    preamble=":WAVeform:PREamble?",
    # The wave descriptor of the programming guide EN11.
    fields=MappingProxyType(
        {
            "points": (116, "<i"),
            "vdiv": (156, "<f"),
            "ofst": (160, "<f"),
            "codes": (164, "<f"),
            "bits": (172, "<H"),
            "dx": (176, "<f"),
            "delay": (180, "<d"),
            "probe": (328, "<f"),
        }
    ),
    wide=(":WAVeform:WIDTh WORD", "<i2"),
    piece=":WAVeform:STARt {at}",
)
_TEKTRONIX = _curve("WFMOutpre")
_TEKTRONIX_TDS = _curve("WFMPre", first="PT_Off")
_ROHDE = WaveformDialect(
    ("FORMat REAL,32", "FORMat:BORDer LSBFirst"),
    MappingProxyType({"x0 x1 points -": "CHANnel{n}:DATA:HEADer?"}),
    "CHANnel{n}:DATA?",
    "<f4",
    lambda volts, f: volts,
    step=lambda f: (f["x1"] - f["x0"]) / f["points"],
)


def _hardcopy(kind: str, port: str) -> tuple[Step, ...]:
    """Steps of a Tektronix TDS; without LAYout and COMPRession it may send what was last printed with."""
    return (
        ("send", f"HARDCopy:FORMat {kind}"),
        ("send", "HARDCopy:LAYout PORTRait"),
        ("send", f"HARDCopy:PORT {port}"),
        ("fetch", "HARDCopy STARt"),
    )


_no_queue = partial(Dialect, halt="STOP", errors="", setup=("CHDR OFF",))
_tektronix = partial(Dialect, halt="ACQuire:STATE STOP", errors="", setup=("HEADer OFF",))

DIALECTS: tuple[Dialect, ...] = (
    Dialect(
        "Keysight Infiniium",
        r"(MXR|EXR|UXR)\d|(DSO|MSO|DSA)(S|V|Z|X?9)\d",
        (("fetch", ":DISPlay:DATA? PNG,SCReen,ON,NORMal"),),
        _INFINIIUM,
    ),
    Dialect(
        "Keysight InfiniiVision X",
        r"(DSO|MSO|EDU)-?X ?[1-6]\d{3}|(DSO|MSO)[5-7]\d{3}|HD3\d|M924|P924",
        (("send", ":HARDcopy:INKSaver OFF"), ("fetch", ":DISPlay:DATA? PNG, COLor")),
        _KEYSIGHT,
    ),
    Dialect("Rigol 1000Z", r"(DS|MSO)1\d{3}Z", (("fetch", ":DISPlay:DATA? ON,0,PNG"),), _RIGOL),
    Dialect(
        "Rigol DS1000D and DS1000E",
        r"DS1\d{3}[CDEM]+\b",
        (("fetch", ":LCD:DATA?"),),
        _RIGOL_E,
        errors="",
        decode=bytes_of_colours,
    ),
    Dialect("Rigol", r"(DS|MSO|DHO|MHO|HDO)\d", (("fetch", ":DISPlay:DATA?"),), _RIGOL),
    _no_queue(
        "Siglent with PRINt",
        r"SDS(\d+X (Plus|HD)|[567]\d{3})",
        (("fetch", "PRINt? PNG"),),
        _SIGLENT_BLOCK,
    ),
    _no_queue("Siglent", r"SDS\d", (("fetch", "SCDP"),), _SIGLENT),
    _tektronix(
        "Tektronix with a file system",
        r"(MSO|DPO|LPD)(2[24]|4[46]|5[468]|58LP|6[468])B?\b",
        (
            ("send", 'SAVe:IMAGe "C:/Temp/reseau.png"'),
            ("query", "*OPC?"),
            ("fetch", 'FILESystem:READFile "C:/Temp/reseau.png"'),
            ("send", 'FILESystem:DELEte "C:/Temp/reseau.png"'),
        ),
        _TEKTRONIX,
    ),
    _tektronix(
        "Tektronix with Windows",
        r"(MSO|DPO)5\d{3}B?\b|(DPO|DSA|MSO)7\d{3,4}",
        (
            ("send", "HARDCopy:PORT FILE"),
            ("send", "EXPort:FORMat PNG"),
            ("send", 'HARDCopy:FILEName "C:\\TEMP\\RESEAU.PNG"'),
            ("send", "HARDCopy STARt"),
            ("query", "*OPC?"),
            ("fetch", 'FILESystem:READFile "C:\\TEMP\\RESEAU.PNG"'),
            ("send", 'FILESystem:DELEte "C:\\TEMP\\RESEAU.PNG"'),
        ),
        _TEKTRONIX,
    ),
    _tektronix(
        "Tektronix TDS 200",
        r"TDS ?2[1-4]\d\b",
        _hardcopy("BMP", "{port}"),
        _TEKTRONIX_TDS,
    ),
    _tektronix(
        "Tektronix TDS 3000",
        r"TDS ?3\d{3}",
        (("send", "HARDCopy:COMPRession OFF"), *_hardcopy("BMPColor", "GPIb")),
        _TEKTRONIX_TDS,
    ),
    _tektronix(
        "Tektronix TDS 1000 and 2000",
        r"(TDS ?[12]0\d\d|TPS ?2\d{3}|TBS ?1\d{3})",
        _hardcopy("BMP", "USB"),
        _TEKTRONIX_TDS,
    ),
    _tektronix(
        "Tektronix",
        r"(MSO|DPO|MDO|TDS|TBS|TPS|DSA|CSA) ?\d",
        (
            ("send", "SAVe:IMAGe:FILEFormat PNG"),
            ("send", "HARDCopy:INKSaver OFF"),
            ("fetch", "HARDCopy STARt"),
        ),
        _TEKTRONIX,
    ),
    Dialect(
        "Rohde & Schwarz with a file system",
        r"RTO|RTE|RTP|MXO",
        (
            ("send", "HCOPy:DEVice1:LANGuage PNG"),
            ("send", "MMEMory:NAME 'C:\\reseau.png'"),
            ("send", "HCOPy:IMMediate1"),
            ("query", "*OPC?"),
            ("fetch", "MMEMory:DATA? 'C:\\reseau.png'"),
            ("send", "MMEMory:DELete 'C:\\reseau.png'"),
        ),
        _ROHDE,
    ),
    Dialect(
        "Rohde & Schwarz handheld",
        r"RTH",
        (
            ("send", "HCOPy:LANGuage PNG"),
            ("send", "MMEMory:NAME '/media/SD/reseau.png'"),
            ("send", "HCOPy:IMMediate"),
            ("query", "*OPC?"),
            ("fetch", "MMEMory:DATA? '/media/SD/reseau.png'"),
            ("send", "MMEMory:DELete '/media/SD/reseau.png'"),
        ),
        _ROHDE,
    ),
    Dialect(
        "Rohde & Schwarz",
        r"RTB|RTM|RTA|RTC|HMO",
        (("send", "HCOPy:FORMat PNG"), ("fetch", "HCOPy:DATA?")),
        _ROHDE,
    ),
    _no_queue("LeCroy T3DSO", r"T3DSO", (("fetch", "SCDP"),), _SIGLENT),
    Dialect(
        "GW Instek",
        r"GDS-?[123]\d{3}|MSO-?2\d{3}|MDO-?2\d{3}",
        (("fetch", ":DISPlay:OUTPut?"),),
        errors="",
        decode=runs_of_colours,
    ),
    _no_queue(
        "LeCroy",
        r"",
        (("send", "HCSU DEV,PNG,BCKG,BLACK,AREA,DSOWINDOW,DEST,REMOTE"), ("fetch", "SCDP")),
    ),
)

_MAKERS = {
    "Keysight": ("KEYSIGHT|AGILENT|HEWLETT", r"34|U?12|U34|L44|EDU3[46]|3[35]\d|N\d|E\d"),
    "Rigol": ("RIGOL", r"(DM|DG|DP|DSA|DL|RSA)\d"),
    "Siglent": ("SIGLENT", r"SDM|SDG|SPD|SSA|SSG|SVA|SDL"),
    "Tektronix": ("TEKTRONIX", r"DMM|AFG|AWG|PWS|RSA|PA"),
    "Rohde & Schwarz": ("ROHDE|HAMEG", r"HMC|NG|FP|FS|SM|HMP|UDS"),
    "LeCroy": ("LECROY|TELEDYNE", r"WAVESTATION|T3(?!DSO)|WS(20[125]|3(08|12|16))2\b"),
    "GW Instek": ("GW|GOOD WILL|INSTEK", r"GDM|GPP|PSW|GPD|AFG|MFG|GSP|PPH"),
    "Keithley": ("KEITHLEY", ""),
}
"""Makers as in the names of their dialects: what ``*IDN?`` begins with, and models that are no oscilloscopes:
multimeters, generators, supplies and analyzers.
"""


def _is(maker: str, models: str, identity: str) -> bool:
    """Whether an identity is of a maker and of models."""
    return re.match(rf"({_MAKERS[maker][0]})[^,]*, *({models})", identity.strip(), re.IGNORECASE) is not None


def candidates_of(identity: str) -> tuple[Dialect, ...]:
    """Return the dialects that an instrument of an unknown model may have: those of its maker, or all.

    Raises
    ------
    ProtocolError
        If it is known to be no oscilloscope.

    Examples
    --------
    >>> [dialect.name for dialect in candidates_of("RIGOL TECHNOLOGIES,XYZ9,1,1")]
    ['Rigol 1000Z', 'Rigol DS1000D and DS1000E', 'Rigol']
    """
    for maker, (_, others) in _MAKERS.items():
        if _is(maker, others, identity):
            raise ProtocolError(f"{identity!r} is no oscilloscope", do="check the address")
        if _is(maker, "", identity):
            return tuple(dialect for dialect in DIALECTS if dialect.maker == maker)
    return DIALECTS


def dialect_of(identity: str) -> Dialect | None:
    """Return the dialect of an instrument by its answer to ``*IDN?``; None if its model is not known.

    Raises
    ------
    ProtocolError
        If it is known to be no oscilloscope.

    Examples
    --------
    >>> dialect_of("RIGOL TECHNOLOGIES,DS1104Z,DS1ZA000000001,00.04.04").name
    'Rigol 1000Z'
    """
    possible = candidates_of(identity)
    return next((dialect for dialect in possible if _is(dialect.maker, dialect.models, identity)), None)


def fields_of(block: bytes, dialect: WaveformDialect) -> Numbers:
    """Decode the numbers of a preamble.

    Raises
    ------
    ProtocolError
        If the preamble is too short or contains invalid numbers.
    """
    try:
        found = {
            name: float(struct.unpack_from(how, block, at)[0]) for name, (at, how) in dialect.fields.items()
        }
    except struct.error:
        raise ProtocolError(f"a preamble of {len(block)} bytes is too short") from None
    divisors = (found.get("codes", 1.0), found.get("dx", 1.0))
    if not all(abs(value) < INFINITE for value in found.values()) or min(divisors) <= 0:
        raise ProtocolError(f"the preamble contains invalid numbers: {found}")
    return found


def samples_of(data: bytes, dialect: WaveformDialect, numbers: Numbers) -> Array:
    """Convert the samples of all blocks to volts.

    Raises
    ------
    ProtocolError
        If the number of samples differs from the announced one, or some have no value.
    """
    dtype = np.dtype(dialect.sampled(numbers)[1])
    if len(data) % dtype.itemsize:
        raise ProtocolError(f"{len(data)} bytes are not a whole number of samples")
    codes = np.frombuffer(data, dtype).astype(np.float64)
    if "points" in numbers and len(codes) != numbers["points"]:
        raise ProtocolError(f"received {len(codes)} samples; {numbers['points']:g} were announced")
    volts = dialect.volts(codes, numbers)
    if not np.all(np.abs(volts) < INFINITE):
        raise ProtocolError("some samples stand for no value", do="is the channel on?")
    return volts
