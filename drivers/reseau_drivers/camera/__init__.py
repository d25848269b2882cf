"""Cameras: Video4Linux; GigE Vision and USB3 Vision by Aravis."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from .aravis import Aravis, AravisSettings, aravis_cameras
from .camera import CameraDriver, CameraExposure, CameraInterface, CameraSettings, RawFrame
from .v4l2 import KernelNode, OpenNode, V4l2, V4l2Settings, video_devices

__all__ = [
    "Aravis",
    "AravisSettings",
    "CameraDriver",
    "CameraExposure",
    "CameraInterface",
    "CameraSettings",
    "RawFrame",
    "V4l2",
    "V4l2Settings",
    "aravis",
    "aravis_cameras",
    "v4l2",
    "video_devices",
]


def v4l2(
    name: str, address: str | OpenNode, *, settings: Mapping[str, Any] | None = None, **options: Any
) -> CameraDriver[V4l2Settings]:
    """A camera of Video4Linux; found by its entry point.

    Parameters
    ----------
    name : str
        On the bench.
    address : str or callable
        Its node, as ``/dev/video0``, or what opens one.
    settings : mapping, optional
        Of :class:`V4l2Settings`.
    **options
        Of :class:`CameraDriver`.
    """
    open_node = partial(KernelNode, address) if isinstance(address, str) else address
    return CameraDriver(name, V4l2(open_node), V4l2Settings().changed(settings or {}), **options)


def aravis(
    name: str, address: str, *, settings: Mapping[str, Any] | None = None, **options: Any
) -> CameraDriver[AravisSettings]:
    """A camera of GigE Vision or USB3 Vision; found by its entry point.

    Parameters
    ----------
    name : str
        On the bench.
    address : str
        Its identifier as `reseau bench list` shows it, or its IP address.
    settings : mapping, optional
        Of :class:`AravisSettings`.
    **options
        Of :class:`CameraDriver`.
    """
    return CameraDriver(name, Aravis(address), AravisSettings().changed(settings or {}), **options)
