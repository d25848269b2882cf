"""Cameras: Video4Linux; GigE Vision and USB3 Vision by Aravis."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from .camera import Camera, CameraSettings, Shot, Source, Taken
from .kernel import KernelNode, OpenNode, video_devices
from .v4l2 import V4l2, V4l2Settings

__all__ = [
    "Camera",
    "CameraSettings",
    "Shot",
    "Source",
    "Taken",
    "V4l2",
    "V4l2Settings",
    "v4l2",
    "video_devices",
]


def v4l2(
    name: str, address: str | OpenNode, *, settings: Mapping[str, Any] | None = None, **options: Any
) -> Camera[V4l2Settings]:
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
        Of :class:`Camera`.
    """
    open_node = partial(KernelNode, address) if isinstance(address, str) else address
    return Camera(name, V4l2(open_node), V4l2Settings().changed(settings or {}), **options)
