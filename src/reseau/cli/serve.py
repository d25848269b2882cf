"""`reseau serve`, `reseau service`, `reseau audit`: the service, its accounts, upkeep and audit log."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core import vocabulary as v
from ..core.errors import UsageError
from ..core.files import writable
from ..core.options import Option
from .common import Place, for_systemd, say, say_either
from .declared import Commands

if TYPE_CHECKING:
    from ..service.accounts import Accounts
    from ..service.http.service import Service
    from ..service.state import StateFolder


app = Commands(help="The service: users, tokens, backup, upgrade, unit of systemd.")
user_app = Commands(help="Users of the service.")
token_app = Commands(help="Tokens of programs.")
audit_app = Commands(help="The audit log of the service.")
app.add_typer(user_app, name="user")
app.add_typer(token_app, name="token")


@dataclass(frozen=True)
class Beside:
    """What a service keeps beside its archive."""

    archive: v.Archive = "archive"
    state: v.State | None = None

    @property
    def folder(self) -> StateFolder:
        """The folder of accounts and keys."""
        from ..service.state import StateFolder

        return StateFolder.beside(self.archive, self.state)


@dataclass(frozen=True)
class Stated(Place):
    """An archive with the accounts and keys of a service beside it."""

    state: v.State | None = None

    @property
    def folder(self) -> StateFolder:
        """The folder of accounts and keys."""
        return Beside(self.archive, self.state).folder


@dataclass(frozen=True)
class Registered(Beside):
    """The accounts of a service."""

    accounts: v.Accounts | None = None

    def open(self, **options: Any) -> Accounts:
        """Open the accounts."""
        from ..service.accounts import Accounts

        return Accounts(self.accounts or self.folder.path("accounts.sqlite"), **options)


def serve(
    place: Stated,
    bench: Annotated[
        list[v.Bench] | None,
        "Repeatable. Each has a worker process; on another machine: FILE@ADDRESS:PORT.",
    ] = None,
    host: Annotated[
        str, Option("Address to listen on; others than 127.0.0.1 need TLS and users.")
    ] = "127.0.0.1",
    port: v.Port = 8480,
    host_name: Annotated[
        list[str] | None, Option("Name by which the service is asked; repeatable.", value="NAME")
    ] = None,
    certificate: Annotated[Path | None, Option("Own certificate with its chain (PEM).")] = None,
    key: Annotated[Path | None, Option("Private key of the certificate (PEM).")] = None,
    proxy: Annotated[
        str, Option("Public address of a proxy that ends TLS, as https://bench.example.org.", value="URL")
    ] = "",
    tiled: Annotated[
        str,
        Option("Server of tiled to publish bluesky's documents to; its key: TILED_API_KEY.", value="URL"),
    ] = "",
    signing_key: v.SigningKey | None = None,
    signing_certificate: v.SigningCertificate | None = None,
    accounts: v.Accounts | None = None,
) -> None:
    """Serve pages and API over an archive, and the benches given."""
    from ..core.optional import optional

    with optional():
        from ..service.http.app import serve as run
    from ..service.http.options import ServeOptions

    benches = [_placed(str(each)) for each in bench or ()]
    options = ServeOptions(
        place.archive, place.objects, place.state, accounts, host, port, tuple(host_name or ()),
        certificate, key, proxy,
        tuple(path for path, _ in benches), {path: at for path, at in benches if at is not None}, tiled,
        signing_key, signing_certificate,
    )  # fmt: skip

    def ready(service: Service) -> None:
        if options.open_to_others:
            return
        if sys.stderr.isatty():
            origin = f"http://127.0.0.1:{service.options.port}"
            typer.echo(f"open {origin}/enter?code={service.entry_code()}", err=True)
        else:  # what is written may be a log, which must not let anybody in
            typer.echo("`reseau service link` prints an address that lets a browser in", err=True)

    run(options, lambda line: typer.echo(line, err=True), ready)


def _placed(text: str) -> tuple[Path, tuple[str, int] | None]:
    """A bench file, and where its worker listens if that is on another machine."""
    name, _, at = text.rpartition("@")
    if not name or Path(text).is_file():
        return Path(text), None
    return Path(name), _address(at)


def _address(text: str) -> tuple[str, int]:
    import ipaddress

    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    try:
        ipaddress.ip_address(host)
    except ValueError:
        host = ""
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise UsageError("is no address and port", where=text, do="use 192.0.2.5:8490")
    return host, int(port)


@app.command()
def worker(
    bench: Annotated[Path, typer.Argument(help="Bench file; the service has the same.")],
    listen: Annotated[str, Option("Address and port to listen on, such as 192.0.2.5:8490.")],
    certificates: Annotated[Path, Option("Folder made by `reseau service worker-certificate`.")],
    archive: v.Archive,
    objects: v.Objects | None = None,
) -> None:
    """Hold the instruments of a bench for a service on another machine, which uses the same archive."""
    from ..service.worker import run

    host, port = _address(listen)
    run(bench, archive, objects, certificates, (host, port))


@app.command("worker-certificate")
def worker_certificate(
    address: Annotated[str, typer.Argument(help="Address of the other machine, such as 192.0.2.5.")],
    out: Annotated[v.Out, "Here a folder, for the other machine."],
    kept: Beside,
) -> None:
    """Make the certificate of a worker on another machine; copy its folder there, and keep it secret."""
    from ..core.optional import optional

    with optional():
        from ..service.wire import Certificates

    Certificates(kept.folder).export(address, out)
    say(f"{out}: for `reseau service worker --certificates` on {address}\n")


@app.command()
def link(kept: Beside, port: v.Port = 8480) -> None:
    """Print an address that lets a browser of this machine in, once."""
    from ..core.errors import InputError
    from ..core.optional import optional

    with optional():
        import httpx
    origin = f"http://127.0.0.1:{port}"
    headers = {"Authorization": f"Bearer {kept.folder.local_token()}"}
    try:
        answer = httpx.post(f"{origin}/api/1/entries", headers=headers, timeout=10.0)
    except httpx.HTTPError as error:
        raise InputError(f"does not answer ({error})", where=origin, do="start `reseau serve`") from None
    if answer.status_code != 201:
        raise InputError(str(answer.json()["error"]["text"]), where=origin)
    say(f"{origin}{answer.json()['path']}\n")


def _asked_password() -> str:
    """A password from the console, twice; from a pipe, one line."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    first: str = typer.prompt("Password (at least 12 characters)", hide_input=True)
    if first != typer.prompt("Again", hide_input=True):
        raise UsageError("differ", where="passwords")
    return first


def _asked_code() -> str:
    """A code of an authenticator, from the console or a pipe."""
    if not sys.stdin.isatty():
        return sys.stdin.readline()
    code: str = typer.prompt("Code that the authenticator shows")
    return code


@user_app.command("add")
def add_user(
    name: Annotated[str, typer.Argument(help="Name of the user.")],
    known: Registered,
    scope: v.Scope = "read",
) -> None:
    """Add a user; the password is asked for on the console."""
    with known.open() as found:
        found.add_user(name, _asked_password(), scope)
    say(f"{name}: {scope}\n")


@user_app.command("list")
def list_users(
    known: Registered,
    as_json: v.AsJson = False,
) -> None:
    """List the users."""
    with known.open() as found:
        users = found.users()
    lines = (f"{each.name}: {each.scope}{', one-time password' if each.one_time else ''}" for each in users)
    say_either(as_json, {"schema": "reseau-users/1", "users": list(map(vars, users))}, lines)


@user_app.command("change")
def change_user(
    name: Annotated[str, typer.Argument(help="Name of the user.")],
    known: Registered,
    password: Annotated[bool, Option("Ask for a new password.")] = False,
    scope: v.Scope | None = None,
    one_time: Annotated[
        bool | None,
        Option("Require a one-time password (TOTP), or not."),
    ] = None,
) -> None:
    """Change password, scope or one-time password of a user; their logins end."""
    if not password and not scope and one_time is None:
        raise UsageError("nothing to change", where=name, do="give --password, --scope or --one-time")
    with known.open() as found:
        if scope:
            found.set_scope(name, scope)
        if password:
            found.set_password(name, _asked_password())
        if one_time:
            say(f"{found.require_code(name)}\n")
            found.confirm_code(name, _asked_code())
        elif one_time is False:
            found.waive_code(name)


@user_app.command("remove")
def remove_user(
    name: Annotated[str, typer.Argument(help="Name of the user.")],
    known: Registered,
) -> None:
    """Remove a user; their logins and tokens end."""
    with known.open() as found:
        found.remove_user(name)


@token_app.command("create")
def create_token(
    name: Annotated[str, typer.Argument(help="Name of the token.")],
    known: Registered,
    scope: v.Scope = "read",
    user: Annotated[
        str, Option("Whose it is: it may do at most what they may, and ends with them.")
    ] = "local",
    days: Annotated[int, Option("How long it lasts.", least=1, most=731)] = 90,
) -> None:
    """Create a token for a program, and print it; it is not kept."""
    from datetime import timedelta

    with known.open() as found:
        say(found.create_token(name, scope, timedelta(days=days), user) + "\n")


@token_app.command("list")
def list_tokens(known: Registered) -> None:
    """List the tokens, without their secrets."""
    with known.open() as found:
        for each in found.tokens():
            ended = f"revoked {each.revoked:%Y-%m-%d}" if each.revoked else f"until {each.expires:%Y-%m-%d}"
            say(f"{each.name}: {each.scope}, of {each.user}, {ended}\n")


@token_app.command("revoke")
def revoke_token(
    name: Annotated[str, typer.Argument(help="Name of the token.")],
    known: Registered,
) -> None:
    """Revoke a token."""
    with known.open() as found:
        found.revoke_token(name)


@app.command()
def backup(out: Annotated[Path, typer.Argument(help="Folder to write; new or empty.")], kept: Beside) -> None:
    """Copy archive, accounts and keys of a service that may be running; the copy is verified."""
    from ..service.upkeep import backup as made

    counted = made(Path(kept.archive), kept.folder.folder, out)
    say(f"{out}: {counted.sessions} sessions, {counted.files} files, accounts and keys\n")


@app.command()
def restore(source: Annotated[Path, typer.Argument(help="Folder of a backup.")], kept: Beside) -> None:
    """Restore a backup to a new archive; it is verified first."""
    from ..service.state import state_beside
    from ..service.upkeep import restore as made

    counted = made(source, Path(kept.archive), kept.state or state_beside(Path(kept.archive)))
    say(f"{kept.archive}: {counted.sessions} sessions, {counted.files} files, accounts and keys\n")


@app.command()
def upgrade(place: Stated, accounts: v.Accounts | None = None) -> None:
    """Change archive and accounts of an earlier version to the present one."""
    from ..service.upkeep import upgrade_archive

    with place.open() as found:
        changed = upgrade_archive(found)
    with Registered(place.archive, place.state, accounts).open(upgrade=True) as known:
        if known.upgraded_from is not None:
            changed.append(f"accounts of version {known.upgraded_from}")
    say("".join(f"upgraded: {each}\n" for each in changed) or "everything is of the present version\n")


_UNIT = """\
# /etc/systemd/system/reseau.service
[Unit]
Description=reseau: acquisition and calibration
After=network.target

[Service]
User=reseau
ExecStart={program} serve --archive {archive} --state /var/lib/reseau{more}
StateDirectory=reseau
StateDirectoryMode=0700
WorkingDirectory={where}
Restart=on-failure
# A worker carries on with its session when the service ends; `systemctl kill` ends it.
KillMode=process
NoNewPrivileges=yes
PrivateTmp=yes
ProtectSystem=strict
ReadWritePaths={where}
ProtectHome=read-only
ProtectKernelTunables=yes
ProtectControlGroups=yes
RestrictSUIDSGID=yes
LockPersonality=yes

[Install]
WantedBy=multi-user.target
"""


@app.command()
def unit(
    archive: v.Archive = "archive", bench: Annotated[list[v.Bench] | None, "Repeatable."] = None
) -> None:
    """Print a unit of systemd for the service."""
    say(for_systemd(_UNIT, archive, bench or ()))


@audit_app.command()
def verify(
    place: Stated,
    public_key: Annotated[Path | None, Option("Public key (PEM). Default: that of the state folder.")] = None,
    head: Annotated[
        list[str] | None,
        Option("Head that was kept elsewhere, a line of `reseau audit head`; repeatable."),
    ] = None,
    as_json: v.AsJson = False,
) -> None:
    """Verify chain, signatures and end of the audit log; exit status 1 if something is wrong."""
    from ..io import read_text
    from ..service.audit import Audit, Head, verify_log

    heads = [Head.read_line(each) for each in head or []]
    with place.open() as found:
        if public_key is None:
            wrong = Audit(found, place.folder).verify(heads)
        else:
            wrong = verify_log(found, read_text(public_key).encode(), heads)
        count = len(found.journal("audit").entries())
    content = {"entries": count, "wrong": wrong}
    said = wrong or [f"{count} entries: nothing is wrong"]
    say_either(as_json, {"schema": "reseau-audit-verification/1", **content}, map(str, said))
    raise typer.Exit(1 if wrong else 0)


@audit_app.command("head")
def head_(place: Stated, out: v.Out | None = None) -> None:
    """Print the end of the audit log, to be kept elsewhere."""
    from ..io import write_whole
    from ..service.audit import Audit

    with place.open() as found:
        head = Audit(found, place.folder).head()
    if head is None:
        raise UsageError("has no entries", where="audit log")
    line = f"{head.number} {head.hash}\n"
    if out is None:
        say(line)
    else:
        write_whole(writable(out), line)


@audit_app.command("list")
def list_audit(
    place: Stated,
    limit: v.Limit = 50,
) -> None:
    """List the last entries of the audit log, newest first."""
    from ..service.audit import Audit

    with place.open() as found:
        for each in Audit(found, place.folder).entries(limit or None):
            facts = ", ".join(f"{k} {v}" for k, v in each.facts.items())
            who = f"{each.by} ({each.via})"
            say(f"{each.number:>6} {each.at[:19]}Z {who}: {each.action}, {each.about}  {facts}\n")
