"""Host, Origin and token of a request."""

from __future__ import annotations

import pytest
from starlette.requests import HTTPConnection

from robot.serve.guard import Guard

GUARD = Guard(["127.0.0.1:8765", "[::1]:8765", "Lab-PC:8765"], "a-token-of-16-or-more")


def ask(**headers: str) -> str | None:
    raw = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
    return GUARD.refuse_address(HTTPConnection({"type": "http", "headers": raw}))


@pytest.mark.parametrize("host", ["127.0.0.1:8765", "[::1]:8765", "lab-pc:8765"])
def test_own_names_are_served(host: str) -> None:
    assert ask(host=host) is None
    assert ask(host=host, origin=f"http://{host}") is None


@pytest.mark.parametrize("host", ["", "127.0.0.1", "127.0.0.1:80", "evil.example:8765", "127.0.0.1:8765.evil.example"])
def test_other_names_are_refused(host: str) -> None:
    assert "this server is not" in str(ask(host=host))


@pytest.mark.parametrize(
    "origin", ["null", "", "http://", "http://evil.example", "http://127.0.0.1:8765.evil.example", "127.0.0.1:8765"]
)
def test_pages_of_other_sites_are_refused(origin: str) -> None:
    assert ask(host="127.0.0.1:8765", origin=origin) == "a page of another site asked"


@pytest.mark.parametrize("token", ["", "a-token", "a-token-of-16-or-more ", "ä-token-of-16-or-more"])
def test_only_the_token_is_accepted(token: str) -> None:
    assert GUARD.refuse_token("a-token-of-16-or-more") is None
    assert "token is missing or wrong" in str(GUARD.refuse_token(token))
