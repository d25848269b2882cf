"""Base of all sensors of the environment: what they measure, its limits, and when a value is believed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from reseau.core.environment import Condition
from reseau.core.errors import ProtocolError, SettingError, StateError
from reseau.instruments import Deadline, Device, Environment, Identity, Limits, Settings

KNOWN: Mapping[str, tuple[str, float, float]] = {
    "temperature": ("°C", -40.0, 85.0),
    "humidity": ("%", 0.0, 100.0),
    "pressure": ("hPa", 300.0, 1100.0),
}
"""Unit and limits of common quantities."""
_ATTEMPTS = 4
_AGREE = 0.002
"""Largest difference of two values in succession, as a share of the range."""


@dataclass(frozen=True)
class SensorSettings(Settings):
    """A sensor has no settings.

    Examples
    --------
    >>> SensorSettings().to_dict()
    {}
    """


@dataclass(frozen=True)
class Quantity:
    """One quantity that a sensor measures.

    Parameters
    ----------
    name, unit : str
        Name and unit.
    low, high : float
        Limits, in the unit: what is outside comes from a broken sensor or a wrong address.
    sigma : float, optional
        Standard uncertainty, in the unit, of its certificate or data sheet.
    scale, offset : float
        From the number of the sensor to the unit: scale · number + offset.
    agree : float, optional
        Largest difference of two values in succession, where no checksum protects them. Default: 0.2 % of the
        range.

    Raises
    ------
    SettingError
        If low is not below high, or sigma, scale or agree are not positive.

    Examples
    --------
    >>> Quantity("temperature", "°C", -40.0, 85.0, scale=0.1).condition(215.0)
    Condition(value=21.5, unit='°C', sigma=None)
    >>> Quantity("temperature", "°C", -40.0, 85.0).condition(999.9)
    Traceback (most recent call last):
    reseau.core.errors.StateError: temperature: 999.9 °C is outside -40…85 °C; is the sensor in order?
    """

    name: str
    unit: str
    low: float
    high: float
    sigma: float | None = None
    scale: float = 1.0
    offset: float = 0.0
    agree: float | None = None

    def __post_init__(self) -> None:
        positive = [each for each in (self.sigma, self.agree) if each is not None]
        if not self.low < self.high or self.scale == 0.0 or not all(each > 0 for each in positive):
            what = "low must be below high, scale not 0, sigma and agree positive"
            raise SettingError(what, where=f"quantity {self.name}")

    def condition(self, number: float) -> Condition:
        """Return the condition for a number of the sensor.

        Raises
        ------
        StateError
            If it is outside the limits.
        """
        value = round(self.scale * number + self.offset, 9)
        if not math.isfinite(value) or not self.low <= value <= self.high:
            what = f"{self.name}: {value:g} {self.unit} is outside {self.low:g}…{self.high:g} {self.unit}"
            raise StateError(what, do="is the sensor in order?")
        return Condition(value, self.unit, self.sigma)

    @property
    def least(self) -> float:
        """Largest difference of two values that agree."""
        return _AGREE * (self.high - self.low) if self.agree is None else self.agree


def quantities_of(
    fields: Mapping[str, Mapping[str, Any]], own: tuple[str, ...] = ()
) -> tuple[dict[str, Quantity], dict[str, dict[str, Any]]]:
    """Create quantities from fields by name; return them, and the fields that a driver has of its own.

    Parameters
    ----------
    fields : mapping
        Fields of :class:`Quantity`; of a quantity of :data:`KNOWN`, unit and limits may be left out.
    own : tuple of str
        Names of further fields.

    Raises
    ------
    SettingError
        If a field is unknown or missing, or there are no quantities.

    Examples
    --------
    >>> found, own = quantities_of({"humidity": {"query": "MEAS:HUM?", "sigma": 2.0}}, ("query",))
    >>> found["humidity"].unit, own["humidity"]
    ('%', {'query': 'MEAS:HUM?'})
    """
    if not fields:
        raise SettingError("has no quantities", where="sensor", do="define at least one")
    made, rest = {}, {}
    for name, given in fields.items():
        values: dict[str, Any] = {}
        if name in KNOWN:
            values = dict(zip(("unit", "low", "high"), KNOWN[name], strict=True))
        values |= {key: value for key, value in given.items() if key not in own}
        rest[name] = {key: value for key, value in given.items() if key in own}
        try:
            made[name] = Quantity(name, **values)
        except TypeError as error:
            raise SettingError(f"its fields do not fit ({error})", where=f"quantity {name}") from None
    return made, rest


class Probe(Protocol):
    """How a sensor is asked."""

    @property
    def checked(self) -> bool:
        """Whether a checksum protects the values; otherwise they count once a second answer agrees."""

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""

    def close(self) -> None:
        """Close the connection."""

    def identify(self, deadline: Deadline) -> Identity:
        """Return the identity of the sensor, as far as it tells it."""

    def numbers(self, deadline: Deadline) -> Mapping[str, float]:
        """Return the numbers of the sensor by quantity."""


class EnvironmentSensor(Device[SensorSettings]):
    """Driver of a sensor of temperature, humidity, pressure or the like.

    Parameters
    ----------
    name : str
        Name on the bench.
    probe : Probe
        How the sensor is asked.
    quantities : mapping of str to Quantity
        What it measures.
    settings : SensorSettings
        None.
    seconds : float
        Time limit of calls that do not specify one (s).
    limits : mapping, optional
        None: a sensor has no settings; the limits of its values belong to the quantities.

    Examples
    --------
    >>> from reseau_drivers.environment import environment_line
    >>> pattern = r"(?P<temperature>\\S+) C"
    >>> sensor = environment_line("air", "/dev/ttyUSB3", pattern=pattern, quantities={"temperature": {}})
    >>> sensor.describe()["air_temperature"]["units"]
    '°C'
    """

    def __init__(
        self,
        name: str,
        probe: Probe,
        quantities: Mapping[str, Quantity],
        settings: SensorSettings | None = None,
        *,
        seconds: float = 3.0,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings or SensorSettings(), seconds=seconds, limits=limits)
        self._probe, self.quantities = probe, dict(quantities)

    def _open(self, deadline: Deadline) -> None:
        self._probe.open(deadline)

    def _disconnect(self) -> None:
        self._probe.close()

    def _push(self, settings: SensorSettings, deadline: Deadline) -> None:
        """Do nothing: there are no settings."""

    def _identify(self, deadline: Deadline) -> Identity:
        return self._probe.identify(deadline)

    def _halt(self, deadline: Deadline) -> None:
        """Do nothing: a sensor moves and sends nothing."""

    def _acquire(self) -> dict[str, Any]:
        return {f"{self.name}_{key}": each.value for key, each in self.environment().conditions.items()}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        return {
            f"{self.name}_{key}": {"dtype": "number", "shape": [], "units": each.unit}
            for key, each in self.quantities.items()
        }

    def _test(self, deadline: Deadline) -> dict[str, str]:
        measured = self.environment(deadline.left)
        return {key: str(each) for key, each in measured.conditions.items()}

    def environment(self, seconds: float | None = None) -> Environment:
        """Return what the sensor measures now.

        Raises
        ------
        StateError
            If a value is outside its limits.
        ProtocolError
            If answers contradict each other, or one has no value for a quantity.
        InstrumentError
            If the sensor does not answer.
        """
        with self._exchange("measure", seconds) as deadline:
            return Environment(self._believed(deadline))

    def _believed(self, deadline: Deadline) -> dict[str, Condition]:
        found = self._conditions(deadline)
        if self._probe.checked:
            return found
        for _ in range(_ATTEMPTS):
            before, found = found, self._conditions(deadline)
            if all(
                abs(found[key].value - before[key].value) <= each.least
                for key, each in self.quantities.items()
            ):
                return found
        raise ProtocolError("gives values that contradict each other", do="check cable and shielding")

    def _conditions(self, deadline: Deadline) -> dict[str, Condition]:
        numbers = self._probe.numbers(deadline)
        missing = [key for key in self.quantities if key not in numbers]
        if missing:
            raise ProtocolError(f"sent no {', '.join(missing)}")
        return {key: each.condition(numbers[key]) for key, each in self.quantities.items()}
