"""Drivers of cameras: Video4Linux, and GigE Vision and USB3 Vision through Aravis."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from .aravis import Aravis, AravisSettings, aravis_cameras
from .burst import Burst
from .camera import CameraDriver, CameraExposure, CameraInterface, CameraSettings, RawFrame
from .rig import Rig, RigSettings
from .v4l2 import KernelNode, OpenNode, V4l2, V4l2Settings, video_devices

__all__ = [
    "Aravis",
    "AravisSettings",
    "Burst",
    "CameraDriver",
    "CameraExposure",
    "CameraInterface",
    "CameraSettings",
    "RawFrame",
    "Rig",
    "RigSettings",
    "V4l2",
    "V4l2Settings",
    "aravis",
    "aravis_cameras",
    "rig",
    "v4l2",
    "video_devices",
]


def v4l2(
    name: str, address: str | OpenNode, *, settings: Mapping[str, Any] | None = None, **options: Any
) -> CameraDriver[V4l2Settings]:
    """Create the driver of a Video4Linux camera; entry point ``v4l2``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str or callable
        Device node, such as ``/dev/video0``, or a function that opens one.
    settings : mapping, optional
        Values for :class:`V4l2Settings`.
    **options
        Further arguments of :class:`CameraDriver`.

    Examples
    --------
    The node is opened on the first call, not on construction:

    >>> camera = v4l2("eye", "/dev/video0", settings={"format": "Y16", "exposure_us": 5000.0})
    >>> camera.settings.format, camera.settings.exposure_us
    ('Y16', 5000.0)
    """
    open_node = partial(KernelNode, address) if isinstance(address, str) else address
    return CameraDriver(name, V4l2(open_node), V4l2Settings().changed(settings or {}), **options)


def aravis(
    name: str, address: str, *, settings: Mapping[str, Any] | None = None, **options: Any
) -> CameraDriver[AravisSettings]:
    """Create the driver of a GigE Vision or USB3 Vision camera; entry point ``aravis``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str
        Identifier as shown by ``reseau bench list``, or IP address.
    settings : mapping, optional
        Values for :class:`AravisSettings`.
    **options
        Further arguments of :class:`CameraDriver`.

    Examples
    --------
    The camera is opened on the first call, not on construction:

    >>> camera = aravis("camera", "192.0.2.30", settings={"format": "Mono12", "trigger": "software"})
    >>> camera.settings.format, camera.settings.trigger
    ('Mono12', 'software')
    """
    return CameraDriver(name, Aravis(address), AravisSettings().changed(settings or {}), **options)


def rig(name: str, address: str, *, settings: Mapping[str, Any] | None = None, **options: Any) -> Rig:
    """Create a rig of cameras of the bench; entry point ``rig``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str
        Names of the cameras, separated by commas; the first is the reference of the others.
    settings : mapping, optional
        Values for :class:`RigSettings`.
    **options
        Further arguments of :class:`Rig`.

    Examples
    --------
    >>> rig("rig", "left, right", settings={"trigger": "action"}).cameras
    ('left', 'right')
    """
    names = [each.strip() for each in address.split(",") if each.strip()]
    return Rig(name, names, RigSettings().changed(settings or {}), **options)
