"""How each maker's oscilloscopes hand over their screen and their waveforms: data, chosen by ``*IDN?``.

Source: the makers' programming manuals. A family's model is found by the first pattern that its identity
matches.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from reseau.core.data import Array
from reseau.core.errors import ProtocolError

__all__ = ["DIALECTS", "Dialect", "Step", "WaveformDialect", "dialect_of", "fields_of", "samples_of"]

Numbers = dict[str, float]
Step = tuple[Literal["send", "query", "fetch"], str]
"""``tell`` sends a command; ``ask`` waits for a line, and lets it be; ``fetch`` takes a picture or block."""


@dataclass(frozen=True)
class WaveformDialect:
    """How a waveform is handed over; ``{n}`` stands for the channel.

    Parameters
    ----------
    setup : tuple of str
        Commands.
    scale : mapping
        Questions by the name of their number; or of several, separated by spaces, answered with commas. A
        name ``-`` is passed over.
    data : str
        Question for the block.
    dtype : str
        Of its samples.
    volts : callable
        From samples and the numbers to volts.
    start, step : callable
        From the numbers to the seconds of the first sample, and of a step.
    preamble : str
        Question for a block that holds more numbers.
    fields : mapping
        Where in it they stand, and how (of :mod:`struct`), by name.
    wide : tuple (str, str), optional
        What is said for samples of more than eight bits (the number ``bits``), and their type.
    piece : str
        Said before each block, where all samples need not come in one; ``{at}`` is the first of it.
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

    def sampled(self, numbers: Numbers) -> tuple[str, str]:
        """What has to be said for these samples, and their type."""
        return self.wide if self.wide and numbers.get("bits", 8) > 8 else ("", self.dtype)


@dataclass(frozen=True)
class Dialect:
    """One way to speak.

    Parameters
    ----------
    name : str
        Of the family.
    identity : str
        Pattern of maker and model, as ``MAKER,MODEL``.
    screen : tuple of Step
        What is said for the picture of the screen; one step fetches it.
    waveform : WaveformDialect, optional
        None where waveforms are not known.
    setup : tuple of str
        Said after connecting.
    halt : str
        Stops the acquisition.
    errors : str
        Asks for the oldest error; nothing where there is no queue.
    """

    name: str
    identity: str
    screen: tuple[Step, ...]
    waveform: WaveformDialect | None = None
    setup: tuple[str, ...] = ()
    halt: str = ":STOP"
    errors: str = ":SYSTem:ERRor?"


_TEN = "- - points - dx x0 - dy y0 yref"
"""The ten numbers of a preamble of Keysight and Rigol: format, type, points, count, x, y."""

_KEYSIGHT = WaveformDialect(
    (":WAVeform:SOURce CHANnel{n}", ":WAVeform:FORMat BYTE", ":WAVeform:UNSigned ON"),
    MappingProxyType({_TEN: ":WAVeform:PREamble?"}),
    ":WAVeform:DATA?",
    "u1",
    lambda codes, f: (codes - f["yref"]) * f["dy"] + f["y0"],
)
_RIGOL = WaveformDialect(
    (":WAVeform:SOURce CHANnel{n}", ":WAVeform:MODE NORMal", ":WAVeform:FORMat BYTE"),
    MappingProxyType({_TEN: ":WAVeform:PREamble?"}),
    ":WAVeform:DATA?",
    "u1",
    lambda codes, f: (codes - f["y0"] - f["yref"]) * f["dy"],
)
_SIGLENT = WaveformDialect(
    ("CHDR OFF", "WFSU SP,0,NP,0,FP,0"),
    MappingProxyType({"vdiv": "C{n}:VDIV?", "ofst": "C{n}:OFST?", "rate": "SARA?", "tdiv": "TDIV?"}),
    "C{n}:WF? DAT2",
    "i1",
    lambda codes, f: codes * f["vdiv"] / 25 - f["ofst"],
    # Fourteen divisions, the trigger in the middle.
    start=lambda f: -7 * f["tdiv"],
    step=lambda f: 1 / f["rate"],
)
_SIGLENT_BLOCK = WaveformDialect(
    (":WAVeform:SOURce C{n}", ":WAVeform:WIDTh BYTE", ":WAVeform:INTerval 1", ":WAVeform:POINt 0"),
    MappingProxyType({"tdiv": ":TIMebase:SCALe?"}),
    ":WAVeform:DATA?",
    "i1",
    lambda codes, f: f["probe"] * (codes / f["codes"] * f["vdiv"] - f["ofst"]),
    # Ten divisions; the delay is that of their middle.
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
_TEKTRONIX = WaveformDialect(
    ("HEADer OFF", "DATa:SOUrce CH{n}", "DATa:ENCdg RIBinary", "DATa:WIDth 1"),
    MappingProxyType(
        {
            "dx": "WFMOutpre:XINcr?",
            "x0": "WFMOutpre:XZEro?",
            "dy": "WFMOutpre:YMUlt?",
            "yoff": "WFMOutpre:YOFf?",
            "y0": "WFMOutpre:YZEro?",
        }
    ),
    "CURVe?",
    "i1",
    lambda codes, f: (codes - f["yoff"]) * f["dy"] + f["y0"],
)
_ROHDE = WaveformDialect(
    ("FORMat REAL,32", "FORMat:BORDer LSBFirst"),
    MappingProxyType({"x0 x1 points -": "CHANnel{n}:DATA:HEADer?"}),
    "CHANnel{n}:DATA?",
    "<f4",
    lambda volts, f: volts,
    step=lambda f: (f["x1"] - f["x0"]) / f["points"],
)

DIALECTS: tuple[Dialect, ...] = (
    Dialect(
        "Keysight InfiniiVision X",
        r"(KEYSIGHT|AGILENT).*,(DSO|MSO|EDU|DSOX|MSOX|MXR)?.*",
        (("send", ":HARDcopy:INKSaver OFF"), ("fetch", ":DISPlay:DATA? PNG, COLor")),
        _KEYSIGHT,
    ),
    Dialect(
        "Rigol 1000Z",
        r"RIGOL.*,(DS|MSO)1\d{3}Z.*",
        (("fetch", ":DISPlay:DATA? ON,0,PNG"),),
        _RIGOL,
    ),
    Dialect("Rigol", r"RIGOL.*", (("fetch", ":DISPlay:DATA?"),), _RIGOL),
    Dialect(
        "Siglent with PRINt",
        r"SIGLENT.*,SDS(2\d{3}X (Plus|HD)|1\d{3}X HD|[567]\d{3}).*",
        (("fetch", "PRINt? PNG"),),
        _SIGLENT_BLOCK,
        setup=("CHDR OFF",),
        halt="STOP",
        errors="",
    ),
    Dialect(
        "Siglent", r"SIGLENT.*", (("fetch", "SCDP"),), _SIGLENT, setup=("CHDR OFF",), halt="STOP", errors=""
    ),
    Dialect(
        "Tektronix with a file system",
        r"TEKTRONIX,(MSO|DPO|LPD)(2[24]|4[46]|5[468]|58LP|6[468])B?\b.*",
        (
            ("send", 'SAVe:IMAGe "C:/Temp/reseau.png"'),
            ("query", "*OPC?"),
            ("fetch", 'FILESystem:READFile "C:/Temp/reseau.png"'),
            ("send", 'FILESystem:DELEte "C:/Temp/reseau.png"'),
        ),
        _TEKTRONIX,
        setup=("HEADer OFF",),
        halt="ACQuire:STATE STOP",
        errors="",
    ),
    Dialect(
        "Tektronix",
        r"TEKTRONIX.*",
        (
            ("send", "SAVe:IMAGe:FILEFormat PNG"),
            ("send", "HARDCopy:INKSaver OFF"),
            ("fetch", "HARDCopy STARt"),
        ),
        _TEKTRONIX,
        setup=("HEADer OFF",),
        halt="ACQuire:STATE STOP",
        errors="",
    ),
    Dialect(
        "Rohde & Schwarz with a file system",
        r"ROHDE&SCHWARZ,(RTO|RTE|RTP|MXO).*",
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
        "Rohde & Schwarz",
        r"(ROHDE&SCHWARZ|HAMEG).*",
        (("send", "HCOPy:FORMat PNG"), ("fetch", "HCOPy:DATA?")),
        _ROHDE,
    ),
    Dialect(
        "LeCroy",
        r"LECROY.*",
        (
            ("send", "CHDR OFF"),
            ("send", "HCSU DEV,PNG,BCKG,BLACK,AREA,DSOWINDOW,DEST,REMOTE"),
            ("fetch", "SCDP"),
        ),
        halt="STOP",
        errors="",
    ),
)


def dialect_of(identity: str) -> Dialect:
    """The dialect of an instrument by its answer to ``*IDN?``.

    Raises
    ------
    ProtocolError
        When none is known for it.

    Examples
    --------
    >>> dialect_of("RIGOL TECHNOLOGIES,DS1104Z,DS1ZA000000001,00.04.04").name
    'Rigol 1000Z'
    """
    for dialect in DIALECTS:
        if re.match(dialect.identity, identity.strip(), re.IGNORECASE):
            return dialect
    raise ProtocolError(f"how to speak to {identity!r} is not known", do="name a dialect")


def fields_of(block: bytes, dialect: WaveformDialect) -> Numbers:
    """The numbers that a preamble holds.

    Raises
    ------
    ProtocolError
        When it is too short for them, or holds what cannot be meant.
    """
    try:
        found = {
            name: float(struct.unpack_from(how, block, at)[0]) for name, (at, how) in dialect.fields.items()
        }
    except struct.error:
        raise ProtocolError(f"a preamble of {len(block)} bytes is too short") from None
    divisors = (found.get("codes", 1.0), found.get("dx", 1.0))
    if not all(math.isfinite(value) for value in found.values()) or min(divisors) <= 0:
        raise ProtocolError(f"a preamble that holds {found}")
    return found


def samples_of(data: bytes, dialect: WaveformDialect, numbers: Numbers) -> Array:
    """Volts of the samples of all blocks.

    Raises
    ------
    ProtocolError
        When their number is not the one that was announced.
    """
    dtype = np.dtype(dialect.sampled(numbers)[1])
    if len(data) % dtype.itemsize:
        raise ProtocolError(f"{len(data)} bytes are no whole number of samples")
    codes = np.frombuffer(data, dtype).astype(np.float64)
    if "points" in numbers and len(codes) != int(numbers["points"]):
        raise ProtocolError(f"{len(codes)} samples came; {numbers['points']:g} were announced")
    return dialect.volts(codes, numbers)
