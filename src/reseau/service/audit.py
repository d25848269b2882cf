"""The audit log: who moved hardware or changed a calibration through the service, when, and from where.

A journal of the archive, which the database keeps from being changed. Each entry contains the hash of the one
before, and is signed with a key that is not in the archive. A bare chain does not show that its end was cut
off: the last entry is therefore also written beside the key, as the head, and can be kept elsewhere, too.
"""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

from ..archive import Archive
from ..core.errors import FormatError, UsageError
from ..core.optional import optional
from ..io import Document
from .state import StateFolder, private_file

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey


_JOURNAL, _KEY, _PUBLIC, _HEAD = "audit", "audit-key.pem", "audit-public.pem", "audit-head.json"
_FIRST = "0" * 64
_PART = 1000
"""Entries that are read at a time."""
_SIGNED = ("number", "previous", "at", "by", "via", "action", "about", "facts")


class Head(Document):
    """The end of an audit log, ``reseau-audit-head/1``: number and hash of its last entry.

    Examples
    --------
    >>> Head.read_line("17 " + 64 * "a").number
    17
    """

    SCHEMA: ClassVar[str] = "reseau-audit-head/1"

    number: int
    hash: str

    @classmethod
    def read_line(cls, text: str) -> Self:
        """Read a head as `reseau audit head` prints it.

        Raises
        ------
        FormatError
            If it is none.
        """
        number, _, digest = text.strip().partition(" ")
        if not number.isdigit() or len(digest) != 64:
            raise FormatError("is not a head", where=repr(text), do="use a line of `reseau audit head`")
        return cls(number=int(number), hash=digest)


@dataclass(frozen=True)
class AuditEntry:
    """An entry of the audit log.

    Parameters
    ----------
    number : int
        From 1 on, without a gap.
    at : str
        When, ISO 8601.
    by, via : str
        Who, and how they were known.
    action, about : str
        What was done, and to what.
    facts : dict
        Its values.

    Examples
    --------
    >>> AuditEntry(1, "2026-03-02T08:00:00+00:00", "Ada", "login", "jog", "bench cellar", {}).about
    'bench cellar'
    """

    number: int
    at: str
    by: str
    via: str
    action: str
    about: str
    facts: dict[str, Any]


class Audit:
    """The audit log of an archive.

    Parameters
    ----------
    archive : Archive
        The archive.
    state : StateFolder
        Has the key, which is made when there is none, and the head.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(f"{folder}/a", create=True) as archive:
    ...     state = StateFolder(Path(folder) / "state")
    ...     audit = Audit(archive, state)
    ...     audit.record("Ada", "login", "jog", "bench cellar", {"axis": "tilt"}).number
    ...     audit.verify()
    1
    []
    """

    def __init__(self, archive: Archive, state: StateFolder) -> None:
        with optional():
            from cryptography.hazmat.primitives import serialization as forms
            from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        self._archive, self._state, self._lock = archive, state, threading.Lock()
        self._journal = archive.journal(_JOURNAL)
        path = state.path(_KEY)
        if not path.is_file():
            made = Ed25519PrivateKey.generate()
            kind = forms.PrivateFormat.PKCS8
            private_file(path, made.private_bytes(forms.Encoding.PEM, kind, forms.NoEncryption()), fresh=True)
        key = forms.load_pem_private_key(path.read_bytes(), None)
        if not isinstance(key, Ed25519PrivateKey):
            raise FormatError("is not an Ed25519 key", where=path)
        self._key, self._whole = key, _Whole()
        public = key.public_key().public_bytes(forms.Encoding.PEM, forms.PublicFormat.SubjectPublicKeyInfo)
        if not state.path(_PUBLIC).is_file():
            private_file(state.path(_PUBLIC), public)
        self.public = public

    def record(
        self, by: str, via: str, action: str, about: str, facts: Mapping[str, Any] | None = None
    ) -> AuditEntry:
        """Append an entry; it is stored when this returns.

        Raises
        ------
        ArchiveError
            If the archive cannot store it: what was to be recorded must not be done then.
        """
        plain = json.loads(json.dumps(dict(facts or {}), default=str))
        with self._lock:
            while True:
                last = self._last()
                number, previous = (1, _FIRST) if last is None else (last["number"] + 1, last["hash"])
                at = self._archive.clock().isoformat()
                signed = {
                    "number": number, "previous": previous, "at": at, "by": by, "via": via, "action": action,
                    "about": about, "facts": plain,
                }  # fmt: skip
                digest = _digest(signed)
                signature = base64.b64encode(self._key.sign(bytes.fromhex(digest))).decode()
                document = signed | {"hash": digest, "signature": signature}
                # Another process may have appended an entry with this number.
                if self._journal.append(str(number), "audit", document) is not None:
                    break
            head = Head(number=number, hash=digest)
            private_file(self._state.path(_HEAD), head.to_json().encode("utf-8"))
        return AuditEntry(number, at, by, via, action, about, plain)

    def _last(self) -> dict[str, Any] | None:
        found = self._journal.last()
        return None if found is None else found.document

    def entries(self, count: int | None = 100, before: int | None = None) -> list[AuditEntry]:
        """Return the last entries, or all, newest first."""
        found = self._journal.entries(before=None if before is None else str(before), last=count)
        return [
            AuditEntry(**{k: v for k, v in each.document.items() if k in AuditEntry.__dataclass_fields__})
            for each in reversed(found)
        ]

    def head(self) -> Head | None:
        """Return the head beside the key; None while there is none."""
        path = self._state.path(_HEAD)
        return Head.parse(path.read_text(), where=path) if path.is_file() else None

    def verify(self, heads: Sequence[Head] = (), *, again: bool = True) -> list[str]:
        """Return what is wrong with the log; nothing if it is whole.

        Parameters
        ----------
        heads : sequence of Head
            Heads that were kept elsewhere, in addition to the one beside the key.
        again : bool
            Whether entries are verified that this object found whole before.
        """
        own, last = self.head(), self._last()
        every = [*heads, *([] if own is None else [own])]
        known, end = self._whole, 0 if last is None else last.get("number", 0)
        if again or any(number < known.number for number in (end, *(each.number for each in every))):
            known = _Whole()
        found, whole = _verified(self._archive, self._key.public_key(), every, known)
        if not found:
            self._whole = whole
        if own is None and last is not None:
            found.append("there is no head beside the key: the end may have been cut off")
        return found


@dataclass(frozen=True)
class _Whole:
    """How far a log is whole: number, hash and row of an entry."""

    number: int = 0
    hash: str = _FIRST
    row: int = 0


def verify_log(archive: Archive, public: bytes, heads: Sequence[Head]) -> list[str]:
    """Return what is wrong with the audit log of an archive; nothing if it is whole.

    Parameters
    ----------
    archive : Archive
        The archive.
    public : bytes
        Public key (PEM).
    heads : sequence of Head
        Heads that were kept: the log must contain each of them.

    Raises
    ------
    UsageError
        If the key is not one.
    """
    with optional():
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
    try:
        key = load_pem_public_key(public)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise UsageError(f"is not a public key ({error})", where="audit log") from None
    if not isinstance(key, Ed25519PublicKey):
        raise UsageError("is not an Ed25519 key", where="audit log")
    return _verified(archive, key, heads, _Whole())[0]


def _verified(
    archive: Archive, key: Ed25519PublicKey, heads: Sequence[Head], whole: _Whole
) -> tuple[list[str], _Whole]:
    """What is wrong after an entry; and how far the log is whole, if nothing is."""
    from cryptography.exceptions import InvalidSignature

    journal, wrong, hashes = archive.journal(_JOURNAL), list[str](), {whole.number: whole.hash}
    while part := journal.entries(after=whole.row, first=_PART):
        for entry in part:
            document, expected = entry.document, whole.number + 1
            number = document.get("number")
            if number != expected:
                wrong.append(f"entry {expected} is missing: number {number} follows")
                break
            signed = {name: document.get(name) for name in _SIGNED}
            digest = _digest(signed)
            if document.get("previous") != whole.hash:
                wrong.append(f"entry {number} does not follow the entry before it")
            if digest != document.get("hash"):
                wrong.append(f"entry {number} was changed")
            good = False
            with suppress(InvalidSignature, ValueError, TypeError):
                key.verify(base64.b64decode(document.get("signature", "")), bytes.fromhex(digest))
                good = True
            if not good:
                wrong.append(f"entry {number} is not signed with this key")
            whole = _Whole(expected, str(document.get("hash")), entry.number)
            hashes[expected] = whole.hash
        else:
            continue
        break
    for head in heads:
        if head.number not in hashes:
            wrong.append(f"entries after {whole.number} are missing: a head names entry {head.number}")
        elif hashes[head.number] != head.hash:
            wrong.append(f"entry {head.number} is not the one that a head names")
    return wrong, whole


def _digest(signed: Mapping[str, Any]) -> str:
    text = json.dumps(dict(signed), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode("ascii")).hexdigest()
