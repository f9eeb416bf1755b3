"""A camera without a camera: MJPEG over HTTP from a process of its own, with faults on request.

``python -m robot.mock.camera.camera --help`` starts one by hand; :class:`MockCamera` starts one for a rig or a test.
The driver in `robot.camera.camera` reads it as it reads a real camera behind mjpg-streamer. Commands come as lines of
JSON on standard input, answers go to standard output; the process ends with its standard input, so it outlives no
parent.
"""

from __future__ import annotations

import argparse
import contextlib
import ipaddress
import json
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass, fields
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robot.errors import DeviceError, DeviceNotConnectedError

STREAM = "/?action=stream"  # where mjpg-streamer has its stream
ANSWER_TIMEOUT = 10.0  # a process that does not answer for so long is killed [s]
MAX_SIDE = 4096  # [px]


@dataclass(frozen=True, slots=True)
class MockCameraState:
    """What a mock camera has done so far, and what is wrong with it at present."""

    frames: int  # exposed
    images: int  # pushed
    dropped: int  # lost on purpose
    sent: int  # handed to clients, all together
    skipped: int  # that slow clients did not get, all together
    clients: int  # connected now
    stall: bool
    drop: float
    delay: float  # [s]
    corrupt: bool
    size: tuple[int, int] | None  # columns, rows [px]
    brightness: float
    refuse: bool


class MockCamera:
    """Starts the process, feeds it, breaks it, ends it. Safe to use from several threads."""

    def __init__(
        self,
        host: str = "127.0.0.2",
        port: int = 0,
        width: int = 320,
        height: int = 240,
        fps: float = 30.0,
        quality: int = 95,
        stamped: bool = True,
        *,
        allow_network: bool = False,
    ) -> None:
        """`width`, `height` of the picture of the gel [px]; with `stamped` each frame has the strip of
        `robot.common.stamp` below it. Port 0: any free one. Raises ValueError for a host that is not loopback unless
        `allow_network`, DeviceError when the process does not start (the port is taken, say)."""
        self.width, self.height = width, height
        self._lock = threading.Lock()
        _check_options(host, port, width, height, fps, quality, allow_network)
        options = {"host": host, "port": port, "width": width, "height": height, "fps": fps, "quality": quality}
        # The package has imported this module by the time that it is run, which is no news.
        command = [sys.executable, "-W", "ignore::RuntimeWarning:runpy", "-P", "-m", "robot.mock.camera.camera"]
        command += [part for name, value in options.items() for part in (f"--{name}", str(value))]
        command += ["--stamped"] * stamped + ["--allow-network"] * allow_network
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.pid = self._process.pid
        try:
            self.port = int(self._answer())
        except BaseException:
            self.close()
            raise
        self.host = host
        self.url = f"http://{host}:{self.port}{STREAM}"

    def push(self, image: NDArray[np.uint8]) -> int:
        """Shows (height, width, 3) uint8 RGB from now on, and sends it at once instead of at the next tick of `fps`: a
        rig in lock-step waits for it. Returns its number (1, 2, ...), which the stamps of its frames carry as `image`.
        The camera has it when this returns. Raises ValueError for another shape, DeviceNotConnectedError."""
        if image.shape != (self.height, self.width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"mock camera {self.url}: push needs ({self.height}, {self.width}, 3) uint8 RGB, "
                f"got {image.shape} {image.dtype}"
            )
        data = np.ascontiguousarray(image).tobytes()
        return int(self._ask({"push": len(data)}, data))

    def stall(self, on: bool) -> None:
        """No frame comes, connections stay."""
        self._ask({"stall": bool(on)})

    def drop(self, probability: float) -> None:
        """Frames get lost after they were numbered."""
        self._ask({"drop": _within(probability, 0.0, 1.0, "drop: probability")})

    def delay(self, seconds: float) -> None:
        """Frames are sent so long after their exposure [s]."""
        self._ask({"delay": _within(seconds, 0.0, 10.0, "delay [s]")})

    def corrupt(self, on: bool) -> None:
        """The second half of each JPEG is noise."""
        self._ask({"corrupt": bool(on)})

    def resize(self, width: int, height: int) -> None:
        """Pictures have another size than promised [px]; the promised one ends the fault."""
        size = [int(_within(each, 16, MAX_SIDE, "resize [px]")) for each in (width, height)]
        self._ask({"size": None if size == [self.width, self.height] else size})

    def brightness(self, factor: float) -> None:
        """Pictures are so much brighter; the strip stays readable."""
        self._ask({"brightness": _within(factor, 0.0, 100.0, "brightness")})

    def refuse(self, on: bool) -> None:
        """Nobody listens at the port; clients that are there stay."""
        self._ask({"refuse": bool(on)})

    def disconnect(self) -> int:
        """Cuts all clients; returns how many there were."""
        return int(self._ask({"disconnect": True}))

    def state(self) -> MockCameraState:
        """Counts and present faults."""
        answer = self._ask({"state": True})
        answer["size"] = None if answer["size"] is None else tuple(answer["size"])
        return MockCameraState(**{field.name: answer[field.name] for field in fields(MockCameraState)})

    @property
    def running(self) -> bool:
        """False once the process has ended."""
        return self._process.poll() is None

    def close(self) -> None:
        """Ends the process; harmless a second time."""
        with self._lock:
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None and not pipe.closed:
                    with contextlib.suppress(OSError):  # the process has gone first
                        pipe.close()
            try:
                self._process.wait(2.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _ask(self, command: dict[str, Any], data: bytes = b"") -> Any:
        with self._lock:
            stdin = self._process.stdin
            if stdin is None or stdin.closed:
                raise DeviceNotConnectedError(f"mock camera {self.url} is closed")
            # The timer guards the writing, too: a stopped process takes no more than what a pipe holds.
            watchdog = threading.Timer(ANSWER_TIMEOUT, self._process.kill)
            watchdog.start()
            try:
                stdin.write(json.dumps(command).encode() + b"\n" + data)
                stdin.flush()
                return self._read_answer()
            except (OSError, ValueError) as error:
                raise self._gone() from error
            finally:
                watchdog.cancel()

    def _answer(self) -> Any:
        watchdog = threading.Timer(ANSWER_TIMEOUT, self._process.kill)
        watchdog.start()
        try:
            return self._read_answer()
        finally:
            watchdog.cancel()

    def _read_answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise self._gone()
        answer = json.loads(line)
        if "error" in answer:
            raise DeviceError(f"mock camera: {answer['error']}")
        return answer["ok"]

    def _gone(self) -> DeviceNotConnectedError:
        try:
            code: object = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            code = "unknown"
        return DeviceNotConnectedError(
            f"mock camera (process {self.pid}): it has ended, exit status {code}; start another"
        )


def _within(value: float, low: float, high: float, what: str) -> float:
    if not low <= value <= high:  # also NaN
        raise ValueError(f"mock camera, {what}: must lie within {low:g} and {high:g}, got {value}")
    return value


def _check_options(
    host: str, port: int, width: int, height: int, fps: float, quality: int, allow_network: bool
) -> None:
    """Raises ValueError."""
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False  # a name: who knows where it leads
    if not (loopback or allow_network):
        raise ValueError(
            f"mock camera: '{host}' is no loopback address; use 127.x.y.z, or allow the network explicitly"
        )
    _within(port, 0, 65535, "port")
    _within(width, 16, MAX_SIDE, "width [px]")
    _within(height, 16, MAX_SIDE, "height [px]")
    _within(fps, 0.1, 1000.0, "fps")
    _within(quality, 50, 100, "quality of JPEG")


def main(arguments: list[str] | None = None) -> int:
    """The process: serves until standard input ends."""
    parser = argparse.ArgumentParser(
        prog="python -m robot.mock.camera.camera", description="MJPEG camera without a camera"
    )
    parser.add_argument("--host", default="127.0.0.2")
    parser.add_argument("--port", type=int, default=0, help="0: any free one")
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--quality", type=int, default=95, help="of JPEG, 50 to 100")
    parser.add_argument("--stamped", action="store_true", help="strip with number and clock below each picture")
    parser.add_argument("--allow-network", action="store_true", help="serve to other machines, too")
    options = vars(parser.parse_args(arguments))
    if not sys.stdin.isatty():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C means the parent, which ends this process in order
    stamped = options.pop("stamped")
    from robot.mock.camera.stream import FrameSource, Listener

    try:
        _check_options(**options)
        host, port = options.pop("host"), options.pop("port")
        options.pop("allow_network")
        source = FrameSource(**options, stamped=stamped)
        listener = Listener(host, port, source)
    except (OSError, ValueError) as error:
        _say({"error": f"cannot serve at {options.get('host', '')}: {error}"})
        return 2
    threading.Thread(target=source.run, name="exposure", daemon=True).start()
    _say({"ok": listener.port})
    shape = (source.height, source.width, 3)
    for line in sys.stdin.buffer:
        try:
            _say({"ok": _obey(json.loads(line), source, listener, shape)})
        except (OSError, ValueError, KeyError) as error:
            _say({"error": f"{type(error).__name__}: {error}"})
    source.close()
    listener.refuse()
    listener.disconnect()
    return 0


def _obey(command: dict[str, Any], source: Any, listener: Any, shape: tuple[int, int, int]) -> Any:
    """Does what one line of JSON says, {name: value}, and returns the answer."""
    ((name, value),) = command.items()
    if name == "push":
        data = sys.stdin.buffer.read(value)
        return source.push(np.frombuffer(data, dtype=np.uint8).reshape(shape))
    if name == "disconnect":
        return listener.disconnect()
    if name == "state":
        return {**source.state(), "clients": listener.clients()}
    if name not in ("stall", "drop", "delay", "corrupt", "size", "brightness", "refuse"):
        raise ValueError(f"no command '{name}'")
    if name == "refuse":
        listener.refuse() if value else listener.listen()
    source.set_fault(name, value)
    return None


def _say(answer: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
