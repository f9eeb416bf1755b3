"""`tacsim serve` in a process of its own, and a client of its page."""

from __future__ import annotations

import json
import re
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Self

from websockets import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from robot.fixtures import rig_addresses
from tests.robot.cli.invoked import environment
from tests.robot.waiting import PATIENCE

# Real time, without a simulation: the gels press by Hertz's closed form. Patient: a busy machine is no broken cable.
REAL_TIME = [
    word
    for override in (
        "contact=hertz",
        "lock_step=false",
        *(f"sensors.{name}.{each}" for name in ("lower", "upper") for each in ("max_age=20", "mock.fps=5")),
        *rig_addresses(),
    )
    for word in ("--set", override)
]
HEARTBEAT = 6.0  # of the served rigs, as patient [s]; shipped: 1 s
START = (
    sys.executable,
    "-c",
    f"import robot.serve.session as session; session.HEARTBEAT = {HEARTBEAT}; from robot.cli import main; main()",
)


class Served:
    """The server; stopped by SIGINT at the end, as by Ctrl-C."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [*START, "serve", *words, "--port", "0", "--out", str(folder / "episodes")],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment(),
        )  # fmt: skip
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        found = re.match(r"http://(127\.0\.0\.1:\d+)/#token=(\S+)$", line)
        assert found is not None, line + (self.process.communicate()[1] if self.process.poll() is not None else "")
        self.host, self.token = found[1], found[2]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.process.send_signal(2)
        try:
            self.errors = self.process.communicate(timeout=3 * PATIENCE)[1]  # it may write a report
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise

    def ask(
        self, method: str, path: str, body: Any = None, token: str | None = None, **headers: str
    ) -> tuple[int, Any]:
        """Status, and the JSON or text that comes back. token: the right one if left out, "" for none."""
        token = self.token if token is None else token
        given = {**({"Authorization": f"Bearer {token}"} if token else {}), **headers}
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"http://{self.host}{path}", data, given, method=method)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                status, text = answer.status, answer.read()
        except urllib.error.HTTPError as error:
            status, text = error.code, error.read()
        try:
            return status, json.loads(text)
        except ValueError:
            return status, text.decode()

    def post(self, path: str, **body: Any) -> tuple[int, Any]:
        return self.ask("POST", path, body)

    def live(self, origin: str | None = "") -> ClientConnection:
        """The stream. origin: the server's own if left out."""
        return connect(f"ws://{self.host}/live", origin=f"http://{self.host}" if origin == "" else origin)  # type: ignore[arg-type]


class Page:
    """A page that is open: it signs life, jogs while `jog` is set, and keeps the newest view."""

    def __init__(self, served: Served) -> None:
        self._stack = ExitStack()
        self._socket = self._stack.enter_context(served.live())
        self._token = served.token
        self.views: list[dict[str, Any]] = []
        self.pictures: dict[str, bytes] = {}
        self.jog: tuple[str, list[float]] | None = None
        self._closed, self._silent = threading.Event(), threading.Event()
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._read, self._beat)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def fall_silent(self) -> None:
        """Sends no sign of life any more."""
        self._silent.set()

    def close(self) -> None:
        self._closed.set()
        self._silent.set()
        self._stack.close()
        for thread in self._threads:
            thread.join()

    @property
    def view(self) -> dict[str, Any]:
        return self.views[-1] if self.views else {}

    def until(self, condition: Callable[[dict[str, Any]], bool], patience: float = PATIENCE) -> dict[str, Any]:
        """Waits for a view."""
        end = time.monotonic() + patience
        while not (self.view and condition(self.view)):
            assert time.monotonic() < end, self.view
            time.sleep(0.01)
        return self.view

    def until_phase(self, *phases: str) -> dict[str, Any]:
        return self.until(lambda view: view["phase"] in phases)

    def until_rest(self) -> dict[str, Any]:
        return self.until_phase("watching", "failed")

    def _read(self) -> None:
        try:
            for message in self._socket:
                assert isinstance(message, bytes)
                (size,) = struct.unpack(">I", message[:4])
                view = json.loads(message[4 : 4 + size])
                offset = 4 + size
                for name, length in view["pictures"].items():
                    self.pictures[name] = message[offset : offset + length]
                    offset += length
                assert offset == len(message)
                self.views = [*self.views[-500:], view]
        except Exception:
            if not self._closed.is_set():
                raise

    def _beat(self) -> None:
        while not self._silent.wait(0.1):
            message: dict[str, Any] = {"token": self._token}
            if self.jog is not None:
                message |= {"arm": self.jog[0], "jog": self.jog[1]}
            with suppress(ConnectionClosed):
                self._socket.send(json.dumps(message))
