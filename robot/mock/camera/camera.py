"""A camera without a camera: MJPEG over HTTP from a process of its own (`python -m robot.mock.camera`), with faults on
request.

The driver in `robot.camera.camera` reads it as it reads a real camera behind mjpg-streamer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.common.loopback import require_loopback
from robot.common.process import Child

STREAM = "/?action=stream"  # where mjpg-streamer has its stream
ANSWER_TIMEOUT = 10.0  # a process that does not answer for so long is killed [s]
MAX_SIDE = 4096  # [px]


@dataclass(frozen=True, slots=True)
class Faults:
    """What is wrong with the camera at present."""

    stall: bool = False  # connections stay, no frame comes
    drop: float = 0.0  # probability that a frame is lost after it was numbered
    delay: float = 0.0  # from exposure to sending [s]
    freeze: bool = False  # the same JPEG comes again and again
    corrupt: bool = False  # the second half of each JPEG is noise
    cut: bool = False  # the second half of each JPEG is lost, all but its end marker
    flip: int = 0  # so many bytes of each JPEG are others
    size: tuple[int, int] | None = None  # columns, rows of the picture, other than promised [px]
    brightness: float = 1.0  # factor on the picture; the strip stays readable
    refuse: bool = False  # the port is closed


@dataclass(frozen=True, slots=True, kw_only=True)
class MockCameraState(Faults):
    """What a mock camera has done so far, and what is wrong with it at present."""

    frames: int  # exposed
    images: int  # pushed
    dropped: int  # lost on purpose
    sent: int  # handed to clients, all together
    skipped: int  # that slow clients did not get, all together
    clients: int  # connected now


class MockCamera(Child):
    """Handle of a mock camera: starts the process, gives it pictures, breaks it, ends it. Threads may share one."""

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
        noise: int | None = None,
        allow_network: bool = False,
    ) -> None:
        """`width`, `height` of the picture of the gel [px]; with `stamped` each frame has the strip of
        `robot.common.stamp` below it. `noise`: no value of a frame is farther off than that [grey levels]; None: 2
        without stamps, as a real sensor's, so that the camera is not taken for a frozen one when nothing moves; 0 with
        stamps. Port 0: any free one. Raises ValueError for a host that is not loopback unless
        `allow_network`, DeviceError when the process does not start (the port is taken, say)."""
        require_loopback(host, "mock camera", allow_network=allow_network)
        _within(port, 0, 65535, "port")
        _within(width, 16, MAX_SIDE, "width [px]")
        _within(height, 16, MAX_SIDE, "height [px]")
        _within(fps, 0.1, 1000.0, "fps")
        _within(quality, 50, 100, "quality of JPEG")
        self.host, self.width, self.height = host, width, height
        amount = int(_within((0 if stamped else 2) if noise is None else noise, 0, 20, "noise [grey levels]"))
        source: dict[str, Any] = {"width": width, "height": height, "fps": fps, "quality": quality}
        source |= {"stamped": stamped, "noise": amount}
        request = {"host": host, "port": port, "source": source}
        name = f"mock camera at {host}"
        super().__init__("robot.mock.camera", name=name, ready_timeout=ANSWER_TIMEOUT, first_request=request)
        self.port = int(self.ready["port"])
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
        return int(self._ask("push", picture=image))

    def stall(self, on: bool) -> None:
        """No frame comes, connections stay; what was exposed and not yet sent is lost."""
        self._ask("stall", bool(on))

    def drop(self, probability: float) -> None:
        """Frames get lost after they were numbered."""
        self._ask("drop", _within(probability, 0.0, 1.0, "drop: probability"))

    def delay(self, seconds: float) -> None:
        """Frames are sent so long after their exposure [s]."""
        self._ask("delay", _within(seconds, 0.0, 10.0, "delay [s]"))

    def corrupt(self, on: bool) -> None:
        """The second half of each JPEG is noise."""
        self._ask("corrupt", bool(on))

    def freeze(self, on: bool) -> None:
        """The same JPEG comes again and again, at the same rate."""
        self._ask("freeze", bool(on))

    def cut(self, on: bool) -> None:
        """The second half of each JPEG is lost, all but its end marker: plain decoders repeat grey or the last row."""
        self._ask("cut", bool(on))

    def flip(self, count: int) -> None:
        """So many bytes of each JPEG, behind its header, are others than were sent; 0 ends the fault."""
        self._ask("flip", int(_within(count, 0, 1_000_000, "flip: bytes")))

    def resize(self, width: int, height: int) -> None:
        """Pictures have another size than promised [px]; the promised one ends the fault."""
        size = [int(_within(each, 16, MAX_SIDE, "resize [px]")) for each in (width, height)]
        self._ask("size", None if size == [self.width, self.height] else size)

    def brightness(self, factor: float) -> None:
        """Pictures are so much brighter; the strip stays readable."""
        self._ask("brightness", _within(factor, 0.0, 100.0, "brightness"))

    def refuse(self, on: bool) -> None:
        """The port refuses new clients; those that are connected stay."""
        self._ask("refuse", bool(on))

    def disconnect(self) -> int:
        """Cuts all clients; returns how many there were."""
        return int(self._ask("disconnect"))

    def state(self) -> MockCameraState:
        """Counts and present faults."""
        answer = self._ask("state")
        answer["size"] = None if answer["size"] is None else tuple(answer["size"])
        return MockCameraState(**answer)

    def _ask(self, command: str, value: Any = None, **pictures: NDArray[np.uint8]) -> Any:
        return self.ask({"do": command, "value": value}, pictures, timeout=ANSWER_TIMEOUT)[0]["result"]


def _within(value: float, low: float, high: float, what: str) -> float:
    if not low <= value <= high:  # also NaN
        raise ValueError(f"mock camera, {what}: must lie within {low:g} and {high:g}, got {value}")
    return value
