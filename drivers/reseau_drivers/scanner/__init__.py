"""Ultrasonic scanners."""

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
    """A Ping360; found by its entry point.

    Parameters
    ----------
    name : str
        On the bench.
    address : str or Link
        Serial device, ``tcp://host:port``, or ``udp://host:9092`` of a vehicle's computer.
    settings : dict, optional
        Of :class:`Ping360Settings`.
    **options
        Of :class:`Ping360`.
    """
    return Ping360(name, link_to(address), Ping360Settings().changed(settings or {}), **options)


def bk_oem(
    name: str, address: str | Link, *, settings: dict[str, Any] | None = None, **options: Any
) -> BkScanner:
    """A BK scanner; found by its entry point ``bk``.

    Parameters
    ----------
    name : str
        On the bench.
    address : str or Link
        ``tcp://host:7915``.
    settings : dict, optional
        Of :class:`BkSettings`.
    **options
        Of :class:`BkScanner`.
    """
    return BkScanner(name, link_to(address), BkSettings().changed(settings or {}), **options)


def compact_pulser(
    name: str, address: str | Link, *, settings: dict[str, Any] | None = None, **options: Any
) -> CompactPulser:
    """A CompactPulser; found by its entry point ``compactpulser``.

    Parameters
    ----------
    name : str
        On the bench.
    address : str or Link
        Serial device, 9600 baud.
    settings : dict, optional
        Of :class:`CompactPulserSettings`.
    **options
        Of :class:`CompactPulser`.
    """
    checked = CompactPulserSettings().changed(settings or {})
    return CompactPulser(name, link_to(address, baud=9600), checked, **options)


def dicom_files(
    name: str, address: str, *, settings: dict[str, Any] | None = None, **options: Any
) -> DicomFiles:
    """Files of a scanner, in its stead; found by its entry point ``dicom``.

    Parameters
    ----------
    name : str
        On the bench.
    address : str
        A DICOM file, or a folder of them.
    settings : dict, optional
        Of :class:`DicomSettings`.
    **options
        Of :class:`DicomFiles`.
    """
    return DicomFiles(name, address, DicomSettings().changed(settings or {}), **options)
