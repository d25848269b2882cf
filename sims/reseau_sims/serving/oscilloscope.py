"""Simulated SCPI oscilloscope with the commands of one of several makers; it shows the simulated world.

Source: programming manuals of the makers: sequences that transfer the screen and waveforms.
"""

from __future__ import annotations

import gzip
import struct
import tomllib
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau_drivers.codecs.ieee488 import Header, block

from .faults import Kind
from .machine import Machine
from .oscilloscope_settings import SETTINGS
from .program import Setting, Status, choice, numeric, string, units_of

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
    format : str
        Header of the setting that names another kind of file, if there is one.
    as_block : bool
        Whether the picture is sent as a block.
    newline : bool
        Whether a newline follows the picture.
    prepared_by : tuple of str
        Headers that must be sent before, in any order.
    waveform : str
        Transfer of waveforms: ``keysight``, ``infiniium``, ``rigol``, ``siglent``, ``siglent-block`` (and
        ``-wide``, with 16 bits), ``tektronix``, ``tektronix-tds``, ``rohde``.
    options : tuple of tuple of str
        Alternatives of each argument of the screen's header, where it has them; all are optional.
    saves : tuple of str
        Headers that save the screen to a file, read a file, and delete it, instead of a query.

    Examples
    --------
    >>> FAMILIES["rigol-1000z"].screen
    ':DISPlay:DATA?'
    """

    idn: str
    screen: str
    screen_arguments: str = ""
    picture: str = ".png"
    format: str = ""
    as_block: bool = True
    newline: bool = True
    prepared_by: tuple[str, ...] = ()
    waveform: str = "keysight"
    options: tuple[tuple[str, ...], ...] = ()
    saves: tuple[str, ...] = ()


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


FAMILIES: Mapping[str, Family] = MappingProxyType(
    {
        name: Family(**{key: _frozen(value) for key, value in told.items()})
        for name, told in tomllib.loads(
            Path(__file__).with_name("oscilloscopes.toml").read_text("utf-8")
        ).items()
    }
)

_PREAMBLE = (1e-6, -5e-4, 0.04, 0.12)
"""Time step and time of the first sample (s); voltage step and voltage of the middle (V)."""


_SUFFIXES = {
    "PNG": ".png", "JPG": ".jpg", "TIF": ".tif", "BMP": ".bmp", "BMPC": ".bmp", "BMP8": ".bmp", "GIF": ".bmp",
}  # fmt: skip
"""Kinds of files; GIF is not drawn."""


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
    status: Status = field(default_factory=Status)
    _seen: set[str] = field(default_factory=set)
    _values: dict[str, str] = field(default_factory=dict)
    _files: dict[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__init__()
        self._like = FAMILIES[self.family]
        self._silent, self._wrong_size = 0, False
        self._begun = b""
        self._piece, self._wide = 0, False
        self._dumped = 0

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
            self.status.error('-221,"Settings conflict"')
        elif kind == "out of range":
            self._wrong_size = True
        elif kind == "power-cycled":
            self._seen.clear()
            self._values.clear()
            self.status.clear()
            self.running = True

    def execute(self, message: bytes) -> bytes | None:
        """Return the answer to a program message, if any; several answers are joined by semicolons."""
        text = message.strip(b"\r\n").decode("latin-1")
        # A newline ends a message (IEEE 488.2, 7.5) also where the transport marks the end itself.
        units, answers = [unit for line in text.split("\n") for unit in units_of(line)], []
        for header, arguments in units:
            answer = self._unit(header, arguments)
            if answer is not None:
                answers.append(answer)
        if not answers:
            return None
        if self._silent:
            self._silent -= 1
            return None
        joined = b";".join(answers)
        bare = any(self._is_picture(header) for header, _ in units) and not self._like.newline
        return joined if bare else joined + b"\n"

    def serial_poll(self, available: bool) -> int:
        """Return the status byte, given whether an answer can be read."""
        return self.status.poll(available)

    def _is_picture(self, header: str) -> bool:
        written = self._like.saves[1] if self._like.saves else self._like.screen
        return Header(written).matches(header)

    def _unit(self, header: str, arguments: str) -> bytes | None:
        try:
            return self._obey(header, arguments)
        except ValueError as error:
            self._error(f"{error}; {header} {arguments}")
            return None

    def _obey(self, header: str, arguments: str) -> bytes | None:
        if header.startswith("*"):
            return self._common(header, arguments)
        if self._like.waveform == "" and (dump := self._dump(header, arguments)) is not None:
            return dump or None
        if any(Header(each).matches(header) for each in self._like.saves):
            return self._file(header, arguments)
        if Header(self._like.screen).matches(header):
            return self._screenshot(arguments)
        for written, act in self._actions().items():
            if Header(written).matches(header):
                return act(arguments)
        for setting in SETTINGS[self._like.waveform]:
            if setting.matches(header):
                return self._set(setting, header, arguments)
        for written, found in self._waveform().items():
            if Header(written).matches(header):
                return self._headed(written, found(arguments, header))
        raise ValueError('-113,"Undefined header"')

    def _set(self, setting: Setting, header: str, arguments: str) -> bytes | None:
        number = "".join(c for c in header if c.isdigit()) if "<n>" in setting.written else ""
        key = setting.written.replace("<n>", number)
        if header.endswith("?"):
            if not arguments:
                return self._headed(key, self._values.get(key, setting.value).encode())
            return setting.read(arguments).encode()  # the limit that MINimum or MAXimum stands for
        if not arguments:
            raise ValueError('-109,"Missing parameter"')
        self._values[key] = setting.read(arguments)
        self._seen.add(setting.written)
        return None

    def _headed(self, written: str, answer: bytes | None) -> bytes | None:
        """Tektronix: an answer begins with its header, unless HEADer is off."""
        if answer is None or not self._like.waveform.startswith("tektronix") or self._value("HEADer") == "0":
            return answer
        name = written.removesuffix("?")
        short = "".join(c for c in name if not c.islower())
        return f":{name.upper() if self._value('VERBose') == '1' else short} ".encode() + answer

    def _value(self, written: str) -> str:
        """A setting that is in force."""
        usual = next(each.value for each in SETTINGS[self._like.waveform] if each.written == written)
        return self._values.get(written, usual)

    def _error(self, said: str) -> None:
        self.status.error(said.split(";")[0])
        self.violations.append(said)

    def _common(self, header: str, arguments: str) -> bytes | None:
        name = header.upper()
        if name == "*IDN?":
            return self._like.idn.encode()
        if name == "*RST":
            self.inject_fault("power-cycled")
            return None
        try:
            answer = self.status.common(header, arguments)
        except KeyError:
            raise ValueError('-113,"Undefined header"') from None
        return None if answer is None else answer.encode()

    def _actions(self) -> dict[str, Callable[[str], bytes | None]]:
        def run(running: bool) -> Callable[[str], None]:
            return lambda _: setattr(self, "running", running)

        def acquire(arguments: str) -> None:
            self.running = arguments.strip().upper() in ("RUN", "ON", "1")

        def error(_: str) -> bytes:
            return self.status.next_error().encode()

        return {
            ":SYSTem:ERRor?": error,
            ":SYSTem:ERRor:NEXT?": error,
            ":STOP": run(False),
            ":RUN": run(True),
            ":SINGle": run(False),
            "TRMD": run(False),
            "ACQuire:STATE": acquire,
        }

    def _file(self, header: str, arguments: str) -> bytes | None:
        """Save the screen to a file, read a file, or delete it."""
        save, read, _ = self._like.saves
        if Header(save).matches(header):
            name = string(arguments) if arguments else self._values.get("MMEMory:NAME", "")
            self._require_settings()
            self._files[name] = self._picture(".png")
            return None
        name = string(arguments)
        if name not in self._files:
            raise ValueError('-256,"File name not found"')
        if Header(read).matches(header):
            data = self._files[name]
            return block(data) if self._like.as_block else data
        del self._files[name]
        return None

    def _dump(self, header: str, arguments: str) -> bytes | None:
        """LeCroy: a screen dump to a file, its register INR, and the file; None for other headers.

        Source: *MAUI Oscilloscopes Remote Control and Automation Manual*, HCSU, INR?, TRFL?, DELF.
        """
        name = f"{self._option('DIR')}\\{self._option('FILE')}--00000.png"
        wanted = string(arguments.rpartition(",")[2]) if arguments.startswith("DISK") else ""
        match header.upper():
            case "SCDP" if self._option("DEST") == "FILE":
                self._files[name] = self._picture(".png")
                self._dumped = 2
                return b""
            case "INE":
                return b""
            case "INR?":
                found, self._dumped = self._dumped, 0
                return (b"" if self._value("CHDR") == "OFF" else b"INR ") + str(found).encode()
            case "DELF":
                self._files.pop(wanted, None)
                return b""
            case "TRFL?" if wanted in self._files:
                data = self._files[wanted]
                return b"TRFL #" + block(data)[1:] + f"{zlib.crc32(data):08X}\r".encode()
        return None

    def _option(self, name: str) -> str:
        """The value after a name in HCSU, such as DEST; empty without one."""
        parts = [part.strip().strip("'") for part in self._values.get("HCSU", "").split(",")]
        return dict(zip(parts[::2], parts[1::2], strict=False)).get(name, "")

    def _require_settings(self) -> None:
        if missing := set(self._like.prepared_by) - self._seen:
            raise ValueError(f'-221,"Settings conflict"; {", ".join(missing)} was not sent')

    def _picture(self, suffix: str) -> bytes:
        screen = self.screen()
        if self._like.waveform == "tektronix-tds" and self._value("HARDCopy:LAYout") == "LAN":
            screen = np.rot90(screen)
        found, coded = cv2.imencode(suffix, screen)
        data = coded.tobytes() if found else b""
        if self._wrong_size:
            self._wrong_size, data = False, data[:-30]
        return data

    def _screenshot(self, arguments: str) -> bytes | None:
        like, kind = self._like, self._value(self._like.format) if self._like.format else ""
        given = [part.strip() for part in arguments.split(",")] if arguments else []
        if like.options:
            if len(given) > len(like.options):
                raise ValueError('-108,"Parameter not allowed"')
            kinds = [choice(*known)(text) for text, known in zip(given, like.options, strict=False)]
            kind = kind or (kinds[0] if kinds else "")
        elif ",".join(given).upper() != like.screen_arguments.replace(" ", ""):
            raise ValueError('-108,"Parameter not allowed"')
        self._require_settings()
        if like.waveform == "tektronix-tds" and self._value("HARDCopy:PORT") not in ("GPI", "USB"):
            return None  # printed, or saved to a file
        data = self._picture(_SUFFIXES.get(kind, like.picture))
        if like.waveform == "tektronix-tds" and self._value("HARDCopy:COMPRession") == "1":
            data = gzip.compress(data)
        return block(data) if like.as_block else data

    def _waveform(self) -> dict[str, Callable[[str, str], bytes | None]]:
        """Return the headers with which this maker transfers waveforms."""
        dx, x0, dy, y0 = _PREAMBLE

        def say(text: str) -> Callable[[str, str], bytes]:
            return lambda _arguments, _header: text.encode()

        data = self.samples()
        n, code = len(data), data.astype(np.int16) - 128
        match self._like.waveform:
            case "keysight" | "rigol" | "infiniium":
                return self._words(data)
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
            case "tektronix" | "tektronix-tds":
                wide = 256 if self._value("DATa:WIDth") == "2" else 1
                # Older instruments count the samples from the trigger.
                older = self._like.waveform == "tektronix-tds"
                group, first = ("WFMPre", n // 2) if older else ("WFMOutpre", 0)
                return {
                    f"{group}:XINcr?": say(f"{dx:.6E}"),
                    f"{group}:XZEro?": say(f"{x0 + dx * first:.6E}"),
                    f"{group}:PT_Off?": say(str(first)),
                    f"{group}:YMUlt?": say(f"{dy / wide:.6E}"),
                    f"{group}:YOFf?": say(f"{128 * wide if self._positive else 0:.6E}"),
                    f"{group}:YZEro?": say(f"{y0:.6E}"),
                    f"{group}:NR_Pt?": say(str(n)),
                    f"{group}:BYT_Nr?": say(self._value("DATa:WIDth")),
                    "CURVe?": lambda _a, _h: self._curve(code.astype(np.int64), wide),
                }
            case "rohde":
                return {
                    "CHANnel<n>:DATA:HEADer?": say(f"{x0:.6E},{x0 + dx * n:.6E},{n},1"),
                    "CHANnel<n>:DATA:YINCrement?": say(f"{dy:.6E}"),
                    "CHANnel<n>:DATA:YORigin?": say(f"{y0 - 128 * dy:.6E}"),
                    "CHANnel<n>:DATA?": lambda _a, _h: self._real(data, code.astype(np.float64) * dy + y0),
                }
        return {}

    def _words(self, data: NDArray[np.uint8]) -> dict[str, Callable[[str, str], bytes | None]]:
        """Keysight and Rigol: bytes, words or text, and the numbers of the preamble."""
        dx, x0, dy, y0 = _PREAMBLE
        kind, form = self._like.waveform, self._value(":WAVeform:FORMat")
        scale = 256 if form == "WORD" and kind != "rigol" else 1
        signed = kind == "infiniium" or (kind == "keysight" and self._value(":WAVeform:UNSigned") == "0")
        middle = 0 if signed else 128 * scale
        yref, yorigin = (128 - round(y0 / dy), 0.0) if kind == "rigol" else (middle, y0)
        numbers = {"keysight": (0, 1, 4), "rigol": (0, 1, 2), "infiniium": (1, 2, 0)}[kind]
        number = dict(zip(("BYTE", "WORD", "ASC"), numbers, strict=True))[form]
        values = [
            number,
            0,
            len(data),
            1,
            f"{dx:.6e}",
            f"{x0:.6e}",
            0,
            f"{dy / scale:.6e}",
            f"{yorigin:g}",
            yref,
        ]
        fields = [str(value) for value in values]
        names = ("FORMat", "TYPE", "POINts", "COUNt", "XINCrement", "XORigin", "XREFerence", "YINCrement",
                 "YORigin", "YREFerence")  # fmt: skip
        codes = data.astype(np.int64) - 128

        def samples(_arguments: str, _header: str) -> bytes:
            if form == "ASC":
                text = ",".join(f"{value:.5E}" for value in codes * dy + y0).encode()
                return text if kind == "infiniium" else block(text)
            size = ("i" if signed else "u") + ("2" if form == "WORD" else "1")
            little = kind == "rigol" or self._value(":WAVeform:BYTeorder") == "LSBF"
            coded = (codes * scale + middle).astype(np.dtype(size).newbyteorder("<" if little else ">"))
            streamed = kind == "infiniium" and self._value(":WAVeform:STReaming") == "1"
            return b"#0" + coded.tobytes() if streamed else block(coded.tobytes())

        def say(text: str) -> Callable[[str, str], bytes]:
            return lambda _arguments, _header: text.encode()

        single = {f":WAVeform:{name}?": say(text) for name, text in zip(names, fields, strict=True)}
        return {":WAVeform:PREamble?": say(",".join(fields)), ":WAVeform:DATA?": samples, **single}

    @property
    def _positive(self) -> bool:
        return self._value("DATa:ENCdg") in ("RPB", "SRP")

    def _curve(self, code: NDArray[np.int64], wide: int) -> bytes:
        """Tektronix: the samples between two points in the chosen coding."""
        first, last = (int(float(self._value(f"DATa:{end}"))) for end in ("STARt", "STOP"))
        coding, part = self._value("DATa:ENCdg"), code[max(first, 1) - 1 : last] * wide
        if coding == "ASCI":
            return ",".join(str(value) for value in part).encode()
        kind = ("u" if self._positive else "i") + ("2" if wide > 1 else "1")
        order = "<" if coding in ("SRI", "SRP") else ">"
        shift = 128 * wide if self._positive else 0
        return block((part + shift).astype(order + kind).tobytes())

    def _real(self, data: NDArray[np.uint8], volts: NDArray[np.float64]) -> bytes:
        """Rohde & Schwarz: text, or a block of floating point numbers or integers."""
        form = self._values.get("FORMat", self._values.get("FORMat:DATA", "ASC"))
        if form == "ASC":
            return ",".join(f"{value:.5E}" for value in volts).encode()
        order = "<" if self._value("FORMat:BORDer") == "LSBF" else ">"
        if form.startswith("REAL"):
            return block(volts.astype(f"{order}f4").tobytes())
        size = 2 if form.endswith("16") else 1
        return block((data.astype(np.int64) * 256 ** (size - 1)).astype(f"{order}u{size}").tobytes())

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
            self._piece = int(float(numeric(low=0, high=1e9)(arguments)))

        def width(arguments: str, _header: str) -> None:
            self._wide = choice("BYTE", "WORD")(arguments) == "WORD"

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
