"""Drivers of sensors of the environment: SCPI instruments, Modbus devices, and lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from reseau.core.errors import SettingError

from ..codecs.sentence import Checksum, Sentence
from ..link import Link, link_to
from ..visa import scpi_link
from .probes import Framing, LineProbe, ModbusProbe, Register, ScpiProbe
from .sensor import EnvironmentSensor, Quantity, SensorSettings, quantities_of

__all__ = [
    "EnvironmentSensor",
    "LineProbe",
    "ModbusProbe",
    "Quantity",
    "Register",
    "ScpiProbe",
    "SensorSettings",
    "environment_line",
    "environment_modbus",
    "environment_scpi",
]


def environment_scpi(
    name: str,
    address: str | Link,
    *,
    quantities: Mapping[str, Mapping[str, Any]],
    answer_s: float = 1.0,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> EnvironmentSensor:
    """Create the driver of a sensor that is asked with SCPI; entry point ``environment_scpi``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str or Link
        A VISA resource, ``tcp://host:port``, or a serial device.
    quantities : mapping
        Fields of :class:`Quantity` by name, each with its `query`.
    answer_s : float
        Time limit of an answer (s).
    settings : mapping, optional
        Empty: sensors have no settings.
    **options
        Further arguments of :class:`EnvironmentSensor`.

    Examples
    --------
    >>> asked = {"temperature": {"query": "MEAS:TEMP?", "sigma": 0.1}, "pressure": {"query": "MEAS:PRES?"}}
    >>> sorted(environment_scpi("air", "TCPIP::192.0.2.9::INSTR", quantities=asked).quantities)
    ['pressure', 'temperature']
    """
    known, own = quantities_of(quantities, ("query",))
    queries = {key: _needed(key, fields, "query") for key, fields in own.items()}
    # A sensor whose numbers are converted tells them in another unit.
    units = {key: each.unit for key, each in known.items() if (each.scale, each.offset) == (1.0, 0.0)}
    probe = ScpiProbe(scpi_link(address), queries, answer_s, units)
    return EnvironmentSensor(name, probe, known, SensorSettings().changed(settings or {}), **options)


def environment_modbus(
    name: str,
    address: str | Link,
    *,
    quantities: Mapping[str, Mapping[str, Any]],
    unit: int = 1,
    framing: Framing | None = None,
    answer_s: float = 1.0,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> EnvironmentSensor:
    """Create the driver of a sensor with Modbus; entry point ``environment_modbus``.

    Parameters
    ----------
    name, answer_s, settings, **options
        As for :func:`environment_scpi`.
    address : str or Link
        ``tcp://host:port`` (the port is 502 as a rule), or a serial device, ``/dev/ttyUSB2@9600``.
    quantities : mapping
        Fields of :class:`Quantity` and of :class:`Register` by name.
    unit : int
        Address of the device.
    framing : {"rtu", "tcp"}, optional
        Frames; by default those of TCP for ``tcp://``, and otherwise those of serial lines.

    Examples
    --------
    >>> sensor = environment_modbus("air", "tcp://192.0.2.9:502", unit=3, quantities={
    ...     "temperature": {"register": 0, "scale": 0.1}, "humidity": {"register": 1, "scale": 0.1}})
    >>> sensor.quantities["temperature"].scale
    0.1
    """
    known, own = quantities_of(quantities, ("register", "function", "format", "words"))
    for key, fields in own.items():
        _needed(key, fields, "register")
    registers = {key: Register(**fields) for key, fields in own.items()}
    if framing is None:
        framing = "tcp" if isinstance(address, str) and address.startswith("tcp://") else "rtu"
    probe = ModbusProbe(link_to(address, baud=19200), registers, unit, framing, answer_s)
    return EnvironmentSensor(name, probe, known, SensorSettings().changed(settings or {}), **options)


def environment_line(
    name: str,
    address: str | Link,
    *,
    pattern: str,
    quantities: Mapping[str, Mapping[str, Any]],
    query: str = "",
    checksum: Checksum = "none",
    answer_s: float = 2.5,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> EnvironmentSensor:
    """Create the driver of a sensor that sends lines of text; entry point ``environment_line``.

    Parameters
    ----------
    name, settings, **options
        As for :func:`environment_scpi`.
    address : str or Link
        Serial device, ``/dev/ttyUSB3@9600``, or ``tcp://host:port``.
    pattern : str
        Regular expression for a line, with a named group for each quantity.
    quantities : mapping
        Fields of :class:`Quantity` by name.
    query : str
        What is sent to get a line; empty: lines come by themselves.
    checksum : {"none", "xor"}
        Checksum of a line; ``xor`` is that of NMEA 0183.
    answer_s : float
        Time limit of a line (s): longer than the time from line to line.

    Examples
    --------
    >>> pattern = r"T=(?P<temperature>\\S+) RH=(?P<humidity>\\S+)"
    >>> sensor = environment_line("air", "/dev/ttyUSB3@9600", pattern=pattern,
    ...                           quantities={"temperature": {"sigma": 0.2}, "humidity": {}})
    >>> sensor.quantities["temperature"].sigma
    0.2
    """
    known, _ = quantities_of(quantities)
    sentence = Sentence(pattern, checksum)
    for key in known:
        if key not in sentence.names:
            raise SettingError(f"has no group {key}", where="pattern", do=f"write (?P<{key}>…)")
    link = link_to(address, baud=9600)
    probe = LineProbe(link, sentence, query, checked=checksum != "none", answer_s=answer_s)
    return EnvironmentSensor(name, probe, known, SensorSettings().changed(settings or {}), **options)


def _needed(quantity: str, fields: Mapping[str, Any], field: str) -> Any:
    """A field that a quantity must have."""
    if field not in fields:
        raise SettingError(f"has no {field}", where=f"quantity {quantity}", do=f"add {field} = …")
    return fields[field]
