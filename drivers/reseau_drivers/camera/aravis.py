"""GigE Vision and USB3 Vision cameras through Aravis; the only module that uses this library.

Aravis is called through its introspection (PyGObject and the typelib ``Aravis-0.8``); if these are not
installed, the driver reports it when it connects. Each buffer is copied and always returned to the stream.
"""

from __future__ import annotations

import math
import os
import shlex
import socket
import sys
import time
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from operator import methodcaller
from threading import Event, Thread
from typing import Any

import psutil  # type: ignore[import-untyped, unused-ignore]

from reseau.core.errors import (
    ConnectionLost,
    InstrumentError,
    ProtocolError,
    RefusedError,
    SettingError,
    UsageError,
)
from reseau.instruments import Deadline, Identity, choice, quantity, text

from ..codecs.gige import Action
from ..codecs.pixels import GENICAM, decode, format_named
from .camera import CameraSettings, OriginalValues, RawFrame, Ready
from .clocks import BlockCounter, ExposureTimes, realtime_offset
from .features import Feature, found_features
from .gvcp import HEARTBEAT_S, controlled_elsewhere, is_ip, require_answer, require_control, send_action

_UNKNOWN_PERIOD_NS = 1_000_000_000
_RELEASE_S = 0.5
_MOST_BUFFERED = 1 << 30
"""Bytes that a socket buffers at most."""
_SO_RCVBUFFORCE = 33
"""Of Linux; Python's socket does not name it."""
_OUTLIVING_S = 0.1
"""Time by which a device outlives the signal that its control is lost."""
_CLOCK_IS_OLD_NS = 1_000_000_000
"""Age of a reading of the clock from which the exposures of a rig need another one."""
_LATCHES = (
    ("TimestampLatch", "TimestampLatchValue"),
    ("GevTimestampControlLatch", "GevTimestampValue"),
)
"""Features that read a camera's clock: Standard Features Naming Convention 2.0 and later, and earlier."""


@dataclass(frozen=True)
class AravisSettings(CameraSettings):
    """Settings of a GenICam camera; gains in dB if the camera uses that unit; packet size 0 is negotiated.

    With the trigger ``action``, the camera exposes at action commands with its keys and a bit of its mask.

    Examples
    --------
    >>> AravisSettings(format="Mono12", features="ReverseX=true").features
    'ReverseX=true'
    """

    format: str = choice("Mono8", *GENICAM)
    trigger: str = choice("off", "off", "software", "hardware", "action")
    trigger_line: str = choice("Line0", "Line0", "Line1", "Line2", "Line3")
    action_device_key: int = quantity(1, "", 0, 0xFFFFFFFF)
    action_group_key: int = quantity(1, "", 0, 0xFFFFFFFF)
    action_group_mask: int = quantity(1, "", 1, 0xFFFFFFFF)
    stamp: str = choice("end", "end", "start")
    chunks: str = choice("off", "off", "on")
    packet_size: int = quantity(0, "B", 0, 65535)
    features: str = text("")  # set by name, before all other settings; see :func:`wanted_features`

    def __post_init__(self) -> None:
        super().__post_init__()
        wanted_features(self.features)

    @property
    def action(self) -> Action:
        """The action command that triggers the camera."""
        return Action(self.action_device_key, self.action_group_key, self.action_group_mask)


def wanted_features(text: str) -> tuple[tuple[str, str], ...]:
    """Parse GenICam features, as ``ReverseX=true BlackLevel=16 DeviceUserID="left eye"``.

    Returns
    -------
    tuple of (str, str)
        Names and values in the order in which they are set.

    Raises
    ------
    SettingError
        If the text is not valid.

    Examples
    --------
    >>> wanted_features('ReverseX=true  DeviceUserID="left eye"')
    (('ReverseX', 'true'), ('DeviceUserID', 'left eye'))
    """
    try:
        pairs = [word.partition("=") for word in shlex.split(text)]
    except ValueError as error:
        raise SettingError(f"{text!r} is incomplete ({error})", where="features") from None
    for name, sign, value in pairs:
        if not (name.isidentifier() and sign and value):
            raise SettingError(
                f"{name + sign + value!r} is not a feature setting",
                where="features",
                do="write Name=value, separated by spaces",
            )
    return tuple((name, value) for name, _, value in pairs)


def same_value(got: str, wanted: str) -> bool:
    """Whether the value that a camera reports equals the requested one.

    Examples
    --------
    >>> same_value("2.500000", "2.5"), same_value("16", "0x10"), same_value("true", "True")
    (True, True, True)
    >>> same_value("2", "3"), same_value("Off", "On")
    (False, False)
    """
    if got.casefold() == wanted.casefold():
        return True
    numbers = _number(got), _number(wanted)
    return math.isclose(*numbers, rel_tol=1e-6)


def require_within(name: str, value: float, bounds: Sequence[float]) -> None:
    """Raise if a value is outside the range of the camera.

    Raises
    ------
    RefusedError
        If the value is outside its bounds.
    """
    low, high = bounds[0], bounds[1]
    if not low <= value <= high:
        raise RefusedError(f"{name} {value:g} is outside {low:g}…{high:g}")


def _number(text: str) -> float:
    """Return the number in a text; NaN if there is none."""
    for kind in (lambda: int(text, 0), lambda: float(text)):
        try:
            return kind()
        except ValueError:
            continue
    return math.nan


@cache
def _library() -> tuple[Any, Any]:
    """Return Aravis and GLib.

    Raises
    ------
    UsageError
        If they are not installed.
    """
    try:
        import gi  # type: ignore[import-untyped, import-not-found, unused-ignore]

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis as library  # type: ignore[import-untyped, unused-ignore]
        from gi.repository import GLib  # type: ignore[import-untyped, unused-ignore]
    except (ImportError, ValueError) as error:
        raise UsageError(
            f"Aravis is not installed ({error})",
            do="install gir1.2-aravis-0.8, and pip install 'reseau[aravis]'",
        ) from None
    return library, GLib


def aravis_cameras() -> tuple[str, ...]:
    """List the identifiers of the cameras that answer; entry point ``aravis``.

    Raises
    ------
    UsageError
        If Aravis is not installed.

    Examples
    --------
    >>> aravis_cameras()  # doctest: +SKIP
    ('Aravis-Fake-GV01',)
    """
    library, _ = _library()
    library.update_device_list()
    return tuple(library.get_device_id(index) for index in range(library.get_n_devices()))


class Aravis:
    """Interface to a camera that Aravis opens.

    Parameters
    ----------
    address : str
        Identifier or IP address.

    Examples
    --------
    >>> Aravis("192.0.2.30").dropped
    0
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._camera: Any = None
        self._stream: Any = None
        self._parser: Any = None
        self._lost = Event()
        self._losing: list[Any] = []
        self._running = False
        self._ours_until = 0.0
        self._settings = AravisSettings()
        self._numbers, self._original = BlockCounter(), OriginalValues()
        self._size = (0, 0)
        self._period_ns = _UNKNOWN_PERIOD_NS
        self._exposure_ns: int | None = None
        self._gain = float("nan")
        self._stamps = ExposureTimes()
        self._chunks: tuple[str, ...] = ()

    @property
    def dropped(self) -> int:
        """Number of frames lost or damaged."""
        return self._numbers.lost

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frames (px)."""
        return self._size[1], self._size[0]

    @property
    def host(self) -> str:
        """IP address of the camera.

        Raises
        ------
        RefusedError
            If it is not a GigE Vision camera.
        """
        if is_ip(self._address):
            return self._address
        with self._translated_errors("address") as camera:
            if not camera.is_gv_device():
                raise RefusedError("has no IP address: action commands are those of GigE Vision")
            return str(camera.get_device().get_device_address().get_address().to_string())

    def open(self, deadline: Deadline) -> None:
        """Open the camera and take control of it; an open one is closed before."""
        self.close()
        library, _ = _library()
        self._lost = lost = Event()
        self._numbers, self._original = BlockCounter(), OriginalValues()
        require_answer(self._address, deadline)
        require_control(self._address, deadline, self._ours_until)
        with self._translated_errors("open"):
            self._camera = library.Camera.new(self._address)
            self._camera.get_device().connect("control-lost", partial(_lost, lost, self._losing))
            if self._camera.is_gv_device() and not self._camera.get_device().is_controller():
                raise controlled_elsewhere(self._address)
            # A previous application may have died during an acquisition; the receiver is set at the next
            # start.
            self._camera.stop_acquisition()
            self._read_clock()

    def close(self) -> None:
        """Release the camera if it is open, without waiting for one that does not answer."""
        held = [self._camera] if self._camera is not None else []
        running, self._running = self._running, False
        # The library releases the control when the last reference is dropped, and retries for a long time.
        self._stream = self._parser = self._camera = None
        if held:
            releasing = Thread(
                target=_release, args=(held, running, self._losing), name="Aravis", daemon=True
            )
            releasing.start()
            releasing.join(_RELEASE_S)
            # A camera that did not receive the release keeps our control until our heartbeat times out.
            self._ours_until = time.monotonic() + HEARTBEAT_S

    def identify(self, deadline: Deadline) -> Identity:
        """Return the identity that the camera reports."""
        with self._translated_errors("identify") as camera:
            version = ""
            if camera.is_feature_available("DeviceVersion"):
                version = camera.get_string("DeviceVersion")
            return Identity(
                camera.get_vendor_name(), camera.get_model_name(), camera.get_device_serial_number(), version
            )

    def apply(self, settings: AravisSettings, deadline: Deadline) -> None:
        """Stop the acquisition and apply settings."""
        self.halt()
        self._settings = settings
        with self._translated_errors("set") as camera:
            for name, value in wanted_features(settings.features):
                self._set_feature(camera, name, value)
            self._set_region(camera, settings)
            self._set_light(camera, settings)
            self._set_trigger(camera, settings)
            self._set_chunks(camera, settings.chunks == "on")
            if settings.packet_size and camera.is_gv_device():
                camera.gv_set_packet_size(settings.packet_size)
                camera.gv_set_packet_size_adjustment(_library()[0].GvPacketSizeAdjustment.NEVER)

    def dark(self, settings: AravisSettings) -> AravisSettings:
        """Return the settings with the shortest exposure."""
        with self._translated_errors("limits") as camera:
            if not camera.is_exposure_time_available():
                return settings
            return replace(settings, exposure_us=max(1.0, float(camera.get_exposure_time_bounds()[0])))

    def features(self) -> list[Feature]:
        """Return the features that are available now."""
        library, glib = _library()
        with self._translated_errors("features") as camera:
            return list(found_features(library, glib, camera.get_device().get_genicam()))

    def set_features(self, wanted: Mapping[str, str]) -> None:
        """Stop the acquisition and set features, in their order.

        Raises
        ------
        RefusedError
            If a feature does not exist, or a value is outside its range; those before it are set.
        """
        self.halt()
        with self._translated_errors("set") as camera:
            for name, value in wanted.items():
                self._require_range(camera, name, value)
                self._set_feature(camera, name, value)

    def _require_range(self, camera: Any, name: str, value: str) -> None:
        """Raise if a number is outside the range of a feature, or a value is none of its entries."""
        if not camera.is_feature_available(name):
            raise RefusedError(f"has no feature {name}", do="list them with `reseau bench features`")
        library, glib = _library()
        genicam = camera.get_device().get_genicam()
        found = next((each for each in found_features(library, glib, genicam) if each.name == name), None)
        if found is None:
            return
        if not found.writable:
            raise RefusedError(f"{name} cannot be changed now")
        number = _number(value)
        if found.low is not None and found.high is not None and not found.low <= number <= found.high:
            raise RefusedError(f"{name} = {value}: {found}")
        if found.entries and value not in found.entries:
            raise RefusedError(f"{name} = {value}: it is one of {', '.join(found.entries)}")

    def user_sets(self) -> tuple[str, ...]:
        """Return the names of the camera's user sets; none if it has none."""
        with self._translated_errors("user sets") as camera:
            if not camera.is_feature_available("UserSetSelector"):
                return ()
            return tuple(camera.dup_available_enumerations_as_strings("UserSetSelector"))

    def load_user_set(self, name: str) -> None:
        """Stop the acquisition and give all features the values of a user set."""
        self._user_set(name, "UserSetLoad")

    def save_user_set(self, name: str) -> None:
        """Keep the present values of all features in a user set of the camera."""
        self._user_set(name, "UserSetSave")

    def _user_set(self, name: str, command: str) -> None:
        known = self.user_sets()
        if name not in known:
            raise RefusedError(
                f"has no user set {name}", do=f"it has {', '.join(known)}" if known else "it has none"
            )
        self.halt()
        with self._translated_errors(command) as camera:
            camera.set_string("UserSetSelector", name)
            camera.execute_command(command)

    def start(self, deadline: Deadline) -> None:
        """Start the acquisition if it is not running."""
        if self._running:
            return
        with self._translated_errors("start") as camera:
            if camera.is_gv_device():
                # Raw sockets of a superuser receive frames of other cameras, too, before their filter is set.
                camera.gv_set_stream_options(_library()[0].GvStreamOption.PACKET_SOCKET_DISABLED)
            self._stream = camera.create_stream(None, None)
            if self._stream is None:
                raise RefusedError("does not open a stream", do="is it open in another program?")
            payload = camera.get_payload()
            if camera.is_gv_device():
                _widen(self._stream, min(4 * payload, _MOST_BUFFERED))
            for _ in range(self._settings.buffers):
                self._stream.push_buffer(_library()[0].Buffer.new_allocate(payload))
            camera.start_acquisition()
        self._running = True
        self._numbers.restart()
        self._stamps.restart(self._period_ns)

    def request(self, deadline: Deadline, ready: Ready | None = None) -> int:
        """Send a software trigger if configured; earlier frames are discarded."""
        if ready is not None and time.monotonic_ns() - self._stamps.read_at > _CLOCK_IS_OLD_NS:
            with self._translated_errors("clock"):
                self._read_clock()
        triggered = self._settings.trigger != "off"
        while triggered and (buffer := self._stream.try_pop_buffer()) is not None:
            self._counted(buffer)
            self._stream.push_buffer(buffer)
        # What counts for the rig is when all waited, however late this thread goes on.
        since, by_rig = (time.monotonic_ns(), False) if ready is None else ready()
        self._stamps.triggered = since if triggered and by_rig else None
        if self._settings.trigger == "software":
            self._stamps.triggered = time.monotonic_ns()
            with self._translated_errors("trigger") as camera:
                camera.software_trigger()
        elif self._settings.trigger == "action" and ready is None:
            self._stamps.triggered = time.monotonic_ns()
            send_action([self.host], self._settings.action)
        return self._stamps.triggered or since

    def take(self, deadline: Deadline) -> RawFrame | None:
        """Return the next complete frame that is newer than the last."""
        if self._lost.is_set() or self._stream is None:
            raise ConnectionLost("control of the camera was lost", do="check power and cable")
        with self._translated_errors("fetch"):
            stream = _held(self._stream)
            buffer = stream.timeout_pop_buffer(max(1, int(deadline.left * 1e6)))
            if buffer is None:
                return None
            try:
                sequence = self._counted(buffer)
                return None if sequence is None else self._read(buffer, sequence)
            finally:
                stream.push_buffer(buffer)

    def halt(self) -> None:
        """Stop the acquisition and close its stream."""
        self._stream = None
        if not self._running:
            return
        self._running = False
        with self._translated_errors("stop") as camera:
            camera.stop_acquisition()

    def clock(self, deadline: Deadline) -> str:
        """Describe the offset of the camera's clock to UTC."""
        with self._translated_errors("clock"):
            self._read_clock()
        return self._stamps.describe()

    def _counted(self, buffer: Any) -> int | None:
        """Return the number of a complete frame without wrapping; None if it is damaged or not newer.

        A damaged frame may have lost its leader, and with it its number; it counts as lost when the next one
        arrives.
        """
        if buffer.get_status() != _library()[0].BufferStatus.SUCCESS:
            return None
        return self._numbers.next(int(buffer.get_frame_id()))

    def _read(self, buffer: Any, sequence: int) -> RawFrame | None:
        width, height = buffer.get_image_width(), buffer.get_image_height()
        layout = GENICAM[self._settings.format]
        if buffer.get_image_pixel_format() != layout.code or (width, height) != self._size:
            raise ProtocolError(
                f"sent {width}×{height} pixels of {format_named(buffer.get_image_pixel_format())}, not "
                f"{self._size[0]}×{self._size[1]} {self._settings.format}"
            )
        stride = layout.row(width) + int(buffer.get_image_padding()[0])
        exposure_ns, gain = self._exposure_ns, self._gain
        if buffer.has_chunks() and "ExposureTime" in self._chunks:
            exposure_ns = int(self._parser.get_float_value(buffer, "ChunkExposureTime") * 1000)
        if buffer.has_chunks() and "Gain" in self._chunks:
            gain = float(self._parser.get_float_value(buffer, "ChunkGain"))
        arrived = int(buffer.get_system_timestamp()) - realtime_offset()[0]
        before = (exposure_ns or 0) if self._settings.stamp == "end" else 0
        began = self._stamps.began(int(buffer.get_timestamp()), arrived, before, exposure_ns or 0)
        data = buffer.get_data()
        pixels, raw = decode(layout, width, height, data, stride), data if layout.coloured else b""
        exposure_us = float("nan") if exposure_ns is None else exposure_ns / 1000
        return RawFrame(pixels, layout.full_scale, layout.pattern, raw, sequence, began, exposure_us, gain)

    def _read_clock(self) -> None:
        self._stamps.offset, self._stamps.read_at = self._latched(), time.monotonic_ns()

    def _latched(self) -> tuple[int, int] | None:
        """Return offset of the camera's clock to the computer's and its uncertainty; None if not readable."""
        camera = _held(self._camera)
        for latch, value in _LATCHES:
            if not (camera.is_feature_available(latch) and camera.is_feature_available(value)):
                continue
            readings = []
            for _ in range(3):
                before = time.monotonic_ns()
                camera.execute_command(latch)
                after = time.monotonic_ns()
                readings.append((after - before, (before + after) // 2, int(camera.get_integer(value))))
            if readings[0][2] == readings[-1][2]:
                return None  # the clock does not run
            accepted, ours, theirs = min(readings)
            return ours - theirs, (accepted + 1) // 2
        return None

    def _set_feature(self, camera: Any, name: str, value: str) -> None:
        if not camera.is_feature_available(name):
            raise RefusedError(f"has no feature {name}", do="list the features with arv-tool-0.8 features")
        # Do not assign the device or its nodes to variables: see :meth:`_translated_errors`.
        camera.get_device().get_feature(name).set_value_from_string(value)
        got = str(camera.get_device().get_feature(name).get_value_as_string())
        if not same_value(got, value):
            raise RefusedError(f"{name} is {got}, not {value}")

    def _set_trigger(self, camera: Any, settings: AravisSettings) -> None:
        if settings.trigger == "off":
            camera.clear_triggers()
        elif settings.trigger == "action":
            for name, value in (
                ("ActionSelector", 0),
                ("ActionDeviceKey", settings.action_device_key),
                ("ActionGroupKey", settings.action_group_key),
                ("ActionGroupMask", settings.action_group_mask),
            ):
                if camera.is_feature_available(name):
                    camera.set_integer(name, value)
                elif name != "ActionSelector":
                    raise RefusedError(f"has no feature {name}: it knows no action commands")
            sources = camera.dup_available_enumerations_as_strings("TriggerSource")
            camera.set_trigger(next((name for name in sources if name.startswith("Action")), "Action1"))
        else:
            camera.set_trigger("Software" if settings.trigger == "software" else settings.trigger_line)

    def _set_chunks(self, camera: Any, wanted: bool) -> None:
        """Make each frame report its exposure and gain, as far as the camera supports it."""
        self._parser, self._chunks = None, ()
        if not wanted:
            if camera.are_chunks_available():
                camera.set_chunk_mode(False)
            return
        if not camera.are_chunks_available():
            raise RefusedError("does not support chunk data")
        offered = camera.dup_available_enumerations_as_strings("ChunkSelector")
        self._chunks = tuple(name for name in ("ExposureTime", "Gain") if name in offered)
        camera.set_chunks(",".join(self._chunks))
        self._parser = camera.create_chunk_parser()

    def _set_region(self, camera: Any, settings: AravisSettings) -> None:
        offered = [format_named(code & 0xFFFFFFFF) for code in camera.dup_available_pixel_formats()]
        if settings.format not in offered:
            known = ", ".join(name for name in offered if name in GENICAM) or "none that is read"
            others = "; ".join(name for name in offered if name not in GENICAM)
            raise RefusedError(
                f"does not offer the format {settings.format}" + (f", but {others}" if others else ""),
                do=f"set `format` to what it offers: {known}",
            )
        camera.set_pixel_format_from_string(settings.format)
        now = tuple(camera.get_region())
        asked = settings.left, settings.top, settings.width, settings.height
        found = self._original.keep("region", any(asked), lambda: now) or now
        region = (*asked[:2], asked[2] or found[2], asked[3] or found[3]) if any(asked) else found
        left, top, width, height = region
        sensor = camera.get_sensor_size()
        if left + width > sensor[0] or top + height > sensor[1]:
            raise RefusedError(
                f"has {sensor[0]}×{sensor[1]} pixels; {width}×{height} at ({left}, {top}) does not fit"
            )
        camera.set_region(0, 0, -1, -1)  # the offset limits the size
        camera.set_region(*region)
        if (got := tuple(camera.get_region())) != region:
            raise RefusedError(f"reads the region {got}, not {region}")
        self._size = width, height

    def _set_light(self, camera: Any, settings: AravisSettings) -> None:
        for name, feature, given in (
            ("rate", "frame_rate", settings.rate > 0),
            ("exposure_us", "exposure_time", settings.exposure_us > 0),
            ("gain", "gain", settings.gain >= 0),
        ):
            value = getattr(settings, name)
            if given:
                require_within(name, value, methodcaller(f"get_{feature}_bounds")(camera))
            found = self._original.keep(name, given, partial(methodcaller(f"get_{feature}"), camera))
            if given or found is not None:
                getattr(camera, f"set_{feature}")(value if given else found)
        self._period_ns = _UNKNOWN_PERIOD_NS
        if camera.is_frame_rate_available() and camera.get_frame_rate() > 0:
            self._period_ns = int(1e9 / camera.get_frame_rate())
        self._exposure_ns = None
        if camera.is_exposure_time_available():
            self._exposure_ns = int(camera.get_exposure_time() * 1000)
        self._gain = float(camera.get_gain()) if camera.is_gain_available() else float("nan")

    @contextmanager
    def _translated_errors(self, what: str) -> Iterator[Any]:
        """Provide the camera and translate errors of the library."""
        glib = _library()[1]
        if self._camera is None and what != "open":
            raise ConnectionLost("the camera is not open")
        try:
            # A traceback keeps its objects alive: were the camera among them, it could not be opened again.
            yield None if self._camera is None else _held(self._camera)
        except glib.Error as error:
            raise _meaning(error, what, self._lost.is_set()) from None
        except ReferenceError:
            raise ConnectionLost("was closed during the call") from None


def _release(held: list[Any], running: bool, losing: list[Any]) -> None:
    """Stop the camera and drop the only reference to it, unless its own thread has just lost control."""
    with suppress(Exception):
        if running:
            held[0].stop_acquisition()
    held.clear()
    if losing:
        # A device that ends in its own thread waits for itself, and the library aborts the process.
        time.sleep(_OUTLIVING_S)
        losing.clear()


def _lost(lost: Event, losing: list[Any], device: Any) -> None:
    """Note that control was lost; in the device's thread, which must not drop the last reference."""
    losing.append(device)
    lost.set()


def _widen(stream: Any, size: int) -> None:
    """Let the socket of a stream buffer so many bytes, or as many as the system allows.

    The library does it only after the first packets, and not beyond the limit of the system, which the
    superuser may pass.
    """
    stream.set_property("socket-buffer", _library()[0].GvStreamSocketBuffer.FIXED)
    stream.set_property("socket-buffer-size", 0)  # the library leaves it alone
    for each in psutil.Process().net_connections("udp4"):
        if each.laddr and each.laddr.port == stream.get_port():
            with suppress(OSError), socket.socket(fileno=os.dup(each.fd)) as same:
                same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
                if sys.platform == "linux":
                    same.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, size)


def _held(thing: Any) -> Any:
    """Return a weak reference."""
    if thing is None:
        raise ConnectionLost("was closed during the call")
    return weakref.proxy(thing)


def _meaning(error: Any, what: str, lost: bool) -> InstrumentError:
    """Translate an error of the library."""
    text, codes = f"{what}: {error.message}", _library()[0].DeviceError
    if lost:
        return ConnectionLost(f"control of the camera was lost ({text})", do="check power and cable")
    gone = (codes.TIMEOUT, codes.NOT_CONNECTED, codes.NOT_FOUND, codes.TRANSFER_ERROR, codes.UNKNOWN)
    if error.domain == "arv-device-error-quark" and error.code in (int(code) for code in gone):
        return ConnectionLost(f"does not answer ({text})", do="check power and address")
    return RefusedError(
        f"refused the request ({text})", do="does it support this, and does no other program control it?"
    )
