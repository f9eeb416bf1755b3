"""`tacsim serve`: addresses, tokens and ports that are refused before a rig is opened."""

from __future__ import annotations

import signal
import socket
from pathlib import Path

import pytest

from robot.cli.serve import TOKEN
from tests.robot.cli.invoked import TINY, plain_text, tacsim
from tests.robot.serve.served import Page, Served
from tests.robot.waiting import PATIENCE


@pytest.mark.parametrize("address", ["0.0.0.0", "192.0.2.1", "::"])
def test_an_address_beyond_this_machine_needs_a_token(address: str) -> None:
    result = tacsim("serve", "mock", "--bind", address)
    assert result.exit_code == 2
    assert f"{address} can be reached from other machines: set {TOKEN}" in plain_text(result.output)


@pytest.mark.parametrize("token", ["short", "x" * 20 + " y", "ü" * 20])
def test_a_weak_token_is_refused(token: str) -> None:
    result = tacsim("serve", "mock", **{TOKEN: token})
    assert result.exit_code == 2
    assert "at least 16 printable characters without spaces" in plain_text(result.output)


def test_a_taken_port_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        result = tacsim("serve", "mock", "--port", port)
    assert result.exit_code == 2
    assert f"127.0.0.1:{port} cannot be listened on" in plain_text(result.output)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "uvicorn" else find(name))
    result = tacsim("serve", "mock")
    assert result.exit_code == 2
    assert "tacsim serve needs uvicorn, which is not installed: pip install 'tacsim[web]'" in plain_text(result.output)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_server_in_order(number: signal.Signals, tmp_path: Path) -> None:
    """Nothing of the rig is left: Python would warn of its semaphores. A service manager sends SIGTERM."""
    served = Served(tmp_path, "sim", *TINY)
    with Page(served) as page:
        page.until_rest()
    served.process.send_signal(number)
    errors = served.process.communicate(timeout=PATIENCE)[1]
    assert served.process.returncode == 128 + number
    assert "leaked" not in errors and "Traceback" not in errors
