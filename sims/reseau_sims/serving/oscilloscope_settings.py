"""Settings of the simulated oscilloscopes, with the forms of their parameters.

Source: programming manuals of the makers. Scales and offsets are stored and reported; what the simulated
channel shows does not depend on them.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from .program import Parameter, Setting, boolean, choice, numeric, string

__all__ = ["SETTINGS"]


def _anything(text: str) -> str:
    return text.strip()


def _source(written: str) -> Parameter:
    """A source such as CHANnel1, of the channels 1 to 4."""
    return choice(*(written.replace("<n>", str(n)) for n in range(1, 5)))


_SECONDS = numeric("S", 1e-10, 1e3, 1e-3)
_DELAY = numeric("S", -1e3, 1e3, 0.0)
_VOLTS = numeric("V", -1e3, 1e3, 0.0)
_SCALE = numeric("V", 1e-4, 100.0, 1.0)
_POINTS = numeric("", 0, 1e9, 0)
_ZERO, _MILLI, _ONE = "0.000000E+00", "1.000000E-03", "1.000000E+00"
_HEADER = Setting("CHDR", choice("OFF", "SHORT", "LONG"), "SHORT")
_USUAL = (
    Setting(":TIMebase:SCALe", _SECONDS, _MILLI),
    Setting(":TIMebase:POSition", _DELAY, _ZERO),
    Setting(":CHANnel<n>:SCALe", _SCALE, _ONE),
    Setting(":CHANnel<n>:OFFSet", _VOLTS, _ZERO),
    Setting(":CHANnel<n>:DISPlay", boolean, "1"),
    Setting(":CHANnel<n>:COUPling", choice("DC", "AC", "GND"), "DC"),
    Setting(":CHANnel<n>:PROBe", numeric("", 1e-3, 1e4, 1.0), _ONE),
    Setting(":TRIGger:EDGE:LEVel", _VOLTS, _ZERO),
    Setting(":TRIGger:EDGE:SOURce", _source("CHANnel<n>"), "CHAN1"),
    Setting(":WAVeform:SOURce", _source("CHANnel<n>"), "CHAN1"),
)
_ORDER = choice("LSBFirst", "MSBFirst")
_SIGLENT = (
    _HEADER,
    Setting(":WAVeform:SOURce", _source("C<n>"), "C1"),
    Setting(":WAVeform:INTerval", _POINTS, _ONE),
    Setting(":WAVeform:POINt", _POINTS, _ZERO),
)
_TEKTRONIX = (
    Setting("HEADer", boolean, "1"),
    Setting("VERBose", boolean, "1"),
    Setting("HORizontal:SCAle", _SECONDS, _MILLI),
    Setting("CH<n>:SCAle", _SCALE, _ONE),
    Setting("CH<n>:OFFSet", _VOLTS, _ZERO),
    Setting("SELect:CH<n>", boolean, "1"),
    Setting("HARDCopy:INKSaver", boolean, "1"),
    Setting("DATa:SOUrce", _source("CH<n>"), "CH1"),
    Setting(
        "DATa:ENCdg", choice("RIBinary", "RPBinary", "SRIbinary", "SRPbinary", "ASCIi", "FAStest"), "RIB"
    ),
    Setting("DATa:WIDth", choice("1", "2"), "1"),
    Setting("DATa:STARt", _POINTS, "1"),
    Setting("DATa:STOP", _POINTS, "1000"),
)

SETTINGS: Mapping[str, tuple[Setting, ...]] = MappingProxyType(
    {
        "keysight": (
            *_USUAL,
            Setting(":HARDcopy:INKSaver", boolean, "1"),
            Setting(":WAVeform:FORMat", choice("BYTE", "WORD", "ASCii"), "BYTE"),
            Setting(":WAVeform:UNSigned", boolean, "1"),
            Setting(":WAVeform:BYTeorder", _ORDER, "MSBF"),
            Setting(":WAVeform:POINts:MODE", choice("NORMal", "MAXimum", "RAW"), "NORM"),
        ),
        "infiniium": (
            *_USUAL,
            Setting(":WAVeform:FORMat", choice("BYTE", "WORD", "ASCii"), "ASC"),
            Setting(":WAVeform:BYTeorder", _ORDER, "MSBF"),
            Setting(":WAVeform:STReaming", boolean, "0"),
        ),
        "rigol": (
            *_USUAL,
            Setting(":WAVeform:MODE", choice("NORMal", "MAXimum", "RAW"), "NORM"),
            Setting(":WAVeform:FORMat", choice("WORD", "BYTE", "ASCii"), "BYTE"),
            Setting(":WAVeform:STARt", _POINTS, _ONE),
            Setting(":WAVeform:STOP", _POINTS, "1.000000E+03"),
        ),
        "siglent": (_HEADER, Setting("WFSU", _anything, "")),
        "siglent-block": _SIGLENT,
        "siglent-wide": _SIGLENT,
        "tektronix": (*_TEKTRONIX, Setting("SAVe:IMAGe:FILEFormat", choice("PNG", "BMP", "TIFf"), "BMP")),
        "tektronix-tds": (
            *_TEKTRONIX,
            Setting("HARDCopy:FORMat", choice("BMP", "BMPColor", "PNG", "TIFf"), "BMP"),
            Setting("HARDCopy:COMPRession", boolean, "0"),
            Setting("HARDCopy:LAYout", choice("PORTRait", "LANdscape"), "PORTR"),
            Setting("HARDCopy:PORT", choice("CENtronics", "ETHERnet", "FILe", "GPIb", "RS232", "USB"), "FIL"),
        ),
        "rohde": (
            Setting("TIMebase:SCALe", _SECONDS, _MILLI),
            Setting("CHANnel<n>:SCALe", _SCALE, _ONE),
            Setting("CHANnel<n>:OFFSet", _VOLTS, _ZERO),
            Setting("CHANnel<n>:STATe", boolean, "1"),
            Setting("FORMat", choice("ASCii", "REAL", "REAL,32", "UINT,8", "UINT,16"), "ASC"),
            Setting("FORMat:DATA", choice("ASCii", "REAL", "REAL,32", "UINT,8", "UINT,16"), "ASC"),
            Setting("FORMat:BORDer", _ORDER, "MSBF"),
            Setting("HCOPy:FORMat", choice("PNG", "BMP"), "PNG"),
            Setting("HCOPy:LANGuage", choice("PNG", "BMP"), "PNG"),
            Setting("HCOPy:DEVice<n>:LANGuage", choice("PNG", "BMP", "JPG"), "PNG"),
            Setting("MMEMory:NAME", string, ""),
        ),
        "": (_HEADER, Setting("HCSU", _anything, "")),
    }
)
"""By the transfer of waveforms; those of the screen are among them."""
