"""VXI-11 and HiSLIP servers for an instrument that executes program messages.

Source: VXI-11 revision 1.0, section B.6; RFC 1833; IVI-6.1 HiSLIP, section 3. In both protocols an answer
waits in an output queue until it is read; a read from an empty queue waits as long as the client allows.
"""

from __future__ import annotations

import itertools
import struct
import time
from collections.abc import Callable

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs import hislip, rpc, vxi11
from reseau_drivers.codecs.stream import Damaged

from .faults import DEVICE_KINDS, FaultScript, Output
from .machine import Machine

Execute = Callable[[bytes], bytes | None]
"""Executes a program message; returns the answer, or None if there is none."""

_LARGEST = 1 << 20
"""Largest size of a message (bytes)."""


class AnswerQueue:
    """Queue of answers with their times; None closes the connection."""

    def __init__(self, machine: Machine, execute: Execute, script: FaultScript) -> None:
        self._machine, self._execute, self._script = machine, execute, script
        self._waiting: list[tuple[float, bytes | None]] = []
        self._surplus = False

    def write(self, message: bytes) -> None:
        """Execute a program message."""
        with self._machine.lock:
            if self._waiting and self._waiting[0][0] <= time.monotonic():
                # IEEE 488.2, 6.3.2.3: an answer not read before the next message is lost, and an error.
                # A repeated answer is not the client's fault.
                if not self._surplus:
                    self._machine.violations.append(f"{message!r} interrupted an answer")
                self._waiting.clear()
            self._surplus = False
            answer = self._execute(message)
            if answer is None:
                return
            fault = self._script.draw()
            sent: list[Output] = [(0.0, answer)]
            if fault is not None:
                if fault.kind in DEVICE_KINDS:
                    self._machine.inject_fault(fault.kind)
                sent = self._script.spoil(answer, fault)
                self._surplus = fault.kind == "repeated"
            self._waiting += [(time.monotonic() + delay, data) for delay, data in sent]

    def available(self) -> bool:
        """Whether an answer can be read."""
        return bool(self._waiting) and self._waiting[0][0] <= time.monotonic()

    def status(self) -> int:
        """Poll the status byte: of the instrument, or with the message available alone."""
        poll: Callable[[bool], int] | None = getattr(self._machine, "serial_poll", None)
        available = self.available()
        return 0x10 * available if poll is None else poll(available)

    def clear(self) -> None:
        """Discard all answers."""
        self._waiting.clear()

    def take(self, patience: float) -> tuple[float, bytes | None, bool]:
        """Return delay, answer, and whether there is an answer, waiting at most `patience` (s)."""
        if not self._waiting or self._waiting[0][0] - time.monotonic() > patience:
            return patience, b"", False
        due, data = self._waiting.pop(0)
        return max(0.0, due - time.monotonic()), data, True

    def put_back(self, rest: bytes) -> None:
        """Return the rest of an answer that did not fit into one read."""
        self._waiting.insert(0, (0.0, rest))


class PortmapperSession:
    """Reports the port of the VXI-11 core channel.

    Parameters
    ----------
    port : int
        Port of the core channel.

    Examples
    --------
    >>> query = rpc.Call(1, rpc.PORTMAPPER, 2, rpc.GETPORT, rpc.pack(vxi11.CORE, 1, 6, 0))
    >>> [(_, reply)] = PortmapperSession(4321).receive(rpc.record(rpc.encode_call(query)))
    >>> rpc.Unpacker(rpc.decode_reply(reply[4:])[2]).number()
    4321
    """

    def __init__(self, port: int) -> None:
        self._port, self._records = port, rpc.RecordDecoder(1024)

    def receive(self, data: bytes) -> list[Output]:
        """Return the replies to GETPORT."""
        sent: list[Output] = []
        for record in self._records.feed(data):
            if isinstance(record, Damaged):
                return [(0.0, None)]
            try:
                call = rpc.decode_call(record)
                program = rpc.Unpacker(call.arguments).number() if call.procedure == rpc.GETPORT else None
            except ProtocolError:
                return [(0.0, None)]
            if call.program != rpc.PORTMAPPER:
                reply = rpc.encode_reply(call.xid, b"", rpc.PROG_UNAVAIL)
            elif program is None:
                reply = rpc.encode_reply(
                    call.xid, b"", rpc.SUCCESS if not call.procedure else rpc.PROC_UNAVAIL
                )
            else:
                reply = rpc.encode_reply(call.xid, rpc.pack(self._port if program == vxi11.CORE else 0))
            sent.append((0.0, rpc.record(reply)))
        return sent

    def disconnected(self) -> None:
        """Do nothing."""


class Vxi11Session:
    """One connection to the core channel, with its links.

    Parameters
    ----------
    machine : Machine
        Simulated instrument.
    execute : callable
        Executes a program message.
    script : FaultScript
        Faults of the answers.

    Examples
    --------
    >>> from reseau_sims.serving import Oscilloscope
    >>> scope = Oscilloscope()
    >>> session = Vxi11Session(scope, scope.execute, FaultScript())
    >>> create = rpc.Call(1, vxi11.CORE, 1, vxi11.Procedure.CREATE_LINK)
    >>> [(_, reply)] = session.receive(rpc.record(rpc.encode_call(create)))
    >>> results = rpc.Unpacker(rpc.decode_reply(reply[4:])[2])
    >>> results.number(), results.number()
    (0, 1)
    """

    def __init__(self, machine: Machine, execute: Execute, script: FaultScript) -> None:
        self._machine = machine
        self._open: Callable[[], AnswerQueue] = lambda: AnswerQueue(machine, execute, script)
        self._links: dict[int, AnswerQueue] = {}
        self._begun: dict[int, bytes] = {}
        self._numbers = itertools.count(1)
        self._records = rpc.RecordDecoder(_LARGEST + 1024)

    def disconnected(self) -> None:
        """Close the links of the connection."""
        self._links.clear()

    def receive(self, data: bytes) -> list[Output]:
        """Return the replies to calls."""
        sent: list[Output] = []
        for record in self._records.feed(data):
            try:
                if isinstance(record, Damaged):
                    raise ProtocolError(str(record))
                call = rpc.decode_call(record)
                sent += self._answer(call)
            except ProtocolError as error:
                self._machine.violations.append(error.what)
                sent.append((0.0, None))
        return sent

    def _answer(self, call: rpc.Call) -> list[Output]:
        def reply(results: bytes, status: int = rpc.SUCCESS) -> bytes:
            return rpc.record(rpc.encode_reply(call.xid, results, status))

        if call.program != vxi11.CORE:
            return [(0.0, reply(b"", rpc.PROG_UNAVAIL))]
        match call.procedure:
            case vxi11.Procedure.NULL:
                return [(0.0, reply(b""))]
            case vxi11.Procedure.CREATE_LINK:
                number = next(self._numbers)
                self._links[number] = self._open()
                return [(0.0, reply(rpc.pack(vxi11.Error.NONE, number, 0, _LARGEST)))]
            case vxi11.Procedure.DEVICE_READ:
                return self._read(vxi11.ReadParameters.parse(call.arguments), reply)
            case vxi11.Procedure.DEVICE_WRITE:
                return [(0.0, reply(self._write(vxi11.WriteParameters.parse(call.arguments))))]
        link = vxi11.generic_link(call.arguments)
        queue = self._links.get(link)
        if queue is None:
            self._machine.violations.append(f"link {link} is not open")
            return [(0.0, reply(rpc.pack(vxi11.Error.INVALID_LINK)))]
        match call.procedure:
            case vxi11.Procedure.DESTROY_LINK:
                del self._links[link]
            case vxi11.Procedure.DEVICE_CLEAR:
                queue.clear()
                self._begun.pop(link, None)
            case vxi11.Procedure.DEVICE_READSTB:
                return [(0.0, reply(rpc.pack(vxi11.Error.NONE, queue.status())))]
            case (
                vxi11.Procedure.DEVICE_TRIGGER
                | vxi11.Procedure.DEVICE_REMOTE
                | vxi11.Procedure.DEVICE_LOCAL
                | vxi11.Procedure.DEVICE_LOCK
                | vxi11.Procedure.DEVICE_UNLOCK
            ):
                pass
            case vxi11.Procedure.DEVICE_ENABLE_SRQ | vxi11.Procedure.DEVICE_DOCMD:
                return [(0.0, reply(rpc.pack(vxi11.Error.NOT_SUPPORTED)))]
            case _:
                return [(0.0, reply(b"", rpc.PROC_UNAVAIL))]
        return [(0.0, reply(rpc.pack(vxi11.Error.NONE)))]

    def _write(self, asked: vxi11.WriteParameters) -> bytes:
        queue = self._links.get(asked.link)
        if queue is None:
            self._machine.violations.append(f"link {asked.link} is not open")
            return rpc.pack(vxi11.Error.INVALID_LINK, 0)
        message = self._begun.pop(asked.link, b"") + asked.data
        if len(message) > _LARGEST:
            return rpc.pack(vxi11.Error.OUT_OF_RESOURCES, 0)
        if asked.flags & vxi11.Flag.END:
            queue.write(message)
        else:
            self._begun[asked.link] = message
        return rpc.pack(vxi11.Error.NONE, len(asked.data))

    def _read(self, asked: vxi11.ReadParameters, reply: Callable[[bytes], bytes]) -> list[Output]:
        queue = self._links.get(asked.link)
        if queue is None:
            self._machine.violations.append(f"link {asked.link} is not open")
            return [(0.0, reply(vxi11.read_response(vxi11.Error.INVALID_LINK, 0, b"")))]
        wait, data, found = queue.take(asked.timeout_ms / 1000)
        if not found:
            return [(wait, reply(vxi11.read_response(vxi11.Error.IO_TIMEOUT, 0, b"")))]
        if data is None:
            return [(wait, None)]
        given, rest = data[: asked.size], data[asked.size :]
        if rest:
            queue.put_back(rest)
        reason = vxi11.Reason.REQUEST_COUNT if rest else vxi11.Reason.END
        return [(wait, reply(vxi11.read_response(vxi11.Error.NONE, reason, given)))]


class HislipInstrument:
    """HiSLIP sessions, each with a synchronous and an asynchronous channel.

    Parameters
    ----------
    machine : Machine
        Simulated instrument.
    execute : callable
        Executes a program message.
    script : FaultScript
        Faults of the answers.

    Examples
    --------
    >>> from reseau_sims.serving import Oscilloscope
    >>> scope = Oscilloscope()
    >>> channel = HislipInstrument(scope, scope.execute, FaultScript()).channel()
    >>> [(_, reply)] = channel.receive(hislip.encode(hislip.Message(hislip.Type.INITIALIZE)))
    >>> hislip.MessageDecoder().feed(reply)[0].type == hislip.Type.INITIALIZE_RESPONSE
    True
    """

    def __init__(self, machine: Machine, execute: Execute, script: FaultScript) -> None:
        self.machine = machine
        self.open_queue: Callable[[], AnswerQueue] = lambda: AnswerQueue(machine, execute, script)
        self.queues: dict[int, AnswerQueue] = {}
        self._numbers = itertools.count(1)

    def channel(self) -> _Channel:
        """Open a connection; its first message determines which channel it is."""
        return _Channel(self)

    def begin(self) -> int:
        """Start a session."""
        number = next(self._numbers) & 0xFFFF
        self.queues[number] = self.open_queue()
        return number


class _Channel:
    """One connection of a HiSLIP session."""

    def __init__(self, instrument: HislipInstrument) -> None:
        self._instrument = instrument
        self._decoder = hislip.MessageDecoder(_LARGEST)
        self._session: int | None = None
        self._synchronous = False
        self._begun = b""

    def disconnected(self) -> None:
        """End the session if this is its synchronous channel."""
        if self._synchronous and self._session is not None:
            self._instrument.queues.pop(self._session, None)

    def receive(self, data: bytes) -> list[Output]:
        """Return the messages in answer."""
        sent: list[Output] = []
        for message in self._decoder.feed(data):
            if isinstance(message, Damaged):
                sent += self._fatal(1, str(message))
            else:
                sent += self._answer(message)
        return sent

    def _fatal(self, code: int, why: str) -> list[Output]:
        self._instrument.machine.violations.append(why)
        return [(0.0, _coded(hislip.Type.FATAL_ERROR, code, 0, why.encode())), (0.0, None)]

    def _answer(self, message: hislip.Message) -> list[Output]:
        kind = message.type
        if kind == hislip.Type.INITIALIZE:
            self._session, self._synchronous = self._instrument.begin(), True
            # Version 1.0 of the protocol, and the number of the session.
            return [(0.0, _coded(hislip.Type.INITIALIZE_RESPONSE, 0, 0x0100 << 16 | self._session))]
        if kind == hislip.Type.ASYNC_INITIALIZE:
            self._session = message.parameter & 0xFFFF
            if self._session not in self._instrument.queues:
                return self._fatal(3, f"session {self._session} does not exist")
            return [(0.0, _coded(hislip.Type.ASYNC_INITIALIZE_RESPONSE, 0, 0))]
        queue = self._instrument.queues.get(self._session) if self._session is not None else None
        if queue is None:
            return self._fatal(2, "a message before both channels were initialized")
        return self._synchronously(message, queue) if self._synchronous else self._aside(message, queue)

    def _synchronously(self, message: hislip.Message, queue: AnswerQueue) -> list[Output]:
        match message.type:
            case hislip.Type.DATA | hislip.Type.DATA_END:
                self._begun += message.payload
                if message.type == hislip.Type.DATA:
                    return [] if len(self._begun) <= _LARGEST else self._fatal(0, "a message without end")
                program, self._begun = self._begun, b""
                # An answer is sent at once; none is left to be interrupted.
                queue.write(program)
                return self._sent(queue, message.parameter)
            case hislip.Type.TRIGGER:
                return []
            case hislip.Type.DEVICE_CLEAR_COMPLETE:
                queue.clear()
                self._begun = b""
                return [(0.0, _coded(hislip.Type.DEVICE_CLEAR_ACKNOWLEDGE, 0, 0))]
        return [(0.0, _coded(hislip.Type.ERROR, 1, 0, b"unrecognized message type"))]

    def _sent(self, queue: AnswerQueue, number: int) -> list[Output]:
        sent: list[Output] = []
        while True:
            wait, data, found = queue.take(float("inf"))
            if not found:
                return sent
            if data is None:
                sent.append((wait, None))
                return sent
            # In two messages, as instruments send long answers.
            half = len(data) // 2
            if half > 100:
                sent.append((wait, _coded(hislip.Type.DATA, 0, number, data[:half])))
                wait, data = 0.0, data[half:]
            sent.append((wait, _coded(hislip.Type.DATA_END, 0, number, data)))

    def _aside(self, message: hislip.Message, queue: AnswerQueue) -> list[Output]:
        match message.type:
            case hislip.Type.ASYNC_MAX_MSG_SIZE:
                size = struct.pack(">Q", _LARGEST)
                return [(0.0, _coded(hislip.Type.ASYNC_MAX_MSG_SIZE_RESPONSE, 0, 0, size))]
            case hislip.Type.ASYNC_STATUS_QUERY:
                status = queue.status()
                return [(0.0, _coded(hislip.Type.ASYNC_STATUS_RESPONSE, status, 0))]
            case hislip.Type.ASYNC_DEVICE_CLEAR:
                queue.clear()
                return [(0.0, _coded(hislip.Type.ASYNC_DEVICE_CLEAR_ACKNOWLEDGE, 0, 0))]
            case hislip.Type.ASYNC_LOCK:
                return [(0.0, _coded(hislip.Type.ASYNC_LOCK_RESPONSE, 1, 0))]
            case hislip.Type.ASYNC_LOCK_INFO:
                return [(0.0, _coded(hislip.Type.ASYNC_LOCK_INFO_RESPONSE, 0, 1))]
            case hislip.Type.ASYNC_REMOTE_LOCAL_CONTROL:
                return [(0.0, _coded(hislip.Type.ASYNC_REMOTE_LOCAL_RESPONSE, 0, 0))]
        return [(0.0, _coded(hislip.Type.ERROR, 1, 0, b"unrecognized message type"))]


def _coded(kind: hislip.Type, control: int, parameter: int, payload: bytes = b"") -> bytes:
    return hislip.encode(hislip.Message(kind, control, parameter, payload))
