"""A mock camera: MJPEG over HTTP from a separate process (`python -m robot.mock.camera`), with faults on request.

The driver in `robot.camera.camera` reads it like a real camera behind mjpg-streamer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.common import require_loopback
from robot.common.process import Child

STREAM = "/?action=stream"  # path of the stream of mjpg-streamer
ANSWER_TIMEOUT = 10.0  # of a request; then the process is killed [s]
MAX_SIDE = 4096  # [px]


@dataclass(frozen=True, slots=True)
class Faults:
    """The present faults of the camera."""

    stall: bool = False  # connections stay open, no frame is sent
    drop: float = 0.0  # probability that a frame is lost after it was numbered
    delay: float = 0.0  # from exposure to sending [s]
    freeze: bool = False  # the same JPEG is sent repeatedly
    corrupt: bool = False  # the second half of each JPEG is noise
    cut: bool = False  # the second half of each JPEG is lost, except its end marker
    flip: int = 0  # number of bytes of each JPEG that are changed
    size: tuple[int, int] | None = None  # columns, rows of the image, if they differ from the configured ones [px]
    brightness: float = 1.0  # factor on the image; the strip stays readable
    refuse: bool = False  # the port is closed


@dataclass(frozen=True, slots=True, kw_only=True)
class MockCameraState(Faults):
    """Counts of a mock camera, and its present faults."""

    frames: int  # exposed
    images: int  # pushed
    dropped: int  # lost by injected faults
    sent: int  # frames sent, summed over the clients
    skipped: int  # frames not sent to slow clients, summed over the clients
    clients: int  # connected now


class MockCamera(Child):
    """Handle of a mock camera: starts the process, sets its image and faults, ends it. Threads may share a handle."""

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
        """Starts the process.

        width, height: of the image of the gel [px].
        stamped: each frame has the strip of `robot.common.stamp` below the image.
        noise: maximum deviation of a value [grey levels]. None: 0 with stamps; 2 without, like a real sensor, so that
            the camera does not count as frozen when nothing moves.
        port: 0 selects any free port.

        Raises ValueError for a host that is not loopback unless `allow_network`, DeviceError if the process does not
        start (for example because the port is taken).
        """
        require_loopback(host, "mock camera", allow_network=allow_network)
        _require_within(port, 0, 65535, "port")
        _require_within(width, 16, MAX_SIDE, "width [px]")
        _require_within(height, 16, MAX_SIDE, "height [px]")
        _require_within(fps, 0.1, 1000.0, "fps")
        _require_within(quality, 50, 100, "quality of JPEG")
        self.host, self.width, self.height = host, width, height
        amount = int(_require_within((0 if stamped else 2) if noise is None else noise, 0, 20, "noise [grey levels]"))
        source: dict[str, Any] = {"width": width, "height": height, "fps": fps, "quality": quality}
        source |= {"stamped": stamped, "noise": amount}
        request = {"host": host, "port": port, "source": source}
        name = f"mock camera at {host}"
        super().__init__("robot.mock.camera", name=name, ready_timeout=ANSWER_TIMEOUT, first_request=request)
        self.port = int(self.ready["port"])
        self.url = f"http://{host}:{self.port}{STREAM}"

    def push(self, image: NDArray[np.uint8]) -> int:
        """Sets the image, (height, width, 3) uint8 RGB, and sends it at once, not at the next tick of `fps`: a rig in
        lock step waits for it. Returns its number (1, 2, ...), which the stamps of its frames contain as `image`.
        The camera has the image on return. Raises ValueError for another shape, DeviceNotConnectedError."""
        if image.shape != (self.height, self.width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"mock camera {self.url}: push needs ({self.height}, {self.width}, 3) uint8 RGB, "
                f"got {image.shape} {image.dtype}"
            )
        return int(self._ask("push", picture=image))

    def stall(self, on: bool) -> None:
        """No frame is sent, connections stay open; frames that were exposed and not yet sent are lost."""
        self._ask("stall", bool(on))

    def drop(self, probability: float) -> None:
        """Frames are lost with this probability after they were numbered."""
        self._ask("drop", _require_within(probability, 0.0, 1.0, "drop: probability"))

    def delay(self, seconds: float) -> None:
        """Frames are sent this time after their exposure [s]."""
        self._ask("delay", _require_within(seconds, 0.0, 10.0, "delay [s]"))

    def corrupt(self, on: bool) -> None:
        """The second half of each JPEG is noise."""
        self._ask("corrupt", bool(on))

    def freeze(self, on: bool) -> None:
        """The same JPEG is sent repeatedly, at the same rate."""
        self._ask("freeze", bool(on))

    def cut(self, on: bool) -> None:
        """The second half of each JPEG is lost, except its end marker: decoders fill it with grey or the last row."""
        self._ask("cut", bool(on))

    def flip(self, count: int) -> None:
        """Changes this number of bytes of each JPEG after its header; 0 ends the fault."""
        self._ask("flip", int(_require_within(count, 0, 1_000_000, "flip: bytes")))

    def resize(self, width: int, height: int) -> None:
        """Images have another size than configured [px]; the configured size ends the fault."""
        size = [int(_require_within(each, 16, MAX_SIDE, "resize [px]")) for each in (width, height)]
        self._ask("size", None if size == [self.width, self.height] else size)

    def brightness(self, factor: float) -> None:
        """Multiplies image values by a factor; the strip stays readable."""
        self._ask("brightness", _require_within(factor, 0.0, 100.0, "brightness"))

    def refuse(self, on: bool) -> None:
        """The port refuses new clients; connected clients stay."""
        self._ask("refuse", bool(on))

    def disconnect(self) -> int:
        """Disconnects all clients; returns their number."""
        return int(self._ask("disconnect"))

    def state(self) -> MockCameraState:
        """Counts and present faults."""
        answer = self._ask("state")
        answer["size"] = None if answer["size"] is None else tuple(answer["size"])
        return MockCameraState(**answer)

    def _ask(self, command: str, value: Any = None, **pictures: NDArray[np.uint8]) -> Any:
        return self.request({"do": command, "value": value}, pictures, timeout=ANSWER_TIMEOUT)[0]["result"]


def _require_within(value: float, low: float, high: float, what: str) -> float:
    if not low <= value <= high:  # also NaN
        raise ValueError(f"mock camera, {what}: must be within {low:g} and {high:g}, got {value}")
    return value
