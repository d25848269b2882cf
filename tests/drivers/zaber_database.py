"""A device database for zaber-motion on this machine: what `identify()` looks up by the number of a device.

The library asks a web service, by default that of the maker, for `device/<id>?fw=<version>`; the form of the
answer is that of its releases 7 to 10. The database has one device, the simulated one, whose axes rotate by
a degree in a thousand steps.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

__all__ = ["STEPS", "device_database"]

STEPS = 1000.0
"""Steps in a degree."""
_ANGLE, _SPEED, _ACCELERATION = 1, 2, 3
_RESOLUTION = 64
# The library's own factors: seconds in 1.6384 of a unit of speed, in 10000/1.6384 of one of acceleration.
_SCALES = {
    _ANGLE: ("Angle", "linear-resolution", 1.0),
    _SPEED: ("Angular Velocity", "linear-resolution", 1.6384),
    _ACCELERATION: ("Angular Acceleration", "linear-resolution", 1.6384 / 10000),
}
_SETTINGS = {
    "pos": _ANGLE, "limit.min": _ANGLE, "limit.max": _ANGLE, "maxspeed": _SPEED, "accel": _ACCELERATION,
    "resolution": 0,
}  # fmt: skip


def _table() -> dict[str, Any]:
    return {
        "capabilities": [],
        "settings": {
            "rows": [
                {"name": name, "param_type": "Int32", "read_access_level": 1, "write_access_level": 1,
                 "visibility": "basic", "real_time_safe": True, "contextual_dimension_id": dimension or None}
                for name, dimension in _SETTINGS.items()
            ]
        },
        "conversion_table": {
            "rows": [
                {"contextual_dimension_id": number, "contextual_dimension_name": name,
                 "dimension_name": name, "function_name": function,
                 "scale": factor * STEPS / _RESOLUTION}
                for number, (name, function, factor) in _SCALES.items()
            ]
        },
        "command_tree": {
            "command": "",
            "nodes": [
                {"command": "home", "is_command": True},
                {"command": "stop", "is_command": True},
                {"command": "move", "nodes": [
                    {"command": how, "nodes": [
                        {"command": "position", "is_param": True, "is_command": True, "param_type": "Int32",
                         "param_arity": 1, "contextual_dimension_id": _ANGLE}
                    ]}
                    for how in ("abs", "rel")
                ]},
            ],
        },
    }  # fmt: skip


_DEVICE = {"device": {"device_id": 50081, "name": "simulated rotary stage"}, **_table()}
_AXIS = {"device": {"device_id": 0, "peripheral_id": 0, "name": "axis"}, **_table()}


class _Service(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        known = self.path.startswith(f"/device/{_DEVICE['device']['device_id']}?fw=7.")
        axes = [_AXIS] * self.path.count("peripheral-id=")
        body = json.dumps(_DEVICE | {"peripherals": axes} if known else {}).encode()
        self.send_response(200 if known else 404)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""


@contextmanager
def device_database() -> Iterator[None]:
    """Have zaber-motion use this database within the context, and store nothing."""
    from zaber_motion import DeviceDbSourceType, Library

    server = ThreadingHTTPServer(("127.0.0.1", 0), _Service)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    Library.disable_device_db_store()
    Library.set_device_db_source(
        DeviceDbSourceType.WEB_SERVICE, f"http://127.0.0.1:{server.server_address[1]}"
    )
    try:
        yield
    finally:
        Library.set_device_db_source(DeviceDbSourceType.WEB_SERVICE)
        server.shutdown()
        thread.join()
        server.server_close()
