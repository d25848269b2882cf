"""The service over other databases and over TLS."""

from __future__ import annotations

import shutil
import ssl
import subprocess
import warnings
from pathlib import Path

import httpx
import pytest

from reseau.archive import Archive
from reseau.service.client import Client
from reseau.service.http.options import ServeOptions
from reseau.service.http.service import Service
from reseau.service.tiled import TiledPublisher

from .served import PASSWORD, Served, process


def test_archive_and_accounts_are_in_postgresql(postgres: str, tmp_path: Path) -> None:
    options = ServeOptions(
        postgres, objects=str(tmp_path / "objects"), state=tmp_path / "state", accounts=postgres
    )
    with Archive.open(postgres, tmp_path / "objects", create=True) as archive:
        archive.begin("monday", "frames", {"count": 1}).end("done")
    with Service(options) as service:
        one = Served(service)
        service.accounts.add_user("Ada", PASSWORD, "administer")
        browser = one.browser("Ada")
        assert browser.get("/api/1/me").json()["name"] == "Ada"
        assert [each["name"] for each in browser.get("/api/1/sessions").json()["sessions"]] == ["monday"]
        assert browser.get("/api/1/sessions/monday").json()["status"] == "done"
        client = one.client("administer")
        made = {"name": "left", "parts": {"camera": "DMK 33"}}
        assert client.post("/api/1/configurations", json=made).status_code == 201
        assert client.get("/api/1/audit").json()[0]["action"] == "define configuration"
        assert client.get("/api/1/audit/state").json()["whole"]
        for path in ("/", "/sessions", "/sessions/monday", "/calibrations/left", "/history", "/account"):
            assert one.client().get(path).status_code == 200, path
    with Service(options) as again:  # everything is in the database, not in the process
        assert Served(again).browser("Ada").get("/api/1/configurations").json()[0]["name"] == "left"


@pytest.mark.slow
def test_requests_over_tls(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the certificate, is not installed")
    given = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=bench"]
    names = ["-addext", "subjectAltName=IP:127.0.0.1"]
    key, pem = tmp_path / "tls.key", tmp_path / "tls.pem"
    openssl = ["openssl", "req", "-x509", *given, *names, "-keyout", key, "-out", pem]
    subprocess.run(openssl, check=True, capture_output=True)
    with process(tmp_path, "--certificate", str(pem), "--key", str(key)) as (address, token, _):
        assert address.startswith("https://")
        with Client(address, token, authority=pem) as client:
            assert client.get("/me")["scope"] == "administer"
            path = client.post("/entries")["path"]
        with httpx.Client(verify=ssl.create_default_context(cafile=pem)) as http:
            entered = http.get(address + path)
            cookie = entered.headers["set-cookie"]
            assert "Secure" in cookie
            assert "HttpOnly" in cookie
            assert "max-age" in entered.headers["strict-transport-security"]
            assert http.get(f"{address}/api/1/me").json()["name"] == "local"
        with pytest.raises(httpx.ConnectError), httpx.Client() as http:  # its certificate is not trusted
            http.get(address)
        with pytest.raises(httpx.HTTPError), httpx.Client() as http:
            http.get(address.replace("https", "http")).raise_for_status()


def test_documents_of_bluesky_are_published_to_tiled_once(archived: Path, tmp_path: Path) -> None:
    pytest.importorskip("tiled.server", reason="needs tiled (pip install 'tiled[server,client]')")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from tiled.catalog import in_memory
        from tiled.client import Context, from_context
        from tiled.server.app import build_app

        places = [str(tmp_path / "files"), f"duckdb:///{tmp_path}/tables.db"]
        with Context.from_app(build_app(in_memory(writable_storage=places))) as context:
            client = from_context(context)
            with Archive.open(archived / "archive") as archive:
                publisher = TiledPublisher(archive, "", client)
                assert publisher.look() == 1
                assert publisher.look() == 0
                (run,) = client.values()
                assert run.metadata["start"]["session"] == "monday"
                assert run.metadata["stop"]["exit_status"] == "success"
                steps = list(run["primary"].read()["step"].values)
    assert steps == ["frontal", "right", "down", "left"]
