"""`reseau serve`, `reseau service`, `reseau audit`: the service, its accounts, upkeep and audit log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..core.errors import UsageError
from .common import ArchivePlace, AsJson, ObjectsPlace, Out, open_archive, say, writable

if TYPE_CHECKING:
    from ..service.accounts import Accounts
    from ..service.http.service import Service
    from ..service.state import StateFolder

__all__ = ["app", "audit_app", "serve"]

app = typer.Typer(no_args_is_help=True, help="The service: users, tokens, backup, upgrade, unit of systemd.")
user_app = typer.Typer(no_args_is_help=True, help="Users of the service.")
token_app = typer.Typer(no_args_is_help=True, help="Tokens of programs.")
audit_app = typer.Typer(no_args_is_help=True, help="The audit log of the service.")
app.add_typer(user_app, name="user")
app.add_typer(token_app, name="token")

State = Annotated[
    Path | None,
    typer.Option(
        "--state", envvar="RESEAU_STATE", help="Folder of accounts and keys. Default: beside the archive."
    ),
]
AccountsPlace = Annotated[
    str | None,
    typer.Option("--accounts", help="URL of the database of accounts. Default: a file in the state folder."),
]
Scope = Annotated[str, typer.Option(help="What it may do: read, operate or administer.")]


def serve(
    archive: ArchivePlace = "archive",
    objects: ObjectsPlace = None,
    bench: Annotated[
        list[str] | None,
        typer.Option(
            "--bench",
            "-b",
            help="Bench file; repeatable. Each has a worker process; on another machine: FILE@ADDRESS:PORT.",
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; others than 127.0.0.1 need TLS and users.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0: a free one.")] = 8480,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Name by which the service is asked; repeatable.")
    ] = None,
    certificate: Annotated[Path | None, typer.Option(help="Own certificate with its chain (PEM).")] = None,
    key: Annotated[Path | None, typer.Option(help="Private key of the certificate (PEM).")] = None,
    proxy: Annotated[
        str, typer.Option(help="Public address of a proxy that ends TLS, as https://bench.example.org.")
    ] = "",
    tiled: Annotated[
        str, typer.Option(help="Server of tiled to publish bluesky's documents to; its key: TILED_API_KEY.")
    ] = "",
    sign_key: Annotated[
        Path | None,
        typer.Option(
            help="Key that signs certificates of calibrations (PEM); password: RESEAU_KEY_PASSWORD."
        ),
    ] = None,
    sign_certificate: Annotated[Path | None, typer.Option(help="Certificate of that key (PEM).")] = None,
    state: State = None,
    accounts: AccountsPlace = None,
) -> None:
    """Serve pages and API over an archive, and the benches given."""
    from ..core.optional import optional

    with optional():
        from ..service.http.app import serve as run
    from ..service.http.options import ServeOptions

    benches = [_placed(each) for each in bench or ()]
    options = ServeOptions(
        archive, objects, state, accounts, host, port, tuple(name or ()), certificate, key, proxy,
        tuple(path for path, _ in benches), {path: at for path, at in benches if at is not None}, tiled,
        sign_key, sign_certificate,
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
    listen: Annotated[str, typer.Option(help="Address and port to listen on, such as 192.0.2.5:8490.")],
    certificates: Annotated[Path, typer.Option(help="Folder made by `reseau service worker-certificate`.")],
    archive: ArchivePlace,
    objects: ObjectsPlace = None,
) -> None:
    """Hold the instruments of a bench for a service on another machine, which uses the same archive."""
    from ..service.worker import run

    host, port = _address(listen)
    run(bench, archive, objects, certificates, (host, port))


@app.command("worker-certificate")
def worker_certificate(
    address: Annotated[str, typer.Argument(help="Address of the other machine, such as 192.0.2.5.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write, for the other machine.")],
    archive: ArchivePlace = "archive",
    state: State = None,
) -> None:
    """Make the certificate of a worker on another machine; copy its folder there, and keep it secret."""
    from ..core.optional import optional

    with optional():
        from ..service.wire import Certificates

    Certificates(_state(archive, state)).export(address, out)
    say(f"{out}: for `reseau service worker --certificates` on {address}\n")


@app.command()
def link(
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the service.")] = 8480,
    archive: ArchivePlace = "archive",
    state: State = None,
) -> None:
    """Print an address that lets a browser of this machine in, once."""
    from ..core.errors import InputError
    from ..core.optional import optional
    from ..service.state import StateFolder

    with optional():
        import httpx
    origin = f"http://127.0.0.1:{port}"
    headers = {"Authorization": f"Bearer {StateFolder.beside(archive, state).local_token()}"}
    try:
        answer = httpx.post(f"{origin}/api/1/entries", headers=headers, timeout=10.0)
    except httpx.HTTPError as error:
        raise InputError(f"does not answer ({error})", where=origin, do="start `reseau serve`") from None
    if answer.status_code != 201:
        raise InputError(str(answer.json()["error"]["text"]), where=origin)
    say(f"{origin}{answer.json()['path']}\n")


def _state(archive: str, state: Path | None) -> StateFolder:
    from ..service.state import StateFolder

    return StateFolder.beside(archive, state)


def _accounts(archive: str, state: Path | None, accounts: str | None, **options: Any) -> Accounts:
    from ..service.accounts import Accounts

    return Accounts(accounts or _state(archive, state).path("accounts.sqlite"), **options)


def _asked_password() -> str:
    """A password from the console, twice; from a pipe, one line."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    first: str = typer.prompt("Password (at least 12 characters)", hide_input=True)
    if first != typer.prompt("Again", hide_input=True):
        raise UsageError("differ", where="passwords")
    return first


@user_app.command("add")
def add_user(
    name: Annotated[str, typer.Argument(help="Name of the user.")],
    scope: Scope = "read",
    archive: ArchivePlace = "archive",
    state: State = None,
    accounts: AccountsPlace = None,
) -> None:
    """Add a user; the password is asked for on the console."""
    with _accounts(archive, state, accounts) as found:
        found.add_user(name, _asked_password(), scope)  # type: ignore[arg-type]
    say(f"{name}: {scope}\n")


@user_app.command("list")
def list_users(
    archive: ArchivePlace = "archive",
    state: State = None,
    accounts: AccountsPlace = None,
    as_json: AsJson = False,
) -> None:
    """List the users."""
    from ..core.provenance import canonical_json

    with _accounts(archive, state, accounts) as found:
        users = found.users()
    if as_json:
        rows = [vars(each) | {"created": each.created.isoformat()} for each in users]
        say(canonical_json({"schema": "reseau-users/1", "users": rows}))
        return
    for each in users:
        say(f"{each.name}: {each.scope}{', one-time password' if each.one_time else ''}\n")


@user_app.command("change")
def change_user(
    name: Annotated[str, typer.Argument(help="Name of the user.")],
    password: Annotated[bool, typer.Option("--password", help="Ask for a new password.")] = False,
    scope: Annotated[str, typer.Option(help="New scope: read, operate or administer.")] = "",
    one_time: Annotated[
        bool | None,
        typer.Option("--one-time/--no-one-time", help="Require a one-time password (TOTP), or not."),
    ] = None,
    archive: ArchivePlace = "archive",
    state: State = None,
    accounts: AccountsPlace = None,
) -> None:
    """Change password, scope or one-time password of a user; their logins end."""
    if not password and not scope and one_time is None:
        raise UsageError("nothing to change", where=name, do="give --password, --scope or --one-time")
    with _accounts(archive, state, accounts) as found:
        if scope:
            found.set_scope(name, scope)  # type: ignore[arg-type]
        if password:
            found.set_password(name, _asked_password())
        if one_time:
            say(f"{found.require_code(name)}\n")
        elif one_time is False:
            found.waive_code(name)


@user_app.command("remove")
def remove_user(
    name: Annotated[str, typer.Argument(help="Name of the user.")],
    archive: ArchivePlace = "archive",
    state: State = None,
    accounts: AccountsPlace = None,
) -> None:
    """Remove a user; their logins end."""
    with _accounts(archive, state, accounts) as found:
        found.remove_user(name)


@token_app.command("create")
def create_token(
    name: Annotated[str, typer.Argument(help="Name of the token.")],
    scope: Scope = "read",
    days: Annotated[int, typer.Option(min=1, max=731, help="How long it lasts.")] = 90,
    archive: ArchivePlace = "archive",
    state: State = None,
    accounts: AccountsPlace = None,
) -> None:
    """Create a token for a program, and print it; it is not kept."""
    from datetime import timedelta

    with _accounts(archive, state, accounts) as found:
        say(found.create_token(name, scope, timedelta(days=days), "console") + "\n")  # type: ignore[arg-type]


@token_app.command("list")
def list_tokens(
    archive: ArchivePlace = "archive", state: State = None, accounts: AccountsPlace = None
) -> None:
    """List the tokens, without their secrets."""
    with _accounts(archive, state, accounts) as found:
        for each in found.tokens():
            ended = f"revoked {each.revoked:%Y-%m-%d}" if each.revoked else f"until {each.expires:%Y-%m-%d}"
            say(f"{each.name}: {each.scope}, by {each.made_by}, {ended}\n")


@token_app.command("revoke")
def revoke_token(
    name: Annotated[str, typer.Argument(help="Name of the token.")],
    archive: ArchivePlace = "archive",
    state: State = None,
    accounts: AccountsPlace = None,
) -> None:
    """Revoke a token."""
    with _accounts(archive, state, accounts) as found:
        found.revoke_token(name)


@app.command()
def backup(
    out: Annotated[Path, typer.Argument(help="Folder to write; new or empty.")],
    archive: ArchivePlace = "archive",
    state: State = None,
) -> None:
    """Copy archive, accounts and keys of a service that may be running; the copy is verified."""
    from ..service.upkeep import backup as made

    counted = made(Path(archive), _state(archive, state).folder, out)
    say(f"{out}: {counted.sessions} sessions, {counted.files} files, accounts and keys\n")


@app.command()
def restore(
    source: Annotated[Path, typer.Argument(help="Folder of a backup.")],
    archive: ArchivePlace = "archive",
    state: State = None,
) -> None:
    """Restore a backup to a new archive; it is verified first."""
    from ..service.upkeep import restore as made
    from ..service.upkeep import state_beside

    counted = made(source, Path(archive), state or state_beside(Path(archive)))
    say(f"{archive}: {counted.sessions} sessions, {counted.files} files, accounts and keys\n")


@app.command()
def upgrade(
    archive: ArchivePlace = "archive",
    objects: ObjectsPlace = None,
    state: State = None,
    accounts: AccountsPlace = None,
) -> None:
    """Change archive and accounts of an earlier version to the present one."""
    from ..service.upkeep import upgrade_archive

    with open_archive(archive, objects) as found:
        changed = upgrade_archive(found)
    with _accounts(archive, state, accounts, upgrade=True) as known:
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
    archive: ArchivePlace = "archive",
    bench: Annotated[list[Path] | None, typer.Option("--bench", "-b", help="Bench file; repeatable.")] = None,
) -> None:
    """Print a unit of systemd for the service."""
    import shutil

    places = [archive, *(str(each) for each in bench or [])]
    if any(character in each for each in places for character in ' "%\n'):
        raise UsageError("contains characters with a meaning for systemd", where=", ".join(places))
    program = shutil.which("reseau") or "/usr/local/bin/reseau"
    place = archive if "://" in archive else str(Path(archive).absolute())
    more = "".join(f" --bench {each.absolute()}" for each in bench or [])
    say(_UNIT.format(program=program, archive=place, more=more, where=Path.cwd()))


@audit_app.command()
def verify(
    archive: ArchivePlace = "archive",
    objects: ObjectsPlace = None,
    state: State = None,
    key: Annotated[
        Path | None, typer.Option(help="Public key (PEM). Default: that of the state folder.")
    ] = None,
    head: Annotated[
        list[str] | None,
        typer.Option(help="Head that was kept elsewhere, a line of `reseau audit head`; repeatable."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Verify chain, signatures and end of the audit log; exit status 1 if something is wrong."""
    from ..core.provenance import canonical_json
    from ..io import read_text
    from ..service.audit import Audit, Head, verify_log

    heads = [Head.read_line(each) for each in head or []]
    with open_archive(archive, objects) as found:
        if key is None:
            wrong = Audit(found, _state(archive, state)).verify(heads)
        else:
            wrong = verify_log(found, read_text(key).encode(), heads)
        count = len(found.journal("audit").entries())
    if as_json:
        say(canonical_json({"schema": "reseau-audit-verification/1", "entries": count, "wrong": wrong}))
    else:
        say("".join(f"{each}\n" for each in wrong) or f"{count} entries: nothing is wrong\n")
    raise typer.Exit(1 if wrong else 0)


@audit_app.command("head")
def head_(
    archive: ArchivePlace = "archive", objects: ObjectsPlace = None, state: State = None, out: Out = None
) -> None:
    """Print the end of the audit log, to be kept elsewhere."""
    from ..io import write_whole
    from ..service.audit import Audit

    with open_archive(archive, objects) as found:
        head = Audit(found, _state(archive, state)).head()
    if head is None:
        raise UsageError("has no entries", where="audit log")
    line = f"{head.number} {head.hash}\n"
    if out is None:
        say(line)
    else:
        write_whole(writable(out), line)


@audit_app.command("list")
def list_audit(
    count: Annotated[int, typer.Option(min=1, help="Number of entries.")] = 50,
    archive: ArchivePlace = "archive",
    objects: ObjectsPlace = None,
    state: State = None,
) -> None:
    """List the last entries of the audit log, newest first."""
    from ..service.audit import Audit

    with open_archive(archive, objects) as found:
        for each in Audit(found, _state(archive, state)).entries(count):
            facts = ", ".join(f"{k} {v}" for k, v in each.facts.items())
            who = f"{each.by} ({each.via})"
            say(f"{each.number:>6} {each.at[:19]}Z {who}: {each.action}, {each.about}  {facts}\n")
