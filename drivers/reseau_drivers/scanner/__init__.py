"""Drivers of ultrasonic scanners."""

from __future__ import annotations

from typing import Any

from ..link import Link, link_to
from .bk import BkScanner, BkSettings
from .compactpulser import CompactPulser, CompactPulserSettings
from .dicom import DicomFiles, DicomSettings
from .ping360 import Ping360, Ping360Settings

__all__ = [
    "BkScanner",
    "BkSettings",
    "CompactPulser",
    "CompactPulserSettings",
    "DicomFiles",
    "DicomSettings",
    "Ping360",
    "Ping360Settings",
    "bk_oem",
    "compact_pulser",
    "dicom_files",
    "ping360",
]


def ping360(
    name: str, address: str | Link, *, settings: dict[str, Any] | None = None, **options: Any
) -> Ping360:
    """Create the driver of a Ping360; entry point ``ping360``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str or Link
        Serial device, ``tcp://host:port``, or ``udp://host:9092`` of a vehicle's computer.
    settings : dict, optional
        Values for :class:`Ping360Settings`.
    **options
        Further arguments of :class:`Ping360`.

    Examples
    --------
    >>> ping360("sonar", "udp://192.0.2.2:9092", settings={"range_mm": 2000.0}).settings.range_mm
    2000.0
    """
    return Ping360(name, link_to(address), Ping360Settings().changed(settings or {}), **options)


def bk_oem(
    name: str, address: str | Link, *, settings: dict[str, Any] | None = None, **options: Any
) -> BkScanner:
    """Create the driver of a BK scanner; entry point ``bk``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str or Link
        ``tcp://host:7915``.
    settings : dict, optional
        Values for :class:`BkSettings`.
    **options
        Further arguments of :class:`BkScanner`.

    Examples
    --------
    >>> bk_oem("bmode", "tcp://192.0.2.3:7915", settings={"frequency_khz": 8000.0}).settings.units
    {'speed_m_s': 'm/s', 'frequency_khz': 'kHz'}
    """
    return BkScanner(name, link_to(address), BkSettings().changed(settings or {}), **options)


def compact_pulser(
    name: str, address: str | Link, *, settings: dict[str, Any] | None = None, **options: Any
) -> CompactPulser:
    """Create the driver of a CompactPulser; entry point ``compactpulser``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str or Link
        Serial device, 9600 baud.
    settings : dict, optional
        Values for :class:`CompactPulserSettings`.
    **options
        Further arguments of :class:`CompactPulser`.

    Examples
    --------
    >>> pulser = compact_pulser("pulser", "/dev/ttyUSB1", settings={"voltage": 120.0}, digitiser="scope")
    >>> pulser.settings.voltage
    120.0
    """
    checked = CompactPulserSettings().changed(settings or {})
    return CompactPulser(name, link_to(address, baud=9600), checked, **options)


def dicom_files(
    name: str, address: str, *, settings: dict[str, Any] | None = None, **options: Any
) -> DicomFiles:
    """Create a scanner that returns the frames of DICOM files; entry point ``dicom``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str
        DICOM file, or folder of DICOM files.
    settings : dict, optional
        Values for :class:`DicomSettings`.
    **options
        Further arguments of :class:`DicomFiles`.

    Examples
    --------
    >>> dicom_files("loops", "recordings/")  # doctest: +SKIP
    <reseau_drivers.scanner.dicom.DicomFiles object at 0x...>
    """
    return DicomFiles(name, address, DicomSettings().changed(settings or {}), **options)
