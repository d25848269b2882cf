"""Who somebody is: tokens, one-time passwords, attempts to log in, and what changes an account."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from reseau.core.errors import UsageError
from reseau.service.accounts import Accounts, one_time_code
from reseau.service.attempts import RefusedLogin

from .served import ORIGIN, PASSWORD, Served, served
from .test_security import NOW, Clock

FRESH = {"my_password": PASSWORD}


@pytest.fixture
def accounts(tmp_path: Path) -> Iterator[tuple[Accounts, Clock]]:
    clock = Clock()
    with Accounts(tmp_path / "accounts.sqlite", clock) as found:
        found.add_user("Ada", PASSWORD, "operate")
        yield found, clock


@pytest.fixture
def one(tmp_path: Path) -> Iterator[Served]:
    with served(tmp_path) as found:
        found.service.accounts.add_user("Ada", PASSWORD, "administer")
        yield found


def logged_in(one: Served, name: str) -> TestClient:
    """A browser in which somebody has logged in, with the token against forged requests."""
    browser = one.browser(name)
    browser.headers["X-CSRF-Token"] = browser.get("/api/1/me").json()["csrf"]
    return browser


def with_token(one: Served, secret: str) -> TestClient:
    client = one.client("")
    client.headers["Authorization"] = f"Bearer {secret}"
    return client


def try_to(one: Served, name: str, password: str, code: str = "") -> Any:
    given = {"name": name, "password": password, "code": code}
    return one.client("").post("/api/1/login", json=given, headers={"Origin": ORIGIN})


def secret_of(address: str) -> str:
    found = re.search(r"secret=([A-Z2-7]+)", address)
    assert found is not None
    return found[1]


def code_of(secret: str, clock: Clock | None = None, later: int = 0) -> str:
    import time

    now = time.time() if clock is None else clock.now.timestamp()
    return one_time_code(secret, int(now) // 30 + later)


@pytest.mark.parametrize("header", ["", " "])
def test_an_empty_authorization_header_does_not_skip_the_csrf_check(one: Served, header: str) -> None:
    browser = one.browser("Ada")
    answer = browser.post("/api/1/logout", headers={"Authorization": header})
    assert (answer.status_code, answer.json()["error"]["code"]) == (403, "forbidden")
    assert browser.get("/api/1/me", headers={"Authorization": header}).json()["csrf"]


def test_tokens_end_with_their_user_and_act_in_the_name_of_the_user(one: Served) -> None:
    ada = logged_in(one, "Ada")
    new = {"name": "Mallory", "password": PASSWORD, "scope": "administer"}
    assert ada.post("/api/1/users", json=new | FRESH).status_code == 201
    mallory = logged_in(one, "Mallory")
    wanted = {"name": "Ada", "scope": "administer", "days": 731}
    secret = mallory.post("/api/1/tokens", json=wanted | FRESH).json()["secret"]
    program = with_token(one, secret)
    assert program.get("/api/1/me").json()["name"] == "Mallory"
    part = {"name": "left", "parts": {"camera": "x"}}
    assert program.post("/api/1/configurations", json=part).status_code == 201
    entry = one.service.audit.entries(1)[0]
    assert (entry.by, entry.via) == ("Mallory", "token Ada")
    back = {"name": "Back", "password": PASSWORD, "scope": "administer"}
    assert program.post("/api/1/users", json=back).status_code == 403
    assert program.post("/api/1/tokens", json=wanted | {"name": "more"}).status_code == 403
    assert ada.post("/api/1/users/Mallory/removal", json=FRESH).status_code == 200
    assert program.get("/api/1/me").status_code == 401
    # Neither does a user of the same name get it back.
    assert ada.post("/api/1/users", json=new | FRESH).status_code == 201
    assert program.get("/api/1/me").status_code == 401


def test_a_token_may_at_most_what_its_user_may(accounts: tuple[Accounts, Clock]) -> None:
    found, _ = accounts
    with pytest.raises(UsageError, match="may operate"):
        found.create_token("more", "administer", timedelta(days=1), "Ada")
    with pytest.raises(UsageError, match="is no user"):
        found.create_token("more", "read", timedelta(days=1), "Eve")
    secret = found.create_token("plotter", "operate", timedelta(days=1), "Ada")
    found.set_scope("Ada", "read")
    who = found.of_token(secret)
    assert who is not None
    assert who.scope == "read"


def test_users_see_create_and_revoke_their_own_tokens_only(one: Served) -> None:
    one.service.accounts.add_user("Bob", PASSWORD, "read")
    one.service.accounts.create_token("of Ada", "read", timedelta(days=1), "Ada")
    bob = logged_in(one, "Bob")
    new = {"name": "of Bob", "scope": "read"}
    assert bob.post("/api/1/tokens", json=new | {"scope": "operate"} | FRESH).status_code == 403
    assert bob.post("/api/1/tokens", json=new | FRESH).status_code == 201
    assert [each["name"] for each in bob.get("/api/1/tokens").json()] == ["of Bob"]
    assert bob.delete("/api/1/tokens/of Ada").status_code == 404
    assert bob.delete("/api/1/tokens/of Bob").status_code == 200


def test_a_token_expires_and_is_revoked(accounts: tuple[Accounts, Clock]) -> None:
    found, clock = accounts
    secret = found.create_token("plotter", "read", timedelta(days=1), "Ada")
    assert found.of_token(secret) is not None
    clock.now += timedelta(days=1)
    assert found.of_token(secret) is None
    clock.now = NOW
    found.revoke_token("plotter")
    assert found.of_token(secret) is None
    with pytest.raises(UsageError, match="is a token already"):
        found.create_token("plotter", "read", timedelta(days=1), "Ada")


@pytest.mark.parametrize(
    ("method", "path", "given"),
    [
        ("PUT", "me/password", {"new": "another long password"}),
        ("POST", "me/one-time", {}),
        ("POST", "tokens", {"name": "plotter"}),
        ("POST", "users", {"name": "Eve", "password": PASSWORD}),
        ("POST", "users/Ada/removal", {}),
    ],
)
def test_an_account_is_changed_with_a_fresh_password_only(
    one: Served, method: str, path: str, given: dict[str, Any]
) -> None:
    browser = logged_in(one, "Ada")
    for wrong in ({}, {"my_password": "wrong wrong wrong"}):
        answer = browser.request(method, f"/api/1/{path}", json=given | wrong)
        assert (answer.status_code, answer.json()["error"]["code"]) == (403, "forbidden")
    assert browser.request(method, f"/api/1/{path}", json=given | FRESH).status_code < 300


def test_one_time_passwords_count_when_confirmed_and_are_changed_with_password_and_code(one: Served) -> None:
    browser = logged_in(one, "Ada")
    answer = browser.post("/api/1/me/one-time", json=FRESH)
    secret = secret_of(answer.json()["secret"])
    assert try_to(one, "Ada", PASSWORD).status_code == 200  # nobody has confirmed it
    path = "/api/1/me/one-time/confirm"
    assert browser.post(path, json={"code": "000000"}).status_code == 422
    assert try_to(one, "Ada", PASSWORD).status_code == 200
    assert browser.post(path, json={"code": code_of(secret, later=-1)}).status_code == 200
    assert browser.get("/api/1/me").status_code == 401  # its logins have ended
    assert try_to(one, "Ada", PASSWORD).status_code == 401
    browser = one.client("")
    given = {"name": "Ada", "password": PASSWORD, "code": code_of(secret)}
    assert browser.post("/api/1/login", json=given, headers={"Origin": ORIGIN}).status_code == 200
    browser.headers["X-CSRF-Token"] = browser.get("/api/1/me").json()["csrf"]
    # Somebody else at this browser: neither the password alone, nor the code that was used.
    for stolen in (FRESH, FRESH | {"my_code": code_of(secret)}):
        assert browser.post("/api/1/me/one-time", json=stolen).status_code == 403
    fresh = FRESH | {"my_code": code_of(secret, later=1)}
    assert browser.post("/api/1/me/one-time", json=fresh).status_code == 200


def test_a_one_time_password_is_accepted_once(accounts: tuple[Accounts, Clock]) -> None:
    found, clock = accounts
    secret = secret_of(found.require_code("Ada"))
    assert found.log_in("Ada", PASSWORD)
    found.confirm_code("Ada", code_of(secret, clock))
    with pytest.raises(RefusedLogin):
        found.log_in("Ada", PASSWORD)
    with pytest.raises(RefusedLogin):
        found.log_in("Ada", PASSWORD, code_of(secret, clock))  # it confirmed
    clock.now += timedelta(seconds=30)
    assert found.log_in("Ada", PASSWORD, code_of(secret, clock))
    with pytest.raises(RefusedLogin):
        found.log_in("Ada", PASSWORD, code_of(secret, clock))
    with pytest.raises(UsageError, match="is not the code"):
        found.confirm_code("Ada", code_of(secret, clock, 1))  # nothing is prepared


@pytest.mark.slow
def test_of_60_guesses_at_once_ten_are_considered(one: Served) -> None:
    with ThreadPoolExecutor(60) as many:
        found = Counter(many.map(lambda k: try_to(one, "Ada", f"guess {k} guess").status_code, range(60)))
    assert found == {401: 10, 429: 50}


def test_wrong_passwords_of_others_do_not_lock_the_owner_out(one: Served) -> None:
    mine = one.browser("Ada")
    for _ in range(6):
        assert try_to(one, "Ada", "wrong wrong wrong").status_code == 401
    assert try_to(one, "Ada", PASSWORD).status_code == 200
    while try_to(one, "Ada", "wrong wrong wrong").status_code == 401:
        pass
    assert try_to(one, "Ada", PASSWORD).status_code == 429
    # From the same address, but in a browser in which Ada has logged in before.
    given = {"name": "Ada", "password": PASSWORD}
    mine.cookies.delete(one.service.cookie)
    assert mine.post("/api/1/login", json=given, headers={"Origin": ORIGIN}).status_code == 200
    # The cookie of that browser lets nobody in, and allows no more guesses than an address.
    found = [
        mine.post("/api/1/login", json=given | {"password": "wrong wrong"}, headers={"Origin": ORIGIN})
        for _ in range(12)
    ]
    assert Counter(each.status_code for each in found) == {401: 10, 429: 2}


def test_attempts_are_limited_by_user_and_address_and_for_a_time(accounts: tuple[Accounts, Clock]) -> None:
    found, clock = accounts

    def refused(name: str, address: str) -> bool:
        with pytest.raises(RefusedLogin) as error:
            found.log_in(name, "no", address=address)
        return error.value.wait_s > 0

    assert [refused("Ada", "192.0.2.1") for _ in range(11)] == [False] * 10 + [True]
    assert found.log_in("Ada", PASSWORD, address="192.0.2.2")
    with pytest.raises(RefusedLogin, match="wait 900 s"):
        found.log_in("Ada", PASSWORD, address="192.0.2.1")
    clock.now += timedelta(minutes=15)
    assert found.log_in("Ada", PASSWORD, address="192.0.2.1")
    device = found.remember("Ada")
    # Many names from an address; many addresses for a name.
    assert [refused(f"user {k}", "192.0.2.3") for k in range(31)] == [False] * 30 + [True]
    assert sum(not refused("Ada", f"198.51.100.{k}") for k in range(60)) == 40  # and ten before
    assert refused("Ada", "203.0.113.1")
    assert found.log_in("Ada", PASSWORD, address="203.0.113.1", device=device)
    assert found.log_in("Ada", PASSWORD, address="192.0.2.3", device=device)
    clock.now += timedelta(days=1)
    assert found.log_in("Ada", PASSWORD, address="203.0.113.1")
