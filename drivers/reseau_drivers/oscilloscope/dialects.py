"""Commands for screen pictures and waveforms of families of oscilloscopes, read from ``profiles/*.toml``.

A profile says by which answers to ``*IDN?`` a family is known, which commands it takes, how its answers begin
and end, and how numbers become volts; every line names its public source. Users add a family by a file of the
same form, without code.
"""

from __future__ import annotations

import ast
import operator
import re
import struct
import tomllib
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from reseau.core.data import Array
from reseau.core.errors import FormatError, ProtocolError, SettingError

from ..codecs.ieee488 import missing_bytes, picture
from ..codecs.numbers import INFINITE
from ..profiles import CONTROLLER_SCHEMA, CONTROLLERS, FOLDER, controller, text_of
from .screens import bytes_of_colours, packets_missing, picture_after, pixels_of_packets, runs_of_colours

Numbers = Mapping[str, Any]
SCHEMA = "reseau-instrument-profile/1"
_ACTS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.USub: operator.neg,
}  # fmt: skip
_ANSWERS: Mapping[str, Callable[[bytes], bytes]] = {
    "picture": picture,
    "bytes of colours": bytes_of_colours,
    "runs of colours": runs_of_colours,
    "picture after 4 bytes": lambda answer: picture_after(answer, 4),
    "picture after 12 bytes": lambda answer: picture_after(answer, 12),
    "packets of pixels": lambda answer: answer,
}


class Formula:
    """Arithmetic of numbers by their names: ``+ - * /`` and parentheses.

    Raises
    ------
    ValueError
        If the text has anything else.

    Examples
    --------
    >>> Formula("(code - yoff) * dy")({"code": 3.0, "yoff": 1.0, "dy": 0.5})
    1.0
    """

    def __init__(self, text: str) -> None:
        try:
            self._tree = ast.parse(text, mode="eval").body
        except SyntaxError:
            raise ValueError(f"{text!r} is not a formula") from None
        self.names = {node.id for node in ast.walk(self._tree) if isinstance(node, ast.Name)}
        for node in ast.walk(self._tree):
            known = isinstance(node, ast.Name | ast.Load | ast.BinOp | ast.UnaryOp) or type(node) in _ACTS
            if not (known or (isinstance(node, ast.Constant) and type(node.value) in (int, float))):
                raise ValueError(f"{text!r} has more than + - * / of names and numbers")

    def __call__(self, numbers: Numbers) -> Any:
        """Return the value for these numbers."""
        return self._value(self._tree, numbers)

    def _value(self, node: ast.expr, numbers: Numbers) -> Any:
        match node:
            case ast.Constant(value):
                return value
            case ast.Name(name):
                return numbers[name]
            case ast.BinOp(left, act, right):
                return _ACTS[type(act)](self._value(left, numbers), self._value(right, numbers))
            case ast.UnaryOp(act, operand):
                return _ACTS[type(act)](self._value(operand, numbers))
        raise AssertionError(node)


def _formula(text: Any) -> Any:
    return Formula(text) if isinstance(text, str) else text


_Formula = Annotated[Formula, BeforeValidator(_formula)]


class _Part(BaseModel):
    """A part of a profile: no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)


class WaveformDialect(_Part):
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
    volts : Formula
        Of the samples (``code``) and numbers.
    start, step : Formula
        Time of the first sample and time step (s), of the numbers.
    units : mapping
        Units that may follow numbers, by their names.
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
    scale: dict[str, str]
    data: str
    dtype: str
    volts: _Formula
    start: _Formula = Formula("x0")
    step: _Formula = Formula("dx")
    units: dict[str, str] = Field(default_factory=dict)
    preamble: str = ""
    fields: dict[str, tuple[int, str]] = Field(default_factory=dict)
    wide: tuple[str, str] | None = None
    piece: str = ""
    more: tuple[int, ...] = (0,)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Formulas have numbers that are asked for; types of samples exist."""
        known = {name for names in self.scale for name in names.split()} | set(self.fields)
        lacking = (self.volts.names - {"code"} | self.start.names | self.step.names) - known
        if lacking:
            raise ValueError(f"no query gives {', '.join(sorted(lacking))}")
        for each in (self.dtype, *(self.wide or ())[1:]):
            try:
                np.dtype(each)
            except TypeError:
                raise ValueError(f"{each!r} is no data type of NumPy") from None
        struct.calcsize("".join(form for _, form in self.fields.values()).replace("<", "").replace(">", ""))
        return self

    def sampled(self, numbers: Numbers) -> tuple[str, str]:
        """Return the command for the sample width, and the data type."""
        return self.wide if self.wide and numbers.get("bits", 8) > 8 else ("", self.dtype)


class Maker(_Part):
    """A maker: what ``*IDN?`` begins with, and models that are no oscilloscopes.

    Parameters
    ----------
    maker : str
        Its name.
    identities, others : str
        Regular expressions for the beginning of the identity, and of the model of what is no oscilloscope.
    greetings : str
        Regular expression for what it may send before its first answer.
    refusals : mapping
        What to do, by a text in answers that are none.
    sources : mapping
        Public sources, by their numbers in the comments of the lines.
    """

    maker: str
    identities: str
    others: str = ""
    greetings: str = ""
    refusals: dict[str, str] = Field(default_factory=dict)
    sources: dict[str, str]


class Dialect(_Part):
    """Commands of one family of oscilloscopes.

    Parameters
    ----------
    name : str
        Name of the family; begins with that of the maker.
    models : str
        Regular expression for the beginning of the model.
    examples : tuple of str
        Identities of instruments of this family.
    screen : tuple of str
        Steps to obtain the screen picture: ``send`` a command, where ``{port}`` is the port that it is
        connected to; ``query``: wait for a line and ignore it; ``fetch`` the picture.
    answer : str
        What the answer with the picture is.
    waveform : WaveformDialect, optional
        None if waveforms are not supported.
    setup : tuple of str
        Commands sent after connecting.
    halt : str
        Command that stops the acquisition.
    errors : str
        Query for the oldest error; empty if there is no error queue.
    ends : str
        What ends a command.
    identifies : bool
        Whether it answers ``*IDN?``.
    silent : str
        What it may lack if it does not answer.
    palette : tuple of str
        Colours of the codes of pixels, in hexadecimal: 256 of them, or none.
    maker : Maker
        Its maker.

    Examples
    --------
    >>> dialect_named("Keysight InfiniiVision X").screen[1]
    'fetch :DISPlay:DATA? PNG, COLor'
    """

    name: str
    models: str
    examples: tuple[Annotated[str, Field(pattern=",")], ...] = ()
    screen: tuple[Annotated[str, Field(pattern=r"^(send|query|fetch) ([^{}]|\{port\})+$")], ...]
    answer: Literal[tuple(_ANSWERS)] = "picture"  # type: ignore[valid-type]
    waveform: WaveformDialect | None = None
    setup: tuple[str, ...] = ()
    halt: str = ":STOP"
    errors: str = ":SYSTem:ERRor?"
    ends: Annotated[str, Field(pattern=r"^[\r\n\x00;]*$")] = "\n"
    identifies: bool = True
    silent: str = ""
    palette: tuple[Annotated[str, Field(pattern=r"^([0-9A-Fa-f]{6})+$")], ...] = ()
    maker: Maker

    @model_validator(mode="after")
    def _coloured(self) -> Self:
        if (self.answer == "packets of pixels") != (len("".join(self.palette)) == 6 * 256):
            raise ValueError("`palette` has 256 colours with packets of pixels, and none otherwise")
        return self

    @property
    def missing(self) -> Callable[[bytes, bool], int | None] | None:
        """How many bytes are missing from an answer with the picture; None: as of a block or picture."""
        match self.answer.split():
            case ["picture", "after", ahead, _]:
                return lambda answer, ended: missing_bytes(answer[int(ahead) :], ended)
            case ["packets", *_]:
                return lambda answer, ended: packets_missing(answer)
        return None

    def decode(self, answer: bytes) -> bytes:
        """Make a PNG or BMP file from the answer with the picture."""
        return pixels_of_packets(answer, self.palette) if self.palette else _ANSWERS[self.answer](answer)


def read_profiles(text: str, *, where: object) -> tuple[Maker, tuple[Dialect, ...]]:
    """Read a maker and the profiles of its families.

    Parameters
    ----------
    text : str
        TOML of the schema ``reseau-instrument-profile/1``.
    where : object
        Names the text in messages.

    Raises
    ------
    FormatError
        If it is not such a document.

    Examples
    --------
    >>> read_profiles('schema = "other/1"', where="mine.toml")
    Traceback (most recent call last):
    reseau.core.errors.FormatError: mine.toml: schema 'other/1' is not reseau-instrument-profile/1
    """
    try:
        content = tomllib.loads(text)
        if (found := content.pop("schema", None)) != SCHEMA:
            raise FormatError(f"schema {found!r} is not {SCHEMA}", where=where)
        profiles, waveforms = content.pop("profiles", []), content.pop("waveforms", {})
        maker, dialects = Maker(**content), list[Dialect]()
        for each in profiles:
            if "waveform" in each:
                each["waveform"] = waveforms[each["waveform"]]
            dialects.append(Dialect(maker=maker, **each))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(f"is not TOML ({error})", where=where) from None
    except KeyError as error:
        raise FormatError(f"there are no [waveforms.{error.args[0]}]", where=where) from None
    except (ValidationError, TypeError, struct.error) as error:
        raise FormatError(_first(error), where=where) from None
    fetches = [sum(step.startswith("fetch") for step in each.screen) for each in dialects]
    if fetches != [1] * len(dialects):
        raise FormatError("each `screen` needs one step that fetches the picture", where=where)
    return maker, tuple(dialects)


def _first(error: Exception) -> str:
    """The first error of a validation in one line."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors(include_url=False, include_context=False)[0]
    return f"`{'.'.join(map(str, first['loc']))}`: {first['msg'].removeprefix('Value error, ')}"


_FILES = {path: text for path in sorted(FOLDER.glob("*.toml")) if SCHEMA in (text := path.read_text("utf-8"))}
_READ = [read_profiles(text, where=path.name) for path, text in _FILES.items()]
MAKERS: tuple[Maker, ...] = tuple(maker for maker, _ in _READ)
DIALECTS: tuple[Dialect, ...] = tuple(each for _, dialects in _READ for each in dialects)


def dialect_named(name: str) -> Dialect:
    """Return a dialect by its name, or the one of a file of profiles (``FILE.toml``, ``FILE.toml#NAME``).

    Raises
    ------
    SettingError
        If there is none.
    FormatError
        If the file has no profiles.
    """
    path, _, wanted = name.partition("#")
    known, chosen = DIALECTS, name
    if path.endswith(".toml"):
        _, known = read_profiles(text_of(path), where=path)
        chosen = wanted or (known[0].name if len(known) == 1 else "")
    found = next((each for each in known if each.name == chosen), None)
    if found is None:
        raise SettingError(
            "is not a known dialect", where=name, do=f"choose from {', '.join(each.name for each in known)}"
        )
    return found


def described(name: str = "") -> str:
    """Return a profile as a file of its own, with the sources of its lines; entry point ``profiles``.

    Parameters
    ----------
    name : str
        Name of a dialect or a controller; a file of profiles, which is checked and listed; empty: list all.

    Raises
    ------
    SettingError
        If there is none of this name.
    FormatError
        If a file has no profiles.

    Examples
    --------
    >>> read_profiles(described("Rigol 1000Z"), where="")[1][0].examples[1]
    'RIGOL TECHNOLOGIES,MSO1104Z,M,1'
    """
    if name.endswith(".toml") and "#" not in name and CONTROLLER_SCHEMA in text_of(name):
        return f"a controller, {controller(own=name)['name']}: for `dialect` in the options of a table\n"
    if not name or (name.endswith(".toml") and "#" not in name):
        known = DIALECTS if not name else read_profiles(text_of(name), where=name)[1]
        examples = {
            each.name: ", ".join(example.split(",")[1] for example in each.examples) for each in known
        }
        examples |= (
            {} if name else dict.fromkeys(CONTROLLERS, "commands, states, codes and flags of a controller")
        )
        return "".join(f"{each}: {models}".rstrip(": ") + "\n" for each, models in examples.items())
    if name in CONTROLLERS:
        return (FOLDER / f"{name}.toml").read_text("utf-8")
    dialect, path = dialect_named(name), name.partition("#")[0]
    texts = [text_of(path)] if path.endswith(".toml") else _FILES.values()
    text = next(text for text in texts if f'name = "{dialect.name}"' in text)
    head, *parts = re.split(r"(?m)^(?=\[)", text)
    kept = [part for part in parts if not part.startswith(("[[profiles]]", "[waveforms"))]
    own = next(part for part in parts if f'name = "{dialect.name}"' in part)
    if found := re.search(r'(?m)^waveform = "(\w+)"', own):
        kept += [part for part in parts if part.startswith(f"[waveforms.{found[1]}]")]
    return "".join([head, *kept, own]).rstrip() + "\n"


def _is(maker: Maker, models: str, identity: str) -> bool:
    """Whether an identity is of a maker and of models."""
    return re.match(rf"({maker.identities})[^,]*, *({models})", identity, re.IGNORECASE) is not None


def _nearness(dialect: Dialect, model: str) -> int:
    """How many characters a model has in common with those of a family."""
    names = [example.split(",")[1].strip() for example in dialect.examples]
    same = ([a == b for a, b in zip(model, name, strict=False)] + [False] for name in names)
    return max((each.index(False) for each in same), default=0)


def candidates_of(identity: str) -> tuple[Dialect, ...]:
    """Return the dialects that an instrument of an unknown model may have: its nearest relatives first.

    Raises
    ------
    ProtocolError
        If it is known to be no oscilloscope.

    Examples
    --------
    >>> [dialect.name for dialect in candidates_of("RIGOL TECHNOLOGIES,MSO5999,1,1")]
    ['Rigol', 'Rigol 1000Z', 'Rigol DS1000D and DS1000E']
    """
    identity = identity.strip()
    asked, model = DIALECTS, identity.partition(",")[2].partition(",")[0].strip()
    for maker in MAKERS:
        if _is(maker, "", identity):
            asked = tuple(each for each in DIALECTS if each.maker is maker)
            if not asked or (maker.others and _is(maker, maker.others, identity)):
                raise ProtocolError(f"{identity!r} is no oscilloscope", do="check the address")
            break
    else:
        model = ""
    return tuple(
        sorted((each for each in asked if each.identifies), key=lambda each: -_nearness(each, model))
    )


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
    possible = {each.name for each in candidates_of(identity)}
    fitting = (each for each in DIALECTS if _is(each.maker, each.models, identity.strip()))
    return next((each for each in fitting if each.name in possible), None)


def fields_of(block: bytes, dialect: WaveformDialect) -> dict[str, float]:
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
    volts: Array = dialect.volts({**numbers, "code": codes})
    if not np.all(np.abs(volts) < INFINITE):
        raise ProtocolError("some samples stand for no value", do="is the channel on?")
    return volts
