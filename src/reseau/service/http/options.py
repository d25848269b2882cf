"""Where the service listens, and under which names it may be asked."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from ...core.errors import UsageError


@dataclass(frozen=True)
class ServeOptions:
    """Options of `reseau serve`.

    Parameters
    ----------
    archive : str
        Folder, or URL of a database.
    objects : str, optional
        Folder or URL of the files, if the archive is a database.
    state : Path, optional
        Folder of accounts and keys; by default beside the archive.
    accounts : str, optional
        URL of the database of accounts; by default a file of SQLite in the state folder.
    host, port
        Address; port 0 for a free one.
    names : tuple of str
        Names, other than the address, by which the service is asked.
    certificate, key : Path, optional
        Own certificate with its chain, and its private key (PEM).
    proxy : str
        Public address of a proxy that ends TLS, such as ``https://bench.example.org``.
    benches : tuple of Path
        Files of benches.
    workers : mapping of Path to (str, int)
        Address and port of the workers of benches on other machines, by the file of the bench.
    tiled : str
        Address of a server of tiled to which bluesky's documents are published; empty: none.
    signing_key, signing_certificate : Path, optional
        Private key and certificate (PEM) with which certificates of calibrations are signed.

    Raises
    ------
    UsageError
        If it would listen on another address than the loopback one without TLS.

    Examples
    --------
    >>> sorted(ServeOptions("archive").hosts)
    ['127.0.0.1:8480', '[::1]:8480', 'localhost:8480']
    >>> ServeOptions("archive", host="192.0.2.7")
    Traceback (most recent call last):
    reseau.core.errors.UsageError: 192.0.2.7: is open to others without TLS; ...
    """

    archive: str
    objects: str | None = None
    state: Path | None = None
    accounts: str | None = None
    host: str = "127.0.0.1"
    port: int = 8480
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    proxy: str = ""
    benches: tuple[Path, ...] = field(default_factory=tuple)
    workers: Mapping[Path, tuple[str, int]] = field(default_factory=dict)
    tiled: str = ""
    signing_key: Path | None = None
    signing_certificate: Path | None = None

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise UsageError("must be given together", where="--certificate and --key")
        if (self.signing_key is None) != (self.signing_certificate is None):
            raise UsageError("must be given together", where="--signing-key and --signing-certificate")
        if self.proxy:
            parts = urlsplit(self.proxy)
            if parts.scheme != "https" or not parts.hostname or parts.path not in ("", "/"):
                raise UsageError("is not an address https://…", where=f"--proxy {self.proxy}")
            if self.certificate is not None:
                raise UsageError("cannot be given with --certificate", where="--proxy")
        if not is_loopback(self.host) and self.certificate is None and not self.proxy:
            do = "give --certificate and --key, or --proxy"
            raise UsageError("is open to others without TLS", where=self.host, do=do)
        if self.names and self.certificate is None:
            # A name of another machine that resolves to this one is how pages of others get in.
            raise UsageError("needs --certificate and --key", where="--host-name")
        for path in (self.certificate, self.key, self.signing_key, self.signing_certificate):
            if path is not None and not path.is_file():
                raise UsageError("is not a file", where=path)

    @property
    def open_to_others(self) -> bool:
        """Whether requests of other machines can arrive: users are needed then."""
        return bool(self.proxy) or not is_loopback(self.host)

    @property
    def encrypted(self) -> bool:
        """Whether browsers speak TLS."""
        return self.certificate is not None or bool(self.proxy)

    @property
    def origins(self) -> frozenset[str]:
        """Origins of our own pages; their hosts are the names under which the service may be asked."""
        if self.proxy:
            return frozenset({self.proxy.rstrip("/").lower()})
        scheme = "https" if self.encrypted else "http"
        hosts = list(self.names)
        if is_loopback(self.host):
            hosts += ["127.0.0.1", "localhost", "::1"]
        elif ipaddress.ip_address(self.host).is_unspecified:
            hosts += ["127.0.0.1", "localhost"]
        else:
            hosts.append(self.host)
        standard = 443 if self.encrypted else 80
        found = set()
        for each in hosts:
            name = f"[{each}]" if ":" in each else each.lower()
            found.add(f"{scheme}://{name}:{self.port}")
            if self.port == standard:
                found.add(f"{scheme}://{name}")
        return frozenset(found)

    @property
    def hosts(self) -> frozenset[str]:
        """Values of the header Host that are accepted."""
        return frozenset(each.partition("://")[2] for each in self.origins)


def is_loopback(host: str) -> bool:
    """Return whether an address is the loopback one.

    Raises
    ------
    UsageError
        If it is not an address.

    Examples
    --------
    >>> is_loopback("127.0.0.1"), is_loopback("::"), is_loopback("localhost")
    (True, False, True)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise UsageError(
            "is not an address", where=f"--host {host}", do="use 127.0.0.1, or 0.0.0.0"
        ) from None
