"""What service and worker say to each other: messages over TLS with certificates on both sides.

A message is two lengths (4 bytes each, most significant first), a header in JSON, and bytes. Requests have
`id` and `do`; answers have the same `id`, and `value` or `error`; events have `event`. The protocol is
described in `docs/formats/service.md`, ``reseau-worker/1``.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import select
import socket
import ssl
import struct
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal, TypeVar

from ..core.errors import (
    ArchiveError,
    ConnectionLost,
    InstrumentError,
    ProtocolError,
    ReseauError,
    UsageError,
)
from ..core.optional import optional
from .state import StateFolder, private_file

T = TypeVar("T")
_LENGTHS = struct.Struct(">II")
_MOST_HEADER, _MOST_BODY = 8 << 20, 256 << 20
_NAME, _AUTHORITY, _KEY = "reseau workers", "authority.pem", "authority-key.pem"
_PATIENCE_S = 10.0
"""How long the other side may not read."""
Role = Literal["service", "worker"]


class Certificates:
    """The certificates with which service and workers know each other; made when they are first needed.

    Parameters
    ----------
    state : StateFolder
        Where they are.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     certificates = Certificates(StateFolder(Path(folder) / "state"))
    ...     certificates.context("worker").verify_mode.name
    'CERT_REQUIRED'
    """

    def __init__(self, state: StateFolder) -> None:
        self._folder = state.subfolder("workers")
        if not (self._folder / _AUTHORITY).is_file():
            self._make()

    @classmethod
    def in_folder(cls, folder: Path) -> Certificates:
        """Return those of a worker on another machine; see :meth:`export`.

        Raises
        ------
        UsageError
            If they are not there, or others may read them.
        """
        found = cls.__new__(cls)
        found._folder = StateFolder(folder).folder
        for name in (_AUTHORITY, "worker.pem"):
            if not (folder / name).is_file():
                do = "make it with `reseau service worker-certificate` beside the service"
                raise UsageError("is missing", where=folder / name, do=do)
        return found

    def export(self, address: str, folder: Path) -> None:
        """Write the certificate of a worker on another machine, and what it needs to know the service.

        Parameters
        ----------
        address : str
            Its address, which the service checks.
        folder : Path
            Written; readable by its owner alone.

        Raises
        ------
        UsageError
            If it is no address, or the authority was made by an earlier version.
        """
        try:
            host = ipaddress.ip_address(address)
        except ValueError:
            raise UsageError("is no address", where=address, do="use 192.0.2.5") from None
        if not (self._folder / _KEY).is_file():
            do = f"end the service, and move {self._folder} away"
            raise UsageError("has no key of its authority", where=self._folder, do=do)
        with optional():
            from cryptography.hazmat.primitives.serialization import load_pem_private_key
        authority: Any = load_pem_private_key((self._folder / _KEY).read_bytes(), None)
        target = StateFolder(folder).folder
        private_file(target / "worker.pem", _issued("worker", authority, host))
        private_file(target / _AUTHORITY, (self._folder / _AUTHORITY).read_bytes())

    def _make(self) -> None:
        with optional():
            from cryptography.hazmat.primitives import serialization as forms
            from cryptography.hazmat.primitives.asymmetric import ec
        authority = ec.generate_private_key(ec.SECP256R1())
        bare = authority.private_bytes(forms.Encoding.PEM, forms.PrivateFormat.PKCS8, forms.NoEncryption())
        private_file(self._folder / _KEY, bare)
        for role in ("service", "worker"):
            private_file(self._folder / f"{role}.pem", _issued(role, authority))
        # Last: its presence says that the others are there.
        private_file(self._folder / _AUTHORITY, _issued("", authority))

    def context(self, role: Role, *, elsewhere: bool = False) -> ssl.SSLContext:
        """Return the settings of one side, which requires the certificate of the other.

        Of a worker elsewhere the service checks the address, too.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if role == "worker" else ssl.PROTOCOL_TLS_CLIENT)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        context.check_hostname = elsewhere
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(self._folder / _AUTHORITY)
        context.load_cert_chain(self._folder / f"{role}.pem")
        return context


def _issued(name: str, authority: Any, address: Any = None) -> bytes:
    """A certificate with its key (PEM); without a name, that of the authority, without its key."""
    with optional():
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives import serialization as forms
        from cryptography.hazmat.primitives.asymmetric import ec

    def named(text: str) -> x509.Name:
        return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, text)])

    key = ec.generate_private_key(ec.SECP256R1()) if name else authority
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(named(name or _NAME))
        .issuer_name(named(_NAME))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        # The clock may be set back later.
        .not_valid_before(now - timedelta(days=3650))
        .not_valid_after(now + timedelta(days=36500))
        .add_extension(x509.BasicConstraints(ca=not name, path_length=None), critical=True)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.public_key()), False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False)
    )
    if address is not None:
        made = made.add_extension(x509.SubjectAlternativeName([x509.IPAddress(address)]), False)
    content: bytes = made.sign(authority, hashes.SHA256()).public_bytes(forms.Encoding.PEM)
    if not name:
        return content
    bare = key.private_bytes(forms.Encoding.PEM, forms.PrivateFormat.PKCS8, forms.NoEncryption())
    return bytes(bare) + content


def checked_peer(sock: ssl.SSLSocket, role: Role) -> None:
    """Check that the other side has the certificate of its role.

    Raises
    ------
    ConnectionLost
        If it has another one.
    """
    found = sock.getpeercert() or {}
    names: Any = found.get("subject", ())
    said = {value for part in names for key, value in part if key == "commonName"}
    if said != {role}:
        raise ConnectionLost(f"is not a {role}", where="certificate")


class Wire:
    """One side of a connection; several threads may send, one receives.

    Parameters
    ----------
    sock : socket
        Connected.

    Examples
    --------
    >>> one, two = socket.socketpair()
    >>> with one, two:
    ...     Wire(one).send({"id": 1, "do": "status"}, b"body")
    ...     Wire(two).receive()
    ({'id': 1, 'do': 'status'}, b'body')
    """

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        # OpenSSL does not read and write one connection at the same time; a message is sent in one piece.
        self._using, self._sending = threading.Lock(), threading.Lock()
        sock.setblocking(False)
        if sock.family in _INET:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, header: dict[str, Any], body: bytes = b"") -> None:
        """Send a message.

        Raises
        ------
        ConnectionLost
            If the other side is gone, or does not read.
        """
        text = json.dumps(header, default=str).encode("utf-8")
        rest = memoryview(_LENGTHS.pack(len(text), len(body)) + text + body)
        with self._sending:
            while rest:
                sent = self._when_ready(lambda rest=rest: self._sock.send(rest[: 1 << 18]), _PATIENCE_S)  # type: ignore[misc]
                rest = rest[sent:]

    def receive(self) -> tuple[dict[str, Any], bytes]:
        """Wait for a message.

        Raises
        ------
        ConnectionLost
            If the other side is gone.
        ProtocolError
            If it is no message.
        """
        header, body = _LENGTHS.unpack(self._exactly(_LENGTHS.size))
        if header > _MOST_HEADER or body > _MOST_BODY:
            raise ProtocolError("is too long", where="message")
        try:
            found = json.loads(self._exactly(header))
        except ValueError:
            raise ProtocolError("is no JSON", where="message") from None
        if not isinstance(found, dict):
            raise ProtocolError("is no object", where="message")
        return found, self._exactly(body)

    def _exactly(self, count: int) -> bytes:
        parts = bytearray()
        while len(parts) < count:
            wanted = min(1 << 18, count - len(parts))
            part = self._when_ready(lambda wanted=wanted: self._sock.recv(wanted), None)  # type: ignore[misc]
            if not part:
                raise ConnectionLost("is gone", where="worker")
            parts += part
        return bytes(parts)

    def _when_ready(self, work: Callable[[], T], seconds: float | None) -> T:
        """Do something with the connection as soon as it allows it."""
        while True:
            try:
                with self._using:
                    return work()
            except (ssl.SSLWantReadError, ssl.SSLWantWriteError, BlockingIOError) as error:
                reads = isinstance(error, ssl.SSLWantReadError) or seconds is None
                mine: list[Any] = [self._sock]
                try:
                    if not any(select.select(mine if reads else [], [] if reads else mine, [], seconds)):
                        raise ConnectionLost("does not read", where="worker") from None
                except (OSError, ValueError):
                    raise ConnectionLost("is gone", where="worker") from None
            except (OSError, ValueError) as error:
                raise ConnectionLost(f"is gone ({error})", where="worker") from None

    def close(self) -> None:
        """Close the connection; whoever waits for a message gets an error."""
        with contextlib.suppress(OSError):
            self._sock.shutdown(socket.SHUT_RDWR)
        self._sock.close()


_INET = (socket.AF_INET, socket.AF_INET6)


def to_error(error: ReseauError) -> dict[str, Any]:
    """Return an error as a part of a message.

    Examples
    --------
    >>> to_error(UsageError("is too small", where="count", do="use 3"))["do"]
    'use 3'
    """
    where = None if error.where is None else str(error.where)
    if isinstance(error, InstrumentError):
        return {"kind": "instrument", "what": str(error), "where": None, "do": None}
    kind = "usage" if error.exit_status == 2 else "archive"
    return {"kind": kind, "what": error.what, "where": where, "do": error.do}


def error_of(found: dict[str, Any]) -> ReseauError:
    """Return the error that a message has.

    Examples
    --------
    >>> str(error_of({"kind": "usage", "what": "is too small", "where": "count", "do": "use 3"}))
    'count: is too small; use 3'
    """
    what, where, do = (found.get(key) for key in ("what", "where", "do"))
    kinds: dict[Any, type[ReseauError]] = {
        "usage": UsageError, "instrument": InstrumentError, "archive": ArchiveError,
    }  # fmt: skip
    return kinds.get(found.get("kind"), ReseauError)(str(what), where=where, do=do)
