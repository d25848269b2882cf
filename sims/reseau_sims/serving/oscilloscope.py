"""Simulated SCPI oscilloscope with the commands of one of several makers; it shows the simulated world.

Source: programming manuals of the makers: sequences that transfer the screen and waveforms.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau_drivers.codecs.ieee488 import Header, block, split_message

from .faults import Kind
from .machine import Machine

__all__ = ["FAMILIES", "Family", "Oscilloscope"]

_LONGEST = 4096
"""Largest size of a program message (bytes)."""


@dataclass(frozen=True)
class Family:
    """Commands of the instruments of one maker.

    Parameters
    ----------
    idn : str
        Answer to ``*IDN?``.
    screen : str
        Header of the query for the screen, or of the command that returns it.
    screen_arguments : str
        Required arguments, in upper case.
    picture : str
        ``.png`` or ``.bmp``.
    as_block : bool
        Whether the picture is sent as a block.
    newline : bool
        Whether a newline follows the picture.
    prepared_by : tuple of str
        Headers that must be sent before, in any order.
    accepts : tuple of str
        Other accepted headers.
    waveform : str
        Transfer of waveforms: ``keysight``, ``rigol``, ``siglent``, ``siglent-block`` (and ``-wide``, with 16
        bits), ``tektronix``, ``rohde``.

    Examples
    --------
    >>> FAMILIES["rigol-1000z"].screen
    ':DISPlay:DATA?'
    """

    idn: str
    screen: str
    screen_arguments: str = ""
    picture: str = ".png"
    as_block: bool = True
    newline: bool = True
    prepared_by: tuple[str, ...] = ()
    accepts: tuple[str, ...] = ()
    waveform: str = "keysight"


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        "keysight": Family(
            "KEYSIGHT TECHNOLOGIES,MSO-X 3024T,MY00000001,07.50",
            ":DISPlay:DATA?",
            "PNG, COLOR",
            accepts=(":HARDcopy:INKSaver",),
        ),
        "rigol-1000z": Family(
            "RIGOL TECHNOLOGIES,DS1104Z,DS1ZA000000001,00.04.04",
            ":DISPlay:DATA?",
            "ON,0,PNG",
            waveform="rigol",
        ),
        "rigol-2000": Family(
            "RIGOL TECHNOLOGIES,DS2202,DS2A000000001,00.03.00",
            ":DISPlay:DATA?",
            picture=".bmp",
            waveform="rigol",
        ),
        "siglent": Family(
            "SIGLENT,SDS1104X-E,SDSMM00000001,8.2.6.1.37",
            "SCDP",
            picture=".bmp",
            as_block=False,
            newline=False,
            accepts=("CHDR", "WFSU"),
            waveform="siglent",
        ),
        "siglent-plus": Family(
            "SIGLENT,SDS2104X Plus,SDS2P00000001,1.3.9R6",
            "PRINt?",
            "PNG",
            as_block=False,
            accepts=("CHDR",),
            waveform="siglent-block",
        ),
        "siglent-hd": Family(
            "SIGLENT,SDS2104X HD,SDS2H00000001,1.2.3.6",
            "PRINt?",
            "PNG",
            accepts=("CHDR",),
            waveform="siglent-wide",
        ),
        "tektronix": Family(
            "TEKTRONIX,MSO2024B,C000001,CF:91.1CT FV:v1.52",
            "HARDCopy",
            "START",
            as_block=False,
            newline=False,
            prepared_by=("SAVe:IMAGe:FILEFormat",),
            accepts=("HARDCopy:INKSaver", "HEADer"),
            waveform="tektronix",
        ),
        "rohde": Family(
            "Rohde&Schwarz,RTB2004,1333.1005k04/000001,02.400",
            "HCOPy:DATA?",
            prepared_by=("HCOPy:FORMat",),
            accepts=("HCOPy:LANGuage",),
            waveform="rohde",
        ),
        "lecroy": Family(
            "LECROY,WAVERUNNER8104,LCRY0000000001,8.5.0",
            "SCDP",
            as_block=False,
            newline=False,
            prepared_by=("HCSU",),
            accepts=("CHDR",),
            waveform="",
        ),
    }
)

_PREAMBLE = (1e-6, -5e-4, 0.04, 0.12)
"""Time step and time of the first sample (s); voltage step and voltage of the middle (V)."""


def _grey() -> NDArray[np.uint8]:
    """Test image."""
    return np.add.outer(np.arange(120), np.arange(200)).astype(np.uint8)


def _ramp() -> NDArray[np.uint8]:
    return np.arange(1000).astype(np.uint8)


@dataclass(eq=False)
class Oscilloscope(Machine):
    r"""Simulated oscilloscope.

    Parameters
    ----------
    family : str
        One of :data:`FAMILIES`.
    screen : callable
        Returns the grey image on the screen.
    samples : callable
        Returns the samples of channel 1, 0 to 255.

    Examples
    --------
    >>> Oscilloscope("rohde").receive(b"*IDN?\n")
    [b'Rohde&Schwarz,RTB2004,1333.1005k04/000001,02.400\n']
    """

    family: str = "keysight"
    screen: Callable[[], NDArray[np.uint8]] = _grey
    samples: Callable[[], NDArray[np.uint8]] = _ramp
    running: bool = True
    _errors: list[str] = field(default_factory=list)
    _seen: set[str] = field(default_factory=set)
    _settings: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__init__()
        self._like = FAMILIES[self.family]
        self._silent, self._wrong_size = 0, False
        self._begun = b""
        self._piece, self._wide = 0, False

    def receive(self, data: bytes) -> list[bytes]:
        """Return the answers to program messages that end with a newline, as on a raw socket."""
        *messages, self._begun = (self._begun + data).split(b"\n")
        if len(self._begun) > _LONGEST:
            self.violations.append("a program message without end")
            self._begun = b""
        return [answer for message in messages if (answer := self.execute(message)) is not None]

    def disconnected(self) -> None:
        """Discard an incomplete message."""
        self._begun = b""

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: two answers are missing; wrong state: an error; out of range: truncated; power: defaults."""
        if kind == "stuck":
            self._silent = 2
        elif kind == "wrong state":
            self._errors.append('-221,"Settings conflict"')
        elif kind == "out of range":
            self._wrong_size = True
        elif kind == "power-cycled":
            self._seen.clear()
            self._errors.clear()
            self._settings.clear()
            self.running = True

    def execute(self, message: bytes) -> bytes | None:
        """Return the answer to a program message, if any; several answers are joined by semicolons."""
        text = message.strip(b"\r\n").decode("latin-1")
        answers = []
        for header, arguments in split_message(text):
            answer = self._unit(header, arguments)
            if answer is not None:
                answers.append(answer)
        if not answers:
            return None
        if self._silent:
            self._silent -= 1
            return None
        joined = b";".join(answers)
        bare = any(self._is_screen(header) for header, _ in split_message(text)) and not self._like.newline
        return joined if bare else joined + b"\n"

    def _is_screen(self, header: str) -> bool:
        return Header(self._like.screen).matches(header)

    def _unit(self, header: str, arguments: str) -> bytes | None:
        if self._is_screen(header):
            return self._screenshot(arguments)
        for written, answer in self._common().items():
            if Header(written).matches(header):
                return answer(arguments)
        for written in (*self._like.prepared_by, *self._like.accepts):
            if Header(written).matches(header):
                self._seen.add(written)
                return None
        for written, found in self._waveform().items():
            if Header(written).matches(header):
                return found(arguments, header)
        self._error(f'-113,"Undefined header"; {header}')
        return None

    def _error(self, said: str) -> None:
        self._errors.append(said.split(";")[0])
        self.violations.append(said)

    def _common(self) -> dict[str, Callable[[str], bytes | None]]:
        def taken(done: Callable[[], Any]) -> Callable[[str], None]:
            return lambda _: (done(), None)[1]

        def run(running: bool) -> Callable[[], None]:
            return lambda: setattr(self, "running", running)

        return {
            "*IDN?": lambda _: self._like.idn.encode(),
            "*OPC?": lambda _: b"1",
            "*CLS": taken(self._errors.clear),
            "*RST": taken(lambda: self.inject_fault("power-cycled")),
            "*TST?": lambda _: b"0",
            ":SYSTem:ERRor?": lambda _: (self._errors.pop(0) if self._errors else '0,"No error"').encode(),
            ":STOP": taken(run(False)),
            ":RUN": taken(run(True)),
            "STOP": taken(run(False)),
            "TRMD": taken(run(False)),
            "ACQuire:STATE": taken(run(False)),
        }

    def _screenshot(self, arguments: str) -> bytes | None:
        like = self._like
        wanted, asked = like.screen_arguments.replace(" ", ""), arguments.upper().replace(" ", "")
        # Keysight supports both.
        as_bmp = wanted == "PNG,COLOR" and asked == "BMP,COLOR"
        if asked != wanted and not as_bmp:
            self._error(f'-108,"Parameter not allowed"; {like.screen} {arguments}')
            return None
        if missing := set(like.prepared_by) - self._seen:
            self._error(f'-221,"Settings conflict"; {", ".join(missing)} was not sent')
            return None
        found, coded = cv2.imencode(".bmp" if as_bmp else like.picture, self.screen())
        data = coded.tobytes() if found else b""
        if self._wrong_size:
            self._wrong_size, data = False, data[:-30]
        return block(data) if like.as_block else data

    def _waveform(self) -> dict[str, Callable[[str, str], bytes | None]]:
        """Return the headers with which this maker transfers waveforms."""
        dx, x0, dy, y0 = _PREAMBLE

        def say(text: str) -> Callable[[str, str], bytes]:
            return lambda _arguments, _header: text.encode()

        def take(_arguments: str, _header: str) -> None:
            return None

        data = self.samples()
        n, code = len(data), data.astype(np.int16) - 128
        match self._like.waveform:
            case "keysight" | "rigol":
                yref = 128 if self._like.waveform == "keysight" else 128 - round(y0 / dy)
                yorigin = y0 if self._like.waveform == "keysight" else 0
                preamble = f"0,0,{n},1,{dx:.6e},{x0:.6e},0,{dy:.6e},{yorigin:g},{yref}"
                return {
                    ":WAVeform:SOURce": take,
                    ":WAVeform:MODE": take,
                    ":WAVeform:FORMat": take,
                    ":WAVeform:UNSigned": take,
                    ":WAVeform:PREamble?": say(preamble),
                    ":WAVeform:DATA?": lambda _a, _h: block(data.tobytes()),
                }
            case "siglent":
                signed = code.astype(np.int8).tobytes()
                return {
                    "C<n>:VDIV?": say(f"{25 * dy:.6E}"),
                    "C<n>:OFST?": say(f"{-y0:.6E}"),
                    "SARA?": say(f"{1 / dx:.6E}"),
                    "TDIV?": say(f"{-x0 * 2 / 14:.12E}"),
                    "C<n>:WF?": lambda _a, _h: b"DAT2," + block(signed) + b"\n",
                }
            case "siglent-block" | "siglent-wide":
                return self._descriptor(code)
            case "tektronix":
                return {
                    "DATa:SOUrce": take,
                    "DATa:ENCdg": take,
                    "DATa:WIDth": take,
                    "WFMOutpre:XINcr?": say(f"{dx:.6E}"),
                    "WFMOutpre:XZEro?": say(f"{x0:.6E}"),
                    "WFMOutpre:YMUlt?": say(f"{dy:.6E}"),
                    "WFMOutpre:YOFf?": say("0.0"),
                    "WFMOutpre:YZEro?": say(f"{y0:.6E}"),
                    "CURVe?": lambda _a, _h: block(code.astype(np.int8).tobytes()),
                }
            case "rohde":
                volts = code * dy + y0
                real = struct.pack(f"<{n}f", *volts)
                return {
                    "FORMat": take,
                    "FORMat:BORDer": take,
                    "CHANnel<n>:DATA:HEADer?": say(f"{x0:.6E},{x0 + dx * n:.6E},{n},1"),
                    "CHANnel<n>:DATA?": lambda _a, _h: block(real),
                }
        return {}

    def _descriptor(self, code: NDArray[np.int16]) -> dict[str, Callable[[str, str], bytes | None]]:
        """Newer Siglent instruments: a wave descriptor, and samples in pieces."""
        dx, x0, dy, y0 = _PREAMBLE
        wide = self._like.waveform == "siglent-wide"
        samples = (16 * code).astype("<i2") if wide else code.astype(np.int8)
        head = bytearray(346)
        # A 10:1 probe: the voltage at its tip is ten times that of the descriptor.
        values = (116, "<i", len(code)), (156, "<f", 2.5 * dy), (160, "<f", -y0 / 10), (328, "<f", 10.0)
        scale = (164, "<f", 25.0 * (16 if wide else 1)), (172, "<H", 12 if wide else 8)
        for at, how, value in (*values, *scale, (176, "<f", dx), (180, "<d", 0.0)):
            struct.pack_into(how, head, at, value)

        def start(arguments: str, _header: str) -> None:
            self._piece = int(arguments)

        def width(arguments: str, _header: str) -> None:
            self._wide = arguments.upper() == "WORD"

        def data(_arguments: str, _header: str) -> bytes:
            if self._wide != wide:
                self._error('-221,"Settings conflict"; WIDTh')
            return block(samples[self._piece : self._piece + 400].tobytes())

        def take(_arguments: str, _header: str) -> None:
            return None

        return {
            ":WAVeform:SOURce": take,
            ":WAVeform:WIDTh": width,
            ":WAVeform:INTerval": take,
            ":WAVeform:POINt": take,
            ":WAVeform:STARt": start,
            ":TIMebase:SCALe?": lambda _a, _h: f"{-x0 / 5:.6E}".encode(),
            ":WAVeform:PREamble?": lambda _a, _h: block(bytes(head)),
            ":WAVeform:DATA?": data,
        }
