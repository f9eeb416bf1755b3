"""Tests meet simulated hardware only: no socket leaves this machine, no serial port and no camera is opened.

The guards hold in the test's own process; a process that a test starts must be pointed at loopback by the test.
"""

from __future__ import annotations

import builtins
import io
import ipaddress
import os
import signal
import socket
from collections.abc import Callable, Iterator
from numbers import Integral
from pathlib import Path
from typing import Any

import hypothesis
import pytest

hypothesis.settings.register_profile("tacsim", deadline=None)  # no test depends on speed
hypothesis.settings.load_profile("tacsim")
pytest_plugins = ["tests.promises"]  # figures of what is promised of arms and cameras
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("TACSIM_THREADS", "1")  # every process has a core
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command has it: the last bits depend on it

DEVICES = ("/dev/tty", "/dev/video", "/dev/v4l", "/dev/serial")


@pytest.fixture(autouse=True, scope="session")
def interruptible() -> Iterator[None]:
    """Signals work in tests whoever started them: a shell's background job inherits SIGINT as ignored, `nohup`'s
    SIGHUP, and so would the processes that tests start."""
    before = {
        number: signal.signal(number, handler)
        for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL))
    }
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


class RealHardware(AssertionError):
    """A test reached for something outside this machine's memory and disk."""


def is_local(address: object) -> bool:
    """True for loopback addresses and Unix sockets; a host name counts as outside, except localhost."""
    if not isinstance(address, tuple):
        return True  # AF_UNIX: a path
    host = str(address[0])
    if host in ("localhost", ""):
        return True
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


def _guard_socket(method: Callable[..., Any], address_of: Callable[[tuple[Any, ...]], object]) -> Callable[..., Any]:
    def guarded(self: socket.socket, *arguments: Any) -> Any:
        address = address_of(arguments)
        if not is_local(address):
            self.close()  # whoever made it does not expect this error, and would leak it
            raise RealHardware(f"test opened a socket to {address!r}; only loopback is allowed: use the mock hardware")
        return method(self, *arguments)

    return guarded


def _guard_path(function: Callable[..., Any]) -> Callable[..., Any]:
    def guarded(file: Any, *arguments: Any, **options: Any) -> Any:
        if isinstance(file, str | bytes | os.PathLike) and os.fsdecode(file).startswith(DEVICES):
            raise RealHardware(f"test opened the device {os.fsdecode(file)}: use the mock hardware")
        return function(file, *arguments, **options)

    return guarded


def _guard_camera(capture: type) -> type:
    class GuardedCapture:
        """Holds a capture instead of inheriting: OpenCV's type crashes when it is subclassed."""

        def __init__(self, *arguments: Any, **options: Any) -> None:
            _refuse_camera(arguments, options)
            self._capture = capture(*arguments, **options)

        def open(self, *arguments: Any, **options: Any) -> Any:
            _refuse_camera(arguments, options)
            return self._capture.open(*arguments, **options)

        def __getattr__(self, attribute: str) -> Any:
            return getattr(self._capture, attribute)

    return GuardedCapture


def _refuse_camera(arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
    source = arguments[0] if arguments else options.get("index", options.get("filename"))
    if isinstance(source, Integral) or str(source).startswith(DEVICES):
        raise RealHardware(f"test opened camera {source!r}: use recorded or simulated frames")


@pytest.fixture(autouse=True)
def no_real_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sockets outside loopback, serial devices and cameras raise RealHardware."""
    real = socket.socket
    monkeypatch.setattr(real, "connect", _guard_socket(real.connect, lambda given: given[0]))
    monkeypatch.setattr(real, "connect_ex", _guard_socket(real.connect_ex, lambda given: given[0]))
    monkeypatch.setattr(real, "sendto", _guard_socket(real.sendto, lambda given: given[-1]))
    monkeypatch.setattr(
        real, "sendmsg", _guard_socket(real.sendmsg, lambda given: given[3] if len(given) > 3 else None)
    )
    monkeypatch.setattr(builtins, "open", _guard_path(builtins.open))
    monkeypatch.setattr(io, "open", _guard_path(io.open))
    monkeypatch.setattr(os, "open", _guard_path(os.open))
    import cv2

    monkeypatch.setattr(cv2, "VideoCapture", _guard_camera(cv2.VideoCapture))
