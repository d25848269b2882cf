"""Hides the system's libusb from Python; see `.ci/bare`."""

import ctypes.util

_find = ctypes.util.find_library
ctypes.util.find_library = lambda name: None if "usb" in name else _find(name)
